"""The schedule of the tracker, counted by hand."""

from typing import Any

import pytest

from tumble.poses.progressive import tracker
from tumble.poses.progressive.registration import Motion
from tumble.poses.progressive.tracker import Phases


def test_every_frame_has_its_phases() -> None:
    phases = Phases(shape=2, pose=3, joint=4)
    n = tracker.n_steps(phases, 5)
    assert n == 2 + 4 * 9
    points = [tracker.schedule_at(phases, step) for step in range(n)]
    assert [p.phase for p in points[:11]] == ["shape"] * 4 + ["pose"] * 3 + ["joint"] * 4
    assert [p.index for p in points] == [0, 0] + [index for index in range(1, 5) for _ in range(9)]
    assert [i for i, p in enumerate(points) if p.first] == [4, 13, 22, 31]
    assert [i for i, p in enumerate(points) if p.last] == [1, 10, 19, 28, 37]
    assert [p.phase_progress for p in points[4:11]] == [0, 1 / 3, 2 / 3, 0, 1 / 4, 2 / 4, 3 / 4]
    assert [p.frame_progress for p in points[4:11]] == [k / 7 for k in range(7)]


def test_a_phase_may_have_no_steps() -> None:
    phases = Phases(shape=1, pose=0, joint=2)
    points = [tracker.schedule_at(phases, step) for step in range(tracker.n_steps(phases, 3))]
    assert [p.phase for p in points] == ["shape", "shape", "joint", "joint", "shape", "joint", "joint"]
    assert [p.first for p in points] == [False, False, True, False, False, True, False]


def test_frames_are_tracked_in_both_directions_from_the_start() -> None:
    assert tracker.tracking_order(0, 4) == [0, 1, 2, 3]
    assert tracker.tracking_order(2, 5) == [2, 3, 4, 1, 0]


@pytest.mark.parametrize(
    "changes",
    [
        {"motion": Motion()},  # the default of poses are networks
        {"closing": 1},
        {"motion": "steady", "closing": 1},
        {"start": "matched"},
        {"window": 1},
        {"pose_steps": 0, "joint_steps": 0},
    ],
)
def test_settings_that_cannot_work_are_refused_at_once(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"set|needed"):
        tracker.Config(**changes)
