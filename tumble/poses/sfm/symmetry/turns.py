"""Discrete symmetry: rotations that leave the visual hull as it is, chosen for every part of a capture by its colours.

A cube turned by a right angle has the same silhouettes. Where a video has a gap, because frames are lost, the motion
before it and the motion behind it can therefore be joined a symmetric turn off, although matches and contours agree
with both. The symmetric turns of the visual hull are searched for over all rotations, so that no group of symmetries
has to be named. The capture is divided into runs: sequences of frames between which no symmetric turn is a plausible
motion. All colours of a run are averaged over points of the hull's surface, and the maps of the runs are compared for
all symmetric turns by their correlation.

Shading is no sign of a turn: it depends on the direction of the normal in the camera frame, which a symmetric turn of
the object does not change. What low-order harmonics of that direction explain is subtracted from the logarithms of the
colours, and the mean over nearby pixels from the brightness, where highlights and shadows remain. What a map and its
turned copies have in common says nothing about the turn and is subtracted as well.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from tumble.maths import SO3, angle_between, linear_from_srgb, spherical_harmonics
from tumble.poses.sfm import relocalization
from tumble.scene import OBJECT, Capture, Trajectory, visual_hull

HULL_RESOLUTION = 48
"""Cells of the visual hull's grid along each side."""
SURFACE_POINTS = 1500
"""Number of points on the hull's surface."""
COARSE_POINTS = 300
"""Number of these points with which rotations are searched for."""
ROTATIONS = 4000
"""Number of rotations of the coarse search, about 13 degrees apart."""
CANDIDATES = 64
"""Number of rotations that are refined."""
SEPARATION = math.radians(25)
"""Least angle between two symmetric turns [radians]."""
MIN_TURN = math.radians(55)
"""Least angle of a symmetric turn that is searched for [radians]: that of a hexagonal prism is 60 degrees. Between two
frames an object rotates by less."""
MIN_SPIN = math.radians(25)
"""Angle from which a turn by less than `MIN_TURN` shows that the hull is one of revolution [radians]."""
MAX_ROTATION_PER_LOST_FRAME = 0.35
"""Rotation per frame up to which a motion between frames that are not consecutive is plausible [radians]: frames are
lost where it is fast."""
REFINEMENT_STEPS = (0.1, 0.05, 0.025, 0.012, 0.006)
"""Steps of the refinement of a turn [radians]."""
MAX_SURFACE_DISTANCE = 0.05
"""Mean distance between the surfaces of the turned and of the given hull, over the mean distance of the surface from
its centre, below which silhouettes do not show the turn."""
MIN_COSINE = 0.15
"""Minimum cosine between normal and line of sight for a point to be visible."""
DARK = 0.02
"""Linear light that is added before the logarithm, so that noise in dark pixels does not count."""
SMOOTHING = 3
"""Width of the window over which images of `IMAGE_SIZE` are averaged, because poses are not exact yet [pixels]."""
MEAN_WINDOW = 21
"""Width of the window whose mean is subtracted from the brightness in images of `IMAGE_SIZE` [pixels]."""
IMAGE_SIZE = 128
"""Approximate larger side to which images are reduced [pixels]."""
SHADING_DEGREE = 3
"""Degree of the spherical harmonics of the normal that explain shading."""
MAX_CONTRAST = 1.5
"""Difference to the shading at which a colour is cut off [logarithm of linear light]."""
MIN_CONTRAST = 0.2
"""Contrast of two maps, root mean square, at which their correlation counts half [logarithm of linear light]: what
shading leaves on an object of one colour correlates by chance."""
MIN_COMMON = 0.1
"""Least fraction of the surface that two maps have in common to be compared."""
MIN_CORRELATION = 0.35
"""Least correlation of two maps for their colours to show a turn."""
CONTRADICTION = 0.65
"""Ratio of the correlations of another turn and of the best one below which colours contradict the other."""
SWEEPS = 3
"""Number of times that the turn of every run is chosen anew, given those of all others."""


@dataclass(frozen=True)
class SymmetricHull:
    """Points on the surface of the visual hull, and the rotations that leave it as it is; object frame."""

    centre: Float[Tensor, "3"]
    """Fixed point of the rotations: the hull's centroid."""
    turns: Float[Tensor, "s 3 3"]
    """Rotation matrices; the first is the identity."""
    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    """Outward, unit length."""


@dataclass(frozen=True)
class Turns:
    """Symmetric turns of the frames that colours show, relative to given poses."""

    hull: SymmetricHull
    runs: Int64[Tensor, " t"]
    """Run that every frame belongs to."""
    reference: int
    """The longest run, with which the others are compared."""
    correlation: Float[Tensor, "r s"]
    """Correlation of every run with all others after a symmetric turn of the run; the others are turned as chosen."""
    chosen: Int64[Tensor, " r"]
    """Index of the turn chosen for every run: 0, as given, unless colours show another and contradict the given one."""

    @property
    def is_better(self) -> bool:
        """Whether colours contradict the given poses."""
        return bool((self.chosen > 0).any())

    def turned(self, trajectory: Trajectory) -> Trajectory:
        """Poses whose object is first turned about the hull's centre, by the turn chosen for the frame's run."""
        return trajectory.turned(SO3.from_matrix(self.hull.turns[self.chosen[self.runs]]), self.hull.centre)

    @property
    def doubt(self) -> float:
        """Mean error of the given rotations if for every run but the longest that turn were right which colours exclude
        least [radians]; 0 if they confirm all runs as given."""
        least_excluded = self.correlation[:, 1:].argmax(1) + 1
        angle = SO3.from_matrix(self.hull.turns[least_excluded]).angle()
        return float(torch.where(self._clear & (self.chosen == 0), 0.0, angle)[self.runs].mean())

    @property
    def confirmed(self) -> Int64[Tensor, " t"]:
        """Run of every frame; -1 if colours do not show its turn."""
        return torch.where(self._clear[self.runs], self.runs, -1)

    @property
    def _clear(self) -> Bool[Tensor, " r"]:
        """Runs whose turn colours show, and the longest."""
        return _is_clear(self.correlation) | (torch.arange(len(self.chosen)) == self.reference)


def estimate_turns(capture: Capture, trajectory: Trajectory, usable: Bool[Tensor, " t"]) -> Turns | None:
    """Symmetric turns of all runs of a capture; None if there is one run only, or the hull has no symmetric turn.

    Args:
        capture: Images and masks of all frames.
        trajectory: Poses that are right but for a symmetric turn of every run; the object lies in the unit sphere.
        usable: Frames whose contours agree with their poses.
    """
    rotations = trajectory.T_cam_obj.rotation
    if not bool(_gaps(rotations, usable, None).any()):
        return None
    frames = torch.nonzero(usable)[:, 0]
    hull = symmetric_hull(capture.select(frames.tolist()), trajectory.select(frames))
    if hull is None or len(hull.turns) < 2:
        return None
    runs = _gaps(rotations, usable, SO3.from_matrix(hull.turns[1:])).cumsum(0)
    if not bool(runs.any()):
        return None
    maps, weights = _colour_maps(capture, trajectory, hull, frames, runs)
    reference = int(torch.bincount(runs[frames]).argmax())
    return Turns(hull, runs, reference, *_choose(maps, weights, reference))


def _gaps(rotations: SO3, usable: Bool[Tensor, " t"], turns: SO3 | None) -> Bool[Tensor, " t"]:
    """Frames at which a run begins, except the first: the motion since the last usable frame is too fast, or another
    motion that a symmetric turn leads to is slow enough.

    Args:
        rotations: `R_cam_obj` of all frames.
        usable: Frames with a pose.
        turns: Symmetric turns except the identity; None if they are not known.
    """
    begins = torch.zeros_like(usable)
    frames = torch.nonzero(usable)[:, 0]
    i, j = frames[:-1], frames[1:]
    largest = (MAX_ROTATION_PER_LOST_FRAME * (j - i)).clamp_min(relocalization.POSE_JUMP)
    step = angle_between(rotations[i], rotations[j])
    if turns is None:
        other = MIN_TURN - step
    else:
        other = angle_between(rotations[i][:, None], rotations[j][:, None] @ turns).amin(1)
    apart = (step > largest) | (other < largest)
    # Frames between two runs belong to the nearer one.
    begins[(i + j + 1)[apart] // 2] = True
    return begins


# The hull -------------------------------------------------------------------------------------------------------------


def symmetric_hull(capture: Capture, trajectory: Trajectory) -> SymmetricHull | None:
    """The rotations that leave the visual hull as it is; None if the hull is empty.

    All rotations are compared on a grid by the mean distance between the turned surface and the surface. The best are
    refined, each step along the axis that lowers the distance most.
    """
    cells = visual_hull.carve(capture, trajectory, resolution=HULL_RESOLUTION, outside=0.0)
    inside = torch.nonzero(cells > 0.5)
    if len(inside) < HULL_RESOLUTION:
        return None
    surface = visual_hull.sample_surface(cells, SURFACE_POINTS, torch.Generator().manual_seed(0))
    centre = (inside.float().mean(0) + 0.5) / HULL_RESOLUTION * 2 - 1
    x = surface.positions - centre
    field = _signed_distance(cells) / x.norm(dim=-1).mean()

    def distance(turns: SO3, points: Tensor) -> Float[Tensor, " s"]:
        at = (centre + turns[:, None] @ points).flip(-1)[None, None]
        return grid_sample(field[None, None], at, padding_mode="border", align_corners=False)[0, 0, 0].abs().mean(-1)

    few = x[:COARSE_POINTS]
    grid = _rotation_grid(ROTATIONS)
    turns = grid[_separate(grid, distance(grid, few), MIN_SPIN, SEPARATION)[:CANDIDATES]]
    axes = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)])
    for step in REFINEMENT_STEPS:
        for _ in range(3):
            tried = SO3.exp(step * axes)[:, None] @ turns
            best = distance(SO3(tried.wxyz.flatten(0, 1)), few).reshape(len(axes), -1).argmin(0)
            turns = SO3(tried.wxyz[best, torch.arange(len(best))])
    final = distance(turns, x)
    turns, final = turns[final < MAX_SURFACE_DISTANCE], final[final < MAX_SURFACE_DISTANCE]
    angle = turns.angle()
    # Turns by any angle leave a body of revolution as it is: its rotation about the axis is the spin.
    kept = (
        [] if bool(((angle > MIN_SPIN) & (angle < MIN_TURN)).any()) else _separate(turns, final, MIN_TURN, SEPARATION)
    )
    matrices = torch.cat([torch.eye(3)[None], turns.matrix()[kept]])
    return SymmetricHull(centre, matrices, surface.positions, surface.normals)


def _signed_distance(cells: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    """Distance of every cell from the surface on which the occupancy is one half, negative inside [object radius]."""
    from scipy.ndimage import distance_transform_edt

    inside = (cells > 0.5).numpy()
    # The distance to the nearest cell on the other side is half a cell too large.
    inward, outward = (torch.from_numpy(distance_transform_edt(each)).float() for each in (inside, ~inside))
    return ((outward - 0.5).clamp_min(0) - (inward - 0.5).clamp_min(0)) * (2 / len(cells))


def _rotation_grid(n: int) -> SO3:
    """Evenly spread rotations: a super-Fibonacci spiral of unit quaternions (Alexa 2022)."""
    s = torch.arange(n, dtype=torch.float64) + 0.5
    a, b = 2 * math.pi * s / math.sqrt(2), 2 * math.pi * s / 1.533751168755204
    r, rest = (s / n).sqrt(), (1 - s / n).sqrt()
    return SO3(torch.stack([r * a.sin(), r * a.cos(), rest * b.sin(), rest * b.cos()], -1).float())


def _separate(turns: SO3, distance: Float[Tensor, " s"], least: float, separation: float) -> list[int]:
    """Indices of the turns larger than an angle, the best first, without those close to a better one [radians]."""
    left = turns.angle() > least
    chosen = []
    for k in distance.argsort().tolist():
        if bool(left[k]):
            chosen.append(k)
            left &= angle_between(turns, turns[k]) > separation
    return chosen


# Colours --------------------------------------------------------------------------------------------------------------


def _colour_maps(
    capture: Capture,
    trajectory: Trajectory,
    hull: SymmetricHull,
    frames: Int64[Tensor, " k"],
    runs: Int64[Tensor, " t"],
) -> tuple[Float[Tensor, "r s n 3"], Float[Tensor, "r s n"]]:
    """Mean colours of all runs after all turns, without shading [logarithm of linear light], and their weights.

    What all turns have in common, such as the dark edges of a cube's faces, is subtracted as well. The three components
    of a colour are brightness and two differences of channels.
    """
    images, size = _contrast_images(capture.select(frames.tolist()))
    trajectory, runs = trajectory.select(frames), runs[frames]
    T, camera_centres = trajectory.T_cam_obj, trajectory.camera_positions

    def seen(turn: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, normals = (hull.positions - hull.centre) @ turn.mT + hull.centre, hull.normals @ turn.mT
        cosine = visual_hull.view_cosine(camera_centres[:, None], x, normals)
        uv = capture.camera.project(T[:, None] @ x)
        sampled = grid_sample(images, 2 * uv[:, :, None] / size - 1, align_corners=False)[..., 0].movedim(1, -1)
        weight = (cosine - MIN_COSINE).clamp_min(0) / (1 - MIN_COSINE) * (sampled[..., 3] > 1 - 1e-3)
        return sampled[..., :3], weight, spherical_harmonics.basis(T.rotation[:, None] @ normals, SHADING_DEGREE)

    colour, weight, basis = seen(hull.turns[0])
    root = weight[weight > 0].sqrt()[:, None]
    # A small ridge, because normals may cover few directions.
    A, y = basis[weight > 0] * root, colour[weight > 0] * root
    shading = torch.linalg.solve(A.mT @ A + 1e-4 * len(A) * torch.eye(A.shape[1]), A.mT @ y)
    maps, weights = [], []
    for turn in hull.turns:
        colour, weight, basis = seen(turn)
        contrast = (colour - basis @ shading).clamp(-MAX_CONTRAST, MAX_CONTRAST) * weight[..., None]
        total = torch.zeros(int(runs.max()) + 1, *weight.shape[1:]).index_add_(0, runs, weight)
        summed = torch.zeros(*total.shape, 3).index_add_(0, runs, contrast)
        maps.append(summed / total.clamp_min(1e-6)[..., None])
        weights.append(total.clamp_max(1))
    mean, weight = torch.stack(maps, 1), torch.stack(weights, 1)
    common = (mean * weight[..., None]).sum(1) / weight.sum(1).clamp_min(1e-6)[..., None]
    return mean - common[:, None], weight


def _contrast_images(capture: Capture) -> tuple[Float[Tensor, "t 4 h w"], Float[Tensor, "2"]]:
    """Brightness without its local mean, two differences of channels [logarithm of linear light], and object pixels.

    They are reduced to about `IMAGE_SIZE`. Also returned are width and height of what they show, in pixels of
    the capture: rows and columns that are left over are dropped.
    """
    factor = max(1, round(max(capture.masks.shape[1:]) / IMAGE_SIZE))
    inside = (avg_pool2d((capture.masks == OBJECT).float()[:, None], factor) > 1 - 1e-3).float()
    # One frame at a time, which limits memory.
    light = torch.stack(
        [avg_pool2d(linear_from_srgb(image.float() / 255).movedim(-1, 0), factor) for image in capture.images]
    )
    light = (light + DARK).log() * inside

    def mean(x: Tensor, width: int) -> Tensor:
        within, counted = (avg_pool2d(each, width, 1, width // 2) for each in (x, inside))
        return within / counted.clamp_min(1e-3) * inside

    red, green, blue = mean(light, SMOOTHING).split(1, 1)
    brightness = (red + green + blue) / 3 - mean(light.mean(1, keepdim=True), MEAN_WINDOW)
    differences = ((red - green) / math.sqrt(2), (red + green - 2 * blue) / math.sqrt(6))
    size = factor * torch.tensor([float(inside.shape[3]), float(inside.shape[2])])
    return torch.cat([brightness, *differences, inside], 1), size


def _choose(
    maps: Float[Tensor, "r s n 3"], weights: Float[Tensor, "r s n"], reference: int
) -> tuple[Float[Tensor, "r s"], Int64[Tensor, " r"]]:
    """Correlation of every run with all others after every turn, and the chosen turns.

    Runs are added in order of their distance from the reference, each compared with those whose turn is clear. Then
    each is compared anew with all others.
    """
    n = len(maps)
    chosen, clear = torch.zeros(n, dtype=torch.long), torch.zeros(n, dtype=torch.bool)
    correlation = torch.zeros(weights.shape[:2])
    clear[reference] = True
    for _ in range(SWEEPS):
        for k in sorted(range(n), key=lambda k: abs(k - reference)):
            others = clear & (torch.arange(n) != k)
            w = weights[others, chosen[others]]
            mean = (maps[others, chosen[others]] * w[..., None]).sum(0) / w.sum(0).clamp_min(1e-6)[:, None]
            correlation[k] = _correlation(mean, w.sum(0).clamp_max(1), maps[k], weights[k])
            if k != reference:
                clear[k] = _is_clear(correlation[k])
                best = float(correlation[k].max())
                # Where two turns are about as good but the given one contradicts the colours, the best is less wrong.
                wrong = best > MIN_CORRELATION and float(correlation[k, 0]) < CONTRADICTION * best
                chosen[k] = int(correlation[k].argmax()) if wrong else 0
    return correlation, chosen


def _correlation(
    a: Float[Tensor, "n 3"], weight_a: Float[Tensor, " n"], b: Float[Tensor, "s n 3"], weight_b: Float[Tensor, "s n"]
) -> Float[Tensor, " s"]:
    """Normalised correlation of a map with several, smaller where both have little contrast; 0 if they share little."""
    common = torch.minimum(weight_a, weight_b)[..., None]
    share = common.sum((1, 2))
    energy = ((common * a.square()).sum((1, 2)) * (common * b.square()).sum((1, 2))).sqrt()
    found = (common * a * b).sum((1, 2)) / (energy + MIN_CONTRAST**2 * share).clamp_min(1e-6)
    return torch.where(share > MIN_COMMON * len(a), found, 0.0)


def _is_clear(correlation: Float[Tensor, "*r s"]) -> Bool[Tensor, "*r"]:
    """Whether colours show the best turn, and contradict all others."""
    best, second = correlation.topk(2, -1).values.unbind(-1)
    return (best > MIN_CORRELATION) & (second < CONTRADICTION * best)
