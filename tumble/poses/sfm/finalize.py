"""What stage 1 hands on: poses in the object's own unit and frame, its points, and how far to trust them.

The gauge: the ball about the object's frontier points, which lie on its convex hull, is the unit ball. The object frame
is turned as the camera saw it in the first frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.maths import SE3, SO3, angle_between, interpolate, iou, linear_from_srgb, smallest_ball
from tumble.poses.result import UNSEEN, Observability, PoseQuality, PoseResult
from tumble.poses.sfm import bundle_adjustment, relocalization, symmetry, texture_information
from tumble.poses.sfm.frontier_points import Outlines, touch
from tumble.poses.sfm.relocalization import Judge
from tumble.poses.sfm.symmetry import Mirrors
from tumble.poses.sfm.tracks import Tracks
from tumble.scene import BACKGROUND, UNKNOWN, Capture, Trajectory, visual_hull

AGREES = 1.5
"""Distance between a match and its point up to which the match is an inlier [pixels]."""
LOST = 8.0
"""Gap over the capture's median from which the outline contradicts the pose."""
LEAST_GAP = 0.15
"""Median gap that is always forgiven [pixels]."""
STRANGE = 0.1
"""Overlap under the median from which a frame's silhouette contradicts the hull."""
FEW, CONTRARY = 8, 6.0
"""Inliers under which matches do not hold a frame against its outline, and median distance between its matches and
their points from which they speak against it [pixels]."""
WIDE = 0.5
"""Least angle between the rays that make a frontier point [radians]."""
STRAY = 1.1
"""Distance from the centre, over that which one point in twenty exceeds, from which a point is a wrong one: frontier
points gather at the object's ends."""
BARE = 0.03
"""Share of observations with texture that no edge explains under which a body of revolution has no texture: bare cans
and balls up to 1.4 %, without grain and with it, and 2.7 % with a film's masks; a soup can 21 %, and 7 % under grain of
25 code values."""
BALL_STEPS = 299
"""Of the search for the smallest ball."""
JUDGED, JUDGES = 24, 16
"""Frames that are asked what their outline would say of a turn, and frames they are compared with."""
CELLS = 48
"""Of the hull's grid, per side, and of the grid of rays that look at it."""


@dataclass(frozen=True)
class Solution:
    """Poses in stage 1's own unit, the object's mean distance."""

    R: Float[Tensor, "t 3 3"]
    t: Float[Tensor, "t 3"]
    radius: float
    """Of the object, roughly."""
    drift: Float[Tensor, " t"]
    """Angle between what tracks and what outlines would have preferred [radians]."""


def finished(capture: Capture, tracks: Tracks, outline: Outlines, solution: Solution) -> PoseResult:
    """Judge every frame, fix the gauge, and collect the points that deserve it."""
    R, t, camera = solution.R, solution.t, capture.camera
    reach = torch.full((len(R),), solution.radius, dtype=torch.float64)
    X = bundle_adjustment.triangulate(tracks, R, t, camera, reach)
    scene = bundle_adjustment.BundleState(R[None], t[None], X)
    group, weight = torch.zeros(tracks.n, dtype=torch.long), torch.ones(len(tracks), dtype=torch.float64)
    place = torch.ones(1, len(R), 2, dtype=torch.float64)
    problem = bundle_adjustment.Problem(camera, tracks, group, weight, place, place[..., 0], depth_sigma=1.0, reach=1.0)
    residual = bundle_adjustment.residuals(problem, scene)[0].norm(dim=-1)
    gap, rim = _frontier(capture, outline, solution)
    median, inliers = _per_frame(residual, tracks.frame, len(R))
    worst = LOST * gap[~gap.isnan()].median().clamp_min(LEAST_GAP) if bool((~gap.isnan()).any()) else torch.inf
    visible = (capture.masks != BACKGROUND).flatten(1).any(1)
    failed = ~outline.sure.any(1)
    lost = ~visible | failed | (((gap > worst) | gap.isnan() | (median > CONTRARY)) & (inliers < FEW))
    lost = ~relocalization.unbroken(R, ~lost)
    sure = torch.zeros(tracks.n).index_add_(0, tracks.point, (residual < AGREES).float()) >= 3
    centre, scale = _ball(torch.cat([rim, X[sure]]) if len(rim) < 50 else rim)
    R_first = R[0]
    origin = t + R @ centre
    T = SE3.from_rotation(SO3.from_matrix(R @ R_first.mT), origin / scale)
    lost, overlap = _contradicting(capture, Trajectory(SE3(T.wxyz.float(), T.xyz.float()), capture.light), lost)
    T = _bridged(T, lost)
    trajectory = Trajectory(SE3(T.wxyz.float(), T.xyz.float()), capture.light)
    points = ((X[sure] - centre) / scale) @ R_first.mT
    colours = _colours(capture, tracks, residual, sure)
    observability = _observability(capture, outline, solution, problem, scene, residual < AGREES)
    drift, turn = solution.drift.float(), angle_between(T.rotation[:, None], T.rotation).max().float()
    quality = PoseQuality(median.float(), inliers.float(), gap.float(), overlap, drift, lost, turn, observability)
    return PoseResult(trajectory, points.float(), colours, quality, camera)


def _frontier(
    capture: Capture, outline: Outlines, solution: Solution
) -> tuple[Float[Tensor, " t"], Float[Tensor, "n 3"]]:
    """Median gap of every frame with all others [pixels], and the frontier points of small gaps."""
    n = len(solution.R)
    i, j = torch.triu_indices(n, n, 1)
    pose_i, pose_j = ((solution.R[k], solution.t[k]) for k in (i, j))
    found = touch(pose_i, pose_j, outline[i], outline[j], capture.camera, radius=solution.radius)
    table = torch.full((n, n, 2), torch.nan, dtype=torch.float64)
    table[i, j] = table[j, i] = torch.where(found.good, found.gap.abs(), torch.nan)
    gap = table.flatten(1).nanmedian(1).values
    # Rays that meet at a small angle do not say where.
    turn = (solution.R[i, 2] * solution.R[j, 2]).sum(-1).clamp(-1, 1).arccos()
    wide = (turn > WIDE) & (turn < torch.pi - WIDE)
    close = found.good & wide[:, None] & (found.gap.abs() < 2 * gap[~gap.isnan()].median().clamp_min(LEAST_GAP))
    frames = torch.stack([i, j], 1)[:, None].expand(-1, 2, -1)[close]
    uv = torch.stack([outline.corners[i[:, None], found.corner_i], outline.corners[j[:, None], found.corner_j]], 2)[
        close
    ]
    point = torch.arange(len(frames)).repeat_interleave(2)
    tracks = Tracks(frames.reshape(-1), point, uv.reshape(-1, 2))
    reach = torch.full((n,), solution.radius, dtype=torch.float64)
    return gap, bundle_adjustment.triangulate(tracks, solution.R, solution.t, capture.camera, reach)


def _per_frame(residual: Float[Tensor, " o"], frame: Tensor, n: int) -> tuple[Float[Tensor, " t"], Float[Tensor, " t"]]:
    """Median residual and number of inliers of every frame."""
    groups = [residual[frame == k] for k in range(n)]
    median = torch.stack([g.median() if len(g) else g.new_tensor(torch.nan) for g in groups])
    return median, torch.stack([(g < AGREES).sum() for g in groups]).double()


def _ball(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Centre and radius of the smallest ball about all points but strays."""
    if len(points) < 4:
        return torch.zeros(3, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    centre = points.median(0).values
    for _ in range(2):
        distance = (points - centre).norm(dim=-1)
        points = points[distance <= STRAY * distance.quantile(0.95)]
        centre = smallest_ball(lambda x, points=points: points - x, centre, steps=BALL_STEPS)
    return centre, (points - centre).norm(dim=-1).max()


def _bridged(T: SE3, lost: Bool[Tensor, " t"]) -> SE3:
    """Poses of lost frames by interpolation between the closest that are not, or by the closest at the ends."""
    kept = torch.nonzero(~lost)[:, 0].tolist()
    if not kept:
        return T
    wxyz, xyz = T.wxyz.clone(), T.xyz.clone()
    for k in torch.nonzero(lost)[:, 0].tolist():
        before, after = (
            max((i for i in kept if i < k), default=kept[0]),
            min((i for i in kept if i > k), default=kept[-1]),
        )
        share = (k - before) / (after - before) if before < k < after else 0.0
        guess = interpolate(T[before], T[after], share)
        wxyz[k], xyz[k] = guess.wxyz, guess.xyz
    return SE3(wxyz, xyz)


def _colours(
    capture: Capture, tracks: Tracks, residual: Float[Tensor, " o"], sure: Bool[Tensor, " n"]
) -> Float[Tensor, "m 3"]:
    """Of the points that are sure, the median over observations that agree."""
    column, row = tracks.uv.floor().long().T
    size = capture.camera
    seen = capture.images[tracks.frame, row.clamp(0, size.height - 1), column.clamp(0, size.width - 1)]
    colour = linear_from_srgb(seen.float() / 255)
    order = torch.argsort(tracks.point, stable=True)
    good = order[(residual < AGREES)[order] & sure[tracks.point[order]]]
    parts = colour[good].split(torch.bincount(tracks.point[good], minlength=tracks.n)[sure].tolist())
    return torch.stack([part.median(0).values for part in parts]) if parts else colour[:0]


def _contradicting(
    capture: Capture, trajectory: Trajectory, lost: Bool[Tensor, " t"]
) -> tuple[Bool[Tensor, " t"], Float[Tensor, " t"]]:
    """Lost frames, with those whose silhouette the hull of the others does not know; also the overlaps.

    Frames that went astray together carve the hull of all: what they leave of it is looked at again without them.
    """
    for _ in range(3):
        overlap = _overlap(capture, trajectory, lost)
        if bool(lost.all()):
            break
        strange = overlap < overlap[~lost].median() - STRANGE
        if not bool((strange & ~lost).any()):
            break
        lost = lost | strange
    return lost, overlap


def _overlap(capture: Capture, trajectory: Trajectory, lost: Bool[Tensor, " t"]) -> Float[Tensor, " t"]:
    """Intersection over union of silhouettes and the hull that those of frames not lost carve."""
    kept = torch.nonzero(~lost)[:, 0]
    if not len(kept):
        return torch.zeros(len(capture))
    inside = visual_hull.carve(_part(capture, kept.tolist()), trajectory.select(kept), resolution=CELLS)
    camera = capture.camera.resized(CELLS, CELLS)
    direction = camera.unproject(camera.pixel_centers(), torch.ones(CELLS, CELLS)).reshape(-1, 1, 3)
    rows = ((torch.arange(CELLS) + 0.5) * capture.camera.height / CELLS).long()
    columns = ((torch.arange(CELLS) + 0.5) * capture.camera.width / CELLS).long()
    scores = []
    for frame in range(len(trajectory)):
        T_cam_obj = trajectory.T_cam_obj[frame]
        depth = T_cam_obj.xyz[2] + torch.linspace(-1.1, 1.1, 2 * CELLS)[:, None]
        x_obj = T_cam_obj.inverse() @ (direction * depth)
        at = x_obj.flip(-1)[None, None]  # grid_sample wants the last axis of the grid first
        through = torch.nn.functional.grid_sample(inside[None, None], at, align_corners=False)[0, 0, 0].amax(-1) > 0.5
        mask = capture.masks[frame][rows][:, columns].flatten()
        counted, silhouette = mask != UNKNOWN, mask != BACKGROUND
        scores.append(iou(through, silhouette, counted))
    return torch.stack(scores)


def _part(capture: Capture, frames: Sequence[int]) -> Capture:
    """Some frames of a capture, without poses."""
    index = torch.as_tensor(frames)
    names = tuple(capture.names[k] for k in frames)
    return replace(capture, images=capture.images[index], masks=capture.masks[index], names=names, trajectory=None)


def _observability(
    capture: Capture,
    outline: Outlines,
    solution: Solution,
    problem: bundle_adjustment.Problem,
    scene: bundle_adjustment.BundleState,
    agrees: Tensor,
) -> Observability:
    """Uncertainty of a single frame's rotation by texture and outlines, points held, translation free: typical over
    frames that texture shows anything of, and others."""
    R, t, camera, n = solution.R, solution.t, capture.camera, len(solution.R)
    textured = texture_information.information(capture, problem.tracks) * agrees[:, None, None]
    # A place is never known better than to the noise of a good match.
    precision = torch.linalg.inv(
        torch.linalg.inv(textured + 1e-9 * torch.eye(2, dtype=torch.float64))
        + bundle_adjustment.NOISE**2 * torch.eye(2, dtype=torch.float64)
    )
    information = bundle_adjustment.information(problem, scene, precision)
    frames = torch.arange(0, n, max(1, n // JUDGED))
    for k in frames.tolist():
        others = torch.tensor([i for i in range(0, n, max(1, n // JUDGES)) if i != k])
        own, theirs = outline[torch.tensor([k])], outline[others]
        judge = Judge((R[others], t[others]), own, theirs, camera, solution.radius)
        information[k] += relocalization.information(judge, R[k], t[k])
    information = information[frames]
    H = information[:, :3, :3] - information[:, :3, 3:] @ torch.linalg.solve(
        information[:, 3:, 3:] + 1e-9 * torch.eye(3, dtype=torch.float64), information[:, 3:, :3]
    )
    R_first_cam = R[0] @ R[frames].mT  # from each camera to the object frame of the outcome
    H = R_first_cam @ H @ R_first_cam.mT
    total = H.diagonal(dim1=1, dim2=2).sum(-1)
    typical = total.median() * (H / total.clamp_min(1e-9)[:, None, None]).mean(0)
    strength, axes = torch.linalg.eigh(typical)
    seen = Observability(axes[:, 0].float(), strength.clamp_min(1 / torch.pi**2).rsqrt().float())
    lesser, greater = torch.linalg.eigvalsh(textured).T
    # Rounding leaves a little across an edge.
    bare = bool((lesser > 1e-6 * greater).double().mean() < BARE)
    return _symmetric(seen, symmetry.mirrors(capture.masks)) if bare else seen


def _symmetric(seen: Observability, mirrors: Mirrors) -> Observability:
    """What is seen of a bare object, whatever the poses that were found for it say."""
    if not mirrors.revolves:
        return seen
    if mirrors.ball:
        return replace(seen, sigma=torch.full_like(seen.sigma, torch.pi))
    axis = torch.nn.functional.pad(mirrors.axis, (0, 1), value=torch.nan)
    return Observability(axis, torch.cat([seen.sigma.new_full((1,), torch.pi), seen.sigma[1:].clamp_max(UNSEEN)]))
