"""Joining two parts of a capture that share no texture: by their contours, where one follows the other in time.

The contours of all pairs of frames of two parts together leave few ways to put one into the other (epipolar tangency),
and what one frame shows must be possible behind what hides the object in the other. They cannot tell a bottle from the
same bottle after half a revolution, nor a box from one after a quarter; but the motion goes on where the first part
ends, so that smaller rotations are likely there. Colours then refuse those that put one side on another of other print.

Joints that keypoints suggest are fitted to the contours as well (`fitted_to_both`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.maths import SO3, Damping, Linearised, angle_between, minimise, select_rows
from tumble.poses.sfm.bundle_adjustment import MIN_DEPTH
from tumble.poses.sfm.frontier_points import EpipolarTangencies, cauchy_loss, epipolar_tangencies
from tumble.poses.sfm.partial import GAP_SCALE, MAX_COLOUR_CONTRADICTION, Observed, Partial, colour_contradictions
from tumble.poses.sfm.relocalization import JACOBIAN_STEP, candidate_rotations, damped_step, robust_cost

MAX_GAP = 6
"""Largest distance in time between two parts that contours join [frames]."""
MAX_TURN = math.radians(60)
"""Largest rotation from the end of one part to the beginning of the other [radians]: parts end where the object turns
too fast for matching, but below a quarter of a revolution boxes do not look the same."""
MAX_DEPTH_RATIO = 1.15
"""Largest ratio of the distances from the camera at the end of one part and at the beginning of the other. Within
`MAX_GAP` frames of the films `MC1` and `SM2` it is 1.06 in nine of ten cases and at most 1.16."""
TURNS = tuple(math.radians(sign * angle) for angle in (10, 20, 30, 40, 50, 60) for sign in (-1, 1))
"""Angles of the hypotheses for the rotation from one part to the other [radians]."""
MIN_FRAMES = 10
"""Number of frames of a part below which its contours alone do not join it."""
USED_FRAMES = 20
"""Number of frames of each part whose contours are compared."""
REFINED = 16
"""Number of hypotheses that are refined, those of lowest cost first."""
STEPS = 16
"""Levenberg-Marquardt steps per hypothesis."""
MAX_COST = 0.2
"""Cost of valid gaps above which contours do not confirm a joint: that of gaps of 1.4 pixels. Within a part it is 0.02
to 0.07; wrong joints of the synthetic film of the mustard bottle have 0.3 to 0.8."""
MIN_GAPS = 75
"""Number of valid gaps below which hands hide too much of the contours. Joints of the synthetic films of the bottle and
the knight with 45 to 55 of these are 12 to 20 degrees off, with 86 and 107 3 and 8 degrees."""
MIN_RATIO = 2.0
"""Cost of the best joint with another rotation over that of the best, below which it is not certain which is right."""
OTHER_ROTATION = math.radians(30)
"""Angle from which a joint is another one [radians]. Below it costs may hardly differ, because few contours of a hidden
object are seen: about its axis a bottle's joint may be known to some ten degrees only."""
Similarity = tuple[Float[Tensor, "h 3 3"], Float[Tensor, "h 4"]]
"""Hypotheses for the motion of a part to the object frame of another: rotation `R_new_obj`; shift [mean distance] and
logarithm of the scale."""


@dataclass(frozen=True)
class ContourJoint:
    """The most likely poses of a part in the object frame of another, and what speaks for them."""

    part: Partial
    cost: float
    """Mean robust cost of the tangency gaps between both parts, and of conflicts where there is no valid gap."""
    second: float
    """Lowest cost with another rotation; infinite if there is none."""
    gaps: int
    """Number of tangency gaps that are valid, as the contours on both sides are seen there."""
    gap_cost: float
    """Mean robust cost of these alone."""
    frames: int
    """Number of frames of the shorter part."""

    @property
    def strength(self) -> float:
        """What the strongest of several joints has most of."""
        return -self.cost

    @property
    def certain(self) -> bool:
        """Whether it can do without more matches: it has none (see `registration.Joint`)."""
        return False

    @property
    def accepted(self) -> bool:
        """Whether contours confirm that the two parts belong together in this way, and in no other."""
        enough = self.gaps >= MIN_GAPS and self.frames >= MIN_FRAMES
        return enough and self.gap_cost <= MAX_COST and self.second >= MIN_RATIO * self.cost


def contour_joint(observed: Observed, part: Partial, other: Partial) -> ContourJoint | None:
    """The joint of two parts whose contours agree best; None unless one follows the other."""
    distance, p, q = part.nearest(other)
    if not 0 < distance <= MAX_GAP:
        return None
    turns = candidate_rotations(TURNS)
    R_new_obj = (turns @ other.R[q]).mT @ part.R[p]
    pairs = _Pairs.of(observed, part, other)
    log_scale = (other.t[q, 2] / part.t[p, 2]).log()
    start = R_new_obj, torch.cat([R_new_obj.new_zeros(3), log_scale[None]]).expand(len(turns), 4)
    best = robust_cost(pairs.residuals(start), GAP_SCALE).argsort()[:REFINED]
    (R_new_obj, rest), cost = _refined(pairs.residuals, (start[0][best], start[1][best]))
    step = angle_between(SO3.from_matrix(part.R[p] @ R_new_obj.mT), SO3.from_matrix(other.R[q]))
    depth_ratio = _moved(part.select([p]), (R_new_obj, rest))[1][:, 0, 2] / other.t[q, 2]
    possible = (step <= MAX_TURN) & (depth_ratio > 1 / MAX_DEPTH_RATIO) & (depth_ratio < MAX_DEPTH_RATIO)
    moved = [moved_part(part, (R_new_obj, rest), k) for k in range(len(cost))]
    same_colours = torch.tensor(colour_contradictions(observed, part, other, moved)) <= MAX_COLOUR_CONTRADICTION
    cost = torch.where(possible & same_colours, cost, torch.inf)
    k = int(cost.argmin())
    if not math.isfinite(float(cost[k])):
        return None
    differs = angle_between(SO3.from_matrix(R_new_obj), SO3.from_matrix(R_new_obj[k])) > OTHER_ROTATION
    second = float(torch.where(differs, cost, torch.inf).min())
    gaps = pairs.valid_gaps((R_new_obj[k : k + 1], rest[k : k + 1]))
    gap_cost = float(robust_cost(gaps[None], GAP_SCALE)[0])
    return ContourJoint(moved[k], float(cost[k]), second, len(gaps), gap_cost, min(len(part), len(other)))


def moved_part(part: Partial, motion: Similarity, k: int) -> Partial:
    """A part in the object frame of another by hypothesis k."""
    R_new_obj, rest = motion
    return part.moved(R_new_obj[k], float(rest[k, 3].exp()), rest[k, :3])


@dataclass(frozen=True)
class Correspondences:
    """Keypoints of a part and surface points of another."""

    place: Int64[Tensor, " c"]
    """Place of the keypoint's frame in the part."""
    uv: Float[Tensor, "c 2"]
    """Keypoints [pixels]."""
    X: Float[Tensor, "c 3"]
    """Surface points, object frame of the other part."""

    def errors(self, observed: Observed, part: Partial, motion: Similarity) -> Float[Tensor, "h c 2"]:
        """Reprojection errors after each motion of the part [pixels]."""
        R, t = _moved(part, motion)
        x = torch.einsum("hcij,cj->hci", R[:, self.place], self.X) + t[:, self.place]
        in_front = torch.cat([x[..., :2], x[..., 2:].clamp_min(MIN_DEPTH)], -1)
        return observed.inputs.capture.camera.project(in_front) - self.uv


def fitted_to_both(
    observed: Observed, part: Partial, other: Partial, seen: Correspondences, start: Similarity, error: float
) -> Similarity:
    """Hypotheses after a fit to the contours and to those correspondences that agree with each at first.

    A few keypoints, often on one face of the object, leave a rotation uncertain that contours then determine.

    Args:
        seen: Correspondences of the part and the other.
        start: Hypotheses for the motion of the part.
        error: Reprojection error up to which they agree [pixels].
    """
    agrees = seen.errors(observed, part, start).norm(dim=-1) < error
    used = agrees.any(0)
    seen = Correspondences(seen.place[used], seen.uv[used], seen.X[used])
    # A hypothesis keeps its own correspondences; the others are wrong, or right for another hypothesis.
    of_others = torch.where(agrees[:, used], 0.0, torch.nan)[..., None]
    pairs = _Pairs.of(observed, part, other)

    def residuals(motion: Similarity) -> Float[Tensor, "h n"]:
        errors = seen.errors(observed, part, motion) + of_others
        return torch.cat([pairs.residuals(motion), errors.flatten(1)], 1)

    return _refined(residuals, start)[0]


def _compared(observed: Observed, part: Partial) -> Partial:
    """Up to `USED_FRAMES` frames of a part, evenly spaced over those that do not contradict it; chosen only once."""
    if part not in observed.compared:
        trusted = _trusted(observed, part)
        places = torch.linspace(0, len(trusted) - 1, USED_FRAMES).round().long().unique().tolist()
        observed.compared[part] = trusted.select(places)
    return observed.compared[part]


def _trusted(observed: Observed, part: Partial) -> Partial:
    """A part without the frames whose contours contradict its other frames, as their mask or pose is wrong.

    What a mask shows in excess contradicts every way of joining the part to another.
    """
    still = torch.eye(3, dtype=part.R.dtype)[None], part.t.new_zeros(1, 4)
    residuals = _Pairs(observed, part, part).residuals(still).reshape(len(part), len(part), 2)
    cost = cauchy_loss(residuals, GAP_SCALE).nanmean(2)
    kept = list(range(len(part)))
    while len(kept) > len(part) / 2:
        of_frame = cost[kept][:, kept].nanmean(1).nan_to_num()
        if float(of_frame.max()) <= MAX_COST:
            return part.select(kept)
        del kept[int(of_frame.argmax())]
    return part


@dataclass(frozen=True)
class _Pairs:
    """All pairs of a frame of one part and a frame of another."""

    observed: Observed
    part: Partial
    other: Partial

    @staticmethod
    def of(observed: Observed, part: Partial, other: Partial) -> "_Pairs":
        """Those of the frames of each that are compared with other parts."""
        return _Pairs(observed, _compared(observed, part), _compared(observed, other))

    def residuals(self, motion: Similarity) -> Float[Tensor, "h n"]:
        """Tangency gaps after each motion of the part, or conflicts where they are not valid [pixels].

        What one frame shows may contradict a motion also where the other frame's contour is hidden. NaN where two views
        are not suitable.
        """
        return self._tangencies(motion).residual.reshape(len(motion[0]), -1)

    def valid_gaps(self, motion: Similarity) -> Float[Tensor, " n"]:
        """Valid tangency gaps after a single motion of the part [pixels]."""
        found = self._tangencies(motion)
        return found.gap[found.valid]

    def _tangencies(self, motion: Similarity) -> EpipolarTangencies:
        """The tangent planes of all pairs of frames, after each motion of the part."""
        (R, t), inputs = _moved(self.part, motion), self.observed.inputs
        h, a, b = len(R), len(self.part), len(self.other)

        def of_part(x: Tensor) -> Tensor:
            return x[:, :, None].expand(h, a, b, *x.shape[2:]).flatten(0, 2)

        def of_other(x: Tensor) -> Tensor:
            return x.expand(h, a, *x.shape).flatten(0, 2)

        frames_a = torch.tensor(self.part.frames)[:, None].expand(h, a, b).flatten()
        frames_b = torch.tensor(self.other.frames).expand(h, a, b).flatten()
        return epipolar_tangencies(
            (of_part(R), of_part(t)),
            (of_other(self.other.R), of_other(self.other.t)),
            inputs.contours[frames_a],
            inputs.contours[frames_b],
            inputs.capture.camera,
            radius=inputs.radius,
        )


def _moved(part: Partial, motion: Similarity) -> tuple[Float[Tensor, "h f 3 3"], Float[Tensor, "h f 3"]]:
    """Poses of a part in the object frame of another: `R_cam_obj`, and the object's origin in the camera frame."""
    R_new_obj, rest = motion
    R = part.R @ R_new_obj[:, None].mT
    return R, rest[:, None, 3:].exp() * part.t - torch.einsum("hfij,hj->hfi", R, rest[:, :3])


def _refined(
    residuals: Callable[[Similarity], Float[Tensor, "h n"]], start: Similarity
) -> tuple[Similarity, Float[Tensor, " h"]]:
    """Hypotheses after Levenberg-Marquardt with finite differences, and their costs.

    Args:
        residuals: Residuals of all hypotheses [pixels]; NaN where they are not valid.
    """
    unit = JACOBIAN_STEP * torch.eye(7, dtype=torch.float64)

    def shifted(motion: Similarity, rotation: Tensor, rest: Tensor) -> Similarity:
        return SO3.exp(rotation).matrix() @ motion[0], motion[1] + rest

    def linearised(motion: Similarity) -> Linearised:
        r = residuals(motion)
        return Linearised(robust_cost(r, GAP_SCALE), r)

    def moved(motion: Similarity, r: Tensor, damping: Tensor) -> Similarity:
        columns = [(residuals(shifted(motion, step[:3], step[3:])) - r) / JACOBIAN_STEP for step in unit]
        return shifted(motion, *damped_step(r, torch.stack(columns, -1), damping, GAP_SCALE))

    damping = Damping(start=1e-2, accepted=0.3, rejected=5.0)
    motion, last = minimise(start, linearised, moved, select_rows, steps=STEPS, damping=damping)
    return motion, last.cost
