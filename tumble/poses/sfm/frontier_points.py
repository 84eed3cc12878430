"""What silhouettes say about poses: points where two of them touch one epipolar plane (frontier points).

A plane through two cameras that just touches the object touches it in one point, which both silhouettes show on their
outlines (Cipolla and Giblin 2000, chapter 4). Every pair of frames has two such planes, so all pairs of frames bind
each other, textured or not, near in time or not, and unlike matches they know nothing of shading or highlights. Between
frames of 128 pixels with true poses the outlines' planes agree to a tenth of a pixel.

For poses that are believed the touching pixels are found here and handed on as matches. When the poses move they slide
along the outlines, to first order along the epipolar lines, which costs nothing.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from tumble.poses.sfm.tracks import Tracks
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture

CORNERS = 48
"""Of the polygon around each silhouette."""
CLEAR = 1.3
"""Least distance of the line through two cameras from the object's centre, over the object's radius: closer lines may
pierce it, and then no plane through them touches."""
LEAST_TURN = 0.15
"""Angle between two viewing directions from which their outlines say something [radians]."""
BORDER = 2
"""Pixels along the border of the picture and around unknown pixels where an outline may be cut off."""
BAND = 3
"""Widest band of unknown pixels along a silhouette that tells where it runs [pixels]; a hand is wider."""


@dataclass(frozen=True)
class Outlines:
    """Convex polygons around silhouettes."""

    corners: Float[Tensor, "c v 2"]
    """[pixels]"""
    sure: Bool[Tensor, "c v"]
    """Whether the object truly ends there."""

    def __getitem__(self, frames: Tensor) -> "Outlines":
        """Those of some frames."""
        return Outlines(self.corners[frames], self.sure[frames])


@dataclass(frozen=True)
class Touch:
    """Where `p` pairs of outlines touch common planes, above and below."""

    corner_i: Int64[Tensor, "p 2"]
    corner_j: Int64[Tensor, "p 2"]
    gap: Float[Tensor, "p 2"]
    """Distance between the two planes that each outline alone would touch [pixels]."""
    good: Bool[Tensor, "p 2"]
    """Whether poses and outlines allow to say so."""


def divided(masks: UInt8[Tensor, "t h w"]) -> UInt8[Tensor, "t h w"]:
    """Masks whose narrow bands of unknown pixels between object and background are given to the nearer of the two.

    Masks of films have such a band all along the silhouette, which runs in its middle: no loss should count those
    pixels, yet they hide nothing.
    """
    cut = []
    for mask in masks.numpy():
        to_object, to_background = (
            cv2.distanceTransform((mask != value).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
            for value in (OBJECT, BACKGROUND)
        )
        # Across a band of n pixels the two distances add up to n + 1.
        band = (mask == UNKNOWN) & (to_object + to_background < BAND + 1.5)
        nearer = np.where(to_object <= to_background, np.uint8(OBJECT), np.uint8(BACKGROUND))
        cut.append(torch.from_numpy(np.where(band, nearer, mask)))
    return torch.stack(cut)


def outlines(capture: Capture) -> Outlines:
    """The polygons of all frames; without sure corners where there is no object."""
    height, width = capture.camera.height, capture.camera.width
    corners, sure = [], []
    for mask in capture.masks.numpy():
        pixels = np.argwhere(mask == OBJECT)[:, [1, 0]].astype(np.int32)
        if len(pixels) < 3:
            corners.append(torch.zeros(CORNERS, 2))
            sure.append(torch.zeros(CORNERS, dtype=torch.bool))
            continue
        hull: np.ndarray = np.asarray(cv2.convexHull(np.ascontiguousarray(pixels)))[:, 0]
        hull = hull[np.linspace(0, len(hull) - 1, CORNERS).round().astype(int)]
        kernel = np.ones((2 * BORDER + 1,) * 2, np.uint8)
        wide: np.ndarray = np.asarray(cv2.dilate((mask == UNKNOWN).astype(np.uint8), kernel))
        hidden = wide[hull[:, 1], hull[:, 0]] > 0
        cut = ((hull < BORDER) | (hull >= np.array([width, height]) - BORDER)).any(1)
        corners.append(torch.from_numpy(hull + 0.5).float())
        sure.append(torch.from_numpy(~hidden & ~cut))
    return Outlines(torch.stack(corners).double(), torch.stack(sure))


def touch(
    pose_i: tuple[Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]],
    pose_j: tuple[Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]],
    outlines_i: Outlines,
    outlines_j: Outlines,
    camera: Camera,
    *,
    radius: float,
) -> Touch:
    """The touching corners of pairs of frames.

    Args:
        pose_i: `R_cam_obj` and the object's origin in the camera frame, of the one frame of each pair.
        pose_j: Of the other.
        outlines_i: One per pair.
        outlines_j: Likewise.
        camera: Of all frames.
        radius: Of the object, in the poses' unit.
    """
    centre_i, centre_j = (-torch.einsum("pji,pj->pi", R, t) for R, t in (pose_i, pose_j))
    base = torch.nn.functional.normalize(centre_j - centre_i, dim=-1)
    away = centre_i - (centre_i * base).sum(-1, keepdim=True) * base
    distance = away.norm(dim=-1)
    turn = (pose_i[0][:, 2] * pose_j[0][:, 2]).sum(-1).clamp(-1, 1).arccos()
    good = (distance > CLEAR * radius) & (turn > LEAST_TURN)
    away = away / distance.clamp_min(1e-9)[:, None]
    frame = torch.stack([torch.linalg.cross(base, away), -away], -1)
    focal, principal = camera.fx_fy_cx_cy.double().split(2)
    angles = []
    for (R, _), outline in ((pose_i, outlines_i), (pose_j, outlines_j)):
        xy = (outline.corners - principal) / focal
        # Angle of the plane through the base line and each ray, 0 towards the object's centre.
        axes = R @ frame
        x = xy @ axes[:, :2] + axes[:, 2:]
        angles.append(torch.atan2(x[..., 0], x[..., 1]))
    picks = [torch.stack([angle.argmax(1), angle.argmin(1)], 1) for angle in angles]
    sure = outlines_i.sure.gather(1, picks[0]) & outlines_j.sure.gather(1, picks[1])
    ends = [angle.gather(1, pick) for angle, pick in zip(angles, picks, strict=True)]
    gap = (ends[0] - ends[1]) * (distance * focal.prod().sqrt())[:, None]
    return Touch(picks[0], picks[1], gap, good[:, None] & sure)


def frontier(
    R: Float[Tensor, "c 3 3"],
    t: Float[Tensor, "c 3"],
    camera: Camera,
    outline: Outlines,
    *,
    radius: float,
    pairs: Int64[Tensor, "p 2"],
) -> Tracks:
    """The touching pixels of pairs of cameras as tracks of two observations each; `frame` counts the cameras."""
    i, j = pairs.T
    found = touch((R[i], t[i]), (R[j], t[j]), outline[i], outline[j], camera, radius=radius)
    frames = pairs[:, None].expand(-1, 2, -1)[found.good]
    uv_i, uv_j = outline.corners[i[:, None], found.corner_i], outline.corners[j[:, None], found.corner_j]
    places = torch.stack([uv_i, uv_j], 2)[found.good]
    point = torch.arange(len(frames)).repeat_interleave(2)
    return Tracks(frames.reshape(-1), point, places.reshape(-1, 2))
