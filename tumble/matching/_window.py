"""Windows: square crops around the object, resampled to the input size of a matcher.

Pixel centres are at +0.5 in frames and windows, so the position `at` in a window is `at / scale + corner` in the frame.
"""

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tumble.scene import OBJECT, View

BORDER_DIVISOR = 96
"""Longer side of a frame per pixel of border that is removed from masks, rounded up: 2 pixels at 128, 3 at 256.

Pixels at the border mix object and background, and the background does not move with the object."""
MARGIN = 0.1
"""Margin of a window on each side of the object [longer side of the object]."""
CONTRAST_SIGMA = 16.0
"""Standard deviation of the Gaussian over which contrast is normalised [pixels of the window]."""
CONTRAST_FLOOR = 3.0
"""Contrast added in the normalisation, so that noise is not amplified [code values]."""

KEPT_WINDOWS = 64
"""Number of windows that are kept, as a view has the same window for all pairs with smaller objects and in all
matchers; limits memory to some 60 MB."""


@dataclass(frozen=True)
class Window:
    """Resampled crop of a frame, as arrays on the CPU for OpenCV."""

    rgb: UInt8[np.ndarray, "h w 3"]
    """Code values; colours of the object are extended smoothly beyond it, so that there is no contour to match."""
    usable: Bool[np.ndarray, "h w"]
    """Pixels whose centres lie on usable pixels of the frame."""
    usable_in_frame: Bool[np.ndarray, "height width"]
    """Pixels of the frame that may be matched, see `interior_pixels`."""
    corner: tuple[float, float]
    """Position (x, y) of the window's top left corner in the frame [pixels of the frame]."""
    scale: float
    """Pixels of the window per pixel of the frame."""

    @cached_property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """Grey values with locally normalised contrast, which removes shading and changes of exposure.

        Shading moves with the light rather than with the object, and would bias optical flow towards no motion.
        """
        grey = cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        detail = grey - cv2.GaussianBlur(grey, (0, 0), CONTRAST_SIGMA)
        spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), CONTRAST_SIGMA))
        detail *= 45
        detail /= spread + CONTRAST_FLOOR
        detail += 128
        return detail.clip(0, 255, out=detail).astype(np.uint8)

    def in_frame(self, at: Float[np.ndarray, "m 2"]) -> Float[Tensor, "m 2"]:
        """Positions in the frame from positions in the window [pixels, centres at +0.5]."""
        return torch.from_numpy((at / self.scale + np.asarray(self.corner)).astype(np.float32))

    def contains(self, at: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
        """Whether positions in the window lie on usable pixels of the frame."""
        return _lookup(self.usable_in_frame, self.in_frame(at))


def interior_pixels(mask: UInt8[Tensor, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Object pixels away from the border of the mask and from unknown pixels; the frame's edge is not a border."""
    height, width = mask.shape
    radius = math.ceil(max(height, width) / BORDER_DIVISOR)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.erode((mask.cpu().numpy() == OBJECT).astype(np.uint8), disc) > 0


@lru_cache(KEPT_WINDOWS)
def extent(view: View) -> float:
    """Longer side of the bounding box of the interior pixels [pixels]; 0 if there are none."""
    rows, columns = np.nonzero(interior_pixels(view.mask))
    return 0.0 if len(rows) == 0 else float(max(np.ptp(rows), np.ptp(columns)) + 1)


@lru_cache(KEPT_WINDOWS)
def crop_window(view: View, width: float, size: int) -> Window:
    """Square window of `size` pixels around the centre of the object, `width` pixels of the frame wide.

    Windows of two views with the same width and size keep the relative scale of the object, but not its translation.
    """
    usable = interior_pixels(view.mask)
    rows, columns = np.nonzero(usable)
    centre = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
    scale, corner = size / width, centre - width / 2
    # cv2 counts pixel centres from 0: window = scale * (frame + 0.5 - corner) - 0.5.
    shift = scale * (0.5 - corner) - 0.5
    warp = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    rgb = view.image.cpu().numpy()
    if scale < 1:
        # Low-pass filter against aliasing: half a pixel of the coarser grid.
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.5 * math.sqrt(1 / scale**2 - 1) + 1e-3)
    image = cv2.warpAffine(rgb, warp, (size, size), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    at = (np.arange(size)[:, None] + 0.5) / scale + corner
    column, row = np.floor(at.astype(np.float32)).astype(int).T
    inside = _values(usable, row[:, None], column)
    return Window(_fill_outside(image, inside), inside, usable, (float(corner[0]), float(corner[1])), scale)


def crop_windows(view_i: View, view_j: View, size: int) -> tuple[Window, Window] | None:
    """Windows of two views at the scale of the larger object; None if a view has no usable pixels."""
    extents = [extent(view) for view in (view_i, view_j)]
    if min(extents) == 0:
        return None
    width = max(extents) * (1 + 2 * MARGIN)
    return crop_window(view_i, width, size), crop_window(view_j, width, size)


def digest(view: View) -> str:
    """Hash of a view's image and mask, independent of its index."""
    digester = hashlib.blake2b(digest_size=16)
    for values in (view.image, view.mask):
        digester.update(repr(tuple(values.shape)).encode())
        digester.update(values.cpu().numpy().tobytes())
    return digester.hexdigest()


def _lookup(mask: Bool[np.ndarray, "h w"], uv: Float[Tensor, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Values of a mask at positions; false outside the frame."""
    column, row = uv.floor().long().numpy().T
    return _values(mask, row, column)


def _values(mask: Bool[np.ndarray, "h w"], row: np.ndarray, column: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Values of a mask at pixels, whose rows and columns broadcast; false outside the frame."""
    height, width = mask.shape
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return within & mask[row.clip(0, height - 1), column.clip(0, width - 1)]


def _fill_outside(rgb: UInt8[np.ndarray, "h w 3"], usable: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Image with all other pixels filled by averages of the usable ones, over wider areas farther away (push-pull)."""
    colours, weight = rgb * usable[..., None].astype(np.float32), usable.astype(np.float32)
    levels: list[tuple[np.ndarray, np.ndarray]] = [(colours, weight)]
    while min(weight.shape) > 1:
        colours, weight = _halve(colours), _halve(weight)
        levels.append((colours, weight))
    filled = None
    for colours, weight in reversed(levels):
        mean = colours / weight.clip(1e-6)[..., None]
        if filled is None:
            filled = mean
            continue
        coarser = np.asarray(cv2.pyrUp(filled, dstsize=weight.shape[::-1]), np.float32)
        mean -= coarser
        mean *= weight[..., None].clip(0, 1)
        filled = np.add(mean, coarser, out=mean)
    assert filled is not None, "there is at least one level"
    return filled.round().clip(0, 255).astype(np.uint8)


def _halve(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Next coarser level of a Gaussian pyramid."""
    return np.asarray(cv2.pyrDown(values), np.float32)
