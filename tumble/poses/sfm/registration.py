"""Registration of frames, and of whole parts of a capture, to a part whose poses and surface points are known.

Poses follow from correspondences between keypoints and surface points (perspective-n-point). A view of a few points
that lie about in a plane has a second, mirrored solution, and wrong matches suggest others, so all of them are
hypotheses. They are rated by all correspondences, by the contours, and by the motion from frame to frame.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int64

from tumble.maths import SO3, angle_between
from tumble.poses.sfm import bundle_adjustment
from tumble.poses.sfm.contour_joints import ContourJoint, contour_joint
from tumble.poses.sfm.partial import Observed, Partial, adjusted, contour_cost, pruned, surface_points

TOLERANCE = 3.0
"""Distance from the epipolar line up to which a match joins tracks, and reprojection error up to which a frame's
keypoint agrees with a surface point [pixels]."""
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
RATED_HYPOTHESES = 12
"""Number of hypotheses, in order of agreeing keypoints, whose contours are compared."""
MIN_SHARE = 0.5
"""Agreeing keypoints of a hypothesis over those of the best, below which it is not considered."""
MIN_JOINT_KEYPOINTS = 40
"""Number of agreeing keypoints below which two parts are not joined."""
MIN_JOINT_FRAMES = 2
"""Number of frames with `MIN_CORRESPONDENCES` agreeing keypoints below which two parts are not joined."""
MIN_GAPS = 50
"""Number of tangency gaps below which contours do not confirm that two parts belong together."""
MIN_UNCONFIRMED_KEYPOINTS = 100
"""Number of agreeing keypoints that two parts need to be joined where contours confirm nothing."""
MAX_CONTOUR_COST = 1.1
"""Cost of contours (`partial.contour_cost`) above which they contradict a pose; of wrong ones it is 1.4 to 5."""
MIN_FRAME_KEYPOINTS = 25
"""Number of agreeing keypoints below which a frame is not added."""
MIN_FRAME_FRACTION = 0.35
"""Fraction of a frame's keypoints with correspondences that have to agree with its pose."""
MIN_FRAME_GAPS = 15
"""Number of tangency gaps from which the contour of a frame counts."""
MAX_STEP = math.radians(20)
"""Largest rotation between consecutive frames with which a frame is added [radians]."""
MAX_DISTANCE = 3
"""Largest distance in time from a frame with a pose at which a frame is added [frames]."""
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
    frames: int
    """Number of frames with `MIN_CORRESPONDENCES` of these."""
    cost: float
    """Cost of the contours."""
    gaps: int
    """Number of tangency gaps behind that cost."""

    @property
    def strength(self) -> float:
        """What the strongest of several joints has most of."""
        return self.keypoints

    @property
    def accepted(self) -> bool:
        """Whether the two parts belong together in this way."""
        if self.keypoints < MIN_JOINT_KEYPOINTS or self.frames < MIN_JOINT_FRAMES:
            return False
        if self.gaps < MIN_GAPS:
            return self.keypoints >= MIN_UNCONFIRMED_KEYPOINTS
        return self.cost <= MAX_CONTOUR_COST


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

    Every frame of the part suggests poses for all of its frames, as their relative poses are known. Among those with
    many agreeing keypoints the contours decide.
    """
    X = surface_points(observed, other, TOLERANCE)
    seen = [observed.keypoints.correspondences(frame, other.frames, X) for frame in part.frames]
    keypoints, all_points = (np.concatenate(each) for each in zip(*seen, strict=True))
    rated = []
    for place, frame in enumerate(part.frames):
        keypoint, points = seen[place]
        found = [solution for solution, _ in solutions(observed, observed.keypoints.uv[keypoint], points)]
        if frame in other.frames:
            k = other.frames.index(frame)
            found.append((other.R[k].numpy(), other.t[k].numpy()))
        for R, t in found:
            scale = float(t[2] / part.t[place, 2])
            if 1 / MAX_SCALE < scale < MAX_SCALE:
                R_new_obj = R.T @ part.R[place].numpy()
                shift = torch.from_numpy(R.T @ (scale * part.t[place].numpy() - t))
                moved = part.moved(torch.from_numpy(R_new_obj), scale, shift)
                counts = _agreeing(observed, moved, keypoints, all_points, JOINT_ERROR)
                rated.append((int(counts.sum()), int((counts >= MIN_CORRESPONDENCES).sum()), moved))
    rated.sort(key=lambda each: -each[0])
    joints = [
        Joint(moved, count, frames, *contour_cost(observed, other, moved))
        for count, frames, moved in rated[:RATED_HYPOTHESES]
        if count >= MIN_SHARE * rated[0][0]
    ]
    return min(joints, key=lambda joint: joint.cost if joint.gaps >= MIN_GAPS else math.inf, default=None)


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


def join(observed: Observed, parts: Sequence[Partial], known: Hypotheses) -> list[Partial]:
    """Join parts, the best confirmed pair first, until no two belong together.

    Args:
        parts: Parts of the capture.
        known: Hypotheses of earlier calls; new ones are added.
    """
    parts = sorted(parts, key=len, reverse=True)
    while True:
        pairs = [(a, b) for k, a in enumerate(parts) for b in parts[k + 1 :]]
        # Contours join what shares no texture.
        found = _best(observed, pairs, known, best_joint) or _best(observed, pairs, known, contour_joint)
        if found is None:
            return parts
        (a, b), joint = found
        both = pruned(observed, adjusted(observed, a.merged(joint.part), JOINING_SCALES), TOLERANCE)
        parts = sorted([part for part in parts if part is not a and part is not b] + [both], key=len, reverse=True)


def _best(
    observed: Observed, pairs: Sequence[tuple[Partial, Partial]], known: Hypotheses, propose: Propose
) -> tuple[tuple[Partial, Partial], Joint | ContourJoint] | None:
    """The pair with the strongest accepted joint, and the joint."""
    for a, b in pairs:
        if (propose, a, b) not in known:
            known[propose, a, b] = propose(observed, b, a)
    joints = [((a, b), joint) for a, b in pairs if (joint := known[propose, a, b]) is not None and joint.accepted]
    return max(joints, key=lambda each: each[1].strength, default=None)


def grow(observed: Observed, part: Partial) -> Partial:
    """Add neighbouring frames, one after another, for as long as keypoints, contours and motion confirm them."""
    while True:
        X = surface_points(observed, part, TOLERANCE)
        new = [_registered(observed, part, frame, X) for frame in range(observed.keypoints.n_frames)]
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
