"""RoMa v2 (Edstedt et al. 2025), installed by the user: dense and robust matching, slow without a GPU.

The package `romav2` (MIT; its backbone under Meta's DINOv3 licence) downloads code and weights from GitHub on first use
and requires torchvision, so it is not a dependency. This adapter is written for the interface of romav2 2.0.1 and
tested with a mock of it; it has not been run with the real network.
"""

import importlib

import numpy as np
import torch

from tumble.matching._window import crop_windows
from tumble.scene import Match, View, empty_match

VERSION = 1
SETTING = "base"
"""RoMa's name for its setting of one direction at 640 pixels."""
SIZE = 640
"""Height and width of the window around the object that is matched [pixels]."""
STEP = 8
"""Spacing of the grid of starting points [pixels of the window]."""
MIN_OVERLAP = 0.5
"""Smallest probability that the other frame shows the point, RoMa's "overlap"."""


def load(device: torch.device | str):
    """Matcher; it has no state. The network runs on the device that romav2 selects; `device` is not used.

    Raises:
        ModuleNotFoundError: romav2 is not installed.
    """
    try:
        romav2 = importlib.import_module("romav2")
    except ModuleNotFoundError as missing:
        fix = "pip install romav2, in a separate environment if this one should stay without torchvision"
        raise ModuleNotFoundError(
            f"the matcher roma needs a package that is not installed: {missing} ({fix})"
        ) from None
    # romav2 refuses to run otherwise, because its warps would be inaccurate.
    torch.set_float32_matmul_precision("highest")
    network = romav2.RoMaV2()
    network.apply_setting(SETTING)

    def match(view_i: View, view_j: View) -> Match:
        pair = crop_windows(view_i, view_j, SIZE)
        if pair is None:
            return empty_match(view_i.number, view_j.number)
        window_i, window_j = pair
        output = network.match(window_i.rgb, window_j.rgb)
        # Position of every pixel in the other window, in [-1, 1] between the outer edges.
        warp, overlap = (output[name][0].float().cpu().numpy() for name in ("warp_AB", "overlap_AB"))
        row, column = np.mgrid[STEP // 2 : SIZE : STEP, STEP // 2 : SIZE : STEP].reshape(2, -1)
        start, end = np.stack([column, row], -1) + 0.5, (warp[row, column] + 1) / 2 * SIZE
        probability = overlap[row, column, 0]
        kept = window_i.usable[row, column] & window_j.contains(end) & (probability > MIN_OVERLAP)
        confidence = torch.from_numpy(probability[kept].astype(np.float32))
        uv_i, uv_j = window_i.in_frame(start[kept]), window_j.in_frame(end[kept])
        return Match(view_i.number, view_j.number, uv_i, uv_j, confidence)

    return match
