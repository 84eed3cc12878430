"""Nearest neighbours, against all distances, and order in memory."""

import pytest
import torch

from tumble.maths import morton_order, neighbours, points


@pytest.mark.parametrize("k", [1, 5])
def test_neighbours_are_those_of_all_distances(k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points, "CHUNK_ROWS", 7)
    x = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    expected = torch.cdist(x, x).argsort(1)[:, :k].sort(1).values
    found = [*neighbours(x, k)]
    assert [len(rows) for rows in found] == [7, 7, 7, 7, 2]
    assert torch.equal(torch.cat(found).sort(1).values, expected)


def test_morton_order() -> None:
    """The curve visits the eight octants one after the other, x fastest; then the octants within each."""
    corners = torch.cartesian_prod(*(torch.tensor([-0.9, 1.0]),) * 3)  # x varies slowest
    mixed = torch.tensor([3, 6, 0, 5, 7, 1, 2, 4])
    order = morton_order(corners[mixed])
    assert mixed[order].tolist() == [0, 4, 2, 6, 1, 5, 3, 7]

    scattered = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    ordered = scattered[morton_order(scattered)]
    assert ordered.unique(dim=0).shape == scattered.shape
    step, random_step = ((x[1:] - x[:-1]).norm(dim=1).mean() for x in (ordered, scattered))
    assert step < 0.15 * random_step


def test_morton_order_of_points_in_one_place_is_theirs() -> None:
    assert morton_order(torch.full((4, 3), 0.3)).tolist() == [0, 1, 2, 3]
