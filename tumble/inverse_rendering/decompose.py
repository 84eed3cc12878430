"""Stage 3: albedo, roughness and light, by physically based deferred shading of the refined Gaussians (section 4.3).

Every step shades some pixels of one frame: the light of that frame is the environment seen through `R_env_obj`, and
so is the light that other parts of the object send on (the paper averages that over frames; it changes with the pose).
Visibility is cached per Gaussian over several turned sets of shared directions.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from tumble.engine import State, optim
from tumble.inverse_rendering import losses, sh_lighting, specular_fit
from tumble.inverse_rendering.refine import Refined
from tumble.io import tree
from tumble.maths import SE3, fibonacci_sphere, linear_from_srgb, random_rotation
from tumble.rendering import (
    AveragedBounce,
    Bounce,
    Buffers,
    Surface,
    Visibility,
    buffers_of,
    build,
    displacement,
    prefilter,
    shade_split,
    surface,
    surface_points,
    threads_for_kernels,
    transfer,
    unoccluded,
    visibility,
)
from tumble.scene import (
    DIELECTRIC,
    TEMPERATURE,
    Asset,
    Capture,
    Environment,
    Gaussians,
    Material,
    Trajectory,
    env_from_obj,
    target_view,
)

VERSION = 14
LOOK_EVERY = 100
"""Steps between two looks at how far geometry has moved."""
FAINT = 0.2
"""Share of a dielectric's highlight below which it hardly counts as one."""
ALBEDO = (0.003, 0.98)
"""At the start. Printed red has a green of 0.004: a start well above it costs 0.6 dB, for the logit has far to go."""
FITTED, FITTED_PIXELS = 64, 2
"""Frames from which the highlight is found at the start, and pixels of each, in those of a step. With a quarter of them
chance decides between the two best widths of the cracker box indoors, a question of 4 dB of albedo."""
MOVED = 0.3
"""Of `trace.moved`, beyond which visibility is traced anew."""


@dataclass(frozen=True)
class Weights:
    """Eq. 14; values from appendix A, stage 3."""

    light: float = 0.05
    """Squared differences of neighbouring texels."""
    material: float = 0.25
    """Edge-aware smoothness of albedo and roughness."""
    mask: float = 0.0
    """Squared difference of coverage and mask, as in stage 2. Without it, once geometry joins, what is darker than its
    light lets shine becomes translucent, as do the grooves of a chess knight."""
    highlight: float = 0.01
    """Price of a highlight, whatever its strength, unless a trial found one.

    On a Lambertian bottle a third of one stands in for a sun that the map blurs: it lowers the photometric term by 3 %
    and costs 2 dB of albedo. A real one lowers that term by half; the one that a trial found on the chess knight
    indoors fell into the price and vanished, which cost 3 dB of relighting.
    """


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates; material and light from appendix A."""

    albedo: float = 0.025
    roughness: float = 0.025
    normal: float = 1e-3
    tint: float = 0.0
    """Of the highlight against the diffuse light; the paper fixes it."""
    light: float = 0.01
    means: float = 1.6e-5
    """Geometry joins after the warm-up, slower than in stage 2 but for `sdf`. The paper: "from SVG-IR"."""
    quats: float = 1e-4
    log_scales: float = 5e-4
    sdf: float = 5e-3
    poses: float = 0.0
    """0 leaves the poses of stage 2."""


@dataclass(frozen=True)
class Config:
    """Paper values where it states them; where it is silent, what measured best."""

    steps: int = 150_000
    """Appendix A."""
    warmup: int = 5_000
    """Steps before geometry joins (appendix A)."""
    directions: int = 512
    """Shared directions of the diffuse light (appendix A)."""
    sets: int = 8
    """Turned sets of directions, taken in turn: more leave less of their pattern in the albedo."""
    pixels: int = 1024
    """Pixels shaded per step."""
    rows: int = 16
    """Of the light map at the start (appendix A)."""
    doublings: int = 6
    """Of the light map, spread evenly over the run (appendix A: up to 1024 rows)."""
    roughness: float = 0.4
    """At the start. The data hardly say: a light too blurred under a lobe too narrow fits as well."""
    fitted: bool = False
    """Whether the highlight's width and strength are found at the start by trying them (`highlight.fit`)."""
    brightness: float = 0.8
    """Brightest albedo at the start (95 %); the light takes up the rest. Their product is all that stage 2 knows."""
    visibility: bool = True
    """Whether the object shadows itself."""
    bounce: Literal["none", "average", "frame"] = "frame"
    """How the object lights itself: with its mean colour over all frames, as in the paper, or as the frame is lit."""
    corners: bool = True
    """Whether material varies within a Gaussian, between its corners."""
    weights: Weights = field(default_factory=Weights)
    rates: Rates = field(default_factory=Rates)


@dataclass(frozen=True)
class Params:
    """What stage 3 trains."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    material: Material
    environment: Environment
    poses: Float[Tensor, "t 6"]
    log_tint: Float[Tensor, "3"]
    """How much brighter the highlight is than light and f0 as they stand make it: what says how the product of albedo
    and light, which the diffuse lobe shows, is shared out. A descent texel by texel hardly moves along that valley."""


@dataclass(frozen=True)
class Inputs:
    """A capture and what stage 2 made of it."""

    capture: Capture
    refined: Refined


def length(cfg: Config, inputs: Inputs) -> int:
    return cfg.steps


@threads_for_kernels()
def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """Materials and light as stage 2 found them; visibility traced."""
    refined = inputs.refined
    # One factor for all channels: a saturated object has a channel that is dark for good reason.
    share = cfg.brightness / refined.albedo.amax(-1).quantile(0.95)
    albedo = (refined.albedo * share).clamp(*ALBEDO)
    light = sh_lighting.environment(refined.light, cfg.rows)
    material = Material.constant(len(albedo), torch.full_like(albedo[0], 0.5), cfg.roughness)
    params = Params(
        gaussians=refined.gaussians,
        gamma=refined.gamma,
        material=replace(material, albedo_logits=(TEMPERATURE * torch.logit(albedo))[:, None].repeat(1, 4, 1)),
        environment=Environment.from_radiance(light.radiance / share),
        poses=albedo.new_zeros(len(refined.trajectory), 6),
        log_tint=(refined.light.log_highlight + share.log()).repeat(3),
    )
    params = optim.leaves(params)
    turns = [fibonacci_sphere(cfg.directions).to(albedo) @ random_rotation(rng).to(albedo).T for _ in range(cfg.sets)]
    memory = {"directions": torch.stack(turns), "price": cfg.weights.highlight * torch.ones_like(params.gamma)}
    state = State(0, params, optim.adam(params, _rates(cfg)), rng, memory)
    _look_around(cfg, inputs, state)
    if cfg.fitted and refined.light.log_highlight.exp() > specular_fit.SURE:
        fit_highlight(cfg, inputs, state)
    return state


@torch.no_grad()
def fit_highlight(cfg: Config, inputs: Inputs, state: State) -> None:
    """Bring the highlight to the width and strength that fit best under the light as it is, and the albedos with it."""
    params, capture, parts = state.params, inputs.capture, []
    widths = sorted({cfg.roughness, *specular_fit.ROUGHNESS})
    for number in range(0, len(capture), -(-len(capture) // FITTED)):
        T_cam_obj = pose(params, inputs, number)
        view = buffers_of(params, T_cam_obj, capture.camera)
        truth = target_view(capture, number, view.alpha)
        inner = -max_pool2d(-truth.mask[None], 3, 1, 1)[0]  # the outermost pixels mix in the background
        pixels = _draw(FITTED_PIXELS * cfg.pixels, view, inner, state.rng)
        points = surface(view, T_cam_obj, capture.camera, pixels=pixels)
        R_env_obj, white = env_from_obj(T_cam_obj, capture.light), torch.ones_like(points.normals)
        shades = [(view, white, 0.0)]
        for width in widths:
            rough = {"roughness": torch.full_like(view.features["roughness"], width)}
            shades.append((replace(view, features=view.features | rough), 0 * white, DIELECTRIC))
        diffuse, *specular = (_shaded(cfg, state, params, v, points, R_env_obj, a, f0) for v, a, f0 in shades)
        parts.append((_shown(view, points), diffuse, torch.stack(specular), points.sample(truth.image)))
    gaussian, diffuse, specular, photograph = zip(*parts, strict=True)
    samples = (torch.cat(gaussian), torch.cat(diffuse), torch.cat(specular, 1), linear_from_srgb(torch.cat(photograph)))
    tint, start, n = params.log_tint.exp(), widths.index(cfg.roughness), len(params.gaussians.means)
    if (found := specular_fit.fit(specular_fit.Samples(*samples), n, start, float(tint.mean()))) is None:
        return
    before, after = tint * found.slope[start], found.slope[found.which]
    albedo = params.material.albedo + (before - found.strength * after)[:, None]
    params.material.albedo_logits.copy_(TEMPERATURE * torch.logit(albedo.clamp(*ALBEDO)))
    params.material.roughness_logits.fill_(TEMPERATURE * torch.logit(torch.tensor(widths[found.which])))
    params.log_tint.fill_(math.log(found.strength))
    state.memory["price"] = torch.zeros_like(params.gamma)


def _rates(cfg: Config) -> dict[str, float]:
    rates = cfg.rates
    return {
        "material.albedo_logits": rates.albedo,
        "material.roughness_logits": rates.roughness,
        "material.normal_offset": rates.normal,
        "material.f0_logit": 0.0,
        "environment": rates.light,
        "gaussians.means": rates.means,
        "gaussians.quats": rates.quats,
        "gaussians.log_scales": rates.log_scales,
        "gaussians.sdf": rates.sdf,
        "gaussians.sh": 0.0,
        "gamma": 0.0,
        "poses": rates.poses,
        "log_tint": rates.tint,
    }


@torch.no_grad()
def _look_around(cfg: Config, inputs: Inputs, state: State) -> None:
    """Trace what every Gaussian sees, from the surface that it stands for."""
    if not cfg.visibility:
        return
    params, gaussians = state.params, state.params.gaussians
    poses = [pose(params, inputs, number) for number in range(len(inputs.capture))]
    points = surface_points(gaussians, params.gamma, poses, inputs.capture.camera)
    tracer = build(gaussians, params.gamma)
    seen = [
        visibility(tracer, points, gaussians.normals, directions, blockers=cfg.bounce != "none")
        for directions in state.memory["directions"]
    ]
    state.memory["bits"] = torch.stack([v.bits for v in seen])
    state.memory |= {f"traced.{name}": x.detach().clone() for name, x in tree.named_tensors(gaussians).items()}
    if cfg.bounce != "none":
        state.memory["transfer"] = transfer(seen, gaussians.normals)
        state.memory["blocker"] = torch.stack([v.blocker for v in seen if v.blocker is not None])


def _look_again(cfg: Config, inputs: Inputs, state: State) -> None:
    """Trace anew when geometry has moved by about the width of a shadow's edge since the last time."""
    if not cfg.visibility or state.step < cfg.warmup or state.step % LOOK_EVERY:
        return
    traced = Gaussians(*(state.memory[f"traced.{name}"] for name in tree.named_tensors(state.params.gaussians)))
    if displacement(traced, state.params.gaussians) > MOVED:
        _look_around(cfg, inputs, state)


def pose(params: Params, inputs: Inputs, number: int) -> SE3:
    """`T_cam_obj` of one frame."""
    base = inputs.refined.trajectory.T_cam_obj[number]
    return SE3.exp(params.poses[number]) @ base if params.poses.requires_grad else base


def uncornered(params: Params) -> Params:
    """The same with one material per Gaussian, the mean of its corners."""

    def mean(x: Tensor) -> Tensor:
        return x.mean(1, keepdim=True).expand_as(x)

    m = params.material
    material = Material(mean(m.albedo_logits), mean(m.roughness_logits), mean(m.normal_offset), m.f0_logit)
    return replace(params, material=material)


@threads_for_kernels()
def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    assert state.optimizer is not None, "init makes one"
    _grow_light(cfg, state)
    _look_again(cfg, inputs, state)
    params, capture = state.params, inputs.capture
    if state.step < cfg.warmup:
        # Not yet trained: half of the rasterizer's backward pass is for nobody.
        params = replace(params, gaussians=tree.detach(params.gaussians), poses=params.poses.detach())
    number = int(torch.randint(len(capture), (1,), generator=state.rng))
    T_cam_obj = pose(params, inputs, number)
    view = buffers_of(params if cfg.corners else uncornered(params), T_cam_obj, capture.camera)
    truth = target_view(capture, number, view.alpha)
    points = surface(view, T_cam_obj, capture.camera, pixels=_draw(cfg.pixels, view, truth.mask, state.rng))
    R_env_obj, f0 = env_from_obj(T_cam_obj, capture.light), params.material.f0 * params.log_tint.exp()
    shaded = _shaded(cfg, state, params, view, points, R_env_obj, points.sample(view.features["albedo"]), f0)
    rendered, photograph = (shaded * points.sample(view.alpha[..., None]))[None], points.sample(truth.image)[None]
    terms = {
        # A frame may show no pixel of the object for sure.
        "render": (losses.developed(rendered, photograph) - photograph).abs().sum() / (3 * max(1, len(points.pixels))),
        "light": cfg.weights.light * losses.unevenness(params.environment.radiance),
        "mask": cfg.weights.mask * losses.silhouette(view.alpha, truth.mask, truth.valid),
        "material": cfg.weights.material * losses.material(view, truth.mask, truth.image),
        "highlight": state.memory["price"] * (1 - (-params.log_tint.exp().mean() / FAINT).exp()),
    }
    slow = 0.1 ** (state.step / cfg.steps)
    joined = slow * (state.step >= cfg.warmup)
    optim.anneal(state.optimizer, {"": slow, "gaussians": joined, "poses": joined})
    optim.descend(torch.stack(list(terms.values())).sum(), state.optimizer, step=state.step)
    return {name: value.detach() for name, value in terms.items()}


def _draw(n: int, view: Buffers, mask: Tensor, rng: torch.Generator) -> Tensor:
    """Some pixels that show the object for sure."""
    solid = torch.where(((view.alpha > 0.5) & (mask > 0.5)).flatten())[0]
    if not len(solid):
        return solid
    return solid[torch.randint(len(solid), (n,), generator=rng).to(solid.device)]


def _shaded(
    cfg: Config,
    state: State,
    params: Params,
    view: Buffers,
    points: Surface,
    R_env_obj: Tensor,
    albedo: Float[Tensor, "p 3"],
    f0: float | Tensor,
) -> Float[Tensor, "p 3"]:
    return shade_split(
        points,
        albedo,
        points.sample(view.features["roughness"]),
        prefilter(params.environment),
        R_env_obj,
        _seen(cfg, state, _shown(view, points)),
        f0=f0,
        bounce=_bounce(cfg, state, params),
    )


def _shown(view: Buffers, points: Surface) -> Tensor:
    """The Gaussian that counts most at each point."""
    return view.dominant.flatten()[points.pixels].clamp_min(0).long()


def _bounce(cfg: Config, state: State, params: Params) -> Bounce | AveragedBounce | None:
    if cfg.bounce == "none" or not cfg.visibility:
        return None
    if cfg.bounce == "average":
        return AveragedBounce(params.gaussians.sh[:, 0] / math.sqrt(4 * math.pi))
    return Bounce(params.material.albedo.mean(1), state.memory["transfer"])


def _seen(cfg: Config, state: State, index: Tensor) -> Visibility:
    """What pixels see under this step's set of directions: the same as the Gaussians `index` that they show."""
    memory, which = state.memory, state.step % cfg.sets
    directions = memory["directions"][which]
    if not cfg.visibility:
        return unoccluded(directions, len(index))
    blocker = memory["blocker"][which] if cfg.bounce != "none" else None
    return Visibility(directions, memory["bits"][which], blocker).gather(index)


def _grow_light(cfg: Config, state: State) -> None:
    """Double the light map at even intervals; the optimizer goes on."""
    done = round(math.log2(state.params.environment.log_radiance.shape[0] / cfg.rows))
    due = min(cfg.doublings, state.step * (cfg.doublings + 1) // cfg.steps)
    if done >= due:
        return

    def doubled(x: Tensor) -> Tensor:
        return interpolate(x.movedim(-1, 0)[None], scale_factor=2, mode="bilinear")[0].movedim(0, -1)

    assert state.optimizer is not None, "init makes one"
    environment = optim.resample(
        state.params.environment,
        state.optimizer,
        "log_radiance",
        lambda x: Environment(x).upsampled().log_radiance,
        moments=doubled,
    )
    state.params = replace(state.params, environment=environment)


def shared_out(params: Params) -> Params:
    """The same with the tint of the highlight moved where it belongs: `highlight.shared_out`."""
    material, log_tint = specular_fit.shared_out(params.material, params.log_tint)
    environment = Environment(params.environment.log_radiance + log_tint)
    return replace(params, material=material, environment=environment, log_tint=torch.zeros_like(log_tint))


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Asset:
    """The relightable object."""
    params = shared_out(state.params if cfg.corners else uncornered(state.params))
    T_cam_obj = SE3.exp(params.poses) @ inputs.refined.trajectory.T_cam_obj
    return Asset(
        gaussians=params.gaussians,
        gamma=params.gamma,
        material=params.material,
        environment=params.environment,
        trajectory=Trajectory(T_cam_obj, inputs.capture.light),
        camera=inputs.capture.camera,
    )
