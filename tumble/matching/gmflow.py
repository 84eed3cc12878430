"""GMFlow (Xu et al. 2022): learned dense flow, which also follows surfaces that show next to no texture.

Both directions come from one pass, and a pixel counts where the way there and back ends at its start. Slow without a
GPU: about four seconds a pair on one core.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.io import weights
from tumble.matching import _gmflow
from tumble.matching._window import Window, windows
from tumble.scene import Match, View, no_match

VERSION = 1
SIZE = 256
"""The object's window is resampled to this size, a multiple of `_gmflow.MULTIPLE`."""
BACK = 1.5
"""Largest distance between a pixel and the end of its way there and back [pixels of the window]."""
STEP = 4
"""Grid of starting points [pixels of the window]."""
LOSS = 0.5
"""How much less a correspondence is believed whose way back just passes; not measured."""


def load(device: torch.device | str):
    """A matcher without memory.

    Raises:
        BadFile: The weights have not been fetched: `tumble weights get gmflow`.
    """
    p = weights.read("gmflow", "gmflow", device)

    @torch.no_grad()
    def match(view_i: View, view_j: View) -> Match:
        looks = windows(view_i, view_j, SIZE)
        if looks is None:
            return no_match(view_i.number, view_j.number)
        look_i, look_j = looks
        there, back = _gmflow.flow(_picture(look_i, device), _picture(look_j, device), p).cpu()
        row, column = np.mgrid[STEP // 2 : SIZE : STEP, STEP // 2 : SIZE : STEP].reshape(2, -1)
        row, column = row[look_i.sure[row, column]], column[look_i.sure[row, column]]
        start = torch.from_numpy(np.stack([column, row], -1)).float()
        end = start + there[:, row, column].T
        error = (end + _at(back, end) - start).norm(dim=-1)
        kept = (error < BACK) & torch.from_numpy(look_j.holds((end + 0.5).numpy()))
        start, end, error = start[kept] + 0.5, end[kept] + 0.5, error[kept]
        uv_i, uv_j = look_i.in_frame(start.numpy()), look_j.in_frame(end.numpy())
        return Match(view_i.number, view_j.number, uv_i, uv_j, 1 - LOSS * error / BACK)

    return match


def _picture(look: Window, device: torch.device | str) -> Float[Tensor, "3 h w"]:
    return torch.from_numpy(look.rgb).to(device).permute(2, 0, 1).float() / 255


def _at(flow: Float[Tensor, "2 h w"], places: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
    """Flow between pixels, bilinear; places are counted from the first pixel's centre."""
    at = 2 * places / (SIZE - 1) - 1
    return torch.nn.functional.grid_sample(flow[None], at[None, None], align_corners=True)[0, :, 0].T
