"""Relative poses of pairs of frames, from matches and silhouettes.

The object's centre is assumed on the ray through the middle of its silhouette, so a relative pose has four degrees of
freedom: a rotation about that centre and the ratio of its distances. A matched pixel is assumed to show a point in the
front half of the bounding sphere that the silhouette indicates: its *segment*, a part of the pixel's ray. The segment
projects to a short line in the other frame, and the residual is the offset from the matched pixel to that line. An
epipolar line, which is unbounded, would not do: at the small field of view of a hand-held object it is consistent with
no rotation at all.

Two rotations can explain two nearly affine images equally well (Necker reversal). The best solution that clearly
differs from the overall best is therefore kept as its *alternative*.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SO3, Damping, Linearised, minimise, select_rows
from tumble.scene import BACKGROUND, Camera, Capture, Match

SPHERE_OVER_DISC = 1.25
"""Radius of the bounding sphere over that of the disc with the silhouette's area; above 1, as few objects are round."""
MIN_HALF_CHORD = 0.15
"""Lower limit of half the chord of a ray in the bounding sphere [radius of the sphere]."""
FAR_END = -0.5
"""Far end of a segment, measured from the middle of the chord away from the camera [half chord]; the near end is at -1.
Two views determine the rotation's angle only up to the object's depth (bas-relief ambiguity), and this prior resolves
it: segments that reach behind the middle admit mirror images."""
MAX_SILHOUETTE_JUMP = 0.2
"""Deviation from the median of nearby frames above which a mask counts as failed: of the logarithm of the radius, and
of the centre [half the diagonal of the bounding box]."""
MIN_MATCHES = 8
"""Smallest number of matches of a pair that is fitted."""
LOSS_SCALE = 2.0
"""Residual above which the soft-L1 loss grows about linearly [pixels]."""
DEPTH_WEIGHT = 30.0
"""Weight of the prior that a hand-held object keeps its distance [pixels per unit of the logarithm of the ratio]."""
INLIER_THRESHOLD = 2.0
"""Residual up to which a match is an inlier [pixels]."""
DISTINCT_ANGLE = 0.12
"""Angle between two rotations above which they count as distinct solutions [radians]."""


@dataclass(frozen=True)
class Silhouettes:
    """Position and size of the object's silhouette in every frame."""

    centre: Float[Tensor, "t 2"]
    """Centre of the bounding box [pixels]."""
    radius: Float[Tensor, " t"]
    """Radius of the bounding sphere over the distance of its centre, positive."""
    extent: Float[Tensor, " t"]
    """Half the diagonal of the bounding box [pixels]."""
    visible: Bool[Tensor, " t"]
    """Whether the mask has any pixel of the object."""


@dataclass(frozen=True)
class RelativePoses:
    """Relative poses of `p` pairs of frames."""

    i: Int64[Tensor, " p"]
    """Index of the first frame."""
    j: Int64[Tensor, " p"]
    """Index of the second frame."""
    R_j_i: Float[Tensor, "p 3 3"]
    """Rotation from the camera frame of i to that of j, about the object's centre."""
    log_depth: Float[Tensor, " p"]
    """Logarithm of the centre's distance in j over that in i."""
    inliers: Float[Tensor, " p"]
    """Number of matches with a residual below `INLIER_THRESHOLD`."""
    cost: Float[Tensor, " p"]
    """Mean robust loss per match [pixels^2]."""
    information: Float[Tensor, "p 3 3"]
    """Information matrix of the rotation, camera frame of j, for matches with one pixel of noise [1 / radian^2]."""
    alternative: Float[Tensor, "p 3 3"]
    """`R_j_i` of the best distinct solution; about `R_j_i` again where all starts lead to one solution."""
    alternative_cost: Float[Tensor, " p"]
    """Cost of the alternative [pixels^2]."""

    def __len__(self) -> int:
        return len(self.i)

    def select(self, keep: Tensor) -> "RelativePoses":
        """A subset of the pairs, by index or mask."""
        return RelativePoses(**{name: value[keep] for name, value in vars(self).items()})


@dataclass(frozen=True)
class _Problem:
    """Segments and matched positions of `p` pairs, padded to `m` matches each."""

    near: Float[Tensor, "p m 3"]
    """Front end of each segment, relative to the object's centre, camera frame of i [distance in i]."""
    far: Float[Tensor, "p m 3"]
    """Rear end of each segment, in the same frame and unit."""
    target: Float[Tensor, "p m 2"]
    """Matched position in frame j [pixels]."""
    weight: Float[Tensor, "p m"]
    """Weight of each match: 1, or 0 for padding."""
    centre_j: Float[Tensor, "p 3"]
    """The object's centre in the camera frame of j, at depth 1."""
    focal: Float[Tensor, "2"]
    """Focal lengths fx, fy [pixels]."""
    principal: Float[Tensor, "2"]
    """Principal point cx, cy [pixels]."""

    def select(self, pairs: Tensor, matches: slice = slice(None)) -> "_Problem":
        near, far, target, weight = (x[pairs][:, matches] for x in (self.near, self.far, self.target, self.weight))
        return _Problem(near, far, target, weight, self.centre_j[pairs], self.focal, self.principal)


def silhouettes(capture: Capture) -> Silhouettes:
    """Silhouettes of all frames.

    Unknown pixels count as object, because a hand hides parts of it. A frame without object pixels gets the centre of
    the image and the median radius.
    """
    camera = capture.camera
    centres, radii, extents, visible = [], [], [], []
    for mask in capture.masks != BACKGROUND:
        rows, columns = torch.nonzero(mask.any(1))[:, 0], torch.nonzero(mask.any(0))[:, 0]
        present = len(rows) > 0
        box = [columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1] if present else [camera.width, camera.height]
        centres.append([0.5 * float(x) for x in box])
        radii.append(float(mask.sum()) / torch.pi)
        sides = [float(columns[-1] - columns[0]), float(rows[-1] - rows[0])] if present else [1.0, 1.0]
        extents.append(0.5 * math.hypot(*sides))
        visible.append(present)
    focal = camera.fx_fy_cx_cy[:2].double().prod().sqrt()
    radius = SPHERE_OVER_DISC * torch.tensor(radii, dtype=torch.float64).sqrt() / focal
    present = torch.tensor(visible)
    median = radius[present].median() if bool(present.any()) else radius.new_tensor(1.0)
    centre, extent = (torch.tensor(values, dtype=torch.float64) for values in (centres, extents))
    return Silhouettes(centre, torch.where(present, radius, median), extent, present)


def failed_masks(shapes: Silhouettes) -> Bool[Tensor, " t"]:
    """Frames whose silhouette differs in size or position from the median of nearby frames: a failed segmentation."""
    n, reach = len(shapes.radius), 3
    near = (torch.arange(n)[:, None] + torch.arange(-reach, reach + 1)).clamp(0, n - 1)
    size = (shapes.radius.log() - shapes.radius.log()[near].median(1).values).abs()
    # In pixels: the focal length is the same in all frames.
    place = (shapes.centre - shapes.centre[near].median(1).values).norm(dim=-1)
    return shapes.visible & ((size > MAX_SILHOUETTE_JUMP) | (place > MAX_SILHOUETTE_JUMP * shapes.extent))


def replace_failed(shapes: Silhouettes, failed: Bool[Tensor, " t"]) -> Silhouettes:
    """Silhouettes in which those of failed masks are replaced by those of the closest other frame."""
    kept = torch.nonzero(~failed)[:, 0]
    if not len(kept):
        return shapes
    closest = kept[(torch.arange(len(failed))[:, None] - kept).abs().argmin(1)]
    return replace(shapes, centre=shapes.centre[closest], radius=shapes.radius[closest], extent=shapes.extent[closest])


def fit(
    matches: Sequence[Match],
    shapes: Silhouettes,
    camera: Camera,
    *,
    starts: Float[Tensor, "p s 3"] | None = None,
    max_matches: int = 300,
    chunk: int = 64,
) -> RelativePoses:
    """Relative pose of every pair of frames, by Levenberg-Marquardt from several initial rotations.

    Args:
        matches: Matches of each pair, at least four correspondences each.
        shapes: Silhouettes of all frames of the capture.
        camera: Camera of all frames.
        starts: Initial rotation vectors per pair, in addition to the fixed ones [radians].
        max_matches: Largest number of correspondences used per pair; a regular subset of the given ones.
        chunk: Number of pairs fitted at once.
    """
    assert matches, "at least one pair"
    common = _start_rotations()
    parts = []
    for first in range(0, len(matches), chunk):
        some = matches[first : first + chunk]
        initial = common[None].expand(len(some), -1, -1)
        if starts is not None:
            initial = torch.cat([starts[first : first + chunk], initial], 1)
        parts.append(_fit(some, _problem(some, shapes, camera, max_matches), initial))
    return RelativePoses(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def _start_rotations() -> Float[Tensor, "s 3"]:
    """Fixed initial rotation vectors: about axes across the view, and about the viewing axis [radians]."""
    diagonal = 0.5**0.5
    axes = [(1, 0, 0), (0, 1, 0), (diagonal, diagonal, 0), (diagonal, -diagonal, 0)]
    across = [(a * x, a * y, a * z) for x, y, z in axes for a in (-0.45, -0.15, 0.15, 0.45)]
    return torch.tensor([*across, (0, 0, 0.3), (0, 0, -0.3)], dtype=torch.float64)


def _problem(matches: Sequence[Match], shapes: Silhouettes, camera: Camera, max_matches: int) -> _Problem:
    """Segments of the matched pixels in frame i, and their matched positions in frame j."""
    longest = max(min(len(m), max_matches) for m in matches)
    focal, principal = camera.fx_fy_cx_cy.double().split(2)

    def at_depth_one(uv: Tensor) -> Tensor:
        xy = (uv.double() - principal) / focal
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)

    uv_i, uv_j = (torch.zeros(len(matches), longest, 2, dtype=torch.float64) for _ in range(2))
    weight = torch.zeros(len(matches), longest, dtype=torch.float64)
    for row, match in enumerate(matches):
        n = min(len(match), longest)
        chosen = torch.linspace(0, len(match) - 1, n).round().long()
        # Shuffled: neighbours in the list are often neighbours in the image, and starts are tried on the first few.
        chosen = chosen[torch.randperm(n, generator=torch.Generator().manual_seed(n))]
        uv_i[row, :n], uv_j[row, :n], weight[row, :n] = match.uv_i[chosen], match.uv_j[chosen], 1.0
    i = torch.tensor([m.i for m in matches])
    j = torch.tensor([m.j for m in matches])
    centre = at_depth_one(shapes.centre)
    c_i, radius = centre[i][:, None], shapes.radius[i][:, None] * centre[i].norm(dim=-1)[:, None]
    ray = torch.nn.functional.normalize(at_depth_one(uv_i), dim=-1)
    middle = (ray * c_i).sum(-1)
    half2 = radius.square() - (c_i.square().sum(-1) - middle.square())
    half = torch.maximum(half2, (MIN_HALF_CHORD * radius).square()).sqrt()
    near, far = (ray * (middle + side * half)[..., None] - c_i for side in (-1.0, FAR_END))
    return _Problem(near, far, uv_j, weight, centre[j], focal, principal)


def _fit(matches: Sequence[Match], problem: _Problem, starts: Float[Tensor, "p s 3"]) -> RelativePoses:
    """Best solution of every pair and its alternative, from all starts."""
    p, s = starts.shape[:2]
    rows = torch.arange(p).repeat_interleave(s)
    R = SO3.exp(starts.reshape(-1, 3)).matrix()
    ell = torch.zeros(p * s, dtype=torch.float64)
    R, ell, cost, _ = _levenberg_marquardt(problem.select(rows, slice(0, 60)), R, ell, steps=12)
    # Two solutions per pair: the best one, and the best of those that differ from it.
    cost, R, ell = cost.reshape(p, s), R.reshape(p, s, 3, 3), ell.reshape(p, s)
    best = cost.argmin(1)
    distinct = _angle(R, R[torch.arange(p), best][:, None]) > DISTINCT_ANGLE
    other = torch.where(distinct, cost, torch.inf).argmin(1)
    chosen = torch.stack([best, other], 1)
    index = torch.arange(p)[:, None]
    twice = problem.select(torch.arange(p).repeat_interleave(2))
    R2, ell2, cost2, H2 = _levenberg_marquardt(
        twice, R[index, chosen].reshape(-1, 3, 3), ell[index, chosen].reshape(-1), steps=12
    )
    inliers = (twice.weight * (_residuals(twice, R2, ell2)[0].norm(dim=-1) < INLIER_THRESHOLD)).sum(1).reshape(p, 2)
    cost2, R2, ell2, H2 = cost2.reshape(p, 2), R2.reshape(p, 2, 3, 3), ell2.reshape(p, 2), H2.reshape(p, 2, 4, 4)
    best = cost2.argmin(1)
    a, b = torch.arange(p), 1 - best
    return RelativePoses(
        i=torch.tensor([m.i for m in matches]),
        j=torch.tensor([m.j for m in matches]),
        R_j_i=R2[a, best],
        log_depth=ell2[a, best],
        inliers=inliers[a, best],
        cost=cost2[a, best],
        information=H2[a, best][:, :3, :3],
        alternative=R2[a, b],
        alternative_cost=cost2[a, b],
    )


def _angle(a: Float[Tensor, "*#b 3 3"], b: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*#b"]:
    """Angle of the rotation between two rotation matrices [radians]."""
    trace = (a * b).sum((-1, -2))
    return ((trace - 1) / 2).clamp(-1, 1).arccos()


def _residuals(
    q: _Problem, R: Float[Tensor, "p 3 3"], ell: Float[Tensor, " p"]
) -> tuple[Float[Tensor, "p m 2"], Float[Tensor, "p m 3"], Float[Tensor, "p m 2"]]:
    """Residuals of the matches for rotations `R` and logarithms `ell` of the distance ratios.

    Returns:
        Offsets from the targets to the nearest points of the projected segments [pixels], these points in the camera
        frame of j, and the unit directions of the projected segments, along which a residual has no effect because the
        point may slide; zero where the nearest point is an end of its segment.
    """
    shift = (ell.exp()[:, None] * q.centre_j)[:, None]
    a, b = (x @ R.mT + shift for x in (q.near, q.far))
    a, b = (torch.cat([x[..., :2], x[..., 2:].clamp_min(0.05)], -1) for x in (a, b))
    uv_a, uv_b = (x[..., :2] / x[..., 2:] * q.focal + q.principal for x in (a, b))
    along = uv_b - uv_a
    length2 = along.square().sum(-1).clamp_min(1e-12)
    t = ((q.target - uv_a) * along).sum(-1) / length2
    inner = (t > 0) & (t < 1)
    t = t.clamp(0, 1)
    # From the position along the projected segment to that along the segment in space.
    s = t * a[..., 2] / (b[..., 2] + t * (a[..., 2] - b[..., 2]))
    nearest = a + s[..., None] * (b - a)
    residual = uv_a + t[..., None] * along - q.target
    slide = torch.where(inner[..., None], along / length2.sqrt()[..., None], 0.0)
    return residual, nearest, slide


def _levenberg_marquardt(
    q: _Problem, R: Tensor, ell: Tensor, *, steps: int
) -> tuple[Float[Tensor, "p 3 3"], Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, "p 4 4"]]:
    """Levenberg-Marquardt on all pairs side by side.

    Returns:
        Rotations, logarithms of the distance ratios, mean loss per match [pixels^2], and normal matrices of
        (rotation, logarithm).
    """

    def moved(state: tuple[Tensor, Tensor], system: tuple[Tensor, Tensor], damping: Tensor) -> tuple[Tensor, Tensor]:
        (R, ell), (H, g) = state, system
        damped = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=-2, dim2=-1) + 1e-9)
        step = torch.linalg.solve(damped, -g[..., None])[..., 0].clamp(-0.4, 0.4)
        return SO3.exp(step[:, :3]).matrix() @ R, (ell + step[:, 3]).clamp(-0.5, 0.5)

    def linearised(state: tuple[Tensor, Tensor]) -> Linearised:
        cost, H, g = _normal_equations(q, *state)
        return Linearised(cost, (H, g))

    damping = Damping(minimum=1e-9, maximum=1e6)
    (R, ell), last = minimise((R, ell), linearised, moved, select_rows, steps=steps, damping=damping)
    return R, ell, last.cost / q.weight.sum(1).clamp_min(1), last.system[0]


def _normal_equations(q: _Problem, R: Tensor, ell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Soft-L1 cost, normal matrix and gradient for a rotation vector applied to R from the left and a change of ell."""
    residual, x, slide = _residuals(q, R, ell)
    squared = residual.square().sum(-1) / LOSS_SCALE**2
    root = (1 + squared).sqrt()
    shift = ell.exp()[:, None] * q.centre_j
    cost = (q.weight * 2 * LOSS_SCALE**2 * (root - 1)).sum(1) + (DEPTH_WEIGHT * ell).square()
    arm = x - shift[:, None]
    # Columns of d x / d (rotation, ell): -[arm]_x, and the motion of the centre.
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
    both = torch.cat([J, residual[..., None]], -1).flatten(1, 2)
    w = (q.weight / root).repeat_interleave(2, 1)
    H, g = ((w[..., None] * both).mT @ both)[:, :4].split([4, 1], -1)
    g = g[..., 0]
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=H.dtype)
    H = H + DEPTH_WEIGHT**2 * torch.diag(last)
    g = g + DEPTH_WEIGHT**2 * ell[:, None] * last
    return cost, H, g
