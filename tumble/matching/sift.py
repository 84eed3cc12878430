"""RootSIFT: few correspondences, but sure and precise ones, also over wide turns of textured objects.

Lowe 2004 with the Hellinger kernel of Arandjelovic and Zisserman 2012; the best two neighbours decide (ratio test),
and both frames have to agree (mutual check). No weights, CPU only; `device` is not used.
"""

import cv2
import numpy as np
import torch

from tumble.matching._window import MARGIN, digest, extent, window
from tumble.scene import Match, View, no_match

VERSION = 1
SIZE = 384
"""The object's window is resampled to this size: frames are small, and SIFT's smallest blobs are five pixels wide. More
finds nothing more in frames of 128 pixels, and takes longer."""
RATIO = 0.85
"""Largest distance to the best neighbour, in units of that to the second."""
DOUBT = 0.15
"""Of the correspondences with distance ratio r, 1 - exp(-(1 - r) / DOUBT) are correct: measured on three hand-held
captures (128 pixels, up to 50 degrees apart), 65 % at 0.85 and 98 % at 0.45."""
CONTRAST = 0.01
"""Least contrast of a keypoint; OpenCV's 0.04 leaves too few on plain surfaces."""
KEPT = 2048
"""Most keypoints of a frame."""

Features = tuple[torch.Tensor, np.ndarray]
"""Positions in the frame, RootSIFT descriptors."""


def load(device: torch.device | str):
    """A matcher that remembers every frame's features."""
    known: dict[str, Features] = {}

    def features(view: View) -> Features:
        name = digest(view)
        if name not in known:
            known[name] = _describe(view)
        return known[name]

    def match(view_i: View, view_j: View) -> Match:
        (uv_i, roots_i), (uv_j, roots_j) = features(view_i), features(view_j)
        if min(len(uv_i), len(uv_j)) < 2:
            return no_match(view_i.number, view_j.number)
        # Unit vectors with non-negative components: the cosine is in [0, 1].
        distance = np.sqrt((2 - 2 * roots_i @ roots_j.T).clip(0))
        best, ratio = _best_two(distance)
        back, ratio_back = _best_two(distance.T)
        i = np.arange(len(best))
        worse = np.maximum(ratio, ratio_back[best])
        i = i[(back[best] == i) & (worse < RATIO)]
        confidence = torch.from_numpy(1 - np.exp((worse[i] - 1) / DOUBT).astype(np.float32))
        return Match(view_i.number, view_j.number, uv_i[i], uv_j[best[i]], confidence)

    return match


def _describe(view: View) -> Features:
    reach = extent(view) * (1 + 2 * MARGIN)
    if reach == 0:
        return torch.zeros(0, 2), np.zeros((0, 128), np.float32)
    look = window(view, reach, SIZE)
    # Without precise upscaling OpenCV's positions are a quarter of a pixel off.
    detector = cv2.SIFT.create(KEPT, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(look.grey, look.sure.astype(np.uint8))
    if descriptors is None:
        return torch.zeros(0, 2), np.zeros((0, 128), np.float32)
    at = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
    roots = np.sqrt(descriptors / descriptors.sum(1, keepdims=True).clip(1e-6)).astype(np.float32)
    # OpenCV asks the mask at the nearest pixel of the window, which may lie over another pixel of the frame.
    kept = look.holds(at)
    return look.in_frame(at[kept]), roots[kept]


def _best_two(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of every row, and its distance in units of that of the second."""
    nearest = np.argpartition(distance, 1, axis=1)[:, :2]
    pair = np.take_along_axis(distance, nearest, 1)
    best = nearest[np.arange(len(distance)), pair.argmin(1)]
    return best, pair.min(1) / pair.max(1).clip(1e-6)
