"""Frames of a white sphere under a light that is known in closed form and turns from frame to frame."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tests.surfaces import GAMMA, sphere
from tumble.inverse_rendering.decompose import Inputs
from tumble.inverse_rendering.refine import Refined
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.maths.images import to_srgb8
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.trajectory import Light, Trajectory
from tumble.synthetic import trajectories

ALBEDO = 0.6
LAMP = torch.tensor([[0.9, 0.1, 0.1], [-0.2, 0.8, 0.1], [0.1, -0.3, 0.9]])
"""Radiance of each colour: 0.5 (1 + the direction times its row), env frame."""
CAMERA = Camera.from_fov(math.radians(30), 32, 32)


def photo(view: Trajectory, i: int) -> tuple[Tensor, Tensor]:
    """Linear image of the unit sphere of frame `i`, and its mask; irradiance keeps 2/3 of a light of degree 1."""
    T_obj_cam = view.T_cam_obj[i].inverse()
    d = T_obj_cam.rotation @ CAMERA.directions()
    along = d @ T_obj_cam.xyz
    inside = along.square() - T_obj_cam.xyz @ T_obj_cam.xyz + 1
    normals = T_obj_cam.xyz + (-along - inside.clamp_min(0).sqrt())[..., None] * d
    shading = 0.5 * (1 + (2 / 3) * normals @ view.R_env_obj[i].T @ LAMP.T)
    return ALBEDO * shading * (inside > 0)[..., None], inside > 0


def inputs(light: Light, *, n: int = 12, turning: bool = False) -> Inputs:
    """Inputs of stage 3: frames of the dome or of a hand-held motion with given poses, and the true sphere."""
    distance = trajectories.distance_for(math.radians(30))
    path = trajectories.trajectory("handheld" if light == "camera" else "dome", n, distance, seed=1)
    trajectory = Trajectory(SE3(path.wxyz.float(), path.xyz.float()), light)
    if turning:
        turns = SO3.exp(2 * torch.randn(n, 3, generator=torch.Generator().manual_seed(0))).matrix()
        trajectory = replace(trajectory, light_turns=turns)
    return painted(trajectory)


def painted(trajectory: Trajectory) -> Inputs:
    """Inputs of stage 3: photos along a trajectory, and the true sphere."""
    n, light = len(trajectory), trajectory.light
    images, masks = zip(*(photo(trajectory, i) for i in range(n)), strict=True)
    labels = torch.where(torch.stack(masks), OBJECT, BACKGROUND).to(torch.uint8)
    names = tuple(f"{i:02}.png" for i in range(n))
    capture = Capture(to_srgb8(torch.stack(images)), labels, CAMERA, names, light, trajectory)
    gaussians = sphere(400)
    grey = torch.full((400, 3), 0.4)
    return Inputs(capture, Refined(gaussians, GAMMA, grey, SHLight.constant(0.4, grey), trajectory))
