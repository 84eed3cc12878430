"""Last step of stage 1: lost frames, the object's frame and unit, surface points and the quality of the poses.

The similarity frame of the result: the smallest sphere around the frontier points, which lie on the object's convex
hull, becomes the unit sphere. The object stands as a person sees it: +y is up in the first frame that is not lost, or
along the axis of a turntable, and +z points to that frame's camera.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SE3, SO3, angle_between, iou, linear_from_srgb, smallest_enclosing_sphere
from tumble.poses.result import (
    MAX_USABLE_UNCERTAINTY,
    UNOBSERVABLE_SIGMA,
    Observability,
    PoseQuality,
    PoseResult,
    interpolate_lost,
)
from tumble.poses.sfm import bundle_adjustment, relocalization
from tumble.poses.sfm.frontier_points import Contours, EpipolarTangencies, epipolar_tangencies, tracks_at
from tumble.poses.sfm.relocalization import ContourConstraints
from tumble.poses.sfm.symmetry import MirrorSymmetry, texture_information
from tumble.poses.sfm.tracks import Tracks, crossings
from tumble.scene import BACKGROUND, UNKNOWN, Camera, Capture, Trajectory, visual_hull

INLIER_THRESHOLD = 1.5
"""Reprojection error below which an observation is an inlier [pixels]."""
MAX_GAP_RATIO = 8.0
"""Tangency gap above which a frame's contour contradicts its pose [median gap of the capture]."""
MIN_MEDIAN_GAP = 0.15
"""Lower limit of the capture's median gap where thresholds are multiples of it [pixels]."""
MAX_OVERLAP_DEFICIT = 0.1
"""Difference to the median overlap above which a frame's silhouette contradicts the visual hull (IoU)."""
MIN_INLIERS = 8
"""Number of inliers below which a frame is lost if its contour or its observations contradict its pose."""
MAX_RESIDUAL = 6.0
"""Median reprojection error above which a frame's observations contradict its pose [pixels]."""
MAX_PAIRS = 50_000
"""Number of pairs of frames whose contours are compared at once, which takes 270 MiB."""
MIN_TRIANGULATION_ANGLE = 0.5
"""Minimum angle between two optical axes, and between one and the reverse of the other, for their frontier points to
be triangulated [radians]."""
OUTLIER_DISTANCE = 1.1
"""Distance from the centre above which a point is an outlier [95th percentile of all distances]. Little more than 1,
because frontier points are dense at the object's extremities."""
MIN_TEXTURED_FRACTION = 0.03
"""Fraction of observations with texture in both image directions, not only across an edge, below which a body of
revolution counts as untextured."""
SPHERE_STEPS = 299
"""Iterations of the search for the smallest enclosing sphere."""
ASSESSED_FRAMES = 24
"""Number of frames, up to a factor of 2, for which the information of the contour about the pose is evaluated."""
REFERENCE_FRAMES = 16
"""Number of frames, up to a factor of 2, with whose contours each of these frames is compared."""
MAX_TURNTABLE_WOBBLE = math.radians(5)
"""Largest deviation of the rotation axis in the camera frame with which a motion counts as that of a turntable
[radians]."""
MIN_TURNTABLE_RANGE = math.radians(90)
"""Smallest rotation range of a turntable [radians]; during smaller rotations other axes hardly move either."""
MAX_TURNTABLE_TILT = math.radians(60)
"""Largest angle between the axis of a turntable and up in the image, which is the elevation of the camera [radians]."""
HULL_TOLERANCES = (0.0, 0.05)
"""Fractions of the frames that may carve a cell in error, of which the one is used whose visual hull overlaps best: a
single wrong mask carves the object away, but a hull that tolerates errors is too large where there are none."""
HULL_RESOLUTION = 48
"""Cells per side of the visual hull's grid; also rays per side of the image in which its silhouette is compared."""
CONFIRMED_OVERLAP = 0.9
"""Median overlap above which the silhouettes confirm a sphere around the object (IoU)."""
HULL_MARGIN = 1.6
"""Radius of the sphere in which the visual hull is searched for, over the object's approximate radius."""
MIN_HULL_CELLS = 50
"""Smallest number of cells of a visual hull around which a sphere is drawn."""
MAX_JOINT_DEFICIT = 0.04
"""Mean loss of overlap by joining two parts of a film, above which the visual hull contradicts the joint (IoU). On a
rendered film of a soup can and the film `SM2` right joints cost -0.02 to 0.02, those turned by 45 degrees 0.05 to 0.3
unless about nearly the axis of the object."""

Sphere = tuple[Float[Tensor, "3"], Float[Tensor, ""]]
"""Centre and radius of a sphere around the object [mean distance]."""


@dataclass(frozen=True)
class Solution:
    """Estimated poses in the unit of stage 1, the mean distance between camera and object."""

    R: Float[Tensor, "t 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "t 3"]
    """Object origin, camera frame [mean distance]."""
    radius: float
    """Approximate radius of the object [mean distance]."""
    rotation_disagreement: Float[Tensor, " t"]
    """Angle between the rotation fitted mainly to tracks and the one fitted mainly to contours [radians]."""
    confirmed: Bool[Tensor, " t"] | None = None
    """Frames whose poses matches have confirmed, if something hides a part of the object: the others are lost. None if
    the object is in full view, where contours and silhouettes decide."""
    parts: Int64[Tensor, " t"] | None = None
    """Parts of the motion between which a pose jump is confirmed by colours (`longest_smooth_sequence`); None: none."""


def pose_result(
    capture: Capture, tracks: Tracks, contours: Contours, mirror_symmetry: MirrorSymmetry, solution: Solution
) -> PoseResult:
    """Result of stage 1 for estimated poses: lost frames, poses in the object's frame and unit, points and quality.

    Where hardly a point is seen on both sides of an instant, and the visual hull contradicts how these are joined, the
    frames of one side are lost.

    Args:
        capture: Images and masks of all frames.
        tracks: Feature tracks.
        contours: Convex contours of all silhouettes.
        mirror_symmetry: Mirror symmetry of all silhouettes.
        solution: The estimated poses.
    """
    refused: dict[int, float] = {}
    while True:
        result = _assessed(capture, tracks, contours, mirror_symmetry, solution)
        side = _consistent_side(capture, result)
        if side is None:
            return _naming(result, refused)
        first, tied, kept = side
        refused[first] = tied
        contours = replace(contours, reliable=contours.reliable & kept[:, None])
        tracks, solution = tracks.select(kept[tracks.frame]), replace(solution, confirmed=kept)


def _naming(result: PoseResult, refused: dict[int, float]) -> PoseResult:
    """The result with the ties at which joints were refused, so that its sentence names these."""
    ties = result.quality.ties
    if ties is None or not refused:
        return result
    ties = ties.index_put((torch.tensor([*refused]),), torch.tensor([*refused.values()]))
    return replace(result, quality=replace(result.quality, ties=ties))


def _assessed(
    capture: Capture, tracks: Tracks, contours: Contours, mirror_symmetry: MirrorSymmetry, solution: Solution
) -> PoseResult:
    """The result for all frames that are confirmed; the arguments are those of `pose_result`."""
    R, t, camera = solution.R, solution.t, capture.camera
    radius = torch.full((len(R),), solution.radius, dtype=torch.float64)
    X = bundle_adjustment.triangulate(tracks, R, t, camera, radius)
    scene = bundle_adjustment.BundleState(R[None], t[None], X)
    group, weight = torch.zeros(tracks.n, dtype=torch.long), torch.ones(len(tracks), dtype=torch.float64)
    # Residuals do not depend on the priors, whose values are placeholders here.
    ones = torch.ones(1, len(R), 2, dtype=torch.float64)
    problem = bundle_adjustment.Problem(camera, tracks, group, weight, ones, ones[..., 0], depth_sigma=1.0, radius=1.0)
    residual = bundle_adjustment.residuals(problem, scene)[0].norm(dim=-1)
    gap, frontier_points = _frontier_points(capture, contours, solution)
    median, inliers = _residuals_per_frame(residual, tracks.frame, len(R))
    known = ~gap.isnan()
    max_gap = MAX_GAP_RATIO * gap[known].median().clamp_min(MIN_MEDIAN_GAP) if bool(known.any()) else torch.inf
    visible = (capture.masks != BACKGROUND).flatten(1).any(1)
    if solution.confirmed is not None:
        lost = ~visible | ~solution.confirmed
    else:
        no_contour = ~contours.reliable.any(1)
        contradicted = (gap > max_gap) | gap.isnan() | (median > MAX_RESIDUAL)
        lost = ~visible | no_contour | (contradicted & (inliers < MIN_INLIERS))
        lost = ~relocalization.longest_smooth_sequence(R, ~lost, solution.parts)
    reliable = torch.zeros(tracks.n).index_add_(0, tracks.point, (residual < INLIER_THRESHOLD).float()) >= 3
    few = len(frontier_points) < 50
    sphere = _bounding_sphere(torch.cat([frontier_points, X[reliable]]) if few else frontier_points)
    sphere = _better_sphere(capture, solution, sphere, lost)
    R_first, (centre, scale) = R[0], sphere
    T = _in_sphere(solution, sphere)
    rejected, overlap = _reject_by_overlap(capture, _trajectory(T, capture), lost)
    # Where something hides the object, its masks are more doubtful than poses that matches confirm.
    lost = rejected if solution.confirmed is None else lost
    T = interpolate_lost(T, lost)
    trajectory = _trajectory(T, capture)
    points = ((X[reliable] - centre) / scale) @ R_first.mT
    colours = _point_colours(capture, tracks, residual, reliable)
    is_inlier = residual < INLIER_THRESHOLD
    observability, textured = _observability(capture, contours, solution, problem, scene, is_inlier, lost)
    if not textured:
        observability = _observability_from_symmetry(observability, mirror_symmetry)
    disagreement = solution.rotation_disagreement.float()
    rotation_range = angle_between(T.rotation[:, None], T.rotation).max().float()
    ties = None if solution.confirmed is None else _ties(tracks, is_inlier & reliable[tracks.point], lost)
    quality = PoseQuality(
        median.float(), inliers.float(), gap.float(), overlap, disagreement, lost, rotation_range, observability, ties
    )
    return _upright(PoseResult(trajectory, points.float(), colours, quality, camera))


def _consistent_side(capture: Capture, result: PoseResult) -> tuple[int, float, Bool[Tensor, " t"]] | None:
    """The first frame after a joint that the visual hull contradicts, its ties, and the frames of the better side.

    None if there is no such joint.

    The hull of parts that are joined at a wrong angle lacks what only one of them shows to be empty in this place. Of
    two sides the one with more frames is kept, if its own silhouettes are consistent or those of neither are.
    """
    quality, frame = result.quality, torch.arange(len(capture))
    if quality.ties is None or not quality.loose_from:
        return None

    def overlap(side: Bool[Tensor, " t"]) -> Float[Tensor, " t"]:
        return _best_hull_overlap(capture, result.trajectory, ~side)

    def preference(side: Bool[Tensor, " t"], alone: Float[Tensor, " t"]) -> tuple[bool, int]:
        uncertainty = replace(quality, lost=~side, overlap=alone).overlap_uncertainty
        return uncertainty <= MAX_USABLE_UNCERTAINTY, int(side.sum())

    joined, found = overlap(~quality.lost), []
    for first in quality.loose_from:
        sides = [(side, overlap(side)) for side in (~quality.lost & (frame < first), ~quality.lost & (frame >= first))]
        deficit = torch.cat([(alone - joined)[side] for side, alone in sides]).mean()
        found.append((float(deficit), first, max(sides, key=lambda each: preference(*each))[0]))
    deficit, first, kept = max(found, key=lambda each: each[0])
    return (first, float(quality.ties[first]), kept) if deficit > MAX_JOINT_DEFICIT else None


def _ties(tracks: Tracks, seen: Bool[Tensor, " o"], lost: Bool[Tensor, " t"]) -> Float[Tensor, " t"]:
    """Number of points that are seen before a frame and from then on; infinite for the first frame and lost ones.

    Args:
        seen: Observations that agree with a surface point.
    """
    ties = crossings(tracks.select(seen & ~lost[tracks.frame]), len(lost)).float()
    first = int((~lost).int().argmax())
    return ties.masked_fill(lost | (torch.arange(len(lost)) == first), torch.inf)


def _upright(result: PoseResult) -> PoseResult:
    """The result with the object frame rotated so that +y is up and +z points to the camera of the first kept frame."""
    T_cam_obj, quality = result.trajectory.T_cam_obj, result.quality
    kept = torch.nonzero(~quality.lost)[:, 0]
    R_cam_obj = T_cam_obj.rotation.matrix()[kept if len(kept) else slice(1)].double()
    R_new_obj = _rotation_to_upright(R_cam_obj, float(quality.rotation_range)).float()
    T_obj_new = SE3.from_rotation_matrix(R_new_obj.mT)
    observability = quality.observability
    # The axis of an untextured body of revolution is a direction in the first image.
    if not bool(observability.axis.isnan().any()):
        observability = replace(observability, axis=R_new_obj @ observability.axis)
    trajectory = Trajectory(T_cam_obj @ T_obj_new, result.trajectory.light)
    quality = replace(quality, observability=observability)
    return replace(result, trajectory=trajectory, points=result.points @ R_new_obj.mT, quality=quality)


def _rotation_to_upright(R_cam_obj: Float[Tensor, "t 3 3"], rotation_range: float) -> Float[Tensor, "3 3"]:
    """Rotation from the object frame to one with +y up and the first camera in the half plane of +z.

    Up is the axis of a turntable, which keeps its direction in the camera frame while the object rotates; for any other
    motion up is that of the first image.
    """
    up_cam = R_cam_obj.new_tensor([0.0, -1.0, 0.0])
    up = R_cam_obj[0].mT @ up_cam
    axes_cam, lengths, axes = torch.linalg.svd(R_cam_obj.mean(0))
    tilt_cosine = axes_cam[:, 0] @ up_cam
    steady = float(lengths[0]) > math.cos(MAX_TURNTABLE_WOBBLE) and rotation_range > MIN_TURNTABLE_RANGE
    if steady and float(tilt_cosine.abs()) > math.cos(MAX_TURNTABLE_TILT):
        up = axes[0] * tilt_cosine.sign()
    right = torch.nn.functional.normalize(torch.linalg.cross(up, -R_cam_obj[0, 2]), dim=0)
    return torch.stack([right, up, torch.linalg.cross(right, up)])


def _frontier_points(
    capture: Capture, contours: Contours, solution: Solution
) -> tuple[Float[Tensor, " t"], Float[Tensor, "n 3"]]:
    """Median tangency gap of every frame with all others [pixels], and the frontier points with small gaps."""
    n = len(solution.R)
    i, j = torch.triu_indices(n, n, 1)
    pairs = torch.stack([i, j], 1)
    parts = []
    for some in pairs.split(MAX_PAIRS):
        pose_a, pose_b = ((solution.R[k], solution.t[k]) for k in some.T)
        contours_a, contours_b = (contours[k] for k in some.T)
        part = epipolar_tangencies(pose_a, pose_b, contours_a, contours_b, capture.camera, radius=solution.radius)
        parts.append(vars(part).values())
    found = EpipolarTangencies(*(torch.cat(each) for each in zip(*parts, strict=True)))
    table = torch.full((n, n, 2), torch.nan, dtype=torch.float64)
    table[i, j] = table[j, i] = torch.where(found.valid, found.gap.abs(), torch.nan)
    gap = table.flatten(1).nanmedian(1).values
    # The depth of a point is uncertain where its rays are nearly parallel.
    angle = (solution.R[i, 2] * solution.R[j, 2]).sum(-1).clamp(-1, 1).arccos()
    wide = (angle > MIN_TRIANGULATION_ANGLE) & (angle < torch.pi - MIN_TRIANGULATION_ANGLE)
    max_gap = 2 * gap[~gap.isnan()].median().clamp_min(MIN_MEDIAN_GAP)
    chosen = found.valid & wide[:, None] & (found.gap.abs() < max_gap)
    tracks = tracks_at(found, contours, pairs, chosen)
    radius = torch.full((n,), solution.radius, dtype=torch.float64)
    return gap, bundle_adjustment.triangulate(tracks, solution.R, solution.t, capture.camera, radius)


def _residuals_per_frame(
    residual: Float[Tensor, " o"], frame: Tensor, n: int
) -> tuple[Float[Tensor, " t"], Float[Tensor, " t"]]:
    """Median residual and number of inliers of every frame."""
    groups = [residual[frame == k] for k in range(n)]
    median = torch.stack([g.median() if len(g) else g.new_tensor(torch.nan) for g in groups])
    return median, torch.stack([(g < INLIER_THRESHOLD).sum() for g in groups]).double()


def _bounding_sphere(points: Float[Tensor, "n 3"]) -> Sphere:
    """Centre and radius of the smallest sphere around all points but outliers."""
    if len(points) < 4:
        return torch.zeros(3, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    centre = points.median(0).values
    for _ in range(2):
        distance = (points - centre).norm(dim=-1)
        points = points[distance <= OUTLIER_DISTANCE * distance.quantile(0.95)]
        centre = smallest_enclosing_sphere(lambda x, points=points: points - x, centre, steps=SPHERE_STEPS)
    return centre, (points - centre).norm(dim=-1).max()


def _better_sphere(capture: Capture, solution: Solution, sphere: Sphere, lost: Bool[Tensor, " t"]) -> Sphere:
    """The sphere of the frontier points, or that of the visual hull if silhouettes confirm that instead.

    Frontier points are few and wrong where hands hide much of the contours. A sphere that is too small cuts the visual
    hull off.
    """

    def overlap(sphere: Sphere) -> float:
        trajectory = _trajectory(_in_sphere(solution, sphere), capture)
        return float(_hull_overlap(capture, trajectory, lost, 0.0)[~lost].median())

    if bool(lost.all()) or (confirmed := overlap(sphere)) > CONFIRMED_OVERLAP:
        return sphere
    large = torch.zeros_like(sphere[0]), HULL_MARGIN * sphere[1].new_tensor(solution.radius)
    hull = _hull(capture, _trajectory(_in_sphere(solution, large), capture), lost, HULL_TOLERANCES[-1])
    cells = ((torch.nonzero(hull > 0.5) + 0.5) / HULL_RESOLUTION * 2 - 1).double()
    if len(cells) < MIN_HULL_CELLS:
        return sphere
    centre, scale = _bounding_sphere(cells @ solution.R[0] * large[1])
    return max((sphere, confirmed), ((centre, scale), overlap((centre, scale))), key=lambda pair: pair[1])[0]


def _in_sphere(solution: Solution, sphere: Sphere) -> SE3:
    """Poses whose object frame has the sphere as unit sphere and the axes of the first camera."""
    R, (centre, scale) = solution.R, sphere
    return SE3.from_rotation(SO3.from_matrix(R @ R[0].mT), (solution.t + R @ centre) / scale)


def _trajectory(T: SE3, capture: Capture) -> Trajectory:
    return Trajectory(SE3(T.wxyz.float(), T.xyz.float()), capture.light)


def _point_colours(
    capture: Capture, tracks: Tracks, residual: Float[Tensor, " o"], reliable: Bool[Tensor, " n"]
) -> Float[Tensor, "m 3"]:
    """Linear RGB of the reliable points: the median over their inlier observations."""
    column, row = tracks.uv.floor().long().T
    size = capture.camera
    code = capture.images[tracks.frame, row.clamp(0, size.height - 1), column.clamp(0, size.width - 1)]
    colour = linear_from_srgb(code.float() / 255)
    order = torch.argsort(tracks.point, stable=True)
    chosen = order[(residual < INLIER_THRESHOLD)[order] & reliable[tracks.point[order]]]
    parts = colour[chosen].split(torch.bincount(tracks.point[chosen], minlength=tracks.n)[reliable].tolist())
    return torch.stack([part.median(0).values for part in parts]) if parts else colour[:0]


def _reject_by_overlap(
    capture: Capture, trajectory: Trajectory, lost: Bool[Tensor, " t"]
) -> tuple[Bool[Tensor, " t"], Float[Tensor, " t"]]:
    """Lost frames, extended by those whose silhouette contradicts the visual hull of the others; also all overlaps.

    Several wrong frames distort the visual hull of all, which is therefore carved again without rejected frames, for as
    long as it contradicts others.
    """
    while True:
        overlap = _best_hull_overlap(capture, trajectory, lost)
        if bool(lost.all()):
            return lost, overlap
        contradicted = (overlap < overlap[~lost].median() - MAX_OVERLAP_DEFICIT) & ~lost
        if not bool(contradicted.any()):
            return lost, overlap
        lost = lost | contradicted


def _best_hull_overlap(capture: Capture, trajectory: Trajectory, lost: Bool[Tensor, " t"]) -> Float[Tensor, " t"]:
    """`_hull_overlap` with the tolerance that suits the frames that are not lost best."""
    overlaps = [_hull_overlap(capture, trajectory, lost, tolerance) for tolerance in HULL_TOLERANCES]
    return max(overlaps, key=lambda each: float(each[~lost].sum()))


def _hull_overlap(
    capture: Capture, trajectory: Trajectory, lost: Bool[Tensor, " t"], tolerance: float
) -> Float[Tensor, " t"]:
    """Intersection over union of all silhouettes with that of the visual hull of the frames that are not lost."""
    if bool(lost.all()):
        return torch.zeros(len(capture))
    inside = _hull(capture, trajectory, lost, tolerance)
    camera = capture.camera.resized(HULL_RESOLUTION, HULL_RESOLUTION)
    ticks = torch.arange(HULL_RESOLUTION) + 0.5
    rows = (ticks * capture.camera.height / HULL_RESOLUTION).long()
    columns = (ticks * capture.camera.width / HULL_RESOLUTION).long()
    overlaps = []
    for frame in range(len(trajectory)):
        hit = _hull_silhouette(inside, trajectory.T_cam_obj[frame], camera)
        mask = capture.masks[frame][rows][:, columns]
        counted, silhouette = mask != UNKNOWN, mask != BACKGROUND
        overlaps.append(iou(hit, silhouette, counted))
    return torch.stack(overlaps)


def _hull(
    capture: Capture, trajectory: Trajectory, lost: Bool[Tensor, " t"], tolerance: float
) -> Float[Tensor, "x y z"]:
    """Visual hull of the frames that are not lost."""
    kept = torch.nonzero(~lost)[:, 0]
    frames = replace(capture, trajectory=None).select(kept.tolist())
    return visual_hull.carve(frames, trajectory.select(kept), resolution=HULL_RESOLUTION, tolerance=tolerance)


def _hull_silhouette(inside: Float[Tensor, "x y z"], T_cam_obj: SE3, camera: Camera) -> Bool[Tensor, "h w"]:
    """Pixels whose rays hit the visual hull; only rays and depths close to its cells are sampled."""
    cell = 2 / len(inside)
    x_cam = T_cam_obj @ ((torch.nonzero(inside > 0.5) + 0.5) * cell - 1)
    hit = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    if not len(x_cam):
        return hit
    # A sample is inside only if one of the eight cells around it is.
    reach = math.sqrt(3) * cell
    near, far = float(x_cam[:, 2].min()) - reach, float(x_cam[:, 2].max()) + reach
    depth = T_cam_obj.xyz[2] + torch.linspace(-1.1, 1.1, 2 * HULL_RESOLUTION)
    depth = depth[(depth >= near) & (depth <= far)]
    directions = camera.unproject(camera.pixel_centers(), torch.ones_like(hit, dtype=torch.float))
    slope = x_cam[:, :2] / x_cam[:, 2:]
    margin = reach / max(near, 1e-6) * (1 + float(slope.abs().max()))
    inner = (directions[..., :2] > slope.amin(0) - margin) & (directions[..., :2] < slope.amax(0) + margin)
    close = inner.all(-1) if near > 0 else torch.ones_like(hit)
    x_obj = T_cam_obj.inverse() @ (directions[close][:, None] * depth[:, None])
    grid = x_obj.flip(-1)[None, None]  # grid_sample expects the last axis of the volume first
    sampled = torch.nn.functional.grid_sample(inside[None, None], grid, align_corners=False)[0, 0, 0]
    hit[close] = (sampled > 0.5).any(-1)
    return hit


def _observability(
    capture: Capture,
    contours: Contours,
    solution: Solution,
    problem: bundle_adjustment.Problem,
    scene: bundle_adjustment.BundleState,
    inlier: Tensor,
    lost: Bool[Tensor, " t"],
) -> tuple[Observability, bool]:
    """Standard deviations of a frame's rotation, from the Fisher information of texture and contours.

    The points are held fixed, the translation is eliminated, and the information is averaged over the frames that are
    not lost, normalised by its trace. Also returned is whether the object has texture, without which a body of
    revolution is recognised by the mirror symmetry of its silhouettes instead.
    """
    R, t, camera, n = solution.R, solution.t, capture.camera, len(solution.R)
    texture = texture_information.information(capture, problem.tracks) * inlier[:, None, None]
    # The noise of a good match limits how precisely a position is known.
    precision = torch.linalg.inv(
        torch.linalg.inv(texture + 1e-9 * torch.eye(2, dtype=torch.float64))
        + bundle_adjustment.NOISE**2 * torch.eye(2, dtype=torch.float64)
    )
    # Outliers tell nothing: of a point behind a camera even a precision of 1e-9 would outweigh all others.
    information = bundle_adjustment.information(problem, scene, precision * inlier[:, None, None])
    kept = torch.nonzero(~lost)[:, 0] if int((~lost).sum()) > 1 else torch.arange(n)
    frames, references = (kept[:: max(1, len(kept) // m)] for m in (ASSESSED_FRAMES, REFERENCE_FRAMES))
    for k in frames.tolist():
        others = references[references != k]
        contour, other_contours = contours[torch.tensor([k])], contours[others]
        constraints = ContourConstraints((R[others], t[others]), contour, other_contours, camera, solution.radius)
        information[k] += relocalization.information(constraints, R[k], t[k])
    information = information[frames]
    H = information[:, :3, :3] - information[:, :3, 3:] @ torch.linalg.solve(
        information[:, 3:, 3:] + 1e-9 * torch.eye(3, dtype=torch.float64), information[:, 3:, :3]
    )
    R_first_cam = R[0] @ R[frames].mT  # from each camera to the object frame of the result
    H = R_first_cam @ H @ R_first_cam.mT
    trace = H.diagonal(dim1=1, dim2=2).sum(-1)
    typical = trace.median() * (H / trace.clamp_min(1e-9)[:, None, None]).mean(0)
    eigenvalues, axes = torch.linalg.eigh(typical)
    estimate = Observability(axes[:, 0].float(), eigenvalues.clamp_min(1 / torch.pi**2).rsqrt().float())
    smaller, larger = torch.linalg.eigvalsh(texture).T
    # Rounding leaves a small eigenvalue along an edge.
    return estimate, not bool((smaller > 1e-6 * larger).double().mean() < MIN_TEXTURED_FRACTION)


def _observability_from_symmetry(estimate: Observability, mirror_symmetry: MirrorSymmetry) -> Observability:
    """Observability of an untextured object: no rotation about an axis of revolution, none at all of a sphere.

    The estimate, which depends on the estimated poses, is kept where the object is not a body of revolution.
    """
    if not mirror_symmetry.is_revolution:
        return estimate
    if mirror_symmetry.is_sphere:
        return replace(estimate, sigma=torch.full_like(estimate.sigma, torch.pi))
    axis = torch.nn.functional.pad(mirror_symmetry.axis, (0, 1), value=torch.nan)
    across = estimate.sigma[1:].clamp_max(UNOBSERVABLE_SIGMA)
    return Observability(axis, torch.cat([estimate.sigma.new_full((1,), torch.pi), across]))
