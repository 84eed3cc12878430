"""ALIKED (Zhao et al. 2023): keypoints with sub-pixel positions and descriptors, as functions of the published weights.

Implemented from the paper. The deformable convolution consists of bilinear lookups, to avoid a dependency on
torchvision.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
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


def dense(image: Float[Tensor, "1 3 h w"], p: Parameters) -> tuple[list[Tensor], Float[Tensor, "1 1 h w"]]:
    """Features at four resolutions, of which those of a pixel are made (`pixel_features`), and every pixel's score.

    The published network enlarges the features before it computes scores. A convolution of one pixel may come first,
    since both are linear: the enlarged features of all pixels, 128 MiB, take longer than the network itself.

    Args:
        image: sRGB values in [0, 1].
        p: Published weights.
    """
    x1 = _block(image, p, "block1")
    x2 = _block(functional.avg_pool2d(x1, 2), p, "block2")
    x3 = _block(functional.avg_pool2d(x2, 4), p, "block3")
    x4 = _block(functional.avg_pool2d(x3, 4), p, "block4")
    levels = [functional.selu(functional.conv2d(x, p[f"conv{k}.weight"])) for k, x in enumerate((x1, x2, x3, x4), 1)]
    parts = p["score_head.0.weight"].split([x.shape[1] for x in levels], 1)
    score = torch.stack(
        [
            functional.interpolate(functional.conv2d(x, part), image.shape[-2:], mode="bilinear", align_corners=True)
            for x, part in zip(levels, parts, strict=True)
        ]
    ).sum(0)
    for k in (2, 4, 6):
        score = functional.conv2d(functional.selu(score), p[f"score_head.{k}.weight"], padding=1)
    return levels, score.sigmoid()


def pixel_features(levels: Sequence[Tensor], pixel: Int64[Tensor, "n m 2"]) -> Float[Tensor, "n m c"]:
    """Unit features of pixels (column, row); 0 outside the image, whose size is that of the first level."""
    size = pixel.new_tensor([levels[0].shape[-1], levels[0].shape[-2]])
    at = (2 * pixel / (size - 1) - 1)[None].to(levels[0])
    parts = [functional.grid_sample(x, at, align_corners=True)[0] for x in levels]
    inside = ((pixel >= 0) & (pixel < size)).all(-1)
    return functional.normalize(torch.cat(parts).movedim(0, -1), dim=-1) * inside[..., None]


def features_at(levels: Sequence[Tensor], at: Float[Tensor, "n m 2"]) -> Float[Tensor, "n m c"]:
    """Bilinear interpolation of the unit features of pixels at positions (x, y) [pixels, first centre at 0]."""
    pixel = at.floor().long()[:, :, None] + _square(0, 1, at.device)
    weight = (1 - (at[:, :, None] - pixel).abs()).prod(-1)
    corners = pixel_features(levels, pixel.flatten(1, 2)).unflatten(1, pixel.shape[1:3])
    return (corners * weight[..., None]).sum(2)


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
    offsets = _square(-RADIUS, RADIUS, score.device).to(score)
    patches = functional.unfold(score, 2 * RADIUS + 1, padding=RADIUS)[0].T[best]
    refinement = (patches / TEMPERATURE).softmax(-1) @ offsets
    return torch.stack([best % width, best // width], -1) + refinement


def descriptors(levels: Sequence[Tensor], at: Float[Tensor, "n 2"], p: Parameters) -> Float[Tensor, "n c"]:
    """Unit descriptors from features at learned positions around every keypoint (SDDH, section III-D).

    Args:
        levels: From `dense`.
        at: Positions (x, y) of the keypoints [pixels, first centre at 0].
        p: Published weights.
    """
    patches = pixel_features(levels, at.long()[:, None] + _square(-1, 1, at.device))
    patches = patches.transpose(1, 2).unflatten(-1, (3, 3))
    hidden = functional.conv2d(patches, p["desc_head.offset_conv.0.weight"], p["desc_head.offset_conv.0.bias"])
    last = functional.conv2d(
        functional.selu(hidden), p["desc_head.offset_conv.2.weight"], p["desc_head.offset_conv.2.bias"]
    )
    farthest = max(levels[0].shape[-2:]) / 4
    offsets = last[:, :, 0, 0].clamp(-farthest, farthest).unflatten(1, (2, -1)).transpose(1, 2)
    sampled = features_at(levels, at[:, None] + offsets).movedim(-1, 0)[None]
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
    rows, columns = torch.arange(height, device=x.device), torch.arange(width, device=x.device)
    pixel = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    tap = _square(-half, half, x.device)[:, None, None]
    shift = offsets[0].unflatten(0, (-1, 2)).permute(0, 2, 3, 1).flip(-1)
    sampled = _sample(x, (pixel + tap + shift).flatten(1, 2)[None])
    return torch.einsum("bcks,dck->bds", sampled, kernel.flatten(2)).unflatten(-1, (height, width))


def _square(first: int, last: int, device: torch.device) -> Int64[Tensor, "k 2"]:
    """Offsets (x, y) of the pixels of a square, row by row."""
    along = torch.arange(first, last + 1, device=device)
    return torch.stack(torch.meshgrid(along, along, indexing="xy"), -1).flatten(0, 1)


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
        across = functional.max_pool2d(x, (1, 2 * RADIUS + 1), 1, (0, RADIUS))
        return functional.max_pool2d(across, (2 * RADIUS + 1, 1), 1, (RADIUS, 0))

    maxima = score == maximum(score)
    for _ in range(2):
        covered = maximum(maxima.float()) > 0
        rest = score.masked_fill(covered, 0)
        maxima = maxima | ((rest == maximum(rest)) & ~covered)
    return maxima
