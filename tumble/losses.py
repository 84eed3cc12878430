"""The terms of the paper's objectives (eq. 9-14). Each is a scalar that is 0 where it must be; none knows a model.

Pictures are sRGB in [0, 1], channels last. `valid` is 1 where the mask is known and 0 where it is not: unknown pixels
enter no term.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from tumble.camera import Camera
from tumble.gaussians import Gaussians
from tumble.images import srgb_from_linear, ssim
from tumble.se3 import SE3

SATURATED = 254 / 255
"""Code value from which a photograph only says "at least this bright"."""


def developed(linear: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A rendering as the camera would store it, for comparison with a photograph.

    The sRGB curve goes on beyond 1, so that a pixel rendered too bright has a gradient; only where the photograph is
    saturated itself does a brighter rendering count as equal.
    """
    srgb = srgb_from_linear(linear.clamp_min(0))
    return torch.where((photograph >= SATURATED) & (srgb > photograph), photograph, srgb)


def photometric(
    rendered: Float[Tensor, "h w 3"],
    photograph: Float[Tensor, "h w 3"],
    valid: Float[Tensor, "h w 1"],
    *,
    ssim_weight: float,
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM) over the picture (eq. 9)."""
    rendered, photograph = rendered * valid, photograph * valid
    return (1 - ssim_weight) * (rendered - photograph).abs().mean() + ssim_weight * (1 - ssim(rendered, photograph))


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
    """Normals of the depth map by central differences, object frame, and where all four neighbours are covered."""
    x_cam = camera.unproject(camera.pixel_centers(), depth)
    right = x_cam[1:-1, 2:] - x_cam[1:-1, :-2]
    down = x_cam[2:, 1:-1] - x_cam[:-2, 1:-1]
    # In OpenCV axes right x down points away from the camera.
    n_cam = normalize(torch.linalg.cross(down, right), dim=-1)
    known = covered[1:-1, 1:-1] & covered[1:-1, 2:] & covered[1:-1, :-2] & covered[2:, 1:-1] & covered[:-2, 1:-1]
    pad = (1, 1, 1, 1)
    n_obj = torch.nn.functional.pad((n_cam @ T_cam_obj.rotation.matrix()).movedim(-1, 0), pad).movedim(0, -1)
    return n_obj, torch.nn.functional.pad(known, pad)


def normal_consistency(
    normal: Float[Tensor, "h w 3"],
    from_depth: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """1 - cosine between rendered normals and those of the rendered depth (eq. 10), averaged over the whole picture."""
    return ((1 - (normalize(normal, dim=-1) * from_depth).sum(-1)) * known).mean()


def variance(depth_var: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Standard deviation of depth along each ray (eq. 11)."""
    return (depth_var.clamp_min(0) + 1e-6).sqrt().mean() - 1e-3


def effective_rank(log_scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Penalty on needles: 0 for discs and balls (eq. 12), with the mean thickness added, which is what flattens."""
    share = torch.softmax(2 * log_scales, -1)
    entropy = -(share * share.clamp_min(1e-12).log()).sum(-1)
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
    x_cam = T_cam_obj @ (gaussians.means - gaussians.sdf[:, None] * gaussians.normals)[seen]
    uv = camera.project(x_cam)
    size = uv.new_tensor([camera.width, camera.height])
    at = (uv / size * 2 - 1)[None, None]
    surface = torch.nn.functional.grid_sample(depth.detach()[None, None], at.detach(), align_corners=False)[0, 0, 0]
    error = (surface - x_cam[:, 2]).abs()
    return torch.where((error < reach) & (surface > 0), error, 0.0).sum() / max(1, int(seen.sum()))
