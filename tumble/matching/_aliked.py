"""ALIKED (Zhao et al. 2023): keypoints with sub-pixel positions and descriptors, as functions of the published weights.

Implemented from the paper. The deformable convolution consists of bilinear lookups, to avoid a dependency on
torchvision.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

RADIUS = 2
"""Radius of the windows for non-maximum suppression and sub-pixel refinement [pixels]."""
TEMPERATURE = 0.1
"""Temperature of the softmax over scores that gives sub-pixel positions (section III-C)."""
MAX_STRIDE = 32
"""Stride of the last block, of which image sizes are multiples [pixels]."""

Parameters = dict[str, Tensor]
"""Published weights by name."""


def dense(image: Float[Tensor, "1 3 h w"], p: Parameters) -> tuple[Float[Tensor, "1 c h w"], Float[Tensor, "1 1 h w"]]:
    """Unit features and keypoint scores of every pixel, from sRGB values in [0, 1]."""
    x1 = _block(image, p, "block1")
    x2 = _block(functional.avg_pool2d(x1, 2), p, "block2")
    x3 = _block(functional.avg_pool2d(x2, 4), p, "block3")
    x4 = _block(functional.avg_pool2d(x3, 4), p, "block4")
    levels = []
    for k, x in enumerate((x1, x2, x3, x4), start=1):
        x = functional.selu(functional.conv2d(x, p[f"conv{k}.weight"]))
        levels.append(functional.interpolate(x, image.shape[-2:], mode="bilinear", align_corners=True))
    joined = torch.cat(levels, 1)
    score = functional.conv2d(joined, p["score_head.0.weight"])
    for k in (2, 4, 6):
        score = functional.conv2d(functional.selu(score), p[f"score_head.{k}.weight"], padding=1)
    return functional.normalize(joined, dim=1), score.sigmoid()


def keypoints(
    score: Float[Tensor, "1 1 h w"], usable: Tensor, *, max_count: int, min_score: float
) -> Float[Tensor, "n 2"]:
    """Positions (x, y) of the highest local maxima of the score [pixels, first centre at 0].

    Args:
        score: Keypoint score per pixel.
        usable: Pixels that may be keypoints, `bool[h w]`.
        max_count: Largest number of keypoints.
        min_score: Smallest score of a keypoint.
    """
    width = score.shape[-1]
    peaks = score[0, 0] * (_local_maxima(score)[0, 0] & usable)
    best = peaks.flatten().topk(min(max_count, int((peaks > min_score).sum()))).indices
    taps = torch.arange(-RADIUS, RADIUS + 1, device=score.device)
    offsets = torch.stack(torch.meshgrid(taps, taps, indexing="xy"), -1).reshape(-1, 2).to(score)
    patches = functional.unfold(score, 2 * RADIUS + 1, padding=RADIUS)[0].T[best]
    refinement = (patches / TEMPERATURE).softmax(-1) @ offsets
    return torch.stack([best % width, best // width], -1) + refinement


def descriptors(features: Float[Tensor, "1 c h w"], at: Float[Tensor, "n 2"], p: Parameters) -> Float[Tensor, "n c"]:
    """Unit descriptors from features at learned positions around every keypoint (SDDH, section III-D)."""
    height, width = features.shape[-2:]
    column, row = at.long().unbind(-1)
    taps = torch.arange(3, device=at.device)
    padded = functional.pad(features[0], (1, 1, 1, 1))
    patches = padded[:, (row[:, None] + taps)[:, :, None], (column[:, None] + taps)[:, None, :]].transpose(0, 1)
    hidden = functional.conv2d(patches, p["desc_head.offset_conv.0.weight"], p["desc_head.offset_conv.0.bias"])
    last = functional.conv2d(
        functional.selu(hidden), p["desc_head.offset_conv.2.weight"], p["desc_head.offset_conv.2.bias"]
    )
    farthest = max(height, width) / 4
    offsets = last[:, :, 0, 0].clamp(-farthest, farthest).unflatten(1, (2, -1)).transpose(1, 2)
    sampled = _sample(features, (at[:, None] + offsets)[None])
    mixed = functional.selu(functional.conv2d(sampled, p["desc_head.sf_conv.weight"]))[0]
    return functional.normalize(torch.einsum("cnp,pcd->nd", mixed, p["desc_head.agg_weights"]), dim=-1)


def deformable(
    x: Float[Tensor, "1 c h w"], offsets: Float[Tensor, "1 taps2 h w"], kernel: Float[Tensor, "d c k k"]
) -> Float[Tensor, "1 d h w"]:
    """Deformable convolution, with zeros outside the image (Dai et al. 2017).

    Args:
        x: Features.
        offsets: Vertical and horizontal offset per tap of the kernel, row by row, and per pixel [pixels].
        kernel: Kernel of odd width.
    """
    height, width = x.shape[-2:]
    half = kernel.shape[-1] // 2
    taps = torch.arange(-half, half + 1, device=x.device)
    rows, columns = torch.arange(height, device=x.device), torch.arange(width, device=x.device)
    pixel = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    tap = torch.stack(torch.meshgrid(taps, taps, indexing="xy"), -1).reshape(-1, 1, 1, 2)
    shift = offsets[0].unflatten(0, (-1, 2)).permute(0, 2, 3, 1).flip(-1)
    sampled = _sample(x, (pixel + tap + shift).flatten(1, 2)[None])
    return torch.einsum("bcks,dck->bds", sampled, kernel.flatten(2)).unflatten(-1, (height, width))


def _sample(x: Float[Tensor, "1 c h w"], at: Float[Tensor, "1 n m 2"]) -> Float[Tensor, "1 c n m"]:
    """Bilinear interpolation at positions (x, y) [pixels, first centre at 0]."""
    size = at.new_tensor([x.shape[-1], x.shape[-2]])
    return functional.grid_sample(x, (2 * at + 1) / size - 1, align_corners=False)


def _block(x: Tensor, p: Parameters, name: str) -> Tensor:
    """Residual block of two convolutions, which are deformable if the weights have offsets."""
    y = x
    for k in (1, 2):
        conv, norm = f"{name}.conv{k}", f"{name}.bn{k}"
        if f"{conv}.offset_conv.weight" in p:
            farthest = max(y.shape[-2:]) / 4
            offsets = functional.conv2d(y, p[f"{conv}.offset_conv.weight"], p[f"{conv}.offset_conv.bias"], padding=1)
            y = deformable(y, offsets.clamp(-farthest, farthest), p[f"{conv}.regular_conv.weight"])
        else:
            y = functional.conv2d(y, p[f"{conv}.weight"], padding=1)
        mean, variance, weight, bias = (p[f"{norm}.{of}"] for of in ("running_mean", "running_var", "weight", "bias"))
        y = functional.batch_norm(y, mean, variance, weight, bias)
        if k == 1:
            y = functional.selu(y)
    if f"{name}.downsample.weight" in p:
        y = y + functional.conv2d(x, p[f"{name}.downsample.weight"], p[f"{name}.downsample.bias"])
    return functional.selu(y)


def _local_maxima(score: Tensor) -> Tensor:
    """Local maxima, and twice the local maxima of what remains without the neighbourhoods of earlier ones."""

    def maximum(x: Tensor) -> Tensor:
        return functional.max_pool2d(x, 2 * RADIUS + 1, 1, RADIUS)

    maxima = score == maximum(score)
    for _ in range(2):
        covered = maximum(maxima.float()) > 0
        rest = score.masked_fill(covered, 0)
        maxima = maxima | ((rest == maximum(rest)) & ~covered)
    return maxima
