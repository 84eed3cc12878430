"""Values of a surface continued from where they are known to where they are not, without an edge between.

Pull-push (Gortler et al. 1996) in a grid of cells: means of the known values, ever coarser, fill the cells without any.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool3d, grid_sample, interpolate

from tumble.export.depth_fusion import HALF_SIDE

CELLS = 64
"""Cells per side of the grid; a power of two."""
UNCERTAIN, CERTAIN = 0.5, 0.8
"""Fraction of the points around a place whose value must be known for it to count a little, and fully."""


def continued(
    values: Float[Tensor, "t c"], known: Bool[Tensor, " t"], points: Float[Tensor, "t 3"]
) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t 1"]]:
    """Smooth continuation of the known values, at all points, and how certain the own value of each point is, 0 to 1.

    Args:
        points: Of a surface, object frame [object radius].
    """
    cell = ((points / HALF_SIDE + 1) * CELLS / 2).long().clamp(0, CELLS - 1)
    index = (cell[:, 2] * CELLS + cell[:, 1]) * CELLS + cell[:, 0]
    own = known[:, None].to(values)
    count, sums = _cell_sums(torch.ones_like(own), index), _cell_sums(torch.cat([own, own * values], -1), index)
    around = avg_pool3d(torch.cat([count, sums[:, :1]], 1), 3, 1, 1, divisor_override=1)
    fraction = around[:, 1:] / around[:, :1].clamp_min(1)
    certainty = ((fraction - UNCERTAIN) / (CERTAIN - UNCERTAIN)).clamp(0, 1)
    weight = certainty * (sums[:, :1] > 0)
    filled = _pull_push(sums[:, 1:] / sums[:, :1].clamp_min(1), weight)
    place = (points / HALF_SIDE)[None, None, None]
    planes = torch.cat([filled, certainty * (around[:, :1] > 0), (around[:, :1] > 0).to(values)], 1)
    sampled = grid_sample(planes, place, align_corners=False, padding_mode="border")[0, :, 0, 0].T
    return sampled[:, :-2], own * sampled[:, -2:-1] / sampled[:, -1:].clamp_min(1e-6)


def _cell_sums(values: Float[Tensor, "t c"], index: Int[Tensor, " t"]) -> Float[Tensor, "1 c d h w"]:
    """Sums of the values of all points in each cell."""
    total = values.new_zeros(CELLS**3, values.shape[1]).index_add_(0, index, values)
    return total.T.reshape(1, -1, CELLS, CELLS, CELLS)


def _pull_push(values: Float[Tensor, "1 c d h w"], weight: Float[Tensor, "1 1 d h w"]) -> Float[Tensor, "1 c d h w"]:
    """Values where their weight is 1, else the more the mean of ever larger surroundings, the smaller it is."""
    if values.shape[-1] == 1:
        return values
    total = avg_pool3d(weight, 2, divisor_override=1)
    coarse = avg_pool3d(weight * values, 2, divisor_override=1) / total.clamp_min(1e-6)
    behind = interpolate(_pull_push(coarse, total.clamp(max=1)), scale_factor=2, mode="trilinear")
    return weight * values + (1 - weight) * behind
