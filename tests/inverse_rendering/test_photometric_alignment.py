"""Photometric alignment against images with known poses: a textured sphere in closed form."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tumble.inverse_rendering.photometric_alignment import align_pose
from tumble.maths.se3 import SE3, SO3, angle_between
from tumble.scene.camera import Camera

CAMERA = Camera.from_fov(math.radians(30), 64, 64)
WAVES = torch.tensor([[5.0, 1, -3], [2, -6, 1], [-1, 3, 5]], dtype=torch.float64)
TRUTH = SE3.from_rotation(SO3.exp(torch.tensor([0.4, -1.1, 0.3]).double()), torch.tensor([0.05, -0.1, 4.5]).double())


def textured_sphere(T_cam_obj: SE3) -> Tensor:
    """Image of a unit sphere with a sinusoidal texture, over black, with an edge one pixel wide; `[64 64 3]`."""
    rays = CAMERA.unproject(CAMERA.pixel_centers().double(), torch.ones(64, 64).double())
    rays = rays / rays.norm(dim=-1, keepdim=True)
    along = rays @ T_cam_obj.xyz
    inside = 1 - T_cam_obj.xyz.square().sum() + along.square()
    hit = (along - inside.clamp_min(0).sqrt())[..., None] * rays
    x_obj = T_cam_obj.inverse() @ hit
    return (0.5 + 0.4 * (x_obj @ WAVES.T).sin()) * (40 * inside).sigmoid()[..., None]


def residual_against(photo: Tensor) -> Callable[[SE3], Tensor]:
    return lambda T_cam_obj: (textured_sphere(T_cam_obj) - photo).flatten()


def pose_error(T_cam_obj: SE3) -> tuple[float, float]:
    """Rotation error [degrees] and translation error [object radius]."""
    degrees = math.degrees(float(angle_between(T_cam_obj.rotation, TRUTH.rotation)))
    return degrees, float((T_cam_obj.xyz - TRUTH.xyz).norm())


@pytest.mark.parametrize("seed", range(4))
def test_an_error_of_two_degrees_and_a_fiftieth_radius_is_corrected(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    axis, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1)
    wrong = SE3.from_rotation(SO3.exp(math.radians(2) * axis) @ TRUTH.rotation, TRUTH.xyz + 0.02 * shift)
    degrees, distance = pose_error(align_pose(residual_against(textured_sphere(TRUTH)), wrong, rounds=6))
    # About a hundredth of a pixel, although the steps of the finite differences are half a pixel.
    assert degrees < 0.05
    assert distance < 0.01


def test_occlusions_hardly_affect_the_pose() -> None:
    """A fifth of the sphere is white, which no pose explains."""
    photo = textured_sphere(TRUTH)
    photo[24:45, 20:41] = 1.0
    wrong = SE3.from_rotation(SO3.exp(torch.tensor([0.02, -0.02, 0.01]).double()) @ TRUTH.rotation, TRUTH.xyz)
    degrees, _ = pose_error(align_pose(residual_against(photo), wrong, rounds=6))
    assert degrees < 0.4  # initially 1.7


def test_the_cost_never_increases_and_a_black_image_changes_nothing() -> None:
    assert align_pose(residual_against(textured_sphere(TRUTH)), TRUTH) is TRUTH
    assert align_pose(lambda T_cam_obj: torch.zeros(10, dtype=torch.float64), TRUTH) is TRUTH
    not_finite = align_pose(lambda T: torch.full((10,), 0.1 if T is TRUTH else math.nan, dtype=torch.float64), TRUTH)
    assert not_finite is TRUTH
