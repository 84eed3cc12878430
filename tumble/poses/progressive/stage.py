"""Stage 1, the paper's route, with the outcome of the graph route: `track`, lifted and judged alike.

The two routes are compared on the same captures in `benchmarks/poses.md`; the graph route is the default.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tumble.engine.loop import State
from tumble.poses.progressive import tracker, virtual_camera
from tumble.poses.progressive.lift import lift
from tumble.poses.progressive.tracker import Config
from tumble.poses.sfm import stage
from tumble.poses.sfm.finalize import Tracked
from tumble.scene.capture import Capture
from tumble.scene.match import Match

VERSION = 3
AIM = 128
"""Size of the virtual frames [pixels]."""


@dataclass(frozen=True)
class Inputs:
    """A capture as either route wants it; `gather` makes it."""

    track: tracker.Inputs
    graph: stage.Inputs


def gather(capture: Capture, matches: Sequence[Match]) -> Inputs:
    """What is needed to track a capture, and to judge the outcome.

    Raises:
        ValueError: No frame shows the object.
    """
    judging = stage.gather(capture, matches)
    aim = virtual_camera.aim_at(capture.masks, capture.camera, size=AIM)
    return Inputs(tracker.Inputs(capture, tuple(matches), aim), judging)


def length(cfg: Config, inputs: Inputs) -> int:
    return tracker.length(cfg, inputs.track)


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    return tracker.init(cfg, inputs.track, rng)


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, torch.Tensor | float]:
    return tracker.step(cfg, inputs.track, state)


def finish(cfg: Config, inputs: Inputs, state: State) -> Tracked:
    """Poses in the true camera, by the closed form, as the graph route hands them on."""
    found = tracker.finish(cfg, inputs.track, state)
    return stage.judged(inputs.graph, lift(found.aim, found.T_aim_obj, inputs.track.capture.light))
