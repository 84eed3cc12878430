"""Whether an object's silhouettes are those of a body that looks the same when it turns about an axis.

Seen from anywhere, a body of revolution is its own mirror image about the picture of its axis; a ball is about every
line through its middle. Outlines then tell nothing of turns about that axis: only texture can.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample

from tumble.scene import OBJECT, UNKNOWN

GRID = 64
"""Silhouettes are compared on a grid of this size."""
LINES, FINE = 45, 9
"""Lines through the middle that are tried, all 4 degrees, and half degrees about the best of them."""
SAME = 0.95
"""Overlap of a silhouette and its mirror image from which they are the same. Median over a capture: cans 0.96 to 0.98,
on grainy films too (masks `frontier.divided`; bands left unknown add up to 0.06), a bottle 0.91 to 0.94, others 0.90
and less."""


@dataclass(frozen=True)
class Mirrors:
    """How well each silhouette agrees with its mirror images."""

    best: Float[Tensor, " t"]
    """Intersection over union for the best line; 0 without an object."""
    worst: Float[Tensor, " t"]
    """For the worst line."""
    line: Float[Tensor, " t"]
    """Angle of the best line from the picture's first axis towards its second [radians]."""
    width: Float[Tensor, "t 2"]
    """How far the silhouette reaches across that line, and along it [pixels]."""

    @property
    def revolves(self) -> bool:
        """Whether all silhouettes could be those of a body of revolution."""
        return bool((self.best > 0).any()) and float(self.best[self.best > 0].median()) > SAME

    @property
    def ball(self) -> bool:
        """Whether they could be a ball's."""
        return self.revolves and float(self.worst[self.best > 0].median()) > SAME

    @property
    def axis(self) -> Float[Tensor, "2"]:
        """Direction of the axis in the first picture with an object.

        Side views of a can are also symmetric about the line across: the axis is the line across which the body is as
        wide as in most pictures, which show its ends at different distances.
        """
        seen = self.best > 0
        width = self.width[seen]
        across = int((width[0] - width[:, 0].median()).abs().argmin())
        angle = self.line[seen][0] + across * math.pi / 2
        return torch.stack([angle.cos(), angle.sin()])


def mirrors(masks: UInt8[Tensor, "t h w"]) -> Mirrors:
    """Compare silhouettes with their mirror images; unknown pixels count for neither."""
    pictures = torch.stack([_about_middle(mask) for mask in masks])
    every = torch.arange(LINES) * (math.pi / LINES)
    coarse = torch.stack([_overlap(pictures, angle.expand(len(masks))) for angle in every], 1)
    near = every[coarse.argmax(1)] + torch.linspace(-0.5, 0.5, FINE)[:, None] * (math.pi / LINES)
    fine = torch.stack([_overlap(pictures, angle) for angle in near])
    best = fine.max(0)
    line = near.gather(0, best.indices[None])[0]
    width = torch.stack([_width(mask, angle) for mask, angle in zip(masks, line, strict=True)])
    return Mirrors(best.values, coarse.min(1).values, line, width)


def _width(mask: UInt8[Tensor, "h w"], angle: Float[Tensor, ""]) -> Float[Tensor, "2"]:
    at = torch.nonzero(mask == OBJECT).flip(-1).float()
    if not len(at):
        return torch.zeros(2)
    ways = torch.stack([torch.stack([-angle.sin(), angle.cos()]), torch.stack([angle.cos(), angle.sin()])], 1)
    return (at @ ways).amax(0) - (at @ ways).amin(0) + 1


def _overlap(pictures: Float[Tensor, "t 2 g g"], angle: Float[Tensor, " t"]) -> Float[Tensor, " t"]:
    """Intersection over union with the mirror images about lines at these angles."""
    c, s, zero = (2 * angle).cos(), (2 * angle).sin(), torch.zeros_like(angle)
    flip = torch.stack([torch.stack([c, s, zero], -1), torch.stack([s, -c, zero], -1)], 1)
    where = torch.nn.functional.affine_grid(flip, list(pictures.shape), align_corners=False)
    mirrored = grid_sample(pictures, where, align_corners=False)
    known = pictures[:, 1] * mirrored[:, 1]
    both = (torch.minimum(pictures[:, 0], mirrored[:, 0]) * known).sum((1, 2))
    return both / (torch.maximum(pictures[:, 0], mirrored[:, 0]) * known).sum((1, 2)).clamp_min(1)


def _about_middle(mask: UInt8[Tensor, "h w"]) -> Float[Tensor, "2 g g"]:
    """Object and known pixels about the object's centroid, as far as its farthest pixel."""
    inside: Bool[Tensor, "h w"] = mask == OBJECT
    if not bool(inside.any()):
        return torch.zeros(2, GRID, GRID)
    at = torch.nonzero(inside).flip(-1).float() + 0.5
    centre = at.mean(0)
    reach = (at - centre).norm(dim=-1).max() + 1
    size = torch.tensor([mask.shape[1], mask.shape[0]])
    ticks = ((torch.arange(GRID) + 0.5) / GRID * 2 - 1) * reach
    where = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1) + centre
    layers = torch.stack([inside.float(), (mask == UNKNOWN).float()])[None]
    found = grid_sample(layers, (2 * where / size - 1)[None], align_corners=False)[0]
    return torch.stack([found[0], 1 - found[1]])
