"""Rays through the Gaussians in the object frame, and the cache of what surface points can see.

The object is rigid and the light far away, so what stands between a surface point and a direction depends on the
point and the direction *in the object frame* alone, never on the pose: it is traced when geometry has moved
(`Tracer.moved`), not when the object has. A *visibility* is one bit per point and shared direction.

Rays start from the surface that a camera sees, lifted along its normal. They never start from a Gaussian's centre:
some centres lie under the surface, and what they see is the Gaussians above them.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from tumble import backends
from tumble.backends import Backend, Hits
from tumble.maths import SE3, nearest, spherical_harmonics
from tumble.rendering.rasterizer import rasterize
from tumble.scene import Camera, Gaussians, opacity

OFFSET = 1.5
"""How far rays start above the surface [median of the Gaussians' largest standard deviations]. On spheres and tori
with noisy centres, normals, sizes and opacities, 1 throws false shadows and 2 loses contact shadows; a sphere then sees
0.998 of its sky."""
WORD = 32
"""Bits in a word of a visibility."""


@dataclass(frozen=True)
class Tracer:
    """A search tree over Gaussians as they were when it was built."""

    backend: Backend
    bvh: Any
    gaussians: Gaussians
    """As they were, without gradient."""
    offset: float
    """How far rays start above the surface [object radius]."""

    def lifted(self, points: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
        """Where rays from surface points start, given the unit normals there; without gradient."""
        return (points + self.offset * normals).detach()

    def moved(self, gaussians: Gaussians) -> float:
        """How far Gaussians have moved since the tree was built: `moved`."""
        return displacement(self.gaussians, gaussians)


@torch.no_grad()
def displacement(before: Gaussians, now: Gaussians) -> float:
    """How far the middle Gaussian has moved [its own largest standard deviation], or turned [radians].

    The larger of both medians. Rebuild a tree and what was traced with it beyond about 0.3: a shadow's edge is as wide
    as a Gaussian. Infinite when their number has changed.
    """
    if len(now) != len(before):
        return float("inf")
    if len(now) == 0:
        return 0.0
    shift = (now.means - before.means).norm(dim=-1) / before.scales.amax(-1)
    turn = (now.normals - before.normals).norm(dim=-1)
    return max(shift.median().item(), turn.median().item())


def build(gaussians: Gaussians, gamma: Float[Tensor, ""]) -> Tracer:
    """A tracer of the Gaussians as they are now; `gamma` is the sharpness of the opacity [1 / object radius]."""
    backend = backends.choose(gaussians.means.device, gaussians.means.dtype)
    raw = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sdf, gaussians.sh)
    # Copies: an optimizer changes parameters in place.
    kept = Gaussians(*(x.detach().clone() for x in raw))
    alpha = opacity(kept.sdf, gamma.detach())
    offset = OFFSET * kept.scales.amax(-1).median().item() if len(kept) else 0.0
    return Tracer(backend, backend.build(kept.means, kept.quats, kept.scales, alpha), kept, offset)


def trace(
    tracer: Tracer,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "n 3"] | None = None,
) -> Hits:
    """What rays meet, object frame: transmittance, radiance of what is hit, and which Gaussian that mostly is.

    Not differentiable.

    Args:
        origins: Lifted off their own surface [object radius].
        directions: Unit directions.
        radiance: Linear radiance of every Gaussian, the same in all directions.
    """
    return tracer.backend.trace(tracer.bvh, origins, directions, origins[:0] if radiance is None else radiance)


@dataclass(frozen=True)
class Visibility:
    """Which of some shared directions surface points can see.

    `D / 8` bytes per point for the bits (32 for 256 directions), and `4 D` more where blockers are kept.
    """

    directions: Float[Tensor, "D 3"]
    """Unit directions, object frame, each standing for 4 pi / D [steradian]."""
    bits: Int32[Tensor, "p words"]
    """Bit j % 32 of word j // 32: whether direction j is above the point's horizon and nothing is in the way."""
    blocker: Int32[Tensor, "p D"] | None
    """Which Gaussian stands in each direction above the horizon that is not visible, -1 elsewhere."""

    def gather(self, index: Int64[Tensor, " q"]) -> "Visibility":
        """That of other points, each of which sees what point `index` does."""
        return Visibility(self.directions, self.bits[index], None if self.blocker is None else self.blocker[index])

    def unpacked(self) -> Bool[Tensor, "p D"]:
        """The bits, one to a byte."""
        places = torch.arange(WORD, dtype=torch.int32, device=self.bits.device)
        return ((self.bits[..., None] >> places) & 1).flatten(1)[:, : len(self.directions)].bool()

    def fraction(self, normals: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        """Visible share of the directions above each point's horizon."""
        above = normals @ self.directions.T > 0
        return (above & self.unpacked()).sum(-1) / above.sum(-1).clamp(min=1).to(normals)


def unoccluded(directions: Float[Tensor, "D 3"], n_points: int) -> Visibility:
    """The visibility of points that see everything."""
    words = -(-len(directions) // WORD)
    return Visibility(
        directions, torch.full((1, words), -1, dtype=torch.int32, device=directions.device).expand(n_points, -1), None
    )


def visibility(
    tracer: Tracer,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "D 3"],
    *,
    blockers: bool = False,
) -> Visibility:
    """What surface points see, object frame; not differentiable.

    Args:
        points: On the surface that cameras see [object radius].
        normals: Outward unit normals there.
        directions: Unit directions, shared by all points.
        blockers: Whether to keep which Gaussian stands in the way, for light that comes from it.
    """
    origins, normals = tracer.lifted(points, normals), normals.detach()
    bits = tracer.backend.visible(tracer.bvh, origins, normals, directions)
    if not blockers:
        return Visibility(directions, bits, None)
    return Visibility(directions, bits, tracer.backend.blockers(tracer.bvh, origins, normals, directions, bits))


@torch.no_grad()
def transfer(skies: Sequence[Visibility], normals: Float[Tensor, "p 3"]) -> Float[Tensor, "p 9"]:
    """What points make of light that is given in harmonics to degree 2: `transfer @ coefficients` is their irradiance,
    in their own shade (precomputed radiance transfer, Sloan et al. 2002).

    Args:
        skies: What they see under several sets of directions, of which the mean is taken.
        normals: Outward unit normals, object frame.
    """
    total = normals.new_zeros(len(normals), 9)
    for sky in skies:
        seen = (normals @ sky.directions.T).clamp(min=0) * sky.unpacked()
        total += 4 * math.pi / len(sky.directions) * (seen @ spherical_harmonics.basis(sky.directions, 2))
    return total / len(skies)


@torch.no_grad()
def surface_points(
    gaussians: Gaussians, gamma: Float[Tensor, ""], poses: Iterable[SE3], camera: Camera, *, alpha_min: float = 0.5
) -> Float[Tensor, "n 3"]:
    """The point of the visible surface that each Gaussian stands for, object frame [object radius].

    That is the mean of the rendered surface over all pixels that the Gaussian dominates (`Buffers.dominant`). One that
    dominates none is lifted along the normal of its nearest neighbour that does, up to that one's tangent plane.

    Args:
        gamma: Sharpness of the opacity [1 / object radius].
        poses: `T_cam_obj` of views that together show all sides.
        alpha_min: Least coverage of a pixel that counts.
    """
    means, normals = gaussians.means, gaussians.normals
    total, count = torch.zeros_like(means), means.new_zeros(len(gaussians))
    for T_cam_obj in poses:
        buffers = rasterize(gaussians, gamma, T_cam_obj, camera, {})
        at = torch.where((buffers.alpha >= alpha_min) & (buffers.dominant >= 0))
        x_cam = camera.unproject(camera.pixel_centers()[at].to(means), buffers.depth[at])
        index = buffers.dominant[at].long()
        total.index_add_(0, index, T_cam_obj.inverse() @ x_cam)
        count.index_add_(0, index, torch.ones_like(x_cam[:, 0]))
    seen = count > 0
    points = torch.where(seen[:, None], total / count.clamp(min=1)[:, None], means)
    if not seen.any() or seen.all():
        return points
    near = nearest(means[~seen], points[seen])
    height = ((points[seen][near] - means[~seen]) * normals[seen][near]).sum(-1, keepdim=True)
    points[~seen] = means[~seen] + height * normals[seen][near]
    return points
