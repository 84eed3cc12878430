"""NeuS under moving poses: what rays of several frames see of one shape, and how far that is from the photographs.

A *glimpse* is some pixels of one frame with the pose that its object has there. Terms are those of NeuS (Wang et al.
2021) for rays of an object with a mask, and FMOV's flow term between two frames (section 4.1 of the paper).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, smooth_l1_loss

from tumble.maths import SE3
from tumble.poses.progressive import sdf_field
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.sdf_field import Fields
from tumble.scene import Camera

LEAST = 1e-3
"""Opacities are kept this far from 0 and 1 in the mask term (NeuS)."""
SEEN = 0.05
"""Opacity under which a ray says nothing about where it met the object."""

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


# Frames and losses ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Glimpse:
    """Pixels of one frame and a pose."""

    pixels: Pixels
    T_aim_obj: SE3
    """Detached where these pixels must not move the pose."""


def look(
    net: Fields, glimpses: Sequence[Glimpse], n_sections: int, *, bound: float, rng: torch.Generator | None
) -> Rendered:
    """What the rays of all glimpses see, one after the other; all in the object frame.

    Args:
        n_sections: Per ray.
        bound: Radius of the ball in which the object is [object radius].
        rng: Shifts the sections of every ray by a random part of their length; None leaves them in place.
    """
    T_obj_aim = [glimpse.T_aim_obj.inverse() for glimpse in glimpses]
    pairs = list(zip(T_obj_aim, glimpses, strict=True))
    directions = torch.cat([T.rotation @ g.pixels.directions for T, g in pairs])
    origins = torch.cat([T.xyz.expand(len(g.pixels), 3) for T, g in pairs])
    jitter = None if rng is None else torch.rand(len(origins), generator=rng).to(origins) - 0.5
    along: Sections = sections(origins, directions, n_sections, bound=bound, jitter=jitter)
    return render(
        lambda x: sdf_field.surface(net.sdf, x),
        lambda x, view, gradient, features: sdf_field.colour(net.colour, x, view, gradient, features),
        net.sharpness,
        origins,
        directions,
        along,
    )


def colour_error(seen: Rendered, pixels: Pixels) -> Float[Tensor, ""]:
    """Absolute difference, summed over channels, meaned over the object (NeuS)."""
    error = (seen.rgb - pixels.rgb).abs().sum(-1)
    return (error * pixels.mask).sum() / (pixels.mask.sum() + 1e-5)


def mask_error(seen: Rendered, pixels: Pixels) -> Float[Tensor, ""]:
    """Mean binary cross entropy between opacity and mask (NeuS); 0 without rays, as where a mask is all unknown."""
    total = binary_cross_entropy(seen.opacity.clamp(LEAST, 1 - LEAST), pixels.mask, reduction="sum")
    return total / max(1, len(pixels))


def eikonal(seen: Rendered) -> Float[Tensor, ""]:
    """A distance changes by 1 per unit of length: mean of `(|gradient| - 1)^2`; 0 without rays."""
    return (seen.gradients.norm(dim=-1) - 1).square().sum() / max(1, seen.weights.numel())


def transfer(
    seen: Rendered, rays: slice, T_aim_obj: SE3, camera: Camera, uv: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Where another frame should see what some rays met, less where its matches are; and how surely the rays met it.

    FMOV sums projections with weights that do not sum to one, so that a ray that misses pulls the picture to the
    origin, and weights to zero; here the weights' mean point is projected.

    Args:
        rays: Of `seen`; ends of the correspondences in the one frame.
        T_aim_obj: Of the other frame.
        camera: The virtual one.
        uv: Ends of the correspondences in the other virtual frame [pixels].
    """
    weights = seen.weights[rays]
    total = weights.sum(-1)
    met = (weights[..., None] * seen.points[rays]).sum(1) / (total[:, None] + 1e-4)
    return camera.project(T_aim_obj @ met) - uv, (total.detach() > SEEN).to(total)


def robust(residual: Float[Tensor, "m 2"], weight: Float[Tensor, " m"], *, threshold: float) -> Float[Tensor, ""]:
    """Weighted mean of Huber's function of both components, in its slope-1 form: `|r|` far out, as FMOV's term."""
    loss = smooth_l1_loss(residual, torch.zeros_like(residual), reduction="none", beta=threshold).mean(-1)
    return (loss * weight).sum() / (weight.sum() + 1e-5)
