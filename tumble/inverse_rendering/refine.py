"""Stage 2: joint optimisation of Gaussians and poses, with initial albedo and light (paper section 4.2).

The Gaussians are initialised on the visual hull of the masks, or on a sphere as in the paper (`Config.start`). Their
colour is shaded by one spherical-harmonic light (`sh_lighting`), or static per Gaussian as in the paper
(`Config.colour`). Poses are aligned photometrically, or corrected by the paper's network (`Config.pose_model`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.engine import State, optim
from tumble.inverse_rendering import densify, losses, pose_network, sh_lighting
from tumble.inverse_rendering.photometric_alignment import align_pose
from tumble.inverse_rendering.self_shadowing import VisibilityTransfer, trace_visibility
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.io import tree
from tumble.maths import SE3, Index, entry, fibonacci_sphere, morton_order, spherical_harmonics
from tumble.rendering import Buffers, rasterize, threads_for_kernels
from tumble.scene import (
    Camera,
    Capture,
    Gaussians,
    TargetView,
    Trajectory,
    constant_sh,
    opacity,
    quats_from_normals,
    sdf_from_opacity,
    target_view,
    visual_hull,
)

VERSION = 19
VISIBILITY_VIEWS = 16
"""Maximum number of frames that are rendered to find the surface points from which visibility is traced."""
COVERAGE_WEIGHT = 0.3
"""Weight of coverage residuals relative to colour residuals in photometric alignment."""


@dataclass(frozen=True)
class Weights:
    """Weights of the loss terms (eq. 11); values from appendix A, stage 2, but for `gamma`."""

    mask: float = 1.0
    """Weight of the silhouette term."""
    normal: float = 0.05
    """Weight of the consistency of normals and depth."""
    variance: float = 1.0
    """Weight of the standard deviation of depth along the rays."""
    rank: float = 0.1
    """Weight of the penalty on needle-shaped Gaussians."""
    gamma: float = 0.05
    """Weight of the sharpness term; 5 in the paper. Its value hardly matters: no other term has a strong gradient to
    gamma, and Adam is invariant to the scale of the gradient."""
    proj: float = 1.0
    """Weight of the projection term."""
    specular: float = 0.0
    """Weight of the penalty on specular scales other than 1. It saturates, so that a Lambertian object can still reach
    a scale near 0; without it, noise of normals and light lowers the scale."""


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates, for an initial visual hull and a few thousand steps; the paper takes those of 3DGS."""

    means: float = 1e-3
    """Learning rate of the centres [object radius]; decays exponentially by the factor `decay`."""
    quats: float = 4e-3
    """Learning rate of the rotations."""
    log_scales: float = 8e-3
    """Learning rate of the logarithmic scales."""
    sdf: float = 2e-3
    """Learning rate of the signed distances [object radius]."""
    gamma: float = 0.05
    """Learning rate of the sharpness of the opacity [1 / object radius]; constant."""
    albedo: float = 2e-2
    """Learning rate of the albedo logits."""
    light: float = 2e-2
    """Learning rate of the coefficients of the light."""
    specular_scale: float = 0.0
    """Learning rate of the logarithmic specular scale; 0 fixes the scale at 1."""
    sh: float = 1e-2
    """Learning rate of the static radiance, if `Config.colour` is "sh": of its mean over all directions."""
    sh_rest: float = 1e-2
    """Learning rate of the static radiance's harmonics of degree 1 to 3."""
    poses: float = 0.0
    """Learning rate of the tangents of all poses, or of the network that predicts them."""
    decay: float = 0.05
    """Factor by which the learning rate of the centres decays over the run."""
    others_decay: float = 0.2
    """Factor by which all other learning rates decay over the run, except that of `gamma`."""


@dataclass(frozen=True)
class Config:
    """Settings of stage 2: the paper's values where it states them, otherwise those with the best results."""

    steps: int = 150_000
    """Number of optimisation steps (appendix A)."""
    colour: Literal["light", "sh"] = "light"
    """light: shading by one light for all Gaussians. sh: the paper's static radiance per Gaussian, degree 3."""
    start: Literal["hull", "sphere"] = "hull"
    """Initial surface. hull: the visual hull of the masks. sphere: the unit sphere, as in the paper."""
    points: int = 20_000
    """Initial number of Gaussians; not stated in the paper."""
    hull: int = 128
    """Cells per side of the visual hull's grid."""
    diameter: float = 0.0
    """Diameter of the object's sphere in the images up to which the numbers of Gaussians hold [pixels]. Where it is
    larger, both numbers grow by its power of 3/2, and `hull` by that of 3/4 (`for_resolution`). 0: they never
    grow."""
    harmonics_every: int = 0
    """Steps until the next degree of the static radiance's harmonics is trained. 0: all from the start."""
    opacity: float = 0.9
    """Initial opacity."""
    gamma: float = 30.0
    """Initial sharpness of the opacity [1 / object radius]."""
    gamma_floor: float = 0.02
    """Lower limit of the median distance in the gamma term (L_gamma), which limits gamma [object radius]."""
    ssim: float = 0.2
    """Weight of 1 - SSIM in the photometric term."""
    mask_loss: Literal["squared", "entropy"] = "squared"
    """Silhouette term. squared: see `losses.image_terms`. entropy: see `losses.mask_entropy`, as in related methods."""
    weights: Weights = field(default_factory=Weights)
    rates: Rates = field(default_factory=Rates)
    crease: float = 0.0
    """Saturation of the normal term (`losses.normal_consistency`); 0 as in the paper."""
    ramp: float = 0.1
    """Fraction of the run over which the weights of the normal and variance terms rise to their full values."""
    densification: densify.Config = field(default_factory=densify.Config)
    shadow_start: float = 0.2
    """Fraction of the run after which self-shadowing is applied; before, the geometry is too coarse."""
    pose_model: Literal["tangents", "network"] = "tangents"
    """Corrections of the poses, if their learning rate is not 0. tangents: one per frame. network: the paper's network
    over embeddings of the frames (`pose_network`)."""
    realignments: int = 0
    """Number of photometric alignments of every pose (`photometric_alignment`), at even intervals."""

    def __post_init__(self) -> None:
        if self.pose_model == "network" and self.realignments:
            raise ValueError("a pose network replaces the photometric alignments of poses: set realignments to 0")


@dataclass(frozen=True)
class Points:
    """Parameters with one row per Gaussian, which densification gathers together."""

    gaussians: Gaussians
    albedo_logits: Float[Tensor, "n 3"]
    """Linear albedo before the sigmoid."""
    sh_rest: Float[Tensor, "n k 3"]
    """Static radiance's harmonics of degree 1 to 3, which continue `gaussians.sh`; none (k = 0) under a light."""


@dataclass(frozen=True)
class Params:
    """Parameters of stage 2."""

    points: Points
    gamma: Float[Tensor, ""]
    """Sharpness of the opacity [1 / object radius]."""
    light: SHLight
    poses: Float[Tensor, "t 6"]
    """Tangents of the pose corrections: `T_cam_obj = exp(poses) @ base`; unused if there is a network."""
    pose_network: dict[str, Tensor] = field(default_factory=dict)
    """Network that predicts these tangents (`pose_network`); empty if there is none."""


@dataclass(frozen=True)
class Refined:
    """Result of stage 2."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    """Sharpness of the opacity [1 / object radius]."""
    albedo: Float[Tensor, "n 3"]
    """Linear albedo, known only up to one factor per channel, whose inverse is in the light."""
    light: SHLight
    trajectory: Trajectory
    """Refined poses."""
    pose_network: dict[str, Tensor] = field(default_factory=dict)
    """Network that predicted the corrections of the poses; empty if there is none."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of stage 2: a capture and its initial poses."""

    capture: Capture
    trajectory: Trajectory


def length(cfg: Config, inputs: Inputs) -> int:
    """Number of steps."""
    return cfg.steps


@threads_for_kernels()
def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """The initial state: grey Gaussians on the initial surface, under a uniform light."""
    like = inputs.trajectory.T_cam_obj.xyz
    start = _start(cfg, inputs, rng)
    n = len(start.positions)
    scale = (0.7 * start.spacing).clamp(1e-3, 0.2)
    gamma = torch.tensor(cfg.gamma).to(like)
    sdf = sdf_from_opacity(torch.full_like(scale, cfg.opacity), gamma)
    k = 0 if cfg.colour == "light" else 15
    gaussians = Gaussians(
        means=start.positions,
        quats=quats_from_normals(start.normals),
        log_scales=torch.stack([scale, scale, 0.1 * scale], -1).log(),
        sdf=sdf,
        sh=constant_sh(torch.full_like(start.positions, 0.2)),
    )
    learned = cfg.pose_model == "network" and cfg.rates.poses != 0
    params = Params(
        points=Points(gaussians, torch.full_like(start.positions, -0.4), start.positions.new_zeros(n, k, 3)),
        gamma=gamma,
        light=SHLight.constant(0.4, like),
        poses=like.new_zeros(len(inputs.trajectory), 6),
        pose_network=pose_network.initial(len(inputs.trajectory), like, rng) if learned else {},
    )
    params = optim.leaves(params)
    memory = {
        "order": torch.zeros(0, dtype=torch.long),
        "max_weight": torch.zeros_like(scale),
        "watched_since": torch.tensor(0),
    }
    return State(0, params, optim.adam(params, _rates(cfg)), rng, memory)


def for_resolution(cfg: Config, inputs: Inputs) -> Config:
    """The settings with as many Gaussians as the images resolve, by the diameter of the object's sphere in them."""
    focal, distances = inputs.capture.camera.fx_fy_cx_cy[0], inputs.trajectory.T_cam_obj.xyz.norm(dim=-1)
    factor = max(1.0, float(2 * focal / distances.median()) / cfg.diameter) ** 1.5 if cfg.diameter else 1.0
    most = round(cfg.densification.max_gaussians * factor)
    return replace(
        cfg,
        points=round(cfg.points * factor),
        hull=round(cfg.hull * math.sqrt(factor)),
        densification=replace(cfg.densification, max_gaussians=most),
    )


def _start(cfg: Config, inputs: Inputs, rng: torch.Generator) -> visual_hull.OrientedPoints:
    """Points on the initial surface, in Morton order: kernels then find neighbours in the caches."""
    points = _initial_surface(for_resolution(cfg, inputs), inputs, rng)
    order = morton_order(points.positions)
    return tree.map(lambda x: x[order], points)


def _initial_surface(cfg: Config, inputs: Inputs, rng: torch.Generator) -> visual_hull.OrientedPoints:
    """Points of the sphere or of the visual hull."""
    if cfg.start == "sphere":
        x_obj = fibonacci_sphere(cfg.points).to(inputs.trajectory.T_cam_obj.xyz)
        spacing = math.sqrt(4 * math.pi / cfg.points)
        return visual_hull.OrientedPoints(x_obj, x_obj, torch.full_like(x_obj[:, 0], spacing))
    cells = visual_hull.carve(inputs.capture, inputs.trajectory, resolution=cfg.hull)
    return visual_hull.sample_surface(cells, cfg.points, rng)


def _rates(cfg: Config) -> dict[str, float]:
    """Learning rates by name of the parameters; 0 for those that the colour model does not use."""
    rates, light = cfg.rates, cfg.colour == "light"
    learned = cfg.pose_model == "network" and rates.poses != 0
    return {
        "points.gaussians.means": rates.means,
        "points.gaussians.quats": rates.quats,
        "points.gaussians.log_scales": rates.log_scales,
        "points.gaussians.sdf": rates.sdf,
        "points.gaussians.sh": 0.0 if light else rates.sh,
        "points.sh_rest": 0.0 if light else rates.sh_rest,
        "points.albedo_logits": rates.albedo if light else 0.0,
        "light.coefficients": rates.light if light else 0.0,
        "light.log_specular_scale": rates.specular_scale if light else 0.0,
        "gamma": rates.gamma,
        "poses": 0.0 if learned else rates.poses,
    } | ({"pose_network": rates.poses} if learned else {})


def pose(params: Params, inputs: Inputs, frame: Index, *, corrected: bool = True) -> SE3:
    """`T_cam_obj` of one frame.

    Args:
        corrected: Whether its tangent may differ from zero. If not, the exponential map, some hundred small operations,
            is skipped; the result is the same.
    """
    base = inputs.trajectory.T_cam_obj.at(frame)
    return pose_network.correction(params.poses, params.pose_network, frame) @ base if corrected else base


def _corrects_poses(cfg: Config, step: int) -> bool:
    """Whether training has changed poses by a step, told from the settings: a device need not be waited for."""
    return cfg.rates.poses != 0 or any(aligned <= step for aligned in _alignment_steps(cfg))


def render(
    points: Points,
    gamma: Tensor,
    light: SHLight,
    T_cam_obj: SE3,
    R_env_obj: Float[Tensor, "3 3"],
    camera: Camera,
    mask: Tensor | None = None,
    *,
    visibility: VisibilityTransfer | None = None,
    harmonics: Index = 15,
) -> Buffers:
    """One view with stage 2's colour model, in linear radiance.

    Args:
        points: Gaussians and albedo.
        gamma: Sharpness of the opacity [1 / object radius].
        light: Light in the env frame.
        T_cam_obj: Pose of the view.
        R_env_obj: Rotation from the object frame to the env frame.
        camera: Intrinsics of the view.
        mask: Pixels that count in `Buffers.touched`; all when None.
        visibility: For self-shadowing; no self-shadowing when None.
        harmonics: Number of the static radiance's harmonics of degree 1 to 3 that are trained; all count.
    """
    gaussians = _with_radiance(points, harmonics)
    if gaussians.sh.shape[1] == 1:
        lit = (visibility, R_env_obj, -(T_cam_obj.translation @ T_cam_obj.rotation.matrix()))
        colour = sh_lighting.radiance(light, gaussians, points.albedo_logits, *lit)
        gaussians = replace(gaussians, sh=constant_sh(colour))
    return rasterize(gaussians, gamma, T_cam_obj, camera, {}, mask)


def _with_radiance(points: Points, harmonics: Index = 15) -> Gaussians:
    """The Gaussians with all harmonics of their static radiance; those beyond a number get no gradient."""
    gaussians, rest = points.gaussians, points.sh_rest
    if not rest.shape[1]:
        return gaussians
    if not isinstance(harmonics, int) or harmonics < rest.shape[1]:
        trained = torch.arange(rest.shape[1], device=rest.device)[:, None] < harmonics
        rest = torch.where(trained, rest, rest.detach())
    return replace(gaussians, sh=torch.cat([gaussians.sh, rest], 1))


@dataclass(frozen=True)
class FrameNumbers:
    """What a step of stage 2 draws, and what changes from step to step; numbers may be tensors (`engine.graph`)."""

    frame: Index
    """Frame whose view is compared."""
    ramp: float | Float[Tensor, ""]
    """Fraction of the weights of the normal and variance terms (`Config.ramp`)."""
    corrected: bool
    """Whether poses may differ from the initial ones."""
    harmonics: Index
    """Number of the static radiance's harmonics of degree 1 to 3 that are trained."""


@threads_for_kernels()
def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """One optimisation step on one frame, preceded by densification, visibility and alignment where they are due."""
    return advance(cfg, inputs, state, prepare(cfg, inputs, state))


def can_be_recorded(cfg: Config) -> bool:
    """Whether `advance` never waits for the device."""
    return True


def prepare(cfg: Config, inputs: Inputs, state: State) -> FrameNumbers:
    """Densification, visibility, alignment and learning rates where they are due, and the numbers of the next step."""
    assert state.optimizer is not None, "init makes one"
    progress, every = state.step / cfg.steps, cfg.densification.refine_every
    if state.step and state.step % every == 0 and progress < cfg.densification.refine_stop:
        _densify(cfg, inputs, state)
    elif densify.prunes_late(cfg.densification, state.step, cfg.steps):
        _prune_late(cfg, inputs, state)
    if state.step % every == 0 and progress >= cfg.shadow_start and cfg.colour == "light":
        _trace_visibility(inputs, state)
    if state.step in _alignment_steps(cfg):
        _align_poses(inputs, state)
    optim.anneal(state.optimizer, _rate_factors(cfg, progress))
    ramp = min(1.0, progress / cfg.ramp) if cfg.ramp else 1.0
    degree = min(3, state.step // cfg.harmonics_every) if cfg.harmonics_every else 3
    frame, corrected = _next_frame(state, len(inputs.capture)), _corrects_poses(cfg, state.step)
    return FrameNumbers(frame, ramp, corrected, (degree + 1) ** 2 - 1)


def advance(cfg: Config, inputs: Inputs, state: State, numbers: FrameNumbers) -> dict[str, Tensor | float]:
    """One optimisation step on one frame; replaces no tensor of the state."""
    assert state.optimizer is not None, "init makes one"
    params, camera, frame = state.params, inputs.capture.camera, numbers.frame
    T_cam_obj = pose(params, inputs, frame, corrected=numbers.corrected)
    R_env_obj = inputs.trajectory.R_env_obj_at(frame, T_cam_obj)
    arguments = (params.points, params.gamma, params.light, T_cam_obj, R_env_obj, camera)
    view = render(*arguments, visibility=cached_visibility(state), harmonics=numbers.harmonics)
    largest = state.memory["max_weight"]
    torch.maximum(largest, view.weight.detach(), out=largest)
    terms = _terms(cfg, params, view, inputs.capture, frame, T_cam_obj, numbers.ramp)
    optim.descend(torch.stack(list(terms.values())).sum(), state.optimizer, step=state.step)
    return {name: value.detach() for name, value in terms.items()} | {
        "gaussians": float(len(params.points.albedo_logits))
    }


@torch.no_grad()
def _trace_visibility(inputs: Inputs, state: State) -> None:
    """Trace the visibility of all Gaussians and store it in the state."""
    params, n = state.params, len(inputs.capture)
    poses = [pose(params, inputs, frame) for frame in range(0, n, -(-n // VISIBILITY_VIEWS))]
    traced = trace_visibility(params.points.gaussians, params.gamma, poses, inputs.capture.camera)
    state.memory |= {"visibility.occluded": traced.occluded, "visibility.unoccluded": traced.unoccluded}


def cached_visibility(state: State) -> VisibilityTransfer | None:
    """The visibility as it was last traced, or None if it has not been traced yet."""
    memory = state.memory
    if "visibility.occluded" not in memory:
        return None
    return VisibilityTransfer(memory["visibility.occluded"], memory["visibility.unoccluded"])


def _next_frame(state: State, n: int) -> int:
    """Index of the next frame: every epoch visits all frames once, in random order."""
    if not len(state.memory["order"]):
        state.memory["order"] = torch.randperm(n, generator=state.rng)
    elif state.step % n == 0:
        state.memory["order"].copy_(torch.randperm(n, generator=state.rng))
    return int(state.memory["order"][state.step % n])


def _rate_factors(cfg: Config, progress: float) -> dict[str, float]:
    """Factors of the learning rates by name prefix, at a progress of 0 to 1."""
    return {"": cfg.rates.others_decay**progress, "points.gaussians.means": cfg.rates.decay**progress, "gamma": 1.0}


def _terms(
    cfg: Config,
    params: Params,
    view: Buffers,
    capture: Capture,
    frame: Index,
    T_cam_obj: SE3,
    ramp: float | Float[Tensor, ""],
) -> dict[str, Tensor]:
    """Weighted loss terms (eq. 11) of the view of a frame; `ramp` is a fraction of the two weights that rise."""
    weights, camera = cfg.weights, capture.camera
    photo, mask = (entry(x, frame).to(view.alpha.device) for x in (capture.images, capture.masks))
    fraction = 1.0 if isinstance(ramp, Tensor) else ramp
    factors = {
        "mask": weights.mask,
        "normal": fraction * weights.normal,
        "variance": fraction * weights.variance,
        "rank": weights.rank,
        "gamma": weights.gamma,
        "proj": weights.proj,
    }
    image = {"ssim_weight": cfg.ssim, "crease": cfg.crease, "weights": factors}
    terms = losses.image_terms(view, photo, mask, camera, T_cam_obj, **image)
    if isinstance(ramp, Tensor):  # weights of kernels are numbers
        terms |= {name: ramp * terms[name] for name in ("normal", "variance")}
    if cfg.mask_loss == "entropy":
        terms |= {"mask": weights.mask * losses.mask_entropy(view.alpha, mask)}
    own = (params.points.gaussians, params.gamma, view, camera, T_cam_obj)
    terms |= losses.gaussian_terms(*own, floor=cfg.gamma_floor, reach=0.1, weights=factors)
    return terms | {"specular": weights.specular * -torch.expm1(-params.light.log_specular_scale.square())}


@torch.no_grad()
def _densify(cfg: Config, inputs: Inputs, state: State) -> None:
    """Score the Gaussians over random frames, then clone, split and prune."""
    params, growth = state.params, for_resolution(cfg, inputs).densification
    assert state.optimizer is not None, "init makes one"
    rules, gaussians = growth.fastgs, params.points.gaussians
    scores = _scores(cfg, inputs, state)
    prune = opacity(gaussians.sdf, params.gamma) < growth.prune_opacity
    # Epochs are in random order: two of them, less one step, contain every frame.
    judged = state.step - int(state.memory["watched_since"]) >= 2 * len(inputs.capture) - 1
    if judged:
        prune |= state.memory["max_weight"] < growth.prune_weight
    if rules is None:
        plan = densify.plan(growth, scores.bad, prune)
    else:
        largest = gaussians.log_scales.amax(-1).exp()
        plan = densify.plan_fastgs(growth, rules, scores, largest, prune, state.step, state.rng)
    points = optim.regrow(params.points, state.optimizer, plan.index, plan.fresh)
    if rules is None:
        densify.place_children(points.gaussians, plan)
    else:
        densify.sample_children(points.gaussians, plan, state.rng)
        sdf = points.gaussians.sdf
        sdf.copy_(densify.limited(rules, sdf, params.gamma, state.step))
        optim.forget(sdf, state.optimizer)
    order = morton_order(points.gaussians.means)
    points = optim.regrow(points, state.optimizer, order, torch.zeros_like(plan.fresh))
    state.params = replace(params, points=points)
    if judged:
        state.memory["max_weight"] = torch.zeros_like(points.albedo_logits[:, 0])
        state.memory["watched_since"] = torch.tensor(state.step)
    else:  # new Gaussians have been watched for less long than the others: they are judged next time
        largest = state.memory["max_weight"][plan.index].masked_fill(plan.fresh, math.inf)
        state.memory["max_weight"] = largest[order]


def _scores(cfg: Config, inputs: Inputs, state: State) -> densify.Scores:
    """The Gaussians' scores over random frames."""
    params, capture, growth = state.params, inputs.capture, cfg.densification

    def view(frame: int) -> tuple[SE3, Callable[[Tensor | None], Buffers]]:
        T_cam_obj = pose(params, inputs, frame)
        R_env_obj = inputs.trajectory.R_env_obj_at(frame, T_cam_obj)
        arguments = (params.points, params.gamma, params.light, T_cam_obj, R_env_obj, capture.camera)
        return T_cam_obj, partial(render, *arguments, visibility=cached_visibility(state))

    frames = torch.randperm(len(capture), generator=state.rng)[: growth.score_views].tolist()
    return densify.score(growth, params.points.gaussians.means, capture, frames, view, ssim_weight=cfg.ssim)


@torch.no_grad()
def _prune_late(cfg: Config, inputs: Inputs, state: State) -> None:
    """Remove faint Gaussians, and those with the highest pruning scores."""
    params, rules = state.params, cfg.densification.fastgs
    assert rules is not None, "only FastGS prunes late"
    assert state.optimizer is not None, "init makes one"
    opacities = opacity(params.points.gaussians.sdf, params.gamma)
    kept = densify.kept_late(rules, opacities, _scores(cfg, inputs, state))
    points = optim.regrow(params.points, state.optimizer, kept, torch.zeros_like(kept, dtype=torch.bool))
    state.params = replace(params, points=points)
    state.memory["max_weight"] = state.memory["max_weight"][kept]


def _alignment_steps(cfg: Config) -> list[int]:
    """Steps at whose beginning all poses are aligned."""
    return [cfg.steps * k // (cfg.realignments + 1) for k in range(1, cfg.realignments + 1)]


@torch.no_grad()
def _align_poses(inputs: Inputs, state: State) -> None:
    """Align the pose of every frame photometrically with the current Gaussians."""
    params, base = state.params, inputs.trajectory.T_cam_obj
    for frame in range(len(inputs.capture)):
        truth = target_view(inputs.capture, frame, params.gamma)
        residual = partial(_residuals, params, inputs, frame, truth, cached_visibility(state))
        T_cam_obj = align_pose(residual, pose(params, inputs, frame))
        params.poses[frame] = (T_cam_obj @ base[frame].inverse()).log()


def _residuals(
    params: Params,
    inputs: Inputs,
    frame: int,
    truth: TargetView,
    visibility: VisibilityTransfer | None,
    T_cam_obj: SE3,
) -> Float[Tensor, " r"]:
    """Residuals of colour [sRGB] and of weighted coverage between the view at a pose and the input image."""
    R_env_obj = inputs.trajectory.R_env_obj_at(frame, T_cam_obj)
    arguments = (params.points, params.gamma, params.light, T_cam_obj, R_env_obj, inputs.capture.camera)
    view = render(*arguments, visibility=visibility)
    colour = losses.srgb_as_captured(view.rgb, truth.image) - truth.image
    coverage = COVERAGE_WEIGHT * (view.alpha - truth.mask)[..., None]
    return (torch.cat([colour, coverage], -1) * truth.valid).flatten()


@threads_for_kernels()
@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Refined:
    """Geometry, albedo and light; the static radiance is the unshadowed diffuse one, averaged over all frames.

    If the radiance was static, the albedo is its mean over the directions in which the Gaussians are seen, and the
    light uniform: the albedo's logits were not trained.
    """
    params = state.params
    every = slice(None)
    T_cam_obj = pose_network.correction(params.poses, params.pose_network, every) @ inputs.trajectory.T_cam_obj
    trajectory = replace(inputs.trajectory, T_cam_obj=T_cam_obj)
    gaussians, albedo, light = _with_radiance(params.points), torch.sigmoid(params.points.albedo_logits), params.light
    if cfg.colour == "sh":
        albedo = _seen_radiance(gaussians)
        light = SHLight.constant(1.0, albedo)
    else:
        mean = torch.zeros_like(albedo)
        for R_env_obj in trajectory.R_env_obj:
            mean += albedo * light.diffuse(gaussians.normals @ R_env_obj.T) / len(trajectory)
        gaussians = replace(gaussians, sh=constant_sh(mean))
    return Refined(gaussians, params.gamma, albedo, light, trajectory, tree.detach(params.pose_network))


def _seen_radiance(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Mean radiance of every Gaussian over the view directions towards its front, weighted by their cosine.

    Harmonics have arbitrary values in all other directions, since back faces are culled.
    """
    d_obj = fibonacci_sphere(256).to(gaussians.means)
    cosine = (-gaussians.normals @ d_obj.T).clamp_min(0)
    weights = cosine / cosine.sum(-1, keepdim=True) @ spherical_harmonics.basis(d_obj, 3)
    return (weights[..., None] * gaussians.sh).sum(1).clamp_min(0)
