"""Joints of two halves of a motion whose poses are known, from contours alone."""

import math
from dataclasses import replace

import pytest
import torch

from tests.lopsided import DISTANCE, tumbling
from tumble.maths import SO3, angle_between
from tumble.poses.sfm import contour_joints, stage
from tumble.poses.sfm.contour_joints import (
    ContourJoint,
    Correspondences,
    _trusted,
    contour_joint,
    fitted_to_both,
    moved_part,
)
from tumble.poses.sfm.partial import Observed, Partial
from tumble.poses.sfm.tracks import NO_TRACKS, gather_keypoints
from tumble.scene import BACKGROUND, OBJECT

SCENE = tumbling(28)
R = SCENE.T_cam_obj.rotation.matrix().double()
T = SCENE.T_cam_obj.xyz.double() / DISTANCE
OTHER_FRAME = (
    SO3.exp(torch.tensor([0.5, -1.1, 0.7], dtype=torch.float64)).matrix(),
    1.15,
    torch.tensor([0.03, -0.02, 0.05]),
)
"""Rotation, scale and shift of the object frame of the second half."""


@pytest.fixture(scope="module")
def observed() -> Observed:
    inputs = stage.gather(SCENE.capture, ())
    return Observed(stage.Config(), inputs, gather_keypoints((), NO_TRACKS, SCENE.capture.camera, len(R)))


def half(frames: range) -> Partial:
    return Partial(tuple(frames), R[list(frames)], T[list(frames)])


def in_other_frame(part: Partial) -> Partial:
    rotation, scale, shift = OTHER_FRAME
    return part.moved(rotation, scale, shift.double())


def test_two_halves_of_a_motion_are_joined_by_their_contours(observed: Observed) -> None:
    """The object of the second half has another frame and size; its true poses come back."""
    joint = contour_joint(observed, in_other_frame(half(range(12, 24))), half(range(12)))
    assert joint is not None
    assert joint.accepted
    error = angle_between(SO3.from_matrix(joint.part.R), SO3.from_matrix(R[12:24]))
    assert math.degrees(float(error.max())) < 3
    assert (joint.part.t - T[12:24]).norm(dim=-1).max() < 0.03


def test_contours_of_another_object_are_not_joined(observed: Observed) -> None:
    """The second half of the film shows a disc of the same size."""
    masks = SCENE.capture.masks.clone()
    row, column = torch.meshgrid(*map(torch.arange, masks.shape[1:]), indexing="ij")
    for mask in masks[12:24]:
        y, x = (mask != BACKGROUND).nonzero().double().mean(0)
        radius = math.sqrt(int((mask != BACKGROUND).sum()) / math.pi)
        mask[:] = torch.where((row - y).square() + (column - x).square() < radius**2, 255, 0).to(mask.dtype)
    inputs = stage.gather(replace(SCENE.capture, masks=masks), ())
    joint = contour_joint(replace(observed, inputs=inputs), in_other_frame(half(range(12, 24))), half(range(12)))
    assert joint is None or not joint.accepted


def test_frames_whose_masks_contradict_their_own_part_are_not_compared(observed: Observed) -> None:
    """In two frames a patch beside the object counts as object; compared as well, they turn the joint by 25 degrees."""
    masks = SCENE.capture.masks.clone()
    masks[[20, 21], 108:124, 20:40] = OBJECT
    inputs = stage.gather(replace(SCENE.capture, masks=masks), ())
    spoilt = replace(observed, inputs=inputs)
    assert bool(inputs.contours.reliable[[20, 21]].any(1).all())
    assert _trusted(spoilt, half(range(12, 24))).frames == (*range(12, 20), 22, 23)
    joint = contour_joint(spoilt, in_other_frame(half(range(12, 24))), half(range(12)))
    assert joint is not None
    assert joint.accepted
    error = angle_between(SO3.from_matrix(joint.part.R), SO3.from_matrix(R[12:24]))
    assert math.degrees(float(error.max())) < 3


def test_frames_to_compare_are_chosen_once_for_every_part(observed: Observed, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the part is compared with; and anew for other masks."""

    def counted(observed: Observed, part: Partial) -> Partial:
        parts.append(part)
        return _trusted(observed, part)

    parts: list[Partial] = []
    monkeypatch.setattr(contour_joints, "_trusted", counted)
    first, second, third = half(range(10)), half(range(10, 20)), half(range(10))
    fresh = replace(observed)
    for each in (first, third, first):
        contour_joint(fresh, second, each)
    assert parts == [second, first, third]
    contour_joint(replace(fresh), second, first)
    assert parts == [second, first, third, second, first]


def test_the_distance_from_the_camera_does_not_jump(observed: Observed) -> None:
    """The second half shows the object twice as near; contours alone would tell that it has grown."""
    near = Partial(tuple(range(12, 24)), R[12:24], T[12:24] / 2)
    assert contour_joint(observed, near, half(range(12))) is not None
    contours = observed.inputs.contours
    centre = contours.vertices[12:24].mean(1, keepdim=True)
    vertices = contours.vertices.clone()
    vertices[12:24] = centre + 2 * (vertices[12:24] - centre)
    inputs = replace(observed.inputs, contours=replace(contours, vertices=vertices))
    joint = contour_joint(replace(observed, inputs=inputs), half(range(12, 24)), half(range(12)))
    assert joint is None or not joint.accepted


def test_parts_far_apart_in_time_are_not_compared(observed: Observed) -> None:
    assert contour_joint(observed, half(range(18, 28)), half(range(10))) is None


def test_short_parts_are_not_joined_by_contours_alone(observed: Observed) -> None:
    joint = contour_joint(observed, half(range(12, 18)), half(range(12)))
    assert joint is not None
    assert not replace(joint, gaps=200, gap_cost=0.01, second=math.inf).accepted


def test_parts_of_which_little_is_seen_are_not_joined(observed: Observed) -> None:
    """Every other frame shows no contour at all."""
    contours = observed.inputs.contours
    reliable = contours.reliable & (torch.arange(len(R)) % 2 == 0)[:, None]
    inputs = replace(observed.inputs, contours=replace(contours, reliable=reliable))
    joint = contour_joint(replace(observed, inputs=inputs), in_other_frame(half(range(12, 24))), half(range(12)))
    assert joint is not None
    assert joint.cost < 0.2
    assert not joint.accepted


@pytest.mark.parametrize(
    ("second", "gaps", "gap_cost", "accepted"),
    [
        (math.inf, 120, 0.1, True),
        (0.11, 120, 0.1, True),
        (0.09, 120, 0.1, False),  # another rotation agrees nearly as well, as half a revolution of a bottle does
        (math.inf, 120, 0.25, False),
        (math.inf, 60, 0.1, False),
    ],
)
def test_a_joint_is_accepted_if_it_is_certain(second: float, gaps: int, gap_cost: float, accepted: bool) -> None:
    assert ContourJoint(half(range(12)), 0.05, second, gaps, gap_cost, 12).accepted == accepted


def test_contours_correct_a_joint_that_few_keypoints_suggest(observed: Observed) -> None:
    """Ten points on one small patch, of which some are seen where they are not, leave the rotation uncertain."""
    first, second = half(range(12)), half(range(12, 24))
    generator = torch.Generator().manual_seed(0)
    X = torch.tensor([0.1, 0.0, 0.1]) + 0.02 * torch.randn(14, 3, generator=generator)
    X = X.double() / DISTANCE
    place = torch.zeros(14, dtype=torch.long)
    uv = SCENE.capture.camera.project(X @ R[12].mT + T[12]).double()
    uv[10:] += 40
    off = SO3.exp(torch.tensor([0.25, 0.2, -0.15], dtype=torch.float64)).matrix()
    # The wrong motion turns about the patch, so that its points still agree.
    middle = X.mean(0)
    start = off[None], torch.cat([middle - off @ middle, torch.zeros(1, dtype=torch.float64)])[None]
    seen = Correspondences(place, uv, X)
    assert int((seen.errors(observed, second, start).norm(dim=-1) < 5).sum()) == 10
    found = moved_part(second, fitted_to_both(observed, second, first, seen, start, 5.0), 0)
    error = angle_between(SO3.from_matrix(found.R), SO3.from_matrix(R[12:24]))
    assert math.degrees(float(error.max())) < 4  # 20 at first
