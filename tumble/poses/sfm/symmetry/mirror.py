"""Mirror symmetry of silhouettes, by which bodies of revolution are recognised.

From every viewpoint, the silhouette of a body of revolution is mirror symmetric about the image of its axis; that of a
sphere is mirror symmetric about every line through its centre.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample

from tumble.scene import OBJECT, UNKNOWN

GRID = 64
"""Resolution at which silhouettes are compared with their mirror images."""
COARSE_LINES = 45
"""Number of mirror lines of the coarse search, 4 degrees apart."""
FINE_LINES = 9
"""Number of mirror lines of the fine search about the best coarse one, half a degree apart."""
MIN_OVERLAP = 0.95
"""Minimum intersection over union, median over frames, for silhouettes to count as mirror symmetric."""


@dataclass(frozen=True)
class MirrorSymmetry:
    """Overlap of each silhouette with its mirror images about lines through its centroid."""

    best: Float[Tensor, " t"]
    """Intersection over union for the best line; 0 where the object is not visible."""
    worst: Float[Tensor, " t"]
    """Intersection over union for the worst line."""
    line_angle: Float[Tensor, " t"]
    """Angle of the best line, from the image's x axis towards its y axis [radians]."""
    extent: Float[Tensor, "t 2"]
    """Extent of the silhouette perpendicular to the best line, and along it [pixels]."""

    @property
    def is_revolution(self) -> bool:
        """Whether the silhouettes are compatible with a body of revolution."""
        return bool((self.best > 0).any()) and float(self.best[self.best > 0].median()) > MIN_OVERLAP

    @property
    def is_sphere(self) -> bool:
        """Whether the silhouettes are compatible with a sphere."""
        return self.is_revolution and float(self.worst[self.best > 0].median()) > MIN_OVERLAP

    @property
    def axis(self) -> Float[Tensor, "2"]:
        """Direction of the axis of revolution in the first image that shows the object, as a unit vector.

        A side view of a can has two mirror lines, the image of the axis and the perpendicular to it. Most other views
        have only the first, because foreshortening makes the two ends of the can look different. Of the two lines, the
        axis is therefore the one for which the perpendicular extent is closer to the median over all frames.
        """
        visible = self.best > 0
        extent = self.extent[visible]
        across = int((extent[0] - extent[:, 0].median()).abs().argmin())
        angle = self.line_angle[visible][0] + across * math.pi / 2
        return torch.stack([angle.cos(), angle.sin()])


def mirror_symmetry(masks: UInt8[Tensor, "t h w"]) -> MirrorSymmetry:
    """Compare every silhouette with its mirror images; unknown pixels and their mirror images are ignored."""
    silhouettes = torch.stack([_centred(mask) for mask in masks])
    all_angles = torch.arange(COARSE_LINES) * (math.pi / COARSE_LINES)
    coarse = torch.stack([_overlap(silhouettes, angle.expand(len(masks))) for angle in all_angles], 1)
    near = all_angles[coarse.argmax(1)] + torch.linspace(-0.5, 0.5, FINE_LINES)[:, None] * (math.pi / COARSE_LINES)
    fine = torch.stack([_overlap(silhouettes, angle) for angle in near])
    best = fine.max(0)
    line_angle = near.gather(0, best.indices[None])[0]
    extent = torch.stack([_extent(mask, angle) for mask, angle in zip(masks, line_angle, strict=True)])
    return MirrorSymmetry(best.values, coarse.min(1).values, line_angle, extent)


def _extent(mask: UInt8[Tensor, "h w"], angle: Float[Tensor, ""]) -> Float[Tensor, "2"]:
    """Extent of the object perpendicular to a line at this angle, and along it [pixels]."""
    xy = torch.nonzero(mask == OBJECT).flip(-1).float()
    if not len(xy):
        return torch.zeros(2)
    axes = torch.stack([torch.stack([-angle.sin(), angle.cos()]), torch.stack([angle.cos(), angle.sin()])], 1)
    return (xy @ axes).amax(0) - (xy @ axes).amin(0) + 1


def _overlap(silhouettes: Float[Tensor, "t 2 g g"], angle: Float[Tensor, " t"]) -> Float[Tensor, " t"]:
    """Intersection over union of silhouettes with their mirror images, for one angle of the mirror line each.

    Args:
        silhouettes: Object and known pixels, centred (`_centred`).
        angle: Angle of the mirror line of each silhouette [radians].
    """
    c, s, zero = (2 * angle).cos(), (2 * angle).sin(), torch.zeros_like(angle)
    flip = torch.stack([torch.stack([c, s, zero], -1), torch.stack([s, -c, zero], -1)], 1)
    grid = torch.nn.functional.affine_grid(flip, list(silhouettes.shape), align_corners=False)
    mirrored = grid_sample(silhouettes, grid, align_corners=False)
    known = silhouettes[:, 1] * mirrored[:, 1]
    intersection = (torch.minimum(silhouettes[:, 0], mirrored[:, 0]) * known).sum((1, 2))
    return intersection / (torch.maximum(silhouettes[:, 0], mirrored[:, 0]) * known).sum((1, 2)).clamp_min(1)


def _centred(mask: UInt8[Tensor, "h w"]) -> Float[Tensor, "2 g g"]:
    """Object and known pixels of a mask, resampled to a square about the object's centroid that contains the object."""
    inside: Bool[Tensor, "h w"] = mask == OBJECT
    if not bool(inside.any()):
        return torch.zeros(2, GRID, GRID)
    xy = torch.nonzero(inside).flip(-1).float() + 0.5
    centre = xy.mean(0)
    radius = (xy - centre).norm(dim=-1).max() + 1
    size = torch.tensor([mask.shape[1], mask.shape[0]])
    ticks = ((torch.arange(GRID) + 0.5) / GRID * 2 - 1) * radius
    grid = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1) + centre
    layers = torch.stack([inside.float(), (mask == UNKNOWN).float()])[None]
    resampled = grid_sample(layers, (2 * grid / size - 1)[None], align_corners=False)[0]
    return torch.stack([resampled[0], 1 - resampled[1]])
