"""Reference backend in torch, for any device and dtype; it defines the correct results of all backends.

It is written for readability; gradients are those of autograd. Vocabulary: `mu` centre, `p_cam` centre in the camera
frame, `W` whitening matrix, `d` ray direction with z = 1, `peak` the point of a ray at which a Gaussian is largest.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor
from torch.nn.functional import normalize

from tumble.backends import (
    ALPHA_MAX,
    ALPHA_MIN,
    CORNER,
    FACING,
    NEAR,
    NEAR_SIGMAS,
    ROUGHNESS_MIN,
    T_MIN,
    Rendering,
)
from tumble.backends._brute import blockers, build, rotation, trace, unpack, visible

__all__ = ["blockers", "build", "rasterize", "ready", "shade", "trace", "visible"]

TILE = 32
"""Side of the squares that are rendered at once [pixels]; limits memory and does not affect results."""


class Thresholds(NamedTuple):
    """Thresholds of blending, which save time and make the image a discontinuous function of its inputs."""

    alpha_min: float
    """See `ALPHA_MIN`."""
    alpha_max: float
    """See `ALPHA_MAX`."""
    T_min: float
    """See `T_MIN`."""


THRESHOLDS = Thresholds(ALPHA_MIN, ALPHA_MAX, T_MIN)
"""The thresholds of all backends."""
NO_THRESHOLDS = Thresholds(0.0, 1.0, 0.0)
"""Blending without thresholds, for finite differences in tests."""


def ready(device: torch.device, dtype: torch.dtype) -> str:
    """Always empty: the reference accepts any device and dtype."""
    return ""


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
    sh: Float[Tensor, "n k 3"],
    corners: Float[Tensor, "n 4 c"],
    R_cam_obj: Float[Tensor, "3 3"],
    t_cam_obj: Float[Tensor, "3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    height: int,
    width: int,
    mask: Float[Tensor, "#h #w"],
) -> Rendering:
    """One view of the Gaussians; see `Backend.rasterize`."""
    view = project(means, quats, scales, opacity, sh, R_cam_obj, t_cam_obj)
    return composite(view, opacity, corners, t_cam_obj, fx_fy_cx_cy, mask.expand(height, width), THRESHOLDS)


class ProjectedView(NamedTuple):
    """The Gaussians of a view after culling, sorted by depth."""

    index: Int64[Tensor, " v"]
    """Indices of the Gaussians that were not culled."""
    p_cam: Float[Tensor, "v 3"]
    """Centres, camera frame."""
    WR_obj_cam: Float[Tensor, "v 3 3"]
    """Whitening matrices that take vectors in the camera frame."""
    normal: Float[Tensor, "v 3"]
    """Outward normals, object frame."""
    rgb: Float[Tensor, "v 3"]
    """Linear radiance."""


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
    sh: Float[Tensor, "n k 3"],
    R_cam_obj: Float[Tensor, "3 3"],
    t_cam_obj: Float[Tensor, "3"],
) -> ProjectedView:
    """The Gaussians of a view: culled, sorted by depth, and with their radiance towards the camera."""
    R_obj_local = rotation(quats)
    p_cam = means @ R_cam_obj.T + t_cam_obj
    R_cam_local = R_cam_obj @ R_obj_local
    with torch.no_grad():
        z = p_cam[:, 2]
        sigma_z = (R_cam_local[:, 2] * scales).norm(dim=-1)
        facing = (normalize(p_cam, dim=-1) * R_cam_local[:, :, 2]).sum(-1)
        kept = (z > NEAR) & (z > NEAR_SIGMAS * sigma_z) & (facing <= FACING) & (opacity >= ALPHA_MIN)
        index = torch.where(kept)[0]
        index = index[torch.argsort(z[index], stable=True)]
    p_cam, R_cam_local = p_cam[index], R_cam_local[index]
    direction = normalize(p_cam @ R_cam_obj, dim=-1)
    Y = harmonics(direction, sh.shape[1])
    rgb = torch.einsum("vk,vkc->vc", Y, sh[index]).clamp(min=0)
    WR_obj_cam = R_cam_local.mT / scales[index, :, None]
    return ProjectedView(index, p_cam, WR_obj_cam, R_obj_local[index, :, 2], rgb)


def composite(
    view: ProjectedView,
    opacity: Float[Tensor, " n"],
    corners: Float[Tensor, "n 4 c"],
    t_cam_obj: Float[Tensor, "3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    mask: Float[Tensor, "h w"],
    thresholds: Thresholds,
) -> Rendering:
    """One view: its Gaussians blended front to back, one square of pixels after the other."""
    height, width = mask.shape
    n, c = corners.shape[0], corners.shape[2]
    sums = opacity.new_zeros(height, width, 9 + c)
    weight = opacity.new_zeros(n)
    touched = torch.zeros(n, dtype=torch.int32, device=mask.device)
    dominant = torch.full((height, width), -1, dtype=torch.int32, device=mask.device)
    z_0 = t_cam_obj[2].detach()
    rows = []
    for top in range(0, height, TILE):
        row = []
        for left in range(0, width, TILE):
            square = (slice(top, min(top + TILE, height)), slice(left, min(left + TILE, width)))
            d = _rays(fx_fy_cx_cy, square)
            near = _near(view, opacity, d, thresholds)
            part = ProjectedView(*(x[near] for x in view))
            w, values = _blend(part, opacity, corners, d, z_0, thresholds)
            row.append(torch.einsum("pv,pvc->pc", w, values).unflatten(0, sums[square].shape[:2]))
            if part.index.numel():
                with torch.no_grad():
                    weight.index_add_(0, part.index, w.sum(0))
                    counted = ((w > 0) & (mask[square].reshape(-1, 1) > 0.5)).sum(0, dtype=torch.int32)
                    touched.index_add_(0, part.index, counted)
                    best, which = w.max(1)
                    winner = torch.where(best > 0, part.index[which], -1).to(torch.int32)
                    dominant[square] = winner.view(dominant[square].shape)
        rows.append(torch.cat(row, 1))
    sums = torch.cat(rows, 0)
    return _finish(sums, z_0, weight, touched, dominant)


def _finish(
    sums: Float[Tensor, "h w s"],
    z_0: Float[Tensor, ""],
    weight: Float[Tensor, " n"],
    touched: Int32[Tensor, " n"],
    dominant: Int32[Tensor, "h w"],
) -> Rendering:
    """The rendering whose means are computed from weighted sums."""
    rgb, alpha, z, zz, normal, features = sums.split([3, 1, 1, 1, 3, sums.shape[2] - 9], -1)
    covered = alpha > 0
    divisor = torch.where(covered, alpha, 1)
    z, zz = z / divisor, zz / divisor
    depth = torch.where(covered, z_0 + z, 0)
    depth_var = zz - z * z
    return Rendering(
        rgb,
        alpha[..., 0],
        depth[..., 0],
        depth_var[..., 0],
        normal / divisor,
        features / divisor,
        weight,
        touched,
        dominant,
    )


def _rays(fx_fy_cx_cy: Float[Tensor, "4"], square: tuple[slice, slice]) -> Float[Tensor, "p 3"]:
    """Ray directions with z = 1 through the pixel centres of a square, row by row."""
    fx, fy, cx, cy = fx_fy_cx_cy
    y, x = (torch.arange(s.start, s.stop).to(fx_fy_cx_cy) + 0.5 for s in square)
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], -1).view(-1, 3)


@torch.no_grad()
def _near(
    view: ProjectedView, opacity: Float[Tensor, " n"], d: Float[Tensor, "p 3"], thresholds: Thresholds
) -> Bool[Tensor, " v"]:
    """A superset of the Gaussians that contribute to any of the rays: bounding spheres that intersect their cone."""
    if thresholds.alpha_min == 0 or view.index.numel() == 0:
        return torch.ones_like(view.index, dtype=torch.bool)
    d = normalize(d, dim=-1)
    axis = normalize(d.mean(0), dim=-1)
    cone = torch.acos((d @ axis).min().clamp(-1, 1))
    distance = view.p_cam.norm(dim=-1)
    sigmas = (2 * torch.log(opacity[view.index] / thresholds.alpha_min)).clamp(min=0).sqrt()
    largest = 1 / view.WR_obj_cam.norm(dim=-1).amin(-1)
    reach = torch.asin((sigmas * largest / distance).clamp(max=1))
    angle = torch.acos((view.p_cam @ axis / distance).clamp(-1, 1))
    return angle <= cone + reach + 1e-3


def _blend(
    view: ProjectedView,
    opacity: Float[Tensor, " n"],
    corners: Float[Tensor, "n 4 c"],
    d: Float[Tensor, "p 3"],
    z_0: Float[Tensor, ""],
    thresholds: Thresholds,
) -> tuple[Float[Tensor, "p v"], Float[Tensor, "p v s"]]:
    """Blending weights of Gaussians at pixels, and their values to blend: rgb, 1, z, z^2, normal, features."""
    Wd = torch.einsum("vij,pj->pvi", view.WR_obj_cam, d)
    Wp = torch.einsum("vij,vj->vi", view.WR_obj_cam, view.p_cam)
    z = (Wd * Wp).sum(-1) / (Wd * Wd).sum(-1)
    peak = z[..., None] * Wd - Wp
    alpha = opacity[view.index] * torch.exp(-0.5 * (peak * peak).sum(-1))
    alpha = torch.where(alpha >= thresholds.alpha_min, alpha.clamp(max=thresholds.alpha_max), 0)
    T = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], 1), 1)[:, :-1]
    w = torch.where(thresholds.T_min > T, 0, alpha * T)
    u, v = (peak[..., :2] / (2 * CORNER) + 0.5).clamp(0, 1)[..., None].unbind(-2)
    f_00, f_10, f_01, f_11 = corners[view.index].unbind(1)
    features = (1 - v) * ((1 - u) * f_00 + u * f_10) + v * ((1 - u) * f_01 + u * f_11)
    z = (z - z_0)[..., None]
    fixed = torch.cat([view.rgb, view.normal], -1).expand(*alpha.shape, 6)
    values = torch.cat([fixed[..., :3], torch.ones_like(z), z, z * z, fixed[..., 3:], features], -1)
    return w, values


def harmonics(d: Float[Tensor, "*b 3"], k: int) -> Float[Tensor, "*b k"]:
    """The first k real spherical harmonics at unit directions, with the signs of 3D Gaussian splatting."""
    x, y, z = d.unbind(-1)
    one = torch.ones_like(x)
    basis = [0.28209479177387814 * one]
    if k > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if k > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if k > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)


def shade(
    normal: Float[Tensor, "p 3"],
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
    view: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "p words"],
    blocker: Int32[Tensor, "#p #d"],
    blocker_radiance: Float[Tensor, "m 3"],
    f0: float,
) -> Float[Tensor, "p 3"]:
    """See `Backend.shade`."""
    d = directions.shape[0]
    arriving = torch.where(unpack(visibility, d)[..., None], radiance, 0)
    if blocker_radiance.shape[0]:
        blocker = blocker.expand(len(normal), d)
        is_blocked = ~unpack(visibility, d) & (blocker >= 0)
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
    fresnel = f0 * (1 + 24 * m**3 * (0.9878 + m * (-3.8886 + m * (9.1922 + m * (-9.6217 + m * 4.3303)))))
    g_v, g_w = (0.5 * (x + (a * a + (1 - a * a) * x * x).sqrt()) for x in (n_v.clamp(min=0), n_w.clamp(min=0)))
    specular = torch.where(exists, fresnel * a * a / (4 * math.pi * t * t * g_v * g_w), 0)
    lit = arriving * (n_w.clamp(min=0) * (4 * math.pi / d))[..., None]
    return albedo / math.pi * lit.sum(1) + torch.einsum("pd,pdc->pc", specular, lit)
