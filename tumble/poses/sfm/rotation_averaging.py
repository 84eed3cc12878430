"""Absolute rotations from relative ones: robust averaging over a graph of frames.

An *edge* says how the object turned from frame i to frame j, `R_j_i`; there may be several for a pair. Edges whose
triangles close are trusted: the start follows them from the best connected frame (a maximum spanning tree). Iteratively
reweighted least squares in the tangent space, with the Geman-McClure loss, then lets edges that contradict the others
fade. The object frame of the result is arbitrary.
"""

import heapq
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SO3

CLOSES = 0.17
"""Angle up to which three edges in a row count as closed [radians]."""


@dataclass(frozen=True)
class Averaged:
    """Rotations of all frames, and how the edges agree with them."""

    R_cam_obj: Float[Tensor, "t 3 3"]
    connected: Bool[Tensor, " t"]
    """Whether edges lead there from the largest part of the graph; the identity stands where not."""
    disagreement: Float[Tensor, " e"]
    """Angle between each edge and the rotations of its frames [radians]."""


def average(
    i: Int64[Tensor, " e"],
    j: Int64[Tensor, " e"],
    R_j_i: Float[Tensor, "e 3 3"],
    weight: Float[Tensor, " e"],
    *,
    n_frames: int,
    scale: float = 0.1,
    steps: int = 40,
) -> Averaged:
    """Average rotations.

    Args:
        i: First frame of every edge.
        j: Second frame.
        R_j_i: From the camera frame of i to that of j.
        weight: Trust, positive.
        n_frames: Frames there are.
        scale: Final angle at which an edge counts as contradicted; four times that in the beginning [radians].
        steps: Iterations.
    """
    R, connected = _spanning_tree(*_trusted(i, j, R_j_i, weight, n_frames))
    used = connected[i] & connected[j]
    for step in range(steps):
        s2 = (scale * max(1.0, 4.0 - 6.0 * step / steps)) ** 2
        error = _error(R, i, j, R_j_i)
        w = used * weight * (s2 / (s2 + error.square().sum(-1))) ** 2
        laplacian = torch.zeros(n_frames, n_frames, dtype=R.dtype)
        for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            laplacian.index_put_((a, b), sign * w, accumulate=True)
        # In the object frame a turn d_k of frame k changes the error by d_j - d_i, whatever the rotations.
        pull = torch.einsum("eba,eb->ea", R[j], error) * w[:, None]
        right = torch.zeros(n_frames, 3, dtype=R.dtype).index_add_(0, j, pull).index_add_(0, i, -pull)
        # A trace of the identity fixes the gauge and the frames without edges.
        turn = torch.linalg.solve(laplacian + 1e-9 * weight.mean() * torch.eye(n_frames, dtype=R.dtype), right)
        R = R @ SO3.exp(turn).matrix()
    angle = torch.linalg.vector_norm(_error(R, i, j, R_j_i), dim=-1)
    return Averaged(R, connected, torch.where(used, angle, torch.pi))


def _error(R: Tensor, i: Tensor, j: Tensor, R_j_i: Tensor) -> Float[Tensor, "e 3"]:
    """Turn that is missing at frame j, camera frame of j [radians]."""
    return SO3.from_matrix(R_j_i @ R[i] @ R[j].mT).log()


def _trusted(
    i: Tensor, j: Tensor, R_j_i: Tensor, weight: Tensor, n_frames: int
) -> tuple[Float[Tensor, "t t 3 3"], Float[Tensor, "t t"]]:
    """One edge per pair of frames and direction, and how far to trust it: its weight times how many triangles close."""
    table = torch.eye(3, dtype=R_j_i.dtype).repeat(n_frames, n_frames, 1, 1)
    trust = torch.zeros(n_frames, n_frames, dtype=R_j_i.dtype)
    pairs: dict[tuple[int, int], list[int]] = {}
    for edge, pair in enumerate(zip(i.tolist(), j.tolist(), strict=True)):
        pairs.setdefault(pair, []).append(edge)
    for (a, b), edges in pairs.items():
        # Of several, the one closest to all of them.
        R = R_j_i[edges]
        distance = (R[:, None] - R[None]).square().sum((-1, -2)).sqrt().sum(1)
        best = edges[int(distance.argmin())]
        table[a, b], trust[a, b] = R_j_i[best], weight[edges].sum()
        table[b, a], trust[b, a] = R_j_i[best].mT, trust[a, b]
    closed, tried = torch.zeros_like(trust), torch.zeros_like(trust)
    for k in range(n_frames):
        near = torch.nonzero(trust[k])[:, 0]
        way = table[k, near][None] @ table[near, k][:, None]
        direct = table[near[:, None], near]
        cosine = ((way * direct).sum((-1, -2)) - 1) / 2
        known = trust[near[:, None], near] > 0
        closed[near[:, None], near] += known & (cosine > torch.cos(torch.tensor(CLOSES)))
        tried[near[:, None], near] += known
    return table, trust * (closed + 0.1) / (tried + 0.2)


def _spanning_tree(
    table: Float[Tensor, "t t 3 3"], trust: Float[Tensor, "t t"]
) -> tuple[Float[Tensor, "t 3 3"], Bool[Tensor, " t"]]:
    """Rotations along the most trusted edges of the largest part of the graph (Prim)."""
    n = len(trust)
    order = trust.sum(1).argsort(descending=True).tolist()
    weights = trust.tolist()
    best: dict[int, Tensor] = {}
    left = set(range(n))
    while left:
        root = next(k for k in order if k in left)
        tree: dict[int, Tensor] = {}
        border = [(0.0, root, root)]
        while border:
            _, frame, parent = heapq.heappop(border)
            if frame in tree:
                continue
            tree[frame] = table[parent, frame] @ tree.get(parent, table[root, root])
            for k in range(n):
                if weights[frame][k] > 0 and k not in tree:
                    heapq.heappush(border, (-weights[frame][k], k, frame))
        left -= tree.keys()
        best = max(best, tree, key=len)
    R = table[0, 0].repeat(n, 1, 1)
    connected = torch.zeros(n, dtype=torch.bool)
    for frame, rotation in best.items():
        R[frame], connected[frame] = rotation, True
    return R, connected
