"""What a matcher looks at: the object's part of a frame, enlarged to the size the matcher likes.

Positions keep the convention of all frames (pixel centres at +0.5) on both sides, so `at / scale + corner` is exact.
"""

import hashlib
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tumble.scene import OBJECT, View

BORDER = 96
"""Masks lose one pixel of border per so many pixels of the frame's longer side: 2 at 128, 3 at 256. What lies there
mixes object and background, which does not move."""
MARGIN = 0.1
"""What a window shows around the object, in units of the object's longer side."""

AROUND = 16.0
"""Standard deviation of the surroundings of a pixel [pixels of the window]."""
FAINT = 3.0
"""Contrast that is not made stronger: noise [code values]."""


@dataclass(frozen=True)
class Window:
    """An enlarged part of a frame; its own arrays live on the CPU, where OpenCV works."""

    rgb: UInt8[np.ndarray, "h w 3"]
    """Code values; around the object, the object's own colours fade out smoothly: no edge to hold on to."""
    sure: Bool[np.ndarray, "h w"]
    """Pixels whose centres may be matched: surely object, away from its border."""
    sure_in_frame: Bool[np.ndarray, "height width"]
    """The same of the frame, which decides."""
    corner: tuple[float, float]
    """Position in the frame of the window's top left corner [pixels of the frame]."""
    scale: float
    """Pixels of the window per pixel of the frame."""

    @property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """What a surface shows against its surroundings, as strong as everywhere else, whatever light falls on it.

        Shading stays with the light when the object turns, and the exposure may drift: both hold flow back. Median
        error of stage 1 on four hand-held captures, with plain grey: 0.82, 1.05, 0.50 and 0.65 degrees; so 0.89, 0.80,
        0.46 and 0.48.
        """
        grey = cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        away = grey - cv2.GaussianBlur(grey, (0, 0), AROUND)
        spread = np.sqrt(cv2.GaussianBlur(away * away, (0, 0), AROUND))
        return (128 + 45 * away / (spread + FAINT)).clip(0, 255).astype(np.uint8)

    def in_frame(self, at: Float[np.ndarray, "m 2"]) -> Float[Tensor, "m 2"]:
        """Positions in the frame of positions in the window [pixels, centres at +0.5]."""
        return torch.from_numpy((at / self.scale + np.asarray(self.corner)).astype(np.float32))

    def holds(self, at: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
        """Whether positions in the window lie on sure pixels of the frame: where matches may begin and end."""
        return _on(self.sure_in_frame, self.in_frame(at))


def sure_pixels(mask: UInt8[Tensor, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels surely of the object and not at its border; that with the unknown is one, the frame's edge is not."""
    height, width = mask.shape
    radius = math.ceil(max(height, width) / BORDER)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.erode((mask.cpu().numpy() == OBJECT).astype(np.uint8), disc) > 0


def extent(view: View) -> float:
    """Longer side of the sure pixels' bounding box [pixels]; 0 when there are none."""
    rows, columns = np.nonzero(sure_pixels(view.mask))
    return 0.0 if len(rows) == 0 else float(max(np.ptp(rows), np.ptp(columns)) + 1)


def window(view: View, reach: float, size: int) -> Window:
    """The square window of `size` pixels about the middle of the object, `reach` pixels of the frame wide.

    Two views with the same reach and size keep their relative scale, and lose how far the object moved between them.
    """
    sure = sure_pixels(view.mask)
    rows, columns = np.nonzero(sure)
    centre = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
    scale, corner = size / reach, centre - reach / 2
    # cv2 counts pixel centres from 0: window = scale * (frame + 0.5 - corner) - 0.5.
    shift = scale * (0.5 - corner) - 0.5
    warp = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    rgb = view.image.cpu().numpy()
    if scale < 1:
        # Blur away what the coarser grid cannot carry: half a pixel of it.
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.5 * math.sqrt(1 / scale**2 - 1) + 1e-3)
    picture = cv2.warpAffine(rgb, warp, (size, size), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    at = np.stack([column, row], -1).reshape(-1, 2) / scale + corner
    inside = _on(sure, torch.from_numpy(at.astype(np.float32))).reshape(size, size)
    return Window(_filled(picture, inside), inside, sure, (float(corner[0]), float(corner[1])), scale)


def windows(view_i: View, view_j: View, size: int) -> tuple[Window, Window] | None:
    """Windows of two views at one scale, which holds the larger of their objects; None when one shows none for sure."""
    reach = [extent(view) for view in (view_i, view_j)]
    if min(reach) == 0:
        return None
    wide = max(reach) * (1 + 2 * MARGIN)
    return window(view_i, wide, size), window(view_j, wide, size)


def _on(mask: Bool[np.ndarray, "h w"], uv: Float[Tensor, "m 2"]) -> Bool[np.ndarray, " m"]:
    """The mask's values at positions; false off the frame."""
    height, width = mask.shape
    column, row = uv.floor().long().numpy().T
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return within & mask[row.clip(0, height - 1), column.clip(0, width - 1)]


def digest(view: View) -> str:
    """A name for what a view shows, whatever its number: equal views have equal names."""
    text = hashlib.blake2b(digest_size=16)
    for values in (view.image, view.mask):
        text.update(repr(tuple(values.shape)).encode())
        text.update(values.cpu().numpy().tobytes())
    return text.hexdigest()


def _filled(rgb: UInt8[np.ndarray, "h w 3"], sure: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with all but the sure pixels replaced by averages of these, the wider the farther (push and pull)."""
    colours, weight = rgb * sure[..., None].astype(np.float32), sure.astype(np.float32)
    levels: list[tuple[np.ndarray, np.ndarray]] = [(colours, weight)]
    while min(weight.shape) > 1:
        colours, weight = _halved(colours), _halved(weight)
        levels.append((colours, weight))
    filled = None
    for colours, weight in reversed(levels):
        mean = colours / weight.clip(1e-6)[..., None]
        if filled is None:
            filled = mean
            continue
        above = np.asarray(cv2.pyrUp(filled, dstsize=weight.shape[::-1]), np.float32)
        filled = above + weight[..., None].clip(0, 1) * (mean - above)
    assert filled is not None, "there is at least one level"
    return filled.round().clip(0, 255).astype(np.uint8)


def _halved(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.asarray(cv2.pyrDown(values), np.float32)
