"""A camera that turns about its own centre to keep looking at the object, so that two unknowns fall away.

The *aim* frame shares its origin with `cam`; its z axis points at the middle of the silhouette's bounding box. Turning
a pinhole camera about its centre is an exact homography, `K_aim R_aim_cam K^-1`, whatever the depth:
nothing is approximated, unlike by a shift of the picture, and the way back is as exact. With poses found in the aim
frame, those of the camera follow in closed form, translation included: `T_cam_obj = R_cam_aim @ T_aim_obj`.

In the aim frame neither the object nor the light of a still camera stands still: shade in `cam`, only track in here.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from tumble.maths import SE3, SO3
from tumble.poses.progressive import sdf_field
from tumble.poses.progressive.sdf_field import Sdf
from tumble.scene import OBJECT, Camera, Light, Trajectory, visual_hull

FILL = 0.8
"""Part of the virtual frame that the largest silhouette takes: room for what its bounding box cuts off-centre."""


THRESHOLD = 3.0
"""Reprojection error up to which RANSAC takes a point for good [pixels] (FMOV)."""
ITERATIONS = 1000
"""Of RANSAC (FMOV: 100)."""


@dataclass(frozen=True)
class Aim:
    """Where the virtual camera looks in every frame, and its lens, the same for all: sizes stay comparable."""

    R_cam_aim: SO3
    """One per frame: the shortest turn from the camera's axis to the middle of the silhouette."""
    camera: Camera
    """Square, centred."""

    def __len__(self) -> int:
        return self.R_cam_aim.wxyz.shape[0]


def aim_at(masks: UInt8[Tensor, "t h w"], camera: Camera, *, size: int, fill: float = FILL) -> Aim:
    """Aim at the silhouettes of a capture.

    A frame without a sure object pixel keeps the aim of the closest frame that has one.

    Args:
        masks: OBJECT, UNKNOWN or BACKGROUND; only what is surely object is aimed at.
        camera: That of the frames.
        size: Height and width of the virtual frames [pixels].
        fill: Part of the virtual frame's width or height that the largest silhouette takes.

    Raises:
        ValueError: No frame shows the object.
    """
    seen = [i for i, mask in enumerate(masks) if bool((mask == OBJECT).any())]
    if not seen:
        raise ValueError("no mask has an object pixel: nothing to aim the virtual camera at")
    lens = camera.fx_fy_cx_cy
    centres, reach = [], 0.0
    for mask in masks[seen]:
        pixels = torch.nonzero(mask == OBJECT).flip(-1).to(lens)
        middle = (pixels.amin(0) + pixels.amax(0) + 1) / 2
        centres.append(camera.unproject(middle, torch.ones_like(middle[0])))
        corners = pixels[:, None] + lens.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
        x_aim = _turn(centres[-1]).inverse() @ camera.unproject(corners, torch.ones_like(corners[..., 0]))
        reach = max(reach, float((x_aim[..., :2] / x_aim[..., 2:]).abs().max()))
    closest = [min(range(len(seen)), key=lambda k: abs(seen[k] - i)) for i in range(len(masks))]
    focal = 0.5 * size * fill / reach
    virtual = Camera(lens.new_tensor([focal, focal, size / 2, size / 2]), size, size)
    return Aim(_turn(torch.stack([centres[k] for k in closest])), virtual)


def into_aim(aim: Aim, camera: Camera, frame: int, uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Where the virtual camera sees what `camera` sees at `uv` in a frame [pixels]; exact, differentiable."""
    return aim.camera.project(aim.R_cam_aim[frame].inverse() @ camera.unproject(uv, torch.ones_like(uv[..., 0])))


def out_of_aim(aim: Aim, camera: Camera, frame: int, uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Where `camera` sees what the virtual camera sees at `uv` in a frame [pixels]; the inverse of `into_aim`."""
    return camera.project(aim.R_cam_aim[frame] @ aim.camera.unproject(uv, torch.ones_like(uv[..., 0])))


def _turn(toward: Float[Tensor, "*b 3"]) -> SO3:
    """The shortest rotation that takes the z axis to directions in front of it."""
    x, y, z = functional.normalize(toward, dim=-1).unbind(-1)
    return SO3.from_wxyz(torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1))


# Back to the true camera ----------------------------------------------------------------------------------------------


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
