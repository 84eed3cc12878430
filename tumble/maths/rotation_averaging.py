"""Rotation averaging: absolute rotations of all frames from relative rotations of pairs.

Frames are the nodes of a graph, and relative rotations `R_j_i` are its *edges*; a pair may have several. The initial
estimate follows a maximum spanning tree, for which an edge weighs more if more of its triangles close. Iteratively
reweighted least squares in the tangent space, with the Geman-McClure loss, then reduces the influence of outliers. The
object frame of the result is arbitrary.
"""

import heapq
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths.se3 import SO3

TRIANGLE_TOLERANCE = 0.17
"""Angle up to which the composition of three edges around a triangle counts as closed [radians]."""


@dataclass(frozen=True)
class AveragedRotations:
    """Absolute rotations of `t` frames, and the residuals of `e` edges."""

    R_cam_obj: Float[Tensor, "t 3 3"]
    """Object to camera, one per frame."""
    connected: Bool[Tensor, " t"]
    """Whether a frame is in the largest connected component of the graph; all other rotations are the identity."""
    disagreement: Float[Tensor, " e"]
    """Angle between each edge and the rotations of its frames, pi for edges outside the component [radians]."""


def average_rotations(
    i: Int64[Tensor, " e"],
    j: Int64[Tensor, " e"],
    R_j_i: Float[Tensor, "e 3 3"],
    weight: Float[Tensor, " e"],
    *,
    n_frames: int,
    scale: float = 0.1,
    steps: int = 40,
) -> AveragedRotations:
    """Robust average of relative rotations.

    Args:
        i: First frame of every edge.
        j: Second frame of every edge.
        R_j_i: Rotation from the camera frame of i to that of j.
        weight: Weight of every edge, positive.
        n_frames: Number of frames.
        scale: Final scale of the Geman-McClure loss; it starts at four times that [radians].
        steps: Number of iterations.
    """
    R, connected = _spanning_tree(*_edge_table(i, j, R_j_i, weight, n_frames))
    used = connected[i] & connected[j]
    for step in range(steps):
        s2 = (scale * max(1.0, 4.0 - 6.0 * step / steps)) ** 2
        error = _residual_rotations(R, i, j, R_j_i)
        w = used * weight * (s2 / (s2 + error.square().sum(-1))) ** 2
        laplacian = torch.zeros(n_frames, n_frames, dtype=R.dtype)
        for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            laplacian.index_put_((a, b), sign * w, accumulate=True)
        # In the object frame, rotations d_k of the frames k change the error by d_j - d_i, whatever the rotations are.
        pull = torch.einsum("eba,eb->ea", R[j], error) * w[:, None]
        right = torch.zeros(n_frames, 3, dtype=R.dtype).index_add_(0, j, pull).index_add_(0, i, -pull)
        # A small multiple of the identity fixes the gauge freedom and the frames without edges.
        delta = torch.linalg.solve(laplacian + 1e-9 * weight.mean() * torch.eye(n_frames, dtype=R.dtype), right)
        R = R @ SO3.exp(delta).matrix()
    angle = torch.linalg.vector_norm(_residual_rotations(R, i, j, R_j_i), dim=-1)
    return AveragedRotations(R, connected, torch.where(used, angle, torch.pi))


def _residual_rotations(R: Tensor, i: Tensor, j: Tensor, R_j_i: Tensor) -> Float[Tensor, "e 3"]:
    """Rotation vectors from the current to the measured rotation of frame j, camera frame of j [radians]."""
    return SO3.from_matrix(R_j_i @ R[i] @ R[j].mT).log()


def _edge_table(
    i: Tensor, j: Tensor, R_j_i: Tensor, weight: Tensor, n_frames: int
) -> tuple[Float[Tensor, "t t 3 3"], Float[Tensor, "t t"]]:
    """`R_j_i` by i and j, and their reliability: weight times fraction of triangles that close; 0 without an edge."""
    table = torch.eye(3, dtype=R_j_i.dtype).repeat(n_frames, n_frames, 1, 1)
    reliability = torch.zeros(n_frames, n_frames, dtype=R_j_i.dtype)
    pairs: dict[tuple[int, int], list[int]] = {}
    for edge, pair in enumerate(zip(i.tolist(), j.tolist(), strict=True)):
        pairs.setdefault(pair, []).append(edge)
    for (a, b), edges in pairs.items():
        # Of several edges, the one closest to all of them.
        R = R_j_i[edges]
        distance = (R[:, None] - R[None]).square().sum((-1, -2)).sqrt().sum(1)
        best = edges[int(distance.argmin())]
        table[a, b], reliability[a, b] = R_j_i[best], weight[edges].sum()
        table[b, a], reliability[b, a] = R_j_i[best].mT, reliability[a, b]
    closed, tested = torch.zeros_like(reliability), torch.zeros_like(reliability)
    for k in range(n_frames):
        near = torch.nonzero(reliability[k])[:, 0]
        around = table[k, near][None] @ table[near, k][:, None]
        direct = table[near[:, None], near]
        cosine = ((around * direct).sum((-1, -2)) - 1) / 2
        known = reliability[near[:, None], near] > 0
        closed[near[:, None], near] += known & (cosine > torch.cos(torch.tensor(TRIANGLE_TOLERANCE)))
        tested[near[:, None], near] += known
    return table, reliability * (closed + 0.1) / (tested + 0.2)


def _spanning_tree(
    table: Float[Tensor, "t t 3 3"], reliability: Float[Tensor, "t t"]
) -> tuple[Float[Tensor, "t 3 3"], Bool[Tensor, " t"]]:
    """Rotations along the maximum spanning tree of the largest connected component, by Prim's algorithm."""
    n = len(reliability)
    order = reliability.sum(1).argsort(descending=True).tolist()
    weights = reliability.tolist()
    best: dict[int, Tensor] = {}
    remaining = set(range(n))
    while remaining:
        root = next(k for k in order if k in remaining)
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
        remaining -= tree.keys()
        best = max(best, tree, key=len)
    R = table[0, 0].repeat(n, 1, 1)
    connected = torch.zeros(n, dtype=torch.bool)
    for frame, rotation in best.items():
        R[frame], connected[frame] = rotation, True
    return R, connected
