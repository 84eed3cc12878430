"""Masks of an object in a hand whose landmarks are known, compared with the true masks of a synthetic video."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from jaxtyping import Bool, UInt8

from tests.films import Scene, scene
from tumble.preprocess import propagation, segmentation
from tumble.preprocess.background import crossed_background, estimate_background, fill_unknown, sample_background
from tumble.preprocess.colour_model import UNIFORM_DENSITY, hand_colours, is_alike
from tumble.preprocess.hands import Hand
from tumble.preprocess.segmentation import Masks, Seed, opened, overlap, search_radius, with_doubt
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

PRINT = (196, 140, 112)
"""A print on the object in the colour of the hand [sRGB code values]."""

SKIN = (205, 150, 120)
"""A hand [sRGB code values]."""


def landmarks(i: int) -> Hand:
    """Those of the hand that `scene` draws: three fingers upwards on a palm at the lower border."""
    sway, points = 5 * np.sin(i / 3), np.zeros((21, 2), np.float32)
    points[0], points[1], points[2:5] = (80 + sway, 129), (46 + sway, 122), (44 + sway, 116)
    for first, finger in ((5, 0), (9, 1), (13, 1), (17, 2)):
        x, y = 60 + 18 * finger + sway, 98 + 4 * np.sin(i / 4 + finger)
        points[first : first + 4] = [(x, y + reach) for reach in (18, 6, -6, -18)]
    return Hand(points, 1.0, 1.0)


@cache
def segmented(printed: bool = False) -> tuple[Masks, Scene]:
    video = scene(hand=True)
    if printed:
        pictures = video.pictures.copy()
        for i, inside in enumerate(video.object):
            row, column = (int(x.mean()) for x in np.nonzero(inside & ~video.hand[i]))
            square, column = np.zeros_like(inside), column + round(12 * np.sin(i / 2))
            square[max(row - 20, 0) : row - 6, column - 7 : column + 7] = True
            pictures[i][square & inside] = PRINT
        video = Scene(pictures, video.object, video.hand, video.background)
    hands = [[landmarks(i)] for i in range(len(video.pictures))]
    # Known wherever neither object nor hand was, as after a first segmentation.
    background = estimate_background(video.pictures, video.object | video.hand)
    return propagation.segment(video.pictures, background, Seed(0, video.box()), hands), video


def without_hands(video: Scene, seed: Seed) -> Masks:
    """Masks of both passes of a survey, if no hand was detected."""
    none = [[] for _ in video.pictures]
    background = estimate_background(video.pictures)
    skin = np.stack([segmentation.moving_skin(image, background) for image in video.pictures])
    background = estimate_background(video.pictures, skin)
    background = segmentation.exclude_possible_object(background, video.pictures[seed.index], seed)
    first = propagation.segment(video.pictures, background, seed, none)
    background = fill_unknown(estimate_background(video.pictures, first.labels != BACKGROUND), background)
    background = crossed_background(video.pictures, first.labels == OBJECT, background)
    samples = sample_background(video.pictures, segmentation.possible_object(first.labels))
    return propagation.segment(video.pictures, background, seed, none, samples)


def scores(masks: Masks, video: Scene) -> tuple[float, float, float]:
    """IoU of known pixels, largest fraction of object labelled background, fraction of hand labelled object."""
    pairs = list(zip(masks.labels, video.object, strict=True))
    known = [overlap(labels == OBJECT, truth & (labels != UNKNOWN)) for labels, truth in pairs]
    lost = [float((labels[truth] == BACKGROUND).mean()) for labels, truth in pairs]
    hand = float((masks.labels[video.hand] == OBJECT).mean()) if video.hand.any() else 0.0
    return float(np.mean(known)), max(lost), hand


def test_the_object_is_segmented_without_the_hand() -> None:
    masks, video = segmented()
    pairs = list(zip(masks.labels, video.object, strict=True))
    assert np.mean([overlap(labels == OBJECT, truth & (labels != UNKNOWN)) for labels, truth in pairs]) > 0.92
    assert (masks.labels[video.hand] == OBJECT).mean() < 0.01
    # Fingers in front of the object must not be background, which would carve the visual hull.
    assert (masks.labels[video.hand] == BACKGROUND).mean() < 0.05
    assert max((labels[truth] == BACKGROUND).mean() for labels, truth in pairs) < 0.06


def test_a_print_in_the_colour_of_the_hand_is_object() -> None:
    """The landmarks say that the hand is elsewhere."""
    masks, video = segmented(printed=True)
    printed = (np.abs(video.pictures.astype(int) - PRINT).max(-1) < 8) & video.object
    assert printed.sum() > 100 * len(printed)
    assert (masks.labels[printed] == OBJECT).mean() > 0.9


def test_a_hole_with_the_colours_of_a_hand_is_print_unless_a_hand_is_there() -> None:
    inside, hand, fingertip = (np.zeros((60, 90), bool) for _ in range(3))
    inside[10:50, 10:80] = True
    for left in (20, 40, 60):
        inside[20:30, left : left + 10] = False
    hand[20:30, 20:30] = hand[20:30, 60:70] = True
    hand[:, 85:] = True
    fingertip[25:32, 65:68] = True
    printed = propagation._with_print(inside, hand, fingertip) & ~inside
    assert (printed == (hand & (np.arange(90) < 30))).all(), "the hole of the background and that of the finger stay"


def test_a_forearm_that_touches_the_object_is_not_object() -> None:
    """It appears where the background is unknown, away from the landmarks, behind a sleeve that reaches the border."""
    video = scene(hand=True)
    pictures, arm = video.pictures.copy(), np.zeros_like(video.object)
    for i, picture in enumerate(pictures):
        arm[i, 44:66, 14 : 24 + min(6 * i, 60)] = True
        arm[i] &= ~video.object[i] & ~video.hand[i]
        picture[44:66, :14], picture[arm[i]] = (30, 30, 34), (164, 120, 96)
    background = estimate_background(video.pictures, video.object | video.hand)
    background.known[36:76, 8:36] = False
    hands = [[landmarks(i)] for i in range(len(pictures))]
    masks = propagation.segment(pictures, background, Seed(0, video.box()), hands)
    assert (masks.labels[10:][arm[10:]] == OBJECT).mean() < 0.02
    assert (masks.labels[video.object] == OBJECT).mean() > 0.8


def test_a_side_that_comes_into_view_is_object_in_the_colours_of_the_sleeve_too() -> None:
    video, sleeve = scene(hand=True), (30, 60, 160)
    pictures, side = video.pictures.copy(), np.zeros_like(video.object)
    for i, picture in enumerate(pictures):
        left = 50 + 6 * (i % 5)
        picture[-14:, left : left + 50] = sleeve
        right = np.nonzero(opened(video.object[i] & ~video.hand[i], 6))[1].max()
        side[i] = video.object[i] & (np.arange(side.shape[2]) > right - 2.5 * (i - 3)) & (i > 3)
        picture[side[i]] = sleeve
    hands = [[landmarks(i)] for i in range(len(pictures))]
    background = estimate_background(pictures, video.object | video.hand)
    masks = propagation.segment(pictures, background, Seed(0, video.box()), hands)
    assert (masks.labels[14:][side[14:]] == OBJECT).mean() > 0.8


def with_label(video: Scene) -> tuple[UInt8[np.ndarray, "t h w 3"], Bool[np.ndarray, "t h w"]]:
    """Pictures in which three quarters of the object take on the hand's colour in frame 8, and these pixels."""
    pictures, label = video.pictures.copy(), np.zeros_like(video.object)
    for i in range(8, len(pictures)):
        columns = np.nonzero((video.object[i] & ~video.hand[i]).any(0))[0]
        label[i] = video.object[i] & (np.arange(label.shape[2]) > columns[0] + 0.25 * np.ptp(columns))
        pictures[i][label[i]] = PRINT
    return pictures, label


def test_a_label_in_the_colour_of_the_hand_is_object_beside_the_hand() -> None:
    """It comes into view at once, as in a fast turn, so that optical flow does not follow it."""
    video = scene(hand=True)
    pictures, label = with_label(video)
    hands = [[landmarks(i)] for i in range(len(pictures))]
    background = estimate_background(pictures, video.object | video.hand)
    masks = propagation.segment(pictures, background, Seed(0, video.box()), hands)
    assert (masks.labels[label] == OBJECT).mean() > 0.8
    assert (masks.labels[video.hand] == OBJECT).mean() < 0.01


def test_background_that_may_as_well_be_the_object_beside_it_is_doubted() -> None:
    """A side in the colours of the wall behind it: neighbours err alike, so that all of them are called background."""
    wall, inside, side, far = np.zeros((60, 90, 3), np.uint8), *np.zeros((3, 60, 90), bool)
    inside[10:40, 20:50], side[15:35, 50:60], far[15:35, 78:88] = True, True, True
    ratio = np.where(inside, np.float32(-5), np.where(side | far, np.float32(2), np.float32(6)))
    alike = is_alike(ratio, ~inside)
    assert alike[side].mean() > 0.7
    assert not alike[:, :48].any()
    background = estimate_background(np.repeat(wall[None], 3, 0), np.zeros((3, 60, 90), bool))
    empty = np.zeros_like(inside)
    sampled = np.zeros(inside.shape, np.float32)
    frame = propagation._Frame(wall, wall, empty, sampled, empty, ~empty, empty, None, empty, empty, empty)
    probabilities = np.stack([inside, empty, ~inside]).astype(np.float32)
    state = propagation._State(probabilities, inside, empty, alike)
    doubted = propagation._doubted(state)
    labels = with_doubt(propagation._labels(frame, state, background), doubted)
    assert (labels[18:32, 52:54] == UNKNOWN).all()
    assert (labels[alike & far] == BACKGROUND).all()
    labels = propagation._labels(frame, state, background)
    assert (labels[18:32, 52:54] == BACKGROUND).all(), "what the background is estimated from"


def test_what_may_be_a_hand_that_was_not_detected_is_unknown() -> None:
    """A hand covers half of an object that has its colours too."""
    video, missed = scene(hand=True), range(14, 19)
    pictures, label = with_label(video)
    hands = [[] if i in missed else [landmarks(i)] for i in range(len(pictures))]
    cover = np.zeros_like(label)
    for i in missed:
        columns = np.nonzero(video.object[i].any(0))[0]
        cover[i] = video.object[i] & (np.arange(label.shape[2]) > columns[0] + 0.5 * np.ptp(columns))
        pictures[i][cover[i]] = SKIN
    background = estimate_background(pictures, video.object | video.hand)
    masks = propagation.segment(pictures, background, Seed(0, video.box()), hands)
    assert (masks.labels[cover] == OBJECT).mean() < 0.1


def test_what_is_near_something_that_reaches_the_border_is_not_alone() -> None:
    wall, empty = np.zeros((60, 90, 3), np.uint8), np.zeros((60, 90), bool)
    arm, thing = empty.copy(), empty.copy()
    arm[:, 60:] = thing[20:40, 20:40] = True
    frame = propagation._Frame(wall, wall, arm, None, arm | thing, ~empty, empty, None, empty, empty, empty)
    assert propagation._is_alone(frame, thing)
    assert not propagation._is_alone(frame, arm)
    beside = np.roll(thing, 20 - search_radius(thing) // 2, 1)
    assert not propagation._is_alone(replace(frame, foreground=arm | thing | beside), thing)


def test_landmarks_that_the_object_hides_do_not_make_it_a_hand() -> None:
    """On the seed frame the hand is behind the object, and its landmarks are all over the box."""
    video = scene(hand=True)
    rows, columns = np.nonzero(video.object[0])
    corner, points = np.array([columns.min(), rows.min()]), landmarks(0).landmarks
    points = (points - points.min(0)) / np.ptp(points, 0) * (np.ptp(columns), np.ptp(rows)) + corner
    hands = [[Hand(points.astype(np.float32), 1.0, 1.0)], *([landmarks(i)] for i in range(1, len(video.pictures)))]
    background = estimate_background(video.pictures, video.object | video.hand)
    masks = propagation.segment(video.pictures, background, Seed(0, video.box()), hands)
    known = masks.labels[0] != UNKNOWN
    assert overlap(masks.labels[0] == OBJECT, video.object[0] & known) > 0.85
    assert (masks.labels[5:][video.object[5:]] == OBJECT).mean() > 0.7
    assert (masks.labels[video.hand] == OBJECT).mean() < 0.01


@pytest.mark.parametrize("label", [False, True])
def test_what_a_hand_had_hidden_is_object_again(label: bool) -> None:
    """A second hand covers three quarters of the object for some frames, then none is there.

    What it had hidden has the object's colours, or those of the hand.
    """
    video, covered = scene(), slice(6, 11)
    pictures, truth, hands = video.pictures.copy(), video.object.copy(), [[] for _ in video.pictures]
    columns = np.nonzero(video.object[6].any(0))[0]
    edge = int(columns[0] + 0.25 * (columns[-1] - columns[0]))
    if label:
        pictures[covered.stop :, :, edge:][truth[covered.stop :, :, edge:]] = PRINT
    pictures[covered, :, edge:] = SKIN
    truth[covered, :, edge:] = False
    palm = landmarks(0).landmarks * 1.4
    palm += (edge + 6, 20) - palm.min(0)
    hands[covered] = [[Hand(palm.astype(np.float32), 1.0, 1.0)] for _ in hands[covered]]
    background = estimate_background(video.pictures, video.object)
    masks = propagation.segment(pictures, background, Seed(0, video.box()), hands)
    pairs = list(zip(masks.labels, truth, strict=True))[covered.stop :]
    assert min(overlap(labels == OBJECT, inside & (labels != UNKNOWN)) for labels, inside in pairs) > 0.9
    assert np.mean([(labels[inside] == OBJECT).mean() for labels, inside in pairs[-4:]]) > 0.7


def test_a_sleeve_has_the_colours_of_the_hand() -> None:
    """It moves at the border of the image, below the hand."""
    video, sleeve = scene(hand=True), (30, 60, 160)
    pictures = video.pictures.copy()
    for i, picture in enumerate(pictures):
        left = 50 + 6 * (i % 5)
        picture[-14:, left : left + 50] = sleeve
    hands = [[landmarks(i)] for i in range(len(pictures))]
    background = estimate_background(pictures, video.object | video.hand)
    density = hand_colours(pictures, hands, background)
    lab = cv2.cvtColor(np.array([[sleeve]], np.uint8), cv2.COLOR_RGB2LAB)[0, 0]
    assert density[lab[0] >> 5, lab[1] >> 3, lab[2] >> 3] > 100 * UNIFORM_DENSITY


def test_an_object_that_leaves_is_not_found() -> None:
    video = scene()
    pictures = video.pictures.copy()
    pictures[12:] = video.background
    hands = [[] for _ in pictures]
    masks = propagation.segment(pictures, estimate_background(pictures), Seed(0, video.box()), hands)
    assert (masks.labels[13:] == OBJECT).mean() < 1e-3
    assert masks.confidence[13:].max() == 0
    assert masks.uncertain[13:].all()


def test_a_box_on_the_empty_wall_is_refused() -> None:
    video = scene()
    hands = [[] for _ in video.pictures]
    with pytest.raises(ValueError, match="no object in the box, or at the click, on frame 0"):
        propagation.segment(video.pictures, estimate_background(video.pictures), Seed(0, (0, 100, 20, 20)), hands)


def test_a_rotating_object_is_tracked_from_a_box() -> None:
    """The bundled clip rotates by 10 degrees per frame, three to ten times as fast as a typical phone video."""
    video = scene()
    masks = without_hands(video, Seed(0, video.box()))
    iou, lost, _ = scores(masks, video)
    assert iou > 0.87
    assert lost < 0.06
    assert not masks.uncertain.any()
    assert masks.confidence.min() > 0.8


def test_a_hand_that_was_not_detected_is_no_object() -> None:
    video = scene(hand=True)
    masks = without_hands(video, Seed(0, video.box()))
    iou, lost, hand = scores(masks, video)
    assert iou > 0.85
    assert lost < 0.2
    assert hand < 0.05
    # Fingers in front of the object must not be background, which would carve the visual hull. The palm holds still.
    near = np.stack([segmentation.dilated(inside, 4) for inside in video.object]) & video.hand
    assert (masks.labels[near] == BACKGROUND).mean() < 0.2


def test_a_skin_coloured_texture_belongs_to_the_object() -> None:
    """A disc rotates into view in the middle of the object; unlike a hand it does not extend beyond the object."""
    video = scene()
    pictures, painted = video.pictures.copy(), np.zeros(video.object.shape, bool)
    for i, inside in enumerate(video.object):
        row, column = (int(x.mean()) for x in np.nonzero(inside))
        disc = np.hypot(np.arange(inside.shape[0])[:, None] - row, np.arange(inside.shape[1]) - column) < min(
            3 * (i - 4), 12
        )
        painted[i] = disc & inside
        pictures[i][painted[i]] = (110, 35, 30)
    masks = without_hands(Scene(pictures, video.object, video.hand, video.background), Seed(0, video.box()))
    assert (masks.labels[painted] == OBJECT).mean() > 0.95


def test_a_seed_in_the_middle_is_propagated_both_ways() -> None:
    video = scene()
    masks = without_hands(video, Seed(10, video.box(10)))
    iou, _, _ = scores(masks, video)
    assert iou > 0.85


def test_a_click_suffices_on_a_clear_video() -> None:
    video = scene()
    rows, columns = np.nonzero(video.object[0])
    masks = without_hands(video, Seed(0, click=(int(np.median(columns)), int(np.median(rows)))))
    assert scores(masks, video)[0] > 0.75
