"""Densification and pruning as a gather of rows."""

import pytest
import torch

from tumble.inverse_rendering import densify
from tumble.maths.se3 import SE3
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians, opacity


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


# FastGS ---------------------------------------------------------------------------------------------------------------


def planned(bad: list[float], gradient: list[float], largest: list[float], **more: torch.Tensor) -> densify.Plan:
    """The plan for Gaussians with a pruning score of 0 that are no candidates, unless `more` says otherwise."""
    n, rules = len(bad), densify.FastGS(gradient=0.1, dense=0.5)
    scores = densify.Scores(torch.tensor(bad), more.get("prune", torch.zeros(n)), torch.tensor(gradient))
    candidates = more.get("candidates", torch.zeros(n, dtype=torch.bool))
    rng = torch.Generator().manual_seed(0)
    return densify.plan_fastgs(config(5.0, 1.0, 8), rules, scores, torch.tensor(largest), candidates, 1, rng)


def test_small_gaussians_are_cloned_and_large_ones_split_if_score_and_gradient_are_high() -> None:
    """The score counts without its fraction: 5.9 is not above 5."""
    plan = planned([6.0, 9.0, 5.9, 9.0], [0.2, 0.1, 0.2, 0.09], [0.5, 0.6, 0.6, 0.6])
    assert plan.index.tolist() == [0, 2, 3, 0, 1, 1]
    assert plan.fresh.tolist() == [False] * 3 + [True] * 3
    assert (plan.n_kept, plan.n_clones) == (3, 1)


def test_growth_ends_at_the_largest_number_with_the_highest_scores() -> None:
    plan = planned([6.0, 9.0, 7.0, 8.0, 6.0, 6.0], [1.0] * 6, [1.0] * 6)
    assert sorted(plan.index.tolist()) == [0, 1, 1, 2, 3, 3, 4, 5]


def test_half_as_many_as_may_be_pruned_are_drawn_by_their_score() -> None:
    """Candidates with a score of 1 are drawn almost surely; with a score as low as the others' hardly any is."""
    n, candidates = 1000, torch.arange(1000) < 10
    for score, fewest, most in ((1.0, 5, 5), (0.0, 0, 2)):
        prune = torch.where(candidates, score, 0.0)
        plan = planned([0.0] * n, [0.0] * n, [1.0] * n, candidates=candidates, prune=prune)
        removed = set(range(n)) - set(plan.index.tolist())
        assert fewest <= len(removed) <= most
        assert removed <= set(range(10))


def test_late_pruning_keeps_what_is_opaque_and_well_rendered() -> None:
    scores = densify.Scores(torch.zeros(4), torch.tensor([0.0, 0.95, 0.9, 0.0]), torch.zeros(4))
    kept = densify.kept_late(densify.FastGS(), torch.tensor([0.2, 0.2, 0.1, 0.09]), scores)
    assert kept.tolist() == [0, 2]
    assert densify.kept_late(densify.FastGS(), torch.full((4,), 0.01), scores).tolist() == [0, 1, 2, 3]


def test_the_gradient_on_the_screen_is_that_of_a_projected_point() -> None:
    """Of u + 2 v in units of half the image's sides, for two points in front of a turned and shifted object."""
    camera = Camera(torch.tensor([90.0, 110.0, 31.0, 22.0]), 48, 64)
    pose = SE3.exp(torch.tensor([0.3, -0.2, 4.0, 0.4, -0.9, 0.5]))
    means = torch.tensor([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.2]], requires_grad=True)
    column, row = camera.project(pose @ means).T
    (gradient,) = torch.autograd.grad((column / 32 + 2 * row / 24).sum(), [means])
    found = densify.screen_gradient(gradient, means.detach(), pose, camera)
    torch.testing.assert_close(found, torch.full((2,), 5**0.5))


@pytest.mark.parametrize(("step", "most"), [(2500, 0.8), (3000, 0.01)])
def test_opacities_are_limited_on_both_sides_of_the_surface(step: int, most: float) -> None:
    sdf, gamma = torch.tensor([0.0, 0.01, -0.01, 3.0, -3.0]), torch.tensor(5.0)
    limited = densify.limited(densify.FastGS(), sdf, gamma, step)
    torch.testing.assert_close(opacity(limited[:3], gamma), torch.full((3,), most))
    assert (limited[:3] < 0).tolist() == [False, False, True]
    assert torch.equal(limited[3:], sdf[3:])


def test_children_are_sampled_from_their_parent_and_clones_stay() -> None:
    """A parent that is turned by 90 degrees about z, so that its longest axis is y."""
    n, half = 4000, 0.5**0.5
    gaussians = Gaussians(
        means=torch.ones(n + 2, 3),
        quats=torch.tensor([half, 0, 0, half]).expand(n + 2, 4),
        log_scales=torch.tensor([0.4, 0.2, 0.01]).log().repeat(n + 2, 1),
        sdf=torch.zeros(n + 2),
        sh=torch.zeros(n + 2, 1, 3),
    )
    plan = densify.Plan(torch.zeros(n + 2, dtype=torch.long), torch.ones(n + 2, dtype=torch.bool), 1, 1)
    densify.sample_children(gaussians, plan, torch.Generator().manual_seed(0))
    assert torch.equal(gaussians.means[:2], torch.ones(2, 3))
    torch.testing.assert_close(gaussians.log_scales[:2].exp(), torch.tensor([[0.4, 0.2, 0.01]] * 2))
    moved = gaussians.means[2:] - 1
    torch.testing.assert_close(moved.std(0), torch.tensor([0.2, 0.4, 0.01]), rtol=0.05, atol=0)
    torch.testing.assert_close(gaussians.log_scales[2].exp(), torch.tensor([0.25, 0.125, 0.00625]))
