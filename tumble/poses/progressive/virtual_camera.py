"""Virtual camera: the true camera rotated about its centre in every frame to look at the object (section 4.1; FMOV).

The *aim* frame is the frame of the virtual camera. It shares its origin with `cam`, and its z axis points at the centre
of the silhouette's bounding box, which eliminates two degrees of freedom of the translation. A rotation of a pinhole
camera about its centre is a homography, `K_aim R_aim_cam K^-1`, that does not depend on depth. It is exact, unlike the
shift of images that FMOV uses, and invertible. Poses in the aim frame therefore give those in the camera frame in
closed form, translation included: `T_cam_obj = R_cam_aim @ T_aim_obj`.

In the aim frame even the light of a static camera moves, so the frame serves for tracking only; shading uses `cam`.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from tumble.io import tree
from tumble.maths import SE3, SO3
from tumble.poses.progressive import sdf_field
from tumble.poses.progressive.grid_field import Grids
from tumble.poses.progressive.sdf_field import Sdf
from tumble.scene import OBJECT, Camera, Light, Trajectory, visual_hull

FILL = 0.8
"""Fraction of the virtual frame's width or height that the largest silhouette takes, which leaves a margin."""
RANSAC_THRESHOLD = 3.0
"""Reprojection error up to which a point is an inlier of RANSAC, as in FMOV [pixels]."""
RANSAC_ITERATIONS = 1000
"""Number of iterations of RANSAC; FMOV uses 100."""


@dataclass(frozen=True)
class Aim:
    """Virtual camera: orientation per frame, and one set of intrinsics for all frames, so that sizes are comparable."""

    R_cam_aim: SO3
    """Aim frame to camera, one per frame: the shortest rotation of the viewing axis to the silhouette's centre."""
    camera: Camera
    """Intrinsics of the virtual camera: square frame, centred principal point."""

    def __len__(self) -> int:
        return self.R_cam_aim.wxyz.shape[0]


def aim_at(masks: UInt8[Tensor, "t h w"], camera: Camera, *, size: int, fill: float = FILL) -> Aim:
    """Virtual camera that looks at the silhouettes of a capture.

    A frame without object pixels takes the orientation of the closest frame that has some.

    Args:
        masks: OBJECT, UNKNOWN or BACKGROUND; unknown pixels are ignored.
        camera: Camera of the frames.
        size: Height and width of the virtual frames [pixels].
        fill: Fraction of the virtual frame's width or height that the largest silhouette takes.

    Raises:
        ValueError: No frame shows the object.
    """
    visible = [i for i, mask in enumerate(masks) if bool((mask == OBJECT).any())]
    if not visible:
        raise ValueError("no mask has an object pixel: the virtual camera has nothing to look at")
    intrinsics = camera.fx_fy_cx_cy
    centres, extent = [], 0.0
    for mask in masks[visible]:
        pixels = torch.nonzero(mask == OBJECT).flip(-1).to(intrinsics)
        middle = (pixels.amin(0) + pixels.amax(0) + 1) / 2
        centres.append(camera.unproject(middle, torch.ones_like(middle[0])))
        corners = pixels[:, None] + intrinsics.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
        x_aim = _shortest_rotation(centres[-1]).inverse() @ camera.unproject(corners, torch.ones_like(corners[..., 0]))
        extent = max(extent, float((x_aim[..., :2] / x_aim[..., 2:]).abs().max()))
    closest = [min(range(len(visible)), key=lambda k: abs(visible[k] - i)) for i in range(len(masks))]
    focal = 0.5 * size * fill / extent
    virtual = Camera(intrinsics.new_tensor([focal, focal, size / 2, size / 2]), size, size)
    return Aim(_shortest_rotation(torch.stack([centres[k] for k in closest])), virtual)


def camera_to_aim(aim: Aim, camera: Camera, frame: int, uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Positions in the virtual frame from positions `uv` in a frame [pixels]; exact and differentiable."""
    return aim.camera.project(aim.R_cam_aim[frame].inverse() @ camera.unproject(uv, torch.ones_like(uv[..., 0])))


def aim_to_camera(aim: Aim, camera: Camera, frame: int, uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Positions in a frame from positions `uv` in the virtual frame [pixels]; the inverse of `camera_to_aim`."""
    return camera.project(aim.R_cam_aim[frame] @ aim.camera.unproject(uv, torch.ones_like(uv[..., 0])))


def _shortest_rotation(direction: Float[Tensor, "*b 3"]) -> SO3:
    """Shortest rotation that takes the z axis to a direction with positive z."""
    x, y, z = functional.normalize(direction, dim=-1).unbind(-1)
    return SO3.from_wxyz(torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1))


# Back to the true camera ----------------------------------------------------------------------------------------------


def lift(aim: Aim, T_aim_obj: SE3, light: Light) -> Trajectory:
    """Poses in the true camera from poses in the aim frame, in closed form; differentiable."""
    R_cam_aim = aim.R_cam_aim
    return Trajectory(SE3.from_rotation(R_cam_aim @ T_aim_obj.rotation, R_cam_aim @ T_aim_obj.xyz), light)


@torch.no_grad()
def surface_points(sdf: Sdf | Grids, n: int, rng: torch.Generator, *, resolution: int = 64) -> Float[Tensor, "n 3"]:
    """The paper's surface points for 2D-3D correspondences (section 4.2), input of `by_pnp`.

    Args:
        sdf: Shape.
        n: Approximate number of points.
        rng: Random number generator that selects the points.
        resolution: Cells per side of the grid on which the surface is extracted; FMOV's mesh for lifting has 64.

    Returns:
        Points on the surface, object frame [object radius].

    Raises:
        ValueError: There is no surface in the unit sphere, as tracking has failed.
    """
    like = next(iter(tree.named_tensors(sdf).values()))
    ticks = (torch.arange(resolution, dtype=like.dtype, device=like.device) + 0.5) / resolution * 2 - 1
    x_obj = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    distance = torch.cat([sdf_field.distance(sdf, part) for part in x_obj.split(1 << 16)])
    # A ramp of two cells across the surface, so that neither end of a grid edge that crosses it is clamped: with the
    # fraction of each cell inside, a ramp of one cell, interpolated points of a sphere are 8 times less precise.
    inside = (0.5 - distance * resolution / 4).clamp(0, 1)
    inside = torch.where(x_obj.norm(dim=-1) < 1, inside, 0.0)
    try:
        return visual_hull.sample_surface(inside.reshape(resolution, resolution, resolution), n, rng).positions
    except ValueError:
        rule = "the tracked shape has no surface in the unit sphere, as tracking has failed"
        raise ValueError(f"{rule}: estimate the poses by the other route (--route graph)") from None


def by_pnp(points: Float[Tensor, "n 3"], aim: Aim, T_aim_obj: SE3, camera: Camera, light: Light) -> Trajectory:
    """The paper's lifting of poses to the true camera by RANSAC-EPnP (section 4.2).

    `lift` does the same in closed form. Points are projected into the virtual frame and
    mapped to the true frame; the pose is then estimated from these 2D-3D correspondences. Points on the back of the
    object are used as well, as correspondences are projections rather than observations.

    Args:
        points: Surface points, object frame.
        aim: Virtual camera.
        T_aim_obj: Object to virtual camera, one per frame.
        camera: True camera.
        light: Motion of the light, see `Trajectory.light`.

    Raises:
        ValueError: RANSAC finds no pose for a frame; the message names the frame.
    """
    matrix = camera.matrix.double().cpu().numpy()
    poses = []
    for frame in range(len(aim)):
        uv_aim = aim.camera.project(T_aim_obj[frame] @ points)
        uv = aim_to_camera(aim, camera, frame, uv_aim).double().cpu().numpy()
        success, rvec, tvec, _ = cv2.solvePnPRansac(
            points.double().cpu().numpy(),
            uv,
            matrix,
            None,
            iterationsCount=RANSAC_ITERATIONS,
            reprojectionError=RANSAC_THRESHOLD,
            flags=cv2.SOLVEPNP_EPNP,
        )
        if not success:
            rule = f"frame {frame}: RANSAC found no pose for the projected surface points"
            raise ValueError(f"{rule}: estimate the poses by the other route (--route graph)")
        T_cam_obj = np.eye(4)
        T_cam_obj[:3, :3], T_cam_obj[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
        poses.append(torch.from_numpy(T_cam_obj).to(points))
    return Trajectory(SE3.from_matrix(torch.stack(poses)), light)
