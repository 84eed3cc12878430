"""Selection of the frame pairs to match: each frame with a few earlier ones, and pairs for loop closure.

Pairs farther apart than `OFFSETS` are not needed: frontier points constrain all pairs of frames
(`poses/sfm/frontier_points`), and tracks connect distant frames. Bodies of revolution are the exception: their
silhouettes do not determine the rotation about the axis, so that errors add up until the texture comes into view again;
these need loop closure (`poses/sfm/symmetry/loop_closure`).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

OFFSETS = (1, 2, 4)
"""Distances in time of the pairs [frames]. FMOV, the tracker that the paper extends, also uses 8 and 16."""

Pairs = list[tuple[int, int]]
"""Indices of two frames, the earlier frame first."""


def neighbours(n: int, offsets: Sequence[int] = OFFSETS) -> Pairs:
    """Pairs of each of `n` frames with the frames that lie `offsets` before it."""
    return [(t - offset, t) for t in range(n) for offset in sorted(offsets) if t >= offset]


def best_pairs(score: Float[Tensor, "t t"], *, count: int, gap: int, min_score: float, spread: int) -> Pairs:
    """The pairs with the highest scores, by greedy non-maximum suppression, best first.

    Args:
        score: Score of every pair (i, j); read where j > i.
        count: Maximum number of pairs.
        gap: Pairs at most this far apart in time are left out [frames].
        min_score: Pairs with a lower score are left out.
        spread: A chosen pair suppresses all pairs whose frames both lie within this distance of its own [frames].
    """
    score = score.clone()
    frame = torch.arange(len(score), device=score.device)
    score[frame[None] - frame[:, None] <= gap] = -torch.inf
    chosen: Pairs = []
    while len(chosen) < count and score.numel() > 0:
        i, j = divmod(int(score.argmax()), len(score))
        if not float(score[i, j]) >= min_score:
            break
        chosen.append((i, j))
        score[max(0, i - spread) : i + spread + 1, max(0, j - spread) : j + spread + 1] = -torch.inf
    return chosen
