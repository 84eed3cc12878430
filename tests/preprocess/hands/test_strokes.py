"""Seeds of a segmentation from landmarks whose places are known."""

import numpy as np
import pytest

from tests.preprocess.hands.picture import LITTLE_FINGER, THUMB_TIP, picture
from tumble.preprocess.hands import Hand, detect_hands, hand_region, hand_strokes, hand_surroundings, wrist_region

WRIST, KNUCKLES, TIPS = 150.5, 100.5, 60.5
"""Rows of a hand that points up."""


def flat() -> Hand:
    """Fingers at the columns 80.5, 90.5 ... 120.5."""
    points = np.empty((21, 2), np.float32)
    points[0] = 100.5, WRIST
    for finger in range(5):
        points[1 + 4 * finger : 5 + 4 * finger, 0] = 80.5 + 10 * finger
        points[1 + 4 * finger : 5 + 4 * finger, 1] = np.linspace(KNUCKLES, TIPS, 4)
    return Hand(points, 1.0, 0.5)


def test_strokes_run_along_the_fingers_and_over_the_palm() -> None:
    mask = hand_strokes([flat()], (200, 220))
    # Size: from the wrist to the outer knuckles, 53.9 pixels; a tenth of it is 5. OpenCV's lines are up to 2 wider.
    fingers = mask[80, 75:125].reshape(5, 10)
    assert fingers[:, 3:8].all()
    assert not fingers[:, [0, 1, 9]].any()
    assert mask[120, 95:106].all()
    assert not mask[160:].any()
    assert not mask[:57].any()
    assert not mask[:, :77].any()
    assert not mask[:, 124:].any()


def test_the_region_contains_the_strokes_with_a_margin() -> None:
    """0.4 of the size: 22 pixels."""
    strokes, region = (seeds([flat()], (200, 220)) for seeds in (hand_strokes, hand_region))
    assert not (strokes & ~region).any()
    columns = np.flatnonzero(region[80])
    assert abs(columns[0] - (80 - 22)) <= 1
    assert abs(columns[-1] - (120 + 22)) <= 1


def test_the_surroundings_are_fingers_with_their_width_and_the_flesh_of_the_palm() -> None:
    """Margins: 0.1 and 0.25 of the size, 5 and 13 pixels. Between thumb and index finger there is skin."""
    hand = flat()
    hand.landmarks[:, 0] += np.where(np.isin(np.arange(21), (2, 3, 4)), -30, 0)  # the thumb points away
    around = hand_surroundings([hand], (200, 220))
    assert not (hand_strokes([hand], (200, 220)) & ~around).any()
    assert abs(np.flatnonzero(around[62])[-1] - (120 + 3 + 5)) <= 2
    assert abs(np.flatnonzero(around[:, 100])[-1] - (150 + 13)) <= 2
    assert around[93, 70], "skin"
    assert not around[65, 70], "between the tips"


def test_an_arm_begins_around_the_wrist() -> None:
    """0.8 of the size, 43 pixels, behind the palm or beside it: the line to the knuckles slants by a tenth."""
    rows, columns = np.nonzero(wrist_region([flat()], (220, 220)))
    assert (rows.min(), rows.max()) == pytest.approx((WRIST - 4.3, WRIST + 43), abs=1)
    assert (columns.min(), columns.max()) == pytest.approx((100 - 43, 100 + 43), abs=1)


def test_strokes_of_a_photograph_are_skin() -> None:
    """Fingers behind the tumbler are strokes too, which is why three quarters are enough."""
    image = picture()
    strokes, region = (seeds(detect_hands(image), image.shape[:2]) for seeds in (hand_strokes, hand_region))
    skin = image[..., 0] > image[..., 2].astype(int) + 30
    assert skin[strokes].mean() > 0.75
    assert region[THUMB_TIP[::-1]]
    assert region[LITTLE_FINGER[::-1]]
    assert not region[:, :160].any()


def test_no_hands_no_seeds() -> None:
    assert not hand_strokes([], (4, 5)).any()
    assert hand_region([], (4, 5)).shape == (4, 5)
