"""An asset in a rotated frame is the same object."""

import math
from dataclasses import replace

import pytest
import torch

from tests.export.test_bake import painted
from tests.surfaces import torus
from tumble.maths import spherical_harmonics as harmonics
from tumble.maths.directions import fibonacci_sphere, random_rotation
from tumble.maths.se3 import SO3
from tumble.rendering.gbuffer import render_gbuffer
from tumble.scene.asset import Asset
from tumble.scene.trajectory import Trajectory


@pytest.fixture(scope="module")
def asset() -> Asset:
    """A torus with directed colours and tilted normals."""
    rng = torch.Generator().manual_seed(0)
    plain = painted(torus(300))
    gaussians = replace(plain.gaussians, sh=torch.randn(300, 16, 3, generator=rng))
    offset = 0.1 * torch.randn(300, 4, 3, generator=rng)
    return replace(plain, gaussians=gaussians, material=replace(plain.material, normal_offset=offset))


def test_a_rotated_asset_looks_the_same(asset: Asset) -> None:
    R_new_obj = random_rotation(torch.Generator().manual_seed(1))
    rotated = asset.rotated(R_new_obj)
    before, after = (render_gbuffer(a, a.trajectory.T_cam_obj[1], a.camera) for a in (asset, rotated))
    torch.testing.assert_close(after.alpha, before.alpha, atol=1e-4, rtol=0)
    torch.testing.assert_close(after.features["albedo"], before.features["albedo"], atol=1e-3, rtol=0)
    torch.testing.assert_close(after.normal, before.normal @ R_new_obj.mT, atol=1e-3, rtol=0)
    d = fibonacci_sphere(20)
    colours = harmonics.basis(d, 3) @ asset.gaussians.sh[5]
    torch.testing.assert_close(
        harmonics.basis(d @ R_new_obj.mT, 3) @ rotated.gaussians.sh[5], colours, atol=1e-4, rtol=0
    )
    assert rotated.environment is asset.environment, "the light is fixed to the camera"


def test_a_light_that_is_fixed_to_the_object_rotates_with_it(asset: Asset) -> None:
    fixed = replace(asset, trajectory=Trajectory(asset.trajectory.T_cam_obj, "object"))
    over = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    d = fibonacci_sphere(20)
    found = fixed.rotated(over).environment.lookup(d @ over.mT)
    torch.testing.assert_close(found, asset.environment.lookup(d), atol=1e-3, rtol=0)


def test_a_turning_light_is_rotated_with_the_object_that_it_is_fixed_to(asset: Asset) -> None:
    """A direction of the object meets the same radiance before and after."""
    over = SO3.exp(torch.tensor([0.0, 0.0, math.pi])).matrix()
    turns = SO3.exp(0.7 * torch.arange(3.0) * torch.ones(len(asset.trajectory), 1)).matrix()
    path = replace(asset.trajectory, light="object", light_turns=turns)
    before = replace(asset, trajectory=path)
    after = before.rotated(over)
    d_obj = fibonacci_sphere(50)
    seen = [
        each.environment.lookup(d @ each.trajectory.R_env_obj[1].T)
        for each, d in ((before, d_obj), (after, d_obj @ over.T))
    ]
    torch.testing.assert_close(seen[1], seen[0], rtol=2e-2, atol=0)
