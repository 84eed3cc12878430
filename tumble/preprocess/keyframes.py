"""Keyframe selection: one frame per few degrees of rotation of the object, the sharpest of the candidates.

The rotation is estimated from optical flow. When a sphere with radius r [pixels] rotates by a small angle about any
axis, the median displacement over its disc is r angle / sqrt(2): about an axis in the image plane the displacement is
angle * depth, about the optical axis it is angle * distance from the centre, and over a disc both depth and distance
have the median r / sqrt(2). So the median flow inside the silhouette, minus the translation of the silhouette, measures
the angle; where a hand covers more and more of an object, only the silhouette moves, and less flow is left without
that. It is a rough measure: a long or flat object is no sphere, and there is no flow on a surface without texture.

An object that is turned to and fro adds up to a large angle, but hardly shows other sides. How far it comes round is
found by fitting the rotation of that sphere, and a translation, to the same flow.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

KEYFRAME_STEP = math.radians(4)
"""Rotation between keyframes [radians]; with the choice inside each window, 2 to 6 degrees. Frames farther
apart share too few features behind a hand; and flow reports less than half of the rotation of a plain surface."""
FRAMES_PER_WINDOW = 2
"""If a video has at most this many usable frames per window, all are kept, or as many as may be, because single
rotation estimates are too rough to select from so few."""
ANCHOR_ROTATION = math.radians(3)
"""Rotations are measured from an anchor frame until they exceed this, so that the noise of flow does not accumulate
[radians]."""
MIN_GRADIENT = 12.0
"""Minimum gradient of a pixel whose flow is used [code values / pixel]."""
PROBE_BLUR = 1.0
"""Standard deviation of the blur before edges are measured, so that noise does not count as sharpness [pixels]."""
MIN_LAPLACIAN = 1e-3
"""Minimum mean squared Laplacian of a region with edges; below it there are only rounding errors."""
MIN_PIXELS = 30
"""Minimum number of pixels from which a rotation is estimated."""
MIN_DEPTH = 0.3
"""Least depth of the sphere's surface where its rotation is fitted [radius]: objects are thicker at their border."""
FITS = 10
"""Number of times that the rotation is fitted, each with smaller weights for flow that contradicts the fit before."""
HUBER = 1.5
"""Deviation from which the weight of flow decreases (Huber) [median deviation]."""


def measured_rotation(
    images: UInt8[np.ndarray, "t h w 3"], inside: Bool[np.ndarray, "t h w"]
) -> tuple[Float64[np.ndarray, " t"], float]:
    """Angle by which the object has rotated since the first frame, summed along the path [radians], which never
    decreases; and the largest angle by which it is turned in one frame against another [radians], at most pi.

    Where too little texture shows to measure it, the object is assumed to rotate as fast as in the median frame. In the
    largest angle errors add up along the path: a fast motion seems to come farther round than it does. It is pi where
    half of the frames are not measured.
    """
    from scipy.spatial.transform import Rotation

    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    increase, turned, anchor, since = np.zeros(len(images)), [Rotation.identity()], 0, 0.0
    for i in range(1, len(images)):
        flow = textured_flow(dis, grays[anchor], grays[i], inside[anchor], inside[i])
        angle, turn = (math.nan, np.zeros(3)) if flow is None else (flow.angle, flow.fitted_rotation())
        increase[i] = np.maximum(angle - since, 0.0)
        since = np.fmax(since, angle)
        turned.append(Rotation.from_rotvec(turn) * turned[anchor])
        if flow is None or max(angle, np.linalg.norm(turn)) > ANCHOR_ROTATION:
            anchor, since = i, 0.0
    unmeasured = np.isnan(increase)
    increase[unmeasured] = np.median(increase[~unmeasured])
    if 2 * unmeasured.sum() >= len(images):
        return increase.cumsum(), math.pi
    quaternions = Rotation.concatenate(turned).as_quat()
    return increase.cumsum(), 2 * math.acos(float(np.abs(quaternions @ quaternions.T).min().clip(0, 1)))


@dataclass(frozen=True)
class TexturedFlow:
    """Optical flow of the object's pixels with texture."""

    pixels: Float32[np.ndarray, "n 2"]
    """Positions relative to the silhouette's centre [pixels]."""
    flow: Float32[np.ndarray, "n 2"]
    """Displacements [pixels]."""
    shift: Float32[np.ndarray, "2"]
    """Translation of the silhouette's centre [pixels]."""
    radius: float
    """Radius of a disc of the silhouette's area [pixels]."""

    @property
    def angle(self) -> float:
        """Small rotation of a sphere with this flow beside the silhouette's translation or, if that leaves less, beside
        none [radians]."""
        left = min(float(np.median(np.linalg.norm(self.flow - shift, axis=-1))) for shift in (self.shift, 0.0))
        return left * math.sqrt(2) / self.radius

    def fitted_rotation(self) -> Float64[np.ndarray, "3"]:
        """Rotation vector of a sphere, camera frame, whose flow beside a translation is closest to this [radians].

        Robust linear least squares.
        """
        x, y = self.pixels.T.astype(np.float64) / self.radius
        flow = self.flow.T.ravel().astype(np.float64) / self.radius
        # The camera looks along +z: points in front of the sphere's centre have z = -depth.
        depth = np.sqrt((1 - x * x - y * y).clip(MIN_DEPTH**2))
        zero, one = np.zeros_like(x), np.ones_like(x)
        columns = np.array([[zero, depth], [-depth, zero], [-y, x], [one, zero], [zero, one]]).reshape(5, -1)
        weight, motion = np.ones_like(flow), np.zeros(5)
        for _ in range(FITS):
            motion = np.linalg.lstsq(columns * weight @ columns.T, columns * weight @ flow, rcond=None)[0]
            deviation = np.abs(flow - motion @ columns)
            limit = max(HUBER * float(np.median(deviation)), np.finfo(np.float64).tiny)
            weight = limit / np.maximum(deviation, limit)
        return motion[:3]


def textured_flow(
    dis: cv2.DISOpticalFlow,
    gray_a: UInt8[np.ndarray, "h w"],
    gray_b: UInt8[np.ndarray, "h w"],
    inside_a: Bool[np.ndarray, "h w"],
    inside_b: Bool[np.ndarray, "h w"],
) -> TexturedFlow | None:
    """Flow of the object between two frames; None with too little texture in the first one, or too few pixels of the
    object in the second, to measure a rotation.
    """
    x, y = cv2.Sobel(gray_a, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(gray_a, cv2.CV_32F, 0, 1, scale=1 / 8)
    core = cv2.erode(inside_a.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    textured = core & (np.hypot(x, y) > MIN_GRADIENT)
    if min(textured.sum(), inside_b.sum()) < MIN_PIXELS:
        return None
    flow = dis.calc(gray_a, gray_b, np.zeros((*gray_a.shape, 2), np.float32))[textured]
    pixels, centre = np.argwhere(textured)[:, ::-1].astype(np.float32), _centre(inside_a)
    return TexturedFlow(pixels - centre, flow, _centre(inside_b) - centre, math.sqrt(float(inside_a.sum()) / math.pi))


def edge_energy(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 2"]:
    """Squared gradient and squared Laplacian of the slightly blurred lightness: the input of `edge_blur`."""
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), PROBE_BLUR)
    x, y = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return np.stack([x * x + y * y, np.square(cv2.Laplacian(gray, cv2.CV_32F, ksize=1))], -1)


def edge_blur(energy: Float32[np.ndarray, "h w 2"], inside: Bool[np.ndarray, "h w"]) -> float:
    """Blur of the edges inside a mask, including the blur of the probe (`PROBE_BLUR`) [pixels of the image].

    An edge blurred by a Gaussian of standard deviation s has (integral of gradient^2) / (integral of second
    derivative^2) = 2 s^2 at any contrast. Fine texture gives less than 1. Infinite where there are no edges.

    Args:
        energy: From `edge_energy`.
    """
    gradient, laplacian = energy[inside].mean(0) if inside.any() else (0.0, 0.0)
    if laplacian < MIN_LAPLACIAN:
        return math.inf
    return math.sqrt(float(gradient / laplacian) / 2)


def select_keyframes(
    rotation: Float64[np.ndarray, " t"],
    blurs: Float64[np.ndarray, " t"],
    usable: Bool[np.ndarray, " t"],
    n_frames: int,
) -> list[int]:
    """Indices of the keyframes: in each window of rotation, the sharpest usable frame near its middle.

    All usable frames of a video that has hardly more frames than windows, or as many as may be.

    Args:
        rotation: From `measured_rotation` [radians].
        blurs: From `edge_blur`.
        usable: Frames with a reliable mask.
        n_frames: Maximum number of keyframes; the windows widen accordingly.
    """
    count = max(round(float(rotation[-1] - rotation[0]) / KEYFRAME_STEP) + 1, 1)
    candidates = [int(i) for i in np.nonzero(usable)[0]]
    if len(candidates) <= FRAMES_PER_WINDOW * count:
        return _thinned(rotation, blurs, candidates, n_frames)
    # Where the object turns fast, windows are empty: more of them than keyframes may fit.
    while len(kept := _sharpest_of_windows(rotation, blurs, usable, count)) > n_frames:
        count = count * n_frames // len(kept)
    return kept


def _thinned(
    rotation: Float64[np.ndarray, " t"], blurs: Float64[np.ndarray, " t"], candidates: list[int], n_frames: int
) -> list[int]:
    """At most `n_frames` of the candidates, without those that are blurred and whose neighbours are close."""
    kept = np.array(candidates, int)
    while len(kept) > max(n_frames, 2):
        gap = rotation[kept[2:]] - rotation[kept[:-2]]
        kept = np.delete(kept, 1 + np.argmin(gap / blurs[kept[1:-1]]))
    return kept[:n_frames].tolist()


def _sharpest_of_windows(
    rotation: Float64[np.ndarray, " t"], blurs: Float64[np.ndarray, " t"], usable: Bool[np.ndarray, " t"], count: int
) -> list[int]:
    """The sharpest usable frame near the middle of each of equal windows of rotation; none of an empty window."""
    first, last = float(rotation[0]), float(rotation[-1])
    step = (last - first) / max(count - 1, 1)
    kept: set[int] = set()
    for target in np.linspace(first, last, count):
        near = np.nonzero(usable & (np.abs(rotation - target) <= step / 4))[0]
        if not len(near):
            near = np.nonzero(usable & (np.abs(rotation - target) <= step / 2))[0]
        if len(near):
            kept.add(int(near[np.argmin(blurs[near])]))
    return sorted(kept)


def largest_step(rotation: Float64[np.ndarray, " t"], kept: list[int]) -> float:
    """Largest rotation between consecutive keyframes [radians]."""
    return max((float(rotation[j] - rotation[i]) for i, j in pairwise(kept)), default=0.0)


def _centre(inside: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "2"]:
    rows, columns = np.nonzero(inside)
    return np.array([columns.mean(), rows.mean()], np.float32)
