"""Poses in the virtual camera give those in the true camera, in closed form and by EPnP."""

import math

import pytest
import torch

from tests.oracles.virtual_camera import disagreement
from tumble.maths.se3 import SE3, SO3
from tumble.poses.progressive import sdf_field, virtual_camera
from tumble.poses.progressive.sdf_field import Sizes
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT
from tumble.scene.trajectory import Trajectory


def scene(n: int = 4) -> tuple[virtual_camera.Aim, Camera, Trajectory]:
    """An off-centre camera, masks far from the axis, and random poses."""
    camera = Camera(torch.tensor([150.0, 170.0, 70.0, 45.0]), 100, 160)
    masks = torch.full((n, 100, 160), BACKGROUND, dtype=torch.uint8)
    for i in range(n):
        masks[i, 10 + 8 * i : 40 + 8 * i, 5 + 30 * i : 45 + 30 * i] = OBJECT
    aim = virtual_camera.aim_at(masks, camera, size=96)
    rng = torch.Generator().manual_seed(0)
    truth = SE3(
        SO3.exp(torch.randn(n, 3, generator=rng)).wxyz, torch.tensor([0.4, -0.3, 5.0]) + torch.rand(n, 3, generator=rng)
    )
    return aim, camera, Trajectory(truth, "camera")


def test_closed_form_equals_the_true_pose() -> None:
    aim, camera, truth = scene()
    R_aim_cam = aim.R_cam_aim.inverse()
    T_aim_obj = SE3.from_rotation(R_aim_cam @ truth.T_cam_obj.rotation, R_aim_cam @ truth.T_cam_obj.xyz)
    lifted = virtual_camera.lift(aim, T_aim_obj, "camera")
    angle, shift = disagreement(lifted, truth)
    # Quaternion products in float32.
    assert angle < 1e-3 * math.degrees(1)
    assert shift < 1e-5
    # Projections by the virtual and by the true camera are related by the homography.
    x_obj = torch.tensor([0.2, -0.5, 0.3])
    for frame in range(len(truth)):
        virtual = aim.camera.project(T_aim_obj[frame] @ x_obj)
        true = camera.project(truth.T_cam_obj[frame] @ x_obj)
        assert torch.allclose(virtual_camera.aim_to_camera(aim, camera, frame, virtual), true, atol=1e-3)


def test_epnp_gives_the_same_poses() -> None:
    aim, camera, truth = scene()
    R_aim_cam = aim.R_cam_aim.inverse()
    T_aim_obj = SE3.from_rotation(R_aim_cam @ truth.T_cam_obj.rotation, R_aim_cam @ truth.T_cam_obj.xyz)
    rng = torch.Generator().manual_seed(0)
    net = sdf_field.sphere_initialised(
        Sizes(width=48, depth=3, skip=0, features=4, octaves=2, colour_width=8, colour_depth=1), rng
    )
    points = virtual_camera.surface_points(net.sdf, 500, rng, resolution=32)
    # The initial shape is a sphere of radius 0.5, to a tenth.
    assert (points.norm(dim=-1) - 0.5).abs().mean() < 0.05
    angle, shift = disagreement(virtual_camera.by_pnp(points, aim, T_aim_obj, camera, "camera"), truth)
    # Pixels in float32 at a distance of 5 radii: 1e-4 of a pixel over 15 pixels of depth relief.
    assert angle < 0.05
    assert shift < 0.01


def test_disagreement_of_a_translation_is_its_length() -> None:
    _, _, truth = scene()
    shifted = Trajectory(SE3(truth.T_cam_obj.wxyz, truth.T_cam_obj.xyz + torch.tensor([0.0, 0.3, 0.4])), "camera")
    assert abs(disagreement(shifted, truth)[1] - 0.5) < 1e-5


def test_a_shape_without_a_surface_is_named() -> None:
    """Its radius is negative."""
    rng = torch.Generator().manual_seed(0)
    sizes = Sizes(width=48, depth=3, skip=0, features=4, octaves=2, colour_width=8, colour_depth=1, radius=-0.5)
    net = sdf_field.sphere_initialised(sizes, rng)
    with pytest.raises(ValueError, match="tracking has failed"):
        virtual_camera.surface_points(net.sdf, 500, rng, resolution=16)
