"""Surface points followed through many frames: matches, chained.

A *track* is one surface point and its *observations*, the pixels that show it. Long tracks are what holds poses
together: points that two or three frames share leave a short stretch of film free to bend by ten degrees and more,
points that ten frames share do not. Dense matches start anywhere, so two of them hardly ever meet in a pixel; a track
therefore goes on from where it *is*, by the matches around it, and fresh tracks begin where none passes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.scene import Match

NEAR = 2.2
"""How far around a point a match speaks for it [pixels]."""
AGREE = 1.0
"""Largest difference between matches that speak for one point [pixels]."""
SPEAK = 8
"""Most matches that speak for one point."""
BEND = 0.05
"""Weight against a flow that changes from pixel to pixel: of few matches the mean is enough."""
NEXT = 2
"""Frames up to which every pair is followed [frames]."""
MANY = 60
"""Matches from which a pair farther apart is followed as well: what a matcher finds there by accident is little."""
CROWDED = 0.5
"""Distance at which of two tracks the younger ends [distance of fresh tracks]."""


@dataclass(frozen=True)
class Tracks:
    """Observations of surface points; `o` observations of `n` points."""

    frame: Int64[Tensor, " o"]
    point: Int64[Tensor, " o"]
    """In [0, n); every point has an observation."""
    uv: Float[Tensor, "o 2"]
    """[pixels]"""

    @property
    def n(self) -> int:
        """Number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def __len__(self) -> int:
        return len(self.point)

    def select(self, keep: Tensor, least: int = 2) -> "Tracks":
        """Some of the observations, without points that keep fewer than `least`; points are numbered anew."""
        frame, point, uv = self.frame[keep], self.point[keep], self.uv[keep]
        if not len(point):
            return Tracks(frame, point, uv)
        enough = torch.bincount(point)[point] >= least
        _, fresh = torch.unique(point[enough], return_inverse=True)
        return Tracks(frame[enough], fresh, uv[enough])


NONE = Tracks(torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long), torch.zeros(0, 2).double())


def of_match(match: Match) -> Tracks:
    """Every correspondence a point that two frames show."""
    point = torch.arange(len(match))
    frame = torch.cat([torch.full_like(point, match.i), torch.full_like(point, match.j)])
    return Tracks(frame, point.repeat(2), torch.cat([match.uv_i, match.uv_j]).double())


def joined(*parts: Tracks) -> Tracks:
    """Tracks of different points, those of the first part numbered first."""
    point, begin = [], 0
    for part in parts:
        point.append(part.point + begin)
        begin += part.n
    return Tracks(torch.cat([p.frame for p in parts]), torch.cat(point), torch.cat([p.uv for p in parts]))


def followed(matches: Sequence[Match], spacing: Float[Tensor, " t"]) -> Tracks:
    """Tracks through all frames, in the order of time.

    Args:
        matches: Of any matcher, each with i < j.
        spacing: Distance of fresh tracks, per frame [pixels].
    """
    from_frame: dict[int, list[Match]] = {}
    for match in matches:
        if len(match) and (match.j - match.i <= NEXT or len(match) >= MANY):
            from_frame.setdefault(match.i, []).append(match)
    arriving: dict[int, list[tuple[int, Tensor, Tensor]]] = {}
    seen: list[Tracks] = []
    fresh = 0
    for frame in range(len(spacing)):
        point, uv = _gathered(arriving.pop(frame, []), CROWDED * spacing[frame])
        begun = _begun(from_frame.get(frame, []), uv, spacing[frame])
        point = torch.cat([point, torch.arange(fresh, fresh + len(begun))])
        uv = torch.cat([uv, begun])
        fresh += len(begun)
        seen.append(Tracks(torch.full_like(point, frame), point, uv))
        for match in from_frame.get(frame, []):
            there, kept = _carried(match, uv)
            arriving.setdefault(match.j, []).append((match.j - match.i, point[kept], there[kept]))
    every = (torch.cat([getattr(part, name) for part in seen]) for name in ("frame", "point", "uv"))
    return (tracks := Tracks(*every)).select(torch.ones(len(tracks), dtype=torch.bool))


def _gathered(
    arrivals: list[tuple[int, Tensor, Tensor]], apart: Tensor
) -> tuple[Int64[Tensor, " n"], Float[Tensor, "n 2"]]:
    """Tracks that the nearest earlier frame leads here; only the oldest in each cell.

    Farther frames sharpen the place where they agree. On their own they are not to be believed: between frames that are
    20 degrees apart flow stays behind by pixels, and everywhere alike.
    """
    if not arrivals:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, 2, dtype=torch.float64)
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    sure = sum(len(a) for gap, a, _ in arrivals if gap == arrivals[0][0])
    point, which = torch.unique(torch.cat([a for _, a, _ in arrivals]), return_inverse=True)
    uv = torch.cat([b for _, _, b in arrivals])
    nearest = torch.full_like(point, len(uv)).scatter_reduce_(0, which, torch.arange(len(uv)), "amin")
    agrees = ((uv - uv[nearest][which]).norm(dim=-1) < AGREE / 2).double()
    total = torch.zeros_like(uv[: len(point), 0]).index_add_(0, which, agrees)
    mean = torch.zeros_like(uv[: len(point)]).index_add_(0, which, agrees[:, None] * uv) / total[:, None]
    point, mean = point[nearest < sure], mean[nearest < sure]
    first = _first_in_cell(mean, apart)
    return point[first], mean[first]


def _first_in_cell(uv: Float[Tensor, "n 2"], width: Tensor) -> Int64[Tensor, " m"]:
    """Of every cell of a grid, the first that lies in it."""
    _, cell = torch.unique((uv / width).floor().long(), dim=0, return_inverse=True)
    n = int(cell.max()) + 1 if len(cell) else 0
    return torch.full((n,), len(uv)).scatter_reduce_(0, cell, torch.arange(len(uv)), "amin").sort().values


def _begun(matches: list[Match], taken: Float[Tensor, "n 2"], spacing: Tensor) -> Float[Tensor, "m 2"]:
    """Where fresh tracks begin: the most confident match of every cell through which no track passes."""
    if not matches:
        return taken[:0]
    confidence = torch.cat([m.confidence for m in matches])
    uv = torch.cat([m.uv_i for m in matches]).double()[torch.argsort(confidence, descending=True, stable=True)]
    first = _first_in_cell(torch.cat([taken, uv]), spacing) - len(taken)
    return uv[first[first >= 0]]


def _carried(match: Match, uv: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """Where places of frame i are in frame j, by an affine fit to the nearest matches, and whether those agree."""
    distance, index = torch.cdist(uv, match.uv_i.double()).topk(min(SPEAK, len(match)), largest=False)
    near = (distance < NEAR) / (distance + 0.3).square()
    around = match.uv_i.double()[index] - uv[:, None]
    basis = torch.cat([torch.ones_like(around[..., :1]), around], -1)
    step = (match.uv_j - match.uv_i).double()[index]
    stiff = torch.diag(torch.tensor([1e-9, BEND, BEND], dtype=torch.float64))
    weight = near
    for _ in range(3):
        H = torch.einsum("nk,nki,nkj->nij", weight, basis, basis) + stiff
        fit = torch.linalg.solve(H, torch.einsum("nk,nki,nkc->nic", weight, basis, step))
        off = (step - basis @ fit).norm(dim=-1)
        weight = near / (1 + (off / (AGREE / 2)).square())
    agreeing, speaking = ((near > 0) & (off < AGREE)).sum(1), (near > 0).sum(1)
    return uv + fit[:, 0], (speaking > 0) & (agreeing > 0.7 * speaking)
