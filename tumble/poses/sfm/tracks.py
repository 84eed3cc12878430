"""Feature tracks: matches chained through many frames.

A *track* is one surface point with its *observations*, the positions at which frames show it. Bundle adjustment needs
long tracks: with tracks of two or three frames the poses of a short stretch of video can bend by many degrees. Dense
matches start at arbitrary positions, so two of them rarely share a pixel. A track is therefore continued by a local
affine fit to the matches around its current position, and new tracks start where no track passes.

Such tracks end where a hand passes or the object turns away. Matches between frames that are far apart in time connect
them, but a few wrong ones would join tracks of different points. Which matches are right can be told once the poses of
both frames are known, by their distance from the epipolar line: `Keypoints` joins tracks for given poses.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.scene import Camera, Match

MATCH_RADIUS = 2.2
"""Distance from a point up to which matches are used to continue its track [pixels]."""
MATCH_TOLERANCE = 1.0
"""Residual against the local affine fit up to which a match agrees with it [pixels]."""
MAX_NEIGHBOURS = 8
"""Largest number of matches used to continue one track."""
AFFINE_REGULARISATION = 0.05
"""Ridge weight on the linear part of the local affine fit, which tends to the mean shift where matches are few."""
SHORT_GAP = 2
"""Distance in time up to which every pair of frames is used [frames]."""
MIN_LONG_GAP_MATCHES = 60
"""Number of matches from which a pair farther apart is used as well; accidental matches are fewer."""
MIN_SEPARATION = 0.5
"""Width of the grid cells in which only the oldest track is continued [spacing of new tracks]."""
KEYPOINT_RESOLUTION = 0.01
"""Positions that agree to this precision are one keypoint [pixels]."""
MIN_CONSISTENT = 8
"""Smallest number of matches of a pair of frames that agree with their poses; fewer agree by chance."""


@dataclass(frozen=True)
class Tracks:
    """Observations of surface points: `o` observations of `n` points."""

    frame: Int64[Tensor, " o"]
    """Index of the frame."""
    point: Int64[Tensor, " o"]
    """Index of the point, in [0, n); every point has at least one observation."""
    uv: Float[Tensor, "o 2"]
    """Observed position [pixels]."""

    @property
    def n(self) -> int:
        """Number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def __len__(self) -> int:
        return len(self.point)

    def select(self, keep: Tensor, min_observations: int = 2) -> "Tracks":
        """A subset of the observations, with points renumbered.

        Points that keep fewer than `min_observations` observations are dropped.
        """
        frame, point, uv = self.frame[keep], self.point[keep], self.uv[keep]
        if not len(point):
            return Tracks(frame, point, uv)
        enough = torch.bincount(point)[point] >= min_observations
        _, renumbered = torch.unique(point[enough], return_inverse=True)
        return Tracks(frame[enough], renumbered, uv[enough])


NO_TRACKS = Tracks(torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long), torch.zeros(0, 2).double())
"""No tracks at all."""


def crossings(tracks: Tracks, n: int) -> Int64[Tensor, " {n}"]:
    """Number of points that are seen both before each of n frames and from then on."""
    first = torch.full((tracks.n,), n).scatter_reduce_(0, tracks.point, tracks.frame, "amin")
    last = torch.full((tracks.n,), -1).scatter_reduce_(0, tracks.point, tracks.frame, "amax")
    k = torch.arange(n)[:, None]
    return ((first < k) & (last >= k)).sum(1)


def concatenate(*parts: Tracks) -> Tracks:
    """Union of tracks of distinct points, numbered in the order of the parts."""
    point, n_points = [], 0
    for part in parts:
        point.append(part.point + n_points)
        n_points += part.n
    return Tracks(torch.cat([p.frame for p in parts]), torch.cat(point), torch.cat([p.uv for p in parts]))


def chain_matches(matches: Sequence[Match], spacing: Float[Tensor, " t"]) -> Tracks:
    """Tracks through all frames, continued forward in time.

    Args:
        matches: Matches of any matcher, each with i < j.
        spacing: Distance between new tracks, per frame [pixels].
    """
    from_frame: dict[int, list[Match]] = {}
    for match in matches:
        if len(match) and (match.j - match.i <= SHORT_GAP or len(match) >= MIN_LONG_GAP_MATCHES):
            from_frame.setdefault(match.i, []).append(match)
    arriving: dict[int, list[tuple[int, Tensor, Tensor]]] = {}
    parts: list[Tracks] = []
    n_points = 0
    for frame in range(len(spacing)):
        point, uv = _merge_arrivals(arriving.pop(frame, []), MIN_SEPARATION * spacing[frame])
        started = _new_tracks(from_frame.get(frame, []), uv, spacing[frame])
        point = torch.cat([point, torch.arange(n_points, n_points + len(started))])
        uv = torch.cat([uv, started])
        n_points += len(started)
        parts.append(Tracks(torch.full_like(point, frame), point, uv))
        for match in from_frame.get(frame, []):
            uv_j, kept = _propagate(match, uv)
            arriving.setdefault(match.j, []).append((match.j - match.i, point[kept], uv_j[kept]))
    columns = (torch.cat([getattr(part, name) for part in parts]) for name in ("frame", "point", "uv"))
    return (tracks := Tracks(*columns)).select(torch.ones(len(tracks), dtype=torch.bool))


def _merge_arrivals(
    arrivals: list[tuple[int, Tensor, Tensor]], width: Tensor
) -> tuple[Int64[Tensor, " n"], Float[Tensor, "n 2"]]:
    """Points and positions of the tracks that reach a frame; only the oldest in each grid cell of that `width`.

    A track is continued by the nearest earlier frame. Predictions from farther frames are averaged in where they agree
    with it, and are discarded otherwise: optical flow over wide rotations underestimates the motion, everywhere alike.

    Args:
        arrivals: Per earlier frame: its distance in time [frames], points, and their predicted positions [pixels].
        width: Side of the grid cells [pixels].
    """
    if not arrivals:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, 2, dtype=torch.float64)
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    n_nearest = sum(len(a) for gap, a, _ in arrivals if gap == arrivals[0][0])
    point, which = torch.unique(torch.cat([a for _, a, _ in arrivals]), return_inverse=True)
    uv = torch.cat([b for _, _, b in arrivals])
    nearest = torch.full_like(point, len(uv)).scatter_reduce_(0, which, torch.arange(len(uv)), "amin")
    agrees = ((uv - uv[nearest][which]).norm(dim=-1) < MATCH_TOLERANCE / 2).double()
    total = torch.zeros_like(uv[: len(point), 0]).index_add_(0, which, agrees)
    mean = torch.zeros_like(uv[: len(point)]).index_add_(0, which, agrees[:, None] * uv) / total[:, None]
    point, mean = point[nearest < n_nearest], mean[nearest < n_nearest]
    first = _first_in_cell(mean, width)
    return point[first], mean[first]


def _first_in_cell(uv: Float[Tensor, "n 2"], width: Tensor) -> Int64[Tensor, " m"]:
    """Indices, ascending, of the first position in each cell of a grid with cells of that width [pixels]."""
    _, cell = torch.unique((uv / width).floor().long(), dim=0, return_inverse=True)
    n = int(cell.max()) + 1 if len(cell) else 0
    return torch.full((n,), len(uv)).scatter_reduce_(0, cell, torch.arange(len(uv)), "amin").sort().values


def _new_tracks(matches: list[Match], tracked: Float[Tensor, "n 2"], spacing: Tensor) -> Float[Tensor, "m 2"]:
    """Start positions of new tracks: the most confident match of every grid cell that holds no track."""
    if not matches:
        return tracked[:0]
    confidence = torch.cat([m.confidence for m in matches])
    uv = torch.cat([m.uv_i for m in matches]).double()[torch.argsort(confidence, descending=True, stable=True)]
    first = _first_in_cell(torch.cat([tracked, uv]), spacing) - len(tracked)
    return uv[first[first >= 0]]


def _propagate(match: Match, uv: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """Positions in frame j of points of frame i, by a robust affine fit to the nearest matches, and which are accepted.

    A point is accepted if most of the matches around it agree with the fit.
    """
    distance, index = torch.cdist(uv, match.uv_i.double()).topk(min(MAX_NEIGHBOURS, len(match)), largest=False)
    near = (distance < MATCH_RADIUS) / (distance + 0.3).square()
    offset = match.uv_i.double()[index] - uv[:, None]
    basis = torch.cat([torch.ones_like(offset[..., :1]), offset], -1)
    shift = (match.uv_j - match.uv_i).double()[index]
    ridge = torch.diag(torch.tensor([1e-9, AFFINE_REGULARISATION, AFFINE_REGULARISATION], dtype=torch.float64))
    weight = near
    for _ in range(3):
        H = torch.einsum("nk,nki,nkj->nij", weight, basis, basis) + ridge
        fit = torch.linalg.solve(H, torch.einsum("nk,nki,nkc->nic", weight, basis, shift))
        residual = (shift - basis @ fit).norm(dim=-1)
        weight = near / (1 + (residual / (MATCH_TOLERANCE / 2)).square())
    agreeing, used = ((near > 0) & (residual < MATCH_TOLERANCE)).sum(1), (near > 0).sum(1)
    return uv + fit[:, 0], (used > 0) & (agreeing > 0.7 * used)


@dataclass(frozen=True)
class Keypoints:
    """Positions in all frames that matches or tracks refer to, numbered frame by frame."""

    frame: Int64[np.ndarray, " k"]
    uv: Float[np.ndarray, "k 2"]
    """Position [pixels]."""
    matched: Int64[np.ndarray, "m 2"] = field(repr=False)
    """Keypoints of every match, the one in the earlier frame first."""
    observations: Int64[np.ndarray, "o 2"] = field(repr=False)
    """Keypoint and track of every observation of a feature track, in ascending order of tracks."""
    camera: Camera
    n_frames: int

    @functools.cached_property
    def _matched_frames(self) -> Int64[np.ndarray, "m 2"]:
        """Frames of the keypoints of every match."""
        return self.frame[self.matched]

    @functools.cached_property
    def _rays(self) -> Float[np.ndarray, "k 3"]:
        """Direction of every keypoint, camera frame; z is 1."""
        focal, principal = self.camera.fx_fy_cx_cy.double().numpy().reshape(2, 2)
        return np.pad((self.uv - principal) / focal, ((0, 0), (0, 1)), constant_values=1.0)

    def consistent(
        self, frames: Sequence[int], R: Float[Tensor, "f 3 3"], t: Float[Tensor, "f 3"], tolerance: float
    ) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, "c 2"], Bool[np.ndarray, " c"]]:
        """Matches between some frames: their indices, the places of both frames in `frames`, and which are consistent.

        Args:
            frames: Frames with a pose.
            R: `R_cam_obj` of these frames.
            t: Object origin in their camera frames.
            tolerance: Distance from the epipolar line up to which a match is consistent [pixels].
        """
        places = _places(frames, self.n_frames)[self._matched_frames]
        index = np.flatnonzero((places >= 0).all(1))
        places = places[index]
        (i, j), (a, b) = self.matched[index].T, places.T
        rotation, centre = R.numpy(), -torch.einsum("fij,fi->fj", R, t).numpy()
        direction = np.einsum("cij,ci->cj", rotation[a], self._rays[i])
        # Normal of the epipolar plane, which is the epipolar line in the frame of the second camera.
        line = np.einsum("cij,cj->ci", rotation[b], np.cross(centre[a] - centre[b], direction))
        focal = self.camera.fx_fy_cx_cy[:2].double().numpy()
        distance = np.abs((line * self._rays[j]).sum(1)) / np.linalg.norm(line[:, :2] / focal, axis=1).clip(1e-12)
        return index, places, distance < tolerance

    def tracks(
        self, frames: Sequence[int], R: Float[Tensor, "f 3 3"], t: Float[Tensor, "f 3"], tolerance: float
    ) -> tuple[Tracks, Int64[np.ndarray, " o"]]:
        """Tracks through some frames, with frames numbered by their place in `frames`, and each observation's keypoint.

        Args:
            frames: Frames with a pose, ascending.
            R: `R_cam_obj` of these frames.
            t: Object origin in their camera frames.
            tolerance: Distance from the epipolar line up to which a match joins tracks [pixels].
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        place, n = _places(frames, self.n_frames), len(self.frame)
        # Tracks are nodes of the graph too, so that they go on beyond frames that have no pose.
        seen = self.observations[place[self.frame[self.observations[:, 0]]] >= 0] + (0, n)
        index, places, right = self.consistent(frames, R, t, tolerance)
        pair = places[:, 0] * len(frames) + places[:, 1]
        right &= np.bincount(pair[right], minlength=len(frames) ** 2)[pair] >= MIN_CONSISTENT
        edge = np.concatenate([seen, self.matched[index[right]]])
        nodes = n + int(self.observations[:, 1].max(initial=-1)) + 1
        graph = coo_array((np.ones(len(edge), np.int8), (edge[:, 0], edge[:, 1])), shape=(nodes, nodes))
        point: np.ndarray = connected_components(graph, directed=False)[1].astype(np.int64)
        used: np.ndarray = np.unique(edge[edge < n])
        # A point has one observation per frame: several would contradict each other.
        first: np.ndarray = np.unique(point[used] * self.n_frames + self.frame[used], return_index=True)[1]
        used = used[first]
        used = used[np.bincount(point[used], minlength=1)[point[used]] > 1]
        number = np.unique(point[used], return_inverse=True)[1]
        frame = place[self.frame[used]]
        return Tracks(torch.from_numpy(frame), torch.from_numpy(number), torch.from_numpy(self.uv[used])), used

    def correspondences(
        self, frame: int, frames: Sequence[int], X: Float[np.ndarray, "k 3"]
    ) -> tuple[Int64[np.ndarray, " c"], Float[np.ndarray, "c 3"]]:
        """Keypoints of a frame and the surface points that they may show: those of their matches and of their tracks.

        Args:
            frame: The frame.
            frames: Frames with a pose.
            X: Surface point of every keypoint, object frame; NaN where none is known.
        """
        place, ends = _places(frames, self.n_frames), self._matched_frames
        # Every match from its first end and from its second one.
        rows = [(ends[:, own] == frame) & (place[ends[:, 1 - own]] >= 0) for own in (0, 1)]
        keypoint = [self.matched[rows[own], own] for own in (0, 1)]
        source = [self.matched[rows[own], 1 - own] for own in (0, 1)]
        at, track = self.observations.T
        here = self.frame[at] == frame
        own_keypoint = np.full(int(track.max(initial=-1)) + 1, -1)
        own_keypoint[track[here]] = at[here]
        # One observation of each track suffices, as all of them show the same point.
        known = ~here & (own_keypoint[track] >= 0) & ~np.isnan(X[at, 0])
        _, first = np.unique(track[known], return_index=True)
        keypoint.append(own_keypoint[track[known][first]])
        source.append(at[known][first])
        points = X[np.concatenate(source)]
        found = ~np.isnan(points[:, 0])
        return np.concatenate(keypoint)[found], points[found]


def _places(frames: Sequence[int], n: int) -> Int64[np.ndarray, " n"]:
    """Place of each of `n` frames in `frames`; -1 where it has none."""
    place = np.full(n, -1)
    place[list(frames)] = np.arange(len(frames))
    return place


def gather_keypoints(matches: Sequence[Match], tracks: Tracks, camera: Camera, n_frames: int) -> Keypoints:
    """Number the positions of matches and of tracks.

    Args:
        matches: Matches of pairs of frames, each with i < j, at most one per pair.
        tracks: Feature tracks through all frames.
        camera: Camera of all frames.
        n_frames: Number of frames.
    """
    ends = [(end, uv) for m in matches for end, uv in ((m.i, m.uv_i), (m.j, m.uv_j))]
    frame = np.concatenate([*(np.full(len(uv), end) for end, uv in ends), tracks.frame.numpy()]).astype(np.int64)
    uv = np.concatenate([*(uv.double().numpy() for _, uv in ends), tracks.uv.numpy()])
    key = np.column_stack([frame, np.round(uv / KEYPOINT_RESOLUTION).astype(np.int64)])
    _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
    number = number.reshape(-1)
    start, matched = 0, [np.zeros((0, 2), np.int64)]
    for m in matches:
        matched.append(number[start : start + 2 * len(m)].reshape(2, -1).T)
        start += 2 * len(m)
    observations = np.column_stack([number[start:], tracks.point.numpy()])
    observations = observations[np.argsort(observations[:, 1], kind="stable")]
    return Keypoints(frame[first], uv[first], np.concatenate(matched), observations, camera, n_frames)
