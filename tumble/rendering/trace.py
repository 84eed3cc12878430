"""Ray tracing of Gaussians in the object frame, and visibility of shared directions from surface points.

The object is rigid and the light far away, so the visibility of a direction *in the object frame* from a surface point
does not depend on the pose. It is therefore traced again only when the geometry has changed (`displacement`). A
*visibility* has one bit per point and direction.

Rays start from the rendered surface, offset along its normal. They do not start from the Gaussians' centres: some
centres are below the surface, where the Gaussians above would occlude them.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from tumble import backends
from tumble.backends import Backend, Hits
from tumble.maths import SE3, nearest, spherical_harmonics
from tumble.rendering.rasterizer import rasterize
from tumble.scene import Camera, Gaussians, opacity

RAY_OFFSET = 1.5
"""Offset of ray origins above the surface [median of the Gaussians' largest standard deviations]; smaller offsets cause
false shadows, larger ones lose contact shadows."""
WORD_BITS = 32
"""Bits per word of a visibility."""


@dataclass(frozen=True)
class Tracer:
    """A bounding volume hierarchy over a copy of the Gaussians."""

    backend: Backend
    """Backend that built the hierarchy."""
    bvh: Any
    """The hierarchy, in a form that only the backend uses."""
    gaussians: Gaussians
    """Copy of the Gaussians, without gradient."""
    offset: float
    """Offset of ray origins above the surface [object radius]."""

    def ray_origins(self, points: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
        """Origins of rays from surface points with given unit normals; without gradient."""
        return (points + self.offset * normals).detach()

    def displacement(self, gaussians: Gaussians) -> float:
        """Displacement of the Gaussians since the hierarchy was built, see the function `displacement`."""
        return displacement(self.gaussians, gaussians)


@torch.no_grad()
def displacement(before: Gaussians, now: Gaussians) -> float:
    """Median shift of the centres [largest standard deviation] or median rotation of the normals [radians].

    The larger of both medians; infinite if the number of Gaussians has changed. Shadow edges are about as wide as a
    Gaussian, so traced results are valid up to a displacement of about 0.3.
    """
    if len(now) != len(before):
        return float("inf")
    if len(now) == 0:
        return 0.0
    shift = (now.means - before.means).norm(dim=-1) / before.scales.amax(-1)
    rotation = (now.normals - before.normals).norm(dim=-1)
    return max(shift.median().item(), rotation.median().item())


def build_tracer(gaussians: Gaussians, gamma: Float[Tensor, ""]) -> Tracer:
    """Build a tracer of the current Gaussians; `gamma` is the sharpness of the opacity [1 / object radius]."""
    backend = backends.choose(gaussians.means.device, gaussians.means.dtype)
    raw = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sdf, gaussians.sh)
    # Copies, since an optimizer changes parameters in place.
    copy = Gaussians(*(x.detach().clone() for x in raw))
    alpha = opacity(copy.sdf, gamma.detach())
    offset = RAY_OFFSET * copy.scales.amax(-1).median().item() if len(copy) else 0.0
    return Tracer(backend, backend.build(copy.means, copy.quats, copy.scales, alpha), copy, offset)


def trace(
    tracer: Tracer,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "n 3"] | None = None,
) -> Hits:
    """Transmittance, radiance and dominant Gaussian along rays; not differentiable.

    Args:
        tracer: Tracer of the Gaussians.
        origins: Ray origins, object frame, offset from the surface they start from [object radius].
        directions: Unit directions, object frame.
        radiance: Linear radiance of every Gaussian, the same in all directions; black when None.
    """
    return tracer.backend.trace(tracer.bvh, origins, directions, origins[:0] if radiance is None else radiance)


@dataclass(frozen=True)
class Visibility:
    """Visibility of D directions from p surface points.

    The bits take `D / 8` bytes per point (32 for 256 directions); the blockers, if stored, `4 D` bytes.
    """

    directions: Float[Tensor, "D 3"]
    """Unit directions shared by all points, object frame; each represents a solid angle of 4 pi / D [steradian]."""
    bits: Int32[Tensor, "q words"]
    """Bit j % 32 of word j // 32 is set if direction j is above the point's horizon and not occluded."""
    blocker: Int32[Tensor, "q D"] | None
    """Index of the Gaussian that occludes each direction above the horizon, -1 for all other directions."""
    index: Int64[Tensor, " p"] | None = None
    """Row of `bits` and `blocker` of each point; one row per point, in order, when None."""

    def gather(self, index: Int64[Tensor, " r"]) -> "Visibility":
        """Visibility of r points, each that of point `index`; nothing is copied."""
        return replace(self, index=index if self.index is None else self.index[index])

    def rows(self) -> Int64[Tensor, " p"]:
        """Row of `bits` and `blocker` of each point."""
        return torch.arange(len(self.bits), device=self.bits.device) if self.index is None else self.index

    def unpacked(self) -> Bool[Tensor, "p D"]:
        """The bits as booleans."""
        shifts = torch.arange(WORD_BITS, dtype=torch.int32, device=self.bits.device)
        bits = self.bits if self.index is None else self.bits[self.index]
        return ((bits[..., None] >> shifts) & 1).flatten(1)[:, : len(self.directions)].bool()

    def fraction(self, normals: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        """Fraction of the directions above each point's horizon that are visible."""
        above = normals @ self.directions.T > 0
        return (above & self.unpacked()).sum(-1) / above.sum(-1).clamp(min=1).to(normals)


def unoccluded(directions: Float[Tensor, "D 3"], n_points: int) -> Visibility:
    """Visibility of points without any occlusion, not even by their own horizon."""
    words = -(-len(directions) // WORD_BITS)
    bits = torch.full((1, words), -1, dtype=torch.int32, device=directions.device)
    return Visibility(directions, bits, None, bits.new_zeros(n_points, dtype=torch.int64))


def visibility(
    tracer: Tracer,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "D 3"],
    *,
    blockers: bool = False,
) -> Visibility:
    """Trace the visibility of directions from surface points; not differentiable.

    Args:
        tracer: Tracer of the Gaussians.
        points: Points on the rendered surface, object frame [object radius].
        normals: Outward unit normals at the points.
        directions: Unit directions, object frame, shared by all points.
        blockers: Whether to store which Gaussian occludes a direction, for indirect light.
    """
    origins, normals = tracer.ray_origins(points, normals), normals.detach()
    bits = tracer.backend.visible(tracer.bvh, origins, normals, directions)
    if not blockers:
        return Visibility(directions, bits, None)
    return Visibility(directions, bits, tracer.backend.blockers(tracer.bvh, origins, normals, directions, bits))


@torch.no_grad()
def transfer(visibilities: Sequence[Visibility], normals: Float[Tensor, "p 3"]) -> Float[Tensor, "p 9"]:
    """Transfer vectors: `transfer @ coefficients` is the shadowed irradiance under light in harmonics up to degree 2.

    Precomputed radiance transfer (Sloan et al. 2002).

    Args:
        visibilities: Visibility of the points in several sets of directions, over which the result is averaged.
        normals: Outward unit normals of the points, object frame.
    """
    total = normals.new_zeros(len(normals), 9)
    for v in visibilities:
        visible_cosine = (normals @ v.directions.T).clamp(min=0) * v.unpacked()
        total += 4 * math.pi / len(v.directions) * (visible_cosine @ spherical_harmonics.basis(v.directions, 2))
    return total / len(visibilities)


@torch.no_grad()
def surface_points(
    gaussians: Gaussians, gamma: Float[Tensor, ""], poses: Iterable[SE3], camera: Camera, *, alpha_min: float = 0.5
) -> Float[Tensor, "n 3"]:
    """Point on the rendered surface for each Gaussian, object frame [object radius].

    The point is the mean of the rendered surface over all pixels in which the Gaussian is dominant
    (`Buffers.dominant`). If there is no such pixel, it is the projection of the Gaussian's centre, along the normal of
    the nearest Gaussian with such pixels, onto that Gaussian's tangent plane.

    Args:
        gaussians: Gaussians, object frame.
        gamma: Sharpness of the opacity [1 / object radius].
        poses: `T_cam_obj` of views that together show all sides.
        camera: Intrinsics of these views.
        alpha_min: Minimum coverage of a pixel that is used.
    """
    means, normals = gaussians.means, gaussians.normals
    total, count = torch.zeros_like(means), means.new_zeros(len(gaussians))
    for T_cam_obj in poses:
        buffers = rasterize(gaussians, gamma, T_cam_obj, camera, {})
        pixels = torch.where((buffers.alpha >= alpha_min) & (buffers.dominant >= 0))
        x_cam = camera.unproject(camera.pixel_centers()[pixels].to(means), buffers.depth[pixels])
        index = buffers.dominant[pixels].long()
        total.index_add_(0, index, T_cam_obj.inverse() @ x_cam)
        count.index_add_(0, index, torch.ones_like(x_cam[:, 0]))
    visible = count > 0
    points = torch.where(visible[:, None], total / count.clamp(min=1)[:, None], means)
    if not visible.any() or visible.all():
        return points
    near = nearest(means[~visible], points[visible])
    height = ((points[visible][near] - means[~visible]) * normals[visible][near]).sum(-1, keepdim=True)
    points[~visible] = means[~visible] + height * normals[visible][near]
    return points
