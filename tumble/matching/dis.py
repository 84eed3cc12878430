"""Dense inverse search (DIS) optical flow (Kroeger et al. 2016): many correspondences between frames close in time.

Flow is computed in both directions, and pixels are kept that pass a forward-backward consistency check. DIS assumes
constant brightness. Shading and highlights do not move with the object, so flow between distant frames is biased
towards no motion. No weights; runs on the CPU, `device` is not used.
"""

import cv2
import numpy as np
import torch

from tumble.matching._window import Window, crop_windows
from tumble.scene import Match, View, empty_match

VERSION = 2
CONCURRENT = True
SIZE = 384
"""Height and width of the window around the object that is matched [pixels]."""
MAX_CYCLE_ERROR = 1.5
"""Largest forward-backward error of a correspondence [pixels of the window]."""
STEP = 6
"""Spacing of the grid of starting points [pixels of the window]."""
RETURN_SCALE = 0.2
"""Scale of the confidence `1 - exp(-s / RETURN_SCALE)`, where s is the fraction of starting points that pass the check.

Fitted to the measured fraction of correct correspondences."""
CYCLE_ERROR_PENALTY = 0.2
"""Fraction by which the confidence is lower at the largest forward-backward error, fitted to the same measurements."""
PRESET = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
"""OpenCV's trade-off between speed and quality."""


def load(device: torch.device | str):
    """Matcher; it has no state."""

    def match(view_i: View, view_j: View) -> Match:
        pair = crop_windows(view_i, view_j, SIZE)
        if pair is None:
            return empty_match(view_i.number, view_j.number)
        window_i, window_j = pair
        at_i, at_j, confidence = _match_crops(window_i, window_j)
        return Match(view_i.number, view_j.number, window_i.in_frame(at_i), window_j.in_frame(at_j), confidence)

    return match


def _match_crops(window_i: Window, window_j: Window) -> tuple[np.ndarray, np.ndarray, torch.Tensor]:
    """Corresponding positions in both windows, and their confidence."""
    flow = cv2.DISOpticalFlow.create(PRESET)
    grey_i, grey_j = window_i.grey, window_j.grey
    forward, backward = (np.zeros((SIZE, SIZE, 2), np.float32) for _ in range(2))
    flow.calc(grey_i, grey_j, forward)
    flow.calc(grey_j, grey_i, backward)
    row, column = np.mgrid[STEP // 2 : SIZE : STEP, STEP // 2 : SIZE : STEP].reshape(2, -1)
    start = np.stack([column, row], -1)[window_i.usable[row, column]].astype(np.float32)
    possible = min(len(start), int(window_j.usable[row, column].sum()))
    end = start + forward[start[:, 1].astype(int), start[:, 0].astype(int)]
    returned = cv2.remap(backward, end[:, None, 0], end[:, None, 1], cv2.INTER_LINEAR)[:, 0] if len(end) else end
    error = np.linalg.norm(end + returned - start, axis=1)
    kept = (error < MAX_CYCLE_ERROR) & window_j.contains(end + 0.5)
    fraction = min(1.0, kept.sum() / max(1, possible))
    confidence = (1 - np.exp(-fraction / RETURN_SCALE)) * (1 - CYCLE_ERROR_PENALTY * error[kept] / MAX_CYCLE_ERROR)
    return start[kept] + 0.5, end[kept] + 0.5, torch.from_numpy(confidence.astype(np.float32))
