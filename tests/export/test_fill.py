"""Continuation of values over a ball of which a cap is unknown."""

import torch
from torch import Tensor

from tumble.export import fill
from tumble.maths import fibonacci_sphere

POINTS = 0.8 * fibonacci_sphere(20000)


def ramp(points: Tensor) -> Tensor:
    """Two values that grow along z and fall along x."""
    return torch.stack([0.5 + 0.4 * points[:, 2], 0.5 - 0.4 * points[:, 0]], -1)


def test_known_values_stay() -> None:
    known = POINTS[:, 0] < 0.4
    _, certainty = fill.continued(ramp(POINTS), known, POINTS)
    assert certainty[POINTS[:, 0] < 0.3].min() > 0.99
    assert certainty[POINTS[:, 0] > 0.5].max() < 0.01


def test_an_unknown_cap_continues_its_border() -> None:
    """Along z the values continue; along x the border's value stays. What was there before is ignored."""
    known = POINTS[:, 0] < 0.4
    values = torch.where(known[:, None], ramp(POINTS), torch.rand(POINTS.shape[0], 2))
    filled, _ = fill.continued(values, known, POINTS)
    cap = POINTS[:, 0] > 0.55
    upper, lower = cap & (POINTS[:, 2] > 0.3), cap & (POINTS[:, 2] < -0.3)
    assert filled[upper, 0].mean() > 0.55
    assert filled[lower, 0].mean() < 0.45
    assert (filled[cap, 0] - 0.5).abs().max() < 0.3
    assert (filled[cap, 1] - 0.34).abs().max() < 0.15


def test_there_is_no_edge() -> None:
    """Neighbours across the border differ by no more than the values themselves do."""
    known = POINTS[:, 0] < 0.4
    values = torch.where(known[:, None], ramp(POINTS), 0)
    filled, certainty = fill.continued(values, known, POINTS)
    blended = filled + certainty * (values - filled)
    band = (POINTS[:, 0] > 0.25) & (POINTS[:, 0] < 0.55)
    distances = torch.cdist(POINTS[band], POINTS[band])
    near = (distances < 0.03) & (distances > 0)
    assert (blended[band][:, None] - blended[band][None])[near].abs().max() < 0.08


def test_single_known_points_do_not_count() -> None:
    known = POINTS[:, 0] < 0.4
    strays = torch.arange(len(POINTS)) % 50 == 0
    _, certainty = fill.continued(ramp(POINTS), known ^ strays, POINTS)
    assert certainty[(POINTS[:, 0] < 0.25) & ~strays].min() > 0.9
    assert certainty[POINTS[:, 0] > 0.55].max() < 0.1
