"""What two frames show of the same surface points: pairs of pixels, the food of stage 1."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


@dataclass(frozen=True)
class View:
    """One frame as it is handed to a matcher; a virtual camera's frame serves as well as a photograph."""

    number: int
    """Index of the frame, repeated in the Match."""
    image: UInt8[Tensor, "h w 3"]
    """sRGB code values."""
    mask: UInt8[Tensor, "h w"]
    """OBJECT, UNKNOWN or BACKGROUND: only what is surely object is matched."""


@dataclass(frozen=True)
class Match:
    """Corresponding pixels of two frames; may be empty."""

    i: int
    """Index of the one frame."""
    j: int
    """Index of the other."""
    uv_i: Float[Tensor, "m 2"]
    """Positions in frame i [pixels, centres at +0.5]."""
    uv_j: Float[Tensor, "m 2"]
    """Of the same surface points in frame j."""
    confidence: Float[Tensor, " m"]
    """In [0, 1], comparable within one matcher only."""

    def __post_init__(self) -> None:
        m = len(self.confidence)
        assert self.i != self.j, "two frames"
        assert self.uv_i.shape == self.uv_j.shape == (m, 2), "one position in each frame per correspondence"

    def __len__(self) -> int:
        return len(self.confidence)

    def reversed(self) -> "Match":
        """The same correspondences, named the other way round."""
        return Match(self.j, self.i, self.uv_j, self.uv_i, self.confidence)

    def select(self, keep: Tensor) -> "Match":
        """Some of the correspondences, by index or mask."""
        return Match(self.i, self.j, self.uv_i[keep], self.uv_j[keep], self.confidence[keep])


def no_match(i: int, j: int) -> Match:
    """Two frames that have nothing in common."""
    return Match(i, j, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0))
