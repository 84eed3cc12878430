"""Lenses of frames, and the resampling of all frames of a capture to one pinhole camera.

The method has one pinhole camera per capture. Images of a distorting lens are undistorted. If the frames have different
lenses, as after a zoom or in a model that was fitted image by image, all are resampled to a camera that sees what any
of them saw; pixels that a frame did not see are unknown. Poses do not change, because no camera is rotated.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from tumble.io import BadFile
from tumble.scene import BACKGROUND, UNKNOWN, Camera, undistortion

MAX_GROWTH = 4.0
"""Maximum number of pixels of the common camera, divided by that of the largest frame."""


@dataclass(frozen=True)
class FrameLens:
    """Intrinsics and lens distortion of one frame."""

    fx_fy_cx_cy: tuple[float, float, float, float]
    """Focal lengths and principal point; the centre of the first pixel is (0.5, 0.5) [pixels]."""
    height: int
    """[pixels]"""
    width: int
    """[pixels]"""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1 k2 p1 p2 k3, or k1 to k4 of its fisheye model; empty without distortion."""
    fisheye: bool = False

    @property
    def camera(self) -> Camera:
        """The pinhole camera with these intrinsics."""
        return Camera(torch.tensor(self.fx_fy_cx_cy), self.height, self.width)

    @property
    def pinhole(self) -> "FrameLens":
        """The lens without its distortion."""
        return replace(self, distortion=(), fisheye=False)


def common_lens(path: Path, lenses: Sequence[FrameLens]) -> FrameLens:
    """The pinhole lens to which frames are resampled: their own, or if they differ one that sees what any of them saw.

    Args:
        path: File of the lenses, for the message.

    Raises:
        BadFile: The fields of view differ so much that the images would become many times larger.
    """
    distinct = list(dict.fromkeys(lens.pinhole for lens in lenses))
    if len(distinct) == 1:
        return distinct[0]
    values = np.array([lens.fx_fy_cx_cy for lens in distinct])
    focal, centre = values[:, :2], values[:, 2:]
    low = (-centre / focal).min(0)
    high = ((np.array([(lens.width, lens.height) for lens in distinct]) - centre) / focal).max(0)
    fx, fy = (median(lens.fx_fy_cx_cy[axis] for lens in lenses) for axis in (0, 1))
    width, height = math.ceil(fx * (high[0] - low[0]) - 1e-6), math.ceil(fy * (high[1] - low[1]) - 1e-6)
    if width * height > MAX_GROWTH * max(lens.width * lens.height for lens in distinct):
        rule = f"the lenses of the frames differ too much: one camera for all would have {width} x {height} pixels"
        raise BadFile(path, rule, "make a capture of each zoom setting")
    return FrameLens((fx, fy, float(-fx * low[0]), float(-fy * low[1])), height, width)


def resample(
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    lens: FrameLens,
    common: FrameLens,
    *,
    beyond: int = BACKGROUND,
) -> tuple[UInt8[np.ndarray, "i j 3"], UInt8[np.ndarray, "i j"]]:
    """Image and mask of a frame as the common lens sees them.

    Args:
        beyond: Label of pixels outside the image of a lens that differs from the common one by distortion only; with
            other lenses they are unknown.
    """
    if lens == common:
        return image, mask
    remap = _remapping(lens, common)
    unseen = beyond if lens.pinhole == common else UNKNOWN
    labels = remap(mask, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT, unseen)
    return remap(image, cv2.INTER_LINEAR), labels


@lru_cache(maxsize=1)
def _remapping(lens: FrameLens, common: FrameLens) -> Callable[..., np.ndarray]:
    coefficients = np.array(lens.distortion or (0.0,) * 4)
    return undistortion(lens.camera.opencv_matrix, coefficients, common.camera, fisheye=lens.fisheye)
