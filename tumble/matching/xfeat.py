"""XFeat (Potje et al. 2024): learned keypoints and descriptors, small enough for a CPU.

Weights: `tumble weights get xfeat`. Written from the paper's architecture; sparse matching with mutual nearest
neighbours, without the paper's refinement.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tumble.io import weights
from tumble.matching._window import MARGIN, digest, extent, window
from tumble.scene import Match, View, no_match

VERSION = 1
SIZE = 512
"""The object's window is resampled to this size; a multiple of 32, the network's coarsest stride."""
DETECTED = 0.05
"""Least share of an 8 x 8 cell's belief in a keypoint that one pixel has (section 3.2 of the paper)."""
KEPT = 2048
"""Most keypoints of a frame."""
ALIKE = 0.82
"""Least cosine between descriptors (the paper's for sparse matching)."""
CELL = 8
"""Pixels per descriptor, along each side."""
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
"""Of the convolutions with normalisation, by the names of the published weights."""

Features = tuple[Tensor, Tensor]
"""Positions in the frame, unit descriptors."""


def load(device: torch.device | str):
    """A matcher that remembers every frame's features.

    Raises:
        BadFile: The weights have not been fetched.
    """
    parameters = weights.read("xfeat", "xfeat", device)
    known: dict[str, Features] = {}

    def features(view: View) -> Features:
        name = digest(view)
        if name not in known:
            known[name] = _describe(view, parameters)
        return known[name]

    def match(view_i: View, view_j: View) -> Match:
        (uv_i, unit_i), (uv_j, unit_j) = features(view_i), features(view_j)
        if min(len(uv_i), len(uv_j)) == 0:
            return no_match(view_i.number, view_j.number)
        cosine = unit_i @ unit_j.T
        best, back = cosine.argmax(1), cosine.argmax(0)
        i = torch.arange(len(best), device=best.device)
        i = i[(back[best] == i) & (cosine[i, best] > ALIKE)]
        j, confidence = best[i].cpu(), cosine[i, best[i]].cpu().clamp(0, 1)
        return Match(view_i.number, view_j.number, uv_i[i.cpu()], uv_j[j], confidence)

    return match


@torch.no_grad()
def _describe(view: View, parameters: dict[str, Tensor]) -> Features:
    reach = extent(view) * (1 + 2 * MARGIN)
    device = next(iter(parameters.values())).device
    if reach == 0:
        return torch.zeros(0, 2), torch.zeros(0, 64, device=device)
    look = window(view, reach, SIZE)
    descriptors, corners, reliable = network(torch.from_numpy(look.rgb).permute(2, 0, 1)[None].to(device), parameters)
    score = corners * (corners == functional.max_pool2d(corners, 5, 1, 2)) * (corners > DETECTED)
    score = score * functional.interpolate(reliable, scale_factor=CELL, mode="bilinear")
    score = score[0, 0] * torch.from_numpy(look.sure).to(device)
    best = score.flatten().topk(min(KEPT, int((score > 0).sum()))).indices
    at = torch.stack([best % SIZE, best // SIZE], -1) + 0.5
    grid = (2 * at / SIZE - 1)[None, None]
    sampled = functional.grid_sample(descriptors, grid, mode="bicubic", align_corners=False)[0, :, 0].T
    return look.in_frame(at.cpu().numpy().astype(np.float64)), functional.normalize(sampled, dim=-1)


def network(
    image: Tensor, parameters: dict[str, Tensor]
) -> tuple[Float[Tensor, "1 64 cells_y cells_x"], Float[Tensor, "1 1 h w"], Float[Tensor, "1 1 cells_y cells_x"]]:
    """Unit descriptors per cell, how much of a keypoint every pixel is, and how reliable every cell is.

    Args:
        image: Code values `[1 3 h w]`, multiples of 32.
        parameters: The published weights.
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
    reliable = convolve(block(descriptors, "heatmap_head"), "heatmap_head.2").sigmoid()
    # 64 pixels of a cell as channels, and one more for "none of them".
    logits = convolve(block(functional.pixel_unshuffle(grey, CELL), "keypoint_head"), "keypoint_head.3")
    corners = functional.pixel_shuffle(logits.softmax(1)[:, :-1], CELL)
    return functional.normalize(descriptors, dim=1), corners, reliable
