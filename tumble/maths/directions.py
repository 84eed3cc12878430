"""Unit vectors: sets of them, frames around them, and their places on an equirectangular map.

Map convention (format.md): for a unit direction d, `u = atan2(d.x, -d.z) / 2pi + 1/2`, `v = acos(d.y) / pi`.
The centre of the map is -z, its right quarter +x, its top row +y. Texel centres lie at +0.5.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Turn between neighbours on a Fibonacci spiral [radians]."""


def equirect_from_direction(d: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
    """Map coordinates (u, v) of directions, u in [0, 1), v in [0, 1]; `d` need not have unit length.

    Differentiable but at the poles, where u has no derivative: there it is zero, as is that of v.
    """
    x, y, z = d.unbind(-1)
    across2 = x.square() + z.square()
    pole = across2 == 0
    # atan2(0, 0) has an infinite gradient, even where it is not used.
    u = torch.atan2(torch.where(pole, 0.0, x), torch.where(pole, 1.0, -z)) / (2 * math.pi) + 0.5
    # acos(y), without its loss of digits near the poles.
    across = torch.where(pole, 0.0, torch.where(pole, 1.0, across2).sqrt())
    v = torch.atan2(across, y) / math.pi
    return torch.stack([torch.where(u >= 1, u - 1, u), v], -1)


def direction_from_equirect(uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
    """Unit directions at map coordinates (u, v)."""
    phi, theta = 2 * math.pi * (uv[..., 0] - 0.5), math.pi * uv[..., 1]
    return torch.stack([theta.sin() * phi.sin(), theta.cos(), -theta.sin() * phi.cos()], -1)


def texel_directions(
    height: int, width: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "h w 3"]:
    """Unit directions at the centres of a map's texels."""
    v = (torch.arange(height, dtype=dtype, device=device) + 0.5) / height
    u = (torch.arange(width, dtype=dtype, device=device) + 0.5) / width
    v, u = torch.meshgrid(v, u, indexing="ij")
    return direction_from_equirect(torch.stack([u, v], -1))


def texel_solid_angles(
    height: int, width: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "h w"]:
    """Exact solid angles of a map's texels [steradian]; they sum to 4 pi."""
    # The difference of two cosines as a product: no cancellation in the thin rows at the poles.
    centre = math.pi * (torch.arange(height, dtype=dtype, device=device) + 0.5) / height
    rows = 2 * math.pi / width * 2 * math.sin(math.pi / 2 / height) * centre.sin()
    return rows[:, None].expand(height, width)


def fibonacci_sphere(
    n: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "n 3"]:
    """`n` directions spread evenly over the sphere; each stands for 4 pi / n [steradian]."""
    return _spiral(1 - (torch.arange(n, dtype=torch.float64) + 0.5) * 2 / n).to(dtype=dtype, device=device)


def local_frame(n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """R_world_local with columns (tangent, bitangent, n): right-handed, around unit vectors (Duff et al.).

    Smooth in `n` on each half z >= 0 and z < 0, without a singular direction.
    """
    x, y, z = n.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(n)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangent = torch.stack([b, sign + y * y * a, -y], -1)
    return torch.stack([tangent, bitangent, n], -1)


def reflect(d: Float[Tensor, "*b 3"], n: Float[Tensor, "*c 3"]) -> Float[Tensor, "*d 3"]:
    """Mirror of `d`, which points away from the surface, at unit normals `n`; so does the result."""
    return 2 * (n * d).sum(-1, keepdim=True) * n - d


def random_rotation(generator: torch.Generator, *, dtype: torch.dtype = torch.float32) -> Float[Tensor, "3 3"]:
    """A rotation drawn uniformly, on the generator's device."""
    like = {"dtype": dtype, "device": generator.device, "generator": generator}
    Q, R = torch.linalg.qr(torch.randn(3, 3, **like))
    # With the signs of R's diagonal fixed the factorisation is unique and Q uniform; then its determinant's.
    Q = Q * R.diagonal().sign()
    return Q * torch.linalg.det(Q).sign()


def _spiral(heights: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Directions at the given z, each a golden angle further round than the one before."""
    turn = GOLDEN_ANGLE * torch.arange(heights.shape[0], dtype=heights.dtype)
    across = (1 - heights.square()).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), heights], -1)
