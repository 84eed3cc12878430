"""Where Gaussians are added and dropped: decisions only, as a gather (`optim.regrow` carries them out).

A *plan* lists the rows of the next generation: rows that stay appear once, rows that split appear twice, dropped rows
not at all. The score is FastGS's: how many badly rendered pixels a Gaussian touches, over several views at once.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tumble.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Plan:
    """The next generation."""

    index: Int[Tensor, " m"]
    """Row of the parent of every Gaussian."""
    fresh: Bool[Tensor, " m"]
    """Children of a split: they start with empty optimizer moments."""
    n_kept: int
    """Rows that stay; behind them come first all first children, then all second ones."""


def bad_pixels(
    error: Float[Tensor, "h w"], mask: Float[Tensor, "h w"], *, relative: float, absolute: float
) -> Float[Tensor, "h w"]:
    """1 where the rendering is bad: above a share of the view's largest error on the object, and above a floor.

    The floor keeps a nearly perfect picture from being split for its noise; the background does not set the scale.
    """
    error = error * mask
    return ((error > relative * error.max()) & (error > absolute)).to(error.dtype)


def plan(
    importance: Float[Tensor, " n"],
    drop: Bool[Tensor, " n"],
    *,
    threshold: float,
    fraction: float,
    limit: int,
) -> Plan:
    """Split the most important Gaussians, drop the useless.

    Args:
        importance: Bad pixels touched, mean over views.
        drop: Rows to leave out.
        threshold: Least importance of a Gaussian that splits [pixels].
        fraction: Largest share of the Gaussians that splits at once.
        limit: Largest number of Gaussians afterwards.
    """
    n = len(importance)
    room = max(0, limit - (n - int(drop.sum())))
    most = min(room, math.ceil(fraction * n))
    candidates = torch.where(drop, -1.0, importance)
    order = candidates.argsort(descending=True, stable=True)[:most]
    split = order[candidates[order] > threshold]
    stays = ~drop
    stays[split] = False
    kept = torch.where(stays)[0]
    index = torch.cat([kept, split, split])
    fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
    fresh[len(kept) :] = True
    return Plan(index, fresh, len(kept))


@torch.no_grad()
def place_children(gaussians: Gaussians, plan: Plan) -> None:
    """Move the children of every split apart along their longer tangential axis and shrink them, in place.

    Two half-covering children at +-0.5 sigma with 1/1.6 of the width repeat their parent's footprint closely.
    """
    children = torch.where(plan.fresh)[0]
    if not len(children):
        return
    half = len(children) // 2
    tangential = gaussians.log_scales[children, :2]
    longer = tangential.argmax(-1)
    axis = gaussians.R_obj_local[children, :, longer]
    step = 0.5 * tangential.amax(-1).exp()
    sign = torch.ones_like(step)
    sign[half:] = -1
    gaussians.means[children] += (sign * step)[:, None] * axis
    gaussians.log_scales[children, longer] -= math.log(1.6)
