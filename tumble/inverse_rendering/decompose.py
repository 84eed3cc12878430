"""Stage 3: albedo, roughness and light by physically based deferred shading (paper section 4.3).

Every step shades some pixels of one frame. Direct and indirect light are those of the frame's pose, since the light is
fixed in the env frame; the paper averages indirect light over all frames. Visibility is cached per Gaussian, for
several rotated sets of directions that all Gaussians share, or traced from the shaded points as in the paper
(`Config.shadows`).
"""

import math
import sys
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from tumble.engine import CACHE, State, graph, optim
from tumble.inverse_rendering import losses, pose_network, sh_lighting, specular_fit
from tumble.inverse_rendering.material_params import (
    ALBEDO_RANGE,
    NO_LOBE,
    Params,
    Rates,
    absorbed,
    shifted_material,
    with_half_the_contrast,
    with_lobe,
    with_metal,
    without_corners,
)
from tumble.inverse_rendering.pixel_sampling import PixelNumbers, pixels_at, pixels_per_step, sample_pixels
from tumble.inverse_rendering.refine import Refined
from tumble.io import tree
from tumble.maths import SE3, Index, entry, fibonacci_sphere, linear_from_srgb, random_rotation
from tumble.rendering import (
    AveragedBounce,
    Bounce,
    Buffers,
    Surface,
    Visibility,
    build_tracer,
    corner_features,
    displacement,
    prefilter,
    rasterize_material,
    render_gbuffer,
    shade,
    shade_split,
    shading_light,
    split_lobes,
    surface,
    surface_points,
    threads_for_kernels,
    transfer,
    unoccluded,
    visibility,
    with_offset,
)
from tumble.scene import (
    DIELECTRIC,
    OBJECT,
    Asset,
    Camera,
    Capture,
    Environment,
    Gaussians,
    Material,
    target_view,
)

VERSION = 26
DISPLACEMENT_CHECK_EVERY = 100
"""Steps between two measurements of the displacement of the geometry."""
PENALTY_SCALE = 0.2
"""Specular scale at which the penalty on the specular lobe reaches 63 % of its maximum."""
FIT_FRAMES = 64
"""Maximum number of frames by which albedos are fitted before the first step (`specular_fit`)."""
FIT_PIXELS = 2
"""Pixels per frame in this fit, as a multiple of the pixels of a step."""
TRIAL_STEPS = 200
"""Number of first steps that are made with and without a specular lobe; at most a third of the run."""
MIN_EXPLAINED = 0.07
"""Smallest part of the photometric error without a specular lobe that a lobe must explain, or the object has none."""
MIN_METAL = 0.1
"""Fraction of the object's pixels that must show regions which may be metal for metal to be tried."""
MAX_HALVINGS = 3
"""Maximum number of times that the contrast of the first albedo is halved."""
BLOCKERS = f"{CACHE}blocker"
"""Name of the blockers of all sets in the state's memory: gigabytes at 100,000 Gaussians, so that no checkpoint has
them."""
MAX_DISPLACEMENT = 0.3
"""Displacement of the Gaussians (`trace.displacement`) above which visibility is traced again."""


@dataclass(frozen=True)
class Weights:
    """Weights of the loss terms (eq. 14); values from appendix A, stage 3."""

    light: float = 0.05
    """Weight of the smoothness of the environment map."""
    material: float = 0.25
    """Weight of the edge-aware smoothness of albedo and roughness."""
    mask: float = 0.0
    """Weight of the silhouette term, as in stage 2. Without it, dark grooves become translucent while geometry is
    optimised."""
    specular: float = 0.01
    """Weight of the penalty on the specular lobe, which hardly depends on the lobe's scale. Without a trial
    (`Config.try_matte`) it keeps a Lambertian object from a lobe that compensates for errors of the light."""


@dataclass(frozen=True)
class Config:
    """Settings of stage 3: the paper's values where it states them, otherwise those with the best results."""

    steps: int = 150_000
    """Number of optimisation steps (appendix A)."""
    warmup: int = 5_000
    """Steps before geometry is optimised, too (appendix A)."""
    directions: int = 512
    """Number of shared directions over which light is integrated (appendix A)."""
    sets: int = 8
    """Number of rotated sets of directions, used alternately, which reduces banding in the albedo."""
    pixels: int = 1024
    """Pixels shaded per step."""
    side: int = 0
    """Smaller side of the images up to which this number holds [pixels]; where it is larger, the number grows in
    proportion. 0: it never grows."""
    rows: int = 16
    """Initial number of rows of the environment map (appendix A)."""
    doublings: int = 6
    """How often the environment map's resolution is doubled, at even intervals (appendix A: up to 1024 rows)."""
    roughness: float = 0.5
    """Initial roughness: that of the lobe in stage 2 (`sh_lighting.GLOSSY_FALLOFF`), for which its light is made."""
    try_matte: bool = False
    """Whether the first steps are made with and without a specular lobe, and with less contrast of the albedo, of which
    the best ones count (`choose_start`)."""
    start: Literal["stage 2", "grey"] = "stage 2"
    """stage 2: its albedo and light. grey: the same albedo everywhere, under its light."""
    initial_albedo: float = 0.8
    """95 % quantile of the initial albedo, or, from grey, the albedo. The factor goes into the light, since stage 2
    determines only the product of albedo and light."""
    visibility: bool = True
    """Whether the object casts shadows on itself."""
    shadows: Literal["cached", "traced"] = "cached"
    """cached: visibility of the Gaussian that a pixel shows, traced when geometry has moved. traced: from the shaded
    points themselves, in every step, as in the paper."""
    lobes: Literal["split", "sum"] = "split"
    """split: narrow specular lobes from a prefiltered map (`shading.shade_split`). sum: both lobes summed over the
    directions (`shading.shade`), as in the paper."""
    smooth_light: Literal["radiance", "log radiance"] = "log radiance"
    """What the smoothness of the environment map is measured on. radiance: as in the paper; the term then depends on
    the absolute scale of the light and dims a sun."""
    bounce: Literal["none", "average", "frame"] = "frame"
    """Indirect light. average: from the mean radiance over all frames, as in the paper. frame: from the radiance under
    the light of the frame."""
    corners: bool = True
    """Whether the material varies between the corners of a Gaussian."""
    region_trials: int = 0
    """How often, at even intervals, the best roughness of every region is looked for (`specular_fit.of_regions`)."""
    solve_albedo: bool = False
    """Whether the albedo is solved from the photographs in the end, in absolute colour (`albedo_solve.solved`)."""
    pose_model: Literal["tangents", "network"] = "tangents"
    """Corrections of the poses, as in stage 2. network: that of stage 2 goes on, or a new one if it had none."""
    weights: Weights = field(default_factory=Weights)
    rates: Rates = field(default_factory=Rates)


@dataclass(frozen=True)
class Inputs:
    """Inputs of stage 3: a capture and the result of stage 2."""

    capture: Capture
    refined: Refined


def length(cfg: Config, inputs: Inputs) -> int:
    """Number of steps."""
    return cfg.steps


@threads_for_kernels()
def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """The first state: material and light of stage 2, with traced visibility, and what `choose_start` makes of it."""
    refined = inputs.refined
    albedo = refined.albedo if cfg.start == "stage 2" else refined.albedo.mean().expand_as(refined.albedo)
    # One factor for all channels, since a channel of a saturated object is rightly dark.
    factor = cfg.initial_albedo / albedo.amax(-1).quantile(0.95)
    albedo = (albedo * factor).clamp(*ALBEDO_RANGE)
    light = sh_lighting.environment(refined.light, cfg.rows)
    material = Material.constant(len(albedo), torch.full_like(albedo[0], 0.5), cfg.roughness)
    scale = refined.light.log_specular_scale + factor.log()
    params = Params(
        gaussians=refined.gaussians,
        gamma=refined.gamma,
        material=material.with_albedo(albedo[:, None].repeat(1, 4, 1)),
        environment=Environment.from_radiance(light.radiance / factor),
        poses=albedo.new_zeros(len(refined.trajectory), 6),
        log_specular_scale=(scale if cfg.rates.specular_scale else torch.zeros_like(scale)).repeat(3),
        roughness_shift=torch.zeros_like(scale),
        pose_network=_first_network(cfg, refined, rng),
    )
    params = optim.leaves(params)
    sets = [fibonacci_sphere(cfg.directions).to(albedo) @ random_rotation(rng).to(albedo).T for _ in range(cfg.sets)]
    rates = learning_rates(cfg, params.material)
    state = State(0, params, optim.adam(params, rates), rng, {"directions": torch.stack(sets)})
    _trace_visibility(cfg, inputs, state)
    return choose_start(cfg, inputs, state) if cfg.try_matte else state


def blank(cfg: Config, inputs: Inputs, rng: torch.Generator, names: Collection[str]) -> State:
    """A state with leaves of these names for those of a checkpoint, which has all that `init` traces and tries out."""
    state = init(replace(cfg, visibility=False, try_matte=False), inputs, rng)
    if "material.metal_logits" in names:
        state.params = optim.leaves(with_metal(state.params, state.params.gaussians.means[:, 0] > 0))
        state.optimizer = optim.adam(state.params, learning_rates(cfg, state.params.material))
    return state


def choose_start(cfg: Config, inputs: Inputs, state: State) -> State:
    """The state after the first steps with or without a specular lobe, as metal where it may be, and with a contrast of
    the albedo, whichever explains the frames better by then.

    Albedos make up for a change of the lobe, so that neither is ahead, and both take the same steps with their own
    light. A lobe, also that of metal, which explains less than `MIN_EXPLAINED` of the error compensates for errors of
    light and shape. One that is brighter than that of a dielectric and than in stage 2 would compensate for them, too.
    So does the albedo of stage 2 where an object has little texture: its contrast is halved for as long as that
    explains the frames better.
    """
    params, coarse = state.params, _coarse(cfg, inputs)
    before = params.log_specular_scale.detach().exp()
    samples = _samples(cfg, inputs, state, state.rng, (cfg.roughness,))[0]
    fitted = specular_fit.fit(samples, len(params.gaussians.means))
    scale = min(fitted.specular_scale, max(1.0, float(before.mean())))
    glossy = with_lobe(params, (before - scale) * fitted.albedo_per_scale, math.log(scale))
    matte = with_lobe(params, before * fitted.albedo_per_scale, NO_LOBE)
    (best, error), (without, error_without) = (_trial(cfg, coarse, state, start) for start in (glossy, matte))
    start, limit = glossy, min(error, (1 - MIN_EXPLAINED) * error_without)
    if error > limit:
        best, error, start = without, error_without, matte
    if cfg.rates.metalness:
        regions = specular_fit.metal_regions(fitted, params.gaussians.means)
        if float(regions[samples.gaussian].float().mean()) > MIN_METAL:
            metal = with_metal(glossy, regions)
            metallic, error_of_metal = _trial(cfg, coarse, state, metal)
            if error_of_metal < limit:
                best, error, start = metallic, error_of_metal, metal
    for _ in range(MAX_HALVINGS):
        start = with_half_the_contrast(start)
        flatter, error_of_flatter = _trial(cfg, coarse, state, start)
        if error_of_flatter >= error:
            break
        best, error = flatter, error_of_flatter
    return best


def _coarse(cfg: Config, inputs: Inputs) -> Inputs:
    """Inputs with images of half the side, as often as that leaves twice `Config.side`; geometry is fixed in trials."""
    while cfg.side and min(inputs.capture.camera.height, inputs.capture.camera.width) >= 4 * cfg.side:
        inputs = replace(inputs, capture=inputs.capture.halved())
    return inputs


def _trial(cfg: Config, inputs: Inputs, before: State, start: Params) -> tuple[State, float]:
    """The state after the first steps from other parameters, and the mean photometric term in their second half.

    Geometry and the resolution of the light stay as they are, so that visibility does, too.
    """
    steps = max(1, min(cfg.steps // 3, TRIAL_STEPS))
    cfg = replace(cfg, warmup=steps, doublings=0, region_trials=0)
    params, rng = optim.leaves(start), torch.Generator()
    rng.set_state(before.rng.get_state())
    state = State(0, params, optim.adam(params, learning_rates(cfg, params.material)), rng, dict(before.memory))
    errors = []
    with graph.steps(sys.modules[__name__], cfg, inputs, state) as steps_on:
        for state.step in range(steps):  # a replay overwrites what the last one returned
            errors.append(torch.as_tensor(steps_on(cfg, inputs, state)["render"]).clone())
    state.step = steps
    return state, float(torch.stack(errors[steps // 2 :]).mean())


@torch.no_grad()
def _samples(
    cfg: Config, inputs: Inputs, state: State, rng: torch.Generator, roughnesses: tuple[float, ...]
) -> list[specular_fit.Samples]:
    """Pixels of the object in several frames with both lobes under the current light, for each of the roughnesses."""
    params, capture, parts = state.params, inputs.capture, []
    n = pixels_per_step(cfg.pixels, cfg.side, capture.camera)
    bounce, light = _bounce(cfg, state, params, corner_features(params.material)[1]), prefilter(params.environment)
    for frame in range(0, len(capture), -(-len(capture) // FIT_FRAMES)):
        T_cam_obj = pose(params, inputs, frame)
        view = render_gbuffer(params, T_cam_obj, capture.camera)
        truth = target_view(capture, frame, view.alpha)
        inner = -max_pool2d(-truth.mask[None], 3, 1, 1)[0]  # pixels at the contour contain background
        pixels = sample_pixels(FIT_PIXELS * n, view.alpha, inner > 0.5, rng)
        points = surface(view, T_cam_obj, capture.camera, pixels=pixels[pixels >= 0])
        gaussian, photo = _dominant_gaussian(view, points), linear_from_srgb(points.sample(truth.image))
        visible = _pixel_visibility(cfg, state, params, points, gaussian)
        lit = (light, inputs.refined.trajectory.R_env_obj_at(frame, T_cam_obj), visible)
        rough = (torch.full_like(points.normals[:, :1], x) for x in roughnesses)
        lobes = [split_lobes(points, x, *lit, bounce=bounce) for x in rough]
        specular = DIELECTRIC * torch.stack([x.specular for x in lobes], 1)
        parts.append((gaussian, lobes[0].diffuse, specular, photo))
    gaussian, diffuse, specular, photo = (torch.cat(x) for x in zip(*parts, strict=True))
    return [specular_fit.Samples(gaussian, diffuse, x, photo) for x in specular.unbind(1)]


@torch.no_grad()
def _find_regions(cfg: Config, inputs: Inputs, state: State) -> None:
    """Give every region its own best roughness when it is due and regions differ.

    Descent finds the roughness of an object, but hardly leaves it for that of a part (docs/experiments/materials.md).
    The mean over the pixels stays as it is: that with the least error of all of them together is biased by the blurred
    light.
    """
    due = [cfg.steps * i // (cfg.region_trials + 1) for i in range(1, cfg.region_trials + 1)]
    params, material = state.params, state.params.material
    if state.step not in due or material.metal_logits is not None or (params.log_specular_scale <= NO_LOBE).all():
        return
    scale = params.log_specular_scale.exp() * material.f0 / DIELECTRIC
    rng = torch.Generator().manual_seed(state.step)  # the numbers of the steps do not depend on the trial
    samples = _samples(cfg, inputs, state, rng, specular_fit.ROUGHNESSES)
    samples = [replace(x, specular=scale * x.specular) for x in samples]
    before = material.roughness_logits.mean(1)
    logits = specular_fit.of_regions(samples, params.gaussians.means, material.albedo.mean(1), before)
    if logits is not None:
        material.roughness_logits.copy_(logits[:, None])


def _learns_network(cfg: Config) -> bool:
    """Whether a network corrects the poses."""
    return cfg.pose_model == "network" and cfg.rates.poses != 0


def _first_network(cfg: Config, refined: Refined, rng: torch.Generator) -> dict[str, Tensor]:
    """The network of stage 2, or a new one if it had none; empty if no network corrects the poses."""
    if not _learns_network(cfg):
        return {}
    return refined.pose_network or pose_network.initial(len(refined.trajectory), refined.albedo, rng)


def learning_rates(cfg: Config, material: Material) -> dict[str, float]:
    """Learning rates by name prefix of the parameters."""
    rates, learned = cfg.rates, _learns_network(cfg)
    of_metal = {} if material.metal_logits is None else {"material.metal_logits": rates.metalness}
    of_network = {"pose_network": rates.poses} if learned else {}
    return {
        "material.albedo_logits": rates.albedo,
        "material.roughness_logits": rates.roughness,
        "roughness_shift": rates.roughness_shift,
        "material.normal_offset": rates.normal,
        "material.f0_logit": 0.0,
        "environment": rates.light,
        "gaussians.means": rates.means,
        "gaussians.quats": rates.quats,
        "gaussians.log_scales": rates.log_scales,
        "gaussians.sdf": rates.sdf,
        "gaussians.sh": 0.0,
        "gamma": 0.0,
        "poses": 0.0 if learned else rates.poses,
        "log_specular_scale": rates.specular_scale,
        **of_metal,
        **of_network,
    }


def _caches_visibility(cfg: Config) -> bool:
    """Whether shadows or indirect light need the visibility of every Gaussian."""
    return cfg.visibility and (cfg.shadows == "cached" or cfg.bounce == "frame")


@torch.no_grad()
def _trace_visibility(cfg: Config, inputs: Inputs, state: State) -> None:
    """Trace the visibility of all Gaussians from their surface points and store it, with the geometry, in the state."""
    if not _caches_visibility(cfg):
        return
    params, gaussians = state.params, state.params.gaussians
    poses = [pose(params, inputs, frame) for frame in range(len(inputs.capture))]
    state.memory |= {f"traced.{name}": x.detach().clone() for name, x in tree.named_tensors(gaussians).items()}
    state.memory["traced.points"] = surface_points(gaussians, params.gamma, poses, inputs.capture.camera)
    traced = _visibility_of_traced(cfg, state)
    state.memory["bits"] = torch.stack([v.bits for v in traced])
    if cfg.bounce != "none":
        state.memory["transfer"] = transfer(traced, gaussians.normals)
        state.memory[BLOCKERS] = torch.stack([v.blocker for v in traced if v.blocker is not None])


def _traced_gaussians(state: State) -> Gaussians:
    """The geometry of which visibility was last traced."""
    return Gaussians(*(state.memory[f"traced.{name}"] for name in tree.named_tensors(state.params.gaussians)))


def _visibility_of_traced(cfg: Config, state: State) -> list[Visibility]:
    """Visibility of the traced geometry, for each set of directions."""
    gaussians, points = _traced_gaussians(state), state.memory["traced.points"]
    tracer, blockers = build_tracer(gaussians, state.params.gamma), cfg.bounce != "none"
    return [visibility(tracer, points, gaussians.normals, x, blockers=blockers) for x in state.memory["directions"]]


def _retrace_if_moved(cfg: Config, inputs: Inputs, state: State) -> None:
    """Trace visibility again when geometry has moved by about the width of a shadow's edge since the last time."""
    if not _caches_visibility(cfg) or state.step < cfg.warmup or state.step % DISPLACEMENT_CHECK_EVERY:
        return
    if displacement(_traced_gaussians(state), state.params.gaussians) > MAX_DISPLACEMENT:
        _trace_visibility(cfg, inputs, state)


def pose(params: Params, inputs: Inputs, frame: Index) -> SE3:
    """`T_cam_obj` of one frame."""
    base = inputs.refined.trajectory.T_cam_obj.at(frame)
    if not params.poses.requires_grad and not params.pose_network:
        return base
    return pose_network.correction(params.poses, params.pose_network, frame, before=inputs.refined.pose_network) @ base


@threads_for_kernels()
def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """One optimisation step on random pixels of a random frame; the weighted loss terms."""
    return advance(cfg, inputs, state, prepare(cfg, inputs, state))


def can_be_recorded(cfg: Config) -> bool:
    """Whether `advance` never waits for the device: a hierarchy to trace shadows in is built with its values."""
    return cfg.shadows == "cached" or not cfg.visibility


def prepare(cfg: Config, inputs: Inputs, state: State) -> PixelNumbers:
    """A finer light, visibility and learning rates where they are due, and the numbers of the next step."""
    assert state.optimizer is not None, "init makes one"
    _upsample_light(cfg, state)
    _retrace_if_moved(cfg, inputs, state)
    _find_regions(cfg, inputs, state)
    decayed = cfg.rates.decay ** (state.step / cfg.steps)
    later = decayed * (state.step >= cfg.warmup)
    optim.anneal(state.optimizer, {"": decayed, "gaussians": later, "poses": later, "pose_network": later})
    frame = int(torch.randint(len(inputs.capture), (1,), generator=state.rng))
    place = float(torch.rand((), generator=state.rng))
    return PixelNumbers(frame, place, state.step % cfg.sets, state.step < cfg.warmup)


def advance(cfg: Config, inputs: Inputs, state: State, numbers: PixelNumbers) -> dict[str, Tensor | float]:
    """One optimisation step on some pixels of one frame; replaces no tensor of the state."""
    assert state.optimizer is not None, "init makes one"
    params, capture, frame = state.params, inputs.capture, numbers.frame
    if numbers.is_fixed:
        # This saves half of the rasterizer's backward pass.
        fixed = {"gaussians": tree.detach(params.gaussians), "poses": params.poses.detach()}
        params = replace(params, **fixed, pose_network={})
    T_cam_obj = pose(params, inputs, frame)
    corners, mean_albedo = corner_features(shifted_material(params if cfg.corners else without_corners(params)))
    view = rasterize_material(params, corners, T_cam_obj, capture.camera)
    photo, mask = (entry(x, frame).to(view.alpha.device) for x in (capture.images, capture.masks))
    n = pixels_per_step(cfg.pixels, cfg.side, capture.camera)
    pixels = pixels_at(numbers.place, n, view.alpha, mask == OBJECT)
    R_env_obj = inputs.refined.trajectory.R_env_obj_at(frame, T_cam_obj)
    shown = _Shown(view, pixels, photo, T_cam_obj, R_env_obj, numbers.current)
    of_view = losses.material_terms(view, photo, mask)
    terms = {
        "render": _render_term(cfg, state, params, shown, capture.camera, mean_albedo),
        "light": cfg.weights.light * _light_smoothness(cfg, params.environment),
        "mask": cfg.weights.mask * of_view["mask"],
        "material": cfg.weights.material * of_view["material"],
        "specular": cfg.weights.specular * (1 - (-params.log_specular_scale.exp().mean() / PENALTY_SCALE).exp()),
    }
    optim.descend(torch.stack(list(terms.values())).sum(), state.optimizer, step=state.step)
    return {name: value.detach() for name, value in terms.items()}


def _light_smoothness(cfg: Config, light: Environment) -> Float[Tensor, ""]:
    """The smoothness term of the environment map before its weight."""
    return losses.light_smoothness(light.log_radiance if cfg.smooth_light == "log radiance" else light.radiance)


@dataclass(frozen=True)
class _Shown:
    """A view of a step and the pixels that it compares with the input image."""

    view: Buffers
    """View by `rasterize_material`."""
    pixels: Int64[Tensor, " p"]
    """Pixels, counted row by row; negative ones do not count."""
    photo: UInt8[Tensor, "h w 3"]
    """Input image, sRGB."""
    T_cam_obj: SE3
    R_env_obj: Float[Tensor, "3 3"]
    current: Index
    """Set of directions."""


def _render_term(
    cfg: Config, state: State, params: Params, shown: _Shown, camera: Camera, mean_albedo: Float[Tensor, "n 3"]
) -> Float[Tensor, ""]:
    """The photometric term: mean absolute difference between shaded pixels and the input image.

    A kernel computes it for lobes, shadows and indirect light as in our recipes (`losses.shading_term`).
    """
    f0 = params.material.f0 * params.log_specular_scale.exp()
    bounce = _bounce(cfg, state, params, mean_albedo)
    light = prefilter(params.environment) if cfg.lobes == "split" else None
    has_kernel = cfg.visibility and cfg.shadows == "cached" and params.material.metal_logits is None
    if has_kernel and light is not None and not light.is_finer and not isinstance(bounce, AveragedBounce):
        shading = shading_light(light, _cached_visibility(cfg, state, shown.current), bounce)
        pose = (shown.T_cam_obj, shown.R_env_obj)
        return losses.shading_term(shown.view, shown.pixels, shown.photo, camera, *pose, shading, f0)
    view, pixels = with_offset(shown.view), shown.pixels.clamp_min(0)
    points = surface(view, shown.T_cam_obj, camera, pixels=pixels)
    albedo, rough, _ = points.sample(view.features["material"]).split([3, 1, 3], -1)
    metalness = points.sample(view.features["metalness"]) if "metalness" in view.features else None
    visible = _pixel_visibility(cfg, state, params, points, _dominant_gaussian(view, points), shown.current)
    material, lit = (points, albedo, rough), (shown.R_env_obj, visible)
    if light is None:
        shaded = shade(*material, params.environment, *lit, f0=f0, bounce=bounce)
    else:
        shaded = shade_split(*material, light, *lit, f0=f0, bounce=bounce, metalness=metalness)
    rendered, wanted = (shaded * points.sample(view.alpha[..., None])), points.sample(shown.photo).to(albedo) / 255
    error = (losses.srgb_as_captured(rendered[None], wanted[None]) - wanted).abs()[0]
    return (error * (shown.pixels >= 0)[:, None]).mean()


def _dominant_gaussian(view: Buffers, points: Surface) -> Tensor:
    """Index of the Gaussian with the largest blending weight at each point."""
    return view.dominant.flatten()[points.pixels].clamp_min(0).long()


def _bounce(cfg: Config, state: State, params: Params, albedo: Float[Tensor, "n 3"]) -> Bounce | AveragedBounce | None:
    """Indirect light as chosen by the settings, None for none; `albedo` is the mean of each Gaussian's corners."""
    if cfg.bounce == "none" or not cfg.visibility:
        return None
    if cfg.bounce == "average":
        return AveragedBounce(params.gaussians.sh[:, 0] / math.sqrt(4 * math.pi))
    metalness = params.material.metalness
    return Bounce(albedo if metalness is None else albedo * (1 - metalness[:, None]), state.memory["transfer"])


def _pixel_visibility(
    cfg: Config, state: State, params: Params, points: Surface, index: Tensor, current: Index = 0
) -> Visibility:
    """Visibility of pixels for one set of directions: of their points, or of the Gaussians `index`."""
    directions = entry(state.memory["directions"], current)
    if not cfg.visibility:
        return unoccluded(directions, len(index))
    if cfg.shadows == "traced":
        tracer = build_tracer(params.gaussians, params.gamma)
        at = (points.points.detach(), points.normals.detach(), directions)
        return visibility(tracer, *at, blockers=cfg.bounce != "none")
    return _cached_visibility(cfg, state, current).gather(index)


def _cached_visibility(cfg: Config, state: State, current: Index = 0) -> Visibility:
    """Visibility of all Gaussians for one set of directions, as it was last traced."""
    memory = state.memory
    directions, bits = (entry(memory[name], current) for name in ("directions", "bits"))
    if cfg.bounce == "none":
        return Visibility(directions, bits, None)
    if BLOCKERS not in memory:  # after a checkpoint was read
        memory[BLOCKERS] = torch.stack([v.blocker for v in _visibility_of_traced(cfg, state) if v.blocker is not None])
    return Visibility(directions, bits, entry(memory[BLOCKERS], current))


def _upsample_light(cfg: Config, state: State) -> None:
    """Double the environment map's resolution when it is due, and the optimizer's moments with it."""
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


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Asset:
    """The relightable asset."""
    params = absorbed(state.params if cfg.corners else without_corners(state.params))
    before, trajectory = inputs.refined.pose_network, inputs.refined.trajectory
    corrections = pose_network.correction(params.poses, params.pose_network, slice(None), before=before)
    return Asset(
        gaussians=params.gaussians,
        gamma=params.gamma,
        material=params.material,
        environment=params.environment,
        trajectory=replace(trajectory, T_cam_obj=corrections @ trajectory.T_cam_obj),
        camera=inputs.capture.camera,
    )
