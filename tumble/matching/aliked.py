"""ALIKED keypoints (Zhao et al. 2023) matched by LightGlue (Lindenberger et al. 2023), for wide rotations.

The published weights, rounded to 16-bit floats, are part of the package (`docs/make_aliked.py`).
"""

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.matching import _aliked, _lightglue
from tumble.matching._lightglue import DescribedKeypoints
from tumble.matching._window import MARGIN, Window, crop_window, digest, extent
from tumble.scene import Match, View, empty_match

VERSION = 5
WEIGHTS = Path(__file__).with_suffix(".safetensors")
SIZE = 512
"""Height and width of the window around the object that is matched [pixels]."""
MAX_KEYPOINTS = 512
"""Largest number of keypoints per frame; with twice as many, a pair takes 2.4 times as long and has fewer matches."""
MIN_SCORE = 0.05
"""Smallest score of a keypoint; the published 0.2 leaves few on weakly textured surfaces."""
KEPT_FEATURES = 600
"""Number of frames, of any turn, whose keypoints are kept; limits memory to 160 MB."""
MIN_PROBABILITY = 0.1
"""Smallest probability of a correspondence (the published threshold)."""
OFFSET = (0.41, -0.04)
"""Mean position (x, y) of the network's keypoints beside what they mark [pixels of the window]
(docs/experiments/constants.md)."""


@dataclass(frozen=True)
class Features:
    """Keypoints of a frame, those of the highest score first."""

    uv: Float[Tensor, "n 2"]
    """Positions in the frame [pixels]."""
    keypoints: DescribedKeypoints
    """What the network matches, in the window around the object, which may be turned."""

    def __len__(self) -> int:
        return len(self.uv)


class AlikedLightGlue:
    """Both networks on a device, with the keypoints of the last frames."""

    def __init__(self, device: torch.device | str) -> None:
        tensors = {name: value.float() for name, value in safetensors.torch.load_file(WEIGHTS, str(device)).items()}
        self._extractor, self.glue = (
            {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
            for prefix in ("aliked.", "lightglue.")
        )
        self._kept: OrderedDict[tuple[str, int], Features] = OrderedDict()

    def features(self, view: View, turns: int = 0) -> Features:
        """Keypoints of a view, described and placed as they are seen after quarter turns to the left.

        They are those of the view as it is, so that tracks go through matches of all turns.
        """
        key = digest(view), turns
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        if turns == 0:
            found = _extract(view, self._extractor)
        else:
            found = _turned(view, self.features(view), turns, self._extractor)
        self._kept[key] = found
        if len(self._kept) > KEPT_FEATURES:
            self._kept.popitem(last=False)
        return found

    @torch.no_grad()
    def matched(self, of_i: Features, of_j: Features, i: int, j: int) -> Match:
        """Keypoints of frames i and j that are each other's best match."""
        if min(len(of_i), len(of_j)) == 0:
            return empty_match(i, j)
        probability = _lightglue.assignment(of_i.keypoints, of_j.keypoints, self.glue).cpu()
        best, back = probability.argmax(1), probability.argmax(0)
        k = torch.arange(len(best))
        k = k[(back[best] == k) & (probability[k, best] > MIN_PROBABILITY)]
        return Match(i, j, of_i.uv[k], of_j.uv[best[k]], probability[k, best[k]])


@lru_cache(maxsize=1)
def network(device: str) -> AlikedLightGlue:
    """Networks on a device: the same for all matchers that use them, so that they share the keypoints."""
    return AlikedLightGlue(device)


def load(device: torch.device | str):
    """Matcher on a device, which keeps the keypoints of frames."""
    both = network(str(device))

    def match(view_i: View, view_j: View) -> Match:
        return both.matched(both.features(view_i), both.features(view_j), view_i.number, view_j.number)

    return match


@torch.no_grad()
def _extract(view: View, parameters: dict[str, Tensor]) -> Features:
    """Keypoints of a view, with descriptors."""
    device = parameters["conv1.weight"].device
    none = Features(
        torch.zeros(0, 2), DescribedKeypoints(torch.zeros(0, 2, device=device), torch.zeros(0, 128, device=device))
    )
    if extent(view) == 0:
        return none
    window = _window_of(view)
    levels, score = _aliked.dense(_network_input(window, device), parameters)
    usable = torch.from_numpy(window.usable).to(device)
    at = _aliked.keypoints(score, usable, max_count=MAX_KEYPOINTS, min_score=MIN_SCORE)
    # Sub-pixel refinement may move a keypoint off the usable pixels.
    at = at[torch.from_numpy(window.contains(at.cpu().numpy() + 0.5)).to(device)]
    if not len(at):
        return none
    uv = window.in_frame(at.cpu().numpy().astype(np.float64) - OFFSET + 0.5)
    return Features(uv, DescribedKeypoints(2 * at / SIZE - 1, _aliked.descriptors(levels, at, parameters)))


@torch.no_grad()
def _turned(view: View, straight: Features, turns: int, parameters: dict[str, Tensor]) -> Features:
    """The same keypoints, described and placed as they are seen after quarter turns to the left."""
    if not len(straight):
        return straight
    offset = straight.keypoints.at.new_tensor(OFFSET)
    at = (straight.keypoints.at + 1) * SIZE / 2 - offset
    for _ in range(turns):
        at = torch.stack([at[:, 1], SIZE - 1 - at[:, 0]], -1)
    at = at + offset
    image = _network_input(_window_of(view), at.device).rot90(turns, (2, 3))
    descriptors = _aliked.descriptors(_aliked.dense(image, parameters)[0], at, parameters)
    return Features(straight.uv, DescribedKeypoints(2 * at / SIZE - 1, descriptors))


def _window_of(view: View) -> Window:
    return crop_window(view, extent(view) * (1 + 2 * MARGIN), SIZE)


def _network_input(window: Window, device: torch.device) -> Float[Tensor, "1 3 h w"]:
    return torch.from_numpy(window.rgb).to(device).permute(2, 0, 1)[None] / 255
