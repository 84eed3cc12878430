"""Directions on the unit sphere: equirectangular maps, uniform sampling, tangent frames, reflection.

Map convention (docs/format.md): for a unit direction d, `u = atan2(d.x, -d.z) / 2pi + 1/2`, `v = acos(d.y) / pi`.
The centre of the map is -z, its right quarter +x, its top row +y. Texel centres lie at +0.5.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Azimuth between consecutive points of a Fibonacci spiral [radians]."""


def equirect_from_direction(d: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
    """Map coordinates (u, v) of directions, u in [0, 1), v in [0, 1]; `d` need not have unit length.

    Differentiable except at the poles, where u has no derivative; both gradients are set to zero there.
    """
    x, y, z = d.unbind(-1)
    horizontal2 = x.square() + z.square()
    pole = horizontal2 == 0
    # Both arguments are replaced because the infinite gradient of atan2(0, 0) would turn into NaN under torch.where.
    u = torch.atan2(torch.where(pole, 0.0, x), torch.where(pole, 1.0, -z)) / (2 * math.pi) + 0.5
    # atan2 instead of acos(y), which loses digits near the poles.
    horizontal = torch.where(pole, 0.0, torch.where(pole, 1.0, horizontal2).sqrt())
    v = torch.atan2(horizontal, y) / math.pi
    return torch.stack([torch.where(u >= 1, u - 1, u), v], -1)


def direction_from_equirect(uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
    """Unit directions at map coordinates (u, v)."""
    phi, theta = 2 * math.pi * (uv[..., 0] - 0.5), math.pi * uv[..., 1]
    return torch.stack([theta.sin() * phi.sin(), theta.cos(), -theta.sin() * phi.cos()], -1)


def texel_directions(
    height: int, width: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "h w 3"]:
    """Unit directions through the texel centres of an equirectangular map."""
    v = (torch.arange(height, dtype=dtype, device=device) + 0.5) / height
    u = (torch.arange(width, dtype=dtype, device=device) + 0.5) / width
    v, u = torch.meshgrid(v, u, indexing="ij")
    return direction_from_equirect(torch.stack([u, v], -1))


def texel_solid_angles(
    height: int, width: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "h w"]:
    """Exact solid angles of the texels of an equirectangular map [steradian]; their sum is 4 pi."""
    # The difference of two cosines is written as a product, which does not cancel in the thin rows at the poles.
    centre = math.pi * (torch.arange(height, dtype=dtype, device=device) + 0.5) / height
    rows = 2 * math.pi / width * 2 * math.sin(math.pi / 2 / height) * centre.sin()
    return rows[:, None].expand(height, width)


def fibonacci_sphere(
    n: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "n 3"]:
    """`n` directions of a Fibonacci lattice on the sphere; each represents a solid angle of 4 pi / n [steradian]."""
    return _spiral(1 - (torch.arange(n, dtype=torch.float64) + 0.5) * 2 / n).to(dtype=dtype, device=device)


def local_frame(n: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Right-handed tangent frames R_world_local with columns (tangent, bitangent, n) (Duff et al. 2017).

    Smooth in `n` within each hemisphere z >= 0 and z < 0, without a singular direction.
    """
    x, y, z = n.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(n)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangent = torch.stack([b, sign + y * y * a, -y], -1)
    return torch.stack([tangent, bitangent, n], -1)


def reflect(d: Float[Tensor, "*b 3"], n: Float[Tensor, "*c 3"]) -> Float[Tensor, "*d 3"]:
    """Mirror reflection of `d` about unit normals `n`; both `d` and the result point away from the surface."""
    return 2 * (n * d).sum(-1, keepdim=True) * n - d


def random_rotation(generator: torch.Generator, *, dtype: torch.dtype = torch.float32) -> Float[Tensor, "3 3"]:
    """Uniformly distributed random rotation matrix, on the device of the generator."""
    like = {"dtype": dtype, "device": generator.device, "generator": generator}
    Q, R = torch.linalg.qr(torch.randn(3, 3, **like))
    # A positive diagonal of R makes the factorisation unique and Q uniform; the second factor makes det Q = 1.
    Q = Q * R.diagonal().sign()
    return Q * torch.linalg.det(Q).sign()


def _spiral(heights: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Directions with the given z, whose azimuth increases by the golden angle from one to the next."""
    phi = GOLDEN_ANGLE * torch.arange(heights.shape[0], dtype=heights.dtype)
    radius = (1 - heights.square()).sqrt()
    return torch.stack([radius * phi.cos(), radius * phi.sin(), heights], -1)
