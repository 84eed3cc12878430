"""Stage 1 of an object that hands hide in part: windows that are certain, joined to segments, and these to one motion.

Where a hand changes its grip, few features are seen in the frames before and after, and a window of frames there has
wrong or mirrored poses; averaged over the capture it spoils all others. Windows are therefore only used where their
mirror image explains the observations worse and neighbouring windows agree. Runs of such windows are segments, whose
poses are adjusted on their own. Matches between frames far apart in time then join segments that show the same side,
and add the frames between them. Frames that nothing confirms get no pose.

This is done twice: with features of which at least one frame shows that they lie on the object, then, for frames that
are in none of these segments, with all features of the object and the hand, which moves with it while its grip lasts.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble import matching
from tumble.poses.sfm.adjustment import Settings, Windows, adjust_windows, averaged_windows, deviation
from tumble.poses.sfm.observations import Inputs, on_object, shown, silhouette_centres, tracks_of
from tumble.poses.sfm.partial import Observed, Partial, adjusted, joined_tracks, pruned, thinned
from tumble.poses.sfm.registration import TOLERANCE, Hypotheses, grow, join
from tumble.poses.sfm.tracks import Tracks, gather_keypoints
from tumble.scene import Match

FRONTIER_WEIGHT = 3.0
"""Weight of an observation of a frontier point; the contours of a hidden object are less certain than others."""
WINDOW_SIZE = 8
"""Number of frames per window: enough for parallax, but few enough for a feature to be seen in most of them."""
ROUGH_SIZE = 6
"""Number of frames of the windows from which initial rotations are averaged."""
WINDOW_STRIDE = 2
"""Distance between the first frames of windows [frames]."""
MIN_LOSS_RATIO = 1.2
"""Loss of a window's mirror image over its own below which it is not certain which of them is right."""
MAX_DEVIATION = math.radians(4.5)
"""Largest angle between the rotations of two neighbouring windows with which they belong to a segment [radians]."""
MIN_WINDOWS = 2
"""Number of agreeing windows below which they are no segment."""
MIN_FRAMES = 5
"""Number of frames below which a segment is dropped."""
MIN_NEW_FRAMES = 3
"""Number of frames without a pose below which a window or a segment adds too little to be considered."""
MAX_GROWN = 3
"""Number of segments, the largest first, to which single frames are added."""
NEAR = 6
"""Distance in time up to which all pairs of frames are matched [frames]."""
FAR_STRIDE = 2
"""Of frames farther apart, every how many-th is matched with all others."""
MIN_WIDE_MATCHES = 8
"""Smallest number of matches of a pair of frames that are used."""
WIDE_MATCHER = "sift"
"""Matcher of frames that are far apart in time; it finds what rotates by up to about 30 degrees."""
LEARNED_MATCHER = "aliked"
"""Second matcher of frames that are farther apart than `NEAR`; it finds what rotates by up to about 70 degrees."""
LEARNED_STRIDE = 3
"""Every how many-th frame the second matcher sees, as it takes ten times as long."""
FIRST_SCALE = 3
"""Index in `global_scales` of the Cauchy loss in the first round in which a segment is adjusted."""
FINISHING_SCALES = (1.5, 1.0, 0.7)
"""Scales of the Cauchy loss in the rounds after uncertain frames of a segment were left out [pixels]."""


def segmented_poses(
    cfg: Settings, inputs: Inputs, wide: Sequence[Match], R: Float[Tensor, "t 3 3"], rng: torch.Generator
) -> tuple[Partial | None, Tracks]:
    """Poses of all frames that can be understood, and their tracks; None if no segment was found.

    Args:
        cfg: Settings of bundle adjustment.
        wide: Matches of the object, also between frames that are far apart in time.
        R: Approximate rotations of all frames, `R_cam_obj`.
        rng: Source of random numbers.
    """
    parts: list[Partial] = []
    known: Hypotheses = {}
    sure = _observed(cfg, inputs, inputs.tracks, wide)
    for tracks in (inputs.tracks, tracks_of(inputs.all_matches, inputs.silhouettes, inputs.capture)):
        observed = sure if tracks is inputs.tracks else _observed(cfg, inputs, tracks, wide)
        posed = torch.zeros(len(R), dtype=torch.bool)
        posed[[frame for part in parts for frame in part.frames]] = True
        if int((~posed).sum()) < MIN_NEW_FRAMES:
            break
        parts = join(sure, [*parts, *_segments(observed, R, ~posed, rng)], known)
        parts = join(sure, [grow(sure, part) for part in parts[:MAX_GROWN]] + parts[MAX_GROWN:], known)
        parts = [p for p in parts if p is parts[0] or len(set(p.frames) - set(parts[0].frames)) >= MIN_NEW_FRAMES]
    if not parts:
        return None, inputs.tracks
    tracks = thinned(joined_tracks(sure, parts[0], TOLERANCE)[0])
    return parts[0], replace(tracks, frame=torch.tensor(parts[0].frames)[tracks.frame])


def wide_matches(inputs: Inputs) -> list[Match]:
    """Matches of pairs of frames, also far apart, with at least one end of each correspondence on the object."""
    n, views = len(inputs.capture), matching.views_of(shown(inputs.capture))
    apart = [(i, j) for i in range(n) for j in range(i + 1, n)]
    pairs = [(i, j) for i, j in apart if j - i <= NEAR or not (i % FAR_STRIDE or j % FAR_STRIDE)]
    learned = [(i, j) for i, j in apart if j - i > NEAR and not (i % LEARNED_STRIDE or j % LEARNED_STRIDE)]
    found: dict[tuple[int, int], list[Match]] = {}
    for matcher, chosen in ((WIDE_MATCHER, pairs), (LEARNED_MATCHER, learned)):
        for match in matching.match_pairs(views, chosen, matcher):
            found.setdefault((match.i, match.j), []).append(on_object(match, inputs.capture.masks))
    return [match for parts in found.values() if len(match := matching.joined(parts)) >= MIN_WIDE_MATCHES]


def _observed(cfg: Settings, inputs: Inputs, tracks: Tracks, wide: Sequence[Match]) -> Observed:
    keypoints = gather_keypoints(wide, tracks, inputs.capture.camera, len(inputs.capture))
    return Observed(cfg, replace(inputs, tracks=tracks), keypoints)


def _segments(
    observed: Observed, R: Float[Tensor, "t 3 3"], wanted: Bool[Tensor, " t"], rng: torch.Generator
) -> list[Partial]:
    """Poses within every run of certain windows that hold wanted frames, each in an object frame of its own."""
    cfg, inputs, parts = observed.cfg, observed.inputs, []
    rough = adjust_windows(cfg, inputs, R, rng, size=ROUGH_SIZE, stride=1)
    R = averaged_windows(rough.frames, rough.best, n_frames=len(R))
    windows = adjust_windows(cfg, inputs, R, rng, size=WINDOW_SIZE, stride=WINDOW_STRIDE)
    for run in _runs(windows, wanted):
        first = int(windows.frames[run[0], 0])
        frames = tuple(range(first, int(windows.frames[run[-1], -1]) + 1))
        rotations = averaged_windows(windows.frames[run] - first, windows.best[run], n_frames=len(frames))
        t = silhouette_centres(inputs.capture, inputs.silhouettes)[list(frames)]
        part = adjusted(observed, Partial(frames, rotations, t), cfg.global_scales[FIRST_SCALE:])
        part = pruned(observed, part, TOLERANCE)
        if len(part) >= MIN_FRAMES:
            parts.append(adjusted(observed, part, FINISHING_SCALES))
    return parts


def _runs(windows: Windows, wanted: Bool[Tensor, " t"]) -> list[list[int]]:
    """Consecutive windows that are certain and agree with each other."""
    best, loss = windows.best, windows.loss
    certain = loss.max(1).values >= MIN_LOSS_RATIO * loss.min(1).values
    certain &= wanted[windows.frames].sum(1) >= MIN_NEW_FRAMES
    runs: list[list[int]] = []
    for k in torch.nonzero(certain)[:, 0].tolist():
        if runs and runs[-1][-1] == k - 1 and _deviation(windows, best, k - 1, k) <= MAX_DEVIATION:
            runs[-1].append(k)
        else:
            runs.append([k])
    return [run for run in runs if len(run) >= MIN_WINDOWS]


def _deviation(windows: Windows, best: Float[Tensor, "g f 3 3"], a: int, b: int) -> float:
    """Largest angle between the rotations of two windows in their common frames [radians]."""
    shift = int(windows.frames[b, 0] - windows.frames[a, 0])
    return float(deviation(best[a, shift:], best[b, : best.shape[1] - shift]).max())
