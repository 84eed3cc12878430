"""Tracking of hands through a video: the landmarks of one frame say where the hand is in the next.

A tracked hand needs only the landmark network. Palms are searched where no hand is tracked, and now and then for
further hands. A second pass, backwards in time, fills the gap before the frame in which a hand was found.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from tumble.preprocess.hands.detection import (
    Hand,
    crop_of_hand,
    detect_hands,
    distinct,
    find_landmarks,
    same_hand,
)

MIN_TRACKED_PRESENCE = 0.3
"""Minimum probability of a hand where the neighbouring frame shows one."""
SEARCH_INTERVAL = 10
"""Number of frames after which palms are searched although a hand is tracked."""
LOST_INTERVAL = 3
"""Number of frames after which palms are searched while no hand is tracked."""


def track_hands(images: Sequence[UInt8[np.ndarray, "h w 3"]] | UInt8[np.ndarray, "t h w 3"]) -> list[list[Hand]]:
    """The hands in each of the consecutive frames of a video, in order of decreasing presence; sRGB."""
    found: list[list[Hand]] = []
    hands: list[Hand] = []
    for i, image in enumerate(images):
        hands = follow(image, hands)
        if i % (SEARCH_INTERVAL if hands else LOST_INTERVAL) == 0:
            hands = distinct(hands + detect_hands(image))
        found.append(hands)
    for i in range(len(images) - 2, -1, -1):
        missed = [hand for hand in found[i + 1] if not any(same_hand(hand, other) for other in found[i])]
        found[i] = distinct(found[i] + follow(images[i], missed))
    return found


def follow(image: UInt8[np.ndarray, "h w 3"], hands: Sequence[Hand]) -> list[Hand]:
    """The hands of a neighbouring frame that this frame shows too."""
    seen = find_landmarks(image, [crop_of_hand(hand) for hand in hands])
    return distinct([hand for hand in seen if hand.presence >= MIN_TRACKED_PRESENCE])
