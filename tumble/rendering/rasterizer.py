"""Rasterization of Gaussians into buffers of one view: passes them to a backend as tensors.

*Features* are quantities that vary over a Gaussian's plane, given at its four corners (`scene.material`). Callers pass
them by name and get images with the same names.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from tumble import backends
from tumble.maths import SE3
from tumble.scene import Camera, Gaussians


@dataclass(frozen=True)
class Buffers:
    """Images of one view. Means are weighted by blending weight and divided by alpha; 0 where alpha is 0."""

    alpha: Float[Tensor, "h w"]
    """Coverage in [0, 1]."""
    depth: Float[Tensor, "h w"]
    """Mean z-depth, camera frame [object radius]."""
    depth_var: Float[Tensor, "h w"]
    """Variance of the z-depth along the ray [object radius^2]."""
    normal: Float[Tensor, "h w 3"]
    """Mean outward normal, object frame; not of unit length."""
    rgb: Float[Tensor, "h w 3"]
    """Linear radiance over black, not divided by alpha."""
    features: dict[str, Float[Tensor, "h w _"]]
    """Images of the features passed to `rasterize`, under the same names."""
    weight: Float[Tensor, " n"]
    """Blending weight of every Gaussian, summed over the view's pixels."""
    touched: Int32[Tensor, " n"]
    """Number of masked pixels that each Gaussian contributes to."""
    dominant: Int32[Tensor, "h w"]
    """Index of the Gaussian with the largest blending weight in each pixel, -1 where there is none."""


def rasterize(
    gaussians: Gaussians,
    gamma: Float[Tensor, ""],
    T_cam_obj: SE3,
    camera: Camera,
    features: dict[str, Float[Tensor, "n 4 _"]],
    mask: Float[Tensor, "h w"] | None = None,
) -> Buffers:
    """Rasterize one view of the Gaussians (paper section 4.2).

    Differentiable in Gaussians, `gamma`, features and pose, but not in camera and mask. The outputs `weight`, `touched`
    and `dominant` have no gradient.

    Args:
        gaussians: Gaussians, object frame.
        gamma: Sharpness of the opacity [1 / object radius].
        T_cam_obj: Pose of the object, without batch axes.
        camera: Intrinsics and image size.
        features: Values at the corners of every Gaussian's plane, by name; may be empty.
        mask: Pixels that count in `Buffers.touched`, where > 0.5; all when None.
    """
    means = gaussians.means
    corners = [*features.values()] or [means.new_zeros(len(gaussians), 4, 0)]
    # A single feature is not copied.
    corners = corners[0] if len(corners) == 1 else torch.cat(corners, -1)
    backend = backends.choose(means.device, means.dtype)
    view = backend.rasterize(
        means,
        gaussians.quats,
        *backend.activate(gaussians.log_scales, gaussians.sdf, gamma),
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
