"""Reference backend in torch, for any device and dtype; it defines the correct results of all backends.

It is written for readability; gradients are those of autograd. Vocabulary: `mu` centre, `p_cam` centre in the camera
frame, `W` whitening matrix, `d` ray direction with z = 1, `peak` the point of a ray at which a Gaussian is largest.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64, UInt8
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, normalize, softplus

from tumble.backends import (
    ALPHA_MAX,
    ALPHA_MIN,
    CORNER,
    FACING,
    IRRADIANCE_FLOOR,
    KNEE,
    NARROW_ROUGHNESS,
    NEAR,
    NEAR_SIGMAS,
    NORMAL_GRADIENT,
    OBJECT,
    RATIO_MAX,
    ROUGHNESS_MIN,
    SATURATED,
    SSIM_SIGMA,
    SSIM_STABILISERS,
    SSIM_WINDOW,
    T_MIN,
    UNKNOWN,
    Leaf,
    Rendering,
    SampledView,
    ShadingLight,
)
from tumble.backends._brute import blockers, build, lookup, rotation, shade, trace, visible

__all__ = [
    "activate",
    "adam",
    "blockers",
    "bounce",
    "build",
    "corner_features",
    "gaussian_terms",
    "image_terms",
    "lookup",
    "material_terms",
    "prefilter",
    "rasterize",
    "ready",
    "sh_shade",
    "shade",
    "shading_term",
    "trace",
    "visible",
]

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


def sh_shade(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    albedo_logits: Float[Tensor, "n 3"],
    light: Float[Tensor, "2 16 3"],
    specular_scale: Float[Tensor, ""],
    occluded: Float[Tensor, "m 9"],
    unoccluded: Float[Tensor, "m 9"],
    directions: Float[Tensor, "d 3"],
    reflectance: Float[Tensor, " k"],
    R_env_obj: Float[Tensor, "3 3"],
    position: Float[Tensor, "3"],
) -> Float[Tensor, "n 3"]:
    """See `Backend.sh_shade`."""

    def at(lobe: int, d_obj: Tensor) -> Tensor:
        return softplus(harmonics(d_obj @ R_env_obj.T, 16) @ light[lobe])

    normals = rotation(quats)[:, :, 2]
    normals = torch.lerp(normals.detach(), normals, NORMAL_GRADIENT)
    view, albedo = normalize(position - means, dim=-1), torch.sigmoid(albedo_logits)
    n_v = (normals * view).sum(-1, keepdim=True)
    facing = n_v > 0
    fresnel = sum(c * (1 - n_v.clamp(max=1)) ** k for k, c in enumerate(reflectance))
    specular = specular_scale * fresnel * at(1, 2 * n_v * normals - view)
    if not len(occluded):
        return torch.where(facing, albedo * at(0, normals) + specular, 0)
    with torch.no_grad():
        radiance = at(1, directions)
        coefficients = 4 * math.pi / len(directions) * harmonics(directions, 9).T @ radiance
        floor = IRRADIANCE_FLOOR * math.pi * radiance.mean(0)

        shadowed, full = (_irradiance(x, coefficients, albedo) + floor for x in (occluded, unoccluded))
        ratio = (shadowed / full.clamp(min=1e-12)).clamp(max=RATIO_MAX)
    return torch.where(facing, albedo * ratio * at(0, normals) + specular, 0)


def _irradiance(transfer: Tensor, coefficients: Tensor, albedo: Tensor) -> Tensor:
    """H of `Backend.sh_shade`."""
    visible_fraction = (transfer[:, :1] * math.sqrt(4 / math.pi)).clamp(0, 1)
    return (transfer @ coefficients).clamp(min=0) / (1 - albedo * (1 - visible_fraction)).clamp(min=1e-3)


def image_terms(
    rgb: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    depth_var: Float[Tensor, "h w"],
    normal: Float[Tensor, "h w 3"],
    photo: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"],
    R_cam_obj: Float[Tensor, "3 3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    ssim_weight: float,
    crease: float,
    weights: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
) -> Float[Tensor, "4"]:
    """See `Backend.image_terms`."""
    known, (srgb, image) = (mask != UNKNOWN).to(rgb), _as_captured(rgb, photo)
    x, y = srgb * known[..., None], image * known[..., None]
    photometric = (1 - ssim_weight) * (x - y).abs().mean() + ssim_weight * (1 - similarity(x, y)).mean()
    silhouette = ((alpha - (mask == OBJECT).to(rgb)) ** 2 * known).mean()
    deviation = torch.where(alpha > 0, (depth_var.clamp(min=0) + 1e-6).sqrt() - 1e-3, 0).mean()
    consistency = _normal_term(depth, alpha, normal, R_cam_obj, fx_fy_cx_cy, crease)
    terms = (photometric, silhouette, consistency, deviation)
    return torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)])


def similarity(x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 h-10 w-10"]:
    """Structural similarity (Wang et al. 2004) at all windows within two images."""
    offset = torch.arange(SSIM_WINDOW, dtype=x.dtype, device=x.device) - SSIM_WINDOW // 2
    taps = torch.softmax(-0.5 * (offset / SSIM_SIGMA) ** 2, 0)

    def mean(image: Tensor) -> Tensor:
        return conv2d(image.movedim(-1, 0)[:, None], torch.outer(taps, taps)[None, None])[:, 0]

    mean_x, mean_y, (c1, c2) = mean(x), mean(y), SSIM_STABILISERS
    var_x, var_y, covariance = mean(x * x) - mean_x**2, mean(y * y) - mean_y**2, mean(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    return luminance * (2 * covariance + c2) / (var_x + var_y + c2)


def _normal_term(
    depth: Tensor, alpha: Tensor, normal: Tensor, R_cam_obj: Tensor, fx_fy_cx_cy: Tensor, crease: float
) -> Float[Tensor, ""]:
    """The third of `image_terms`. A surface z(x, y) (X, Y, 1) has the normal (p, q, -1 - p X - q Y), p = fx z_x / z."""
    h, w = depth.shape
    covered, center = alpha > 0.5, (slice(1, -1), slice(1, -1))
    right, left, below, above = (1, 2), (1, 0), (2, 1), (0, 1)

    def neighbour(image: Tensor, at: tuple[int, int]) -> Tensor:
        return image[at[0] : h - 2 + at[0], at[1] : w - 2 + at[1]]

    known = covered[center]
    for at in (right, left, below, above):
        known = known & neighbour(covered, at)
    fx, fy, cx, cy = fx_fy_cx_cy
    x, y = (torch.arange(n, dtype=depth.dtype, device=depth.device) + 0.5 for n in (w, h))
    X, Y = (x - cx) / fx, (y - cy) / fy

    def slope(focal: Tensor, after: tuple[int, int], before: tuple[int, int]) -> Tensor:
        a, b = neighbour(depth, after), neighbour(depth, before)
        return focal * (a - b) / torch.where(known, a + b, 1)

    p, q = slope(fx, right, left), slope(fy, below, above)
    from_depth = normalize(torch.stack([p, q, -1 - p * X[1:-1] - q * Y[1:-1, None]], -1), dim=-1) @ R_cam_obj
    difference = 1 - (normalize(normal[center], dim=-1) * from_depth).sum(-1)
    return (difference / (1 + crease * difference) * known).sum() / (h * w)


def gaussian_terms(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    log_scales: Float[Tensor, "n 3"],
    sdf: Float[Tensor, " n"],
    gamma: Float[Tensor, ""],
    weight: Float[Tensor, " n"],
    depth: Float[Tensor, "h w"],
    R_cam_obj: Float[Tensor, "3 3"],
    t_cam_obj: Float[Tensor, "3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    floor: float,
    reach: float,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
) -> Float[Tensor, "3"]:
    """See `Backend.gaussian_terms`."""
    if not len(means):
        return means.sum() + means.new_zeros(3)
    log_fraction = (2 * log_scales).log_softmax(-1)
    entropy = -(log_fraction.exp() * log_fraction).sum(-1)
    needle = (-(entropy.exp() - 1).clamp(min=1e-4).log()).clamp(min=0)
    sharpness = (1.762747 / sdf.detach().abs().median().clamp(min=floor) - gamma).clamp(min=0)
    x_cam = (means - sdf[:, None] * rotation(quats)[:, :, 2]) @ R_cam_obj.T + t_cam_obj
    z, visible = x_cam[:, 2], weight > 0
    with torch.no_grad():
        uv = x_cam[:, :2] / x_cam[:, 2:] * fx_fy_cx_cy[:2] + fx_fy_cx_cy[2:]
        u, v = uv[:, 0] / depth.shape[1], uv[:, 1] / depth.shape[0]
        at = torch.stack([u, v], -1)[None, None] * 2 - 1
        surface = grid_sample(depth[None, None], at, align_corners=False)[0, 0, 0]
        inlier = visible & ((surface - z).abs() < reach) & (surface > 0)
        surface = torch.where(inlier, surface, 0)  # NaN behind the camera would reach the gradients
    difference = torch.where(inlier, (z - surface).abs(), 0).sum() / visible.sum().clamp(min=1)
    terms = (needle.mean() + log_scales[:, 2].exp().mean(), sharpness, difference)
    return torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)])


def activate(
    log_scales: Float[Tensor, "n 3"], sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """See `Backend.activate`."""
    inside = torch.sigmoid(-gamma * sdf)
    return log_scales.exp(), 4 * inside * (1 - inside)


@torch.no_grad()
def adam(leaves: Sequence[Leaf], loss: Tensor, failed: Tensor, beta_1: float, beta_2: float, eps: float) -> None:
    """See `Backend.adam`."""
    finite = torch.stack([loss.isfinite(), *(leaf.gradient.isfinite().all() for leaf in leaves)]).all()
    failed.copy_(torch.maximum(failed, 1 - finite.to(failed)))
    moves = failed == 0
    for leaf in leaves:
        leaf.count.add_(1 - failed)
        count, gradient = leaf.count.double(), leaf.gradient
        first = leaf.first.lerp(gradient, 1 - beta_1)
        second = (leaf.second * beta_2).addcmul(gradient, gradient, value=1 - beta_2)
        root = second.sqrt() / (1 - beta_2**count).sqrt() + eps
        value = leaf.value - leaf.rate / (1 - beta_1**count) * first / root
        for old, new in ((leaf.value, value), (leaf.first, first), (leaf.second, second)):
            old.copy_(torch.where(moves, new, old))


def corner_features(
    albedo_logits: Float[Tensor, "n 4 3"],
    roughness_logits: Float[Tensor, "n 4"],
    normal_offset: Float[Tensor, "n 4 3"],
    temperature: float,
) -> tuple[Float[Tensor, "n 4 7"], Float[Tensor, "n 3"]]:
    """See `Backend.corner_features`."""
    albedo, roughness = (torch.sigmoid(x / temperature) for x in (albedo_logits, roughness_logits))
    return torch.cat([albedo, roughness[..., None], normal_offset], -1), albedo.mean(1)


def bounce(
    albedo: Float[Tensor, "n 3"],
    transfer: Float[Tensor, "n 9"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
) -> Float[Tensor, "n 3"]:
    """See `Backend.bounce`."""
    coefficients = 4 * math.pi / len(directions) * harmonics(directions, 9).T @ radiance
    return albedo / math.pi * _irradiance(transfer.detach(), coefficients, albedo)


def shading_term(
    view: SampledView,
    light: ShadingLight,
    R_cam_obj: Float[Tensor, "3 3"],
    R_env_obj: Float[Tensor, "3 3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    f0: Float[Tensor, "3"],
) -> Float[Tensor, ""]:
    """See `Backend.shading_term`."""
    counted, pixels, width = (view.pixels >= 0)[:, None], view.pixels.clamp(min=0), view.alpha.shape[1]
    albedo, roughness, offset = view.features.flatten(0, 1)[pixels].split([3, 1, 3], -1)
    normal = normalize(view.normal.flatten(0, 1)[pixels] + offset, dim=-1)
    fx, fy, cx, cy = fx_fy_cx_cy
    x, y = ((pixels % width + 0.5 - cx) / fx, (pixels // width + 0.5 - cy) / fy)
    towards = normalize(-torch.stack([x, y, torch.ones_like(x)], -1).to(normal) @ R_cam_obj, dim=-1)
    n_v, d = (normal * towards).sum(-1, keepdim=True), len(light.directions)
    looked = torch.cat([light.directions, 2 * n_v * normal - towards]) @ R_env_obj.T
    cell = torch.full_like(light.directions[:, 0], d**-0.25)
    arriving = lookup(light.stack, looked, torch.cat([cell, roughness[:, 0]]))
    sky, mirrored = arriving.split([d, len(pixels)])
    bounced = bounce(light.albedo, light.transfer, light.directions, sky) if len(light.albedo) else sky[:0]
    rows = view.dominant.flatten()[pixels].clamp(min=0).long()
    seen = light.visibility, light.blocker, rows, bounced
    lobes = shade(normal, roughness[:, 0], towards, light.directions, sky, *seen)
    at = torch.cat(
        [2 * (roughness.clamp(min=ROUGHNESS_MIN) - ROUGHNESS_MIN) / (1 - ROUGHNESS_MIN), 2 * n_v.clamp(0, 1)], -1
    )
    options = {"padding_mode": "border", "align_corners": True}
    reflectance = grid_sample(light.table[None, None], at[None, None] - 1, **options)[0, 0, 0, :, None]
    narrow = mirrored * lobes.specular_visibility[:, None] * reflectance
    wide = ((roughness - NARROW_ROUGHNESS[0]) / (NARROW_ROUGHNESS[1] - NARROW_ROUGHNESS[0])).clamp(0, 1)
    reflected = albedo * lobes.diffuse + f0 * torch.lerp(narrow, lobes.specular, wide)
    srgb, image = _as_captured(reflected * view.alpha.flatten()[pixels, None], view.photo.flatten(0, 1)[pixels])
    return ((srgb - image).abs() * counted).mean()


def _as_captured(linear: Float[Tensor, "*b 3"], photo: UInt8[Tensor, "*b 3"]) -> tuple[Tensor, Tensor]:
    """A linear rendering in sRGB, at most the photo where that is saturated, and the photo from 0 to 1."""
    power = 1.055 * linear.clamp(min=KNEE) ** (1 / 2.4) - 0.055
    srgb, image = torch.where(linear <= KNEE, 12.92 * linear.clamp(min=0), power), photo.to(linear) / 255
    return torch.where((photo >= SATURATED) & (srgb > image), image, srgb), image


def prefilter(radiance: Float[Tensor, "h w 3"], lobes: Float[Tensor, "f rows h"]) -> Float[Tensor, "out w 3"]:
    """See `Backend.prefilter`."""
    width, rows = radiance.shape[1], lobes.shape[1]
    spectrum = torch.view_as_real(torch.fft.rfft(radiance.permute(2, 0, 1)))  # colour, row, frequency, part
    # The product in this order takes a quarter of the time of its transpose.
    filtered = spectrum.permute(2, 0, 3, 1).flatten(1, 2) @ lobes.mT
    filtered = filtered.view(-1, 3, 2, rows).permute(3, 1, 0, 2).contiguous()
    return torch.cat([radiance, torch.fft.irfft(torch.view_as_complex(filtered), n=width).mT])


def material_terms(
    features: Float[Tensor, "h w c"],
    alpha: Float[Tensor, "h w"],
    photo: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"],
) -> Float[Tensor, "2"]:
    """See `Backend.material_terms`."""
    error = (alpha - (mask == OBJECT).to(alpha)) * (mask != UNKNOWN)
    x, y = features[..., :4] * ((mask == OBJECT) & (alpha > 0.5))[..., None], photo.to(alpha) / 255

    def along(dim: int) -> Tensor:
        weighted = x.diff(dim=dim).abs() * (-y.diff(dim=dim).abs()).exp().mean(-1, keepdim=True)
        return weighted.sum() / max(1, weighted.numel())

    return torch.stack([(error**2).mean(), along(1) + along(0)])
