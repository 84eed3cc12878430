"""Stage 1 by the paper's progressive route (section 4.1): tracking frame by frame against a shape learned meanwhile.

The tracker estimates poses in the frame of the virtual camera, which are converted to the true camera (`Config.lift`).
Their quality is computed by a function that the caller passes in, so that both routes of stage 1 are assessed alike.

Frames whose mask failed are not tracked, as if they were not there: a silhouette of the wrong size would set the scale
of all frames, and an empty one would train the shape to be empty. They are lost, as in the other route.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from tumble.engine import State
from tumble.poses.progressive import tracker, virtual_camera
from tumble.poses.result import PoseResult, interpolate_lost
from tumble.scene import OBJECT, Capture, Match, Trajectory

VERSION = 10
VIRTUAL_SIZE = 128
"""Height and width of the virtual frames [pixels]."""
PNP_POINTS = 1000
"""Approximate number of surface points whose projections determine a pose, if it is lifted by RANSAC-EPnP."""
MIN_AREA = 0.02
"""Smallest number of object pixels of a mask that has not failed [median of all masks]. A plate has about a tenth when
seen from the edge."""
MIN_TRACKED = 2
"""Smallest number of frames that can be tracked."""


@dataclass(frozen=True)
class Config(tracker.Config):
    """Settings of the progressive route: those of the tracker, and how poses are lifted to the true camera."""

    lift: Literal["exact", "pnp"] = "exact"
    """exact: in closed form. pnp: by RANSAC-EPnP from points of the shape, as in the paper."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of the progressive route; `gather` creates them."""

    track: tracker.Inputs
    """Inputs of the tracker: the frames that are tracked, and the matches between them."""
    tracked: Bool[Tensor, " t"]
    """Frames of the capture that are tracked; the masks of the others failed."""
    assess: Callable[[Trajectory], PoseResult]
    """Computes points, quality and lost frames from poses in the camera frame."""


def gather(
    capture: Capture,
    matches: Sequence[Match],
    assess: Callable[[Trajectory], PoseResult],
    failed: Bool[Tensor, " t"],
) -> Inputs:
    """Inputs of the route, with the virtual camera aimed at the silhouettes.

    Args:
        capture: Frames and masks, without poses.
        matches: Correspondences between the frames.
        assess: See `Inputs`.
        failed: Frames whose silhouette differs from those of nearby frames, because the mask failed. Masks with hardly
            any object pixels have failed as well.

    Raises:
        ValueError: Too few frames show the object.
    """
    tracked = _with_object(capture.masks) & ~failed
    frames = torch.nonzero(tracked)[:, 0].tolist()
    if len(frames) < MIN_TRACKED:
        raise ValueError(f"the masks of {len(frames)} of {len(tracked)} frames show the object: tracking needs more")
    index = {frame: k for k, frame in enumerate(frames)}
    between = tuple(
        replace(match, i=index[match.i], j=index[match.j]) for match in matches if {match.i, match.j} <= index.keys()
    )
    kept = capture.select(frames)
    aim = virtual_camera.aim_at(kept.masks, kept.camera, size=VIRTUAL_SIZE)
    return Inputs(tracker.Inputs(kept, between, aim), tracked, assess)


def _with_object(masks: UInt8[Tensor, "t h w"]) -> Bool[Tensor, " t"]:
    """Frames whose mask has about as many object pixels as others; an empty or unknown mask has none."""
    area = (masks == OBJECT).flatten(1).sum(1)
    seen = area[area > 0]
    return area > (MIN_AREA * seen.median() if len(seen) else 0)


def length(cfg: Config, inputs: Inputs) -> int:
    return tracker.length(cfg, inputs.track)


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    return tracker.init(cfg, inputs.track, rng)


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, torch.Tensor | float]:
    return tracker.step(cfg, inputs.track, state)


def finish(cfg: Config, inputs: Inputs, state: State) -> PoseResult:
    """Poses in the true camera, with their quality; those of frames that were not tracked are interpolated."""
    found = inputs.assess(_of_all_frames(_lifted(cfg, inputs, state), inputs.tracked))
    return replace(found, quality=replace(found.quality, lost=found.quality.lost | ~inputs.tracked))


def _lifted(cfg: Config, inputs: Inputs, state: State) -> Trajectory:
    """Poses of the tracked frames in the true camera."""
    result = tracker.finish(cfg, inputs.track, state)
    capture = inputs.track.capture
    if cfg.lift == "exact":
        return virtual_camera.lift(result.aim, result.T_aim_obj, capture.light)
    points = virtual_camera.surface_points(result.sdf, PNP_POINTS, state.rng)
    return virtual_camera.by_pnp(points, result.aim, result.T_aim_obj, capture.camera, capture.light)


def _of_all_frames(trajectory: Trajectory, tracked: Bool[Tensor, " t"]) -> Trajectory:
    """Poses of the tracked frames, and interpolated ones of the others."""
    row = (tracked.cumsum(0) - 1).clamp_min(0)
    return Trajectory(interpolate_lost(trajectory.T_cam_obj[row], ~tracked), trajectory.light)
