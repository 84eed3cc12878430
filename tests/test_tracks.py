"""Chains of matches, by hand."""

import pytest
import torch

from tumble.match import Match
from tumble.tracks import anchored, build_tracks, joined


def match(i: int, j: int, uv_i: list, uv_j: list, confidence: list | None = None) -> Match:
    tensors = (torch.tensor(uv, dtype=torch.float64).reshape(-1, 2) for uv in (uv_i, uv_j))
    return Match(i, j, *tensors, torch.tensor(confidence or [1.0] * len(uv_i), dtype=torch.float64))


def test_matches_that_meet_become_one_track() -> None:
    tracks = build_tracks([match(0, 1, [[5, 5], [9, 9]], [[6, 5], [20, 20]]), match(1, 2, [[6, 5]], [[7, 5]])])
    assert tracks.n == 2
    first = tracks.point[(tracks.uv == torch.tensor([5.0, 5.0])).all(1)]
    mine = tracks.point == first
    assert sorted(tracks.frame[mine].tolist()) == [0, 1, 2]
    assert sorted(tracks.uv[mine, 0].tolist()) == [5, 6, 7]


def test_no_track_is_in_two_places_of_one_frame() -> None:
    """The ring 0 -> 1 -> 2 -> 0 ends elsewhere: its least confident link breaks."""
    ring = [
        match(0, 1, [[5, 5]], [[6, 5]], [0.9]),
        match(1, 2, [[6, 5]], [[7, 5]], [0.8]),
        match(0, 2, [[30, 30]], [[7, 5]], [0.1]),
    ]
    tracks = build_tracks(ring)
    assert tracks.n == 1
    assert sorted(tracks.uv[:, 0].tolist()) == [5, 6, 7]


def test_nothing_makes_no_tracks() -> None:
    assert build_tracks([match(0, 1, [], [])]).n == 0


def test_selection_and_union_keep_points_apart() -> None:
    tracks = build_tracks([match(0, 1, [[5, 5], [9, 9]], [[6, 5], [20, 20]]), match(1, 2, [[6, 5]], [[7, 5]])])
    early = tracks.select(tracks.frame < 2)
    assert (early.n, len(early)) == (2, 4)
    late = tracks.select(tracks.frame > 0)
    assert (late.n, len(late)) == (1, 2), "the other point has one observation left"
    both = joined(early, late)
    assert (both.n, len(both)) == (3, 6)
    assert both.point[4:].tolist() == [2, 2]


def test_anchors_follow_a_smooth_flow() -> None:
    """Dense matches of an affine flow from jittered places: an anchor ends where the flow takes it."""
    rng = torch.Generator().manual_seed(0)
    A = torch.tensor([[1.05, 0.08], [-0.06, 0.97]], dtype=torch.float64)

    def dense(j: int) -> Match:
        uv = 40 * torch.rand(1500, 2, generator=rng, dtype=torch.float64)
        flow = uv @ torch.linalg.matrix_power(A, j).T + torch.tensor([3.0, -2.0]) * j
        return Match(0, j, uv, flow, torch.rand(1500, generator=rng, dtype=torch.float64))

    moved = anchored([dense(1), dense(2)], torch.full((3,), 5.0))
    starts = [set(map(tuple, m.uv_i.tolist())) for m in moved]
    assert len(starts[0] & starts[1]) > 40, "both matches start from the same anchors"
    for m in moved:
        true = m.uv_i @ torch.linalg.matrix_power(A, m.j).T + torch.tensor([3.0, -2.0]) * m.j
        # Four matches within 1.2 pixels; the flow's gradient is at most 0.2.
        assert (m.uv_j - true).norm(dim=-1).quantile(0.9) < 0.1
    assert build_tracks(moved).n == len(starts[0] | starts[1])


def test_anchors_where_matches_disagree_are_dropped() -> None:
    here = [[10.0, 10.0], [10.3, 10.0], [30.0, 30.0], [30.3, 30.0]]
    there = [[12.0, 10.0], [18.0, 10.0], [32.0, 30.0], [32.3, 30.0]]
    (moved,) = anchored([match(0, 1, here, there)], torch.full((2,), 5.0))
    assert len(moved) == 1
    assert moved.uv_i[0].tolist() == pytest.approx([30.0, 30.0], abs=0.31)
