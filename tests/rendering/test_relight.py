"""Relighting: the preview of a sphere under one small light, in closed form; metal in a white furnace."""

import math
from dataclasses import replace

import pytest
import torch

from tests.surfaces import GAMMA, look_at, sphere, torus
from tumble.maths.directions import texel_directions, texel_solid_angles
from tumble.maths.se3 import SE3
from tumble.rendering import relight
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.material import Material
from tumble.scene.trajectory import Trajectory

CAMERA = Camera(torch.tensor([70.0, 70.0, 32.0, 32.0]), 64, 64)
ALBEDO = torch.tensor([0.7, 0.4, 0.2])


@pytest.mark.parametrize(("row", "column"), [(20, 40), (33, 90), (45, 61)])
@pytest.mark.parametrize("rows", [64, 256])
def test_a_small_light_between_the_directions_is_not_missed(rows: int, row: int, column: int) -> None:
    """A light of one texel, or of 4 x 4 texels of a finer map: the radiance is albedo / pi times irradiance."""
    fine = rows // 64
    radiance = torch.full((rows, 2 * rows, 3), 1e-6)
    radiance[fine * row : fine * (row + 1), fine * column : fine * (column + 1)] = 500.0
    lamp = texel_directions(64, 128)[row, column]
    strength = 500.0 * texel_solid_angles(64, 128)[row, column]
    gaussians = sphere(4000)
    material = Material.constant(4000, ALBEDO, 0.9)
    # No specular lobe: f0 is about 0.
    material = Material(material.albedo_logits, material.roughness_logits, material.normal_offset, torch.tensor(-20.0))
    # The camera is close to the direction of the light.
    T_cam_obj = look_at((4 * lamp + torch.tensor([0.5, 0.5, 0.7])).tolist())
    poses = SE3(T_cam_obj.wxyz[None], T_cam_obj.xyz[None])
    environment = Environment.from_radiance(radiance)
    asset = Asset(gaussians, GAMMA, material, environment, Trajectory(poses, "object"), CAMERA)
    (image,) = relight.preview(relight.Config(), asset, environment, asset.trajectory, CAMERA)
    normals = sphere_normals(T_cam_obj)
    inside = normals.norm(dim=-1) > 0.5
    expected = ALBEDO / math.pi * strength * (normals @ lamp).clamp(min=0)[..., None]
    error = (image - expected)[inside].square().mean(0).sqrt() / expected.amax((0, 1))
    # Cells are about as wide as the distance between directions, which causes errors of 5 % of the brightest value on
    # average, at most 14 % for sixty positions of the light. Point lookups would miss the light or triple it.
    assert error.max() < 0.15


def test_metal_is_lit_by_the_mirrored_light_of_other_metal_and_by_no_diffuse_one() -> None:
    """A white metal torus in a white furnace is nowhere brighter than the light."""
    gaussians, T_cam_obj = torus(1000), look_at([2, 1, 3])
    material = replace(Material.constant(1000, torch.full((3,), 0.999), 0.4), metal_logits=torch.full((1000,), 200.0))
    white = Environment.from_radiance(torch.ones(8, 16, 3))
    path = Trajectory(SE3(T_cam_obj.wxyz[None], T_cam_obj.xyz[None]), "object")
    asset = Asset(gaussians, GAMMA, material, white, path, CAMERA)
    cfg = relight.Config(brdf_samples=64, light_samples=64)
    (image,) = relight.relight(cfg, asset, white, path, CAMERA)
    covered = image.mean(-1) > 0.5
    assert covered.sum() > 800
    # 128 rays leave an error of up to a tenth; single scattering loses some of the light at this roughness.
    assert float(image.max()) < 1.2
    assert 0.85 < float(image[covered].mean()) < 1


def sphere_normals(T_cam_obj: SE3) -> torch.Tensor:
    """Normals of the unit sphere behind every pixel, a little inside its silhouette; zero elsewhere."""
    eye = T_cam_obj.inverse().xyz
    rays = T_cam_obj.inverse().rotation @ CAMERA.directions()
    along = rays @ eye
    root = along.square() - eye @ eye + 1
    hit = eye - rays * (along + root.clamp(min=0).sqrt())[..., None]
    return hit * (root > 0.15)[..., None]
