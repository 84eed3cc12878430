"""Point sets: nearest neighbours, order in memory and smallest enclosing spheres."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

CURVE_BITS = 10
"""Bits per coordinate of a place on the space-filling curve."""
CHUNK_ROWS = 1024
"""Rows of the distance matrix that are computed at once; limits memory and does not affect results."""


def nearest(x: Float[Tensor, "a 3"], y: Float[Tensor, "b 3"]) -> Int64[Tensor, " a"]:
    """Index of the nearest point of `y` for each point of `x`: by a k-d tree, or on a GPU from all distances."""
    if x.device.type == "cpu" and len(y):
        from scipy.spatial import KDTree

        return torch.from_numpy(KDTree(y.detach().numpy()).query(x.detach().numpy())[1]).long()
    indices = [torch.cdist(rows, y).argmin(1) for rows in x.split(CHUNK_ROWS)]
    return torch.cat([*indices, torch.zeros(0, dtype=torch.long, device=x.device)])


def neighbours(x: Float[Tensor, "points d"], k: int) -> Iterator[Int64[Tensor, "rows {k}"]]:
    """Indices of the `k` points nearest to each point, itself among them, some rows at a time."""
    if x.device.type == "cpu":
        from scipy.spatial import KDTree

        points = x.detach().numpy()
        tree = KDTree(points)
        for start in range(0, len(points), CHUNK_ROWS):
            found = tree.query(points[start : start + CHUNK_ROWS], k=k)[1]
            yield torch.from_numpy(np.reshape(found, (-1, k))).long()
        return
    for rows in x.split(CHUNK_ROWS):
        yield torch.cdist(rows, x).topk(k, largest=False).indices


def morton_order(x: Float[Tensor, "n 3"]) -> Int64[Tensor, " n"]:
    """Order of the points along a space-filling curve (Morton 1966): points close in space are close in memory."""
    low, high = x.amin(0), x.amax(0)
    cells = ((x - low) / (high - low).clamp_min(1e-12) * (2**CURVE_BITS - 1)).long()
    place = torch.zeros_like(cells[:, 0])
    for bit in range(CURVE_BITS):
        for axis in range(3):
            place |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return place.argsort(stable=True)


def smallest_enclosing_sphere(
    offsets: Callable[[Float[Tensor, "3"]], Float[Tensor, "n 3"]], centre: Float[Tensor, "3"], *, steps: int
) -> Float[Tensor, "3"]:
    """Centre of the smallest sphere that encloses points or touches lines (Badoiu and Clarkson 2003).

    Args:
        offsets: Vectors from a given centre to each point, or to the nearest point of each line.
        centre: Initial centre.
        steps: Number of iterations; the last one moves the centre by 1 / (steps + 1) of the radius.
    """
    for step in range(1, steps + 1):
        to_points = offsets(centre)
        centre = centre + to_points[to_points.norm(dim=-1).argmax()] / (step + 1)
    return centre
