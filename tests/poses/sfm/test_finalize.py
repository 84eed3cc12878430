"""Last step of stage 1: object frame and unit, lost frames, and the observability of rotations."""

import math
from dataclasses import replace

import pytest
import torch

from tests.lopsided import DISTANCE, KNOBS, tumbling
from tumble.maths.directions import random_rotation
from tumble.maths.se3 import SE3, SO3
from tumble.poses.result import Observability, PoseResult
from tumble.poses.sfm import bundle_adjustment, finalize, frontier_points
from tumble.poses.sfm.finalize import Solution
from tumble.poses.sfm.symmetry import mirror_symmetry
from tumble.poses.sfm.tracks import Tracks, chain_matches, concatenate
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture
from tumble.synthetic import trajectories


@pytest.fixture(scope="module")
def result() -> PoseResult:
    """True poses and matches, frame 7 without an object and frame 12 rotated by 40 degrees without matches."""
    scene = tumbling(24)
    rng = torch.Generator().manual_seed(0)
    pairs = [(t - k, t) for k in (1, 2) for t in range(k, 24) if not {7, 12} & {t - k, t}]
    matches = [scene.match(i, j, rng, noise=0.0, wrong=0.0) for i, j in pairs]
    tracks = chain_matches(matches, torch.full((24,), 5.0))
    scene.capture.masks[7] = 0
    R = scene.T_cam_obj.rotation.matrix().clone()
    R[12] = SO3.exp(torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)).matrix() @ R[12]
    solution = Solution(R, scene.T_cam_obj.xyz / DISTANCE, 0.9 / DISTANCE, torch.zeros(24))
    return finalize.pose_result(
        scene.capture,
        tracks,
        frontier_points.convex_contours(scene.capture),
        mirror_symmetry(scene.capture.masks),
        solution,
    )


def test_the_object_fills_the_unit_sphere(result: PoseResult) -> None:
    """The longest semi-axis is 0.9 and the knobs hardly reach farther: the unit is 0.9, about the centre."""
    assert float((KNOBS[:, :3].norm(dim=-1) + KNOBS[:, 3]).max()) > 0.9, "one knob sticks out"
    true = tumbling(24).T_cam_obj.xyz[:, 2]
    keep = ~result.quality.lost
    scale = (true[keep] / result.trajectory.T_cam_obj.xyz[keep, 2]).median()
    assert 0.85 < float(scale) < 1.1
    assert float(result.points.norm(dim=-1).quantile(0.99)) < 1.05
    assert (result.colours - 0.127).abs().max() < 0.01, "code value 100 is 0.127 of linear light"


def test_a_sphere_that_the_silhouettes_contradict_is_replaced_by_that_of_the_hull() -> None:
    """Few frontier points, where hands hide contours, may give a sphere of half the size."""
    scene, lost = tumbling(24), torch.zeros(24, dtype=torch.bool)
    solution = Solution(scene.T_cam_obj.rotation.matrix(), scene.T_cam_obj.xyz / DISTANCE, 0.7 / DISTANCE, lost * 0.0)
    true = torch.tensor(0.9 / DISTANCE, dtype=torch.float64)
    origin = torch.zeros(3, dtype=torch.float64)
    centre, radius = finalize._better_sphere(scene.capture, solution, (origin, 0.5 * true), lost)
    assert centre.norm() < 0.25 * true, "knobs stick out"
    assert 0.9 * true < radius < 1.2 * true
    good = origin, 1.05 * true
    assert finalize._better_sphere(scene.capture, solution, good, lost) is good


def test_frames_without_observations_are_lost_and_interpolated(result: PoseResult) -> None:
    assert torch.nonzero(result.quality.lost)[:, 0].tolist() == [7, 12]
    true = tumbling(24).T_cam_obj.rotation.matrix()
    found = result.trajectory.T_cam_obj.rotation.matrix().double()
    for k in (7, 12):
        # Halfway between neighbours of a smooth tumble, relative to the first frame.
        error = SO3.from_matrix(found[k] @ (true[k] @ true[0].T @ found[0]).T).angle()
        assert error.rad2deg() < 3
    assert result.quality.tangency_gap[~result.quality.lost & ~result.quality.tangency_gap.isnan()].max() < 1
    kept = ~result.quality.lost
    assert result.quality.overlap[kept].min() > 0.85
    assert result.quality.inliers[12] == 0
    assert result.quality.residual[12].isnan()


def test_a_frame_whose_matches_contradict_its_pose_is_lost() -> None:
    """Its contour agrees with those of the others."""
    scene, rng = tumbling(24), torch.Generator().manual_seed(0)
    matches = [scene.match(t - k, t, rng, noise=0.0, wrong=0.0) for k in (1, 2) for t in range(k, 24)]
    tracks = chain_matches(matches, torch.full((24,), 5.0))
    shift = torch.tensor([14.0, -11.0]) * (tracks.frame == 9)[:, None]
    R, t = scene.T_cam_obj.rotation.matrix(), scene.T_cam_obj.xyz / DISTANCE
    quality = finalize.pose_result(
        scene.capture,
        replace(tracks, uv=tracks.uv + shift),
        frontier_points.convex_contours(scene.capture),
        mirror_symmetry(scene.capture.masks),
        Solution(R, t, 0.9 / DISTANCE, torch.zeros(24)),
    ).quality
    assert torch.nonzero(quality.lost)[:, 0].tolist() == [9]
    assert quality.tangency_gap[9] < 0.2
    assert quality.overlap[9] > 0.9


def test_a_hand_is_no_contradiction_to_the_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    """Something unknown to the left of the object in all frames."""
    monkeypatch.setattr(finalize, "HULL_RESOLUTION", 24)  # for speed
    scene = tumbling(24)
    masks = scene.capture.masks.clone()
    masks[:, :, :64][masks[:, :, :64] == BACKGROUND] = UNKNOWN
    trajectory = finalize._trajectory(scene.T_cam_obj, scene.capture)
    held = replace(scene.capture, masks=masks)
    assert finalize._hull_overlap(held, trajectory, torch.zeros(24, dtype=torch.bool), 0.0).min() > 0.9


def test_a_long_run_of_wrong_frames_is_rejected_from_its_middle_to_its_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the frames are turned away, smoothly to 103 degrees and back; they carve the hull of all at first."""
    monkeypatch.setattr(finalize, "HULL_RESOLUTION", 24)  # for speed
    scene, n = tumbling(48), 48
    angle = torch.zeros(n, dtype=torch.float64)
    angle[12:36] = 1.8 * torch.sin(torch.linspace(0, math.pi, 26, dtype=torch.float64)[1:-1])
    turn = SO3.exp(angle[:, None] * torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64))
    T_cam_obj = SE3.from_rotation(turn @ scene.T_cam_obj.rotation, scene.T_cam_obj.xyz)
    trajectory = finalize._trajectory(T_cam_obj, scene.capture)
    lost, _ = finalize._reject_by_overlap(scene.capture, trajectory, torch.zeros(n, dtype=torch.bool))
    assert bool(lost[angle > math.radians(30)].all())
    assert not bool(lost[angle == 0].any())


@pytest.mark.parametrize("turn", [0.0, 0.9])
def test_of_two_parts_joined_against_the_hull_the_larger_is_kept(turn: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """No point is seen both in the first 20 frames and in the last 12, and a hand hides some of the background."""
    monkeypatch.setattr(finalize, "HULL_RESOLUTION", 24)  # for speed
    scene, rng, n, first = tumbling(32), torch.Generator().manual_seed(0), 32, 20
    pairs = [(t - k, t) for k in (1, 2) for t in range(k, n) if (t < first) == (t - k < first)]
    tracks = chain_matches([scene.match(i, j, rng, wrong=0.0) for i, j in pairs], torch.full((n,), 5.0))
    R = scene.T_cam_obj.rotation.matrix().clone()
    R[first:] = R[first:] @ SO3.exp(turn * torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)).matrix()
    masks = scene.capture.masks.clone()
    masks[:, :, :40][masks[:, :, :40] == BACKGROUND] = UNKNOWN
    capture, confirmed = replace(scene.capture, masks=masks), torch.ones(n, dtype=torch.bool)
    solution = Solution(R, scene.T_cam_obj.xyz / DISTANCE, 0.9 / DISTANCE, torch.zeros(n), confirmed)
    contours = frontier_points.convex_contours(capture)
    quality = finalize.pose_result(capture, tracks, contours, mirror_symmetry(capture.masks), solution).quality
    if turn == 0:
        assert not bool(quality.lost.any())
    else:
        assert quality.lost.tolist() == [k >= first for k in range(n)]
    assert quality.loose_from == [first], "named, whether its joint is refused or not"
    assert quality.overlap[~quality.lost].median() > 0.88, "at this resolution"


def test_up_is_up_in_the_first_frame_that_is_not_lost(result: PoseResult) -> None:
    """Its camera is at +z, with +y up in the image; points move with the frame."""
    opengl = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    T_cam_obj = result.trajectory.T_cam_obj
    torch.testing.assert_close(T_cam_obj[0].rotation.matrix(), opengl, atol=1e-5, rtol=0)
    lost = replace(result, quality=replace(result.quality, lost=torch.arange(24) < 3))
    turned = finalize._upright(lost)
    T_cam_new = turned.trajectory.T_cam_obj
    torch.testing.assert_close(T_cam_new[3].rotation.matrix(), opengl, atol=1e-5, rtol=0)
    torch.testing.assert_close(T_cam_new[9] @ turned.points, T_cam_obj[9] @ result.points, atol=1e-5, rtol=0)


def test_up_is_the_axis_of_a_turntable() -> None:
    """Seen from 25 degrees above by a camera that is rolled by 5 degrees; the estimated frame is a random one."""
    true = trajectories.turntable(30, DISTANCE).rotation
    roll = SO3.exp(torch.tensor([0.0, 0.0, math.radians(5)], dtype=torch.float64))
    R_old_obj = random_rotation(torch.Generator().manual_seed(0)).double()
    R_cam_old = (roll @ true).matrix() @ R_old_obj.mT
    R_new_obj = finalize._rotation_to_upright(R_cam_old, math.pi) @ R_old_obj
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(R_new_obj @ up, up, atol=1e-6, rtol=0)
    # A tenth of a revolution is no evidence for a turntable.
    few = R_cam_old[:3]
    R_new_old = finalize._rotation_to_upright(few, math.radians(24))
    torch.testing.assert_close(few[0] @ R_new_old.mT @ up, -up, atol=1e-6, rtol=0)


def test_the_sphere_around_a_cube_excludes_an_outlier() -> None:
    vertices = torch.tensor([[x, y, z] for x in (0.0, 2) for y in (0.0, 2) for z in (0.0, 2)], dtype=torch.float64)
    centre, radius = finalize._bounding_sphere(
        torch.cat([vertices.repeat(20, 1), torch.tensor([[9.0, 9, 9]]).double()])
    )
    torch.testing.assert_close(centre, torch.ones(3).double(), atol=0.02, rtol=0)
    assert float(radius) == pytest.approx(math.sqrt(3), abs=0.02)


def test_frames_beyond_a_pose_jump_are_lost() -> None:
    """The first two frames, rotated by 180 degrees, are matched only with each other: nothing contradicts them."""
    scene = tumbling(24)
    rng = torch.Generator().manual_seed(0)
    pairs = [(t - k, t) for k in (1, 2) for t in range(k, 24) if (t < 2) == (t - k < 2)]
    tracks = chain_matches([scene.match(i, j, rng, wrong=0.0) for i, j in pairs], torch.full((24,), 5.0))
    R = scene.T_cam_obj.rotation.matrix().clone()
    R[:2] = R[:2] @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    solution = Solution(R, scene.T_cam_obj.xyz / DISTANCE, 0.9 / DISTANCE, torch.zeros(24))
    quality = finalize.pose_result(
        scene.capture,
        tracks,
        frontier_points.convex_contours(scene.capture),
        mirror_symmetry(scene.capture.masks),
        solution,
    ).quality
    assert torch.nonzero(quality.lost)[:, 0].tolist() == [0, 1]
    assert quality.rating == "warn"


def on_an_axis() -> tuple[Capture, Tracks, Solution]:
    """A sphere in front of a static camera; all its points lie on its y axis."""
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


def test_rotation_about_an_axis_that_holds_all_texture_is_unobservable(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, tracks, solution = on_an_axis()
    sharp = 10 * torch.eye(2, dtype=torch.float64).expand(len(tracks), 2, 2)
    monkeypatch.setattr(finalize.texture_information, "information", lambda capture, tracks: sharp)
    quality = finalize.pose_result(
        capture, tracks, frontier_points.convex_contours(capture), mirror_symmetry(capture.masks), solution
    ).quality
    observability = quality.observability
    assert observability.axis_unobservable
    assert not observability.several_axes_unobservable
    # The object axes are those of the first camera in OpenGL axes.
    expected = solution.R[0] @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64) * torch.tensor([1.0, -1.0, -1.0])
    assert abs(float(observability.axis.double() @ expected)) > 0.98
    assert observability.sentence.startswith("Rotation about axis (")
    assert quality.rating == "bad"
    assert quality.sentence == observability.sentence


def test_lost_frames_say_nothing_about_what_is_observable() -> None:
    """More than half of the frames have no matches and arbitrary rotations, and are lost."""
    scene, rng = tumbling(24), torch.Generator().manual_seed(0)
    kept = torch.arange(24) < 10
    matches = [scene.match(t - k, t, rng, noise=0.3, wrong=0.0) for k in (1, 2) for t in range(k, 10)]
    tracks, contours = chain_matches(matches, torch.full((24,), 5.0)), frontier_points.convex_contours(scene.capture)
    R, t = scene.T_cam_obj.rotation.matrix(), scene.T_cam_obj.xyz / DISTANCE
    wrong = torch.where(kept[:, None, None], R, torch.stack([random_rotation(rng) for _ in range(24)]).to(R))
    symmetry = mirror_symmetry(scene.capture.masks)
    sigma = [
        finalize.pose_result(
            scene.capture, tracks, contours, symmetry, Solution(each, t, 0.9 / DISTANCE, torch.zeros(24), kept)
        ).quality.observability.sigma
        for each in (R, wrong)
    ]
    assert torch.allclose(*sigma, rtol=1e-4)


def test_outliers_say_nothing_about_what_is_observable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their points lie behind the cameras, where small changes of a pose would move them far."""
    scene, rng = tumbling(24), torch.Generator().manual_seed(0)
    matches = [scene.match(t - k, t, rng, noise=0.0, wrong=0.0) for k in (1, 2) for t in range(k, 24)]
    tracks = chain_matches(matches, torch.full((24,), 5.0))
    R, t = scene.T_cam_obj.rotation.matrix(), scene.T_cam_obj.xyz / DISTANCE
    wrong = Tracks(torch.arange(24), torch.arange(24) // 2, 20 + 80 * torch.rand(24, 2, generator=rng).double())
    triangulate = bundle_adjustment.triangulate

    def with_wrong_ones(tracks: Tracks, *others: object) -> torch.Tensor:
        X = triangulate(tracks, *others)
        behind = torch.tensor([3.0, 2.0, -3.0], dtype=torch.float64)
        if len(X) == n + 12:
            X[n:] = torch.einsum("fji,fj->fi", R, behind - t)[::2]
        return X

    def sigma(tracks: Tracks) -> torch.Tensor:
        contours, symmetry = frontier_points.convex_contours(scene.capture), mirror_symmetry(scene.capture.masks)
        solution = Solution(R, t, 0.9 / DISTANCE, torch.zeros(24))
        return finalize.pose_result(scene.capture, tracks, contours, symmetry, solution).quality.observability.sigma

    n = tracks.n
    monkeypatch.setattr(bundle_adjustment, "triangulate", with_wrong_ones)
    torch.testing.assert_close(sigma(concatenate(tracks, wrong)), sigma(tracks), rtol=1e-3, atol=0)


def test_no_rotation_of_an_untextured_sphere_is_observable() -> None:
    """Uniform grey images and round contours, whatever the matches are."""
    capture, tracks, solution = on_an_axis()
    quality = finalize.pose_result(
        capture, tracks, frontier_points.convex_contours(capture), mirror_symmetry(capture.masks), solution
    ).quality
    assert quality.observability.several_axes_unobservable
    assert quality.rating == "bad"
    assert quality.sentence.startswith("Rotation is not observable")


def test_the_sentence_of_an_observable_object() -> None:
    fine = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.005, 0.004, 0.003]))
    assert not fine.axis_unobservable
    assert fine.sentence == "Rotations are observable about every axis, to about 0.3 degrees about the worst axis."


def test_ties_count_the_points_seen_before_and_after() -> None:
    """Points 0 and 1 are seen in frames 1 to 4, point 2 before and after the gap, point 3 in lost frames only."""
    frames, points = [1, 4, 2, 4, 1, 6, 0, 5], [0, 0, 1, 1, 2, 2, 3, 3]
    tracks = Tracks(torch.tensor(frames), torch.tensor(points), torch.zeros(8, 2, dtype=torch.float64))
    lost = torch.tensor([True, False, False, False, False, True, False])
    seen = torch.ones(8, dtype=torch.bool)
    inf = math.inf
    assert finalize._ties(tracks, seen, lost).tolist() == [inf, inf, 2, 3, 3, inf, 1]
    seen[5] = False
    assert finalize._ties(tracks, seen, lost).tolist() == [inf, inf, 1, 2, 2, inf, 0]
