"""Captures from images and masks, shared by the readers of third-party layouts."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from tumble.datasets._lens import FrameLens, common_lens, resample
from tumble.datasets._plausibility import plausible_centre, plausible_focal
from tumble.io import BadFile, files, limits
from tumble.scene import BACKGROUND, Capture, Light


def opencv_lens(path: Path, K: np.ndarray, height: int, width: int) -> FrameLens:
    """Lens with a matrix in OpenCV's convention: the centre of the first pixel is (0, 0).

    Raises:
        BadFile: The matrix in `path` is not that of a camera.
    """
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    plausible = plausible_focal(fx, height, width) and plausible_focal(fy, height, width)
    if not (plausible and plausible_centre(cx, cy, height, width)):
        raise BadFile(path, f"has the camera matrix {K.tolist()} for images of {width} x {height}", "it is in pixels")
    return FrameLens((fx, fy, cx, cy), height, width)


def build_capture(
    root: Path, frames: Iterable[tuple[Path, UInt8[np.ndarray, "h w"]]], lenses: Mapping[Path, FrameLens], light: Light
) -> Capture:
    """A capture without poses from image files and masks.

    The background is set to black. Frames are named like the files. Images of different lenses are resampled to one.

    Args:
        lenses: The lens of every image.

    Raises:
        BadFile: There is no frame, or an image or a mask differs in size from its lens.
    """
    common = common_lens(root, list(lenses.values()))
    size = 4 * common.height * common.width
    images, masks, names = [], [], []
    for path, mask in frames:
        limits.require_bytes(root, size * (len(names) + 1), f"{len(lenses)} frames", limits.MAX_CAPTURE_BYTES)
        image, mask = resample(_read_image(path, mask, lenses[path]), mask, lenses[path], common)
        images.append(image)
        masks.append(mask)
        names.append(path.name)
    if not names:
        raise BadFile(root, "has no frame with a mask of the object")
    pixels, regions = (torch.from_numpy(np.stack(arrays)) for arrays in (images, masks))
    return Capture(pixels, regions, common.camera, tuple(names), light)


def _read_image(path: Path, mask: UInt8[np.ndarray, "h w"], lens: FrameLens) -> UInt8[np.ndarray, "h w 3"]:
    pixels = files.read_image(path)
    for shape, what in ((pixels.shape[:2], "has"), (mask.shape, "has a mask of")):
        if shape != (lens.height, lens.width):
            size = f"{what} {shape[1]} x {shape[0]} pixels"
            raise BadFile(path, f"{size}, but the capture has {lens.width} x {lens.height}")
    colour = np.repeat(pixels, 3, 2) if pixels.shape[2] == 1 else pixels[..., :3]
    return np.where((mask == BACKGROUND)[..., None], np.uint8(0), colour)
