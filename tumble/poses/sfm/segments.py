"""Stage 1 of an object that hands hide in part: windows that are certain, joined to segments, and these to one motion.

Where a hand changes its grip, few features are seen in the frames before and after, and a window of frames there has
wrong or mirrored poses; averaged over the capture it spoils all others. Windows are therefore only used where their
mirror image explains the observations worse and neighbouring windows agree. Runs of such windows are segments, whose
poses are adjusted on their own: once with features of which at least one frame shows that they lie on the object, and
once with all features of the object and the hand, which moves with it while its grip lasts. Matches between frames far
apart in time, of the object alone, then join segments that show the same side, and add the frames between them. Frames
that nothing confirms get no pose.

At first two parts are only joined where most matches between them agree, or some in many frames. Where this leaves
frames out or apart, a network matches these with their neighbours and with frames far apart as well, and all is done
again; fewer matches, contours alone, or both where they agree, then join parts, too. At the limits of what is joined
chance decides, so this search is repeated where it leaves many frames out.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble import matching
from tumble.poses.frame_pairs import neighbours
from tumble.poses.sfm.adjustment import Windows, adjust_windows, averaged_windows, deviation
from tumble.poses.sfm.observations import Inputs, gather, on_object, shown, silhouette_centres, tracks_of
from tumble.poses.sfm.partial import (
    MIN_OBSERVATIONS,
    TOLERANCE,
    Observed,
    Partial,
    adjusted,
    consistent_matches,
    cut,
    joined_tracks,
    pruned,
    thinned,
)
from tumble.poses.sfm.registration import Hypotheses, grow, join
from tumble.poses.sfm.schedule import BaseConfig
from tumble.poses.sfm.tracks import Tracks, concatenate, gather_keypoints
from tumble.scene import Match

FRONTIER_WEIGHT = 3.0
"""Weight of an observation of a frontier point here: contours tell what is right from its mirror image and join parts
that share no texture. It is lower than elsewhere, as masks end a little beside the object where a hand begins."""
FINAL_FRONTIER_WEIGHT = 1.0
"""Weight in the last adjustment of all frames with a pose: that of a match, as walls beside the object in many masks
bend long motions."""
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
MIN_CROSSING = 50
"""Number of surface points seen before and after an instant below which a segment is cut there: at a jump of the film,
or where a hand hides nearly all, the frames on either side agree among themselves only."""
MIN_AGREEMENT = 0.5
"""Fraction of the object's matches in a segment that agree with a frame's pose, below which it is left out."""
MIN_NEW_FRAMES = 3
"""Number of frames that are in no better or larger segment below which a segment is not used."""
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
"""Second matcher, where the first leaves frames out; it finds what rotates by up to about 70 degrees."""
FAR_LEARNED_MATCHER = "aliked_turned"
"""The same for frames farther apart than `NEAR`, between which the object may have turned far in the image plane."""
ATTEMPTS = 4
"""Number of times that parts are sought and joined with all matches, while too few frames have a pose: at the limits of
what is joined, chance decides."""
MAX_UNPOSED = 0.25
"""Fraction of the frames without a pose up to which one attempt is enough."""
MAX_MISSING = 0.05
"""Fraction of the frames without a pose up to which the second matcher is not needed."""
LEARNED_STRIDE = 3
"""Of frames farther apart than `NEAR`, every how many-th it sees first, as it takes ten times as long."""
MIN_PROMISING = 40
"""Number of matches of such a pair from which it sees the pairs beside it. Of 60 pairs of a bottle in a hand that show
the same side, most matches were right in 19 of the 26 with as many, and in one of the other 34."""
MAX_BESIDE = 300
"""Number of these from which no more are added, those beside the pairs with the most matches first: some minutes."""
FIRST_SCALE = 3
"""Index in `global_scales` of the Cauchy loss in the first round in which a segment is adjusted."""
FINISHING_SCALES = (1.5, 1.0, 0.7)
"""Scales of the Cauchy loss in the rounds after uncertain frames of a segment were left out [pixels]."""


def segmented_poses(
    cfg: BaseConfig, inputs: Inputs, R: Float[Tensor, "t 3 3"], rng: torch.Generator
) -> tuple[Partial | None, Tracks]:
    """Poses of all frames that can be understood, and their tracks; None if no segment was found.

    Args:
        cfg: Settings of bundle adjustment.
        R: Approximate rotations of all frames, `R_cam_obj`.
        rng: Source of random numbers.
    """
    n = len(R)
    apart = [(i, j) for i in range(n) for j in range(i + 1, n)]
    near_or_even = [(i, j) for i, j in apart if j - i <= NEAR or not (i % FAR_STRIDE or j % FAR_STRIDE)]
    wide = _matched(inputs, near_or_even, WIDE_MATCHER)
    parts, tracks = _understood(cfg, inputs, wide, R, rng, cautious=True)
    part = parts[0] if parts else None
    if part is None or n - len(part) > MAX_MISSING * n:
        of_near, of_far = _learned(inputs, [set(each.frames) for each in parts])
        inputs = gather(inputs.capture, _merged(inputs.all_matches, of_near), hidden=True)
        every = _merged(wide, of_near, of_far)
        for _ in range(ATTEMPTS):
            others, other_tracks = _understood(cfg, inputs, every, R, rng, cautious=False)
            if others and (part is None or len(others[0]) >= len(part)):
                part, tracks = others[0], other_tracks
            if part is not None and n - len(part) <= MAX_UNPOSED * n:
                break
    return part, tracks


def _understood(
    cfg: BaseConfig,
    inputs: Inputs,
    wide: Sequence[Match],
    R: Float[Tensor, "t 3 3"],
    rng: torch.Generator,
    *,
    cautious: bool,
) -> tuple[list[Partial], Tracks]:
    """The parts of the capture that matches explain, the largest first, and the tracks of that one.

    Args:
        wide: Matches of all that is not background, also between frames that are far apart in time.
        cautious: Leave apart what only few matches would join, or contours alone.
    """
    on_it = [match for each in wide if len(match := on_object(each, inputs.capture.masks)) >= MIN_WIDE_MATCHES]
    sure = _observed(cfg, inputs, inputs.tracks, on_it)
    tracks = tracks_of(inputs.all_matches, inputs.silhouettes, inputs.capture)
    known: Hypotheses = {}
    found = [part for each in (sure, _observed(cfg, inputs, tracks, on_it)) for part in _segments(each, R, rng)]
    parts = join(sure, _supported(sure, found), known, certain=cautious)
    parts = join(sure, _grown(sure, parts, cautious=cautious), known, certain=cautious)
    if not parts:
        return [], inputs.tracks
    tracks = matched_tracks(sure, parts[0])
    return parts, replace(tracks, frame=torch.tensor(parts[0].frames)[tracks.frame])


def matched_tracks(observed: Observed, part: Partial) -> Tracks:
    """The tracks to which all frames of a part are adjusted in the end, with frames numbered by their place in it.

    They are joined from matches of pairs of frames. Chained tracks, which follow highlights and shading, are only used
    through the frames that too few of these see.
    """
    none = replace(observed.keypoints, observations=observed.keypoints.observations[:0])
    matched, _ = joined_tracks(replace(observed, keypoints=none), part, TOLERANCE)
    every, _ = joined_tracks(observed, part, TOLERANCE)
    few = torch.bincount(matched.frame, minlength=len(part)) < MIN_OBSERVATIONS
    there = torch.zeros(every.n, dtype=torch.bool)
    there[every.point[few[every.frame]]] = True
    return concatenate(thinned(matched), thinned(every.select(there[every.point])))


def _learned(inputs: Inputs, known: Sequence[set[int]]) -> tuple[list[Match], list[Match]]:
    """A network's matches of neighbouring frames and of frames far apart, except of those of one known part.

    Of frames far apart it sees every `LEARNED_STRIDE`-th, and then those beside pairs that have many matches.
    """

    def unknown(pairs: set[tuple[int, int]]) -> set[tuple[int, int]]:
        return {pair for pair in pairs if not any(map(set(pair).issubset, known))}

    n, step = len(inputs.capture), LEARNED_STRIDE
    near = _matched(inputs, sorted(unknown(set(neighbours(n)))), LEARNED_MATCHER)
    coarse = {(i, j) for j in range(0, n, step) for i in range(0, j - NEAR, step)}
    far = _matched(inputs, sorted(unknown(coarse)), FAR_LEARNED_MATCHER)
    count = {(match.i, match.j): len(on_object(match, inputs.capture.masks)) for match in far}
    around, beside = range(-(step // 2), step // 2 + 1), set[tuple[int, int]]()
    for i, j in sorted(count, key=lambda pair: -count[pair]):
        if count[i, j] < MIN_PROMISING or len(beside) >= MAX_BESIDE:
            break
        new = {(i + a, j + b) for a in around for b in around if 0 <= i + a < j + b - NEAR and j + b < n}
        beside |= unknown(new - coarse)
    return near, far + _matched(inputs, sorted(beside), FAR_LEARNED_MATCHER)


def _matched(inputs: Inputs, pairs: Sequence[tuple[int, int]], matcher: str) -> list[Match]:
    """Matches of pairs of frames, of all that is not background."""
    return matching.match_pairs(matching.views_of(shown(inputs.capture)), pairs, matcher)


def _merged(*parts: Sequence[Match]) -> list[Match]:
    """All correspondences of every pair of frames."""
    of_pair: dict[tuple[int, int], list[Match]] = {}
    for match in (match for part in parts for match in part):
        of_pair.setdefault((match.i, match.j), []).append(match)
    return [matching.joined(matches) for matches in of_pair.values()]


def _observed(cfg: BaseConfig, inputs: Inputs, tracks: Tracks, wide: Sequence[Match]) -> Observed:
    keypoints = gather_keypoints(wide, tracks, inputs.capture.camera, len(inputs.capture))
    return Observed(cfg, replace(inputs, tracks=tracks), keypoints)


def _supported(sure: Observed, parts: Sequence[Partial]) -> list[Partial]:
    """Segments without the frames that most matches of the object contradict; of those of the same frames the best one.

    Args:
        sure: Matches and tracks of the object.
        parts: Segments; those from features of the object and from all features hold many of the same frames.
    """
    rated = []
    for part in parts:
        agreeing, of = consistent_matches(sure, part, TOLERANCE)
        part = part.select(np.flatnonzero(agreeing >= MIN_AGREEMENT * of).tolist())
        if len(part) >= MIN_FRAMES:
            rated.append((agreeing.sum() / max(1, of.sum()), part))
    kept, covered = [], set()
    for _, part in sorted(rated, key=lambda each: -each[0]):
        if len(set(part.frames) - covered) >= MIN_NEW_FRAMES:
            kept.append(part)
            covered |= set(part.frames)
    return kept


def _grown(sure: Observed, parts: Sequence[Partial], *, cautious: bool) -> list[Partial]:
    """Parts, the largest first, with single frames added; without those that then add too few frames to the others.

    Args:
        cautious: Add no frames that other parts have: a part that grows over another one drifts away from it.
    """
    grown, covered = [], set()
    for part in parts:
        if len(set(part.frames) - covered) >= MIN_NEW_FRAMES:
            others = covered.union(*(each.frames for each in parts if each is not part)) if cautious else set()
            grown.append(grow(sure, part, without=others) if len(grown) < MAX_GROWN else part)
            covered |= set(grown[-1].frames)
    return grown


def _segments(observed: Observed, R: Float[Tensor, "t 3 3"], rng: torch.Generator) -> list[Partial]:
    """Poses within every run of certain windows, each in an object frame of its own."""
    cfg, inputs, parts = observed.cfg, observed.inputs, []
    rough = adjust_windows(cfg, inputs, R, rng, size=ROUGH_SIZE, stride=1)
    R = averaged_windows(rough.frames, rough.best, n_frames=len(R))
    windows = adjust_windows(cfg, inputs, R, rng, size=WINDOW_SIZE, stride=WINDOW_STRIDE)
    for run in _runs(windows):
        first = int(windows.frames[run[0], 0])
        frames = tuple(range(first, int(windows.frames[run[-1], -1]) + 1))
        rotations = averaged_windows(windows.frames[run] - first, windows.best[run], n_frames=len(frames))
        t = silhouette_centres(inputs.capture, inputs.silhouettes)[list(frames)]
        part = adjusted(observed, Partial(frames, rotations, t), cfg.global_scales[FIRST_SCALE:])
        part = pruned(observed, part, TOLERANCE)
        if len(part) >= MIN_FRAMES:
            part = adjusted(observed, part, FINISHING_SCALES)
            parts += [piece for piece in cut(observed, part, TOLERANCE, MIN_CROSSING) if len(piece) >= MIN_FRAMES]
    return parts


def _runs(windows: Windows) -> list[list[int]]:
    """Consecutive windows that are certain and agree with each other."""
    best, loss = windows.best, windows.loss
    certain = loss.max(1).values >= MIN_LOSS_RATIO * loss.min(1).values
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
