"""Which frames to keep: one per few degrees of the object's turning, the sharpest of those at hand.

For a ball of radius r in pixels that turns by a small angle, about whatever axis, half of its disc moves by more than
r angle / sqrt(2) pixels: about an axis in the picture plane the motion is angle * depth, about the line of sight
angle * distance from the centre, and depth and distance both have the median r / sqrt(2) over a disc. So the median
optical flow inside the silhouette, less the silhouette's own shift, measures the turn, roughly: a long or flat object
is not a ball, and flow is blind on a surface without texture.
"""

import math
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

STEP = math.radians(8)
"""Turn between kept frames [radians]; with the choice inside a window, 4 to 12 degrees."""
FEW = 2
"""Frames per window up to which all are kept: to thin so few saves little, and single turns are measured too roughly to
say which would leave a gap."""
ANCHOR = math.radians(3)
"""Turns are measured from an earlier frame until they reach this, lest the noise of flow adds up [radians]."""
TEXTURED = 12.0
"""Least gradient by which flow is believed [code values / pixel]."""
PROBE_BLUR = 1.0
"""Of the picture before its edges are measured: keeps noise from passing for sharpness [pixels]."""
FAINTEST = 1e-3
"""Mean squared Laplacian below which there is nothing but rounding."""
LEAST_PIXELS = 30
"""Smaller silhouettes do not measure a turn."""


def turned(pictures: UInt8[np.ndarray, "t h w 3"], inside: Bool[np.ndarray, "t h w"]) -> Float64[np.ndarray, " t"]:
    """How far the object has turned since the first frame, along its way [radians]; never falls."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    total, anchor, base = np.zeros(len(pictures)), 0, 0.0
    grays = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    for i in range(1, len(pictures)):
        angle = turn(dis, grays[anchor], grays[i], inside[anchor], inside[i])
        total[i] = max(total[i - 1], base + angle)
        if angle > ANCHOR or inside[anchor].sum() < LEAST_PIXELS:
            anchor, base = i, total[i]
    return total


def turn(
    dis: cv2.DISOpticalFlow,
    one: UInt8[np.ndarray, "h w"],
    other: UInt8[np.ndarray, "h w"],
    inside_one: Bool[np.ndarray, "h w"],
    inside_other: Bool[np.ndarray, "h w"],
) -> float:
    """Angle between two frames [radians], small ones only; 0 where there is too little to see."""
    x, y = cv2.Sobel(one, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(one, cv2.CV_32F, 0, 1, scale=1 / 8)
    core = cv2.erode(inside_one.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    seen = core & (np.hypot(x, y) > TEXTURED)
    if min(seen.sum(), inside_other.sum()) < LEAST_PIXELS:
        return 0.0
    flow = dis.calc(one, other, np.zeros((*one.shape, 2), np.float32))[seen]
    shift = _centre(inside_other) - _centre(inside_one)
    radius = math.sqrt(float(inside_one.sum()) / math.pi)
    return float(np.median(np.linalg.norm(flow - shift, axis=-1))) * math.sqrt(2) / radius


def edges(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 2"]:
    """Squared gradient and squared Laplacian of the slightly blurred lightness: the food of `blur`."""
    gray = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), PROBE_BLUR)
    x, y = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return np.stack([x * x + y * y, np.square(cv2.Laplacian(gray, cv2.CV_32F, ksize=1))], -1)


def blur(energy: Float32[np.ndarray, "h w 2"], inside: Bool[np.ndarray, "h w"]) -> float:
    """Width of the edges inside a mask, with the probe's own of 1 [pixels of the picture that `edges` saw].

    An edge blurred by a Gaussian of deviation s has (integral of gradient^2) / (integral of second derivative^2) =
    2 s^2, whatever its contrast. Fine texture gives less than 1. Infinite where there are no edges.
    """
    gradient, laplacian = energy[inside].mean(0) if inside.any() else (0.0, 0.0)
    if laplacian < FAINTEST:
        return math.inf
    return math.sqrt(float(gradient / laplacian) / 2)


def chosen(
    total: Float64[np.ndarray, " t"],
    blurs: Float64[np.ndarray, " t"],
    usable: Bool[np.ndarray, " t"],
    n_frames: int,
) -> list[int]:
    """Indices of the frames to keep: the sharpest usable one in the middle half of every window of turning.

    All usable ones of a film that has hardly more frames than windows.

    Args:
        total: From `turned`.
        blurs: From `blur`.
        usable: Frames whose mask is good enough.
        n_frames: At most this many; the windows widen to fit.
    """
    first, last = float(total[0]), float(total[-1])
    count = max(min(round((last - first) / STEP) + 1, n_frames), 1)
    every = [int(i) for i in np.nonzero(usable)[0]]
    if len(every) <= min(FEW * count, n_frames):
        return every
    step = (last - first) / max(count - 1, 1)
    kept: list[int] = []
    for k in range(count):
        aim = first + k * step
        near = np.nonzero(usable & (np.abs(total - aim) <= step / 4))[0]
        if not len(near):
            near = np.nonzero(usable & (np.abs(total - aim) <= step / 2))[0]
        if len(near):
            kept.append(int(near[np.argmin(blurs[near])]))
    return sorted(set(kept))


def largest_step(total: Float64[np.ndarray, " t"], kept: list[int]) -> float:
    """The widest turn between neighbouring kept frames [radians]."""
    return max((float(total[j] - total[i]) for i, j in pairwise(kept)), default=0.0)


def _centre(inside: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "2"]:
    rows, columns = np.nonzero(inside)
    return np.array([columns.mean(), rows.mean()], np.float32)
