"""Real spherical harmonics up to degree 3 (16 functions), orthonormal over the sphere.

Order: degree l = 0, 1, 2, 3, and within a degree m = -l .. l. The signs include the Condon-Shortley phase, as in
Gaussian splatting: Y_1 is proportional to (-y, z, -x). A *coefficient* is the integral of a function times a harmonic;
the function is the sum of coefficients times harmonics. Rotations are applied to directions, never to coefficients.
"""

import math
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths.directions import texel_directions, texel_solid_angles

MAX_DEGREE = 3
"""Highest degree of the harmonics in this file."""
MONOMIALS = ["".join(letters) for degree in range(4) for letters in combinations_with_replacement("xyz", degree)]
"""All monomials up to degree 3 in order: "" (the constant 1), x, y, z, xx, xy, xz, yy, yz, zz, xxx, xxy and so on."""
POLYNOMIALS: list[tuple[tuple[int, int], dict[str, int]]] = [
    ((1, 4), {"": 1}),
    ((3, 4), {"y": -1}),
    ((3, 4), {"z": 1}),
    ((3, 4), {"x": -1}),
    ((15, 4), {"xy": 1}),
    ((15, 4), {"yz": -1}),
    ((5, 16), {"zz": 3, "": -1}),
    ((15, 4), {"xz": -1}),
    ((15, 16), {"xx": 1, "yy": -1}),
    ((35, 32), {"xxy": -3, "yyy": 1}),
    ((105, 4), {"xyz": 1}),
    ((21, 32), {"yzz": -5, "y": 1}),
    ((7, 16), {"zzz": 5, "z": -3}),
    ((21, 32), {"xzz": -5, "x": 1}),
    ((105, 16), {"xxz": 1, "yyz": -1}),
    ((35, 32), {"xxx": -1, "xyy": 3}),
]
"""Each harmonic as the arguments of `_norm` and the integer coefficients of its monomials."""
COSINE_LOBE = (math.pi, 2 * math.pi / 3, math.pi / 4, 0.0)
"""Factors A_l by which convolution with the clamped cosine scales degree l (Ramamoorthi and Hanrahan 2001)."""


def basis(d: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """Values of all `k = (degree + 1)^2` harmonics up to `degree` at unit directions.

    Raises:
        ValueError: The degree is not in 0 to 3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"the degree of spherical harmonics is 0 to {MAX_DEGREE}, not {degree}")
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


def series(coefficients: Float[Tensor, "k c"], d: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """Values at unit directions of functions with given coefficients: `basis(d, degree) @ coefficients`.

    It takes a third of the time of that expression for the directions of a training step.
    """
    return _Series.apply(coefficients, d)


def sum_series(
    coefficients: Float[Tensor, "k c"], xyz: Float[Tensor, "3 n"]
) -> tuple[Float[Tensor, "c n"], Float[Tensor, "m n"]]:
    """Values of `series` and the monomials that `series_adjoint` needs, for callers with an explicit derivative."""
    monomials = _monomials(xyz, math.isqrt(len(coefficients)) - 1)
    of_harmonics, _ = _polynomials(len(coefficients), xyz.dtype, xyz.device)
    return (coefficients.mT @ of_harmonics) @ monomials, monomials


def series_adjoint(
    coefficients: Float[Tensor, "k c"], monomials: Float[Tensor, "m n"], v: Float[Tensor, "c n"]
) -> tuple[Float[Tensor, "k c"], Float[Tensor, "3 n"]]:
    """Gradients of coefficients and directions from the gradient `v` of the values."""
    of_harmonics, derivatives = _polynomials(len(coefficients), v.dtype, v.device)
    # The product in this order takes a fifth of the time of its transpose.
    v_coefficients = of_harmonics @ (v @ monomials.mT).mT
    c, lower = len(v), derivatives.shape[1]
    slopes = (coefficients.mT @ of_harmonics @ derivatives.mT).flatten(0, 1) @ monomials[:lower]
    return v_coefficients, (slopes.unflatten(0, (3, c)) * v).sum(1)


class _Series(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, d: Tensor) -> Tensor:
        values, monomials = sum_series(coefficients, d.mT.contiguous())
        ctx.save_for_backward(coefficients, monomials)
        return values.mT

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        coefficients, monomials = ctx.saved_tensors
        v_coefficients, v_xyz = series_adjoint(coefficients, monomials, v.mT.contiguous())
        return v_coefficients, v_xyz.mT


def project(radiance: Float[Tensor, "h w c"]) -> Float[Tensor, "16 c"]:
    """Coefficients of an equirectangular map; each texel counts with its exact solid angle."""
    h, w, _ = radiance.shape
    like = {"dtype": radiance.dtype, "device": radiance.device}
    weighted = radiance * texel_solid_angles(h, w, **like)[..., None]
    return torch.einsum("hwk,hwc->kc", basis(texel_directions(h, w, **like), MAX_DEGREE), weighted)


def _monomials(xyz: Float[Tensor, "3 n"], degree: int) -> Float[Tensor, "m n"]:
    """Values of `MONOMIALS` up to a degree."""
    x, y, z = xyz
    m = xyz.new_empty((1, 4, 10, 20)[degree], xyz.shape[1])
    m[0] = 1
    if degree >= 1:
        m[1:4] = xyz
    if degree >= 2:
        torch.mul(x, m[1:4], out=m[4:7])
        torch.mul(y, m[2:4], out=m[7:9])
        torch.mul(z, z, out=m[9])
    if degree >= 3:
        torch.mul(x, m[4:10], out=m[10:16])
        torch.mul(y, m[7:10], out=m[16:19])
        torch.mul(z, m[9], out=m[19])
    return m


@cache
def _polynomials(
    k: int, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "k m"], Float[Tensor, "3 lower m"]]:
    """Coefficients over monomials of the first k harmonics, and of the derivatives of monomials along x, y and z."""
    degree = math.isqrt(k) - 1
    names, lower = MONOMIALS[: (1, 4, 10, 20)[degree]], (1, 1, 4, 10)[degree]
    of_harmonics = torch.zeros(k, len(names), dtype=torch.float64)
    for row, (norm, terms) in enumerate(POLYNOMIALS[:k]):
        for name, factor in terms.items():
            of_harmonics[row, names.index(name)] = factor * _norm(*norm)
    derivatives = torch.zeros(3, lower, len(names), dtype=torch.float64)
    for column, name in enumerate(names):
        for axis, letter in enumerate("xyz"):
            if power := name.count(letter):
                derivatives[axis, names.index(name.replace(letter, "", 1)), column] = power
    return of_harmonics.to(device, dtype), derivatives.to(device, dtype)


def _norm(numerator: int, denominator: int) -> float:
    """Normalisation factor of a harmonic, sqrt(numerator / denominator / pi)."""
    return math.sqrt(numerator / denominator / math.pi)
