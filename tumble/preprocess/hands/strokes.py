"""Regions of an image that belong to a hand for certain, or perhaps, from its landmarks: seeds of a segmentation."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from tumble.maths import filled_hull
from tumble.preprocess.hands.detection import MIDDLE, RING, WRIST, Hand

FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (0, 9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
"""Landmarks of thumb, index, middle, ring and little finger, from the palm to the tip; the middle one from the wrist,
because a palm seen from its edge has no area."""
PALM = (0, 1, 5, 9, 13, 17)
"""Landmarks around the palm."""
STROKE_WIDTH = 0.1
"""Width of a stroke as a fraction of the size of the palm; a finger is almost twice as wide."""
PALM_MARGIN = 0.05
"""Width of the rim of the palm that is not certain, as a fraction of the size of the palm."""
REGION_MARGIN = 0.4
"""Distance from the landmarks up to which a hand may reach, as a fraction of the size of the palm."""

FINGER_MARGIN = 0.1
"""Distance from the strokes up to which pixels may show fingers, as a fraction of the size of the palm."""
FLESH = (PALM, (1, 2, 5))
"""Landmarks around the palm, and around the skin between thumb and index finger."""
FLESH_MARGIN = 0.25
"""Distance from these areas up to which pixels may show a hand, as a fraction of the size of the palm."""
ARM_WIDTH = 0.8
"""Width of an arm as a fraction of the size of the palm."""
ARM_REACH = (0.3, 6.0)
"""Distances from the wrist between which the arm is expected [size of the palm]."""


def hand_strokes(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the hands: lines along the bones of the fingers, and the palms without their rims.

    There are landmarks of hidden parts of a hand too: strokes may run over an object that is held.

    Args:
        hands: Hands of one image.
        shape: Height and width of the image [pixels].
    """
    mask = np.zeros(shape, np.uint8)
    for hand in hands:
        points, size = np.floor(hand.landmarks).astype(np.int32), palm_size(hand)
        palm = cv2.fillPoly(np.zeros(shape, np.uint8), [points[list(PALM)]], 1)
        cv2.polylines(palm, [points[list(PALM)]], True, 0, _thickness(2 * PALM_MARGIN * size))
        mask[palm > 0] = 1
        for finger in FINGERS:
            cv2.polylines(mask, [points[list(finger)]], False, 1, _thickness(STROKE_WIDTH * size))
    return mask.astype(bool)


def hand_region(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels that may belong to the hands: the convex hulls of their landmarks, with a margin. Arms reach further.

    Args:
        hands: Hands of one image.
        shape: Height and width of the image [pixels].
    """
    mask = np.zeros(shape, bool)
    for hand in hands:
        border = _thickness(2 * REGION_MARGIN * palm_size(hand))
        mask |= filled_hull(np.floor(hand.landmarks).astype(np.int32), shape, border)
    return mask


def hand_surroundings(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the hands and close to them: the strokes, widened to fingers, and the palms, widened to their flesh.

    Args:
        hands: Hands of one image.
        shape: Height and width of the image [pixels].
    """
    mask = np.zeros(shape, bool)
    for hand in hands:
        points, size, flesh = np.floor(hand.landmarks).astype(np.int32), palm_size(hand), np.zeros(shape, np.uint8)
        for area in FLESH:
            cv2.fillPoly(flesh, [points[list(area)]], 1)
        mask |= _widened(flesh > 0, FLESH_MARGIN * size) | _widened(hand_strokes([hand], shape), FINGER_MARGIN * size)
    return mask


def arm_region(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels behind the wrists, in the direction of the palms: an arm is there unless the wrist is bent.

    Args:
        hands: Hands of one image.
        shape: Height and width of the image [pixels].
    """
    mask = np.zeros(shape, np.uint8)
    for hand in hands:
        wrist, size, direction = hand.landmarks[WRIST], palm_size(hand), _arm_direction(hand)
        near, far = (np.floor(wrist + reach * size * direction).astype(int).tolist() for reach in ARM_REACH)
        cv2.line(mask, near, far, 1, _thickness(ARM_WIDTH * size))
    return mask.astype(bool)


def wrist_region(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels around the wrists, without the palms' sides: an arm begins there, wherever a bent wrist lets it go.

    Args:
        hands: Hands of one image.
        shape: Height and width of the image [pixels].
    """
    mask = np.zeros(shape, np.uint8)
    for hand in hands:
        wrist, radius = np.floor(hand.landmarks[WRIST]).astype(int).tolist(), round(ARM_WIDTH * palm_size(hand))
        x, y = _arm_direction(hand)
        cv2.ellipse(mask, wrist, (radius, radius), math.degrees(math.atan2(y, x)), -90, 90, 1, -1)
    return mask.astype(bool)


def palm_size(hand: Hand) -> float:
    """Largest distance between landmarks of the palm, about the same from all sides [pixels]."""
    palm = hand.landmarks[list(PALM)]
    return float(np.linalg.norm(palm[:, None] - palm, axis=-1).max())


def _arm_direction(hand: Hand) -> Float[np.ndarray, "2"]:
    """Direction from the knuckles to the wrist, of length 1: that of the arm, unless the wrist is bent."""
    direction = hand.landmarks[WRIST] - (hand.landmarks[MIDDLE] + hand.landmarks[RING]) / 2
    return direction / max(float(np.linalg.norm(direction)), 1e-3)


def _widened(mask: Bool[np.ndarray, "h w"], distance: float) -> Bool[np.ndarray, "h w"]:
    """The mask with all pixels up to a distance from it [pixels]."""
    radius = _thickness(distance)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(mask.astype(np.uint8), disc) > 0


def _thickness(width: float) -> int:
    """Width of a line that OpenCV can draw [pixels]."""
    return max(1, round(width))
