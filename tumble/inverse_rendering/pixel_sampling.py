"""The pixels of a step of stage 3: a frame, and pixels of the object in it, spread evenly over the object."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import Index
from tumble.scene import Camera


@dataclass(frozen=True)
class PixelNumbers:
    """What a step of stage 3 draws, and what changes from step to step; numbers may be tensors (`engine.graph`)."""

    frame: Index
    """Frame whose pixels are compared."""
    place: float | Float[Tensor, ""]
    """Place of the pixels in their parts, see `sample_pixels`."""
    current: Index
    """Set of directions."""
    is_fixed: bool
    """Whether geometry and poses are fixed, in the warm-up."""


def pixels_per_step(pixels: int, side: int, camera: Camera) -> int:
    """Number of pixels that a step shades: more in larger images. Asks no device.

    Args:
        pixels: Their number in images up to a size.
        side: Smaller side of images of that size [pixels]; 0 if the number is the same for all images.
        camera: Camera of the images.
    """
    return round(pixels * max(1.0, min(camera.height, camera.width) / side)) if side else pixels


def sample_pixels(
    n: int, alpha: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"], rng: torch.Generator
) -> Int64[Tensor, "{n}"]:
    """`n` pixels that certainly show the object, counted row by row; -1 if there are no such pixels.

    Systematic sampling: every n-th part of the list of these pixels gives one, all at the same place of their part. The
    host asks the device for nothing.
    """
    return pixels_at(float(torch.rand((), generator=rng)), n, alpha, mask)


def pixels_at(
    start: float | Float[Tensor, ""], n: int, alpha: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]
) -> Int64[Tensor, "{n}"]:
    """`sample_pixels` at a given place of the parts, 0 to 1."""
    count = ((alpha > 0.5) & mask).flatten().cumsum(0, dtype=torch.int32)
    place = torch.arange(n, device=alpha.device) + start
    total = count[-1]
    rank = torch.minimum((place * (total / n)).int(), total - 1)
    return torch.where(total > 0, torch.searchsorted(count, rank + 1), -1)
