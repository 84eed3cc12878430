"""ALIKED keypoints (Zhao et al. 2023) matched by LightGlue (Lindenberger et al. 2023): learned, for wide turns.

Weights: `tumble weights get aliked`.
"""

import numpy as np
import torch
from torch import Tensor

from tumble.io import weights
from tumble.matching import _aliked, _lightglue
from tumble.matching._window import MARGIN, digest, extent, window
from tumble.scene import Match, View, no_match

VERSION = 1
SIZE = 512
"""The object's window is resampled to this size."""
KEPT = 1024
"""Most keypoints of a frame."""
LEAST = 0.05
"""Least score of a keypoint; the published 0.2 leaves few on plain surfaces."""
BELIEF = 0.1
"""Least probability of a correspondence (the published threshold)."""

Features = tuple[Tensor, Tensor, Tensor]
"""Positions in the frame, positions in the window in [-1, 1], unit descriptors."""


def load(device: torch.device | str):
    """A matcher that remembers every frame's features.

    Raises:
        BadFile: The weights have not been fetched.
    """
    extractor = weights.read("aliked", "aliked-n16rot", device)
    glue = weights.read("aliked", "aliked_lightglue", device)
    known: dict[str, Features] = {}

    def features(view: View) -> Features:
        name = digest(view)
        if name not in known:
            known[name] = _describe(view, extractor)
        return known[name]

    @torch.no_grad()
    def match(view_i: View, view_j: View) -> Match:
        (uv_i, at_i, unit_i), (uv_j, at_j, unit_j) = features(view_i), features(view_j)
        if min(len(uv_i), len(uv_j)) == 0:
            return no_match(view_i.number, view_j.number)
        likely = _lightglue.assignment(at_i, at_j, unit_i, unit_j, glue).cpu()
        best, back = likely.argmax(1), likely.argmax(0)
        i = torch.arange(len(best))
        i = i[(back[best] == i) & (likely[i, best] > BELIEF)]
        return Match(view_i.number, view_j.number, uv_i[i], uv_j[best[i]], likely[i, best[i]])

    return match


@torch.no_grad()
def _describe(view: View, parameters: dict[str, Tensor]) -> Features:
    device = parameters["conv1.weight"].device
    reach = extent(view) * (1 + 2 * MARGIN)
    if reach == 0:
        return torch.zeros(0, 2), torch.zeros(0, 2, device=device), torch.zeros(0, 128, device=device)
    look = window(view, reach, SIZE)
    image = torch.from_numpy(look.rgb).to(device).permute(2, 0, 1)[None] / 255
    features, score = _aliked.dense(image, parameters)
    sure = torch.from_numpy(look.sure).to(device)
    at = _aliked.keypoints(score, sure, count=KEPT, least=LEAST)
    # A maximum on a sure pixel may move to a neighbour that is not.
    at = at[torch.from_numpy(look.holds(at.cpu().numpy() + 0.5)).to(device)]
    unit = _aliked.descriptors(features, at, parameters)
    return look.in_frame(at.cpu().numpy().astype(np.float64) + 0.5), 2 * at / SIZE - 1, unit
