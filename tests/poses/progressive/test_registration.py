"""Registration of frames, on a tumbling ellipsoid with noisy and partly wrong matches and on a scene by Mitsuba."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.learning.scene import CAPTURE
from tests.lopsided import AXES, truth, tumbling
from tests.poses.progressive.test_tracker import Crashing, bits
from tumble import matching, recipes
from tumble.datasets import folder
from tumble.engine.loop import drive
from tumble.evaluation import metrics
from tumble.maths import SE3, SO3, angle_between
from tumble.poses import neighbours
from tumble.poses.progressive import anchors, registration, tracker, virtual_camera
from tumble.poses.progressive.registration import Motion, Scene
from tumble.poses.progressive.tracker import Inputs
from tumble.scene import Trajectory

FRAMES = 8
LOPSIDED = tumbling(FRAMES, points=300)
RNG = torch.Generator().manual_seed(0)
SOME = [LOPSIDED.match(t - k, t, RNG, wrong=0.1) for k in (1, 2, 4) for t in range(k, FRAMES)]
AIM = virtual_camera.aim_at(LOPSIDED.capture.masks, LOPSIDED.capture.camera, size=128)
ANCHORS = anchors.gather(LOPSIDED.capture, AIM, SOME)


def ellipsoid(x: torch.Tensor) -> torch.Tensor:
    """About the signed distance from the ellipsoid without its knobs."""
    scaled = (x / AXES.float()).norm(dim=-1)
    return scaled * (scaled - 1) / (x / AXES.float().square()).norm(dim=-1).clamp_min(1e-6)


def true_poses() -> SE3:
    """In the aim frame."""
    T = truth(LOPSIDED).T_cam_obj
    R_aim_cam = AIM.R_cam_aim.inverse()
    return SE3((R_aim_cam @ T.rotation).wxyz, R_aim_cam @ T.xyz)


def scene() -> Scene:
    return Scene(ANCHORS, ellipsoid, 1.1, float(true_poses().xyz[:, 2].mean()))


def rotation_errors(found: SE3) -> torch.Tensor:
    """Degrees between estimated and true rotations since the first frame."""
    true = true_poses().rotation
    since = [R @ R[0].inverse() for R in (found.rotation, true)]
    return torch.rad2deg(angle_between(*since))


def test_anchors_are_seen_where_the_truth_has_them() -> None:
    """Through the depth of the surface; matches have 0.2 pixels of noise, and every tenth is wrong by about 8."""
    T, errors = true_poses(), []
    for frame in range(FRAMES):
        origin, direction = T[frame].inverse().xyz, T[frame].inverse().rotation @ ANCHORS.ray[frame].float()
        o, d = origin / AXES.float(), direction / AXES.float()
        a, b = d.square().sum(-1), (d * o).sum(-1)
        depth = (-b - (b.square() - a * (o.square().sum() - 1)).clamp_min(0).sqrt()) / a
        for slot, partner in enumerate(ANCHORS.partner[frame].tolist()):
            x, y, z = (T[partner] @ (origin + depth[:, None] * direction)).unbind(-1)
            off = ANCHORS.focal * (torch.stack([x / z, y / z], -1) - ANCHORS.seen[frame, :, slot]).norm(dim=-1)
            errors.append(off[ANCHORS.weight[frame, :, slot] > 0])
    assert len(torch.cat(errors)) > 1000
    # 0.2 pixels in one frame each, times 1.18 for the median of two components.
    assert torch.cat(errors).median() < 0.4


def test_the_first_frames_are_registered_without_a_shape() -> None:
    """Sixty degrees; the mirror image of the motion would be off by twice that."""
    still = SE3(SO3.identity((FRAMES,)).wxyz, torch.tensor([0.0, 0.0, scene().distance]).repeat(FRAMES, 1))
    found = registration.register_first(Motion(), scene(), still, list(range(FRAMES)))
    assert rotation_errors(true_poses()).max() < 1e-3
    # Eight frames leave the scale of the relief to the prior of a sphere.
    assert rotation_errors(found).median() < 6


def test_a_new_frame_is_registered_against_the_shape() -> None:
    """Of the last frame nothing is known."""
    true = true_poses()
    xyz, wxyz = true.xyz.clone(), true.wxyz.clone()
    xyz[-1], wxyz[-1] = xyz[0], wxyz[0]
    found = registration.register(Motion(), scene(), SE3(wxyz, xyz), list(range(FRAMES)))
    assert rotation_errors(found)[-1] < 1


def test_frames_are_adjusted_together() -> None:
    """From errors of up to 6 degrees in all frames; the shape that holds them lacks the knobs."""
    true = true_poses()
    off = SO3.exp(0.06 * torch.randn(FRAMES, 3, generator=torch.Generator().manual_seed(1)))
    start = SE3((off @ true.rotation).wxyz, true.xyz)
    for adjust in (registration.adjust_window, registration.adjust_all):
        found = adjust(Motion(), scene(), start, list(range(FRAMES)))
        assert rotation_errors(found).median() < 1 < rotation_errors(start).median()


QUICK = replace(
    recipes.QUICK_TRACK, warmup=60, joint_steps=8, closing=1, closing_steps=30, samples=24, rays=128, old_rays=64
)
"""The quick recipe with fewer steps and rays."""


@pytest.fixture(scope="module")
def photographed() -> tuple[Inputs, Trajectory]:
    """Twelve frames of the scene by Mitsuba, 64 x 64 pixels, with the matches of the default matcher; true poses."""
    capture = folder.load(CAPTURE).select(list(range(12)))
    assert capture.trajectory is not None
    found = matching.match_pairs(matching.views_of(capture), neighbours(12), "mixed")
    aim = virtual_camera.aim_at(capture.masks, capture.camera, size=64)
    return Inputs(replace(capture, trajectory=None), tuple(found), aim), capture.trajectory


@pytest.mark.slow
def test_the_quick_recipe_tracks_a_scene_by_mitsuba(photographed: tuple[Inputs, Trajectory]) -> None:
    """Frames 16 to 24 degrees apart, twice as far as a hand-held video's, so that only neighbours have matches, and 64
    pixels wide: seen 12 degrees (9 with all steps of the recipe), where no rotation at all is 80 off and more."""
    inputs, true = photographed
    tracked = drive(tracker, tracker.Config(**{k: v for k, v in vars(QUICK).items() if k != "lift"}), inputs, seed=0)
    found = virtual_camera.lift(tracked.aim, tracked.T_aim_obj, inputs.capture.light)
    still = Trajectory(SE3(found.T_cam_obj.wxyz[:1].expand(12, 4), found.T_cam_obj.xyz), "camera")
    errors = [metrics.rotation_scores(poses, true)["rotation_median_degrees"] for poses in (found, still)]
    assert errors[0] < 15
    assert errors[1] > 45


def test_a_run_with_registration_is_resumed_bit_for_bit(
    photographed: tuple[Inputs, Trajectory], tmp_path: Path
) -> None:
    """Interrupted in the warm-up, in the tracking and in the closing round."""
    inputs, _ = photographed
    capture, n = inputs.capture.select(list(range(10))), 10
    matches = tuple(match for match in inputs.matches if max(match.i, match.j) < n)
    inputs = Inputs(capture, matches, replace(inputs.aim, R_cam_aim=inputs.aim.R_cam_aim[:n]))
    few = {k: v for k, v in vars(QUICK).items() if k != "lift"} | {"warmup": 4, "joint_steps": 2, "closing_steps": 3}
    cfg = tracker.Config(**few | {"sizes": replace(QUICK.sizes, nodes=(6, 12)), "motion": Motion(steps=4)})
    uninterrupted = bits(drive(tracker, cfg, inputs, seed=3))
    first_shape = 8 * 4 + 7 * 2
    for stop in (first_shape + 2, first_shape + 5, tracker.length(cfg, inputs) - 2):
        with pytest.raises(RuntimeError, match="power cut"):
            drive(Crashing(stop), cfg, inputs, seed=3, checkpoint=tmp_path / "state", every=1)
    assert bits(drive(tracker, cfg, inputs, seed=3, checkpoint=tmp_path / "state")) == uninterrupted
