"""Hands in images and videos, by the networks of MediaPipe: 21 landmarks per hand, tracking, seeds of a segmentation.

`detect_hands` looks at one image; `track_hands` follows hands through a video, which finds more of them in less time.
`hand_strokes` and `hand_region` say which pixels belong to the hands for certain, and which perhaps.
"""

from tumble.preprocess.hands.detection import Hand, detect_hands
from tumble.preprocess.hands.strokes import hand_region, hand_strokes
from tumble.preprocess.hands.tracking import track_hands

__all__ = ["Hand", "detect_hands", "hand_region", "hand_strokes", "track_hands"]
