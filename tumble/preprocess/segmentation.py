"""Parts of the segmentation of a video that concern one frame: where the object is marked, its mask, the mask's parts.

The camera stands still, so pixels that differ from the static *background* are the object or a hand that holds it. A
mask has three values: pixels that are neither object nor certainly background are unknown, as is a band along the
silhouette. The masks of all frames are in `preprocess.propagation`. The *confidence* of a frame is the overlap of the
mask predicted by optical flow with the final mask.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from tumble.maths import filled_hull, iou
from tumble.preprocess.background import MIN_DIFFERENCE, Background, channel_max, moved_along
from tumble.preprocess.colour_model import skin_coloured
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

CERTAIN_OVERLAP = 0.85
"""Minimum overlap (IoU) of predicted and final mask; a frame below is marked uncertain."""
MAX_AREA_RATIO = 1.2
"""Maximum ratio of the areas of consecutive masks; a frame beyond is marked uncertain."""
LOST_OVERLAP = 0.4
"""Minimum overlap (IoU) of predicted and final mask; below it the object counts as hidden in the frame."""
MIN_PIXELS = 30
"""Minimum area of the object; a smaller mask cannot be tracked [pixels]."""
SEARCH_FRACTION = 0.06
"""Maximum distance of a silhouette from its prediction, as a fraction of the square root of its area."""
MIN_MOVED_FRACTION = 0.03
"""Minimum fraction of pixels that differ from the background in a hand that holds still: its edges."""
MIN_MOVING_FRACTION = 0.1
"""Minimum fraction of the box that differs from the background, or has none that is known; with less, the background
inside the box is not used."""
MIN_STATIC_PART = 0.02
"""Minimum area of a static part that may be the object, as a fraction of the box; smaller ones are closed as holes."""
MAX_ALIKE = 0.01
"""Fraction of the surroundings of the box with the colour of a static part, below which that part may be the object."""
EDGE_MARGIN = 2
"""Width of the edge around such a part [pixels]."""
MIN_PART_FRACTION = 0.15
"""Minimum area of further components of the object (behind a finger), as a fraction of the largest one."""
MAX_HOLE_FRACTION = 0.03
"""Maximum area of a hole labelled unknown, as a fraction of the object's; the handle of a mug is larger."""
GRABCUT_SEED = 7
"""Seed of OpenCV's random numbers, from which GrabCut initialises its colour models."""


@dataclass(frozen=True)
class Seed:
    """Position of the object on one frame, as a box or a click."""

    index: int
    """Index of the frame."""
    box: tuple[int, int, int, int] | None = None
    """Left, top, width, height of a box around the whole object [pixels]."""
    click: tuple[int, int] | None = None
    """Column and row of a pixel on the object [pixels]."""


@dataclass(frozen=True)
class Masks:
    """Three-valued masks of all frames, with their confidence."""

    labels: UInt8[np.ndarray, "t h w"]
    """OBJECT, UNKNOWN or BACKGROUND."""
    confidence: Float32[np.ndarray, " t"]
    """Overlap (IoU) of predicted and final mask; 0 where the object was not found."""
    uncertain: Bool[np.ndarray, " t"]
    """Frames whose mask should be checked by eye."""
    doubted: Bool[np.ndarray, "t h w"] | None = None
    """Pixels that may be object where the labels say background, because both have the same colours there; None: none.
    """

    def with_doubt(self, i: int) -> UInt8[np.ndarray, "h w"]:
        """The labels of a frame as they are in a capture: doubted background is unknown."""
        return self.labels[i] if self.doubted is None else with_doubt(self.labels[i], self.doubted[i])


def exclude_possible_object(background: Background, image: UInt8[np.ndarray, "h w 3"], seed: Seed) -> Background:
    """The background for the seed frame, without the pixels that may be the object itself.

    An object of one colour that rotates in place looks static. So inside the box, pixels that match the background are
    accepted as background only if they are connected to the border of the box. Where the silhouette keeps its place,
    such an object is connected to it, too; then an edge separates both, and nothing around the box has its colour.
    """
    static, moving = opened(background.same(image), 1), opened(background.differs(image), 1)
    inside = box_mask(moving.shape, seed.box or box_around(seed.click, moving))
    rim = inside & ~eroded(inside, 1)
    enclosed = _enclosed(static & inside, rim)
    count, ids = components(_enclosed(static & inside & ~_edges(image), rim))
    for k in 1 + np.flatnonzero(np.bincount(ids.ravel(), minlength=count)[1:] > MIN_STATIC_PART * inside.sum()):
        colour = np.median(image[ids == k], 0).astype(np.int16)
        alike = channel_max(np.abs(image.astype(np.int16) - colour)) < MIN_DIFFERENCE
        if alike[~inside].sum() < MAX_ALIKE * (~inside).sum():
            enclosed |= dilated(ids == k, EDGE_MARGIN) & static & inside
    mostly_static = ((moving | ~background.known) & inside).sum() < MIN_MOVING_FRACTION * inside.sum()
    return replace(background, known=background.known & ~(inside if mostly_static else enclosed))


def _enclosed(mask: Bool[np.ndarray, "h w"], rim: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The connected components of a mask that do not reach the rim."""
    _, ids = components(mask)
    return mask & ~np.isin(ids, np.unique(ids[rim]))


def _edges(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose neighbours differ by more than shadows and codec artefacts do."""
    square = np.ones((3, 3), np.uint8)
    return channel_max(cv2.subtract(cv2.dilate(image, square), cv2.erode(image, square))) > MIN_DIFFERENCE


def moving_skin(image: UInt8[np.ndarray, "h w 3"], background: Background) -> Bool[np.ndarray, "h w"]:
    """Connected components of skin colour that move, for the frames before the object is known.

    A hand that holds still becomes part of the static background except for its edges, so a few moving pixels suffice.
    A wooden table does not move; an object of the colour of skin is included.
    """
    count, ids = components(opened(skin_coloured(image), 1))
    sizes = np.bincount(ids.ravel(), minlength=count)
    moved = np.bincount(ids[background.differs(image) | ~background.known], minlength=count)
    keep = moved > MIN_MOVED_FRACTION * sizes
    keep[0] = False
    return keep[ids]


def find_seed(images: UInt8[np.ndarray, "t h w 3"], background: Background) -> Seed | None:
    """A box around the largest moving component that is not skin-coloured, over nine frames; None if nothing moves.

    The default for footage without box and click. It may be wrong: a sleeve or a turntable moves as well.
    """
    best, largest = None, MIN_PIXELS
    for i in np.unique(np.linspace(0, len(images) - 1, 9).round().astype(int)):
        changing = background.differs(images[i]) | ~background.known
        moving = opened(changing & ~skin_coloured(images[i]), 2)
        count, _, stats, _ = cv2.connectedComponentsWithStats(closed(moving, 4).astype(np.uint8))
        if count < 2:
            continue
        left, top, width, height, area = stats[1:][stats[1:, cv2.CC_STAT_AREA].argmax()].tolist()
        if area > largest:
            margin = 2 + round(0.05 * max(width, height))
            h, w = moving.shape
            left, top = max(left - margin, 0), max(top - margin, 0)
            box = (left, top, min(width + 2 * margin, w - left), min(height + 2 * margin, h - top))
            best, largest = Seed(int(i), box), area
    return best


def make_trimap(
    inside: Bool[np.ndarray, "h w"], unknown: Bool[np.ndarray, "h w"], band: int
) -> UInt8[np.ndarray, "h w"]:
    """Label a mask's inside OBJECT, and a band along its silhouette and other pixels UNKNOWN.

    Small holes are unknown as well: a dark texture in front of a dark wall looks like a hole, and would be carved out
    of the visual hull.

    Args:
        inside: Pixels of the object.
        unknown: Pixels that are neither object nor certainly background.
        band: Half the width of the band, which straddles the silhouette [pixels].
    """
    labels = np.where(dilated(inside, band) | unknown, np.uint8(UNKNOWN), np.uint8(BACKGROUND))
    labels[eroded(inside, band)] = OBJECT
    _, ids, stats, _ = cv2.connectedComponentsWithStats((labels == BACKGROUND).astype(np.uint8), connectivity=4)
    left, top, width, height, area = stats.T
    enclosed = (left > 0) & (top > 0) & (left + width < labels.shape[1]) & (top + height < labels.shape[0])
    labels[(enclosed & (area < MAX_HOLE_FRACTION * inside.sum()))[ids]] = UNKNOWN
    return labels


def possible_object(labels: UInt8[np.ndarray, "t h w"]) -> Bool[np.ndarray, "t h w"]:
    """Pixels of the object, and unknown ones within its convex hull: these may be a print in a hand's colours."""
    pixels = (np.argwhere(mask == OBJECT)[:, ::-1].astype(np.int32, order="C") for mask in labels)
    return np.stack([filled_hull(each, labels.shape[1:]) for each in pixels]) & (labels != BACKGROUND)


def with_doubt(labels: UInt8[np.ndarray, "h w"], doubted: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Labels in which doubted background is unknown."""
    return np.where((labels == BACKGROUND) & doubted, np.uint8(UNKNOWN), labels)


def refine_mask(
    image: UInt8[np.ndarray, "h w 3"], coarse: UInt8[np.ndarray, "h w"], radius: int
) -> UInt8[np.ndarray, "h w"]:
    """Align an enlarged mask with the edges of the image, by GrabCut within `radius` of its silhouette.

    Args:
        coarse: OBJECT, UNKNOWN or BACKGROUND, enlarged to the image's size.
        radius: Width of the uncertain band [pixels].
    """
    inner, outer = coarse == OBJECT, coarse != BACKGROUND
    near = dilated(inner, radius)
    trimap = np.where(near, np.uint8(cv2.GC_PR_BGD), np.uint8(cv2.GC_BGD))
    trimap[inner] = cv2.GC_PR_FGD
    trimap[eroded(inner, radius)] = cv2.GC_FGD
    if not (trimap == cv2.GC_FGD).any() or not (trimap == cv2.GC_BGD).any():
        return coarse
    return make_trimap(main_components(grabcut(image, trimap, 2), inner), outer & ~near, 1)


def overlap(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union (IoU); 0 for two empty masks."""
    return float(iou(torch.from_numpy(a), torch.from_numpy(b)))


def is_lost(agreement: float, area: int) -> bool:
    """Whether the object counts as hidden in a frame, from the overlap of its mask with the prediction and its area."""
    return area < MIN_PIXELS or agreement < LOST_OVERLAP


def is_uncertain(agreement: float, old_area: int, new_area: int) -> bool:
    """Whether the mask of a frame should be checked by eye, from its overlap and the areas of the last two masks."""
    return agreement < CERTAIN_OVERLAP or not 1 / MAX_AREA_RATIO < new_area / max(old_area, 1) < MAX_AREA_RATIO


def warped(dis: cv2.DISOpticalFlow, gray: np.ndarray, previous: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Probabilities of the previous frame, warped to this one along the optical flow."""
    return moved_along(dis.calc(gray, previous, np.zeros((*gray.shape, 2), np.float32)), probability)


def search_radius(mask: np.ndarray) -> int:
    return max(2, round(SEARCH_FRACTION * float(np.sqrt(mask.sum()))))


def box_mask(shape: tuple[int, ...], box: tuple[int, int, int, int]) -> np.ndarray:
    left, top, width, height = box
    inside = np.zeros(shape, bool)
    inside[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)] = True
    return inside


def box_around(click: tuple[int, int] | None, moving: np.ndarray) -> tuple[int, int, int, int]:
    """Square around a clicked pixel, sized by the moving component there, at least a quarter of the image wide."""
    if click is None:
        raise ValueError("a seed needs a box or a click")
    h, w = moving.shape
    column, row = min(max(click[0], 0), w - 1), min(max(click[1], 0), h - 1)
    _, ids = components(closed(moving, 4))
    component = (ids == ids[row, column]) & (ids[row, column] > 0)
    half = round(0.125 * min(h, w))
    if component.any():
        rows, columns = np.nonzero(component)
        spans = [column - columns.min(), columns.max() - column, row - rows.min(), rows.max() - row]
        half = max(half, round(1.1 * float(np.median(spans))))
    return column - half, row - half, 2 * half + 1, 2 * half + 1


def disc_around(click: tuple[int, int], box: np.ndarray) -> np.ndarray:
    """Pixels around a clicked one that belong to the object, given the mask of its box."""
    disc = np.zeros(box.shape, np.uint8)
    cv2.circle(disc, click, max(3, round(0.05 * float(np.sqrt(box.sum())))), 1, -1)
    return disc > 0


# GrabCut and morphology -----------------------------------------------------------------------------------------------


def grabcut(image: np.ndarray, trimap: np.ndarray, steps: int) -> np.ndarray:
    cv2.setRNGSeed(GRABCUT_SEED)
    trimap = np.ascontiguousarray(trimap)
    mixtures = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(image), trimap, (0, 0, 0, 0), *mixtures, steps, cv2.GC_INIT_WITH_MASK)
    return (trimap & 1) > 0


def main_components(mask: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """The component that overlaps the expected object most, and other large ones, with small holes closed."""
    count, ids = components(mask)
    overlaps = np.bincount(ids[expected], minlength=count)
    overlaps[0] = 0
    if not overlaps.any():
        return _empty_like(mask)
    return closed((overlaps > MIN_PART_FRACTION * overlaps.max())[ids], 1)


def components(mask: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of labels, and the label of the connected component of every pixel; label 0 is outside the mask."""
    count, ids = cv2.connectedComponents(mask.astype(np.uint8))
    return count, np.asarray(ids, np.int32)


def touching(mask: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Connected components of a mask that a region touches."""
    count, ids = components(mask)
    keep = np.bincount(ids[where], minlength=count) > 0
    keep[0] = False
    return keep[ids]


def _empty_like(mask: np.ndarray) -> np.ndarray:
    return np.zeros(mask.shape, bool)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def dilated(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), _disc(radius)) > 0


def eroded(mask: np.ndarray, radius: int) -> np.ndarray:
    """Erosion that does not shrink the mask at the image border."""
    return cv2.erode(mask.astype(np.uint8), _disc(radius)) > 0


def opened(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(radius)) > 0


def closed(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, _disc(radius)) > 0
