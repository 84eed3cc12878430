"""The pinhole camera: OpenCV axes (x right, y down, z forward), the centre of the first pixel at (0.5, 0.5).

A *pixel position* `uv` counts from the top left corner of the image; `uv[0]` runs along the width.
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
    """Intrinsics of one pinhole camera; where it stands is the trajectory's business."""

    fx_fy_cx_cy: Float[Tensor, "4"]
    """Focal lengths and principal point [pixels]."""
    height: int
    """[pixels]"""
    width: int
    """[pixels]"""

    @staticmethod
    def from_fov(fov_x: float, height: int, width: int) -> "Camera":
        """The centred camera with square pixels and horizontal field of view `fov_x` [radians]."""
        focal = 0.5 * width / math.tan(0.5 * fov_x)
        return Camera(torch.tensor([focal, focal, width / 2, height / 2]), height, width)

    @property
    def fov_x(self) -> float:
        """Horizontal field of view [radians], for a centred principal point."""
        return 2 * math.atan(0.5 * self.width / float(self.fx_fy_cx_cy[0]))

    @property
    def matrix(self) -> Float[Tensor, "3 3"]:
        """K with `[u w, v w, w] = K @ x_cam`."""
        fx, fy, cx, cy = self.fx_fy_cx_cy
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(3, 3)

    @property
    def opencv_matrix(self) -> Float64[np.ndarray, "3 3"]:
        """K for OpenCV's functions and layouts like BOP's, which put the centre of the first pixel at (0, 0)."""
        K = self.matrix.double().numpy().copy()
        K[:2, 2] -= 0.5
        return K

    def pixel_centers(self) -> Float[Tensor, "h w 2"]:
        """Positions of all pixel centres [pixels]."""
        like = {"dtype": self.fx_fy_cx_cy.dtype, "device": self.fx_fy_cx_cy.device}
        v, u = torch.meshgrid(torch.arange(self.height, **like), torch.arange(self.width, **like), indexing="ij")
        return torch.stack([u, v], -1) + 0.5

    def project(self, x_cam: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
        """Pixel position of points in front of the camera."""
        return x_cam[..., :2] / x_cam[..., 2:] * self.fx_fy_cx_cy[:2] + self.fx_fy_cx_cy[2:]

    def unproject(self, uv: Float[Tensor, "*b 2"], depth: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
        """Points at z-depth `depth` [object radius] seen at pixel positions, camera frame."""
        xy = (uv - self.fx_fy_cx_cy[2:]) / self.fx_fy_cx_cy[:2]
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1) * depth[..., None]

    def directions(self) -> Float[Tensor, "h w 3"]:
        """Unit directions from the camera through all pixel centres, camera frame."""
        uv = self.pixel_centers()
        return torch.nn.functional.normalize(self.unproject(uv, torch.ones_like(uv[..., 0])), dim=-1)

    def resized(self, height: int, width: int) -> "Camera":
        """The same view sampled by another grid of pixels."""
        x, y = width / self.width, height / self.height
        return Camera(self.fx_fy_cx_cy * self.fx_fy_cx_cy.new_tensor([x, y, x, y]), height, width)

    def zoomed(self, factor: float) -> "Camera":
        """The camera with focal lengths times a factor."""
        return replace(self, fx_fy_cx_cy=self.fx_fy_cx_cy * self.fx_fy_cx_cy.new_tensor([factor, factor, 1, 1]))

    def centred(self) -> "Camera":
        """The camera that looks through the middle of its picture."""
        middle = self.fx_fy_cx_cy.new_tensor([self.width / 2, self.height / 2])
        return replace(self, fx_fy_cx_cy=torch.cat([self.fx_fy_cx_cy[:2], middle]))

    def cropped(self, top: int, left: int, height: int, width: int) -> "Camera":
        """The part of the view that a window of pixels shows."""
        return Camera(self.fx_fy_cx_cy - self.fx_fy_cx_cy.new_tensor([0, 0, left, top]), height, width)


def undistortion(
    K: Float64[np.ndarray, "3 3"],
    coefficients: Float64[np.ndarray, " k"],
    camera: Camera,
    *,
    fisheye: bool,
    R_new_cam: Float64[np.ndarray, "3 3"] | None = None,
) -> Callable[..., np.ndarray]:
    """What a pinhole camera sees of what a real lens photographed, as a function of picture and interpolation.

    It may also be given OpenCV's number of what lies beyond the photograph, and a value for that.

    Args:
        K: Of the real lens, as OpenCV counts pixels (`Camera.opencv_matrix`).
        coefficients: OpenCV's, of its fisheye or its normal model.
        camera: The pinhole camera.
        R_new_cam: Turns the pinhole camera against the real one.
    """
    tables = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    R = np.eye(3) if R_new_cam is None else R_new_cam
    x, y = tables(K, coefficients, R, camera.opencv_matrix, (camera.width, camera.height), cv2.CV_32FC1)

    def undistorted(picture: np.ndarray, how: int, border: int = cv2.BORDER_CONSTANT, value: int = 0) -> np.ndarray:
        return cv2.remap(picture, x, y, how, borderMode=border, borderValue=value)

    return undistorted
