"""3D Gaussians whose opacity is a function of a signed distance (paper section 4.2).

Object frame, object radius = 1. The third local axis is the *normal*, which initially points outwards; its scale is the
*thickness*. The paper takes the axis of the smallest scale instead, whose argmin may change during training.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from tumble.maths import SO3


@dataclass(frozen=True)
class Gaussians:
    """Geometry and stage-2 colour of an object; raw parameters, as trained."""

    means: Float[Tensor, "n 3"]
    """Centres [object radius]."""
    quats: Float[Tensor, "n 4"]
    """Rotations from local to object frame, wxyz, not necessarily of unit length."""
    log_scales: Float[Tensor, "n 3"]
    """Logarithms of the standard deviations along the local axes [log object radius]."""
    sdf: Float[Tensor, " n"]
    """Signed distances to the surface, positive outside [object radius]."""
    sh: Float[Tensor, "n k 3"]
    """Linear radiance as spherical harmonics of the object-frame view direction."""

    @property
    def R_obj_local(self) -> Float[Tensor, "n 3 3"]:
        """Rotations from local to object frame."""
        return SO3(torch.nn.functional.normalize(self.quats, dim=-1)).matrix()

    @property
    def normals(self) -> Float[Tensor, "n 3"]:
        """Outward unit normals, object frame."""
        return _ThirdAxis.apply(self.quats)

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the local axes [object radius]."""
        return self.log_scales.exp()

    def __len__(self) -> int:
        return self.means.shape[0]


class _ThirdAxis(torch.autograd.Function):
    """Third column of the rotation matrices of quaternions of any non-zero length: a quadratic form of q over |q|^2."""

    @staticmethod
    def forward(ctx: Any, quats: Tensor) -> Tensor:
        w, x, y, z = q = quats.mT.contiguous()
        length2 = (q * q).sum(0)
        axis = torch.stack([x * z + w * y, y * z - w * x, w * w + z * z]).mul_(2 / length2)
        axis[2] -= 1
        ctx.save_for_backward(q, length2, axis)
        return axis.mT

    @staticmethod
    def backward(ctx: Any, v_axis: Tensor) -> Tensor:  # type: ignore[override]
        q, length2, axis = ctx.saved_tensors
        w, x, y, z = q
        a, b, c = v = v_axis.mT.contiguous()
        quadratic = torch.stack([a * y - b * x + 2 * c * w, a * z - b * w, a * w + b * z, a * x + b * y + 2 * c * z])
        along = (v * axis).sum(0) + c
        return ((quadratic - along * q) * (2 / length2)).mT


def opacity(sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""]) -> Float[Tensor, " n"]:
    """Opacity from signed distance: 1 on the surface, falling off on both sides (eq. 8).

    Equal to the paper's 4 e^{-gamma s} / (1 + e^{-gamma s})^2, in the form that does not overflow for s < 0.

    Args:
        sdf: Signed distances [object radius].
        gamma: Sharpness [1 / object radius].
    """
    inside = torch.sigmoid(-gamma * sdf)
    return 4 * inside * (1 - inside)


def sdf_from_opacity(opacity: Float[Tensor, " n"], gamma: Float[Tensor, ""]) -> Float[Tensor, " n"]:
    """Non-negative signed distance [object radius] of a given opacity in (0, 1], the inverse of `opacity` (eq. 8)."""
    return 2 / gamma * torch.acosh(opacity.rsqrt())


def constant_sh(radiance: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Spherical harmonics of degree 0 that represent a given linear radiance, the same in all directions.

    The rasterizer evaluates them to `max(0, radiance)`.
    """
    return radiance[:, None] * math.sqrt(4 * math.pi)


def quats_from_normals(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Quaternions wxyz of the shortest rotations that take the third axis to given unit normals."""
    z = normals[:, 2:]
    w = 1 + z
    axis = torch.stack([-normals[:, 1], normals[:, 0], torch.zeros_like(normals[:, 0])], -1)
    quats = torch.cat([w, axis], -1)
    opposite = (w < 1e-4).expand_as(quats)
    return normalize(torch.where(opposite, quats.new_tensor([0.0, 1.0, 0.0, 0.0]), quats), dim=-1)
