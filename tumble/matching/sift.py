"""RootSIFT: few but reliable and precise correspondences, also over wide rotations of textured objects.

Lowe 2004, with the Hellinger kernel of Arandjelovic and Zisserman 2012, ratio test, and mutual nearest neighbours. No
weights; runs on the CPU, `device` is not used.
"""

import cv2
import numpy as np
import torch

from tumble.matching._window import MARGIN, crop_window, digest, extent
from tumble.scene import Match, View, empty_match

VERSION = 1
CONCURRENT = True
SIZE = 384
"""Height and width of the window around the object that is matched [pixels].

It enlarges small frames, because SIFT's smallest blobs are five pixels wide."""
MAX_RATIO = 0.85
"""Largest ratio of the distances to the nearest and the second nearest descriptor (ratio test)."""
RATIO_SCALE = 0.15
"""Scale of the confidence `1 - exp(-(1 - r) / RATIO_SCALE)` of a correspondence with distance ratio r.

Fitted to the measured fraction of correct correspondences."""
MIN_CONTRAST = 0.01
"""Smallest contrast of a keypoint; OpenCV's 0.04 leaves too few on weakly textured surfaces."""
MAX_KEYPOINTS = 2048
"""Largest number of keypoints per frame."""

Features = tuple[torch.Tensor, np.ndarray]
"""Keypoints of a frame: positions [pixels], RootSIFT descriptors."""


def load(device: torch.device | str):
    """Matcher, which caches every frame's keypoints."""
    cached: dict[str, Features] = {}

    def features(view: View) -> Features:
        name = digest(view)
        if name not in cached:
            cached[name] = _extract(view)
        return cached[name]

    def match(view_i: View, view_j: View) -> Match:
        (uv_i, roots_i), (uv_j, roots_j) = features(view_i), features(view_j)
        if min(len(uv_i), len(uv_j)) < 2:
            return empty_match(view_i.number, view_j.number)
        # Unit vectors with non-negative components: the cosine is in [0, 1].
        squared = (2 - 2 * roots_i @ roots_j.T).clip(0)
        back, ratio_back = _best_two(np.ascontiguousarray(squared.T))
        best, ratio = _best_two(squared)
        i = np.arange(len(best))
        max_ratio = np.maximum(ratio, ratio_back[best])
        i = i[(back[best] == i) & (max_ratio < MAX_RATIO)]
        confidence = torch.from_numpy(1 - np.exp((max_ratio[i] - 1) / RATIO_SCALE).astype(np.float32))
        return Match(view_i.number, view_j.number, uv_i[i], uv_j[best[i]], confidence)

    return match


def _extract(view: View) -> Features:
    """Keypoints of a view, with descriptors."""
    width = extent(view) * (1 + 2 * MARGIN)
    if width == 0:
        return torch.zeros(0, 2), np.zeros((0, 128), np.float32)
    window = crop_window(view, width, SIZE)
    # Without precise upscaling, OpenCV's positions are off by a quarter of a pixel.
    detector = cv2.SIFT.create(MAX_KEYPOINTS, contrastThreshold=MIN_CONTRAST, enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(window.grey, window.usable.astype(np.uint8))
    if descriptors is None:
        return torch.zeros(0, 2), np.zeros((0, 128), np.float32)
    at = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
    roots = np.sqrt(descriptors / descriptors.sum(1, keepdims=True).clip(1e-6)).astype(np.float32)
    # OpenCV tests the mask at the nearest pixel of the window, which may lie on another pixel of the frame.
    kept = window.contains(at)
    return window.in_frame(at[kept]), roots[kept]


def _best_two(squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the smallest distance in every row, and its ratio to the second smallest; overwrites the argument."""
    rows, best = np.arange(len(squared)), squared.argmin(1)
    smallest = squared[rows, best]
    squared[rows, best] = np.inf
    return best, np.sqrt(smallest) / np.sqrt(squared.min(1)).clip(1e-6)
