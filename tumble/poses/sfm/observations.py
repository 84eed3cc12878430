"""Observations from which stage 1 estimates poses: silhouettes, their convex contours, matches and feature tracks.

Unit of length: the mean distance between camera and object. In this unit a different focal length changes only the size
of the object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.poses.sfm import frontier_points, relative_pose
from tumble.poses.sfm.frontier_points import Contours
from tumble.poses.sfm.relative_pose import Silhouettes
from tumble.poses.sfm.tracks import Tracks, chain_matches
from tumble.scene import Capture, Match

TRACKS_PER_FRAME = 150
"""Number of tracks aimed at in every frame; it determines the distance between tracks."""
RADIUS_MARGIN = 1.1
"""Assumed radius of the object over the median radius of the spheres that its silhouettes indicate."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of stage 1: a capture and what was extracted from its frames by `gather`; its own poses are not used."""

    capture: Capture
    """Images, camera, and masks without the bands of unknown pixels along silhouettes."""
    matches: Sequence[Match] = field(repr=False)
    """Matches between pairs of frames, each with i < j."""
    silhouettes: Silhouettes
    """Position and size of the silhouette in every frame; that of a nearby frame where the mask failed."""
    contours: Contours
    """Convex contours of all silhouettes; those of failed masks have no reliable vertex."""
    tracks: Tracks
    """Feature tracks, chained from the matches."""
    radius: float
    """Approximate radius of the object [mean distance]."""
    matcher: str
    """Name of the matcher for loop closure: a file of `matching`."""


def gather(capture: Capture, matches: Sequence[Match], matcher: str) -> Inputs:
    """Extract silhouettes, contours and tracks from a capture and the matches between its frames.

    Raises:
        ValueError: No frame shows the object.
    """
    capture = replace(capture, masks=frontier_points.fill_boundary_bands(capture.masks))
    silhouettes = relative_pose.silhouettes(capture)
    if not bool(silhouettes.visible.any()):
        raise ValueError("no mask has an object pixel: poses need masks that show the object")
    area = math.pi * (silhouettes.radius * focal_length(capture) / relative_pose.SPHERE_OVER_DISC).square()
    contours = frontier_points.convex_contours(capture)
    failed = relative_pose.failed_masks(silhouettes)
    contours = replace(contours, reliable=contours.reliable & ~failed[:, None])
    silhouettes = relative_pose.replace_failed(silhouettes, failed)
    tracks = chain_matches(matches, (area / TRACKS_PER_FRAME).sqrt().clamp_min(2.0))
    radius = RADIUS_MARGIN * float(silhouettes.radius[silhouettes.visible].median())
    return Inputs(capture, matches, silhouettes, contours, tracks, radius, matcher)


def focal_length(capture: Capture) -> float:
    """Geometric mean of the focal lengths of both image axes [pixels]."""
    return float(capture.camera.fx_fy_cx_cy[:2].double().prod().sqrt())


def with_focal_length(inputs: Inputs, log_focal: Float[Tensor, ""]) -> Inputs:
    """The same observations under another focal length: the object is smaller in inverse proportion.

    Args:
        log_focal: Logarithm of the new focal length over the capture's.
    """
    if not float(log_focal):
        return inputs
    factor = float(log_focal.exp())
    capture = replace(inputs.capture, camera=inputs.capture.camera.zoomed(factor))
    silhouettes = replace(inputs.silhouettes, radius=inputs.silhouettes.radius / factor)
    return replace(inputs, capture=capture, silhouettes=silhouettes, radius=inputs.radius / factor)


def silhouette_centres(capture: Capture, silhouettes: Silhouettes) -> Float[Tensor, "t 3"]:
    """Points at depth 1 on the rays through the centres of the silhouettes, camera frame."""
    focal, principal = capture.camera.fx_fy_cx_cy.double().split(2)
    return torch.nn.functional.pad((silhouettes.centre - principal) / focal, (0, 1), value=1.0)
