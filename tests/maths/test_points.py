"""Nearest neighbours, against all distances."""

import pytest
import torch

from tumble.maths import neighbours, points


@pytest.mark.parametrize("k", [1, 5])
def test_neighbours_are_those_of_all_distances(k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points, "CHUNK_ROWS", 7)
    x = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    expected = torch.cdist(x, x).argsort(1)[:, :k].sort(1).values
    found = [*neighbours(x, k)]
    assert [len(rows) for rows in found] == [7, 7, 7, 7, 2]
    assert torch.equal(torch.cat(found).sort(1).values, expected)
