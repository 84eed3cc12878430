"""How much of a coarse light reaches Gaussians that stand in the object's own shade: shadows for stage 2.

Without them grooves and folds are dark to no purpose: stage 2 bends their normals away from the light, or paints them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.inverse_rendering.sh_lighting import CoarseLight
from tumble.maths import SE3, fibonacci_sphere, spherical_harmonics
from tumble.rendering import build, self_shadowed_irradiance, surface_points, transfer, unoccluded, visibility
from tumble.scene import Camera, Gaussians

DIRECTIONS = 256
"""In which the sky is looked for, and from which the light is summed."""
FLOOR = 0.03
"""Of the mean irradiance, added above and below: where hardly any light falls a ratio says nothing."""
BRIGHTEST = 2.0
"""What light between parts may add at most, as a multiple of the light of an open sky."""


@dataclass(frozen=True)
class Sky:
    """What every Gaussian sees of the sky, and what it would see if nothing stood in the way: `trace.transfer`."""

    seen: Float[Tensor, "n 9"]
    whole: Float[Tensor, "n 9"]

    @torch.no_grad()
    def share(
        self, light: CoarseLight, albedo: Float[Tensor, "n 3"], R_env_obj: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "n 3"]:
        """Diffuse light in its own shade, with all bounces, over that of the open sky; not differentiable.

        As a ratio it leaves the dependence on the normal to `coarse_light.radiance`, which is differentiable.
        """
        directions, projection = _grid(albedo.dtype, albedo.device)
        radiance = light.glossy(directions @ R_env_obj.mT)
        coefficients = projection @ radiance
        floor = FLOOR * math.pi * radiance.mean(0)
        shaded, whole = (self_shadowed_irradiance(t, coefficients, albedo) + floor for t in (self.seen, self.whole))
        return (shaded / whole.clamp_min(1e-12)).clamp_max(BRIGHTEST)


@cache
def _grid(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "D 3"], Float[Tensor, "9 D"]]:
    """Directions, and what takes radiance from there to coefficients of harmonics."""
    directions = fibonacci_sphere(DIRECTIONS).to(device, dtype)
    return directions, 4 * math.pi / DIRECTIONS * spherical_harmonics.basis(directions, 2).mT


@torch.no_grad()
def look_around(gaussians: Gaussians, gamma: Float[Tensor, ""], poses: Sequence[SE3], camera: Camera) -> Sky:
    """Trace what every Gaussian sees, from the surface that it stands for.

    Args:
        gamma: Sharpness of the opacity [1 / object radius].
        poses: `T_cam_obj` of views that together show all sides.
    """
    points, normals = surface_points(gaussians, gamma, poses, camera), gaussians.normals
    directions = fibonacci_sphere(DIRECTIONS).to(points)
    seen = visibility(build(gaussians, gamma), points, normals, directions)
    return Sky(transfer([seen], normals), transfer([unoccluded(directions, len(points))], normals))
