"""The pinhole camera, with OpenCV axes (x right, y down, z forward) and the first pixel centre at (0.5, 0.5).

A *pixel position* `uv` is measured from the top left corner of the image; `uv[0]` runs along the width.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one pinhole camera; the extrinsics are part of `Trajectory`."""

    fx_fy_cx_cy: Float[Tensor, "4"]
    """Focal lengths and principal point [pixels]."""
    height: int
    """Image height [pixels]."""
    width: int
    """Image width [pixels]."""

    @staticmethod
    def from_fov(fov_x: float, height: int, width: int) -> "Camera":
        """Camera with a centred principal point, square pixels and horizontal field of view `fov_x` [radians]."""
        focal = 0.5 * width / math.tan(0.5 * fov_x)
        return Camera(torch.tensor([focal, focal, width / 2, height / 2]), height, width)

    @property
    def fov_x(self) -> float:
        """Horizontal field of view [radians], for a centred principal point."""
        return 2 * math.atan(0.5 * self.width / float(self.fx_fy_cx_cy[0]))

    @property
    def matrix(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix K with `[u w, v w, w] = K @ x_cam`."""
        fx, fy, cx, cy = self.fx_fy_cx_cy
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(3, 3)

    @property
    def opencv_matrix(self) -> Float64[np.ndarray, "3 3"]:
        """Intrinsic matrix for OpenCV and data layouts such as BOP's, whose first pixel centre lies at (0, 0)."""
        K = self.matrix.double().cpu().numpy().copy()
        K[:2, 2] -= 0.5
        return K

    def pixel_centers(self) -> Float[Tensor, "h w 2"]:
        """Positions of all pixel centres [pixels]."""
        like = {"dtype": self.fx_fy_cx_cy.dtype, "device": self.fx_fy_cx_cy.device}
        v, u = torch.meshgrid(torch.arange(self.height, **like), torch.arange(self.width, **like), indexing="ij")
        return torch.stack([u, v], -1) + 0.5

    def project(self, x_cam: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
        """Pixel positions of points in front of the camera, camera frame."""
        return x_cam[..., :2] / x_cam[..., 2:] * self.fx_fy_cx_cy[:2] + self.fx_fy_cx_cy[2:]

    def unproject(self, uv: Float[Tensor, "*b 2"], depth: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
        """Points with z-depth `depth` [object radius] at the given pixel positions, camera frame."""
        xy = (uv - self.fx_fy_cx_cy[2:]) / self.fx_fy_cx_cy[:2]
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1) * depth[..., None]

    def directions(self) -> Float[Tensor, "h w 3"]:
        """Unit directions from the camera through all pixel centres, camera frame."""
        uv = self.pixel_centers()
        return torch.nn.functional.normalize(self.unproject(uv, torch.ones_like(uv[..., 0])), dim=-1)

    def resized(self, height: int, width: int) -> "Camera":
        """The camera of the same view resized to another number of pixels."""
        x, y = width / self.width, height / self.height
        return Camera(self.fx_fy_cx_cy * self.fx_fy_cx_cy.new_tensor([x, y, x, y]), height, width)

    def zoomed(self, factor: float) -> "Camera":
        """The camera with both focal lengths multiplied by a factor."""
        return replace(self, fx_fy_cx_cy=self.fx_fy_cx_cy * self.fx_fy_cx_cy.new_tensor([factor, factor, 1, 1]))

    def centred(self) -> "Camera":
        """The camera with its principal point moved to the image centre."""
        middle = self.fx_fy_cx_cy.new_tensor([self.width / 2, self.height / 2])
        return replace(self, fx_fy_cx_cy=torch.cat([self.fx_fy_cx_cy[:2], middle]))

    def cropped(self, top: int, left: int, height: int, width: int) -> "Camera":
        """The camera of a cropped image; `top` and `left` are the corner of the crop [pixels]."""
        return Camera(self.fx_fy_cx_cy - self.fx_fy_cx_cy.new_tensor([0, 0, left, top]), height, width)


def undistortion(
    K: Float64[np.ndarray, "3 3"],
    coefficients: Float64[np.ndarray, " k"],
    camera: Camera,
    *,
    fisheye: bool,
    R_new_cam: Float64[np.ndarray, "3 3"] | None = None,
) -> Callable[..., np.ndarray]:
    """Function that resamples images of a distorting lens to those of a pinhole camera.

    Its arguments are the image, OpenCV's interpolation flag, and optionally OpenCV's border mode and border value.

    Args:
        K: Intrinsic matrix of the real lens in OpenCV's pixel convention (`Camera.opencv_matrix`).
        coefficients: Distortion coefficients of OpenCV's fisheye model or of its standard model.
        camera: The pinhole camera.
        fisheye: Use the fisheye model.
        R_new_cam: Rotation from the real camera to the pinhole camera; None is the identity.
    """
    tables = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    R = np.eye(3) if R_new_cam is None else R_new_cam
    x, y = tables(K, coefficients, R, camera.opencv_matrix, (camera.width, camera.height), cv2.CV_32FC1)

    def undistort(
        image: np.ndarray, interpolation: int, border: int = cv2.BORDER_CONSTANT, value: int = 0
    ) -> np.ndarray:
        return cv2.remap(image, x, y, interpolation, borderMode=border, borderValue=value)

    return undistort
