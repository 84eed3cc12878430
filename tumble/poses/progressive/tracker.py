"""Progressive tracking: poses frame by frame while a coarse neural shape is learned (section 4.1; FMOV).

Frames are added one at a time. The initial pose of a frame is that of the frame before. Its pose alone is optimised
against the shape so far, then pose and shape together. When the object has rotated far since the shape was initialised,
the shape is reset to a sphere and trained on all frames so far, whose poses are kept. Poses are parametrised by
`pose_networks.orbit` in the aim frame of `virtual_camera`.

With `Config.motion = Motion(...)` poses come from `registration` instead: the first frames together, before there is a
shape, then every new frame against the shape so far, and at the end all frames in rounds with the shape.

Deliberate differences from the paper and FMOV:
- The virtual camera rotates rays, which is exact and does not resample images (FMOV shifts images).
- The match loss is robust, weighted by confidence, and normalised by the sum of the compositing weights (the gradient
  of FMOV's decreases these weights).
- The shape is frozen while a pose alone is optimised, as in the paper (FMOV's code trains it).
- Poses have six degrees of freedom (as FMOV's in its second phase). The paper's four keep the object's centre at the
  centre of the silhouette's bounding box, which moves relative to the object when it rotates; poses then drift.
- Rays are sampled inside a sphere (`neus.sections`). The first frame's pose is fixed, which removes the gauge freedom.
- The initial distance follows from the largest silhouette of all frames, not from the first one, so that an object
  first visible end-on does not outgrow the sphere.
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
from tumble.poses.progressive import anchors, neus, pose_networks, ray_sampling, registration, sdf_field, virtual_camera
from tumble.poses.progressive.grid_field import Grids
from tumble.poses.progressive.neus import RayBatch, Rendered
from tumble.poses.progressive.pose_networks import PoseSource
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.registration import Motion, Scene
from tumble.poses.progressive.sdf_field import Fields, Sdf, Sizes
from tumble.poses.progressive.virtual_camera import Aim
from tumble.scene import OBJECT, Capture, Match

VERSION = 5
OBJECT_PIXELS = 160
"""Diameter of the object in the frame whose pixels are the unit of match residuals [pixels].

About that of HO3D at 640 x 480, for which FMOV's weight was chosen; the loss is thus independent of the frame size."""
FIT_RAYS = 512
"""Number of pixels at which `FrameFit` is measured, per frame."""

Phase = Literal["shape", "pose", "joint"]


@dataclass(frozen=True)
class Phases:
    """Number of steps of each phase."""

    shape: int
    """Shape alone, after it was initialised."""
    pose: int
    """Pose of the newest frame alone."""
    joint: int
    """Poses and shape."""


@dataclass(frozen=True)
class SchedulePoint:
    """Position of a step in the schedule."""

    index: int
    """Index of the newest frame in the tracking order."""
    phase: Phase
    """Phase of the step."""
    phase_progress: float
    """Fraction of the phase completed, in [0, 1)."""
    frame_progress: float
    """Fraction of the pose and joint phases of the frame completed, in [0, 1)."""
    first: bool
    """Whether this is the first step of the frame's pose and joint phases."""
    last: bool
    """Whether this is the last step of the frame."""


def n_steps(phases: Phases, n_frames: int) -> int:
    """Number of steps for all frames."""
    return n_frames * phases.shape + (n_frames - 1) * (phases.pose + phases.joint)


def schedule_at(phases: Phases, step: int) -> SchedulePoint:
    """Position of step number `step` in the schedule."""
    tracking = phases.pose + phases.joint
    if step < phases.shape:
        return SchedulePoint(0, "shape", step / phases.shape, 0.0, first=False, last=step == phases.shape - 1)
    previous, at = divmod(step - phases.shape, phases.shape + tracking)
    if at < phases.shape:
        return SchedulePoint(previous + 1, "shape", at / phases.shape, 0.0, first=False, last=False)
    at -= phases.shape
    phase, begin, length = ("pose", 0, phases.pose) if at < phases.pose else ("joint", phases.pose, phases.joint)
    return SchedulePoint(
        previous + 1, phase, (at - begin) / length, at / tracking, first=at == 0, last=at == tracking - 1
    )


def tracking_order(start: int, n_frames: int) -> list[int]:
    """Frames in the order of their tracking: forward from `start`, then backward from it."""
    return [*range(start, n_frames), *range(start - 1, -1, -1)]


@dataclass(frozen=True)
class Weights:
    """Weights of the losses of section 4.1; values from appendix A, stage 1."""

    render: float = 1.0
    """Weight of the colour loss."""
    eikonal: float = 0.1
    """Weight of the eikonal loss."""
    mask: float = 5.0
    """Weight of the mask loss."""
    match: float = 0.1
    """Weight of the match loss, of either direction."""


@dataclass(frozen=True)
class Rates:
    """Learning rates of Adam."""

    poses: float = 5e-4
    """Rate of the poses; the default is that of appendix A for networks, vectors need a larger one."""
    poses_decay: float = 0.5
    """Factor on that rate at the end of a frame's tracking, reached along a cosine (FMOV)."""
    fields: float = 5e-4
    """Rate of the networks (NeuS)."""
    sharpness: float = 5e-4
    """Rate of the sharpness (NeuS)."""
    ramp: int = 5000
    """Number of steps of the networks' linear warm-up after each initialisation of the shape (FMOV)."""


@dataclass(frozen=True)
class Config:
    """Settings of the tracker: the paper's where it states them (appendix A, stage 1), else those of FMOV."""

    poses: Literal["mlps", "vectors"] = "mlps"
    """Parametrisation of the poses. mlps: a network per frame; vectors: six numbers per frame."""
    motion: Literal["still", "steady"] | Motion = "still"
    """Initial pose of a frame. still: that of the frame before; steady: rotated on with constant angular velocity; else
    by `registration`."""
    start: Literal["first", "largest", "matched"] = "first"
    """First frame to track: the first in time, that of the largest silhouette, or the first of those with the most
    matches; tracking goes both ways from it."""
    sizes: Sizes = field(default_factory=Sizes)
    """Sizes of the networks."""
    samples: int = 32
    """Number of sections per ray (appendix A)."""
    warmup: int = 100
    """Number of steps for the shape alone, after each of its initialisations (appendix A)."""
    pose_steps: int = 500
    """Number of steps per frame for its pose alone (appendix A)."""
    joint_steps: int = 500
    """Number of steps per frame for poses and shape (appendix A)."""
    closing: int = 0
    """Number of rounds after the last frame: the shape is trained on all frames, then all poses are adjusted to it."""
    closing_steps: int = 0
    """Number of steps of the shape in each of these rounds."""
    rays: int = 512
    """Number of rays per step from a recent frame (FMOV)."""
    old_rays: int = 512
    """Number of rays per step from an older frame, which preserve the shape (FMOV)."""
    match_rays: int = 256
    """Number of correspondences per step; two rays each, taken from `rays` (FMOV)."""
    match_share: float = 0.5
    """Fraction of steps with correspondences (FMOV)."""
    window: int = 10
    """Number of newest frames that rays and matches are drawn from (FMOV)."""
    newest: float = 0.8
    """Fraction of joint steps whose rays are from the newest frame (FMOV)."""
    inside: float = 0.7
    """Fraction of steps whose rays stay in the silhouette's bounding box with `margin` (FMOV)."""
    margin: float = 0.05
    """Margin around the bounding box [image widths]; FMOV uses 30 of 640 pixels."""
    block: int = 1
    """Side of the square averaged per ray in the first half of each phase; 1 in the second half [pixels]."""
    huber: float = 4.0
    """Threshold of the Huber loss on match residuals [pixels, see OBJECT_PIXELS]; not in the paper."""
    reset: float = 60.0
    """Rotation since the initialisation of the shape from which it is reset [degrees] (FMOV)."""
    fill: float = 0.9
    """Radius of the largest silhouette at the initial distance [object radius] (FMOV)."""
    bound: float = 1.1
    """Radius of the sphere that contains the object [object radius]."""
    weights: Weights = field(default_factory=Weights)
    """Weights of the losses."""
    rates: Rates = field(default_factory=Rates)
    """Learning rates."""

    def __post_init__(self) -> None:
        registers = isinstance(self.motion, Motion)
        if registers and self.poses != "vectors":
            raise ValueError('motion=Motion(...) registers frames, whose poses cannot be networks: set poses="vectors"')
        if not registers and (self.closing or self.start == "matched"):
            raise ValueError('closing rounds and start="matched" need a registration: set motion=Motion(...)')
        if self.window < 2:
            raise ValueError(f"window is {self.window}: at least the newest frame and the one before it are needed")
        if not (registers or self.pose_steps + self.joint_steps):
            raise ValueError("without a registration, poses need steps: set pose_steps or joint_steps above 0")

    @property
    def phases(self) -> Phases:
        """Number of steps of each phase of a frame."""
        return Phases(self.warmup, self.pose_steps, self.joint_steps)


@dataclass(frozen=True)
class Inputs:
    """Inputs of the tracker."""

    capture: Capture
    """Frames and masks, without poses."""
    matches: tuple[Match, ...]
    """Correspondences, in pixels of the capture's frames."""
    aim: Aim
    """Virtual camera."""

    @functools.cached_property
    def anchors(self) -> anchors.Anchors:
        """Anchors of all frames, which take seconds."""
        return anchors.gather(self.capture, self.aim, self.matches)


@dataclass(frozen=True)
class Params:
    """Trained parameters."""

    fields: Fields
    """Networks of the object."""
    poses: PoseSource
    """Parameters of the poses."""


@dataclass(frozen=True)
class FrameFit:
    """Residuals of each frame right after it was tracked; large ones indicate a lost frame.

    Of frames that are registered together, before there is a shape, only the last one has some, those of the sphere.
    """

    match: Float[Tensor, " t"]
    """Median match residual [pixels, see OBJECT_PIXELS]; infinite without matches."""
    iou: Float[Tensor, " t"]
    """Intersection over union of rendered silhouette and mask, over sampled pixels."""
    colour: Float[Tensor, " t"]
    """Mean absolute difference to the input image on the object, sRGB."""


@dataclass(frozen=True)
class ProgressiveResult:
    """Result of the tracker, in the frame of the virtual camera."""

    T_aim_obj: SE3
    """Object to virtual camera, one per frame [object radius]."""
    aim: Aim
    """Virtual camera."""
    sdf: Sdf | Grids
    """The last shape, trained mostly on the frames since its last reset."""
    fit: FrameFit
    """Residuals per frame."""


def length(cfg: Config, inputs: Inputs) -> int:
    """Number of steps, including those of a shape reset in every frame; these are skipped where there is no reset."""
    return n_steps(cfg.phases, len(inputs.capture)) + cfg.closing * cfg.closing_steps


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """Initial state: a sphere as shape, and the same pose in all frames.

    Its memory holds the initial poses, the `FrameFit` of every frame, the first frame to track, and of the shape's last
    reset the index in the tracking order and the number of steps since.
    """
    n, like = len(inputs.capture), inputs.capture.camera.fx_fy_cx_cy
    radius = torch.stack([_silhouette_radius(inputs, frame) for frame in range(n)])
    start = 0 if cfg.start == "first" else int(radius.argmax())
    if cfg.start == "matched" and isinstance(cfg.motion, Motion):
        start = registration.best_start(cfg.motion, inputs.anchors)
    base = SE3.identity((n,), dtype=like.dtype, device=like.device)
    base = SE3(base.wxyz, torch.stack([0 * radius, 0 * radius, (cfg.fill / radius.max()).expand(n)], -1))
    source = pose_networks.vectors(n, 6) if cfg.poses == "vectors" else pose_networks.frame_mlps(n, 6, rng)
    params = optim.leaves(tree.to(Params(sdf_field.sphere_initialised(cfg.sizes, rng), source), like.device))
    rates = {"fields": cfg.rates.fields, "fields.log_sharpness": cfg.rates.sharpness, "poses": cfg.rates.poses}
    # The first frame's pose is fixed, which removes the gauge freedom.
    rates[f"poses.values.{start}"] = 0.0
    if cfg.poses == "mlps":
        rates["poses.codes"] = 0.0
    memory = {
        "base": torch.cat([base.wxyz, base.xyz], -1),
        "frame_fit": torch.full((n, 3), math.inf).to(like),
        "start": torch.tensor(start),
        "distance": base.xyz[0, 2],
        "shape_start": torch.tensor(0),
        "shape_steps": torch.tensor(0),
    }
    return State(0, params, optim.adam(params, rates), rng, memory)


def _silhouette_radius(inputs: Inputs, frame: int) -> Float[Tensor, ""]:
    """Radius of a silhouette about the centre of the virtual frame, over the object's distance; 0 without object."""
    capture = inputs.capture
    uv = capture.camera.pixel_centers()[capture.masks[frame] == OBJECT]
    if not len(uv):
        return capture.camera.fx_fy_cx_cy.new_tensor(0.0)
    x_aim = inputs.aim.R_cam_aim[frame].inverse() @ capture.camera.unproject(uv, torch.ones_like(uv[:, 0]))
    return (x_aim[:, :2] / x_aim[:, 2:]).norm(dim=-1).max()


def poses(params: Params, memory: dict[str, Tensor], frames: list[int]) -> SE3:
    """Current `T_aim_obj` of some frames."""
    base = memory["base"][frames]
    return pose_networks.orbit(SE3(base[:, :4], base[:, 4:]), pose_networks.raw_outputs(params.poses, frames))


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """One step of the schedule; nothing in shape phases without a reset."""
    tracked = n_steps(cfg.phases, len(inputs.capture))
    if state.step >= tracked:
        return _closing_step(cfg, inputs, state, state.step - tracked)
    now, memory = schedule_at(cfg.phases, state.step), state.memory
    frames = tracking_order(int(memory["start"]), len(inputs.capture))
    first = _n_first(cfg, len(frames))
    # The first frames are registered together, and the shape starts afterwards.
    if now.index < first - 1 or (now.index == first - 1 and first > 1 and not (now.first or now.last)):
        return {}
    # A later frame has a shape phase only if the shape was reset after the frame before.
    if now.phase == "shape" and int(memory["shape_start"]) != now.index:
        return {}
    if now.first and isinstance(cfg.motion, Motion):
        _register(cfg, inputs, state, frames[: now.index + 1])
    elif now.first:
        _initialise_pose(cfg, state, frames, now.index)
    known = frames[: max(1, now.index)] if now.phase == "shape" else frames[: now.index + 1]
    terms = _descend(cfg, inputs, state, now, known)
    if now.phase != "pose":
        memory["shape_steps"] += 1
    if now.last:
        _finish_frame(cfg, inputs, state, frames, now.index)
    return terms | {"frame": float(now.index)}


def _n_first(cfg: Config, n: int) -> int:
    """Number of frames, of `n`, that are known before there is a shape."""
    return min(cfg.motion.first, n) if isinstance(cfg.motion, Motion) else 1


def _descend(
    cfg: Config, inputs: Inputs, state: State, now: SchedulePoint, known: list[int]
) -> dict[str, Tensor | float]:
    """A step of gradient descent; returns the weighted terms of the loss."""
    assert state.optimizer is not None, "init creates the optimizer"
    terms = _loss_terms(cfg, inputs, state, now, known)
    optim.anneal(state.optimizer, _rates(cfg, now, state.memory))
    optim.descend(torch.stack(list(terms.values())).sum(), state.optimizer, step=state.step)
    return {name: value.detach() for name, value in terms.items()}


def _rates(cfg: Config, now: SchedulePoint, memory: dict[str, Tensor]) -> dict[str, float]:
    """Factors on the learning rates."""
    cosine = 0.5 * (1 + math.cos(math.pi * now.frame_progress))
    ramp = min(1.0, (int(memory["shape_steps"]) + 1) / max(1, cfg.rates.ramp))
    return {"poses": cfg.rates.poses_decay + (1 - cfg.rates.poses_decay) * cosine, "fields": ramp}


@torch.no_grad()
def _initialise_pose(cfg: Config, state: State, frames: list[int], index: int) -> None:
    """Set the initial pose of a frame from its neighbour in time: the same pose, or rotated on steadily."""
    frame = frames[index]
    back = -1 if frame > frames[0] else 1
    past = poses(state.params, state.memory, [frame + back, (frame + 2 * back) % len(frames)])
    T_aim_obj = past[0]
    if cfg.motion == "steady" and frame + 2 * back in frames[:index]:
        R_before_last = past[1].rotation.inverse() @ past[0].rotation
        T_aim_obj = SE3((past[0].rotation @ R_before_last).wxyz, past[0].xyz)
    # A product of three rotations: without normalisation, an error in length would grow 2.4 times with every frame.
    state.memory["base"][frame] = torch.cat([SO3.from_wxyz(T_aim_obj.wxyz).wxyz, T_aim_obj.xyz], -1)


@torch.no_grad()
def _register(cfg: Config, inputs: Inputs, state: State, known: list[int]) -> None:
    """Estimate the pose of the newest frame, or of all first ones, and adjust those of the frames near it."""
    motion, scene = cfg.motion, _scene(cfg, inputs, state)
    assert isinstance(motion, Motion), "other motions need no registration"
    T_aim_obj = poses(state.params, state.memory, list(range(len(inputs.capture))))
    if len(known) <= motion.first:
        T_aim_obj = registration.register_first(motion, scene, T_aim_obj, known)
    else:
        T_aim_obj = registration.register(motion, scene, T_aim_obj, known)
        T_aim_obj = registration.adjust_window(motion, scene, T_aim_obj, known)
        if len(known) % motion.every == 0 or len(known) == len(inputs.capture):
            T_aim_obj = registration.adjust_all(motion, scene, T_aim_obj, known)
    _set_poses(state, T_aim_obj, known)


def _scene(cfg: Config, inputs: Inputs, state: State) -> Scene:
    """What poses are registered against."""
    shape = functools.partial(sdf_field.distance, tree.detach(state.params.fields.sdf))
    return Scene(inputs.anchors, shape, cfg.bound, float(state.memory["distance"]))


def _closing_step(cfg: Config, inputs: Inputs, state: State, step: int) -> dict[str, Tensor | float]:
    """A step after all frames are known: of the shape alone, and at the ends of a round also of all poses."""
    assert isinstance(cfg.motion, Motion), "closing rounds need a registration"
    known = tracking_order(int(state.memory["start"]), len(inputs.capture))
    now = SchedulePoint(len(known) - 1, "shape", 0.5, 1.0, first=False, last=False)
    terms = _descend(cfg, inputs, state, now, known)
    if (step + 1) % cfg.closing_steps == 0:
        with torch.no_grad():
            T_aim_obj = poses(state.params, state.memory, sorted(known))
            scene = _scene(cfg, inputs, state)
            _set_poses(state, registration.adjust_all(cfg.motion, scene, T_aim_obj, known), known)
    return terms


def _set_poses(state: State, T_aim_obj: SE3, frames: list[int]) -> None:
    """Give some frames new poses, from which their parameters start again."""
    assert isinstance(state.params.poses, pose_networks.Vectors), "networks have no zero"
    state.memory["base"][frames] = torch.cat([T_aim_obj.wxyz, T_aim_obj.xyz], -1)[frames]
    for frame in frames:
        leaf = state.params.poses.values[str(frame)]
        leaf.zero_()
        if state.optimizer is not None:
            state.optimizer.state.pop(leaf, None)


@torch.no_grad()
def _finish_frame(cfg: Config, inputs: Inputs, state: State, frames: list[int], index: int) -> None:
    """Record how well a frame fits, and reset the shape if the object has rotated far since the last reset."""
    memory = state.memory
    memory["frame_fit"][frames[index]] = _frame_fit(cfg, inputs, state, frames[: index + 1])
    began = isinstance(cfg.motion, Motion) and index + 1 == _n_first(cfg, len(frames))
    pair = poses(state.params, memory, [frames[index], frames[max(0, int(memory["shape_start"]) - 1)]]).rotation
    if index + 1 == len(frames) or (float(angle_between(pair[0], pair[1])) < math.radians(cfg.reset) and not began):
        return
    memory["shape_start"], memory["shape_steps"] = torch.tensor(index + 1), torch.tensor(0)
    fresh = tree.named_tensors(sdf_field.sphere_initialised(cfg.sizes, state.rng))
    for name, leaf in tree.named_tensors(state.params.fields).items():
        leaf.copy_(fresh[name])
        assert state.optimizer is not None
        state.optimizer.state.pop(leaf, None)


# Losses of a step -----------------------------------------------------------------------------------------------------


def _loss_terms(cfg: Config, inputs: Inputs, state: State, now: SchedulePoint, known: list[int]) -> dict[str, Tensor]:
    """Weighted losses of one step; `known` are the frames tracked so far, in the order of tracking."""
    match = _draw_match(cfg, inputs, state, now, known)
    n_rays = cfg.rays if match is None else max(0, cfg.rays - 2 * cfg.match_rays)
    samples: list[tuple[int, bool, Pixels]] = []
    if n_rays:
        main = _draw_main(cfg, state, now, known) if match is None else match.i
        samples.append((main, now.phase != "shape", _draw(cfg, inputs, state, now, main, n_rays)))
    if now.phase != "pose" and cfg.old_rays:
        older = known[: -cfg.window] or known
        only_first = now.phase == "shape" and not isinstance(cfg.motion, Motion)
        frame = known[0] if only_first else older[_random_index(state, len(older))]
        samples.append((frame, False, _draw(cfg, inputs, state, now, frame, cfg.old_rays)))
    if match is not None:
        for frame, uv in ((match.i, match.uv_i), (match.j, match.uv_j)):
            ends = ray_sampling.at_positions(inputs.capture, inputs.aim, frame, uv)
            samples.append((frame, now.phase == "joint" or frame == known[-1], ends))
    batches = [_ray_batch(state, frame, pixels, moves=moves) for frame, moves, pixels in samples]
    fields = tree.detach(state.params.fields) if now.phase == "pose" else state.params.fields
    rendered = neus.render_batches(fields, batches, cfg.samples, bound=cfg.bound, rng=state.rng)
    targets = functools.reduce(Pixels.__add__, (batch.pixels for batch in batches))
    terms = {
        "render": cfg.weights.render * neus.colour_loss(rendered, targets),
        "mask": cfg.weights.mask * neus.mask_loss(rendered, targets),
    }
    if now.phase != "pose":
        terms["eikonal"] = cfg.weights.eikonal * neus.eikonal_loss(rendered)
    if match is not None:
        residual, weight = _match_residual(inputs, rendered, (batches[-2].T_aim_obj, batches[-1].T_aim_obj), match)
        # FMOV adds the means of both directions; here one mean is over both.
        terms["match"] = 2 * cfg.weights.match * neus.huber_loss(residual, weight, threshold=cfg.huber)
    return terms


def _ray_batch(state: State, frame: int, pixels: Pixels, *, moves: bool) -> RayBatch:
    """Rays of a frame with its current pose, which receives gradients if it `moves`."""
    T_aim_obj = poses(state.params, state.memory, [frame])[0]
    return RayBatch(pixels, T_aim_obj if moves else tree.detach(T_aim_obj))


def _match_residual(
    inputs: Inputs, rendered: Rendered, T_aim_obj: tuple[SE3, SE3], match: Match
) -> tuple[Tensor, Tensor]:
    """Residuals of a match in both directions [pixels, see OBJECT_PIXELS] and weights; its rays are the last ones."""
    n, m, camera, capture = len(rendered.opacity), len(match), inputs.aim.camera, inputs.capture.camera
    uv_i = virtual_camera.camera_to_aim(inputs.aim, capture, match.i, match.uv_i)
    uv_j = virtual_camera.camera_to_aim(inputs.aim, capture, match.j, match.uv_j)
    forward, hit_i = neus.transfer_residuals(rendered, slice(n - 2 * m, n - m), T_aim_obj[1], camera, uv_j)
    backward, hit_j = neus.transfer_residuals(rendered, slice(n - m, n), T_aim_obj[0], camera, uv_i)
    per_radius = [camera.fx_fy_cx_cy[0] / T.xyz[2].detach() for T in T_aim_obj]
    residual = torch.cat([forward / per_radius[1], backward / per_radius[0]]) * (OBJECT_PIXELS / 2)
    return residual, torch.cat([hit_i, hit_j]) * match.confidence.repeat(2)


def _draw(cfg: Config, inputs: Inputs, state: State, now: SchedulePoint, frame: int, n: int) -> Pixels:
    """Random pixels of a frame, in most steps near its silhouette."""
    box = (0, 0, inputs.capture.camera.height, inputs.capture.camera.width)
    if float(torch.rand((), generator=state.rng)) < cfg.inside:
        box = ray_sampling.silhouette_box(inputs.capture, frame, cfg.margin)
    block = cfg.block if now.phase_progress < 0.5 else 1
    return ray_sampling.draw(inputs.capture, inputs.aim, frame, n, box=box, block=block, rng=state.rng)


def _draw_main(cfg: Config, state: State, now: SchedulePoint, known: list[int]) -> int:
    """Frame of most rays: the newest in the pose phase, any in the shape phase, else mostly the newest."""
    if now.phase == "pose":
        return known[-1]
    if now.phase == "shape" or len(known) <= cfg.window:
        return known[_random_index(state, len(known))]
    if float(torch.rand((), generator=state.rng)) < cfg.newest:
        return known[-1]
    return known[-2 - _random_index(state, cfg.window - 1)]


def _draw_match(cfg: Config, inputs: Inputs, state: State, now: SchedulePoint, known: list[int]) -> Match | None:
    """Random correspondences of a frame with one of `known` near it in time; None in steps without a match loss."""
    if now.phase == "shape" or float(torch.rand((), generator=state.rng)) >= cfg.match_share:
        return None
    frame = _draw_main(cfg, state, now, known)
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
    match = usable[_random_index(state, len(usable))]
    rows = torch.randint(len(match), (cfg.match_rays,), generator=state.rng)
    return match.select(rows.to(match.uv_i.device))


def _random_index(state: State, n: int) -> int:
    """Random integer in [0, n)."""
    return int(torch.randint(n, (), generator=state.rng))


# Results --------------------------------------------------------------------------------------------------------------


def _frame_fit(cfg: Config, inputs: Inputs, state: State, known: list[int]) -> Tensor:
    """Match residual, IoU of the silhouette and colour error of the newest frame, see `FrameFit`."""
    frame, fields = known[-1], state.params.fields
    box = ray_sampling.silhouette_box(inputs.capture, frame, cfg.margin)
    pixels = ray_sampling.draw(inputs.capture, inputs.aim, frame, FIT_RAYS, box=box, block=1, rng=state.rng)
    batch = _ray_batch(state, frame, pixels, moves=False)
    rendered = neus.render_batches(fields, [batch], cfg.samples, bound=cfg.bound, rng=None)
    colour = ((rendered.rgb - pixels.rgb).abs().mean(-1) * pixels.mask).sum() / pixels.mask.sum().clamp_min(1)
    residuals = []
    for match in inputs.matches:
        if frame in (match.i, match.j) and {match.i, match.j} <= set(known) and len(match):
            match = match.select(torch.arange(len(match))[:: 1 + len(match) // cfg.match_rays])
            ends = ((match.i, match.uv_i), (match.j, match.uv_j))
            rays = [(f, ray_sampling.at_positions(inputs.capture, inputs.aim, f, uv)) for f, uv in ends]
            pair = [_ray_batch(state, f, part, moves=False) for f, part in rays]
            rendered_pair = neus.render_batches(fields, pair, cfg.samples, bound=cfg.bound, rng=None)
            residual, weight = _match_residual(inputs, rendered_pair, (pair[0].T_aim_obj, pair[1].T_aim_obj), match)
            residuals.append(residual.norm(dim=-1)[weight > 0])
    residual = torch.cat(residuals) if residuals else colour.new_zeros(0)
    median = residual.median() if len(residual) else colour.new_tensor(math.inf)
    return torch.stack([median, iou(rendered.opacity > 0.5, pixels.mask > 0.5), colour])


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> ProgressiveResult:
    """Poses in the aim frame, which `virtual_camera.lift` converts to the camera frame."""
    T_aim_obj = poses(state.params, state.memory, list(range(len(inputs.capture))))
    fit = FrameFit(*state.memory["frame_fit"].unbind(-1))
    return ProgressiveResult(T_aim_obj, inputs.aim, tree.detach(state.params.fields.sdf), fit)
