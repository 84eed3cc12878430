"""The visual hull: what all silhouettes leave standing, as oriented points to start the Gaussians from.

Object frame, object radius 1. A pixel whose mask is unknown carves nothing.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv3d, grid_sample, normalize

from tumble.scene.capture import BACKGROUND, Capture
from tumble.scene.trajectory import Trajectory


@dataclass(frozen=True)
class OrientedPoints:
    """Points on a surface."""

    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    """Outward, unit length."""
    spacing: Float[Tensor, " n"]
    """Mean distance to the three nearest other points [object radius]."""


def carve(capture: Capture, trajectory: Trajectory, *, resolution: int) -> Float[Tensor, "x y z"]:
    """How surely each cell of [-1, 1]^3 is inside all silhouettes: the least, over all frames, of the masks around it.

    Cells of the unit ball that no frame shows count as inside; what lies beyond the ball is outside.
    """
    like = {"dtype": trajectory.T_cam_obj.xyz.dtype, "device": trajectory.T_cam_obj.xyz.device}
    ticks = (torch.arange(resolution, **like) + 0.5) / resolution * 2 - 1
    x_obj = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    size = torch.tensor([capture.camera.width, capture.camera.height], **like)
    inside = (x_obj.norm(dim=-1) <= 1).to(**like)
    for frame in range(len(trajectory)):
        uv = capture.camera.project(trajectory.T_cam_obj[frame] @ x_obj)
        mask = (capture.masks[frame] != BACKGROUND).to(**like)
        at = (uv / size * 2 - 1)[None, None]
        seen = grid_sample(mask[None, None], at, padding_mode="border", align_corners=False)[0, 0, 0]
        within = ((uv > 0) & (uv < size)).all(-1)
        inside = torch.minimum(inside, torch.where(within, seen, 1.0))
    return inside.reshape(resolution, resolution, resolution)


def surface(inside: Float[Tensor, "x y z"], n: int, rng: torch.Generator) -> OrientedPoints:
    """About `n` points where `inside` crosses one half, drawn evenly over the surface.

    Raises:
        ValueError: Nothing is inside: the poses and the silhouettes contradict each other.
    """
    resolution = inside.shape[0]
    positions, normals = _crossings(inside)
    if len(positions) < 16:
        raise ValueError("the silhouettes leave nothing standing: are the poses those of these masks?")
    # An edge grid cuts a slanted surface more often per area than a level one: by the sum of the normal's components.
    chance = 1 / normals.abs().sum(-1)
    chosen = torch.multinomial(chance.cpu(), min(n, len(positions)), generator=rng).to(positions.device)
    jitter = (torch.rand(len(chosen), 3, generator=rng).to(positions) - 0.5) * (2 / resolution)
    normals = normals[chosen]
    # Move along the surface only, so that points do not line up with the grid.
    positions = positions[chosen] + jitter - (jitter * normals).sum(-1, keepdim=True) * normals
    return OrientedPoints(positions, normals, spacing(positions))


def _crossings(inside: Float[Tensor, "x y z"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Points on grid edges where `inside` crosses one half, with outward normals from its blurred gradient."""
    resolution = inside.shape[0]
    outwards = outward(inside)
    positions, normals = [], []
    for axis in range(3):
        low, high = inside.narrow(axis, 0, resolution - 1), inside.narrow(axis, 1, resolution - 1)
        index = torch.nonzero((low > 0.5) != (high > 0.5))
        a, b = (values[tuple(index.T)] for values in (low, high))
        at = index.to(inside)
        at[:, axis] += (0.5 - a) / (b - a)
        positions.append((at + 0.5) / resolution * 2 - 1)
        normals.append(outwards[tuple(index.T)])
    known = torch.cat(normals).any(-1)  # a speck of one cell gets emptier on all sides alike
    return torch.cat(positions)[known], normalize(torch.cat(normals)[known], dim=-1)


def outward(inside: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z 3"]:
    """Where it gets emptier, at every cell; its direction near a surface is the normal's, its length says nothing."""
    return -torch.stack(torch.gradient(_blurred(inside)), -1)


def _blurred(inside: Float[Tensor, "x y z"], sigma: float = 1.5) -> Float[Tensor, "x y z"]:
    """Smoothed over `sigma` cells: carved silhouettes are stairs, their normals must not be."""
    taps = torch.arange(-4, 5).to(inside)
    kernel = torch.exp(-0.5 * (taps / sigma) ** 2)
    kernel = kernel / kernel.sum()
    blurred = torch.nn.functional.pad(inside[None, None], (4,) * 6, mode="replicate")
    for shape in ((1, 1, -1, 1, 1), (1, 1, 1, -1, 1), (1, 1, 1, 1, -1)):
        blurred = conv3d(blurred, kernel.reshape(shape))
    return blurred[0, 0]


def spacing(positions: Float[Tensor, "n 3"], chunk: int = 2048) -> Float[Tensor, " n"]:
    """Mean distance of every point to its three nearest others [object radius]."""
    near = [
        torch.cdist(part, positions).topk(4, largest=False).values[:, 1:].mean(-1) for part in positions.split(chunk)
    ]
    return torch.cat(near)
