"""Poses of some frames of a capture, in an object frame of their own: a part of the capture that is understood."""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor

from tumble.maths import SO3, angle_between
from tumble.poses.sfm import bundle_adjustment, frontier_points
from tumble.poses.sfm.adjustment import adjust_round
from tumble.poses.sfm.bundle_adjustment import BundleState
from tumble.poses.sfm.observations import Inputs
from tumble.poses.sfm.schedule import BaseConfig
from tumble.poses.sfm.tracks import Keypoints, Tracks, crossings
from tumble.scene import OBJECT

TOLERANCE = 3.0
"""Distance from the epipolar line up to which a match joins tracks, and reprojection error up to which a frame's
keypoint agrees with a surface point [pixels]."""
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
MAX_STEP = math.radians(20)
"""Largest rotation between consecutive frames of a motion [radians]."""
MAX_DISTANCE = 3
"""Largest distance in time of frames that are compared by it [frames]."""
GAP_SCALE = 3.0
"""Scale of the robust cost of tangency gaps [pixels]."""
MAX_COLOUR_CONTRADICTION = 2.0
"""Difference of colours between two parts, over that within them, above which they contradict a joint. On the films
`MC1` and `SM2` it is at most 1.83 for right joints, and above 2 for those that put the front on the back."""
COLOURED_POINTS = 1500
"""Number of surface points of a part whose colours are compared."""
COLOURED_FRAMES = 20
"""Number of frames, evenly spaced over a part, in which they are."""
COLOUR_SIGMA = 2.0
"""Standard deviation of the Gaussian with which frames are blurred before [pixels]."""
COLOUR_SHIFT = 3
"""Distance from its projection at which a point's colour is looked for as well [pixels]: poses have errors."""
MIN_BRIGHTNESS = 30.0
"""Sum of the channels below which the chromaticity of a pixel is uncertain [code values]."""
COLOUR_QUANTILE = 0.7
"""Quantile of the differences of colours: two faces of a box may have the same colour at half of the points."""
SAME_SIDE = math.cos(math.radians(35))
"""Cosine of the angle between two lines of sight to a surface point up to which both show it."""
MIN_TIME_APART = 3
"""Least distance in time of frames of one part whose colours are compared [frames]."""
MIN_COLOUR_DIFFERENCE = 8.0
"""Difference of colours that lights and shadows make at least [255 x chromaticity]."""
MIN_SHOWN_SHARE = 0.05
"""Share of all pairs of surface points and frames that have to be compared; fewer lie at edges only."""


@dataclass(frozen=True)
class Observed:
    """What is known of all frames."""

    cfg: BaseConfig
    inputs: Inputs
    keypoints: Keypoints
    compared: dict["Partial", "Partial"] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Frames of parts whose contours are compared with other parts' (`contour_joints`), kept since they were chosen."""
    coloured: dict["Partial", "ColouredPoints"] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Surface points of parts with their colours (`coloured_points`), kept since they were found."""

    @property
    def masks(self) -> UInt8[np.ndarray, "t h w"]:
        """Labels of all pixels (`scene.OBJECT` and others)."""
        return self.inputs.capture.masks.numpy()

    @functools.cached_property
    def chromaticity(self) -> UInt8[np.ndarray, "t h w 3"]:
        """Blurred colours of the object in all frames, divided by their sum [255 x fraction]."""
        found = []
        for image, mask in zip(self.inputs.capture.images.numpy(), self.masks, strict=True):
            shown = (mask == OBJECT).astype(np.float32)[..., None]
            total, weight = (cv2.GaussianBlur(x, (0, 0), COLOUR_SIGMA) for x in (image * shown, shown))
            blurred = total / weight[..., None].clip(1e-3)
            found.append(np.rint(255 * blurred / blurred.sum(-1, keepdims=True).clip(MIN_BRIGHTNESS)).astype(np.uint8))
        return np.stack(found)


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
    """Without the frames that few matches or few observations of surface points confirm, or where the motion jumps."""
    tracks, _ = joined_tracks(observed, part, tolerance)
    _, agrees = _triangulated(observed, part, tracks)
    observations = torch.bincount(tracks.frame[agrees], minlength=len(part))
    matches, _ = consistent_matches(observed, part, 2.0)
    enough = (observations.numpy() >= MIN_OBSERVATIONS) & (matches >= MIN_MATCHES)
    return without_jumps(part.select(np.nonzero(enough)[0].tolist()))


def without_jumps(part: Partial) -> Partial:
    """Without the frames to and from which the motion jumps, first those with a jump on both sides."""
    while len(part) > 1:
        R, distance = SO3.from_matrix(part.R), np.diff(part.frames)
        near = distance <= MAX_DISTANCE
        goes_on = near & (angle_between(R[:-1], R[1:]).numpy() <= MAX_STEP * distance)
        jumps, steps = (np.convolve(each, (1, 1)) for each in (near & ~goes_on, goes_on))
        if not (wrong := np.where(steps == 0, jumps, 0)).any():
            break
        part = part.select(np.delete(np.arange(len(part)), wrong.argmax()).tolist())
    return part


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
    count = crossings(seen, len(part)).tolist()
    cuts = [k for k in range(1, len(part)) if count[k] < min_points]
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


@dataclass(frozen=True)
class ColouredPoints:
    """Surface points of a part, one for every keypoint, and the colours that its frames show there."""

    frame: Int64[np.ndarray, " p"]
    """Frame of the keypoint."""
    X: Float[np.ndarray, "p 3"]
    """Object frame of the part."""
    towards: Float[np.ndarray, "p 3"]
    """Direction of the camera, of unit length."""
    colour: UInt8[np.ndarray, "p 3"]
    """See `Observed.chromaticity`."""
    usual: float = 0.0
    """Difference between the colours that the part's own frames show at the points (`difference`)."""

    def difference(self, observed: Observed, part: Partial, *, apart: int = 0) -> float:
        """Difference from the colours that frames of a part show at the points; 0 if they show too few.

        Args:
            part: Poses in the same object frame.
            apart: Least distance in time of the frames that are compared.
        """
        found, pairs, (_, height, width) = [np.zeros(0, np.float32)], 0, observed.masks.shape
        for k in np.linspace(0, len(part) - 1, min(COLOURED_FRAMES, len(part))).astype(np.int64).tolist():
            frame, pairs = part.frames[k], pairs + len(self.X)
            facing = (_towards(part, self.X, np.full(len(self.X), k)) * self.towards).sum(1) > SAME_SIDE
            index = np.flatnonzero(facing & (np.abs(self.frame - frame) >= apart))
            x = torch.from_numpy(self.X[index]) @ part.R[k].mT + part.t[k]
            uv = observed.keypoints.camera.project(x).floor().long().numpy()
            inside = ((uv >= 0) & (uv < (width, height))).all(1)
            found.append(_least_difference(observed, frame, uv[inside], self.colour[index[inside]]))
        differences = np.concatenate(found)
        if len(differences) <= MIN_SHOWN_SHARE * pairs:
            return 0.0
        return float(np.quantile(differences, COLOUR_QUANTILE))


def coloured_points(observed: Observed, part: Partial) -> ColouredPoints:
    """A sample of the surface points of a part that its frames show as object, and their colours."""
    if part in observed.coloured:
        return observed.coloured[part]
    X, keypoints, masks = surface_points(observed, part, TOLERANCE), observed.keypoints, observed.masks
    place = np.full(keypoints.n_frames, -1)
    place[list(part.frames)] = range(len(part))
    row_column = keypoints.uv[:, ::-1].astype(np.int64).clip(0, np.array(masks.shape[1:]) - 1)
    shown = masks[keypoints.frame, *row_column.T] == OBJECT
    index = np.flatnonzero(~np.isnan(X[:, 0]) & (place[keypoints.frame] >= 0) & shown)
    index = index[np.linspace(0, len(index) - 1, min(COLOURED_POINTS, len(index))).astype(np.int64)]
    frame, X = keypoints.frame[index], X[index]
    colour = observed.chromaticity[frame, *row_column[index].T]
    points = ColouredPoints(frame, X, _towards(part, X, place[frame]), colour)
    usual = points.difference(observed, part, apart=MIN_TIME_APART)
    observed.coloured[part] = replace(points, usual=usual)
    return observed.coloured[part]


def colour_contradictions(observed: Observed, part: Partial, other: Partial, moved: Sequence[Partial]) -> list[float]:
    """Difference of colours of two parts where they show the same surface, over that within them; 0 if they hardly do.

    Args:
        moved: The part in the object frame of the other, in each of several ways.
    """
    points = coloured_points(observed, other)
    usual = max(points.usual, coloured_points(observed, part).usual, MIN_COLOUR_DIFFERENCE)
    return [points.difference(observed, each) / usual for each in moved]


def _towards(part: Partial, X: Float[np.ndarray, "p 3"], place: Int64[np.ndarray, " p"]) -> Float[np.ndarray, "p 3"]:
    """Directions from points to the cameras of the frames at some places of a part."""
    centre = -torch.einsum("fij,fi->fj", part.R, part.t).numpy()[place] - X
    return centre / np.linalg.norm(centre, axis=1, keepdims=True)


def _least_difference(
    observed: Observed, frame: int, uv: Int64[np.ndarray, "p 2"], colour: UInt8[np.ndarray, "p 3"]
) -> Float32[np.ndarray, " q"]:
    """Differences of colours from the most similar ones at and around pixels of a frame, where these are object."""
    image, mask = observed.chromaticity[frame], observed.masks[frame]
    (column, row), (height, width) = uv.T, mask.shape
    shown = mask[row, column] == OBJECT
    least = np.full(int(shown.sum()), np.inf, np.float32)
    for shift in itertools.product((0, -COLOUR_SHIFT, COLOUR_SHIFT), repeat=2):
        column, row = (uv[shown] + shift).clip(0, (width - 1, height - 1)).T
        difference = np.abs(image[row, column].astype(np.float32) - colour[shown]).sum(1)
        least = np.minimum(least, np.where(mask[row, column] == OBJECT, difference, np.inf))
    return least
