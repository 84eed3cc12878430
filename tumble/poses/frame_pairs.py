"""Which frames to match: every frame with some before it, and those where the object comes round again.

Farther pairs are left out: outlines bind all pairs of frames to each other (`frontier`), and tracks carry on. Measured
on hand-held captures of 64 frames of 128 pixels (knight, soup can, duck): pairs 8 and 16 apart change the median error
by nothing, pairs of frames that see the same side again by less than 0.05 degrees. A body of revolution is another
matter: its outlines do not show how it turns about its axis, so that small errors add up until its texture comes round
again (`comeback`).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

OFFSETS = (1, 2, 4)
"""Frames between neighbours; FMOV has 8 and 16 as well."""

Pairs = list[tuple[int, int]]
"""The earlier frame first."""


def neighbours(n: int, offsets: Sequence[int] = OFFSETS) -> Pairs:
    """Every one of `n` frames with those that many frames before it."""
    return [(t - offset, t) for t in range(n) for offset in sorted(offsets) if t >= offset]


def best(score: Float[Tensor, "t t"], *, count: int, gap: int, least: float, spread: int) -> Pairs:
    """The pairs with the highest scores, none beside another that is better.

    Args:
        count: Most pairs.
        gap: Largest distance in time that the neighbours see to [frames].
        least: Of a score.
        spread: A pair stands for all whose frames lie within so many frames of its own.
    """
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
