"""NeuS volume rendering of one shape under several poses, and the losses of stage 1.

The losses are those of NeuS (Wang et al. 2021) for rays of an object with a mask, and FMOV's flow loss between two
frames (section 4.1 of the paper).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional
from torch.nn.functional import binary_cross_entropy, smooth_l1_loss

from tumble.maths import SE3
from tumble.poses.progressive import sdf_field
from tumble.poses.progressive.grid_field import Grids
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.sdf_field import Fields
from tumble.scene import Camera

OPACITY_MARGIN = 1e-3
"""Smallest distance of opacities from 0 and 1 in the mask loss (NeuS)."""
MIN_WEIGHT = 1e-3
"""Weight below which a section of a ray through voxel grids is left out."""
MIN_HIT_OPACITY = 0.05
"""Opacity of a ray below which its intersection with the object is undefined."""

SdfFunction = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
"""Function of points [n 3] that returns signed distance [n], its gradient [n 3] and features [n f]."""
ColourFunction = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Function of points, ray directions, gradients [n 3] and features [n f] that returns colours [n 3]."""


@dataclass(frozen=True)
class Sections:
    """Sections along rays, each of which contributes one sample."""

    middles: Float[Tensor, "r k"]
    """Distances of the sections' centres from the origin of the ray."""
    lengths: Float[Tensor, "r k"]
    """Lengths of the sections."""


@dataclass(frozen=True)
class Rendered:
    """Rendered rays: `r` rays with `k` sections each."""

    rgb: Float[Tensor, "r 3"]
    """Colour over black, sRGB."""
    opacity: Float[Tensor, " r"]
    """Sum of the weights."""
    weights: Float[Tensor, "r k"]
    """Weight of each section in the colour."""
    points: Float[Tensor, "r k 3"]
    """Centres of the sections, object frame."""
    gradients: Float[Tensor, "n 3"]
    """Gradient of the signed distance at the centres of the sections that were evaluated."""


@torch.no_grad()
def sections(
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    n: int,
    *,
    bound: float,
    jitter: Float[Tensor, " r"] | None = None,
) -> Sections:
    """Sections of equal length along the chord of each ray in a sphere.

    NeuS samples one radius before and behind the point closest to the centre, and so also outside the sphere. Chords
    are shorter; a ray that misses the sphere gets sections of length 0, whose opacity is 0.

    Args:
        origins: Origins of the rays.
        directions: Directions of the rays, unit length.
        n: Number of sections per ray.
        bound: Radius of the sphere.
        jitter: Shift of all sections of a ray, as a fraction of their length, in [-0.5, 0.5].
    """
    closest = -(origins * directions).sum(-1)
    squared = bound**2 - (origins + closest[:, None] * directions).square().sum(-1)
    half = squared.clamp_min(0).sqrt()
    step = 2 * half / n
    ticks = torch.arange(n, dtype=origins.dtype, device=origins.device) + 0.5
    positions = ticks if jitter is None else ticks + jitter[:, None]
    middles = (closest - half)[:, None] + positions * step[:, None]
    return Sections(middles, step[:, None].expand_as(middles))


def opacities(
    sdf: Float[Tensor, "*b"],
    slope: Float[Tensor, "*b"],
    lengths: Float[Tensor, "*b"],
    sharpness: Float[Tensor, ""],
) -> Float[Tensor, "*b"]:
    """Opacity of each section: `(F(s0) - F(s1)) / F(s0)` with the logistic function F (NeuS eq. 13).

    Args:
        sdf: Signed distance at the sections' centres.
        slope: Derivative of the distance along the ray; where it is positive, the opacity is 0.
        lengths: Lengths of the sections.
        sharpness: Sharpness of the logistic function [1 / object radius].
    """
    half = 0.5 * slope.clamp_max(0) * lengths
    before, after = torch.sigmoid((sdf - half) * sharpness), torch.sigmoid((sdf + half) * sharpness)
    # 1e-5 as in NeuS, because deep inside both are 0; not in the numerator, so that a section of length 0 gives 0.
    return ((before - after) / (before + 1e-5)).clamp(0, 1)


def composite(alpha: Float[Tensor, "r k"]) -> Float[Tensor, "r k"]:
    """Compositing weights: `alpha_k` times the product of `1 - alpha_j` over j < k."""
    transmittance = torch.cumprod(1 - alpha + 1e-7, dim=1)
    return alpha * torch.cat([torch.ones_like(transmittance[:, :1]), transmittance[:, :-1]], 1)


def render(
    sdf: SdfFunction,
    colour: ColourFunction,
    sharpness: Float[Tensor, ""],
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    intervals: Sections,
    *,
    where: Bool[Tensor, "r k"] | None = None,
) -> Rendered:
    """Volume rendering of rays over black; differentiable in both functions, origins and directions.

    Args:
        sdf: Shape.
        colour: Colour.
        sharpness: Sharpness of the logistic function [1 / object radius].
        origins: Origins of the rays.
        directions: Directions of the rays, unit length.
        intervals: Sections of the rays.
        where: Sections that are evaluated; the others are empty. None for all.
    """
    r, k = intervals.middles.shape
    points = origins[:, None] + intervals.middles[..., None] * directions[:, None]
    if where is None:
        where = torch.ones_like(intervals.middles, dtype=torch.bool)
    index = where.flatten().nonzero()[:, 0]
    flat, ray = points.reshape(-1, 3)[index], index // k
    views = directions[ray]
    distance, gradient, features = sdf(flat)
    slope = (gradient * views).sum(-1)
    alpha = opacities(distance, slope, intervals.lengths.reshape(-1)[index], sharpness)
    weights = composite(alpha.new_zeros(r * k).index_put((index,), alpha).reshape(r, k))
    own = weights.reshape(-1)[index]
    rgb = torch.zeros_like(origins).index_add(0, ray, own[:, None] * colour(flat, views, gradient, features))
    return Rendered(rgb, weights.sum(1), weights, points, gradient)


@torch.no_grad()
def near_surface(
    distance: Callable[[Tensor], Tensor],
    sharpness: Float[Tensor, ""],
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    intervals: Sections,
) -> Bool[Tensor, "r k"]:
    """Sections that contribute to a ray, and the one of each ray that lies closest to the surface.

    Args:
        distance: Signed distance [n] of points [n 3].
        sharpness: Sharpness of the logistic function [1 / object radius].
        origins: Origins of the rays.
        directions: Directions of the rays, unit length.
        intervals: Sections of the rays.
    """
    points = origins[:, None] + intervals.middles[..., None] * directions[:, None]
    sdf = distance(points.reshape(-1, 3)).reshape(intervals.middles.shape)
    # As if the ray met the surface at a right angle.
    weights = composite(opacities(sdf, -torch.ones_like(sdf), intervals.lengths, sharpness))
    closest = functional.one_hot(sdf.abs().argmin(1), sdf.shape[1]).bool()
    return (weights > MIN_WEIGHT) | closest


# Frames and losses ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RayBatch:
    """Rays of one frame and the pose of the object in it."""

    pixels: Pixels
    """Rays and their targets."""
    T_aim_obj: SE3
    """Object to virtual camera; detached where the rays must not change the pose."""


def render_batches(
    fields: Fields, batches: Sequence[RayBatch], n_sections: int, *, bound: float, rng: torch.Generator | None
) -> Rendered:
    """Volume rendering of the rays of all batches, concatenated, in the object frame.

    Args:
        fields: Networks of the object.
        batches: Rays and poses of several frames.
        n_sections: Sections per ray.
        bound: Radius of the sphere that contains the object [object radius].
        rng: Random number generator for a shift of the sections of every ray; None for no shift.
    """
    T_obj_aim = [batch.T_aim_obj.inverse() for batch in batches]
    pairs = list(zip(T_obj_aim, batches, strict=True))
    directions = torch.cat([T.rotation @ batch.pixels.directions for T, batch in pairs])
    origins = torch.cat([T.xyz.expand(len(batch.pixels), 3) for T, batch in pairs])
    jitter = None if rng is None else torch.rand(len(origins), generator=rng).to(origins) - 0.5
    intervals: Sections = sections(origins, directions, n_sections, bound=bound, jitter=jitter)
    where = None
    if isinstance(fields.sdf, Grids):
        where = near_surface(partial(sdf_field.distance, fields.sdf), fields.sharpness, origins, directions, intervals)
    return render(
        lambda x: sdf_field.distance_and_gradient(fields.sdf, x),
        lambda x, view, gradient, features: sdf_field.colour(fields.colour, x, view, gradient, features),
        fields.sharpness,
        origins,
        directions,
        intervals,
        where=where,
    )


def colour_loss(rendered: Rendered, pixels: Pixels) -> Float[Tensor, ""]:
    """Absolute colour difference, summed over channels and averaged over object pixels (NeuS)."""
    error = (rendered.rgb - pixels.rgb).abs().sum(-1)
    return (error * pixels.mask).sum() / (pixels.mask.sum() + 1e-5)


def mask_loss(rendered: Rendered, pixels: Pixels) -> Float[Tensor, ""]:
    """Mean binary cross entropy between opacity and mask (NeuS); 0 without rays, as where all pixels are unknown."""
    total = binary_cross_entropy(
        rendered.opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN), pixels.mask, reduction="sum"
    )
    return total / max(1, len(pixels))


def eikonal_loss(rendered: Rendered) -> Float[Tensor, ""]:
    """Eikonal loss of the signed distance, the mean of `(|gradient| - 1)^2`; 0 without rays."""
    return (rendered.gradients.norm(dim=-1) - 1).square().sum() / max(1, len(rendered.gradients))


def transfer_residuals(
    rendered: Rendered, rays: slice, T_aim_obj: SE3, camera: Camera, uv: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Reprojection errors of correspondences through the rendered shape, and weights that exclude rays without a hit.

    The points where rays of one frame meet the shape are projected into another frame and compared with the matched
    positions there. FMOV sums projections with weights that do not sum to one, which biases them towards the origin and
    the weights towards zero; here the weighted mean point is projected.

    Args:
        rendered: Rendered rays.
        rays: Range of the rays through the correspondences of the first frame.
        T_aim_obj: Pose in the second frame.
        camera: Virtual camera.
        uv: Positions of the correspondences in the second virtual frame [pixels].

    Returns:
        Projected minus matched positions [pixels], and weights 0 or 1.
    """
    weights = rendered.weights[rays]
    total = weights.sum(-1)
    hit = (weights[..., None] * rendered.points[rays]).sum(1) / (total[:, None] + 1e-4)
    return camera.project(T_aim_obj @ hit) - uv, (total.detach() > MIN_HIT_OPACITY).to(total)


def huber_loss(residual: Float[Tensor, "m 2"], weight: Float[Tensor, " m"], *, threshold: float) -> Float[Tensor, ""]:
    """Weighted mean of the Huber loss of both components, scaled to slope 1: `|r|` for large residuals, as in FMOV."""
    loss = smooth_l1_loss(residual, torch.zeros_like(residual), reduction="none", beta=threshold).mean(-1)
    return (loss * weight).sum() / (weight.sum() + 1e-5)
