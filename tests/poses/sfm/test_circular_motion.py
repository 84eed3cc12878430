"""Turntables with true silhouettes and without a single match.

The contours of a lopsided ellipsoid tell its motion; those of a body of revolution do not, but the paint on it does.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.lopsided import DISTANCE, Tumble, moving, truth, tumbling
from tests.poses.sfm import test_spin as revolution
from tumble.engine.loop import drive
from tumble.evaluation import metrics
from tumble.maths.se3 import SE3, SO3
from tumble.poses.sfm import circular_motion, stage
from tumble.poses.sfm.observations import Inputs
from tumble.poses.sfm.symmetry import texture_agreement
from tumble.scene.capture import Capture
from tumble.scene.trajectory import Trajectory
from tumble.synthetic import trajectories


def turning(azimuth: Tensor) -> Tumble:
    """The object seen from 25 degrees above, from one azimuth per frame [turns]."""
    angle, elevation = 2 * math.pi * azimuth.double(), math.radians(25)
    horizontal = math.cos(elevation)
    height = torch.full_like(angle, math.sin(elevation))
    position = DISTANCE * torch.stack([horizontal * angle.sin(), height, horizontal * angle.cos()], -1)
    return moving(trajectories.look_at_object(position))


def painted(frames: int, sense: int = 1, contrast: float = 0.12) -> tuple[Capture, Trajectory]:
    """A shaded body of revolution that stands on the axis of the turntable, seen from 25 degrees above."""
    k, x, z = torch.arange(frames), torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    upright = SO3.exp((math.pi / 2 + math.radians(25)) * x)
    turns = SO3.exp((sense * 2 * math.pi / frames) * k[:, None] * z)
    T = SE3.from_rotation(upright @ turns, torch.tensor([0.0, 0.0, revolution.DISTANCE]).expand(frames, 3))
    waves = 10 * torch.randn(3, 12, generator=torch.Generator().manual_seed(1))
    return revolution.photographed(T, lambda x: 0.5 + contrast * (x @ waves).sin().sum(-1))


def gathered(capture: Capture) -> Inputs:
    return stage.gather(capture, ())


def error(right: Trajectory, motion: circular_motion.CircularMotion) -> float:
    """Median rotation error [degrees]."""
    T = SE3.from_rotation(SO3.from_matrix(motion.R.float()), motion.t.float())
    return metrics.rotation_scores(Trajectory(T, "camera"), right)["rotation_median_degrees"]


def test_the_motion_of_a_turntable_is_found_from_contours_alone() -> None:
    scene = turning(torch.arange(36) / 36)
    out = drive(stage, stage.Config(), gathered(scene.capture), seed=0)
    scores = metrics.rotation_scores(out.trajectory, truth(scene))
    assert scores["rotation_median_degrees"] < 0.6
    assert scores["rotation_below_2_percent"] == 100
    assert out.quality.rating == "good"
    assert out.quality.uncertainty > math.radians(0.5 * scores["rotation_median_degrees"])


def test_a_table_may_turn_unevenly_and_the_other_way() -> None:
    time = -torch.arange(36) / 36
    scene = turning(time + 0.3 / (2 * math.pi) * torch.sin(2 * math.pi * time))
    found = circular_motion.fit(gathered(scene.capture))
    assert found is not None
    assert error(truth(scene), found) < 1


def test_the_error_of_a_frame_that_does_not_fit_is_known() -> None:
    """One frame is eight degrees ahead of the others, of which a smooth change of speed explains a part."""
    azimuth = torch.arange(36) / 36
    azimuth[20] += 8 / 360
    found = circular_motion.fit(gathered(turning(azimuth).capture))
    assert found is not None
    disagreement = torch.rad2deg(found.disagreement)
    assert int(disagreement.argmax()) == 20
    assert 3 < float(disagreement[20]) < 10
    assert float(disagreement.median()) < 1.5


def test_a_focal_length_that_is_only_assumed_is_estimated() -> None:
    scene = turning(torch.arange(36) / 36)
    short = replace(scene.capture, camera=scene.capture.camera.zoomed(0.8), focal_assumed=True)
    found = circular_motion.fit(gathered(short))
    assert found is not None
    assert error(truth(scene), found) < 1
    assert 0.5 * math.log(1 / 0.8) < float(found.log_focal) < 1.5 * math.log(1 / 0.8)


def test_an_object_in_a_hand_has_no_circular_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither do its frames recur, nor would its contours be explained if they did."""
    inputs = gathered(tumbling(40).capture)
    assert circular_motion.periods(inputs.capture) == []
    assert circular_motion.fit(inputs) is None
    monkeypatch.setattr(circular_motion, "periods", lambda capture: [len(capture)])
    assert circular_motion.fit(inputs) is None


def test_contours_that_stay_the_same_do_not_tell_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither does the texture of another object."""
    monkeypatch.setattr(circular_motion, "ELEVATIONS", (-30, 0, 30))
    monkeypatch.setattr(circular_motion, "MAX_PERIODS", 1)
    capture = turning(torch.arange(16) / 16).capture
    same = replace(capture, masks=capture.masks[:1].expand_as(capture.masks).clone())
    assert circular_motion.periods(same)
    assert circular_motion.fit(gathered(same)) is None


def test_frames_recur_after_every_turn() -> None:
    assert 22 in circular_motion.periods(turning(torch.arange(55) / 22).capture)
    assert circular_motion.periods(turning(torch.arange(36) / 36).capture) == [36]
    assert circular_motion.periods(turning(torch.arange(36) / 45).capture) == []


@pytest.mark.parametrize("sense", [1, -1])
def test_paint_tells_how_a_body_of_revolution_turns(sense: int, monkeypatch: pytest.MonkeyPatch) -> None:
    if sense == -1:  # few elevations are enough to tell the senses apart
        monkeypatch.setattr(circular_motion, "ELEVATIONS", (-20, 0, 20, 30))
    capture, right = painted(24, sense)
    found = circular_motion.fit(gathered(capture))
    assert found is not None
    assert error(right, found) < 3
    assert float(torch.rad2deg(found.disagreement).median()) > 0.3 * error(right, found)


def test_a_body_of_revolution_without_paint_has_no_known_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(circular_motion, "ELEVATIONS", (-30, 0, 30))
    assert circular_motion.fit(gathered(painted(24, contrast=0.0)[0])) is None


def test_frames_agree_about_the_texture_at_the_right_poses_only() -> None:
    capture, right = painted(24)
    other_way = painted(24, -1)[1]
    assert texture_agreement(capture, right, 300).mean() > 0.8
    assert texture_agreement(capture, other_way, 300).mean() < 0.4
    # What is left of smooth shading is faint, and fits both ways.
    plain = painted(24, contrast=0.0)[0]
    shading = [texture_agreement(plain, poses, 300) for poses in (right, other_way)]
    assert abs(shading[0].mean() - shading[1].mean()) < circular_motion.MIN_LEAD
    assert shading[0].weight.mean() < 0.1 * texture_agreement(capture, right, 300).weight.mean()
