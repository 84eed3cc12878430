"""The paper's route with the graph route's outcome."""

import math
import sys

import torch

from tests.lopsided import truth, tumbling
from tests.test_track import INPUTS, SMOKE, TRUTH
from tumble import graph, lift, progressive, recipes, track
from tumble.loop import Stage, drive
from tumble.se3 import angle_between


def test_true_poses_are_judged_good() -> None:
    """In another unit and frame, but the same motion."""
    scene = tumbling(24, points=200)
    rng = torch.Generator().manual_seed(0)
    some = [scene.match(t - k, t, rng, wrong=0.0) for k in (1, 2) for t in range(k, 24)]
    found = graph.judged(graph.gather(scene.capture, some), truth(scene))
    assert found.health.verdict == "good"
    assert math.degrees(found.health.uncertainty) < 1
    between = found.trajectory.T_cam_obj.rotation.inverse() @ truth(scene).T_cam_obj.rotation
    assert angle_between(between[1:], between[:-1]).max() < 1e-3


def test_it_finds_what_track_finds() -> None:
    """Five frames of a painted ball: too few steps to be right, the same ones as those of the stage alone."""
    inputs = progressive.gather(INPUTS.capture, INPUTS.matches)
    assert isinstance(sys.modules["tumble.progressive"], Stage)
    assert progressive.length(SMOKE, inputs) == track.length(SMOKE, inputs.track)
    both = drive(progressive, SMOKE, inputs, seed=1)
    alone = drive(track, SMOKE, inputs.track, seed=1)
    lifted = lift.lift(alone.aim, alone.T_aim_obj, "camera").T_cam_obj
    between = both.trajectory.T_cam_obj.rotation.inverse() @ lifted.rotation
    assert angle_between(between[1:], between[:-1]).max() < 1e-3
    assert len(both.health) == len(TRUTH.xyz)


def test_the_recipe_names_the_route() -> None:
    quick, paper = (recipes.progressive_poses(r).track for r in (recipes.DRAFT, recipes.PAPER))
    assert isinstance(quick, track.Config)
    assert paper == track.Config()
    assert quick.pose_steps < 100
