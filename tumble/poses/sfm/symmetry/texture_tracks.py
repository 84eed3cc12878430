"""Texture tracks: points of the visual hull's surface, located in all frames that show them by their texture.

Chained matches follow a surface point for a few frames only, so that small errors add up over a turn, and where shading
and highlights have more contrast than the texture, all of them err alike. Here patches of the surface are sampled from
all frames at once, at approximate poses. In each patch the mean and the slope of the brightness are removed, and with
them smooth shading; the mean patch of all other frames is then searched for in each frame, by normalised
cross-correlation. What remains between both is the error of the poses, a few pixels. The position found is an
observation of the point in that frame. As bundle adjustment moves the points freely, errors of the hull cancel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from tumble.poses.sfm.tracks import NO_TRACKS, Tracks, concatenate
from tumble.scene import OBJECT, Camera, Capture, Trajectory, visual_hull

HULL_RESOLUTION = 64
"""Cells of the hull's grid along each side."""
HULL_TOLERANCE = 0.03
"""Fraction of the frames that may carve the hull in error: the pose of a single wrong frame would carve it away."""
POINTS = 3000
"""Surface points that are searched for."""
POINTS_AT_ONCE = 128
"""Number of points that are searched for at once, which limits memory."""
HALF = 3
"""Half the width of a patch without its middle [pixels at the object's mean distance]."""
WINDOW_SIGMA = 0.6
"""Standard deviation of the Gaussian that weights the pixels of a patch [`HALF`]."""
REACH = 3
"""Largest shift of a patch that is searched for [pixels]."""
MIN_COSINE = 0.25
"""Minimum cosine between normal and line of sight for a point to be visible."""
LIFT = 0.03
"""Distance from the surface at which occlusion of a point begins [object radius]; about a cell."""
OCCLUSION_SAMPLES = 24
"""Samples on the line of sight, over one object radius, by which occlusion is found."""
SEARCHES = 3
"""Number of times that all patches are compared with the mean patches, which get sharper."""
MIN_CORRELATION = 0.6
"""Minimum correlation of a patch with the mean patch."""
MIN_CURVATURE = 0.02
"""Minimum curvature of the correlation over the shift, in the direction in which it is least [1 / pixel^2]; along an
edge there is none."""
MAX_VARIANCE = 1.0
"""Maximum of (1 - correlation) / curvature, to which the variance of the position is proportional [pixels^2]."""
MIN_OBSERVATIONS = 3
"""Points that fewer frames show are dropped."""


@dataclass(frozen=True)
class _Patches:
    """Patches of surface points, one for every frame that shows the point; each is wider than the mean patches by
    `REACH` on every side."""

    frame: Int64[Tensor, " m"]
    point: Int64[Tensor, " m"]
    cosine: Float[Tensor, " m"]
    """Cosine between normal and line of sight."""
    values: Float[Tensor, "m s s"]
    """Brightness [code values]."""

    def of_points(self, first: int, end: int) -> "_Patches":
        """Those of the points from `first` on, before `end`."""
        mine = (self.point >= first) & (self.point < end)
        return _Patches(*(values[mine] for values in vars(self).values()))


def texture_tracks(capture: Capture, trajectory: Trajectory, rng: torch.Generator) -> Tracks:
    """Observations of surface points by their texture, at least `MIN_OBSERVATIONS` for each.

    Args:
        capture: Images and masks of all frames.
        trajectory: Approximate poses, wrong by a few pixels; the object lies in the unit sphere.
        rng: Source of the random choice of points.
    """
    try:
        surface, patches = _surface_patches(capture, trajectory, POINTS, rng)
    except ValueError:  # The poses contradict each other.
        return NO_TRACKS
    found = []
    for first in range(0, len(surface.positions), POINTS_AT_ONCE):
        some = patches.of_points(first, first + POINTS_AT_ONCE)
        if len(some.frame):
            found.append(_located(some, capture.camera, trajectory, surface))
    return concatenate(NO_TRACKS, *found)


@dataclass(frozen=True)
class Agreement:
    """How much the frames agree about the texture of surface points at given poses."""

    positions: Float[Tensor, "n 3"]
    """Points of the visual hull, object frame."""
    correlation: Float[Tensor, " n"]
    """Correlation of a point's patch in each frame with its mean patch of all others, averaged over the frames."""
    weight: Float[Tensor, " n"]
    """Contrast of the texture, summed over the frames; 0 for a point that no frame shows."""

    def mean(self, some: Bool[Tensor, " n"] | None = None) -> float:
        """Mean correlation, weighted by contrast, of some points or of all; 0 if none is seen."""
        weight = self.weight if some is None else self.weight * some
        return float((self.correlation * weight).sum() / weight.sum().clamp_min(1e-6))


def texture_agreement(capture: Capture, trajectory: Trajectory, points: int) -> Agreement:
    """The agreement of all frames about `points` points of the visual hull; the object lies in the unit sphere.

    Raises:
        ValueError: The poses contradict each other, so that there is no hull.
    """
    surface, patches = _surface_patches(capture, trajectory, points, torch.Generator().manual_seed(0))
    middle, (window, smooth) = slice(REACH, REACH + 2 * HALF + 1), _window(2 * HALF + 1)
    values, contrast = _normalised(patches.values[:, middle, middle].flatten(1), window, smooth)
    weight, point = patches.cosine * contrast, patches.point
    mean = _mean_of_others(values * weight[:, None], point, points, window, smooth)
    agreement, weights = torch.zeros(2, points)
    agreement.index_add_(0, point, weight * (values * mean * window).sum(-1))
    weights.index_add_(0, point, weight)
    return Agreement(surface.positions, agreement / weights.clamp_min(1e-6), weights)


def _surface_patches(
    capture: Capture, trajectory: Trajectory, points: int, rng: torch.Generator
) -> tuple[visual_hull.OrientedPoints, _Patches]:
    """Points on the visual hull, and their patches in all frames.

    Raises:
        ValueError: The poses contradict each other, so that there is no hull.
    """
    cells = visual_hull.carve(capture, trajectory, resolution=HULL_RESOLUTION, tolerance=HULL_TOLERANCE, outside=0.0)
    surface = visual_hull.sample_surface(cells, points, rng)
    return surface, _sampled(capture, trajectory, cells, surface)


def _plane(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 3"]:
    """Two orthogonal unit vectors along the surface."""
    across = torch.eye(3).to(normals)[normals.abs().argmin(1)]
    first = normalize(torch.linalg.cross(normals, across), dim=-1)
    return torch.stack([first, torch.linalg.cross(normals, first)], 1)


def _pixel(camera: Camera, trajectory: Trajectory) -> float:
    """Size of a pixel at the object's mean distance [object radius]."""
    return float(trajectory.T_cam_obj.xyz[:, 2].mean() / camera.fx_fy_cx_cy[:2].prod().sqrt())


def _sampled(
    capture: Capture, trajectory: Trajectory, cells: Float[Tensor, "x y z"], surface: visual_hull.OrientedPoints
) -> _Patches:
    """Patches of points in all frames that show them, wholly on the object.

    Args:
        cells: Occupancy of the visual hull.
        surface: Points on its surface.
    """
    x, normals, camera = surface.positions, surface.normals, capture.camera
    ticks = torch.arange(-HALF - REACH, HALF + REACH + 1) * _pixel(camera, trajectory)
    axes = _plane(normals)
    spread = x[:, None, None] + ticks[:, None, None] * axes[:, None, None, 0] + ticks[:, None] * axes[:, None, None, 1]
    size = torch.tensor([camera.width, camera.height])
    parts = []
    for frame, centre in enumerate(trajectory.camera_positions):
        cosine = visual_hull.view_cosine(centre, x, normals)
        point = torch.nonzero(cosine > MIN_COSINE)[:, 0]
        point = point[~_occluded(cells, x[point], normals[point], centre)]
        uv = camera.project(trajectory.T_cam_obj[frame] @ spread[point].reshape(-1, 3))
        at = (2 * uv / size - 1).reshape(1, -1, len(ticks), 2)
        image = torch.stack([capture.images[frame].float().mean(-1), (capture.masks[frame] == OBJECT).float()])
        grey, covered = grid_sample(image[None], at, align_corners=False)[0].reshape(2, -1, *spread.shape[1:3])
        whole = (covered > 1 - 1e-3).flatten(1).all(1)
        point = point[whole]
        parts.append(_Patches(torch.full_like(point, frame), point, cosine[point], grey[whole]))
    return _Patches(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def _occluded(
    cells: Float[Tensor, "x y z"], x: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], camera: Float[Tensor, "3"]
) -> Bool[Tensor, " n"]:
    """Whether the hull lies between surface points and a camera centre."""
    steps = torch.linspace(LIFT, 1 + LIFT, OCCLUSION_SAMPLES)[:, None]
    between = (x + LIFT * normals)[:, None] + steps * normalize(camera - x, dim=-1)[:, None]
    occupancy = grid_sample(cells[None, None], between[None, None].flip(-1), align_corners=False)
    return (occupancy[0, 0, 0] > 0.5).any(-1)


def _located(patches: _Patches, camera: Camera, trajectory: Trajectory, surface: visual_hull.OrientedPoints) -> Tracks:
    """Observations of the points whose patches are found in several frames."""
    shift, sure = _shifts(patches)
    frame, point = patches.frame[sure], patches.point[sure]
    shift = shift[sure] * _pixel(camera, trajectory)
    shifted = surface.positions[point] + (shift[:, :, None] * _plane(surface.normals[point])).sum(1)
    uv = torch.zeros(len(frame), 2)
    for k in frame.unique().tolist():
        uv[frame == k] = camera.project(trajectory.T_cam_obj[k] @ shifted[frame == k])
    every = torch.ones(len(frame), dtype=torch.bool)
    return Tracks(frame, point, uv.double()).select(every, MIN_OBSERVATIONS)


def _shifts(patches: _Patches) -> tuple[Float[Tensor, "m 2"], Bool[Tensor, " m"]]:
    """By how much every patch is shifted against the mean patch of its point [pixels], and whether that is sure."""
    points, point = patches.point.unique(return_inverse=True)
    width, shifts = 2 * HALF + 1, 2 * REACH + 1
    window, smooth = _window(width)
    candidates = patches.values.unfold(1, width, 1).unfold(2, width, 1).reshape(-1, shifts * shifts, width * width)
    candidates, contrast = _normalised(candidates, window, smooth)
    every, middle = torch.arange(len(candidates)), shifts * shifts // 2
    own_weight = patches.cosine * contrast[:, middle]
    weight, best = own_weight, torch.full_like(every, middle)
    correlation = torch.zeros_like(contrast)
    for _ in range(SEARCHES):
        chosen = candidates[every, best] * weight[:, None]
        mean = _mean_of_others(chosen, point, len(points), window, smooth)
        correlation = torch.einsum("msp,mp->ms", candidates, mean * window)
        best = correlation.argmax(1)
        weight = own_weight * correlation.amax(1).clamp_min(0).square()
    return _peak(correlation.reshape(-1, shifts, shifts), best // shifts, best % shifts)


def _normalised(
    values: Float[Tensor, "*b p"], window: Float[Tensor, " p"], smooth: Float[Tensor, "p p"]
) -> tuple[Float[Tensor, "*b p"], Float[Tensor, "*b"]]:
    """Patches without mean and slope, of unit contrast, and their contrast before [code values]."""
    rest = values - values @ smooth.T
    contrast = (rest.square() * window).sum(-1, keepdim=True).sqrt()
    return rest / contrast.clamp_min(1e-6), contrast[..., 0]


def _mean_of_others(
    patches: Float[Tensor, "m p"],
    point: Int64[Tensor, " m"],
    points: int,
    window: Float[Tensor, " p"],
    smooth: Float[Tensor, "p p"],
) -> Float[Tensor, "m p"]:
    """Mean patch of all other frames that show a patch's point, of unit contrast; every patch agrees with itself.

    Args:
        patches: Normalised patches times their weights.
        points: Number of points.
    """
    total = torch.zeros(points, patches.shape[1]).index_add_(0, point, patches)
    return _normalised(total[point] - patches, window, smooth)[0]


def _window(width: int) -> tuple[Float[Tensor, " p"], Float[Tensor, "p p"]]:
    """Weights of a patch's pixels, of sum 1, and the projection of its values onto their mean and slope."""
    at = torch.arange(width) - width // 2
    weight = torch.exp(-0.5 * (at[:, None] ** 2 + at**2) / (WINDOW_SIGMA * HALF) ** 2).flatten()
    weight = weight / weight.sum()
    row, column = torch.meshgrid(at.float(), at.float(), indexing="ij")
    basis = torch.stack([torch.ones_like(row), row, column], -1).reshape(-1, 3)
    weighted = weight[:, None] * basis
    return weight, basis @ torch.linalg.solve(basis.T @ weighted, weighted.T)


def _peak(
    correlation: Float[Tensor, "m s s"], row: Int64[Tensor, " m"], column: Int64[Tensor, " m"]
) -> tuple[Float[Tensor, "m 2"], Bool[Tensor, " m"]]:
    """Shift of the maximum by a quadratic fit around its cell [pixels], and whether it is a clear maximum."""
    last = correlation.shape[1] - 2
    inside = (row >= 1) & (row <= last) & (column >= 1) & (column <= last)
    row, column = row.clamp(1, last), column.clamp(1, last)
    m = torch.arange(len(correlation))

    def at(rows: int, columns: int) -> Tensor:
        return correlation[m, row + rows, column + columns]

    peak = at(0, 0)
    gradient = torch.stack([at(1, 0) - at(-1, 0), at(0, 1) - at(0, -1)], -1) / 2
    rr, cc = at(1, 0) + at(-1, 0) - 2 * peak, at(0, 1) + at(0, -1) - 2 * peak
    rc = (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)) / 4
    # The smaller curvature is the smaller eigenvalue of the negative Hessian.
    curvature = -(rr + cc) / 2 - (((rr - cc) / 2).square() + rc.square()).sqrt()
    clear = inside & (peak > MIN_CORRELATION) & (curvature > MIN_CURVATURE)
    clear &= 1 - peak < MAX_VARIANCE * curvature
    determinant = torch.where(clear, rr * cc - rc * rc, 1.0)
    offset = torch.stack([rc * gradient[:, 1] - cc * gradient[:, 0], rc * gradient[:, 0] - rr * gradient[:, 1]], -1)
    offset = offset / determinant[:, None]
    middle = torch.stack([row, column], -1) - correlation.shape[1] // 2
    return middle + offset, clear & (offset.abs() < 1).all(-1)
