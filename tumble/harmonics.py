"""Real spherical harmonics to degree 3, 16 functions, orthonormal over the sphere.

Order: degree l = 0, 1, 2, 3 and within it m = -l .. l. Signs: with the Condon-Shortley phase, so Y_1 is proportional
to (-y, z, -x), as Gaussian splatting has them. A *coefficient* is the integral of a function times a harmonic; the
function is the sum of coefficients times harmonics. Directions are rotated, coefficients never are.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.directions import texel_directions, texel_solid_angles

MAX_DEGREE = 3
COSINE_LOBE = (math.pi, 2 * math.pi / 3, math.pi / 4, 0.0)
"""A_l: what the clamped cosine makes of degree l (Ramamoorthi and Hanrahan 2001)."""


def basis(d: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """All `k = (degree + 1)^2` harmonics to `degree` at unit directions.

    Raises:
        ValueError: A degree not in 0 to 3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"harmonics exist for degrees 0 to {MAX_DEGREE}, not {degree}")
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [
        [torch.full_like(x, _norm(1, 4))],
        [-_norm(3, 4) * y, _norm(3, 4) * z, -_norm(3, 4) * x],
        [
            _norm(15, 4) * x * y,
            -_norm(15, 4) * y * z,
            _norm(5, 16) * (3 * zz - 1),
            -_norm(15, 4) * x * z,
            _norm(15, 16) * (xx - yy),
        ],
        [
            -_norm(35, 32) * y * (3 * xx - yy),
            _norm(105, 4) * x * y * z,
            -_norm(21, 32) * y * (5 * zz - 1),
            _norm(7, 16) * z * (5 * zz - 3),
            -_norm(21, 32) * x * (5 * zz - 1),
            _norm(105, 16) * z * (xx - yy),
            -_norm(35, 32) * x * (xx - 3 * yy),
        ],
    ]
    return torch.stack([value for row in values[: degree + 1] for value in row], -1)


def project(radiance: Float[Tensor, "h w c"]) -> Float[Tensor, "16 c"]:
    """Coefficients of an equirectangular map, each texel taken as constant over its exact solid angle."""
    h, w, _ = radiance.shape
    like = {"dtype": radiance.dtype, "device": radiance.device}
    weighted = radiance * texel_solid_angles(h, w, **like)[..., None]
    return torch.einsum("hwk,hwc->kc", basis(texel_directions(h, w, **like), MAX_DEGREE), weighted)


def irradiance_coefficients(coefficients: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
    """Coefficients of the irradiance on a surface, as a function of its normal, from those of the radiance.

    `basis(n, degree) @ irradiance_coefficients(c)` is the integral of radiance times max(0, n . w); degree 3 adds
    nothing to it. Divide by pi and multiply by albedo for the light a Lambertian surface sends back.
    """
    degree = math.isqrt(coefficients.shape[0]) - 1
    lobe = [COSINE_LOBE[l] for l in range(degree + 1) for _ in range(2 * l + 1)]  # noqa: E741
    return coefficients * coefficients.new_tensor(lobe)[:, None]


def _norm(numerator: int, denominator: int) -> float:
    return math.sqrt(numerator / denominator / math.pi)
