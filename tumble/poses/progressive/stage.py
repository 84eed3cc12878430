"""Stage 1 by the paper's progressive route (section 4.1): tracking frame by frame against a shape learned meanwhile.

The tracker estimates poses in the frame of the virtual camera, which are converted to the true camera (`Config.lift`).
Their quality is computed by a function that the caller passes in, so that both routes of stage 1 are assessed alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch

from tumble.engine import State
from tumble.poses.progressive import tracker, virtual_camera
from tumble.poses.result import PoseResult
from tumble.scene import Capture, Match, Trajectory

VERSION = 9
VIRTUAL_SIZE = 128
"""Height and width of the virtual frames [pixels]."""
PNP_POINTS = 1000
"""Approximate number of surface points whose projections determine a pose, if it is lifted by RANSAC-EPnP."""


@dataclass(frozen=True)
class Config(tracker.Config):
    """Settings of the progressive route: those of the tracker, and how poses are lifted to the true camera."""

    lift: Literal["exact", "pnp"] = "exact"
    """exact: in closed form. pnp: by RANSAC-EPnP from points of the shape, as in the paper."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of the progressive route; `gather` creates them."""

    track: tracker.Inputs
    """Inputs of the tracker."""
    assess: Callable[[Trajectory], PoseResult]
    """Computes points, quality and lost frames from poses in the camera frame."""


def gather(capture: Capture, matches: Sequence[Match], assess: Callable[[Trajectory], PoseResult]) -> Inputs:
    """Inputs of the route, with the virtual camera aimed at the silhouettes.

    Args:
        capture: Frames and masks, without poses.
        matches: Correspondences between the frames.
        assess: See `Inputs`.

    Raises:
        ValueError: No frame shows the object.
    """
    aim = virtual_camera.aim_at(capture.masks, capture.camera, size=VIRTUAL_SIZE)
    return Inputs(tracker.Inputs(capture, tuple(matches), aim), assess)


def length(cfg: Config, inputs: Inputs) -> int:
    return tracker.length(cfg, inputs.track)


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    return tracker.init(cfg, inputs.track, rng)


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, torch.Tensor | float]:
    return tracker.step(cfg, inputs.track, state)


def finish(cfg: Config, inputs: Inputs, state: State) -> PoseResult:
    """Poses in the true camera, with their quality."""
    result = tracker.finish(cfg, inputs.track, state)
    capture = inputs.track.capture
    if cfg.lift == "exact":
        return inputs.assess(virtual_camera.lift(result.aim, result.T_aim_obj, capture.light))
    points = virtual_camera.surface_points(result.sdf, PNP_POINTS, state.rng)
    return inputs.assess(virtual_camera.by_pnp(points, result.aim, result.T_aim_obj, capture.camera, capture.light))
