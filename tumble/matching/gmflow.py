"""GMFlow (Xu et al. 2022): learned dense optical flow, also for surfaces with hardly any texture.

Flow is computed in both directions in one pass, and pixels are kept that pass a forward-backward consistency check.
Slow without a GPU: about four seconds per pair on one core.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.io import weights
from tumble.matching import _gmflow
from tumble.matching._window import Window, crop_windows
from tumble.scene import Match, View, empty_match

VERSION = 1
SIZE = 256
"""Height and width of the window around the object that is matched, a multiple of `_gmflow.MULTIPLE` [pixels]."""
MAX_CYCLE_ERROR = 1.5
"""Largest forward-backward error of a correspondence [pixels of the window]."""
STEP = 4
"""Spacing of the grid of starting points [pixels of the window]."""
CYCLE_ERROR_PENALTY = 0.5
"""Reduction of the confidence at the largest forward-backward error; not fitted to measurements."""


def load(device: torch.device | str):
    """Matcher on a device; it has no state.

    Raises:
        BadFile: The weights have not been downloaded: `tumble weights get gmflow`.
    """
    p = weights.load("gmflow", "gmflow", device)

    @torch.no_grad()
    def match(view_i: View, view_j: View) -> Match:
        pair = crop_windows(view_i, view_j, SIZE)
        if pair is None:
            return empty_match(view_i.number, view_j.number)
        window_i, window_j = pair
        forward, backward = _gmflow.flow(_to_tensor(window_i, device), _to_tensor(window_j, device), p).cpu()
        row, column = np.mgrid[STEP // 2 : SIZE : STEP, STEP // 2 : SIZE : STEP].reshape(2, -1)
        row, column = row[window_i.usable[row, column]], column[window_i.usable[row, column]]
        start = torch.from_numpy(np.stack([column, row], -1)).float()
        end = start + forward[:, row, column].T
        error = (end + _sample(backward, end) - start).norm(dim=-1)
        kept = (error < MAX_CYCLE_ERROR) & torch.from_numpy(window_j.contains((end + 0.5).numpy()))
        start, end, error = start[kept] + 0.5, end[kept] + 0.5, error[kept]
        uv_i, uv_j = window_i.in_frame(start.numpy()), window_j.in_frame(end.numpy())
        return Match(view_i.number, view_j.number, uv_i, uv_j, 1 - CYCLE_ERROR_PENALTY * error / MAX_CYCLE_ERROR)

    return match


def _to_tensor(window: Window, device: torch.device | str) -> Float[Tensor, "3 h w"]:
    """Image of a window, in [0, 1]."""
    return torch.from_numpy(window.rgb).to(device).permute(2, 0, 1).float() / 255


def _sample(flow: Float[Tensor, "2 h w"], positions: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
    """Bilinear interpolation of flow at positions (x, y) [pixels, first centre at 0]."""
    at = 2 * positions / (SIZE - 1) - 1
    return torch.nn.functional.grid_sample(flow[None], at[None, None], align_corners=True)[0, :, 0].T
