"""Feature tracks of matches counted by hand, and of matches of a known flow."""

import numpy as np
import pytest
import torch

from tumble.maths import SO3
from tumble.poses.sfm import tracks
from tumble.poses.sfm.tracks import Tracks, chain_matches, concatenate
from tumble.scene.camera import Camera
from tumble.scene.match import Match

A = torch.tensor([[1.05, 0.08], [-0.06, 0.97]], dtype=torch.float64)
SHIFT = torch.tensor([3.0, -2.0], dtype=torch.float64)


def match(i: int, j: int, uv_i: list, uv_j: list, confidence: list | None = None) -> Match:
    tensors = (torch.tensor(uv, dtype=torch.float64).reshape(-1, 2) for uv in (uv_i, uv_j))
    return Match(i, j, *tensors, torch.tensor(confidence or [1.0] * len(uv_i), dtype=torch.float64))


def flowed(uv: torch.Tensor, steps: int) -> torch.Tensor:
    """Positions after some steps of an affine flow."""
    for _ in range(steps):
        uv = uv @ A.T + SHIFT
    return uv


def dense(i: int, j: int, rng: torch.Generator, n: int = 3000) -> Match:
    """Matches of an affine flow from random positions."""
    uv = 60 * torch.rand(n, 2, generator=rng, dtype=torch.float64)
    return Match(i, j, uv, flowed(uv, j - i), torch.rand(n, generator=rng, dtype=torch.float64))


def spacing(n: int) -> torch.Tensor:
    return torch.full((n,), 5.0, dtype=torch.float64)


def observations(tracks: Tracks, point: int) -> dict[int, list[float]]:
    """Positions of one point, by frame."""
    mine = tracks.point == point
    return dict(zip(tracks.frame[mine].tolist(), tracks.uv[mine].tolist(), strict=True))


def test_matches_that_share_a_pixel_become_one_track() -> None:
    tracks = chain_matches(
        [match(0, 1, [[5, 5], [29, 29]], [[6, 5], [20, 20]]), match(1, 2, [[6, 5]], [[7, 5]])], spacing(3)
    )
    assert tracks.n == 2
    by_frame = observations(tracks, int(tracks.point[tracks.frame == 2]))
    assert [by_frame[t] for t in range(3)] == [pytest.approx(uv) for uv in ([5, 5], [6, 5], [7, 5])]


def test_tracks_are_continued_between_matches() -> None:
    """With dense matches that share no pixels, a track of five frames ends where the flow leads."""
    rng = torch.Generator().manual_seed(0)
    tracks = chain_matches([dense(t, t + 1, rng) for t in range(4)], spacing(5))
    first = tracks.frame == 0
    assert int(first.sum()) > 80, "of 12 x 12 cells some leave the part of the frame that has matches"
    lengths, errors = [], []
    for point, uv in zip(tracks.point[first].tolist(), tracks.uv[first], strict=True):
        by_frame = observations(tracks, point)
        lengths.append(len(by_frame))
        last = max(by_frame)
        errors.append(float((flowed(uv, last) - torch.tensor(by_frame[last], dtype=torch.float64)).norm()))
    assert sorted(lengths)[len(lengths) // 2] == 5
    # An affine flow is fitted by affine maps; the regularisation has little effect except at the border of the matches.
    assert sorted(errors)[len(errors) // 2] < 0.02
    assert max(errors) < 0.5


def test_the_nearest_frame_has_precedence_over_farther_ones() -> None:
    """Flow between far frames underestimates motion: it may refine a position, not move it or continue alone."""
    near = [match(0, 1, [[5, 5], [25, 25]], [[8, 5], [28, 25]]), match(1, 2, [[8, 5]], [[11, 5]])]
    lagging = match(0, 2, [[5, 5], [25, 25]], [[9, 5], [29, 25]])
    tracks = chain_matches([*near, lagging], spacing(3))
    assert tracks.uv[tracks.frame == 2].tolist() == [pytest.approx([11, 5])]
    agreeing = match(0, 2, [[5, 5]], [[11.4, 5]])
    tracks = chain_matches([*near, agreeing], spacing(3))
    assert tracks.uv[tracks.frame == 2][0].tolist() == pytest.approx([11.2, 5])


def test_a_frame_without_matches_is_bridged() -> None:
    tracks = chain_matches([match(0, 2, [[5, 5]], [[9, 5]]), match(2, 3, [[9, 5]], [[11, 5]])], spacing(4))
    assert tracks.n == 1
    assert tracks.frame.tolist() == [0, 2, 3]


def test_empty_matches_give_no_tracks() -> None:
    assert chain_matches([match(0, 1, [], [])], spacing(2)).n == 0


def test_of_tracks_that_meet_only_the_older_continues() -> None:
    """Two points of frame 0 coincide in frame 1; one surface point must not have two tracks."""
    tracks = chain_matches(
        [match(0, 1, [[5, 5], [25, 25]], [[11, 6], [11.5, 6.5]]), match(1, 2, [[11, 6]], [[13, 6]])], spacing(3)
    )
    assert len(tracks) == 3


def test_select_and_concatenate_keep_points_distinct() -> None:
    tracks = chain_matches(
        [match(0, 1, [[5, 5], [29, 29]], [[6, 5], [20, 20]]), match(1, 2, [[6, 5]], [[7, 5]])], spacing(3)
    )
    early = tracks.select(tracks.frame < 2)
    assert (early.n, len(early)) == (2, 4)
    late = tracks.select(tracks.frame > 0)
    assert (late.n, len(late)) == (1, 2), "the other point has one observation left"
    both = concatenate(early, late)
    assert (both.n, len(both)) == (3, 6)
    assert both.point[4:].tolist() == [2, 2]


def test_tracks_end_where_matches_disagree() -> None:
    here = [[10.0, 10.0], [10.3, 10.0], [30.0, 30.0], [30.3, 30.0]]
    there = [[12.0, 10.0], [18.0, 10.0], [32.0, 30.0], [32.3, 30.0]]
    tracks = chain_matches([match(0, 1, here, there)], spacing(2))
    assert tracks.n == 1
    assert observations(tracks, 0)[1] == pytest.approx([32.0, 30.0], abs=0.31)


def test_matches_join_tracks_where_they_agree_with_the_poses() -> None:
    """Two tracks of each of 20 points, in frames 0-1 and 3-4, which frame 2 does not see; a tenth of the matches of
    frames 0 and 4 is wrong, and all of those of frames 1 and 3 are.
    """
    rng = torch.Generator().manual_seed(0)
    X = 0.3 * torch.randn(20, 3, generator=rng, dtype=torch.float64)
    turns = torch.linspace(0, 0.8, 5, dtype=torch.float64)[:, None] * torch.tensor([0.2, 1.0, 0.3])
    R, t = SO3.exp(turns.double()).matrix(), torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64).expand(5, 3)
    camera = Camera.from_fov(0.6, 200, 200)
    x = torch.einsum("fij,nj->fni", R, X) + t[:, None]
    focal, principal = camera.fx_fy_cx_cy.double().split(2)
    uv = x[..., :2] / x[..., 2:] * focal + principal
    frame = torch.tensor([0, 1, 3, 4]).repeat_interleave(20)
    point = torch.cat([torch.arange(20), torch.arange(20), 20 + torch.arange(20), 20 + torch.arange(20)])
    found = Tracks(frame, point, uv[frame, torch.arange(20).repeat(4)])
    far = uv[4].clone()
    far[:2] += torch.tensor([30.0, -40.0])
    matches = [
        Match(0, 4, uv[0], far, torch.ones(20)),
        Match(1, 3, uv[1], uv[3].roll(1, 0), torch.ones(20)),
    ]
    keypoints = tracks.gather_keypoints(matches, found, camera, 5)
    index, places, right = keypoints.consistent((0, 2, 4), R[[0, 2, 4]], t[[0, 2, 4]], 1.0)
    assert index.tolist() == [*range(20)]
    assert places.tolist() == [[0, 2]] * 20
    assert right.tolist() == [False] * 2 + [True] * 18
    frames = (0, 1, 3, 4)
    joined, keypoint = keypoints.tracks(frames, R[list(frames)], t[list(frames)], 1.0)
    assert sorted(torch.bincount(joined.point).tolist()) == [2] * 4 + [4] * 18
    assert torch.equal(torch.tensor(frames)[joined.frame], torch.from_numpy(keypoints.frame[keypoint]))
    # Without frames 1 and 3, tracks still go through their other observations.
    joined, _ = keypoints.tracks((0, 4), R[[0, 4]], t[[0, 4]], 1.0)
    assert torch.bincount(joined.point).tolist() == [2] * 18


def test_correspondences_follow_matches_and_tracks_to_known_points() -> None:
    """Keypoint a of frame 0 is matched with frame 1; keypoint b of frame 0 and frame 2 are of one track."""
    found = Tracks(torch.tensor([0, 2]), torch.tensor([0, 0]), torch.tensor([[5.0, 5.0], [7.0, 7.0]]).double())
    matches = [match(0, 1, [[1.0, 1.0], [3.0, 3.0]], [[2.0, 2.0], [4.0, 4.0]])]
    keypoints = tracks.gather_keypoints(matches, found, Camera.from_fov(0.6, 20, 20), 3)
    positions = [tuple(uv) for uv in keypoints.uv.tolist()]
    X = np.full((len(positions), 3), np.nan)
    X[positions.index((2.0, 2.0))] = 1
    X[positions.index((7.0, 7.0))] = 2
    keypoint, points = keypoints.correspondences(0, (1, 2), X)
    assert [positions[k] for k in keypoint] == [(1.0, 1.0), (5.0, 5.0)]
    assert points[:, 0].tolist() == [1, 2]
