"""What one view of the Gaussians looks like before it is shaded."""

from dataclasses import dataclass

from jaxtyping import Float, Int32
from torch import Tensor


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
