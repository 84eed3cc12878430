"""Monte Carlo shading of final images by multiple importance sampling of BRDF and light; not differentiable.

Samples of both kinds are combined by the balance heuristic (Veach and Guibas 1995), so that narrow lobes under a
uniform light and diffuse surfaces under a small light converge equally well. Every sample is a ray traced through the
Gaussians; occluded light is replaced by the radiance of the occluding Gaussians (`GlossyBounce`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from tumble import backends
from tumble.maths import equirect_from_direction, fibonacci_sphere, texel_directions, texel_solid_angles
from tumble.rendering import brdf
from tumble.rendering.prefiltered_light import Prefiltered
from tumble.rendering.shading import Bounce, Surface, specular
from tumble.rendering.trace import Tracer, trace
from tumble.scene import Environment

MAX_RAYS = 1 << 18
"""Maximum number of rays traced at once; limits memory to some 300 MB and does not affect the result."""
CELL_ROWS = 512
"""Target number of rows of a light sampler's cells; maps with as many rows or more get twice as many, which is two
million cells in all."""
BOUNCE_DIRECTIONS = 256
"""Directions in which the light is sampled for the diffuse indirect radiance."""
GOLDEN_RATIO_3D = 1.2207440846057596
"""Root of x^4 = x + 1; the fractional parts of multiples of its negative powers fill the unit cube evenly."""


@dataclass(frozen=True)
class LightSampler:
    """Sampler of directions with a density proportional to an environment's radiance.

    The density is constant on *cells*, at least four per texel of maps of up to `CELL_ROWS` rows. It is nonzero
    wherever the bilinear map is nonzero. Finer cells reduce the noise that bright texels cause.
    """

    environment: Environment
    """The light that is sampled."""
    density: Float[Tensor, "cells_h cells_w"]
    """Density of each cell [1 / steradian], env frame."""
    cumulative: Float64[Tensor, " cells"]
    """Cumulative probability of the cells, row by row; in 64 bits, because of the dynamic range over a million
    cells."""

    def sample(self, u: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
        """Unit directions, env frame, from uniform numbers in [0, 1): `u[0]` chooses the row, `u[1]` the column."""
        rows, columns = self.density.shape
        ends = self.cumulative[columns - 1 :: columns].contiguous()
        row, down, start, probability = _locate(ends, u[..., 0].double())
        cell, along, _, _ = _locate(self.cumulative, start + u[..., 1] * probability)
        # Rounding may give a cell of the next row.
        column = (cell - row * columns).clamp(0, columns - 1)
        # Uniform in solid angle: within a cell, uniform in the cosine of the polar angle.
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


def _locate(
    ends: Float64[Tensor, " bins"], x: Float64[Tensor, "*b"]
) -> tuple[Int64[Tensor, "*b"], Float64[Tensor, "*b"], Float64[Tensor, "*b"], Float64[Tensor, "*b"]]:
    """Index of the bin that contains x, relative position of x in it (0 to 1), and start and width of the bin."""
    # Nearly ascending numbers find their places in half the time, and 16-bit integers are sorted almost for free.
    values = x.flatten()
    order = (values * torch.iinfo(torch.int16).max).short().argsort()
    bin_ = torch.empty_like(order).index_copy_(0, order, torch.searchsorted(ends, values[order], right=True))
    bin_ = bin_.reshape(x.shape).clamp(max=len(ends) - 1)
    start = torch.where(bin_ > 0, ends[(bin_ - 1).clamp(min=0)], 0.0)
    width = ends[bin_] - start
    return bin_, ((x - start) / width.clamp(min=1e-300)).clamp(0, 1), start, width


@torch.no_grad()
def light_sampler(environment: Environment) -> LightSampler:
    """Build the sampler of an environment, with a density proportional to the mean of the colour channels."""
    h, w, _ = environment.log_radiance.shape
    # Averages of a finer map are also nonzero wherever the map is nonzero.
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
    """Indirect light of relighting: shadowed diffuse radiance, and the specular lobe by the split sum."""

    diffuse: Bounce
    """Diffuse radiance of the Gaussians."""
    roughness: Float[Tensor, "n 1"]
    """Perceptual roughness of the Gaussians."""
    prefiltered: Prefiltered
    """The light, prefiltered for the specular lobes."""


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
    """Reflected radiance of points under a light (paper section 4.4); unbiased for direct light.

    Args:
        surface: Surface points.
        albedo: Linear albedo of the points.
        roughness: Perceptual roughness of the points.
        light: Sampler of the light.
        R_env_obj: Rotation from the object frame to the env frame.
        tracer: Tracer of the Gaussians, for visibility.
        f0: Reflectance at normal incidence, of points and indirect light.
        generator: Random numbers, which shift a fixed low-discrepancy pattern of samples for each point.
        n_brdf: Samples per point by importance sampling of the BRDF.
        n_light: Samples per point by importance sampling of the light.
        bounce: Indirect light; occluded directions are black when None.
    """
    shift = torch.rand(len(surface.points), 1, 3, generator=generator, dtype=albedo.dtype, device=generator.device)
    diffuse, radiance = None if bounce is None else _diffuse(bounce, R_env_obj), light.environment.radiance
    backend = backends.choose(albedo.device, albedo.dtype)
    chunk = max(1, MAX_RAYS // (n_brdf + n_light))
    parts = [albedo.new_zeros(0, 3)]
    for at in torch.arange(len(surface.points), device=albedo.device).split(chunk):
        normals, views, rough = surface.normals[at, None], surface.views[at, None], roughness[at, None]
        u = (_lattice(n_brdf + n_light).to(albedo) + shift[at.to(shift.device)].to(albedo)) % 1
        scattered = brdf.sample(u[:, :n_brdf], views, normals, roughness=rough)
        directions = torch.cat([scattered, light.sample(u[:, n_brdf:, 1:]) @ R_env_obj], 1)
        # All that follows is for the directions above the horizon, in one list for all points.
        above = torch.where((directions @ normals.mT).flatten() > 0)[0]
        index, wi = at[above // (n_brdf + n_light)], directions.flatten(0, 1).index_select(0, above)
        normals, views, rough = (x.index_select(0, index) for x in (surface.normals, surface.views, roughness))
        wi_env = wi @ R_env_obj.mT
        density = n_brdf * brdf.pdf(wi, views, normals, roughness=rough) + n_light * light.pdf(wi_env)
        value = brdf.evaluate(wi, views, normals, albedo=albedo.index_select(0, index), roughness=rough, f0=f0)
        weight = torch.where(density > 0, value * brdf.cosine(wi, normals) / density, 0.0)
        origins = tracer.ray_origins(surface.points, surface.normals).index_select(0, index)
        environment = backend.lookup(radiance[None], wi_env, torch.zeros_like(wi_env[:, 0]))
        arriving = _arriving_radiance(
            origins, wi, environment, R_env_obj, tracer, f0=f0, bounce=bounce, diffuse=diffuse
        )
        reflected = torch.zeros_like(directions).flatten(0, 1).index_copy_(0, above, weight * arriving)
        parts.append(reflected.view_as(directions).sum(1))
    return torch.cat(parts)


def _arriving_radiance(
    origins: Float[Tensor, "r 3"],
    wi: Float[Tensor, "r 3"],
    environment: Float[Tensor, "r 3"],
    R_env_obj: Float[Tensor, "3 3"],
    tracer: Tracer,
    *,
    f0: float,
    bounce: GlossyBounce | None,
    diffuse: Float[Tensor, "n 3"] | None,
) -> Float[Tensor, "r 3"]:
    """Incident radiance along rays: the environment's times the transmittance, plus that of occluding Gaussians."""
    hits = trace(tracer, origins, wi, diffuse)
    arriving = hits.transmittance[:, None] * environment + hits.radiance
    if bounce is None:
        return arriving
    occluded = torch.where(hits.hit >= 0)[0]
    index = hits.hit[occluded].long()
    normals = tracer.gaussians.normals[index]
    glossy = specular(normals, -wi[occluded], bounce.roughness[index], bounce.prefiltered, R_env_obj, f0)
    return arriving.index_add(0, occluded, (1 - hits.transmittance[occluded])[:, None] * glossy)


def _diffuse(bounce: GlossyBounce, R_env_obj: Float[Tensor, "3 3"]) -> Float[Tensor, "n 3"]:
    """Diffuse radiance of every Gaussian under the light of one frame."""
    directions = fibonacci_sphere(BOUNCE_DIRECTIONS).to(R_env_obj)
    return bounce.diffuse.radiance(directions, bounce.prefiltered.cell_radiance(directions @ R_env_obj.mT))


def _lattice(n: int) -> Float64[Tensor, "n 3"]:
    """Kronecker sequence, a low-discrepancy sequence in the unit cube: multiples of irrational numbers modulo 1."""
    steps = torch.tensor([GOLDEN_RATIO_3D**-1, GOLDEN_RATIO_3D**-2, GOLDEN_RATIO_3D**-3], dtype=torch.float64)
    return torch.arange(n, dtype=torch.float64)[:, None] * steps % 1
