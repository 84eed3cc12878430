"""Damped least squares on many small problems side by side: the loop alone, each problem brings its own equations."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

State = TypeVar("State")


class Linearised(NamedTuple):
    """A least-squares problem about one state."""

    cost: Float[Tensor, " p"]
    """Of every problem."""
    system: Any
    """What a step is computed from: residuals, or normal equations."""


class Damping(NamedTuple):
    """How much the diagonal of the normal equations is raised."""

    start: float = 1e-3
    accepted: float = 0.2
    """Factor after a step that lowers the cost."""
    rejected: float = 8.0
    """Factor after one that does not."""
    least: float = 0.0
    most: float = float("inf")


STUCK = 1e6
"""Damping from which a problem does not move any more."""


def minimise(
    state: State,
    linearise: Callable[[State], Linearised],
    move: Callable[[State, Any, Float[Tensor, " p"]], State],
    choose: Callable[[Bool[Tensor, " p"], Any, Any], Any],
    *,
    steps: int,
    damping: Damping,
    tolerance: float | None = None,
) -> tuple[State, Linearised]:
    """Levenberg-Marquardt (Marquardt 1963): steps that lower a problem's cost are taken, others raise its damping.

    Args:
        state: Where all problems start.
        linearise: Costs and equations about a state.
        move: The state after the damped step, from a state, its system and the damping of every problem.
        choose: Per problem, the second argument where the first is true, else the third; of states and of systems.
        steps: Largest number.
        tolerance: A problem is done when a step lowers its cost by less than this share; None: only `steps` ends it.
    """
    now = linearise(state)
    lam = torch.full_like(now.cost, damping.start)
    done = torch.zeros_like(now.cost, dtype=torch.bool)
    for _ in range(steps):
        moved = move(state, now.system, lam)
        then = linearise(moved)
        better = then.cost < now.cost
        if tolerance is not None:
            done |= better & (now.cost - then.cost < tolerance * now.cost)
        state = choose(better, moved, state)
        now = Linearised(torch.where(better, then.cost, now.cost), choose(better, then.system, now.system))
        lam = torch.where(better, damping.accepted * lam, damping.rejected * lam).clamp(damping.least, damping.most)
        if tolerance is not None and bool((done | (lam > STUCK)).all()):
            break
    return state, now


def rowwise(better: Bool[Tensor, " p"], new: Any, old: Any) -> Any:
    """`choose` for tuples of tensors with one row per problem."""
    if isinstance(new, Tensor):
        return torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    return tuple(rowwise(better, a, b) for a, b in zip(new, old, strict=True))
