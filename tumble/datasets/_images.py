"""Captures from images and masks, shared by the readers of third-party layouts."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from tumble.io import BadFile, files
from tumble.scene import BACKGROUND, Camera, Capture, Light


def opencv_camera(K: np.ndarray, image: Path) -> Camera:
    """Camera with the size of an image and a matrix in OpenCV's convention: the centre of the first pixel is (0, 0)."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
    return Camera(torch.tensor([fx, fy, cx, cy]).float(), *files.image_size(image))


def build_capture(
    root: Path, frames: Iterable[tuple[Path, UInt8[np.ndarray, "h w"]]], camera: Camera, light: Light
) -> Capture:
    """A capture without poses from image files and masks.

    The background is set to black. Frames are named like the files.

    Raises:
        BadFile: There is no frame, or an image or a mask differs in size from the camera.
    """
    images, masks, names = [], [], []
    for path, mask in frames:
        images.append(_read_image(path, mask, camera))
        masks.append(mask)
        names.append(path.name)
    if not names:
        raise BadFile(root, "has no frame with a mask of the object")
    pixels, regions = (torch.from_numpy(np.stack(arrays)) for arrays in (images, masks))
    return Capture(pixels, regions, camera, tuple(names), light)


def _read_image(path: Path, mask: UInt8[np.ndarray, "h w"], camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    pixels = files.read_image(path)
    for shape, what in ((pixels.shape[:2], "has"), (mask.shape, "has a mask of")):
        if shape != (camera.height, camera.width):
            size = f"{what} {shape[1]} x {shape[0]} pixels"
            raise BadFile(path, f"{size}, but the capture has {camera.width} x {camera.height}")
    colour = np.repeat(pixels, 3, 2) if pixels.shape[2] == 1 else pixels[..., :3]
    return np.where((mask == BACKGROUND)[..., None], np.uint8(0), colour)
