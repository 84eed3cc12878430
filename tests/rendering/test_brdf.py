"""Energy, reciprocity and sampling of both lobes, against the printed formulas, quadrature and histograms."""

import math

import pytest
import torch
from torch import Tensor

from tests.oracles.directions import fibonacci_hemisphere, spherical
from tumble.maths import directions
from tumble.rendering import brdf

UP = torch.tensor([0.0, 0.0, 1.0])
DOUBLE = torch.float64
WHITE = torch.ones(3, dtype=DOUBLE)


def uniform(n: int, seed: int = 0, dtype: torch.dtype = DOUBLE) -> Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def unit_vectors(n: int, seed: int = 0) -> Tensor:
    normal = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)
    return torch.nn.functional.normalize(normal, dim=-1)


def glass(cosine: float) -> float:
    """Fresnel's equations for unpolarised light that enters a medium of index 1.5."""
    inside = math.sqrt(1 - (1 - cosine**2) / 1.5**2)
    s, p = (cosine - 1.5 * inside) / (cosine + 1.5 * inside), (inside - 1.5 * cosine) / (inside + 1.5 * cosine)
    return (s * s + p * p) / 2


def printed_ggx(wi: list, wo: list, n: list, r: float, f0: float) -> float:
    """D F G / (4 nol nov), factor by factor."""

    def dot(a: list, b: list) -> float:
        return sum(x * y for x, y in zip(a, b, strict=True))

    h = [x + y for x, y in zip(wi, wo, strict=True)]
    h = [x / math.sqrt(dot(h, h)) for x in h]
    nol, nov, noh, voh = dot(n, wi), dot(n, wo), dot(n, h), dot(wo, h)
    if nol <= 0 or nov <= 0:
        return 0.0
    a2 = r**4
    D = a2 / (math.pi * (noh * noh * (a2 - 1) + 1) ** 2)
    F = f0 / 0.04 * glass(voh)
    # Walter 2007, equation 34.
    G = math.prod(2 / (1 + math.sqrt(1 + a2 * (1 - x * x) / (x * x))) for x in (nol, nov))
    return D * F * G / (4 * nol * nov)


@pytest.mark.parametrize("roughness", [0.05, 0.3, 1.0])
def test_ggx_is_the_printed_formula(roughness: float) -> None:
    wi, wo, n = unit_vectors(60, 0), unit_vectors(60, 1), unit_vectors(60, 2)
    expected = [printed_ggx(*rows, roughness, 0.04) for rows in zip(wi.tolist(), wo.tolist(), n.tolist(), strict=True)]
    assert sum(value > 0 for value in expected) > 10
    found = brdf.ggx(wi, wo, n, roughness=roughness, f0=0.04)[:, 0]
    # `fresnel` is a fit to Fresnel's equations.
    torch.testing.assert_close(found, torch.tensor(expected, dtype=DOUBLE), rtol=4e-3, atol=0)


def test_roughness_below_its_lower_limit_is_raised_to_it() -> None:
    wi, wo = unit_vectors(20, 0), unit_vectors(20, 1)
    at_floor = brdf.ggx(wi, wo, UP.double(), roughness=brdf.MIN_ROUGHNESS, f0=0.04)
    assert torch.equal(brdf.ggx(wi, wo, UP.double(), roughness=0.0, f0=0.04), at_floor)


def test_the_fresnel_fit_matches_the_equations_for_glass() -> None:
    voh = torch.linspace(0, 1, 1001, dtype=DOUBLE)
    exact = torch.tensor([glass(x) / 0.04 for x in voh.tolist()], dtype=DOUBLE)
    torch.testing.assert_close(brdf.fresnel(voh), exact, rtol=4e-3, atol=0)
    assert brdf.fresnel(torch.ones(1)).item() == 1


def test_the_peak_of_a_smooth_lobe_keeps_its_digits_in_float32() -> None:
    """Two milliradians from the mirror direction, nine tenths of alpha; computed from noh^2 the error would be 2 %."""
    theta = torch.linspace(0, 0.01, 50, dtype=DOUBLE)
    wi, wo = spherical(theta, 0.0), UP.double()
    exact = brdf.ggx(wi, wo, UP.double(), roughness=0.05, f0=0.04)
    assert exact[0].item() == pytest.approx(0.04 / (4 * math.pi * 0.05**4))
    single = brdf.ggx(wi.float(), UP, UP, roughness=0.05, f0=0.04)
    # The directions themselves are rounded by 6e-8 of 2e-3.
    torch.testing.assert_close(single.double(), exact, rtol=2e-4, atol=0)


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("theta", [0.1, 0.6, 1.2])
def test_ggx_never_creates_energy(roughness: float, theta: float) -> None:
    """Reflected fraction of uniform light for glass: above 0, and below that of perfect mirrors as microfacets."""
    wi, area = fibonacci_hemisphere(1 << 16)
    wo = spherical(theta, phi=0.0)
    reflected = (brdf.ggx(wi, wo, UP, roughness=roughness, f0=0.04) * wi[:, 2:] * area).sum(0)
    assert 0.01 < reflected.item() <= 0.3


def test_lambert_reflects_exactly_its_albedo() -> None:
    albedo = torch.tensor([0.2, 0.5, 1.0], dtype=DOUBLE)
    wi, area = fibonacci_hemisphere(64, dtype=DOUBLE)
    reflected = (brdf.lambert(albedo) * wi[:, 2:] * area).sum(0)
    # Midpoints in z integrate z exactly.
    torch.testing.assert_close(reflected, albedo, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("roughness", "excess"), [(0.1, 1.454), (0.2, 1.400), (0.3, 1.294)])
def test_a_white_surface_reflects_more_than_it_receives(roughness: float, excess: float) -> None:
    """As in the paper, whose diffuse lobe is not reduced by the specular reflectance."""
    wi, area = fibonacci_hemisphere(1 << 17, dtype=DOUBLE)
    reflected = []
    for theta in torch.linspace(1.34, 1.43, 7).tolist():
        wo = spherical(torch.tensor(theta, dtype=DOUBLE), phi=0.0)
        f = brdf.evaluate(wi, wo, UP.double(), albedo=WHITE, roughness=roughness, f0=0.04)
        reflected.append((f * wi[:, 2:] * area).sum(0)[0].item())
    # The maximum over theta, to three digits.
    assert max(reflected) == pytest.approx(excess, abs=1e-3)


def test_the_sum_of_lobes_is_reciprocal() -> None:
    wi, wo = unit_vectors(200, 0), unit_vectors(200, 1)
    n = torch.nn.functional.normalize(wi + wo + 0.7 * unit_vectors(200, 2), dim=-1)
    settings = {"albedo": uniform(200), "roughness": uniform(200)[:, :1], "f0": 0.04}
    forth, back = brdf.evaluate(wi, wo, n, **settings), brdf.evaluate(wo, wi, n, **settings)
    assert ((n * wi).sum(-1) > 0).sum() > 100
    torch.testing.assert_close(forth, back, rtol=1e-11, atol=0)


def test_the_specular_lobe_is_zero_below_the_horizon() -> None:
    above, below = torch.tensor([0.6, 0.0, 0.8]), torch.tensor([0.6, 0.0, -0.8])
    for wi, wo in [(above, below), (below, above), (below, below)]:
        assert brdf.ggx(wi, wo, UP, roughness=0.5, f0=0.04).item() == 0


def test_operands_broadcast() -> None:
    wi, wo, n = unit_vectors(5, 0)[:, None], unit_vectors(7, 1), UP.double()
    roughness = uniform(7)[:, :1]
    f = brdf.evaluate(wi, wo, n, albedo=WHITE, roughness=roughness, f0=0.04)
    assert f.shape == (5, 7, 3)
    one = brdf.evaluate(wi[2, 0], wo[3], n, albedo=WHITE, roughness=roughness[3], f0=0.04)
    torch.testing.assert_close(f[2, 3], one)
    assert brdf.pdf(wi, wo, n, roughness=roughness).shape == (5, 7, 1)
    assert brdf.sample(uniform(5)[:, None], wo, n, roughness=roughness).shape == (5, 7, 3)


def test_gradients_are_those_of_finite_differences() -> None:
    wi, wo = torch.tensor([0.36, 0.48, 0.8], dtype=DOUBLE), torch.tensor([-0.6, 0.0, 0.8], dtype=DOUBLE)
    inputs = (wi, wo, UP.double(), torch.tensor([0.4], dtype=DOUBLE), torch.tensor([0.3], dtype=DOUBLE))

    def lobe(wi: Tensor, wo: Tensor, n: Tensor, roughness: Tensor, f0: Tensor) -> Tensor:
        return brdf.ggx(wi, wo, n, roughness=roughness, f0=f0)

    assert torch.autograd.gradcheck(lobe, tuple(x.clone().requires_grad_() for x in inputs))


def test_gradients_are_finite_at_the_mirror_direction_the_horizon_and_opposite_to_the_eye() -> None:
    horizon = torch.tensor([1.0, 0.0, 0.0])
    wi = torch.stack([UP, horizon, horizon, -UP, -horizon]).requires_grad_()
    wo = torch.stack([UP, UP, horizon, UP, horizon]).requires_grad_()
    n = UP.clone().requires_grad_()
    roughness = torch.full((5, 1), 0.05, requires_grad=True)
    brdf.ggx(wi, wo, n, roughness=roughness, f0=0.04).sum().backward()
    for tensor in (wi, wo, n, roughness):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()


@pytest.mark.parametrize("theta", [0.0, 0.8, 1.4])
@pytest.mark.parametrize("roughness", [0.3, 1.0])
def test_the_density_of_samples_integrates_to_one(roughness: float, theta: float) -> None:
    """Over the whole sphere, since GGX samples can be below the horizon."""
    wi = directions.fibonacci_sphere(1 << 18, dtype=DOUBLE)
    wo = spherical(torch.tensor(theta, dtype=DOUBLE), 0.3)
    density = brdf.pdf(wi, wo, UP.double(), roughness=roughness)
    # The lattice's error for a lobe of 0.1 radians, and the integrable pole opposite to the eye.
    assert (density.mean() * 4 * math.pi).item() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("theta", [0.3, 1.3])
@pytest.mark.parametrize("roughness", [0.35, 0.8])
def test_samples_are_distributed_with_their_density(roughness: float, theta: float) -> None:
    """Pearson's chi-square over the cells of a map of the sphere."""
    n = torch.tensor([0.48, -0.64, 0.6], dtype=DOUBLE)
    wo = directions.local_frame(n) @ spherical(torch.tensor(theta, dtype=DOUBLE), 1.0)
    rows, columns, draws = 10, 20, 200_000

    def cell(d: Tensor) -> Tensor:
        u, v = directions.equirect_from_direction(d).unbind(-1)
        return (v * rows).long().clamp_max(rows - 1) * columns + (u * columns).long()

    wi = brdf.sample(uniform(draws), wo, n, roughness=roughness)
    torch.testing.assert_close(wi.norm(dim=-1), torch.ones(draws, dtype=DOUBLE))
    counts = torch.bincount(cell(wi), minlength=rows * columns)

    points = directions.fibonacci_sphere(1 << 19, dtype=DOUBLE)
    density = brdf.pdf(points, wo, n, roughness=roughness)[:, 0]
    expected = torch.bincount(cell(points), density, minlength=rows * columns) / density.sum() * draws
    enough = expected > 20
    statistic = ((counts - expected).square() / expected)[enough].sum().item()
    freedom = int(enough.sum())
    # Four standard deviations; and the quadrature of a cell (0.5 % of a count of 1000 is 0.03 of its variance).
    assert statistic < freedom + 4 * math.sqrt(2 * freedom)
    assert freedom > 60


def test_half_vectors_of_the_smoothest_lobe_have_their_distribution_in_float32() -> None:
    """Kolmogorov-Smirnov against the closed form u = t / (a^2 + t), t the squared tangent."""
    u = uniform(20_000, dtype=torch.float32)
    u[:, 0] = 0.75
    wi = brdf.sample(u, UP, UP, roughness=0.05).double()
    half = 0.5 * torch.atan2(wi[:, :2].norm(dim=-1), wi[:, 2])
    tangent2 = half.tan().square()
    distribution = (tangent2 / (0.05**4 + tangent2)).sort().values
    distance = (distribution - (torch.arange(20_000) + 0.5) / 20_000).abs().max()
    # The 99.9 % quantile is 1.95 / sqrt(n).
    assert distance < 1.95 / math.sqrt(20_000)


@pytest.mark.parametrize("theta", [0.2, 1.2])
@pytest.mark.parametrize("roughness", [0.1, 0.4, 0.9])
def test_importance_sampling_matches_quadrature(roughness: float, theta: float) -> None:
    """Both lobes with a coloured albedo, under a light with a gradient."""
    albedo = torch.tensor([0.8, 0.4, 0.1], dtype=DOUBLE)
    n, wo = UP.double(), spherical(torch.tensor(theta, dtype=DOUBLE), 0.0)

    def integrand(wi: Tensor) -> Tensor:
        f = brdf.evaluate(wi, wo, n, albedo=albedo, roughness=roughness, f0=0.5)
        return f * wi[:, 2:].clamp_min(0) * (1 + 0.8 * wi[:, :1])

    wi, area = fibonacci_hemisphere(1 << 17, dtype=DOUBLE)
    quadrature = (integrand(wi) * area).sum(0)
    draws = brdf.sample(uniform(100_000, seed=3), wo, n, roughness=roughness)
    terms = integrand(draws) / brdf.pdf(draws, wo, n, roughness=roughness)
    error = terms.std(0) / math.sqrt(terms.shape[0])
    assert ((terms.mean(0) - quadrature).abs() < 4 * error + 1e-4).all()
    # The weights of the samples are bounded.
    assert terms.max() < 8


def test_samples_are_symmetric_about_a_tilted_normal() -> None:
    n = torch.tensor([0.0, 0.6, -0.8])
    wi = brdf.sample(uniform(4096, dtype=torch.float32), n, n, roughness=0.2)
    # Cosine lobe: mean of the cosine 2/3; GGX at normal incidence: close to 1.
    assert (wi @ n).mean().item() == pytest.approx((2 / 3 + 0.99) / 2, abs=0.02)
    across = wi.mean(0) - (wi.mean(0) @ n) * n
    assert across.norm() < 0.03


@pytest.fixture(scope="module")
def table() -> Tensor:
    return brdf.split_sum_table()


@pytest.mark.parametrize("f0", [0.0, 0.04])
@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("theta", [0.0, 0.6, 1.2, 1.5])
def test_split_sum_matches_the_directional_albedo_by_quadrature(
    table: Tensor, roughness: float, theta: float, f0: float
) -> None:
    wi, area = fibonacci_hemisphere(1 << 16, dtype=DOUBLE)
    wo = spherical(torch.tensor(theta, dtype=DOUBLE), 0.0)
    exact = (brdf.ggx(wi, wo, UP.double(), roughness=roughness, f0=f0) * wi[:, 2:] * area).sum()
    directional_albedo = brdf.split_sum(table, wo[2:].float(), roughness)
    # The error of 4096 half vectors, and linear interpolation between 64 entries where grazing Fresnel is steep.
    assert (f0 * directional_albedo).item() == pytest.approx(exact.item(), abs=4e-3)


def test_split_sum_interpolates_entries_and_clamps_at_the_borders(table: Tensor) -> None:
    nov = torch.tensor([[0.0], [1.0], [2.0], [10 / 63]])
    rough = brdf.MIN_ROUGHNESS + (1 - brdf.MIN_ROUGHNESS) * torch.tensor([[0.0], [1.0], [3.0], [20 / 63]])
    found = brdf.split_sum(table, nov, rough)
    expected = torch.stack([table[0, 0], table[-1, -1], table[-1, -1], table[10, 20]])[:, None]
    # Coordinates over 63 intervals are rounded by 4e-6 of an interval.
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-4)
    assert torch.equal(brdf.split_sum(table, nov, 0.0)[0], found[0])
    assert brdf.split_sum(table, nov.reshape(2, 2, 1), 0.5).shape == (2, 2, 1)


@pytest.mark.parametrize("roughness", [0.2, 0.6])
def test_a_white_metal_sends_back_at_most_what_it_gets_and_its_tables_agree(roughness: float) -> None:
    """Schlick's term of a white metal is 1 everywhere; single scattering loses light on a rough one."""
    n, wi = UP, directions.fibonacci_sphere(200_000)
    tables, colour = brdf.metal_split_sum_tables(), torch.tensor([1.0, 0.6, 0.1])
    for theta in (0.2, 1.0, 1.4):
        wo = torch.tensor([math.sin(theta), 0.0, math.cos(theta)])
        value = brdf.metal(wi, wo, n, albedo=colour, roughness=roughness) * brdf.cosine(n, wi).clamp_min(0)
        reflected = value.mean(0) * 4 * math.pi
        rough, nov = torch.full((1, 1), roughness), wo[None, 2:]
        of_colour, of_all = (brdf.split_sum(table, nov, rough)[0, 0] for table in tables)
        torch.testing.assert_close(reflected, colour * of_colour + of_all, rtol=0.01, atol=2e-3)
        assert 0.5 < reflected[0] <= 1.001
        assert reflected[0] > reflected[1] > reflected[2] > 0.08


def test_split_sum_tables_are_deterministic_and_conserve_energy(table: Tensor) -> None:
    assert torch.equal(table, brdf.split_sum_table())
    assert brdf.split_sum_table(16).shape == (16, 16)
    assert table.min() >= 0
    # 4096 half vectors have an error of up to 1e-4 where the eye is near the horizon.
    assert 0.04 * table.max() <= 1 + 2e-4
