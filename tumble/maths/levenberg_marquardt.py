"""Levenberg-Marquardt minimisation of many small least-squares problems in parallel (Marquardt 1963).

This file holds the loop over steps and the control of damping; the caller provides the equations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

State = TypeVar("State")


class Linearised(NamedTuple):
    """Least-squares problems linearised at a state."""

    cost: Float[Tensor, " p"]
    """Cost of every problem."""
    system: Any
    """Equations from which a step is computed: residuals, or normal equations."""


class Damping(NamedTuple):
    """Control of the damping, which is added to the diagonal of the normal equations."""

    start: float = 1e-3
    """Damping of the first step."""
    accepted: float = 0.2
    """Factor after a step that lowers the cost."""
    rejected: float = 8.0
    """Factor after a step that does not lower the cost."""
    minimum: float = 0.0
    """Lower limit of the damping."""
    maximum: float = float("inf")
    """Upper limit of the damping."""


STALLED_DAMPING = 1e6
"""Damping above which steps are negligible and a problem counts as converged."""


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
    """The states of least cost found, and the problems linearised there.

    Each problem has its own damping: a step that lowers the cost is accepted, any other only raises the damping.

    Args:
        state: Initial states of all problems.
        linearise: Costs and equations at a state.
        move: The state after the damped step, from a state, its system and the damping of every problem.
        choose: `torch.where` per problem for states and systems: the second argument where the first is true, else the
            third.
        steps: Maximum number of steps.
        tolerance: A problem has converged when a step lowers its cost by less than this fraction. With None the loop
            always makes all steps.
    """
    current = linearise(state)
    lam = torch.full_like(current.cost, damping.start)
    converged = torch.zeros_like(current.cost, dtype=torch.bool)
    for _ in range(steps):
        moved = move(state, current.system, lam)
        proposed = linearise(moved)
        better = proposed.cost < current.cost
        if tolerance is not None:
            converged |= better & (current.cost - proposed.cost < tolerance * current.cost)
        state = choose(better, moved, state)
        cost = torch.where(better, proposed.cost, current.cost)
        current = Linearised(cost, choose(better, proposed.system, current.system))
        lam = torch.where(better, damping.accepted * lam, damping.rejected * lam)
        lam = lam.clamp(damping.minimum, damping.maximum)
        if tolerance is not None and bool((converged | (lam > STALLED_DAMPING)).all()):
            break
    return state, current


def select_rows(better: Bool[Tensor, " p"], new: Any, old: Any) -> Any:
    """The argument `choose` of `minimise` for (nested tuples of) tensors with one row per problem."""
    if isinstance(new, Tensor):
        return torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    return tuple(select_rows(better, a, b) for a, b in zip(new, old, strict=True))
