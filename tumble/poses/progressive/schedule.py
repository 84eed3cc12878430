"""When frames join stage 1, and what happens to them: the order of frames and of phases, as functions of a number.

A *turn* is what is done for one frame. It begins with steps of the *shape* alone, which are skipped in most turns, then
the frame's *pose* alone, then both *jointly*. The first turn is shape alone.
"""

from dataclasses import dataclass
from typing import Literal

Phase = Literal["shape", "pose", "joint"]


@dataclass(frozen=True)
class Phases:
    """Steps of each phase."""

    shape: int
    pose: int
    joint: int


@dataclass(frozen=True)
class Place:
    """Where in the schedule a step is."""

    turn: int
    """Frames tracked before this one."""
    phase: Phase
    progress: float
    """Of the phase, in [0, 1)."""
    tracked: float
    """Share of this frame's tracking that is done, in [0, 1)."""
    first: bool
    """The first step of the frame's tracking."""
    last: bool
    """The last step of the turn."""


def length(phases: Phases, n_frames: int) -> int:
    """Steps of all turns."""
    return n_frames * phases.shape + (n_frames - 1) * (phases.pose + phases.joint)


def place(phases: Phases, step: int) -> Place:
    """What step number `step` is for."""
    tracking = phases.pose + phases.joint
    if step < phases.shape:
        return Place(0, "shape", step / phases.shape, 0.0, first=False, last=step == phases.shape - 1)
    turn, at = divmod(step - phases.shape, phases.shape + tracking)
    if at < phases.shape:
        return Place(turn + 1, "shape", at / phases.shape, 0.0, first=False, last=False)
    at -= phases.shape
    phase, before, of = ("pose", 0, phases.pose) if at < phases.pose else ("joint", phases.pose, phases.joint)
    return Place(turn + 1, phase, (at - before) / of, at / tracking, first=at == 0, last=at == tracking - 1)


def order(start: int, n_frames: int) -> list[int]:
    """Frames as they are tracked: forward from the first one, then backward from it."""
    return [*range(start, n_frames), *range(start - 1, -1, -1)]
