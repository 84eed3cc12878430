"""Confidence of each Gaussian's material: the number of directions from which it was lit and observed.

Albedo and light are separated best where a point was lit from many directions (paper section 3). Directions are counted
in the object frame, in cells of one Fibonacci sphere. Light that is fixed to the object always comes from the same
cells; light that is fixed to the camera reaches new cells as the object rotates. The *bright lights* below are the
brightest directions of the recovered light map.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from tumble.maths import fibonacci_sphere, texel_directions, texel_solid_angles
from tumble.rendering import rasterize
from tumble.scene import Asset, Camera, Environment

N_CELLS = 256
"""Number of cells of the sphere, about 13 degrees across; half of them are above a point's horizon."""
N_LIGHTS = 6
"""Number of bright lights: most rooms have fewer windows and lamps."""
MIN_LIGHT_ANGLE = 0.5
"""Minimum angle between two bright lights [radians]."""
MAX_FRAMES = 64
"""Maximum number of frames that are counted, evenly spaced."""
MIN_RELATIVE_WEIGHT = 0.1
"""Rendering weight above which a Gaussian counts as visible [fraction of its largest weight in any frame]: low enough
for oblique views, high enough to exclude occluded Gaussians."""


@dataclass(frozen=True)
class Confidence:
    """Observation counts of each Gaussian."""

    views: Float[Tensor, " n"]
    """Fraction of the counted frames in which it is visible."""
    lights: Float[Tensor, " n"]
    """Number of cells from which a bright light reached it while it was visible."""
    half_vectors: Float[Tensor, " n"]
    """Number of cells that contained a half vector between the camera and a bright light."""

    @property
    def score(self) -> Float[Tensor, " n"]:
        """Fraction of the cells above its horizon from which a bright light reached it, 0 to 1."""
        return (self.lights / (N_CELLS / 2)).clamp(max=1)


def brightest_directions(environment: Environment) -> Float[Tensor, "k 3"]:
    """Unit directions of the `N_LIGHTS` brightest texels, `MIN_LIGHT_ANGLE` apart, brightest first; env frame."""
    coarse = environment.resampled(16, 32)
    d_env = texel_directions(16, 32).to(coarse.log_radiance).flatten(0, 1)
    power = (coarse.radiance.mean(-1) * texel_solid_angles(16, 32).to(d_env)).flatten()
    brightest = []
    for _ in range(N_LIGHTS):
        best = d_env[int(power.argmax())]
        brightest.append(best)
        power = power.where((d_env @ best).clamp(-1, 1).acos() > MIN_LIGHT_ANGLE, power.new_zeros(()))
    return torch.stack(brightest)


@torch.no_grad()
def confidence_of(asset: Asset, camera: Camera) -> Confidence:
    """Confidence from the training frames, rendered with any camera; shadows are not taken into account."""
    gaussians, trajectory = asset.gaussians, asset.trajectory
    selected = torch.linspace(0, len(trajectory) - 1, min(MAX_FRAMES, len(trajectory))).round().long()
    weights = torch.stack(
        [rasterize(gaussians, asset.gamma, trajectory.T_cam_obj[int(i)], camera, {}).weight for i in selected]
    )
    visible = weights > MIN_RELATIVE_WEIGHT * weights.max(0).values.clamp(min=1e-6)
    cells = fibonacci_sphere(N_CELLS).to(gaussians.means)
    lit, half = (visible.new_zeros(len(gaussians), N_CELLS) for _ in range(2))
    d_env, normals = brightest_directions(asset.environment), gaussians.normals
    positions = trajectory.camera_positions
    for i, in_frame in zip(selected.tolist(), visible, strict=True):
        views = normalize(positions[i] - gaussians.means, dim=-1)
        for d_obj in d_env @ trajectory.R_env_obj[i]:
            above = in_frame & (normals @ d_obj > 0)
            lit[above, int((cells @ d_obj).argmax())] = True
            h = normalize(views[above] + d_obj, dim=-1)
            half[above.nonzero()[:, 0], (h @ cells.T).argmax(-1)] = True
    return Confidence(visible.float().mean(0), lit.sum(1).float(), half.sum(1).float())
