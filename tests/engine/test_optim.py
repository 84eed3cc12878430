"""Leaves, learning rates and moments, compared with Adam written out in float64."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from tumble.engine import optim
from tumble.engine.optim import NotFinite, adam, anneal, descend, leaves, pack, regrow, resample, unpack
from tumble.io import tree


@dataclass(frozen=True)
class Cloud:
    """Leaves whose rows are regrown."""

    means: Tensor
    sdf: Tensor
    empty: Tensor


@dataclass(frozen=True)
class Scene:
    cloud: Cloud
    light: Tensor
    gamma: Tensor
    ids: Tensor
    word: str


def make_scene(n: int = 5, dtype: torch.dtype = torch.float64) -> Scene:
    torch.manual_seed(0)
    cloud = Cloud(torch.randn(n, 3, dtype=dtype), torch.randn(n, dtype=dtype), torch.zeros(n, 0, 3, dtype=dtype))
    light, gamma = torch.randn(2, 4, 3, dtype=dtype), torch.tensor(2.0, dtype=dtype)
    return leaves(Scene(cloud, light, gamma, torch.arange(n), "word"))


def bowl(scene: Scene) -> Tensor:
    """A loss whose gradient differs between all elements and steps."""
    floats = [x for x in tree.named_tensors(scene).values() if x.is_floating_point()]
    return sum(((x - 1) ** 2 * torch.linspace(1, 2, x.numel()).reshape(x.shape)).sum() for x in floats).to(floats[0])


class ByHand:
    """Adam of Kingma and Ba, one parameter, in float64."""

    def __init__(self, x: Tensor, rate: float) -> None:
        self.x, self.rate, self.m, self.v, self.t = x.detach().double().clone(), rate, 0.0, 0.0, 0

    def step(self, gradient: Tensor) -> None:
        self.t += 1
        self.m = 0.9 * self.m + 0.1 * gradient
        self.v = 0.999 * self.v + 0.001 * gradient**2
        m, v = self.m / (1 - 0.9**self.t), self.v / (1 - 0.999**self.t)
        self.x = self.x - self.rate * m / (v**0.5 + 1e-15)


# Rates ----------------------------------------------------------------------------------------------------------------


def test_leaves_are_copies_and_floats_require_gradients() -> None:
    source = Scene(
        Cloud(torch.ones(2, 3).T, torch.ones(2), torch.ones(2)), torch.ones(1), torch.ones(()), torch.arange(2), "a"
    )
    scene = leaves(source)
    with torch.no_grad():
        scene.cloud.means.zero_()
    assert source.cloud.means.sum() == 6
    assert scene.cloud.means.is_leaf
    assert scene.cloud.means.is_contiguous()
    assert [x.requires_grad for x in tree.named_tensors(scene).values()] == [True, True, True, True, True, False]
    assert scene.word == "a"


def test_the_longest_matching_key_sets_the_rate_and_keys_end_at_a_dot() -> None:
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1, "cloud": 0.2, "cloud.sdf": 0.3})
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    assert rates == {"cloud.means": 0.2, "cloud.sdf": 0.3, "cloud.empty": 0.2, "light": 0.1, "gamma": 0.1}
    assert all(group["base"] == group["lr"] for group in optimizer.param_groups)
    with pytest.raises(ValueError, match=r"no learning rate for gamma"):
        adam(scene, {"cloud": 0.1, "light": 0.1})
    with pytest.raises(ValueError, match=r"for clo, which is no leaf"):
        adam(scene, {"": 0.1, "clo": 0.1})


def test_rate_zero_freezes_a_leaf() -> None:
    scene = make_scene()
    before = scene.light.clone()
    optimizer = adam(scene, {"": 0.1, "light": 0.0})
    descend(bowl(scene), optimizer, step=0)
    assert torch.equal(scene.light, before)
    assert not scene.light.requires_grad
    assert "light" not in [group["name"] for group in optimizer.param_groups]
    with pytest.raises(ValueError, match="nothing to train"):
        adam(scene, {"": 0.0})


def test_annealing_scales_base_rates_and_leaves_other_leaves_alone() -> None:
    optimizer = adam(make_scene(), {"": 0.1, "cloud": 0.2})
    anneal(optimizer, 0.5)
    anneal(optimizer, {"cloud": 0.25, "cloud.sdf": 0.0})
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    assert rates == {"cloud.means": 0.05, "cloud.sdf": 0.0, "cloud.empty": 0.05, "light": 0.05, "gamma": 0.05}


# Steps ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_steps_follow_adam_written_out(dtype: torch.dtype, tolerance: float) -> None:
    """The tolerance is the rounding of ten steps."""
    scene = make_scene(dtype=dtype)
    optimizer = adam(scene, {"": 0.05, "cloud.means": 0.01})
    hand = {"cloud.means": ByHand(scene.cloud.means, 0.01), "light": ByHand(scene.light, 0.05)}
    for step in range(10):
        descend(bowl(scene), optimizer, step=step)
        for copy in hand.values():
            weight = torch.linspace(1, 2, copy.x.numel()).reshape(copy.x.shape)
            copy.step(2 * (copy.x - 1) * weight)
    named = tree.named_tensors(scene)
    for name, copy in hand.items():
        torch.testing.assert_close(named[name].detach().double(), copy.x, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("steep", [lambda x: x.sqrt(), lambda x: x.abs().sqrt()], ids=["infinity", "nan"])
def test_a_gradient_that_is_not_finite_is_named_before_anything_changes(steep: Callable[[Tensor], Tensor]) -> None:
    """A square root has an infinite slope at 0 where its value is finite, so only the gradient is not finite."""
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1})
    descend(bowl(scene), optimizer, step=0)
    before = {name: x.clone() for name, x in (tree.named_tensors(scene) | pack(optimizer)).items()}
    with pytest.raises(NotFinite, match=r"the gradient of light is not finite at step 7") as caught:
        descend(bowl(scene) + steep(scene.light - scene.light.detach()).sum(), optimizer, step=7)
    assert (caught.value.name, caught.value.step) == ("light", 7)
    after = tree.named_tensors(scene) | pack(optimizer)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_loss_that_is_not_finite_is_named() -> None:
    scene = make_scene()
    with pytest.raises(NotFinite, match="the loss is not finite at step 3"):
        descend(bowl(scene) * float("nan"), adam(scene, {"": 0.1}), step=3)


def test_gradients_whose_norm_overflows_are_still_finite() -> None:
    """Three times the square of 1.5e19 is beyond float32, one is not. Adam's first step has the length of the rate."""
    x = leaves({"x": torch.zeros(3)})
    descend(1.5e19 * x["x"].sum(), adam(x, {"": 0.1}), step=0)
    torch.testing.assert_close(x["x"].detach(), torch.full((3,), -0.1))


def test_leaves_that_the_loss_does_not_depend_on_are_unchanged() -> None:
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1})
    descend(bowl(scene), optimizer, step=0)
    before, moment = scene.gamma.clone(), optimizer.state[scene.gamma]["exp_avg"].clone()
    descend(bowl(replace(scene, gamma=scene.gamma.detach())), optimizer, step=1)
    assert torch.equal(scene.gamma, before)
    assert torch.equal(optimizer.state[scene.gamma]["exp_avg"], moment)


# Rows that come and go ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frozen", [False, True])
def test_regrowing_moves_rows_with_their_moments_and_clears_fresh_ones(frozen: bool) -> None:
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1, "cloud.sdf": 0.0 if frozen else 0.1})
    for step in range(3):
        descend(bowl(scene), optimizer, step=step)
    old, moments = scene.cloud.means.clone(), optimizer.state[scene.cloud.means]["exp_avg_sq"].clone()
    index, fresh = torch.tensor([4, 0, 0, 2]), torch.tensor([False, False, True, False])
    grown = replace(scene, cloud=regrow(scene.cloud, optimizer, index, fresh))
    assert torch.equal(grown.cloud.means, old[index])
    assert grown.cloud.empty.shape == (4, 0, 3)
    expected = moments[index]
    expected[2] = 0
    assert torch.equal(optimizer.state[grown.cloud.means]["exp_avg_sq"], expected)
    assert optimizer.state[grown.cloud.means]["step"] == 3
    assert scene.cloud.means not in optimizer.state
    assert grown.cloud.sdf.requires_grad != frozen
    with torch.no_grad():
        grown.cloud.means[fresh] += 0.5
    before = {name: x.clone() for name, x in tree.named_tensors(grown).items()}
    descend(bowl(grown), optimizer, step=3)
    moved = {name for name, x in tree.named_tensors(grown).items() if not torch.equal(x, before[name])}
    assert moved == {"cloud.means", "light", "gamma"} | (set() if frozen else {"cloud.sdf"})


def test_pruning_does_not_affect_the_remaining_rows() -> None:
    """The loss is a sum over rows, so rows are independent of each other."""
    target = torch.arange(15.0).reshape(5, 3)
    whole, keep = make_scene(dtype=torch.float32).cloud, torch.tensor([3, 1])
    part = leaves(whole)
    of_whole, of_part = (adam(cloud, {"": 0.1, "empty": 0.0, "sdf": 0.0}) for cloud in (whole, part))
    for step in range(8):
        if step == 4:
            part, target_of_part = regrow(part, of_part, keep, torch.zeros(2, dtype=torch.bool)), target[keep]
        descend(((whole.means - target) ** 2).sum(), of_whole, step=step)
        descend(((part.means - (target if step < 4 else target_of_part)) ** 2).sum(), of_part, step=step)
    # Vectorised and scalar square roots may round differently at another row index, by a few units in the last place.
    torch.testing.assert_close(part.means, whole.means[keep], rtol=1e-6, atol=1e-6)


def test_regrowing_before_the_first_step_and_down_to_nothing_works() -> None:
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1})
    none = torch.zeros(0, dtype=torch.long)
    cloud = regrow(scene.cloud, optimizer, none, none.bool())
    assert len(cloud.means) == 0
    descend(bowl(replace(scene, cloud=cloud)), optimizer, step=0)


def test_trees_that_cannot_be_regrown_are_rejected() -> None:
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1})
    index, fresh = torch.tensor([0]), torch.tensor([True])
    with pytest.raises(ValueError, match="same number of rows"):
        regrow(scene, optimizer, index, fresh)
    regrow(scene.cloud, optimizer, index, fresh)
    with pytest.raises(ValueError, match="does not hold"):
        regrow(scene.cloud, optimizer, index, fresh)


# A finer grid ---------------------------------------------------------------------------------------------------------


def finer(x: Tensor) -> Tensor:
    return x.repeat_interleave(2, 0).repeat_interleave(2, 1)


def test_a_resampled_leaf_trains_like_the_coarse_one() -> None:
    """A loss of the means of 2 x 2 cells has the same descent on both grids, cell for cell."""
    coarse = leaves({"light": torch.randn(2, 4, 3, dtype=torch.float64), "x": torch.ones(2, dtype=torch.float64)})
    fine = leaves(coarse)
    of_coarse, of_fine = adam(coarse, {"": 0.1}), adam(fine, {"": 0.1})

    def loss(light: Tensor, x: Tensor, step: int) -> Tensor:
        return ((light - 0.1 * step) ** 4).sum() + (x**2).sum()

    for step in range(12):
        if step == 5:
            fine = resample(fine, of_fine, "light", finer)
        means = fine["light"] if step < 5 else fine["light"].reshape(2, 2, 4, 2, 3).mean((1, 3))
        descend(loss(coarse["light"], coarse["x"], step), of_coarse, step=step)
        descend(loss(means, fine["x"], step), of_fine, step=step)
    # Equal except for the order of float64 sums.
    torch.testing.assert_close(fine["light"], finer(coarse["light"]), rtol=1e-12, atol=1e-12)
    assert fine["light"].shape == (4, 8, 3)
    assert of_fine.state[fine["light"]]["step"] == 12


def test_a_nonlinear_map_requires_a_map_of_moments() -> None:
    """exp, upsample, log is right for log radiance, but would erase second moments, which are tiny."""
    scene = make_scene()
    optimizer = adam(scene, {"": 0.1})
    descend(bowl(scene), optimizer, step=0)
    with pytest.raises(ValueError, match="light is not linear"):
        resample(scene, optimizer, "light", lambda x: finer(x.exp()).log() + 0.1)
    scene = resample(scene, optimizer, "light", lambda x: finer(x.exp()).log() + 0.1, moments=finer)
    assert scene.light.shape == (4, 8, 3)
    assert (optimizer.state[scene.light]["exp_avg_sq"] > 0).all()
    with pytest.raises(ValueError, match=r"no leaf 'lamp'; leaves are cloud\.means"):
        resample(scene, optimizer, "lamp", finer)


def test_second_moments_stay_non_negative_under_a_map_that_overshoots() -> None:
    def sharpened(x: Tensor) -> Tensor:
        return finer(2 * x - x.mean())

    scene = make_scene()
    optimizer = adam(scene, {"": 0.1})
    descend(bowl(scene), optimizer, step=0)
    scene = resample(scene, optimizer, "light", sharpened)
    assert (optimizer.state[scene.light]["exp_avg_sq"] >= 0).all()


# To and from the disk -------------------------------------------------------------------------------------------------


def trained(steps: int) -> tuple[Scene, optim.Adam]:
    scene = make_scene(dtype=torch.float32)
    optimizer = adam(scene, {"": 0.1, "gamma": 0.0})
    for step in range(steps):
        anneal(optimizer, 0.9**step)
        descend(bowl(scene), optimizer, step=step)
    return scene, optimizer


@pytest.mark.parametrize("steps", [0, 6])
def test_training_with_unpacked_moments_continues_bit_for_bit(steps: int) -> None:
    scene, optimizer = trained(steps)
    index = torch.tensor([1, 1, 3])
    scene = replace(scene, cloud=regrow(scene.cloud, optimizer, index, torch.tensor([False, True, False])))
    values = {name: x.detach().clone() for name, x in tree.named_tensors(scene).items()}
    packed = {name: x.clone() for name, x in pack(optimizer).items()}
    again, other = trained(0)
    again = optim.overwrite(again, other, values)
    unpack(other, packed)
    assert not again.gamma.requires_grad
    for step in range(3):
        descend(bowl(scene), optimizer, step=step)
        descend(bowl(again), other, step=step)
    before, after = tree.named_tensors(scene), tree.named_tensors(again)
    assert all(torch.equal(before[name], after[name]) for name in before)
    before, after = pack(optimizer), pack(other)
    assert list(before) == list(after)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_moments_of_other_leaves_are_rejected() -> None:
    _, optimizer = trained(2)
    packed = pack(optimizer)
    other = adam(leaves({"light": torch.zeros(2, 4, 3)}), {"": 0.1})
    with pytest.raises(ValueError, match=r"do not match the leaves light"):
        unpack(other, packed)
    scene, same = trained(0)
    regrow(scene.cloud, same, torch.tensor([0]), torch.tensor([False]))
    with pytest.raises(ValueError, match=r"exp_avg of cloud\.means has the shape \[5, 3\], not \[1, 3\]"):
        unpack(same, packed)
    with pytest.raises(ValueError, match="do not match the tree"):
        optim.overwrite(scene, None, {"means": torch.zeros(1)})


def test_linear_maps_are_recognised() -> None:
    like = torch.zeros(3, 4)
    assert all(optim._is_linear(fn, like) for fn in (finer, lambda x: x.mean(0)))
    assert not any(optim._is_linear(fn, like) for fn in (lambda x: x + 1, lambda x: x.exp().mean(0).log()))


def test_adam_does_what_the_class_of_torch_does_without_importing_its_compiler() -> None:
    program = """if True:
        import sys, torch
        from tumble.engine.optim import adam, descend, leaves
        mine, other = leaves({"x": torch.linspace(-1, 1, 101)}), torch.linspace(-1, 1, 101, requires_grad=True)
        optimizer = adam(mine, {"": 0.1})
        for step in range(5):
            descend((mine["x"] - 0.3).square().sum(), optimizer, step=step)
        assert "torch._dynamo" not in sys.modules
        reference = torch.optim.Adam([other], lr=0.1, eps=1e-15, fused=True)
        for step in range(5):
            reference.zero_grad()
            (other - 0.3).square().sum().backward()
            reference.step()
        torch.testing.assert_close(mine["x"], other, rtol=1e-6, atol=1e-6)  # five roundings
    """
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
