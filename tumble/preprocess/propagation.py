"""Masks of all frames of a video, from a box or a click on one and the landmarks of the hands, if there are any.

No trained weights are needed for it. On the seed frame GrabCut finds the object in the box. Every pixel has the
probabilities of three classes: object, hand (with arm, sleeve and body) and background. From the seed frame they are
propagated forwards and backwards by optical flow (DIS); in each frame they are the prior, the colours and the static
background give the likelihood, and the landmarks say where a hand is. The colours of hands, arms and sleeves are learnt
once, from the whole video; the object's on the seed frame, and later only from pixels that certainly differ from the
background, so that a wrong mask does not reinforce itself. Foreground that no hand covers and that does not reach the
border of the image is likely to be the object, so parts of it that a hand had hidden return. Moving pixels that are not
object are unknown: a hand, a sleeve, a shadow.

Limits: there is no edge between object and background of one colour where the background is unknown; a hand that was
not detected is told by the colours of skin alone, and is background where it holds still; a sleeve of the object's
colours that touches the object is segmented as object; what the shape of the object contradicts is removed when that is
known (`tumble.poses.mask_refinement`).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from tumble.preprocess import segmentation
from tumble.preprocess.background import NO_SAMPLE_LOG_LIKELIHOOD, Background, BackgroundSamples
from tumble.preprocess.colour_model import (
    BACKGROUND_CLASS,
    HAND_CLASS,
    NO_HAND_LOG_LIKELIHOOD,
    OBJECT_CLASS,
    SEED_WEIGHT,
    ColourModel,
    class_probabilities,
    hand_colours,
    is_alike,
    log_likelihoods,
    skin_coloured,
    trim_rim,
)
from tumble.preprocess.hands import Hand, arm_region, hand_strokes, hand_surroundings, wrist_region
from tumble.preprocess.segmentation import Masks, Seed
from tumble.scene import OBJECT, UNKNOWN

STROKE_LOG_ODDS = 3.0
"""Log odds of a hand at its landmarks, against the other classes."""
MAX_OBJECT_LOG_RATIO = 1.5
"""Log likelihood ratio of object to hand above which a pixel at a landmark, which may be hidden, shows the object."""
ARM_LOG_ODDS = 1.5
"""Log odds of a hand behind the wrist."""
MAX_LOG_RATIO = 8.0
"""Limit of the log likelihood ratios of one pixel."""
MIN_PROBABILITY = 0.01
"""Lower limit of a prior probability, because optical flow alone is not conclusive."""
MAX_DISTANT_PROBABILITY = 1e-4
"""Prior probability of the object beyond the search radius around its prediction."""
MIN_HAND_ELSEWHERE = 0.1
"""Lower limit of the prior probability of a hand there: an arm or a body may appear."""
CERTAIN = 0.9
"""Probability of a class above which a pixel's colour is learnt."""
ISLAND_PROBABILITY = 0.6
"""Prior probability of the object in an island of the foreground, unless the prediction is higher."""
MIN_ISLAND_LOG_RATIO = 1.0
"""Minimum mean log likelihood ratio of object to hand in an island away from the predicted object, and of a pixel that
belongs to an island where no hand was detected."""
MAX_AVERAGED_LOG_RATIO = 4.0
"""Limit of the log likelihood ratios of object to hand that are averaged over pixels."""
MAX_HOLE_FRACTION = 0.3
"""Maximum area of a hole in the object that may be its print, as a fraction of the object's."""
MIN_SKIN_FRACTION = 0.1
"""Minimum fraction of skin-coloured pixels at the landmarks of hands without gloves."""
SEED_ITERATIONS = 2
"""Number of times that the colours and the mask of the seed frame are estimated in turn."""
SEED_PRIOR = {
    "object": (0.9, 0.05, 0.05),
    "hand": (0.25, 0.6, 0.15),
    "box": (0.1, 0.1, 0.8),
    "moving": (0.01, 0.9, 0.09),
    "rest": (0.01, 0.2, 0.79),
}
"""Prior probabilities of object, hand and background on the seed frame: in GrabCut's mask, at the hands, elsewhere in
the box, at moving pixels outside it, and elsewhere."""


@dataclass(frozen=True)
class _Frame:
    """One frame, and what is known of it before its segmentation."""

    image: UInt8[np.ndarray, "h w 3"]
    lab: UInt8[np.ndarray, "h w 3"]
    differs: Bool[np.ndarray, "h w"]
    """Pixels that certainly differ from the known background."""
    sampled: Float32[np.ndarray, "h w"] | None
    """Log likelihood of the background from other frames; not a number where there are too few."""
    foreground: Bool[np.ndarray, "h w"]
    """Pixels that differ from the known background or, where it is unknown, from its samples, if there are any."""
    known: Bool[np.ndarray, "h w"]
    """Pixels whose background is known, or sampled."""
    strokes: Bool[np.ndarray, "h w"]
    surroundings: Bool[np.ndarray, "h w"] | None
    """Pixels that may show the detected hands or their arms; none of them if the object is alone; None if no hand was
    detected."""
    arm: Bool[np.ndarray, "h w"]
    wrists: Bool[np.ndarray, "h w"]
    """Pixels where an arm may begin."""
    skin: Bool[np.ndarray, "h w"]
    """Pixels in the colour range of skin."""


@dataclass(frozen=True)
class _State:
    """Segmentation of one frame."""

    probabilities: Float32[np.ndarray, "3 h w"]
    inside: Bool[np.ndarray, "h w"]
    doubtful: Bool[np.ndarray, "h w"]
    """Pixels close to the landmarks or, without any, of what reaches the border, whose colour is the hand's rather than
    the object's."""
    alike: Bool[np.ndarray, "h w"]
    """Pixels that are rather background, but whose colours the object may have, too."""


def segment(
    images: UInt8[np.ndarray, "t h w 3"],
    background: Background,
    seed: Seed,
    hands: Sequence[Sequence[Hand]],
    samples: BackgroundSamples | None = None,
) -> Masks:
    """Masks of all frames from a box or a click on one.

    Args:
        hands: The hands of every frame.
        samples: Colours of the background at each pixel, known from an earlier segmentation.

    Raises:
        ValueError: No object was found at the seed.
    """

    def frame(i: int) -> _Frame:
        shape, found = images.shape[1:3], hands[i]
        arm = arm_region(found, shape)
        differs = segmentation.opened(background.differs(images[i]), 1)
        sampled = samples.log_likelihood(images[i], i) if samples else None
        foreground, known = differs, background.known
        if sampled is not None:
            # Without samples, as where something covers the background in nearly all frames, this is true as well.
            foreground = differs | (~known & ~(sampled >= NO_SAMPLE_LOG_LIKELIHOOD))
            known = known | ~np.isnan(sampled)
        return _Frame(
            images[i],
            cv2.cvtColor(images[i], cv2.COLOR_RGB2LAB),
            differs,
            sampled,
            foreground,
            known,
            hand_strokes(found, shape),
            hand_surroundings(found, shape) | arm if found else None,
            arm,
            wrist_region(found, shape),
            skin_coloured(images[i]),
        )

    start = frame(seed.index)
    first, colours = _segment_seed(start, background, seed, hand_colours(images, hands, background))
    if first.inside.sum() < segmentation.MIN_PIXELS:
        raise ValueError(f"shows no object in the box, or at the click, on frame {seed.index}")
    labels, doubted = np.zeros(images.shape[:3], np.uint8), np.zeros(images.shape[:3], bool)
    confidence, uncertain = np.ones(len(images), np.float32), np.zeros(len(images), bool)
    labels[seed.index], doubted[seed.index] = _labels(start, first, background), _doubted(first)
    for order in (range(seed.index + 1, len(images)), range(seed.index - 1, -1, -1)):
        tracked = _track(start, map(frame, order), first, background, colours)
        for i, each in zip(order, tracked, strict=True):
            labels[i], doubted[i], confidence[i], uncertain[i] = each
    return Masks(labels, confidence, uncertain, doubted)


def _segment_seed(
    frame: _Frame, background: Background, seed: Seed, hand: Float32[np.ndarray, "8 32 32"]
) -> tuple[_State, ColourModel]:
    """Segmentation of the seed frame and the colours of the classes."""
    static = segmentation.opened(background.same(frame.image), 1)
    box = segmentation.box_mask(frame.differs.shape, seed.box or segmentation.box_around(seed.click, frame.differs))
    # The object may hide what landmarks show; hands that do not have the colours of skin wear gloves.
    gloved = not frame.strokes.any() or frame.skin[frame.strokes].mean() < MIN_SKIN_FRACTION
    strokes = frame.strokes & (frame.skin | gloved)
    at_hand = strokes if frame.surroundings is None else frame.surroundings & (frame.skin | gloved)
    trimap = np.where(box & ~static, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_BGD))
    trimap[box & at_hand] = cv2.GC_PR_BGD
    trimap[box & strokes] = cv2.GC_BGD
    if seed.click is not None:
        trimap[segmentation.disc_around(seed.click, box)] = cv2.GC_FGD
    empty = np.zeros(frame.differs.shape, bool)
    if not (trimap & 1).any() or (trimap & 1).all():
        return _State(np.zeros((3, *empty.shape), np.float32), empty, empty, empty), ColourModel(hand, hand, hand)
    rough = segmentation.main_components(segmentation.grabcut(frame.image, trimap, 5), box)
    unlearnt = np.zeros_like(hand)
    colours = ColourModel(unlearnt, hand, unlearnt).updated(
        frame.lab,
        object=rough & ~at_hand,
        hand=empty,
        background=~segmentation.dilated(box, 1) & ~frame.differs,
        weight=SEED_WEIGHT,
    )
    regions = (rough, box & at_hand, box, frame.differs)
    prior = np.empty((3, *empty.shape), np.float32)
    prior[:] = np.array(SEED_PRIOR["rest"], np.float32)[:, None, None]
    for name, region in reversed(list(zip(SEED_PRIOR, regions, strict=False))):
        prior[:, region] = np.array(SEED_PRIOR[name], np.float32)[:, None]
    state = _State(prior, rough, empty, empty)
    for _ in range(SEED_ITERATIONS):
        likelihood = log_likelihoods(frame.image, background, colours, frame.sampled)
        state = _segment_frame(frame, prior, state.inside | (box & ~static), box, likelihood)
        certain = state.inside & (state.probabilities[OBJECT_CLASS] > CERTAIN)
        colours = colours.updated(frame.lab, object=certain, hand=empty, background=empty, weight=SEED_WEIGHT / 2)
    return state, colours


def _track(
    start: _Frame, frames: Iterable[_Frame], first: _State, background: Background, colours: ColourModel
) -> Iterator[tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"], float, bool]]:
    """Mask of consecutive frames, doubted background, overlap with the prediction, whether the mask is uncertain."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    state, area, gray = first, int(first.inside.sum()), cv2.cvtColor(start.image, cv2.COLOR_RGB2GRAY)
    for frame in frames:
        previous, gray = gray, cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        lost = not state.inside.any()
        warped = segmentation.warped(dis, gray, previous, state.probabilities.transpose(1, 2, 0)).transpose(2, 0, 1)
        prior = _prior(warped)
        likelihood = log_likelihoods(frame.image, background, colours, frame.sampled)
        predicted = warped[OBJECT_CLASS] > 0.5
        if frame.surroundings is None and _is_alone(frame, predicted):
            frame = replace(frame, surroundings=np.zeros_like(predicted), skin=np.zeros_like(predicted))
        islands = _islands(frame, predicted, likelihood)
        prior = _raised(prior, islands & (prior[OBJECT_CLASS] < ISLAND_PROBABILITY))
        predicted = prior[OBJECT_CLASS] > 0.5
        state = _segment_frame(frame, prior, predicted, _filled(predicted), likelihood)
        agreement, new_area = segmentation.overlap(predicted, state.inside), int(state.inside.sum())
        if segmentation.is_lost(agreement, new_area):
            nothing = np.zeros_like(predicted)
            state, agreement = _State(_without_object(state.probabilities), nothing, nothing, nothing), 0.0
        else:
            colours = _updated(colours, frame, state, predicted)
        uncertain = lost or segmentation.is_uncertain(agreement, area, new_area)
        area = new_area
        yield _labels(frame, state, background), _doubted(state), agreement, uncertain


def _prior(warped: Float32[np.ndarray, "3 h w"]) -> Float32[np.ndarray, "3 h w"]:
    """Prior probabilities: the warped ones, blurred by the uncertainty of the flow."""
    predicted = warped[OBJECT_CLASS] > 0.5
    radius = segmentation.search_radius(predicted)
    blurred = np.stack([cv2.GaussianBlur(each, (0, 0), radius / 2) for each in warped])
    prior = (0.5 * (warped + blurred)).clip(MIN_PROBABILITY, 1 - 2 * MIN_PROBABILITY)
    far = ~segmentation.dilated(predicted, radius)
    prior[OBJECT_CLASS, far] = MAX_DISTANT_PROBABILITY
    prior[HAND_CLASS, far] = np.maximum(prior[HAND_CLASS, far], MIN_HAND_ELSEWHERE)
    return prior / prior.sum(0)


def _islands(
    frame: _Frame, predicted: Bool[np.ndarray, "h w"], log_likelihood: Float32[np.ndarray, "3 h w"]
) -> Bool[np.ndarray, "h w"]:
    """Connected parts of the foreground that are likely to show the object.

    No hand covers them, none of their parts is skin by its colours, and they do not reach the border of the image, as
    arms do. They are near the predicted object, or they have its colours and are next to a hand; any place will do
    if the object was not predicted anywhere. Near the predicted object they may have any colours if hands were detected
    or the object is alone, and even with the skin they reach neither the border nor a wrist: print may have the colours
    of a hand.
    """
    log_ratio = _object_over_hand(log_likelihood)
    radius = segmentation.search_radius(predicted)
    if frame.surroundings is None:
        hand = log_ratio < MIN_ISLAND_LOG_RATIO
    else:  # Without the colours, a forearm that touches the object would be a part of its island.
        window = (2 * radius + 1,) * 2
        skin = cv2.blur(frame.skin.astype(np.float32), window) > 0.5
        hand = frame.surroundings | (skin & (cv2.blur(log_ratio, window) < 0))
    count, ids = segmentation.components(segmentation.opened(frame.foreground & ~hand, 1))
    size = np.bincount(ids.ravel(), minlength=count)
    mean = np.bincount(ids.ravel(), log_ratio.ravel(), minlength=count) / np.maximum(size, 1)
    close = segmentation.dilated(predicted, 2 * radius)
    near = _touches(ids, count, close)
    place = np.ones_like(predicted)
    if predicted.any():
        place = predicted if frame.surroundings is None else segmentation.dilated(frame.surroundings, radius)
    coloured = (mean > MIN_ISLAND_LOG_RATIO) & _touches(ids, count, place)
    chosen = (size >= segmentation.MIN_PIXELS) & ((near & (mean > 0)) | coloured) & ~_at_border(ids, count)
    chosen[0] = False
    islands = chosen[ids]
    return islands if frame.surroundings is None else islands | _free_parts(frame, frame.surroundings, close)


def _free_parts(
    frame: _Frame, surroundings: Bool[np.ndarray, "h w"], close: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Parts of the foreground beside any detected hands that are near the object and reach no border and no wrist."""
    count, ids = segmentation.components(_possible_foreground(frame) & ~surroundings)
    free = np.bincount(ids.ravel(), minlength=count) >= segmentation.MIN_PIXELS
    free &= _touches(ids, count, close) & ~_at_border(ids, count) & ~_touches(ids, count, frame.wrists)
    free[0] = False
    return free[ids] & frame.foreground


def _is_alone(frame: _Frame, predicted: Bool[np.ndarray, "h w"]) -> bool:
    """Whether nothing that reaches the border is near the object, as between two grips."""
    # Parts of an arm, or of a hand that resembles the background, are one with what they belong to.
    joined = segmentation.dilated(_possible_foreground(frame), segmentation.search_radius(predicted) // 2)
    count, ids = segmentation.components(joined)
    hit = np.bincount(ids[predicted], minlength=count)
    return bool(((hit > 0.5 * predicted.sum()) & ~_at_border(ids, count))[1:].any())


def _possible_foreground(frame: _Frame) -> Bool[np.ndarray, "h w"]:
    """The foreground and the unknown background, through which an arm may reach the border too."""
    return segmentation.opened(frame.foreground | ~frame.known, 1)


def _object_over_hand(log_likelihood: Float32[np.ndarray, "3 h w"]) -> Float32[np.ndarray, "h w"]:
    """Log likelihood ratio of object to hand, limited and averaged over 3 x 3 pixels."""
    log_ratio = log_likelihood[OBJECT_CLASS] - log_likelihood[HAND_CLASS]
    return cv2.blur(log_ratio.clip(-MAX_AVERAGED_LOG_RATIO, MAX_AVERAGED_LOG_RATIO), (3, 3))


def _raised(prior: Float32[np.ndarray, "3 h w"], where: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "3 h w"]:
    """Prior probabilities with that of an island where one is."""
    others = prior * ((1 - ISLAND_PROBABILITY) / np.maximum(1 - prior[OBJECT_CLASS], MIN_PROBABILITY))
    others[OBJECT_CLASS] = ISLAND_PROBABILITY
    return np.where(where, others, prior)


def _segment_frame(
    frame: _Frame,
    prior: Float32[np.ndarray, "3 h w"],
    predicted: Bool[np.ndarray, "h w"],
    expected: Bool[np.ndarray, "h w"],
    log_likelihood: Float32[np.ndarray, "3 h w"],
) -> _State:
    """Segmentation of a frame.

    Args:
        predicted: The object, as predicted.
        expected: Where the object is expected; away from the landmarks a colour does not tell a hand there: it is the
            object's print, or a side that comes into view. Only skin at the edge may be an arm, which would else become
            object from frame to frame.
        log_likelihood: Of the pixels' colours under object, hand and background.
    """
    log_ratio, radius = log_likelihood.copy(), segmentation.search_radius(predicted)
    doubtful = _object_over_hand(log_ratio) < 0
    if frame.surroundings is None:
        doubtful &= segmentation.touching(_possible_foreground(frame), _border(doubtful.shape))
    else:
        doubtful &= frame.surroundings
        possible_arm = frame.skin & ~segmentation.eroded(expected, radius)
        far = expected & ~possible_arm & ~frame.surroundings
        log_ratio[HAND_CLASS, far] = np.minimum(log_ratio[HAND_CLASS, far], NO_HAND_LOG_LIKELIHOOD)
    log_ratio = np.maximum(log_ratio, log_ratio.max(0) - MAX_LOG_RATIO)
    hidden = log_ratio[OBJECT_CLASS] - log_ratio[HAND_CLASS] > MAX_OBJECT_LOG_RATIO
    log_ratio[HAND_CLASS, frame.strokes & ~hidden] += STROKE_LOG_ODDS
    inner = segmentation.eroded(predicted, radius)
    log_ratio[HAND_CLASS, frame.arm & ~inner] += ARM_LOG_ODDS
    probabilities = class_probabilities(log_ratio + np.log(prior), frame.image)
    label = probabilities.argmax(0)
    inside = _connected(label == OBJECT_CLASS, predicted)
    inside = _with_print(inside, label == HAND_CLASS, frame.surroundings)
    if frame.surroundings is None:  # what the object surrounds is its print
        doubtful = segmentation.touching(doubtful & inside, ~segmentation.eroded(inside, 1))
    background_ratio = log_likelihood[BACKGROUND_CLASS] - log_likelihood[OBJECT_CLASS]
    alike = is_alike(background_ratio, label == BACKGROUND_CLASS)
    return _State(np.where(inside, probabilities, _without_object(probabilities)), inside, doubtful, alike)


def _connected(mask: Bool[np.ndarray, "h w"], predicted: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The main components without those at the border of the image, which are arms and walls.

    Only the one that overlaps the prediction most may reach the border, if it was predicted for the most part.
    """
    mask = segmentation.main_components(mask, predicted)
    count, ids = segmentation.components(mask)
    size, hit = np.bincount(ids.ravel(), minlength=count), np.bincount(ids[predicted], minlength=count)
    hit[0] = 0
    main = (hit == hit.max()) & (hit >= 0.5 * size)
    return mask & (main | ~_at_border(ids, count))[ids]


def _touches(ids: np.ndarray, count: int, where: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, " n"]:
    """Whether each labelled component has pixels in a region."""
    return np.bincount(ids[where], minlength=count) > 0


def _at_border(ids: np.ndarray, count: int) -> Bool[np.ndarray, " n"]:
    """Whether each labelled component touches the border of the image."""
    return _touches(ids, count, _border(ids.shape))


def _border(shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """The outermost pixels of an image."""
    border = np.ones(shape, bool)
    border[1:-1, 1:-1] = False
    return border


def _without_object(probabilities: Float32[np.ndarray, "3 h w"]) -> Float32[np.ndarray, "3 h w"]:
    """Probabilities of pixels that are not the object."""
    others = probabilities.copy()
    others[OBJECT_CLASS] = np.minimum(others[OBJECT_CLASS], 0.2)
    return others / others.sum(0)


def _filled(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The mask without holes, except those too large for a print that was taken for something else."""
    _, ids, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    return mask | (stats[:, cv2.CC_STAT_AREA] <= MAX_HOLE_FRACTION * mask.sum())[ids]


def _with_print(
    inside: Bool[np.ndarray, "h w"], hand: Bool[np.ndarray, "h w"], surroundings: Bool[np.ndarray, "h w"] | None
) -> Bool[np.ndarray, "h w"]:
    """The object with its print in a hand's colours: holes that show these for the most part, but no detected hand."""
    count, ids = segmentation.components(~inside)
    size = np.bincount(ids.ravel(), minlength=count)
    filled = ~_at_border(ids, count) & (size <= MAX_HOLE_FRACTION * inside.sum())
    filled &= np.bincount(ids[hand], minlength=count) > 0.5 * size
    if surroundings is not None:
        filled &= ~_touches(ids, count, surroundings)
    filled[0] = False
    return inside | filled[ids]


def _updated(colours: ColourModel, frame: _Frame, state: _State, predicted: Bool[np.ndarray, "h w"]) -> ColourModel:
    """The colours after a frame; those of the hand stay."""
    certain = state.probabilities > CERTAIN
    inside = state.inside & segmentation.eroded(predicted, 1) & frame.differs & ~frame.strokes
    return colours.updated(
        frame.lab,
        object=inside & certain[OBJECT_CLASS],
        hand=np.zeros_like(predicted),
        background=~segmentation.dilated(state.inside, 2) & certain[BACKGROUND_CLASS],
    )


def _labels(frame: _Frame, state: _State, background: Background) -> UInt8[np.ndarray, "h w"]:
    """Three-valued mask. What moves is unknown, and so are doubtful pixels and uncertain background near the object."""
    radius = segmentation.search_radius(state.inside)
    uncertain = segmentation.dilated(state.inside, radius) & ~frame.known
    unknown = (state.probabilities[BACKGROUND_CLASS] < 0.5) | frame.differs | uncertain
    labels = segmentation.make_trimap(trim_rim(state.inside, frame.image, background), unknown & ~state.inside, 1)
    labels[state.doubtful & (labels == OBJECT)] = UNKNOWN
    return labels


def _doubted(state: _State) -> Bool[np.ndarray, "h w"]:
    """Pixels close to the object that it may be, by their colours."""
    return state.alike & segmentation.dilated(state.inside, 2 * segmentation.search_radius(state.inside))
