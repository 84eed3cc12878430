"""RoMa v2 (Edstedt et al. 2025), through an installation of the user's own: dense, robust, slow without a GPU.

The package `romav2` (MIT; its backbone under Meta's DINOv3 licence) fetches code and weights from GitHub on first use
and needs torchvision, so nothing here installs it. This adapter is written against the interface of romav2 2.0.1 and
its tests drive it with a stand-in of that interface; with the real network it has not been run by the project.
"""

import importlib

import numpy as np
import torch

from tumble.matching._window import windows
from tumble.scene import Match, View, no_match

VERSION = 1
SETTING, SIZE = "base", 640
"""RoMa's name for one direction at 640 pixels, and the size of the object's window."""
STEP = 8
"""Grid of starting points [pixels of the window]."""
BELIEF = 0.5
"""Least probability that the other frame shows the point ("overlap")."""


def load(device: torch.device | str):
    """A matcher without memory; the network runs where romav2 puts it, `device` is not used.

    Raises:
        ModuleNotFoundError: romav2 is not installed.
    """
    try:
        romav2 = importlib.import_module("romav2")
    except ModuleNotFoundError as missing:
        fix = "pip install romav2, in an environment of its own if torchvision is not to come into this one"
        raise ModuleNotFoundError(f"the matcher roma needs a package that is not here: {missing} ({fix})") from None
    # It refuses to run otherwise, for its warps would be off.
    torch.set_float32_matmul_precision("highest")
    network = romav2.RoMaV2()
    network.apply_setting(SETTING)

    def match(view_i: View, view_j: View) -> Match:
        looks = windows(view_i, view_j, SIZE)
        if looks is None:
            return no_match(view_i.number, view_j.number)
        look_i, look_j = looks
        found = network.match(look_i.rgb, look_j.rgb)
        # Where every pixel goes, in [-1, 1] between the outer edges of the picture.
        warp, overlap = (found[name][0].float().cpu().numpy() for name in ("warp_AB", "overlap_AB"))
        row, column = np.mgrid[STEP // 2 : SIZE : STEP, STEP // 2 : SIZE : STEP].reshape(2, -1)
        start, end = np.stack([column, row], -1) + 0.5, (warp[row, column] + 1) / 2 * SIZE
        likely = overlap[row, column, 0]
        kept = look_i.sure[row, column] & look_j.holds(end) & (likely > BELIEF)
        confidence = torch.from_numpy(likely[kept].astype(np.float32))
        uv_i, uv_j = look_i.in_frame(start[kept]), look_j.in_frame(end[kept])
        return Match(view_i.number, view_j.number, uv_i, uv_j, confidence)

    return match
