"""NeuS: a picture of a signed distance field by summing colours along rays (section 4.1, eq. 5; Wang et al. 2021).

Rays and points are in the object frame [object radius]; `r` rays, `k` sections along each. Opacity comes from the drop
of a logistic curve of the distance over a section, so that the weight peaks where the ray enters the surface.
Distances along rays are not differentiated: a moving camera moves the points at them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

SdfFunction = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
"""Points [n 3] to signed distance [n], its gradient [n 3] and features [n f]."""
ColourFunction = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Points, ray directions, gradients [n 3] and features [n f] to colours [n 3]."""


@dataclass(frozen=True)
class Sections:
    """Pieces that rays are cut into."""

    middles: Float[Tensor, "r k"]
    """Distance of their centres from the origin of the ray."""
    lengths: Float[Tensor, "r k"]


@dataclass(frozen=True)
class Rendered:
    """What rays saw."""

    rgb: Float[Tensor, "r 3"]
    opacity: Float[Tensor, " r"]
    weights: Float[Tensor, "r k"]
    """Share of each section in the colour."""
    points: Float[Tensor, "r k 3"]
    """Centres of the sections."""
    gradients: Float[Tensor, "r k 3"]
    """Of the signed distance."""


@torch.no_grad()
def sections(
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    n: int,
    *,
    bound: float,
    jitter: Float[Tensor, " r"] | None = None,
) -> Sections:
    """The chord of each ray through the ball of radius `bound`, in `n` equal pieces.

    NeuS marches one radius before and behind the point closest to the centre, and may put matter outside the ball;
    chords are shorter, and a ray that misses the ball gets sections of length 0, which see nothing.

    Args:
        directions: Of unit length.
        jitter: Moves all sections of a ray by that share of their length, in [-0.5, 0.5].
    """
    closest = -(origins * directions).sum(-1)
    squared = bound**2 - (origins + closest[:, None] * directions).square().sum(-1)
    half = squared.clamp_min(0).sqrt()
    step = 2 * half / n
    ticks = torch.arange(n, dtype=origins.dtype, device=origins.device) + 0.5
    places = ticks if jitter is None else ticks + jitter[:, None]
    middles = (closest - half)[:, None] + places * step[:, None]
    return Sections(middles, step[:, None].expand_as(middles))


def opacities(
    sdf: Float[Tensor, "r k"],
    slope: Float[Tensor, "r k"],
    lengths: Float[Tensor, "r k"],
    sharpness: Float[Tensor, ""],
) -> Float[Tensor, "r k"]:
    """How much each section hides of what is behind it: `(F(s0) - F(s1)) / F(s0)`, F logistic (NeuS eq. 13).

    Args:
        sdf: Signed distance at the sections' centres.
        slope: Its derivative along the ray. Rising distance (leaving the object) hides nothing.
        sharpness: [1 / object radius]
    """
    half = 0.5 * slope.clamp_max(0) * lengths
    before, after = torch.sigmoid((sdf - half) * sharpness), torch.sigmoid((sdf + half) * sharpness)
    # 1e-5 as in NeuS: deep inside both are 0; but a section of no length must hide nothing.
    return ((before - after) / (before + 1e-5)).clamp(0, 1)


def composite(alpha: Float[Tensor, "r k"]) -> Float[Tensor, "r k"]:
    """Weights `alpha_k * product of (1 - alpha_j) over j < k`."""
    free = torch.cumprod(1 - alpha + 1e-7, dim=1)
    return alpha * torch.cat([torch.ones_like(free[:, :1]), free[:, :-1]], 1)


def render(
    sdf: SdfFunction,
    colour: ColourFunction,
    sharpness: Float[Tensor, ""],
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    along: Sections,
) -> Rendered:
    """Colours and opacities of rays over black; differentiable in both functions, origins and directions."""
    r, k = along.middles.shape
    points = origins[:, None] + along.middles[..., None] * directions[:, None]
    flat = points.reshape(-1, 3)
    views = directions[:, None].expand(r, k, 3).reshape(-1, 3)
    distance, gradient, features = sdf(flat)
    slope = (gradient * views).sum(-1)
    weights = composite(opacities(distance.reshape(r, k), slope.reshape(r, k), along.lengths, sharpness))
    rgb = (weights[..., None] * colour(flat, views, gradient, features).reshape(r, k, 3)).sum(1)
    return Rendered(rgb, weights.sum(1), weights, points, gradient.reshape(r, k, 3))
