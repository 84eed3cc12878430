"""Poses of a new frame and of the frames near it, from matches, silhouettes and the present shape.

The first frames are registered together, without a shape, from constant rotations in several directions: two or three
views fit their mirror image about as well (Necker reversal), eight no longer. A new frame starts from several poses,
each adjusted alone against the frames nearest to it; the best one stays. Then all poses of a window are adjusted
together, and now and then those of all frames so far.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tumble.maths import SE3, SO3
from tumble.poses.progressive.adjustment import Priors, Shape, adjusted
from tumble.poses.progressive.anchors import Anchors

STEP = math.radians(10)
"""Rotation of the starts of a new frame from the pose of the frame before [radians]."""
DIRECTIONS = 4
"""Number of these starts, about axes across the view."""
NEAR = 5
"""Number of nearest frames against which a new one is registered; its matches reach back by four."""
FIRST_STEP = math.radians(8)
"""Constant rotation per frame from which the first frames start [radians]."""
FIRST_DIRECTIONS = 8
"""Number of directions of this rotation."""
FIRST_RADIUS = 0.5
"""Radius of the sphere in place of a shape while the first frames are registered [object radius]."""
COARSE = (16.0, 4.0)
"""Factors on the residual from which an observation counts less, before it has its value."""


@dataclass(frozen=True)
class Motion:
    """Settings of the registration."""

    first: int = 8
    """Number of frames that are registered together, without a shape, before the tracking starts."""
    window: int = 12
    """Number of nearest frames that are adjusted with a new one."""
    held: int = 3
    """Number of those farthest from it that keep their poses, unless the window holds all frames."""
    steps: int = 20
    """Largest number of steps of an adjustment."""
    every: int = 8
    """Number of frames after which all frames are adjusted together."""
    depth: float = 0.3
    """Standard deviation of an anchor's depth from the shape's [object radius]."""
    all_depth: float = 1.0
    """The same where all frames are adjusted together, so that silhouettes and matches decide."""
    centre: float = 0.07
    """Standard deviation of the object's centre from the middle of its silhouette [object radius]."""
    distance: float = 0.05
    """Standard deviation of the logarithm of the ratio of neighbouring frames' distances."""
    any_distance: float = 0.15
    """Standard deviation of the logarithm of the ratio of a frame's distance to the initial one."""
    turn: float = 0.15
    """Standard deviation of the rotation between neighbouring frames [radians]."""
    border: float = 0.5
    """Weight of a ray through the silhouette's border; that of a match is at most 1."""
    all_border: float = 1.0
    """The same where all frames are adjusted together."""
    scale: float = 0.5
    """Residual from which an observation counts less [pixels]."""


@dataclass(frozen=True)
class Scene:
    """What poses are registered against."""

    anchors: Anchors
    """Anchors of all frames."""
    shape: Shape
    """Signed distance of the present shape."""
    bound: float
    """Radius of the sphere that contains the object [object radius]."""
    distance: float
    """Initial distance of the object [object radius]."""


def best_start(motion: Motion, anchors: Anchors) -> int:
    """The frame from which tracking starts: the first of those that see the most of each other."""
    n = len(anchors.ray)
    count = min(motion.first, n)
    seen = [float(anchors.select(range(i, i + count)).weight.sum()) for i in range(n - count + 1)]
    return max(range(len(seen)), key=seen.__getitem__)


def register_first(motion: Motion, scene: Scene, T_aim_obj: SE3, frames: Sequence[int]) -> SE3:
    """All poses, with those of the first frames estimated together from constant rotations in several directions."""
    order = sorted(frames)
    local, before = scene.anchors.select(order), T_aim_obj[order]
    free = torch.ones(len(order), dtype=torch.bool)
    sphere = replace(scene, shape=lambda x: x.norm(dim=-1) - FIRST_RADIUS)
    priors = replace(_priors(motion, scene), border=0.0)
    results = []
    for step in _directions(FIRST_STEP, FIRST_DIRECTIONS):
        start = SE3(SO3.exp(torch.arange(len(order))[:, None] * step).wxyz, before.xyz)
        results.append(_adjusted(motion, sphere, local, start, free, priors, (*COARSE, 1.0)))
    found, _ = min(results, key=lambda result: result[1])
    # The first frame keeps its orientation, which defines the object frame.
    return _with(T_aim_obj, order, SE3((found.rotation @ found.rotation[0].inverse()).wxyz, found.xyz))


def register(motion: Motion, scene: Scene, T_aim_obj: SE3, known: Sequence[int]) -> SE3:
    """All poses, with that of the newest of the `known` frames, in the order of tracking, estimated."""
    new = known[-1]
    near = _nearest(known, NEAR)
    local, free = scene.anchors.select(near), torch.tensor(near) == new
    results = []
    for start in _starts(T_aim_obj, known):
        guess = _with(T_aim_obj, [new], start)
        results.append(_adjusted(motion, scene, local, guess[near], free, _priors(motion, scene), (*COARSE, 1.0)))
    found, _ = min(results, key=lambda result: result[1])
    return _with(T_aim_obj, near, found)


def adjust_window(motion: Motion, scene: Scene, T_aim_obj: SE3, known: Sequence[int]) -> SE3:
    """All poses, with those of the frames nearest to the newest one adjusted together."""
    near = _nearest(known, motion.window)
    far = sorted(near, key=lambda frame: -abs(frame - known[-1]))[: motion.held if len(known) > len(near) else 0]
    free = torch.tensor([frame not in far for frame in near])
    found, _ = _adjusted(
        motion, scene, scene.anchors.select(near), T_aim_obj[near], free, _priors(motion, scene), (1.0,)
    )
    return _with(T_aim_obj, near, found)


def adjust_all(motion: Motion, scene: Scene, T_aim_obj: SE3, known: Sequence[int]) -> SE3:
    """All poses, with those of the known frames adjusted together."""
    order, free = sorted(known), torch.ones(len(known), dtype=torch.bool)
    local = scene.anchors.select(order)
    priors = replace(_priors(motion, scene), depth=motion.all_depth, border=motion.all_border)
    found, _ = _adjusted(motion, scene, local, T_aim_obj[order], free, priors, (1.0, 1.0))
    return _with(T_aim_obj, order, found)


def _priors(motion: Motion, scene: Scene) -> Priors:
    names = ("depth", "centre", "distance", "turn", "any_distance", "border", "scale")
    return Priors(**{name: getattr(motion, name) for name in names}, usual_distance=scene.distance)


def _adjusted(
    motion: Motion,
    scene: Scene,
    anchors: Anchors,
    T_aim_obj: SE3,
    free: Tensor,
    priors: Priors,
    factors: Sequence[float],
) -> tuple[SE3, float]:
    """Poses of least cost and their cost, with the residual's scale times each of the factors in turn."""
    scales = [motion.scale * factor for factor in factors]
    return adjusted(anchors, T_aim_obj, free, scene.shape, priors, bound=scene.bound, steps=motion.steps, scales=scales)


def _nearest(known: Sequence[int], n: int) -> list[int]:
    """The frames nearest in time to the newest one and itself, in the order of time."""
    return sorted(sorted(known, key=lambda frame: abs(frame - known[-1]))[:n])


def _directions(step: float, n: int) -> list[Tensor]:
    """Rotation vectors of an angle [radians] about `n` axes across the view."""
    angles = [2 * math.pi * k / n for k in range(n)]
    return [step * torch.tensor([math.cos(angle), math.sin(angle), 0.0]) for angle in angles]


def _starts(T_aim_obj: SE3, known: Sequence[int]) -> list[SE3]:
    """Initial poses of the newest frame: the same pose, steady rotation, and the same pose rotated across the view."""
    back = -1 if known[-1] > known[0] else 1
    before, last = T_aim_obj[[known[-1] + back]], T_aim_obj[[known[-1] + 2 * back]]
    steady = before.rotation @ last.rotation.inverse()
    turns = [steady, *(SO3.exp(step[None]) for step in (torch.zeros(3), *_directions(STEP, DIRECTIONS)))]
    return [SE3((turn @ before.rotation).wxyz, before.xyz) for turn in turns]


def _with(T_aim_obj: SE3, frames: list[int], new: SE3) -> SE3:
    """All poses, those of some frames replaced."""
    wxyz, xyz = T_aim_obj.wxyz.clone(), T_aim_obj.xyz.clone()
    wxyz[frames], xyz[frames] = SO3.from_wxyz(new.wxyz).wxyz, new.xyz
    return SE3(wxyz, xyz)
