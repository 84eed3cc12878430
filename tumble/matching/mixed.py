"""The default: SIFT's few sure correspondences together with the dense flow's many, where that one is to be believed.

Both state how likely a correspondence is correct. Flow between frames that are far apart loses most of its points on
the way back, hence its trust in the rest, and falls under the bar as a whole: then SIFT is alone.
"""

import torch

from tumble.matching import dis, sift
from tumble.scene import Match, View

VERSION = 1
PARTS = ("sift", "dis")
BELIEF = 0.6
"""Least confidence. It asks that about a quarter of the object's surface returns."""


def load(device: torch.device | str):
    """A matcher that remembers every frame's features."""
    sparse, dense = sift.load(device), dis.load(device)

    def match(view_i: View, view_j: View) -> Match:
        found = [matcher(view_i, view_j) for matcher in (sparse, dense)]
        uv_i, uv_j, confidence = (
            torch.cat([getattr(m, name) for m in found]) for name in ("uv_i", "uv_j", "confidence")
        )
        return Match(view_i.number, view_j.number, uv_i, uv_j, confidence).select(confidence >= BELIEF)

    return match
