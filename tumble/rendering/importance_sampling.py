"""Monte Carlo shading of final images by multiple importance sampling of BRDF and light; not differentiable.

Samples of both kinds are combined by the balance heuristic (Veach and Guibas 1995), so that narrow lobes under a
uniform light and diffuse surfaces under a small light converge equally well. Every sample is a ray traced through the
Gaussians; occluded light is replaced by the radiance of the occluding Gaussians (`GlossyBounce`).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import interpolate

from tumble import backends
from tumble.backends import GlossyGaussians, LightTables, SurfaceSamples
from tumble.maths import equirect_from_direction, fibonacci_sphere, texel_solid_angles
from tumble.rendering import brdf
from tumble.rendering.prefiltered_light import Prefiltered
from tumble.rendering.shading import Bounce, Surface, reflectance_table, specular
from tumble.rendering.trace import Tracer, trace
from tumble.scene import Environment

MAX_RAYS = 1 << 18
"""Maximum number of rays traced at once; limits memory to some 300 MB and does not affect the result."""
MAX_RAYS_ON_GPU = 1 << 21
"""The same on a GPU, 2.4 GB: it is as long busy with the longest of a few hundred thousand rays as with all of them."""
CELL_ROWS = 512
"""Target number of rows of a light sampler's cells; maps with as many rows or more get twice as many, which is two
million cells in all."""
ROW_BUCKETS, COLUMN_BUCKETS = 1024, 256
"""Numbers of intervals of the guides to the rows of cells and to the cells of a row (`LightTables`); powers of two."""
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

    @cached_property
    def tables(self) -> LightTables:
        """Light and tables for the kernel."""
        rows, columns = self.density.shape
        like = {"dtype": torch.float64, "device": self.cumulative.device}
        ends = self.cumulative[columns - 1 :: columns].contiguous()
        starts = torch.cat([ends.new_zeros(1), ends[:-1]])
        row_guide = torch.searchsorted(ends, torch.arange(ROW_BUCKETS + 1, **like) / ROW_BUCKETS, right=True)
        along = torch.arange(COLUMN_BUCKETS + 1, **like) / COLUMN_BUCKETS
        values = starts[:, None] + along * (ends - starts)[:, None]
        column_guide = torch.searchsorted(self.cumulative, values, right=True)
        cosines = (math.pi / rows * torch.arange(rows + 1, **like)).cos()
        guides = row_guide.int(), column_guide.int()
        return LightTables(self.environment.radiance, self.density, self.cumulative, cosines, *guides)

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
    brightness = _enlarged(coarse.radiance.mean(-1), max(2, min(8, CELL_ROWS // coarse.radiance.shape[0])))
    area = texel_solid_angles(*brightness.shape, dtype=torch.float64, device=brightness.device)
    power = brightness.double() * area
    density = brightness / power.sum().to(brightness)
    return LightSampler(environment, density, power.flatten().cumsum(0) / power.sum())


def _enlarged(texels: Float[Tensor, "h w"], factor: int) -> Float[Tensor, "{factor}*h {factor}*w"]:
    """Bilinear lookups in an equirectangular map (`scene.bilinear`) at the texel centres of a finer one."""
    # The neighbour of a row across a pole is that row, half a revolution away.
    above, below = (row.roll(texels.shape[1] // 2, 1) for row in (texels[:1], texels[-1:]))
    padded = torch.cat([above, texels, below])
    padded = torch.cat([padded[:, -1:], padded, padded[:, :1]], 1)
    finer = interpolate(padded[None, None], scale_factor=factor, mode="bilinear", align_corners=False)[0, 0]
    return finer[factor:-factor, factor:-factor]


@dataclass(frozen=True)
class GlossyBounce:
    """Indirect light of relighting: shadowed diffuse radiance, and the specular lobe by the split sum."""

    diffuse: Bounce
    """Diffuse radiance of the Gaussians."""
    roughness: Float[Tensor, "n 1"]
    """Perceptual roughness of the Gaussians."""
    prefiltered: Prefiltered
    """The light, prefiltered for the specular lobes."""
    metal: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 1"]] | None = None
    """Linear base colour and metalness of the Gaussians; None for an object without metal."""


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
    metalness: Float[Tensor, "p 1"] | None = None,
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
        metalness: Metalness of the points; None for an object without metal. The kernel is not used for metals.
    """
    shift = torch.rand(len(surface.points), 3, generator=generator, dtype=albedo.dtype, device=generator.device)
    lattice = _lattice(n_brdf + n_light).to(albedo)
    origins = tracer.ray_origins(surface.points, surface.normals)
    samples = SurfaceSamples(
        origins, surface.normals, surface.views, albedo, roughness, shift.to(albedo.device), lattice
    )
    gaussians = None if bounce is None else _glossy_gaussians(bounce, tracer, R_env_obj)
    kernel = backends.relight_kernel(tracer.backend)
    if kernel is not None and metalness is None:
        return kernel(tracer.bvh, samples, light.tables, gaussians, R_env_obj, n_brdf, f0)
    return relight_by_operations(samples, light, R_env_obj, tracer, n_brdf, f0, bounce, gaussians, metalness)


def relight_by_operations(
    samples: SurfaceSamples,
    light: LightSampler,
    R_env_obj: Float[Tensor, "3 3"],
    tracer: Tracer,
    n_brdf: int,
    f0: float,
    bounce: GlossyBounce | None,
    gaussians: GlossyGaussians | None,
    metalness: Float[Tensor, "p 1"] | None = None,
) -> Float[Tensor, "p 3"]:
    """The definition of `RelightKernel` by operations of torch, for every device, and relighting of metals."""
    n_light, radiance = len(samples.lattice) - n_brdf, light.environment.radiance
    backend = backends.choose(radiance.device, radiance.dtype)
    chunk = max(1, (MAX_RAYS_ON_GPU if radiance.is_cuda else MAX_RAYS) // (n_brdf + n_light))
    parts = [samples.albedo.new_zeros(0, 3)]
    for at in torch.arange(len(samples.origins), device=radiance.device).split(chunk):
        normals, views, rough = samples.normals[at, None], samples.views[at, None], samples.roughness[at, None]
        u = (samples.lattice + samples.shift[at, None]) % 1
        scattered = brdf.sample(u[:, :n_brdf], views, normals, roughness=rough)
        directions = torch.cat([scattered, light.sample(u[:, n_brdf:, 1:]) @ R_env_obj], 1)
        # All that follows is for the directions above the horizon, in one list for all points.
        above = torch.where((directions @ normals.mT).flatten() > 0)[0]
        index, wi = at[above // (n_brdf + n_light)], directions.flatten(0, 1).index_select(0, above)
        normals, views, rough = (x.index_select(0, index) for x in (samples.normals, samples.views, samples.roughness))
        wi_env = wi @ R_env_obj.mT
        density = n_brdf * brdf.pdf(wi, views, normals, roughness=rough) + n_light * light.pdf(wi_env)
        albedo = samples.albedo.index_select(0, index)
        metal = None if metalness is None else metalness.index_select(0, index)
        value = brdf.evaluate(wi, views, normals, albedo=albedo, roughness=rough, f0=f0, metalness=metal)
        weight = torch.where(density > 0, value * brdf.cosine(wi, normals) / density, 0.0)
        origins = samples.origins.index_select(0, index)
        environment = backend.lookup(radiance[None], wi_env, torch.zeros_like(wi_env[:, 0]))
        arriving = _arriving_radiance(origins, wi, environment, R_env_obj, tracer, f0, bounce, gaussians)
        reflected = torch.zeros_like(directions).flatten(0, 1).index_copy_(0, above, weight * arriving)
        parts.append(reflected.view_as(directions).sum(1))
    return torch.cat(parts)


def _arriving_radiance(
    origins: Float[Tensor, "r 3"],
    wi: Float[Tensor, "r 3"],
    environment: Float[Tensor, "r 3"],
    R_env_obj: Float[Tensor, "3 3"],
    tracer: Tracer,
    f0: float,
    bounce: GlossyBounce | None,
    gaussians: GlossyGaussians | None,
) -> Float[Tensor, "r 3"]:
    """Incident radiance along rays: the environment's times the transmittance, plus that of occluding Gaussians."""
    hits = trace(tracer, origins, wi, None if gaussians is None else gaussians.radiance)
    arriving = hits.transmittance[:, None] * environment + hits.radiance
    if bounce is None or gaussians is None:
        return arriving
    occluded = torch.where(hits.hit >= 0)[0]
    index = hits.hit[occluded].long()
    normals, roughness = gaussians.normals[index], gaussians.roughness[index]
    albedo, metalness = (None, None) if bounce.metal is None else (x[index] for x in bounce.metal)
    seen = (normals, -wi[occluded], roughness, bounce.prefiltered, R_env_obj)
    glossy = specular(*seen, f0, albedo=albedo, metalness=metalness)
    return arriving.index_add(0, occluded, (1 - hits.transmittance[occluded])[:, None] * glossy)


def _glossy_gaussians(bounce: GlossyBounce, tracer: Tracer, R_env_obj: Float[Tensor, "3 3"]) -> GlossyGaussians:
    """Occluding Gaussians under the light of one frame."""
    directions = fibonacci_sphere(BOUNCE_DIRECTIONS).to(R_env_obj)
    radiance = bounce.diffuse.radiance(directions, bounce.prefiltered.cell_radiance(directions @ R_env_obj.mT))
    table = reflectance_table(radiance.dtype, radiance.device)
    return GlossyGaussians(radiance, tracer.gaussians.normals, bounce.roughness, bounce.prefiltered.stack, table)


def _lattice(n: int) -> Float64[Tensor, "n 3"]:
    """Kronecker sequence, a low-discrepancy sequence in the unit cube: multiples of irrational numbers modulo 1."""
    steps = torch.tensor([GOLDEN_RATIO_3D**-1, GOLDEN_RATIO_3D**-2, GOLDEN_RATIO_3D**-3], dtype=torch.float64)
    return torch.arange(n, dtype=torch.float64)[:, None] * steps % 1
