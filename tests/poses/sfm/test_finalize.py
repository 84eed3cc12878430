"""The gauge of stage 1's outcome, and what is said about frames and axes."""

import math
from dataclasses import replace

import pytest
import torch

from tests.lopsided import DISTANCE, KNOBS, tumbling
from tumble.maths.se3 import SE3, SO3
from tumble.poses.result import Observability, PoseResult
from tumble.poses.sfm import finalize, frontier_points
from tumble.poses.sfm.finalize import Solution
from tumble.poses.sfm.tracks import Tracks, followed
from tumble.scene.capture import BACKGROUND, OBJECT, Capture


@pytest.fixture(scope="module")
def outcome() -> PoseResult:
    """True poses and matches, frame 7 without an object and frame 12 turned by 40 degrees without matches."""
    scene = tumbling(24)
    rng = torch.Generator().manual_seed(0)
    pairs = [(t - k, t) for k in (1, 2) for t in range(k, 24) if not {7, 12} & {t - k, t}]
    matches = [scene.match(i, j, rng, noise=0.0, wrong=0.0) for i, j in pairs]
    tracks = followed(matches, torch.full((24,), 5.0))
    scene.capture.masks[7] = 0
    R = scene.T_cam_obj.rotation.matrix().clone()
    R[12] = SO3.exp(torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)).matrix() @ R[12]
    solution = Solution(R, scene.T_cam_obj.xyz / DISTANCE, 0.9 / DISTANCE, torch.zeros(24))
    return finalize.finished(scene.capture, tracks, frontier_points.outlines(scene.capture), solution)


def test_the_object_fills_the_unit_ball(outcome: PoseResult) -> None:
    """Longest axis 0.9 on both sides, and the knobs stay within: the unit is 0.9, about the ellipsoid's centre."""
    assert float((KNOBS[:, :3].norm(dim=-1) + KNOBS[:, 3]).max()) > 0.9, "one knob sticks out"
    true = tumbling(24).T_cam_obj.xyz[:, 2]
    keep = ~outcome.quality.lost
    scale = (true[keep] / outcome.trajectory.T_cam_obj.xyz[keep, 2]).median()
    assert 0.85 < float(scale) < 1.1
    assert float(outcome.points.norm(dim=-1).quantile(0.99)) < 1.05
    assert (outcome.colours - 0.127).abs().max() < 0.01, "code value 100 is 0.127 of linear light"


def test_frames_without_evidence_are_lost_and_bridged(outcome: PoseResult) -> None:
    assert torch.nonzero(outcome.quality.lost)[:, 0].tolist() == [7, 12]
    true = tumbling(24).T_cam_obj.rotation.matrix()
    found = outcome.trajectory.T_cam_obj.rotation.matrix().double()
    for k in (7, 12):
        # Halfway between neighbours of a smooth tumble; the first frame fixes the gauge.
        off = SO3.from_matrix(found[k] @ (true[k] @ true[0].T @ found[0]).T).angle()
        assert off.rad2deg() < 3
    assert outcome.quality.gap[~outcome.quality.lost & ~outcome.quality.gap.isnan()].max() < 1
    kept = ~outcome.quality.lost
    assert outcome.quality.overlap[kept].min() > 0.85
    assert outcome.quality.inliers[12] == 0
    assert outcome.quality.residual[12].isnan()


def test_the_ball_about_a_cube_leaves_a_stray_point_out() -> None:
    corners = torch.tensor([[x, y, z] for x in (0.0, 2) for y in (0.0, 2) for z in (0.0, 2)], dtype=torch.float64)
    centre, radius = finalize._ball(torch.cat([corners.repeat(20, 1), torch.tensor([[9.0, 9, 9]]).double()]))
    torch.testing.assert_close(centre, torch.ones(3).double(), atol=0.02, rtol=0)
    assert float(radius) == pytest.approx(math.sqrt(3), abs=0.02)


def test_poses_at_the_ends_repeat_the_closest() -> None:
    T = SE3(
        SO3.exp(torch.randn(4, 3, generator=torch.Generator().manual_seed(0)).double()).wxyz, torch.rand(4, 3).double()
    )
    bridged = finalize._bridged(T, torch.tensor([True, False, True, False]))
    torch.testing.assert_close(bridged.wxyz[0], T.wxyz[1])
    torch.testing.assert_close(bridged.xyz[2], (T.xyz[1] + T.xyz[3]) / 2)


def test_frames_beyond_a_leap_are_lost() -> None:
    """The first two turned by half a turn, their matches with each other only: nothing else contradicts them."""
    scene = tumbling(24)
    rng = torch.Generator().manual_seed(0)
    pairs = [(t - k, t) for k in (1, 2) for t in range(k, 24) if (t < 2) == (t - k < 2)]
    tracks = followed([scene.match(i, j, rng, wrong=0.0) for i, j in pairs], torch.full((24,), 5.0))
    R = scene.T_cam_obj.rotation.matrix().clone()
    R[:2] = R[:2] @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    solution = Solution(R, scene.T_cam_obj.xyz / DISTANCE, 0.9 / DISTANCE, torch.zeros(24))
    health = finalize.finished(scene.capture, tracks, frontier_points.outlines(scene.capture), solution).quality
    assert torch.nonzero(health.lost)[:, 0].tolist() == [0, 1]
    assert health.verdict == "warn"


def on_an_axis() -> tuple[Capture, Tracks, Solution]:
    """A ball before a still camera; all its points lie on its y axis."""
    scene = tumbling(12)
    line = torch.linspace(-0.8, 0.8, 30, dtype=torch.float64)
    points = torch.stack([0 * line, line, 0 * line], -1)
    camera = scene.capture.camera
    n = len(points)
    R = scene.T_cam_obj.rotation.matrix()
    t = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(12, 3)
    X = points / DISTANCE
    frame, point = torch.arange(12).repeat_interleave(n), torch.arange(n).repeat(12)
    x = torch.einsum("oij,oj->oi", R[frame], X[point]) + t[frame]
    focal, principal = camera.fx_fy_cx_cy.double().split(2)
    tracks = Tracks(frame, point, x[:, :2] / x[:, 2:] * focal + principal)
    disc = (camera.pixel_centers() - principal).norm(dim=-1) < 0.8 / DISTANCE * focal[0]
    masks = torch.where(disc, OBJECT, BACKGROUND).to(torch.uint8).expand(12, -1, -1)
    return replace(scene.capture, masks=masks), tracks, Solution(R, t, 0.8 / DISTANCE, torch.zeros(12))


def test_texture_on_one_axis_leaves_the_turn_about_it_unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing tells how far the ball is turned about the axis that holds all its texture."""
    capture, tracks, solution = on_an_axis()
    sharp = 10 * torch.eye(2, dtype=torch.float64).expand(len(tracks), 2, 2)
    monkeypatch.setattr(finalize.texture_information, "information", lambda capture, tracks: sharp)
    health = finalize.finished(capture, tracks, frontier_points.outlines(capture), solution).quality
    seen = health.observability
    assert seen.unseen
    assert not seen.plain
    # The object frame is that of the first view.
    expected = solution.R[0] @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    assert abs(float(seen.axis.double() @ expected)) > 0.98
    assert seen.sentence.startswith("Rotation about axis (")
    assert health.verdict == "bad"
    assert health.sentence == seen.sentence


def test_a_plain_ball_shows_no_turn() -> None:
    """Grey pictures, round outlines: whatever the matches say, it is not to be believed."""
    capture, tracks, solution = on_an_axis()
    health = finalize.finished(capture, tracks, frontier_points.outlines(capture), solution).quality
    assert health.observability.plain
    assert health.verdict == "bad"
    assert health.sentence.startswith("Rotation is not observable")


def test_a_seen_object_is_said_to_be_seen() -> None:
    fine = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.005, 0.004, 0.003]))
    assert not fine.unseen
    assert fine.sentence == "Rotations are seen about every axis, to about 0.3 degrees about the worst."
