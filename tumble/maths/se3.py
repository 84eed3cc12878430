"""Rotations and rigid motions.

Frames cancel on the page: `R_a_b @ x_b = x_a`, `T_a_b @ T_b_c = T_a_c`. A rotation is a unit quaternion, real
part first (`wxyz`); a rigid motion adds a translation (`xyz`). Angles are in radians. Batch axes broadcast
like those of tensors; one motion per frame over many points per frame is `T[:, None] @ x`.

A *tangent* is the argument of `exp` and the result of `log`: a rotation vector `omega` (axis times angle) or, for
rigid motions, `(v, omega)`. `exp` is smooth everywhere, `log` for angles below pi; at pi it has two solutions.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths.entries import Index, entry

SMALL = 1e-2
"""Squared angle below which series replace the closed forms, which divide 0 by 0 at zero."""
COSINE_SERIES = tuple((-1) ** k / 4**k / math.factorial(2 * k) for k in range(6))
"""cos(x / 2)"""
SINE_SERIES = tuple((-1) ** k / 2 ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(6))
"""sin(x / 2) / x"""
FIRST_SERIES = tuple((-1) ** k / math.factorial(2 * k + 2) for k in range(6))
"""(1 - cos x) / x^2"""
SECOND_SERIES = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(6))
"""(x - sin x) / x^3"""
INVERSE_SERIES = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000)
"""(1 - x/2 cot(x/2)) / x^2"""
ARCTAN_SERIES = tuple((-1) ** k / (2 * k + 1) for k in range(8))
"""atan(x) / x"""
COLLINEAR = 1e-6
"""Ratio of the second to the first singular value of a covariance below which points count as collinear: such a set is
a thousand times as long as wide, and the limit is still ten times the rounding error of float32."""


@dataclass(frozen=True)
class SO3:
    """Rotations `R_a_b`."""

    wxyz: Float[Tensor, "*b 4"]
    """Unit quaternion, real part first; q and -q are the same rotation."""

    @staticmethod
    def identity(
        batch: tuple[int, ...] = (),
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> "SO3":
        """The identity, once per element of the batch."""
        return SO3(torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype, device=device).expand(*batch, 4))

    @staticmethod
    def exp(omega: Float[Tensor, "*b 3"]) -> "SO3":
        """The rotation by the angle `|omega|` [radians] about the axis `omega`."""
        angle2 = omega.square().sum(-1, keepdim=True)
        imag = _smooth(angle2, SINE_SERIES, lambda x: (0.5 * x).sin() / x) * omega
        real = _smooth(angle2, COSINE_SERIES, lambda x: (0.5 * x).cos())
        return SO3(torch.cat([real, imag], -1))

    @staticmethod
    def from_matrix(matrix: Float[Tensor, "*b 3 3"]) -> "SO3":
        """From rotation matrices (not checked); the real part of the result is non-negative."""
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
        # The rows of 4 q q^T. The row with the largest diagonal element is never close to zero.
        rows = [
            [1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
            [m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20],
            [m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m12 + m21],
            [m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22],
        ]
        outer = torch.stack([torch.stack(row, -1) for row in rows], -2)
        largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*outer.shape[:-2], 1, 4)
        wxyz = outer.gather(-2, largest)[..., 0, :]
        return SO3.from_wxyz(torch.where(wxyz[..., :1] < 0, -wxyz, wxyz))

    @staticmethod
    def from_wxyz(wxyz: Float[Tensor, "*b 4"]) -> "SO3":
        """From quaternions of any length except zero, which are normalised."""
        return SO3(wxyz / torch.linalg.vector_norm(wxyz, dim=-1, keepdim=True))

    def log(self) -> Float[Tensor, "*b 3"]:
        """The shortest rotation vector, at most pi long [radians]; at the angle pi, one of the two solutions."""
        # q and -q are the same rotation; the one with w >= 0 has an angle of at most pi.
        w, v = torch.where(self.wxyz[..., :1] < 0, -self.wxyz, self.wxyz).split([1, 3], -1)
        sine2 = v.square().sum(-1, keepdim=True)
        small = sine2 < SMALL
        near_w = torch.where(small, w, 1.0)
        near = 2 * _polynomial(torch.where(small, sine2, 0.0) / near_w.square(), ARCTAN_SERIES) / near_w
        sine = torch.where(small, 1.0, sine2).sqrt()
        far = 2 * torch.atan2(sine, w) / sine
        return torch.where(small, near, far) * v

    def matrix(self) -> Float[Tensor, "*b 3 3"]:
        """Rotation matrices, `R @ x_b = x_a` for column vectors."""
        # A matrix with a gradient may not be kept: the first caller may have switched gradients off.
        return self._computed_matrix() if self.wxyz.requires_grad else self._kept_matrix

    @cached_property
    def _kept_matrix(self) -> Float[Tensor, "*b 3 3"]:
        return self._computed_matrix()

    def _computed_matrix(self) -> Float[Tensor, "*b 3 3"]:
        q = self.wxyz
        products = (q[..., :, None] * q[..., None, :]).flatten(-2)
        # One matrix product instead of many small operations, because stages convert single poses in every step.
        of_products, constant = _matrix_of_products(q.dtype, q.device)
        return (products @ of_products + constant).unflatten(-1, (3, 3))

    def inverse(self) -> "SO3":
        """`R_b_a`."""
        return SO3(torch.cat([self.wxyz[..., :1], -self.wxyz[..., 1:]], -1))

    def angle(self) -> Float[Tensor, "*b"]:
        """Rotation angle, 0 to pi [radians]; its gradient at the identity is zero."""
        sine = torch.linalg.vector_norm(self.wxyz[..., 1:], dim=-1)
        return 2 * torch.atan2(sine, self.wxyz[..., 0].abs())

    @overload
    def __matmul__(self, other: "SO3") -> "SO3": ...
    @overload
    def __matmul__(self, other: Tensor) -> Tensor: ...
    def __matmul__(self, other):
        """`R_a_b @ R_b_c = R_a_c`; `R_a_b @ x_b = x_a` for points `[*b 3]`."""
        if isinstance(other, SO3):
            return SO3(_quaternion_product(self.wxyz, other.wxyz))
        if self.wxyz.ndim == 1:  # the usual case, without the overhead of einsum
            return other @ self.matrix().mT
        return torch.einsum("...ij,...j->...i", self.matrix(), other)

    def __getitem__(self, index: Any) -> "SO3":
        """Some of a batch; `R[:, None]` adds a batch axis."""
        return SO3(self.wxyz[_batch_index(index)])


@dataclass(frozen=True)
class SE3:
    """Rigid motions `T_a_b`: rotate, then translate."""

    wxyz: Float[Tensor, "*b 4"]
    """Rotation as a unit quaternion, real part first."""
    xyz: Float[Tensor, "*b 3"]
    """Position of the origin of b in frame a [unit of the points]."""

    @staticmethod
    def identity(
        batch: tuple[int, ...] = (),
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> "SE3":
        """The identity, once per element of the batch."""
        wxyz = SO3.identity(batch, dtype=dtype, device=device).wxyz
        return SE3(wxyz, torch.zeros(*batch, 3, dtype=dtype, device=device))

    @staticmethod
    def exp(tangent: Float[Tensor, "*b 6"]) -> "SE3":
        """The screw motion along `tangent` = (v, omega) for unit time."""
        v, omega = tangent.split(3, -1)
        angle2 = omega.square().sum(-1, keepdim=True)
        first = _smooth(angle2, FIRST_SERIES, lambda x: 2 * ((0.5 * x).sin() / x).square())
        second = _smooth(angle2, SECOND_SERIES, lambda x: (x - x.sin()) / x**3)
        turned = torch.linalg.cross(omega, v)
        xyz = v + first * turned + second * torch.linalg.cross(omega, turned)
        return SE3(SO3.exp(omega).wxyz, xyz)

    @staticmethod
    def from_matrix(matrix: Float[Tensor, "*b 4 4"]) -> "SE3":
        """From homogeneous rigid matrices with the last row 0 0 0 1."""
        return SE3(SO3.from_matrix(matrix[..., :3, :3]).wxyz, matrix[..., :3, 3])

    @staticmethod
    def from_rotation(rotation: SO3, xyz: Float[Tensor, "*b 3"]) -> "SE3":
        """A rotation followed by a translation; their batch axes broadcast."""
        return _broadcast(rotation.wxyz, xyz)

    @staticmethod
    def from_rotation_matrix(matrix: Float[Tensor, "*b 3 3"]) -> "SE3":
        """From rotation matrices, without translation."""
        return SE3(SO3.from_matrix(matrix).wxyz, torch.zeros_like(matrix[..., 0]))

    @cached_property
    def rotation(self) -> SO3:
        """`R_a_b`."""
        return SO3(self.wxyz)

    @property
    def translation(self) -> Float[Tensor, "*b 3"]:
        """Position of the origin of b in frame a."""
        return self.xyz

    def log(self) -> Float[Tensor, "*b 6"]:
        """The tangent (v, omega) of the shortest screw motion, with `|omega| <= pi`."""
        omega = self.rotation.log()
        angle2 = omega.square().sum(-1, keepdim=True)
        curved = _smooth(angle2, INVERSE_SERIES, lambda x: (1 - 0.5 * x / (0.5 * x).tan()) / x.square())
        turned = torch.linalg.cross(omega, self.xyz)
        v = self.xyz - 0.5 * turned + curved * torch.linalg.cross(omega, turned)
        return torch.cat([v, omega], -1)

    def matrix(self) -> Float[Tensor, "*b 4 4"]:
        """Homogeneous matrices."""
        top = torch.cat([self.rotation.matrix(), self.xyz[..., None]], -1)
        bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
        return torch.cat([top, bottom], -2)

    def inverse(self) -> "SE3":
        """`T_b_a`."""
        R_b_a = self.rotation.inverse()
        return SE3(R_b_a.wxyz, -(R_b_a @ self.xyz))

    @overload
    def __matmul__(self, other: "SE3") -> "SE3": ...
    @overload
    def __matmul__(self, other: Tensor) -> Tensor: ...
    def __matmul__(self, other):
        """`T_a_b @ T_b_c = T_a_c`; `T_a_b @ x_b = x_a` for points `[*b 3]`."""
        if isinstance(other, SE3):
            return _broadcast(_quaternion_product(self.wxyz, other.wxyz), self @ other.xyz)
        return self.rotation @ other + self.xyz

    def __getitem__(self, index: Any) -> "SE3":
        """Some of a batch; `T[:, None]` adds a batch axis."""
        index = _batch_index(index)
        return SE3(self.wxyz[index], self.xyz[index])

    def at(self, index: Index) -> "SE3":
        """One of a batch with one axis, also by an index that only the device knows."""
        return SE3(entry(self.wxyz, index), entry(self.xyz, index))


def slerp(a: SO3, b: SO3, t: float | Float[Tensor, "*t"]) -> SO3:
    """Spherical interpolation from `a` at t = 0 to `b` at t = 1 along the shortest path; `t` has the batch axes."""
    return a @ SO3.exp(_trailing(t) * (a.inverse() @ b).log())


def interpolate(a: SE3, b: SE3, t: float | Float[Tensor, "*t"]) -> SE3:
    """Interpolation from `a` at t = 0 to `b` at t = 1: `slerp` of rotations, linear interpolation of translations."""
    xyz = a.xyz + _trailing(t) * (b.xyz - a.xyz)
    return SE3.from_rotation(slerp(a.rotation, b.rotation, t), xyz)


def angle_between(a: SO3, b: SO3) -> Float[Tensor, "*b"]:
    """Angle of the rotation that takes `a` to `b`, 0 to pi [radians]."""
    return (a.inverse() @ b).angle()


def mean_rotation(rotations: SO3, weights: Float[Tensor, " n"] | None = None) -> SO3:
    """Chordal mean of a batch `[n]`: the rotation with the least (weighted) sum of squared matrix differences.

    Without weights a batch `[n *b]` gives the means `[*b]`.
    """
    matrices = rotations.matrix()
    U, _, Vh = torch.linalg.svd((matrices if weights is None else weights[:, None, None] * matrices).mean(0))
    return SO3.from_matrix(_proper(U, Vh))


def umeyama(x_b: Float[Tensor, "n 3"], y_a: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, ""], SO3, Float[Tensor, "3"]]:
    """Scale s, rotation R_a_b and translation t that minimise |y_a - (s R_a_b @ x_b + t)|^2 (Umeyama 1991).

    Raises:
        ValueError: There are fewer than three points, or all are (nearly) collinear, which leaves a rotation undefined.
    """
    n = x_b.shape[0]
    if n < 3:
        raise ValueError(f"a similarity needs at least 3 pairs of points, got {n}")
    mean_b, mean_a = x_b.mean(0), y_a.mean(0)
    centred_b, centred_a = x_b - mean_b, y_a - mean_a
    covariance = centred_a.mT @ centred_b / n
    U, spread, Vh = torch.linalg.svd(covariance)
    if spread[1] <= COLLINEAR * spread[0]:
        raise ValueError(f"a similarity needs points that do not lie on one line, got {n} collinear points")
    R_a_b = _proper(U, Vh)
    # trace(R^T covariance) is the sum of singular values, the last one negated where a reflection would fit better.
    scale = (R_a_b * covariance).sum() / centred_b.square().sum(-1).mean()
    return scale, SO3.from_matrix(R_a_b), mean_a - scale * (R_a_b @ mean_b)


@cache
def _matrix_of_products(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "16 9"], Float[Tensor, "9"]]:
    """Factors and constants with which products of all pairs of w, x, y, z sum to the entries of a rotation matrix."""
    w, x, y, z = range(4)
    terms = [
        [(y, y, -2), (z, z, -2)], [(x, y, 2), (w, z, -2)], [(x, z, 2), (w, y, 2)],
        [(x, y, 2), (w, z, 2)], [(x, x, -2), (z, z, -2)], [(y, z, 2), (w, x, -2)],
        [(x, z, 2), (w, y, -2)], [(y, z, 2), (w, x, 2)], [(x, x, -2), (y, y, -2)],
    ]  # fmt: skip
    table = torch.zeros(4, 4, 9, dtype=dtype, device=device)
    for number, sums in enumerate(terms):
        for i, j, factor in sums:
            table[i, j, number] = factor
    return table.flatten(0, 1), torch.eye(3, dtype=dtype, device=device).flatten()


def _smooth(x2: Tensor, series: tuple[float, ...], closed: Callable[[Tensor], Tensor]) -> Tensor:
    """`closed(x)` at x = sqrt(x2), or its series near zero; the unused branch stays finite for the gradient."""
    small = x2 < SMALL
    near = _polynomial(torch.where(small, x2, 0.0), series)
    return torch.where(small, near, closed(torch.where(small, 1.0, x2).sqrt()))


def _polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    total = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def _quaternion_product(p: Tensor, q: Tensor) -> Tensor:
    p_w, p_x, p_y, p_z = p.unbind(-1)
    q_w, q_x, q_y, q_z = q.unbind(-1)
    product = [
        p_w * q_w - p_x * q_x - p_y * q_y - p_z * q_z,
        p_w * q_x + p_x * q_w + p_y * q_z - p_z * q_y,
        p_w * q_y - p_x * q_z + p_y * q_w + p_z * q_x,
        p_w * q_z + p_x * q_y - p_y * q_x + p_z * q_w,
    ]
    return torch.stack(product, -1)


def _proper(U: Tensor, Vh: Tensor) -> Float[Tensor, "*b 3 3"]:
    """U Vh as a rotation: the last singular direction is negated where U Vh would be a reflection."""
    sign = torch.linalg.det(U @ Vh).sign()[..., None, None]
    return torch.cat([U[..., :2], U[..., 2:] * sign], -1) @ Vh


def _broadcast(wxyz: Tensor, xyz: Tensor) -> SE3:
    # That of torch imports a library of symbolic mathematics, which takes a second.
    batch = np.broadcast_shapes(wxyz.shape[:-1], xyz.shape[:-1])
    return SE3(wxyz.expand(*batch, 4), xyz.expand(*batch, 3))


def _batch_index(index: Any) -> Any:
    """The index with a full slice appended for the last axis, so that an ellipsis covers the batch axes only."""
    return (*index, slice(None)) if isinstance(index, tuple) and Ellipsis in index else index


def _trailing(t: float | Tensor) -> float | Tensor:
    return t[..., None] if isinstance(t, Tensor) else t
