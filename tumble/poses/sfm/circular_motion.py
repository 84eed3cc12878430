"""The motion of a turntable: a rotation about one axis, found from contours, or from the texture where those are equal.

Shading and highlights stay in place while a surface turns below them, so that matches of a round object with little
texture show too small a rotation, or one of the wrong sense, and bundle adjustment of all poses follows them. A
circular motion has four unknowns instead of six per frame, which tangency gaps (`frontier_points`) determine without
any match. Light and camera stand still, so that a frame looks like another exactly where the object has turned once
more, from which the rotation per frame is known in advance.

A body of revolution that stands on the axis has the same contour in all frames, which then do not tell how it turns.
They still leave two unknowns only: the sense, and the elevation of the camera above the plane of rotation. Under the
right ones all frames show the same texture at a point of the visual hull (`symmetry.texture_agreement`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, normalize

from tumble.maths import SO3
from tumble.poses.sfm import bundle_adjustment
from tumble.poses.sfm.adjustment import deviation
from tumble.poses.sfm.frontier_points import epipolar_tangencies
from tumble.poses.sfm.observations import Inputs, in_unit_sphere, silhouette_centres, with_focal_length
from tumble.poses.sfm.relocalization import robust_cost
from tumble.poses.sfm.symmetry import Agreement, texture_agreement
from tumble.scene import BACKGROUND, Capture

GRID = 32
"""Resolution at which frames are compared."""
MIN_PERIOD = 8
"""Shortest period [frames]; matches cannot follow an object that turns faster, either."""
MAX_PERIODS = 3
"""Maximum number of periods that are tried."""
ELEVATIONS = tuple(range(-60, 61, 10))
"""Elevations of the camera above the plane of rotation at which contours are compared first [degrees]."""
REFINED = 3
"""Number of these elevations, for each period and sense, from which the motion is fitted."""
PAIRS = 1000
"""Number of frame pairs, chosen at random, whose tangency gaps are fitted."""
GAP_SCALE = 1.0
"""Scale of the Cauchy loss of a tangency gap [pixels]."""
MAX_LOSS = math.log(2)
"""Largest loss with which a motion explains the contours: that of gaps of a pixel, which masks of films may have. With
true masks turntables have losses of 0.01 to 0.07, the best circular motions for objects in a hand 2.8 to 3.6."""
MIN_RISE = math.log1p(0.25**2)
"""Smallest rise of the loss by which other motions count as excluded: that of gaps of a quarter of a pixel, about as
large as the pixel grid makes them."""
EXCLUDED = math.radians(10)
"""Change of the axis' elevation that has to be excluded [radians]."""
MIN_AGREEMENT = 0.5
"""Smallest mean correlation of the texture by which a motion is found: half of the contrast is common to all frames."""
MIN_LEAD = 0.1
"""Lead of this correlation over that of all other rotations per frame: a turn the other way, or another period."""
COARSE_POINTS, POINTS = 500, 1500
"""Number of surface points whose texture is compared at all elevations, and near the best one."""
FINE_STEP, FINE_STEPS = 2, 4
"""Distance of elevations near the best one [degrees], and their number on either side."""
PARTS = 4
"""Number of parts of the object along the axis, from each of which the elevation is found as well; between them the
visual hull has other errors."""
SPEED_TERMS = 8
"""Number of sines by which the angle may deviate from a constant speed: a hand does not turn a table evenly."""
MIN_EXPLAINED = 0.1
"""Part of the loss of frames that were not fitted that they must explain, or the speed is constant: a motor's is, and
noise of the contours would be taken for changes."""
SAME_MOTION = math.radians(5)
"""Median difference of rotations up to which two fits have found the same motion [radians]."""
DIFFERENCE, EVALUATIONS = 1e-4, 30
"""Relative step of the differences of the fit, and its maximum number of iterations."""
ANGLE_STEP = math.radians(1)
"""Step of the differences of single frames' gaps [radians]; wide, because contours are polygons."""


@dataclass(frozen=True)
class CircularMotion:
    """Poses of all frames under a circular motion, and how far they may be wrong."""

    R: Float[Tensor, "t 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "t 3"]
    """Object origin, camera frame [mean distance]."""
    log_focal: Float[Tensor, ""]
    """Logarithm of the focal length over that of the capture; 0 if the latter is known."""
    disagreement: Float[Tensor, " t"]
    """Angle between the rotations fitted to the even frames alone and to the odd ones alone, or the one by which the
    frame's own contour deviates from the motion if that is larger; where texture tells the elevation, the standard
    deviation of those that parts of the object tell [radians]."""


def periods(capture: Capture) -> list[int]:
    """After how many frames the object may have turned once, most likely first; none if no frame recurs.

    The number of frames itself is one of them if the last frame is followed by the first. Frames count as recurring
    if they differ no more than neighbouring frames do at most. Symmetric objects have several periods.
    """
    n = len(capture)
    if n <= MIN_PERIOD:
        return []
    object_pixels = (capture.masks != BACKGROUND)[:, None].float()
    pixels = torch.cat([capture.images.movedim(-1, 1) * object_pixels, object_pixels], 1)
    small = adaptive_avg_pool2d(pixels, GRID).flatten(1)
    difference = torch.cdist(small, small, p=1)
    lag = torch.stack([difference.diagonal(k).median() for k in range(n)])
    limit = difference.diagonal(1).max()
    recurring = [
        k for k in range(MIN_PERIOD, n - 1) if lag[k] <= limit and lag[k] <= lag[k - 1] and lag[k] <= lag[k + 1]
    ]
    return ([n] if lag[n - 1] <= limit else []) + sorted(recurring, key=lambda k: float(lag[k]))


def fit(inputs: Inputs) -> CircularMotion | None:
    """The circular motion that explains the contours, and the texture if others explain the contours about as well.

    None if no frame recurs, or if there is no such motion.
    """
    pairs = torch.combinations(torch.arange(len(inputs.capture)))
    pairs = pairs[torch.randperm(len(pairs), generator=torch.Generator().manual_seed(0))[:PAIRS]]
    problem, found = _Problem(inputs, pairs), []
    periods_and_senses = product(periods(inputs.capture)[:MAX_PERIODS], (1, -1))
    steps = [sense * 2 * math.pi / period for period, sense in periods_and_senses]
    for step in steps:
        starts = [problem.start(math.radians(elevation), step) for elevation in ELEVATIONS]
        found += [problem.refined(start) for start in sorted(starts, key=problem.loss)[:REFINED]]
    if not found:
        return None
    best = min(found, key=problem.loss)
    R, _ = problem.poses(best)
    others = [x for x in found if deviation(problem.poses(x)[0], R).median() > SAME_MOTION]
    others += [best + np.array([change, *(0.0 for _ in best[1:])]) for change in (-EXCLUDED, EXCLUDED)]
    if min(map(problem.loss, others)) < problem.loss(best) + MIN_RISE:
        return _by_texture(problem, steps) if problem.loss(best) <= MAX_LOSS else None
    even, odd = (replace(problem, pairs=pairs[(pairs % 2 == k).all(1)]) for k in (0, 1))
    choices = [best, problem.refined(np.concatenate([best, np.zeros(SPEED_TERMS)]))]
    fitted = [(even.refined(x), odd.refined(x)) for x in choices]
    constant, varying = (odd.loss(a) + even.loss(b) for a, b in fitted)
    chosen = int(varying < (1 - MIN_EXPLAINED) * constant)
    best = choices[chosen]
    if problem.loss(best) > MAX_LOSS:
        return None
    disagreement = deviation(*(problem.poses(x)[0] for x in fitted[chosen]))
    return CircularMotion(*problem.poses(best), problem.log_focal(best), disagreement.maximum(problem.deviations(best)))


def _by_texture(problem: "_Problem", steps: list[float]) -> CircularMotion | None:
    """The circular motion under which the frames agree about the texture; None if none is clearly the best.

    Args:
        steps: Possible rotations per frame [radians].
    """
    rated = [
        (problem.agreement(problem.upright(math.radians(elevation), step), COARSE_POINTS).mean(), elevation, step)
        for step in steps
        for elevation in ELEVATIONS
    ]
    agreement, elevation, step = max(rated)
    if agreement < max([MIN_AGREEMENT, *(other + MIN_LEAD for other, _, its in rated if its != step)]):
        return None
    elevations = [elevation + FINE_STEP * k for k in range(-FINE_STEPS, FINE_STEPS + 1)]
    motions = [problem.upright(math.radians(each), step) for each in elevations]
    found = [problem.agreement(x, POINTS) for x in motions]
    whole = _peak(elevations, [each.mean() for each in found])
    ranks = [problem.along_axis(x, each.positions).argsort().argsort() for x, each in zip(motions, found, strict=True)]
    parts = [
        _peak(elevations, [each.mean(rank * PARTS // POINTS == k) for rank, each in zip(ranks, found, strict=True)])
        for k in range(PARTS)
    ]
    R, t = problem.poses(problem.upright(math.radians(whole), step))
    disagreement = torch.full_like(t[:, 0], math.radians(float(np.std(parts))))
    return CircularMotion(R, t, torch.zeros_like(t[0, 0]), disagreement)


def _peak(x: list[int], y: list[float]) -> float:
    """Place of the maximum of values at evenly spaced places, by a parabola through the seven around the largest one,
    since values are noisy."""
    middle = min(max(int(np.argmax(y)), 3), len(x) - 4)
    curvature, slope, _ = np.polyfit(np.arange(-3, 4), y[middle - 3 : middle + 4], 2)
    shift = float(np.clip(-slope / (2 * curvature), -3, 3)) if curvature < 0 else 3.0 * float(np.sign(slope))
    return x[middle] + shift * (x[1] - x[0])


@dataclass(frozen=True)
class _Problem:
    """The fit of a circular motion to the tangency gaps of some pairs of frames.

    Unknowns: elevation and slant of the axis [radians], its horizontal position [mean distance], the mean rotation per
    frame [radians], 1 plus the logarithm of the focal length over the capture's if that is only assumed (differences
    are relative to a value, and those about 0 would be lost in rounding), and possibly deviations from a constant speed
    [radians].
    """

    inputs: Inputs
    pairs: Int64[Tensor, "p 2"]

    @cached_property
    def _rays(self) -> Float[Tensor, "t 3"]:
        """Unit vectors towards the silhouettes' centres, camera frame."""
        return normalize(silhouette_centres(self.inputs.capture, self.inputs.silhouettes), dim=1)

    @cached_property
    def _across(self) -> Float[Tensor, "t 3 3"]:
        """Projections onto the planes across `_rays`."""
        return torch.eye(3, dtype=torch.float64) - self._rays[:, :, None] * self._rays[:, None]

    def start(self, elevation: float, step: float) -> np.ndarray:
        """Unknowns of a rotation about an upright axis through the mean centre of the silhouettes."""
        middle = self._rays.mean(0)
        focal = [1.0] if self.inputs.capture.focal_assumed else []
        return np.array([elevation, 0.0, float(middle[0] / middle[2]), step, *focal])

    def upright(self, elevation: float, step: float) -> np.ndarray:
        """Unknowns of a rotation with a known elevation and step, whose axis' slant and position fit the contours."""
        return self.refined(self.start(elevation, step), [1, 2])

    def agreement(self, x: np.ndarray, points: int) -> Agreement:
        """Agreement of all frames about the texture of the visual hull; none if the poses contradict each other."""
        try:
            return texture_agreement(self.inputs.capture, in_unit_sphere(self.inputs, *self.poses(x)), points)
        except ValueError:
            nothing = torch.zeros(points)
            return Agreement(torch.zeros(points, 3), nothing, nothing)

    def along_axis(self, x: np.ndarray, positions: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Places of points along the axis, object frame."""
        # The first frame's rotation is the identity: the object frame has the axes of the camera's.
        return positions @ torch.tensor(self._axis(x), dtype=positions.dtype)

    @property
    def _first_term(self) -> int:
        """Index of the first deviation from a constant speed."""
        return 5 if self.inputs.capture.focal_assumed else 4

    def poses(
        self, x: np.ndarray, turned: Float[Tensor, " t"] | float = 0.0
    ) -> tuple[Float[Tensor, "t 3 3"], Float[Tensor, "t 3"]]:
        """`R_cam_obj` and the position of the origin, which is the object's point that is nearest to all `_rays`.

        Args:
            turned: Angle about the axis by which every frame is turned in addition [radians].
        """
        offset, step = x[2:4]
        time = torch.arange(len(self._rays), dtype=torch.float64)
        angle = step * time + turned
        for k, amplitude in enumerate(x[self._first_term :].tolist(), 1):
            angle = angle + amplitude * torch.sin(math.pi * k / (len(time) - 1) * time)
        R = SO3.exp(angle[:, None] * torch.tensor(self._axis(x), dtype=torch.float64)).matrix()
        middle = self._rays.mean(0)
        # Any point of the axis gives the same poses: the one at the silhouettes' mean height.
        on_axis = torch.stack([middle.new_tensor(offset), middle[1] / middle[2], middle.new_ones(())])
        A = (R.mT @ self._across @ R).mean(0)
        t = on_axis - R @ torch.linalg.solve(A, (R.mT @ self._across @ on_axis).mean(0))
        return R, t / t[:, 2].mean()

    def _axis(self, x: np.ndarray) -> list[float]:
        """Direction of the axis: x to the right, y down, z forward. Seen from above, it leans towards the camera."""
        elevation, slant = x[:2]
        return [math.sin(slant) * math.cos(elevation), -math.cos(slant) * math.cos(elevation), -math.sin(elevation)]

    def log_focal(self, x: np.ndarray) -> Float[Tensor, ""]:
        """Logarithm of the focal length over the capture's."""
        return torch.tensor(x[4] - 1.0 if self.inputs.capture.focal_assumed else 0.0, dtype=torch.float64)

    def gaps(self, x: np.ndarray, turned: Float[Tensor, " t"] | float = 0.0) -> Float[Tensor, "p 2"]:
        """Tangency gaps [pixels]; NaN where they are not valid."""
        inputs = with_focal_length(self.inputs, self.log_focal(x))
        (R, t), (i, j), contours = self.poses(x, turned), self.pairs.T, inputs.contours
        first, second, camera = (R[i], t[i]), (R[j], t[j]), inputs.capture.camera
        found = epipolar_tangencies(first, second, contours[i], contours[j], camera, radius=inputs.radius)
        return torch.where(found.valid, found.gap, torch.nan)

    def loss(self, x: np.ndarray) -> float:
        """Mean Cauchy loss of the gaps; infinite if too few are valid."""
        return float(robust_cost(self.gaps(x).flatten()[None], GAP_SCALE))

    def deviations(self, x: np.ndarray) -> Float[Tensor, " t"]:
        """Angle by which every frame's own contour deviates from the motion, from one Gauss-Newton step [radians]."""
        gaps = self.gaps(x)
        numerator, denominator = torch.zeros(2, len(self._rays), dtype=torch.float64)
        for k in (0, 1):
            # Of pairs of an even and an odd frame, only one is turned.
            turned = torch.zeros_like(numerator)
            turned[k::2] = ANGLE_STEP
            frame = torch.where(self.pairs[:, 0] % 2 == k, self.pairs[:, 0], self.pairs[:, 1])
            slope = (self.gaps(x, turned) - gaps) / ANGLE_STEP
            usable = (self.pairs.sum(1) % 2 == 1)[:, None] & slope.isfinite()
            weight = torch.where(usable, 1 / (1 + gaps.square()), 0.0)
            numerator.index_add_(0, frame, (weight * slope * gaps).nan_to_num().sum(1))
            denominator.index_add_(0, frame, (weight * slope.square()).nan_to_num().sum(1))
        return (numerator / denominator.clamp_min(1e-9)).abs()

    def refined(self, x: np.ndarray, free: Sequence[int] | None = None) -> np.ndarray:
        """The unknowns with the least Cauchy loss of the gaps near some others.

        Args:
            free: Indices of the unknowns that change; all by default.
        """
        from scipy.optimize import least_squares

        free = range(len(x)) if free is None else free
        prior = bundle_adjustment.FOCAL_NOISE / bundle_adjustment.FOCAL_SIGMA * math.sqrt(2 * len(self.pairs))
        focal = slice(4, self._first_term)

        def changed(values: np.ndarray) -> np.ndarray:
            new = x.copy()
            new[free] = values
            return new

        def residuals(values: np.ndarray) -> np.ndarray:
            new = changed(values)
            return np.concatenate([self.gaps(new).nan_to_num().flatten().numpy(), prior * (new[focal] - 1)])

        scale = np.concatenate([[0.3, 0.1, 0.02, 0.02 * abs(x[3])], np.full(len(x) - 4, 0.1)])
        options = {"loss": "cauchy", "f_scale": GAP_SCALE, "x_scale": scale[free], "diff_step": DIFFERENCE}
        return changed(least_squares(residuals, x[free], max_nfev=EVALUATIONS, **options).x)
