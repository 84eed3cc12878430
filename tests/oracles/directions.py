"""Directions from polar angles, and a Fibonacci lattice on the hemisphere."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths.directions import GOLDEN_ANGLE


def spherical(theta: float | Float[Tensor, "*b"], phi: float | Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
    """Unit directions at polar angle `theta` from +z and azimuth `phi` from +x [radians]; z is up."""
    like = theta if isinstance(theta, Tensor) else phi if isinstance(phi, Tensor) else torch.zeros(())
    to = {"dtype": like.dtype, "device": like.device}
    t, p = torch.broadcast_tensors(torch.as_tensor(theta, **to), torch.as_tensor(phi, **to))
    return torch.stack([t.sin() * p.cos(), t.sin() * p.sin(), t.cos()], -1)


def fibonacci_hemisphere(n: int, *, dtype: torch.dtype = torch.float32) -> tuple[Float[Tensor, "n 3"], float]:
    """`n` directions of a Fibonacci lattice around +z, and the solid angle 2 pi / n [steradian] of each.

    They lie at the midpoints of equal slices down to the horizon, which makes integrals unbiased.
    """
    i = torch.arange(n, dtype=torch.float64)
    z = (i + 0.5) / n
    radius, phi = (1 - z * z).sqrt(), GOLDEN_ANGLE * i
    return torch.stack([radius * phi.cos(), radius * phi.sin(), z], -1).to(dtype), 2 * math.pi / n
