"""Conventions of equirectangular maps on directions computed by hand; integrals against closed forms."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from tests.oracles.directions import fibonacci_hemisphere, spherical
from tumble.maths.directions import (
    direction_from_equirect,
    equirect_from_direction,
    fibonacci_sphere,
    local_frame,
    random_rotation,
    reflect,
    texel_directions,
    texel_solid_angles,
)

DOUBLE = torch.float64


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def unit_vectors(n: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=seeded(), dtype=DOUBLE), dim=-1)


@pytest.mark.parametrize(
    ("direction", "u", "v"),
    [
        ((0, 0, -1), 0.5, 0.5),
        ((1, 0, 0), 0.75, 0.5),
        ((-1, 0, 0), 0.25, 0.5),
        ((0, 0, 1), 0.0, 0.5),
        ((0, 1, 0), 0.5, 0.0),
        ((0, -1, 0), 0.5, 1.0),
        ((1, 0, -1), 0.625, 0.5),
        ((0, 1, -1), 0.5, 0.25),
        ((-1, -math.sqrt(2), 1), 0.125, 0.75),
    ],
)
def test_the_map_has_minus_z_in_the_centre_and_plus_x_at_its_right(
    direction: tuple[float, float, float], u: float, v: float
) -> None:
    d = torch.tensor(direction, dtype=DOUBLE)
    uv = equirect_from_direction(d)
    torch.testing.assert_close(uv, torch.tensor([u, v], dtype=DOUBLE))
    torch.testing.assert_close(direction_from_equirect(uv), d / d.norm())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_map_coordinates_convert_back_to_directions(dtype: torch.dtype) -> None:
    d = unit_vectors(1000).to(dtype)
    uv = equirect_from_direction(d)
    assert ((uv >= 0) & (uv <= 1)).all()
    assert (uv[:, 0] < 1).all()
    # An angle of 2 pi is rounded to a few machine epsilons.
    torch.testing.assert_close(direction_from_equirect(uv), d, rtol=0, atol=16 * torch.finfo(dtype).eps)


def test_u_stays_below_one_just_behind_the_seam() -> None:
    d = torch.tensor([[1e-12, 0.0, 1.0], [-1e-12, 0.0, 1.0]])
    u = equirect_from_direction(d)[:, 0]
    assert ((u >= 0) & (u < 1)).all()


def test_map_coordinates_have_finite_gradients_at_the_poles() -> None:
    d = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], requires_grad=True)
    equirect_from_direction(d).sum().backward()
    assert d.grad is not None
    assert d.grad.isfinite().all()
    generic = unit_vectors(5).requires_grad_()
    assert torch.autograd.gradcheck(equirect_from_direction, generic)


def test_texel_centres_are_at_half() -> None:
    d = texel_directions(4, 8, dtype=DOUBLE)
    assert d.shape == (4, 8, 3)
    uv = equirect_from_direction(d[1, 6])
    torch.testing.assert_close(uv, torch.tensor([6.5 / 8, 1.5 / 4], dtype=DOUBLE))
    assert d[0, :, 1].min() > 0 > d[3, :, 1].max()


@pytest.mark.parametrize(("height", "width"), [(1, 2), (4, 8), (16, 32), (64, 96)])
def test_solid_angles_are_exact(height: int, width: int) -> None:
    areas = texel_solid_angles(height, width, dtype=DOUBLE)
    edges = [math.cos(math.pi * row / height) for row in range(height + 1)]
    exact = [2 * math.pi / width * (top - bottom) for top, bottom in itertools.pairwise(edges)]
    torch.testing.assert_close(areas, torch.tensor(exact, dtype=DOUBLE)[:, None].expand(height, width))
    assert areas.sum().item() == pytest.approx(4 * math.pi, rel=1e-13)


def test_solid_angles_agree_with_numerical_quadrature() -> None:
    fine = 512
    theta = math.pi * (torch.arange(4 * fine, dtype=DOUBLE) + 0.5) / (4 * fine)
    strips = theta.sin() * math.pi / (4 * fine) * 2 * math.pi / 8
    # The midpoint rule over a texel errs by (pi / 2048)^2 / 24, relatively.
    torch.testing.assert_close(
        texel_solid_angles(4, 8, dtype=DOUBLE)[:, 0], strips.reshape(4, fine).sum(1), rtol=2e-7, atol=0
    )


def test_spherical_has_z_up_and_takes_numbers_and_tensors() -> None:
    torch.testing.assert_close(spherical(0.0, phi=0.0), torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(spherical(math.pi / 2, 0.0), torch.tensor([1.0, 0.0, 0.0]), atol=1e-7, rtol=0)
    theta = torch.tensor([math.pi / 2, math.pi / 6], dtype=DOUBLE)
    expected = torch.tensor([[0, 1, 0], [0, 0.5, math.sqrt(0.75)]], dtype=DOUBLE)
    torch.testing.assert_close(spherical(theta, math.pi / 2), expected, atol=1e-15, rtol=0)
    assert spherical(0.5, theta[:, None]).shape == (2, 1, 3)


def monomials(d: Tensor) -> Tensor:
    x, y, z = d.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z, z**4], -1)


def test_the_fibonacci_sphere_integrates_low_polynomials() -> None:
    n = 4096
    d = fibonacci_sphere(n, dtype=DOUBLE)
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(n, dtype=DOUBLE))
    exact = 4 * math.pi * torch.tensor([1, 0, 0, 0, 1 / 3, 1 / 3, 1 / 3, 0, 0, 0, 1 / 5], dtype=DOUBLE)
    integrals = monomials(d).mean(0) * 4 * math.pi
    # The lattice's discrepancy is O(1 / n); random points would give 1 / sqrt(n) = 0.016.
    torch.testing.assert_close(integrals, exact, rtol=0, atol=4 / n)


def test_the_fibonacci_hemisphere_is_unbiased_down_to_the_horizon() -> None:
    n = 4096
    d, area = fibonacci_hemisphere(n, dtype=DOUBLE)
    assert area == pytest.approx(2 * math.pi / n)
    assert 0 < d[:, 2].min() < math.sin(math.radians(1))
    z = d[:, 2]
    exact = 2 * math.pi * torch.tensor([1, 1 / 2, 1 / 3, 1 / 4], dtype=DOUBLE)
    # The midpoint rule in z: exact for z, O(1 / n^2) beyond.
    torch.testing.assert_close(torch.stack([z**k for k in range(4)]).sum(1) * area, exact, rtol=0, atol=10 / n**2)
    assert (d[:, :2].sum(0) * area).abs().max() < 4 / n


def test_local_frames_are_rotations_whose_third_column_is_the_normal() -> None:
    poles = torch.tensor([[0, 0, 1], [0, 0, -1], [0, 1e-9, -1], [1, 0, 0], [1, 0, -1e-20]], dtype=DOUBLE)
    n = torch.cat([unit_vectors(500), poles])
    R = local_frame(n)
    eye = torch.eye(3, dtype=DOUBLE).expand(R.shape[0], 3, 3)
    # The near-pole vector above has length 1 + 5e-19: unit to float64.
    torch.testing.assert_close(R.mT @ R, eye, rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(R.shape[0], dtype=DOUBLE))
    torch.testing.assert_close(R[..., 2], n)


def test_local_frames_have_finite_gradients_at_both_poles() -> None:
    n = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], requires_grad=True)
    local_frame(n).sum().backward()
    assert n.grad is not None
    assert n.grad.isfinite().all()


def test_reflected_directions_stay_on_the_same_side() -> None:
    up, slanted = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.6, 0.0, 0.8])
    torch.testing.assert_close(reflect(slanted, up), torch.tensor([-0.6, 0.0, 0.8]))
    torch.testing.assert_close(reflect(up, up), up)
    assert reflect(slanted.expand(5, 3), up).shape == (5, 3)


def test_random_rotations_are_proper_and_uniform() -> None:
    generator = seeded()
    R = torch.stack([random_rotation(generator, dtype=DOUBLE) for _ in range(2000)])
    eye = torch.eye(3, dtype=DOUBLE).expand(2000, 3, 3)
    torch.testing.assert_close(R.mT @ R, eye, rtol=0, atol=1e-13)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(2000, dtype=DOUBLE))
    # Entries have mean 0 and variance 1/3; the trace has variance 1. Five standard errors.
    assert R.mean(0).abs().max() < 5 * math.sqrt(1 / 3 / 2000)
    assert R.diagonal(dim1=-2, dim2=-1).sum(-1).mean().abs() < 5 / math.sqrt(2000)
    again = random_rotation(seeded(), dtype=DOUBLE)
    assert torch.equal(again, R[0])
