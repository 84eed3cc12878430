"""Densification and pruning: decides which Gaussians are split and removed; `optim.regrow` applies the decision.

A *plan* lists the parent row of every Gaussian afterwards: kept rows appear once, split rows twice, pruned rows not at
all. The score of a Gaussian is that of FastGS: the number of badly rendered pixels that it contributes to, as a mean
over several views.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tumble.scene import Gaussians


@dataclass(frozen=True)
class Config:
    """Settings of densification and pruning, named as in 3D Gaussian splatting."""

    refine_every: int = 500
    """Steps between densifications (FastGS)."""
    refine_stop: float = 0.7
    """Fraction of the run after which the number of Gaussians is constant."""
    max_gaussians: int = 100_000
    """Upper limit of the number of Gaussians."""
    score_views: int = 10
    """Views that are scored at each densification (FastGS)."""
    bad_fraction: float = 0.1
    """Fraction of a view's largest error above which a pixel counts as bad (FastGS)."""
    bad_min_error: float = 0.02
    """Minimum error of a bad pixel [sRGB]."""
    grow_score: float = 2.0
    """Score above which a Gaussian is split [bad pixels per view]."""
    grow_fraction: float = 0.12
    """Maximum fraction of the Gaussians that is split at once."""
    prune_opacity: float = 0.05
    """Opacity below which a Gaussian is removed."""
    prune_weight: float = 0.05
    """Blending weight [pixels] that a Gaussian must reach in some view, once all were rendered; otherwise it is
    removed, since it lies inside the object."""


@dataclass(frozen=True)
class Plan:
    """The Gaussians after a densification, as indices of the Gaussians before it."""

    index: Int[Tensor, " m"]
    """Parent row of every Gaussian."""
    fresh: Bool[Tensor, " m"]
    """Whether a Gaussian is the child of a split; its optimizer moments start at zero."""
    n_kept: int
    """Number of kept rows, which come first; then follow all first children, then all second children."""


def bad_pixels(cfg: Config, error: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """1 where the rendering error on the object exceeds both thresholds (relative and absolute), 0 elsewhere.

    The absolute threshold avoids splits for the noise of a nearly perfect rendering. The background does not enter the
    largest error.
    """
    error = error * mask
    return ((error > cfg.bad_fraction * error.max()) & (error > cfg.bad_min_error)).to(error.dtype)


def plan(cfg: Config, score: Float[Tensor, " n"], prune: Bool[Tensor, " n"]) -> Plan:
    """Split the Gaussians with the highest scores, within the limits of the settings, and remove pruned ones.

    Args:
        cfg: Settings.
        score: Number of bad pixels each Gaussian contributes to, mean over views.
        prune: Gaussians to remove.
    """
    n = len(score)
    capacity = max(0, cfg.max_gaussians - (n - int(prune.sum())))
    max_splits = min(capacity, math.ceil(cfg.grow_fraction * n))
    candidates = torch.where(prune, -1.0, score)
    order = candidates.argsort(descending=True, stable=True)[:max_splits]
    split = order[candidates[order] > cfg.grow_score]
    keep = ~prune
    keep[split] = False
    kept = torch.where(keep)[0]
    index = torch.cat([kept, split, split])
    fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
    fresh[len(kept) :] = True
    return Plan(index, fresh, len(kept))


@torch.no_grad()
def place_children(gaussians: Gaussians, plan: Plan) -> None:
    """Move the two children of every split apart along their longer tangential axis and shrink them, in place.

    Children at +-0.5 sigma with 1/1.6 of the parent's width together cover nearly the parent's footprint.
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
