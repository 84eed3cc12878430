"""Bundle adjustment: poses and surface points that minimise the reprojection errors of feature tracks.

Levenberg-Marquardt with the Cauchy loss; points are eliminated by the Schur complement. Cameras are arranged in
*groups* of equal size that share no points, so that many short windows of a video are adjusted side by side in the same
way as one whole capture, each group with its own damping.

Two priors constrain what reprojection errors constrain weakly: the object's origin projects near the centre of its
silhouette, and its distance stays about constant. Where the focal length is only assumed, a factor on it per group is
estimated as well, with a third prior on that factor. All computations are in float64. The unit of length is the
origin's mean distance from the camera; the final scale is set at the end of the stage.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.backends import BundleKernel, BundleObservations, BundleVariables, bundle_kernel
from tumble.maths import SO3, Damping, Linearised, minimise
from tumble.poses.sfm.tracks import Tracks
from tumble.scene import Camera

NOISE = 0.3
"""Standard deviation of an inlier match, which weighs priors against reprojection errors [pixels]."""
MIN_DEPTH = 0.05
"""Lower limit of a point's depth in projections, which keeps points in front of the camera [unit of length]."""
MIN_HALF_CHORD = 0.15
"""Lower limit of half the chord of a ray in the bounding sphere [radius of the sphere]."""
FRONT_POSITION = 0.6
"""Prior position of a visible point on its ray, from the middle of the chord towards the camera [half chord]."""
FRONT_WEIGHT = 0.003
"""Weight of the prior position in triangulation, relative to a ray's weight of 1."""
FOCAL_SIGMA = math.log(1.25)
"""Standard deviation of the logarithm of an assumed focal length; phones record at equivalents of 24 to 35 mm."""
FOCAL_NOISE = 0.02
"""Noise that weighs the focal length's prior against the reprojection errors of all observations [pixels].

Small, because the errors of observations are not independent: the focal length then hardly changes where observations
do not constrain it, and the prior hardly biases it elsewhere."""
SHORT_TRACK, LONG_TRACK = 3, 12
"""Limits of the number of observations up to which a point is eliminated by a sum over their pairs; points with more
are eliminated by a matrix product."""
CAMERAS_PER_OBSERVATION = 3
"""Cameras of a group per observation of that number, at which both ways take the same time."""
PAIRS_AT_ONCE = 1 << 16
"""Maximum number of pairs that are summed at once; limits memory."""


@dataclass(frozen=True)
class BundleState:
    """Optimised variables: poses of `g` groups of `f` cameras, `n` points, and focal lengths."""

    R: Float[Tensor, "g f 3 3"]
    """`R_cam_obj`: object to camera."""
    t: Float[Tensor, "g f 3"]
    """Position of the object's origin, camera frame."""
    X: Float[Tensor, "n 3"]
    """Positions of the points, object frame of their group."""
    log_focal: Float[Tensor, " g"] | None = None
    """Logarithm of the focal length over that of `Problem.camera`; None if the latter is known."""


@dataclass(frozen=True)
class Problem:
    """Measurements and priors: `o` observations of `n` points by `g` groups of `f` cameras."""

    camera: Camera
    """Camera of all frames."""
    tracks: Tracks
    """Observations, with frames numbered over all groups: `group * f + frame`."""
    group: Int64[Tensor, " n"]
    """Group of every point."""
    weight: Float[Tensor, " o"]
    """Weight of every observation."""
    centre: Float[Tensor, "g f 2"]
    """Prior position of the projected origin of the object [pixels]."""
    centre_sigma: Float[Tensor, "g f"]
    """Standard deviation of that position [pixels]."""
    depth_sigma: float
    """Standard deviation of the logarithm of the origin's depth, whose mean is 0."""
    radius: float
    """Standard deviation of the points' coordinates in the prior that keeps them near the origin [unit of length]."""
    log_focal_prior: float = 0.0
    """Mean of the prior on `BundleState.log_focal`, without effect where that is None."""


def residuals(problem: Problem, scene: BundleState) -> tuple[Float[Tensor, "o 2"], Float[Tensor, "o 3"]]:
    """Reprojection errors, projected minus observed [pixels], and the points in their camera frames."""
    R, t = scene.R.flatten(0, 1)[problem.tracks.frame], scene.t.flatten(0, 1)[problem.tracks.frame]
    x = torch.einsum("oij,oj->oi", R, scene.X[problem.tracks.point]) + t
    focal, principal = _focals(problem, scene)[problem.tracks.frame], problem.camera.fx_fy_cx_cy.double()[2:]
    z = x[:, 2:].clamp_min(MIN_DEPTH)
    return x[:, :2] / z * focal + principal - problem.tracks.uv, x


def _focals(problem: Problem, scene: BundleState) -> Float[Tensor, "c 2"]:
    """Focal lengths fx, fy of all cameras [pixels]."""
    g, f = scene.t.shape[:2]
    focal = problem.camera.fx_fy_cx_cy.double()[:2].expand(g * f, 2)
    return focal if scene.log_focal is None else focal * scene.log_focal.exp().repeat_interleave(f)[:, None]


@dataclass(frozen=True)
class _FocalBorder:
    """Row and column of the logarithm of the focal length in the normal equations of each group."""

    H: Float[Tensor, " g"]
    """Diagonal entry."""
    g: Float[Tensor, " g"]
    """Gradient."""
    cam: Float[Tensor, "c 6"]
    """Entries coupled with the poses."""
    point: Float[Tensor, "n 3"]
    """Entries coupled with the points."""


@dataclass(frozen=True)
class _System:
    """Costs of the groups, and normal equations before elimination, for `c` cameras of all groups."""

    cost: Float[Tensor, " g"]
    """Robust loss and priors [pixels^2]."""
    U: Float[Tensor, "c 6 6"]
    """Blocks of the poses."""
    V: Float[Tensor, "n 3 3"]
    """Blocks of the points."""
    W: Float[Tensor, "o 6 3"]
    """Blocks of pose and point of each observation."""
    g_cam: Float[Tensor, "c 6"]
    """Gradient by the poses."""
    g_point: Float[Tensor, "n 3"]
    """Gradient by the points."""
    border: _FocalBorder | None
    """Terms of the focal lengths; None where they are known."""


@dataclass(frozen=True)
class _Slots:
    """Places of some observations in a table with a row for every camera."""

    camera: Int64[Tensor, " k"]
    """Camera of every observation."""
    index: Int64[Tensor, " k"]
    """Index of every observation within its camera."""
    size: tuple[int, int]
    """Numbers of cameras, and of observations of the camera with most."""

    def gram(self, rows: Float[Tensor, "k r w"]) -> Float[Tensor, "c w w"]:
        """Sum of `rows.mT @ rows` over the observations of every camera, as one matrix product per camera."""
        table = rows.new_zeros(*self.size, *rows.shape[1:])
        table[self.camera, self.index] = rows
        table = table.flatten(1, 2)
        return table.mT @ table


@dataclass(frozen=True)
class _Layout:
    """Observations by camera, and those that the elimination of points couples.

    Points with short tracks couple pairs of observations, each of the others is a column of a matrix.
    """

    slot: "_Slots"
    """Of all observations."""
    short: Int64[Tensor, " k"]
    """Observations of points with short tracks."""
    short_slot: "_Slots"
    """Of the observations of points with short tracks."""
    a: Int64[Tensor, " l"]
    """First observation of every pair of observations of one such point, the earlier one in `Tracks`."""
    b: Int64[Tensor, " l"]
    """Second observation of every pair."""
    long: Int64[Tensor, " m"]
    """Observations of all other points."""
    column: Int64[Tensor, " n"]
    """Index of each of these other points within its group."""
    columns: int
    """Largest number of such points in a group."""


def adjust(
    problem: Problem, scene: BundleState, *, steps: int, scale: float, tolerance: float = 1e-4
) -> tuple[BundleState, Float[Tensor, " g"]]:
    """Adjusted poses and points of every group, and its final cost [pixels^2].

    Args:
        problem: Measurements and priors.
        scene: Initial poses, points and focal lengths.
        steps: Largest number of iterations.
        scale: Scale of the Cauchy loss: the residual from which an observation is down-weighted [pixels].
        tolerance: A group has converged when an iteration lowers its cost by less than this fraction.
    """
    choose = partial(_select_better, problem)
    damping = Damping(minimum=1e-10, maximum=1e8)
    kernel = bundle_kernel()
    equations = _equations(problem, scale) if kernel is None else _kernel_equations(kernel, problem, scale)
    scene, last = minimise(scene, *equations, choose, steps=steps, damping=damping, tolerance=tolerance)
    return scene, last.cost


Equations = tuple[Callable[[BundleState], Linearised], Callable[[BundleState, Any, Tensor], BundleState]]
"""Costs and normal equations of a state, and the state after the damped step that solves them."""


def _equations(problem: Problem, scale: float) -> Equations:
    """The equations in plain torch, which define what the kernel computes."""
    layout = _layout(problem)

    def linearised(scene: BundleState) -> Linearised:
        system = _linearise(problem, scene, scale, layout)
        return Linearised(system.cost, system)

    def moved(scene: BundleState, system: _System, damping: Tensor) -> BundleState:
        return _apply_step(scene, *_solve(problem, scene, system, damping, layout))

    return linearised, moved


def _kernel_equations(kernel: BundleKernel, problem: Problem, scale: float) -> Equations:
    """The same by a kernel, which linearises again at every step instead of keeping the equations of all states."""
    observations = _sorted_observations(problem, scale)

    def variables(scene: BundleState) -> BundleVariables:
        weight = _point_prior_weight(problem, scene, torch.arange(len(scene.t)))[:, 0].expand(len(scene.t))
        R, t = scene.R.flatten(0, 1), scene.t.flatten(0, 1)
        return BundleVariables(R, t, _focals(problem, scene), scene.X, weight)

    def linearised(scene: BundleState) -> Linearised:
        cost = kernel.bundle_cost(observations, variables(scene))
        cost = cost + _origin_prior(problem, scene)[1].square().sum(-1).reshape(scene.t.shape[:2]).sum(1)
        if scene.log_focal is not None:
            cost = cost + _focal_weight(problem, len(cost)) * (scene.log_focal - problem.log_focal_prior).square()
        return Linearised(cost, None)

    def moved(scene: BundleState, _: None, damping: Tensor) -> BundleState:
        g, f = scene.t.shape[:2]
        focal_free = scene.log_focal is not None
        reduced = kernel.bundle_reduce(observations, variables(scene), damping, focal_free=focal_free)
        _camera_priors(problem, scene, reduced.U, reduced.g_camera)
        U = _damped(reduced.U, damping.repeat_interleave(f)[:, None])
        S = -reduced.E
        S.view(g, f, 6, f, 6).diagonal(dim1=1, dim2=3).add_(U.reshape(g, f, 6, 6).permute(0, 2, 3, 1))
        row = None
        if scene.log_focal is not None:
            cam, e, sums = reduced.focal_camera, reduced.focal_e, reduced.focal_sums
            assert cam is not None, "the kernel was asked for it"
            assert e is not None, "the kernel was asked for it"
            assert sums is not None, "the kernel was asked for them"
            H, gradient, *subtracted = sums.unbind(1)
            H, gradient = _add_focal_priors(problem, scene, cam, H, gradient)
            row = _FocalRow(cam - e, H, gradient, *subtracted)
        d_cam, d_focal = _camera_steps(S, reduced.e - reduced.g_camera, row, damping)
        return _apply_step(scene, d_cam, kernel.bundle_move(observations, reduced, d_cam, d_focal), d_focal)

    return linearised, moved


def _sorted_observations(problem: Problem, scale: float) -> BundleObservations:
    """The observations in the order of their points, which are in the order of their groups."""
    tracks, g = problem.tracks, len(problem.centre)
    point = torch.argsort(problem.group, stable=True)
    rank = torch.empty_like(point)
    rank[point] = torch.arange(len(point))
    order = torch.argsort(rank[tracks.point], stable=True)
    zero = point.new_zeros(1)
    count = torch.bincount(tracks.point, minlength=len(point))[point]
    first_observation = torch.cat([zero, count.cumsum(0)])
    first_point = torch.cat([zero, torch.bincount(problem.group, minlength=g).cumsum(0)])
    _, _, cx, cy = problem.camera.fx_fy_cx_cy.double().tolist()
    each = tracks.frame[order], tracks.uv[order], problem.weight[order]
    return BundleObservations(*each, point, first_observation, first_point, (cx, cy), scale, MIN_DEPTH)


def _layout(problem: Problem) -> _Layout:
    """Couplings between observations, the same in all iterations."""
    point = problem.tracks.point
    count = torch.bincount(point, minlength=len(problem.group))
    limit = max(SHORT_TRACK, min(LONG_TRACK, problem.centre.shape[1] // CAMERAS_PER_OBSERVATION))
    short, many = count[point] <= limit, count > limit
    order = torch.nonzero(short)[:, 0][torch.argsort(point[short], stable=True)]
    size = count[point[order]]
    begin = torch.nonzero(torch.cat([size.new_ones(1), point[order].diff()]))[:, 0] if len(order) else size
    begin = torch.repeat_interleave(begin, count[point[order][begin]])
    first = torch.repeat_interleave(torch.arange(len(order)), size)
    second = begin[first] + torch.arange(len(first)) - (torch.cumsum(size, 0) - size)[first]
    first, second = first[first < second], second[first < second]
    # Points with many observations are numbered within their group.
    column = torch.zeros_like(count)
    n = 0
    for group in range(int(problem.group.max()) + 1 if len(problem.group) else 0):
        mine = many & (problem.group == group)
        column[mine] = torch.arange(int(mine.sum()))
        n = max(n, int(mine.sum()))
    frame, n_cameras = problem.tracks.frame, problem.centre[..., 0].numel()
    slots = _slots(frame, n_cameras), _slots(frame[order], n_cameras)
    return _Layout(slots[0], order, slots[1], order[first], order[second], torch.nonzero(~short)[:, 0], column, n)


def _slots(camera: Int64[Tensor, " k"], n_cameras: int) -> _Slots:
    """Places of observations, given their cameras."""
    count = torch.bincount(camera, minlength=n_cameras)
    by_camera = torch.argsort(camera, stable=True)
    index = torch.empty_like(camera)
    index[by_camera] = torch.arange(len(camera)) - (torch.cumsum(count, 0) - count)[camera[by_camera]]
    return _Slots(camera, index, (n_cameras, int(count.max())))


def _jacobians(
    problem: Problem, scene: BundleState, x: Float[Tensor, "o 3"]
) -> tuple[Float[Tensor, "o 2 6"], Float[Tensor, "o 2 3"]]:
    """Derivatives of the projections by poses (rotation vector from the left, translation) and by points."""
    focal = _focals(problem, scene)[problem.tracks.frame]
    R = scene.R.flatten(0, 1)[problem.tracks.frame]
    z = x[:, 2].clamp_min(MIN_DEPTH)
    zero = torch.zeros_like(z)
    J_x = torch.stack(
        [
            torch.stack([focal[:, 0] / z, zero, -focal[:, 0] * x[:, 0] / z**2], -1),
            torch.stack([zero, focal[:, 1] / z, -focal[:, 1] * x[:, 1] / z**2], -1),
        ],
        -2,
    )
    arm = x - scene.t.flatten(0, 1)[problem.tracks.frame]
    J_rotation = torch.linalg.cross(arm[:, None].expand_as(J_x), J_x)
    return torch.cat([J_rotation, J_x], -1), J_x @ R


def _linearise(problem: Problem, scene: BundleState, scale: float, layout: _Layout) -> _System:
    """Costs and normal equations at the current poses and points."""
    g = len(scene.t)
    residual, x = residuals(problem, scene)
    squared = (residual[:, 0].square() + residual[:, 1].square()) / scale**2
    w = problem.weight / (1 + squared)
    J_cam, J_point = _jacobians(problem, scene, x)
    wJ_cam, wJ_point = w[:, None, None] * J_cam, w[:, None, None] * J_point
    n, track = len(scene.X), problem.tracks
    rows = w.sqrt()[:, None, None] * torch.cat([J_cam, residual[..., None]], -1)
    U, g_cam = layout.slot.gram(rows)[:, :6].split([6, 1], -1)
    g_cam = g_cam[..., 0].clone()
    V = torch.zeros(n, 3, 3, dtype=torch.float64).index_add_(0, track.point, wJ_point.mT @ J_point)
    g_point = torch.zeros(n, 3, dtype=torch.float64).index_add_(0, track.point, _gradient(wJ_point, residual))
    loss = problem.weight * scale**2 * torch.log1p(squared)
    cost = torch.zeros(g, dtype=torch.float64).index_add_(0, problem.group[track.point], loss)
    cost = cost + _camera_priors(problem, scene, U, g_cam)
    # A prior keeps weakly constrained points within the object.
    prior = _point_prior_weight(problem, scene, problem.group)
    V = V + prior[..., None] * torch.eye(3, dtype=torch.float64)
    g_point = g_point + prior * scene.X
    cost = cost.index_add(0, problem.group, prior[:, 0] * scene.X.square().sum(-1))
    known = scene.log_focal is None
    penalty, border = (0, None) if known else _focal_border(problem, scene, x, residual, wJ_cam, wJ_point, w)
    return _System(cost + penalty, U, V, wJ_cam.mT @ J_point, g_cam, g_point, border)


def _gradient(wJ: Float[Tensor, "o 2 d"], residual: Float[Tensor, "o 2"]) -> Float[Tensor, "o d"]:
    """Gradient of every observation."""
    return wJ[:, 0] * residual[:, :1] + wJ[:, 1] * residual[:, 1:]


def _point_prior_weight(problem: Problem, scene: BundleState, group: Tensor) -> Float[Tensor, "#n 1"]:
    """Weight of the prior on the distance from the origin of points in these groups; a longer focal length implies a
    smaller object."""
    weight = torch.full((1, 1), (NOISE / problem.radius) ** 2, dtype=torch.float64)
    return weight if scene.log_focal is None else weight * (2 * scene.log_focal).exp()[group, None]


def _focal_border(
    problem: Problem, scene: BundleState, x: Tensor, residual: Tensor, wJ_cam: Tensor, wJ_point: Tensor, w: Tensor
) -> tuple[Float[Tensor, " g"], _FocalBorder]:
    """Cost of the focal length's prior, and all derivatives by the logarithm of the focal length."""
    assert scene.log_focal is not None, "the focal length is estimated"
    g, f = scene.t.shape[:2]
    track, focal = problem.tracks, _focals(problem, scene)
    group = problem.group[track.point]
    J = x[:, :2] / x[:, 2:].clamp_min(MIN_DEPTH) * focal[track.frame]
    cam = torch.zeros(g * f, 6, dtype=torch.float64).index_add_(0, track.frame, _gradient(wJ_cam, J))
    prior = _point_prior_weight(problem, scene, problem.group) * scene.X
    point = prior.index_add(0, track.point, _gradient(wJ_point, J))
    zero, offset = torch.zeros(g, dtype=torch.float64), scene.log_focal - problem.log_focal_prior
    shrinkage = zero.index_add(0, problem.group, (prior * scene.X).sum(-1))
    H = shrinkage.index_add(0, group, w * J.square().sum(-1))
    gradient = shrinkage.index_add(0, group, w * (J * residual).sum(-1))
    H, gradient = _add_focal_priors(problem, scene, cam, H, gradient)
    return _focal_weight(problem, g) * offset.square(), _FocalBorder(H, gradient, cam, point)


def _focal_weight(problem: Problem, g: int) -> Float[Tensor, " g"]:
    """Weight of the focal length's prior in every group."""
    total = torch.zeros(g, dtype=torch.float64).index_add(0, problem.group[problem.tracks.point], problem.weight)
    return (FOCAL_NOISE / FOCAL_SIGMA) ** 2 * total


def _add_focal_priors(
    problem: Problem, scene: BundleState, cam: Tensor, H: Tensor, gradient: Tensor
) -> tuple[Float[Tensor, " g"], Float[Tensor, " g"]]:
    """Diagonal entry and gradient of the focal length with all priors; those coupled with poses are added in place."""
    assert scene.log_focal is not None, "the focal length is estimated"
    g, weight = len(scene.t), _focal_weight(problem, len(scene.t))
    rows, r, J = _origin_prior(problem, scene)
    cam[:, 3:] += torch.einsum("cki,ck->ci", rows[:, :2], J)
    gradient = gradient + weight * (scene.log_focal - problem.log_focal_prior) + (J * r[:, :2]).reshape(g, -1).sum(1)
    return H + weight + J.square().reshape(g, -1).sum(1), gradient


def _camera_priors(problem: Problem, scene: BundleState, U: Tensor, g_cam: Tensor) -> Float[Tensor, " g"]:
    """Cost of the priors on the origin's position, which are added to the normal equations in place."""
    rows, r, _ = _origin_prior(problem, scene)
    U[:, 3:, 3:] += rows.mT @ rows
    g_cam[:, 3:] += torch.einsum("cki,ck->ci", rows, r)
    return r.square().sum(-1).reshape(scene.t.shape[:2]).sum(1)


def _origin_prior(problem: Problem, scene: BundleState) -> tuple[Tensor, Tensor, Tensor]:
    """Priors on the origin's position: derivatives by it, residuals, derivatives by the logarithmic focal length."""
    focal, principal = _focals(problem, scene), problem.camera.fx_fy_cx_cy.double()[2:]
    t = scene.t.flatten(0, 1)
    z = t[:, 2:].clamp_min(MIN_DEPTH)
    offset = (t[:, :2] / z * focal + principal - problem.centre.flatten(0, 1)) / problem.centre_sigma.flatten()[:, None]
    log_depth = z.log() / problem.depth_sigma
    rows = torch.zeros(len(t), 3, 3, dtype=torch.float64)
    scaled = focal / z / problem.centre_sigma.flatten()[:, None]
    rows[:, 0, 0], rows[:, 1, 1] = scaled[:, 0], scaled[:, 1]
    rows[:, :2, 2] = -scaled * t[:, :2] / z
    rows[:, 2, 2] = 1 / (z[:, 0] * problem.depth_sigma)
    return NOISE * rows, NOISE * torch.cat([offset, log_depth], -1), NOISE * scaled * t[:, :2]


def _solve(
    problem: Problem, scene: BundleState, system: _System, damping: Float[Tensor, " g"], layout: _Layout
) -> tuple[Float[Tensor, "c 6"], Float[Tensor, "n 3"], Float[Tensor, " g"] | None]:
    """Damped steps of poses, points and, where they are estimated, logarithms of the focal lengths."""
    g, f = scene.t.shape[:2]
    lam_cam, lam_point = damping.repeat_interleave(f)[:, None], damping[problem.group][:, None]
    U, V = _damped(system.U, lam_cam), _damped(system.V, lam_point)
    V_inv = torch.linalg.inv(V)
    frame, point = problem.tracks.frame, problem.tracks.point
    # With V_inv = L L^T, points add -(W L)(W L)^T, which is symmetric.
    WL = system.W @ torch.linalg.cholesky(V_inv)[point]
    pairs = torch.zeros(g * f * f, 6, 6, dtype=torch.float64)
    for a, b in zip(layout.a.split(PAIRS_AT_ONCE), layout.b.split(PAIRS_AT_ONCE), strict=True):
        pairs.index_add_(0, frame[a] * f + frame[b] % f, WL[a] @ WL[b].mT)
    pairs = pairs.reshape(g, f, f, 6, 6).permute(0, 1, 3, 2, 4).reshape(g, 6 * f, 6 * f)
    U = U - layout.short_slot.gram(WL[layout.short].mT)
    # One matrix product instead of a sum over pairs, whose number is the square of a track's length.
    camera, column = frame[layout.long], layout.column[point[layout.long]]
    half = torch.zeros(g, f, 6, layout.columns, 3, dtype=torch.float64)
    half[camera // f, camera % f, :, column] = WL[layout.long]
    half = half.reshape(g, 6 * f, 3 * layout.columns)
    S = torch.zeros(g, f, 6, f, 6, dtype=torch.float64)
    S.diagonal(dim1=1, dim2=3).copy_(U.reshape(g, f, 6, 6).permute(0, 2, 3, 1))
    S = S.reshape(g, 6 * f, 6 * f) - pairs - pairs.mT - half @ half.mT
    eliminated = (V_inv @ system.g_point[..., None])[point]
    right = (-system.g_cam).index_add(0, frame, (system.W @ eliminated)[..., 0])
    g_point, row = system.g_point, None
    if (border := system.border) is not None:
        V_point = (V_inv @ border.point[..., None])[..., 0]
        side = border.cam.index_add(0, frame, -(system.W @ V_point[point][..., None])[..., 0])
        subtracted = (
            torch.zeros(g, dtype=torch.float64).index_add(0, problem.group, (V_point * x).sum(-1))
            for x in (border.point, g_point)
        )
        row = _FocalRow(side, border.H, border.g, *subtracted)
    d_cam, d_focal = _camera_steps(S, right, row, damping)
    if border is not None and d_focal is not None:
        g_point = g_point + d_focal[problem.group][:, None] * border.point
    back = g_point.index_add(0, point, (system.W.mT @ d_cam[frame][..., None])[..., 0])
    return d_cam, -(V_inv @ back[..., None])[..., 0], d_focal


@dataclass(frozen=True)
class _FocalRow:
    """Row of the logarithm of the focal length in the normal equations of each group, points eliminated."""

    camera: Float[Tensor, "c 6"]
    """Entries coupled with the poses."""
    H: Float[Tensor, " g"]
    """Diagonal entry before the elimination."""
    g: Float[Tensor, " g"]
    """Gradient before the elimination."""
    subtracted_H: Float[Tensor, " g"]
    """What points subtract from the diagonal entry."""
    subtracted_g: Float[Tensor, " g"]
    """What points subtract from the gradient."""


def _camera_steps(
    S: Float[Tensor, "g m m"], right: Float[Tensor, "c 6"], focal: _FocalRow | None, damping: Float[Tensor, " g"]
) -> tuple[Float[Tensor, "c 6"], Float[Tensor, " g"] | None]:
    """Steps of the poses and of the logarithms of the focal lengths; the latter are None where these are known."""
    g, m = S.shape[:2]
    if focal is None:
        return torch.linalg.solve(S, right.reshape(g, m, 1)).reshape(-1, 6), None
    both = torch.linalg.solve(S, torch.stack([right, focal.camera], -1).reshape(g, m, 2))
    step, slope = both.unbind(-1)
    side = focal.camera.reshape(g, m)
    H = (1 + damping) * focal.H - focal.subtracted_H - (side * slope).sum(1)
    d_focal = (focal.subtracted_g - focal.g - (side * step).sum(1)) / H
    return (step - d_focal[:, None] * slope).reshape(-1, 6), d_focal


def _damped(H: Float[Tensor, "n d d"], damping: Float[Tensor, "n 1"]) -> Float[Tensor, "n d d"]:
    """Blocks of the normal equations with their diagonals raised."""
    return H + torch.diag_embed(damping * H.diagonal(dim1=-2, dim2=-1) + 1e-9)


def _apply_step(scene: BundleState, d_cam: Tensor, d_point: Tensor, d_focal: Tensor | None = None) -> BundleState:
    """The variables after a step, which is clamped; rotations are applied from the left."""
    g, f = scene.t.shape[:2]
    rotation = SO3.exp(d_cam[:, :3].clamp(-0.5, 0.5)).matrix().reshape(g, f, 3, 3)
    shift = d_cam[:, 3:].clamp(-0.2, 0.2).reshape(g, f, 3)
    log_focal = None if d_focal is None or scene.log_focal is None else scene.log_focal + d_focal.clamp(-0.1, 0.1)
    return BundleState(rotation @ scene.R, scene.t + shift, scene.X + d_point.clamp(-0.2, 0.2), log_focal)


def _select_better(problem: Problem, better: Tensor, new: Any, old: Any) -> Any:
    """Per group, the new value where it is better, else the old one; of variables and of systems."""
    if bool(better.all()):
        return new
    point = better[problem.group]
    camera = better.repeat_interleave(len(problem.centre.flatten(0, 1)) // len(better))
    masks: dict[str, Tensor] = {"U": camera, "g_cam": camera, "cam": camera, "X": point, "V": point, "g_point": point}
    masks |= {"point": point, "W": point[problem.tracks.point]}

    def pick(name: str, a: Any, b: Any) -> Any:
        if not isinstance(a, Tensor):
            return None if a is None else type(a)(**{k: pick(k, x, getattr(b, k)) for k, x in vars(a).items()})
        return torch.where(masks.get(name, better).reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return pick("", new, old)


def information(problem: Problem, scene: BundleState, precision: Float[Tensor, "o 2 2"]) -> Float[Tensor, "c 6 6"]:
    """Information matrix of every pose (rotation, translation), with points fixed and without priors.

    Args:
        problem: Observations; its weights and priors are not used.
        scene: Poses and points.
        precision: Inverse covariance of every observation [1/pixel^2].
    """
    _, x = residuals(problem, scene)
    J, _ = _jacobians(problem, scene, x)
    U = torch.zeros(scene.t.shape[0] * scene.t.shape[1], 6, 6, dtype=torch.float64)
    return U.index_add_(0, problem.tracks.frame, J.mT @ precision @ J)


# Points from poses ----------------------------------------------------------------------------------------------------


def triangulate(
    tracks: Tracks,
    R: Float[Tensor, "c 3 3"],
    t: Float[Tensor, "c 3"],
    camera: Camera,
    radius: Float[Tensor, " c"],
) -> Float[Tensor, "n 3"]:
    """Points closest to all their rays, with a weak prior on the front of the object's bounding sphere.

    Args:
        tracks: Observations, with frames in [0, c).
        R: `R_cam_obj` of every frame.
        t: Position of the object's origin in every frame, camera frame.
        camera: Camera of all frames.
        radius: Radius of the bounding sphere over its distance, per frame.
    """
    focal, principal = camera.fx_fy_cx_cy.double().split(2)
    xy = (tracks.uv - principal) / focal
    ray = torch.nn.functional.normalize(torch.cat([xy, torch.ones_like(xy[:, :1])], -1), dim=-1)
    R, t = R[tracks.frame], t[tracks.frame]
    middle = (ray * t).sum(-1)
    sphere = radius[tracks.frame] * t.norm(dim=-1)
    half2 = sphere.square() - t.square().sum(-1) + middle.square()
    half = torch.maximum(half2, (MIN_HALF_CHORD * sphere).square()).sqrt()
    direction, centre = torch.einsum("oji,oj->oi", R, ray), -torch.einsum("oji,oj->oi", R, t)
    front = centre + direction * (middle - FRONT_POSITION * half)[:, None]
    # The projection across a ray is I - d d^T, and d . centre is -middle.
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(tracks.n, 3, 3, dtype=torch.float64)
    A = zero.index_add(0, tracks.point, (1 + FRONT_WEIGHT) * eye - direction[:, :, None] * direction[:, None])
    right = centre + direction * middle[:, None] + FRONT_WEIGHT * front
    return torch.linalg.solve(A, zero[..., 0].index_add(0, tracks.point, right))
