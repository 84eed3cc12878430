"""The terms of the paper's objectives (eq. 11, 14). Each is a scalar; none knows a model.

Pictures are sRGB in [0, 1], channels last. `valid` is 1 where the mask is known and 0 where it is not: unknown pixels
enter no term.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from tumble.maths import SE3, channels_first, edge_aware, srgb_from_linear, ssim_map
from tumble.rendering import Buffers
from tumble.scene import Camera, Gaussians

SSIM_MARGIN = 10
"""Pixels by which the window of `images.ssim_map` reaches beyond one of its pixels, both sides together."""
SATURATED = 254 / 255
"""Code value from which a photograph only says "at least this bright"."""


def developed(linear: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A rendering as the camera would store it, for comparison with a photograph.

    The sRGB curve goes on beyond 1, so that a pixel rendered too bright has a gradient; only where the photograph is
    saturated itself does a brighter rendering count as equal.
    """
    srgb = srgb_from_linear(linear)
    return torch.where((photograph >= SATURATED) & (srgb > photograph), photograph, srgb)


def photometric(
    rendered: Float[Tensor, "h w 3"],
    photograph: Float[Tensor, "h w 3"],
    valid: Float[Tensor, "h w 1"],
    *,
    ssim_weight: float,
    size: tuple[int, int] | None = None,
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM) over the picture (L_render, eq. 11).

    Args:
        size: Height and width of the picture where only a window of it is given, outside of which both are black, as
            is a margin of `SSIM_MARGIN` inside unless the picture ends there: the result is that of the whole picture.
    """
    height, width = size or rendered.shape[:2]
    rendered, photograph = rendered * valid, photograph * valid
    difference = (rendered - photograph).abs().sum() / (3 * height * width)
    unlike = (1 - ssim_map(rendered, photograph)).sum() / (3 * (height - SSIM_MARGIN) * (width - SSIM_MARGIN))
    return (1 - ssim_weight) * difference + ssim_weight * unlike


def silhouette(
    alpha: Float[Tensor, "h w"], mask: Float[Tensor, "h w"], valid: Float[Tensor, "h w 1"]
) -> Float[Tensor, ""]:
    """Squared difference between coverage and mask.

    The relatives take binary cross entropy; a pixel that the object covers by half has a hard mask all the same, and
    cross entropy pays without bound for admitting it.
    """
    return ((alpha - mask) ** 2 * valid[..., 0]).mean()


def surface_normals(
    depth: Float[Tensor, "h w"], covered: Bool[Tensor, "h w"], camera: Camera, T_cam_obj: SE3
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Normals of the depth map by central differences, object frame, and where all four neighbours are covered.

    With x = z (X, Y, 1) on the ray through a pixel, the cross product of the differences along both axes of the image
    is a positive multiple of (p, q, -1 - p X - q Y), where p = fx (z_right - z_left) / (z_right + z_left) and q alike.
    """
    inner = covered[1:-1, 1:-1] & covered[1:-1, 2:] & covered[1:-1, :-2] & covered[2:, 1:-1] & covered[:-2, 1:-1]
    known = pad(inner, (1, 1, 1, 1))
    fx, fy, cx, cy = camera.fx_fy_cx_cy.to(depth)
    height, width = depth.shape
    X = (torch.arange(1, width - 1).to(depth) + (0.5 - cx)) / fx
    Y = ((torch.arange(1, height - 1).to(depth) + (0.5 - cy)) / fy)[:, None]
    right, left, below, above = depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]
    p = fx * (right - left) / torch.where(inner, right + left, 1.0)
    q = fy * (below - above) / torch.where(inner, below + above, 1.0)
    n_cam = torch.stack([p, q, -1 - p * X - q * Y])
    n_cam = n_cam / n_cam.square().sum(0).sqrt()  # never zero; torch's norm is slow over an outer axis
    n_obj = T_cam_obj.rotation.matrix().mT @ n_cam.flatten(1)
    return pad(n_obj.unflatten(1, p.shape), (1, 1, 1, 1)).movedim(0, -1), known


def normal_consistency(
    normal: Float[Tensor, "h w 3"],
    from_depth: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
    *,
    crease: float = 0.0,
) -> Float[Tensor, ""]:
    """x = 1 - cosine between rendered normals and those of the depth (L_normal, eq. 11), averaged over the picture.

    Args:
        crease: With c above 0, x / (1 + c x): differences beyond 1 / c are an edge or a groove, which smoothing would
            round off or fill.
    """
    # One plane per axis: sums over short rows are slow.
    a, b = channels_first(normal), channels_first(from_depth)
    cosine = (a * b).sum(0) / a.square().sum(0).clamp_min(1e-24).sqrt()
    apart = 1 - cosine
    return (apart / (1 + crease * apart) * known).mean()


def variance(depth_var: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Standard deviation of depth along each ray (L_variance, eq. 11)."""
    return (depth_var.clamp_min(0) + 1e-6).sqrt().mean() - 1e-3


def effective_rank(log_scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Penalty on needles: 0 for discs and balls (L_rank, eq. 11), and the mean thickness, which is what flattens."""
    # Three long rows: softmax over many short ones takes most of a millisecond.
    log_share = (2 * log_scales.mT.contiguous()).log_softmax(0)
    entropy = -(log_share.exp() * log_share).sum(0)
    needle = (-(entropy.exp() - 1).clamp_min(1e-4).log()).clamp_min(0)
    return needle.mean() + log_scales[:, 2].exp().mean()


def sharpness(sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""], *, floor: float) -> Float[Tensor, ""]:
    """How far gamma is below the value at which the median Gaussian is half opaque (L_gamma).

    Args:
        floor: Median distance under which gamma is not pushed further [object radius].
    """
    median = sdf.detach().abs().median().clamp_min(floor)
    return (1.762747 / median - gamma).clamp_min(0)


def projection(
    gaussians: Gaussians,
    seen: Bool[Tensor, " n"],
    depth: Float[Tensor, "h w"],
    camera: Camera,
    T_cam_obj: SE3,
    *,
    reach: float,
) -> Float[Tensor, ""]:
    """Centres moved to the surface by their own signed distance should meet the rendered depth (L_proj).

    Args:
        seen: Gaussians that the view shows.
        depth: Rendered depth; no gradient flows to it.
        reach: Differences beyond this are another surface and do not count [object radius].
    """
    offset = gaussians.sdf[:, None] * gaussians.normals
    R_cam_obj = T_cam_obj.rotation.matrix()
    z = (gaussians.means - offset) @ R_cam_obj[2] + T_cam_obj.xyz[2]
    with torch.no_grad():
        xy = (gaussians.means - offset) @ R_cam_obj[:2].mT + T_cam_obj.xyz[:2]
        uv = camera.project(torch.cat([xy, z[:, None]], -1))
        at = (uv / uv.new_tensor([camera.width, camera.height]) * 2 - 1)[None, None]
        surface = grid_sample(depth[None, None], at, align_corners=False)[0, 0, 0]
        error = surface - z
        counts = seen & (error.abs() < reach) & (surface > 0)
        share = torch.where(counts, error.sign(), 0.0) / seen.sum().clamp_min(1)
        surface = torch.where(counts, surface, 0.0)
    return (share * (surface - z)).sum()


def unevenness(radiance: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean squared difference between neighbouring texels of a light map, around the seam too (L_light, eq. 14)."""
    down, across = radiance[1:] - radiance[:-1], radiance.roll(-1, 1) - radiance
    return (down**2).mean() + (across**2).mean()


def material(view: Buffers, mask: Float[Tensor, "h w"], photograph: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Edge-aware smoothness of albedo and roughness, which count as 0 beyond the outline (L_material, eq. 14).

    So it was published (Relightable 3D Gaussian). At the weights of STANDARD a torus loses nothing by it.
    """
    inside = (mask * (view.alpha > 0.5))[..., None]
    return edge_aware(torch.cat([view.features["albedo"], view.features["roughness"]], -1) * inside, photograph)
