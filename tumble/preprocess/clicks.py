"""Clicks of a person, "object" or "not object": masks of the clicked frames and of their neighbours are cut again.

On a clicked frame the clicks are hard evidence. The pixels of similar colour around each of them give the colours of
its side, the rest of the mask those of the other one; the likelihoods are smoothed as in the segmentation (mean-field
iterations of a Markov random field), and what is connected to a click changes. The changed pixels are warped along the
optical flow (DIS) to the neighbouring frames, where they are the prior, for as long as the mask has the same fault.

It corrects masks of any segmentation method. Limit: nothing tells an object from a hand of its colour but further
clicks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from tumble.preprocess import segmentation
from tumble.preprocess.background import Background, channel_max
from tumble.preprocess.colour_model import BINS, ColourModel, hand_colours, mean_field_probability
from tumble.preprocess.hands import Hand, hand_strokes
from tumble.preprocess.segmentation import Masks
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

SIMILAR_LAB = (40, 10, 10)
"""Largest difference of L, a and b from a clicked pixel at which a connected pixel has its colour [code values]."""
CLICK_RADIUS = 1
"""Radius of the disc around a clicked pixel whose class is certain [pixels]."""
SAMPLE_RADIUS = 4
"""Radius of the disc around a clicked pixel whose colours are learnt in any case [pixels]."""
MAX_REACH = 0.4
"""Maximum distance from a click on the object at which pixels of its colour are object [square root of the median area
of the masks]."""
CERTAIN_LOG_ODDS = 100.0
"""Log odds of a clicked pixel, which no neighbour outweighs."""
MASK_LOG_ODDS = 1.0
"""Prior log odds of the object inside the old mask, and against it outside."""
EVIDENCE_LOG_ODDS = 2.0
"""Log odds of pixels of a click's colour that are connected to it, and of those that changed in the frame before."""
STROKE_LOG_ODDS = 6.0
"""Log odds against the object at the landmarks of a hand."""
GROWTH = 2
"""Distance from pixels of the colour of a click up to which others become object with them [pixels]."""
STATIC_LOG_ODDS = 4.0
"""Log odds against the object where a frame equals the static background."""
MAX_LOG_RATIO = 4.0
"""Limit of the log likelihood ratio of one pixel."""
MIN_FAULT = 0.3
"""Minimum fraction of the changed pixels, warped to the next frame, that are wrong there too; below it the correction
ends."""
MAX_WARPED_DIFFERENCE = 24.0
"""Largest difference of a pixel from the frame before, warped to it, that shows the same surface [code values]."""
MIN_CHANGE = 12
"""Minimum number of changed pixels that are followed to the next frame."""


@dataclass(frozen=True)
class Click:
    """A pixel of which a person said whether it shows the object."""

    index: int
    """Index of the frame."""
    pixel: tuple[int, int]
    """Column and row [pixels]."""
    is_object: bool


@dataclass(frozen=True)
class _Frame:
    """One frame, with the pixels at the landmarks of its hands."""

    image: UInt8[np.ndarray, "h w 3"]
    strokes: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class _Change:
    """Pixels of one frame whose class was corrected, and the colours by which they were found."""

    removed: Bool[np.ndarray, "h w"]
    added: Bool[np.ndarray, "h w"]
    colours: ColourModel

    @property
    def ends(self) -> bool:
        """Whether too few pixels changed to be followed."""
        return max(int(self.removed.sum()), int(self.added.sum())) < MIN_CHANGE


def correct_masks(
    images: UInt8[np.ndarray, "t h w 3"],
    masks: Masks,
    background: Background,
    clicks: Sequence[Click],
    hands: Sequence[Sequence[Hand]],
) -> Masks:
    """The masks, cut again on the clicked frames and on neighbouring frames with the same fault.

    Pixels that are no longer object become background where they equal the static background, and else unknown, because
    a hand in front of the object hides it.

    Args:
        hands: The hands of every frame; nothing at their landmarks becomes object, unless it is clicked.
    """
    if not clicks:
        return masks
    labels, confidence, uncertain = masks.labels.copy(), masks.confidence.copy(), masks.uncertain.copy()
    by_frame = {i: [click for click in clicks if click.index == i] for i in sorted({c.index for c in clicks})}
    areas = (labels == OBJECT).sum((1, 2))
    area = float(np.median(areas[areas > 0])) if areas.any() else 0.0
    skin = hand_colours(images, hands, background) if any(hands) else None
    frames = [_Frame(image, hand_strokes(found, image.shape[:2])) for image, found in zip(images, hands, strict=True)]
    # What a click brings back may be too much in another frame, where a click then removes it: so those come last.
    for is_object in (True, False):
        for start in (i for i, own in by_frame.items() if any(c.is_object == is_object for c in own)):
            first = _clicked_change(frames[start], labels[start], background, by_frame[start], area, skin)
            labels[start] = _corrected(images[start], labels[start], first, background)
            confidence[start], uncertain[start] = float((labels[start] == OBJECT).any()), False
            for order in (range(start + 1, len(images)), range(start - 1, -1, -1)):
                change, previous = first, start
                for i in order:
                    if change.ends or i in by_frame:
                        break
                    change = _followed(frames[i], images[previous], labels[i], change, background)
                    labels[i] = _corrected(images[i], labels[i], change, background)
                    if confidence[i] == 0 and change.added.any():
                        confidence[i] = 1.0
                    previous = i
    return replace(masks, labels=labels, confidence=confidence, uncertain=uncertain)


def _clicked_change(
    frame: _Frame,
    labels: np.ndarray,
    background: Background,
    clicks: Sequence[Click],
    area: float,
    skin: Float32[np.ndarray, "8 32 32"] | None,
) -> _Change:
    """What the clicks on a frame change in it.

    Args:
        area: Median area of the object in all frames [pixels].
        skin: Density of the colours of the hands.
    """
    inside, lab = labels == OBJECT, cv2.cvtColor(frame.image, cv2.COLOR_RGB2LAB)
    regions, discs, samples = ([np.zeros(inside.shape, bool) for _ in range(2)] for _ in range(3))
    reach = max(SAMPLE_RADIUS, round(MAX_REACH * float(np.sqrt(area))))
    for click in clicks:
        side = int(click.is_object)
        discs[side] |= _disc(inside.shape, click.pixel, CLICK_RADIUS)
        sample = _disc(inside.shape, click.pixel, SAMPLE_RADIUS) & _near_colour(lab, click.pixel)
        # A hand that holds the object has some of its colours somewhere.
        barrier = frame.strokes | ~_disc(inside.shape, click.pixel, reach) if click.is_object else inside & ~inside
        regions[side] |= (_similar(lab, click.pixel, barrier) & (inside != click.is_object)) | sample
        samples[side] |= sample
    both = regions[0] & regions[1]
    wrong, missing = regions[0] & ~both, regions[1] & ~both
    nothing = np.zeros(BINS, np.float32)
    other = wrong if wrong.any() else ~inside & ~missing
    known = (inside & ~wrong) | (samples[1] & ~both)
    colours = ColourModel(nothing, nothing, nothing).updated(
        lab, object=known if inside.any() else missing, hand=other, background=np.zeros_like(inside)
    )
    if skin is not None and not wrong.any():
        colours = replace(colours, hand=skin)
    odds = _log_odds(frame, inside, wrong, missing, colours, background)
    odds[~inside & ~segmentation.dilated(missing, GROWTH)] = -CERTAIN_LOG_ODDS
    odds[discs[0]], odds[discs[1]] = -CERTAIN_LOG_ODDS, CERTAIN_LOG_ODDS
    return _change(odds, frame.image, inside, discs[0], discs[1], colours)


def _followed(
    frame: _Frame, previous: np.ndarray, labels: np.ndarray, before: _Change, background: Background
) -> _Change:
    """What the change of the frame before changes in the next one."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    gray, gray_before = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (frame.image, previous))
    both = np.dstack([before.removed, before.added, previous]).astype(np.float32)
    moved = segmentation.warped(dis, gray, gray_before, both)
    removed, added = (moved[..., :2] > 0.5).transpose(2, 0, 1)
    # Where a hand comes in front, the flow carries the object's pixels onto it.
    same = channel_max(cv2.blur(np.abs(moved[..., 2:] - frame.image), (3, 3))) < MAX_WARPED_DIFFERENCE
    inside = labels == OBJECT
    wrong, missing = removed & inside & same, added & ~inside & same
    if wrong.sum() < MIN_FAULT * removed.sum():
        wrong = np.zeros_like(inside)
    if missing.sum() < MIN_FAULT * added.sum():
        missing = np.zeros_like(inside)
    odds = _log_odds(frame, inside, wrong, missing, before.colours, background)
    # The colours of the object may be a hand's as well: what comes back must have been there in the frame before.
    odds[~inside & ~segmentation.dilated(missing, 1)] = -CERTAIN_LOG_ODDS
    return _change(odds, frame.image, inside, wrong, missing, before.colours)


def _log_odds(
    frame: _Frame,
    inside: np.ndarray,
    wrong: np.ndarray,
    missing: np.ndarray,
    colours: ColourModel,
    background: Background,
) -> np.ndarray:
    """Log odds of the object at every pixel, from the old mask, the evidence against and for it, and the colours."""
    log_ratio = colours.hand_log_ratio(cv2.cvtColor(frame.image, cv2.COLOR_RGB2LAB))
    odds = np.where(inside, MASK_LOG_ODDS, -MASK_LOG_ODDS) - log_ratio.clip(-MAX_LOG_RATIO, MAX_LOG_RATIO)
    odds += EVIDENCE_LOG_ODDS * (missing.astype(np.float32) - wrong)
    odds[background.same(frame.image) & ~inside] -= STATIC_LOG_ODDS
    odds[frame.strokes & ~inside] -= STROKE_LOG_ODDS
    return odds.astype(np.float32)


def _change(
    odds: np.ndarray,
    image: np.ndarray,
    inside: np.ndarray,
    wrong: np.ndarray,
    missing: np.ndarray,
    colours: ColourModel,
) -> _Change:
    """The connected parts of the change that touch the evidence."""
    after = mean_field_probability(odds, image) > 0.5
    return _Change(
        segmentation.touching(inside & ~after, wrong), segmentation.touching(after & ~inside, missing), colours
    )


def _corrected(image: np.ndarray, labels: np.ndarray, change: _Change, background: Background) -> np.ndarray:
    """The mask after a change, with a band of unknown pixels along its new silhouette."""
    static = background.same(image)
    new = labels.copy()
    new[change.removed] = UNKNOWN
    new[segmentation.dilated(change.removed, 2) & (new == UNKNOWN) & static] = BACKGROUND
    grown = segmentation.dilated(new == OBJECT, 1) | change.added
    new[change.added] = UNKNOWN
    new[segmentation.dilated(change.added, 2) & segmentation.eroded(grown, 1)] = OBJECT
    return new


def _similar(lab: np.ndarray, pixel: tuple[int, int], barrier: np.ndarray) -> np.ndarray:
    """Pixels connected to a clicked one, not across a barrier, that have its colour (median of 3 x 3 pixels)."""
    smooth = cv2.medianBlur(lab, 3)
    filled = np.zeros((lab.shape[0] + 2, lab.shape[1] + 2), np.uint8)
    filled[1:-1, 1:-1][barrier] = 2
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    cv2.floodFill(smooth, filled, pixel, (0, 0, 0), SIMILAR_LAB, SIMILAR_LAB, flags)
    return filled[1:-1, 1:-1] == 1


def _near_colour(lab: np.ndarray, pixel: tuple[int, int]) -> np.ndarray:
    """Pixels anywhere that have the colour of a clicked one."""
    difference = np.abs(lab.astype(int) - lab[pixel[1], pixel[0]])
    return np.asarray((difference <= SIMILAR_LAB).all(-1))


def _disc(shape: tuple[int, ...], pixel: tuple[int, int], radius: int) -> np.ndarray:
    return cv2.circle(np.zeros(shape, np.uint8), pixel, radius, 1, -1) > 0
