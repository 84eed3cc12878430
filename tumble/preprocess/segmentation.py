"""Video object segmentation from a box or a click on one frame, without trained weights.

The camera stands still, so pixels that differ from the static *background* are the object or the hand that holds it. On
the *seed* frame GrabCut finds the object in the box. From there the mask is propagated forwards and backwards by
optical flow (DIS): the warped mask is the prior of the next frame, and the colour model and the static background
decide (`colour_model`). Moving pixels that are not object are unknown: a hand, a sleeve, a shadow. So is a band of
pixels along the silhouette.

Limits: a hand of the object's colour is not separated from it; there is no edge between object and background of one
colour where the background is unknown; a hand in front of the object from the first frame on is found only by the
colour of skin. The *confidence* of a frame is the overlap of the mask predicted by flow with the final mask.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from tumble.maths import filled_hull, iou
from tumble.preprocess.background import MIN_DIFFERENCE, Background, channel_max
from tumble.preprocess.colour_model import (
    SEED_WEIGHT,
    ColourModel,
    initial_colours,
    is_alike,
    mean_field_probability,
    object_log_odds,
    object_log_ratio,
    skin_coloured,
    trim_rim,
)
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
MIN_PRIOR = 0.01
"""Lower limit of the prior probability, because optical flow alone is not conclusive."""
MAX_PRIOR = 0.98
"""Upper limit of the prior probability."""
MIN_HAND_LOG_RATIO = 1.5
"""Minimum log likelihood ratio of hand to object colours of a pixel that may be hand."""
MAX_HAND_GAP = 3
"""Maximum distance of a hand from the object [pixels]."""
MIN_MOVED_FRACTION = 0.03
"""Minimum fraction of pixels that differ from the background in a hand that holds still: its edges."""
MIN_FRACTION_OUTSIDE = 0.1
"""Minimum fraction of a hand that lies outside the region in which the object is expected."""
MAX_COVER_OUTSIDE = 0.5
"""Maximum fraction of the image outside the region in which the object is expected that one hand covers; a wall covers
more."""
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


@dataclass(frozen=True)
class _Segmentation:
    """Segmentation of one frame."""

    inside: Bool[np.ndarray, "h w"]
    """Pixels of the object."""
    unknown: Bool[np.ndarray, "h w"]
    """Other pixels that are not certainly background: moving ones, hands, undecided ones."""
    probability: Float32[np.ndarray, "h w"]
    """Probability of the object; 0 far from it."""
    alike: Bool[np.ndarray, "h w"]
    """Pixels close to the object that are rather background, but whose colours the object may have, too."""


def segment(images: UInt8[np.ndarray, "t h w 3"], background: Background, seed: Seed) -> Masks:
    """Masks of all frames from a box or a click on one.

    Raises:
        ValueError: No object was found at the seed.
    """
    first, colours = _segment_seed(images[seed.index], background, seed)
    if first.inside.sum() < MIN_PIXELS:
        raise ValueError(f"shows no object in the box, or at the click, on frame {seed.index}")
    labels, doubted = np.zeros(images.shape[:3], np.uint8), np.zeros(images.shape[:3], bool)
    confidence, uncertain = np.ones(len(images), np.float32), np.zeros(len(images), bool)
    labels[seed.index] = make_trimap(trim_rim(first.inside, images[seed.index], background), first.unknown, 1)
    doubted[seed.index] = first.alike
    for order in (range(seed.index + 1, len(images)), range(seed.index - 1, -1, -1)):
        for i, current, agreement, is_uncertain in _track(images, order, seed.index, first, background, colours):
            labels[i] = make_trimap(trim_rim(current.inside, images[i], background), current.unknown, 1)
            doubted[i], confidence[i], uncertain[i] = current.alike, agreement, is_uncertain
    return Masks(labels, confidence, uncertain, doubted)


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
    return _moved_components(opened(skin_coloured(image), 1), background.differs(image) | ~background.known)


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


# One frame ------------------------------------------------------------------------------------------------------------


def _segment_seed(image: np.ndarray, background: Background, seed: Seed) -> tuple[_Segmentation, ColourModel]:
    """Segmentation of the seed frame, and its colour model; moving pixels outside the box count as hand."""
    moving, static = opened(background.differs(image), 1), opened(background.same(image), 1)
    inside = box_mask(moving.shape, seed.box or box_around(seed.click, moving))
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    trimap = np.where(inside & ~static, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_BGD))
    if seed.click is not None:
        trimap[disc_around(seed.click, inside)] = cv2.GC_FGD
    surroundings = ~dilated(inside, 1) & ~moving
    initial = initial_colours().updated(
        lab, object=inside & ~static, hand=moving & ~inside, background=surroundings, weight=SEED_WEIGHT
    )
    hand = _hand_mask(initial.hand_log_ratio(lab), inside, moving, background)
    trimap[hand & (trimap == cv2.GC_PR_FGD)] = cv2.GC_PR_BGD
    if not (trimap & 1).any() or (trimap & 1).all():
        empty = np.zeros(moving.shape, bool)
        return _Segmentation(empty, empty, empty.astype(np.float32), empty), initial
    rough = main_components(grabcut(image, trimap, 5), inside)
    around = (moving | hand) & ~inside
    colours = initial_colours().updated(
        lab, object=rough, hand=around, background=surroundings & ~hand, weight=SEED_WEIGHT
    )
    prior = np.where(inside, np.where(rough, np.float32(0.9), np.float32(0.3)), np.float32(MIN_PRIOR))
    current = _segment_frame(image, prior, rough, background, colours)
    surroundings &= ~current.unknown
    return current, initial_colours().updated(
        lab, object=current.inside, hand=current.unknown & ~inside, background=surroundings, weight=SEED_WEIGHT
    )


def _track(
    images: np.ndarray,
    order: Iterable[int],
    start: int,
    first: _Segmentation,
    background: Background,
    colours: ColourModel,
) -> Iterator[tuple[int, _Segmentation, float, bool]]:
    """Index, segmentation, overlap with the prediction and uncertainty of every frame, tracked from `start`."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    current, area, gray = first, int(first.inside.sum()), cv2.cvtColor(images[start], cv2.COLOR_RGB2GRAY)
    for i in order:
        previous, gray = gray, cv2.cvtColor(images[i], cv2.COLOR_RGB2GRAY)
        lost = not current.inside.any()
        probability = (
            reappearance(images[i], background, colours) if lost else warped(dis, gray, previous, current.probability)
        )
        predicted = probability > 0.5
        current = _segment_frame(images[i], _spread_prior(probability), predicted, background, colours)
        agreement, new_area = overlap(predicted, current.inside), int(current.inside.sum())
        if is_lost(agreement, new_area):
            empty = np.zeros(predicted.shape, bool)
            unknown = current.unknown | current.inside
            current, agreement = _Segmentation(empty, unknown, empty.astype(np.float32), empty), 0.0
        else:
            lab = cv2.cvtColor(images[i], cv2.COLOR_RGB2LAB)
            outside = ~dilated(current.inside | current.unknown, 2)
            # Only pixels that certainly differ from the background, so that a wrong mask does not reinforce itself.
            certain = current.inside & background.differs(images[i])
            colours = colours.updated(lab, object=certain, hand=_empty_like(predicted), background=outside)
        uncertain = lost or is_uncertain(agreement, area, new_area)
        area = new_area
        yield i, current, agreement, uncertain


def _segment_frame(
    image: np.ndarray, prior: np.ndarray, predicted: np.ndarray, background: Background, colours: ColourModel
) -> _Segmentation:
    """Segmentation of a frame, given the prior and the predicted mask."""
    moving = opened(background.differs(image), 1)
    probability, alike = np.zeros(predicted.shape, np.float32), _empty_like(predicted)
    if predicted.sum() < MIN_PIXELS:
        return _Segmentation(alike, moving, probability, alike)
    log_ratio = colours.hand_log_ratio(cv2.cvtColor(image, cv2.COLOR_RGB2LAB))
    hand = _hand_mask(log_ratio, predicted, moving, background)
    window = _window(predicted, 4 * search_radius(predicted))
    cropped = Background(background.image[window], background.noise[window], background.known[window])
    ratio = object_log_ratio(image[window], hand[window], cropped, colours)
    odds = object_log_odds(ratio, prior[window], hand[window])
    probability[window] = mean_field_probability(odds, image[window])
    inside = main_components(probability > 0.5, predicted)
    probability = np.where(inside, np.maximum(probability, np.float32(0.5)), np.minimum(probability, np.float32(0.3)))
    # Near the object, where the static background is unknown, colour alone is not enough to label a pixel background.
    undecided = dilated(predicted, search_radius(predicted)) & ~background.known
    unknown = (moving | hand | undecided) & ~inside
    alike[window] = is_alike(-ratio, ~(inside | unknown)[window])
    alike &= dilated(inside, 2 * search_radius(inside))
    return _Segmentation(inside, unknown, probability, alike)


def _hand_mask(log_ratio: np.ndarray, expected: np.ndarray, moving: np.ndarray, background: Background) -> np.ndarray:
    """Components of hand colour that moved, touch the object and extend beyond it (else they are its texture)."""
    candidates = _moved_components(opened(log_ratio > MIN_HAND_LOG_RATIO, 1), moving | ~background.known)
    count, ids = components(candidates)
    touching = np.bincount(ids[dilated(expected, MAX_HAND_GAP)], minlength=count) > 0
    outside = ~dilated(expected, search_radius(expected))
    beyond = np.bincount(ids[outside], minlength=count)
    # Where a silhouette moves past a wall, the colour model learns the wall as hand.
    touching &= (beyond > MIN_FRACTION_OUTSIDE * np.bincount(ids.ravel(), minlength=count)) & (
        beyond < MAX_COVER_OUTSIDE * outside.sum()
    )
    touching[0] = False
    return touching[ids]


def _moved_components(mask: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Connected components of a mask of which at least `MIN_MOVED_FRACTION` moved."""
    count, ids = components(mask)
    sizes = np.bincount(ids.ravel(), minlength=count)
    keep = np.bincount(ids[moved], minlength=count) > MIN_MOVED_FRACTION * sizes
    keep[0] = False
    return keep[ids]


def warped(dis: cv2.DISOpticalFlow, gray: np.ndarray, previous: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Probabilities of the previous frame, warped to this one along the optical flow."""
    flow = dis.calc(gray, previous, np.zeros((*gray.shape, 2), np.float32))
    rows, columns = np.indices(gray.shape, np.float32)
    return cv2.remap(probability, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR)


def _spread_prior(probability: np.ndarray) -> np.ndarray:
    """The warped probability, blurred by the uncertainty of flow and rotation."""
    radius = search_radius(probability > 0.5)
    spread = 0.5 * probability + 0.5 * cv2.GaussianBlur(probability, (0, 0), radius / 2)
    return spread.clip(MIN_PRIOR, MAX_PRIOR)


def search_radius(mask: np.ndarray) -> int:
    return max(2, round(SEARCH_FRACTION * float(np.sqrt(mask.sum()))))


def reappearance(image: np.ndarray, background: Background, colours: ColourModel) -> np.ndarray:
    """Pixels where a hidden object may have reappeared: moving, and closer in colour to the object than to the hand."""
    log_ratio = colours.hand_log_ratio(cv2.cvtColor(image, cv2.COLOR_RGB2LAB))
    return opened(background.differs(image) & (log_ratio < -MIN_HAND_LOG_RATIO), 2).astype(np.float32)


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


def _window(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + margin + 1), slice(left, int(columns[-1]) + margin + 1)


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
