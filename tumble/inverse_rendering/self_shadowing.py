"""Self-shadowing of stage 2: the ratio of shadowed to unshadowed irradiance of every Gaussian.

Visibility is traced from time to time and kept as precomputed radiance transfer (Sloan et al. 2002). Without
self-shadowing, stage 2 explains dark grooves by normals that turn away from the light, or by a dark albedo.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.maths import SE3, fibonacci_sphere, spherical_harmonics
from tumble.rendering import build_tracer, self_shadowed_irradiance, surface_points, transfer, unoccluded, visibility
from tumble.scene import Camera, Gaussians

DIRECTIONS = 256
"""Directions in which visibility is traced and over which the light is integrated."""
IRRADIANCE_FLOOR = 0.03
"""Fraction of the mean irradiance that is added to numerator and denominator of the ratio, which is unstable where
hardly any light arrives."""
MAX_RATIO = 2.0
"""Upper limit of the ratio, which interreflection can raise above 1."""


@dataclass(frozen=True)
class VisibilityTransfer:
    """Transfer vectors of every Gaussian, with and without occlusion by the other Gaussians (`trace.transfer`)."""

    occluded: Float[Tensor, "n 9"]
    """From spherical-harmonic light to irradiance, with occlusion."""
    unoccluded: Float[Tensor, "n 9"]
    """From spherical-harmonic light to irradiance, without occlusion."""

    @torch.no_grad()
    def irradiance_ratio(
        self, light: SHLight, albedo: Float[Tensor, "n 3"], R_env_obj: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "n 3"]:
        """Irradiance with shadows and all bounces, divided by the unoccluded irradiance; not differentiable.

        Only the ratio is used, so that the dependence on the normal remains in `sh_lighting.radiance`, which is
        differentiable.
        """
        directions, projection = _quadrature(albedo.dtype, albedo.device)
        radiance = light.glossy(directions @ R_env_obj.mT)
        coefficients = projection @ radiance
        floor = IRRADIANCE_FLOOR * math.pi * radiance.mean(0)
        shadowed, unshadowed = (
            self_shadowed_irradiance(t, coefficients, albedo) + floor for t in (self.occluded, self.unoccluded)
        )
        return (shadowed / unshadowed.clamp_min(1e-12)).clamp_max(MAX_RATIO)


@cache
def _quadrature(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "D 3"], Float[Tensor, "9 D"]]:
    """Directions, and the matrix that projects radiance in them onto spherical harmonics up to degree 2."""
    directions = fibonacci_sphere(DIRECTIONS).to(device, dtype)
    return directions, 4 * math.pi / DIRECTIONS * spherical_harmonics.basis(directions, 2).mT


@torch.no_grad()
def trace_visibility(
    gaussians: Gaussians, gamma: Float[Tensor, ""], poses: Sequence[SE3], camera: Camera
) -> VisibilityTransfer:
    """Transfer vectors of all Gaussians, traced from the surface points that they represent.

    Args:
        gaussians: Geometry, both occluders and receivers.
        gamma: Sharpness of the opacity [1 / object radius].
        poses: `T_cam_obj` of views that together show all sides.
        camera: Intrinsics of these views.
    """
    points, normals = surface_points(gaussians, gamma, poses, camera), gaussians.normals
    directions = fibonacci_sphere(DIRECTIONS).to(points)
    traced = visibility(build_tracer(gaussians, gamma), points, normals, directions)
    return VisibilityTransfer(transfer([traced], normals), transfer([unoccluded(directions, len(points))], normals))
