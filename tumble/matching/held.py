"""Matcher for an object that hands hide in part, in place of the default one: that and ALIKED.

Between frames of which hands leave little of the object, optical flow and SIFT lose nearly all points as soon as it
rotates by 20 degrees; the network keeps some up to 60. Chosen by `--matcher held` only (docs/method.md).
"""

import torch

from tumble.matching import aliked, joined, mixed
from tumble.scene import Match, View

VERSION = 1
PARTS = ("mixed", "aliked")
"""Names of the combined matchers."""


def load(device: torch.device | str):
    """Matcher, which caches every frame's keypoints."""
    matchers = mixed.load(device), aliked.load(device)

    def match(view_i: View, view_j: View) -> Match:
        return joined([matcher(view_i, view_j) for matcher in matchers])

    return match
