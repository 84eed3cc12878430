"""Rounds of bundle adjustment, of windows of frames or of all, with frontier points found anew in every round."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.maths import SO3, angle_between, average_rotations, fibonacci_sphere, mean_rotation
from tumble.poses.sfm import bundle_adjustment, frontier_points
from tumble.poses.sfm.bundle_adjustment import BundleState, Problem
from tumble.poses.sfm.observations import Inputs, focal_length, silhouette_centres
from tumble.poses.sfm.perturbation import mirrored
from tumble.poses.sfm.schedule import BaseConfig
from tumble.poses.sfm.tracks import Tracks, concatenate

CONTRADICTION_COST = 3.0
"""Cost of two neighbouring windows of which one shows the mirror image of the other's motion [logarithm of the loss].
As a motion does not reverse its depth from one frame to the next, it is more than what wrong windows gain in loss."""
SMALL_DEVIATION = math.radians(15)
"""Mean angle up to which rotations of neighbouring windows differ by their noise alone [radians]."""
DISTINCT = math.radians(5)
"""Mean angle by which two motions of a window differ at least to be kept both: what motions of six frames are off at
best where an object has little texture [radians]."""
START_STEP = math.radians(8)
"""Rotation per frame of the constant rotations from which windows start: the middle of the 5 to 12
degrees of hand-held captures [radians]."""
SCREENING_ROUNDS = 2
"""Rounds after which only the starts with the smallest losses are continued."""
KEPT_STARTS = 4
"""Number of starts of a window that are continued."""


@dataclass(frozen=True)
class Windows:
    """Overlapping windows of consecutive frames, each adjusted from several starts."""

    frames: Int64[Tensor, "g f"]
    R: Float[Tensor, "g s f 3 3"]
    """`R_cam_obj`, in a frame of each window's own, from every start."""
    loss: Float[Tensor, "g s"]
    """Loss per observation from every start [pixels^2]."""

    @property
    def best(self) -> Float[Tensor, "g f 3 3"]:
        """The rotations with the smaller loss."""
        return self.R[torch.arange(len(self.R)), self.loss.argmin(1)]

    @property
    def consistent(self) -> Float[Tensor, "g f 3 3"]:
        """The rotations, from one start per window, that have small losses and agree with those of their neighbours.

        A short window is explained about as well by its mirror image, but windows that overlap show the same motion. So
        the starts of all windows are chosen together: they have the least sum of log losses and contradictions.
        """
        loss = self.loss.clamp_min(1e-12).log()
        cost, previous = loss[0], []
        for k in range(1, len(loss)):
            through = cost[:, None] + CONTRADICTION_COST * self._contradiction(k - 1, k)
            cost, index = through.min(0)
            cost = cost + loss[k]
            previous.append(index)
        chosen = [int(cost.argmin())]
        for index in reversed(previous):
            chosen.append(int(index[chosen[-1]]))
        return self.R[torch.arange(len(self.R)), torch.tensor(chosen[::-1])]

    def promising(self, k: int) -> Int64[Tensor, "g k"]:
        """Starts with the smallest losses among those that differ from each other (`DISTINCT`), then any others."""
        every, rank, chosen = torch.arange(len(self.R)), self.loss.clone(), []
        for _ in range(min(k, self.R.shape[1])):
            chosen.append(rank.argmin(1))
            best = self.R[every, chosen[-1]].transpose(0, 1)[:, :, None]
            R = self.R.movedim(2, 0)
            similar = deviation(R, best.expand_as(R)).mean(0) < DISTINCT
            rank = torch.where(similar, rank + self.loss.amax() + 1, rank)
            rank[every, chosen[-1]] = torch.inf
        return torch.stack(chosen, 1)

    def joined(self, frames: Int64[Tensor, "h e"]) -> Float[Tensor, "h p e 3 3"]:
        """Rotations in larger windows, from all pairs of starts of two windows that cover each of them."""
        first, last = self.frames[:, 0], self.frames[:, -1]
        a = (first <= frames[:, :1]).sum(1) - 1
        b = (last < frames[:, -1:]).sum(1)
        return torch.stack([self._joined(*ends) for ends in zip(a.tolist(), b.tolist(), frames, strict=True)])

    def _joined(self, a: int, b: int, frames: Int64[Tensor, " e"]) -> Float[Tensor, "p e 3 3"]:
        """All starts of window a continued by all of window b, which are turned to agree where both overlap."""
        shift, starts = int(self.frames[b, 0] - self.frames[a, 0]), self.R.shape[1]
        common = self.frames.shape[1] - shift
        R_a = self.R[a].repeat_interleave(starts, 0)
        R_b = self.R[b].repeat(starts, 1, 1, 1)
        between = R_b[:, :common].mT @ R_a[:, shift:]
        R_b = R_b @ mean_rotation(SO3.from_matrix(between.transpose(0, 1))).matrix()[:, None]
        whole = torch.cat([R_a[:, : shift + common // 2], R_b[:, common // 2 :]], 1)
        offset = int(frames[0] - self.frames[a, 0])
        return whole[:, offset : offset + len(frames)]

    def _contradiction(self, a: int, b: int) -> Float[Tensor, "s s"]:
        """How much every start of one window contradicts every start of a later one, 0 to 1."""
        shift, starts = int(self.frames[b, 0] - self.frames[a, 0]), self.R.shape[1]
        common = self.frames.shape[1] - shift
        if common < 2:
            return torch.zeros(starts, starts, dtype=self.R.dtype)
        R_a, R_b = self.R[a, :, shift:].transpose(0, 1), self.R[b, :, :common].transpose(0, 1)
        each = (-1, starts, starts, -1, -1)
        angle = deviation(R_a[:, :, None].expand(each), R_b[:, None].expand(each)).mean(0)
        return angle / angle.max().clamp_min(SMALL_DEVIATION)


def deviation(R_a: Float[Tensor, "f *b 3 3"], R_b: Float[Tensor, "f *b 3 3"]) -> Float[Tensor, "f *b"]:
    """Angles between two estimates of the same rotations `R_cam_obj`, each in an object frame of its own [radians]."""
    a, b = SO3.from_matrix(R_a), SO3.from_matrix(R_b)
    return angle_between(b, a @ mean_rotation(a.inverse() @ b))


def adjust_windows(
    cfg: BaseConfig,
    inputs: Inputs,
    R: Float[Tensor, "t 3 3"],
    rng: torch.Generator,
    *,
    size: int,
    stride: int | None = None,
    directions: int = 0,
) -> Windows:
    """Adjust windows of `size` frames, one every `stride` frames, from rotations and from their mirror image.

    Args:
        R: Rotations to start from, `R_cam_obj`.
        stride: None: a quarter of the size.
        directions: Number of axes, spread over the sphere, about which a constant rotation is one more start of every
            window, for rotations that may be far off. The `KEPT_STARTS` most promising starts are continued.
    """
    frames = _overlapping(len(R), size, stride or _stride(size))
    starts = _given(R, frames)
    if directions:
        starts = torch.cat([starts, _constant_rotations(directions, frames, R)], 1)
        return _best_starts(cfg, inputs, frames, starts, rng, evenly=False)
    chosen = window_tracks(inputs.tracks, frames, cfg.max_window_tracks, rng)
    return _adjust_starts(cfg, inputs, frames, *chosen, starts, cfg.window_scales)


def grow_windows(
    cfg: BaseConfig,
    inputs: Inputs,
    R: Float[Tensor, "t 3 3"],
    rng: torch.Generator,
    *,
    size: int,
    directions: int,
) -> Windows:
    """One window of all frames, joined from windows of `size` frames through larger and larger ones (beam search).

    Where an object has little texture, wrong motions explain a few frames as well as the right one, and many frames do
    not, but there adjustment finds it from near starts only. So the best `KEPT_STARTS` motions of every window are
    kept, and a larger window starts from all pairs of motions of two smaller ones that cover it.

    Args:
        R: Rotations to start from, `R_cam_obj`.
        directions: As in `adjust_windows`, for the smallest windows.
    """
    frames = _overlapping(len(R), size, _stride(size))
    starts = _constant_rotations(directions, frames, R)
    windows = _best_starts(cfg, inputs, frames, torch.cat([starts, _given(R, frames)], 1), rng, evenly=True)
    while windows.frames.shape[1] < len(R):
        # Two windows that cover a larger one then have at least two frames in common.
        size = 2 * (size - _stride(size))
        frames = _overlapping(len(R), size, _stride(size))
        R = averaged_windows(windows.frames, windows.consistent, n_frames=len(R))
        starts = torch.cat([windows.joined(frames), _given(R, frames)], 1)
        windows = _best_starts(cfg, inputs, frames, starts, rng, evenly=True)
    return windows


def _given(R: Float[Tensor, "t 3 3"], frames: Int64[Tensor, "g f"]) -> Float[Tensor, "g 2 f 3 3"]:
    """The rotations of all frames within every window, and their mirror image."""
    return torch.stack([R[frames], mirrored(R[frames])], 1)


def _constant_rotations(
    directions: int, frames: Int64[Tensor, "g f"], R: Float[Tensor, "t 3 3"]
) -> Float[Tensor, "g s f 3 3"]:
    """The same constant rotations, about axes spread over the sphere, for every window."""
    size = frames.shape[1]
    turns = START_STEP * (torch.arange(size, dtype=R.dtype) - size // 2)
    axes = fibonacci_sphere(directions, dtype=R.dtype)
    return SO3.exp(axes[:, None] * turns[:, None]).matrix().expand(len(frames), -1, -1, -1, -1)


def _stride(size: int) -> int:
    """Number of frames from one window to the next."""
    return max(1, size // 4)


def _overlapping(n: int, size: int, stride: int) -> Int64[Tensor, "g f"]:
    """Frames of windows of a size, or of all n frames if they are fewer, that cover all n frames."""
    size = min(size, n)
    first = sorted({*range(0, n - size + 1, stride), n - size})
    return torch.tensor(first)[:, None] + torch.arange(size)


def _best_starts(
    cfg: BaseConfig,
    inputs: Inputs,
    frames: Int64[Tensor, "g f"],
    starts: Float[Tensor, "g s f 3 3"],
    rng: torch.Generator,
    *,
    evenly: bool,
) -> Windows:
    """Windows adjusted from the most promising of several starts.

    Args:
        evenly: Whether starts are compared by losses in which every observation counts once, as whole captures are, and
            the promising ones differ from each other (`Windows.promising`).
    """
    tracks = window_tracks(inputs.tracks, frames, cfg.max_window_tracks, rng)
    screening, rest = cfg.window_scales[:SCREENING_ROUNDS], cfg.window_scales[SCREENING_ROUNDS:]

    def adjusted(starts: Float[Tensor, "g s f 3 3"], scales: Sequence[float]) -> Windows:
        windows = _adjust_starts(cfg, inputs, frames, *tracks, starts, scales, rng)
        if not evenly:
            return windows
        even = replace(cfg, frontier_weight=1.0, iterations=1)
        return replace(windows, loss=_adjust_starts(even, inputs, frames, *tracks, windows.R, scales[-1:], rng).loss)

    screened = adjusted(starts, screening)
    kept = screened.promising(KEPT_STARTS) if evenly else screened.loss.topk(KEPT_STARTS, dim=1, largest=False).indices
    return adjusted(screened.R[torch.arange(len(frames))[:, None], kept], rest)


def _adjust_starts(
    cfg: BaseConfig,
    inputs: Inputs,
    frames: Int64[Tensor, "g f"],
    tracks: Tracks,
    group: Int64[Tensor, " n"],
    starts: Float[Tensor, "g s f 3 3"],
    scales: Sequence[float],
    rng: torch.Generator | None = None,
) -> Windows:
    """Adjust windows from several rotations each, in one round for every scale of the Cauchy loss [pixels].

    Args:
        rng: As in `adjust_round`.
    """
    g, s = starts.shape[:2]
    shifted = [replace(tracks, frame=tracks.frame + k * frames.numel()) for k in range(s)]
    group = torch.cat([group + k * g for k in range(s)])
    repeated = frames.repeat(s, 1)
    t = silhouette_centres(inputs.capture, inputs.silhouettes)[repeated]
    scene = BundleState(starts.transpose(0, 1).flatten(0, 1), t, torch.zeros(0, 3, dtype=starts.dtype))
    loss, every = torch.zeros(s * g), concatenate(*shifted)
    for scale in scales:
        scene, loss = adjust_round(cfg, inputs, scene, every, group, repeated, scale, rng)
    return Windows(frames, torch.stack(scene.R.split(g), 1), torch.stack(loss.split(g), 1))


def averaged_windows(
    frames: Int64[Tensor, "g f"], R: Float[Tensor, "g f 3 3"], *, n_frames: int
) -> Float[Tensor, "t 3 3"]:
    """Rotations of all frames whose relative rotations are the mean of those within windows."""
    a, b = torch.triu_indices(frames.shape[1], frames.shape[1], 1)
    relative = (R[:, b] @ R[:, a].mT).flatten(0, 1)
    i, j = frames[:, a].flatten(), frames[:, b].flatten()
    return average_rotations(i, j, relative, torch.ones(len(i), dtype=R.dtype), n_frames=n_frames).R_cam_obj


def adjust_round(
    cfg: BaseConfig,
    inputs: Inputs,
    scene: BundleState,
    tracks: Tracks,
    group: Tensor,
    frames: Int64[Tensor, "g f"],
    scale: float,
    rng: torch.Generator | None = None,
    log_focal_prior: float = 0.0,
    weight: Float[Tensor, " o"] | None = None,
) -> tuple[BundleState, Float[Tensor, " g"]]:
    """One round of bundle adjustment: find frontier points, triangulate all points, adjust.

    Args:
        scene: Current poses of all groups; the points are not read.
        tracks: Observations, with frames numbered over all groups.
        group: Group of every point.
        frames: Frames of every group.
        scale: Scale of the Cauchy loss [pixels].
        rng: Source of the random choice of frame pairs; None uses all pairs.
        log_focal_prior: Mean of the prior on the logarithm of the focal length over the camera's.
        weight: Weights of the observations; None: 1.

    Returns:
        The adjusted scene, and the loss per observation of every group [pixels^2].
    """
    g, f = frames.shape
    R, t, camera = scene.R.flatten(0, 1), scene.t.flatten(0, 1), inputs.capture.camera
    a, b = torch.triu_indices(f, f, 1)
    if rng is not None and len(a) > cfg.max_frontier_pairs:
        chosen = torch.randperm(len(a), generator=rng)[: cfg.max_frontier_pairs]
        a, b = a[chosen], b[chosen]
    first = torch.arange(g)[:, None] * f
    pairs = torch.stack([(first + a).flatten(), (first + b).flatten()], 1)
    flat = frames.flatten()
    frontier = frontier_points.frontier_tracks(R, t, camera, inputs.contours[flat], radius=inputs.radius, pairs=pairs)
    all_tracks = concatenate(tracks, frontier)
    weight = torch.ones(len(tracks), dtype=torch.float64) if weight is None else weight
    weight = torch.cat([weight, weight.new_full((len(frontier),), cfg.frontier_weight)])
    group = torch.cat([group, frontier.frame[::2] // f])
    sigma = cfg.centre_sigma * inputs.silhouettes.radius[frames] * focal_length(inputs.capture)
    centre, radius = inputs.silhouettes.centre[frames], 1.5 * inputs.radius
    problem = Problem(camera, all_tracks, group, weight, centre, sigma, cfg.depth_sigma, radius, log_focal_prior)
    X = bundle_adjustment.triangulate(all_tracks, R, t, camera, inputs.silhouettes.radius[flat])
    adjusted, loss = bundle_adjustment.adjust(problem, replace(scene, X=X), steps=cfg.iterations, scale=scale)
    total = torch.zeros(g, dtype=torch.float64).index_add_(0, group[all_tracks.point], weight)
    return adjusted, loss / total.clamp_min(1)


def window_tracks(
    tracks: Tracks, frames: Int64[Tensor, "g f"], max_tracks: int, rng: torch.Generator
) -> tuple[Tracks, Int64[Tensor, " n"]]:
    """The longest tracks of every window, with frames numbered over all windows; also the window of every point."""
    size = frames.shape[1]
    parts, groups = [], []
    for number, first in enumerate(frames[:, 0].tolist()):
        part = tracks.select((tracks.frame >= first) & (tracks.frame < first + size))
        if part.n > max_tracks:
            rank = torch.bincount(part.point) + torch.rand(part.n, generator=rng)
            chosen = torch.zeros(part.n, dtype=torch.bool)
            chosen[rank.topk(max_tracks).indices] = True
            part = part.select(chosen[part.point])
        parts.append(replace(part, frame=part.frame - first + number * size))
        groups.append(torch.full((part.n,), number))
    return concatenate(*parts), torch.cat(groups)
