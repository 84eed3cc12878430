"""What a camera sees of the Gaussians, before light: the one place where nouns become the tensors of a backend.

*Features* are whatever varies over a Gaussian's plane, given at its four corners (`material`): callers name them and
get images of the same names back.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from tumble import backends
from tumble.maths import SE3
from tumble.scene import Camera, Gaussians, opacity


@dataclass(frozen=True)
class Buffers:
    """Images of one view. Per-pixel means are over what covers the pixel (divided by alpha); 0 where nothing does."""

    alpha: Float[Tensor, "h w"]
    """Coverage in [0, 1]."""
    depth: Float[Tensor, "h w"]
    """Expected z-depth, camera frame [object radius]."""
    depth_var: Float[Tensor, "h w"]
    """Variance of that depth along the ray [object radius^2]."""
    normal: Float[Tensor, "h w 3"]
    """Mean outward normal, object frame; not of unit length."""
    rgb: Float[Tensor, "h w 3"]
    """Linear radiance over black (not divided by alpha)."""
    features: dict[str, Float[Tensor, "h w _"]]
    """Images of the features handed to `rasterize`, under the same names."""
    weight: Float[Tensor, " n"]
    """Blending weight of every Gaussian, summed over the view's pixels."""
    touched: Int32[Tensor, " n"]
    """Number of pixels under the mask that every Gaussian contributes to."""
    dominant: Int32[Tensor, "h w"]
    """The Gaussian of largest weight in each pixel, -1 where there is none."""


def rasterize(
    gaussians: Gaussians,
    gamma: Float[Tensor, ""],
    T_cam_obj: SE3,
    camera: Camera,
    features: dict[str, Float[Tensor, "n 4 _"]],
    mask: Float[Tensor, "h w"] | None = None,
) -> Buffers:
    """One view of the Gaussians (paper section 4.2); differentiable in all of them, in `gamma`, features and pose.

    Not differentiable: the camera (intrinsics are known), the mask, and `weight`, `touched`, `dominant`.

    Args:
        gamma: Sharpness of the opacity [1 / object radius].
        T_cam_obj: One pose, without batch axes.
        features: Values at the corners of every Gaussian's plane, by name; may be empty.
        mask: Pixels that count in `Buffers.touched`, where > 0.5; all when None.
    """
    means = gaussians.means
    corners = torch.cat([*features.values(), means.new_zeros(len(gaussians), 4, 0)], -1)
    view = backends.choose(means.device, means.dtype).rasterize(
        means,
        gaussians.quats,
        gaussians.scales,
        opacity(gaussians.sdf, gamma),
        gaussians.sh,
        corners,
        T_cam_obj.rotation.matrix(),
        T_cam_obj.translation,
        camera.fx_fy_cx_cy.to(means),
        camera.height,
        camera.width,
        means.new_ones(1, 1) if mask is None else mask,
    )
    images = view.features.split([values.shape[-1] for values in features.values()], -1)
    return Buffers(
        alpha=view.alpha,
        depth=view.depth,
        depth_var=view.depth_var,
        normal=view.normal,
        rgb=view.rgb,
        features=dict(zip(features, images, strict=True)),
        weight=view.weight,
        touched=view.touched,
        dominant=view.dominant,
    )
