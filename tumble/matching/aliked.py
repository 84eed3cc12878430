"""ALIKED keypoints (Zhao et al. 2023) matched by LightGlue (Lindenberger et al. 2023), for wide rotations.

The published weights, rounded to 16-bit floats, are part of the package (`docs/make_aliked.py`).
"""

from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from tumble.matching import _aliked, _lightglue
from tumble.matching._window import MARGIN, crop_window, digest, extent
from tumble.scene import Match, View, empty_match

VERSION = 4
WEIGHTS = Path(__file__).with_suffix(".safetensors")
SIZE = 512
"""Height and width of the window around the object that is matched [pixels]."""
MAX_KEYPOINTS = 512
"""Largest number of keypoints per frame; with twice as many, a pair takes 2.4 times as long and has fewer matches."""
MIN_SCORE = 0.05
"""Smallest score of a keypoint; the published 0.2 leaves few on weakly textured surfaces."""
MIN_PROBABILITY = 0.1
"""Smallest probability of a correspondence (the published threshold)."""

Features = tuple[Tensor, Tensor, Tensor]
"""Keypoints of a frame: positions in the frame [pixels], positions in the window in [-1, 1], unit descriptors."""


def load(device: torch.device | str):
    """Matcher on a device, which caches every frame's keypoints."""
    tensors = {name: value.float() for name, value in safetensors.torch.load_file(WEIGHTS, str(device)).items()}
    extractor, glue = (
        {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        for prefix in ("aliked.", "lightglue.")
    )
    cached: dict[str, Features] = {}

    def features(view: View) -> Features:
        name = digest(view)
        if name not in cached:
            cached[name] = _extract(view, extractor)
        return cached[name]

    @torch.no_grad()
    def match(view_i: View, view_j: View) -> Match:
        (uv_i, at_i, unit_i), (uv_j, at_j, unit_j) = features(view_i), features(view_j)
        if min(len(uv_i), len(uv_j)) == 0:
            return empty_match(view_i.number, view_j.number)
        probability = _lightglue.assignment(at_i, at_j, unit_i, unit_j, glue).cpu()
        best, back = probability.argmax(1), probability.argmax(0)
        i = torch.arange(len(best))
        i = i[(back[best] == i) & (probability[i, best] > MIN_PROBABILITY)]
        return Match(view_i.number, view_j.number, uv_i[i], uv_j[best[i]], probability[i, best[i]])

    return match


@torch.no_grad()
def _extract(view: View, parameters: dict[str, Tensor]) -> Features:
    """Keypoints of a view, with descriptors."""
    device = parameters["conv1.weight"].device
    none = torch.zeros(0, 2), torch.zeros(0, 2, device=device), torch.zeros(0, 128, device=device)
    width = extent(view) * (1 + 2 * MARGIN)
    if width == 0:
        return none
    window = crop_window(view, width, SIZE)
    image = torch.from_numpy(window.rgb).to(device).permute(2, 0, 1)[None] / 255
    levels, score = _aliked.dense(image, parameters)
    usable = torch.from_numpy(window.usable).to(device)
    at = _aliked.keypoints(score, usable, max_count=MAX_KEYPOINTS, min_score=MIN_SCORE)
    # Sub-pixel refinement may move a keypoint off the usable pixels.
    at = at[torch.from_numpy(window.contains(at.cpu().numpy() + 0.5)).to(device)]
    if not len(at):
        return none
    unit = _aliked.descriptors(levels, at, parameters)
    return window.in_frame(at.cpu().numpy().astype(np.float64) + 0.5), 2 * at / SIZE - 1, unit
