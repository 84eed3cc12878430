"""Tracer and shading of the reference backend, in torch on any device and dtype.

By brute force: every ray against every Gaussian, every point under every direction.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor
from torch.nn.functional import normalize

from tumble.backends import ALPHA_MAX, ALPHA_MIN, ROUGHNESS_MIN, TRACE_SIGMAS, TRACE_T_MIN, VISIBLE, Hits, Lobes

MAX_PAIRS = 1 << 22
"""Ray-Gaussian pairs that are computed at once; limits memory and does not affect results."""


class GaussianList(NamedTuple):
    """The result of `build`: all Gaussians, without a search tree."""

    means: Float[Tensor, "n 3"]
    W: Float[Tensor, "n 3 3"]
    """Whitening matrices."""
    opacity: Float[Tensor, " n"]
    normals: Float[Tensor, "n 3"]


@torch.no_grad()
def build(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
) -> GaussianList:
    """See `Backend.build`."""
    R_obj_local = rotation(quats)
    return GaussianList(means, R_obj_local.mT / scales[..., None], opacity, R_obj_local[..., 2])


@torch.no_grad()
def trace(
    bvh: GaussianList,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "m 3"],
) -> Hits:
    """See `Backend.trace`."""
    n, r = len(bvh.means), len(origins)
    if n == 0 or r == 0:
        none = torch.full((r,), -1, dtype=torch.int32, device=origins.device)
        return Hits(origins.new_ones(r), origins.new_zeros(r, 3), none)
    chunk = max(1, MAX_PAIRS // n)
    parts = [_trace(bvh, o, d, radiance) for o, d in zip(origins.split(chunk), directions.split(chunk), strict=True)]
    return Hits(*(torch.cat(x) for x in zip(*parts, strict=True)))


def _trace(
    bvh: GaussianList,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "m 3"],
) -> Hits:
    Wd = torch.einsum("nij,rj->rni", bvh.W, directions)
    Wp = torch.einsum("nij,rnj->rni", bvh.W, bvh.means - origins[:, None])
    z = (Wd * Wp).sum(-1) / (Wd * Wd).sum(-1)
    distance_2 = (z[..., None] * Wd - Wp).square().sum(-1)
    alpha = (bvh.opacity * torch.exp(-0.5 * distance_2)).clamp(max=ALPHA_MAX)
    is_hit = (z > 0) & (distance_2 <= TRACE_SIGMAS**2) & (alpha >= ALPHA_MIN) & (directions @ bvh.normals.T <= 0)
    order = torch.argsort(torch.where(is_hit, z, math.inf), dim=1, stable=True)
    alpha = torch.where(is_hit, alpha, 0).gather(1, order)
    T = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], 1), 1)
    w = torch.where(T[:, :-1] >= TRACE_T_MIN, alpha * T[:, :-1], 0)
    total = w.sum(1)
    blocked = 1 - total < TRACE_T_MIN
    sums = radiance.new_zeros(len(w), 3) if len(radiance) == 0 else torch.einsum("rn,rnc->rc", w, radiance[order])
    sums = torch.where(blocked[:, None], sums / total[:, None], sums)
    best, which = w.max(1)
    hit = torch.where(best > 0, order.gather(1, which[:, None])[:, 0], -1)
    return Hits(torch.where(blocked, 0, 1 - total), sums, hit.to(torch.int32))


def visible(
    bvh: GaussianList,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
) -> Int32[Tensor, "p words"]:
    """See `Backend.visible`."""
    above, hits = _around(bvh, points, normals, directions)
    return pack(above & (hits.transmittance.view(above.shape) >= VISIBLE))


def blockers(
    bvh: GaussianList,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "p words"],
) -> Int32[Tensor, "p d"]:
    """See `Backend.blockers`."""
    above, hits = _around(bvh, points, normals, directions)
    return torch.where(above & ~unpack(visibility, directions.shape[0]), hits.hit.view(above.shape), -1)


def _around(
    bvh: GaussianList, points: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"], directions: Float[Tensor, "d 3"]
) -> tuple[Bool[Tensor, "p d"], Hits]:
    """Which directions are above the horizon of each point, and the hits of rays in all directions from all points."""
    p, d = len(points), len(directions)
    hits = trace(bvh, points.repeat_interleave(d, 0), directions.repeat(p, 1), points.new_zeros(0, 3))
    return normals @ directions.T > 0, hits


def shade(
    normal: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
    view: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "q words"],
    blocker: Int32[Tensor, "#q #d"],
    rows: Int64[Tensor, " p"],
    blocker_radiance: Float[Tensor, "m 3"],
) -> Lobes:
    """See `Backend.shade`."""
    d = directions.shape[0]
    visible = unpack(visibility, d)[rows]
    arriving = torch.where(visible[..., None], radiance, 0)
    if blocker_radiance.shape[0]:
        blocker = blocker.expand(len(visibility), d)[rows]
        is_blocked = ~visible & (blocker >= 0)
        arriving = torch.where(is_blocked[..., None], blocker_radiance[blocker.clamp(min=0).long()], arriving)
    a = roughness.clamp(min=ROUGHNESS_MIN)[:, None] ** 2
    n_w = normal @ directions.T
    n_v = (normal * view).sum(-1, keepdim=True)
    HH = 2 * (1 + view @ directions.T)
    exists = (HH > 1e-6) & (n_v > 0)
    HH = torch.where(exists, HH, 1)
    H = view[:, None] + directions
    t = (torch.linalg.cross(normal[:, None], H).square().sum(-1) + a * a * (n_v + n_w) ** 2) / HH
    m = 1 - 0.5 * HH.sqrt()
    fresnel = 1 + 24 * m**3 * (0.9878 + m * (-3.8886 + m * (9.1922 + m * (-9.6217 + m * 4.3303))))
    g_v, g_w = (0.5 * (x + (a * a + (1 - a * a) * x * x).sqrt()) for x in (n_v.clamp(min=0), n_w.clamp(min=0)))
    specular = torch.where(exists, fresnel * a * a / (4 * math.pi * t * t * g_v * g_w), 0)
    lit = arriving * (n_w.clamp(min=0) * (4 * math.pi / d))[..., None]
    with torch.no_grad():
        c = ((2 * n_v * normal - view) @ directions.T).clamp(min=0)
        bb = a.clamp(min=math.sqrt(math.pi / d) / 2) ** 2
        weight = torch.where(n_w > 0, c / (0.5 * (1 - c) + bb * 0.5 * (1 + c)) ** 2, 0)
        fraction = (weight * visible).sum(-1) / weight.sum(-1).clamp(min=torch.finfo(weight.dtype).tiny)
    return Lobes(lit.sum(1) / math.pi, torch.einsum("pd,pdc->pc", specular, lit), fraction)


def lookup(
    stack: Float[Tensor, "levels h w 3"],
    directions: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
) -> Float[Tensor, "p 3"]:
    """See `Backend.lookup`."""
    levels, h, w, _ = stack.shape
    x, y, z = directions.unbind(-1)
    rho2 = x * x + z * z
    # The gradient of atan2(0, 0) is infinite.
    pole = rho2 == 0
    rho = torch.where(pole, 0.0, torch.where(pole, 1.0, rho2).sqrt())
    u = torch.atan2(torch.where(pole, 0.0, x), torch.where(pole, 1.0, -z)) / (2 * math.pi) + 0.5
    column, row = u * w - 0.5, torch.atan2(rho, y) / math.pi * h - 0.5
    level = roughness.clamp(0, 1) * (levels - 1)
    left, top, low = (position.detach().floor() for position in (column, row, level))
    values = torch.zeros_like(directions)
    for k in range(8):
        right, down, up = k & 1, k >> 1 & 1, k >> 2
        at_level, at_row, at_column = (
            (low + up).long().clamp(max=levels - 1),
            (top + down).long(),
            (left + right).long(),
        )
        # The neighbour across a pole is the same row, half a revolution away.
        beyond = (at_row < 0) | (at_row >= h)
        at_column = torch.where(beyond, at_column + w // 2, at_column) % w
        x, y, z = column - left, row - top, level - low
        weight = (x if right else 1 - x) * (y if down else 1 - y) * (z if up else 1 - z)
        values = values + weight[:, None] * stack[at_level, at_row.clamp(0, h - 1), at_column]
    return values


def pack(bits: Bool[Tensor, "p d"]) -> Int32[Tensor, "p words"]:
    """Bits packed into words: bit j becomes bit j % 32 of word j // 32."""
    padded = torch.nn.functional.pad(bits, (0, -bits.shape[1] % 32)).unflatten(1, (-1, 32))
    words = (padded.long() << torch.arange(32, device=bits.device)).sum(-1)
    return torch.where(words < 1 << 31, words, words - (1 << 32)).to(torch.int32)


def unpack(words: Int32[Tensor, "p words"], d: int) -> Bool[Tensor, "p d"]:
    """The first d bits of each row of words, the inverse of `pack`."""
    bits = (words.long()[..., None] >> torch.arange(32, device=words.device)) & 1
    return bits.flatten(1)[:, :d].bool()


def rotation(quats: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of quaternions wxyz of any length except 0."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
