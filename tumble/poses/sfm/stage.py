"""Stage 1 by structure from motion: poses of all frames at once, from matches and silhouettes.

Relative rotations of nearby frames are fitted and averaged. Short overlapping windows of frames are then adjusted to
feature tracks and frontier points (bundle adjustment), and the rotations within them are averaged; larger windows
follow. Finally the whole capture is adjusted in several rounds, in each of which the frontier points of all pairs of
frames are found anew. Necker reversal is resolved where it arises: each window is also adjusted from its mirror image,
and the better result is kept. Frames whose contour contradicts the others are relocalized by a search over many
rotations.

What contours do not show is corrected by texture: the rotation of a body of revolution about its axis, and turns of a
part of the motion that leave the visual hull as it is (`symmetry`). These corrections are repeated until the poses
settle.

The motion of a turntable is found before all that, from contours or from the texture of a body of revolution, and then
nothing else is done (`circular_motion`).

A capture that has not converged is attempted again, until two attempts agree: windows are adjusted from many starts,
and joined to larger and larger ones (`adjustment.grow_windows`). If none agree, parts of the best attempt are changed
at random, and what lowers the loss is kept (`perturbation`); the same follows with windows of fixed sizes, and the
better result is taken. A focal length that is only assumed is estimated as well whenever all frames are adjusted
together.

Unit of length until `finish`: the mean distance between camera and object.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.engine import State
from tumble.maths import SO3, angle_between, average_rotations, mean_rotation
from tumble.poses.result import PoseResult
from tumble.poses.sfm import circular_motion, relative_pose, segments, symmetry
from tumble.poses.sfm.adjustment import (
    adjust_round,
    adjust_windows,
    averaged_windows,
    deviation,
    grow_windows,
)
from tumble.poses.sfm.bundle_adjustment import BundleState
from tumble.poses.sfm.finalize import Solution, pose_result
from tumble.poses.sfm.observations import (
    BOUNDING_RADIUS_FACTOR,
    Inputs,
    focal_length,
    in_unit_sphere,
    silhouette_centres,
    with_focal_length,
)
from tumble.poses.sfm.observations import gather as gather
from tumble.poses.sfm.observations import is_hidden as is_hidden
from tumble.poses.sfm.observations import shown as shown
from tumble.poses.sfm.perturbation import perturbed, stretched
from tumble.poses.sfm.relocalization import (
    MIN_GAPS,
    POSE_JUMP,
    ContourConstraints,
    candidate_rotations,
    longest_smooth_sequence,
    relocalize,
    robust_cost,
)
from tumble.poses.sfm.schedule import (
    RELOCALIZATION_SCALE,
    AdjustAll,
    AdjustWindows,
    AlignColours,
    AlignTexture,
    AverageRotations,
    BaseConfig,
    CheckSettled,
    GrowWindows,
    JoinSegments,
    KeepBest,
    Perturb,
    Relocalize,
    SetAside,
    Step,
    TakeBetter,
    TrackTexture,
    TryCircularMotion,
    schedule,
)
from tumble.poses.sfm.tracks import NO_TRACKS, Tracks, concatenate
from tumble.scene import Trajectory

VERSION = 49
RELOCALIZATION_COST_RATIO = 1.5
"""Robust cost of a frame's tangency gaps above which the frame is relocalized [median over all frames].

Relocalization would make good poses worse, because it uses contours alone.
"""
TOLERATED_COST = 0.1
"""Robust cost up to which a frame is never relocalized: that of gaps of about a quarter of a pixel."""
DISAGREEMENT_FACTOR = 6.0
"""Factor by which the weight of contours is lowered and raised for the two fits whose rotations are compared.

It is finite, because neither tracks nor contours alone determine all poses.
"""
MAX_COST_RATIO = 4.0
"""Robust cost of a frame's tangency gaps above which its pose does not show a gap of the motion [median]."""
SETTLED_ANGLE = math.radians(1.0)
"""Largest change of a frame's rotation by a round of corrections below which no more rounds follow [radians]. A frame
that is relocated or turned moves farther, one that is only adjusted less."""
AGREEMENT = math.radians(3.0)
"""Angle by which the rotations of two attempts that have found the same motion differ at most [radians]; for a body of
revolution that between its axes."""
AGREEING_FRAMES = 0.9
"""Fraction of the frames in which they have to agree."""
PROBED_TURN = math.radians(15)
"""Angle by which a body is turned about its axis to see whether contours contradict that [radians]."""
PROBED_COST_RATIO = 3.0
"""Robust cost of contours after that turn above which they do [before it]. On true poses it is 1.1 for a soup can, 7
for a mustard bottle and 9 for a bell pepper; for a round body whose spin is wrong it is up to 2.3."""
PERTURBATIONS = 10
"""Number of changes of the motion that are tried in one step."""
NO_ROTATION_WEIGHT = 0.01
"""Weight of the prior that the object does not rotate between consecutive frames [weight of one inlier match]."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """The settings; by the module of their class a stage is found."""


@dataclass(frozen=True)
class Poses:
    """Poses of all frames, and the focal length: the variables of this stage."""

    R: Float[Tensor, "t 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "t 3"]
    """Object origin, camera frame [mean distance]."""
    log_focal: Float[Tensor, ""]
    """Logarithm of the focal length over that of the capture; 0 if the latter is known."""


def length(cfg: Config, inputs: Inputs) -> int:
    return len(schedule(cfg, hidden=inputs.hidden))


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """Initial state: an object that does not rotate, at the centre of its silhouette in every frame."""
    R = torch.eye(3, dtype=torch.float64).repeat(len(inputs.capture), 1, 1)
    t = silhouette_centres(inputs.capture, inputs.silhouettes)
    log_focal = torch.zeros((), dtype=torch.float64)
    infinite = torch.full_like(log_focal, torch.inf)
    best = {"R": R, "t": t, "log_focal": log_focal, "loss": infinite, "first_loss": infinite}
    best["agreed"] = torch.tensor(False)
    best["posed"] = torch.ones(len(R), dtype=torch.bool)
    best["confirmed"] = torch.full((len(R),), -1)
    # Poses at the last check, before which there are none.
    best |= {"checked_R": torch.full_like(R, torch.nan), "checked_t": t, "checked_log_focal": log_focal}
    best["settled"] = torch.tensor(False)
    best["steady"] = torch.ones(len(inputs.tracks), dtype=torch.bool)
    return State(0, Poses(R, t, log_focal), None, rng, best)


@torch.no_grad()
def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """Carry out the next step of the schedule.

    Nothing is done where no more attempts are needed, because the first has converged or two agree, and no more
    corrections, because the poses have settled.
    """
    now = schedule(cfg, hidden=inputs.hidden)[state.step]
    cfg = _weighted(cfg, inputs)
    converged = float(state.memory["first_loss"]) < cfg.converged_loss or bool(state.memory["agreed"])
    if converged and (now.attempt > 0 or now.mends):
        return {}
    if bool(state.memory["settled"]):
        return {}
    state.params, scalars = _run_phase(now, cfg, with_focal_length(inputs, state.params.log_focal), state)
    return scalars


def _weighted(cfg: Config, inputs: Inputs) -> Config:
    """The settings with the weight of contours for an object that is hidden in part, if it is."""
    return replace(cfg, frontier_weight=segments.FINAL_FRONTIER_WEIGHT) if inputs.hidden else cfg


def _run_phase(now: Step, cfg: Config, inputs: Inputs, state: State) -> "PhaseResult":
    match now.phase:
        case AverageRotations():
            return _average_rotations(cfg, inputs, state)
        case AdjustWindows() | GrowWindows():
            return _adjust_windows(cfg, inputs, state, now.phase)
        case AdjustAll(scale):
            return adjust_all(cfg, inputs, state, scale)
        case KeepBest(scale):
            return _keep_best(cfg, inputs, state, scale, is_other=now.attempt > 0 and not now.mends)
        case Perturb(scale):
            return _perturb(cfg, inputs, state, scale)
        case CheckSettled(scale):
            return _check_settled(cfg, inputs, state, scale)
        case Relocalize(scale):
            return _relocalize(inputs, state, scale)
        case JoinSegments():
            return _join_segments(cfg, inputs, state)
        case TryCircularMotion() | AlignTexture() | AlignColours() | TrackTexture() | SetAside() | TakeBetter():
            return _WITHOUT_SETTINGS[type(now.phase)](inputs, state)


# Phases ---------------------------------------------------------------------------------------------------------------

PhaseResult = tuple[Poses, dict[str, Tensor | float]]
"""New poses, and scalars to report."""


def _average_rotations(cfg: Config, inputs: Inputs, state: State) -> PhaseResult:
    """Fit the relative rotations of nearby frames and average them."""
    near = [
        m for m in inputs.matches if abs(m.j - m.i) <= cfg.max_pair_distance and len(m) >= relative_pose.MIN_MATCHES
    ]
    if not near:
        return state.params, {"pairs": 0.0}
    fits = relative_pose.fit(near, inputs.silhouettes, inputs.capture.camera, max_matches=150)
    weight = (fits.inliers + 1) / (fits.j - fits.i).abs()
    # The motion is smooth: where frames have no matches, the object is assumed not to rotate at first.
    n = len(inputs.capture)
    previous = torch.arange(n - 1)
    identity = torch.eye(3, dtype=weight.dtype).expand(n - 1, 3, 3)
    i, j = torch.cat([fits.i, previous]), torch.cat([fits.j, previous + 1])
    weight = torch.cat([weight, torch.full((n - 1,), NO_ROTATION_WEIGHT, dtype=weight.dtype)])
    averaged = average_rotations(i, j, torch.cat([fits.R_j_i, identity]), weight, n_frames=n)
    poses = replace(state.params, R=averaged.R_cam_obj, t=silhouette_centres(inputs.capture, inputs.silhouettes))
    return poses, {"pairs": float(len(fits))}


def _adjust_windows(cfg: Config, inputs: Inputs, state: State, phase: AdjustWindows | GrowWindows) -> PhaseResult:
    """Adjust overlapping windows, and average the consistent rotations within them."""
    R, rng, stretch = state.params.R, state.rng, 1.0
    if isinstance(phase, GrowWindows):
        windows = grow_windows(cfg, inputs, R, rng, size=phase.size, directions=cfg.directions)
    else:
        directions, stretch = cfg.directions if phase.widely else 0, phase.stretch
        windows = adjust_windows(cfg, inputs, R, rng, size=phase.size, directions=directions)
    R = averaged_windows(windows.frames, windows.consistent, n_frames=len(R))
    return replace(state.params, R=R if stretch == 1 else stretched(R, stretch)), {"loss": windows.loss.amin(1).mean()}


def _join_segments(cfg: Config, inputs: Inputs, state: State) -> PhaseResult:
    """Pose the frames that can be understood, and keep their tracks."""
    cfg = replace(cfg, frontier_weight=segments.FRONTIER_WEIGHT)
    part, tracks = segments.segmented_poses(cfg, inputs, state.params.R, state.rng)
    if part is None:
        return state.params, {"posed": 0.0}
    frames = list(part.frames)
    R, t = state.params.R.clone(), state.params.t.clone()
    R[frames], t[frames] = part.R, part.t
    posed = torch.zeros(len(R), dtype=torch.bool)
    posed[frames] = True
    state.memory |= {"posed": posed} | {f"joined_{name}": x for name, x in vars(tracks).items()}
    return replace(state.params, R=R, t=t), {"posed": float(len(frames))}


def adjust_all(cfg: Config, inputs: Inputs, state: State, scale: float) -> PhaseResult:
    """One round of bundle adjustment of all frames with a pose, and of the focal length if that is only assumed."""
    poses, posed = state.params, _posed(state)
    frames = torch.nonzero(posed)[:, 0]
    log_focal = torch.zeros(1, dtype=poses.R.dtype) if inputs.capture.focal_assumed else None
    scene = BundleState(poses.R[None, posed], poses.t[None, posed], torch.zeros(0, 3, dtype=poses.R.dtype), log_focal)
    chained, textured = (_renumbered(tracks, posed) for tracks in (_chained(inputs, state), _textured(state)))
    tracks = concatenate(chained, textured)
    group = torch.zeros(tracks.n, dtype=torch.long)
    weight = torch.cat([torch.ones(len(chained)), torch.full((len(textured),), cfg.texture_weight)]).double()
    # `inputs` have the current focal length; the prior is centred on that of the capture.
    prior = -float(poses.log_focal)
    scene, loss = adjust_round(cfg, inputs, scene, tracks, group, frames[None], scale, state.rng, prior, weight)
    R, t = poses.R.clone(), poses.t.clone()
    R[posed], t[posed] = scene.R[0], scene.t[0]
    if scene.log_focal is None:
        return Poses(R, t, poses.log_focal), {"loss": loss.mean()}
    focal = focal_length(inputs.capture) * scene.log_focal[0].exp()
    return Poses(R, t, poses.log_focal + scene.log_focal[0]), {"loss": loss.mean(), "focal": focal}


def _posed(state: State) -> Bool[Tensor, " t"]:
    """Which frames have a pose; all of them unless the object is hidden in part."""
    return state.memory.get("posed", torch.ones(len(state.params.R), dtype=torch.bool))


def _renumbered(tracks: Tracks, posed: Bool[Tensor, " t"]) -> Tracks:
    """The tracks in frames with a pose, numbered without the other frames."""
    if bool(posed.all()):
        return tracks
    tracks = tracks.select(posed[tracks.frame])
    return replace(tracks, frame=(posed.cumsum(0) - 1)[tracks.frame])


def _chained(inputs: Inputs, state: State) -> Tracks:
    """Feature tracks; for an object that is hidden in part those that matches have joined."""
    joined = _stored("joined", state)
    return joined if len(joined) else _steady_tracks(inputs, state)


def _textured(state: State) -> Tracks:
    """Points located by their texture (`TrackTexture`)."""
    return _stored("texture", state)


def _stored(kind: str, state: State) -> Tracks:
    """Tracks that an earlier step has put into the memory of the state; none if it has not."""
    if f"{kind}_frame" not in state.memory:
        return NO_TRACKS
    return Tracks(*(state.memory[f"{kind}_{name}"] for name in ("frame", "point", "uv")))


def _steady_tracks(inputs: Inputs, state: State) -> Tracks:
    """Feature tracks without the observations that have slipped from their surface point (`AlignTexture`)."""
    steady = state.memory.get("steady")
    return inputs.tracks if steady is None or bool(steady.all()) else inputs.tracks.select(steady)


def _from_unit_sphere(inputs: Inputs, poses: Poses, trajectory: Trajectory) -> Poses:
    """Poses in the unit of this stage, of which others are those of `in_unit_sphere`."""
    T_cam_obj = trajectory.T_cam_obj
    t = T_cam_obj.xyz.double() * (BOUNDING_RADIUS_FACTOR * inputs.radius)
    return replace(poses, R=T_cam_obj.rotation.matrix().double(), t=t)


def _align_texture(inputs: Inputs, state: State) -> PhaseResult:
    """Correct the rotations of a body of revolution about its axis where texture contradicts them."""
    found = _spin(inputs, state.params)
    if found is None or not found.is_better:
        return state.params, {}
    trajectory = found.surface.turned(in_unit_sphere(inputs, state.params.R, state.params.t), found.angle)
    state.memory["steady"] = symmetry.steady_observations(inputs.capture, trajectory, found.surface, inputs.tracks)
    return _from_unit_sphere(inputs, state.params, trajectory), {"turned": found.angle.abs().median()}


def _check_settled(cfg: Config, inputs: Inputs, state: State, scale: float) -> PhaseResult:
    """Compare the poses with those of the last check."""
    now, memory = state.params, state.memory
    before = Poses(*(memory[f"checked_{name}"] for name in vars(now)))
    memory |= {f"checked_{name}": x for name, x in vars(now).items()}
    change = angle_between(SO3.from_matrix(now.R), SO3.from_matrix(before.R)).max()
    if not bool(change.isfinite()):  # the first check
        return now, {}
    losses = [_comparable_loss(cfg, inputs, state, poses, scale) for poses in (before, now)]
    is_worse = bool(losses[1] > losses[0])
    memory["settled"] = torch.tensor(is_worse or bool(change < SETTLED_ANGLE))
    return before if is_worse else now, {"changed": change, "undone": float(is_worse)}


def _align_colours(inputs: Inputs, state: State) -> PhaseResult:
    """Correct the rotations of parts of the motion by symmetric turns of the visual hull where colours contradict."""
    found = _turns(inputs, state.params)
    if found is None:
        return state.params, {}
    state.memory["confirmed"] = found.confirmed
    if not found.is_better:
        return state.params, {}
    trajectory = found.turned(in_unit_sphere(inputs, state.params.R, state.params.t))
    return _from_unit_sphere(inputs, state.params, trajectory), {"turned": float((found.chosen > 0).sum())}


def _turns(inputs: Inputs, poses: Poses) -> symmetry.Turns | None:
    """Symmetric turns of parts of the motion that colours show."""
    cost = _contour_costs(inputs, poses, RELOCALIZATION_SCALE)
    usable = cost <= max(MAX_COST_RATIO * float(cost.median()), TOLERATED_COST)
    return symmetry.estimate_turns(inputs.capture, in_unit_sphere(inputs, poses.R, poses.t), usable & ~cost.isinf())


def _spin(inputs: Inputs, poses: Poses) -> symmetry.Spin | None:
    """Rotations about the axis that the texture of a body of revolution shows, relative to the poses."""
    surface = _surface_of_revolution(inputs, poses)
    if surface is None:
        return None
    return symmetry.estimate_spin(inputs.capture, in_unit_sphere(inputs, poses.R, poses.t), surface)


def _keep_best(cfg: Config, inputs: Inputs, state: State, scale: float, *, is_other: bool) -> PhaseResult:
    """Keep the poses with the lowest loss, the current ones or those of an earlier attempt; see whether both agree."""
    memory, found = state.memory, _comparable_loss(cfg, inputs, state, state.params, scale)
    if bool(memory["first_loss"].isinf()):
        trial = State(0, state.params, None, torch.Generator().manual_seed(0))
        memory["first_loss"] = torch.as_tensor(adjust_all(cfg, inputs, trial, scale)[1]["loss"])
    best = Poses(**{name: memory[name] for name in vars(state.params)})
    if is_other:
        memory["agreed"] = _difference(inputs, state.params, best).quantile(AGREEING_FRAMES) < AGREEMENT
    if found < memory["loss"]:
        memory |= {**vars(state.params), "loss": found}
        best = state.params
    return best, {"loss": memory["loss"]}


def _set_aside(_: Inputs, state: State) -> PhaseResult:
    """Remember the best poses, and let the attempts that follow be compared among themselves."""
    memory = state.memory
    memory |= {f"aside_{name}": memory[name] for name in (*vars(state.params), "loss")}
    memory["loss"] = torch.full_like(memory["loss"], torch.inf)
    return state.params, {}


def _take_better(_: Inputs, state: State) -> PhaseResult:
    """The best poses of all, if some were set aside: these or those found since."""
    memory = state.memory
    if "aside_loss" not in memory:
        return state.params, {}
    if memory["aside_loss"] <= memory["loss"]:
        memory |= {name: memory[f"aside_{name}"] for name in (*vars(state.params), "loss")}
    return Poses(**{name: memory[name] for name in vars(state.params)}), {"loss": memory["loss"]}


def _difference(inputs: Inputs, a: Poses, b: Poses) -> Float[Tensor, " t"]:
    """Angle in every frame between the rotations of two attempts [radians].

    For a body of revolution between its axes: texture tells its rotation about the axis afterwards (`AlignTexture`),
    which matches of all attempts get wrong in different ways.
    """
    if _surface_of_revolution(inputs, b) is not None:
        found = symmetry.axis_deviation(inputs.capture, *(in_unit_sphere(inputs, each.R, each.t) for each in (a, b)))
        if found is not None:
            return found.double()
    return deviation(a.R, b.R)


def _surface_of_revolution(inputs: Inputs, poses: Poses) -> symmetry.SurfaceOfRevolution | None:
    """The surface of a body of revolution, whose silhouettes show its rotation but for that about the axis; None if the
    object is none.

    Silhouettes that are nearly symmetric, each on its own, also belong to other bodies (a bell pepper), but at their
    poses contours contradict a turn about the axis: to one side in even frames, to the other in odd ones.
    """
    if not inputs.mirror_symmetry.is_revolution or inputs.mirror_symmetry.is_sphere:
        return None
    trajectory = in_unit_sphere(inputs, poses.R, poses.t)
    surface = symmetry.surface_of_revolution(inputs.capture, trajectory)
    if surface is None:
        return None
    angle = torch.full((len(trajectory),), PROBED_TURN)
    angle[1::2] *= -1
    turned = _from_unit_sphere(inputs, poses, surface.turned(trajectory, angle))
    before, after = (_contour_costs(inputs, each, RELOCALIZATION_SCALE).median() for each in (poses, turned))
    return surface if after <= max(PROBED_COST_RATIO * float(before), TOLERATED_COST) else None


def _try_circular_motion(inputs: Inputs, state: State) -> PhaseResult:
    """Take a circular motion if there is one; nothing else is to be done then."""
    found, poses = circular_motion.fit(inputs), state.params
    if found is None:
        return poses, {}
    state.memory |= {"settled": torch.tensor(True), "circular": found.disagreement}
    return Poses(found.R, found.t, poses.log_focal + found.log_focal), {"circular": found.disagreement.median()}


def _perturb(cfg: Config, inputs: Inputs, state: State, scale: float) -> PhaseResult:
    """Try random changes of the poses, and keep those after which the adjusted poses have a lower loss."""
    best, loss, accepted = state.params, _comparable_loss(cfg, inputs, state, state.params, scale), 0
    for _ in range(PERTURBATIONS):
        trial = replace(state, params=replace(best, R=perturbed(best.R, state.rng)))
        for each in cfg.perturbation_scales:
            current = with_focal_length(inputs, trial.params.log_focal - state.params.log_focal)
            trial.params, _ = adjust_all(cfg, current, trial, each)
        found = _comparable_loss(cfg, inputs, state, trial.params, scale)
        if found < loss:
            best, loss, accepted = trial.params, found, accepted + 1
    return best, {"loss": loss, "accepted": float(accepted)}


def _comparable_loss(cfg: Config, inputs: Inputs, state: State, poses: Poses, scale: float) -> Tensor:
    """Loss per observation by which poses are compared [pixels^2].

    Every observation counts once. In adjustment frontier points have a larger weight, because matches have a bias, but
    wrong rotations often fit the contours as well as the true ones do, and then not the matches.

    Args:
        inputs: Observations with the focal length of `state.params`.
    """
    cfg = replace(cfg, frontier_weight=1.0, iterations=1)
    inputs = with_focal_length(inputs, poses.log_focal - state.params.log_focal)
    trial = State(0, poses, None, torch.Generator().manual_seed(0), state.memory)
    return torch.as_tensor(adjust_all(cfg, inputs, trial, scale)[1]["loss"])


def _track_texture(inputs: Inputs, state: State) -> PhaseResult:
    """Locate points of the visual hull in all frames by their texture, in place of those located before."""
    frames = torch.nonzero(_posed(state))[:, 0]
    trajectory = in_unit_sphere(inputs, state.params.R, state.params.t).select(frames)
    tracks = symmetry.texture_tracks(inputs.capture.select(frames.tolist()), trajectory, state.rng)
    tracks = replace(tracks, frame=frames[tracks.frame])
    state.memory |= {f"texture_{name}": x for name, x in vars(tracks).items()}
    return state.params, {"texture": float(tracks.n)}


def _relocalize(inputs: Inputs, state: State, scale: float) -> PhaseResult:
    """Relocalize frames whose contour contradicts those of the others, in order of distance from consistent frames."""
    R, t = state.params.R.clone(), state.params.t.clone()
    n, poses = len(R), replace(state.params, R=R, t=t)
    initial_cost = _contour_costs(inputs, poses, scale)
    smooth = longest_smooth_sequence(R, torch.ones(n, dtype=torch.bool), state.memory.get("confirmed"))
    smoothed_cost = torch.nn.functional.avg_pool1d(
        initial_cost.nan_to_num(posinf=9.0)[None], 5, 1, 2, count_include_pad=False
    )[0]
    seed = int(torch.where(smooth, smoothed_cost, torch.inf).argmin())
    max_cost = max(RELOCALIZATION_COST_RATIO * float(initial_cost.median()), TOLERATED_COST)
    # Several wrong frames can be consistent with each other: only reliable frames serve as references.
    reliable = (initial_cost <= max_cost) & smooth
    rotations, centres = candidate_rotations(), silhouette_centres(inputs.capture, inputs.silhouettes)
    n_relocalized = 0
    for k in [*range(seed, n), *range(seed - 1, -1, -1)]:
        if reliable[k] or int(reliable.sum()) < MIN_GAPS:
            continue
        near = [i for i in (k, k - 1, k + 1) if 0 <= i < n]
        R_try = torch.cat([R[k : k + 1], *(rotations @ R[i] for i in near)])
        t_try = torch.cat([t[k : k + 1], (centres[k] * t[near, 2].mean()).expand(len(R_try) - 1, 3)])
        current_cost = robust_cost(_constraints(inputs, poses, k, reliable).gaps(R_try[:1], t_try[:1]), scale)[0]
        neighbour = k - 1 if k > seed else k + 1
        if reliable[neighbour]:
            near_neighbour = angle_between(SO3.from_matrix(R_try), SO3.from_matrix(R[neighbour])) < POSE_JUMP
            current_cost = current_cost if near_neighbour[0] else torch.full_like(current_cost, torch.inf)
            R_try, t_try = R_try[near_neighbour], t_try[near_neighbour]
        (R_new, t_new), new_cost = relocalize(_constraints(inputs, poses, k, reliable), R_try, t_try, scale=scale)
        if new_cost < 0.9 * current_cost:
            R[k], t[k] = R_new, t_new
            n_relocalized += 1
        reliable[k] = new_cost <= max_cost
    return replace(state.params, R=R, t=t), {"relocated": float(n_relocalized)}


def _constraints(inputs: Inputs, poses: Poses, k: int, reliable: Bool[Tensor, " t"]) -> ContourConstraints:
    """Constraints on the pose of frame k by the contours of about 32 reliable frames."""
    others = torch.nonzero(reliable & (torch.arange(len(reliable)) != k))[:, 0]
    others = others[:: max(1, len(others) // 32)]
    contour, reference = inputs.contours[torch.tensor([k])], inputs.contours[others]
    return ContourConstraints(
        (poses.R[others], poses.t[others]), contour, reference, inputs.capture.camera, inputs.radius
    )


def _contour_costs(inputs: Inputs, poses: Poses, scale: float) -> Float[Tensor, " t"]:
    """Robust cost of every frame's tangency gaps with all others; infinite where too few are valid."""
    every = torch.ones(len(poses.R), dtype=torch.bool)
    gaps = [
        _constraints(inputs, poses, k, every).gaps(poses.R[k : k + 1], poses.t[k : k + 1]) for k in range(len(every))
    ]
    return torch.cat([robust_cost(each, scale) for each in gaps])


_WITHOUT_SETTINGS = {
    TryCircularMotion: _try_circular_motion,
    AlignTexture: _align_texture,
    AlignColours: _align_colours,
    TrackTexture: _track_texture,
    SetAside: _set_aside,
    TakeBetter: _take_better,
}
"""The phases that have none."""


def assess(inputs: Inputs, trajectory: Trajectory) -> PoseResult:
    """The result for poses that another method has estimated: lost frames, points and quality as for this method."""
    T_cam_obj = trajectory.T_cam_obj
    t = T_cam_obj.xyz.double()
    poses = Poses(T_cam_obj.rotation.matrix().double(), t / t[:, 2].mean(), torch.zeros((), dtype=torch.float64))
    return finish(Config(), inputs, State(0, poses, None, torch.Generator().manual_seed(0)))


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> PoseResult:
    """The result: poses in the object's unit and frame, surface points, and the quality of the poses."""
    disagreement, posed = _rotation_disagreement(_weighted(cfg, inputs), inputs, state), _posed(state)
    inputs = with_focal_length(inputs, state.params.log_focal)
    found = None if inputs.hidden else _spin(inputs, state.params)
    if found is not None and found.is_better:
        # Matches and contours agree, but matches are wrong about the spin, which contours do not show.
        disagreement = torch.maximum(disagreement, found.angle.abs().double())
    turns = None if inputs.hidden else _turns(inputs, state.params)
    if turns is not None:
        # Matches and contours agree on either side of a gap, but not on the turn between both sides.
        disagreement = disagreement.clamp_min(turns.doubt)
    parts = None if turns is None or turns.is_better else turns.confirmed
    confirmed = state.memory.get("posed") if inputs.hidden else None  # None as well for poses of another method
    solution = Solution(state.params.R, state.params.t, inputs.radius, disagreement, confirmed, parts)
    tracks = _steady_tracks(inputs, state)
    contours = replace(inputs.contours, reliable=inputs.contours.reliable & posed[:, None])
    tracks = tracks.select(posed[tracks.frame])
    return pose_result(inputs.capture, tracks, contours, inputs.mirror_symmetry, solution)


def _rotation_disagreement(cfg: Config, inputs: Inputs, state: State) -> Float[Tensor, " t"]:
    """Angle between the rotation fitted mainly to tracks and the one fitted mainly to contours [radians]; for a
    circular motion, which is found without tracks, `CircularMotion.disagreement`."""
    if "circular" in state.memory:
        return state.memory["circular"]
    fits = []
    for weight in (cfg.frontier_weight / DISAGREEMENT_FACTOR, cfg.frontier_weight * DISAGREEMENT_FACTOR):
        trial = State(0, state.params, None, torch.Generator().manual_seed(0), state.memory)
        for scale in cfg.disagreement_scales:
            current = with_focal_length(inputs, trial.params.log_focal)
            trial.params, _ = adjust_all(replace(cfg, frontier_weight=weight), current, trial, scale)
        fits.append(SO3.from_matrix(trial.params.R).inverse())
    a, b = fits
    return angle_between(b, mean_rotation(b @ a.inverse()) @ a)
