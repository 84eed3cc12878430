"""Pictures as tensors `[h w c]`, rows downwards: colour curves, similarity, gradients, resampling, cropping.

Pixel centres lie at +0.5, so a resized picture covers the same area. Values are linear RGB unless a name says sRGB.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped, UInt8
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
    return _SrgbFromLinear.apply(linear)


class _SrgbFromLinear(torch.autograd.Function):
    """The curve, whose derivative needs no second power."""

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
    """The inverse of `srgb_from_linear`: negative values become 0, without gradient."""
    srgb = srgb.clamp_min(0)
    return torch.where(srgb <= SRGB_KNEE, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb8(linear: Float[Tensor, "*b"]) -> UInt8[Tensor, "*b"]:
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
    return _Similarity.apply(channels_first(x), channels_first(y), _gaussian(window, sigma), c1, c2).movedim(0, -1)


class _Similarity(torch.autograd.Function):
    """`ssim_map` of planes `[c h w]`, with its derivative written out: a third of the time."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, weight: list[float], c1: float, c2: float) -> Tensor:
        moments = torch.stack([x, y, x * x + y * y, x * y]).flatten(0, 1)
        mean_x, mean_y, power, product = _blur(moments, weight).unflatten(0, (4, -1))
        both, squares = mean_x * mean_y, mean_x.square() + mean_y.square()
        upper = 2 * both + c1, 2 * (product - both) + c2
        lower = squares + c1, power - squares + c2
        similarity = upper[0] * upper[1] / (lower[0] * lower[1])
        ctx.weight = weight
        ctx.save_for_backward(x, y, mean_x, mean_y, *upper, *lower, similarity)
        return similarity

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x, y, mean_x, mean_y, a1, a2, b1, b2, similarity = ctx.saved_tensors
        v_ratio, v_similarity = 2 * v / (b1 * b2), v * similarity
        across, along = v_ratio * (a2 - a1), 2 * v_similarity * (1 / b2 - 1 / b1)
        shared = [-v_similarity / b2, v_ratio * a1]
        wanted = [ctx.needs_input_grad[0], ctx.needs_input_grad[1]]
        own = [across * theirs + along * mine for mine, theirs in ((mean_x, mean_y), (mean_y, mean_x))]
        own = [gradient for gradient, want in zip(own, wanted, strict=True) if want]
        # The window is symmetric, so that its adjoint is itself, on planes with room for it.
        room = functional.pad(torch.cat(own + shared), 4 * [len(ctx.weight) - 1])
        back = iter(_blur(room, ctx.weight).split(len(x)))
        first, second = (next(back) if want else None for want in wanted)
        v_power, v_product = back
        v_x = None if first is None else first + 2 * x * v_power + y * v_product
        v_y = None if second is None else second + 2 * y * v_power + x * v_product
        return v_x, v_y, None, None, None


def iou(x: Bool[Tensor, "*b"], y: Bool[Tensor, "*b"], counted: Bool[Tensor, "*b"] | None = None) -> Float[Tensor, ""]:
    """Intersection over union of two masks, among the counted pixels; 0 when both are empty there."""
    both, either = x & y, x | y
    if counted is not None:
        both, either = both & counted, either & counted
    return both.sum() / either.sum().clamp_min(1)


def channels_first(x: Shaped[Tensor, "h w c"]) -> Shaped[Tensor, "c h w"]:
    """Each channel by itself in memory: whatever mixes channels is then several times as fast."""
    return x.movedim(-1, 0).contiguous()


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


def _gaussian(window: int, sigma: float) -> list[float]:
    offset = torch.arange(window, dtype=torch.float64) - (window - 1) / 2
    weight = (-0.5 * (offset / sigma).square()).exp()
    return (weight / weight.sum()).tolist()


def _blur(x: Float[Tensor, "n h w"], weight: list[float]) -> Float[Tensor, "n i j"]:
    """Filter rows and columns with the same weights, only where they fit.

    By shifted sums: a convolution of another size each time is prepared anew each time.
    """
    for axis in (1, 2):
        size = x.shape[axis] - len(weight) + 1
        blurred = x.narrow(axis, 0, size) * weight[0]
        for i, w in enumerate(weight[1:], 1):
            blurred.add_(x.narrow(axis, i, size), alpha=w)
        x = blurred
    return x


def _overlaps(old: int, new: int) -> Float[Tensor, "{new} {old}"]:
    """How much of every new pixel each old one covers; rows sum to one."""
    old_edges = torch.arange(old + 1, dtype=torch.float64)
    new_edges = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    start = torch.maximum(old_edges[:-1], new_edges[:-1, None])
    end = torch.minimum(old_edges[1:], new_edges[1:, None])
    return (end - start).clamp_min(0) * (new / old)
