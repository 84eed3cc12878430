"""Which frames to match: every frame with some before it, and those where the object comes round again.

Farther pairs are left out: outlines bind all pairs of frames to each other (`frontier`), and tracks carry on. Measured
on hand-held captures of 64 frames of 128 pixels (knight, soup can, duck): pairs 8 and 16 apart change the median error
by nothing, pairs of frames that see the same side again by less than 0.05 degrees. A body of revolution is another
matter: its outlines do not show how it turns about its axis, so that small errors add up until its texture comes round
again. For the soup can in two tumbles under two lights, loops took medians of 1.1, 2.8 and 2.5 degrees to 1.1, 2.5 and
2.5.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.se3 import SO3

OFFSETS = (1, 2, 4)
"""Frames between neighbours; method_poses 10.1 has 8 and 16 as well."""

Pairs = list[tuple[int, int]]
"""The earlier frame first."""


def neighbours(n: int, offsets: Sequence[int] = OFFSETS) -> Pairs:
    """Every one of `n` frames with those that many frames before it."""
    return [(t - offset, t) for t in range(n) for offset in sorted(offsets) if t >= offset]


def loops_by_rotation(R_cam_obj: SO3, *, count: int, gap: int, widest: float, spread: int = 2) -> Pairs:
    """Pairs of frames, more than `gap` apart, that see the object from the closest directions, by estimated rotations.

    How far the object has rolled about the viewing direction in between does not matter to features like SIFT's.

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
