"""Where Gaussians are added and dropped: decisions only, as a gather (`optim.regrow` carries them out).

A *plan* lists the rows of the next generation: rows that stay appear once, rows that split appear twice, dropped rows
not at all. The score is FastGS's: how many badly rendered pixels a Gaussian touches, over several views at once.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tumble.scene import Gaussians


@dataclass(frozen=True)
class Config:
    """When Gaussians are added and dropped; names are those of 3D Gaussian splatting, the score is FastGS's."""

    refine_every: int = 500
    """Steps between densifications (FastGS)."""
    refine_stop: float = 0.7
    """Share of the run after which the number of Gaussians stays."""
    max_gaussians: int = 100_000
    score_views: int = 10
    """Views that are scored at each densification (FastGS)."""
    bad_share: float = 0.1
    """Share of a view's largest error from which a pixel counts as bad (FastGS)."""
    bad_floor: float = 0.02
    """Least error of a bad pixel, sRGB."""
    grow_score: float = 2.0
    """Bad pixels that a Gaussian touches, mean over views, from which it splits."""
    grow_share: float = 0.12
    """Largest share of the Gaussians that splits at once."""
    prune_opacity: float = 0.05
    """Opacity below which a Gaussian is dropped."""
    prune_weight: float = 0.05
    """Blending weight that a Gaussian must reach in some view since the last densification, else it lies inside and is
    dropped [pixels]."""


@dataclass(frozen=True)
class Plan:
    """The next generation."""

    index: Int[Tensor, " m"]
    """Row of the parent of every Gaussian."""
    fresh: Bool[Tensor, " m"]
    """Children of a split: they start with empty optimizer moments."""
    n_kept: int
    """Rows that stay; behind them come first all first children, then all second ones."""


def bad_pixels(cfg: Config, error: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """1 where the rendering is bad: above a share of the view's largest error on the object, and above a floor.

    The floor keeps a nearly perfect picture from being split for its noise; the background does not set the scale.
    """
    error = error * mask
    return ((error > cfg.bad_share * error.max()) & (error > cfg.bad_floor)).to(error.dtype)


def plan(cfg: Config, score: Float[Tensor, " n"], drop: Bool[Tensor, " n"]) -> Plan:
    """Split the Gaussians of the highest scores, drop the useless.

    Args:
        score: Bad pixels touched, mean over views.
        drop: Rows to leave out.
    """
    n = len(score)
    room = max(0, cfg.max_gaussians - (n - int(drop.sum())))
    most = min(room, math.ceil(cfg.grow_share * n))
    candidates = torch.where(drop, -1.0, score)
    order = candidates.argsort(descending=True, stable=True)[:most]
    split = order[candidates[order] > cfg.grow_score]
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
