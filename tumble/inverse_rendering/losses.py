"""Terms of the paper's objectives (eq. 11, 14), each a scalar.

Images are sRGB in [0, 1], channels last. `photo` is the input image. `valid` is 1 where the mask is known and 0
elsewhere; pixels with an unknown mask do not contribute.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from tumble.maths import SE3, channels_first, edge_aware, srgb_from_linear, ssim_map
from tumble.rendering import Buffers
from tumble.scene import Camera, Gaussians

SSIM_MARGIN = 10
"""Width of the window of `images.ssim_map` minus one [pixels]."""
SATURATED = 254 / 255
"""Value of the input image from which a pixel counts as saturated [sRGB]."""


def srgb_as_captured(linear: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A linear rendering in sRGB, clipped to the input image where the input image is saturated.

    Elsewhere values above 1 are not clipped, so that a pixel rendered too bright has a gradient.
    """
    srgb = srgb_from_linear(linear)
    return torch.where((photo >= SATURATED) & (srgb > photo), photo, srgb)


def photometric(
    rendered: Float[Tensor, "h w 3"],
    photo: Float[Tensor, "h w 3"],
    valid: Float[Tensor, "h w 1"],
    *,
    ssim_weight: float,
    size: tuple[int, int] | None = None,
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), averaged over the image, with w = `ssim_weight` (L_render, eq. 11).

    Args:
        rendered: Rendered image, or a window of it.
        photo: Input image, or the same window of it.
        valid: Validity of the pixels.
        ssim_weight: Weight of the SSIM term, 0 to 1.
        size: Height and width of the whole image if a window is given; the result is that of the whole image. Both
            images must be black outside of the window, and in a margin of `SSIM_MARGIN` inside of it except at the
            borders of the image.
    """
    height, width = size or rendered.shape[:2]
    rendered, photo = rendered * valid, photo * valid
    l1 = (rendered - photo).abs().sum() / (3 * height * width)
    dissimilarity = (1 - ssim_map(rendered, photo)).sum() / (3 * (height - SSIM_MARGIN) * (width - SSIM_MARGIN))
    return (1 - ssim_weight) * l1 + ssim_weight * dissimilarity


def silhouette(
    alpha: Float[Tensor, "h w"], mask: Float[Tensor, "h w"], valid: Float[Tensor, "h w 1"]
) -> Float[Tensor, ""]:
    """Mean squared difference between coverage and mask.

    Related methods use binary cross entropy, which is unbounded: it would penalise the correct coverage of half-covered
    pixels, whose mask is 0 or 1, without limit.
    """
    return ((alpha - mask) ** 2 * valid[..., 0]).mean()


def surface_normals(
    depth: Float[Tensor, "h w"], covered: Bool[Tensor, "h w"], camera: Camera, T_cam_obj: SE3
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Unit normals of a depth map by central differences, object frame, and the mask of pixels where they are defined.

    A normal is defined where a pixel and its four neighbours are covered. With points x = z (X, Y, 1) on the rays
    through the pixels, the cross product of the differences along both image axes is a positive multiple of
    (p, q, -1 - p X - q Y), where p = fx (z_right - z_left) / (z_right + z_left), and likewise q along the columns.
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
    """1 - cosine between rendered normals and normals of the depth map, averaged over the image (L_normal, eq. 11).

    Args:
        normal: Rendered normals, object frame, of any length.
        from_depth: Unit normals of the depth map, object frame.
        known: Where `from_depth` is defined.
        crease: If c > 0, the difference x becomes x / (1 + c x), which saturates beyond 1 / c: large differences are
            edges or grooves, which the term would otherwise round off or fill.
    """
    # One plane per axis: sums over short rows are slow.
    a, b = channels_first(normal), channels_first(from_depth)
    cosine = (a * b).sum(0) / a.square().sum(0).clamp_min(1e-24).sqrt()
    difference = 1 - cosine
    return (difference / (1 + crease * difference) * known).mean()


def variance(depth_var: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean standard deviation of the depth along each ray (L_variance, eq. 11)."""
    return (depth_var.clamp_min(0) + 1e-6).sqrt().mean() - 1e-3


def effective_rank(log_scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Penalty on needle-shaped Gaussians plus mean thickness (L_rank, eq. 11).

    The penalty is 0 for discs and spheres; the thickness term flattens all Gaussians.
    """
    # Three long rows: softmax over many short ones takes most of a millisecond.
    log_fraction = (2 * log_scales.mT.contiguous()).log_softmax(0)
    entropy = -(log_fraction.exp() * log_fraction).sum(0)
    needle = (-(entropy.exp() - 1).clamp_min(1e-4).log()).clamp_min(0)
    return needle.mean() + log_scales[:, 2].exp().mean()


def sharpness(sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""], *, floor: float) -> Float[Tensor, ""]:
    """Difference by which gamma is below the value at which the median Gaussian has an opacity of 1/2 (L_gamma).

    Args:
        sdf: Signed distances of the Gaussians [object radius].
        gamma: Sharpness of the opacity [1 / object radius].
        floor: Lower limit of the median distance, which limits gamma [object radius].
    """
    median = sdf.detach().abs().median().clamp_min(floor)
    return (1.762747 / median - gamma).clamp_min(0)


def projection(
    gaussians: Gaussians,
    visible: Bool[Tensor, " n"],
    depth: Float[Tensor, "h w"],
    camera: Camera,
    T_cam_obj: SE3,
    *,
    reach: float,
) -> Float[Tensor, ""]:
    """Mean absolute difference between rendered depth and the Gaussians' projected surface points (L_proj).

    The surface point of a Gaussian is its centre, moved along the normal by its signed distance.

    Args:
        gaussians: All Gaussians.
        visible: Gaussians that the view shows, over which the mean is taken.
        depth: Rendered depth [object radius]; no gradient flows to it.
        camera: Intrinsics of the view.
        T_cam_obj: Pose of the view.
        reach: Differences above this belong to another surface and count as 0 [object radius].
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
        inlier = visible & (error.abs() < reach) & (surface > 0)
        weight = torch.where(inlier, error.sign(), 0.0) / visible.sum().clamp_min(1)
        surface = torch.where(inlier, surface, 0.0)
    return (weight * (surface - z)).sum()


def light_smoothness(radiance: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean squared difference of neighbouring texels of an environment map, also across its seam (L_light, eq. 14)."""
    down, across = radiance[1:] - radiance[:-1], radiance.roll(-1, 1) - radiance
    return (down**2).mean() + (across**2).mean()


def material_smoothness(view: Buffers, mask: Float[Tensor, "h w"], photo: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Edge-aware smoothness of albedo and roughness (L_material, eq. 14; Relightable 3D Gaussian).

    Outside of the silhouette both are 0, as published, so that the term also acts at the contour.
    """
    inside = (mask * (view.alpha > 0.5))[..., None]
    return edge_aware(torch.cat([view.features["albedo"], view.features["roughness"]], -1) * inside, photo)
