"""How far the poses of a capture can be trusted, frame by frame and as a whole."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

UNSEEN = 0.05
"""Uncertainty about an axis from which a frame's rotation about it counts as not seen [radians]."""
WORSE = 4.0
"""Uncertainty about the worst axis over that about the next from which the axis is blamed, not the frames."""


@dataclass(frozen=True)
class Observability:
    """The axis of the object about which frames can turn with the least notice."""

    axis: Float[Tensor, "3"]
    """Unit length, object frame."""
    sigma: Float[Tensor, "3"]
    """Typical uncertainty of a frame's rotation about this axis, and about the two across it [radians]."""

    @property
    def unseen(self) -> bool:
        """Whether turns about the axis leave no trace in the pictures."""
        return float(self.sigma[0]) > UNSEEN and float(self.sigma[0]) > WORSE * float(self.sigma[1])

    @property
    def sentence(self) -> str:
        """What to tell a person."""
        degrees = [f"{float(torch.rad2deg(s)):.1f}" for s in self.sigma]
        x, y, z = (f"{float(a):.2f}" for a in self.axis)
        if self.unseen:
            return (
                f"The object looks the same when it turns about its axis ({x}, {y}, {z}): poses are uncertain by "
                f"{degrees[0]} degrees about it, by {degrees[1]} about others. Stick something on it that breaks the "
                f"symmetry."
            )
        return f"Rotations are seen about every axis, to about {degrees[0]} degrees about the worst."


@dataclass(frozen=True)
class Health:
    """Per frame, what its pose rests on."""

    residual: Float[Tensor, " t"]
    """Median distance between matches and the points they show [pixels]; NaN without matches."""
    inliers: Float[Tensor, " t"]
    """Number of matches that agree with the pose."""
    gap: Float[Tensor, " t"]
    """Median distance between the epipolar planes that touch this outline and those of others [pixels]."""
    overlap: Float[Tensor, " t"]
    """Intersection over union of the silhouette and that of the visual hull."""
    lost: Bool[Tensor, " t"]
    """Whether the pose is a guess from its neighbours."""
    observability: Observability

    def __len__(self) -> int:
        return len(self.residual)
