"""Selection of the frame pairs to match: each frame with a few earlier ones.

Pairs farther apart than `OFFSETS` are not needed: frontier points constrain all pairs of frames
(`poses/sfm/frontier_points`), and points located by their texture connect distant frames
(`poses/sfm/symmetry/texture_tracks`).
"""

from collections.abc import Sequence

OFFSETS = (1, 2, 4)
"""Distances in time of the pairs [frames]. FMOV, the tracker that the paper extends, also uses 8 and 16."""

Pairs = list[tuple[int, int]]
"""Indices of two frames, the earlier frame first."""


def neighbours(n: int, offsets: Sequence[int] = OFFSETS) -> Pairs:
    """Pairs of each of `n` frames with the frames that lie `offsets` before it."""
    return [(t - offset, t) for t in range(n) for offset in sorted(offsets) if t >= offset]
