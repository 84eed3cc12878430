"""Stage 1, the progressive way: follow the object frame by frame while its coarse shape grows (section 4.1; FMOV).

Frames join in turn. A frame begins with the pose of the one before; first its pose alone is fitted to the shape so far,
then pose and shape together. When the object has turned far since the shape was begun, the shape starts over as a
sphere and is fitted to all frames so far, whose poses stay. Poses (`posenets.orbit`) are found in the aim frame of
`virtual_camera`, which looks at the object in each frame.

On purpose unlike the paper and FMOV:
- The virtual camera turns rays, not pictures: exact, and photographs are not resampled (FMOV shifts pictures).
- The match term is divided by the weights' sum, weighted by confidence, and robust (FMOV's pulls weights to zero).
- The shape is frozen while a pose alone is fitted, as the paper says (FMOV's code trains it).
- Poses have all six degrees of freedom (so have FMOV's in its second phase). The paper's four hold the object's centre
  to the middle of its silhouette's box; a box that turns by ten degrees moves by 0.04 radii against it, which looks
  like four degrees of turn. On a shape that is right, errors then grow to 14 degrees in ten frames; with six, to 2.
- Rays are cut inside a ball (`neus.sections`); the first frame's pose never moves, it is the gauge.
- The first distance is that of the largest silhouette of all frames, not of the first: an object that is first seen
  end-on does not outgrow the ball.
"""

import functools
import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.engine import State, optim
from tumble.io import tree
from tumble.maths import SE3, SO3, angle_between, iou
from tumble.poses.progressive import neus, pose_networks, ray_sampling, sdf_field, virtual_camera
from tumble.poses.progressive.neus import Glimpse, Rendered
from tumble.poses.progressive.pose_networks import PoseSource
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.sdf_field import Fields, Sdf, Sizes
from tumble.poses.progressive.virtual_camera import Aim
from tumble.scene import OBJECT, Capture, Match

VERSION = 3
OBJECT_PIXELS = 160
"""Match residuals are in pixels of a frame in which the object has this diameter, about that of HO3D at 640 x 480, for
which FMOV's weight was chosen: frames of all sizes are then alike."""
HEALTH_RAYS = 512
"""Pixels that a frame's health is measured at."""


Phase = Literal["shape", "pose", "joint"]


@dataclass(frozen=True)
class Phases:
    """Steps of each phase."""

    shape: int
    pose: int
    joint: int


@dataclass(frozen=True)
class Place:
    """Where in the schedule a step is."""

    turn: int
    """Frames tracked before this one."""
    phase: Phase
    progress: float
    """Of the phase, in [0, 1)."""
    tracked: float
    """Share of this frame's tracking that is done, in [0, 1)."""
    first: bool
    """The first step of the frame's tracking."""
    last: bool
    """The last step of the turn."""


def n_steps(phases: Phases, n_frames: int) -> int:
    """Steps of all turns."""
    return n_frames * phases.shape + (n_frames - 1) * (phases.pose + phases.joint)


def place(phases: Phases, step: int) -> Place:
    """What step number `step` is for."""
    tracking = phases.pose + phases.joint
    if step < phases.shape:
        return Place(0, "shape", step / phases.shape, 0.0, first=False, last=step == phases.shape - 1)
    turn, at = divmod(step - phases.shape, phases.shape + tracking)
    if at < phases.shape:
        return Place(turn + 1, "shape", at / phases.shape, 0.0, first=False, last=False)
    at -= phases.shape
    phase, before, of = ("pose", 0, phases.pose) if at < phases.pose else ("joint", phases.pose, phases.joint)
    return Place(turn + 1, phase, (at - before) / of, at / tracking, first=at == 0, last=at == tracking - 1)


def order(start: int, n_frames: int) -> list[int]:
    """Frames as they are tracked: forward from the first one, then backward from it."""
    return [*range(start, n_frames), *range(start - 1, -1, -1)]


@dataclass(frozen=True)
class Weights:
    """Eq. of section 4.1; values from appendix A, stage 1."""

    render: float = 1.0
    eikonal: float = 0.1
    mask: float = 5.0
    match: float = 0.1


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates."""

    poses: float = 5e-4
    """Appendix A, for networks; plain vectors want more."""
    poses_decay: float = 0.5
    """Share of it at the end of a frame, along a cosine (FMOV)."""
    fields: float = 5e-4
    """NeuS."""
    sharpness: float = 5e-4
    """NeuS."""
    ramp: int = 5000
    """Steps over which the networks' rates rise after each start of the shape (FMOV)."""


@dataclass(frozen=True)
class Config:
    """Paper values where it states them (appendix A, stage 1), else those of FMOV, whose settings it follows."""

    poses: Literal["mlps", "vectors"] = "mlps"
    """mlps: a network per frame; vectors: six numbers per frame."""
    motion: Literal["still", "steady"] = "still"
    """How a frame begins: still: as the one before; steady: turned as much again as that one was."""
    start: Literal["first", "largest"] = "first"
    """The frame to begin with; from the largest silhouette on, it goes both ways in time."""
    sizes: Sizes = field(default_factory=Sizes)
    samples: int = 32
    """Sections per ray. Appendix A."""
    warmup: int = 100
    """Steps of the shape alone, at its starts. Appendix A."""
    pose_steps: int = 500
    """Steps per frame for its pose alone. Appendix A."""
    joint_steps: int = 500
    """Steps per frame for poses and shape. Appendix A."""
    rays: int = 512
    """Per step, of one frame (FMOV)."""
    old_rays: int = 512
    """Per step, of an older frame, to keep the shape (FMOV)."""
    match_rays: int = 256
    """Correspondences per step; two rays each, taken from `rays` (FMOV)."""
    match_share: float = 0.5
    """Share of steps with correspondences (FMOV)."""
    window: int = 10
    """Newest frames that rays and matches are drawn from (FMOV)."""
    newest: float = 0.8
    """Share of joint steps that look at the newest frame (FMOV)."""
    inside: float = 0.7
    """Share of steps whose rays stay near the mask's bounding box (FMOV)."""
    margin: float = 0.05
    """What "near" is [picture widths] (FMOV: 30 of 640 pixels)."""
    block: int = 1
    """Pixels averaged per ray, squared side, in the first half of each phase; single ones follow."""
    huber: float = 4.0
    """Match residual from which an error counts linearly [pixels, see OBJECT_PIXELS]. Not in the paper."""
    reset: float = 60.0
    """Turn since the start of the shape from which it is started over [degrees] (FMOV)."""
    fill: float = 0.9
    """Radius of the largest silhouette [object radius] (FMOV)."""
    bound: float = 1.1
    """Radius of the ball that holds the object [object radius]."""
    weights: Weights = field(default_factory=Weights)
    rates: Rates = field(default_factory=Rates)

    @property
    def phases(self) -> Phases:
        """Of every turn."""
        return Phases(self.warmup, self.pose_steps, self.joint_steps)


@dataclass(frozen=True)
class Inputs:
    """A capture without poses, and what its frames have in common."""

    capture: Capture
    matches: tuple[Match, ...]
    """Positions in the capture's own frames."""
    aim: Aim


@dataclass(frozen=True)
class Params:
    """What stage 1 trains."""

    fields: Fields
    poses: PoseSource


@dataclass(frozen=True)
class FrameFit:
    """How well each frame fitted when it had been tracked; a frame of bad numbers is probably lost."""

    match: Float[Tensor, " t"]
    """Median match residual [pixels, see OBJECT_PIXELS]; infinite without matches."""
    iou: Float[Tensor, " t"]
    """Of rendered and given silhouette, over drawn pixels."""
    colour: Float[Tensor, " t"]
    """Mean absolute difference to the photograph on the object, sRGB."""


@dataclass(frozen=True)
class ProgressiveResult:
    """The outcome of stage 1."""

    T_aim_obj: SE3
    """Object to virtual camera, one per frame [object radius]."""
    aim: Aim
    sdf: Sdf
    """The last shape: of all frames, but best of those since its start."""
    fit: FrameFit


def length(cfg: Config, inputs: Inputs) -> int:
    """Every frame has room to start the shape over; the steps are skipped where that is not needed."""
    return n_steps(cfg.phases, len(inputs.capture))


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """A sphere, and all frames where the first one starts."""
    n, like = len(inputs.capture), inputs.capture.camera.fx_fy_cx_cy
    reach = torch.stack([_reach(inputs, frame) for frame in range(n)])
    start = 0 if cfg.start == "first" else int(reach.argmax())
    base = SE3.identity((n,), dtype=like.dtype, device=like.device)
    base = SE3(base.wxyz, torch.stack([0 * reach, 0 * reach, (cfg.fill / reach.max()).expand(n)], -1))
    source = pose_networks.vectors(n, 6) if cfg.poses == "vectors" else pose_networks.frame_mlps(n, 6, rng)
    params = optim.leaves(tree.to(Params(sdf_field.sphere(cfg.sizes, rng), source), like.device))
    rates = {"fields": cfg.rates.fields, "fields.log_sharpness": cfg.rates.sharpness, "poses": cfg.rates.poses}
    # The gauge: the first frame's pose stays as it is.
    rates[f"poses.values.{start}"] = 0.0
    if cfg.poses == "mlps":
        rates["poses.codes"] = 0.0
    memory = {
        "base": torch.cat([base.wxyz, base.xyz], -1),
        "health": torch.full((n, 3), math.inf).to(like),
        "start": torch.tensor(start),
        "began": torch.tensor(0),
        "age": torch.tensor(0),
    }
    return State(0, params, optim.adam(params, rates), rng, memory)


def _reach(inputs: Inputs, frame: int) -> Float[Tensor, ""]:
    """How far a silhouette goes from the middle of the virtual frame [1 / distance]."""
    capture = inputs.capture
    uv = capture.camera.pixel_centers()[capture.masks[frame] == OBJECT]
    if not len(uv):
        return capture.camera.fx_fy_cx_cy.new_tensor(0.0)
    x_aim = inputs.aim.R_cam_aim[frame].inverse() @ capture.camera.unproject(uv, torch.ones_like(uv[:, 0]))
    return (x_aim[:, :2] / x_aim[:, 2:]).norm(dim=-1).max()


def poses(params: Params, memory: dict[str, Tensor], frames: list[int]) -> SE3:
    """`T_aim_obj` of some frames."""
    base = memory["base"][frames]
    return pose_networks.orbit(SE3(base[:, :4], base[:, 4:]), pose_networks.raw(params.poses, frames))


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    assert state.optimizer is not None, "init makes one"
    here, memory = place(cfg.phases, state.step), state.memory
    frames = order(int(memory["start"]), len(inputs.capture))
    # memory["began"] says in which turn the shape was begun; it is not begun anew unless that is this turn.
    if here.phase == "shape" and int(memory["began"]) != here.turn:
        return {}
    if here.first:
        _join(cfg, state, frames, here.turn)
    known = frames[: max(1, here.turn)] if here.phase == "shape" else frames[: here.turn + 1]
    terms = _terms(cfg, inputs, state, here, known)
    optim.anneal(state.optimizer, _rates(cfg, here, memory))
    optim.descend(torch.stack(list(terms.values())).sum(), state.optimizer, step=state.step)
    if here.phase != "pose":
        memory["age"] += 1
    if here.last:
        _close(cfg, inputs, state, frames, here.turn)
    return {name: value.detach() for name, value in terms.items()} | {"frame": float(here.turn)}


def _rates(cfg: Config, here: Place, memory: dict[str, Tensor]) -> dict[str, float]:
    cosine = 0.5 * (1 + math.cos(math.pi * here.tracked))
    ramp = min(1.0, (int(memory["age"]) + 1) / max(1, cfg.rates.ramp))
    return {"poses": cfg.rates.poses_decay + (1 - cfg.rates.poses_decay) * cosine, "fields": ramp}


@torch.no_grad()
def _join(cfg: Config, state: State, frames: list[int], turn: int) -> None:
    """Let a frame begin where its neighbour in time ended, or where that one was going."""
    frame = frames[turn]
    back = -1 if frame > frames[0] else 1
    past = poses(state.params, state.memory, [frame + back, (frame + 2 * back) % len(frames)])
    T_aim_obj = past[0]
    if cfg.motion == "steady" and frame + 2 * back in frames[:turn]:
        R_before_last = past[1].rotation.inverse() @ past[0].rotation
        T_aim_obj = SE3((past[0].rotation @ R_before_last).wxyz, past[0].xyz)
    # Three past rotations in one: what rounding does to a quaternion's length would grow by 2.4 with every frame.
    state.memory["base"][frame] = torch.cat([SO3.from_wxyz(T_aim_obj.wxyz).wxyz, T_aim_obj.xyz], -1)


@torch.no_grad()
def _close(cfg: Config, inputs: Inputs, state: State, frames: list[int], turn: int) -> None:
    """Note how well a frame fits, and start the shape over when the object has turned far since its start."""
    memory = state.memory
    memory["health"][frames[turn]] = _health(cfg, inputs, state, frames[: turn + 1])
    pair = poses(state.params, memory, [frames[turn], frames[max(0, int(memory["began"]) - 1)]]).rotation
    if turn + 1 == len(frames) or float(angle_between(pair[0], pair[1])) < math.radians(cfg.reset):
        return
    memory["began"], memory["age"] = torch.tensor(turn + 1), torch.tensor(0)
    fresh = tree.named_tensors(sdf_field.sphere(cfg.sizes, state.rng))
    for name, leaf in tree.named_tensors(state.params.fields).items():
        leaf.copy_(fresh[name])
        assert state.optimizer is not None
        state.optimizer.state.pop(leaf, None)


# What a step looks at -------------------------------------------------------------------------------------------------


def _terms(cfg: Config, inputs: Inputs, state: State, here: Place, known: list[int]) -> dict[str, Tensor]:
    match = _draw_match(cfg, inputs, state, here, known)
    n_rays = cfg.rays if match is None else max(0, cfg.rays - 2 * cfg.match_rays)
    views: list[tuple[int, bool, Pixels]] = []
    if n_rays:
        main = _draw_main(cfg, state, here, known) if match is None else match.i
        views.append((main, here.phase != "shape", _draw(cfg, inputs, state, here, main, n_rays)))
    if here.phase != "pose" and cfg.old_rays:
        older = known[: -cfg.window] or known
        frame = known[0] if here.phase == "shape" else older[_pick(state, len(older))]
        views.append((frame, False, _draw(cfg, inputs, state, here, frame, cfg.old_rays)))
    if match is not None:
        for frame, uv in ((match.i, match.uv_i), (match.j, match.uv_j)):
            at = ray_sampling.at(inputs.capture, inputs.aim, frame, uv)
            views.append((frame, here.phase == "joint" or frame == known[-1], at))
    glimpses = [_glimpse(state, frame, part, moves=moves) for frame, moves, part in views]
    net = tree.detach(state.params.fields) if here.phase == "pose" else state.params.fields
    seen = neus.look(net, glimpses, cfg.samples, bound=cfg.bound, rng=state.rng)
    shown = functools.reduce(Pixels.__add__, (glimpse.pixels for glimpse in glimpses))
    terms = {
        "render": cfg.weights.render * neus.colour_error(seen, shown),
        "mask": cfg.weights.mask * neus.mask_error(seen, shown),
    }
    if here.phase != "pose":
        terms["eikonal"] = cfg.weights.eikonal * neus.eikonal(seen)
    if match is not None:
        residual, weight = _match_residual(inputs, seen, (glimpses[-2].T_aim_obj, glimpses[-1].T_aim_obj), match)
        terms["match"] = cfg.weights.match * neus.robust(residual, weight, threshold=cfg.huber)
    return terms


def _glimpse(state: State, frame: int, part: Pixels, *, moves: bool) -> Glimpse:
    """Pixels of a frame and its present pose, with a gradient where it `moves`."""
    T_aim_obj = poses(state.params, state.memory, [frame])[0]
    return Glimpse(part, T_aim_obj if moves else tree.detach(T_aim_obj))


def _match_residual(inputs: Inputs, seen: Rendered, T_aim_obj: tuple[SE3, SE3], match: Match) -> tuple[Tensor, Tensor]:
    """Residuals of the last rays, which are the ends of a match, both ways [pixels, see OBJECT_PIXELS]; weights."""
    n, m, camera, capture = len(seen.opacity), len(match), inputs.aim.camera, inputs.capture.camera
    uv_i = virtual_camera.into_aim(inputs.aim, capture, match.i, match.uv_i)
    uv_j = virtual_camera.into_aim(inputs.aim, capture, match.j, match.uv_j)
    there, seen_i = neus.transfer(seen, slice(n - 2 * m, n - m), T_aim_obj[1], camera, uv_j)
    back, seen_j = neus.transfer(seen, slice(n - m, n), T_aim_obj[0], camera, uv_i)
    per_radius = [camera.fx_fy_cx_cy[0] / T.xyz[2].detach() for T in T_aim_obj]
    residual = torch.cat([there / per_radius[1], back / per_radius[0]]) * (OBJECT_PIXELS / 2)
    return residual, torch.cat([seen_i, seen_j]) * match.confidence.repeat(2)


def _draw(cfg: Config, inputs: Inputs, state: State, here: Place, frame: int, n: int) -> Pixels:
    box = (0, 0, inputs.capture.camera.height, inputs.capture.camera.width)
    if float(torch.rand((), generator=state.rng)) < cfg.inside:
        box = ray_sampling.around(inputs.capture, frame, cfg.margin)
    block = cfg.block if here.progress < 0.5 else 1
    return ray_sampling.draw(inputs.capture, inputs.aim, frame, n, box=box, block=block, rng=state.rng)


def _draw_main(cfg: Config, state: State, here: Place, known: list[int]) -> int:
    """The frame that most rays show: the newest one as long as it alone can move."""
    if here.phase == "pose":
        return known[-1]
    if here.phase == "shape" or len(known) <= cfg.window:
        return known[_pick(state, len(known))]
    if float(torch.rand((), generator=state.rng)) < cfg.newest:
        return known[-1]
    return known[-2 - _pick(state, cfg.window - 1)]


def _draw_match(cfg: Config, inputs: Inputs, state: State, here: Place, known: list[int]) -> Match | None:
    """Some correspondences of a frame with another known one not far from it in time; None in other steps."""
    if here.phase == "shape" or float(torch.rand((), generator=state.rng)) >= cfg.match_share:
        return None
    frame = _draw_main(cfg, state, here, known)
    usable = [
        match if match.i == frame else match.reversed()
        for match in inputs.matches
        if frame in (match.i, match.j)
        and len(match)
        and {match.i, match.j} <= set(known)
        and abs(match.i - match.j) <= cfg.window
    ]
    if not usable:
        return None
    match = usable[_pick(state, len(usable))]
    rows = torch.randint(len(match), (cfg.match_rays,), generator=state.rng)
    return match.select(rows.to(match.uv_i.device))


def _pick(state: State, n: int) -> int:
    return int(torch.randint(n, (), generator=state.rng))


# What comes out -------------------------------------------------------------------------------------------------------


def _health(cfg: Config, inputs: Inputs, state: State, known: list[int]) -> Tensor:
    """Match residual, silhouette's IoU and colour error of the newest frame; see `FrameFit`."""
    frame, net = known[-1], state.params.fields
    box = ray_sampling.around(inputs.capture, frame, cfg.margin)
    part = ray_sampling.draw(inputs.capture, inputs.aim, frame, HEALTH_RAYS, box=box, block=1, rng=state.rng)
    glimpse = _glimpse(state, frame, part, moves=False)
    seen = neus.look(net, [glimpse], cfg.samples, bound=cfg.bound, rng=None)
    colour = ((seen.rgb - part.rgb).abs().mean(-1) * part.mask).sum() / part.mask.sum().clamp_min(1)
    residuals = []
    for match in inputs.matches:
        if frame in (match.i, match.j) and {match.i, match.j} <= set(known) and len(match):
            match = match.select(torch.arange(len(match))[:: 1 + len(match) // cfg.match_rays])
            ends = ((match.i, match.uv_i), (match.j, match.uv_j))
            rays = [(f, ray_sampling.at(inputs.capture, inputs.aim, f, uv)) for f, uv in ends]
            at = [_glimpse(state, f, part, moves=False) for f, part in rays]
            met = neus.look(net, at, cfg.samples, bound=cfg.bound, rng=None)
            residual, weight = _match_residual(inputs, met, (at[0].T_aim_obj, at[1].T_aim_obj), match)
            residuals.append(residual.norm(dim=-1)[weight > 0])
    residual = torch.cat(residuals) if residuals else colour.new_zeros(0)
    far = residual.median() if len(residual) else colour.new_tensor(math.inf)
    return torch.stack([far, iou(seen.opacity > 0.5, part.mask > 0.5), colour])


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> ProgressiveResult:
    """Poses in the aim frame; `lift` takes them to the camera's."""
    T_aim_obj = poses(state.params, state.memory, list(range(len(inputs.capture))))
    fit = FrameFit(*state.memory["health"].unbind(-1))
    return ProgressiveResult(T_aim_obj, inputs.aim, tree.detach(state.params.fields.sdf), fit)
