"""Stage 1, the graph route: poses of all frames at once, from matches and silhouettes.

Rotations of pairs, averaged, say roughly how the object turns. Short windows of frames are then adjusted to matches and
frontier points and averaged again, twice with growing windows; at last the whole capture is adjusted, with the frontier
of all pairs of frames found anew in every round. Frames that contradict the others are tried in many other rotations.
Necker's reversal is met where it arises: every window also starts from its mirror image, and the better one stays.

A capture whose outlines and tracks still contradict each other begins anew in other ways; the best is kept.

A focal length that is a guess is found along, whenever all frames are adjusted together.

Unit of length until `finish`: the object's mean distance from the camera.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.engine import State
from tumble.maths import SE3, SO3, angle_between, mean_rotation
from tumble.poses.result import PoseResult
from tumble.poses.sfm import bundle_adjustment, frontier_points, relative_pose
from tumble.poses.sfm.bundle_adjustment import BundleState, Problem
from tumble.poses.sfm.finalize import Solution, finished
from tumble.poses.sfm.loop_closure import comebacks
from tumble.poses.sfm.observations import Inputs, focal_length, on_axis, through
from tumble.poses.sfm.observations import gather as gather
from tumble.poses.sfm.relocalization import FEW, LEAP, Judge, cost, hypotheses, relocate, unbroken
from tumble.poses.sfm.rotation_averaging import average
from tumble.poses.sfm.symmetry import mirrors
from tumble.poses.sfm.tracks import NONE, Tracks, joined, of_match
from tumble.scene import Trajectory

VERSION = 9
CONTRADICTS = 1.5
"""Loss of a frame's outline over the median from which the frame is given a second look: alone, with outlines only, a
good pose gets worse."""
FORGIVEN = 0.1
"""Such loss that is always forgiven: a quarter of a pixel."""
PREFERENCE = 6.0
"""Factor on the weight of outlines when one witness is preferred: without the other neither holds all poses."""
MOST_LOOPS, AGAIN = 60, 12
"""Pairs of frames that see the same side again, and their least distance in time [frames]."""
ROOM = 1.3
"""Radius of the ball about the origin in which the object surely lies, over the object's."""
RELOCALIZED_AT = 0.7
"""Scale of the robust loss where frames are relocalized [pixels]."""
STILL = 0.01
"""Weight of the belief that the object does not turn from one frame to the next, of a match 1."""


@dataclass(frozen=True)
class Start:
    """One way to begin."""

    windows: tuple[int, ...]
    """Sizes of the windows, rising [frames]."""
    frontier: float
    """Weight of a frontier point, of a match 1."""


@dataclass(frozen=True)
class Config:
    """Not in the paper, whose stage 1 is a neural field per frame; values are what measured best."""

    windows: tuple[int, ...] = (6, 12)
    """Sizes of the windows, rising [frames]."""
    others: tuple[Start, ...] = (Start((8, 16), 12.0), Start((6, 12), 5.0))
    """Other ways to begin, for captures that do not settle."""
    settled: float = 0.06
    """Loss under which a capture has settled [pixels^2]: those with median errors of 2 degrees and less came to 0.02 to
    0.07, others to 0.13 and more."""
    window_points: int = 250
    """Most tracks of a window."""
    schedule: tuple[float, ...] = (5.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5)
    """Residual at which the loss starts to forgive, per round of windows [pixels]."""
    rounds: tuple[float, ...] = (5.0, 4.0, 3.0, 2.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5)
    """Likewise, per round of the whole capture."""
    again: tuple[float, ...] = (3.0, 1.5, 1.0, 0.7, 0.5, 0.5, 0.5, 0.5)
    """Likewise, after frames have been relocated."""
    preferring: tuple[float, ...] = (1.0, 0.7, 0.5, 0.5)
    """Likewise, where tracks or outlines are preferred, whose difference tells how far to trust the poses."""
    relocations: int = 2
    """How often contradicting frames are given a second look."""
    frontier: float = 12.0
    """Weight of a frontier point, of a match 1: outlines know nothing of shading, whose pull all matches share."""
    iterations: int = 4
    """Of the adjustment, per round: then the frontier has moved."""
    reach: int = 2
    """Largest distance in time of pairs whose rotation is fitted on its own [frames]."""
    centre: float = 0.25
    """How far the origin is seen from the middle of the silhouette [its radius]."""
    depth: float = 0.1
    """Change of the object's distance, one sigma of its logarithm."""
    pairs: int = 3000
    """Most pairs of frames whose frontier is used at once."""


@dataclass(frozen=True)
class Poses:
    """What this stage finds."""

    R: Float[Tensor, "t 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "t 3"]
    """The object's origin, camera frame [its mean distance]."""
    log_focal: Float[Tensor, ""]
    """Logarithm of the focal length over the capture's: 0 where that is no guess."""


@dataclass(frozen=True)
class AverageRotations:
    """Fit near pairs one by one and average their rotations."""


@dataclass(frozen=True)
class AdjustWindows:
    """Adjust overlapping windows of frames, and average the rotations within them."""

    size: int
    """[frames]"""


@dataclass(frozen=True)
class AdjustAll:
    """One round of bundle adjustment of the whole capture."""

    scale: float
    """Of the robust loss [pixels]."""


@dataclass(frozen=True)
class KeepBest:
    """Keep the poses with the lower loss of these and those of earlier initializations."""

    scale: float
    """Of the robust loss [pixels]."""


@dataclass(frozen=True)
class CloseLoops:
    """Match frames of a body of revolution that see the same side again."""


@dataclass(frozen=True)
class Relocalize:
    """Try other rotations for frames whose contours contradict the others'."""

    scale: float
    """Of the robust loss [pixels]."""


Phase = AverageRotations | AdjustWindows | AdjustAll | KeepBest | CloseLoops | Relocalize


@dataclass(frozen=True)
class Step:
    """One step of the schedule."""

    phase: Phase
    start: int = 0
    """Initialization that it belongs to: 0 is the first, others follow `Config.others`."""


def schedule(cfg: Config) -> list[Step]:
    """All steps, in order."""
    steps: list[Step] = []
    for start, windows in enumerate((cfg.windows, *(other.windows for other in cfg.others))):
        phases = [AverageRotations(), *map(AdjustWindows, windows), *map(AdjustAll, cfg.rounds)]
        steps += [Step(phase, start) for phase in (*phases, KeepBest(cfg.rounds[-1]))]
    for _ in range(cfg.relocations):
        steps += map(Step, (CloseLoops(), Relocalize(RELOCALIZED_AT), *map(AdjustAll, cfg.again)))
    return steps


def length(cfg: Config, inputs: Inputs) -> int:
    return len(schedule(cfg))


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """Every frame as the camera would see an object that does not turn, in the middle of its silhouette."""
    R = torch.eye(3, dtype=torch.float64).repeat(len(inputs.capture), 1, 1)
    t = on_axis(inputs.capture, inputs.shapes)
    log_focal = torch.zeros((), dtype=torch.float64)
    kept = {"R": R, "t": t, "log_focal": log_focal, "loss": torch.full_like(log_focal, torch.inf)}
    return State(0, Poses(R, t, log_focal), None, rng, kept | {f"loop_{name}": x for name, x in vars(NONE).items()})


@torch.no_grad()
def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    now = schedule(cfg)[state.step]
    if now.start > 0:
        if float(state.memory["loss"]) < cfg.settled:
            return {}
        if not isinstance(now.phase, KeepBest):
            cfg = replace(cfg, frontier=cfg.others[now.start - 1].frontier)
    state.params, scalars = _carried_out(now.phase, cfg, through(inputs, state.params.log_focal), state)
    return scalars


def _carried_out(phase: Phase, cfg: Config, inputs: Inputs, state: State) -> "Outcome":
    match phase:
        case AverageRotations():
            return _pairs(cfg, inputs, state)
        case AdjustWindows(size):
            return _windows(cfg, inputs, state, size)
        case AdjustAll(scale):
            return adjust_all(cfg, inputs, state, scale)
        case KeepBest(scale):
            return _keep(cfg, inputs, state, scale)
        case CloseLoops():
            return _loops(inputs, state)
        case Relocalize(scale):
            return _relocate(inputs, state, scale)


# Phases ---------------------------------------------------------------------------------------------------------------

Outcome = tuple[Poses, dict[str, Tensor | float]]


def _pairs(cfg: Config, inputs: Inputs, state: State) -> Outcome:
    """Fit near pairs one by one and average their rotations."""
    near = [m for m in inputs.matches if abs(m.j - m.i) <= cfg.reach and len(m) >= relative_pose.LEAST]
    if not near:
        return state.params, {"pairs": 0.0}
    fits = relative_pose.fit(near, inputs.shapes, inputs.capture.camera, most=150)
    weight = (fits.inliers + 1) / (fits.j - fits.i).abs()
    # A film is smooth: where matches do not say how it goes on, it is first believed to stand still.
    n = len(inputs.capture)
    before = torch.arange(n - 1)
    still = torch.eye(3, dtype=weight.dtype).expand(n - 1, 3, 3)
    i, j = torch.cat([fits.i, before]), torch.cat([fits.j, before + 1])
    weight = torch.cat([weight, torch.full((n - 1,), STILL, dtype=weight.dtype)])
    found = average(i, j, torch.cat([fits.R_j_i, still]), weight, n_frames=n)
    poses = replace(state.params, R=found.R_cam_obj, t=on_axis(inputs.capture, inputs.shapes))
    return poses, {"pairs": float(len(fits))}


def _windows(cfg: Config, inputs: Inputs, state: State, size: int) -> Outcome:
    """Adjust overlapping windows, each also from its mirror image, and average the rotations within them."""
    n, size = len(inputs.capture), min(size, len(inputs.capture))
    first = sorted({*range(0, n - size + 1, max(1, size // 4)), n - size})
    frames = torch.tensor(first)[:, None] + torch.arange(size)
    tracks, group = _cut(inputs.tracks, frames, cfg.window_points, state.rng)
    R = state.params.R[frames]
    middle = R[:, size // 2, None]
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=R.dtype))
    best, least = R, torch.full((len(frames),), torch.inf, dtype=R.dtype)
    for start in (R, flip @ R @ middle.mT @ flip @ middle):
        scene = BundleState(start, on_axis(inputs.capture, inputs.shapes)[frames], torch.zeros(0, 3, dtype=R.dtype))
        for scale in cfg.schedule:
            scene, price = _round(cfg, inputs, scene, tracks, group, frames, scale)
        best = torch.where((price < least)[:, None, None, None], scene.R, best)
        least = torch.minimum(price, least)
    a, b = torch.triu_indices(size, size, 1)
    relative = best[:, b] @ best[:, a].mT
    i, j = frames[:, a].flatten(), frames[:, b].flatten()
    found = average(i, j, relative.flatten(0, 1), torch.ones(len(i), dtype=R.dtype), n_frames=n)
    return replace(state.params, R=found.R_cam_obj), {"loss": least.mean()}


def _cut(tracks: Tracks, frames: Int64[Tensor, "g f"], most: int, rng: torch.Generator) -> tuple[Tracks, Tensor]:
    """The longest tracks of every window, with frames counted over all windows; also the window of every point."""
    size = frames.shape[1]
    parts, groups = [], []
    for number, first in enumerate(frames[:, 0].tolist()):
        part = tracks.select((tracks.frame >= first) & (tracks.frame < first + size))
        if part.n > most:
            rank = torch.bincount(part.point) + torch.rand(part.n, generator=rng)
            chosen = torch.zeros(part.n, dtype=torch.bool)
            chosen[rank.topk(most).indices] = True
            part = part.select(chosen[part.point])
        parts.append(replace(part, frame=part.frame - first + number * size))
        groups.append(torch.full((part.n,), number))
    return joined(*parts), torch.cat(groups)


def adjust_all(cfg: Config, inputs: Inputs, state: State, scale: float) -> Outcome:
    """One round of adjusting all frames together."""
    poses = state.params
    frames = torch.arange(len(inputs.capture))[None]
    free = torch.zeros(1, dtype=poses.R.dtype) if inputs.capture.focal_guessed else None
    scene = BundleState(poses.R[None], poses.t[None], torch.zeros(0, 3, dtype=poses.R.dtype), free)
    tracks = inputs.tracks
    if len(state.memory.get("loop_point", ())):
        tracks = joined(tracks, Tracks(*(state.memory[f"loop_{name}"] for name in ("frame", "point", "uv"))))
    group = torch.zeros(tracks.n, dtype=torch.long)
    guess = -float(poses.log_focal)
    scene, price = _round(cfg, inputs, scene, tracks, group, frames, scale, state.rng, guess)
    log_focal = poses.log_focal if scene.log_focal is None else poses.log_focal + scene.log_focal[0]
    said = {} if scene.log_focal is None else {"focal": focal_length(inputs.capture) * scene.log_focal[0].exp()}
    return Poses(scene.R[0], scene.t[0], log_focal), {"loss": price.mean(), **said}


def _keep(cfg: Config, inputs: Inputs, state: State, scale: float) -> Outcome:
    """The better of these poses and those of other ways to begin."""
    alone = State(0, state.params, None, torch.Generator().manual_seed(0))
    loss, memory = torch.as_tensor(adjust_all(cfg, inputs, alone, scale)[1]["loss"]), state.memory
    if float(loss) < float(memory["loss"]):
        memory |= {**vars(state.params), "loss": loss}
    return Poses(**{name: memory[name] for name in vars(state.params)}), {"loss": memory["loss"]}


def _loops(inputs: Inputs, state: State) -> Outcome:
    """Points that are seen again when a body of revolution comes round: its outlines do not tell how it turned."""
    if not mirrors(inputs.capture.masks).revolves:
        return state.params, {}
    R, t = state.params.R.float(), state.params.t.float() / (ROOM * inputs.radius)
    trajectory = Trajectory(SE3.from_rotation(SO3.from_matrix(R), t), inputs.capture.light)
    found = comebacks(inputs.capture, trajectory, inputs.matcher, count=MOST_LOOPS, gap=AGAIN)
    for name, x in vars(joined(NONE, *(of_match(match) for match in found))).items():
        state.memory[f"loop_{name}"] = x
    return state.params, {"loops": float(len(found))}


def _round(
    cfg: Config,
    inputs: Inputs,
    scene: BundleState,
    tracks: Tracks,
    group: Tensor,
    frames: Int64[Tensor, "g f"],
    scale: float,
    rng: torch.Generator | None = None,
    guess: float = 0.0,
) -> tuple[BundleState, Float[Tensor, " g"]]:
    """Find the frontier, triangulate, adjust; also the loss per observation of every group [pixels^2]."""
    g, f = frames.shape
    R, t, camera = scene.R.flatten(0, 1), scene.t.flatten(0, 1), inputs.capture.camera
    a, b = torch.triu_indices(f, f, 1)
    if rng is not None and len(a) > cfg.pairs:
        chosen = torch.randperm(len(a), generator=rng)[: cfg.pairs]
        a, b = a[chosen], b[chosen]
    begin = torch.arange(g)[:, None] * f
    pairs = torch.stack([(begin + a).flatten(), (begin + b).flatten()], 1)
    flat = frames.flatten()
    touching = frontier_points.frontier(R, t, camera, inputs.outline[flat], radius=inputs.radius, pairs=pairs)
    both = joined(tracks, touching)
    weight = torch.cat([torch.ones(len(tracks)), torch.full((len(touching),), cfg.frontier)]).double()
    group = torch.cat([group, touching.frame[::2] // f])
    sigma = cfg.centre * inputs.shapes.radius[frames] * focal_length(inputs.capture)
    centre, reach = inputs.shapes.centre[frames], 1.5 * inputs.radius
    problem = Problem(camera, both, group, weight, centre, sigma, cfg.depth, reach, guess)
    X = bundle_adjustment.triangulate(both, R, t, camera, inputs.shapes.radius[flat])
    moved, price = bundle_adjustment.adjust(problem, replace(scene, X=X), steps=cfg.iterations, scale=scale)
    total = torch.zeros(g, dtype=torch.float64).index_add_(0, group[both.point], weight)
    return moved, price / total.clamp_min(1)


def _relocate(inputs: Inputs, state: State, scale: float) -> Outcome:
    """Try other rotations for every frame that contradicts the rest, outwards from those that agree best."""
    R, t = state.params.R.clone(), state.params.t.clone()
    n, camera = len(R), inputs.capture.camera

    def judge(k: int, trusted: Tensor) -> Judge:
        others = torch.nonzero(trusted & (torch.arange(n) != k))[:, 0]
        others = others[:: max(1, len(others) // 32)]
        return Judge(
            (R[others], t[others]), inputs.outline[torch.tensor([k])], inputs.outline[others], camera, inputs.radius
        )

    every = torch.ones(n, dtype=torch.bool)
    before = torch.stack([cost(judge(k, every).gaps(R[k : k + 1], t[k : k + 1]), scale)[0] for k in range(n)])
    stretch = unbroken(R, every)
    calm = torch.nn.functional.avg_pool1d(before.nan_to_num(posinf=9.0)[None], 5, 1, 2, count_include_pad=False)[0]
    seed = int(torch.where(stretch, calm, torch.inf).argmin())
    limit = max(CONTRADICTS * float(before.median()), FORGIVEN)
    # Frames that went astray together agree with each other: only those beyond doubt may judge.
    trusted = (before <= limit) & stretch
    turns, middle = hypotheses(), on_axis(inputs.capture, inputs.shapes)
    changed = 0
    for k in [*range(seed, n), *range(seed - 1, -1, -1)]:
        if trusted[k] or int(trusted.sum()) < FEW:
            continue
        near = [i for i in (k, k - 1, k + 1) if 0 <= i < n]
        R_try = torch.cat([R[k : k + 1], *(turns @ R[i] for i in near)])
        t_try = torch.cat([t[k : k + 1], (middle[k] * t[near, 2].mean()).expand(len(R_try) - 1, 3)])
        now = cost(judge(k, trusted).gaps(R_try[:1], t_try[:1]), scale)[0]
        inner = k - 1 if k > seed else k + 1
        if trusted[inner]:
            smooth = angle_between(SO3.from_matrix(R_try), SO3.from_matrix(R[inner])) < LEAP
            now = now if smooth[0] else torch.full_like(now, torch.inf)
            R_try, t_try = R_try[smooth], t_try[smooth]
        (R_new, t_new), after = relocate(judge(k, trusted), R_try, t_try, scale=scale)
        if after < 0.9 * now:
            R[k], t[k] = R_new, t_new
            changed += 1
        trusted[k] = after <= limit
    return replace(state.params, R=R, t=t), {"relocated": float(changed)}


def assess(inputs: Inputs, trajectory: Trajectory) -> PoseResult:
    """Poses of another route as if this one had found them."""
    T_cam_obj = trajectory.T_cam_obj
    t = T_cam_obj.xyz.double()
    poses = Poses(T_cam_obj.rotation.matrix().double(), t / t[:, 2].mean(), torch.zeros((), dtype=torch.float64))
    return finish(Config(), inputs, State(0, poses, None, torch.Generator().manual_seed(0)))


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> PoseResult:
    """Poses in the object's own unit and frame, its points, and how far to trust them."""
    drift, inputs = _drift(cfg, inputs, state), through(inputs, state.params.log_focal)
    solution = Solution(state.params.R, state.params.t, inputs.radius, drift)
    return finished(inputs.capture, inputs.tracks, inputs.outline, solution)


def _drift(cfg: Config, inputs: Inputs, state: State) -> Float[Tensor, " t"]:
    """Angle between the rotations that tracks and outlines, the two witnesses, would each have preferred [radians]."""
    preferred = []
    for weight in (cfg.frontier / PREFERENCE, cfg.frontier * PREFERENCE):
        alone = State(0, state.params, None, torch.Generator().manual_seed(0), state.memory)
        for scale in cfg.preferring:
            seen = through(inputs, alone.params.log_focal)
            alone.params, _ = adjust_all(replace(cfg, frontier=weight), seen, alone, scale)
        preferred.append(SO3.from_matrix(alone.params.R).inverse())
    a, b = preferred
    return angle_between(b, mean_rotation(b @ a.inverse()) @ a)
