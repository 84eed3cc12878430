"""Whether the camera moved, from the optical flow of the background."""

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from tumble.preprocess.background import Background
from tumble.scene import BACKGROUND

MAX_CAMERA_MOTION = 0.02
"""Maximum motion of the background; beyond it segmentation fails [longer side of the image] (38 of 1920 pixels)."""
N_MOTION_SAMPLES = 12
"""Number of frames on which the motion of the camera is measured."""
MIN_GRADIENT = 16
"""Minimum Sobel gradient of a pixel whose optical flow is used: 2 code values per pixel."""
FLOW_PATCH = 8
"""Side of the patches that the optical flow compares [pixels]; those of usable pixels show nothing but background."""
MIN_STATIC_FRACTION = 0.5
"""Fraction of the image with a known background from which that counts as static, even if too plain to measure its
motion."""
MIN_USABLE_FRACTION = 0.01
"""Minimum fraction of usable pixels of an image; with fewer, its shift is not estimated."""


def camera_motion(
    images: UInt8[np.ndarray, "t h w 3"], background: Background, labels: UInt8[np.ndarray, "t h w"]
) -> float:
    """Upper quartile over frames of the motion of the background, as a fraction of the image's longer side.

    Not a number if the background has too little texture in all of them.

    Args:
        background: The background from which it is measured.
        labels: Masks of the frames.
    """
    samples = np.unique(np.linspace(0, len(images) - 1, N_MOTION_SAMPLES).round().astype(int))
    shift = background_shift(images[samples], background, labels[samples] != BACKGROUND)
    measured = shift[~np.isnan(shift)]
    return float(np.percentile(measured, 75)) if len(measured) else math.nan


def background_shift(
    images: UInt8[np.ndarray, "t h w 3"], reference: Background, covered: Bool[np.ndarray, "t h w"]
) -> Float32[np.ndarray, " t"]:
    """Displacement of the background per frame, as a fraction of the longer side; not a number if it is too plain.

    The median length of the optical flow over textured background. Pixels that the object covers in some frame count
    only where the background is known, because elsewhere the reference may show the object itself. Nor do pixels beside
    unknown or covered ones: before a plain wall these edges are most of the texture, and a still camera seems to move.
    If they leave too few and the background is not static either, as with a camera on a head, those pixels count.

    Args:
        reference: The background from which the shift is measured.
        covered: Pixels that are not background in each frame.
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    gray = cv2.cvtColor(reference.image, cv2.COLOR_RGB2GRAY)
    textured = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)) > MIN_GRADIENT
    object_path = cv2.dilate(np.asarray(covered.any(0), np.uint8), np.ones((5, 5))) > 0
    doubtful, is_static = object_path & ~reference.known, reference.known.mean() >= MIN_STATIC_FRACTION
    shift = np.full(len(images), np.nan, np.float32)
    for i, image in enumerate(images):
        keep = textured & ~_near(doubtful | covered[i])
        if keep.mean() < MIN_USABLE_FRACTION and not is_static:
            keep = textured & ~doubtful & ~covered[i]
        if keep.mean() >= MIN_USABLE_FRACTION:
            flow = dis.calc(gray, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.zeros((*gray.shape, 2), np.float32))
            shift[i] = np.median(np.linalg.norm(flow[keep], axis=-1)) / max(gray.shape)
    return shift


def _near(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose patch, which the optical flow compares, contains pixels of a mask."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * FLOW_PATCH + 1,) * 2)) > 0
