"""How well each point's material can be told from the light: the directions it was lit from and seen under.

A *lamp* is one of the brightest directions of the recovered light. Directions are counted in the object frame, in cells
of one Fibonacci sphere: light that turns with the object always comes from the same cells, light that stands still
visits new ones as the object turns, which is what the method lives on (paper section 3).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from tumble.maths import fibonacci_sphere, texel_directions, texel_solid_angles
from tumble.rendering import rasterize
from tumble.scene import Asset, Camera, Environment

CELLS = 256
"""Cells of the sphere: about 13 degrees across; half of them lie above a point's horizon."""
LAMPS = 6
"""Bright directions that are followed: most rooms have fewer windows and lamps."""
APART = 0.5
"""Least angle between two lamps [radians]."""
FRAMES = 64
"""Frames that are looked at, evenly spread."""
SEEN = 0.1
"""Share of its largest weight in any frame from which a Gaussian counts as seen: at a slant, but not through others."""


@dataclass(frozen=True)
class Confidence:
    """Per Gaussian, what was seen of it."""

    views: Float[Tensor, " n"]
    """Share of the frames looked at that show it."""
    lights: Float[Tensor, " n"]
    """Number of cells that a lamp lit it from."""
    halves: Float[Tensor, " n"]
    """Number of cells in which the half-vector of camera and a lamp fell."""

    @property
    def score(self) -> Float[Tensor, " n"]:
        """0 to 1: how much of the sky above it a lamp has stood in, the count that says most about albedo."""
        return (self.lights / (CELLS / 2)).clamp(max=1)


def lamps(environment: Environment) -> Float[Tensor, "k 3"]:
    """Unit directions of the brightest places, env frame, brightest first, at least `APART`."""
    coarse = environment.resampled(16, 32)
    d_env = texel_directions(16, 32).to(coarse.log_radiance).flatten(0, 1)
    power = (coarse.radiance.mean(-1) * texel_solid_angles(16, 32).to(d_env)).flatten()
    found = []
    for _ in range(LAMPS):
        best = d_env[int(power.argmax())]
        found.append(best)
        power = power.where((d_env @ best).clamp(-1, 1).acos() > APART, power.new_zeros(()))
    return torch.stack(found)


@torch.no_grad()
def confidence_of(asset: Asset, camera: Camera) -> Confidence:
    """Count over the training frames, as seen by a camera of any size; nothing stands in the way of the lamps."""
    gaussians, trajectory = asset.gaussians, asset.trajectory
    chosen = torch.linspace(0, len(trajectory) - 1, min(FRAMES, len(trajectory))).round().long()
    weights = torch.stack(
        [rasterize(gaussians, asset.gamma, trajectory.T_cam_obj[int(i)], camera, {}).weight for i in chosen]
    )
    seen = weights > SEEN * weights.max(0).values.clamp(min=1e-6)
    cells = fibonacci_sphere(CELLS).to(gaussians.means)
    lit, half = (seen.new_zeros(len(gaussians), CELLS) for _ in range(2))
    d_env, normals = lamps(asset.environment), gaussians.normals
    positions = trajectory.camera_positions
    for i, shown in zip(chosen.tolist(), seen, strict=True):
        views = normalize(positions[i] - gaussians.means, dim=-1)
        for d_obj in d_env @ trajectory.R_env_obj[i]:
            above = shown & (normals @ d_obj > 0)
            lit[above, int((cells @ d_obj).argmax())] = True
            h = normalize(views[above] + d_obj, dim=-1)
            half[above.nonzero()[:, 0], (h @ cells.T).argmax(-1)] = True
    return Confidence(seen.float().mean(0), lit.sum(1).float(), half.sum(1).float())
