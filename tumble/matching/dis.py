"""Dense inverse search optical flow (Kroeger et al. 2016): many correspondences between near frames.

Both directions are computed, and a pixel counts where the way there and back ends at its start. Brightness constancy
is the assumption: shading and highlights stay with the light when the object turns, so far pairs drift towards no
motion at all. No weights, CPU only; `device` is not used.
"""

import cv2
import numpy as np
import torch

from tumble.matching._window import Window, windows
from tumble.scene import Match, View, no_match

VERSION = 1
SIZE = 384
"""The object's window is enlarged to this size."""
BACK = 1.5
"""Largest distance between a pixel and the end of its way there and back [pixels of the window]."""
STEP = 6
"""Grid of starting points [pixels of the window]."""
SHARE, LOSS = 0.2, 0.2
"""Where a share s of the starting points returns, 1 - exp(-s / SHARE) of them are correct, and fewer by LOSS where the
way back just passes: measured on three hand-held captures (128 pixels, up to 50 degrees apart)."""
PRESET = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM


def load(device: torch.device | str):
    """A matcher without memory."""

    def match(view_i: View, view_j: View) -> Match:
        looks = windows(view_i, view_j, SIZE)
        if looks is None:
            return no_match(view_i.number, view_j.number)
        look_i, look_j = looks
        at_i, at_j, confidence = _matched(look_i, look_j)
        return Match(view_i.number, view_j.number, look_i.in_frame(at_i), look_j.in_frame(at_j), confidence)

    return match


def _matched(look_i: Window, look_j: Window) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
    """Positions in both windows, and how well they survive the way back."""
    flow = cv2.DISOpticalFlow.create(PRESET)
    grey_i, grey_j = look_i.grey, look_j.grey
    there, back = (np.zeros((SIZE, SIZE, 2), np.float32) for _ in range(2))
    flow.calc(grey_i, grey_j, there)
    flow.calc(grey_j, grey_i, back)
    row, column = np.mgrid[STEP // 2 : SIZE : STEP, STEP // 2 : SIZE : STEP].reshape(2, -1)
    start = np.stack([column, row], -1)[look_i.sure[row, column]].astype(np.float32)
    possible = min(len(start), int(look_j.sure[row, column].sum()))
    end = start + there[start[:, 1].astype(int), start[:, 0].astype(int)]
    returned = cv2.remap(back, end[:, None, 0], end[:, None, 1], cv2.INTER_LINEAR)[:, 0] if len(end) else end
    error = np.linalg.norm(end + returned - start, axis=1)
    kept = (error < BACK) & look_j.holds(end + 0.5)
    share = min(1.0, kept.sum() / max(1, possible))
    confidence = (1 - np.exp(-share / SHARE)) * (1 - LOSS * error[kept] / BACK)
    return start[kept] + 0.5, end[kept] + 0.5, torch.from_numpy(confidence.astype(np.float32))
