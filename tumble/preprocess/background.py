"""What stands still while the object turns: its picture, the drift of exposure and white balance, the camera's shake.

The camera is on a tripod, so a pixel that nothing passes keeps its radiance, and what changes there is the camera's
doing: a *gain* per colour channel, in linear light, relative to the middle of the film.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Shaped, UInt8

from tumble.maths import linear_from_srgb, to_srgb8

SAMPLES = 41
"""Frames the median is taken over; odd, so that it is a value that was there."""
SUPPORT = 0.4
"""Share of the sightings of a pixel that must agree for their value to be the background's."""
SEEN = 3
"""Fewest agreeing sightings that count as knowledge."""
NEVER = 700
"""Stands, times the number of the sample, for a hidden value: behind all code values, and never near another."""
RESTLESS = 8.0
"""A pixel whose code values scatter more than this shows no still background [code values]."""
LEAST_NOISE = 1.5
"""What rounding and compression leave at least [code values]."""
DIFFERENT, SAME = 5.0, 2.5
"""Deviations from the background [its noise] from which a pixel surely shows something else, or may be it."""
LEAST_DIFFERENCE = 14.0
"""No pixel counts as different below this, whatever its noise: shadows and blocks of the codec [code values]."""
USABLE = (25, 235)
"""Code values that carry a gain: neither noise nor clipped."""
TEXTURED = 16
"""Least Sobel gradient that shows motion: 2 code values per pixel."""
LEAST_USABLE = 0.01
"""Share of the picture below which the drift is not estimated."""


@dataclass(frozen=True)
class Backdrop:
    """The still background."""

    picture: UInt8[np.ndarray, "h w 3"]
    """sRGB code values."""
    noise: Float32[np.ndarray, "h w"]
    """Robust standard deviation over time, of the worst channel [code values]."""
    known: Bool[np.ndarray, "h w"]
    """Where the background was seen often enough, and stood still."""

    def same(self, picture: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Pixels that look like the known background."""
        return self.known & (self._distance(picture) < np.maximum(SAME * self.noise, LEAST_DIFFERENCE / 2))

    def differs(self, picture: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Pixels that surely do not show the known background."""
        return self.known & (self._distance(picture) > np.maximum(DIFFERENT * self.noise, LEAST_DIFFERENCE))

    def _distance(self, picture: np.ndarray) -> np.ndarray:
        # A light blur takes the codec's noise away before it is compared.
        near, far = cv2.GaussianBlur(picture, (3, 3), 0), cv2.GaussianBlur(self.picture, (3, 3), 0)
        return worst(cv2.absdiff(near, far)).astype(np.float32)


def backdrop(pictures: UInt8[np.ndarray, "t h w 3"], covered: Bool[np.ndarray, "t h w"] | None = None) -> Backdrop:
    """The mode over time of every pixel, over the frames in which nothing covers it.

    The mode is the middle of the narrowest interval that holds a `SUPPORT` of the values (Grenander's estimator of a
    mode, channel by channel): the object may be in front more than half of the time.

    Args:
        covered: Where the object, or what holds it, is known to be in front.
    """
    samples = np.unique(np.linspace(0, len(pictures) - 1, SAMPLES).round().astype(int))
    stack = pictures[samples].astype(np.int16)
    seen = np.full(stack.shape[1:3], len(stack), np.int64)
    if covered is not None:
        hidden = covered[samples]
        never = NEVER * np.arange(1, len(stack) + 1, dtype=np.int16)
        stack = np.where(hidden[..., None], never[:, None, None, None], stack)
        seen -= hidden.sum(0)
    stack.sort(axis=0)
    agreeing = np.maximum(np.ceil(SUPPORT * seen).astype(int), min(SEEN, len(samples)))
    picture, width = np.zeros(stack.shape[1:], np.uint8), np.full(stack.shape[1:3], np.inf, np.float32)
    for count in np.unique(agreeing).tolist():
        where = (agreeing == count) & (seen >= count)
        picture[where], width[where] = _mode(stack[:, where], count)
    # The values of a normal distribution that lie in its middle 40 % spread over 1.05 standard deviations.
    noise = np.maximum(width / 1.05, LEAST_NOISE)
    return Backdrop(picture, noise, noise < RESTLESS)


def completed(one: Backdrop, other: Backdrop) -> Backdrop:
    """The one, and the other where the one does not know."""
    picture = np.where(one.known[..., None], one.picture, other.picture)
    return Backdrop(picture, np.where(one.known, one.noise, other.noise), one.known | other.known)


def drift(
    pictures: UInt8[np.ndarray, "t h w 3"], covered: Bool[np.ndarray, "t h w"] | None = None
) -> Float32[np.ndarray, "t 3"]:
    """Gain of every frame and channel against the median frame: what the camera changed; ones where it cannot tell.

    The middle of many pixels' ratios, so the object may be in front of a good part of what is usable. A backdrop from
    drifting frames is not quite one frame's, so the gains are measured twice: the second time against the backdrop of
    the frames that the first has mended.

    Args:
        covered: Where the object, or what holds it, is known to be in front.
    """
    rough = _gains(pictures, backdrop(pictures, covered).picture, covered)
    mended = np.stack([compensate(picture, gain) for picture, gain in zip(pictures, rough, strict=True)])
    gains = _gains(pictures, backdrop(mended, covered).picture, covered)
    return gains / np.median(gains, 0)


def compensate(picture: UInt8[np.ndarray, "h w 3"], gain: Float32[np.ndarray, "3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture as the camera would have taken it without the drift; what it clipped stays clipped."""
    values = torch.from_numpy(_linear()[:, None] / gain)
    table = to_srgb8(values).numpy()
    table[255] = 255
    return cv2.LUT(picture, table[None])


def shake(
    pictures: UInt8[np.ndarray, "t h w 3"], reference: Backdrop, covered: Bool[np.ndarray, "t h w"]
) -> Float32[np.ndarray, " t"]:
    """How far the background lies from where it was, as a share of the longer side of the picture.

    The median length of the optical flow over textured background. 0 where there is too little texture to tell. Where
    the object is at some time, and nothing is known to stand still, the reference shows the object itself.
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    gray = cv2.cvtColor(reference.picture, cv2.COLOR_RGB2GRAY)
    textured = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)) > TEXTURED
    path = cv2.dilate(np.asarray(covered.any(0), np.uint8), np.ones((5, 5))) > 0
    textured &= reference.known | ~path
    moved = np.zeros(len(pictures), np.float32)
    for i, picture in enumerate(pictures):
        keep = textured & ~covered[i]
        if keep.mean() >= LEAST_USABLE:
            flow = dis.calc(gray, cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.zeros((*gray.shape, 2), np.float32))
            moved[i] = np.median(np.linalg.norm(flow[keep], axis=-1)) / max(gray.shape)
    return moved


def worst(values: Shaped[np.ndarray, "*b 3"]) -> Shaped[np.ndarray, "*b"]:
    """The largest of three channels; a reduction over so short an axis is many times slower."""
    return np.maximum(np.maximum(values[..., 0], values[..., 1]), values[..., 2])


def _gains(pictures: np.ndarray, reference: np.ndarray, covered: np.ndarray | None) -> Float32[np.ndarray, "t 3"]:
    """The mean of the middle half of the ratios to a reference: as robust as it needs to be, and finer than 8 bits."""
    curve, usable = _linear(), _usable(reference)
    gains = np.ones((len(pictures), 3), np.float32)
    for i, picture in enumerate(pictures):
        keep = usable & _usable(picture)
        if covered is not None:
            keep &= ~covered[i]
        if keep.mean() >= LEAST_USABLE:
            ratios = np.sort(curve[picture[keep]] / curve[reference[keep]], 0)
            quarter = len(ratios) // 4
            gains[i] = ratios[quarter : len(ratios) - quarter].mean(0)
    return gains


def _usable(picture: np.ndarray) -> np.ndarray:
    return cv2.inRange(picture, (USABLE[0],) * 3, (USABLE[1],) * 3) > 0


def _mode(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Middle and width of the narrowest interval that holds `count` of sorted values; of the widest channel."""
    widths = values[count - 1 :] - values[: len(values) - count + 1]
    start = widths.argmin(0)[None]
    middle = np.take_along_axis(values, start + (count - 1) // 2, 0)[0]
    return middle.astype(np.uint8), worst(np.take_along_axis(widths, start, 0)[0]).astype(np.float32)


@cache
def _linear() -> Float32[np.ndarray, "256"]:
    """Linear light of all code values."""
    return linear_from_srgb(torch.arange(256, dtype=torch.float32) / 255).numpy()
