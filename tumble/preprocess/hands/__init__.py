"""Hands in images and videos, by the networks of MediaPipe: 21 landmarks per hand, tracking, seeds of a segmentation.

`detect_hands` looks at one image; `track_hands` follows hands through a video, which finds more of them in less time.
`hand_strokes` are pixels of the hands, `hand_surroundings` and the larger `hand_region` may be, `arm_region` are arms,
which begin in the `wrist_region`.
"""

from tumble.preprocess.hands.detection import Hand, detect_hands
from tumble.preprocess.hands.strokes import arm_region, hand_region, hand_strokes, hand_surroundings, wrist_region
from tumble.preprocess.hands.tracking import track_hands

__all__ = [
    "Hand",
    "arm_region",
    "detect_hands",
    "hand_region",
    "hand_strokes",
    "hand_surroundings",
    "track_hands",
    "wrist_region",
]
