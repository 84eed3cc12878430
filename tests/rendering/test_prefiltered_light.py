"""Prefiltered environment maps against integrals over the sphere."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from tumble.maths.directions import fibonacci_sphere, random_rotation, texel_directions
from tumble.rendering import prefiltered_light as filtering
from tumble.scene.environment import Environment


def smooth(h: int, dtype: torch.dtype = torch.float64) -> Environment:
    """A light 30 degrees wide, off all axes, plus uniform light."""
    towards = normalize(torch.tensor([0.5, 0.3, -0.8], dtype=dtype), dim=-1)
    bright = (8 * (texel_directions(h, 2 * h, dtype=dtype) @ towards - 1)).exp()[..., None]
    return Environment.from_radiance(0.2 + bright * torch.tensor([1.0, 2.0, 3.0], dtype=dtype))


@pytest.mark.parametrize("roughness", [0.25, 0.5, 0.75, 1.0])
def test_a_level_is_the_light_weighted_by_the_lobe_at_normal_incidence(roughness: float) -> None:
    environment = smooth(16)
    mirrored = normalize(torch.tensor([[0.1, 0.2, -1.0], [-0.7, 0.7, 0.1], [0.05, -1, 0.02]]).double(), dim=-1)
    wi = fibonacci_sphere(1 << 16, dtype=torch.float64)
    cosine = mirrored @ wi.T
    a2 = roughness**4
    noh = ((1 + cosine) / 2).sqrt()
    weight = cosine.clamp(min=0) * a2 / (math.pi * (noh.square() * (a2 - 1) + 1).square())
    expected = weight @ environment.lookup(wi) / weight.sum(-1, keepdim=True)
    found = filtering.prefilter(environment).lookup(mirrored, torch.full((3, 1), roughness).double())
    # The bilinear map of 16 rows has texels of 0.2 radians, and the light is 0.5 radians wide.
    torch.testing.assert_close(found, expected, rtol=0.04, atol=0.0)


def test_the_roughest_level_is_the_irradiance() -> None:
    environment = smooth(16)
    n = normalize(torch.tensor([[0.3, 0.8, -0.4]]).double(), dim=-1)
    wi = fibonacci_sphere(1 << 16, dtype=torch.float64)
    irradiance = 4 * math.pi / len(wi) * (n @ wi.T).clamp(min=0) @ environment.lookup(wi)
    found = filtering.prefilter(environment).lookup(n, torch.ones(1, 1).double())
    torch.testing.assert_close(math.pi * found, irradiance, rtol=0.01, atol=0)


def test_without_roughness_the_light_is_unfiltered() -> None:
    torch.manual_seed(0)
    environment = Environment.from_radiance(torch.rand(8, 16, 3, dtype=torch.float64))
    d = torch.cat([fibonacci_sphere(200, dtype=torch.float64), torch.tensor([[0, 1e6, 1], [1e-9, 0, 1]]).double()])
    d = normalize(d, dim=-1)
    found = filtering.prefilter(environment).lookup(d, torch.zeros(len(d), 1).double())
    torch.testing.assert_close(found, environment.lookup(d))


def test_a_uniform_light_is_uniform_at_all_levels() -> None:
    prefiltered = filtering.prefilter(Environment.from_radiance(torch.full((8, 16, 3), 0.7)))
    torch.testing.assert_close(prefiltered.stack, torch.full((filtering.LEVELS, 8, 16, 3), 0.7))


def test_a_rotation_of_the_light_about_the_vertical_rotates_all_levels() -> None:
    environment = smooth(8)
    rotated = filtering.prefilter(Environment(environment.log_radiance.roll(3, 1))).stack
    torch.testing.assert_close(rotated, filtering.prefilter(environment).stack.roll(3, 2))


def test_a_fine_map_is_averaged_down_and_keeps_its_light() -> None:
    fine, coarse = smooth(2 * filtering.ROWS, torch.float32), smooth(filtering.ROWS, torch.float32)
    torch.testing.assert_close(filtering.prefilter(fine).stack, filtering.prefilter(coarse).stack, rtol=5e-3, atol=1e-3)


def test_smooth_lobes_use_the_finest_texels_and_rough_ones_their_mean() -> None:
    torch.manual_seed(0)
    environment = Environment.from_radiance(torch.rand(4 * filtering.ROWS, 8 * filtering.ROWS, 3))
    light, d = filtering.prefilter(environment), fibonacci_sphere(300)
    first = 1 / (filtering.LEVELS - 1)
    at = [light.lookup(d, torch.full((300, 1), roughness)) for roughness in (0.0, first / 2, first)]
    torch.testing.assert_close(at[0], environment.lookup(d))
    torch.testing.assert_close(at[1], (at[0] + at[2]) / 2)
    coarse = filtering.prefilter(environment.resampled(filtering.ROWS, 2 * filtering.ROWS))
    torch.testing.assert_close(at[2], coarse.lookup(d, torch.full((300, 1), first)), rtol=0.02, atol=0)


def test_gradients_reach_texels_direction_and_roughness() -> None:
    torch.manual_seed(0)
    d = normalize(torch.randn(5, 3, dtype=torch.float64), dim=-1)
    roughness = torch.tensor([0.06, 0.3, 0.45, 0.7, 0.95], dtype=torch.float64)[:, None]
    log_radiance = torch.randn(4, 8, 3, dtype=torch.float64)
    inputs = [x.requires_grad_() for x in (log_radiance, d, roughness)]

    def glossy(log: torch.Tensor, d: torch.Tensor, r: torch.Tensor) -> torch.Tensor:
        return filtering.prefilter(Environment(log)).lookup(d, r)

    assert torch.autograd.gradcheck(glossy, inputs, fast_mode=True)


def test_cell_radiance_does_not_miss_a_small_light() -> None:
    """Point lookups in 256 directions may miss a light of one texel, cells do not."""
    radiance = torch.full((32, 64, 3), 0.1)
    radiance[11, 40] = 300.0
    light = filtering.prefilter(Environment.from_radiance(radiance))
    mean = light.environment.integral() / (4 * math.pi)
    sets = [fibonacci_sphere(256) @ random_rotation(torch.Generator().manual_seed(k)).T for k in range(20)]
    cells = torch.stack([light.cell_radiance(d).mean(0) for d in sets])
    points = torch.stack([light.environment.lookup(d).mean(0) for d in sets])
    assert (cells / mean - 1).abs().mean() < 0.1, "the mean over cells is not exact, since the lobes overlap unevenly"
    assert (points / mean - 1).abs().mean() > 3 * (cells / mean - 1).abs().mean()
