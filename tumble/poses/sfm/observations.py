"""All that the frames of a capture say about poses, gathered once: silhouettes, outlines, matches and tracks.

Unit of length: the object's mean distance from the camera. A lens of another focal length therefore changes how large
the object is, and nothing else of what is gathered.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.poses.sfm import frontier_points, relative_pose
from tumble.poses.sfm.frontier_points import Outlines
from tumble.poses.sfm.relative_pose import Silhouettes
from tumble.poses.sfm.tracks import Tracks, followed
from tumble.scene import Capture, Match

POINTS = 150
"""Tracks that pass through a frame."""
FULL = 1.1
"""The object's radius over that of the ball about its middling silhouette."""


@dataclass(frozen=True)
class Inputs:
    """A capture whose poses nobody knows, and all that its frames say; `gather` makes it."""

    capture: Capture
    matches: Sequence[Match] = field(repr=False)
    shapes: Silhouettes
    outline: Outlines
    tracks: Tracks
    radius: float
    """Of the object [its mean distance]."""
    matcher: str
    """Of frames that see the same side again: a file of `matching`."""


def gather(capture: Capture, matches: Sequence[Match], matcher: str) -> Inputs:
    """Silhouettes, outlines and tracks of a capture and its matches; its masks without the bands along silhouettes.

    Raises:
        ValueError: No frame shows the object.
    """
    capture = replace(capture, masks=frontier_points.divided(capture.masks))
    shapes = relative_pose.silhouettes(capture)
    if not bool(shapes.visible.any()):
        raise ValueError("no mask has an object pixel: there is nothing to find poses of")
    area = math.pi * (shapes.radius * focal_length(capture) / relative_pose.ROUNDNESS).square()
    outline = frontier_points.outlines(capture)
    odd = relative_pose.odd(shapes)
    outline = replace(outline, sure=outline.sure & ~odd[:, None])
    shapes = relative_pose.mended(shapes, odd)
    tracks = followed(matches, (area / POINTS).sqrt().clamp_min(2.0))
    radius = FULL * float(shapes.radius[shapes.visible].median())
    return Inputs(capture, matches, shapes, outline, tracks, radius, matcher)


def focal_length(capture: Capture) -> float:
    """Of both axes, their mean [pixels]."""
    return float(capture.camera.fx_fy_cx_cy[:2].double().prod().sqrt())


def through(inputs: Inputs, log_focal: Float[Tensor, ""]) -> Inputs:
    """The same frames through a lens of another focal length: what is seen as large is as much smaller.

    Args:
        log_focal: Logarithm of the new focal length over the capture's.
    """
    if not float(log_focal):
        return inputs
    factor = float(log_focal.exp())
    capture = replace(inputs.capture, camera=inputs.capture.camera.zoomed(factor))
    shapes = replace(inputs.shapes, radius=inputs.shapes.radius / factor)
    return replace(inputs, capture=capture, shapes=shapes, radius=inputs.radius / factor)


def on_axis(capture: Capture, shapes: Silhouettes) -> Float[Tensor, "t 3"]:
    """Points at depth 1 in the middle of the silhouettes."""
    focal, principal = capture.camera.fx_fy_cx_cy.double().split(2)
    return torch.nn.functional.pad((shapes.centre - principal) / focal, (0, 1), value=1.0)
