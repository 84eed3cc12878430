"""A light that turns by itself: stages 2 and 3 use the rotation of each frame."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from tests import turning
from tumble import recipes
from tumble.engine.loop import drive
from tumble.inverse_rendering import decompose, refine
from tumble.inverse_rendering.decompose import Inputs

SMOKE = recipes.known_poses(recipes.SMOKE)
SECOND = replace(SMOKE.refine, steps=60, rates=replace(SMOKE.refine.rates, light=0.05))
THIRD = replace(SMOKE.decompose, steps=60, warmup=61, pixels=128, try_matte=False, visibility=False, bounce="none")


def without_turns(inputs: Inputs) -> Inputs:
    still = replace(inputs.refined.trajectory, light_turns=None)
    return Inputs(replace(inputs.capture, trajectory=still), replace(inputs.refined, trajectory=still))


@torch.no_grad()
def correlation(irradiance: Callable[[Tensor], Tensor]) -> float:
    """Of a light with the true one, over the six directions of the axes."""
    d_env = torch.cat([torch.eye(3), -torch.eye(3)])
    pair = torch.stack([irradiance(d_env).flatten(), (1 + d_env @ turning.LAMP.T).flatten()])
    return float(torch.corrcoef(pair)[0, 1])


def test_stage_2_finds_a_turning_light_that_it_knows_the_turns_of() -> None:
    """Without the turns no single light explains the frames."""
    found = []
    known = turning.inputs("object", turning=True)
    for each in (known, without_turns(known)):
        refined = drive(refine, SECOND, refine.Inputs(each.capture, each.refined.trajectory), seed=0)
        assert (refined.trajectory.light_turns is None) == (each is not known)
        found.append(correlation(refined.light.diffuse))
    assert found[0] > 0.9 > 0.6 > found[1]


def test_stage_3_finds_a_turning_light_that_it_knows_the_turns_of() -> None:
    found = []
    known = turning.inputs("object", turning=True)
    for each in (known, without_turns(known)):
        asset = drive(decompose, THIRD, each, seed=0)
        assert (asset.trajectory.light_turns is None) == (each is not known)
        found.append(correlation(asset.environment.lookup))
    assert found[0] > 0.9 > 0.6 > found[1]
