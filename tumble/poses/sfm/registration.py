"""Registration of frames, and of whole parts of a capture, to a part whose poses and surface points are known.

Poses follow from correspondences between keypoints and surface points (perspective-n-point). A view of a few points
that lie about in a plane has a second, mirrored solution, and wrong matches suggest others, so all of them are
hypotheses. They are rated by all correspondences, by the contours, and by the motion from frame to frame.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.maths import SO3, angle_between
from tumble.poses.sfm import bundle_adjustment
from tumble.poses.sfm.contour_joints import MAX_COST as MAX_AGREEING_COST
from tumble.poses.sfm.contour_joints import MIN_GAPS as MIN_CONFIRMING_GAPS
from tumble.poses.sfm.contour_joints import (
    ContourJoint,
    Correspondences,
    Similarity,
    contour_joint,
    fitted_to_both,
    moved_part,
)
from tumble.poses.sfm.partial import (
    MAX_COLOUR_CONTRADICTION,
    MAX_DISTANCE,
    MAX_STEP,
    TOLERANCE,
    Observed,
    Partial,
    adjusted,
    colour_contradictions,
    contour_cost,
    pruned,
    surface_points,
)

RANSAC_ERROR = 2.5
"""Reprojection error of inliers in the search for a pose [pixels]."""
RANSAC_ITERATIONS = 400
MIN_CORRESPONDENCES = 8
"""Number of correspondences, and of inliers, below which no pose is computed."""
SAME_ROTATION = math.radians(13)
"""Angle below which two solutions are the same [radians]."""
MIN_DEPTH = 0.3
"""Least distance of a solution [mean distance]; smaller ones are degenerate."""
JOINT_ERROR = 5.0
"""Reprojection error up to which a keypoint agrees with a hypothesis for a whole part, which is not adjusted yet
[pixels]."""
MAX_SCALE = 1.6
"""Largest ratio of the scales of two parts; the distance of the object hardly changes."""
FITTED_HYPOTHESES = 6
"""Number of hypotheses, in order of agreeing keypoints, that are fitted to these and to the contours."""
MIN_SHARE = 0.5
"""Agreeing keypoints of a hypothesis over those of the best, below which it is not considered."""
MIN_JOINT_KEYPOINTS = 100
"""Number of agreeing keypoints from which two parts are joined."""
MIN_MAJORITY_KEYPOINTS = 40
"""The same if they are more than half of the keypoints that have a surface point in the other part, or if contours
confirm them. Of 149 pairs of pieces of twelve frames (the film `MC1` of a cracker box, a synthetic one of a soup can in
a hand) hypotheses with 40 to 100 keypoints were wrong 12 times of 12 where these were less than half, and right 10
times of 10 elsewhere."""
MIN_JOINT_FRAMES = 2
"""Number of frames with `MIN_CORRESPONDENCES` agreeing keypoints below which keypoints alone do not join two parts."""
MIN_CERTAIN_FRAMES = 0.25
"""The same, as a fraction of the part's frames, below which a joint of a minority of keypoints waits until the network
has matched (`Joint.certain`). The wrong joint of the halves of `SM2` has 0.08, right ones of `MC1` 0.35 to 0.45."""
MIN_GAPS = 50
"""Number of tangency gaps below which contours do not contradict that two parts belong together."""
MAX_CONTOUR_COST = 1.1
"""Cost of contours (`partial.contour_cost`) above which they contradict a pose; of wrong ones that were not fitted to
contours it is 1.4 to 5."""
MAX_CONFIRMING_COST = 0.1
"""Cost of contours up to which they confirm a joint of few keypoints: that of gaps of one pixel. On the film `SM2` a
joint at 0.19 was 20 degrees off; the bottle's are at 0.05 to 0.07."""
SURE_SHARE = 0.8
"""Share of agreeing keypoints from which contours do not contradict: it is a mask then that is wrong. On the film `MC1`
a forearm counts as object, and right joints of 800 to 2,900 keypoints with such shares cost 1.2 to 1.7; wrong joints
that contours contradict have shares up to 0.74 (`SM2`)."""
MIN_FRAME_KEYPOINTS = 25
"""Number of agreeing keypoints below which a frame is not added."""
MIN_FRAME_FRACTION = 0.35
"""Fraction of a frame's keypoints with correspondences that have to agree with its pose."""
MIN_FRAME_GAPS = 15
"""Number of tangency gaps from which the contour of a frame counts."""
JOINING_SCALES = (3.0, 2.0, 1.5, 1.0, 0.7, 0.7)
"""Scales of the Cauchy loss in the rounds of adjustment after two parts were joined [pixels]."""
ADDING_SCALES = (2.0, 1.5, 1.0, 0.7)
"""Scales of the Cauchy loss in the rounds of adjustment after frames were added [pixels]."""

Solution = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
"""`R_cam_obj` and the object's origin in the camera frame."""


@dataclass(frozen=True)
class Joint:
    """A hypothesis for a part: its poses in the object frame of another part, and what speaks for it."""

    part: Partial
    keypoints: int
    """Number of keypoints that agree with the surface points of the other part."""
    share: float
    """The same over the number of all keypoints that have a surface point there."""
    frames: int
    """Number of frames with `MIN_CORRESPONDENCES` of these."""
    cost: float
    """Cost of the contours."""
    gaps: int
    """Number of tangency gaps behind that cost."""
    continuous: bool
    """Whether the object turns little from the frames of one part to those of the other that are near in time."""
    contradiction: float = 0.0
    """See `colour_contradictions`."""

    @property
    def strength(self) -> float:
        """What the strongest of several joints has most of."""
        return self.keypoints

    @property
    def accepted(self) -> bool:
        """Whether the two parts belong together in this way."""
        if not self.possible:
            return False
        if self.measurable and self.cost > MAX_CONTOUR_COST and self.share < SURE_SHARE:
            return False
        if self.confirmed:
            return self.keypoints >= MIN_MAJORITY_KEYPOINTS and self.frames > 0
        enough = MIN_MAJORITY_KEYPOINTS if self.share > 0.5 else MIN_JOINT_KEYPOINTS
        return self.keypoints >= enough and self.frames >= MIN_JOINT_FRAMES

    @property
    def possible(self) -> bool:
        """Whether the colours of both parts do not contradict it."""
        return self.contradiction <= MAX_COLOUR_CONTRADICTION

    @property
    def certain(self) -> bool:
        """Whether it can do without other matches: more than half of the keypoints agree, or some in many frames."""
        return self.share > 0.5 or self.frames >= MIN_CERTAIN_FRAMES * len(self.part)

    @property
    def measurable(self) -> bool:
        """Whether enough contours are seen to contradict it."""
        return self.gaps >= MIN_GAPS

    @property
    def confirmed(self) -> bool:
        """Whether contours confirm it.

        On synthetic films of a bottle and a can in a hand this was so of 11 joints with 40 to 100 keypoints; all are
        right but one of a can, about whose axis contours say nothing, which is 26 degrees off.
        """
        return self.gaps >= MIN_CONFIRMING_GAPS and self.cost <= MAX_CONFIRMING_COST

    def agrees_with(self, contours: ContourJoint) -> bool:
        """Whether contours alone suggest the same rotation, so that each confirms the other.

        Each is searched for without the other; only then keypoints are fitted to contours as well. Among the rotations
        within 60 degrees of the motion's continuation a random one is that near to another one time of a hundred.
        """
        angle = angle_between(SO3.from_matrix(self.part.R[0]), SO3.from_matrix(contours.part.R[0]))
        same = float(angle) < SAME_ROTATION and contours.cost <= MAX_AGREEING_COST
        not_contradicted = self.measurable and self.cost <= MAX_CONTOUR_COST and self.possible and self.continuous
        return same and not_contradicted and self.keypoints >= MIN_CORRESPONDENCES

    @property
    def order(self) -> tuple[bool, bool, float]:
        """What the best of several hypotheses for the same parts has least of."""
        return not self.accepted, not self.continuous, self.cost if self.measurable else math.inf


Propose = Callable[[Observed, Partial, Partial], Joint | ContourJoint | None]
"""The best joint of a part and another, by keypoints or by contours; None if there is none."""
Hypotheses = dict[tuple[Propose, Partial, Partial], Joint | ContourJoint | None]
"""Joints that have been computed, of pairs of parts with the larger part first."""


def solutions(
    observed: Observed, uv: Float[np.ndarray, "c 2"], X: Float[np.ndarray, "c 3"]
) -> list[tuple[Solution, int]]:
    """Poses that agree with correspondences of keypoints and surface points, and the number of inliers of each.

    Beside the best pose this is its mirror image in depth, from which it cannot be told if the points are few and flat.
    """
    if len(uv) < MIN_CORRESPONDENCES:
        return []
    K = observed.keypoints.camera.matrix.double().numpy()
    try:
        found, r, t, inliers = cv2.solvePnPRansac(
            X,
            uv,
            K,
            None,
            iterationsCount=RANSAC_ITERATIONS,
            reprojectionError=RANSAC_ERROR,
            confidence=0.999,
            flags=cv2.SOLVEPNP_EPNP,
        )
    except cv2.error:  # EPnP refuses degenerate configurations, such as points on a line.
        return []
    if not found or inliers is None or len(inliers) < MIN_CORRESPONDENCES:
        return []
    inlier: np.ndarray = np.asarray(inliers)[:, 0]
    X_in, uv_in = X[inlier], uv[inlier]
    R = cv2.Rodrigues(r)[0]
    kept: list[tuple[Solution, int]] = []
    for start_R, start_t in ((R, t[:, 0]), _mirrored(R, t[:, 0], X_in)):
        r, t = cv2.solvePnPRefineLM(X_in, uv_in, K, None, cv2.Rodrigues(start_R)[0], start_t[:, None].copy())
        new_R, new_t = cv2.Rodrigues(r)[0], t[:, 0]
        cosines = [(np.trace(new_R.T @ old) - 1) / 2 for (old, _), _ in kept]
        if new_t[2] < MIN_DEPTH or any(cosine > math.cos(SAME_ROTATION) for cosine in cosines):
            continue
        kept.append(((new_R, new_t), int((_errors(observed, (new_R, new_t), uv, X) < RANSAC_ERROR).sum())))
    return [each for each in kept if each[1] >= MIN_CORRESPONDENCES]


def _mirrored(R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"], X: Float[np.ndarray, "c 3"]) -> Solution:
    """The pose in which the plane through points that lie about in one has the mirrored normal (Necker reversal)."""
    middle = X.mean(0)
    ray = R @ middle + t
    ray = ray / np.linalg.norm(ray)
    normal = np.linalg.svd((X - middle) @ R.T)[2][2]
    mirrored = 2 * (normal @ ray) * ray - normal
    axis = np.cross(normal, mirrored)
    sine = float(np.linalg.norm(axis))
    turn = cv2.Rodrigues(axis / max(sine, 1e-12) * math.atan2(sine, float(normal @ mirrored)))[0]
    return turn @ R, R @ middle + t - turn @ R @ middle


def _errors(
    observed: Observed, solution: Solution, uv: Float[np.ndarray, "c 2"], X: Float[np.ndarray, "c 3"]
) -> Float[np.ndarray, " c"]:
    """Reprojection errors [pixels]."""
    return _distances(observed, X @ solution[0].T + solution[1], uv)


def _distances(
    observed: Observed, x: Float[np.ndarray, "c 3"], uv: Float[np.ndarray, "c 2"]
) -> Float[np.ndarray, " c"]:
    """Distances between the projections of points in the camera frame and positions [pixels]."""
    in_front = np.column_stack([x[:, :2], x[:, 2].clip(bundle_adjustment.MIN_DEPTH)])
    return np.linalg.norm(observed.keypoints.camera.project(torch.from_numpy(in_front)).numpy() - uv, axis=1)


def best_joint(observed: Observed, part: Partial, other: Partial) -> Joint | None:
    """The best hypothesis for the poses of a part in the object frame of another, larger one; None if there is none.

    Every frame of the part suggests poses for all of its frames, as their relative poses are known. Those with many
    agreeing keypoints are fitted to these and to the contours; among them the contours decide, but a jump of the motion
    is the last resort: print that is on two faces of a box suggests half a revolution, of which contours see nothing.
    Where all of them put one face on another of other colours, those with fewer keypoints follow.
    """
    X = surface_points(observed, other, TOLERANCE)
    seen = [observed.keypoints.correspondences(frame, other.frames, X) for frame in part.frames]
    keypoint, points = (np.concatenate(each) for each in zip(*seen, strict=True))
    proposed = _proposed(observed, part, other, seen)
    if proposed is None:
        return None
    as_proposed = (moved_part(part, proposed, k) for k in range(len(proposed[0])))
    agreeing = np.array([_agreeing(observed, each, keypoint, points, JOINT_ERROR).sum() for each in as_proposed])
    place = np.searchsorted(part.frames, observed.keypoints.frame[keypoint])
    together = Correspondences(*map(torch.from_numpy, (place, observed.keypoints.uv[keypoint], points)))
    left, found = _distinct(proposed[0], agreeing), []
    while left and (not found or agreeing[left[0]] >= MIN_MAJORITY_KEYPOINTS):
        chosen = [k for k in left[:FITTED_HYPOTHESES] if agreeing[k] >= MIN_SHARE * agreeing[left[0]]]
        start = proposed[0][chosen], proposed[1][chosen]
        fitted = fitted_to_both(observed, part, other, together, start, JOINT_ERROR)
        moved = [moved_part(part, fitted, k) for k in range(len(chosen))]
        found += _joints(observed, part, other, (keypoint, points), moved)
        if any(joint.possible for joint in found):
            break
        left = left[len(chosen) :]
    found = [joint for joint in found if joint.possible] or found
    most = max(joint.keypoints for joint in found)
    return min((joint for joint in found if joint.keypoints >= MIN_SHARE * most), key=lambda joint: joint.order)


def _joints(
    observed: Observed,
    part: Partial,
    other: Partial,
    seen: tuple[Int64[np.ndarray, " c"], Float[np.ndarray, "c 3"]],
    moved: Sequence[Partial],
) -> list[Joint]:
    """What speaks for each of several ways to put a part into the object frame of another.

    Args:
        seen: Keypoints of the part and their surface points in the other.
    """
    (keypoint, points), (distance, p, q) = seen, part.nearest(other)
    matched, joints = max(1, len(np.unique(keypoint))), []
    contradictions = colour_contradictions(observed, part, other, moved)
    for new, contradiction in zip(moved, contradictions, strict=True):
        counts = _agreeing(observed, new, keypoint, points, JOINT_ERROR)
        step = float(angle_between(SO3.from_matrix(new.R[p]), SO3.from_matrix(other.R[q])))
        continuous = distance == 0 or step <= MAX_STEP * distance
        number, frames = int(counts.sum()), int((counts >= MIN_CORRESPONDENCES).sum())
        cost, gaps = contour_cost(observed, other, new)
        joints.append(Joint(new, number, number / matched, frames, cost, gaps, continuous, contradiction))
    return joints


def _proposed(
    observed: Observed,
    part: Partial,
    other: Partial,
    seen: Sequence[tuple[Int64[np.ndarray, " c"], Float[np.ndarray, "c 3"]]],
) -> Similarity | None:
    """Motions of a part to the object frame of another that single frames suggest; None if there are none.

    Args:
        seen: Of every frame of the part, keypoints and their surface points in the other.
    """
    found = []
    for place, (frame, (keypoint, points)) in enumerate(zip(part.frames, seen, strict=True)):
        poses = [solution for solution, _ in solutions(observed, observed.keypoints.uv[keypoint], points)]
        if frame in other.frames:
            k = other.frames.index(frame)
            poses.append((other.R[k].numpy(), other.t[k].numpy()))
        for R, t in (map(torch.from_numpy, pose) for pose in poses):
            scale = t[2] / part.t[place, 2]
            if 1 / MAX_SCALE < scale < MAX_SCALE:
                found.append((R.mT @ part.R[place], torch.cat([R.mT @ (scale * part.t[place] - t), scale.log()[None]])))
    return None if not found else (torch.stack([R for R, _ in found]), torch.stack([rest for _, rest in found]))


def _distinct(R_new_obj: Float[Tensor, "h 3 3"], keypoints: Int64[np.ndarray, " h"]) -> list[int]:
    """Of hypotheses with about the same rotation the one with the most agreeing keypoints, best first."""
    chosen: list[int] = []
    rotation = SO3.from_matrix(R_new_obj)
    for k in np.argsort(-keypoints, kind="stable").tolist():
        if not chosen or bool((angle_between(rotation[chosen], rotation[k]) > SAME_ROTATION).all()):
            chosen.append(k)
    return chosen


def _agreeing(
    observed: Observed,
    part: Partial,
    keypoint: Int64[np.ndarray, " c"],
    X: Float[np.ndarray, "c 3"],
    error: float = TOLERANCE,
) -> Int64[np.ndarray, " f"]:
    """Number of keypoints of each frame of a part that agree with a surface point.

    Args:
        keypoint: Keypoints of the part's frames; one may have several surface points.
        X: Their surface points, object frame.
        error: Reprojection error up to which they agree [pixels].
    """
    place = np.searchsorted(part.frames, observed.keypoints.frame[keypoint])
    x = np.einsum("cij,cj->ci", part.R.numpy()[place], X) + part.t.numpy()[place]
    agreeing = np.unique(keypoint[_distances(observed, x, observed.keypoints.uv[keypoint]) < error])
    return np.bincount(np.searchsorted(part.frames, observed.keypoints.frame[agreeing]), minlength=len(part))


def join(observed: Observed, parts: Sequence[Partial], known: Hypotheses, *, certain: bool) -> list[Partial]:
    """Join parts, the best confirmed pair first, until no two belong together.

    Args:
        parts: Parts of the capture.
        known: Hypotheses of earlier calls; new ones are added.
        certain: Only make joints that are `Joint.certain`. Others are the last resort: the cap of a bottle looks the
            same from all sides, and its keypoints agree with any turn about the axis.
    """
    parts = sorted(parts, key=len, reverse=True)
    while True:
        pairs = [(a, b) for k, a in enumerate(parts) for b in parts[k + 1 :]]
        found = _best(observed, pairs, known, best_joint, certain=certain)
        if found is None and not certain:
            by_contours = _best(observed, pairs, known, contour_joint)  # contours join what shares no texture
            found = _agreed(pairs, known) or by_contours
        if found is None:
            return parts
        (a, b), joint = found
        both = pruned(observed, adjusted(observed, a.merged(joint.part), JOINING_SCALES), TOLERANCE)
        parts = sorted([part for part in parts if part is not a and part is not b] + [both], key=len, reverse=True)


def _best(
    observed: Observed,
    pairs: Sequence[tuple[Partial, Partial]],
    known: Hypotheses,
    propose: Propose,
    *,
    certain: bool = False,
) -> tuple[tuple[Partial, Partial], Joint | ContourJoint] | None:
    """The pair with the strongest accepted joint, and the joint."""
    for a, b in pairs:
        if (propose, a, b) not in known:
            known[propose, a, b] = propose(observed, b, a)
    joints = [((a, b), joint) for a, b in pairs if (joint := known[propose, a, b]) is not None and joint.accepted]
    joints = [each for each in joints if each[1].certain or not certain]
    return max(joints, key=lambda each: each[1].strength, default=None)


def _agreed(
    pairs: Sequence[tuple[Partial, Partial]], known: Hypotheses
) -> tuple[tuple[Partial, Partial], Joint] | None:
    """Of the pairs for which keypoints and contours suggest the same joint, that with most keypoints, and the joint."""
    found = []
    for a, b in pairs:
        joint, contours = known[best_joint, a, b], known[contour_joint, a, b]
        if isinstance(joint, Joint) and isinstance(contours, ContourJoint) and joint.agrees_with(contours):
            found.append(((a, b), joint))
    return max(found, key=lambda each: each[1].strength, default=None)


def grow(observed: Observed, part: Partial, *, without: Collection[int] = ()) -> Partial:
    """Add neighbouring frames, one after another, for as long as keypoints, contours and motion confirm them.

    Args:
        without: Frames that are not added.
    """
    frames = [frame for frame in range(observed.keypoints.n_frames) if frame not in without]
    while True:
        X = surface_points(observed, part, TOLERANCE)
        new = [_registered(observed, part, frame, X) for frame in frames]
        grown = part
        for each in new:
            grown = grown if each is None else grown.merged(each)
        if len(grown) == len(part):
            return part
        grown = pruned(observed, adjusted(observed, grown, ADDING_SCALES), TOLERANCE)
        if set(grown.frames) <= set(part.frames):
            return part
        part = grown


def _registered(observed: Observed, part: Partial, frame: int, X: Float[np.ndarray, "k 3"]) -> Partial | None:
    """A frame with its pose in the object frame of a part; None if there is none or it is not confirmed."""
    distance, near = min((abs(frame - other), k) for k, other in enumerate(part.frames))
    if distance == 0 or distance > MAX_DISTANCE:
        return None
    seen = observed.keypoints.correspondences(frame, part.frames, X)
    keypoint = seen[0]
    confirmed = []
    for (R, t), _ in solutions(observed, observed.keypoints.uv[keypoint], seen[1]):
        one = Partial((frame,), torch.from_numpy(R)[None], torch.from_numpy(t)[None])
        count = int(_agreeing(observed, one, *seen)[0])
        cost, gaps = contour_cost(observed, part, one)
        cost = cost if gaps >= MIN_FRAME_GAPS else 0.0
        step = float(angle_between(SO3.from_matrix(one.R[0]), SO3.from_matrix(part.R[near]))) / distance
        enough = count >= max(MIN_FRAME_KEYPOINTS, MIN_FRAME_FRACTION * len(np.unique(keypoint)))
        if enough and step <= MAX_STEP and cost <= MAX_CONTOUR_COST:
            confirmed.append((count, one))
    return max(confirmed, key=lambda each: each[0], default=(0, None))[1]
