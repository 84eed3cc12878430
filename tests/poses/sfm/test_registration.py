"""Poses from keypoints and surface points that were projected by a known pose."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.lopsided import AXES, Tumble, first_hits, tumbling
from tumble.maths import SO3
from tumble.poses.sfm import partial, registration, stage
from tumble.poses.sfm.partial import Observed, Partial, colour_contradictions, contour_cost
from tumble.poses.sfm.registration import Joint, best_joint, contour_joint, join, solutions
from tumble.poses.sfm.tracks import NO_TRACKS, gather_keypoints

SCENE = tumbling(12, points=200)
CAMERA = SCENE.capture.camera
R = SO3.exp(torch.tensor([0.4, -0.3, 0.8], dtype=torch.float64)).matrix().numpy()
T = np.array([0.1, -0.05, 4.0])


@pytest.fixture(scope="module")
def observed() -> Observed:
    inputs = stage.gather(SCENE.capture, ())
    return Observed(stage.Config(), inputs, gather_keypoints((), NO_TRACKS, CAMERA, 12))


def projected(X: np.ndarray) -> np.ndarray:
    x = X @ R.T + T
    focal, principal = CAMERA.fx_fy_cx_cy.double().numpy().reshape(2, 2)
    return x[:, :2] / x[:, 2:] * focal + principal


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1)))


def test_a_pose_is_found_among_wrong_correspondences(observed: Observed) -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(60, 3)) * 0.4
    uv = projected(X) + 0.3 * rng.normal(size=(60, 2))
    uv[:20] += rng.normal(size=(20, 2)) * 30
    (found_R, found_t), inliers = max(solutions(observed, uv, X), key=lambda each: each[1])
    assert angle(found_R, R) < 1
    assert np.abs(found_t - T).max() < 0.05
    assert 38 <= inliers <= 42


def test_few_points_in_a_plane_have_a_mirrored_solution_too(observed: Observed) -> None:
    rng = np.random.default_rng(1)
    X = np.column_stack([rng.uniform(-0.15, 0.15, (12, 2)), np.zeros(12)])
    found = [solution for solution, _ in solutions(observed, projected(X) + 0.2 * rng.normal(size=(12, 2)), X)]
    assert len(found) == 2
    angles = sorted(angle(each, R) for each, _ in found)
    assert angles[0] < 10 < angles[1]
    normals = [each[:, 2] for each, _ in found]
    ray = (X.mean(0) @ R.T + T) / np.linalg.norm(X.mean(0) @ R.T + T)
    # Both planes make the same angle with the line of sight.
    assert abs(normals[0] @ ray) == pytest.approx(abs(normals[1] @ ray), abs=0.12)


def test_too_few_correspondences_have_no_solution(observed: Observed) -> None:
    X = np.eye(3).repeat(2, 0)
    assert solutions(observed, projected(X), X) == []


def test_contours_contradict_a_part_that_is_turned(observed: Observed) -> None:
    """The two parts are frames of one capture; the second is then turned by 30 degrees in the object's frame."""
    pose = SCENE.T_cam_obj
    scale = float(pose.xyz[:, 2].mean())
    every = Partial(tuple(range(12)), pose.rotation.matrix().double(), pose.xyz.double() / scale)
    first, second = every.select(range(6)), every.select(range(6, 12))
    turn = SO3.exp(torch.tensor([0.3, 0.4, 0.2], dtype=torch.float64)).matrix()
    right, gaps = contour_cost(observed, first, second)
    wrong, _ = contour_cost(observed, first, second.moved(turn, 1.0, torch.zeros(3, dtype=torch.float64)))
    assert gaps > 50
    assert right < 0.1
    assert wrong > 5 * right


def two_coloured(scene: Tumble, brightness: torch.Tensor) -> torch.Tensor:
    """Images of the ellipsoid, yellow where x is positive in the object frame and blue elsewhere."""
    images = torch.zeros(*scene.capture.masks.shape, 3)
    for k, T_obj_cam in enumerate(scene.T_cam_obj[i].inverse() for i in range(len(images))):
        o, d = T_obj_cam.xyz / AXES, (T_obj_cam.rotation @ scene.capture.camera.directions().double()) / AXES
        hit, _ = first_hits(o, d, 1.0)
        colours = torch.where(hit[..., :1] > 0, torch.tensor([200.0, 170.0, 40.0]), torch.tensor([50.0, 80.0, 180.0]))
        images[k] = colours * brightness[k]
    return images.round().to(torch.uint8)


def seen_in_colour(scene: Tumble, images: torch.Tensor) -> tuple[Observed, Partial]:
    """What is known of the frames of a scene with other images, and its true motion."""
    rng = torch.Generator().manual_seed(0)
    matches = [scene.match(i, j, rng) for i in range(12) for j in range(i + 1, min(12, i + 5))]
    inputs = stage.gather(replace(scene.capture, images=images), ())
    pose = scene.T_cam_obj
    every = Partial(tuple(range(12)), pose.rotation.matrix().double(), pose.xyz.double())
    return Observed(stage.Config(), inputs, gather_keypoints(matches, NO_TRACKS, CAMERA, 12)), every


def test_colours_contradict_a_part_that_shows_another_face() -> None:
    """Half a revolution about a line of sight swaps yellow and blue; the light changes from frame to frame."""
    scene = tumbling(12)
    seen, every = seen_in_colour(scene, two_coloured(scene, torch.linspace(0.5, 1.1, 12)))
    first, second = every.select(range(6)), every.select(range(6, 12))
    sight = torch.nn.functional.normalize(first.R[3].mT @ first.t[3], dim=0)
    ways = [second.moved(SO3.exp(turn * sight).matrix(), 1.0, torch.zeros(3).double()) for turn in (0, 0.05, math.pi)]
    found = colour_contradictions(seen, second, first, ways)
    assert max(found[:2]) < 1 < registration.MAX_COLOUR_CONTRADICTION < 4 < found[2]
    joints = [Joint(way, 500, 0.9, 6, 0.1, 80, True, each) for way, each in zip(ways, found, strict=True)]
    assert [joint.accepted for joint in joints] == [True, True, False]


def test_parts_that_show_different_sides_do_not_contradict_each_other() -> None:
    """All is red in the first frames and blue in the last, which is compared only if they show the same side."""
    scene = tumbling(12)
    images = torch.zeros_like(scene.capture.images)
    images[:6, ..., 0], images[6:, ..., 2] = 200, 200
    seen, every = seen_in_colour(scene, images)
    first, second = every.select(range(3)), every.select(range(9, 12))
    half = SO3.exp(torch.tensor([0, math.pi, 0], dtype=torch.float64)).matrix()
    ways = [
        second.moved(first.R[1].mT @ turn @ second.R[1], 1.0, torch.zeros(3).double())
        for turn in (torch.eye(3).double(), half)
    ]
    same, opposite = colour_contradictions(seen, second, first, ways)
    assert same > 4
    assert opposite == 0


@pytest.mark.parametrize(
    ("keypoints", "share", "frames", "cost", "gaps", "accepted"),
    [
        (50, 0.6, 3, 0.5, 80, True),
        (50, 0.6, 3, 2.0, 80, False),  # contours contradict it
        (500, 0.85, 3, 2.0, 80, True),  # but a mask may be wrong
        (50, 0.6, 3, 2.0, 9, True),  # too few to contradict it
        (50, 0.4, 3, 0.5, 80, False),
        (110, 0.4, 3, 0.5, 80, True),
        (50, 0.2, 1, 0.1, 80, True),  # contours confirm it
        (50, 0.2, 0, 0.1, 80, False),  # but chance may have one keypoint in each of many frames
        (50, 0.2, 1, 0.15, 80, False),
        (50, 0.2, 1, 0.1, 70, False),  # too few to confirm it
        (30, 0.6, 3, 0.1, 80, False),
    ],
)
def test_keypoints_and_contours_decide_together(
    keypoints: int, share: float, frames: int, cost: float, gaps: int, accepted: bool
) -> None:
    part = Partial((0,), torch.eye(3)[None].double(), torch.zeros(1, 3).double())
    assert Joint(part, keypoints, share, frames, cost, gaps, True).accepted == accepted


def test_a_jump_of_the_motion_is_the_last_resort() -> None:
    """Print on both faces of a box: half a revolution agrees with contours better than what is right."""
    part = Partial((0,), torch.eye(3)[None].double(), torch.zeros(1, 3).double())
    jump, right = Joint(part, 50, 0.6, 3, 0.2, 100, False), Joint(part, 60, 0.6, 3, 0.9, 100, True)
    refused = Joint(part, 60, 0.6, 3, 1.9, 100, True)
    assert min((jump, right), key=lambda joint: joint.order) is right
    assert min((jump, refused), key=lambda joint: joint.order) is jump


def test_a_part_moved_to_another_object_frame_shows_the_same_points() -> None:
    """A point keeps its position in the camera frame up to the scale."""
    pose = SCENE.T_cam_obj
    part = Partial((0, 1), pose.rotation.matrix()[:2].double(), pose.xyz[:2].double())
    turn, shift = SO3.exp(torch.tensor([0.3, 0.4, 0.2], dtype=torch.float64)).matrix(), torch.tensor([0.1, 0.2, -0.3])
    moved = part.moved(turn, 1.3, shift.double())
    x = torch.tensor([0.5, -0.2, 0.7], dtype=torch.float64)
    x_new = 1.3 * turn @ x + shift.double()
    assert torch.allclose(moved.R @ x_new + moved.t, 1.3 * (part.R @ x + part.t))


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> tuple[Partial, Partial, Partial]:
    """A motion of 24 frames and two parts of it, which joining leaves as they are."""
    monkeypatch.setattr(registration, "adjusted", lambda _, part, __: part)
    monkeypatch.setattr(registration, "pruned", lambda _, part, __: part)
    every = Partial(tuple(range(24)), torch.eye(3).double().expand(24, 3, 3), torch.zeros(24, 3).double())
    return every, every.select(range(14)), every.select(range(14, 24))


@pytest.mark.parametrize(("share", "frames", "waits"), [(0.4, 2, True), (0.6, 2, False), (0.3, 3, False)])
def test_a_joint_of_a_minority_of_keypoints_in_few_frames_waits(
    observed: Observed, parts: tuple[Partial, Partial, Partial], share: float, frames: int, waits: bool
) -> None:
    """The cap of a bottle agrees with any turn about its axis; its label does not."""
    every, a, b = parts
    joint = Joint(b, 110, share, frames, 0.5, 80, True)
    assert joint.accepted
    known = {(best_joint, a, b): joint, (contour_joint, a, b): None}
    first = join(observed, [b, a], dict(known), certain=True)
    assert [part.frames for part in first] == ([a.frames, b.frames] if waits else [every.frames])
    assert [part.frames for part in join(observed, [a, b], dict(known), certain=False)] == [every.frames]


def test_parts_are_joined_by_contours_only_after_all_keypoints(
    observed: Observed, parts: tuple[Partial, Partial, Partial]
) -> None:
    _, a, b = parts
    by_contours = registration.ContourJoint(b, 0.05, math.inf, 100, 0.05, 10)
    assert by_contours.accepted
    known = {(best_joint, a, b): None, (contour_joint, a, b): by_contours}
    assert len(join(observed, [a, b], dict(known), certain=True)) == 2
    assert len(join(observed, [a, b], dict(known), certain=False)) == 1


@pytest.mark.parametrize(
    ("degrees", "cost", "gaps", "joined"),
    [
        (5, 0.3, 80, True),
        (30, 0.3, 80, False),  # contours and keypoints name different motions
        (5, 1.5, 80, False),  # contours contradict what the keypoints are fitted to
        (5, 0.3, 20, False),  # contours say next to nothing
    ],
)
def test_parts_are_joined_where_keypoints_and_contours_agree(
    observed: Observed, parts: tuple[Partial, Partial, Partial], degrees: float, cost: float, gaps: int, joined: bool
) -> None:
    """Twelve keypoints are too few, and the contours of a bottle agree nearly as well with other turns."""
    _, a, b = parts
    joint = Joint(b, 12, 0.1, 1, cost, gaps, True)
    turn = SO3.exp(torch.tensor([0, math.radians(degrees), 0], dtype=torch.float64)).matrix()
    contours = registration.ContourJoint(b.moved(turn, 1.0, torch.zeros(3).double()), 0.1, 0.15, 60, 0.1, 10)
    assert not joint.accepted
    assert not contours.accepted
    known = {(best_joint, a, b): joint, (contour_joint, a, b): contours}
    assert len(join(observed, [a, b], dict(known), certain=True)) == 2
    assert len(join(observed, [a, b], dict(known), certain=False)) == (1 if joined else 2)


@pytest.mark.parametrize(
    ("frames", "degrees", "kept"),
    [
        ((3, 4, 5, 6), (0, 12, 24, 90), (3, 4, 5)),  # at an end, after a jump
        ((3, 4, 5, 6), (0, 80, 24, 36), (3, 5, 6)),  # without frame 4 the motion goes on
        ((3, 4, 5, 6), (0, 12, 90, 102), (3, 4, 5, 6)),  # two pairs that go on: which is wrong is not known
        ((3, 4, 8), (0, 10, 90), (3, 4, 8)),  # too far in time to tell
        ((3, 8, 9, 10), (0, 60, 90, 100), (3, 9, 10)),
        ((3, 4), (0, 30), (4,)),
        ((3,), (0,), (3,)),
    ],
)
def test_frames_to_which_the_motion_jumps_are_left_out(
    frames: tuple[int, ...], degrees: tuple[int, ...], kept: tuple[int, ...]
) -> None:
    turn = torch.tensor([[0.0, math.radians(angle), 0.0] for angle in degrees], dtype=torch.float64)
    part = Partial(frames, SO3.exp(turn).matrix(), torch.zeros(len(frames), 3).double())
    assert partial.without_jumps(part).frames == kept
