"""The steps of stage 1 in order, and its settings; `stage` carries them out."""

from dataclasses import dataclass

RELOCALIZATION_SCALE = 0.7
"""Scale of the Cauchy loss in relocalization [pixels]."""


@dataclass(frozen=True)
class BaseConfig:
    """Settings of stage 1 by structure from motion, found by experiment; the paper's method is `progressive`."""

    window_sizes: tuple[int, ...] = (6, 12)
    """Sizes of the windows, in ascending order [frames]."""
    growing: tuple[int, ...] = (6, 8, 12)
    """Size of the smallest windows in each further attempt at a capture that has not converged, which grow until one
    holds all frames; at least 3 [frames]."""
    directions: int = 16
    """Number of constant rotations from which these smallest windows start as well."""
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
    """The same for every further attempt before it is compared with the best."""
    stretch: float = 1.2
    """Factor on the rotations between consecutive frames of the best attempt, with which all frames are adjusted again.

    Shading and highlights stay where they are while a surface turns below them, so that matches of an object with
    little texture show too small a rotation: 0.7 of it where all is shading.
    """
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
class Stretch:
    """Enlarge the rotations between consecutive frames (`BaseConfig.stretch`)."""


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
    | Stretch
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
    """Attempt that the step belongs to: 0 is the first; the others are those of `BaseConfig.growing`."""
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
    # The loss of the first attempt decides whether any more steps follow.
    steps += map(Step, (*first, *map(AdjustAll, cfg.global_scales), keep))
    steps += [Step(phase, mends=True) for phase in mending]
    for attempt, size in enumerate(cfg.growing, 1):
        again = (AverageRotations(), GrowWindows(size), *map(AdjustAll, cfg.global_scales))
        early = [Perturb(keep.scale)] * cfg.early_perturbations
        steps += [Step(phase, attempt) for phase in (*again, *early, keep)]
    if cfg.growing:
        # Relocalization fits contours alone, so the best attempt is changed after it and compared by matches as well.
        stretched = [Stretch(), *map(AdjustAll, cfg.global_scales), keep]
        mending = [*stretched, *mending, *[Perturb(keep.scale)] * cfg.perturbations, keep, *mending]
        steps += [Step(phase, len(cfg.growing), mends=True) for phase in mending]
    steps.append(Step(AlignTexture()))
    for _ in range(cfg.max_corrections):
        steps += map(Step, (CheckSettled(keep.scale), AlignColours(), TrackTexture(), *relocalization))
    return [*steps, Step(CheckSettled(keep.scale)), *_texture_rounds(cfg)]


def _texture_rounds(cfg: BaseConfig) -> list[Step]:
    """The last steps: points are located by their texture and all frames adjusted, in turn.

    They are for an object that is hidden in part, which has no rounds of corrections, and for poses that do not settle.
    """
    return [*map(Step, (TrackTexture(), *map(AdjustAll, cfg.texture_scales)))] * cfg.texture_rounds
