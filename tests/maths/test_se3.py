"""Group axioms, also near the identity and the angle pi; SciPy and the matrix exponential as oracles."""

import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch import Tensor

from tumble.maths.se3 import SE3, SO3, angle_between, interpolate, mean_rotation, slerp, umeyama

EXACT = 1e-12
"""A few dozen roundings of float64 on numbers of size one."""
ANGLES = st.one_of(
    st.floats(0, math.pi),
    st.sampled_from([0.0, 1e-200, 1e-12, 1e-7, 1e-4, 0.0999, 0.1, 0.1001]),
    st.floats(-12, -1).map(lambda power: math.pi - 10**power),
)
COORDINATES = st.floats(-2, 2).map(lambda x: round(x, 6))


@st.composite
def rotation_vectors(draw: Callable) -> Tensor:
    """Any axis; angles to pi, dense near both ends and around the switch to the series."""
    axis = torch.tensor(draw(st.tuples(COORDINATES, COORDINATES, COORDINATES)), dtype=torch.float64)
    axis = axis + torch.tensor([0.0, 0.0, 1e-3 if axis.norm() == 0 else 0.0])
    return axis / axis.norm() * draw(ANGLES)


@st.composite
def tangents(draw: Callable) -> Tensor:
    v = torch.tensor(draw(st.tuples(COORDINATES, COORDINATES, COORDINATES)), dtype=torch.float64)
    return torch.cat([v, draw(rotation_vectors())])


def random_tangents(n: int, seed: int = 0) -> Tensor:
    return torch.randn(n, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def generator_matrix(tangent: Tensor) -> Tensor:
    """The 4 x 4 matrix whose exponential is the motion."""
    v1, v2, v3, x, y, z = tangent.tolist()
    rows = [[0, -z, y, v1], [z, 0, -x, v2], [-y, x, 0, v3], [0, 0, 0, 0]]
    return torch.tensor(rows, dtype=torch.float64)


def same(a: Tensor, b: Tensor, tolerance: float = EXACT) -> None:
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


@settings(deadline=None)
@given(tangents(), tangents(), tangents())
def test_motions_form_a_group(a: Tensor, b: Tensor, c: Tensor) -> None:
    A, B, C = SE3.exp(a), SE3.exp(b), SE3.exp(c)
    eye = torch.eye(4, dtype=torch.float64)
    same(((A @ B) @ C).matrix(), (A @ (B @ C)).matrix(), 1e-11)
    same((A @ A.inverse()).matrix(), eye)
    same((A.inverse() @ A).matrix(), eye)
    same((A @ SE3.identity(dtype=torch.float64)).matrix(), A.matrix())
    same((A @ B).matrix(), A.matrix() @ B.matrix())
    same((A @ B) @ c[:3], A @ (B @ c[:3]), 1e-11)


@settings(deadline=None)
@given(tangents())
def test_exponential_is_the_matrix_exponential(tangent: Tensor) -> None:
    # Torch's own matrix exponential errs by 2e-11 at a rotation of 1/32.
    same(SE3.exp(tangent).matrix(), torch.from_numpy(expm(generator_matrix(tangent).numpy())))


@settings(deadline=None)
@given(rotation_vectors())
def test_rotations_agree_with_scipy(omega: Tensor) -> None:
    ours, theirs = SO3.exp(omega), Rotation.from_rotvec(omega.numpy())
    same(ours.matrix(), torch.from_numpy(theirs.as_matrix()))
    assert ours.angle().item() == pytest.approx(theirs.magnitude(), abs=EXACT)
    same(ours.log(), torch.from_numpy(theirs.as_rotvec()))


@settings(deadline=None)
@given(tangents())
def test_log_undoes_exp_up_to_the_half_turn(tangent: Tensor) -> None:
    back = SE3.exp(tangent).log()
    half_turn = tangent[3:].norm() > math.pi - 1e-9
    # At the half turn the axis may come back reversed; the motion is then still the same.
    same(SE3.exp(back).matrix(), SE3.exp(tangent).matrix())
    if not half_turn:
        same(back, tangent)
    assert back[3:].norm() <= math.pi + EXACT


@settings(deadline=None)
@given(rotation_vectors())
def test_rotations_convert_to_matrices_and_back(omega: Tensor) -> None:
    R = SO3.exp(omega)
    same(SO3.from_matrix(R.matrix()).matrix(), R.matrix())
    T = SE3(R.wxyz, omega + 1)
    same(SE3.from_matrix(T.matrix()).matrix(), T.matrix())


def test_the_log_of_a_rotation_beyond_pi_is_the_shortest_rotation() -> None:
    omega = torch.tensor([0.0, 0.0, 1.5 * math.pi], dtype=torch.float64)
    same(SO3.exp(omega).log(), torch.tensor([0.0, 0.0, -0.5 * math.pi], dtype=torch.float64))
    assert SO3.exp(omega).angle().item() == pytest.approx(0.5 * math.pi)


def test_quaternions_are_normalised_real_part_first() -> None:
    quarter_about_z = SO3.from_wxyz(torch.tensor([3.0, 0.0, 0.0, 3.0]))
    same(quarter_about_z @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), 1e-6)


def test_batch_axes_broadcast() -> None:
    T, x = SE3.exp(random_tangents(4)), random_tangents(7)[:, :3]
    moved = T[:, None] @ x
    one_by_one = torch.stack([x @ T[i].matrix()[:3, :3].mT + T[i].xyz for i in range(4)])
    same(moved, one_by_one)
    same((T[:, None] @ T[None, :2]).matrix(), T.matrix()[:, None] @ T.matrix()[None, :2])
    same((T[0] @ T).matrix(), T.matrix()[0] @ T.matrix())
    same(SE3.from_rotation(T[0].rotation, x).xyz, x)
    assert SE3.identity((2, 3)).matrix().shape == (2, 3, 4, 4)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.1, 1.0, 3.0])
def test_gradients_are_those_of_finite_differences(angle: float) -> None:
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    tangent = torch.cat([torch.tensor([0.3, -1.0, 0.5], dtype=torch.float64), axis * angle]).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: SE3.exp(t).matrix(), tangent)
    assert torch.autograd.gradcheck(lambda t: SE3.exp(t).log(), tangent)
    assert torch.autograd.gradcheck(lambda t: SE3.from_matrix(SE3.exp(t).matrix()).log(), tangent)


def test_log_near_the_half_turn_has_the_gradient_of_the_identity() -> None:
    """log after exp is the identity there too; gradcheck's steps would cross the half turn."""
    axis = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    omega = axis * (math.pi - 1e-9)
    jacobian = torch.autograd.functional.jacobian(lambda w: SO3.exp(w).log(), omega)
    assert isinstance(jacobian, Tensor)
    same(jacobian, torch.eye(3, dtype=torch.float64), 1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_the_identity_are_finite(dtype: torch.dtype) -> None:
    tangent = torch.zeros(6, dtype=dtype, requires_grad=True)
    T = SE3.exp(tangent)
    (T.log().sum() + T.matrix().sum() + T.rotation.angle() + T.inverse().log().square().sum()).backward()
    assert tangent.grad is not None
    assert tangent.grad.isfinite().all()


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 0.1, 1.0, 3.1415])
def test_float32_keeps_its_digits(angle: float) -> None:
    """Relative 1e-6 is ten roundings; a naive acos would have lost half of the digits near both ends."""
    omega = torch.tensor([0.48, -0.6, 0.64]) * angle
    torch.testing.assert_close(SO3.exp(omega).log(), omega, rtol=1e-6, atol=0)


def test_slerp_has_constant_angular_speed() -> None:
    a, b = SO3.exp(random_tangents(5, seed=1)[:, 3:]), SO3.exp(random_tangents(5, seed=2)[:, 3:])
    whole = angle_between(a, b)
    for t in (0.0, 0.25, 1.0):
        between = slerp(a, b, t)
        same(angle_between(a, between), t * whole)
        same(angle_between(between, b), (1 - t) * whole)
    same(slerp(a, b, torch.full((5,), 0.25, dtype=torch.float64)).matrix(), slerp(a, b, 0.25).matrix())


def test_interpolation_moves_the_origin_on_a_straight_line() -> None:
    a, b = SE3.exp(random_tangents(3, seed=1)), SE3.exp(random_tangents(3, seed=2))
    middle = interpolate(a, b, 0.5)
    same(middle.xyz, 0.5 * (a.xyz + b.xyz))
    same(middle.rotation.matrix(), slerp(a.rotation, b.rotation, 0.5).matrix())
    same(interpolate(a, b, 1.0).matrix(), b.matrix())


def test_angle_between_quarter_turns_is_a_quarter_turn() -> None:
    quarter = SO3.exp(torch.tensor([0.0, 0.5 * math.pi, 0.0], dtype=torch.float64))
    assert angle_between(quarter, quarter @ quarter).item() == pytest.approx(0.5 * math.pi)


def test_mean_rotation_agrees_with_scipy() -> None:
    """SciPy's quaternion mean minimises the same chordal distance."""
    omegas = 0.5 * random_tangents(20)[:, 3:] + 2.0
    ours = mean_rotation(SO3.exp(omegas)).matrix()
    same(ours, torch.from_numpy(Rotation.from_rotvec(omegas.numpy()).mean().as_matrix()))


@pytest.mark.parametrize("n", [3, 4, 50])
def test_umeyama_finds_a_known_similarity(n: int) -> None:
    x_b = random_tangents(n)[:, :3] * torch.tensor([1.0, 0.3, 2.0])
    R_a_b = SO3.exp(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64))
    t = torch.tensor([0.1, 5.0, -3.0], dtype=torch.float64)
    scale, rotation, offset = umeyama(x_b, 2.5 * (R_a_b @ x_b) + t)
    assert scale.item() == pytest.approx(2.5, rel=1e-12)
    same(rotation.matrix(), R_a_b.matrix())
    same(offset, t, 1e-11)


def test_umeyama_maps_from_b_to_a() -> None:
    x_b = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], dtype=torch.float64)
    y_a = torch.tensor([[0, 2.0, 0], [-2, 0, 0], [0, 0, 2], [0, 0, 0]], dtype=torch.float64)
    scale, rotation, _ = umeyama(x_b, y_a)
    assert scale.item() == pytest.approx(2.0)
    same(rotation @ x_b[0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_umeyama_never_returns_a_reflection() -> None:
    """A mirrored set is best approximated by a rotation with a smaller scale, here found by brute force."""
    x_b = random_tangents(12)[:, :3]
    x_b = x_b - x_b.mean(0)
    y_a = x_b * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    scale, rotation, offset = umeyama(x_b, y_a)
    assert torch.linalg.det(rotation.matrix()).item() == pytest.approx(1.0)

    def residual(R: Tensor, s: Tensor) -> Tensor:
        return (y_a - s[..., None, None] * (x_b @ R.mT)).square().sum((-2, -1))

    ours = residual(rotation.matrix(), scale)
    assert offset.norm() < EXACT
    R = torch.from_numpy(Rotation.from_quat(np.random.default_rng(0).normal(size=(20000, 4))).as_matrix())
    # The best scale of each rotation; a negative scale would be a reflection.
    s = ((y_a * (x_b @ R.mT)).sum((-2, -1)) / x_b.square().sum()).clamp_min(0)
    assert ours <= residual(R, s).min() + EXACT


@pytest.mark.parametrize("width", [0.0, 1e-4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_umeyama_rejects_collinear_points(width: float, dtype: torch.dtype) -> None:
    along = torch.linspace(-1, 1, 9, dtype=dtype)
    x_b = torch.stack([along, width * (along * 7).sin(), width * (along * 5).cos()], -1)
    with pytest.raises(ValueError, match="line"):
        umeyama(x_b, x_b + 1)
    with pytest.raises(ValueError, match="at least 3"):
        umeyama(x_b[:2], x_b[:2])


def test_umeyama_accepts_points_in_a_plane() -> None:
    x_b = random_tangents(6)[:, :3] * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    T = SE3.exp(random_tangents(1)[0])
    _, rotation, offset = umeyama(x_b, T @ x_b)
    same(rotation.matrix(), T.rotation.matrix())
    same(offset, T.xyz)


def test_poses_need_no_symbolic_mathematics() -> None:
    program = """if True:
        import sys, torch
        from tumble.maths import SE3, SO3
        assert SE3.from_rotation(SO3.identity(), torch.zeros(5, 3)).wxyz.shape == (5, 4)
        assert "sympy" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
