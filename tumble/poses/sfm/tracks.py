"""Feature tracks: matches chained through many frames.

A *track* is one surface point with its *observations*, the positions at which frames show it. Bundle adjustment needs
long tracks: with tracks of two or three frames the poses of a short stretch of video can bend by many degrees. Dense
matches start at arbitrary positions, so two of them rarely share a pixel. A track is therefore continued by a local
affine fit to the matches around its current position, and new tracks start where no track passes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.scene import Match

MATCH_RADIUS = 2.2
"""Distance from a point up to which matches are used to continue its track [pixels]."""
MATCH_TOLERANCE = 1.0
"""Residual against the local affine fit up to which a match agrees with it [pixels]."""
MAX_NEIGHBOURS = 8
"""Largest number of matches used to continue one track."""
AFFINE_REGULARISATION = 0.05
"""Ridge weight on the linear part of the local affine fit, which tends to the mean shift where matches are few."""
SHORT_GAP = 2
"""Distance in time up to which every pair of frames is used [frames]."""
MIN_LONG_GAP_MATCHES = 60
"""Number of matches from which a pair farther apart is used as well; accidental matches are fewer."""
MIN_SEPARATION = 0.5
"""Width of the grid cells in which only the oldest track is continued [spacing of new tracks]."""


@dataclass(frozen=True)
class Tracks:
    """Observations of surface points: `o` observations of `n` points."""

    frame: Int64[Tensor, " o"]
    """Index of the frame."""
    point: Int64[Tensor, " o"]
    """Index of the point, in [0, n); every point has at least one observation."""
    uv: Float[Tensor, "o 2"]
    """Observed position [pixels]."""

    @property
    def n(self) -> int:
        """Number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def __len__(self) -> int:
        return len(self.point)

    def select(self, keep: Tensor, min_observations: int = 2) -> "Tracks":
        """A subset of the observations, with points renumbered.

        Points that keep fewer than `min_observations` observations are dropped.
        """
        frame, point, uv = self.frame[keep], self.point[keep], self.uv[keep]
        if not len(point):
            return Tracks(frame, point, uv)
        enough = torch.bincount(point)[point] >= min_observations
        _, renumbered = torch.unique(point[enough], return_inverse=True)
        return Tracks(frame[enough], renumbered, uv[enough])


NO_TRACKS = Tracks(torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long), torch.zeros(0, 2).double())
"""No tracks at all."""


def two_frame_tracks(match: Match) -> Tracks:
    """Tracks of two observations, one for every correspondence of a match."""
    point = torch.arange(len(match))
    frame = torch.cat([torch.full_like(point, match.i), torch.full_like(point, match.j)])
    return Tracks(frame, point.repeat(2), torch.cat([match.uv_i, match.uv_j]).double())


def concatenate(*parts: Tracks) -> Tracks:
    """Union of tracks of distinct points, numbered in the order of the parts."""
    point, n_points = [], 0
    for part in parts:
        point.append(part.point + n_points)
        n_points += part.n
    return Tracks(torch.cat([p.frame for p in parts]), torch.cat(point), torch.cat([p.uv for p in parts]))


def chain_matches(matches: Sequence[Match], spacing: Float[Tensor, " t"]) -> Tracks:
    """Tracks through all frames, continued forward in time.

    Args:
        matches: Matches of any matcher, each with i < j.
        spacing: Distance between new tracks, per frame [pixels].
    """
    from_frame: dict[int, list[Match]] = {}
    for match in matches:
        if len(match) and (match.j - match.i <= SHORT_GAP or len(match) >= MIN_LONG_GAP_MATCHES):
            from_frame.setdefault(match.i, []).append(match)
    arriving: dict[int, list[tuple[int, Tensor, Tensor]]] = {}
    parts: list[Tracks] = []
    n_points = 0
    for frame in range(len(spacing)):
        point, uv = _merge_arrivals(arriving.pop(frame, []), MIN_SEPARATION * spacing[frame])
        started = _new_tracks(from_frame.get(frame, []), uv, spacing[frame])
        point = torch.cat([point, torch.arange(n_points, n_points + len(started))])
        uv = torch.cat([uv, started])
        n_points += len(started)
        parts.append(Tracks(torch.full_like(point, frame), point, uv))
        for match in from_frame.get(frame, []):
            uv_j, kept = _propagate(match, uv)
            arriving.setdefault(match.j, []).append((match.j - match.i, point[kept], uv_j[kept]))
    columns = (torch.cat([getattr(part, name) for part in parts]) for name in ("frame", "point", "uv"))
    return (tracks := Tracks(*columns)).select(torch.ones(len(tracks), dtype=torch.bool))


def _merge_arrivals(
    arrivals: list[tuple[int, Tensor, Tensor]], width: Tensor
) -> tuple[Int64[Tensor, " n"], Float[Tensor, "n 2"]]:
    """Points and positions of the tracks that reach a frame; only the oldest in each grid cell of that `width`.

    A track is continued by the nearest earlier frame. Predictions from farther frames are averaged in where they agree
    with it, and are discarded otherwise: optical flow over wide rotations underestimates the motion, everywhere alike.

    Args:
        arrivals: Per earlier frame: its distance in time [frames], points, and their predicted positions [pixels].
        width: Side of the grid cells [pixels].
    """
    if not arrivals:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, 2, dtype=torch.float64)
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    n_nearest = sum(len(a) for gap, a, _ in arrivals if gap == arrivals[0][0])
    point, which = torch.unique(torch.cat([a for _, a, _ in arrivals]), return_inverse=True)
    uv = torch.cat([b for _, _, b in arrivals])
    nearest = torch.full_like(point, len(uv)).scatter_reduce_(0, which, torch.arange(len(uv)), "amin")
    agrees = ((uv - uv[nearest][which]).norm(dim=-1) < MATCH_TOLERANCE / 2).double()
    total = torch.zeros_like(uv[: len(point), 0]).index_add_(0, which, agrees)
    mean = torch.zeros_like(uv[: len(point)]).index_add_(0, which, agrees[:, None] * uv) / total[:, None]
    point, mean = point[nearest < n_nearest], mean[nearest < n_nearest]
    first = _first_in_cell(mean, width)
    return point[first], mean[first]


def _first_in_cell(uv: Float[Tensor, "n 2"], width: Tensor) -> Int64[Tensor, " m"]:
    """Indices, ascending, of the first position in each cell of a grid with cells of that width [pixels]."""
    _, cell = torch.unique((uv / width).floor().long(), dim=0, return_inverse=True)
    n = int(cell.max()) + 1 if len(cell) else 0
    return torch.full((n,), len(uv)).scatter_reduce_(0, cell, torch.arange(len(uv)), "amin").sort().values


def _new_tracks(matches: list[Match], tracked: Float[Tensor, "n 2"], spacing: Tensor) -> Float[Tensor, "m 2"]:
    """Start positions of new tracks: the most confident match of every grid cell that holds no track."""
    if not matches:
        return tracked[:0]
    confidence = torch.cat([m.confidence for m in matches])
    uv = torch.cat([m.uv_i for m in matches]).double()[torch.argsort(confidence, descending=True, stable=True)]
    first = _first_in_cell(torch.cat([tracked, uv]), spacing) - len(tracked)
    return uv[first[first >= 0]]


def _propagate(match: Match, uv: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """Positions in frame j of points of frame i, by a robust affine fit to the nearest matches, and which are accepted.

    A point is accepted if most of the matches around it agree with the fit.
    """
    distance, index = torch.cdist(uv, match.uv_i.double()).topk(min(MAX_NEIGHBOURS, len(match)), largest=False)
    near = (distance < MATCH_RADIUS) / (distance + 0.3).square()
    offset = match.uv_i.double()[index] - uv[:, None]
    basis = torch.cat([torch.ones_like(offset[..., :1]), offset], -1)
    shift = (match.uv_j - match.uv_i).double()[index]
    ridge = torch.diag(torch.tensor([1e-9, AFFINE_REGULARISATION, AFFINE_REGULARISATION], dtype=torch.float64))
    weight = near
    for _ in range(3):
        H = torch.einsum("nk,nki,nkj->nij", weight, basis, basis) + ridge
        fit = torch.linalg.solve(H, torch.einsum("nk,nki,nkc->nic", weight, basis, shift))
        residual = (shift - basis @ fit).norm(dim=-1)
        weight = near / (1 + (residual / (MATCH_TOLERANCE / 2)).square())
    agreeing, used = ((near > 0) & (residual < MATCH_TOLERANCE)).sum(1), (near > 0).sum(1)
    return uv + fit[:, 0], (used > 0) & (agreeing > 0.7 * used)
