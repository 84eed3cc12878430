"""How the object turned between two frames, from pixel pairs and silhouettes: fits with four degrees of freedom.

The object's centre is on the ray through the middle of its silhouette, so a motion has a rotation and a ratio of
distances. A matched pixel's point lies on its ray inside the ball that the silhouette fills, in its front half;
moved to the other frame that *segment* projects to a short line, and the residual is the way from the matched pixel to
it. An epipolar line would be endless: at the small field of view of an object in the hand it lets "no rotation" explain
everything (method, section 10.1).

Two rotations can explain two nearly affine pictures equally well (Necker's reversal): the best fit that is clearly
another one is kept beside the best as its *rival*.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SO3, Damping, Linearised, minimise, rowwise
from tumble.scene import BACKGROUND, Camera, Capture, Match

ROUNDNESS = 1.25
"""Radius of the ball over that of the disc with the silhouette's area: few objects are round."""
LEAST_DEPTH = 0.15
"""Half length of the shortest segment [radius of the ball]."""
BEHIND = -0.5
"""Where the far end is, from the middle of the chord, over half its length: all in the front half. Two views tell the
angle only up to the object's depth (bas-relief), and this belief is what keeps it near; with points allowed behind the
middle, half of all fits were mirror images."""
JUMP = 0.2
"""Change against the frames around from which a mask has failed [logarithm of the radius; half the box's diagonal]."""
LEAST = 8
"""Matches from which a pair is worth fitting."""
SOFT = 2.0
"""Residual from which the loss grows linearly [pixels]."""
DEPTH_WEIGHT = 30.0
"""Of the logarithm of the ratio of distances: an object in the hand stays about where it is [pixels]."""
INLIER = 2.0
"""Residual up to which a match counts as explained [pixels]."""
APART = 0.12
"""Angle between two fits from which they are two answers [radians]."""


@dataclass(frozen=True)
class Silhouettes:
    """Where the object stands in every frame, from its mask."""

    centre: Float[Tensor, "t 2"]
    """Middle of the bounding box [pixels]."""
    radius: Float[Tensor, " t"]
    """Of the ball about the object, over its distance, positive."""
    extent: Float[Tensor, " t"]
    """Half the diagonal of the bounding box [pixels]."""
    visible: Bool[Tensor, " t"]
    """Whether the mask has any pixel of it."""


@dataclass(frozen=True)
class Relative:
    """Motions between pairs of frames; `p` pairs."""

    i: Int64[Tensor, " p"]
    j: Int64[Tensor, " p"]
    R_j_i: Float[Tensor, "p 3 3"]
    """From the camera frame of frame i to that of frame j, about the object's centre."""
    log_depth: Float[Tensor, " p"]
    """Logarithm of distance in j over distance in i."""
    inliers: Float[Tensor, " p"]
    """Number of matches within `INLIER`."""
    cost: Float[Tensor, " p"]
    """Mean robust loss per match [pixels^2]."""
    information: Float[Tensor, "p 3 3"]
    """Of the rotation, camera frame of j, from matches of one pixel of noise [1 / radian^2]."""
    rival: Float[Tensor, "p 3 3"]
    """The next best other rotation; `R_j_i` itself where there is none."""
    rival_cost: Float[Tensor, " p"]

    def __len__(self) -> int:
        return len(self.i)

    def select(self, keep: Tensor) -> "Relative":
        """Some of the pairs, by index or mask."""
        return Relative(**{name: value[keep] for name, value in vars(self).items()})


@dataclass(frozen=True)
class _Problem:
    """Padded matches of several pairs as points and targets."""

    near: Float[Tensor, "p m 3"]
    """Front end of each segment, from the object's centre in frame i [distance in i]."""
    far: Float[Tensor, "p m 3"]
    target: Float[Tensor, "p m 2"]
    """Matched position in j [pixels]."""
    weight: Float[Tensor, "p m"]
    """0 for padding."""
    centre_j: Float[Tensor, "p 3"]
    """The object's centre in frame j at depth 1."""
    focal: Float[Tensor, "2"]
    principal: Float[Tensor, "2"]

    def select(self, pairs: Tensor, matches: slice = slice(None)) -> "_Problem":
        near, far, target, weight = (x[pairs][:, matches] for x in (self.near, self.far, self.target, self.weight))
        return _Problem(near, far, target, weight, self.centre_j[pairs], self.focal, self.principal)


def silhouettes(capture: Capture) -> Silhouettes:
    """Boxes and sizes of all masks; unknown pixels count as object, which is what a hand hides.

    Where there is no object, the middle of the picture and the usual size stand.
    """
    camera = capture.camera
    centres, radii, extents, visible = [], [], [], []
    for mask in capture.masks != BACKGROUND:
        rows, columns = torch.nonzero(mask.any(1))[:, 0], torch.nonzero(mask.any(0))[:, 0]
        seen = len(rows) > 0
        box = [columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1] if seen else [camera.width, camera.height]
        centres.append([0.5 * float(x) for x in box])
        radii.append(float(mask.sum()) / torch.pi)
        sides = [float(columns[-1] - columns[0]), float(rows[-1] - rows[0])] if seen else [1.0, 1.0]
        extents.append(0.5 * math.hypot(*sides))
        visible.append(seen)
    focal = camera.fx_fy_cx_cy[:2].double().prod().sqrt()
    radius = ROUNDNESS * torch.tensor(radii, dtype=torch.float64).sqrt() / focal
    seen = torch.tensor(visible)
    usual = radius[seen].median() if bool(seen.any()) else radius.new_tensor(1.0)
    centre, extent = (torch.tensor(values, dtype=torch.float64) for values in (centres, extents))
    return Silhouettes(centre, torch.where(seen, radius, usual), extent, seen)


def odd(shapes: Silhouettes) -> Bool[Tensor, " t"]:
    """Frames whose silhouette jumps in size or place against those before and after: a mask that failed."""
    n, reach = len(shapes.radius), 3
    near = (torch.arange(n)[:, None] + torch.arange(-reach, reach + 1)).clamp(0, n - 1)
    size = (shapes.radius.log() - shapes.radius.log()[near].median(1).values).abs()
    # Pixels per radius are the same in all frames of one lens.
    place = (shapes.centre - shapes.centre[near].median(1).values).norm(dim=-1)
    return shapes.visible & ((size > JUMP) | (place > JUMP * shapes.extent))


def mended(shapes: Silhouettes, odd: Bool[Tensor, " t"]) -> Silhouettes:
    """Silhouettes with place and size of the closest frame where they are odd."""
    kept = torch.nonzero(~odd)[:, 0]
    if not len(kept):
        return shapes
    closest = kept[(torch.arange(len(odd))[:, None] - kept).abs().argmin(1)]
    return replace(shapes, centre=shapes.centre[closest], radius=shapes.radius[closest], extent=shapes.extent[closest])


def fit(
    matches: Sequence[Match],
    shapes: Silhouettes,
    camera: Camera,
    *,
    starts: Float[Tensor, "p s 3"] | None = None,
    most: int = 300,
    chunk: int = 64,
) -> Relative:
    """The motion of every pair, from many starts, by Levenberg-Marquardt.

    Args:
        matches: At least four correspondences each.
        shapes: Of all frames of the capture.
        starts: Rotation vectors to start from, per pair, besides the fixed ones [radians].
        most: Correspondences used per pair, spread evenly over those there are.
        chunk: Pairs fitted at once.
    """
    assert matches, "at least one pair"
    common = _starts()
    parts = []
    for first in range(0, len(matches), chunk):
        some = matches[first : first + chunk]
        guess = common[None].expand(len(some), -1, -1)
        if starts is not None:
            guess = torch.cat([starts[first : first + chunk], guess], 1)
        parts.append(_fit(some, _problem(some, shapes, camera, most), guess))
    return Relative(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def _starts() -> Float[Tensor, "s 3"]:
    """Fixed rotation vectors in all directions that make new sides visible, and about the viewing axis [radians]."""
    diagonal = 0.5**0.5
    axes = [(1, 0, 0), (0, 1, 0), (diagonal, diagonal, 0), (diagonal, -diagonal, 0)]
    turns = [(a * x, a * y, a * z) for x, y, z in axes for a in (-0.45, -0.15, 0.15, 0.45)]
    return torch.tensor([*turns, (0, 0, 0.3), (0, 0, -0.3)], dtype=torch.float64)


def _problem(matches: Sequence[Match], shapes: Silhouettes, camera: Camera, most: int) -> _Problem:
    longest = max(min(len(m), most) for m in matches)
    focal, principal = camera.fx_fy_cx_cy.double().split(2)

    def at_depth_one(uv: Tensor) -> Tensor:
        xy = (uv.double() - principal) / focal
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)

    uv_i, uv_j = (torch.zeros(len(matches), longest, 2, dtype=torch.float64) for _ in range(2))
    weight = torch.zeros(len(matches), longest, dtype=torch.float64)
    for row, match in enumerate(matches):
        n = min(len(match), longest)
        chosen = torch.linspace(0, len(match) - 1, n).round().long()
        # Neighbours in the list are often neighbours in the picture; the starts are tried on the first few.
        chosen = chosen[torch.randperm(n, generator=torch.Generator().manual_seed(n))]
        uv_i[row, :n], uv_j[row, :n], weight[row, :n] = match.uv_i[chosen], match.uv_j[chosen], 1.0
    i = torch.tensor([m.i for m in matches])
    j = torch.tensor([m.j for m in matches])
    centre = at_depth_one(shapes.centre)
    c_i, radius = centre[i][:, None], shapes.radius[i][:, None] * centre[i].norm(dim=-1)[:, None]
    ray = torch.nn.functional.normalize(at_depth_one(uv_i), dim=-1)
    middle = (ray * c_i).sum(-1)
    half2 = radius.square() - (c_i.square().sum(-1) - middle.square())
    half = torch.maximum(half2, (LEAST_DEPTH * radius).square()).sqrt()
    near, far = (ray * (middle + side * half)[..., None] - c_i for side in (-1.0, BEHIND))
    return _Problem(near, far, uv_j, weight, centre[j], focal, principal)


def _fit(matches: Sequence[Match], problem: _Problem, starts: Float[Tensor, "p s 3"]) -> Relative:
    p, s = starts.shape[:2]
    rows = torch.arange(p).repeat_interleave(s)
    R = SO3.exp(starts.reshape(-1, 3)).matrix()
    ell = torch.zeros(p * s, dtype=torch.float64)
    R, ell, cost, _ = _descend(problem.select(rows, slice(0, 60)), R, ell, steps=12)
    # Two answers per pair: the best start, and the best of those that went elsewhere.
    cost, R, ell = cost.reshape(p, s), R.reshape(p, s, 3, 3), ell.reshape(p, s)
    best = cost.argmin(1)
    apart = _angle(R, R[torch.arange(p), best][:, None]) > APART
    other = torch.where(apart, cost, torch.inf).argmin(1)
    pick = torch.stack([best, other], 1)
    index = torch.arange(p)[:, None]
    twice = problem.select(torch.arange(p).repeat_interleave(2))
    R2, ell2, cost2, H2 = _descend(twice, R[index, pick].reshape(-1, 3, 3), ell[index, pick].reshape(-1), steps=12)
    inliers = (twice.weight * (_residuals(twice, R2, ell2)[0].norm(dim=-1) < INLIER)).sum(1).reshape(p, 2)
    cost2, R2, ell2, H2 = cost2.reshape(p, 2), R2.reshape(p, 2, 3, 3), ell2.reshape(p, 2), H2.reshape(p, 2, 4, 4)
    win = cost2.argmin(1)
    a, b = torch.arange(p), 1 - win
    return Relative(
        i=torch.tensor([m.i for m in matches]),
        j=torch.tensor([m.j for m in matches]),
        R_j_i=R2[a, win],
        log_depth=ell2[a, win],
        inliers=inliers[a, win],
        cost=cost2[a, win],
        information=H2[a, win][:, :3, :3],
        rival=R2[a, b],
        rival_cost=cost2[a, b],
    )


def _angle(a: Float[Tensor, "*#b 3 3"], b: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*#b"]:
    trace = (a * b).sum((-1, -2))
    return ((trace - 1) / 2).clamp(-1, 1).arccos()


def _residuals(
    q: _Problem, R: Float[Tensor, "p 3 3"], ell: Float[Tensor, " p"]
) -> tuple[Float[Tensor, "p m 2"], Float[Tensor, "p m 3"], Float[Tensor, "p m 2"]]:
    """Way from the targets to the segments [pixels], the nearest points (camera frame j), and the directions along
    which that way does not count because the point may slide (zero at the segments' ends)."""
    shift = (ell.exp()[:, None] * q.centre_j)[:, None]
    a, b = (x @ R.mT + shift for x in (q.near, q.far))
    a, b = (torch.cat([x[..., :2], x[..., 2:].clamp_min(0.05)], -1) for x in (a, b))
    uv_a, uv_b = (x[..., :2] / x[..., 2:] * q.focal + q.principal for x in (a, b))
    along = uv_b - uv_a
    length2 = along.square().sum(-1).clamp_min(1e-12)
    t = ((q.target - uv_a) * along).sum(-1) / length2
    inner = (t > 0) & (t < 1)
    t = t.clamp(0, 1)
    # From the share of the projected segment to that of the segment in space.
    s = t * a[..., 2] / (b[..., 2] + t * (a[..., 2] - b[..., 2]))
    nearest = a + s[..., None] * (b - a)
    residual = uv_a + t[..., None] * along - q.target
    slide = torch.where(inner[..., None], along / length2.sqrt()[..., None], 0.0)
    return residual, nearest, slide


def _descend(
    q: _Problem, R: Tensor, ell: Tensor, *, steps: int
) -> tuple[Float[Tensor, "p 3 3"], Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, "p 4 4"]]:
    """Levenberg-Marquardt on all problems side by side; also the costs per match and the normal matrices."""

    def moved(state: tuple[Tensor, Tensor], system: tuple[Tensor, Tensor], damping: Tensor) -> tuple[Tensor, Tensor]:
        (R, ell), (H, g) = state, system
        damped = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=-2, dim2=-1) + 1e-9)
        step = torch.linalg.solve(damped, -g[..., None])[..., 0].clamp(-0.4, 0.4)
        return SO3.exp(step[:, :3]).matrix() @ R, (ell + step[:, 3]).clamp(-0.5, 0.5)

    def linearised(state: tuple[Tensor, Tensor]) -> Linearised:
        cost, H, g = _normal(q, *state)
        return Linearised(cost, (H, g))

    damping = Damping(least=1e-9, most=1e6)
    (R, ell), last = minimise((R, ell), linearised, moved, rowwise, steps=steps, damping=damping)
    return R, ell, last.cost / q.weight.sum(1).clamp_min(1), last.system[0]


def _normal(q: _Problem, R: Tensor, ell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Soft-L1 cost, normal matrix and gradient for a left turn of R and a change of ell."""
    residual, x, slide = _residuals(q, R, ell)
    squared = residual.square().sum(-1) / SOFT**2
    root = (1 + squared).sqrt()
    shift = ell.exp()[:, None] * q.centre_j
    cost = (q.weight * 2 * SOFT**2 * (root - 1)).sum(1) + (DEPTH_WEIGHT * ell).square()
    arm = x - shift[:, None]
    # Columns of d x / d (turn, ell): -[arm]_x and the centre's own motion.
    zero = torch.zeros_like(arm[..., 0])
    ax, ay, az = arm.unbind(-1)
    rows = [
        torch.stack([zero, az, -ay, shift[:, None, 0].expand_as(zero)], -1),
        torch.stack([-az, zero, ax, shift[:, None, 1].expand_as(zero)], -1),
        torch.stack([ay, -ax, zero, shift[:, None, 2].expand_as(zero)], -1),
    ]
    z = x[..., 2:]
    J = torch.stack([q.focal[k] / z * (rows[k] - x[..., k : k + 1] / z * rows[2]) for k in range(2)], -2)
    J = J - slide[..., None] * (slide[..., None] * J).sum(-2, keepdim=True)
    w = q.weight / root
    H = torch.einsum("pm,pmki,pmkj->pij", w, J, J)
    g = torch.einsum("pm,pmki,pmk->pi", w, J, residual)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=H.dtype)
    H = H + DEPTH_WEIGHT**2 * torch.diag(last)
    g = g + DEPTH_WEIGHT**2 * ell[:, None] * last
    return cost, H, g
