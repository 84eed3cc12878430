"""NeuS under moving poses: what rays of several frames see of one shape, and how far that is from the photographs.

A *glimpse* is some pixels of one frame with the pose that its object has there. Terms are those of NeuS (Wang et al.
2021) for rays of an object with a mask, and FMOV's flow term between two frames (section 4.1 of the paper).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, smooth_l1_loss

from tumble.maths.se3 import SE3
from tumble.poses.progressive import sdf_field, volume
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.sdf_field import Fields
from tumble.poses.progressive.volume import Rendered, Sections
from tumble.scene.camera import Camera

LEAST = 1e-3
"""Opacities are kept this far from 0 and 1 in the mask term (NeuS)."""
SEEN = 0.05
"""Opacity under which a ray says nothing about where it met the object."""


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
    along: Sections = volume.sections(origins, directions, n_sections, bound=bound, jitter=jitter)
    return volume.render(
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
