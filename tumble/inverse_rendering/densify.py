"""Densification and pruning: decides which Gaussians are split and removed; `optim.regrow` applies the decision.

A *plan* lists the parent row of every Gaussian afterwards: kept rows appear once, cloned and split rows twice, pruned
rows not at all. The score of a Gaussian is that of FastGS: the number of badly rendered pixels that it contributes to,
as a mean over several views. Ours splits the highest scores; `FastGS` adds gradients, clones and a budget of pruning.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tumble.inverse_rendering import losses
from tumble.maths import SE3
from tumble.rendering import Buffers
from tumble.scene import Camera, Capture, Gaussians, sdf_from_opacity, target_view


@dataclass(frozen=True)
class FastGS:
    """Settings of FastGS (Ren et al. 2026) beyond those of `Config`. Small Gaussians are cloned, large ones split."""

    gradient: float = 2e-4
    """Gradient of the photometric term by a centre in the image, mean over the views that show it, from which on a
    Gaussian is cloned or split [1 / half the image's side]."""
    dense: float = 0.005
    """Largest scale up to which a Gaussian is cloned instead of split: 0.001 of DiscretizedSDF's extent of 5 [object
    radius]."""
    big: float = 0.5
    """Largest scale above which a Gaussian may be pruned after the first reset: 0.1 of that extent [object radius]."""
    max_opacity: float = 0.8
    """Limit of all opacities at each densification."""
    reset_every: int = 3_000
    """Steps between two resets of all opacities and, after the last densification, between two late prunings."""
    reset_opacity: float = 0.01
    """Limit of all opacities at a reset."""
    late_stop: float = 0.2
    """Fraction of the run after which late pruning ends: 30,000 of the paper's steps."""
    late_opacity: float = 0.1
    """Opacity below which a Gaussian is removed in late pruning."""
    late_score: float = 0.9
    """Pruning score above which a Gaussian is removed in late pruning."""


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
    removed, since it lies inside the object. 0: it is not."""
    fastgs: FastGS | None = None
    """FastGS in place of splitting the highest scores; `grow_fraction` does not count then."""


@dataclass(frozen=True)
class Scores:
    """What several views say of each Gaussian."""

    bad: Float[Tensor, " n"]
    """Number of bad pixels that it contributes to, mean over the views."""
    prune: Float[Tensor, " n"]
    """The same, each view weighted by its photometric term, scaled to [0, 1]: the pruning score of FastGS."""
    gradient: Float[Tensor, " n"]
    """Gradient of the photometric term by its centre in the image, mean over the views that show it [1 / half the
    image's side]; 0 where it is not needed."""


@dataclass(frozen=True)
class Plan:
    """The Gaussians after a densification, as indices of the Gaussians before it."""

    index: Int[Tensor, " m"]
    """Parent row of every Gaussian."""
    fresh: Bool[Tensor, " m"]
    """Whether a Gaussian is a clone or the child of a split; its optimizer moments start at zero."""
    n_kept: int
    """Number of kept rows, which come first; then follow clones, all first children, and all second children."""
    n_clones: int = 0
    """Number of clones, which equal their parents, and whose parents are kept."""


def bad_pixels(cfg: Config, error: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """1 where the rendering error on the object exceeds both thresholds (relative and absolute), 0 elsewhere.

    The absolute threshold avoids splits for the noise of a nearly perfect rendering. The background does not enter the
    largest error.
    """
    error = error * mask
    return ((error > cfg.bad_fraction * error.max()) & (error > cfg.bad_min_error)).to(error.dtype)


@torch.no_grad()
def score(
    cfg: Config,
    means: Float[Tensor, "n 3"],
    capture: Capture,
    frames: Sequence[int],
    view_of: Callable[[int], tuple[SE3, Callable[[Tensor | None], Buffers]]],
    *,
    ssim_weight: float,
) -> Scores:
    """Scores of the Gaussians over views.

    Args:
        means: Centres, object frame [object radius].
        frames: Indices of the frames whose views are scored.
        view_of: The pose of a frame, and a function that renders it; it takes the pixels that count in
            `Buffers.touched`, or None for all.
        ssim_weight: Weight of SSIM in the photometric term.
    """
    bad, weighted, gradient, shown = means.new_zeros(4, len(means))
    for frame in frames:
        T_cam_obj, rendered = view_of(frame)
        with torch.set_grad_enabled(cfg.fastgs is not None):
            view = rendered(None)
        truth = target_view(capture, frame, view.alpha)
        error = (losses.srgb_as_captured(view.rgb, truth.image) - truth.image).abs().mean(-1)
        touched = rendered(bad_pixels(cfg, error, truth.mask)).touched
        bad += touched / len(frames)
        if cfg.fastgs is None:
            continue
        photo, mask = (x[frame].to(means.device) for x in (capture.images, capture.masks))
        with torch.enable_grad():
            terms = losses.image_terms(view, photo, mask, capture.camera, T_cam_obj, ssim_weight=ssim_weight)
            (by_mean,) = torch.autograd.grad(terms["render"], [means])
        weighted += terms["render"].detach() * touched
        gradient += screen_gradient(by_mean, means, T_cam_obj, capture.camera)
        shown += view.weight.detach() > 0
    spread = (weighted - weighted.min()) / (weighted.max() - weighted.min()).clamp_min(1e-12)
    return Scores(bad, spread, gradient / shown.clamp_min(1))


def prunes_late(cfg: Config, step: int, steps: int) -> bool:
    """Whether FastGS removes faint Gaussians before a step, after the last densification."""
    rules = cfg.fastgs
    if rules is None or not cfg.refine_stop < step / steps < rules.late_stop:
        return False
    return step % rules.reset_every == 0


def kept_late(rules: FastGS, opacities: Float[Tensor, " n"], scores: Scores) -> Int[Tensor, " m"]:
    """Indices of the Gaussians that stay in late pruning; all if none would, as when few steps follow a reset."""
    kept = torch.where((opacities >= rules.late_opacity) & (scores.prune <= rules.late_score))[0]
    return kept if len(kept) else torch.arange(len(opacities), device=opacities.device)


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
    return _plan(torch.where(keep)[0], split[:0], split)


def plan_fastgs(
    cfg: Config,
    rules: FastGS,
    scores: Scores,
    largest: Float[Tensor, " n"],
    candidates: Bool[Tensor, " n"],
    step: int,
    rng: torch.Generator,
) -> Plan:
    """Clone and split as FastGS does, and remove those candidates for pruning that its budget draws.

    Half as many Gaussians as there are candidates are drawn from all, with a probability that grows with their pruning
    score; of these the candidates are removed, unless they are split.

    Args:
        largest: Largest scale of each Gaussian [object radius].
        candidates: Gaussians that may be removed; after the first reset, so may big ones.
        step: Number of steps before this one.
    """
    candidates = candidates | (largest > rules.big) & (step > rules.reset_every)
    n, budget = len(largest), int(candidates.sum()) // 2
    growing = (scores.bad.floor() > cfg.grow_score) & (scores.gradient >= rules.gradient)
    order = torch.where(growing, scores.bad, -1.0).argsort(descending=True, stable=True)
    growing[order[max(0, cfg.max_gaussians - n) :]] = False
    cloned = torch.where(growing & (largest <= rules.dense))[0]
    split = torch.where(growing & (largest > rules.dense))[0]
    keep = torch.ones_like(candidates)
    if budget:
        weights = 1 / (1e-6 + 1 - scores.prune.double().cpu())
        drawn = torch.multinomial(weights, budget, generator=rng).to(candidates.device)
        keep[drawn] = ~candidates[drawn]
    keep[split] = False
    return _plan(torch.where(keep)[0], cloned, split)


def _plan(kept: Int[Tensor, " k"], cloned: Int[Tensor, " c"], split: Int[Tensor, " s"]) -> Plan:
    """The plan that keeps some rows, clones some of them, and splits others."""
    index = torch.cat([kept, cloned, split, split])
    fresh = torch.arange(len(index), device=index.device) >= len(kept)
    return Plan(index, fresh, len(kept), len(cloned))


def screen_gradient(
    gradient: Float[Tensor, "n 3"], means: Float[Tensor, "n 3"], T_cam_obj: SE3, camera: Camera
) -> Float[Tensor, " n"]:
    """Length of the gradient by the centres in the image, from that by the centres in the object frame.

    The gradient through the shape of the footprint, which changes little with the centre, is counted as well.

    Returns:
        [1 / half the image's side], as in 3D Gaussian splatting.
    """
    by_x_y = (T_cam_obj.rotation @ gradient)[:, :2] * (T_cam_obj @ means)[:, 2:]
    half = torch.tensor([camera.width / 2, camera.height / 2]).to(gradient)
    return (by_x_y / camera.fx_fy_cx_cy[:2].to(gradient) * half).norm(dim=-1)


def limited(rules: FastGS, sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""], step: int) -> Float[Tensor, " n"]:
    """Signed distances of the same sign, whose opacities are limited as FastGS does after a step."""
    most = rules.max_opacity if step % rules.reset_every else rules.reset_opacity
    least = sdf_from_opacity(torch.full_like(sdf, most), gamma)
    return torch.where(sdf < 0, -1.0, 1.0) * sdf.abs().maximum(least)


@torch.no_grad()
def sample_children(gaussians: Gaussians, plan: Plan, rng: torch.Generator) -> None:
    """Move both children of every split to random places of the parent's distribution, and divide their scales by 1.6
    (3D Gaussian splatting), in place."""
    children = slice(plan.n_kept + plan.n_clones, None)
    scales = gaussians.log_scales[children].exp()
    local = torch.randn(scales.shape, generator=rng).to(scales) * scales
    gaussians.means[children] += (gaussians.R_obj_local[children] @ local[..., None])[..., 0]
    gaussians.log_scales[children] -= math.log(1.6)


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
