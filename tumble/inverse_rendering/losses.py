"""Terms of the paper's objectives (eq. 11, 14), each a scalar.

Images are sRGB, channels last. `photo` is the input image. Pixels with an unknown mask do not contribute. Terms that
are computed together are kernels of the backends.
"""

from collections.abc import Mapping
from types import MappingProxyType

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import binary_cross_entropy

from tumble import backends
from tumble.maths import SE3, srgb_from_linear
from tumble.rendering import Buffers
from tumble.scene import OBJECT, UNKNOWN, Camera, Gaussians

IMAGE_TERMS = ("render", "mask", "normal", "variance")
"""Names of the terms of `image_terms`, in the order of the backends."""
GAUSSIAN_TERMS = ("rank", "gamma", "proj")
"""Names of the terms of `gaussian_terms`, in the order of the backends."""


def srgb_as_captured(linear: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A linear rendering in sRGB, clipped to the input image where the input image is saturated.

    Elsewhere values above 1 are not clipped, so that a pixel rendered too bright has a gradient.
    """
    srgb = srgb_from_linear(linear)
    return torch.where((photo >= backends.SATURATED / 255) & (srgb > photo), photo, srgb)


def image_terms(
    view: Buffers,
    photo: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"],
    camera: Camera,
    T_cam_obj: SE3,
    *,
    ssim_weight: float,
    crease: float = 0.0,
    weights: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms of a view of stage 2 by name, averaged over the image (eq. 11; exact in `Backend.image_terms`).

    render: `(1 - ssim_weight) L1 + ssim_weight (1 - SSIM)` between rendering and input image (L_render).
    mask: mean squared difference between coverage and mask. Related methods use binary cross entropy (`mask_entropy`),
    which is unbounded: it penalises the correct coverage of half-covered pixels, whose mask is 0 or 1, without limit.
    normal: 1 - cosine between rendered normals and normals of the depth map (L_normal).
    variance: mean standard deviation of the depth along each ray (L_variance).

    Args:
        view: Rendered view.
        photo: Input image, sRGB.
        mask: Mask of the capture.
        camera: Intrinsics of the view.
        T_cam_obj: Pose of the view.
        ssim_weight: Weight of the SSIM term, 0 to 1.
        crease: If c > 0, the difference x of normals becomes x / (1 + c x), which saturates beyond 1 / c: large
            differences are edges or grooves, which the term would otherwise round off or fill.
        weights: Factors of the terms; 1 for those that are not named.

    Raises:
        ValueError: The image is smaller than the window of SSIM.
    """
    if min(camera.height, camera.width) < backends.SSIM_WINDOW:
        size = f"{camera.width} x {camera.height}"
        raise ValueError(f"an image of {size} is smaller than the window of {backends.SSIM_WINDOW} pixels")
    images = (view.rgb, view.alpha, view.depth, view.depth_var, view.normal, photo, mask)
    pose = (T_cam_obj.rotation.matrix(), camera.fx_fy_cx_cy.to(view.alpha))
    factors = [weights.get(name, 1.0) for name in IMAGE_TERMS]
    backend = backends.choose(view.alpha.device, view.alpha.dtype)
    terms = backend.image_terms(*images, *pose, ssim_weight, crease, factors)
    return dict(zip(IMAGE_TERMS, terms.unbind(), strict=True))


def mask_entropy(alpha: Float[Tensor, "h w"], mask: UInt8[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean binary cross entropy between coverage and mask, the silhouette term of related methods (R3DG).

    Coverage is clamped to [1e-6, 1 - 1e-6], as published. Pixels with an unknown mask count as 0.
    """
    clamped = alpha.clamp(1e-6, 1 - 1e-6)
    return (binary_cross_entropy(clamped, (mask == OBJECT).to(alpha), reduction="none") * (mask != UNKNOWN)).mean()


def gaussian_terms(
    gaussians: Gaussians,
    gamma: Float[Tensor, ""],
    view: Buffers,
    camera: Camera,
    T_cam_obj: SE3,
    *,
    floor: float,
    reach: float,
    weights: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Float[Tensor, ""]]:
    """Weighted terms of the Gaussians in stage 2 by name (eq. 11; exact in `Backend.gaussian_terms`).

    rank: penalty on needle-shaped Gaussians, which is 0 for discs and spheres, plus the mean thickness (L_rank).
    gamma: difference by which gamma is below the value at which the median Gaussian has an opacity of 1/2 (L_gamma).
    proj: mean absolute difference between rendered depth and the surface points of the visible Gaussians, which are
    their centres moved along the normal by the signed distance (L_proj).

    Args:
        gaussians: All Gaussians.
        gamma: Sharpness of the opacity [1 / object radius].
        view: Rendered view; no gradient flows to it.
        camera: Intrinsics of the view.
        T_cam_obj: Pose of the view.
        floor: Lower limit of the median distance, which limits gamma [object radius].
        reach: Differences of depth above this belong to another surface and count as 0 [object radius].
        weights: Factors of the terms; 1 for those that are not named.
    """
    own = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sdf, gamma)
    pose = (T_cam_obj.rotation.matrix(), T_cam_obj.translation, camera.fx_fy_cx_cy.to(gamma))
    backend = backends.choose(gamma.device, gamma.dtype)
    factors = [weights.get(name, 1.0) for name in GAUSSIAN_TERMS]
    terms = backend.gaussian_terms(*own, view.weight, view.depth.detach(), *pose, floor, reach, factors)
    return dict(zip(GAUSSIAN_TERMS, terms.unbind(), strict=True))


def light_smoothness(texels: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean squared difference of neighbouring texels of an environment map, also across its seam (L_light, eq. 14)."""
    down, across = texels[1:] - texels[:-1], texels.roll(-1, 1) - texels
    return (down**2).mean() + (across**2).mean()


def shading_term(
    view: Buffers,
    pixels: Int64[Tensor, " p"],
    photo: UInt8[Tensor, "h w 3"],
    camera: Camera,
    T_cam_obj: SE3,
    R_env_obj: Float[Tensor, "3 3"],
    light: backends.ShadingLight,
    f0: Float[Tensor, "3"],
) -> Float[Tensor, ""]:
    """Photometric term of stage 3: mean absolute difference between shaded pixels and input image, as in `shade_split`.

    Args:
        view: View by `rasterize_material`, with the feature "material".
        pixels: Pixels to shade, counted row by row; negative ones do not count.
        photo: Input image, sRGB.
        camera: Intrinsics of the view.
        T_cam_obj: Pose of the view.
        R_env_obj: Rotation from the object frame to the env frame.
        light: Light and occlusion.
        f0: Reflectance at normal incidence.
    """
    shaded = backends.SampledView(
        view.features["material"], view.alpha, view.normal, view.dominant, photo.contiguous(), pixels
    )
    pose = (T_cam_obj.rotation.matrix(), R_env_obj, camera.fx_fy_cx_cy.to(view.alpha))
    return backends.choose(view.alpha.device, view.alpha.dtype).shading_term(shaded, light, *pose, f0)


def material_terms(
    view: Buffers, photo: UInt8[Tensor, "h w 3"], mask: UInt8[Tensor, "h w"]
) -> dict[str, Float[Tensor, ""]]:
    """Terms of a view of stage 3 by name (eq. 14; exact in `Backend.material_terms`).

    mask: as in `image_terms`.
    material: edge-aware smoothness of albedo and roughness (L_material; Relightable 3D Gaussian): their gradients count
    less at edges of the input image. Outside of the silhouette both are 0, as published, so that the term also acts at
    the contour.

    Args:
        view: View with the feature "material", whose first channels are albedo and roughness.
        photo: Input image, sRGB.
        mask: Mask of the capture.
    """
    backend = backends.choose(view.alpha.device, view.alpha.dtype)
    terms = backend.material_terms(view.features["material"], view.alpha, photo, mask)
    return dict(zip(("mask", "material"), terms.unbind(), strict=True))
