"""Stage 1 by the paper's progressive route: a neural shape that grows while the object is followed frame by frame.

The tracker finds poses in the virtual camera; they are lifted to the true camera in closed form. How far they can be
trusted is assessed by whatever judges the other route, which is handed in.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from tumble.engine import State
from tumble.poses.progressive import tracker, virtual_camera
from tumble.poses.result import PoseResult
from tumble.scene import Capture, Match, Trajectory

VERSION = 4
AIM = 128
"""Size of the virtual frames [pixels]."""


@dataclass(frozen=True)
class Config(tracker.Config):
    """Settings of the tracker: the route has no others."""


@dataclass(frozen=True)
class Inputs:
    """A capture without poses, as `gather` makes it."""

    track: tracker.Inputs
    assess: Callable[[Trajectory], PoseResult]
    """Adds points, quality and lost frames to poses in the camera frame."""


def gather(capture: Capture, matches: Sequence[Match], assess: Callable[[Trajectory], PoseResult]) -> Inputs:
    """Aim the virtual camera at the silhouettes.

    Raises:
        ValueError: No frame shows the object.
    """
    aim = virtual_camera.aim_at(capture.masks, capture.camera, size=AIM)
    return Inputs(tracker.Inputs(capture, tuple(matches), aim), assess)


def length(cfg: Config, inputs: Inputs) -> int:
    return tracker.length(cfg, inputs.track)


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    return tracker.init(cfg, inputs.track, rng)


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, torch.Tensor | float]:
    return tracker.step(cfg, inputs.track, state)


def finish(cfg: Config, inputs: Inputs, state: State) -> PoseResult:
    """Poses in the true camera, assessed."""
    found = tracker.finish(cfg, inputs.track, state)
    return inputs.assess(virtual_camera.lift(found.aim, found.T_aim_obj, inputs.track.capture.light))
