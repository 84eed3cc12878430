"""Final pictures: light by samples drawn where the surface scatters it and where it comes from.

Both kinds of samples are weighted by the balance heuristic, so that a mirror under a cloudy sky and chalk under the
sun converge alike. Every sample is a ray through the Gaussians; light that is blocked is replaced by what the blocking
Gaussians send on (`GlossyBounce`). Not differentiable.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from tumble.maths import equirect_from_direction, fibonacci_sphere, texel_directions, texel_solid_angles
from tumble.rendering import brdf
from tumble.rendering.prefiltered_light import Prefiltered
from tumble.rendering.shading import Bounce, Surface, specular
from tumble.rendering.trace import Tracer, trace
from tumble.scene import Environment

RAYS = 1 << 18
"""Rays at once: bounds memory to some 300 MB, changes nothing else."""
CELL_ROWS = 512
"""Rows of cells aimed at; a map of as many or more has twice as many: two million cells in all."""
BOUNCE_DIRECTIONS = 256
"""Of the light of what stands in the way, in harmonics to degree 2."""
HARMONIOUS = 1.2207440846057596
"""Root of x^4 = x + 1: the fractions of its powers fill the unit cube evenly."""


@dataclass(frozen=True)
class LightSampler:
    """Directions in proportion to the radiance that arrives from them.

    The density is constant on *cells*, four and more to a texel of maps of up to `CELL_ROWS` rows: it is nowhere zero
    where the bilinear map is not. The finer the cells, the less noise a bright texel leaves.
    """

    environment: Environment
    density: Float[Tensor, "cells_h cells_w"]
    """[1 / steradian], env frame."""
    cumulative: Float64[Tensor, " cells"]
    """Probability of this cell or one before it, row by row. In 64 bits: a bright sun shares a million cells."""

    def sample(self, u: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
        """Unit directions, env frame, from uniform numbers in [0, 1): `u[0]` picks the row, `u[1]` the place in it."""
        rows, columns = self.density.shape
        ends = self.cumulative[columns - 1 :: columns].contiguous()
        row, down, start, share = _place(ends, u[..., 0].double())
        cell, along, _, _ = _place(self.cumulative, start + u[..., 1] * share)
        # Rounding may end a row in the next.
        column = (cell - row * columns).clamp(0, columns - 1)
        # Even by area: down a cell, in the cosine of the polar angle.
        top, bottom = ((torch.pi / rows * (row + i)).cos() for i in (0, 1))
        cosine = top + (bottom - top) * down
        phi = 2 * torch.pi * ((column + along) / columns - 0.5)
        sine = (1 - cosine.square()).clamp(min=0).sqrt()
        return torch.stack([sine * phi.sin(), cosine, -sine * phi.cos()], -1).to(u)

    def pdf(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 1"]:
        """Density of `sample` [1 / steradian]."""
        rows, columns = self.density.shape
        u, v = equirect_from_direction(d_env).unbind(-1)
        row = (v * rows).long().clamp(0, rows - 1)
        column = (u * columns).long().clamp(0, columns - 1)
        return self.density[row, column][..., None]


def _place(
    ends: Float64[Tensor, " bins"], x: Float64[Tensor, "*b"]
) -> tuple[Int64[Tensor, "*b"], Float64[Tensor, "*b"], Float64[Tensor, "*b"], Float64[Tensor, "*b"]]:
    """The bin in which x lies, how far in it is from 0 to 1, and the bin's start and width."""
    bin_ = torch.searchsorted(ends, x.contiguous(), right=True).clamp(max=len(ends) - 1)
    start = torch.where(bin_ > 0, ends[(bin_ - 1).clamp(min=0)], 0.0)
    width = ends[bin_] - start
    return bin_, ((x - start) / width.clamp(min=1e-300)).clamp(0, 1), start, width


@torch.no_grad()
def light_sampler(environment: Environment) -> LightSampler:
    """A sampler of an environment, by the mean of its channels."""
    h, w, _ = environment.log_radiance.shape
    # Means of a map that is finer still: they, too, are nowhere zero where it is not.
    coarse = environment if h <= CELL_ROWS else environment.resampled(CELL_ROWS, w * CELL_ROWS // h)
    h, w, _ = coarse.log_radiance.shape
    h, w = (x * max(2, min(8, CELL_ROWS // h)) for x in (h, w))
    like = {"dtype": environment.log_radiance.dtype, "device": environment.log_radiance.device}
    brightness = coarse.lookup(texel_directions(h, w, **like)).mean(-1)
    power = brightness.double() * texel_solid_angles(h, w, dtype=torch.float64, device=like["device"])
    density = brightness / power.sum().to(brightness)
    return LightSampler(environment, density, power.flatten().cumsum(0) / power.sum())


@dataclass(frozen=True)
class GlossyBounce:
    """What Gaussians in the way send on: the diffuse lobe in their own shade, the other by the split sum."""

    diffuse: Bounce
    roughness: Float[Tensor, "n 1"]
    prefiltered: Prefiltered


@torch.no_grad()
def relight_surface(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    light: LightSampler,
    R_env_obj: Float[Tensor, "3 3"],
    tracer: Tracer,
    *,
    f0: float,
    generator: torch.Generator,
    n_brdf: int = 512,
    n_light: int = 512,
    bounce: GlossyBounce | None = None,
) -> Float[Tensor, "p 3"]:
    """Reflected radiance of points under a light (paper section 4.4); unbiased in direct light.

    Args:
        f0: Reflectance at normal incidence, of surface and bounce.
        generator: One draw per point shifts a fixed, even pattern of samples.
        n_brdf: Samples per point drawn like the surface scatters.
        n_light: Samples per point drawn like the light arrives.
        bounce: What stands in the way; black when None.
    """
    shift = torch.rand(len(surface.points), 1, 3, generator=generator, dtype=albedo.dtype, device=generator.device)
    diffuse = None if bounce is None else _diffuse(bounce, R_env_obj)
    chunk = max(1, RAYS // (n_brdf + n_light))
    parts = [albedo.new_zeros(0, 3)]
    for at in torch.arange(len(surface.points), device=albedo.device).split(chunk):
        normals, views, rough = surface.normals[at, None], surface.views[at, None], roughness[at, None]
        u = (_lattice(n_brdf + n_light).to(albedo) + shift[at.to(shift.device)].to(albedo)) % 1
        scattered = brdf.sample(u[:, :n_brdf], views, normals, roughness=rough)
        wi = torch.cat([scattered, light.sample(u[:, n_brdf:, 1:]) @ R_env_obj], 1)
        cosine = (wi * normals).sum(-1, keepdim=True).clamp(min=0)
        pdf_light = light.pdf(wi @ R_env_obj.mT)
        density = n_brdf * brdf.pdf(wi, views, normals, roughness=rough) + n_light * pdf_light
        value = brdf.evaluate(wi, views, normals, albedo=albedo[at, None], roughness=rough, f0=f0)
        weight = torch.where(density > 0, value * cosine / density, 0.0)
        origins = tracer.lifted(surface.points[at], surface.normals[at])[:, None].expand_as(wi)
        useful = cosine[..., 0] > 0
        arriving = torch.zeros_like(wi)
        arriving[useful] = _arriving(
            origins[useful], wi[useful], light.environment, R_env_obj, tracer, f0=f0, bounce=bounce, diffuse=diffuse
        )
        parts.append((weight * arriving).sum(1))
    return torch.cat(parts)


def _arriving(
    origins: Float[Tensor, "r 3"],
    wi: Float[Tensor, "r 3"],
    environment: Environment,
    R_env_obj: Float[Tensor, "3 3"],
    tracer: Tracer,
    *,
    f0: float,
    bounce: GlossyBounce | None,
    diffuse: Float[Tensor, "n 3"] | None,
) -> Float[Tensor, "r 3"]:
    """Radiance along rays: of the environment as far as it shows through, and of what is in front of it."""
    hits = trace(tracer, origins, wi, diffuse)
    arriving = hits.transmittance[:, None] * environment.lookup(wi @ R_env_obj.mT) + hits.radiance
    if bounce is None:
        return arriving
    met = torch.where(hits.hit >= 0)[0]
    which = hits.hit[met].long()
    normals = tracer.gaussians.normals[which]
    shine = specular(normals, -wi[met], bounce.roughness[which], bounce.prefiltered, R_env_obj, f0)
    return arriving.index_add(0, met, (1 - hits.transmittance[met])[:, None] * shine)


def _diffuse(bounce: GlossyBounce, R_env_obj: Float[Tensor, "3 3"]) -> Float[Tensor, "n 3"]:
    """Diffuse radiance of every Gaussian."""
    directions = fibonacci_sphere(BOUNCE_DIRECTIONS).to(R_env_obj)
    return bounce.diffuse.radiance(directions, bounce.prefiltered.cells(directions @ R_env_obj.mT))


def _lattice(n: int) -> Float64[Tensor, "n 3"]:
    """An even pattern in the unit cube."""
    steps = torch.tensor([HARMONIOUS**-1, HARMONIOUS**-2, HARMONIOUS**-3], dtype=torch.float64)
    return torch.arange(n, dtype=torch.float64)[:, None] * steps % 1
