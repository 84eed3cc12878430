"""The adjustment of surface points and poses to what the frames show (bundle adjustment).

Levenberg-Marquardt with Cauchy's loss; points are eliminated first (Schur complement). Cameras come in *groups* of
equal size that share no point: many short windows are adjusted side by side as easily as one whole capture, each with
its own damping.

Two priors hold what pixels say little about: the object's origin stays near the middle of its silhouette, and at about
the same distance. Where the focal length is a guess, one factor on it per group is found as well; the guess is a third
prior. Everything is float64. Unit of length: the origin's mean distance from the camera, until the gauge is fixed at
the end of the stage.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.maths import SO3, Damping, Linearised, minimise
from tumble.poses.sfm.tracks import Tracks
from tumble.scene import Camera

NOISE = 0.3
"""Of a good match: what a prior's one sigma weighs against residuals [pixels]."""
NEAREST = 0.05
"""Least depth of a point: what comes closer is on its way behind the camera."""
SHALLOW = 0.15
"""Half length of the shortest chord through the ball about the object [its radius]."""
FRONT = 0.6
"""How far towards the camera a visible point is first believed to be [half chord]."""
TRUST_FRONT = 0.003
"""Weight of that belief against the rays of all frames that show the point."""
GUESS = math.log(1.25)
"""One sigma of the logarithm of a guessed focal length: phones film at equivalents of 24 to 35 mm."""
GUESS_NOISE = 0.02
"""What that sigma weighs against the residuals of all observations, whose errors are not independent [pixels]: where
they say nothing (a bare ball) little moves, elsewhere a guess 25 % off pulls by one percent."""
SHORT = 3
"""Observations of a point up to which pairs of them are summed one by one."""


@dataclass(frozen=True)
class BundleState:
    """Poses and points that are adjusted; `g` groups of `f` cameras."""

    R: Float[Tensor, "g f 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "g f 3"]
    """The object's origin, camera frame."""
    X: Float[Tensor, "n 3"]
    """Points, object frame of their group."""
    log_focal: Float[Tensor, " g"] | None = None
    """Logarithm of the focal length over the camera's; None: the camera's is known."""


@dataclass(frozen=True)
class Problem:
    """What is seen, and what is believed before; `o` observations of `n` points by `g` groups of `f` cameras."""

    camera: Camera
    tracks: Tracks
    """With frames counted over all groups: `group * f + frame`."""
    group: Int64[Tensor, " n"]
    """Of every point."""
    weight: Float[Tensor, " o"]
    """Of every observation."""
    centre: Float[Tensor, "g f 2"]
    """Where the object's origin should be seen [pixels]."""
    centre_sigma: Float[Tensor, "g f"]
    """[pixels]"""
    depth_sigma: float
    """Of the logarithm of the origin's distance about 0."""
    reach: float
    """Radius about the origin in which points are expected."""
    guess: float = 0.0
    """Logarithm of the guessed focal length over the camera's; counts where the scene has one of its own."""


def residuals(problem: Problem, scene: BundleState) -> tuple[Float[Tensor, "o 2"], Float[Tensor, "o 3"]]:
    """Projected minus seen positions [pixels], and the points in the camera frames."""
    R, t = scene.R.flatten(0, 1)[problem.tracks.frame], scene.t.flatten(0, 1)[problem.tracks.frame]
    x = torch.einsum("oij,oj->oi", R, scene.X[problem.tracks.point]) + t
    focal, principal = _focals(problem, scene)[problem.tracks.frame], problem.camera.fx_fy_cx_cy.double()[2:]
    z = x[:, 2:].clamp_min(NEAREST)
    return x[:, :2] / z * focal + principal - problem.tracks.uv, x


def _focals(problem: Problem, scene: BundleState) -> Float[Tensor, "c 2"]:
    """Focal lengths of all cameras [pixels]."""
    g, f = scene.t.shape[:2]
    focal = problem.camera.fx_fy_cx_cy.double()[:2].expand(g * f, 2)
    return focal if scene.log_focal is None else focal * scene.log_focal.exp().repeat_interleave(f)[:, None]


@dataclass(frozen=True)
class _Border:
    """What the logarithm of the focal length adds to the normal equations: one row and column per group."""

    H: Float[Tensor, " g"]
    g: Float[Tensor, " g"]
    cam: Float[Tensor, "c 6"]
    point: Float[Tensor, "n 3"]


@dataclass(frozen=True)
class _System:
    """Normal equations before elimination, and the costs."""

    cost: Float[Tensor, " g"]
    U: Float[Tensor, "c 6 6"]
    V: Float[Tensor, "n 3 3"]
    W: Float[Tensor, "o 6 3"]
    g_cam: Float[Tensor, "c 6"]
    g_point: Float[Tensor, "n 3"]
    border: _Border | None


@dataclass(frozen=True)
class _Layout:
    """Who shares points with whom: what elimination couples."""

    a: Int64[Tensor, " l"]
    """Ordered pairs of observations of one point, for points with few."""
    b: Int64[Tensor, " l"]
    long: Int64[Tensor, " m"]
    """Observations of all other points."""
    column: Int64[Tensor, " n"]
    """Number of those points within their group."""
    columns: int
    """Most of a group."""


def adjust(
    problem: Problem, scene: BundleState, *, steps: int, scale: float, tolerance: float = 1e-4
) -> tuple[BundleState, Float[Tensor, " g"]]:
    """Adjust poses and points of every group; also its final robust cost [pixels^2].

    Args:
        scene: The start.
        steps: Largest number of iterations.
        scale: Residual at which Cauchy's loss starts to forgive [pixels].
        tolerance: A group is done when an iteration lowers its cost by less than this share.
    """
    layout = _layout(problem)

    def linearised(scene: BundleState) -> Linearised:
        system = _linearise(problem, scene, scale)
        return Linearised(system.cost, system)

    def moved(scene: BundleState, system: _System, damping: Tensor) -> BundleState:
        return _moved(scene, *_solve(problem, scene, system, damping, layout))

    choose = partial(_choose, problem)
    damping = Damping(least=1e-10, most=1e8)
    scene, last = minimise(scene, linearised, moved, choose, steps=steps, damping=damping, tolerance=tolerance)
    return scene, last.cost


def _layout(problem: Problem) -> _Layout:
    point = problem.tracks.point
    count = torch.bincount(point, minlength=len(problem.group))
    short, many = count[point] <= SHORT, count > SHORT
    order = torch.nonzero(short)[:, 0][torch.argsort(point[short], stable=True)]
    size = count[point[order]]
    begin = torch.nonzero(torch.cat([size.new_ones(1), point[order].diff()]))[:, 0] if len(order) else size
    begin = torch.repeat_interleave(begin, count[point[order][begin]])
    first = torch.repeat_interleave(torch.arange(len(order)), size)
    offset = torch.arange(len(first)) - (torch.cumsum(size, 0) - size)[first]
    # Points with many observations are numbered within their group.
    column = torch.zeros_like(count)
    n = 0
    for group in range(int(problem.group.max()) + 1 if len(problem.group) else 0):
        mine = many & (problem.group == group)
        column[mine] = torch.arange(int(mine.sum()))
        n = max(n, int(mine.sum()))
    return _Layout(order[first], order[begin[first] + offset], torch.nonzero(~short)[:, 0], column, n)


def _jacobians(
    problem: Problem, scene: BundleState, x: Float[Tensor, "o 3"]
) -> tuple[Float[Tensor, "o 2 6"], Float[Tensor, "o 2 3"]]:
    """Derivatives of the projections by poses (turn, shift) and by points."""
    focal = _focals(problem, scene)[problem.tracks.frame]
    R = scene.R.flatten(0, 1)[problem.tracks.frame]
    z = x[:, 2].clamp_min(NEAREST)
    zero = torch.zeros_like(z)
    J_x = torch.stack(
        [
            torch.stack([focal[:, 0] / z, zero, -focal[:, 0] * x[:, 0] / z**2], -1),
            torch.stack([zero, focal[:, 1] / z, -focal[:, 1] * x[:, 1] / z**2], -1),
        ],
        -2,
    )
    arm = x - scene.t.flatten(0, 1)[problem.tracks.frame]
    J_turn = torch.linalg.cross(arm[:, None].expand_as(J_x), J_x)
    return torch.cat([J_turn, J_x], -1), J_x @ R


def _linearise(problem: Problem, scene: BundleState, scale: float) -> _System:
    g, f = scene.t.shape[:2]
    residual, x = residuals(problem, scene)
    squared = residual.square().sum(-1) / scale**2
    w = problem.weight / (1 + squared)
    J_cam, J_point = _jacobians(problem, scene, x)
    wJ_cam, wJ_point = w[:, None, None] * J_cam, w[:, None, None] * J_point
    n, c = len(scene.X), g * f
    U = torch.zeros(c, 6, 6, dtype=torch.float64).index_add_(0, problem.tracks.frame, wJ_cam.mT @ J_cam)
    V = torch.zeros(n, 3, 3, dtype=torch.float64).index_add_(0, problem.tracks.point, wJ_point.mT @ J_point)
    g_cam = torch.zeros(c, 6, dtype=torch.float64).index_add_(
        0, problem.tracks.frame, (wJ_cam * residual[..., None]).sum(1)
    )
    g_point = torch.zeros(n, 3, dtype=torch.float64).index_add_(
        0, problem.tracks.point, (wJ_point * residual[..., None]).sum(1)
    )
    loss = problem.weight * scale**2 * torch.log1p(squared)
    cost = torch.zeros(g, dtype=torch.float64).index_add_(0, problem.group[problem.tracks.point], loss)
    cost = cost + _camera_priors(problem, scene, U, g_cam)
    # A point that few pixels hold stays within the object.
    hold = _hold(problem, scene)
    V = V + hold[..., None] * torch.eye(3, dtype=torch.float64)
    g_point = g_point + hold * scene.X
    cost = cost.index_add(0, problem.group, hold[:, 0] * scene.X.square().sum(-1))
    known = scene.log_focal is None
    price, border = (0, None) if known else _border(problem, scene, x, residual, wJ_cam, wJ_point, w)
    return _System(cost + price, U, V, wJ_cam.mT @ J_point, g_cam, g_point, border)


def _hold(problem: Problem, scene: BundleState) -> Float[Tensor, "#n 1"]:
    """Weight of the points' distance from the origin: through a longer lens the object is as much smaller."""
    hold = torch.full((1, 1), (NOISE / problem.reach) ** 2, dtype=torch.float64)
    return hold if scene.log_focal is None else hold * (2 * scene.log_focal).exp()[problem.group, None]


def _border(
    problem: Problem, scene: BundleState, x: Tensor, residual: Tensor, wJ_cam: Tensor, wJ_point: Tensor, w: Tensor
) -> tuple[Float[Tensor, " g"], _Border]:
    """The cost of leaving the guessed focal length, and all derivatives by its logarithm."""
    assert scene.log_focal is not None, "a focal length to find"
    g, f = scene.t.shape[:2]
    track, focal = problem.tracks, _focals(problem, scene)
    group = problem.group[track.point]
    J = x[:, :2] / x[:, 2:].clamp_min(NEAREST) * focal[track.frame]
    cam = torch.zeros(g * f, 6, dtype=torch.float64).index_add_(0, track.frame, (wJ_cam * J[..., None]).sum(1))
    held = _hold(problem, scene) * scene.X
    point = held.index_add(0, track.point, (wJ_point * J[..., None]).sum(1))
    none, off = torch.zeros(g, dtype=torch.float64), scene.log_focal - problem.guess
    pull = (GUESS_NOISE / GUESS) ** 2 * none.index_add(0, group, problem.weight)
    shrinks = none.index_add(0, problem.group, (held * scene.X).sum(-1))
    H = (pull + shrinks).index_add(0, group, w * J.square().sum(-1))
    gradient = (pull * off + shrinks).index_add(0, group, w * (J * residual).sum(-1))
    rows, r, J = _origin(problem, scene)
    cam[:, 3:] += torch.einsum("cki,ck->ci", rows[:, :2], J)
    H, gradient = H + J.square().reshape(g, -1).sum(1), gradient + (J * r[:, :2]).reshape(g, -1).sum(1)
    return pull * off.square(), _Border(H, gradient, cam, point)


def _camera_priors(problem: Problem, scene: BundleState, U: Tensor, g_cam: Tensor) -> Float[Tensor, " g"]:
    """Add the priors of the origin's place to the normal equations in place; their cost."""
    rows, r, _ = _origin(problem, scene)
    U[:, 3:, 3:] += rows.mT @ rows
    g_cam[:, 3:] += torch.einsum("cki,ck->ci", rows, r)
    return r.square().sum(-1).reshape(scene.t.shape[:2]).sum(1)


def _origin(problem: Problem, scene: BundleState) -> tuple[Tensor, Tensor, Tensor]:
    """Of the origin's place: derivatives of the residuals by it, residuals, derivatives by the logarithmic focal."""
    focal, principal = _focals(problem, scene), problem.camera.fx_fy_cx_cy.double()[2:]
    t = scene.t.flatten(0, 1)
    z = t[:, 2:].clamp_min(NEAREST)
    off = (t[:, :2] / z * focal + principal - problem.centre.flatten(0, 1)) / problem.centre_sigma.flatten()[:, None]
    far = z.log() / problem.depth_sigma
    rows = torch.zeros(len(t), 3, 3, dtype=torch.float64)
    scaled = focal / z / problem.centre_sigma.flatten()[:, None]
    rows[:, 0, 0], rows[:, 1, 1] = scaled[:, 0], scaled[:, 1]
    rows[:, :2, 2] = -scaled * t[:, :2] / z
    rows[:, 2, 2] = 1 / (z[:, 0] * problem.depth_sigma)
    return NOISE * rows, NOISE * torch.cat([off, far], -1), NOISE * scaled * t[:, :2]


def _solve(
    problem: Problem, scene: BundleState, system: _System, damping: Float[Tensor, " g"], layout: _Layout
) -> tuple[Float[Tensor, "c 6"], Float[Tensor, "n 3"], Float[Tensor, " g"] | None]:
    g, f = scene.t.shape[:2]
    lam_cam, lam_point = damping.repeat_interleave(f)[:, None], damping[problem.group][:, None]
    U, V = (
        H + torch.diag_embed(lam * H.diagonal(dim1=-2, dim2=-1) + 1e-9)
        for H, lam in ((system.U, lam_cam), (system.V, lam_point))
    )
    V_inv = torch.linalg.inv(V)
    Y = system.W @ V_inv[problem.tracks.point]
    a, b, frame = layout.a, layout.b, problem.tracks.frame
    S = torch.zeros(g * f * f, 6, 6, dtype=torch.float64)
    S.index_add_(0, frame[a] * f + frame[b] % f, -(Y[a] @ system.W[b].mT))
    S = S.reshape(g, f, f, 6, 6)
    S.diagonal(dim1=1, dim2=2).add_(U.reshape(g, f, 6, 6).permute(0, 2, 3, 1))
    S = S.permute(0, 1, 3, 2, 4).reshape(g, 6 * f, 6 * f)
    # One product of matrices instead of a sum over pairs: there are as many as a track's length squared.
    half = torch.zeros(g * f, layout.columns, 6, 3, dtype=torch.float64)
    point = problem.tracks.point[layout.long]
    half[frame[layout.long], layout.column[point]] = system.W[layout.long] @ torch.linalg.cholesky(V_inv)[point]
    half = half.transpose(1, 2).reshape(g, 6 * f, 3 * layout.columns)
    S = S - half @ half.mT
    right = -system.g_cam
    right = right.index_add(0, problem.tracks.frame, (Y @ system.g_point[problem.tracks.point][..., None])[..., 0])
    d_cam = torch.linalg.solve(S, right.reshape(g, 6 * f, 1)).reshape(g * f, 6)
    g_point, d_focal = system.g_point, None
    if (border := system.border) is not None:
        V_point = (V_inv @ border.point[..., None])[..., 0]
        side = border.cam.index_add(0, frame, -(Y @ border.point[problem.tracks.point][..., None])[..., 0])
        slope = torch.linalg.solve(S, side.reshape(g, 6 * f, 1)).reshape(g * f, 6)

        def among(cameras: Tensor, points: Tensor) -> Float[Tensor, " g"]:
            return cameras.reshape(g, -1).sum(1).index_add(0, problem.group, points.sum(-1))

        H = (1 + damping) * border.H - among(side * slope, border.point * V_point)
        d_focal = (-border.g - among(side * d_cam, -V_point * g_point)) / H
        d_cam = d_cam - d_focal.repeat_interleave(f)[:, None] * slope
        g_point = g_point + d_focal[problem.group][:, None] * border.point
    back = g_point.index_add(0, problem.tracks.point, (system.W.mT @ d_cam[problem.tracks.frame][..., None])[..., 0])
    return d_cam, -(V_inv @ back[..., None])[..., 0], d_focal


def _moved(scene: BundleState, d_cam: Tensor, d_point: Tensor, d_focal: Tensor | None = None) -> BundleState:
    g, f = scene.t.shape[:2]
    turn = SO3.exp(d_cam[:, :3].clamp(-0.5, 0.5)).matrix().reshape(g, f, 3, 3)
    shift = d_cam[:, 3:].clamp(-0.2, 0.2).reshape(g, f, 3)
    log_focal = None if d_focal is None or scene.log_focal is None else scene.log_focal + d_focal.clamp(-0.1, 0.1)
    return BundleState(turn @ scene.R, scene.t + shift, scene.X + d_point.clamp(-0.2, 0.2), log_focal)


def _choose(problem: Problem, better: Tensor, new: Any, old: Any) -> Any:
    """Per group, the new where it is better: of scenes, and of systems."""
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
    """Of every pose (turn, shift) with the points held and without priors.

    Args:
        precision: Of every observation [1/pixel^2].
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
    """Points closest to all their rays, drawn slightly towards where the front of a ball would be.

    Args:
        tracks: With frames in [0, c).
        R: `R_cam_obj`
        t: The object's origin, camera frame.
        camera: Of all frames.
        radius: Of the ball about the object, over its distance.
    """
    focal, principal = camera.fx_fy_cx_cy.double().split(2)
    xy = (tracks.uv - principal) / focal
    ray = torch.nn.functional.normalize(torch.cat([xy, torch.ones_like(xy[:, :1])], -1), dim=-1)
    R, t = R[tracks.frame], t[tracks.frame]
    middle = (ray * t).sum(-1)
    reach = radius[tracks.frame] * t.norm(dim=-1)
    half2 = reach.square() - t.square().sum(-1) + middle.square()
    half = torch.maximum(half2, (SHALLOW * reach).square()).sqrt()
    front = torch.einsum("oji,oj->oi", R, ray * (middle - FRONT * half)[:, None] - t)
    direction = torch.einsum("oji,oj->oi", R, ray)
    eye = torch.eye(3, dtype=torch.float64)
    across = eye - direction[:, :, None] * direction[:, None]
    centre = -torch.einsum("oji,oj->oi", R, t)
    A = torch.zeros(tracks.n, 3, 3, dtype=torch.float64)
    A.index_add_(0, tracks.point, across + TRUST_FRONT * eye)
    b = torch.zeros(tracks.n, 3, dtype=torch.float64)
    b.index_add_(0, tracks.point, (across @ centre[..., None])[..., 0] + TRUST_FRONT * front)
    return torch.linalg.solve(A, b)
