"""The schedule of stage 1, counted out by hand."""

from tumble.poses.progressive import tracker
from tumble.poses.progressive.tracker import Phases


def test_every_frame_gets_its_phases() -> None:
    phases = Phases(shape=2, pose=3, joint=4)
    n = tracker.n_steps(phases, 5)
    assert n == 2 + 4 * 9
    places = [tracker.place(phases, step) for step in range(n)]
    assert [p.phase for p in places[:11]] == ["shape"] * 4 + ["pose"] * 3 + ["joint"] * 4
    assert [p.turn for p in places] == [0, 0] + [turn for turn in range(1, 5) for _ in range(9)]
    assert [i for i, p in enumerate(places) if p.first] == [4, 13, 22, 31]
    assert [i for i, p in enumerate(places) if p.last] == [1, 10, 19, 28, 37]
    assert [p.progress for p in places[4:11]] == [0, 1 / 3, 2 / 3, 0, 1 / 4, 2 / 4, 3 / 4]
    assert [p.tracked for p in places[4:11]] == [k / 7 for k in range(7)]


def test_a_phase_may_be_left_out() -> None:
    phases = Phases(shape=1, pose=0, joint=2)
    places = [tracker.place(phases, step) for step in range(tracker.n_steps(phases, 3))]
    assert [p.phase for p in places] == ["shape", "shape", "joint", "joint", "shape", "joint", "joint"]
    assert [p.first for p in places] == [False, False, True, False, False, True, False]


def test_frames_go_both_ways_from_the_start() -> None:
    assert tracker.order(0, 4) == [0, 1, 2, 3]
    assert tracker.order(2, 5) == [2, 3, 4, 1, 0]
