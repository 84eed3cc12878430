"""One frame's pose brought in line with a photograph: Gauss-Newton on what a renderer shows, all else fixed.

Descent by Adam moves every pose by about its rate, whatever the frame has to say of it: at a rate that moves a wrong
pose by two degrees within a run, all others shake by half a degree. Here a frame moves as far as its own picture asks,
in the scale of its own derivatives (direct image alignment; Lucas and Kanade 1981).
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, Damping, Linearised, minimise

NUDGES = (0.01, 0.01, 0.01, 0.01, 0.01, 0.02)
"""Of the finite differences: three turns [radians], three shifts [object radius], about half a pixel at 128 pixels."""
ROBUST = 0.1
"""Residual from which a pixel counts less (Cauchy): highlights and print that the Gaussians lack are no motion."""
DAMPING = 1e-3
"""Of the normal equations, in units of their diagonal."""
FARTHEST = 8.0
"""Largest step [nudges]: beyond it, the derivatives say nothing."""


def nudged(T_cam_obj: SE3, motion: Float[Tensor, "6"]) -> SE3:
    """The object turned about its own centre by `motion[:3]` [radians], then shifted by `motion[3:]`, camera axes."""
    R_cam_obj = SO3.exp(motion[:3]) @ T_cam_obj.rotation
    return SE3.from_rotation(R_cam_obj, T_cam_obj.xyz + motion[3:])


@torch.no_grad()
def realign(residual: Callable[[SE3], Float[Tensor, " r"]], T_cam_obj: SE3, *, rounds: int = 1) -> SE3:
    """The pose near `T_cam_obj` with the least residuals, as far as a few steps reach; never one with larger ones.

    Args:
        residual: What a pose leaves unexplained of a photograph, sRGB units; needs no derivative.
    """
    scale = T_cam_obj.xyz.new_tensor(NUDGES)

    def linearised(pose: SE3) -> Linearised:
        left = residual(pose)
        cost = torch.log1p((left / ROBUST).square()).sum()
        return Linearised(cost.nan_to_num(math.inf, math.inf)[None], left)

    def moved(pose: SE3, now: Tensor, damping: Tensor) -> SE3:
        columns = [residual(nudged(pose, motion)) - now for motion in scale.diag()]
        J = torch.stack(columns, -1)
        weighted = J / (1 + (now / ROBUST).square())[:, None]
        A = weighted.mT @ J
        # A direction that changes nothing at all (a black picture) has an empty row: leave it where it is.
        A = A + torch.diag(damping * A.diagonal() + 1e-9)
        step = -torch.linalg.solve(A, weighted.mT @ now)
        step = step * (FARTHEST / step.abs().max().clamp_min(FARTHEST))
        return nudged(pose, step * scale)

    def choose(better: Tensor, new: Any, old: Any) -> Any:
        return new if bool(better) else old

    return minimise(T_cam_obj, linearised, moved, choose, steps=rounds, damping=Damping(start=DAMPING))[0]
