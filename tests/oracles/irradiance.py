"""Irradiance from spherical harmonics of the radiance, term by term (Ramamoorthi and Hanrahan 2001)."""

import math

from jaxtyping import Float
from torch import Tensor

from tumble.maths.spherical_harmonics import COSINE_LOBE


def irradiance_coefficients(coefficients: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
    """Coefficients of the irradiance on a surface, as a function of its normal, from those of the radiance.

    `basis(n, degree) @ irradiance_coefficients(c)` is the integral of radiance times max(0, n . w); degree 3 does not
    contribute. Albedo / pi times the irradiance is the radiance reflected by a Lambertian surface.
    """
    degree = math.isqrt(coefficients.shape[0]) - 1
    lobe = [COSINE_LOBE[l] for l in range(degree + 1) for _ in range(2 * l + 1)]  # noqa: E741
    return coefficients * coefficients.new_tensor(lobe)[:, None]
