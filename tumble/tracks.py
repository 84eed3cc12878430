"""Surface points followed through many frames: matches, chained.

A *track* is one surface point and its *observations*, the pixels that show it. Dense matchers start anywhere, so two of
their matches hardly ever meet in a pixel: `anchored` first brings all matches of a frame to the same few starting
points, the *anchors*, whereupon `build_tracks` chains what meets.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.match import Match

SAME = 0.25
"""Positions in one frame that are closer than this are one observation [pixels]."""
NEAR = 1.2
"""How far around an anchor a match speaks for it [pixels]."""
AGREE = 1.0
"""Largest difference between matches that speak for one anchor [pixels]."""


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


def joined(*parts: Tracks) -> Tracks:
    """Tracks of different points, those of the first part numbered first."""
    point, begin = [], 0
    for part in parts:
        point.append(part.point + begin)
        begin += part.n
    return Tracks(torch.cat([p.frame for p in parts]), torch.cat(point), torch.cat([p.uv for p in parts]))


def anchored(matches: Sequence[Match], spacing: Float[Tensor, " t"]) -> list[Match]:
    """Matches that start, in their frame i, from anchors common to all matches of that frame.

    Each cell of a grid gives its most confident starting point as an anchor; matches around it say where it went.

    Args:
        matches: Of any matcher.
        spacing: Width of the cells, per frame [pixels].
    """
    by_frame: dict[int, list[Match]] = {}
    for match in matches:
        if len(match):
            by_frame.setdefault(match.i, []).append(match)
    moved = []
    for i, group in by_frame.items():
        uv = torch.cat([m.uv_i for m in group]).double()
        order = torch.argsort(torch.cat([m.confidence for m in group]), descending=True, stable=True)
        cell = (uv[order] / spacing[i]).floor().long()
        _, which = torch.unique(cell, dim=0, return_inverse=True)
        first = torch.full((int(which.max()) + 1,), len(order)).scatter_reduce_(
            0, which, torch.arange(len(order)), "amin"
        )
        anchors = uv[order[first]]
        moved += [_follow(match, anchors) for match in group]
    return [match for match in moved if len(match)]


def _follow(match: Match, anchors: Float[Tensor, "a 2"]) -> Match:
    """Where the anchors of frame i are in frame j, by the nearest matches; without those that nothing speaks for."""
    distance, index = torch.cdist(anchors, match.uv_i.double()).topk(min(4, len(match)), largest=False)
    weight = (distance < NEAR) / (distance + 0.05).square()
    step = (match.uv_j - match.uv_i).double()[index]
    mean = (weight[..., None] * step).sum(1) / weight.sum(1, keepdim=True).clamp_min(1e-9)
    spread = ((step - mean[:, None]).norm(dim=-1) * (weight > 0)).amax(1)
    kept = (weight.sum(1) > 0) & (spread < AGREE)
    confidence = match.confidence.double()[index[:, 0]]
    return Match(match.i, match.j, anchors[kept], (anchors + mean)[kept], confidence[kept])


def build_tracks(matches: Sequence[Match]) -> Tracks:
    """Chain matches that meet in the same pixel, the most confident first (union-find).

    A match that would put two different pixels of one frame into one track is refused.
    """
    if not any(len(match) for match in matches):
        nothing = torch.zeros(0, dtype=torch.long)
        return Tracks(nothing, nothing, torch.zeros(0, 2, dtype=torch.float64))
    uv = torch.cat([torch.cat([m.uv_i, m.uv_j]) for m in matches]).double()
    frame = torch.cat([torch.tensor([m.i] * len(m) + [m.j] * len(m), dtype=torch.long) for m in matches])
    cell = (uv / SAME).round().long()
    _, node = torch.unique((frame << 40) + (cell[:, 0] << 20) + cell[:, 1], return_inverse=True)
    place = torch.zeros(int(node.max()) + 1, 2, dtype=torch.float64).index_copy_(0, node, uv)
    where = torch.zeros(len(place), dtype=torch.long).index_copy_(0, node, frame)
    _, point = torch.unique(torch.tensor(_roots(matches, node.tolist(), where.tolist())), return_inverse=True)
    return Tracks(where, point, place).select(torch.ones(len(place), dtype=torch.bool))


def _roots(matches: Sequence[Match], node: list[int], frame: list[int]) -> list[int]:
    """The representative of every node; sets know their frames."""
    links, begin = [], 0
    for match in matches:
        n = len(match)
        ends = zip(match.confidence.tolist(), node[begin : begin + n], node[begin + n : begin + 2 * n], strict=True)
        links += ends
        begin += 2 * n
    parent = list(range(len(frame)))
    frames = [{f} for f in frame]

    def find(a: int) -> int:
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        return a

    for _, a, b in sorted(links, key=lambda link: -link[0]):
        a, b = find(a), find(b)
        if a == b or frames[a] & frames[b]:
            continue
        if len(frames[a]) < len(frames[b]):
            a, b = b, a
        parent[b] = a
        frames[a] |= frames[b]
    return [find(a) for a in range(len(parent))]
