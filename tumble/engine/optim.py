"""Trees of leaves under one Adam: rates by name, steps that refuse NaN, and rows that come and go while it runs.

A *leaf* is a tensor that training changes; it has the dotted name of tumble.tree. The optimizer has one group per
leaf: `group["name"]`, `group["base"]` (the rate given at the start) and `group["lr"]` (the rate now). A table of rates
or factors is read by the longest key that is the leaf's name or a part of it up to a dot; the key "" fits all names.
The *moments* are Adam's running means of the gradient and of its square. *Regrowing* rebuilds leaves row by row
(Gaussians are born and die), *resampling* rebuilds one leaf on another grid (the light map gets finer); both carry
the moments along and hand back a new tree, whose leaves are the ones that the optimizer changes from then on.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.io import tree as trees

T = TypeVar("T")

MOMENTS = ("exp_avg", "exp_avg_sq")
"""What torch's Adam calls the running means of the gradient and of its square."""


class NotFinite(ValueError):
    """A NaN or an infinity, found before it could spread. The message names the tensor, the step and the state kept."""

    def __init__(self, name: str, step: int, *, part: str = "", state_file: Path | None = None) -> None:
        self.name, self.step, self.part, self.state_file = name, step, part, state_file
        message = f"{part + ' of ' if part else ''}{name} is not finite at step {step}"
        super().__init__(message + (f"; the last good state is in {state_file}" if state_file else ""))


def leaves(tree: T) -> T:
    """A copy of a tree that can be trained: every float tensor is a leaf of its own, other tensors are plain copies."""

    def leaf(x: Tensor) -> Tensor:
        # Contiguous, so that an uninterrupted run and one restored from disk sum in the same order.
        copy = x.detach().clone(memory_format=torch.contiguous_format)
        return copy.requires_grad_(copy.is_floating_point())

    return trees.map(leaf, tree)


def adam(
    tree: object, rates: dict[str, float], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15
) -> torch.optim.Adam:
    """Adam over the float leaves of a tree, one group each, fused where torch offers that for the device.

    Args:
        tree: As `leaves` makes it. Leaves of rate 0 are frozen in place: they get no group and ask for no gradient.
        rates: Learning rates by leaf name or name prefix, the longest wins.

    Raises:
        ValueError: A leaf without a rate, a rate without a leaf, or nothing left to train.
    """
    named = {name: x for name, x in trees.named_tensors(tree).items() if x.is_floating_point()}
    found = {name: _longest(name, rates) for name in named}
    if bare := [name for name, key in found.items() if key is None]:
        raise ValueError(f"no learning rate for {', '.join(bare)}; there are rates for {', '.join(rates) or 'nothing'}")
    if idle := [key for key in rates if not any(_fits(key, name) for name in named)]:
        raise ValueError(f"a learning rate for {', '.join(idle)}, which is no leaf; there are {', '.join(named)}")
    groups = []
    for name, leaf in named.items():
        rate = rates[found[name] or ""]
        leaf.requires_grad_(rate != 0)
        if rate != 0:
            groups.append({"params": [leaf], "lr": rate, "name": name, "base": rate})
    if not groups:
        raise ValueError("every leaf has rate 0: there is nothing to train")
    try:
        return torch.optim.Adam(groups, betas=betas, eps=eps, fused=True)
    except RuntimeError:  # This device has no fused kernel.
        return torch.optim.Adam(groups, betas=betas, eps=eps)


def anneal(optimizer: torch.optim.Adam, factor: dict[str, float] | float) -> None:
    """Set rates to their base times a factor, for schedules. Leaves that no key fits keep the rate they have.

    A rate of 0 leaves the values alone, but moments go on following the gradient.
    """
    table = factor if isinstance(factor, dict) else {"": factor}
    for group in optimizer.param_groups:
        key = _longest(group["name"], table)
        if key is not None:
            group["lr"] = group["base"] * table[key]


def descend(loss: Float[Tensor, ""], optimizer: torch.optim.Adam, *, step: int) -> None:
    """One step down the gradient of `loss`. A leaf that the loss does not reach keeps its value and its moments.

    Raises:
        NotFinite: The loss or a gradient holds NaN or infinity; no leaf has changed.
    """
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    gradients = {name: x.grad for name, x in _named_leaves(optimizer) if x.grad is not None}
    # One number tells whether all is well, so that a device is waited for once per step.
    size = torch.nn.utils.get_total_norm(list(gradients.values()))
    if not bool(torch.isfinite(size + loss.detach())):
        _blame(loss, gradients, step)
    optimizer.step()


def _blame(loss: Tensor, gradients: dict[str, Tensor], step: int) -> None:
    """Name the tensor that is not finite; silent when only the norm overflowed."""
    if not torch.isfinite(loss):
        raise NotFinite("the loss", step)
    if name := first_not_finite(gradients.items()):
        raise NotFinite(name, step, part="the gradient")


def first_not_finite(named: Iterable[tuple[str, Tensor]]) -> str | None:
    """Name of the first tensor that holds NaN or infinity; None when all are finite."""
    return next((name for name, x in named if not bool(torch.isfinite(x).all())), None)


# Leaves that change their shape ---------------------------------------------------------------------------------------


def regrow(tree: T, optimizer: torch.optim.Adam, index: Int64[Tensor, " m"], fresh: Bool[Tensor, " m"]) -> T:
    """Gather rows of every leaf of a tree together with their moments: pruning, cloning and splitting in one.

    The caller may edit fresh rows of the new leaves in place, under `torch.no_grad()`.

    Args:
        tree: Leaves that share their first axis, such as Gaussians; may be a part of what the optimizer trains.
        index: Row of the old leaves that each new row starts from; a row left out is pruned.
        fresh: New rows that start with moments of zero.
    """
    counts = {name: x.shape[0] if x.ndim else 0 for name, x in trees.named_tensors(tree).items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"leaves to regrow need the same number of rows, these have {counts}")

    def gathered(moment: Tensor, which: str) -> Tensor:
        rows = moment[index]
        rows[fresh] = 0
        return rows

    return trees.map(lambda leaf: _replaced(leaf, leaf.detach()[index], optimizer, gathered), tree)


def resample(
    tree: T,
    optimizer: torch.optim.Adam,
    name: str,
    fn: Callable[[Tensor], Tensor],
    *,
    moments: Callable[[Tensor], Tensor] | None = None,
) -> T:
    """Put one leaf on another grid, with its moments; the step count goes on.

    A cell of a grid r times as fine gets 1/r of the gradient. The moments are scaled by that, or Adam would take steps
    r times too short until it has forgotten the coarse grid, 1 / (1 - beta_2) steps later.

    Args:
        tree: Holds the leaf; may be a part of what the optimizer trains.
        name: Of the leaf, in `tree`.
        fn: From the old values to the new.
        moments: The same for gradients, where `fn` is not linear.

    Raises:
        ValueError: There is no such leaf, or `fn` is not linear and `moments` is missing.
    """
    if name not in (named := trees.named_tensors(tree)):
        raise ValueError(f"no leaf {name!r}; there are {', '.join(named)}")
    old = named[name]
    values = fn(old.detach()).contiguous()
    if moments is None and not _is_linear(fn, old):
        raise ValueError(f"the map of {name} is not linear: say with `moments` how gradients move to the new grid")
    resized, coarser = moments or fn, old.numel() / values.numel()

    def carried(moment: Tensor, which: str) -> Tensor:
        if which == "exp_avg":
            return coarser * resized(moment).contiguous()
        return coarser**2 * resized(moment).contiguous().clamp_min(0)  # a map with overshoots would make it negative

    return trees.map(lambda leaf: _replaced(leaf, values, optimizer, carried) if leaf is old else leaf, tree)


def overwrite(tree: T, optimizer: torch.optim.Adam | None, values: dict[str, Tensor]) -> T:
    """The tree with new leaves of the given values, whatever their shapes; moments are dropped (see `unpack`).

    Raises:
        ValueError: The names of `values` are not those of the tree.
    """
    if (names := list(trees.named_tensors(tree))) != list(values):
        raise ValueError(f"leaves {', '.join(values)} do not fit the tree of {', '.join(names)}")
    following = iter(values.values())  # map_tree goes through a tree in the order of its names

    def new(leaf: Tensor) -> Tensor:
        value = next(following).to(leaf.device, copy=True)
        return _replaced(leaf, value, optimizer, lambda moment, which: torch.zeros_like(value))

    return trees.map(new, tree)


def _replaced(
    leaf: Tensor,
    values: Tensor,
    optimizer: torch.optim.Adam | None,
    carry: Callable[[Tensor, str], Tensor],
) -> Tensor:
    """A new leaf in place of an old one; the optimizer lets go of the old one. `carry` maps its moments."""
    new = values.detach().requires_grad_(leaf.requires_grad)
    if optimizer is None or not leaf.requires_grad:
        return new
    group = next((group for group in optimizer.param_groups if group["params"][0] is leaf), None)
    if group is None:
        raise ValueError("a leaf that the optimizer does not hold: was it replaced before?")
    group["params"] = [new]
    if memory := optimizer.state.pop(leaf, {}):
        optimizer.state[new] = {key: carry(x, key) if key in MOMENTS else x for key, x in memory.items()}
    return new


def _is_linear(fn: Callable[[Tensor], Tensor], like: Tensor) -> bool:
    """Whether twice the values give twice the result, on a ramp."""
    ramp = torch.linspace(-1, 1, like.numel(), dtype=like.dtype, device=like.device).reshape(like.shape)
    return torch.allclose(fn(2 * ramp), 2 * fn(ramp), rtol=1e-4, atol=1e-4)


# To and from the disk -------------------------------------------------------------------------------------------------


def pack(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """All that the optimizer remembers, as `name/exp_avg`, `name/exp_avg_sq`, `name/step` and `name/lr` (float64)."""
    packed: dict[str, Tensor] = {}
    for group in optimizer.param_groups:
        name, memory = group["name"], optimizer.state.get(group["params"][0], {})
        packed[f"{name}/lr"] = torch.tensor(group["lr"], dtype=torch.float64)
        packed |= {f"{name}/{key}": value for key, value in memory.items()}
    return packed


def unpack(optimizer: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    """Put back what `pack` took, exactly. The leaves must have their shapes by then.

    Raises:
        ValueError: The tensors belong to an optimizer of other leaves.
    """
    given: dict[str, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        name, _, part = key.rpartition("/")
        given.setdefault(name, {})[part] = value
    if set(given) != (known := {group["name"] for group in optimizer.param_groups}):
        raise ValueError(f"moments of {', '.join(sorted(given))} do not fit the leaves {', '.join(sorted(known))}")
    for group in optimizer.param_groups:
        leaf, memory = group["params"][0], given[group["name"]]
        group["lr"] = memory.pop("lr").item()
        if wrong := [key for key in MOMENTS if key in memory and memory[key].shape != leaf.shape]:
            shapes = f"{list(memory[wrong[0]].shape)}, not {list(leaf.shape)}"
            raise ValueError(f"{wrong[0]} of {group['name']} has the shape {shapes}")
        # Without a fused kernel torch counts steps on the CPU.
        home = {"step": leaf.device if group["fused"] else torch.device("cpu")}
        optimizer.state.pop(leaf, None)
        if memory:
            optimizer.state[leaf] = {key: x.to(home.get(key, leaf.device), copy=True) for key, x in memory.items()}


def _named_leaves(optimizer: torch.optim.Adam) -> list[tuple[str, Tensor]]:
    return [(group["name"], group["params"][0]) for group in optimizer.param_groups]


def _fits(key: str, name: str) -> bool:
    return key in ("", name) or name.startswith(key + ".")


def _longest(name: str, table: Iterable[str]) -> str | None:
    """The longest key of a table that fits a name; None when no key does."""
    return max((key for key in table if _fits(key, name)), key=len, default=None)
