"""Signed distance and features on voxel grids, in place of a network of eight layers on a CPU.

The field is the sum of a sphere and of several grids of growing resolution, each interpolated trilinearly: coarse ones
move large parts of the surface at once, fine ones add detail. Points are in the object frame [object radius]; the
distance is negative inside.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

FEATURE_STD = 0.1
"""Standard deviation of the initial features."""


@dataclass(frozen=True)
class Grids:
    """Values at the nodes of the grids, which cover the cube around the sphere of radius `bound`."""

    offsets: dict[str, Tensor]
    """Parts of the signed distance beside that of the sphere, `[1 1 n n n]` each (z, y, x) [object radius]."""
    features: dict[str, Tensor]
    """Parts of the features, `[1 f n n n]` each."""
    radius: float
    """Radius of the sphere to which the offsets are added [object radius]."""
    bound: float
    """Half the side of the cube [object radius]."""


def sphere(nodes: tuple[int, ...], features: int, *, radius: float, bound: float, rng: torch.Generator) -> Grids:
    """Grids whose shape is a sphere, with small random features.

    Args:
        nodes: Nodes per side of each grid.
        features: Number of features.
        radius: Radius of the sphere [object radius].
        bound: Half the side of the cube [object radius].
        rng: Random number generator of the features.
    """
    offsets = {str(n): torch.zeros(1, 1, n, n, n) for n in nodes}
    drawn = {str(n): FEATURE_STD * torch.randn(1, features, n, n, n, generator=rng) for n in nodes}
    return Grids(offsets, drawn, radius, bound)


def distance(grids: Grids, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Signed distance; differentiable in grids and points."""
    return x.norm(dim=-1) - grids.radius + _sampled(grids.offsets, x / grids.bound)[:, 0]


def distance_and_gradient(
    grids: Grids, x: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n f"]]:
    """Signed distance, its gradient by differences over a cell of the finest grid, and features; differentiable."""
    h = grids.bound / (max(map(int, grids.offsets)) - 1)
    shifts = h * torch.eye(3, dtype=x.dtype, device=x.device)
    shifted = (x + torch.cat([torch.zeros_like(shifts[:1]), shifts, -shifts])[:, None]).flatten(0, 1)
    around = distance(grids, shifted).reshape(7, -1)
    gradient = (around[1:4] - around[4:]).T / (2 * h)
    return around[0], gradient, _sampled(grids.features, x / grids.bound)


def _sampled(levels: dict[str, Tensor], at: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """Sum of all levels at positions in [-1, 1]^3."""
    parts = [grid_sample(v, at[None, None, None], padding_mode="border", align_corners=True) for v in levels.values()]
    return torch.stack(parts).sum(0)[0, :, 0, 0].T
