"""Images as tensors `[h w c]`: sRGB transfer curves, structural similarity, gradients, resampling, cropping, hulls.

Rows run downwards. Pixel centres lie at +0.5, so that a resized image covers the same area. Values are linear RGB
unless the name contains `srgb`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Shaped, UInt8
from torch import Tensor
from torch.nn import functional

Box = tuple[int, int, int, int]
"""Top, left, height, width of a window [pixels]."""
LINEAR_KNEE = 0.0031308
"""Linear value at which the sRGB curve (IEC 61966-2-1) changes from a line to a power."""
SRGB_KNEE = 0.04045
"""sRGB value of `LINEAR_KNEE`."""
STABILISERS = 0.01, 0.03
"""Constants K1 and K2 of SSIM (Wang et al. 2004), relative to the range of the values."""


def srgb_from_linear(linear: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """sRGB values of linear ones (IEC 61966-2-1), element by element.

    Negative values become 0 and have no gradient, because the power is undefined there. Values above 1 follow the same
    power.
    """
    return _SrgbFromLinear.apply(linear)


class _SrgbFromLinear(torch.autograd.Function):
    """`srgb_from_linear` with a derivative that reuses the power of the forward pass."""

    @staticmethod
    def forward(ctx: Any, linear: Tensor) -> Tensor:
        power = linear.clamp_min(LINEAR_KNEE).log_().mul_(1 / 2.4).exp_().mul_(1.055).sub_(0.055)
        srgb = torch.where(linear <= LINEAR_KNEE, 12.92 * linear.clamp_min(0), power)
        ctx.save_for_backward(linear, srgb)
        return srgb

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> Tensor:  # type: ignore[override]
        linear, srgb = ctx.saved_tensors
        slope = (srgb + 0.055) / (2.4 * linear.clamp_min(LINEAR_KNEE))
        return v * torch.where(linear <= LINEAR_KNEE, 12.92 * (linear >= 0), slope)


def linear_from_srgb(srgb: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Linear values of sRGB ones, the inverse of `srgb_from_linear`; negative values become 0 and have no gradient."""
    srgb = srgb.clamp_min(0)
    return torch.where(srgb <= SRGB_KNEE, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb8(linear: Float[Tensor, "*b"]) -> UInt8[Tensor, "*b"]:
    """8-bit sRGB code values of linear ones, which are clamped to [0, 1]."""
    return (srgb_from_linear(linear.clamp(0, 1)) * 255).round().to(torch.uint8)


def ssim(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    *,
    window: int = 11,
    sigma: float = 1.5,
    range: float = 1.0,
) -> Float[Tensor, ""]:
    """Structural similarity (SSIM, Wang et al. 2004), the mean of `ssim_map`; it is 1 for equal images.

    Args:
        x: First image.
        y: Second image.
        window: Width of the Gaussian window [pixels], odd.
        sigma: Standard deviation of the Gaussian window [pixels].
        range: Difference between the largest and the smallest possible value.

    Raises:
        ValueError: An image is smaller than the window.
    """
    return ssim_map(x, y, window=window, sigma=sigma, range=range).mean()


def ssim_map(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    *,
    window: int = 11,
    sigma: float = 1.5,
    range: float = 1.0,
) -> Float[Tensor, "h-{window}+1 w-{window}+1 c"]:
    """Structural similarity at all pixels whose window lies within the images; the arguments are those of `ssim`.

    Raises:
        ValueError: An image is smaller than the window.
    """
    if min(x.shape[:2]) < window:
        raise ValueError(f"an image of {x.shape[1]} x {x.shape[0]} is smaller than the window of {window} pixels")
    c1, c2 = ((k * range) ** 2 for k in STABILISERS)
    return _similarity(channels_first(x), channels_first(y), window, sigma, c1, c2).movedim(0, -1)


def _similarity(x: Tensor, y: Tensor, window: int, sigma: float, c1: float, c2: float) -> Tensor:
    """`ssim_map` of images `[c h w]`."""
    moments = torch.stack([x, y, x * x + y * y, x * y]).flatten(0, 1)
    mean_x, mean_y, power, product = gaussian_blur(moments, window, sigma, (1, 2)).unflatten(0, (4, -1))
    mean_product, squares = mean_x * mean_y, mean_x.square() + mean_y.square()
    numerator = (2 * mean_product + c1) * (2 * (product - mean_product) + c2)
    return numerator / ((squares + c1) * (power - squares + c2))


def iou(x: Bool[Tensor, "*b"], y: Bool[Tensor, "*b"], valid: Bool[Tensor, "*b"] | None = None) -> Float[Tensor, ""]:
    """Intersection over union of two masks within the valid pixels (default: all); 0 when both masks are empty."""
    intersection, union = x & y, x | y
    if valid is not None:
        intersection, union = intersection & valid, union & valid
    return intersection.sum() / union.sum().clamp_min(1)


def channels_first(x: Shaped[Tensor, "h w c"]) -> Shaped[Tensor, "c h w"]:
    """The image as contiguous channel planes; operations that mix channels are several times as fast on these."""
    return x.movedim(-1, 0).contiguous()


def resize(x: Float[Tensor, "h w c"], height: int, width: int) -> Float[Tensor, "{height} {width} c"]:
    """The image resampled bilinearly; when shrinking, with a triangle filter two new pixels wide against aliasing."""
    resized = functional.interpolate(
        x.permute(2, 0, 1)[None], (height, width), mode="bilinear", align_corners=False, antialias=True
    )
    return resized[0].permute(1, 2, 0)


def resize_area(x: Float[Tensor, "h w c"], height: int, width: int) -> Float[Tensor, "{height} {width} c"]:
    """The image resampled by area averaging, which preserves its mean exactly."""
    rows, columns = _overlaps(x.shape[0], height).to(x), _overlaps(x.shape[1], width).to(x)
    return torch.einsum("ih,hwc,jw->ijc", rows, x, columns)


def resize_srgb8(images: UInt8[Tensor, "t h w 3"], height: int, width: int) -> UInt8[Tensor, "t {height} {width} 3"]:
    """Images of sRGB code values resampled by area averaging in linear light."""
    curve = linear_from_srgb(torch.arange(256, device=images.device) / 255)
    return torch.stack([to_srgb8(resize_area(curve[image.long()], height, width)) for image in images])


def crop_box(mask: Shaped[Tensor, "h w"], margin: int) -> Box:
    """Bounding box of the pixels above zero, widened by `margin` [pixels] and clipped to the image.

    Raises:
        ValueError: The mask is empty.
    """
    rows, columns = (mask > 0).any(1).nonzero(), (mask > 0).any(0).nonzero()
    if not len(rows):
        raise ValueError("there is nothing to crop to: the mask is empty")
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    bottom = min(int(rows[-1]) + 1 + margin, mask.shape[0])
    right = min(int(columns[-1]) + 1 + margin, mask.shape[1])
    return top, left, bottom - top, right - left


def crop(x: Shaped[Tensor, "h w *c"], box: Box) -> Shaped[Tensor, "i j *c"]:
    """The part of the image in a box, as a view."""
    top, left, height, width = box
    return x[top : top + height, left : left + width]


def filled_hull(pixels: Int32[np.ndarray, "n 2"], shape: tuple[int, int], border: int = 1) -> Bool[np.ndarray, "h w"]:
    """Pixels in the convex hull of some, none if there are none.

    Args:
        pixels: Column and row of each.
        shape: Height and width of the image [pixels].
        border: Width of a line along the hull, of which one half is outside [pixels].
    """
    import cv2

    mask = np.zeros(shape, np.uint8)
    if len(pixels):
        hull = np.asarray(cv2.convexHull(pixels))
        cv2.fillConvexPoly(mask, hull, 1)
        cv2.polylines(mask, [hull], True, 1, border)
    return mask > 0


def gaussian_blur(x: Float[Tensor, "*n"], window: int, sigma: float, axes: Sequence[int]) -> Float[Tensor, "*m"]:
    """The values filtered by a Gaussian of `window` values along some axes, without padding, which shortens them.

    It sums shifted values because torch prepares a convolution anew for each new size, and takes four times as long
    with large grids.
    """
    offset = torch.arange(window, dtype=torch.float64) - (window - 1) / 2
    weight = (-0.5 * (offset / sigma).square()).exp()
    weight = (weight / weight.sum()).tolist()
    for axis in axes:
        size = x.shape[axis] - window + 1
        blurred = x.narrow(axis, 0, size) * weight[0]
        for i, w in enumerate(weight[1:], 1):
            blurred.add_(x.narrow(axis, i, size), alpha=w)
        x = blurred
    return x


def _overlaps(old: int, new: int) -> Float[Tensor, "{new} {old}"]:
    """Fraction of every new pixel that each old pixel covers; each row sums to one."""
    old_edges = torch.arange(old + 1, dtype=torch.float64)
    new_edges = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    start = torch.maximum(old_edges[:-1], new_edges[:-1, None])
    end = torch.minimum(old_edges[1:], new_edges[1:, None])
    return (end - start).clamp_min(0) * (new / old)
