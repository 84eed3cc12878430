"""The baseline with a light per block of frames, on a sphere under a light that is known in closed form."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests import turning
from tumble import recipes
from tumble.engine.loop import drive
from tumble.inverse_rendering import decompose, separate_lights
from tumble.inverse_rendering.separate_lights import Config
from tumble.io import tree
from tumble.maths.directions import texel_directions
from tumble.scene.asset import Asset
from tumble.scene.environment import Environment

BASE = replace(
    recipes.known_poses(recipes.SMOKE).decompose,
    steps=20,
    warmup=10,
    doublings=1,
    pixels=128,
    visibility=False,
    bounce="none",
    try_matte=False,
)


def same(a: Asset, b: Asset) -> bool:
    """Up to the rounding of the logarithm of the light."""
    one, other = tree.named_tensors(a), tree.named_tensors(b)
    return all(torch.allclose(one[name], other[name], rtol=0, atol=1e-6) for name in one)


def test_one_block_under_a_light_that_is_fixed_to_the_object_is_our_method() -> None:
    inputs = turning.inputs("object")
    ours = drive(decompose, BASE, inputs, seed=1)
    assert same(drive(separate_lights, Config(BASE, 1), inputs, seed=1), ours)
    assert not same(drive(separate_lights, Config(BASE, 2), inputs, seed=1), ours)


def test_each_block_finds_the_light_of_its_frames() -> None:
    """Three blocks of a turned light: each map agrees with the light as it was then in the object frame."""
    inputs = turning.inputs("object", turning=True)
    turns = inputs.refined.trajectory.light_turns
    assert turns is not None
    held = replace(inputs.refined.trajectory, light_turns=turns[[0, 4, 8]].repeat_interleave(4, 0))
    inputs = turning.painted(held)
    cfg = Config(replace(BASE, steps=150, warmup=151, doublings=0), 3)
    state = separate_lights.init(cfg, inputs, torch.Generator().manual_seed(0))
    for number in range(cfg.base.steps):
        state.step = number
        separate_lights.step(cfg, inputs, state)
    lights = [state.params.environment, *(state.params.others[key] for key in ("1", "2"))]
    d_obj = torch.cat([torch.eye(3), -torch.eye(3)])

    def correlation(found: Tensor, frame: int) -> float:
        true = 1 + d_obj @ held.R_env_obj[frame].T @ turning.LAMP.T
        return float(torch.corrcoef(torch.stack([found.flatten(), true.flatten()]))[0, 1])

    with torch.no_grad():
        found = [light.lookup(d_obj) for light in lights]
    for block in range(3):
        assert correlation(found[block], 4 * block) > 0.75
        assert correlation(found[block], 4 * block) > 0.2 + max(
            correlation(found[block], 4 * other) for other in range(3) if other != block
        )
    asset = separate_lights.finish(cfg, inputs, state)
    assert asset.trajectory is inputs.refined.trajectory
    # Rotated to the env frame, the three are one light.
    assert correlation(asset.environment.lookup(d_obj @ held.R_env_obj[0].T), 0) > 0.75


def test_the_lights_of_all_blocks_are_rotated_to_the_frame_in_which_they_are_one() -> None:
    """Two halves of a light that turns once, each with its true map in the object frame; untrained."""
    inputs = turning.inputs("object", n=4, turning=True)
    turns = inputs.refined.trajectory.light_turns
    assert turns is not None
    held = replace(inputs.refined.trajectory, light_turns=turns[[0, 3]].repeat_interleave(2, 0))
    inputs = replace(inputs, refined=replace(inputs.refined, trajectory=held))
    cfg = Config(replace(BASE, rows=32), 2)
    state = separate_lights.init(cfg, inputs, torch.Generator().manual_seed(0))
    d_obj = texel_directions(32, 64)
    maps = [Environment.from_radiance(0.5 * (1 + d_obj @ (turning.LAMP @ held.R_env_obj[i]).T)) for i in (0, 2)]
    state.params = replace(state.params, environment=maps[0], others={"1": maps[1]})
    found = separate_lights.finish(cfg, inputs, state).environment.radiance
    true = 0.5 * (1 + d_obj @ turning.LAMP.T)
    torch.testing.assert_close(found / found.mean((0, 1)), true / true.mean((0, 1)), atol=0.02, rtol=0)


@pytest.mark.parametrize(("frames", "lights", "sizes"), [(12, 5, [3, 2, 3, 2, 2]), (12, 100, [1] * 12), (12, 1, [12])])
def test_blocks_are_consecutive_and_nearly_equal(frames: int, lights: int, sizes: list[int]) -> None:
    blocks = separate_lights._blocks(Config(BASE, lights), turning.inputs("camera", n=frames))
    assert sorted(map(len, blocks)) == sorted(sizes)
    assert [frame for block in blocks for frame in block] == list(range(frames))


def test_poses_are_not_optimised() -> None:
    loose = replace(BASE, rates=replace(BASE.rates, poses=1e-3))
    with pytest.raises(ValueError, match="does not optimise poses"):
        separate_lights.init(Config(loose, 2), turning.inputs("camera"), torch.Generator())
    assert recipes.recap(10, recipes.PAPER).decompose.base.rates.poses == 0
