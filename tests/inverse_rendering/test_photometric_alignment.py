"""Poses against photographs whose true ones are known: a painted ball in closed form."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tumble.inverse_rendering.photometric_alignment import realign
from tumble.maths.se3 import SE3, SO3, angle_between
from tumble.scene.camera import Camera

CAMERA = Camera.from_fov(math.radians(30), 64, 64)
WAVES = torch.tensor([[5.0, 1, -3], [2, -6, 1], [-1, 3, 5]], dtype=torch.float64)
TRUTH = SE3.from_rotation(SO3.exp(torch.tensor([0.4, -1.1, 0.3]).double()), torch.tensor([0.05, -0.1, 4.5]).double())


def painted_ball(T_cam_obj: SE3) -> Tensor:
    """A unit ball whose three channels are waves over its own axes, on black, with an edge of a pixel; `[64 64 3]`."""
    rays = CAMERA.unproject(CAMERA.pixel_centers().double(), torch.ones(64, 64).double())
    rays = rays / rays.norm(dim=-1, keepdim=True)
    along = rays @ T_cam_obj.xyz
    inside = 1 - T_cam_obj.xyz.square().sum() + along.square()
    hit = (along - inside.clamp_min(0).sqrt())[..., None] * rays
    x_obj = T_cam_obj.inverse() @ hit
    return (0.5 + 0.4 * (x_obj @ WAVES.T).sin()) * (40 * inside).sigmoid()[..., None]


def against(photograph: Tensor) -> Callable[[SE3], Tensor]:
    return lambda T_cam_obj: (painted_ball(T_cam_obj) - photograph).flatten()


def off(T_cam_obj: SE3) -> tuple[float, float]:
    degrees = math.degrees(float(angle_between(T_cam_obj.rotation, TRUTH.rotation)))
    return degrees, float((T_cam_obj.xyz - TRUTH.xyz).norm())


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_two_degrees_and_a_fiftieth_off_is_found(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    turn, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1)
    wrong = SE3.from_rotation(SO3.exp(math.radians(2) * turn) @ TRUTH.rotation, TRUTH.xyz + 0.02 * shift)
    degrees, distance = off(realign(against(painted_ball(TRUTH)), wrong, rounds=6))
    # A hundredth of a pixel: the differences are half a pixel long.
    assert degrees < 0.05
    assert distance < 0.01


def test_stains_are_no_motion() -> None:
    """A fifth of the ball is white, as no pose explains."""
    photograph = painted_ball(TRUTH)
    photograph[24:45, 20:41] = 1.0
    wrong = SE3.from_rotation(SO3.exp(torch.tensor([0.02, -0.02, 0.01]).double()) @ TRUTH.rotation, TRUTH.xyz)
    degrees, _ = off(realign(against(photograph), wrong, rounds=6))
    assert degrees < 0.4  # of 1.7


def test_a_pose_never_gets_worse_and_a_black_picture_moves_nothing() -> None:
    assert realign(against(painted_ball(TRUTH)), TRUTH) is TRUTH
    assert realign(lambda T_cam_obj: torch.zeros(10, dtype=torch.float64), TRUTH) is TRUTH
    broken = realign(lambda T: torch.full((10,), 0.1 if T is TRUTH else math.nan, dtype=torch.float64), TRUTH)
    assert broken is TRUTH
