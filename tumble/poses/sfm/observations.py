"""Observations from which stage 1 estimates poses: silhouettes, their convex contours, matches and feature tracks.

Unit of length: the mean distance between camera and object. In this unit a different focal length changes only the size
of the object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tumble.maths import SE3, SO3
from tumble.poses.sfm import frontier_points, relative_pose
from tumble.poses.sfm.frontier_points import Contours
from tumble.poses.sfm.relative_pose import Silhouettes
from tumble.poses.sfm.symmetry import MirrorSymmetry, mirror_symmetry
from tumble.poses.sfm.tracks import Tracks, chain_matches
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Capture, Match, Trajectory

TRACKS_PER_FRAME = 150
"""Number of tracks aimed at in every frame; it determines the distance between tracks."""
RADIUS_MARGIN = 1.1
"""Assumed radius of the object over the median radius of the spheres that its silhouettes indicate."""
BOUNDING_RADIUS_FACTOR = 1.3
"""Radius of a sphere about the origin that safely contains the object, over the object's approximate radius."""
RIM = 2
"""Width of the rim around an object in which something that hides it shows [pixels]."""
MAX_HIDDEN_RIM = 0.25
"""Fraction of the rim that is unknown, in the median frame, above which the object counts as hidden in part."""


@dataclass(frozen=True)
class Inputs:
    """Inputs of stage 1: a capture and what was extracted from its frames by `gather`; its own poses are not used."""

    capture: Capture
    """Images, camera, and masks without the bands of unknown pixels along silhouettes."""
    matches: Sequence[Match] = field(repr=False)
    """Matches between pairs of frames, each with i < j, of the object."""
    silhouettes: Silhouettes
    """Position and size of the silhouette in every frame; that of a nearby frame where the mask failed."""
    contours: Contours
    """Convex contours of all silhouettes; those of failed masks have no reliable vertex."""
    tracks: Tracks
    """Feature tracks, chained from the matches."""
    radius: float
    """Approximate radius of the object [mean distance]."""
    failed: Bool[Tensor, " t"]
    """Frames whose silhouette differs from those of nearby frames, because the mask failed."""
    mirror_symmetry: MirrorSymmetry
    """Mirror symmetry of all silhouettes, by which a body of revolution is recognised."""
    all_matches: Sequence[Match] = field(default=(), repr=False)
    """If the object is hidden in part: matches of everything that is not background, a hand for example, as well."""

    @property
    def hidden(self) -> bool:
        """Whether the object is hidden in part (`is_hidden`)."""
        return bool(self.all_matches)


def gather(capture: Capture, matches: Sequence[Match], *, hidden: bool = False) -> Inputs:
    """Extract silhouettes, contours and tracks from a capture and the matches between its frames.

    Args:
        matches: Matches between the frames of the capture; of `shown(capture)` if the object is hidden in part.
        hidden: Whether something hides a part of the object (`is_hidden`).

    Raises:
        ValueError: No frame shows the object.
    """
    settled, original = without_doubt(capture), capture
    capture = _cleared(capture, hidden=hidden)
    silhouettes = relative_pose.silhouettes(capture)
    if not bool(silhouettes.visible.any()):
        raise ValueError("no mask has an object pixel: poses need masks that show the object")
    sure = [on_object(match, capture.masks) for match in matches] if hidden else matches
    tracks = tracks_of(sure, silhouettes, capture)
    contoured = capture if settled is original else _cleared(settled, hidden=hidden)
    contours = frontier_points.convex_contours(contoured)
    failed = relative_pose.failed_masks(silhouettes)
    contours = replace(contours, reliable=contours.reliable & ~failed[:, None])
    silhouettes = relative_pose.replace_failed(silhouettes, failed)
    radius = RADIUS_MARGIN * float(silhouettes.radius[silhouettes.visible].median())
    mirror = mirror_symmetry(capture.masks)
    return Inputs(capture, sure, silhouettes, contours, tracks, radius, failed, mirror, matches if hidden else ())


def _cleared(capture: Capture, *, hidden: bool) -> Capture:
    """The capture without bands of unknown pixels along silhouettes and, of a hidden object, without scraps."""
    masks = frontier_points.fill_boundary_bands(capture.masks)
    return replace(capture, masks=frontier_points.without_scraps(masks) if hidden else masks)


def tracks_of(matches: Sequence[Match], silhouettes: Silhouettes, capture: Capture) -> Tracks:
    """Feature tracks chained from matches."""
    area = math.pi * (silhouettes.radius * focal_length(capture) / relative_pose.SPHERE_OVER_DISC).square()
    return chain_matches(matches, (area / TRACKS_PER_FRAME).sqrt().clamp_min(2.0))


def is_hidden(masks: UInt8[Tensor, "t h w"]) -> bool:
    """Whether something hides a part of the object in most frames: a wide unknown region adjoins it.

    Masks of films without a hand have narrow unknown bands along the silhouette, which do not count.
    """
    fractions = []
    for mask in frontier_points.fill_boundary_bands(masks).numpy():
        inside = (mask == OBJECT).astype(np.uint8)
        rim = np.asarray(cv2.dilate(inside, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8))) > inside
        if rim.any():
            fractions.append(float((mask[rim] == UNKNOWN).mean()))
    return bool(fractions) and float(np.median(fractions)) > MAX_HIDDEN_RIM


def without_doubt(capture: Capture) -> Capture:
    """The capture with doubted background as background: unknown pixels that are black, but not in the full image.

    Where the object has the colours of what is behind it, a single wrong contour carves its shape. But poses need
    contours, and follow from so many that a wrong one does little harm.
    """
    if capture.full_images is None:
        return capture
    black = (capture.images == 0).all(-1) & (capture.full_images > 0).any(-1)
    doubted = black & (capture.masks == UNKNOWN)
    if not bool(doubted.any()):
        return capture
    return capture.with_masks(capture.masks.masked_fill(doubted, BACKGROUND))


def shown(capture: Capture) -> Capture:
    """The capture with everything that is not background in its masks: the object and what hides it."""
    capture = without_doubt(capture)
    masks = torch.where(capture.masks == BACKGROUND, capture.masks, torch.full_like(capture.masks, OBJECT))
    return replace(capture, masks=masks)


def on_object(match: Match, masks: UInt8[Tensor, "t h w"]) -> Match:
    """The correspondences of which at least one end lies on an object pixel: both then show the object."""
    height, width = masks.shape[1:]
    known = torch.zeros(len(match), dtype=torch.bool)
    for frame, uv in ((match.i, match.uv_i), (match.j, match.uv_j)):
        column, row = uv.floor().long().T
        known |= masks[frame][row.clamp(0, height - 1), column.clamp(0, width - 1)] == OBJECT
    return match.select(known)


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


def in_unit_sphere(inputs: Inputs, R: Float[Tensor, "t 3 3"], t: Float[Tensor, "t 3"]) -> Trajectory:
    """Poses in a unit in which the object lies in the unit sphere, from `R_cam_obj` and the object's origin."""
    distance = t.float() / (BOUNDING_RADIUS_FACTOR * inputs.radius)
    return Trajectory(SE3.from_rotation(SO3.from_matrix(R.float()), distance), inputs.capture.light)


def silhouette_centres(capture: Capture, silhouettes: Silhouettes) -> Float[Tensor, "t 3"]:
    """Points at depth 1 on the rays through the centres of the silhouettes, camera frame."""
    focal, principal = capture.camera.fx_fy_cx_cy.double().split(2)
    return torch.nn.functional.pad((silhouettes.centre - principal) / focal, (0, 1), value=1.0)
