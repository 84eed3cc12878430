"""Adjustment of the poses of some frames to anchors, silhouettes and the present shape (Levenberg-Marquardt).

The depth of each anchor is one unknown, which the shape's depth along its ray holds softly. Depths are eliminated
(Schur complement), so that poses and depths move together; by turns they would not, because in a few frames a smaller
rotation of a deeper shape explains the same matches (bas-relief ambiguity). The rays through a silhouette's border
touch the shape: the least signed distance along each is zero.

Everything is in the aim frame of `virtual_camera`, in double precision. A step of a pose is a rotation vector about the
object's centre and a shift, both in the aim frame. Residuals are in the pixels of `anchors`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SE3, SO3
from tumble.poses.progressive.anchors import RADIUS_PIXELS, Anchors

DEPTH_SAMPLES = 48
"""Number of samples along a ray among which its intersection with the shape is found."""
BORDER_SAMPLES = 32
"""Number of samples along a ray through the silhouette's border, the closest of which to the shape counts."""
SLOPE_STEP = 0.03
"""Half the distance over which the gradient of the signed distance is measured [object radius]."""
MISSED = 0.02
"""Weight of the depth of an anchor whose ray misses the shape; that of one that meets it is 1 more."""
START_DAMPING = 1e-3
"""Damping of the first step, relative to the diagonal of the normal equations."""
ACCEPTED = 0.2
"""Factor on the damping after a step that lowers the cost."""
REJECTED = 8.0
"""Factor on the damping after any other step."""
MIN_DAMPING = 1e-9
"""Smallest damping; where all frames are free, nothing else holds the orientation of the object frame."""
MAX_DAMPING = 1e4
"""Damping from which steps are negligible."""
TOLERANCE = 1e-4
"""Fraction of the cost: a step that lowers it by less is the last."""

Shape = Callable[[Tensor], Tensor]
"""Function of points [n 3] that returns the signed distance [n]; no gradients are taken."""


@dataclass(frozen=True)
class Priors:
    """What holds poses and depths besides the observations, and how these count."""

    depth: float
    """Standard deviation of an anchor's depth from the shape's [object radius]."""
    centre: float
    """Standard deviation of the object's centre from the middle of its silhouette [object radius]."""
    distance: float
    """Standard deviation of the logarithm of the ratio of neighbouring frames' distances."""
    usual_distance: float
    """Distance of the object at the start [object radius]."""
    any_distance: float
    """Standard deviation of the logarithm of the ratio of a frame's distance to it."""
    turn: float
    """Standard deviation of the rotation between neighbouring frames [radians]."""
    border: float
    """Weight of a ray through the silhouette's border; that of a match is at most 1."""
    scale: float
    """Residual from which an observation counts less (Cauchy) [pixels]."""


@dataclass(frozen=True)
class _Poses:
    """Unknowns of an adjustment."""

    R: Float[Tensor, "t 3 3"]
    """Rotations, object to aim frame."""
    xyz: Float[Tensor, "t 3"]
    """Positions of the object in the aim frame [object radius]."""
    depth: Float[Tensor, "t a"]
    """Depth of every anchor [object radius]."""


@dataclass(frozen=True)
class _Known:
    """What an adjustment does not change."""

    anchors: Anchors
    """Anchors and silhouettes of the frames."""
    shape: Shape
    """Signed distance of the present shape."""
    bound: float
    """Radius of the sphere that contains the object [object radius]."""
    priors: Priors
    """See there."""
    depth: Float[Tensor, "t a"]
    """Depth of the shape along every anchor's ray [object radius]."""
    hold: Float[Tensor, "t a"]
    """Weight of this depth."""


@dataclass(frozen=True)
class _Depths:
    """Equations from which the depths follow when the poses have moved."""

    frames: Int64[Tensor, "t b"]
    """Frames that the anchors of each frame depend on: it and its partners."""
    mixed: Float[Tensor, "t a b 6"]
    """Second derivatives by depth and by poses of these frames."""
    own: Float[Tensor, "t a"]
    """Second derivative by each depth."""
    gradient: Float[Tensor, "t a"]
    """Derivative by each depth."""


@dataclass(frozen=True)
class _Linearised:
    """Normal equations of the poses."""

    cost: Float[Tensor, ""]
    """Robust cost [pixels^2]."""
    hessian: Float[Tensor, "t t 6 6"]
    """Blocks of the matrix, depths eliminated."""
    gradient: Float[Tensor, "t 6"]
    """Right side, negated."""
    depths: _Depths
    """Equations of the depths."""


@torch.no_grad()
def adjusted(
    anchors: Anchors,
    T_aim_obj: SE3,
    free: Bool[Tensor, " t"],
    shape: Shape,
    priors: Priors,
    *,
    bound: float,
    steps: int,
    scales: Sequence[float],
) -> tuple[SE3, float]:
    """Poses of least cost, and the cost per free frame [pixels^2].

    Args:
        anchors: Anchors and silhouettes of the frames.
        T_aim_obj: Initial poses.
        free: Frames whose poses may change.
        shape: Signed distance of the present shape.
        priors: See `Priors`.
        bound: Radius of the sphere that contains the object [object radius].
        steps: Largest number of steps, for each of the scales.
        scales: Values of `Priors.scale`, one after another; for each the rays meet the shape anew.
    """
    cost = 0.0
    for scale in scales:
        R, xyz = SO3.from_wxyz(T_aim_obj.wxyz.double()).matrix(), T_aim_obj.xyz.double()
        depth, hit = _shape_depth(anchors.ray, R, xyz, shape, bound)
        known = _Known(anchors, shape, bound, replace(priors, scale=scale), depth, MISSED + hit)
        poses, cost = _minimise(known, _Poses(R, xyz, depth), free, steps)
        T_aim_obj = SE3(SO3.from_matrix(poses.R).wxyz.float(), poses.xyz.float())
    return T_aim_obj, cost / max(1, int(free.sum()))


def _minimise(known: _Known, poses: _Poses, free: Bool[Tensor, " t"], steps: int) -> tuple[_Poses, float]:
    """Unknowns of least cost, and this cost."""
    damping, current = START_DAMPING, _linearise(known, poses)
    for _ in range(steps):
        moved = _moved(poses, current, free, damping)
        proposed = _linearise(known, moved)
        if not proposed.cost < current.cost:
            damping *= REJECTED
            if damping > MAX_DAMPING:
                break
            continue
        converged = current.cost - proposed.cost < TOLERANCE * current.cost
        poses, current, damping = moved, proposed, max(MIN_DAMPING, ACCEPTED * damping)
        if converged:
            break
    return poses, float(current.cost)


def _moved(poses: _Poses, at: _Linearised, free: Bool[Tensor, " t"], damping: float) -> _Poses:
    """Unknowns after a damped step."""
    index = free.nonzero()[:, 0]
    n = 6 * len(index)
    matrix = at.hessian[index][:, index].transpose(1, 2).reshape(n, n)
    matrix = matrix + torch.diag(damping * matrix.diagonal())
    delta = torch.zeros_like(at.gradient)
    delta[index] = -torch.linalg.solve(matrix, at.gradient[index].reshape(n)).reshape(-1, 6)
    by_pose = torch.einsum("tabx,tbx->ta", at.depths.mixed, delta[at.depths.frames])
    depth = poses.depth - (at.depths.gradient + by_pose) / at.depths.own
    return _Poses(SO3.exp(delta[:, :3]).matrix() @ poses.R, poses.xyz + delta[:, 3:], depth)


# Along rays -----------------------------------------------------------------------------------------------------------


def _shape_depth(
    ray: Float[Tensor, "t a 3"], R: Float[Tensor, "t 3 3"], xyz: Float[Tensor, "t 3"], shape: Shape, bound: float
) -> tuple[Float[Tensor, "t a"], Float[Tensor, "t a"]]:
    """Depth at which rays enter the shape, and 1; where they miss it, the depth of the point closest to it, and 0."""
    depth, distance = _along(ray, R, xyz, shape, bound, DEPTH_SAMPLES)
    inside = distance < 0
    after = inside.float().argmax(-1, keepdim=True)
    before = (after - 1).clamp_min(0)
    outside, within = distance.gather(-1, before), distance.gather(-1, after)
    step = depth.gather(-1, after) - depth.gather(-1, before)
    entry = depth.gather(-1, before) + step * outside / (outside - within).clamp_min(1e-9)
    hit = inside.any(-1, keepdim=True) & (after > 0)
    closest = depth.gather(-1, distance.argmin(-1, keepdim=True))
    return torch.where(hit, entry, closest)[..., 0], hit[..., 0].to(depth)


def _along(
    ray: Float[Tensor, "t a 3"],
    R: Float[Tensor, "t 3 3"],
    xyz: Float[Tensor, "t 3"],
    shape: Shape,
    bound: float,
    n: int,
) -> tuple[Float[Tensor, "t a n"], Float[Tensor, "t a n"]]:
    """Depths of `n` samples along the chord of each ray in the sphere around the object, and signed distances there."""
    squared = ray.square().sum(-1)
    closest = (ray * xyz[:, None]).sum(-1) / squared
    miss = (closest[..., None] * ray - xyz[:, None]).square().sum(-1)
    half = ((bound**2 - miss).clamp_min(1e-6) / squared).sqrt()
    ticks = (torch.arange(n).to(ray) + 0.5) / n * 2 - 1
    depth = closest[..., None] + half[..., None] * ticks
    x_obj = (depth[..., None] * ray[:, :, None] - xyz[:, None, None]) @ R[:, None]
    return depth, shape(x_obj.reshape(-1, 3).float()).reshape(depth.shape).to(depth)


# Normal equations -----------------------------------------------------------------------------------------------------


def _linearise(known: _Known, poses: _Poses) -> _Linearised:
    """Normal equations of all terms."""
    t = len(poses.R)
    match_cost, depths, blocks, gradient = _match_terms(known, poses)
    hessian = poses.R.new_zeros(t, t, 6, 6)
    b = depths.frames.shape[1]
    rows, columns = depths.frames[:, :, None].expand(t, b, b), depths.frames[:, None].expand(t, b, b)
    hessian.index_put_((rows, columns), blocks, accumulate=True)
    total = poses.R.new_zeros(t, 6).index_put_((depths.frames,), gradient, accumulate=True)
    border_cost, own, own_gradient = _border_terms(known, poses)
    every = torch.arange(t)
    hessian[every, every] += own
    prior_cost, held, held_gradient = _prior_terms(known.priors, poses)
    cost = match_cost + border_cost + prior_cost
    return _Linearised(cost, hessian + held, total + own_gradient + held_gradient, depths)


def _match_terms(known: _Known, poses: _Poses) -> tuple[Tensor, _Depths, Tensor, Tensor]:
    """Cost and depths of the anchors; per frame, blocks `[t b b 6 6]` and gradient `[t b 6]` of what it depends on."""
    anchors, depth = known.anchors, poses.depth
    t, k = anchors.partner.shape
    residual, project, R_j_i, v = _residuals(anchors, poses)
    cost, w = _robust(residual.square().sum(-1), anchors.weight, known.priors.scale)
    by_i = project @ R_j_i[:, None]
    turned = torch.einsum("tkxy,tay->takx", R_j_i, v)
    J = torch.zeros(t, v.shape[1], k, 2, 2, 6).to(v)
    J[..., 0, :3], J[..., 0, 3:] = by_i @ _skew(v)[:, :, None], -by_i
    J[..., 1, :3], J[..., 1, 3:] = -project @ _skew(turned), project
    J_depth = (by_i @ anchors.ray[:, :, None, :, None])[..., 0]
    wJ = w[..., None, None, None] * J
    pairs = torch.einsum("takrux,takrvy->tkuvxy", wJ, J)
    parts = torch.einsum("takrux,takr->tkux", wJ, residual)
    mixed = torch.einsum("takrux,takr->takux", wJ, J_depth)
    blocks, gradient = pairs.new_zeros(t, 1 + k, 1 + k, 6, 6), parts.new_zeros(t, 1 + k, 6)
    index = torch.arange(1, 1 + k)
    blocks[:, 0, 0], blocks[:, index, index] = pairs[:, :, 0, 0].sum(1), pairs[:, :, 1, 1]
    blocks[:, 0, 1:], blocks[:, 1:, 0] = pairs[:, :, 0, 1], pairs[:, :, 1, 0]
    gradient[:, 0], gradient[:, 1:] = parts[:, :, 0].sum(1), parts[:, :, 1]
    c = torch.cat([mixed[..., 0, :].sum(2, keepdim=True), mixed[..., 1, :]], 2)
    # The shape's depth holds robustly as well: the shape may be wrong.
    off = (depth - known.depth) / known.priors.depth
    hold = known.hold / (1 + off.square())
    h = (w[..., None] * J_depth.square()).sum((2, 3)) + hold / known.priors.depth**2
    g = (w[..., None] * J_depth * residual).sum((2, 3)) + hold * off / known.priors.depth
    blocks = blocks - torch.einsum("tabx,tacy->tbcxy", c / h[..., None, None], c)
    gradient = gradient - torch.einsum("tabx,ta->tbx", c, g / h)
    cost = cost + (known.hold * torch.log1p(off.square())).sum()
    frames = torch.cat([torch.arange(t)[:, None], anchors.partner], 1)
    return cost, _Depths(frames, c, h, g), blocks, gradient


def _residuals(anchors: Anchors, poses: _Poses) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals `[t a k 2]`, their derivatives by points, `R_j_i [t k 3 3]`, and points about the centre `[t a 3]`."""
    R_j_i = poses.R[anchors.partner] @ poses.R[:, None].mT
    v = poses.depth[..., None] * anchors.ray - poses.xyz[:, None]
    x, y, z = (torch.einsum("tkxy,tay->takx", R_j_i, v) + poses.xyz[anchors.partner][:, None]).unbind(-1)
    # A point behind the camera would change its sign.
    z = z.clamp_min(0.1)
    residual = anchors.focal * (torch.stack([x / z, y / z], -1) - anchors.seen)
    zero = torch.zeros_like(z)
    project = torch.stack([1 / z, zero, -x / z.square(), zero, 1 / z, -y / z.square()], -1).unflatten(-1, (2, 3))
    return residual, anchors.focal * project, R_j_i, v


def _border_terms(known: _Known, poses: _Poses) -> tuple[Tensor, Tensor, Tensor]:
    """Cost, blocks `[t 6 6]` and gradient `[t 6]` of the rays through the silhouettes' borders."""
    ray, weight = known.anchors.border, known.priors.border * known.anchors.border_weight
    depth, distance = _along(ray, poses.R, poses.xyz, known.shape, known.bound, BORDER_SAMPLES)
    least, at = distance.min(-1)
    y = depth.gather(-1, at[..., None]) * ray - poses.xyz[:, None]
    x_obj = (y @ poses.R).float().reshape(-1, 3)
    shifts = SLOPE_STEP * torch.eye(3)
    around = known.shape((x_obj + torch.cat([shifts, -shifts])[:, None]).reshape(-1, 3)).reshape(2, 3, -1)
    slope = ((around[0] - around[1]) / (2 * SLOPE_STEP)).T.reshape(ray.shape).to(ray)
    residual = RADIUS_PIXELS * least
    cost, w = _robust(residual.square(), weight, known.priors.scale)
    n_aim = RADIUS_PIXELS * slope @ poses.R.mT
    J = torch.cat([torch.linalg.cross(n_aim, y), -n_aim], -1)
    return cost, torch.einsum("tc,tcx,tcy->txy", w, J, J), torch.einsum("tc,tcx,tc->tx", w, J, residual)


def _prior_terms(priors: Priors, poses: _Poses) -> tuple[Tensor, Tensor, Tensor]:
    """Cost, blocks `[t t 6 6]` and gradient `[t 6]` of centres, distances, and turns between neighbours in the list."""
    R, xyz = poses.R, poses.xyz
    t = len(R)
    hessian, gradient = R.new_zeros(t, t, 6, 6), R.new_zeros(t, 6)
    own = hessian.diagonal(dim1=0, dim2=1)
    centre = xyz[:, :2] / priors.centre
    own[3, 3] += priors.centre**-2
    own[4, 4] += priors.centre**-2
    gradient[:, 3:5] += centre / priors.centre
    far = (xyz[:, 2] / priors.usual_distance).log() / priors.any_distance
    slope = 1 / (priors.any_distance * xyz[:, 2])
    own[5, 5] += slope.square()
    gradient[:, 5] += far * slope
    turn = SO3.from_matrix(R[1:] @ R[:-1].mT).log() / priors.turn
    nearer = (xyz[1:, 2] / xyz[:-1, 2]).log() / priors.distance
    # Derivatives by the later frame of each pair, and by the earlier one; those of turns hold for small ones.
    later = torch.full((t - 1, 4), 1 / priors.turn).to(R)
    earlier = -later
    later[:, 3], earlier[:, 3] = 1 / (priors.distance * xyz[1:, 2]), -1 / (priors.distance * xyz[:-1, 2])
    residual = torch.cat([turn, nearer[:, None]], 1)
    a, b = torch.arange(t - 1), torch.arange(1, t)
    for column, axis in enumerate((0, 1, 2, 5)):
        first, second = earlier[:, column], later[:, column]
        hessian[a, a, axis, axis] += first.square()
        hessian[b, b, axis, axis] += second.square()
        hessian[a, b, axis, axis] += first * second
        hessian[b, a, axis, axis] += first * second
        gradient[a, axis] += first * residual[:, column]
        gradient[b, axis] += second * residual[:, column]
    return centre.square().sum() + far.square().sum() + residual.square().sum(), hessian, gradient


def _robust(squared: Tensor, weight: Tensor, scale: float) -> tuple[Float[Tensor, ""], Tensor]:
    """Sum of Cauchy's loss of squared residuals, and the weights of the residuals in the normal equations."""
    ratio = squared / scale**2
    return (weight * scale**2 * torch.log1p(ratio)).sum(), weight / (1 + ratio)


def _skew(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Matrix of the cross product with `v`."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
