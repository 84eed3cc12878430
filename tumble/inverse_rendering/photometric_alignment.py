"""Photometric alignment of one frame's pose by Gauss-Newton, with everything else fixed.

Direct image alignment (Lucas and Kanade 1981): residuals between rendered and input image, finite differences, and a
robust loss. Gradient descent by Adam would move every pose by about the learning rate per step, also those that are
already accurate; Gauss-Newton scales each step by the frame's own Jacobian.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, Damping, Linearised, minimise

DIFFERENCE_STEPS = (0.01, 0.01, 0.01, 0.01, 0.01, 0.02)
"""Steps of the finite differences: rotation [radians], translation [object radius]; half a pixel at 128 pixels."""
ROBUST_SCALE = 0.1
"""Scale of the robust loss (Cauchy) [sRGB]: larger residuals are mostly specular highlights or texture that the
Gaussians do not represent."""
DAMPING = 1e-3
"""Initial damping of the normal equations, relative to their diagonal."""
MAX_STEP = 8.0
"""Largest Gauss-Newton step [difference steps], since the linearisation is local."""


def perturbed(T_cam_obj: SE3, motion: Float[Tensor, "6"]) -> SE3:
    """Pose after a rotation `motion[:3]` [radians] about the object's centre and a shift `motion[3:]`, camera frame."""
    R_cam_obj = SO3.exp(motion[:3]) @ T_cam_obj.rotation
    return SE3.from_rotation(R_cam_obj, T_cam_obj.xyz + motion[3:])


@torch.no_grad()
def align_pose(residual: Callable[[SE3], Float[Tensor, " r"]], T_cam_obj: SE3, *, rounds: int = 1) -> SE3:
    """The pose after a few damped Gauss-Newton steps from `T_cam_obj`; its cost is never larger than the initial one.

    Args:
        residual: Residuals of a pose against the input image [sRGB]; needs no derivative.
        T_cam_obj: Initial pose.
        rounds: Number of steps.
    """
    scale = T_cam_obj.xyz.new_tensor(DIFFERENCE_STEPS)

    def linearise(pose: SE3) -> Linearised:
        residuals = residual(pose)
        cost = torch.log1p((residuals / ROBUST_SCALE).square()).sum()
        return Linearised(cost.nan_to_num(math.inf, math.inf)[None], residuals)

    def move(pose: SE3, residuals: Tensor, damping: Tensor) -> SE3:
        columns = [residual(perturbed(pose, motion)) - residuals for motion in scale.diag()]
        J = torch.stack(columns, -1)
        weighted = J / (1 + (residuals / ROBUST_SCALE).square())[:, None]
        A = weighted.mT @ J
        # A motion that does not change the residuals (black image) has an empty row; the constant makes its step 0.
        A = A + torch.diag(damping * A.diagonal() + 1e-9)
        step = -torch.linalg.solve(A, weighted.mT @ residuals)
        step = step * (MAX_STEP / step.abs().max().clamp_min(MAX_STEP))
        return perturbed(pose, step * scale)

    def choose(better: Tensor, new: Any, old: Any) -> Any:
        return new if bool(better) else old

    return minimise(T_cam_obj, linearise, move, choose, steps=rounds, damping=Damping(start=DAMPING))[0]
