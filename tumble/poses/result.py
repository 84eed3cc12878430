"""How far the poses of a capture can be trusted, frame by frame and as a whole."""

import math
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from tumble.scene import Camera, Trajectory

PoseVerdict = Literal["good", "warn", "bad"]

UNSEEN = 0.1
"""Uncertainty about an axis from which a frame's rotation about it counts as not seen [radians]."""
WORSE = 4.0
"""Uncertainty about the worst axis over that about the next from which the axis is blamed, not the frames."""
FITS, PER_MISFIT = 0.94, math.radians(130)
"""Overlap of silhouettes and hull that converged solutions keep, and how much one of missing overlap tells: a line by
eye through six solutions that had not converged, with median errors of 24 to 72 degrees at overlaps of 0.81 to 0.40."""
LIMITS = math.radians(2.0), math.radians(5.0)
"""Uncertainty from which poses are worth a look, and from which they are not to be used [radians]."""
STILL = math.radians(10)
"""Turn under which an object was not filmed from different sides."""
MANY_LOST = 0.5
"""Share of lost frames from which the rest is not to be used either."""


@dataclass(frozen=True)
class Observability:
    """The axis of the object about which frames can turn with the least notice."""

    axis: Float[Tensor, "3"]
    """Unit length, object frame. Of a bare body of revolution only its direction in the first picture is known: the
    last number is NaN."""
    sigma: Float[Tensor, "3"]
    """Typical uncertainty of a frame's rotation about this axis, and about the two across it [radians]."""

    @property
    def plain(self) -> bool:
        """Whether hardly any turn leaves a trace in the pictures."""
        return float(self.sigma[1]) > UNSEEN

    @property
    def unseen(self) -> bool:
        """Whether turns about the axis leave no trace in the pictures."""
        return float(self.sigma[0]) > UNSEEN and (self.plain or float(self.sigma[0]) > WORSE * float(self.sigma[1]))

    @property
    def sentence(self) -> str:
        """What to tell a person."""
        known = [f"{float(a):.2f}" for a in self.axis if not a.isnan()]
        where = f"({', '.join(known)})" + ("" if len(known) == 3 else " of the first picture")
        if self.plain:
            return (
                "Rotation is not observable: neither texture nor outline shows how the object turns. Stick something "
                "on it that can be followed."
            )
        if self.unseen:
            return (
                f"Rotation about axis {where} is not observable: neither outline nor texture shows it. If the object "
                f"has a print, grain hides it: film in more light. If it has none, stick something on it."
            )
        return f"Rotations are seen about every axis, to about {_degrees(self.sigma[0])} degrees about the worst."


@dataclass(frozen=True)
class PoseQuality:
    """Per frame, what its pose rests on."""

    residual: Float[Tensor, " t"]
    """Median distance between matches and the points they show [pixels]; NaN without matches."""
    inliers: Float[Tensor, " t"]
    """Number of matches that agree with the pose."""
    gap: Float[Tensor, " t"]
    """Median distance between the epipolar planes that touch this outline and those of others [pixels]."""
    overlap: Float[Tensor, " t"]
    """Intersection over union of the silhouette and that of the visual hull."""
    drift: Float[Tensor, " t"]
    """Angle between the rotations that tracks and that outlines would have preferred [radians]."""
    lost: Bool[Tensor, " t"]
    """Whether the pose is a guess from its neighbours."""
    turn: Float[Tensor, ""]
    """Largest angle between the rotations of two frames [radians]."""
    observability: Observability

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def still(self) -> bool:
        """Whether the object seems not to turn at all: what a ball without texture looks like."""
        return float(self.turn) < STILL

    @property
    def misfit(self) -> float:
        """What silhouettes that contradict each other tell about the median error of rotation [radians]."""
        kept = self.overlap[~self.lost]
        return PER_MISFIT * max(0.0, FITS - float(kept.median())) if len(kept) else math.pi

    @property
    def uncertainty(self) -> float:
        """Median error of rotation to be expected [radians]."""
        kept = self.drift[~self.lost]
        return max(self.misfit, float(kept.median())) if len(kept) else math.pi

    @property
    def verdict(self) -> PoseVerdict:
        gone = float(self.lost.float().mean())
        if self.still or self.observability.unseen or self.uncertainty > LIMITS[1] or gone > MANY_LOST:
            return "bad"
        return "warn" if gone > 0 or self.uncertainty > LIMITS[0] else "good"

    @property
    def sentence(self) -> str:
        """What to tell a person."""
        if self.still:
            return (
                "Rotation is not observable: nothing in the pictures shows that the object turns. If it did, stick "
                "something on it that can be followed."
            )
        if self.observability.unseen:
            return self.observability.sentence
        if self.misfit > LIMITS[1]:
            return (
                "The silhouettes contradict each other at these poses: the object changed, or its turns were not "
                "understood. Film it in smaller turns, alone, and with more texture."
            )
        lost = int(self.lost.sum())
        words = f"Rotations are right to about {_degrees(self.uncertainty)} degrees."
        return f"{words} {lost} of {len(self)} frames contradict the others." if lost else words


@dataclass(frozen=True)
class PoseResult:
    """The outcome of stage 1, by either route."""

    trajectory: Trajectory
    """One pose per frame of the capture; of lost frames an interpolated one."""
    points: Float[Tensor, "n 3"]
    """On the surface, object frame."""
    colours: Float[Tensor, "n 3"]
    """Linear RGB of the points, median over the frames that show them: shading included."""
    quality: PoseQuality
    camera: Camera
    """The capture's; where its focal length is a guess, with the one that was found."""


def _degrees(angle: Tensor | float) -> str:
    return f"{math.degrees(float(angle)):.1f}"
