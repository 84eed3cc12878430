"""Poses of some frames of a capture, in an object frame of their own: a part of the capture that is understood."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.poses.sfm import bundle_adjustment, frontier_points
from tumble.poses.sfm.adjustment import adjust_round
from tumble.poses.sfm.bundle_adjustment import BundleState
from tumble.poses.sfm.observations import Inputs
from tumble.poses.sfm.schedule import BaseConfig
from tumble.poses.sfm.tracks import Keypoints, Tracks

TRACKS_PER_FRAME = 120
"""Number of tracks, the longest first, up to which bundle adjustment uses those of a frame."""
ROUNDS_PER_JOIN = 3
"""Number of rounds of bundle adjustment after which tracks are joined anew."""
MIN_TOLERANCE = 1.5
"""Distance from the epipolar line up to which a match joins tracks in the last rounds [pixels]."""
MAX_POINT_ERROR = 2.5
"""Reprojection error up to which an observation agrees with a surface point [pixels]."""
MIN_OBSERVATIONS = 25
"""Number of observations that agree with the surface points below which a frame is left out."""
MIN_MATCHES = 15
"""Number of matches that agree with the epipolar lines below which a frame is left out."""
GAP_SCALE = 3.0
"""Scale of the robust cost of tangency gaps [pixels]."""


@dataclass(frozen=True)
class Observed:
    """What is known of all frames."""

    cfg: BaseConfig
    inputs: Inputs
    keypoints: Keypoints
    compared: dict["Partial", "Partial"] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Frames of parts whose contours are compared with other parts' (`contour_joints`), kept since they were chosen."""


@dataclass(frozen=True, eq=False)
class Partial:
    """Poses of some frames, in an object frame of their own."""

    frames: tuple[int, ...]
    """Their indices, ascending."""
    R: Float[Tensor, "f 3 3"]
    """`R_cam_obj`"""
    t: Float[Tensor, "f 3"]
    """Object origin, camera frame [mean distance]."""

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, places: Sequence[int]) -> "Partial":
        """Some of the frames, by their places."""
        return Partial(tuple(self.frames[k] for k in places), self.R[list(places)], self.t[list(places)])

    def merged(self, other: "Partial") -> "Partial":
        """With the frames of another part in the same object frame; the own pose is kept where both have one."""
        new = [k for k, frame in enumerate(other.frames) if frame not in self.frames]
        both = Partial(
            self.frames + tuple(other.frames[k] for k in new),
            torch.cat([self.R, other.R[new]]),
            torch.cat([self.t, other.t[new]]),
        )
        return both.select(np.argsort(both.frames).tolist())

    def nearest(self, other: "Partial") -> tuple[int, int, int]:
        """The frames of both that are nearest in time: their distance [frames], and their places in both parts."""
        return min((abs(a - b), p, q) for p, a in enumerate(self.frames) for q, b in enumerate(other.frames))

    def moved(self, R_new_obj: Tensor, scale: float, shift: Tensor) -> "Partial":
        """The same motion in another object frame: `x_new = scale * R_new_obj @ x + shift`."""
        R = self.R @ R_new_obj.mT
        return Partial(self.frames, R, scale * self.t - torch.einsum("fij,j->fi", R, shift))


def joined_tracks(observed: Observed, part: Partial, tolerance: float) -> tuple[Tracks, Int64[np.ndarray, " o"]]:
    """Tracks through the frames of a part (`Keypoints.tracks`)."""
    return observed.keypoints.tracks(part.frames, part.R, part.t, tolerance)


def adjusted(observed: Observed, part: Partial, scales: Sequence[float]) -> Partial:
    """Bundle adjustment of a part, one round for every scale of the Cauchy loss [pixels]."""
    frames, rng = torch.tensor(part.frames)[None], torch.Generator().manual_seed(0)
    tracks, group = None, torch.zeros(0, dtype=torch.long)
    for number, scale in enumerate(scales):
        if tracks is None or number % ROUNDS_PER_JOIN == 0:
            tracks = thinned(joined_tracks(observed, part, max(MIN_TOLERANCE, 2 * scale))[0])
            group = torch.zeros(tracks.n, dtype=torch.long)
        scene = BundleState(part.R[None], part.t[None], torch.zeros(0, 3, dtype=part.R.dtype))
        scene, _ = adjust_round(observed.cfg, observed.inputs, scene, tracks, group, frames, scale, rng)
        part = Partial(part.frames, scene.R[0], scene.t[0])
    return part


def thinned(tracks: Tracks) -> Tracks:
    """The longest tracks, until every frame has `TRACKS_PER_FRAME` of them."""
    length = torch.bincount(tracks.point, minlength=tracks.n)
    count = np.zeros(int(tracks.frame.max()) + 1 if len(tracks) else 0, np.int64)
    keep = torch.zeros(tracks.n, dtype=torch.bool)
    order = torch.argsort(tracks.point, stable=True)
    frames_of = tracks.frame[order].split(length.tolist())
    for point in length.argsort(descending=True, stable=True).tolist():
        frames = frames_of[point].numpy()
        if count[frames].min() < TRACKS_PER_FRAME:
            keep[point] = True
            count[frames] += 1
    return tracks.select(keep[tracks.point])


def surface_points(observed: Observed, part: Partial, tolerance: float) -> Float[np.ndarray, "k 3"]:
    """Surface point of every keypoint, in the object frame of the part; NaN where no observation agrees with one."""
    tracks, keypoint = joined_tracks(observed, part, tolerance)
    X, agrees = _triangulated(observed, part, tracks)
    points = np.full((len(observed.keypoints.frame), 3), np.nan)
    points[keypoint[agrees.numpy()]] = X[tracks.point].numpy()[agrees.numpy()]
    return points


def _triangulated(observed: Observed, part: Partial, tracks: Tracks) -> tuple[Tensor, Tensor]:
    """The points of tracks, and which observations agree with them."""
    inputs, camera = observed.inputs, observed.inputs.capture.camera
    radius = inputs.silhouettes.radius[list(part.frames)]
    X = bundle_adjustment.triangulate(tracks, part.R, part.t, camera, radius)
    x = torch.einsum("oij,oj->oi", part.R[tracks.frame], X[tracks.point]) + part.t[tracks.frame]
    in_front = torch.cat([x[:, :2], x[:, 2:].clamp_min(bundle_adjustment.MIN_DEPTH)], 1)
    return X, (camera.project(in_front) - tracks.uv).norm(dim=-1) < MAX_POINT_ERROR


def pruned(observed: Observed, part: Partial, tolerance: float) -> Partial:
    """Without the frames that few matches and few observations of surface points confirm."""
    tracks, _ = joined_tracks(observed, part, tolerance)
    _, agrees = _triangulated(observed, part, tracks)
    observations = torch.bincount(tracks.frame[agrees], minlength=len(part))
    matches, _ = consistent_matches(observed, part, 2.0)
    enough = (observations.numpy() >= MIN_OBSERVATIONS) & (matches >= MIN_MATCHES)
    return part.select(np.nonzero(enough)[0].tolist())


def consistent_matches(
    observed: Observed, part: Partial, tolerance: float
) -> tuple[Int64[np.ndarray, " f"], Int64[np.ndarray, " f"]]:
    """Per frame, the matches with other frames of the part that agree with the epipolar lines, and all matches."""
    _, places, right = observed.keypoints.consistent(part.frames, part.R, part.t, tolerance)
    agreeing, of = (np.bincount(each.ravel(), minlength=len(part)) for each in (places[right], places))
    return agreeing, of


def cut(observed: Observed, part: Partial, tolerance: float, min_points: int) -> list[Partial]:
    """The pieces of a part between which fewer than `min_points` surface points are seen before and after."""
    tracks, _ = joined_tracks(observed, part, tolerance)
    seen = tracks.select(_triangulated(observed, part, tracks)[1])
    first = torch.full((seen.n,), len(part)).scatter_reduce_(0, seen.point, seen.frame, "amin")
    last = torch.zeros(seen.n, dtype=torch.long).scatter_reduce_(0, seen.point, seen.frame, "amax")
    cuts = [k for k in range(1, len(part)) if int(((first < k) & (last >= k)).sum()) < min_points]
    return [part.select(range(a, b)) for a, b in itertools.pairwise((0, *cuts, len(part)))]


def contour_cost(observed: Observed, part: Partial, other: Partial) -> tuple[float, int]:
    """Mean robust cost of the tangency gaps between the frames of two parts, and the number of gaps."""
    a, b = torch.cartesian_prod(torch.arange(len(part)), torch.arange(len(other))).T
    frames_a, frames_b = torch.tensor(part.frames)[a], torch.tensor(other.frames)[b]
    inputs = observed.inputs
    found = frontier_points.epipolar_tangencies(
        (part.R[a], part.t[a]),
        (other.R[b], other.t[b]),
        inputs.contours[frames_a],
        inputs.contours[frames_b],
        inputs.capture.camera,
        radius=inputs.radius,
    )
    gap = found.gap[found.valid & (frames_a != frames_b)[:, None]]
    return float(frontier_points.cauchy_loss(gap, GAP_SCALE).mean()) if len(gap) else 0.0, len(gap)
