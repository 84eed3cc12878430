"""Stage 1 by the paper's progressive route (section 4.1): tracking frame by frame against a shape learned meanwhile.

The tracker estimates poses in the frame of the virtual camera, which are converted to the true camera in closed form.
Their quality is computed by a function that the caller passes in, so that both routes of stage 1 are assessed alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from tumble.engine import State
from tumble.poses.progressive import tracker, virtual_camera
from tumble.poses.result import PoseResult
from tumble.scene import Capture, Match, Trajectory

VERSION = 5
VIRTUAL_SIZE = 128
"""Height and width of the virtual frames [pixels]."""


@dataclass(frozen=True)
class Config(tracker.Config):
    """Settings of the progressive route, which are those of the tracker."""


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
    return inputs.assess(virtual_camera.lift(result.aim, result.T_aim_obj, inputs.track.capture.light))
