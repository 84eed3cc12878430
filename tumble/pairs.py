"""Which frames to match: every frame with some before it, and those where the object comes round again.

Neighbours alone let small errors add up: 200 frames of 0.3 degrees are 60. Only pairs that are far apart in time and
close in what they show close the loop (method_poses, pitfall 12). What they show is the side that faces the camera:
how far the object has *rolled* about the viewing direction in between does not matter to features like SIFT's, and a
hand that turns an object shows the same side again far more often than it repeats the whole pose.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.capture import BACKGROUND, OBJECT, UNKNOWN
from tumble.se3 import SO3

OFFSETS = (1, 2, 4, 8, 16)
"""Frames between neighbours (method_poses 10.1)."""
GRID = 48
"""Silhouettes are compared on a grid of this size."""
ROLLS = 24
"""Silhouettes are compared in steps of 15 degrees of roll."""

Pairs = list[tuple[int, int]]
"""The earlier frame first."""


def neighbours(n: int, offsets: Sequence[int] = OFFSETS) -> Pairs:
    """Every one of `n` frames with those that many frames before it."""
    return [(t - offset, t) for t in range(n) for offset in sorted(offsets) if t >= offset]


def loops_by_silhouette(
    masks: UInt8[Tensor, "t h w"], *, count: int, gap: int, least: float = 0.85, spread: int = 2
) -> Pairs:
    """Pairs of frames, more than `gap` apart, with the most similar silhouettes: candidates, for shapes may deceive.

    Of those over 0.9 on three short hand-held captures (64 frames of 128 pixels, almost no side seen twice) one in
    five was a true one. The matches have to decide; with rotations at hand, `loops_by_rotation` is the better judge.

    Args:
        masks: OBJECT, UNKNOWN or BACKGROUND, of one camera with one lens.
        count: Most pairs.
        gap: Largest distance in time that the neighbours see to [frames].
        least: Least overlap, intersection over union.
        spread: A pair stands for all whose frames lie within so many frames of its own.
    """
    return _best(silhouette_overlap(masks), count=count, gap=gap, least=least, spread=spread)


def loops_by_rotation(R_cam_obj: SO3, *, count: int, gap: int, widest: float, spread: int = 2) -> Pairs:
    """Pairs of frames, more than `gap` apart, that see the object from the closest directions, by estimated rotations.

    Args:
        R_cam_obj: One per frame.
        count: Most pairs.
        gap: Largest distance in time that the neighbours see to [frames].
        widest: Largest angle between the viewing directions [radians].
        spread: A pair stands for all whose frames lie within so many frames of its own.
    """
    # The camera's axis in the object's frame, unchanged by a roll about it.
    axis_obj = R_cam_obj.matrix()[:, 2]
    return _best(axis_obj @ axis_obj.T, count=count, gap=gap, least=math.cos(widest), spread=spread)


def silhouette_overlap(masks: UInt8[Tensor, "t h w"]) -> Float[Tensor, "t t"]:
    """Intersection over union of all pairs of silhouettes, each moved to its centroid, at the best of ROLLS rolls.

    Pixels unknown in either count for neither. A frame without an object overlaps with none.
    """
    centres, reach = _centroids(masks)
    angles = torch.arange(ROLLS) * (2 * math.pi / ROLLS)
    upright = torch.stack([_on_grid(mask, c, reach, 0.0) for mask, c in zip(masks, centres, strict=True)])
    inside, known = (upright == OBJECT).flatten(1).float(), (upright != UNKNOWN).flatten(1).float()
    overlap = torch.zeros(len(masks), len(masks), device=masks.device)
    for angle in angles.tolist():
        rolled = torch.stack([_on_grid(mask, c, reach, angle) for mask, c in zip(masks, centres, strict=True)])
        inside_j, known_j = (rolled == OBJECT).flatten(1).float(), (rolled != UNKNOWN).flatten(1).float()
        both = inside @ inside_j.T
        # Inside implies known: the union counts what is inside one and known in the other.
        either = inside @ known_j.T + known @ inside_j.T - both
        overlap = torch.maximum(overlap, both / either.clamp_min(1))
    return torch.maximum(overlap, overlap.T)


def _centroids(masks: UInt8[Tensor, "t h w"]) -> tuple[Float[Tensor, "t 2"], float]:
    """Middle of every object's pixels, and how far the farthest pixel of any object lies from it [pixels]."""
    centres, reach = [], 1.0
    for mask in masks:
        pixels = torch.nonzero(mask == OBJECT).flip(-1).float() + 0.5
        centres.append(pixels.mean(0) if len(pixels) else torch.zeros(2, device=mask.device))
        if len(pixels):
            reach = max(reach, float((pixels - centres[-1]).norm(dim=-1).max()))
    return torch.stack(centres), reach


def _on_grid(
    mask: UInt8[Tensor, "h w"], centre: Float[Tensor, "2"], reach: float, angle: float
) -> UInt8[Tensor, "grid grid"]:
    """A mask about its object, rolled, by the nearest pixel; BACKGROUND off the frame."""
    ticks = ((torch.arange(GRID, device=mask.device) + 0.5) / GRID * 2 - 1) * reach
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    turned = torch.stack([math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y], -1)
    column, row = (turned + centre).floor().long().unbind(-1)
    height, width = mask.shape
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return torch.where(within, mask[row.clamp(0, height - 1), column.clamp(0, width - 1)], BACKGROUND).to(mask.dtype)


def _best(score: Float[Tensor, "t t"], *, count: int, gap: int, least: float, spread: int) -> Pairs:
    """The pairs with the highest scores, none beside another that is better."""
    score = score.clone()
    frame = torch.arange(len(score), device=score.device)
    score[frame[None] - frame[:, None] <= gap] = -torch.inf
    chosen: Pairs = []
    while len(chosen) < count and score.numel() > 0:
        i, j = divmod(int(score.argmax()), len(score))
        if not float(score[i, j]) >= least:
            break
        chosen.append((i, j))
        score[max(0, i - spread) : i + spread + 1, max(0, j - spread) : j + spread + 1] = -torch.inf
    return chosen
