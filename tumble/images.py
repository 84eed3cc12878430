"""Pictures as tensors `[h w c]`, rows downwards: colour curves, similarity, gradients, resampling, cropping.

Pixel centres lie at +0.5, so a resized picture covers the same area. Values are linear RGB unless a name says sRGB.
"""

import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor
from torch.nn import functional

Box = tuple[int, int, int, int]
"""Top, left, height, width of a window [pixels]."""
LINEAR_KNEE, SRGB_KNEE = 0.0031308, 0.04045
"""Where the curve of IEC 61966-2-1 turns from a line into a power."""
STABILISERS = 0.01, 0.03
"""K1 and K2 of Wang et al. 2004, in units of the range of the values."""


def srgb_from_linear(linear: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The sRGB curve (IEC 61966-2-1), element by element.

    Negative values, which the power cannot take, become 0, without gradient. Values above 1 follow the same power.
    """
    linear = linear.clamp_min(0)
    # The power has no finite gradient at 0: keep it away from there also where it is not used.
    power = 1.055 * linear.clamp_min(LINEAR_KNEE) ** (1 / 2.4) - 0.055
    return torch.where(linear <= LINEAR_KNEE, 12.92 * linear, power)


def linear_from_srgb(srgb: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The inverse of `srgb_from_linear`: negative values become 0, without gradient."""
    srgb = srgb.clamp_min(0)
    return torch.where(srgb <= SRGB_KNEE, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def photograph(linear: Float[Tensor, "*b"]) -> UInt8[Tensor, "*b"]:
    """What a camera stores of linear values: saturated at 1, along the sRGB curve, rounded to 8 bits."""
    return (srgb_from_linear(linear.clamp(0, 1)) * 255).round().to(torch.uint8)


def ssim(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    *,
    window: int = 11,
    sigma: float = 1.5,
    range: float = 1.0,
) -> Float[Tensor, ""]:
    """Structural similarity (Wang et al. 2004), the mean of `ssim_map`: 1 for equal pictures.

    Args:
        window: Width of the Gaussian window [pixels], odd.
        sigma: Standard deviation of the Gaussian window [pixels].
        range: Difference between the largest and the smallest possible value.

    Raises:
        ValueError: A picture smaller than the window.
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
    """Structural similarity wherever the window fits into the pictures: `(window - 1) / 2` pixels less on each side.

    Raises:
        ValueError: A picture smaller than the window.
    """
    if min(x.shape[:2]) < window:
        raise ValueError(f"a picture of {x.shape[1]} x {x.shape[0]} is smaller than the window of {window} pixels")
    c1, c2 = ((k * range) ** 2 for k in STABILISERS)
    moments = torch.stack([x, y, x * x + y * y, x * y])
    mean_x, mean_y, power, product = _blur(moments, _gaussian(window, sigma).to(x))
    means, mean_power = mean_x * mean_y, mean_x.square() + mean_y.square()
    similar = (2 * means + c1) * (2 * (product - means) + c2)
    return similar / ((mean_power + c1) * (power - mean_power + c2))


def gradients(x: Float[Tensor, "h w c"]) -> tuple[Float[Tensor, "h w-1 c"], Float[Tensor, "h-1 w c"]]:
    """Differences to the next pixel on the right and to the next one below."""
    return x[:, 1:] - x[:, :-1], x[1:] - x[:-1]


def edge_aware(x: Float[Tensor, "h w c"], guide: Float[Tensor, "h w g"]) -> Float[Tensor, ""]:
    """Mean absolute gradient of `x`, each weighed by exp(-|gradient|) of the guide, averaged over its channels.

    Where the guide has an edge, `x` may have one. The sum of both axes' means, so independent of size and channels.
    """
    pairs = zip(gradients(x), gradients(guide), strict=True)
    across, down = ((dx.abs() * (-dg.abs()).exp().mean(-1, keepdim=True)).mean() for dx, dg in pairs)
    return across + down


def resize(x: Float[Tensor, "h w c"], height: int, width: int) -> Float[Tensor, "{height} {width} c"]:
    """The picture on another grid: bilinear, with a triangle as wide as two new pixels when shrinking."""
    resized = functional.interpolate(
        x.permute(2, 0, 1)[None], (height, width), mode="bilinear", align_corners=False, antialias=True
    )
    return resized[0].permute(1, 2, 0)


def resize_area(x: Float[Tensor, "h w c"], height: int, width: int) -> Float[Tensor, "{height} {width} c"]:
    """The picture on another grid, every new pixel the mean over the area it covers; keeps the mean exactly."""
    rows, columns = _overlaps(x.shape[0], height).to(x), _overlaps(x.shape[1], width).to(x)
    return torch.einsum("ih,hwc,jw->ijc", rows, x, columns)


def crop_box(mask: Shaped[Tensor, "h w"], margin: int) -> Box:
    """The smallest window around all pixels above zero, and `margin` more [pixels] where the picture has them.

    Raises:
        ValueError: An empty mask.
    """
    rows, columns = (mask > 0).any(1).nonzero(), (mask > 0).any(0).nonzero()
    if not len(rows):
        raise ValueError("nothing to crop to: the mask is empty")
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    bottom = min(int(rows[-1]) + 1 + margin, mask.shape[0])
    right = min(int(columns[-1]) + 1 + margin, mask.shape[1])
    return top, left, bottom - top, right - left


def crop(x: Shaped[Tensor, "h w *c"], box: Box) -> Shaped[Tensor, "i j *c"]:
    """A window of the picture, as a view."""
    top, left, height, width = box
    return x[top : top + height, left : left + width]


def _gaussian(window: int, sigma: float) -> Float[Tensor, "{window}"]:
    offset = torch.arange(window, dtype=torch.float64) - (window - 1) / 2
    weight = (-0.5 * (offset / sigma).square()).exp()
    return weight / weight.sum()


def _blur(x: Float[Tensor, "n h w c"], weight: Float[Tensor, " k"]) -> Float[Tensor, "n i j c"]:
    """Filter rows and columns with the same weights, only where they fit."""
    n, h, w, c = x.shape
    # As channels of one picture: fourteen times as fast as a batch of pictures with one channel.
    planes = x.movedim(-1, 1).reshape(1, n * c, h, w)
    weights = weight.expand(n * c, 1, -1)
    blurred = functional.conv2d(planes, weights[..., None], groups=n * c)
    blurred = functional.conv2d(blurred, weights[..., None, :], groups=n * c)
    return blurred.reshape(n, c, *blurred.shape[2:]).movedim(1, -1)


def _overlaps(old: int, new: int) -> Float[Tensor, "{new} {old}"]:
    """How much of every new pixel each old one covers; rows sum to one."""
    old_edges = torch.arange(old + 1, dtype=torch.float64)
    new_edges = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    start = torch.maximum(old_edges[:-1], new_edges[:-1, None])
    end = torch.minimum(old_edges[1:], new_edges[1:, None])
    return (end - start).clamp_min(0) * (new / old)
