"""The trajectory: object poses in the camera frame, and the frame in which the light is static.

Frames: `obj` (the object, inside the unit sphere), `cam` (OpenCV), `env` (the frame of the environment map). With
`light == "camera"` the env frame is the camera with OpenGL axes (x right, y up, z backwards), so that the top of the
map is up in the image; with `light == "object"` it is the object frame (docs/format.md). In some synthetic captures the
light also turns by itself, from frame to frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, Index, entry

Light = Literal["camera", "object"]
"""Frame in which the light is static."""


def opengl_from_opencv(like: Tensor) -> Float[Tensor, "3 3"]:
    """Rotation from OpenCV to OpenGL camera axes, and its own inverse."""
    return _opengl_from_opencv(like.dtype, like.device)


@cache
def _opengl_from_opencv(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 3"]:
    """`opengl_from_opencv`, copied to a device once."""
    return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=dtype)).to(device)


def env_from_obj(T_cam_obj: SE3, light: Light) -> Float[Tensor, "*b 3 3"]:
    """`R_env_obj` of given poses; rotation only, because the light is distant (eq. 3)."""
    R_cam_obj = T_cam_obj.rotation.matrix()
    if light == "camera":
        return opengl_from_opencv(R_cam_obj) @ R_cam_obj
    return torch.eye(3, dtype=R_cam_obj.dtype, device=R_cam_obj.device).expand_as(R_cam_obj)


@dataclass(frozen=True)
class Trajectory:
    """Object pose per frame, and the frame in which the light is static."""

    T_cam_obj: SE3
    """Object to camera (OpenCV axes), one per frame [object radius]."""
    light: Light
    """"camera" for hand-held and turntable captures, "object" for a static dome."""
    light_turns: Float[Tensor, "t 3 3"] | None = None
    """Rotation of each frame from the frame named by `light` to the env frame; None if the light does not turn."""

    @staticmethod
    def from_camera_to_object(matrices: Float[Tensor, "t 4 4"], light: Light) -> "Trajectory":
        """From the `transform_matrix` of docs/format.md: camera to object, OpenGL camera axes."""
        T_obj_gl = SE3.from_matrix(matrices)
        T_gl_cam = SE3.from_rotation_matrix(opengl_from_opencv(matrices))
        return Trajectory((T_obj_gl @ T_gl_cam).inverse(), light)

    def camera_to_object(self) -> Float[Tensor, "t 4 4"]:
        """The `transform_matrix` of docs/format.md: camera to object, OpenGL camera axes."""
        T_cam_gl = SE3.from_rotation_matrix(opengl_from_opencv(self.T_cam_obj.xyz))
        return (self.T_cam_obj.inverse() @ T_cam_gl).matrix()

    @property
    def R_env_obj(self) -> Float[Tensor, "t 3 3"]:
        """Object to environment; rotation only, because the light is distant (eq. 3)."""
        R_env_obj = env_from_obj(self.T_cam_obj, self.light)
        return R_env_obj if self.light_turns is None else self.light_turns @ R_env_obj

    def R_env_obj_at(self, frame: Index, T_cam_obj: SE3) -> Float[Tensor, "3 3"]:
        """`R_env_obj` of a frame at another pose, such as a corrected one."""
        R_env_obj = env_from_obj(T_cam_obj, self.light)
        return R_env_obj if self.light_turns is None else entry(self.light_turns, frame) @ R_env_obj

    @property
    def camera_positions(self) -> Float[Tensor, "t 3"]:
        """Camera centres, object frame [object radius]."""
        return self.T_cam_obj.inverse().xyz

    def turned(self, turn: SO3, centre: Float[Tensor, "3"]) -> "Trajectory":
        """Poses whose object is first turned about a point of the object frame; one turn per pose, or one for all."""
        return replace(self, T_cam_obj=self.T_cam_obj @ SE3.from_rotation(turn, centre - turn @ centre))

    def __len__(self) -> int:
        return self.T_cam_obj.xyz.shape[0]

    def select(self, frames: Sequence[int] | Tensor) -> "Trajectory":
        """The trajectory reduced to the given frames, in the given order."""
        index = torch.as_tensor(frames, dtype=torch.long).to(self.T_cam_obj.xyz.device)
        turns = None if self.light_turns is None else self.light_turns[index]
        return replace(self, T_cam_obj=self.T_cam_obj[index], light_turns=turns)
