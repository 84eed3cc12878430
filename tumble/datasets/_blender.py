"""Views of layouts that were written by Blender, or in its convention: a field of view and a pose per image.

Poses are camera to world, with OpenGL camera axes and +z up in the world. The *object frame* has +y up, its origin at
the object's centre and the object's radius as unit; centre and radius are determined by the silhouettes of the training
views. The world's -x becomes +z, so that environment maps of Blender, whose centre is the world's +x, need no rotation.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.datasets._bounding_sphere import bounding_sphere
from tumble.datasets._lens import FrameLens
from tumble.datasets._plausibility import plausible_focal
from tumble.io import BadFile
from tumble.scene import OBJECT, Trajectory

R_OBJ_WORLD = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0))
"""Rotation from Blender's world to the object frame, row by row."""


@dataclass(frozen=True)
class ObjectFrame:
    """Where the object is in the world."""

    centre: Float[Tensor, "3"]
    """Origin of the object frame, world frame."""
    radius: float
    """Radius of the object [unit of the world]."""

    def trajectory(self, T_world_cam: Float[Tensor, "t 4 4"]) -> Trajectory:
        """Object poses of views from their matrices, camera to world; the light is fixed to the object."""
        R_obj_world = T_world_cam.new_tensor(R_OBJ_WORLD)
        matrices = T_world_cam.clone()
        matrices[:, :3, :3] = R_obj_world @ T_world_cam[:, :3, :3]
        matrices[:, :3, 3] = (T_world_cam[:, :3, 3] - self.centre) @ R_obj_world.T / self.radius
        return Trajectory.from_camera_to_object(matrices, "object")


def object_frame(
    path: Path, masks: UInt8[np.ndarray, "t h w"], lens: FrameLens, T_world_cam: Float[Tensor, "t 4 4"]
) -> ObjectFrame:
    """The object frame from the silhouettes of the training views.

    Raises:
        BadFile: A silhouette is empty, or they do not show one object.
    """
    fx, fy, cx, cy = lens.fx_fy_cx_cy
    starts, rays = [], []
    for mask, matrix in zip(masks, T_world_cam.double().numpy(), strict=True):
        rows, columns = np.nonzero(mask == OBJECT)
        if not len(rows):
            raise BadFile(path, "has a training view that does not show the object", "remove the view")
        hull = cv2.convexHull(np.stack([columns, rows], -1).astype(np.int32))[:, 0] + 0.5
        # OpenGL camera axes: y up, z backwards.
        d_cam = np.stack([(hull[:, 0] - cx) / fx, -(hull[:, 1] - cy) / fy, -np.ones(len(hull))], -1)
        starts.append(matrix[:3, 3])
        rays.append(d_cam / np.linalg.norm(d_cam, axis=-1, keepdims=True) @ matrix[:3, :3].T)
    centre, radius, _ = bounding_sphere(starts, rays)
    frame = ObjectFrame(torch.from_numpy(centre).to(T_world_cam), radius)
    if bool((frame.trajectory(T_world_cam).T_cam_obj.xyz[:, 2] <= 1).any()) or not radius > 0:
        raise BadFile(path, "has poses that contradict the masks", "poses and masks must belong to these images")
    return frame


def lens_of(path: Path, angle: float, height: int, width: int) -> FrameLens:
    """Lens with a horizontal field of view [radians] and its principal point at the centre.

    Raises:
        BadFile: The field of view in `path` is not that of a lens.
    """
    focal = 0.5 * width / math.tan(0.5 * angle) if 0 < angle < math.pi else math.nan
    if not plausible_focal(focal, height, width):
        raise BadFile(path, f"has a field of view of {angle:.4g}", "it is horizontal, and in radians")
    return FrameLens((focal, focal, width / 2, height / 2), height, width)
