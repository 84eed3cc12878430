"""Spin: the rotation of a body of revolution about its axis, from texture unwrapped on its surface.

Rotations about the axis do not change the silhouettes, so that they are observable from texture alone.

Most matches on a body with little texture are wrong about the spin in the same way: shading and highlights keep their
place in the image while the surface turns, so optical flow reports too little motion wherever these have more contrast
than the texture. The silhouettes of a body of revolution however determine its surface. Every frame is sampled on that
surface, over the angle about the axis and the position along it: a spin shifts such a map along the angle. The maps of
all pairs of frames are compared for all shifts by their normalised cross-correlation, after the mean over nearby angles
is subtracted. This removes smooth shading, and weighs texture by its contrast instead of its area. A spin that shading
explains as well, because it keeps the object still before the camera, is not used.

Frames that look along the axis show nothing of the side, so that the parts of the capture before and after them are
compared as wholes. A label that repeats on the other side correlates as well after half a turn: the turn between two
parts is to leave the motion smooth.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import avg_pool1d, grid_sample, normalize, pad

from tumble.maths import SO3
from tumble.poses.sfm.tracks import Tracks
from tumble.scene import OBJECT, Capture, Trajectory, visual_hull

ANGLES = 180
"""Cells of a map over the angle about the axis."""
HEIGHTS = 32
"""Cells of a map along the axis."""
HULL_RESOLUTION = 64
"""Cells of the visual hull's grid along each side."""
PROFILE_MARGIN = 0.01
"""Fraction of the hull's cells at either end of the axis that the surface leaves out."""
MEAN_WINDOW = 17
"""Width of the window whose mean is subtracted [cells of the angle]; shading changes little within it."""
MIN_COSINE = 0.15
"""Minimum cosine between normal and line of sight for a cell to be visible."""
MAX_STEP = math.radians(30)
"""Largest error of the spin between consecutive frames that is searched for [radians]; repeating patterns, such as six
equal panels, match again at larger shifts."""
REFINED_STEP = math.radians(10)
"""Largest change of a frame's spin when all frames are compared with all [radians]."""
NEAR = 8
"""Distance in time up to which frames are compared at first [frames]."""
SWEEPS = 4
"""Number of times that the spin of every frame is chosen anew, given all others."""
MIN_CONTRAST = 0.1
"""Energy of the texture that two maps have in common, relative to the median frame's, at which a correlation counts
half: where only untextured parts overlap, noise correlates."""
STEP_PENALTY = 0.006
"""Penalty on a change of the given spin between consecutive frames, which decides where a frame shows no texture, and
on the difference between the spin from one part to the next and that of a smooth motion [mean correlation / degree]."""
MIN_CORRELATION = 0.3
"""Minimum mean correlation of a frame with those near in time, with the spin found, for its texture to show the spin;
shading and noise alone reach 0.28."""
CONTRADICTION = 0.8
"""Ratio of the correlation for another spin to that for the spin found below which texture contradicts that one."""
MIN_CONTRADICTED = 4
"""Number of frames that contradict the given poses from which these are wrong; the first or last two may do so by
noise, as they are compared with few others."""
MIN_VISIBLE = 0.3
"""Visible area of the surface, relative to the median frame's, below which a frame looks along the axis."""
MIN_PART = 5
"""Minimum number of consecutive frames with a view of the side that are compared as a whole."""
RATE_STEPS = 4
"""Number of steps from frame to frame before and after a gap that tell how fast the object spins there."""
MAX_SLIP = 1.5
"""Largest distance of a track's observations from one surface point [pixels]."""


@dataclass(frozen=True)
class SurfaceOfRevolution:
    """A surface of revolution, object frame."""

    centre: Float[Tensor, "3"]
    """A point on the axis."""
    axes: Float[Tensor, "3 3"]
    """Unit vectors of a right-handed frame, of which the last is the axis."""
    height: Float[Tensor, " z"]
    """Positions along the axis, relative to the centre, equally spaced."""
    radius: Float[Tensor, " z"]
    """Distance of the surface from the axis there."""

    def cells(self) -> tuple[Float[Tensor, "a z 3"], Float[Tensor, "a z 3"]]:
        """Points of the surface over angle and position along the axis, and the outward unit normals there."""
        angle = torch.arange(ANGLES) * (2 * math.pi / ANGLES)
        outward = angle.cos()[:, None] * self.axes[0] + angle.sin()[:, None] * self.axes[1]
        slope = torch.gradient(self.radius, spacing=(self.height,))[0]
        x = self.centre + outward[:, None] * self.radius[:, None] + self.height[:, None] * self.axes[2]
        return x, normalize(outward[:, None] - slope[:, None] * self.axes[2], dim=-1)

    def turned(self, trajectory: Trajectory, angle: Float[Tensor, " t"]) -> Trajectory:
        """Poses whose object is first turned about the axis by these angles [radians]."""
        return trajectory.turned(SO3.exp(angle[:, None] * self.axes[2]), self.centre)


@dataclass(frozen=True)
class Spin:
    """Spin of every frame that the texture shows, relative to given poses."""

    surface: SurfaceOfRevolution
    angle: Float[Tensor, " t"]
    """By what the object is turned about the axis, before the given pose, to agree with the other frames [radians]; its
    median is 0."""
    given_correlation: Float[Tensor, " t"]
    """Mean correlation of every frame's map with those of frames at most `NEAR` away in time, at the given poses."""
    correlation: Float[Tensor, " t"]
    """The same after the turn."""
    static_correlation: Float[Tensor, " t"]
    """The same if the object is turned so that it does not spin before the camera, as shading does not."""
    joined: int
    """Number of times that texture contradicts the given turn between the parts before and after frames that look along
    the axis."""

    @property
    def is_better(self) -> bool:
        """Whether texture, not shading, contradicts the given poses of several frames, or between two parts."""
        contradicted = _contradicts(self.correlation, self.given_correlation, self.static_correlation)
        return self.joined > 0 or int(contradicted.sum()) >= MIN_CONTRADICTED


def estimate_spin(capture: Capture, trajectory: Trajectory, surface: SurfaceOfRevolution | None = None) -> Spin | None:
    """Spin of a body of revolution in every frame; None if the poses and silhouettes contradict each other.

    Args:
        capture: Images and masks of all frames.
        trajectory: Poses that are right but for the spin; the object lies in the unit sphere.
        surface: The body's surface at these poses; None: that of the visual hull.
    """
    surface = surface or surface_of_revolution(capture, trajectory)
    if surface is None or len(trajectory) < 2:
        return None
    contrast, weight = _unwrapped(capture, trajectory, surface)
    product, energy = _products(contrast, weight)
    score = product / energy
    towards_camera = (trajectory.T_cam_obj.inverse().xyz - surface.centre) @ surface.axes.mT
    static = (torch.atan2(towards_camera[:, 1], towards_camera[:, 0]) / (2 * math.pi) * ANGLES).round().long()
    rotation = trajectory.T_cam_obj.rotation
    given = (rotation[:-1].inverse() @ rotation[1:]).log() @ surface.axes[2] / (2 * math.pi) * ANGLES
    parts = list(pairwise(_parts(weight)))
    shift = _refined_shifts(score, _joined(product, energy, _shifts_near(score), static, given, parts))
    joined = [
        _contradicts(*(_correlation_between(product, energy, s, *pair) for s in (shift, 0 * shift, static)))
        for pair in parts
    ]
    return Spin(
        surface,
        _least_turn(shift - shift.median()) * (2 * math.pi / ANGLES),
        given_correlation=_correlations_near(score, 0 * shift),
        correlation=_correlations_near(score, shift),
        static_correlation=_correlations_near(score, static),
        joined=sum(map(bool, joined)),
    )


def _least_turn(cells: Tensor) -> Tensor:
    """Turns of at most half a revolution that are the same [cells]."""
    return (cells + ANGLES // 2) % ANGLES - ANGLES // 2


def _contradicts(found: Tensor, given: Tensor, static: Tensor) -> Tensor:
    """Whether texture with this correlation contradicts the given poses, and shading does not explain it as well.

    Args:
        found: Correlation with the spin found.
        given: Correlation with the given spin.
        static: Correlation if the object does not spin before the camera.
    """
    return (found > MIN_CORRELATION) & (torch.maximum(given, static) < CONTRADICTION * found)


def surface_of_revolution(capture: Capture, trajectory: Trajectory) -> SurfaceOfRevolution | None:
    """Surface of revolution with the cross sections of the visual hull; None if the hull is empty.

    The axis is the principal axis of the hull whose moment of inertia differs most from the other two.
    """
    cells = visual_hull.carve(capture, trajectory, resolution=HULL_RESOLUTION, outside=0.0)
    x = (torch.nonzero(cells > 0.5) + 0.5) / HULL_RESOLUTION * 2 - 1
    if len(x) < HEIGHTS:
        return None
    centre = x.mean(0)
    variance, directions = torch.linalg.eigh(torch.cov((x - centre).T))
    axis = directions[:, 0 if variance[1] * variance[1] > variance[0] * variance[2] else 2]
    across = normalize(torch.linalg.cross(axis, torch.eye(3)[axis.abs().argmin()]), dim=0)
    position = (x - centre) @ axis
    low, high = position.quantile(torch.tensor([PROFILE_MARGIN, 1 - PROFILE_MARGIN]))
    thickness = (high - low) / HEIGHTS
    layer = ((position - low) / thickness).floor().long()
    volume = torch.bincount(layer[(layer >= 0) & (layer < HEIGHTS)], minlength=HEIGHTS) * (2 / HULL_RESOLUTION) ** 3
    # A layer has few cells across: layers are averaged.
    area = avg_pool1d(pad((volume / thickness)[None], (2, 2), mode="replicate"), 5, 1)[0]
    height = low + (torch.arange(HEIGHTS) + 0.5) * thickness
    return SurfaceOfRevolution(
        centre, torch.stack([across, torch.linalg.cross(axis, across), axis]), height, (area / math.pi).sqrt()
    )


def axis_deviation(capture: Capture, a: Trajectory, b: Trajectory) -> Float[Tensor, " t"] | None:
    """Angle in every frame between the axes of a body of revolution at two trajectories, whatever the spin [radians].

    None if the poses and silhouettes of either contradict each other.
    """
    lines = []
    for each in (a, b):
        surface = surface_of_revolution(capture, each)
        if surface is None:
            return None
        lines.append(each.T_cam_obj.rotation @ surface.axes[2])
    cosine = (lines[0] * lines[1]).sum(-1)
    # Both ends of an axis are alike.
    return (cosine * cosine.sum().sign()).clamp(-1, 1).arccos()


def _visible_cells(
    capture: Capture, trajectory: Trajectory, surface: SurfaceOfRevolution
) -> tuple[Float[Tensor, "t a z 2"], Float[Tensor, "t a z"]]:
    """Positions of the surface's cells in all frames [pixels], and how visible they are, 0 to 1."""
    x, normals = surface.cells()
    cosine = visual_hull.view_cosine(trajectory.camera_positions[:, None, None], x, normals)
    uv = torch.stack(
        [capture.camera.project(trajectory.T_cam_obj[k] @ x.reshape(-1, 3)) for k in range(len(trajectory))]
    )
    return uv.reshape(*cosine.shape, 2), (cosine - MIN_COSINE).clamp_min(0) / (1 - MIN_COSINE)


def _unwrapped(
    capture: Capture, trajectory: Trajectory, surface: SurfaceOfRevolution
) -> tuple[Float[Tensor, "t a z"], Float[Tensor, "t a z"]]:
    """Maps of the texture's contrast in every frame [code values], and the weights of their cells."""
    uv, weight = _visible_cells(capture, trajectory, surface)
    inside = (capture.masks == OBJECT).float()
    image = torch.stack([capture.images.float().mean(-1), inside], 1)
    size = torch.tensor([capture.camera.width, capture.camera.height])
    grey, covered = grid_sample(image, 2 * uv / size - 1, align_corners=False).unbind(1)
    weight = weight * (covered > 1 - 1e-3)
    visible = (weight > 0).float()

    def mean(values: Tensor) -> Tensor:
        wrapped = pad(values.mT, (MEAN_WINDOW // 2, MEAN_WINDOW // 2), mode="circular")
        return avg_pool1d(wrapped, MEAN_WINDOW, 1).mT

    return (grey - mean(grey * visible) / mean(visible).clamp_min(1e-6)) * visible, weight


def _products(
    contrast: Float[Tensor, "t a z"], weight: Float[Tensor, "t a z"]
) -> tuple[Float[Tensor, "t t a"], Float[Tensor, "t t a"]]:
    """Sums over the cells of the products of all pairs of maps for all shifts of the second one [cells], and their
    energies, of which the former are the fraction that correlates.

    The energy is larger where the maps have little texture in common.
    """
    products, energies, w = (torch.fft.rfft(x, dim=1) for x in (weight * contrast, weight * contrast.square(), weight))

    def correlate(a: Tensor, b: Tensor) -> Float[Tensor, "t t a"]:
        # One frame at a time, which limits memory.
        return torch.stack([torch.fft.irfft((row.conj() * b).sum(-1), n=ANGLES, dim=1) for row in a])

    common = (correlate(energies, w).clamp_min(0) * correlate(w, energies).clamp_min(0)).sqrt()
    typical = common[:, :, 0].diagonal().median()
    return correlate(products, products), (common + MIN_CONTRAST * typical).clamp_min(1e-6)


def _correlations_near(score: Float[Tensor, "t t a"], shift: Int64[Tensor, " t"]) -> Float[Tensor, " t"]:
    """Mean correlation of every frame with the others at most `NEAR` away in time, for given shifts [cells]."""
    frames = torch.arange(len(shift))
    correlation = score[frames[:, None], frames, (shift - shift[:, None]) % ANGLES]
    apart = (frames - frames[:, None]).abs()
    near = ((apart > 0) & (apart <= NEAR)).float()
    return (correlation * near).sum(1) / near.sum(1)


def _shifts_near(score: Float[Tensor, "t t a"]) -> Int64[Tensor, " t"]:
    """Shift of every frame's map [cells]: frames are added one after the other, each compared with the ones before."""
    shift = torch.zeros(len(score), dtype=torch.long)
    for k in range(1, len(score)):
        before = torch.arange(max(0, k - NEAR), k)
        shift[k] = _best_shift(score, shift, k, before, before[-1:], int(shift[k - 1]), MAX_STEP)
    return shift


def _refined_shifts(score: Float[Tensor, "t t a"], shift: Int64[Tensor, " t"]) -> Int64[Tensor, " t"]:
    """Shift of every frame's map, so that all pairs of frames agree best [cells]: all are compared with all."""
    shift, frames = shift.clone(), torch.arange(len(score))
    for _ in range(SWEEPS):
        for k in range(len(score)):
            neighbours = frames[(frames - k).abs() == 1]
            shift[k] = _best_shift(score, shift, k, frames[frames != k], neighbours, int(shift[k]), REFINED_STEP)
    return shift


def _best_shift(
    score: Float[Tensor, "t t a"],
    shift: Int64[Tensor, " t"],
    k: int,
    others: Int64[Tensor, " n"],
    neighbours: Int64[Tensor, " m"],
    middle: int,
    reach: float,
) -> int:
    """Shift of frame k, at most `reach` [radians] from the middle [cells], with the best mean correlation with others,
    less the penalty on its difference to its neighbours' shifts."""
    cells = round(reach / (2 * math.pi) * ANGLES)
    options = middle + torch.arange(-cells, cells + 1)
    total = score[others[:, None], k, (options - shift[others, None]) % ANGLES].mean(0)
    total = total - STEP_PENALTY * 360 / ANGLES * (options - shift[neighbours, None]).abs().sum(0)
    return int(options[total.argmax()])


def _parts(weight: Float[Tensor, "t a z"]) -> list[Int64[Tensor, " n"]]:
    """Frames of every longer part of the capture in which no frame looks along the axis."""
    visible = weight.sum((1, 2))
    seen, lengths = torch.unique_consecutive(visible > MIN_VISIBLE * visible.median(), return_counts=True)
    runs = torch.arange(len(weight)).split(lengths.tolist())
    return [run for run, of_side in zip(runs, seen, strict=True) if of_side and len(run) >= MIN_PART]


def _joined(
    product: Float[Tensor, "t t a"],
    energy: Float[Tensor, "t t a"],
    shift: Int64[Tensor, " t"],
    static: Int64[Tensor, " t"],
    given: Float[Tensor, " s"],
    parts: list[tuple[Int64[Tensor, " n"], Int64[Tensor, " m"]]],
) -> Int64[Tensor, " t"]:
    """Shifts [cells] after every part is turned as a whole where its texture contradicts the shift to the one before.

    Args:
        product: Products of all pairs of frames (`_products`).
        energy: Their energies.
        shift: Shifts of all frames, right within the parts [cells].
        static: Shifts with which the object does not spin before the camera [cells].
        given: Spin of the given poses from each frame to the next [cells].
        parts: Frames of all consecutive pairs of parts, in order.
    """
    shift = shift.clone()
    for before, after in parts:
        last, first = int(before[-1]), int(after[0])
        spin = given + shift.diff()
        rates = spin[max(0, last - RATE_STEPS) : last].median(), spin[first : first + RATE_STEPS].median()
        smooth = (first - last) * (rates[0] + rates[1]) / 2 - spin[last:first].sum()
        turns = torch.arange(ANGLES) - ANGLES // 2
        found = torch.stack([_correlation_between(product, energy, shift, before, after, turn) for turn in turns])
        best = int((found - STEP_PENALTY * 360 / ANGLES * _least_turn(turns - smooth).abs()).argmax())
        others = (_correlation_between(product, energy, s, before, after) for s in (shift, static))
        if bool(_contradicts(found[best], *others)):
            ramp = torch.arange(last + 1, first) - last
            shift[last + 1 : first] += (turns[best] * ramp / (first - last)).round().long()
            shift[first:] += turns[best]
    return shift


def _correlation_between(
    product: Float[Tensor, "t t a"],
    energy: Float[Tensor, "t t a"],
    shift: Int64[Tensor, " t"],
    before: Int64[Tensor, " n"],
    after: Int64[Tensor, " m"],
    turn: Int64[Tensor, ""] | int = 0,
) -> Float[Tensor, ""]:
    """Correlation of all frames of one part with all of another that is turned in addition [cells], most of all of
    those that have much texture in common."""
    pairs = before[:, None], after, (shift[after] - shift[before, None] + turn) % ANGLES
    return product[pairs].sum() / energy[pairs].sum()


def steady_observations(
    capture: Capture, trajectory: Trajectory, surface: SurfaceOfRevolution, tracks: Tracks
) -> Bool[Tensor, " o"]:
    """Whether each observation shows the surface point that its track shows where it is seen most nearly head-on.

    Nothing contradicts those of a frame that shows no part of the surface.
    """
    uv, visible = _visible_cells(capture, trajectory, surface)
    uv, visible = uv.flatten(1, 2), visible.flatten(1)
    cell, facing = torch.zeros_like(tracks.point), torch.zeros(len(tracks))
    for k in range(len(trajectory)):
        mine = torch.nonzero(tracks.frame == k)[:, 0]
        seen = torch.nonzero(visible[k])[:, 0]
        if not len(seen):
            continue
        cell[mine] = seen[torch.cdist(tracks.uv[mine].float(), uv[k, seen]).argmin(1)]
        facing[mine] = visible[k, cell[mine]]
    order = torch.argsort(facing, stable=True)
    reference = torch.zeros(tracks.n, dtype=torch.long)
    reference[tracks.point[order]] = order
    reference = reference[tracks.point]
    moved = uv[tracks.frame, cell[reference]] - uv[tracks.frame[reference], cell[reference]]
    return (facing == 0) | ((tracks.uv - tracks.uv[reference] - moved).norm(dim=-1) < MAX_SLIP)
