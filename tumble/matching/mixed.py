"""Default matcher: the sparse correspondences of SIFT together with the dense ones of DIS optical flow.

The confidences of both estimate the probability that a correspondence is correct. Between frames far apart most pixels
fail the forward-backward check of the flow; the confidence of the others is then below the threshold as well, and only
SIFT's correspondences remain.
"""

import torch

from tumble.matching import dis, joined, sift
from tumble.scene import Match, View

VERSION = 1
CONCURRENT = True
PARTS = ("sift", "dis")
"""Names of the combined matchers."""
MIN_CONFIDENCE = 0.6
"""Smallest confidence; for flow, about a quarter of the starting points must pass the forward-backward check."""


def load(device: torch.device | str):
    """Matcher, which caches every frame's SIFT keypoints."""
    sparse, dense = sift.load(device), dis.load(device)

    def match(view_i: View, view_j: View) -> Match:
        found = joined([matcher(view_i, view_j) for matcher in (sparse, dense)])
        return found.select(found.confidence >= MIN_CONFIDENCE)

    return match
