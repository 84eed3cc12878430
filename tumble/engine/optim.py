"""Adam over trees of named parameters, with parameters that change their shape during training.

A *leaf* is a trainable tensor; it has the dotted name of `tumble.io.tree`. The optimizer has one group per leaf:
`group["name"]`, `group["base"]` (initial learning rate) and `group["lr"]` (current learning rate). A table of rates or
factors is read by the longest key that is the leaf's name or a prefix of it up to a dot; the key "" matches all names.
The *moments* are Adam's running means of the gradient and of its square. *Regrowing* rebuilds leaves row by row
(densification and pruning of Gaussians); *resampling* moves one leaf to another grid (a finer environment map). Both
transfer the moments and return a new tree, whose leaves replace the old ones in the optimizer.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble import backends
from tumble.io import tree as trees

T = TypeVar("T")

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Keys of the moments in the state of Adam: running means of the gradient and of its square."""

CHECK_EVERY = 50
"""Steps between two times at which the host asks a GPU whether loss and gradients are finite."""


class NotFinite(ValueError):
    """Error for a NaN or an infinity; the message holds the tensor, the step and the last valid checkpoint."""

    def __init__(self, name: str, step: int, *, part: str = "", state_file: Path | None = None) -> None:
        self.name, self.step, self.part, self.state_file = name, step, part, state_file
        message = f"{part + ' of ' if part else ''}{name} is not finite at step {step}"
        super().__init__(message + (f"; the last valid state is in {state_file}" if state_file else ""))


@dataclass
class Adam:
    """Adam (Kingma and Ba 2015) with the fields of `torch.optim.Adam`.

    The class of torch itself imports its compiler, which takes two seconds, and spends more time around its kernel than
    the kernel takes.
    """

    param_groups: list[dict[str, Any]]
    """One group per leaf."""
    betas: tuple[float, float]
    """Decay rates of the moments."""
    eps: float
    """Constant against division by zero."""
    state: dict[Tensor, dict[str, Tensor]] = field(default_factory=dict)
    """Moments and number of steps (`step`) of each leaf that has had a gradient."""
    rates: list[Tensor] | None = None
    """Learning rates on the device, one per group, in place of those of the groups: a recording of a step reads them
    (`engine.graph`). The host then looks at no step; None for all other steps."""
    failed: Tensor | None = None
    """1 since the first loss or gradient that was not finite, from which on no leaf moves; else 0."""

    def state_of(self, leaf: Tensor) -> dict[str, Tensor]:
        """State of a leaf, which begins with zeros."""
        if leaf not in self.state:
            first, second = (torch.zeros_like(leaf, memory_format=torch.preserve_format) for _ in MOMENTS)
            count = torch.zeros((), dtype=torch.float32, device=leaf.device)
            self.state[leaf] = {"step": count, "exp_avg": first, "exp_avg_sq": second}
        return self.state[leaf]

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor | None], loss: Float[Tensor, ""]) -> None:
        """Move every leaf that has a gradient, unless `failed` is or becomes 1; the host waits for no device."""
        if self.failed is None:
            self.failed = torch.zeros((), dtype=torch.float32, device=loss.device)
        rates = self.rates or [group["lr"] for group in self.param_groups]
        moved = []
        for group, x, rate in zip(self.param_groups, gradients, rates, strict=True):
            if x is not None:
                leaf = group["params"][0]
                state = self.state_of(leaf)
                first, second = (state[key] for key in MOMENTS)
                moved.append(backends.Leaf(leaf, x, first, second, state["step"], rate))
        backends.choose(loss.device, loss.dtype).adam(moved, loss, self.failed, *self.betas, self.eps)


def leaves(tree: T) -> T:
    """A trainable copy of a tree: every float tensor becomes a leaf, other tensors are plain copies."""

    def leaf(x: Tensor) -> Tensor:
        # Contiguous, so that a run restored from disk sums in the same order as an uninterrupted one.
        copy = x.detach().clone(memory_format=torch.contiguous_format)
        return copy.requires_grad_(copy.is_floating_point())

    return trees.map(leaf, tree)


def adam(
    tree: object, rates: dict[str, float], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15
) -> Adam:
    """Adam over the float leaves of a tree, one group each.

    Args:
        tree: Result of `leaves`. Leaves with rate 0 are frozen in place: they have no group and require no gradient.
        rates: Learning rates by leaf name or name prefix; the longest matching key counts.
        betas: Decay rates of Adam's two moments.
        eps: Adam's constant against division by zero.

    Raises:
        ValueError: A leaf has no rate, a rate matches no leaf, or all rates are 0.
    """
    named = {name: x for name, x in trees.named_tensors(tree).items() if x.is_floating_point()}
    keys = {name: _longest_match(name, rates) for name in named}
    if missing := [name for name, key in keys.items() if key is None]:
        rule = f"no learning rate for {', '.join(missing)}; there are rates for {', '.join(rates) or 'nothing'}"
        raise ValueError(rule)
    if unused := [key for key in rates if not any(_matches(key, name) for name in named)]:
        raise ValueError(f"a learning rate for {', '.join(unused)}, which is no leaf; leaves are {', '.join(named)}")
    groups = []
    for name, leaf in named.items():
        rate = rates[keys[name] or ""]
        leaf.requires_grad_(rate != 0)
        if rate != 0:
            groups.append({"params": [leaf], "lr": rate, "name": name, "base": rate})
    if not groups:
        raise ValueError("every leaf has learning rate 0: there is nothing to train")
    return Adam(groups, betas, eps)


def anneal(optimizer: Adam, factor: dict[str, float] | float) -> None:
    """Set learning rates to their initial value times a factor; leaves that match no key keep their current rate.

    A rate of 0 freezes the values, but their moments are still updated.
    """
    table = factor if isinstance(factor, dict) else {"": factor}
    for group in optimizer.param_groups:
        key = _longest_match(group["name"], table)
        if key is not None:
            group["lr"] = group["base"] * table[key]


def descend(loss: Float[Tensor, ""], optimizer: Adam, *, step: int) -> None:
    """One optimizer step on `loss`; leaves that the loss does not depend on keep their values and moments.

    On a GPU the host looks only in every `CHECK_EVERY`th step whether all is finite, and never if the optimizer's rates
    lie on the device; then `check_steps` tells.

    Raises:
        NotFinite: The loss or a gradient holds NaN or infinity; no leaf was changed since.
    """
    leaves = [group["params"][0] for group in optimizer.param_groups]
    found = torch.autograd.grad(loss, leaves, allow_unused=True)
    gradients = [None if x is None else x.contiguous() for x in found]
    optimizer.step(gradients, loss.detach())
    if optimizer.rates is not None:
        return
    free = loss.device.type == "cpu"
    if (free or (step + 1) % CHECK_EVERY == 0) and optimizer.failed is not None and bool(optimizer.failed):
        if free:
            optimizer.failed = None  # nothing was changed: the caller may go on
        _raise_if_not_finite(loss, gradients, optimizer, step)
        check_steps(optimizer, step)


def check_steps(optimizer: Adam, step: int) -> None:
    """Raise `NotFinite` if `descend` has left out steps on a device since a loss or a gradient was not finite."""
    if optimizer.failed is not None and bool(optimizer.failed):
        raise NotFinite(f"the loss or a gradient in one of the last {CHECK_EVERY} steps", step)


def _raise_if_not_finite(loss: Tensor, gradients: Sequence[Tensor | None], optimizer: Adam, step: int) -> None:
    """Raise `NotFinite` for the first tensor that is not finite, if there is one."""
    if not torch.isfinite(loss):
        raise NotFinite("the loss", step)
    named = zip((group["name"] for group in optimizer.param_groups), gradients, strict=True)
    if name := first_not_finite((name, x) for name, x in named if x is not None):
        raise NotFinite(name, step, part="the gradient")


def first_not_finite(named: Iterable[tuple[str, Tensor]]) -> str | None:
    """Name of the first tensor that holds NaN or infinity; None if all are finite."""
    return next((name for name, x in named if not bool(torch.isfinite(x).all())), None)


def forget(leaf: Tensor, optimizer: Adam) -> None:
    """Set the moments of a leaf to zero, after its values were changed by another rule."""
    for moment in MOMENTS:
        optimizer.state_of(leaf)[moment].zero_()


# Leaves that change their shape ---------------------------------------------------------------------------------------


def regrow(tree: T, optimizer: Adam, index: Int64[Tensor, " m"], fresh: Bool[Tensor, " m"]) -> T:
    """The tree with rows of every leaf gathered together with their moments, for pruning, cloning and splitting.

    The caller may edit fresh rows of the new leaves in place, under `torch.no_grad()`.

    Args:
        tree: Leaves that share their first axis, such as Gaussians; may be a part of the optimizer's parameters.
        optimizer: Optimizer of the leaves.
        index: For each new row, the old row that it is copied from; old rows that do not occur are pruned.
        fresh: New rows whose moments are reset to zero.

    Raises:
        ValueError: The leaves have different numbers of rows.
    """
    counts = {name: x.shape[0] if x.ndim else 0 for name, x in trees.named_tensors(tree).items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"leaves to regrow need the same number of rows, these have {counts}")

    def gather(moment: Tensor, key: str) -> Tensor:
        rows = moment[index]
        rows[fresh] = 0
        return rows

    return trees.map(lambda leaf: _replaced(leaf, leaf.detach()[index], optimizer, gather), tree)


def resample(
    tree: T,
    optimizer: Adam,
    name: str,
    fn: Callable[[Tensor], Tensor],
    *,
    moments: Callable[[Tensor], Tensor] | None = None,
) -> T:
    """The tree with one leaf and its moments moved to another grid; Adam's step count is kept.

    A cell of a grid with r times as many cells receives 1/r of the gradient. The moments are scaled accordingly;
    otherwise Adam's steps would be r times too short for the next 1 / (1 - beta_2) steps.

    Args:
        tree: Tree with the leaf; may be a part of the optimizer's parameters.
        optimizer: Optimizer of the leaf.
        name: Name of the leaf in `tree`.
        fn: Map from the old values to the new ones.
        moments: Map from old gradients to new ones; required if `fn` is not linear.

    Raises:
        ValueError: There is no such leaf, or `fn` is not linear and `moments` is missing.
    """
    if name not in (named := trees.named_tensors(tree)):
        raise ValueError(f"no leaf {name!r}; leaves are {', '.join(named)}")
    old = named[name]
    values = fn(old.detach()).contiguous()
    if moments is None and not _is_linear(fn, old):
        raise ValueError(f"the map of {name} is not linear: pass the map of its gradients as `moments`")
    resample_moment, ratio = moments or fn, old.numel() / values.numel()

    def transfer(moment: Tensor, key: str) -> Tensor:
        if key == "exp_avg":
            return ratio * resample_moment(moment).contiguous()
        return ratio**2 * resample_moment(moment).contiguous().clamp_min(0)  # interpolation may overshoot below zero

    return trees.map(lambda leaf: _replaced(leaf, values, optimizer, transfer) if leaf is old else leaf, tree)


def overwrite(tree: T, optimizer: Adam | None, values: dict[str, Tensor]) -> T:
    """The tree with new leaves of the given values and any shapes; moments are reset (see `unpack`).

    Raises:
        ValueError: The names of `values` are not those of the tree.
    """
    if (names := list(trees.named_tensors(tree))) != list(values):
        raise ValueError(f"leaves {', '.join(values)} do not match the tree of {', '.join(names)}")
    remaining = iter(values.values())  # `tree.map` visits tensors in the order of `tree.named_tensors`

    def new(leaf: Tensor) -> Tensor:
        value = next(remaining).to(leaf.device, copy=True)
        return _replaced(leaf, value, optimizer, lambda moment, key: torch.zeros_like(value))

    return trees.map(new, tree)


def _replaced(
    leaf: Tensor,
    values: Tensor,
    optimizer: Adam | None,
    transfer: Callable[[Tensor, str], Tensor],
) -> Tensor:
    """A new leaf that replaces an old one in the optimizer; `transfer` maps each moment, given with its key."""
    new = values.detach().requires_grad_(leaf.requires_grad)
    if optimizer is None or not leaf.requires_grad:
        return new
    group = next((group for group in optimizer.param_groups if group["params"][0] is leaf), None)
    if group is None:
        raise ValueError("the optimizer does not hold this leaf: pass the tree that the last replacement returned")
    group["params"] = [new]
    if state := optimizer.state.pop(leaf, {}):
        optimizer.state[new] = {key: transfer(x, key) if key in MOMENTS else x for key, x in state.items()}
    return new


def _is_linear(fn: Callable[[Tensor], Tensor], like: Tensor) -> bool:
    """Whether `fn` maps twice a ramp to twice the result, a test of linearity."""
    ramp = torch.linspace(-1, 1, like.numel(), dtype=like.dtype, device=like.device).reshape(like.shape)
    return torch.allclose(fn(2 * ramp), 2 * fn(ramp), rtol=1e-4, atol=1e-4)


# To and from the disk -------------------------------------------------------------------------------------------------


def pack(optimizer: Adam) -> dict[str, Tensor]:
    """The optimizer's state as tensors `name/exp_avg`, `name/exp_avg_sq`, `name/step` and `name/lr` (float64)."""
    packed: dict[str, Tensor] = {}
    for group in optimizer.param_groups:
        name, state = group["name"], optimizer.state.get(group["params"][0], {})
        packed[f"{name}/lr"] = torch.tensor(group["lr"], dtype=torch.float64)
        packed |= {f"{name}/{key}": value for key, value in state.items()}
    return packed


def unpack(optimizer: Adam, tensors: dict[str, Tensor]) -> None:
    """Restore the state returned by `pack` exactly; the leaves must already have their shapes.

    Raises:
        ValueError: The tensors belong to an optimizer of other leaves.
    """
    given: dict[str, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        name, _, part = key.rpartition("/")
        given.setdefault(name, {})[part] = value
    if set(given) != (known := {group["name"] for group in optimizer.param_groups}):
        raise ValueError(f"moments of {', '.join(sorted(given))} do not match the leaves {', '.join(sorted(known))}")
    for group in optimizer.param_groups:
        leaf, state = group["params"][0], given[group["name"]]
        group["lr"] = state.pop("lr").item()
        if wrong := [key for key in MOMENTS if key in state and state[key].shape != leaf.shape]:
            shapes = f"{list(state[wrong[0]].shape)}, not {list(leaf.shape)}"
            raise ValueError(f"{wrong[0]} of {group['name']} has the shape {shapes}")
        optimizer.state.pop(leaf, None)
        if state:
            optimizer.state[leaf] = {key: x.to(leaf.device, copy=True) for key, x in state.items()}


def _matches(key: str, name: str) -> bool:
    return key in ("", name) or name.startswith(key + ".")


def _longest_match(name: str, table: Iterable[str]) -> str | None:
    """The longest key of a table that matches a name; None if no key does."""
    return max((key for key in table if _matches(key, name)), key=len, default=None)
