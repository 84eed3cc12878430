"""The motion of a turntable, found from contours alone: a constant rotation about one axis.

Shading and highlights stay in place while a surface turns below them, so that matches of a round object with little
texture show too small a rotation, or one of the wrong sense, and bundle adjustment of all poses follows them. A
circular motion has four unknowns instead of six per frame, which tangency gaps (`frontier_points`) determine without
any match. Light and camera stand still, so that a frame looks like another exactly where the object has turned once
more, from which the rotation per frame is known in advance.

A body of revolution that stands on the axis has the same contour in all frames, which then do not tell how it turns.
"""

import math
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
from tumble.poses.sfm.observations import Inputs, silhouette_centres, with_focal_length
from tumble.poses.sfm.relocalization import robust_cost
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
    """Poses of all frames under a circular motion."""

    R: Float[Tensor, "t 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "t 3"]
    """Object origin, camera frame [mean distance]."""
    log_focal: Float[Tensor, ""]
    """Logarithm of the focal length over that of the capture; 0 if the latter is known."""
    disagreement: Float[Tensor, " t"]
    """Angle between the rotations fitted to the even frames alone and to the odd ones alone, or the one by which the
    frame's own contour deviates from the motion if that is larger [radians]."""


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
    """The circular motion that explains the contours.

    None if no frame recurs, if there is no such motion, or if others explain the contours about as well.
    """
    pairs = torch.combinations(torch.arange(len(inputs.capture)))
    pairs = pairs[torch.randperm(len(pairs), generator=torch.Generator().manual_seed(0))[:PAIRS]]
    problem, found = _Problem(inputs, pairs), []
    for period, sense in product(periods(inputs.capture)[:MAX_PERIODS], (1, -1)):
        starts = [problem.start(math.radians(elevation), sense * 2 * math.pi / period) for elevation in ELEVATIONS]
        found += [problem.refined(start) for start in sorted(starts, key=problem.loss)[:REFINED]]
    if not found:
        return None
    best = min(found, key=problem.loss)
    R, _ = problem.poses(best)
    others = [x for x in found if deviation(problem.poses(x)[0], R).median() > SAME_MOTION]
    others += [best + np.array([change, *(0.0 for _ in best[1:])]) for change in (-EXCLUDED, EXCLUDED)]
    if min(map(problem.loss, others)) < problem.loss(best) + MIN_RISE:
        return None
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
        elevation, slant, offset, step = x[:4]
        # Camera frame: x to the right, y down, z forward. Seen from above, the axis leans towards the camera.
        axis = [math.sin(slant) * math.cos(elevation), -math.cos(slant) * math.cos(elevation), -math.sin(elevation)]
        time = torch.arange(len(self._rays), dtype=torch.float64)
        angle = step * time + turned
        for k, amplitude in enumerate(x[self._first_term :].tolist(), 1):
            angle = angle + amplitude * torch.sin(math.pi * k / (len(time) - 1) * time)
        R = SO3.exp(angle[:, None] * torch.tensor(axis, dtype=torch.float64)).matrix()
        middle = self._rays.mean(0)
        # Any point of the axis gives the same poses: the one at the silhouettes' mean height.
        on_axis = torch.stack([middle.new_tensor(offset), middle[1] / middle[2], middle.new_ones(())])
        A = (R.mT @ self._across @ R).mean(0)
        t = on_axis - R @ torch.linalg.solve(A, (R.mT @ self._across @ on_axis).mean(0))
        return R, t / t[:, 2].mean()

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

    def refined(self, x: np.ndarray) -> np.ndarray:
        """The unknowns with the least Cauchy loss of the gaps near some others."""
        from scipy.optimize import least_squares

        prior = bundle_adjustment.FOCAL_NOISE / bundle_adjustment.FOCAL_SIGMA * math.sqrt(2 * len(self.pairs))
        focal = slice(4, self._first_term)

        def residuals(x: np.ndarray) -> np.ndarray:
            return np.concatenate([self.gaps(x).nan_to_num().flatten().numpy(), prior * (x[focal] - 1)])

        scale = np.concatenate([[0.3, 0.1, 0.02, 0.02 * abs(x[3])], np.full(len(x) - 4, 0.1)])
        options = {"loss": "cauchy", "f_scale": GAP_SCALE, "x_scale": scale, "diff_step": DIFFERENCE}
        return least_squares(residuals, x, max_nfev=EVALUATIONS, **options).x
