"""Adjustment of the poses of some frames to anchors, silhouettes and the present shape (Levenberg-Marquardt).

An *anchor* is a pixel of one frame with its matched positions in the frames around it. Its depth is one unknown, which
the shape's depth along the pixel's ray holds softly; depths are eliminated (Schur complement), so that poses and depths
move together. By turns they would not: in a few frames a smaller rotation of a deeper shape explains the same matches
(bas-relief ambiguity), and neither changes while the other is held. The rays through the silhouette's border touch the
shape: the least signed distance along each is zero.

Everything is in the aim frame of `virtual_camera`. Residuals are in pixels of a frame in which the object's radius is
`RADIUS_PIXELS`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SE3, SO3
from tumble.scene import BACKGROUND, OBJECT, Capture, Match

from tumble.poses.progressive.virtual_camera import FILL, Aim, camera_to_aim

RADIUS_PIXELS = 50.0
"""Radius of the object in the frame whose pixels are the unit of residuals [pixels]."""
ANCHORS = 100
"""Number of anchors per frame."""
NEAREST = 0.012
"""Distance from an anchor to the nearest match from which its own match is taken [image widths]."""
MIN_MATCHES = 20
"""Smallest number of matches of a pair of frames that is used: of fewer, most are wrong."""
BORDER = 48
"""Number of rays through the silhouette's border per frame."""

Shape = Callable[[Tensor], Tensor]
"""Function of points [n 3] that returns the signed distance [n], without gradients."""


@dataclass(frozen=True)
class Anchors:
    """Anchors and silhouettes of `t` frames."""

    ray: Float[Tensor, "t a 3"]
    """Ray of each anchor in its own frame, aim frame, with depth 1."""
    partner: Int64[Tensor, "t k"]
    """Frames in which the anchors of a frame are observed; the frame itself where there are fewer."""
    seen: Float[Tensor, "t a k 2"]
    """Positions x / z, y / z in the partners' aim frames."""
    weight: Float[Tensor, "t a k"]
    """Weight of each observation, 0 where there is none."""
    border: Float[Tensor, "t c 3"]
    """Rays through the silhouette's border, aim frame, with depth 1."""
    border_weight: Float[Tensor, "t c"]
    """Weight of each ray, 0 where there is none."""
    focal: float
    """Focal length at which the largest silhouette's radius is `RADIUS_PIXELS` [pixels]."""

    def select(self, frames: Sequence[int]) -> "Anchors":
        """Some frames, with what they observe in each other."""
        index = torch.tensor(frames)
        place = torch.full((len(self.ray),), -1)
        place[index] = torch.arange(len(index))
        partner = place[self.partner[index]]
        weight = self.weight[index] * (partner >= 0)[:, None]
        own = torch.arange(len(index))[:, None].expand_as(partner)
        partner = torch.where(partner >= 0, partner, own)
        picked = (getattr(self, name)[index] for name in ("ray", "seen", "border", "border_weight"))
        ray, seen, border, border_weight = picked
        return Anchors(ray, partner, seen, weight, border, border_weight, self.focal)


def gather(capture: Capture, aim: Aim, matches: Sequence[Match]) -> Anchors:
    """Anchors and silhouettes' borders of all frames."""
    n = len(capture)
    of_frame: list[list[Match]] = [[] for _ in range(n)]
    for match in matches:
        if len(match) >= MIN_MATCHES:
            of_frame[match.i].append(match)
            of_frame[match.j].append(match.reversed())
    k = max(1, max(len(found) for found in of_frame))
    ray = torch.zeros(n, ANCHORS, 3, dtype=torch.float64)
    ray[..., 2] = 1
    partner = torch.arange(n)[:, None].repeat(1, k)
    seen, weight = torch.zeros(n, ANCHORS, k, 2, dtype=torch.float64), torch.zeros(n, ANCHORS, k, dtype=torch.float64)
    border, border_weight = ray[:, :BORDER].clone(), weight[:, :BORDER, 0].clone()
    for frame in range(n):
        edge = _border(capture, frame)
        border[frame, : len(edge)] = _rays(capture, aim, frame, edge)
        border_weight[frame, : len(edge)] = 1
        if not of_frame[frame]:
            continue
        all_uv = torch.cat([match.uv_i for match in of_frame[frame]])
        uv = _spread(all_uv, ANCHORS)
        ray[frame, : len(uv)] = _rays(capture, aim, frame, uv)
        for slot, match in enumerate(of_frame[frame]):
            distance, nearest = torch.cdist(uv, match.uv_i).min(1)
            uv_j = match.uv_j[nearest] + uv - match.uv_i[nearest]
            seen[frame, : len(uv), slot] = _rays(capture, aim, match.j, uv_j)[:, :2]
            near = distance < NEAREST * capture.camera.width
            weight[frame, : len(uv), slot] = (near * match.confidence[nearest]).double()
            partner[frame, slot] = match.j
    focal = RADIUS_PIXELS * float(aim.camera.fx_fy_cx_cy[0]) / (0.5 * FILL * aim.camera.width)
    return Anchors(ray, partner, seen, weight, border, border_weight, focal)


def _rays(capture: Capture, aim: Aim, frame: int, uv: Tensor) -> Float[Tensor, "m 3"]:
    """Rays with depth 1 in the aim frame through positions of a frame [pixels]."""
    uv_aim = camera_to_aim(aim, capture.camera, frame, uv)
    return aim.camera.unproject(uv_aim, torch.ones_like(uv[:, 0])).double()


def _spread(uv: Float[Tensor, "m 2"], n: int) -> Float[Tensor, "b 2"]:
    """At most `n` of some positions, each of which is far from those chosen before (farthest point sampling)."""
    distance = torch.full((len(uv),), torch.inf)
    chosen = [0]
    while len(chosen) < min(n, len(uv)):
        distance = torch.minimum(distance, (uv - uv[chosen[-1]]).square().sum(-1))
        chosen.append(int(distance.argmax()))
    return uv[chosen]


def _border(capture: Capture, frame: int) -> Float[Tensor, "c 2"]:
    """Positions between neighbouring pixels of object and background, evenly along the border [pixels]."""
    mask = capture.masks[frame]
    found = []
    for axis, shift in ((0, (0.0, 0.5)), (1, (0.5, 0.0))):
        a, b = mask.narrow(axis, 0, mask.shape[axis] - 1), mask.narrow(axis, 1, mask.shape[axis] - 1)
        changes = ((a == OBJECT) & (b == BACKGROUND)) | ((a == BACKGROUND) & (b == OBJECT))
        found.append(changes.nonzero().flip(-1) + 0.5 + torch.tensor(shift))
    uv = torch.cat(found).to(capture.camera.fx_fy_cx_cy)
    return _spread(uv, BORDER) if len(uv) else uv


@dataclass(frozen=True)
class Priors:
    """What holds poses and depths besides the observations."""

    depth: float
    """Standard deviation of an anchor's depth from the shape's [object radius]."""
    centre: float
    """Standard deviation of the object's centre from the middle of its silhouette [object radius]."""
    distance: float
    """Standard deviation of the logarithm of the distance between neighbouring frames."""
    turn: float
    """Standard deviation of the rotation between neighbouring frames [radians]."""
    usual_distance: float
    """Distance of the object at the start [object radius]."""
    any_distance: float
    """Standard deviation of the logarithm of the ratio of a frame's distance to it."""
    border: float
    """Weight of the silhouette's rays; that of a match is at most 1."""
    scale: float
    """Residual from which an observation counts less (Cauchy) [pixels]."""


@dataclass(frozen=True)
class Poses:
    """Unknowns of an adjustment."""

    R: Float[Tensor, "t 3 3"]
    """Rotations, object to aim frame."""
    xyz: Float[Tensor, "t 3"]
    """Positions of the object in the aim frame [object radius]."""
    depth: Float[Tensor, "t a"]
    """Depth of every anchor [object radius]."""

    @property
    def T_aim_obj(self) -> SE3:
        """Poses, float32."""
        return SE3(SO3.from_matrix(self.R).wxyz.float(), self.xyz.float())


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
    """Poses of least cost, and the cost per free frame [pixels^2]; the shape is met anew for each of the `scales`."""
    cost = 0.0
    for scale in scales:
        poses, hit = start(anchors, T_aim_obj, shape, bound=bound)
        sharper = replace(priors, scale=scale)
        poses, cost = adjust(anchors, poses, poses.depth, hit, free, shape, sharper, bound=bound, steps=steps)
        T_aim_obj = poses.T_aim_obj
    return T_aim_obj, cost


def start(anchors: Anchors, T_aim_obj: SE3, shape: Shape, *, bound: float) -> tuple[Poses, Float[Tensor, "t a"]]:
    """Unknowns at given poses, and the weights of the shape's depths: 0 where a ray misses it."""
    R = SO3.from_wxyz(T_aim_obj.wxyz.double()).matrix()
    xyz = T_aim_obj.xyz.double()
    depth, hit = shape_depth(anchors.ray, R, xyz, shape, bound=bound)
    return Poses(R, xyz, depth), hit


@torch.no_grad()
def shape_depth(
    ray: Float[Tensor, "t a 3"], R: Float[Tensor, "t 3 3"], xyz: Float[Tensor, "t 3"], shape: Shape, *, bound: float
) -> tuple[Float[Tensor, "t a"], Float[Tensor, "t a"]]:
    """Depth at which rays meet the shape, and 1 where they do; elsewhere the depth of the point closest to it."""
    depth, distance = _along(ray, R, xyz, shape, bound=bound, n=48)
    inside = distance < 0
    first = inside.float().argmax(-1)
    hit = inside.any(-1) & (first > 0)
    before = (first - 1).clamp_min(0)
    pick = lambda values, index: values.gather(-1, index[..., None])[..., 0]  # noqa: E731
    d0, d1, f0, f1 = pick(depth, before), pick(depth, first), pick(distance, before), pick(distance, first)
    crossing = d0 + (d1 - d0) * f0 / (f0 - f1).clamp_min(1e-9)
    closest = pick(depth, distance.argmin(-1))
    return torch.where(hit, crossing, closest), hit.double()


def _along(
    ray: Tensor, R: Tensor, xyz: Tensor, shape: Shape, *, bound: float, n: int
) -> tuple[Float[Tensor, "t a n"], Float[Tensor, "t a n"]]:
    """Depths of samples along rays inside the sphere around the object, and signed distances there."""
    length = ray.norm(dim=-1)
    closest = (ray * xyz[:, None]).sum(-1) / length.square()
    half = (bound**2 - (closest[..., None] * ray - xyz[:, None]).square().sum(-1)).clamp_min(1e-6).sqrt() / length
    ticks = (torch.arange(n, dtype=ray.dtype) + 0.5) / n * 2 - 1
    depth = closest[..., None] + half[..., None] * ticks
    x_obj = (depth[..., None] * ray[:, :, None] - xyz[:, None, None]) @ R[:, None]
    return depth, shape(x_obj.reshape(-1, 3).float()).reshape(depth.shape).to(depth)


def adjust(
    anchors: Anchors,
    poses: Poses,
    target: Float[Tensor, "t a"],
    hit: Float[Tensor, "t a"],
    free: Bool[Tensor, " t"],
    shape: Shape,
    priors: Priors,
    *,
    bound: float,
    steps: int,
) -> tuple[Poses, float]:
    """Poses of the free frames and depths of least cost, and the cost per free frame [pixels^2].

    Args:
        anchors: Anchors and silhouettes of the frames.
        poses: Where to start.
        target: Depth of the shape along each anchor's ray.
        hit: Weight of that depth.
        free: Frames whose poses may change.
        shape: Signed distance of the shape.
        priors: See `Priors`.
        bound: Radius of the sphere around the object.
        steps: Number of steps.
    """
    lam = 1e-3
    terms = _linearise(anchors, poses, target, hit, shape, priors, bound)
    for _ in range(steps):
        moved = _moved(poses, terms, free, lam)
        new = _linearise(anchors, moved, target, hit, shape, priors, bound)
        if new.cost < terms.cost:
            done = terms.cost - new.cost < 1e-4 * terms.cost
            poses, terms, lam = moved, new, 0.2 * lam
            if done:
                break
        else:
            lam *= 8
            if lam > 1e4:
                break
    return poses, terms.cost / max(1, int(free.sum()))


@dataclass(frozen=True)
class _Terms:
    """Normal equations, with depths still in them."""

    cost: float
    frames: Int64[Tensor, "t b"]
    """Frames of each block: the anchors' own, then their partners."""
    blocks: Float[Tensor, "t b b 6 6"]
    gradient: Float[Tensor, "t b 6"]
    depth_depth: Float[Tensor, "t a"]
    depth_gradient: Float[Tensor, "t a"]
    depth_pose: Float[Tensor, "t a b 6"]
    own: Float[Tensor, "t 6 6"]
    own_gradient: Float[Tensor, "t 6"]
    chain: Float[Tensor, "t t"]
    chain_gradient: Float[Tensor, " t"]
    turns: Float[Tensor, "t t"]
    turns_gradient: Float[Tensor, "t 3"]


def _skew(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Matrix of the cross product with `v`."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _linearise(
    anchors: Anchors, poses: Poses, target: Tensor, hit: Tensor, shape: Shape, priors: Priors, bound: float
) -> _Terms:
    R, xyz, depth = poses.R, poses.xyz, poses.depth
    partner = anchors.partner
    t, a, k = anchors.weight.shape
    focal = anchors.focal
    v = depth[..., None] * anchors.ray - xyz[:, None]
    R_j_i = R[partner] @ R[:, None].mT
    turned = torch.einsum("tkxy,tay->takx", R_j_i, v)
    z = turned + xyz[partner][:, None]
    uv = z[..., :2] / z[..., 2:]
    residual = focal * (uv - anchors.seen)
    inverse = focal / z[..., 2]
    project = torch.zeros(t, a, k, 2, 3, dtype=R.dtype)
    project[..., 0, 0] = project[..., 1, 1] = inverse
    project[..., 2] = -inverse[..., None] * uv
    squared = residual.square().sum(-1) / priors.scale**2
    cost = (anchors.weight * priors.scale**2 * torch.log1p(squared)).sum()
    w = anchors.weight / (1 + squared)
    by_i = project @ R_j_i[:, None]
    J_i = torch.cat([by_i @ _skew(v)[:, :, None], -by_i], -1)
    J_j = torch.cat([-project @ _skew(turned), project], -1)
    J_s = (by_i @ anchors.ray[:, :, None, :, None])[..., 0]
    wJ_i, wJ_j = w[..., None, None] * J_i, w[..., None, None] * J_j
    blocks = torch.zeros(t, 1 + k, 1 + k, 6, 6, dtype=R.dtype)
    gradient = torch.zeros(t, 1 + k, 6, dtype=R.dtype)
    blocks[:, 0, 0] = torch.einsum("takrx,takry->txy", wJ_i, J_i)
    cross = torch.einsum("takrx,takry->tkxy", wJ_i, J_j)
    blocks[:, 0, 1:], blocks[:, 1:, 0] = cross, cross.mT
    index = torch.arange(1, 1 + k)
    blocks[:, index, index] = torch.einsum("takrx,takry->tkxy", wJ_j, J_j)
    gradient[:, 0] = torch.einsum("takrx,takr->tx", wJ_i, residual)
    gradient[:, 1:] = torch.einsum("takrx,takr->tkx", wJ_j, residual)
    depth_pose = torch.zeros(t, a, 1 + k, 6, dtype=R.dtype)
    depth_pose[:, :, 0] = torch.einsum("takrx,takr->tax", wJ_i, J_s)
    depth_pose[:, :, 1:] = torch.einsum("takrx,takr->takx", wJ_j, J_s)
    # The shape's depth, robust as well: the shape may be wrong.
    off = (depth - target) / priors.depth
    hold = (0.02 + hit) / (1 + off.square())
    cost = cost + ((0.02 + hit) * torch.log1p(off.square())).sum()
    depth_depth = torch.einsum("tak,takr,takr->ta", w, J_s, J_s) + hold / priors.depth**2
    depth_gradient = torch.einsum("tak,takr,takr->ta", w, J_s, residual) + hold * off / priors.depth
    own, own_gradient, own_cost = _border_terms(anchors, poses, shape, priors, bound)
    centre = xyz[:, :2] / priors.centre
    own[:, 3, 3] += 1 / priors.centre**2
    own[:, 4, 4] += 1 / priors.centre**2
    own_gradient[:, 3:5] += centre / priors.centre
    cost = cost + own_cost + centre.square().sum()
    # Neighbours in the selection have about the same distance.
    chain = torch.zeros(t, t, dtype=R.dtype)
    step = (xyz[1:, 2] / xyz[:-1, 2]).log() / priors.distance
    rows = torch.arange(t - 1)
    g = 1 / (priors.distance * xyz[:, 2])
    chain[rows, rows] += g[:-1].square()
    chain[rows + 1, rows + 1] += g[1:].square()
    chain[rows, rows + 1] -= g[:-1] * g[1:]
    chain[rows + 1, rows] -= g[:-1] * g[1:]
    chain_gradient = torch.zeros(t, dtype=R.dtype)
    chain_gradient[1:] += step * g[1:]
    chain_gradient[:-1] -= step * g[:-1]
    cost = cost + step.square().sum()
    turn = SO3.from_matrix(R[1:] @ R[:-1].mT).log() / priors.turn
    turns, turns_gradient = torch.zeros_like(chain), torch.zeros(t, 3, dtype=R.dtype)
    turns[rows, rows] += priors.turn**-2
    turns[rows + 1, rows + 1] += priors.turn**-2
    turns[rows, rows + 1] -= priors.turn**-2
    turns[rows + 1, rows] -= priors.turn**-2
    turns_gradient[1:] += turn / priors.turn
    turns_gradient[:-1] -= turn / priors.turn
    cost = cost + turn.square().sum()
    far = (xyz[:, 2] / priors.usual_distance).log() / priors.any_distance
    g = 1 / (priors.any_distance * xyz[:, 2])
    own[:, 5, 5] += g.square()
    own_gradient[:, 5] += far * g
    cost = cost + far.square().sum()
    frames = torch.cat([torch.arange(t)[:, None], partner], 1)
    return _Terms(
        float(cost), frames, blocks, gradient, depth_depth, depth_gradient, depth_pose, own, own_gradient, chain,
        chain_gradient, turns, turns_gradient,
    )


@torch.no_grad()
def _border_terms(
    anchors: Anchors, poses: Poses, shape: Shape, priors: Priors, bound: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Normal equations of the rays through the silhouettes' borders, whose least signed distance is zero."""
    t = len(poses.R)
    zero = torch.zeros((), dtype=poses.R.dtype)
    if priors.border == 0:
        return zero.expand(t, 6, 6).clone(), zero.expand(t, 6).clone(), zero
    ray = anchors.border
    depth, distance = _along(ray, poses.R, poses.xyz, shape, bound=bound, n=32)
    least, at = distance.min(-1)
    y = depth.gather(-1, at[..., None]) * ray - poses.xyz[:, None]
    x_obj = (y @ poses.R).float().reshape(-1, 3)
    h = 0.03
    shifts = h * torch.eye(3)
    around = shape(torch.cat([x_obj + s for s in shifts] + [x_obj - s for s in shifts])).reshape(2, 3, -1)
    slope = ((around[0] - around[1]) / (2 * h)).T.reshape(*least.shape, 3).to(least)
    residual = RADIUS_PIXELS * least
    squared = residual.square() / priors.scale**2
    weight = priors.border * anchors.border_weight
    cost = (weight * priors.scale**2 * torch.log1p(squared)).sum()
    w = weight / (1 + squared)
    n_aim = RADIUS_PIXELS * slope @ poses.R.mT
    J = torch.cat([torch.linalg.cross(n_aim, y), -n_aim], -1)
    return torch.einsum("tc,tcx,tcy->txy", w, J, J), torch.einsum("tc,tcx,tc->tx", w, J, residual), cost


def _moved(poses: Poses, terms: _Terms, free: Bool[Tensor, " t"], lam: float) -> Poses:
    """Poses and depths after a damped step."""
    t = len(free)
    h = terms.depth_depth * (1 + lam) + 1e-9
    c = terms.depth_pose
    blocks = terms.blocks - torch.einsum("tabx,tacy->tbcxy", c / h[..., None, None], c)
    gradient = terms.gradient - torch.einsum("tabx,ta->tbx", c, terms.depth_gradient / h)
    H, g = torch.zeros(t, t, 6, 6, dtype=h.dtype), torch.zeros(t, 6, dtype=h.dtype)
    frames = terms.frames
    b = frames.shape[1]
    rows, columns = frames[:, :, None].expand(t, b, b), frames[:, None].expand(t, b, b)
    H.index_put_((rows, columns), blocks, accumulate=True)
    g.index_put_((frames,), gradient, accumulate=True)
    every = torch.arange(t)
    H[every, every] += terms.own
    H[:, :, 5, 5] += terms.chain
    for axis in range(3):
        H[:, :, axis, axis] += terms.turns
    g[:, :3] += terms.turns_gradient
    g += terms.own_gradient
    g[:, 5] += terms.chain_gradient
    index = free.nonzero()[:, 0]
    m = len(index)
    matrix = H[index][:, index].transpose(1, 2).reshape(6 * m, 6 * m)
    matrix = matrix + torch.diag(lam * matrix.diagonal() + 1e-6)
    delta = torch.zeros(t, 6, dtype=h.dtype)
    delta[index] = -torch.linalg.solve(matrix, g[index].reshape(-1)).reshape(m, 6)
    depth_step = -(terms.depth_gradient + torch.einsum("tabx,tbx->ta", c, delta[frames])) / h
    R = SO3.exp(delta[:, :3]).matrix() @ poses.R
    return replace(poses, R=R, xyz=poses.xyz + delta[:, 3:], depth=poses.depth + depth_step)
