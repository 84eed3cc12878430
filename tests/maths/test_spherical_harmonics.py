"""Spherical harmonics against SciPy, and irradiance against brute-force integrals."""

import math
import warnings

import numpy as np
import pytest
import torch
from scipy import special
from torch import Tensor

from tests.oracles.irradiance import irradiance_coefficients
from tumble.maths.directions import fibonacci_sphere, texel_directions, texel_solid_angles
from tumble.maths.spherical_harmonics import basis, project, series

DOUBLE = torch.float64


def scipy_harmonic(l: int, m: int, theta: np.ndarray, phi: np.ndarray) -> np.ndarray:  # noqa: E741
    """Real harmonic from the complex one; SciPy renamed the function and swapped its arguments in 1.15."""
    if hasattr(special, "sph_harm_y"):
        value = special.sph_harm_y(l, abs(m), theta, phi)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            value = getattr(special, "sph_harm")(abs(m), l, phi, theta)  # noqa: B009
    if m == 0:
        return value.real
    return math.sqrt(2) * (value.real if m > 0 else value.imag)


def test_harmonics_are_those_of_scipy_in_order_and_sign() -> None:
    d = fibonacci_sphere(200, dtype=DOUBLE)
    theta, phi = np.arccos(d[:, 2].numpy()), np.arctan2(d[:, 1].numpy(), d[:, 0].numpy())
    expected = [scipy_harmonic(l, m, theta, phi) for l in range(4) for m in range(-l, l + 1)]  # noqa: E741
    torch.testing.assert_close(basis(d, 3), torch.from_numpy(np.stack(expected, -1)))


def test_harmonics_are_orthonormal() -> None:
    # Gauss-Legendre in z times equal steps in azimuth: exact for products of two harmonics of degree 3.
    z, weight = np.polynomial.legendre.leggauss(8)
    phi = 2 * np.pi * np.arange(16) / 16
    across = np.sqrt(1 - z * z)[:, None]
    d = np.stack([across * np.cos(phi), across * np.sin(phi), np.broadcast_to(z[:, None], (8, 16))], -1)
    Y = basis(torch.from_numpy(d), 3).reshape(-1, 16)
    area = torch.from_numpy(np.repeat(weight * 2 * np.pi / 16, 16))
    torch.testing.assert_close(Y.mT @ (Y * area[:, None]), torch.eye(16, dtype=DOUBLE), rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_the_first_harmonics(degree: int) -> None:
    d = fibonacci_sphere(7)
    assert torch.equal(basis(d, degree), basis(d, 3)[:, : (degree + 1) ** 2])


def test_degrees_beyond_three_are_an_error() -> None:
    with pytest.raises(ValueError, match="0 to 3"):
        basis(fibonacci_sphere(2), 4)


def test_projection_recovers_coefficients() -> None:
    coefficients = torch.randn(16, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    coarse = project(basis(texel_directions(32, 64, dtype=DOUBLE), 3) @ coefficients)
    fine = project(basis(texel_directions(64, 128, dtype=DOUBLE), 3) @ coefficients)
    # The midpoint rule errs by the square of the texels' size, (pi / 32)^2 = 0.01, and a quarter of it when halved.
    torch.testing.assert_close(coarse, coefficients, rtol=0, atol=0.02)
    torch.testing.assert_close(fine, coefficients, rtol=0, atol=0.005)


def irradiance(radiance: Tensor, n: Tensor) -> Tensor:
    """The integral of radiance times clamped cosine, summed texel by texel."""
    h, w, _ = radiance.shape
    cosine = torch.einsum("hwi,ni->nhw", texel_directions(h, w, dtype=DOUBLE), n).clamp_min(0)
    return torch.einsum("nhw,hw,hwc->nc", cosine, texel_solid_angles(h, w, dtype=DOUBLE), radiance)


def test_irradiance_of_uniform_light_is_pi() -> None:
    uniform = torch.ones(16, 32, 1, dtype=DOUBLE)
    E = basis(fibonacci_sphere(20, dtype=DOUBLE), 3) @ irradiance_coefficients(project(uniform))
    # The light is evaluated at texel centres: (pi / 16)^2 / 12 of the constant leaks into degree 2.
    torch.testing.assert_close(E, torch.full_like(E, math.pi), rtol=0, atol=0.01)


def test_irradiance_of_smooth_light_is_the_cosine_integral() -> None:
    """Light of degree 3 at most has an irradiance of degree 2, exactly."""
    coefficients = torch.randn(16, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    radiance = basis(texel_directions(128, 256, dtype=DOUBLE), 3) @ coefficients
    n = fibonacci_sphere(30, dtype=DOUBLE)
    approximated = basis(n, 3) @ irradiance_coefficients(coefficients)
    # Midpoint quadrature over 128 rows: (pi / 128)^2 = 6e-4, times a sum of coefficients of order one.
    torch.testing.assert_close(approximated, irradiance(radiance, n), rtol=0, atol=2e-3)


def test_irradiance_of_a_small_light_is_accurate_to_a_tenth() -> None:
    """The error is the omitted part of the irradiance of degree 4 and above."""
    radiance = torch.zeros(32, 64, 3, dtype=DOUBLE)
    radiance[8:14, 20:30] = torch.tensor([5.0, 4.0, 3.0], dtype=DOUBLE)
    n = fibonacci_sphere(50, dtype=DOUBLE)
    exact = irradiance(radiance, n)
    approximated = basis(n, 3) @ irradiance_coefficients(project(radiance))
    assert (approximated - exact).abs().max() < 0.1 * exact.max()


def test_irradiance_accepts_fewer_degrees() -> None:
    c = torch.ones(4, 3)
    torch.testing.assert_close(irradiance_coefficients(c)[:, 0], torch.tensor([3.0, 2.0, 2.0, 2.0]) * math.pi / 3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_series_is_the_basis_times_coefficients_with_its_gradients(degree: int) -> None:
    d = fibonacci_sphere(9, dtype=DOUBLE).requires_grad_()
    rng = torch.Generator().manual_seed(0)
    c = torch.randn((degree + 1) ** 2, 3, generator=rng, dtype=DOUBLE).requires_grad_()
    torch.testing.assert_close(series(c, d), basis(d, degree) @ c)
    assert torch.autograd.gradcheck(series, (c, d))
