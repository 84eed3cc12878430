"""How many pairs of a tile and a Gaussian the lists of a training view hold."""

import warnings
from dataclasses import dataclass

import torch
from jaxtyping import Int32, Int64
from torch import Tensor

from tumble.backends._graphs import recording

LOOK_EVERY = 64
"""Views after which the host asks a GPU for the number of pairs again."""


@dataclass
class PairLimit:
    """Length of the lists of tiles for views of one size in training, so that the host need not wait for the true one.

    Lists are at least twice as long as those of the first view of as many Gaussians. The device keeps the length of the
    longest since; the host looks at it after 1, 2, 4, 8, ... views, at least every `LOOK_EVERY`, and before each view
    without gradients, whose lists have the true length. Lists that were more than half full become longer. Had a view
    more pairs than its lists could hold, those of the Gaussians farthest from the camera were left out of it; then a
    warning says so. While a view is recorded (`_graphs`) the host does not look; it does between replays.
    """

    capacity: int = 0
    """Pairs of a tile and a Gaussian that the lists hold."""
    n: int = -1
    """Number of Gaussians for which this was found."""
    views: int = 0
    """Views of as many Gaussians so far."""
    longest: Int32[Tensor, "1"] | None = None
    """Number of pairs of the view with most of them, on the device."""

    def room(self, ends: Int64[Tensor, " n"]) -> tuple[int, Int32[Tensor, "1"]]:
        """Capacity for a view whose i-th Gaussian by depth has its pairs before `ends[i]`, and `longest`."""
        if recording():
            assert len(ends) == self.n, "a view of as many Gaussians precedes a recording"
            assert self.longest is not None
            return self.capacity, self.longest
        if len(ends) != self.n or self.longest is None:
            self.look()
            self.n, self.views, self.longest = len(ends), 0, torch.zeros(1, dtype=torch.int32, device=ends.device)
            self.capacity = _power_of_two(2 * int(ends[-1]))
        elif self.views & (self.views - 1) == 0 or self.views % LOOK_EVERY == 0:
            self.look()
        self.views += 1
        return self.capacity, self.longest

    def look(self) -> None:
        """Wait for the number of pairs of the view with most of them, and make lists longer if need be."""
        found = int(self.longest) if self.longest is not None else 0
        if found > self.capacity:
            lost = f"{found - self.capacity} of {found} pairs of a tile and a Gaussian"
            warnings.warn(f"a training view left out {lost}, far from the camera", RuntimeWarning, stacklevel=2)
        self.capacity = max(self.capacity, _power_of_two(2 * found))


def _power_of_two(n: int) -> int:
    """The smallest power of two that is at least n."""
    return 1 << max(0, n - 1).bit_length()
