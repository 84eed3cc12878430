"""Sets of points: the nearest of another set, and the smallest ball around one."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int64
from torch import Tensor

ROWS = 1024
"""Rows of a distance matrix at once: bounds memory, changes nothing else."""


def nearest(x: Float[Tensor, "a 3"], y: Float[Tensor, "b 3"]) -> Int64[Tensor, " a"]:
    """Index of the y nearest to each x."""
    found = [torch.cdist(rows, y).argmin(1) for rows in x.split(ROWS)]
    return torch.cat([*found, torch.zeros(0, dtype=torch.long, device=x.device)])


def smallest_ball(
    offsets: Callable[[Float[Tensor, "3"]], Float[Tensor, "n 3"]], centre: Float[Tensor, "3"], *, steps: int
) -> Float[Tensor, "3"]:
    """Centre of the smallest ball that reaches all of some sets (Badoiu and Clarkson 2003).

    Args:
        offsets: From a centre to the nearest point of every set: a point itself, the foot on a line.
        centre: To start from.
        steps: The last one moves the centre by a share 1 / (steps + 1) of the radius.
    """
    for step in range(1, steps + 1):
        off = offsets(centre)
        centre = centre + off[off.norm(dim=-1).argmax()] / (step + 1)
    return centre
