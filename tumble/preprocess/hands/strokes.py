"""Regions of an image that belong to a hand for certain, or perhaps, from its landmarks: seeds of a segmentation."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from tumble.preprocess.hands.detection import CROP_LANDMARKS, LITTLE, WRIST, Hand

FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
"""Landmarks of thumb, index, middle, ring and little finger, from the palm to the tip."""
PALM = (0, 1, 5, 9, 13, 17)
"""Landmarks around the palm."""
BONES = tuple(pair for finger in FINGERS for pair in zip(finger, finger[1:], strict=False))
"""Pairs of landmarks that a bone of a finger connects."""
STROKE_WIDTH = 0.1
"""Width of a stroke as a fraction of the size of the palm; a finger is about 0.2 wide."""
PALM_MARGIN = 0.1
"""Width of the rim of the palm that is not certain, as a fraction of its size."""
REGION_MARGIN = 0.5
"""Distance from the landmarks up to which the hand may reach, as a fraction of the size of the palm."""


def hand_strokes(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the hands: lines along the bones of the fingers, and the palm without a rim.

    Landmarks are given for hidden parts of the hand too: strokes may run over an object that is held.

    Args:
        hands: Hands of one image.
        shape: Height and width of the image [pixels].
    """
    mask = np.zeros(shape, np.uint8)
    for hand in hands:
        size = palm_size(hand)
        palm = np.zeros(shape, np.uint8)
        cv2.fillPoly(palm, [_pixels(hand, PALM)], 1)
        mask |= cv2.erode(palm, _disc(PALM_MARGIN * size), borderValue=0)
        for bone in BONES:
            start, end = _pixels(hand, bone)
            cv2.line(mask, start.tolist(), end.tolist(), 1, max(1, round(STROKE_WIDTH * size)))
    return mask.astype(bool)


def hand_region(hands: Sequence[Hand], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Pixels that may belong to the hands: the convex hull of the landmarks with a margin. The arm reaches further."""
    mask = np.zeros(shape, np.uint8)
    for hand in hands:
        hull = np.zeros(shape, np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(_pixels(hand, range(21))), 1)
        mask |= cv2.dilate(hull, _disc(REGION_MARGIN * palm_size(hand)))
    return mask.astype(bool)
