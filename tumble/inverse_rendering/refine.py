"""Stage 2: geometry, poses and a first guess of albedo and light, by fitting Gaussians to the frames (section 4.2).

The Gaussians start on the visual hull of the masks. Their colour is the rotation-aware one of `coarse_light`; the
paper's static colour per Gaussian is an ablation (`Config.colour`).
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from tumble.engine import State, optim
from tumble.inverse_rendering import densify, losses, sh_lighting
from tumble.inverse_rendering.photometric_alignment import realign
from tumble.inverse_rendering.self_shadowing import Sky, look_around
from tumble.inverse_rendering.sh_lighting import CoarseLight
from tumble.maths import SE3, channels_first, crop, crop_box
from tumble.rendering import Buffers, rasterize, threads_for_kernels
from tumble.scene import (
    Camera,
    Capture,
    Gaussians,
    TargetView,
    Trajectory,
    constant_sh,
    env_from_obj,
    facing,
    opacity,
    sdf_from_opacity,
    target_view,
    visual_hull,
)

VERSION = 9
SEEN_FROM = 16  # frames, in tracing what Gaussians see
HINT = 0.3
"""Share of the gradient of colours that turns normals: the light is too coarse to be trusted. Hand-held, all of it
leaves the knight's normals at 8.2 degrees, this share or none at 7.3; the bottle's are 3.8 with it, 4.0 without."""
OUTLINE = 0.3
"""Weight of coverage against colours where poses are realigned."""


@dataclass(frozen=True)
class Weights:
    """Eq. 11; values from appendix A, stage 2. A hundredth of `gamma` counts; its rate moves gamma whatever that is,
    for nothing else pulls at it and Adam knows no scale."""

    mask: float = 1.0
    normal: float = 0.05
    variance: float = 1.0
    rank: float = 0.1
    gamma: float = 5.0
    proj: float = 1.0
    highlight: float = 0.0
    """Of an object whose highlight is not that of glass. It saturates: noise in normals and light alone pulls the
    highlight down by a third, and a third too faint puts the rest into the albedo; a Lambertian object pays it.
    """


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates. The paper takes those of 3DGS; ours suit a start on the hull and a few thousand steps."""

    means: float = 1e-3
    """[object radius]; decays to `decay` of it."""
    quats: float = 4e-3
    log_scales: float = 8e-3
    sdf: float = 2e-3
    gamma: float = 0.05
    albedo: float = 2e-2
    light: float = 2e-2
    highlight: float = 0.0
    """Of the strength of the highlight; 0 leaves it that of glass."""
    sh: float = 1e-2
    poses: float = 0.0
    """Of the tangents of all poses."""
    decay: float = 0.05


@dataclass(frozen=True)
class Config:
    """Paper values where it states them; where it is silent, what measured best."""

    steps: int = 150_000
    """Appendix A."""
    colour: Literal["light", "sh"] = "light"
    """light: rotation-aware; sh: the paper's static radiance per Gaussian, degree 3."""
    points: int = 20_000
    """Gaussians at the start. Not stated in the paper."""
    hull: int = 128
    """Cells per side of the carved grid."""
    opacity: float = 0.9
    """At the start."""
    gamma: float = 30.0
    """Sharpness at the start [1 / object radius]."""
    gamma_floor: float = 0.02
    """Median distance under which gamma is not pushed further (L_gamma) [object radius]."""
    ssim: float = 0.2
    """Share of 1 - SSIM in the photometric term."""
    weights: Weights = field(default_factory=Weights)
    rates: Rates = field(default_factory=Rates)
    crease: float = 0.0
    """Of the normal term (`losses.normal_consistency`); 0 as in the paper."""
    ramp: float = 0.1
    """Share of the run over which normal and variance terms come in."""
    densification: densify.Config = field(default_factory=densify.Config)
    shaded: float = 0.2
    """Share of the run from which the object stands in its own shade (`shadow`); before, it is too coarse."""
    realignments: int = 0
    """How often, at even intervals, each pose is brought in line with its own frame (`realign`)."""


@dataclass(frozen=True)
class Points:
    """All that there is one row of per Gaussian."""

    gaussians: Gaussians
    albedo_logits: Float[Tensor, "n 3"]


@dataclass(frozen=True)
class Params:
    """What stage 2 trains."""

    points: Points
    gamma: Float[Tensor, ""]
    light: CoarseLight
    poses: Float[Tensor, "t 6"]
    """Tangents: `T_cam_obj = exp(poses) @ base`."""


@dataclass(frozen=True)
class Refined:
    """The outcome of stage 2."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    albedo: Float[Tensor, "n 3"]
    """Linear, up to one factor per channel that the light takes up."""
    light: CoarseLight
    trajectory: Trajectory


@dataclass(frozen=True)
class Inputs:
    """A capture and its poses."""

    capture: Capture
    trajectory: Trajectory


def length(cfg: Config, inputs: Inputs) -> int:
    return cfg.steps


@threads_for_kernels()
def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """Gaussians on the visual hull, grey, under a uniform light."""
    like = inputs.trajectory.T_cam_obj.xyz
    cells = visual_hull.carve(inputs.capture, inputs.trajectory, resolution=cfg.hull)
    start = visual_hull.surface(cells, cfg.points, rng)
    n = len(start.positions)
    scale = (0.7 * start.spacing).clamp(1e-3, 0.2)
    gamma = torch.tensor(cfg.gamma).to(like)
    sdf = sdf_from_opacity(torch.full_like(scale, cfg.opacity), gamma)
    k = 1 if cfg.colour == "light" else 16
    gaussians = Gaussians(
        means=start.positions,
        quats=facing(start.normals),
        log_scales=torch.stack([scale, scale, 0.1 * scale], -1).log(),
        sdf=sdf,
        sh=torch.cat([constant_sh(torch.full_like(start.positions, 0.2)), start.positions.new_zeros(n, k - 1, 3)], 1),
    )
    params = Params(
        points=Points(gaussians, torch.full_like(start.positions, -0.4)),
        gamma=gamma,
        light=CoarseLight.constant(0.4, like),
        poses=like.new_zeros(len(inputs.trajectory), 6),
    )
    params = optim.leaves(params)
    memory = {"order": torch.zeros(0, dtype=torch.long), "shown": torch.zeros_like(scale)}
    return State(0, params, optim.adam(params, _rates(cfg)), rng, memory)


def _rates(cfg: Config) -> dict[str, float]:
    rates, light = cfg.rates, cfg.colour == "light"
    return {
        "points.gaussians.means": rates.means,
        "points.gaussians.quats": rates.quats,
        "points.gaussians.log_scales": rates.log_scales,
        "points.gaussians.sdf": rates.sdf,
        "points.gaussians.sh": 0.0 if light else rates.sh,
        "points.albedo_logits": rates.albedo if light else 0.0,
        "light.coefficients": rates.light if light else 0.0,
        "light.log_highlight": rates.highlight if light else 0.0,
        "gamma": rates.gamma,
        "poses": rates.poses,
    }


def pose(params: Params, inputs: Inputs, number: int) -> SE3:
    """`T_cam_obj` of one frame."""
    base = inputs.trajectory.T_cam_obj[number]
    # Poses that are left as given have tangents of 0, which take a hundred small tensors to say nothing.
    free = params.poses.requires_grad or bool(params.poses[number].any())
    return SE3.exp(params.poses[number]) @ base if free else base


def render(
    points: Points,
    gamma: Tensor,
    light: CoarseLight,
    T_cam_obj: SE3,
    trajectory: Trajectory,
    camera: Camera,
    mask: Tensor | None = None,
    *,
    sky: Sky | None = None,
) -> Buffers:
    """One view with stage 2's colour, linear radiance; without a sky nothing shadows anything."""
    gaussians = points.gaussians
    if gaussians.sh.shape[1] == 1:
        R_env_obj = env_from_obj(T_cam_obj, trajectory.light)
        view = normalize(T_cam_obj.inverse().xyz - gaussians.means, dim=-1)
        albedo = torch.sigmoid(points.albedo_logits)
        if sky is not None:
            albedo = albedo * sky.share(light, albedo, R_env_obj)
        normals = torch.lerp(gaussians.normals.detach(), gaussians.normals, HINT)
        colour = sh_lighting.radiance(light, albedo, normals, view, R_env_obj)
        gaussians = replace(gaussians, sh=constant_sh(colour))
    return rasterize(gaussians, gamma, T_cam_obj, camera, {}, mask)


@threads_for_kernels()
def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    assert state.optimizer is not None, "init makes one"
    progress, every = state.step / cfg.steps, cfg.densification.refine_every
    if state.step and state.step % every == 0 and progress < cfg.densification.refine_stop:
        _densify(cfg, inputs, state)
    if state.step % every == 0 and progress >= cfg.shaded and cfg.colour == "light":
        _look_around(inputs, state)
    if state.step in _realignments(cfg):
        _realign(inputs, state)
    params, camera = state.params, inputs.capture.camera
    number = _draw(state, len(inputs.capture))
    T_cam_obj = pose(params, inputs, number)
    view = render(params.points, params.gamma, params.light, T_cam_obj, inputs.trajectory, camera, sky=sky(state))
    state.memory["shown"] = torch.maximum(state.memory["shown"], view.weight.detach())
    terms = _terms(cfg, params, view, target_view(inputs.capture, number, view.alpha), camera, T_cam_obj, progress)
    optim.anneal(state.optimizer, _annealed(cfg, progress))
    optim.descend(torch.stack(list(terms.values())).sum(), state.optimizer, step=state.step)
    return {name: value.detach() for name, value in terms.items()} | {
        "gaussians": float(len(params.points.albedo_logits))
    }


@torch.no_grad()
def _look_around(inputs: Inputs, state: State) -> None:
    params, n = state.params, len(inputs.capture)
    poses = [pose(params, inputs, number) for number in range(0, n, -(-n // SEEN_FROM))]
    found = look_around(params.points.gaussians, params.gamma, poses, inputs.capture.camera)
    state.memory |= {"sky.seen": found.seen, "sky.whole": found.whole}


def sky(state: State) -> Sky | None:
    """What Gaussians saw when it was last traced."""
    return Sky(state.memory["sky.seen"], state.memory["sky.whole"]) if "sky.seen" in state.memory else None


def _draw(state: State, n: int) -> int:
    """The next frame: all frames in a new random order, again and again."""
    if state.step % n == 0 or not len(state.memory["order"]):
        state.memory["order"] = torch.randperm(n, generator=state.rng)
    return int(state.memory["order"][state.step % n])


def _annealed(cfg: Config, progress: float) -> dict[str, float]:
    slow = 0.2**progress
    return {"": slow, "points.gaussians.means": cfg.rates.decay**progress, "gamma": 1.0}


def _terms(
    cfg: Config, params: Params, view: Buffers, truth: TargetView, camera: Camera, T_cam_obj: SE3, progress: float
) -> dict[str, Tensor]:
    weights, gaussians = cfg.weights, params.points.gaussians
    ramp = min(1.0, progress / cfg.ramp) if cfg.ramp else 1.0
    full, size, seen, depth = camera, (camera.height, camera.width), view.weight > 0, view.depth
    view, truth, camera, share = _window(view, truth, camera)
    image = losses.developed(view.rgb, truth.image)
    from_depth, known = losses.surface_normals(view.depth, view.alpha > 0.5, camera, T_cam_obj)
    normal = losses.normal_consistency(view.normal, from_depth, known, crease=cfg.crease)
    return {
        "render": losses.photometric(image, truth.image, truth.valid, ssim_weight=cfg.ssim, size=size),
        "mask": share * weights.mask * losses.silhouette(view.alpha, truth.mask, truth.valid),
        "normal": share * ramp * weights.normal * normal,
        "variance": share * ramp * weights.variance * losses.variance(view.depth_var),
        "rank": weights.rank * losses.effective_rank(gaussians.log_scales),
        "gamma": weights.gamma * losses.sharpness(gaussians.sdf, params.gamma, floor=cfg.gamma_floor) * 1e-2,
        "proj": weights.proj * losses.projection(gaussians, seen, depth, full, T_cam_obj, reach=0.1),
        "highlight": weights.highlight * -torch.expm1(-params.light.log_highlight.square()),
    }


def _window(view: Buffers, truth: TargetView, camera: Camera) -> tuple[Buffers, TargetView, Camera, float]:
    """The part of a view beyond which rendering and photograph are black, and its share of the picture.

    Means over the picture are those over the window times the share: often a third of the work.
    """
    shown = (view.alpha.detach() > 0) | (truth.image > 0).any(-1) | (truth.mask > 0)
    if not shown.any():
        return view, truth, camera, 1.0
    box = crop_box(shown, losses.SSIM_MARGIN)
    cut = replace(
        view,
        **{name: crop(getattr(view, name), box) for name in ("alpha", "depth", "depth_var", "normal", "dominant")},
        rgb=channels_first(crop(view.rgb, box)).movedim(0, -1),
    )
    seen = TargetView(
        channels_first(crop(truth.image, box)).movedim(0, -1), crop(truth.mask, box), crop(truth.valid, box)
    )
    return cut, seen, camera.cropped(*box), box[2] * box[3] / shown.numel()


@torch.no_grad()
def _densify(cfg: Config, inputs: Inputs, state: State) -> None:
    params, camera, how = state.params, inputs.capture.camera, cfg.densification
    assert state.optimizer is not None, "init makes one"
    bad = params.gamma.new_zeros(len(params.points.albedo_logits))
    numbers = torch.randperm(len(inputs.capture), generator=state.rng)[: how.score_views].tolist()
    for number in numbers:
        T_cam_obj = pose(params, inputs, number)
        arguments = (params.points, params.gamma, params.light, T_cam_obj, inputs.trajectory, camera)
        first = render(*arguments, sky=sky(state))
        truth = target_view(inputs.capture, number, first.alpha)
        error = (losses.developed(first.rgb, truth.image) - truth.image).abs().mean(-1)
        where = densify.bad_pixels(how, error, truth.mask)
        bad += render(*arguments, mask=where, sky=sky(state)).touched / len(numbers)
    drop = opacity(params.points.gaussians.sdf, params.gamma) < how.prune_opacity
    drop |= state.memory["shown"] < how.prune_weight
    plan = densify.plan(how, bad, drop)
    points = optim.regrow(params.points, state.optimizer, plan.index, plan.fresh)
    densify.place_children(points.gaussians, plan)
    state.params = replace(params, points=points)
    state.memory["shown"] = torch.zeros_like(points.albedo_logits[:, 0])


def _realignments(cfg: Config) -> list[int]:
    """Steps before which poses are realigned."""
    return [cfg.steps * k // (cfg.realignments + 1) for k in range(1, cfg.realignments + 1)]


@torch.no_grad()
def _realign(inputs: Inputs, state: State) -> None:
    params, base = state.params, inputs.trajectory.T_cam_obj
    for number in range(len(inputs.capture)):
        unexplained = partial(
            _unexplained, params, inputs, target_view(inputs.capture, number, params.gamma), sky(state)
        )
        T_cam_obj = realign(unexplained, pose(params, inputs, number))
        params.poses[number] = (T_cam_obj @ base[number].inverse()).log()


def _unexplained(
    params: Params, inputs: Inputs, truth: TargetView, shade: Sky | None, T_cam_obj: SE3
) -> Float[Tensor, " r"]:
    """Colours and, with less weight, coverage that a pose leaves over of a photograph, sRGB."""
    arguments = (params.points, params.gamma, params.light, T_cam_obj, inputs.trajectory, inputs.capture.camera)
    view = render(*arguments, sky=shade)
    colour = losses.developed(view.rgb, truth.image) - truth.image
    outline = OUTLINE * (view.alpha - truth.mask)[..., None]
    return (torch.cat([colour, outline], -1) * truth.valid).flatten()


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Refined:
    """Geometry, first albedo and light; as static colour the mean diffuse one of all frames, unshaded."""
    params = state.params
    T_cam_obj = SE3.exp(params.poses) @ inputs.trajectory.T_cam_obj
    trajectory = Trajectory(T_cam_obj, inputs.trajectory.light)
    gaussians, albedo = params.points.gaussians, torch.sigmoid(params.points.albedo_logits)
    if cfg.colour == "light":
        mean = torch.zeros_like(albedo)
        for R_env_obj in trajectory.R_env_obj:
            mean += albedo * params.light.diffuse(gaussians.normals @ R_env_obj.T) / len(trajectory)
        gaussians = replace(gaussians, sh=constant_sh(mean))
    return Refined(gaussians, params.gamma, albedo, params.light, trajectory)
