"""Tracking on films made of a photograph that is shifted and turned by known amounts."""

import cv2
import numpy as np

from tests.preprocess.hands.picture import picture
from tumble.preprocess.hands import detect_hands, track_hands
from tumble.preprocess.hands.tracking import follow


def moved(angle: float, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The photograph turned about its centre [degrees] and shifted [pixels], and the map of positions [2 3]."""
    A = cv2.getRotationMatrix2D((160, 120), angle, 1.0)
    A[:, 2] += shift
    of_pixels = A.copy()
    of_pixels[:, 2] += A[:, :2].sum(1) / 2 - 0.5
    return cv2.warpAffine(picture(), of_pixels, (320, 240), borderMode=cv2.BORDER_REPLICATE), A


def test_a_hand_is_followed_through_shifts_and_turns() -> None:
    (start,) = detect_hands(picture())
    hands = [start]
    for i in range(1, 7):
        image, A = moved(10.0 * i, (-8.0 * i, 4.0 * i))
        hands = follow(image, hands)
        assert len(hands) == 1
        error = start.landmarks @ A[:, :2].T + A[:, 2] - hands[0].landmarks
        # Half the width of a finger. Not of all landmarks: the wrist lies at the border of the photograph.
        assert np.median(np.linalg.norm(error, axis=-1)) < 6


def test_a_hand_is_followed_backwards_to_where_it_is_not_detected() -> None:
    """The photograph fades in; the palm network sees the hand late, the landmark network sooner."""
    film = np.stack([(255 - fade * (255.0 - picture())).astype(np.uint8) for fade in (0, 0.15, 0.2, 0.25)])
    assert [len(detect_hands(image)) for image in film] == [0, 0, 0, 1]
    assert [len(hands) for hands in track_hands(film)] == [0, 1, 1, 1]


def test_a_hand_is_found_again_after_it_was_away() -> None:
    wall = np.ascontiguousarray(picture()[:, :160].repeat(2, 1))
    found = track_hands([picture(), wall, wall, picture()])
    assert [len(hands) for hands in found] == [1, 0, 0, 1]


def test_no_frames_have_no_hands() -> None:
    assert track_hands([]) == []
