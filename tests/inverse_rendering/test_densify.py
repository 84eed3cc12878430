"""Densification and pruning as a gather of rows."""

import torch

from tumble.inverse_rendering import densify
from tumble.scene.gaussians import Gaussians


def config(score: float, fraction: float, limit: int) -> densify.Config:
    return densify.Config(grow_score=score, grow_fraction=fraction, max_gaussians=limit)


def test_high_scores_split_pruned_rows_vanish_and_the_rest_is_kept() -> None:
    score = torch.tensor([0.0, 9.0, 5.0, 7.0, 1.0])
    prune = torch.tensor([True, False, False, False, False])
    plan = densify.plan(config(2.0, 0.4, 100), score, prune)
    assert plan.index.tolist() == [2, 4, 1, 3, 1, 3]
    assert plan.fresh.tolist() == [False, False, True, True, True, True]


def test_the_number_of_gaussians_is_limited() -> None:
    score = torch.arange(10.0) + 5
    plan = densify.plan(config(0.0, 1.0, 12), score, torch.zeros(10, dtype=torch.bool))
    assert len(plan.index) == 12
    assert plan.index[plan.fresh].unique().tolist() == [8, 9]


def test_pruned_gaussians_do_not_split() -> None:
    score = torch.tensor([9.0, 1.0])
    plan = densify.plan(config(0.5, 0.5, 10), score, torch.tensor([True, False]))
    assert plan.index.tolist() == [1, 1]


def test_children_are_placed_on_both_sides_along_the_longer_axis() -> None:
    half = 0.5**0.5
    gaussians = Gaussians(
        means=torch.zeros(3, 3),
        quats=torch.tensor([[1.0, 0, 0, 0], [half, 0, 0, half], [half, 0, 0, half]]),  # 90 degrees about z
        log_scales=torch.tensor([[0.1, 0.2, 0.01], [0.4, 0.2, 0.01], [0.4, 0.2, 0.01]]).log(),
        sdf=torch.zeros(3),
        sh=torch.zeros(3, 1, 3),
    )
    plan = densify.Plan(torch.tensor([0, 1, 1]), torch.tensor([False, True, True]), 1)
    densify.place_children(gaussians, plan)
    expected = torch.tensor([[0.0, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])
    torch.testing.assert_close(gaussians.means, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(gaussians.log_scales[1:].exp(), torch.tensor([[0.25, 0.2, 0.01]] * 2))
    torch.testing.assert_close(gaussians.log_scales[0].exp(), torch.tensor([0.1, 0.2, 0.01]))


def test_a_nearly_perfect_rendering_has_no_bad_pixels() -> None:
    error, mask = torch.full((4, 4), 0.01), torch.ones(4, 4)
    error[0, 0] = 0.015
    assert densify.bad_pixels(densify.Config(), error, mask).sum() == 0
    error[0, 0] = 0.5
    assert densify.bad_pixels(densify.Config(), error, mask).sum() == 1
    mask[0, 0] = 0
    assert densify.bad_pixels(densify.Config(), error, mask).sum() == 0
