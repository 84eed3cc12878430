"""Pixel correspondences between two frames, the input of stage 1."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


@dataclass(frozen=True)
class View:
    """One frame as input of a matcher: a frame of the capture or of a virtual camera."""

    number: int
    """Index of the frame, which becomes `i` or `j` of the `Match`."""
    image: UInt8[Tensor, "h w 3"]
    """sRGB code values."""
    mask: UInt8[Tensor, "h w"]
    """OBJECT, UNKNOWN or BACKGROUND; only OBJECT pixels are matched."""


@dataclass(frozen=True)
class Match:
    """Pixel correspondences between two frames; may be empty."""

    i: int
    """Index of the first frame."""
    j: int
    """Index of the second frame."""
    uv_i: Float[Tensor, "m 2"]
    """Positions in frame i [pixels, centres at +0.5]."""
    uv_j: Float[Tensor, "m 2"]
    """Positions of the same surface points in frame j [pixels, centres at +0.5]."""
    confidence: Float[Tensor, " m"]
    """Confidence in [0, 1], comparable only within one matcher."""

    def __post_init__(self) -> None:
        m = len(self.confidence)
        assert self.i != self.j, "a match needs two different frames"
        assert self.uv_i.shape == self.uv_j.shape == (m, 2), "a correspondence needs one position in each frame"

    def __len__(self) -> int:
        return len(self.confidence)

    def reversed(self) -> "Match":
        """The same correspondences with both frames swapped."""
        return Match(self.j, self.i, self.uv_j, self.uv_i, self.confidence)

    def select(self, keep: Tensor) -> "Match":
        """The match reduced to the given correspondences (indices or boolean mask)."""
        return Match(self.i, self.j, self.uv_i[keep], self.uv_j[keep], self.confidence[keep])


def empty_match(i: int, j: int) -> Match:
    """A match without correspondences."""
    return Match(i, j, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0))
