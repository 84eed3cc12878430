"""Rotation averaging of exact, noisy and partly wrong relative rotations."""

import torch

from tumble.maths import average_rotations
from tumble.maths.se3 import SO3


def graph(n: int, offsets: tuple[int, ...], seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random walk of `n` rotations, and the edges between frames at the given distances in time."""
    rng = torch.Generator().manual_seed(seed)
    R = [torch.eye(3, dtype=torch.float64)]
    for _ in range(n - 1):
        R.append(SO3.exp(0.3 * torch.randn(3, generator=rng, dtype=torch.float64)).matrix() @ R[-1])
    edges = torch.tensor([(t - k, t) for k in offsets for t in range(k, n)])
    return torch.stack(R), edges[:, 0], edges[:, 1]


def errors(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Angles to the truth once the object frame is aligned at the middle frame [radians]."""
    Q = found.mT @ true
    return SO3.from_matrix(Q.mT @ Q[len(Q) // 2]).angle()


def test_exact_edges_give_exact_rotations() -> None:
    R, i, j = graph(20, (1, 3), seed=0)
    out = average_rotations(i, j, R[j] @ R[i].mT, torch.ones(len(i)).double(), n_frames=20)
    assert errors(out.R_cam_obj, R).max() < 1e-6
    assert out.connected.all()
    assert out.disagreement.max() < 1e-6


def test_outlier_edges_have_little_influence_and_are_detected() -> None:
    """A fifth of the edges are random; the others have noise of half a degree."""
    R, i, j = graph(40, (1, 2, 4, 8), seed=1)
    rng = torch.Generator().manual_seed(2)
    noise = SO3.exp(0.009 * torch.randn(len(i), 3, generator=rng, dtype=torch.float64)).matrix()
    random = SO3.exp(2 * torch.randn(len(i), 3, generator=rng, dtype=torch.float64)).matrix()
    wrong = (torch.rand(len(i), generator=rng) < 0.2) & (j - i > 1)
    edges = torch.where(wrong[:, None, None], random, noise) @ R[j] @ R[i].mT
    out = average_rotations(i, j, edges, torch.ones(len(i)).double(), n_frames=40)
    assert errors(out.R_cam_obj, R).max() < 0.04
    assert (out.disagreement[~wrong] < 0.1).all()
    assert (out.disagreement[wrong] > 0.1).float().mean() > 0.9


def test_drift_is_distributed_over_a_loop() -> None:
    """A ring whose edges all rotate 1 percent too far does not close; the error is distributed over all edges."""
    n = 36
    step = torch.tensor([0.0, 2 * torch.pi / n, 0.0], dtype=torch.float64)
    i, j = torch.arange(n), (torch.arange(n) + 1) % n
    edges = SO3.exp((1.01 * step).expand(n, 3)).matrix()
    out = average_rotations(i, j, edges, torch.ones(n).double(), n_frames=n)
    torch.testing.assert_close(out.disagreement, torch.full((n,), 0.01 * 2 * torch.pi / n).double(), atol=1e-5, rtol=0)


def test_frames_without_edges_are_not_connected() -> None:
    R, i, j = graph(6, (1,), seed=3)
    keep = (i != 3) & (j != 3)  # leaves 0-1-2 and 4-5
    out = average_rotations(i[keep], j[keep], (R[j] @ R[i].mT)[keep], torch.ones(int(keep.sum())).double(), n_frames=6)
    assert out.connected.tolist() == [True, True, True, False, False, False]
    assert out.disagreement[-1] == torch.pi
