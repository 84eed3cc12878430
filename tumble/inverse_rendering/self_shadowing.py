"""Self-shadowing of stage 2: transfer from light to shadowed irradiance of every Gaussian.

Visibility is traced from time to time and kept as precomputed radiance transfer (Sloan et al. 2002). Without
self-shadowing, stage 2 explains dark grooves by normals that turn away from the light, or by a dark albedo.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, fibonacci_sphere
from tumble.rendering import build_tracer, surface_points, transfer, unoccluded, visibility
from tumble.scene import Camera, Gaussians

DIRECTIONS = 256
"""Directions in which visibility is traced and over which the light is integrated."""


@dataclass(frozen=True)
class VisibilityTransfer:
    """Transfer vectors of every Gaussian, with and without occlusion by the other Gaussians (`trace.transfer`)."""

    occluded: Float[Tensor, "n 9"]
    """From spherical-harmonic light to irradiance, with occlusion."""
    unoccluded: Float[Tensor, "n 9"]
    """From spherical-harmonic light to irradiance, without occlusion."""


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
