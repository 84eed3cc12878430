"""Frontier points: surface points where a plane through two camera centres is tangent to the object.

Both silhouettes show such a point on their contours, where the epipolar plane is tangent to them (Cipolla and Giblin
2000, chapter 4). Any two frames whose baseline misses the object have two such planes, one on each side of it. This
constrains their relative pose without texture and however far apart in time they are, and unlike matches it does not
depend on shading or highlights.

The tangent vertices are found for given poses and then treated as matches. As the poses change, the true tangent points
slide along the contours, to first order along the epipolar lines, so that matches kept fixed add no first-order error.

What is seen of an object behind a hand also has tangents, but the object may go on beyond them behind the hand. A
tangent therefore only counts where it is also that of the object together with what may hide the rest of it.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64, UInt8
from torch import Tensor

from tumble.poses.sfm.tracks import Tracks
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture

VERTICES = 48
"""Number of vertices of each contour polygon."""
MIN_BASELINE_DISTANCE = 1.3
"""Minimum distance of the baseline from the object's centre [object radius].

A closer baseline may pierce the object, which then has no tangent epipolar plane.
"""
MIN_VIEW_ANGLE = 0.15
"""Minimum angle between the optical axes of two frames [radians]; closer views hardly constrain each other."""
MARGIN = 2
"""Distance to the image border or to an unknown pixel within which a contour may be truncated, and by which what may
be hidden may reach beyond a tangent [pixels]."""
MAX_BAND = 3
"""Maximum width of a band of unknown pixels that follows a silhouette [pixels]; an occluding hand is wider."""
MIN_PART = 0.15
"""Area of a part of the object below which it may be something else [largest part], as in the masks of films."""
MAX_SHIFT = 3.0
"""Largest distance of a contour from the edge of the photo that it is moved to [pixels]."""
SIDE = 3.0
"""Length of the profile on either side of an edge, over which colours are averaged [pixels]."""
PROFILE_STEP = 0.25
"""Distance between the samples of a profile [pixels]."""
BESIDE = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Parallel lines over which a profile is averaged [pixels]."""
MIN_CONTRAST = 25.0
"""Distance of the colours on both sides below which there is no edge [code values]: that of shading, or of noise."""
NOISE_VARIANCE = 30.0
"""Variance of colour by noise, the sum of three channels [squared code values]."""


@dataclass(frozen=True)
class Contours:
    """Convex hulls of the silhouettes of `c` frames, as polygons of `v` vertices."""

    vertices: Float[Tensor, "c v 2"]
    """Positions in the image [pixels]."""
    reliable: Bool[Tensor, "c v"]
    """Whether the object ends at the vertex, rather than being occluded or cut off by the image border."""
    outer: Float[Tensor, "c v 2"] | None = None
    """The same polygons of silhouettes together with pixels where more of the object may be, unknown ones and those
    beyond the border of the image [pixels]; None if there are none."""

    def __getitem__(self, frames: Tensor) -> "Contours":
        """The contours of some frames."""
        outer = None if self.outer is None else self.outer[frames]
        return Contours(self.vertices[frames], self.reliable[frames], outer)


@dataclass(frozen=True)
class EpipolarTangencies:
    """Tangent epipolar planes of `p` pairs of frames, one on each side of the object."""

    vertex_i: Int64[Tensor, "p 2"]
    """Index of the tangent vertex in the first frame's contour."""
    vertex_j: Int64[Tensor, "p 2"]
    """Index of the tangent vertex in the second frame's contour."""
    gap: Float[Tensor, "p 2"]
    """Signed distance at the object between the planes tangent to either contour, 0 for true poses [pixels]."""
    valid: Bool[Tensor, "p 2"]
    """Whether the two views are suitable, both tangent vertices are reliable, and nothing may be hidden beyond them."""
    conflict: Float[Tensor, "p 2"]
    """Signed distance by which one frame shows more of the object than the other may hide [pixels]; 0 if all that is
    seen is possible, NaN if the two views are not suitable."""

    @property
    def residual(self) -> Float[Tensor, "p 2"]:
        """The gap where both tangents are known, else the conflict; NaN where neither is [pixels]."""
        return torch.where(self.valid, self.gap, self.conflict)


def cauchy_loss(gaps: Float[Tensor, "*b"], scale: float) -> Float[Tensor, "*b"]:
    """Robust loss of each tangency gap or conflict; NaN where there is none.

    Args:
        gaps: Gaps or conflicts [pixels].
        scale: Scale of the Cauchy loss [pixels].
    """
    return torch.log1p((gaps / scale).square())


def fill_boundary_bands(masks: UInt8[Tensor, "t h w"]) -> UInt8[Tensor, "t h w"]:
    """Masks whose narrow bands of unknown pixels between object and background are assigned to the nearer of the two.

    The masks of a video have such a band along the whole silhouette, whose contour runs in the middle of the band.
    Losses ignore these pixels, but they do not occlude the object.
    """
    filled = []
    for mask in masks.numpy():
        object_distance, background_distance = (
            cv2.distanceTransform((mask != value).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
            for value in (OBJECT, BACKGROUND)
        )
        # Across a band of n pixels the two distances add up to n + 1.
        band = (mask == UNKNOWN) & (object_distance + background_distance < MAX_BAND + 1.5)
        nearer = np.where(object_distance <= background_distance, np.uint8(OBJECT), np.uint8(BACKGROUND))
        filled.append(torch.from_numpy(np.where(band, nearer, mask)))
    return torch.stack(filled)


def without_scraps(masks: UInt8[Tensor, "t h w"]) -> UInt8[Tensor, "t h w"]:
    """Masks in which small parts of the object, away from the rest, are unknown.

    A few pixels of a sleeve beside the object would stretch its convex hull to them.
    """
    masks = masks.clone()
    for mask in masks.numpy():
        _, ids, stats, _ = cv2.connectedComponentsWithStats((mask == OBJECT).astype(np.uint8))
        area = stats[:, cv2.CC_STAT_AREA]
        small = area < MIN_PART * area[1:].max(initial=0)
        small[0] = False
        mask[small[ids]] = UNKNOWN
    return masks


def convex_contours(capture: Capture) -> Contours:
    """Contours of all frames; no vertex is reliable in a frame without the object.

    With photos of what is around the object, they are moved to the edges in these (`at_edges`).
    """
    height, width = capture.camera.height, capture.camera.width
    vertices, outer, reliable = [], [], []
    reach = _reach(capture.masks.numpy())
    for mask in capture.masks.numpy():
        inside = mask == OBJECT
        if inside.sum() < 3:
            vertices.append(torch.zeros(VERTICES, 2))
            outer.append(torch.zeros(VERTICES, 2))
            reliable.append(torch.zeros(VERTICES, dtype=torch.bool))
            continue
        hull = _hull(inside)
        possible = _possible_hull(mask, reach)
        kernel = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
        unknown: np.ndarray = np.asarray(cv2.dilate((mask == UNKNOWN).astype(np.uint8), kernel))
        occluded = unknown[hull[:, 1], hull[:, 0]] > 0
        cut_off = ((hull < MARGIN) | (hull >= np.array([width, height]) - MARGIN)).any(1)
        vertices.append(torch.from_numpy(hull + 0.5).float())
        outer.append(vertices[-1] if possible is None else torch.from_numpy(possible + 0.5).float())
        reliable.append(torch.from_numpy(~occluded & ~cut_off))
    same = torch.equal(torch.stack(vertices), torch.stack(outer))
    contours = Contours(
        torch.stack(vertices).double(), torch.stack(reliable), None if same else torch.stack(outer).double()
    )
    return contours if capture.full_images is None else at_edges(contours, capture.full_images)


def at_edges(contours: Contours, photos: UInt8[Tensor, "c h w 3"]) -> Contours:
    """Contours moved to the clearest edges of the photos beside them; vertices without one are not reliable.

    Masks of a film err by one or two pixels alike along a whole side, in many frames: by a shadow beside the object, or
    by a part of it that is as dark as what is behind it. That turns the poses of these frames by degrees.
    """
    moved, outer, found = [], [], []
    for k, photo in enumerate(photos.numpy()):
        vertices, is_edge = _at_edges(contours.vertices[k].numpy(), photo)
        moved.append(torch.from_numpy(vertices))
        found.append(torch.from_numpy(is_edge))
        if contours.outer is not None:
            outer.append(torch.from_numpy(_at_edges(contours.outer[k].numpy(), photo)[0]))
    reliable = contours.reliable & torch.stack(found)
    return Contours(torch.stack(moved), reliable, torch.stack(outer) if outer else None)


def _at_edges(
    polygon: Float[np.ndarray, "v 2"], photo: UInt8[np.ndarray, "h w 3"]
) -> tuple[Float[np.ndarray, "v 2"], Bool[np.ndarray, " v"]]:
    """Vertices of a convex polygon moved along its normals to the clearest edge, and which of them have one.

    The edge is where the colours on both sides differ most, over their variance.
    """
    corner = (polygon != np.roll(polygon, 1, 0)).any(1)
    corners = polygon[corner]
    if len(corners) < 3:
        return polygon, np.zeros(len(polygon), bool)
    along = np.roll(corners, -1, 0) - corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    tangent = along + np.roll(along, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True).clip(1e-9)
    area = (corners * np.roll(corners, -1, 0)[:, ::-1] * (1, -1)).sum()
    tangent = np.sign(area) * tangent[corner.cumsum() - 1]
    normal = tangent[:, ::-1] * (1, -1)
    steps = np.arange(-MAX_SHIFT - SIDE, MAX_SHIFT + SIDE, PROFILE_STEP) + PROFILE_STEP / 2
    at = (polygon[:, None, None] + steps[:, None, None] * normal[:, None, None]) + (
        np.array(BESIDE)[:, None] * tangent[:, None, None]
    )
    # Centres of pixels are at whole numbers for OpenCV.
    x, y = np.moveaxis(at.reshape(len(polygon), -1, 2).astype(np.float32) - np.float32(0.5), -1, 0)
    colours = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    profile = colours.reshape(len(polygon), len(steps), len(BESIDE), 3).mean(2)
    side = round(SIDE / PROFILE_STEP)
    windows = np.lib.stride_tricks.sliding_window_view(profile, side, axis=1)
    mean, variance = windows.mean(-1), windows.var(-1).sum(-1)
    contrast = np.linalg.norm(mean[:, side:] - mean[:, :-side], axis=-1)
    best = (contrast**2 / (variance[:, side:] + variance[:, :-side] + NOISE_VARIANCE)).argmax(1)
    found = contrast[np.arange(len(polygon)), best] >= MIN_CONTRAST
    shift = np.where(found, best * PROFILE_STEP - MAX_SHIFT, 0.0)
    return polygon + shift[:, None] * normal, found


def _reach(masks: UInt8[np.ndarray, "t h w"]) -> float:
    """Distance from what is seen of the object up to which more of it may be hidden [pixels].

    Twice the diameter of a disc of the same area, as a bottle is longer than that and some of it is always hidden.
    """
    areas = [area for mask in masks if (area := int((mask == OBJECT).sum()))]
    return 4 * math.sqrt(float(np.median(areas)) / math.pi) if areas else 0.0


def _possible_hull(mask: UInt8[np.ndarray, "h w"], reach: float) -> Int32[np.ndarray, "v 2"] | None:
    """Hull of the object's pixels, and of those where more of it may be: connected to them and near, and unknown or
    beyond the border of the image. None if there are none of these."""
    inner = np.zeros(mask.shape, bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    cut_off = bool((mask[~inner] == OBJECT).any())
    if not cut_off and not (mask == UNKNOWN).any():
        return None
    border = math.ceil(reach) if cut_off else 0
    mask = np.pad(mask, border, constant_values=UNKNOWN)
    inside = mask == OBJECT
    distance = np.asarray(cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5))
    either = inside | ((mask == UNKNOWN) & (distance <= reach))
    component = np.asarray(cv2.connectedComponents(either.astype(np.uint8))[1])
    return _hull(either & np.isin(component, np.unique(component[inside]))) - border


def _hull(inside: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "v 2"]:
    """Convex hull of pixels, as a polygon of `VERTICES` of its corners."""
    pixels = np.ascontiguousarray(np.argwhere(inside)[:, [1, 0]].astype(np.int32))
    hull: np.ndarray = np.asarray(cv2.convexHull(pixels))[:, 0]
    return hull[np.linspace(0, len(hull) - 1, VERTICES).round().astype(int)]


def epipolar_tangencies(
    pose_i: tuple[Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]],
    pose_j: tuple[Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]],
    contours_i: Contours,
    contours_j: Contours,
    camera: Camera,
    *,
    radius: float,
) -> EpipolarTangencies:
    """Tangent epipolar planes of pairs of frames, and the contour vertices where they are tangent.

    Args:
        pose_i: `R_cam_obj` and the object's origin in the camera frame [object's mean distance], for the first frame
            of each pair.
        pose_j: The same for the second frame of each pair.
        contours_i: Contour of the first frame of each pair.
        contours_j: Contour of the second frame of each pair.
        camera: Camera of all frames.
        radius: Object radius [object's mean distance].
    """
    centre_i, centre_j = (-torch.einsum("pji,pj->pi", R, t) for R, t in (pose_i, pose_j))
    baseline = torch.nn.functional.normalize(centre_j - centre_i, dim=-1)
    offset = centre_i - (centre_i * baseline).sum(-1, keepdim=True) * baseline
    distance = offset.norm(dim=-1)
    view_angle = (pose_i[0][:, 2] * pose_j[0][:, 2]).sum(-1).clamp(-1, 1).arccos()
    valid = (distance > MIN_BASELINE_DISTANCE * radius) & (view_angle > MIN_VIEW_ANGLE)
    offset = offset / distance.clamp_min(1e-9)[:, None]
    plane_axes = torch.stack([torch.linalg.cross(baseline, offset), -offset], -1)
    focal, principal = camera.fx_fy_cx_cy.double().split(2)
    pixels = (distance * focal.prod().sqrt())[:, None]
    vertices, inner, outer = [], [], []
    suitable, reliable = valid[:, None], valid[:, None]
    for (R, _), contours in ((pose_i, contours_i), (pose_j, contours_j)):
        axes = R @ plane_axes
        angles = _plane_angles((contours.vertices - principal) / focal, axes)
        vertices.append(torch.stack([angles.argmax(1), angles.argmin(1)], 1))
        inner.append(angles.gather(1, vertices[-1]))
        outer.append(inner[-1])
        if contours.outer is not None:
            angles = _plane_angles((contours.outer - principal) / focal, axes)
            outer[-1] = torch.stack([angles.amax(1), angles.amin(1)], 1)
        reliable = reliable & contours.reliable.gather(1, vertices[-1])
        reliable = reliable & ((outer[-1] - inner[-1]).abs() * pixels <= MARGIN)
        suitable = suitable & contours.reliable.any(1)[:, None]
    side = torch.tensor([1.0, -1.0], dtype=pixels.dtype)
    beyond = [(side * (inner[a] - outer[b])).clamp_min(0) for a, b in ((0, 1), (1, 0))]
    conflict = torch.where(suitable, side * (beyond[0] - beyond[1]) * pixels, torch.nan)
    return EpipolarTangencies(vertices[0], vertices[1], (inner[0] - inner[1]) * pixels, reliable, conflict)


def _plane_angles(xy: Float[Tensor, "p v 2"], axes: Float[Tensor, "p 3 2"]) -> Float[Tensor, "p v"]:
    """Angles about the baseline of the epipolar planes of contour vertices [radians].

    Args:
        xy: Their positions in the image plane at depth 1.
        axes: Axes of the angles, camera frame; the second one points from the baseline to the object's centre, whose
            plane has the angle 0.
    """
    x = xy @ axes[:, :2] + axes[:, 2:]
    return torch.atan2(x[..., 0], x[..., 1])


def frontier_tracks(
    R: Float[Tensor, "c 3 3"],
    t: Float[Tensor, "c 3"],
    camera: Camera,
    contours: Contours,
    *,
    radius: float,
    pairs: Int64[Tensor, "p 2"],
) -> Tracks:
    """Frontier points of pairs of frames, as tracks of two observations each.

    Args:
        R: `R_cam_obj` of all frames.
        t: The object's origin in the camera frame [object's mean distance].
        camera: Camera of all frames.
        contours: Contours of all frames.
        radius: Object radius [object's mean distance].
        pairs: Indices into the frames; `Tracks.frame` has the same indices.
    """
    i, j = pairs.T
    found = epipolar_tangencies((R[i], t[i]), (R[j], t[j]), contours[i], contours[j], camera, radius=radius)
    return tracks_at(found, contours, pairs, found.valid)


def tracks_at(
    found: EpipolarTangencies, contours: Contours, pairs: Int64[Tensor, "p 2"], chosen: Bool[Tensor, "p 2"]
) -> Tracks:
    """The chosen frontier points of pairs of frames, as tracks of two observations each.

    Args:
        contours: Contours of all frames.
        pairs: Indices into the frames, for which the tangencies were found.
    """
    i, j = pairs.T
    frames = pairs[:, None].expand(-1, 2, -1)[chosen]
    uv_i, uv_j = contours.vertices[i[:, None], found.vertex_i], contours.vertices[j[:, None], found.vertex_j]
    uv = torch.stack([uv_i, uv_j], 2)[chosen]
    point = torch.arange(len(frames)).repeat_interleave(2)
    return Tracks(frames.reshape(-1), point, uv.reshape(-1, 2))
