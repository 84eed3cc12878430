"""XFeat (Potje et al. 2024): learned keypoints and descriptors, fast enough for a CPU.

Weights: `tumble weights get xfeat`. Implemented from the paper; sparse matching with mutual nearest neighbours, without
the paper's refinement.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tumble.io import weights
from tumble.matching._window import MARGIN, crop_window, digest, extent
from tumble.scene import Match, View, empty_match

VERSION = 1
SIZE = 512
"""Height and width of the window around the object that is matched, a multiple of the largest stride 32 [pixels]."""
MIN_SCORE = 0.05
"""Smallest probability of a keypoint at a pixel, given its 8 x 8 cell (section 3.2 of the paper)."""
MAX_KEYPOINTS = 2048
"""Largest number of keypoints per frame."""
MIN_COSINE = 0.82
"""Smallest cosine between matched descriptors (the paper's for sparse matching)."""
CELL = 8
"""Side of the cell of one descriptor [pixels]."""
STRIDES = {
    "block1": (1, 2, 1, 2),
    "block2": (1, 1),
    "block3": (2, 1, 1),
    "block4": (2, 1, 1),
    "block5": (2, 1, 1, 1),
    "block_fusion": (1, 1),
    "heatmap_head": (1, 1),
    "keypoint_head": (1, 1, 1),
}
"""Strides of the convolutions with normalisation, by the names of the published weights."""

Features = tuple[Tensor, Tensor]
"""Keypoints of a frame: positions [pixels], unit descriptors."""


def load(device: torch.device | str):
    """Matcher on a device, which caches every frame's keypoints.

    Raises:
        BadFile: The weights have not been downloaded.
    """
    parameters = weights.load("xfeat", "xfeat", device)
    cached: dict[str, Features] = {}

    def features(view: View) -> Features:
        name = digest(view)
        if name not in cached:
            cached[name] = _extract(view, parameters)
        return cached[name]

    def match(view_i: View, view_j: View) -> Match:
        (uv_i, unit_i), (uv_j, unit_j) = features(view_i), features(view_j)
        if min(len(uv_i), len(uv_j)) == 0:
            return empty_match(view_i.number, view_j.number)
        cosine = unit_i @ unit_j.T
        best, back = cosine.argmax(1), cosine.argmax(0)
        i = torch.arange(len(best), device=best.device)
        i = i[(back[best] == i) & (cosine[i, best] > MIN_COSINE)]
        j, confidence = best[i].cpu(), cosine[i, best[i]].cpu().clamp(0, 1)
        return Match(view_i.number, view_j.number, uv_i[i.cpu()], uv_j[j], confidence)

    return match


@torch.no_grad()
def _extract(view: View, parameters: dict[str, Tensor]) -> Features:
    """Keypoints of a view, with descriptors."""
    width = extent(view) * (1 + 2 * MARGIN)
    device = next(iter(parameters.values())).device
    if width == 0:
        return torch.zeros(0, 2), torch.zeros(0, 64, device=device)
    window = crop_window(view, width, SIZE)
    descriptors, scores, reliability = network(
        torch.from_numpy(window.rgb).permute(2, 0, 1)[None].to(device), parameters
    )
    score = scores * (scores == functional.max_pool2d(scores, 5, 1, 2)) * (scores > MIN_SCORE)
    score = score * functional.interpolate(reliability, scale_factor=CELL, mode="bilinear")
    score = score[0, 0] * torch.from_numpy(window.usable).to(device)
    best = score.flatten().topk(min(MAX_KEYPOINTS, int((score > 0).sum()))).indices
    at = torch.stack([best % SIZE, best // SIZE], -1) + 0.5
    grid = (2 * at / SIZE - 1)[None, None]
    sampled = functional.grid_sample(descriptors, grid, mode="bicubic", align_corners=False)[0, :, 0].T
    return window.in_frame(at.cpu().numpy().astype(np.float64)), functional.normalize(sampled, dim=-1)


def network(
    image: Tensor, parameters: dict[str, Tensor]
) -> tuple[Float[Tensor, "1 64 cells_y cells_x"], Float[Tensor, "1 1 h w"], Float[Tensor, "1 1 cells_y cells_x"]]:
    """Unit descriptors per cell, keypoint probability per pixel, and reliability per cell.

    Args:
        image: Code values `[1 3 h w]`, height and width multiples of 32.
        parameters: Published weights by name.
    """

    def convolve(x: Tensor, name: str) -> Tensor:
        return functional.conv2d(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"])

    def block(x: Tensor, name: str) -> Tensor:
        for k, stride in enumerate(STRIDES[name]):
            kernel = parameters[f"{name}.{k}.layer.0.weight"]
            mean, variance = (parameters[f"{name}.{k}.layer.1.running_{of}"] for of in ("mean", "var"))
            x = functional.conv2d(x, kernel, stride=stride, padding=kernel.shape[-1] // 2)
            x = functional.relu(functional.batch_norm(x, mean, variance))
        return x

    grey = functional.instance_norm(image.float().mean(1, keepdim=True))
    x = block(grey, "block1") + convolve(functional.avg_pool2d(grey, 4), "skip1.1")
    third = block(block(x, "block2"), "block3")
    fourth = block(third, "block4")
    size = third.shape[-2:]
    coarse = [functional.interpolate(y, size, mode="bilinear") for y in (fourth, block(fourth, "block5"))]
    descriptors = convolve(block(third + coarse[0] + coarse[1], "block_fusion"), "block_fusion.2")
    reliability = convolve(block(descriptors, "heatmap_head"), "heatmap_head.2").sigmoid()
    # Channels are the 64 pixels of a cell, and one for "no keypoint".
    logits = convolve(block(functional.pixel_unshuffle(grey, CELL), "keypoint_head"), "keypoint_head.3")
    scores = functional.pixel_shuffle(logits.softmax(1)[:, :-1], CELL)
    return functional.normalize(descriptors, dim=1), scores, reliability
