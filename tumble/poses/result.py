"""Quality of estimated poses, per frame and for the whole capture, and the result of stage 1."""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.maths import SE3, interpolate
from tumble.scene import Camera, Trajectory

PoseRating = Literal["good", "warn", "bad"]

UNOBSERVABLE_SIGMA = 0.1
"""Standard deviation of the rotation about an axis above which that rotation counts as not observable [radians]."""
UNOBSERVABLE_RATIO = 4.0
"""Ratio of the largest to the second largest standard deviation above which a single axis counts as not observable.
Below it, all rotations are uncertain, and the frames are at fault rather than the axis."""
CONVERGED_OVERLAP = 0.94
"""Median overlap of silhouettes and visual hull at which solutions that have converged arrive (IoU)."""
ERROR_PER_OVERLAP = math.radians(130)
"""Median rotation error per unit of overlap below `CONVERGED_OVERLAP` [radians]: a line through measured solutions that
had not converged."""
MAX_GOOD_UNCERTAINTY = math.radians(2.0)
"""Largest uncertainty of rotations that is rated "good" [radians]."""
MAX_USABLE_UNCERTAINTY = math.radians(5.0)
"""Largest uncertainty of rotations that is rated "warn"; above it the poses are "bad" [radians]."""
MIN_ROTATION_RANGE = math.radians(10)
"""Rotation range below which the object counts as not having rotated [radians]."""
MAX_LOST_FRACTION = 0.5
"""Largest fraction of lost frames with which the remaining poses are still usable."""
MIN_TIES = 8
"""Number of surface points seen before and after an instant below which contours tell how the object is turned from one
part of the film to the other: a pose needs as many (`registration.MIN_CORRESPONDENCES`)."""
MAX_NAMED = 3
"""Number of such instants that are named, the weakest ones."""


@dataclass(frozen=True)
class Observability:
    """Axis of the object about which rotations are least certain, and the standard deviations about three axes."""

    axis: Float[Tensor, "3"]
    """Unit vector, object frame. For an untextured body of revolution only its direction in the first image is known:
    the last component is NaN."""
    sigma: Float[Tensor, "3"]
    """Typical standard deviation of a frame's rotation about `axis` and about the two axes perpendicular to it, in
    descending order [radians]."""

    @property
    def several_axes_unobservable(self) -> bool:
        """Whether rotations about at least two axes are not observable."""
        return float(self.sigma[1]) > UNOBSERVABLE_SIGMA

    @property
    def axis_unobservable(self) -> bool:
        """Whether rotation about `axis` is not observable."""
        return float(self.sigma[0]) > UNOBSERVABLE_SIGMA and (
            self.several_axes_unobservable or float(self.sigma[0]) > UNOBSERVABLE_RATIO * float(self.sigma[1])
        )

    @property
    def sentence(self) -> str:
        """Result and advice in plain words, for the user."""
        known = [f"{float(a):.2f}" for a in self.axis if not a.isnan()]
        where = f"({', '.join(known)})" + ("" if len(known) == 3 else " of the first image")
        if self.several_axes_unobservable:
            return (
                "Rotation is not observable: neither texture nor silhouette shows how the object rotates. Stick "
                "something on it that can be tracked."
            )
        if self.axis_unobservable:
            return (
                f"Rotation about axis {where} is not observable: neither silhouette nor texture shows it. If the "
                f"object has a texture, image noise hides it: record in more light. If it has none, stick something "
                f"on it that can be tracked."
            )
        return (
            f"Rotations are observable about every axis, to about {_degrees(self.sigma[0])} degrees about the worst "
            f"axis."
        )


@dataclass(frozen=True)
class PoseQuality:
    """Quality of estimated poses: residuals of every frame, and what follows for the capture."""

    residual: Float[Tensor, " t"]
    """Median reprojection error of the frame's track observations [pixels]; NaN without any."""
    inliers: Float[Tensor, " t"]
    """Number of the frame's track observations with a small reprojection error."""
    tangency_gap: Float[Tensor, " t"]
    """Median distance between the tangent epipolar planes of the frame's silhouette contour and those of the other
    frames' contours [pixels]; NaN where no pair of frames has frontier points."""
    overlap: Float[Tensor, " t"]
    """Intersection over union of the silhouette and the projected visual hull."""
    rotation_disagreement: Float[Tensor, " t"]
    """Angle between the rotation fitted mainly to tracks and the one fitted mainly to contours [radians]."""
    lost: Bool[Tensor, " t"]
    """Whether no consistent pose was found; the pose is then interpolated from other frames."""
    rotation_range: Float[Tensor, ""]
    """Largest angle between the rotations of two frames [radians]."""
    observability: Observability
    ties: Float[Tensor, " t"] | None = None
    """Number of surface points that are seen before a frame and from then on; infinite for the first frame and lost
    ones, except where one side was lost because the hull contradicts how both are joined. None: nothing hides the
    object, so that its contours tell how it is turned."""

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def loose_from(self) -> list[int]:
        """Frames from which on poses are hardly tied to earlier ones by what they show.

        Of consecutive ones the weakest, and up to `MAX_NAMED`, in order of time.
        """
        if self.ties is None:
            return []
        ties = self.ties.tolist()
        tied = [k for k, count in enumerate(ties) if math.isfinite(count)]
        runs = [list(run) for weak, run in itertools.groupby(tied, lambda k: ties[k] < MIN_TIES) if weak]
        weakest = sorted((min(run, key=ties.__getitem__) for run in runs), key=ties.__getitem__)
        return sorted(weakest[:MAX_NAMED])

    @property
    def stationary(self) -> bool:
        """Whether the poses hardly rotate; those of a sphere without texture do not either, however it rotates."""
        return float(self.rotation_range) < MIN_ROTATION_RANGE

    @property
    def overlap_uncertainty(self) -> float:
        """Median rotation error expected from the overlap of silhouettes and visual hull [radians]."""
        kept = self.overlap[~self.lost]
        return ERROR_PER_OVERLAP * max(0.0, CONVERGED_OVERLAP - float(kept.median())) if len(kept) else math.pi

    @property
    def uncertainty(self) -> float:
        """Expected median rotation error of the frames that are not lost [radians]."""
        kept = self.rotation_disagreement[~self.lost]
        return max(self.overlap_uncertainty, float(kept.median())) if len(kept) else math.pi

    @property
    def rating(self) -> PoseRating:
        """Overall rating: "bad" poses should not be used."""
        lost = float(self.lost.float().mean())
        if (
            self.stationary
            or self.observability.axis_unobservable
            or self.uncertainty > MAX_USABLE_UNCERTAINTY
            or lost > MAX_LOST_FRACTION
        ):
            return "bad"
        doubtful = lost > 0 or self.uncertainty > MAX_GOOD_UNCERTAINTY or bool(self.loose_from)
        return "warn" if doubtful else "good"

    @property
    def sentence(self) -> str:
        """Result and advice in plain words, for the user."""
        if self.stationary:
            return (
                "Rotation is not observable: nothing in the images shows that the object rotates. If it did, stick "
                "something on it that can be tracked."
            )
        if self.observability.axis_unobservable:
            return self.observability.sentence
        if self.overlap_uncertainty > MAX_USABLE_UNCERTAINTY:
            return (
                "The silhouettes are inconsistent at these poses: the object changed its shape, or its rotations were "
                "not found. Record it alone, with smaller rotations between frames and with more texture."
                f"{self._about_ties}"
            )
        lost = int(self.lost.sum())
        accuracy = f"Rotations are accurate to about {_degrees(self.uncertainty)} degrees."
        contradicted = f" {lost} of {len(self)} frames are inconsistent with the others." if lost else ""
        return accuracy + contradicted + self._about_ties

    @property
    def _about_ties(self) -> str:
        """What to know, and to do, where two parts of the film share little; empty if none do."""
        if not self.loose_from:
            return ""
        frames = " or ".join(map(str, self.loose_from))
        return (
            f" Hardly any point of the object is seen both before and after frame {frames}: only contours tell how "
            "it is turned from one part to the other, which may be wrong by tens of degrees. When you change your "
            "grip, show the same side before and after."
        )


@dataclass(frozen=True)
class PoseResult:
    """Result of stage 1, by either method."""

    trajectory: Trajectory
    """One pose per frame of the capture; lost frames have an interpolated one."""
    points: Float[Tensor, "n 3"]
    """Triangulated surface points, object frame [object radius]."""
    colours: Float[Tensor, "n 3"]
    """Linear RGB of the points, shading included: the median over the frames in which they are visible."""
    quality: PoseQuality
    camera: Camera
    """Camera of the capture, with the estimated focal length where the capture's was only assumed."""


def interpolate_lost(T: SE3, lost: Bool[Tensor, " t"]) -> SE3:
    """Poses with those of lost frames interpolated between the closest other frames, or copied at either end."""
    kept = torch.nonzero(~lost)[:, 0].tolist()
    if not kept:
        return T
    wxyz, xyz = T.wxyz.clone(), T.xyz.clone()
    for k in torch.nonzero(lost)[:, 0].tolist():
        before, after = (
            max((i for i in kept if i < k), default=kept[0]),
            min((i for i in kept if i > k), default=kept[-1]),
        )
        fraction = (k - before) / (after - before) if before < k < after else 0.0
        pose = interpolate(T[before], T[after], fraction)
        wxyz[k], xyz[k] = pose.wxyz, pose.xyz
    return SE3(wxyz, xyz)


def _degrees(angle: Tensor | float) -> str:
    return f"{math.degrees(float(angle)):.1f}"
