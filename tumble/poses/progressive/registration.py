"""Poses of a new frame and of the newest frames, from matches, silhouettes and the present shape.

A new frame starts from several poses, each adjusted alone against the frames before it; the best one stays. Then all
poses of a window are adjusted together. As long as the window holds all frames, its mirror image is tried as well: two
or three views of a shape that is not known yet fit their mirror image about as well (Necker reversal).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tumble.maths import SE3, SO3
from tumble.poses.progressive.adjustment import Anchors, Priors, Shape, adjusted

STEP = math.radians(10)
"""Rotation of the starts of a new frame from the pose of the frame before [radians]."""
DIRECTIONS = 4
"""Number of these starts, about axes across the view."""
NEAR = 5
"""Number of newest frames against which a new one is registered; its matches reach back by four."""


@dataclass(frozen=True)
class Motion:
    """Settings of the registration."""

    window: int = 12
    """Number of newest frames that are adjusted together."""
    held: int = 3
    """Number of the oldest of them that keep their poses, unless the window holds all frames."""
    steps: int = 10
    """Largest number of steps of an adjustment."""
    every: int = 8
    """Number of frames after which all frames are adjusted together."""
    depth: float = 0.3
    """Standard deviation of an anchor's depth from the shape's [object radius]."""
    centre: float = 0.1
    """Standard deviation of the object's centre from the middle of its silhouette [object radius]."""
    distance: float = 0.05
    """Standard deviation of the logarithm of the distance between neighbouring frames."""
    border: float = 0.5
    """Weight of a ray through the silhouette's border; that of a match is at most 1."""
    scale: float = 2.0
    """Residual from which an observation counts less [pixels]."""

    @property
    def priors(self) -> Priors:
        """What holds poses and depths besides the observations."""
        return Priors(self.depth, self.centre, self.distance, self.border, self.scale)


def register(
    motion: Motion, anchors: Anchors, T_aim_obj: SE3, known: Sequence[int], shape: Shape, *, bound: float
) -> SE3:
    """Poses of all frames with that of the newest of the `known` ones, in the order of tracking, estimated."""
    near = list(known[-NEAR:])
    local = anchors.select(near)
    free = torch.arange(len(near)) == len(near) - 1
    best: tuple[float, SE3] | None = None
    for start in _starts(T_aim_obj, known):
        guess = _with(T_aim_obj, [known[-1]], start)
        scales = (4 * motion.scale, motion.scale)
        found, cost = adjusted(
            local, guess[near], free, shape, motion.priors, bound=bound, steps=motion.steps, scales=scales
        )
        if best is None or cost < best[0]:
            best = cost, found[[-1]]
    assert best is not None, "there are several starts"
    return _with(T_aim_obj, [known[-1]], best[1])


def adjust_window(
    motion: Motion, anchors: Anchors, T_aim_obj: SE3, known: Sequence[int], shape: Shape, *, bound: float
) -> SE3:
    """Poses of all frames with those of the newest ones adjusted together."""
    near = list(known[-motion.window :])
    local, every = anchors.select(near), len(near) == len(known)
    free = torch.arange(len(near)) >= (0 if every else motion.held)
    candidates = [T_aim_obj[near]]
    if every:
        candidates.append(_mirrored(candidates[0]))
    results = [
        adjusted(local, T, free, shape, motion.priors, bound=bound, steps=motion.steps, scales=(motion.scale,) * 2)
        for T in candidates
    ]
    found, _ = min(results, key=lambda result: result[1])
    return _with(T_aim_obj, near, found)


def adjust_all(motion: Motion, anchors: Anchors, T_aim_obj: SE3, known: Sequence[int], shape: Shape, *, bound: float) -> SE3:
    """Poses of all frames with those of the known ones adjusted together."""
    free = torch.ones(len(known), dtype=torch.bool)
    order = sorted(known)
    found, _ = adjusted(
        anchors.select(order), T_aim_obj[order], free, shape, motion.priors, bound=bound, steps=motion.steps,
        scales=(motion.scale,) * 2,
    )
    return _with(T_aim_obj, order, found)


def _starts(T_aim_obj: SE3, known: Sequence[int]) -> list[SE3]:
    """Initial poses of the newest frame: steady rotation, the same pose, and this one rotated in several directions."""
    back = -1 if known[-1] > known[0] else 1
    before = T_aim_obj[[known[-1] + back]]
    starts = [before]
    if known[-1] + 2 * back in known:
        last = before.rotation @ T_aim_obj[[known[-1] + 2 * back]].rotation.inverse()
        starts.append(SE3((last @ before.rotation).wxyz, before.xyz))
    for k in range(DIRECTIONS):
        angle = 2 * math.pi * k / DIRECTIONS
        step = SO3.exp(STEP * torch.tensor([[math.cos(angle), math.sin(angle), 0.0]]))
        starts.append(SE3((step @ before.rotation).wxyz, before.xyz))
    return starts


def _mirrored(T_aim_obj: SE3) -> SE3:
    """Motion of the mirror image at the plane across the view through the centre of the first frame's object."""
    R = T_aim_obj.rotation.matrix()
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=R.dtype))
    mirrored = mirror @ (R @ R[0].mT) @ mirror @ R[0]
    return SE3(SO3.from_matrix(mirrored).wxyz, T_aim_obj.xyz)


def _with(T_aim_obj: SE3, frames: list[int], new: SE3) -> SE3:
    """All poses, those of some frames replaced."""
    wxyz, xyz = T_aim_obj.wxyz.clone(), T_aim_obj.xyz.clone()
    wxyz[frames], xyz[frames] = SO3.from_wxyz(new.wxyz).wxyz, new.xyz
    return SE3(wxyz, xyz)
