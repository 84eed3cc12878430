"""Deferred shading: what a camera sees of the surface, lit by the environment of one frame.

Everything happens in the object frame, under one set of directions for the whole view: the light of a frame is
`environment.lookup(R_env_obj @ w)`, one lookup per direction and frame. *Surface*: the points behind some pixels.
*Bounce*: light that Gaussians standing in the way send on, of the same frame, since light and object turn apart.

Two estimators for training. `shade` sums both lobes over the shared directions: unbiased, but a few hundred cannot
resolve a narrow lobe. `shade_split` sums the diffuse lobe and a wide specular one, and takes a narrow one (`NARROW`)
from a prefiltered light. On a sphere under real light, 256 directions, the first errs by 1.6 to 3.9 at roughness 0.1,
by 0.4 to 1.5 at 0.2 and by 0.01 to 0.24 from 0.5 up; the second, which sees the light of whole cells, by 0.01 to 0.11
everywhere (`benchmarks`). Training takes the second. `importance.relight_surface` is for final pictures.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor
from torch.nn.functional import normalize

from tumble import backends
from tumble.maths import SE3, reflect, spherical_harmonics
from tumble.rendering import brdf
from tumble.rendering.prefiltered_light import Prefiltered
from tumble.rendering.rasterizer import Buffers
from tumble.rendering.trace import Visibility
from tumble.scene import Camera, Environment

NARROW = (0.3, 0.45)
"""Roughness up to which a few hundred directions cannot resolve the specular lobe, and from which they can."""


@dataclass(frozen=True)
class Surface:
    """Points that a camera sees, object frame."""

    pixels: Int64[Tensor, " p"]
    """Which pixels, counted row by row."""
    points: Float[Tensor, "p 3"]
    """[object radius]"""
    normals: Float[Tensor, "p 3"]
    """Outward, unit."""
    views: Float[Tensor, "p 3"]
    """Unit directions to the camera."""

    def sample(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "p c"]:
        """An image of the same view at the points."""
        return image.flatten(0, 1)[self.pixels]

    def paint(self, values: Float[Tensor, "p c"], height: int, width: int) -> Float[Tensor, "{height} {width} c"]:
        """An image with values at the points, 0 elsewhere."""
        empty = values.new_zeros(height * width, values.shape[1])
        return empty.index_copy(0, self.pixels, values).unflatten(0, (height, width))


def surface(
    buffers: Buffers,
    T_cam_obj: SE3,
    camera: Camera,
    *,
    alpha_min: float = 0.5,
    pixels: Int64[Tensor, " p"] | None = None,
) -> Surface:
    """The points behind pixels, at their mean depth; differentiable in buffers and pose.

    To shade detail of the normal (`Material.normal_offset`), add its image to `Buffers.normal` beforehand.

    Args:
        alpha_min: Coverage from which a pixel counts as surface: at a depth edge the mean depth is in mid-air.
        pixels: Only these, counted row by row, each with a coverage above zero; all with `alpha_min` when None.
    """
    if pixels is None:
        pixels = torch.where(buffers.alpha.flatten() >= alpha_min)[0]
    column, row = pixels % camera.width, pixels // camera.width
    uv = torch.stack([column, row], -1).to(buffers.depth) + 0.5
    ray_cam = camera.unproject(uv, torch.ones_like(uv[:, 0])).to(buffers.depth)
    T_obj_cam = T_cam_obj.inverse()
    points = T_obj_cam @ (buffers.depth.flatten()[pixels][:, None] * ray_cam)
    normals = normalize(buffers.normal.flatten(0, 1)[pixels], dim=-1)
    return Surface(pixels, points, normals, normalize(T_obj_cam.rotation @ -ray_cam, dim=-1))


@dataclass(frozen=True)
class Bounce:
    """Diffuse light from whatever stands in the way, itself in its own shade."""

    albedo: Float[Tensor, "n 3"]
    """Linear base colour of every Gaussian."""
    transfer: Float[Tensor, "n 9"]
    """What every Gaussian sees of the light: `trace.transfer`."""

    def radiance(self, directions: Float[Tensor, "D 3"], light: Float[Tensor, "D 3"]) -> Float[Tensor, "n 3"]:
        """Radiance of every Gaussian under light from directions of equal area.

        Irradiance is that of harmonics to degree 2, within 1 % of the integral for most lights (Ramamoorthi and
        Hanrahan 2001). What a Gaussian does not see of the sky is taken to be as bright as itself, which sums all
        bounces (Jimenez et al. 2016): in grooves one bounce alone is too dark, and an open sky too bright.
        """
        coefficients = 4 * math.pi / len(directions) * (spherical_harmonics.basis(directions, 2).mT @ light)
        return self.albedo / math.pi * self_shadowed_irradiance(self.transfer, coefficients, self.albedo)


def self_shadowed_irradiance(
    transfer: Float[Tensor, "n 9"], coefficients: Float[Tensor, "9 3"], albedo: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Irradiance of surfaces under light in harmonics to degree 2, with all bounces between them: `Bounce.radiance`."""
    # Under a single lamp the truncated series dips below zero on the far side.
    irradiance = (transfer @ coefficients).clamp(min=0)
    sky = (transfer[:, :1] * math.sqrt(4 / math.pi)).clamp(0, 1)
    return irradiance / (1 - albedo * (1 - sky)).clamp(min=1e-3)


@dataclass(frozen=True)
class AveragedBounce:
    """The paper's indirect light: what stands in the way sends on its mean colour over all frames."""

    colour: Float[Tensor, "n 3"]
    """Linear radiance of every Gaussian."""

    def radiance(self, directions: Float[Tensor, "D 3"], light: Float[Tensor, "D 3"]) -> Float[Tensor, "n 3"]:
        """The same under every light."""
        return self.colour


def shade(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    environment: Environment,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    f0: float,
    bounce: Bounce | AveragedBounce | None = None,
) -> Float[Tensor, "p 3"]:
    """Reflected radiance (eq. 3), both lobes summed over the visibility's directions.

    Differentiable in everything but directions and visibility. Unbiased if the directions are rotated at random.

    Args:
        visibility: What the points see; `trace.unoccluded` for everything.
        f0: Reflectance at normal incidence.
        bounce: What stands in the way, where the visibility keeps blockers; black when None.
    """
    light = environment.lookup(visibility.directions @ R_env_obj.mT)
    return _sum(surface.normals, albedo, roughness, surface.views, visibility, light, bounce, f0)


def diffuse(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    environment: Environment,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    bounce: Bounce | AveragedBounce | None = None,
) -> Float[Tensor, "p 3"]:
    """The diffuse lobe of `shade` alone."""
    light = environment.lookup(visibility.directions @ R_env_obj.mT)
    return _diffuse(surface, albedo, visibility, light, bounce)


def shade_split(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    prefiltered: Prefiltered,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    f0: float | Float[Tensor, "*c"],
    bounce: Bounce | AveragedBounce | None = None,
) -> Float[Tensor, "p 3"]:
    """Reflected radiance, the diffuse lobe summed over the directions, the specular one too where it is wide.

    A narrow lobe (`NARROW`), which the directions cannot resolve, is found by the split sum, its mirrored light dimmed
    by the share of the lobe that is visible. The split sum alone sends back 1.6 times too much at grazing angles, where
    the horizon cuts the lobe (test_a_wide_lobe_is_that_of_the_path_tracer). Arguments as for `shade`.
    """
    light = prefiltered.cells(visibility.directions @ R_env_obj.mT)
    narrow = specular(surface.normals, surface.views, roughness, prefiltered, R_env_obj, f0)
    narrow = lobe_visibility(surface, roughness, visibility) * narrow
    black = torch.zeros_like(albedo)
    # The kernel's lobe is linear in f0, which may be learnt.
    wide = f0 * _sum(surface.normals, black, roughness, surface.views, visibility, light, bounce, 1.0)
    share = ((roughness - NARROW[0]) / (NARROW[1] - NARROW[0])).clamp(0, 1)
    return _diffuse(surface, albedo, visibility, light, bounce) + torch.lerp(narrow, wide, share)


def specular(
    normals: Float[Tensor, "p 3"],
    views: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    prefiltered: Prefiltered,
    R_env_obj: Float[Tensor, "3 3"],
    f0: float | Float[Tensor, "*c"],
) -> Float[Tensor, "p 3"]:
    """The specular lobe by the split sum, nothing in the way; unit normals and directions to the eye, object frame."""
    nov = (normals * views).sum(-1, keepdim=True).clamp(0, 1)
    share = f0 * brdf.split_sum(_table(nov.dtype, nov.device), nov, roughness)
    return prefiltered.lookup(reflect(views, normals) @ R_env_obj.mT, roughness) * share


@torch.no_grad()
def lobe_visibility(surface: Surface, roughness: Float[Tensor, "p 1"], visibility: Visibility) -> Float[Tensor, "p 1"]:
    """Visible share of the specular lobe above the horizon; not differentiable.

    Directions are weighted as `prefilter` does, by a lobe no narrower than they lie apart. On a torus it errs by 0.02
    to 0.07, where the one nearest bit errs by 0.10 to 0.18 and the visible share of the sky by 0.05 to 0.19.
    """
    cosine = reflect(surface.views, surface.normals) @ visibility.directions.T
    # GGX falls to a quarter 2 a from its peak; neighbours lie sqrt(4 pi / D) apart.
    a = roughness.square().clamp(min=math.sqrt(math.pi / len(visibility.directions)) / 2)
    t = 0.5 * (1 - cosine) + a * a * 0.5 * (1 + cosine)
    above = surface.normals @ visibility.directions.T > 0
    weight = torch.where(above, cosine.clamp(min=0), 0.0) / t.square()
    total = weight.sum(-1, keepdim=True)
    return (weight * visibility.unpacked()).sum(-1, keepdim=True) / total.clamp(min=torch.finfo(total.dtype).tiny)


@cache
def _table(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "size size"]:
    return brdf.split_sum_table().to(device, dtype)


def _diffuse(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    visibility: Visibility,
    light: Float[Tensor, "D 3"],
    bounce: Bounce | AveragedBounce | None,
) -> Float[Tensor, "p 3"]:
    # An eye behind the surface sees no highlight.
    behind, unused = -surface.normals.detach(), torch.ones_like(albedo[:, :1])
    return _sum(surface.normals, albedo, unused, behind, visibility, light, bounce, 0.0)


def _sum(
    normals: Float[Tensor, "p 3"],
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    views: Float[Tensor, "p 3"],
    visibility: Visibility,
    light: Float[Tensor, "D 3"],
    bounce: Bounce | AveragedBounce | None,
    f0: float,
) -> Float[Tensor, "p 3"]:
    """Both lobes through the backend's kernel."""
    blocker, sent = _in_the_way(visibility, light, bounce)
    backend = backends.choose(normals.device, normals.dtype)
    directions, bits = visibility.directions, visibility.bits
    return backend.shade(normals, albedo, roughness[:, 0], views, directions, light, bits, blocker, sent, f0)


def _in_the_way(
    visibility: Visibility, light: Float[Tensor, "D 3"], bounce: Bounce | AveragedBounce | None
) -> tuple[Int32[Tensor, "#p #D"], Float[Tensor, "n 3"]]:
    """What stands in each direction, and the radiance that it sends on."""
    if bounce is None or visibility.blocker is None:
        return torch.full((1, 1), -1, dtype=torch.int32, device=light.device), light.new_zeros(0, 3)
    return visibility.blocker, bounce.radiance(visibility.directions, light)
