"""The steps of stage 1 in order, and its settings; `stage` carries them out."""

from dataclasses import dataclass

RELOCALIZATION_SCALE = 0.7
"""Scale of the Cauchy loss in relocalization [pixels]."""


@dataclass(frozen=True)
class Fallback:
    """Settings of another attempt at a capture that has not converged."""

    window_sizes: tuple[int, ...]
    """Sizes of the windows, in ascending order [frames]."""
    stretch: float
    """Factor on the rotations between consecutive frames before all frames are adjusted.

    Shading and highlights stay where they are while a surface turns below them, so that matches of an object with
    little texture show too small a rotation: 0.7 of it where all is shading.
    """


@dataclass(frozen=True)
class BaseConfig:
    """Settings of stage 1 by structure from motion, found by experiment; the paper's method is `progressive`."""

    window_sizes: tuple[int, ...] = (6, 12)
    """Sizes of the windows, in ascending order [frames]."""
    growing: tuple[int, ...] = (6, 8, 12)
    """Size of the smallest windows in each further attempt at a capture that has not converged, which grow until one
    holds all frames; at least 3 [frames]."""
    fallbacks: tuple[Fallback, ...] = (
        Fallback((12, 24), 1.0),
        Fallback((6, 12), 1.2),
        Fallback((6, 12, 24), 1.2),
        Fallback((12, 24), 1.2),
        Fallback((6, 12), 1.0),
        Fallback((6, 12, 24), 1.0),
        Fallback((12, 24), 1.4),
    )
    """Settings of attempts after these."""
    directions: int = 16
    """Number of constant rotations from which windows of further attempts start as well; of windows that grow, the
    smallest ones."""
    converged_loss: float = 0.06
    """Loss per observation of the first attempt below which it has converged [pixels^2].

    Only before relocalization, which fits contours, also with wrong rotations.
    """
    max_window_tracks: int = 250
    """Maximum number of tracks per window."""
    window_scales: tuple[float, ...] = (5.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5)
    """Scale of the Cauchy loss in each round of adjusting windows [pixels]."""
    global_scales: tuple[float, ...] = (5.0, 4.0, 3.0, 2.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5)
    """Scale of the Cauchy loss in each round of adjusting the whole capture [pixels]."""
    relocalized_scales: tuple[float, ...] = (3.0, 1.5, 1.0, 0.7, 0.5, 0.5, 0.5, 0.5)
    """Scale of the Cauchy loss in each round of adjusting the whole capture after a relocalization [pixels]."""
    disagreement_scales: tuple[float, ...] = (1.0, 0.7, 0.5, 0.5)
    """Scale of the Cauchy loss in each round of the two fits that rely mainly on tracks or on contours [pixels]."""
    perturbations: int = 10
    """Number of times that `PERTURBATIONS` random changes of the best attempt's poses are tried."""
    early_perturbations: int = 3
    """The same for every attempt with windows that grow, before it is compared with the best."""
    perturbation_scales: tuple[float, ...] = (3.0, 1.5, 1.0, 0.7, 0.5)
    """Scale of the Cauchy loss in each round of adjusting the whole capture after such a change [pixels]."""
    relocalizations: int = 1
    """Number of relocalizations of the first and of the best attempt, each followed by rounds of adjustment."""
    max_corrections: int = 4
    """Maximum number of rounds of corrections at the end (`CheckSettled`)."""
    texture_rounds: int = 3
    """Number of times that points are located by their texture in the last steps, which are left out if the poses have
    settled: every round of corrections has located them already."""
    texture_scales: tuple[float, ...] = (1.0, 0.7, 0.5, 0.5)
    """Scale of the Cauchy loss in each round of adjusting the whole capture in the last steps [pixels]."""
    texture_weight: float = 4.0
    """Weight of an observation of a point by its texture, relative to one of a chained match.

    Chained matches err alike, those of one surface point by its texture do not.
    """
    frontier_weight: float = 12.0
    """Weight of an observation of a frontier point, relative to an observation of a track.

    It is large, because shading biases all matches in the same way, but not contours.
    """
    iterations: int = 4
    """Levenberg-Marquardt iterations per round, after which the frontier points are found anew."""
    max_pair_distance: int = 2
    """Maximum distance in time of frames whose relative rotation is fitted [frames]."""
    centre_sigma: float = 0.25
    """Standard deviation of the projected origin about the silhouette's centre [projected radius of the object]."""
    depth_sigma: float = 0.1
    """Standard deviation of the logarithm of the object's distance."""
    max_frontier_pairs: int = 3000
    """Maximum number of frame pairs whose frontier points are used in a round; chosen at random if there are more."""


@dataclass(frozen=True)
class AverageRotations:
    """Fit the relative rotations of nearby frames and average them."""


@dataclass(frozen=True)
class AdjustWindows:
    """Adjust overlapping windows of frames, and average the rotations within them."""

    size: int
    """Number of frames per window."""
    widely: bool = False
    """Whether windows start from constant rotations as well (`BaseConfig.directions`)."""
    stretch: float = 1.0
    """Factor on the averaged rotations between consecutive frames (`Fallback.stretch`)."""


@dataclass(frozen=True)
class GrowWindows:
    """Adjust windows from many starts, and join them to larger and larger ones (`adjustment.grow_windows`)."""

    size: int
    """Number of frames of the smallest windows."""


@dataclass(frozen=True)
class AdjustAll:
    """One round of bundle adjustment of the whole capture."""

    scale: float
    """Scale of the Cauchy loss [pixels]."""


@dataclass(frozen=True)
class KeepBest:
    """Keep the poses with the lowest loss: the current ones or those of an earlier attempt."""

    scale: float
    """Scale of the Cauchy loss [pixels]."""


@dataclass(frozen=True)
class TryCircularMotion:
    """Take the motion of a turntable, with which all is done, if there is one (`circular_motion`)."""


@dataclass(frozen=True)
class Perturb:
    """Change parts of the motion at random, and keep what is better (`perturbation`)."""

    scale: float
    """Scale of the Cauchy loss by which poses are compared [pixels]."""


@dataclass(frozen=True)
class SetAside:
    """Set the best poses aside, so that attempts of another kind compete among themselves: while motions are wrong, a
    lower loss does not say which is nearer to the right one."""


@dataclass(frozen=True)
class TakeBetter:
    """Take the poses with the lower loss: those set aside or those found since."""


@dataclass(frozen=True)
class AlignTexture:
    """Turn frames of a body of revolution about its axis where their texture contradicts the poses (`symmetry`)."""


@dataclass(frozen=True)
class CheckSettled:
    """Start a round of corrections: by colours, texture tracks and relocalization, then all frames are adjusted.

    If the last round has raised the loss, it is undone. In that case, and if no rotation has changed by `SETTLED_ANGLE`
    since the last check, this and all further steps are skipped.
    """

    scale: float
    """Scale of the Cauchy loss by which poses are compared [pixels]."""


@dataclass(frozen=True)
class AlignColours:
    """Turn a part of the motion by a rotation that silhouettes do not show, where colours say so (`symmetry.turns`)."""


@dataclass(frozen=True)
class TrackTexture:
    """Locate points of the visual hull in all frames by their texture (`symmetry.texture_tracks`)."""


@dataclass(frozen=True)
class Relocalize:
    """Relocalize frames whose contour contradicts those of the others."""

    scale: float
    """Scale of the Cauchy loss [pixels]."""


@dataclass(frozen=True)
class JoinSegments:
    """Pose the frames of an object that is hidden in part (`segments`); the other frames are lost."""


Phase = (
    AverageRotations
    | AdjustWindows
    | GrowWindows
    | AdjustAll
    | KeepBest
    | TryCircularMotion
    | Perturb
    | SetAside
    | TakeBetter
    | AlignTexture
    | CheckSettled
    | AlignColours
    | TrackTexture
    | Relocalize
    | JoinSegments
)


@dataclass(frozen=True)
class Step:
    """One step of the schedule."""

    phase: Phase
    attempt: int = 0
    """Attempt that the step belongs to: 0 is the first; the others are those of `BaseConfig.growing` and
    `BaseConfig.fallbacks`."""
    mends: bool = False
    """Whether the step corrects poses that have not converged; it is skipped otherwise."""


def schedule(cfg: BaseConfig, *, hidden: bool = False) -> list[Step]:
    """All steps, in order.

    Args:
        hidden: Whether something hides a part of the object, which contours alone then do not relocalize.
    """
    if hidden:
        first = [*map(Step, (AverageRotations(), JoinSegments(), *map(AdjustAll, cfg.relocalized_scales)))]
        return [*first, *_texture_rounds(cfg)]
    keep = KeepBest(cfg.global_scales[-1])
    relocalization = [Relocalize(RELOCALIZATION_SCALE), *map(AdjustAll, cfg.relocalized_scales)]
    steps: list[Step] = []
    first = [TryCircularMotion(), AverageRotations(), *map(AdjustWindows, cfg.window_sizes)]
    mending = [*relocalization * cfg.relocalizations, keep]
    adjusting = list(map(AdjustAll, cfg.global_scales))
    # The loss of the first attempt decides whether any more steps follow.
    steps += map(Step, (*first, *adjusting, keep))
    steps += [Step(phase, mends=True) for phase in mending]
    early = [Perturb(keep.scale)] * cfg.early_perturbations
    growing: list[list[Phase]] = [[GrowWindows(size), *adjusting, *early, keep] for size in cfg.growing]
    others: list[list[Phase]] = []
    for other in cfg.fallbacks:
        *shorter, longest = other.window_sizes
        windows = [*(AdjustWindows(size, widely=True) for size in shorter)]
        others.append([*windows, AdjustWindows(longest, widely=True, stretch=other.stretch), *adjusting, keep])
    # Relocalization fits contours alone, so the best attempt is changed after it and compared by matches as well.
    mending = [*mending, *[Perturb(keep.scale)] * cfg.perturbations, keep, *mending]
    attempt = 0
    for attempts in filter(None, (growing, others)):
        if attempt:
            steps.append(Step(SetAside(), attempt, mends=True))
        for phases in attempts:
            attempt += 1
            steps += [Step(phase, attempt) for phase in (AverageRotations(), *phases)]
        steps += [Step(phase, attempt, mends=True) for phase in mending]
    if growing and others:
        # Also where the last attempt agreed with the poses set aside: it may differ from them in some frames.
        steps.append(Step(TakeBetter()))
    steps.append(Step(AlignTexture()))
    for _ in range(cfg.max_corrections):
        steps += map(Step, (CheckSettled(keep.scale), AlignColours(), TrackTexture(), *relocalization))
    return [*steps, Step(CheckSettled(keep.scale)), *_texture_rounds(cfg)]


def _texture_rounds(cfg: BaseConfig) -> list[Step]:
    """The last steps: points are located by their texture and all frames adjusted, in turn.

    They are for an object that is hidden in part, which has no rounds of corrections, and for poses that do not settle.
    """
    return [*map(Step, (TrackTexture(), *map(AdjustAll, cfg.texture_scales)))] * cfg.texture_rounds
