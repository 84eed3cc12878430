"""Importance sampling: samples against their density, and shading against quadrature."""

import math

import pytest
import torch
from torch import Tensor

from tests.rendering.test_shading import CAMERA, F0, grey, lamp, rms, transfer_vectors, uniform, visible_sphere
from tests.surfaces import GAMMA, look_at, sphere, torus
from tumble import backends
from tumble.maths.directions import fibonacci_sphere, random_rotation, texel_directions, texel_solid_angles
from tumble.rendering import importance_sampling, shading
from tumble.rendering.prefiltered_light import prefilter
from tumble.rendering.rasterizer import rasterize
from tumble.rendering.shading import Bounce
from tumble.rendering.trace import build_tracer, unoccluded
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians

EMPTY = Gaussians(*(x[:0] for x in vars(sphere(1)).values()))


def one_texel() -> Environment:
    radiance = torch.zeros(16, 32, 3)
    radiance[5, 20] = 500.0
    return Environment.from_radiance(radiance)


def quadrature(surface: shading.Surface, roughness: float, environment: Environment, R_env_obj: Tensor) -> Tensor:
    """Both lobes, integrated over 2^17 evenly distributed directions, without occlusion."""
    total, n = torch.zeros_like(surface.points), 1 << 17
    for directions in fibonacci_sphere(n).split(1 << 14):
        unshadowed = unoccluded(directions, len(surface.pixels))
        part = shading.shade(surface, *grey(surface, 0.5, roughness), environment, R_env_obj, unshadowed, f0=F0)
        total += len(directions) / n * part
    return total


def relit(
    surface: shading.Surface, roughness: float, environment: Environment, R: Tensor, n: int, seed: int = 0
) -> Tensor:
    light, generator = importance_sampling.light_sampler(environment), torch.Generator().manual_seed(seed)
    counts = {"n_brdf": n, "n_light": n}
    material = grey(surface, 0.5, roughness)
    return importance_sampling.relight_surface(
        surface, *material, light, R, build_tracer(EMPTY, GAMMA), f0=F0, generator=generator, **counts
    )


@pytest.mark.parametrize("environment", [one_texel(), lamp([0.1, 0.9, -0.3]), uniform()])
def test_the_density_integrates_to_one_and_is_that_of_the_samples(environment: Environment) -> None:
    sampler = importance_sampling.light_sampler(environment)
    area = texel_solid_angles(*sampler.density.shape)
    assert math.isclose((sampler.density * area).sum().item(), 1, rel_tol=1e-4)
    u = torch.rand(1 << 16, 2, generator=torch.Generator().manual_seed(0))
    d = sampler.sample(u)
    # Means of smooth functions, by samples and by the density: 65536 samples leave 0.4 % of the unit vectors.
    for axis in range(3):
        by_cell = fibonacci_sphere(1 << 18)
        expected = 4 * math.pi * (sampler.pdf(by_cell)[:, 0] * by_cell[:, axis]).mean()
        assert abs(d[:, axis].mean() - expected) < 0.012


def test_a_fine_map_is_sampled_by_averages_of_its_texels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells cover a bright texel of a map that is four times as fine as the cells may be."""
    monkeypatch.setattr(importance_sampling, "CELL_ROWS", 32)
    radiance = torch.zeros(128, 256, 3)
    radiance[41, 55] = 1e6
    sampler = importance_sampling.light_sampler(Environment.from_radiance(radiance))
    assert sampler.density.shape == (64, 128)
    d = sampler.sample(torch.rand(1 << 14, 2, generator=torch.Generator().manual_seed(0)))
    integral = sampler.environment.integral()
    # The texel covers a thirtieth of the sampled cells: 16384 samples leave an error of 5 %.
    torch.testing.assert_close((sampler.environment.lookup(d) / sampler.pdf(d)).mean(0), integral, rtol=0.1, atol=0)


@pytest.mark.parametrize("rows", [1, 6])
def test_the_density_is_that_of_lookups_in_the_map(rows: int) -> None:
    """Across the seam and the poles too; of a map of one row, all rows of cells lie beside a pole."""
    environment = Environment.from_radiance(torch.rand(rows, 2 * rows, 3, generator=torch.Generator().manual_seed(0)))
    density = importance_sampling.light_sampler(environment).density
    expected = environment.lookup(texel_directions(*density.shape)).mean(-1)
    torch.testing.assert_close(density / density.mean(), expected / expected.mean(), rtol=1e-4, atol=0)


def test_few_and_many_numbers_find_the_same_bins() -> None:
    """Fewer numbers than bins are sorted first."""
    generator = torch.Generator().manual_seed(0)
    ends, x = torch.rand(1000, generator=generator).double().cumsum(0), torch.rand(4, 500, generator=generator).double()
    ends = ends / ends[-1]
    many = importance_sampling._locate(ends, x)
    few = importance_sampling._locate(ends, x[:, :20])
    assert all(torch.equal(a[:, :20], b) for a, b in zip(many, few, strict=True))


def test_samples_of_a_light_estimate_its_integral() -> None:
    environment = lamp([0.1, 0.9, -0.3])
    sampler = importance_sampling.light_sampler(environment)
    d = sampler.sample(torch.rand(1 << 14, 2, generator=torch.Generator().manual_seed(0)))
    # Radiance over density varies by 5 % within cells, so the mean of 16384 samples has an error of 0.1 %.
    torch.testing.assert_close(
        (environment.lookup(d) / sampler.pdf(d)).mean(0), environment.integral(), rtol=2e-3, atol=0
    )


@pytest.mark.parametrize("roughness", [0.3, 0.8])
@pytest.mark.parametrize("name", ["one texel", "lamp", "uniform"])
def test_the_estimator_converges_to_quadrature(name: str, roughness: float) -> None:
    environment = {"one texel": one_texel(), "lamp": lamp([0.3, 0.5, 0.8]), "uniform": uniform()}[name]
    surface, R = visible_sphere(128), random_rotation(torch.Generator().manual_seed(5))
    truth = quadrature(surface, roughness, environment, R)
    few, many = (relit(surface, roughness, environment, R, n) for n in (64, 512))
    assert rms(many - truth) < 0.02 * rms(truth)
    # With eight times the samples, a low-discrepancy pattern gains more than sqrt(8), apart from quadrature noise.
    assert rms(many - truth) < 0.6 * rms(few - truth) + 0.004 * rms(truth)
    # Unbiased: the mean over points, each with its own shift of the pattern, has a smaller error than single points.
    assert abs((many - truth).mean()) < 0.005 * truth.mean()


def test_a_single_bright_texel_needs_few_samples() -> None:
    """A small light that one of a hundred shared directions hits."""
    surface, R = visible_sphere(128), torch.eye(3)
    truth = quadrature(surface, 0.5, one_texel(), R)
    assert rms(relit(surface, 0.5, one_texel(), R, 32) - truth) < 0.05 * rms(truth)


def test_shading_in_chunks_equals_shading_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    surface, R = visible_sphere(128), torch.eye(3)
    whole = relit(surface, 0.5, one_texel(), R, 32)
    monkeypatch.setattr(importance_sampling, "MAX_RAYS", 640)
    torch.testing.assert_close(relit(surface, 0.5, one_texel(), R, 32), whole)


def test_indirect_light_compensates_self_shadowing_under_uniform_light() -> None:
    """A white torus in a white furnace: its radiance is that of the light it occludes."""
    gaussians, T_cam_obj = torus(1000), look_at([2, 1, 3])
    surface = shading.surface(rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA, alpha_min=0.95)
    light, tracer = importance_sampling.light_sampler(uniform()), build_tracer(gaussians, GAMMA)
    # A specular lobe in addition to a white albedo would violate energy conservation, so f0 is 0.
    rough = torch.ones(1000, 1)
    diffuse = Bounce(torch.ones(1000, 3), transfer_vectors(gaussians))
    bounce = importance_sampling.GlossyBounce(diffuse, rough, prefilter(uniform()))
    found = [
        importance_sampling.relight_surface(
            surface,
            *grey(surface, 1.0, 1.0),
            light,
            torch.eye(3),
            tracer,
            f0=0.0,
            generator=torch.Generator().manual_seed(0),
            n_brdf=64,
            n_light=64,
            bounce=b,
        )
        for b in (None, bounce)
    ]
    assert found[0].min() < 0.7
    assert found[0].mean() < 0.97
    # 128 samples leave an error of 3 %.
    assert (found[1] - 1).abs().mean() < 0.04


def test_the_sample_pattern_is_even_along_all_axes() -> None:
    pattern = importance_sampling._lattice(512)
    for axis in range(3):
        counts = torch.histc(pattern[:, axis], 16, 0, 1)
        # Random numbers would give 32 +- 5.6, so one of the 16 bins would probably exceed 42.
        assert (counts - 32).abs().max() <= 8


def by_kernel_and_by_operations(
    environment: Environment, n_brdf: int, n_light: int, *, glossy: bool, n_points: int = 300
) -> tuple[Tensor, Tensor]:
    """A torus with much occlusion under a rotated light: by the CPU kernel, and by its definition."""
    gaussians, T_cam_obj = torus(1000), look_at([2, 1, 3])
    surface = shading.surface(rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA, alpha_min=0.95)
    generator = torch.Generator().manual_seed(1)
    R, tracer = random_rotation(generator), build_tracer(gaussians, GAMMA)
    lattice = importance_sampling._lattice(n_brdf + n_light).float()
    albedo, roughness = torch.rand(1000, 3, generator=generator), torch.rand(1000, 1, generator=generator)
    origins = tracer.ray_origins(surface.points, surface.normals)
    points = (x[:n_points] for x in (origins[::3], surface.normals[::3], surface.views[::3], albedo, roughness))
    samples = backends.SurfaceSamples(*points, torch.rand(n_points, 3, generator=generator), lattice)
    bounce = gaussian_light = None
    if glossy:
        diffuse = Bounce(albedo.flip(0), transfer_vectors(gaussians))
        bounce = importance_sampling.GlossyBounce(diffuse, roughness.flip(0), prefilter(environment))
        gaussian_light = importance_sampling._glossy_gaussians(bounce, tracer, R)
    light, kernel = importance_sampling.light_sampler(environment), backends.relight_kernel(backends.load("cpu"))
    assert kernel is not None
    found = kernel(tracer.bvh, samples, light.tables, gaussian_light, R, n_brdf, 0.04)
    return found, importance_sampling.relight_by_operations(
        samples, light, R, tracer, n_brdf, 0.04, bounce, gaussian_light
    )


@pytest.mark.parametrize("glossy", [False, True])
@pytest.mark.parametrize("rows", [16, 128])
def test_the_kernel_computes_what_the_operations_do(rows: int, glossy: bool) -> None:
    """Batches are cut at 256 samples, and neither kind of samples fills whole vectors; 128 rows exceed the stack's."""
    radiance = torch.rand(rows, 2 * rows, 3, generator=torch.Generator().manual_seed(0)) ** 4
    radiance[rows // 3, rows] = 200.0
    found, expected = by_kernel_and_by_operations(Environment.from_radiance(radiance), 37, 301, glossy=glossy)
    # Rounding moves some of the samples across edges: of texels' cells, of Gaussians, of the horizon.
    assert rms(found - expected) < 5e-4 * rms(expected)
    assert (found - expected).abs().median() < 1e-5 * rms(expected)


@pytest.mark.parametrize(("n_brdf", "n_light", "n_points"), [(1, 0, 5), (0, 1, 5), (700, 3, 2), (8, 8, 0)])
def test_the_kernel_takes_any_number_of_samples_and_points(n_brdf: int, n_light: int, n_points: int) -> None:
    found, expected = by_kernel_and_by_operations(one_texel(), n_brdf, n_light, glossy=True, n_points=n_points)
    torch.testing.assert_close(found, expected, rtol=2e-4, atol=2e-5)


def test_the_kernel_gives_the_same_with_two_threads() -> None:
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(by_kernel_and_by_operations(uniform(), 20, 20, glossy=True)[0])
    torch.set_num_threads(before)
    assert torch.equal(*results)
