"""Which pixels show the object: masks from a box or a click on one frame, without trained weights.

The camera stands still, so what differs from the *backdrop* is the object or the hand that holds it. On the *seed*
frame a graph cut (GrabCut) finds the object in the box. From there the mask is carried forwards and backwards by
optical flow (DIS): what it predicts is the prior of the next frame, and colours and backdrop decide (`appearance`).
What moves and is not the object is unknown: a hand, a sleeve, a shadow. So is a band of pixels along the silhouette.

What this cannot do: tell a hand from an object of its colour; find an edge between object and background of one colour
where the backdrop was never seen; follow a hand that was in front of the object from the first frame on as anything but
skin. Frames in which it is unsure say so in their *confidence*: the overlap of what flow predicts with what is found.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from tumble.maths import iou
from tumble.preprocess.background import Backdrop
from tumble.preprocess.colour_model import FIRST, Colours, at_first, object_odds, skin_coloured, smoothed, trimmed
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

SURE_OVERLAP = 0.85
"""Overlap (IoU) of predicted and found mask below which a frame is flagged."""
SURE_AREA = 1.2
"""Change of area from frame to frame above which a frame is flagged (the same)."""
LOST_OVERLAP = 0.4
"""Below this the found mask is not believed: the object is taken for hidden."""
LEAST_PIXELS = 30
"""Smaller masks show nothing to track."""
REACH = 0.06
"""How far a silhouette may be off from its prediction, as a share of the square root of its area."""
LEAST_PRIOR, LARGEST_PRIOR = 0.01, 0.98
"""What flow alone can make sure of."""
HAND_EVIDENCE = 1.5
"""Log likelihood ratio of the hand's colours against the object's from which a pixel may be hand."""
TOUCH = 3
"""A hand lies at most this far from the object [pixels]."""
MOVED_SHARE = 0.03
"""Of a hand that holds almost still, the share of pixels that differ from the backdrop: its edges."""
REACHES_IN, WALL = 0.1, 0.5
"""Share of a hand, at least, that lies beyond where the object is expected; share of all there that no hand fills."""
LEAST_MOVING = 0.1
"""Share of the box that must differ from the backdrop for it to be of use there before the object is known."""
OTHER_PART = 0.15
"""A second piece of the object, behind a finger, has at least this share of the largest one's area."""
SMALL_HOLE = 0.03
"""Share of the object's area up to which a hole in it is doubted; the handle of a mug is larger."""
GRABCUT_SEED = 7
"""GrabCut starts its colour models at random."""


@dataclass(frozen=True)
class Seed:
    """Where a person says that the object is. One of box and click."""

    index: int
    """Of the frame."""
    box: tuple[int, int, int, int] | None = None
    """Left, top, width, height, around the whole object [pixels]."""
    click: tuple[int, int] | None = None
    """A pixel on the object: column, row."""


@dataclass(frozen=True)
class Masks:
    """Three-valued masks, and how far to trust them."""

    labels: UInt8[np.ndarray, "t h w"]
    """OBJECT, UNKNOWN or BACKGROUND."""
    confidence: Float32[np.ndarray, " t"]
    """Overlap of prediction and finding, in [0, 1]; 0 where the object was not found."""
    unsure: Bool[np.ndarray, " t"]
    """Frames a person should look at."""


@dataclass(frozen=True)
class _Cut:
    """One frame, cut out."""

    inside: Bool[np.ndarray, "h w"]
    """The object."""
    other: Bool[np.ndarray, "h w"]
    """What moves besides, or holds it."""
    likely: Float32[np.ndarray, "h w"]
    """Probability of the object, 0 away from it."""


def segment(pictures: UInt8[np.ndarray, "t h w 3"], backdrop: Backdrop, seed: Seed) -> Masks:
    """Masks of all frames from a hint on one.

    Raises:
        ValueError: Nothing was found at the seed.
    """
    first, colours = _cut_seed(pictures[seed.index], backdrop, seed)
    if first.inside.sum() < LEAST_PIXELS:
        raise ValueError(f"shows no object at the hint on frame {seed.index}")
    labels = np.zeros(pictures.shape[:3], np.uint8)
    confidence, unsure = np.ones(len(pictures), np.float32), np.zeros(len(pictures), bool)
    labels[seed.index] = three_valued(trimmed(first.inside, pictures[seed.index], backdrop), first.other, 1)
    for order in (range(seed.index + 1, len(pictures)), range(seed.index - 1, -1, -1)):
        for i, cut, agreement, doubtful in _follow(pictures, order, seed.index, first, backdrop, colours):
            labels[i] = three_valued(trimmed(cut.inside, pictures[i], backdrop), cut.other, 1)
            confidence[i], unsure[i] = agreement, doubtful
    return Masks(labels, confidence, unsure)


def trusted(backdrop: Backdrop, picture: UInt8[np.ndarray, "h w 3"], seed: Seed) -> Backdrop:
    """The backdrop before anything is known of the object: without what may be the object itself.

    An object of one colour that turns in place looks still. Inside the box, what looks like the backdrop is believed to
    be the backdrop only where it reaches in from the box's border.
    """
    same, moving = _opened(backdrop.same(picture), 1), _opened(backdrop.differs(picture), 1)
    inside = _boxed(moving.shape, seed.box or _box_about(seed.click, moving))
    _, pieces = _pieces(same & inside)
    enclosed = same & inside & ~np.isin(pieces, np.unique(pieces[inside & ~_eroded(inside, 1)]))
    hopeless = (moving & inside).sum() < LEAST_MOVING * inside.sum()
    return replace(backdrop, known=backdrop.known & ~(inside if hopeless else enclosed))


def hands(picture: UInt8[np.ndarray, "h w 3"], backdrop: Backdrop) -> Bool[np.ndarray, "h w"]:
    """Pieces of the colour of skin that are no part of the still background, before anything else is known.

    A hand that holds still hides in the backdrop, all but its edges: a little motion is enough. A wooden table does not
    move; an object of the colour of skin counts as a hand here.
    """
    return _moved_pieces(_opened(skin_coloured(picture), 1), backdrop.differs(picture) | ~backdrop.known)


def find_seed(pictures: UInt8[np.ndarray, "t h w 3"], backdrop: Backdrop) -> Seed | None:
    """A box around what moves and has not the colour of skin, on the frame that shows most of it; None if nothing does.

    A guess, for films that come without a hint: a sleeve or a platter moves, too.
    """
    best, most = None, LEAST_PIXELS
    for i in np.unique(np.linspace(0, len(pictures) - 1, 9).round().astype(int)):
        restless = backdrop.differs(pictures[i]) | ~backdrop.known
        moving = _opened(restless & ~skin_coloured(pictures[i]), 2)
        count, _, stats, _ = cv2.connectedComponentsWithStats(_closed(moving, 4).astype(np.uint8))
        if count < 2:
            continue
        left, top, width, height, area = stats[1:][stats[1:, cv2.CC_STAT_AREA].argmax()].tolist()
        if area > most:
            margin = 2 + round(0.05 * max(width, height))
            h, w = moving.shape
            left, top = max(left - margin, 0), max(top - margin, 0)
            box = (left, top, min(width + 2 * margin, w - left), min(height + 2 * margin, h - top))
            best, most = Seed(int(i), box), area
    return best


def three_valued(
    inside: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"], band: int
) -> UInt8[np.ndarray, "h w"]:
    """Object with a band of unknown pixels along its silhouette, half inside, and other things that move unknown.

    A small hole is unknown, too: a dark print before a dark wall looks like one, and would be carved out of the object.

    Args:
        other: What moves and is not the object.
        band: Half the width of the band [pixels].
    """
    labels = np.where(_dilated(inside, band) | other, np.uint8(UNKNOWN), np.uint8(BACKGROUND))
    labels[_eroded(inside, band)] = OBJECT
    _, pieces, stats, _ = cv2.connectedComponentsWithStats((labels == BACKGROUND).astype(np.uint8), connectivity=4)
    left, top, width, height, area = stats.T
    within = (left > 0) & (top > 0) & (left + width < labels.shape[1]) & (top + height < labels.shape[0])
    labels[(within & (area < SMALL_HOLE * inside.sum()))[pieces]] = UNKNOWN
    return labels


def sharpened(
    picture: UInt8[np.ndarray, "h w 3"], coarse: UInt8[np.ndarray, "h w"], reach: int
) -> UInt8[np.ndarray, "h w"]:
    """A mask from a smaller picture, brought to this one's edges: a graph cut within `reach` of the coarse silhouette.

    Args:
        coarse: OBJECT, UNKNOWN or BACKGROUND, enlarged to the picture's size.
        reach: Width of the uncertain band [pixels].
    """
    inner, outer = coarse == OBJECT, coarse != BACKGROUND
    near = _dilated(inner, reach)
    trimap = np.where(near, np.uint8(cv2.GC_PR_BGD), np.uint8(cv2.GC_BGD))
    trimap[inner] = cv2.GC_PR_FGD
    trimap[_eroded(inner, reach)] = cv2.GC_FGD
    if not (trimap == cv2.GC_FGD).any() or not (trimap == cv2.GC_BGD).any():
        return coarse
    return three_valued(_connected(_grabcut(picture, trimap, 2), inner), outer & ~near, 1)


def overlap(one: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union; 0 for two empty masks."""
    return float(iou(torch.from_numpy(one), torch.from_numpy(other)))


# One frame ------------------------------------------------------------------------------------------------------------


def _cut_seed(picture: np.ndarray, backdrop: Backdrop, seed: Seed) -> tuple[_Cut, Colours]:
    """The object on the seed frame; its colours, and the hand's from what moves outside the box."""
    moving, still = _opened(backdrop.differs(picture), 1), _opened(backdrop.same(picture), 1)
    inside = _boxed(moving.shape, seed.box or _box_about(seed.click, moving))
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    trimap = np.where(inside & ~still, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_BGD))
    if seed.click is not None:
        disc = np.zeros(moving.shape, np.uint8)
        cv2.circle(disc, seed.click, max(3, round(0.05 * float(np.sqrt(inside.sum())))), 1, -1)
        trimap[disc > 0] = cv2.GC_FGD
    away = ~_dilated(inside, 1) & ~moving
    guess = at_first().learn(lab, object=inside & ~still, hand=moving & ~inside, background=away, weight=FIRST)
    hand = _hand(guess.hand_evidence(lab), inside, moving, backdrop)
    trimap[hand & (trimap == cv2.GC_PR_FGD)] = cv2.GC_PR_BGD
    if not (trimap & 1).any() or (trimap & 1).all():
        nothing = np.zeros(moving.shape, bool)
        return _Cut(nothing, nothing, nothing.astype(np.float32)), guess
    rough = _connected(_grabcut(picture, trimap, 5), inside)
    outside = (moving | hand) & ~inside
    colours = at_first().learn(lab, object=rough, hand=outside, background=away & ~hand, weight=FIRST)
    prior = np.where(inside, np.where(rough, np.float32(0.9), np.float32(0.3)), np.float32(LEAST_PRIOR))
    cut = _decided(picture, prior, rough, backdrop, colours)
    away &= ~cut.other
    return cut, at_first().learn(lab, object=cut.inside, hand=cut.other & ~inside, background=away, weight=FIRST)


def _follow(
    pictures: np.ndarray, order: Iterable[int], start: int, first: _Cut, backdrop: Backdrop, colours: Colours
) -> Iterator[tuple[int, _Cut, float, bool]]:
    """Index, cut, overlap with the prediction and doubt of every frame in order, from the cut of the start."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    cut, area, gray = first, int(first.inside.sum()), cv2.cvtColor(pictures[start], cv2.COLOR_RGB2GRAY)
    for i in order:
        before, gray = gray, cv2.cvtColor(pictures[i], cv2.COLOR_RGB2GRAY)
        hidden = not cut.inside.any()
        likely = _candidates(pictures[i], backdrop, colours) if hidden else _carried(dis, gray, before, cut.likely)
        predicted = likely > 0.5
        cut = _decided(pictures[i], _prior(likely), predicted, backdrop, colours)
        agreement, found = overlap(predicted, cut.inside), int(cut.inside.sum())
        if found < LEAST_PIXELS or agreement < LOST_OVERLAP:
            nothing = np.zeros(predicted.shape, bool)
            cut, agreement = _Cut(nothing, cut.other | cut.inside, nothing.astype(np.float32)), 0.0
        else:
            lab = cv2.cvtColor(pictures[i], cv2.COLOR_RGB2LAB)
            background = ~_dilated(cut.inside | cut.other, 2)
            # Only what surely covers the backdrop teaches: else one mistake would teach the next.
            sure = cut.inside & backdrop.differs(pictures[i])
            colours = colours.learn(lab, object=sure, hand=_nowhere(predicted), background=background)
        doubtful = hidden or agreement < SURE_OVERLAP or not 1 / SURE_AREA < found / max(area, 1) < SURE_AREA
        area = found
        yield i, cut, agreement, doubtful


def _decided(
    picture: np.ndarray, prior: np.ndarray, predicted: np.ndarray, backdrop: Backdrop, colours: Colours
) -> _Cut:
    """Where the object is, given where it may be."""
    moving = _opened(backdrop.differs(picture), 1)
    likely = np.zeros(predicted.shape, np.float32)
    if predicted.sum() < LEAST_PIXELS:
        return _Cut(_nowhere(predicted), moving, likely)
    evidence = colours.hand_evidence(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB))
    hand = _hand(evidence, predicted, moving, backdrop)
    part = _window(predicted, 4 * _reach(predicted))
    cropped = Backdrop(backdrop.picture[part], backdrop.noise[part], backdrop.known[part])
    odds = object_odds(picture[part], prior[part], hand[part], cropped, colours)
    likely[part] = smoothed(odds, picture[part])
    found = _connected(likely > 0.5, predicted)
    likely = np.where(found, np.maximum(likely, np.float32(0.5)), np.minimum(likely, np.float32(0.3)))
    # Near the object, where the backdrop was never seen, only colour speaks: not enough to call it background.
    doubt = _dilated(predicted, _reach(predicted)) & ~backdrop.known
    return _Cut(found, (moving | hand | doubt) & ~found, likely)


def _hand(evidence: np.ndarray, about: np.ndarray, moving: np.ndarray, backdrop: Backdrop) -> np.ndarray:
    """Pieces of the hand's colour that moved, touch the object and reach in from outside: one within it is a print."""
    pieces = _moved_pieces(_opened(evidence > HAND_EVIDENCE, 1), moving | ~backdrop.known)
    count, numbers = _pieces(pieces)
    touching = np.bincount(numbers[_dilated(about, TOUCH)], minlength=count) > 0
    outside = ~_dilated(about, _reach(about))
    beyond = np.bincount(numbers[outside], minlength=count)
    # A wall is taught as hand where a silhouette moves past it.
    touching &= (beyond > REACHES_IN * np.bincount(numbers.ravel(), minlength=count)) & (beyond < WALL * outside.sum())
    touching[0] = False
    return touching[numbers]


def _moved_pieces(mask: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """The connected pieces of a mask of which a little has moved."""
    count, numbers = _pieces(mask)
    sizes = np.bincount(numbers.ravel(), minlength=count)
    keep = np.bincount(numbers[moved], minlength=count) > MOVED_SHARE * sizes
    keep[0] = False
    return keep[numbers]


def _carried(dis: cv2.DISOpticalFlow, gray: np.ndarray, before: np.ndarray, likely: np.ndarray) -> np.ndarray:
    """The probabilities of the frame before, moved along the optical flow to this one."""
    flow = dis.calc(gray, before, np.zeros((*gray.shape, 2), np.float32))
    rows, columns = np.indices(gray.shape, np.float32)
    return cv2.remap(likely, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR)


def _prior(likely: np.ndarray) -> np.ndarray:
    """What flow says, spread by how far flow and rotation may be off."""
    reach = _reach(likely > 0.5)
    spread = 0.5 * likely + 0.5 * cv2.GaussianBlur(likely, (0, 0), reach / 2)
    return spread.clip(LEAST_PRIOR, LARGEST_PRIOR)


def _reach(mask: np.ndarray) -> int:
    return max(2, round(REACH * float(np.sqrt(mask.sum()))))


def _candidates(picture: np.ndarray, backdrop: Backdrop, colours: Colours) -> np.ndarray:
    """Where a hidden object may have come back: what moves and has its colours more than the hand's."""
    evidence = colours.hand_evidence(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB))
    return _opened(backdrop.differs(picture) & (evidence < -HAND_EVIDENCE), 2).astype(np.float32)


def _boxed(shape: tuple[int, ...], box: tuple[int, int, int, int]) -> np.ndarray:
    left, top, width, height = box
    inside = np.zeros(shape, bool)
    inside[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)] = True
    return inside


def _box_about(click: tuple[int, int] | None, moving: np.ndarray) -> tuple[int, int, int, int]:
    """A square about a clicked pixel, as wide as what moves around it, a quarter of the picture when nothing does."""
    if click is None:
        raise ValueError("a seed needs a box or a click")
    h, w = moving.shape
    column, row = min(max(click[0], 0), w - 1), min(max(click[1], 0), h - 1)
    _, components = _pieces(_closed(moving, 4))
    blob = (components == components[row, column]) & (components[row, column] > 0)
    half = round(0.125 * min(h, w))
    if blob.any():
        rows, columns = np.nonzero(blob)
        spans = [column - columns.min(), columns.max() - column, row - rows.min(), rows.max() - row]
        half = max(half, round(1.1 * float(np.median(spans))))
    return column - half, row - half, 2 * half + 1, 2 * half + 1


# Graph cut and shapes -------------------------------------------------------------------------------------------------


def _grabcut(picture: np.ndarray, trimap: np.ndarray, steps: int) -> np.ndarray:
    cv2.setRNGSeed(GRABCUT_SEED)
    trimap = np.ascontiguousarray(trimap)
    mixtures = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(picture), trimap, (0, 0, 0, 0), *mixtures, steps, cv2.GC_INIT_WITH_MASK)
    return (trimap & 1) > 0


def _window(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + margin + 1), slice(left, int(columns[-1]) + margin + 1)


def _connected(cut: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """The piece that overlaps most with where the object is expected, other large ones, without small holes."""
    count, components = _pieces(cut)
    overlaps = np.bincount(components[expected], minlength=count)
    overlaps[0] = 0
    if not overlaps.any():
        return _nowhere(cut)
    return _closed((overlaps > OTHER_PART * overlaps.max())[components], 1)


def _pieces(mask: np.ndarray) -> tuple[int, np.ndarray]:
    """How many numbers there are, and the number of the connected piece at every pixel; 0 is none."""
    count, numbers = cv2.connectedComponents(mask.astype(np.uint8))
    return count, np.asarray(numbers, np.int32)


def _nowhere(mask: np.ndarray) -> np.ndarray:
    return np.zeros(mask.shape, bool)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _dilated(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), _disc(radius)) > 0


def _eroded(mask: np.ndarray, radius: int) -> np.ndarray:
    """The border of the picture does not eat into the mask."""
    return cv2.erode(mask.astype(np.uint8), _disc(radius)) > 0


def _opened(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(radius)) > 0


def _closed(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, _disc(radius)) > 0
