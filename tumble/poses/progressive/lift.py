"""From poses in the virtual camera to poses in the true one, six degrees of freedom (section 4.2).

The virtual camera only turned about its own centre, so the way back is a rotation: `T_cam_obj = R_cam_aim @ T_aim_obj`,
exact. The paper's virtual camera shifts pictures, so that it needs RANSAC and EPnP from projected mesh vertices; the
same is here as a check of the whole chain of frames, lenses and pixels.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths.se3 import SE3
from tumble.poses.progressive import sdf_field
from tumble.poses.progressive.sdf_field import Sdf
from tumble.poses.progressive.virtual_camera import Aim, out_of_aim
from tumble.scene import visual_hull
from tumble.scene.camera import Camera
from tumble.scene.trajectory import Light, Trajectory

THRESHOLD = 3.0
"""Reprojection error up to which RANSAC takes a point for good [pixels] (FMOV)."""
ITERATIONS = 1000
"""Of RANSAC (FMOV: 100)."""


def lift(aim: Aim, T_aim_obj: SE3, light: Light) -> Trajectory:
    """Poses in the true camera, in closed form; differentiable."""
    R_cam_aim = aim.R_cam_aim
    return Trajectory(SE3.from_rotation(R_cam_aim @ T_aim_obj.rotation, R_cam_aim @ T_aim_obj.xyz), light)


@torch.no_grad()
def surface_points(sdf: Sdf, n: int, rng: torch.Generator, *, resolution: int = 64) -> Float[Tensor, "n 3"]:
    """About `n` points on a shape, object frame [object radius].

    Args:
        resolution: Cells per side of the grid (FMOV's mesh for lifting: 64).

    Raises:
        ValueError: There is no surface in the unit ball.
    """
    like = sdf.layers.weights["bias0"]
    ticks = (torch.arange(resolution, dtype=like.dtype, device=like.device) + 0.5) / resolution * 2 - 1
    x_obj = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    distance = torch.cat([sdf_field.distance(sdf, part) for part in x_obj.split(1 << 16)])
    # As shares of a cell, inside 1: what `hull` takes for silhouettes.
    inside = (0.5 - distance * resolution / 4).clamp(0, 1)
    inside = torch.where(x_obj.norm(dim=-1) < 1, inside, 0.0)
    return visual_hull.surface(inside.reshape(resolution, resolution, resolution), n, rng).positions


def by_pnp(points: Float[Tensor, "n 3"], aim: Aim, T_aim_obj: SE3, camera: Camera, light: Light) -> Trajectory:
    """The paper's lifting: project points virtually, find the pixels in the true frames, solve for the pose.

    Points at the back count as well: they are no observations.

    Raises:
        ValueError: No pose explains a frame's pixels; the message names the frame.
    """
    matrix = camera.matrix.double().cpu().numpy()
    poses = []
    for frame in range(len(aim)):
        uv_aim = aim.camera.project(T_aim_obj[frame] @ points)
        uv = out_of_aim(aim, camera, frame, uv_aim).double().cpu().numpy()
        found, rvec, tvec, _ = cv2.solvePnPRansac(
            points.double().cpu().numpy(),
            uv,
            matrix,
            None,
            iterationsCount=ITERATIONS,
            reprojectionError=THRESHOLD,
            flags=cv2.SOLVEPNP_EPNP,
        )
        if not found:
            raise ValueError(f"frame {frame}: no pose explains where the shape's points should be seen")
        T_cam_obj = np.eye(4)
        T_cam_obj[:3, :3], T_cam_obj[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
        poses.append(torch.from_numpy(T_cam_obj).to(points))
    return Trajectory(SE3.from_matrix(torch.stack(poses)), light)


def disagreement(a: Trajectory, b: Trajectory) -> tuple[float, float]:
    """Largest difference of two trajectories in rotation [degrees] and translation [object radius]."""
    between = a.T_cam_obj.inverse() @ b.T_cam_obj
    angle = float(between.rotation.angle().max())
    return math.degrees(angle), float((a.T_cam_obj.xyz - b.T_cam_obj.xyz).norm(dim=-1).max())
