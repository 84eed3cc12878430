"""Photographs with their masks, as a capture: what readers of foreign layouts share."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from tumble.io import BadFile, files
from tumble.scene import BACKGROUND, Camera, Capture, Light


def camera(K: np.ndarray, picture: Path) -> Camera:
    """The camera of a matrix that puts the centre of the first pixel at (0, 0), as OpenCV does, and of a picture."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
    return Camera(torch.tensor([fx, fy, cx, cy]).float(), *files.image_size(picture))


def capture(
    root: Path, frames: Iterable[tuple[Path, UInt8[np.ndarray, "h w"]]], camera: Camera, light: Light
) -> Capture:
    """Photographs with masks as a capture without poses; the background made black, frames named as their files.

    Raises:
        BadFile: There is no frame, or a picture is not of the camera's size.
    """
    images, masks, names = [], [], []
    for path, mask in frames:
        images.append(_photograph(path, mask, camera))
        masks.append(mask)
        names.append(path.name)
    if not names:
        raise BadFile(root, "has no frame with a mask that shows the object")
    pixels, regions = (torch.from_numpy(np.stack(pictures)) for pictures in (images, masks))
    return Capture(pixels, regions, camera, tuple(names), light)


def _photograph(path: Path, mask: UInt8[np.ndarray, "h w"], camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    pixels = files.read_image(path)
    for shape, what in ((pixels.shape[:2], "is"), (mask.shape, "has a mask of")):
        if shape != (camera.height, camera.width):
            found = f"{what} {shape[1]} x {shape[0]} pixels"
            raise BadFile(path, f"{found}, the capture is {camera.width} x {camera.height}")
    colour = np.repeat(pixels, 3, 2) if pixels.shape[2] == 1 else pixels[..., :3]
    return np.where((mask == BACKGROUND)[..., None], np.uint8(0), colour)
