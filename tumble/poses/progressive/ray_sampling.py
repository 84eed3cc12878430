"""Sampling of pixels of a frame as rays of the virtual camera, with the colours of the input image.

The input image is not resampled: the virtual camera is the true one rotated about its centre, so only rays are rotated
(`virtual_camera`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from tumble.maths import Box, crop_box
from tumble.poses.progressive.virtual_camera import Aim
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Capture


@dataclass(frozen=True)
class Pixels:
    """Rays of one frame, with their target colours and masks."""

    directions: Float[Tensor, "r 3"]
    """Directions in the aim frame, unit length."""
    rgb: Float[Tensor, "r 3"]
    """Target colour, sRGB in [0, 1]."""
    mask: Float[Tensor, " r"]
    """Target opacity: fraction of the averaged pixels that are object."""

    def __len__(self) -> int:
        return len(self.mask)

    def __add__(self, other: "Pixels") -> "Pixels":
        """Concatenation of the rays."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("directions", "rgb", "mask"))
        return Pixels(*(torch.cat(pair) for pair in pairs))


def silhouette_box(capture: Capture, frame: int, margin: float) -> Box:
    """Bounding box of a frame's silhouette, enlarged by `margin` [image widths]; the whole frame without silhouette."""
    mask = capture.masks[frame] != BACKGROUND
    if not bool(mask.any()):
        return 0, 0, mask.shape[0], mask.shape[1]
    return crop_box(mask, round(margin * mask.shape[1]))


def draw(capture: Capture, aim: Aim, frame: int, n: int, *, box: Box, block: int, rng: torch.Generator) -> Pixels:
    """Random pixels within a box; fewer than `n` where some are unknown, as these are left out.

    Args:
        capture: Frames and masks.
        aim: Virtual camera.
        frame: Index of the frame.
        n: Number of pixels drawn.
        box: Top, left, height and width of the box [pixels].
        block: Side of the square of pixels averaged into one sample, whose ray passes through the square's centre.
        rng: Random number generator.
    """
    top, left, height, width = box
    block = min(block, height, width)
    size = torch.tensor([height - block + 1, width - block + 1])
    corner = torch.tensor([top, left]) + (torch.rand(n, 2, generator=rng) * size).long()
    return _averaged(capture, aim, frame, corner.to(capture.masks.device), block)


def at_positions(capture: Capture, aim: Aim, frame: int, uv: Float[Tensor, "m 2"]) -> Pixels:
    """Rays through given positions of a frame [pixels, centres at +0.5], with the colours of the pixels there.

    Their mask is 1, because correspondences lie on the object.
    """
    limit = torch.tensor([capture.camera.width - 1, capture.camera.height - 1]).to(uv)
    column, row = torch.minimum(uv.floor().clamp_min(0), limit).long().unbind(-1)
    rgb = capture.images[frame, row, column].to(uv) / 255
    return Pixels(_directions(capture, aim, frame, uv), rgb, torch.ones_like(uv[:, 0]))


def _averaged(capture: Capture, aim: Aim, frame: int, corner: Int64[Tensor, "n 2"], block: int) -> Pixels:
    """Squares of pixels by their top left corners (row, column), averaged; those with unknown pixels are left out."""
    like = capture.camera.fx_fy_cx_cy
    within = torch.arange(block, device=corner.device)
    row, column = corner[:, :1, None] + within[:, None], corner[:, 1:, None] + within
    mask = capture.masks[frame, row, column].flatten(1)
    known = (mask != UNKNOWN).all(1)
    rgb = capture.images[frame, row, column].to(like).flatten(1, 2).mean(1)[known] / 255
    uv = corner.flip(-1)[known].to(like) + 0.5 * block
    return Pixels(_directions(capture, aim, frame, uv), rgb, (mask == OBJECT)[known].to(like).mean(1))


def _directions(capture: Capture, aim: Aim, frame: int, uv: Tensor) -> Float[Tensor, "m 3"]:
    """Unit directions in the aim frame through positions of a frame [pixels]."""
    x_cam = capture.camera.unproject(uv, torch.ones_like(uv[:, 0]))
    return normalize(aim.R_cam_aim[frame].inverse() @ x_cam, dim=-1)
