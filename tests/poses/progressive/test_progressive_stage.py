"""The progressive route of stage 1, with the assessment of the other route."""

import math
import sys
from functools import partial

import torch

from tests.lopsided import truth, tumbling
from tests.poses.progressive.test_tracker import INPUTS, SMOKE, TRUTH
from tumble import recipes
from tumble.engine.loop import Stage, drive
from tumble.maths.se3 import angle_between
from tumble.poses.progressive import stage as progressive
from tumble.poses.progressive import tracker, virtual_camera
from tumble.poses.sfm import stage as sfm


def test_true_poses_are_rated_good() -> None:
    """The assessed trajectory may have another scale and object frame, but the motion is the same."""
    scene = tumbling(24, points=200)
    rng = torch.Generator().manual_seed(0)
    some = [scene.match(t - k, t, rng, wrong=0.0) for k in (1, 2) for t in range(k, 24)]
    found = sfm.assess(sfm.gather(scene.capture, some, "mixed"), truth(scene))
    assert found.quality.rating == "good"
    assert math.degrees(found.quality.uncertainty) < 1
    between = found.trajectory.T_cam_obj.rotation.inverse() @ truth(scene).T_cam_obj.rotation
    assert angle_between(between[1:], between[:-1]).max() < 1e-3


def test_the_stage_has_the_poses_of_the_tracker() -> None:
    """On five frames of a textured sphere, with too few steps to be accurate."""
    assess = partial(sfm.assess, sfm.gather(INPUTS.capture, INPUTS.matches, "mixed"))
    inputs = progressive.gather(INPUTS.capture, INPUTS.matches, assess)
    cfg = progressive.Config(**vars(SMOKE))
    assert isinstance(sys.modules["tumble.poses.progressive.stage"], Stage)
    assert progressive.length(cfg, inputs) == tracker.length(SMOKE, inputs.track)
    both = drive(progressive, cfg, inputs, seed=1)
    alone = drive(tracker, SMOKE, inputs.track, seed=1)
    lifted = virtual_camera.lift(alone.aim, alone.T_aim_obj, "camera").T_cam_obj
    between = both.trajectory.T_cam_obj.rotation.inverse() @ lifted.rotation
    assert angle_between(between[1:], between[:-1]).max() < 1e-3
    assert len(both.quality) == len(TRUTH.xyz)


def test_lifting_by_epnp_gives_the_poses_of_the_closed_form() -> None:
    """Projections of the shape's surface have no noise, so that RANSAC-EPnP errs by its rounding alone."""
    assess = partial(sfm.assess, sfm.gather(INPUTS.capture, INPUTS.matches, "mixed"))
    inputs = progressive.gather(INPUTS.capture, INPUTS.matches, assess)
    few = vars(SMOKE) | {"warmup": 1, "pose_steps": 1, "joint_steps": 1}
    exact = drive(progressive, progressive.Config(**few), inputs, seed=1).trajectory.T_cam_obj
    lifted = drive(progressive, progressive.Config(**few, lift="pnp"), inputs, seed=1).trajectory.T_cam_obj
    assert angle_between(exact.rotation, lifted.rotation).max() < 1e-2
    assert (exact.xyz - lifted.xyz).abs().max() < 2e-2
    assert not torch.equal(exact.xyz, lifted.xyz)


def test_recipes_select_the_progressive_route() -> None:
    quick, paper = (recipes.progressive_poses(r).track for r in (recipes.DRAFT, recipes.PAPER))
    assert isinstance(quick, progressive.Config)
    assert paper == recipes.PAPER.track == progressive.Config(lift="pnp")
    assert quick.pose_steps < 100
