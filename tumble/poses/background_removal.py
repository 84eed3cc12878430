"""What does not belong to the object inside its masks, recognised once the poses are known: background and hands.

The mask of a held object may contain a piece of the wall beside it, where the wall was hidden in most other frames. If
this happens in the few frames that show the object edge-on, nothing else carves its visual hull there. But the other
frames show how the object looks at this place. A pixel of a mask becomes background if its colour is not the object's,
there or nearby, and is that of the background close by in the same frame. Both are required: where poses have errors,
the object's own colours are unexpected, too, and a wall may have the object's colours.

A hand is unknown in the masks, since it may hide the object, so that a hull keeps a hand that stays at its place: a mug
has a fist on its rim. But the surface of the object is object in the frames that it faces, and that of the hand is not.
What lies outside of the convex hull of the confirmed surface is no object, and its pixels become background.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from tumble.poses import mask_refinement, working_size
from tumble.poses.mask_refinement import EXTENT, RESOLUTION, beyond, hull_by_vote, silhouette_of
from tumble.poses.result import PoseResult
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture

SPACING = 2 * EXTENT / RESOLUTION
"""Side of a cell of the hull [object radius]."""
MAX_DEPTH_DIFFERENCE = 2.5
"""Distance behind the nearest cell of a pixel up to which a cell of the hull's surface is visible [cells]."""
MIN_SHOWN = 0.25
"""Of the frames in which a cell of the hull's surface is in front, the fraction that must show object there."""
NEIGHBOURHOOD = 5.0
"""Distance up to which most other cells of the surface must be confirmed as well, since masks have errors [cells]."""
MIN_FACED = 0.1
"""Fraction of the frames in which a cell has to be in front; of others too little is known."""
MIN_LEFT = 1 / 3
"""Fraction of the hull that has to be left; with less, hands hide too much of the object to be told from it."""
MIN_FRAMES = 2
"""Minimum number of frames that must show a cell; the colour of others is unknown."""
SHADING_SIGMA = 0.15
"""Standard deviation of the Gaussian over which changes of the light from frame to frame are averaged [object size]."""
MAX_SHIFT = 0.06
"""Distance within which a pixel's colour is looked for in the object's expected appearance; poses have errors
[object size]."""
SURROUNDINGS = 0.18
"""Distance within which a pixel's colour is looked for in the background of the same frame [object size]."""
MIN_DIFFERENCE = 15.0
"""Difference in a channel from all expected colours above which a pixel does not show the object [code values]."""
MAX_DIFFERENCE = 10.0
"""Difference from a colour of the background in each channel up to which a pixel shows it [code values]."""
MAX_GAP = 0.1
"""Distance up to which a region adjoins what is outside, as a band of unknown pixels may lie between [object size]."""
MIN_AREA = 0.006
"""Minimum area of a region; smaller ones are noise [squared object size].

The object size is the square root of the median area of the object in the masks."""


@dataclass(frozen=True)
class _Surface:
    """Cells of the hull's surface in one frame."""

    column_row: Int[np.ndarray, "n 2"]
    """Pixel that contains each cell's centre; it may lie outside of the image."""
    visible: Bool[np.ndarray, " n"]
    nearest: Int[np.ndarray, "h w"]
    """Number of the cell that each pixel shows, -1 if none."""


def remove_background(capture: Capture, result: PoseResult) -> Capture:
    """The capture without background and hands in its masks, and without its full images.

    Captures without full images and those whose poses are bad keep their masks, as do frames without a pose.
    """
    kept = torch.nonzero(~result.quality.lost)[:, 0].tolist()
    if capture.full_images is None or result.quality.rating == "bad":
        return replace(capture, full_images=None)
    photos = np.stack([cv2.GaussianBlur(capture.full_images[k].numpy(), (3, 3), 0) for k in kept]).astype(np.float32)
    labels, T_cam_obj = capture.masks[kept].numpy(), result.trajectory.T_cam_obj[kept]
    cells = hull_by_vote(replace(capture, camera=result.camera), result.trajectory.T_cam_obj, kept)
    faces = _surface_cells(cells)
    surfaces = [_surface(result.camera, T_cam_obj[i] @ faces) for i in range(len(kept))]
    own = _own_cells(labels, surfaces, faces, cells)
    size = float(np.sqrt(np.median((labels == OBJECT).sum((1, 2)))))
    expected = _expected_colours(photos, labels, surfaces, size)
    masks, images = capture.masks.clone(), capture.images.clone()
    for i, k in enumerate(kept):
        outside = beyond(silhouette_of(result.camera, T_cam_obj[i] @ own))
        wrong = torch.from_numpy(_background(photos[i], labels[i], expected[i], size) | outside)
        masks[k][wrong], images[k][wrong] = BACKGROUND, 0
    return replace(capture, masks=masks, images=images, full_images=None)


def stored_result(out: Path, capture: Capture) -> tuple[PoseResult | None, Capture]:
    """The poses of a run, None if there are none, and its capture with the masks that stages 2 and 3 have seen."""
    small = working_size.reduced(capture)
    tracked, trimmed = mask_refinement.stored_rounds(out, small)
    if tracked is None:
        return None, capture
    cut = remove_background(trimmed, tracked)
    return working_size.enlarged(tracked, capture, small), working_size.with_masks(capture, small, cut)


def _own_cells(
    labels: UInt8[np.ndarray, "t h w"],
    surfaces: Sequence[_Surface],
    faces: Float[Tensor, "f 3"],
    cells: Float[Tensor, "n 3"],
) -> Float[Tensor, "m 3"]:
    """The cells of a hull in the convex hull of the surface that masks confirm; all if that leaves too few.

    Args:
        surfaces: What every frame shows of the hull's surface.
        faces: The cells of that surface.
    """
    from scipy.spatial import ConvexHull, KDTree, QhullError

    shown, hidden = np.zeros((2, len(faces)))
    for mask, surface in zip(labels, surfaces, strict=True):
        column, row = surface.column_row[surface.visible].T
        shown[surface.visible] += mask[row, column] == OBJECT
        hidden[surface.visible] += mask[row, column] == UNKNOWN
    known = shown + hidden >= MIN_FACED * len(labels)
    points, confirmed = faces.numpy()[known], (shown >= MIN_SHOWN * (shown + hidden))[known]
    near = KDTree(points).query_ball_point(points[confirmed], NEIGHBOURHOOD * SPACING)
    agreeing = np.array([confirmed[each].mean() > 0.5 for each in near], bool)
    try:
        planes = torch.from_numpy(ConvexHull(points[confirmed][agreeing]).equations)
    except (QhullError, ValueError):  # Nothing is confirmed, or only points in a plane.
        return cells
    own = (cells.double() @ planes[:, :3].T + planes[:, 3] <= SPACING).all(1)
    return cells[own] if own.double().mean() >= MIN_LEFT else cells


def _expected_colours(
    photos: Float32[np.ndarray, "t h w 3"],
    labels: UInt8[np.ndarray, "t h w"],
    surfaces: Sequence[_Surface],
    size: float,
) -> Float32[np.ndarray, "t h w 3"]:
    """Colours of the object in every frame, sRGB code values; not a number where they are unknown.

    The colour of a cell is the median over the frames that show it. Its shading is that of each frame: expected colours
    are multiplied by the smooth gain that fits them to the photo.
    """
    n = len(surfaces[0].visible)
    colours = np.full((len(photos), n, 3), np.nan, np.float32)
    for i, surface in enumerate(surfaces):
        column, row = surface.column_row[surface.visible].T
        sampled = photos[i][row, column]
        sampled[labels[i][row, column] != OBJECT] = np.nan
        colours[i, surface.visible] = sampled
    shown = (~np.isnan(colours[..., 0])).sum(0) >= MIN_FRAMES
    median = np.full((n, 3), np.nan, np.float32)
    median[shown] = np.nanmedian(colours[:, shown], 0)
    expected = []
    for photo, mask, surface in zip(photos, labels, surfaces, strict=True):
        colour = np.where(surface.nearest[..., None] >= 0, median[surface.nearest], np.float32(np.nan))
        fitted = np.where((mask == OBJECT)[..., None], np.nan_to_num(colour), np.float32(0))
        products = np.concatenate([fitted * photo, fitted * fitted], -1)
        whole = products[..., :3].sum((0, 1)) / products[..., 3:].sum((0, 1)).clip(1)
        local = cv2.GaussianBlur(products, (0, 0), SHADING_SIGMA * size)
        expected.append(colour * (local[..., :3] + whole) / (local[..., 3:] + 1))
    return np.stack(expected)


def _surface_cells(cells: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """The cells of a hull with an empty neighbour."""
    index = ((cells / EXTENT + 1) / 2 * RESOLUTION).floor().long() + 1
    full = torch.zeros((RESOLUTION + 2,) * 3, dtype=torch.bool)
    full[tuple(index.T)] = True
    steps = torch.cat([torch.eye(3, dtype=torch.long), -torch.eye(3, dtype=torch.long)])
    return cells[~full[tuple((index[:, None] + steps).permute(2, 0, 1))].all(1)]


def _surface(camera: Camera, cells: Float[Tensor, "n 3"]) -> _Surface:
    """What a frame shows of the hull's surface, from the centres of its cells in the camera frame."""
    column_row, depth = camera.project(cells).floor().long().numpy(), cells[:, 2].numpy()
    # Discs of cells are painted from far to near, large enough to leave no holes.
    radius = max(1, int(np.ceil(0.65 * float(camera.fx_fy_cx_cy[0]) * SPACING / depth.mean())))
    offsets = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 2), -1).reshape(-1, 2)
    offsets = offsets[(offsets**2).sum(1) <= radius**2]
    order = np.argsort(-depth)
    painted = (column_row[order, None] + offsets).reshape(-1, 2)
    inside = ((painted >= 0) & (painted < (camera.width, camera.height))).all(1)
    nearest = np.full((camera.height, camera.width), -1)
    nearest[painted[inside, 1], painted[inside, 0]] = np.repeat(order, len(offsets))[inside]
    visible = np.asarray(((column_row >= 0) & (column_row < (camera.width, camera.height))).all(1))
    column, row = column_row[visible].T
    visible[visible] = depth[visible] - depth[nearest[row, column]] < MAX_DEPTH_DIFFERENCE * SPACING
    return _Surface(column_row, visible, nearest)


def _background(
    photo: Float32[np.ndarray, "h w 3"],
    labels: UInt8[np.ndarray, "h w"],
    expected: Float32[np.ndarray, "h w 3"],
    size: float,
) -> Bool[np.ndarray, "h w"]:
    """Pixels that show background although the mask of the frame labels them as object.

    Args:
        expected: Colours of the object.
        size: Square root of the object's area [pixels].
    """
    from scipy.spatial import KDTree

    inside, outside = labels == OBJECT, labels == BACKGROUND
    distance = cv2.distanceTransform((~outside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)

    def found(image: np.ndarray, where: np.ndarray, reach: float, difference: float) -> np.ndarray:
        """Which pixels of the mask have, within a reach, a colour of the given pixels of an image."""
        source = np.hstack([np.argwhere(where) / (reach * size), image[where] / difference])
        mask = np.hstack([np.argwhere(inside) / (reach * size), photo[inside] / difference])
        return KDTree(source).query(mask, p=np.inf, distance_upper_bound=1)[0] <= 1

    object_like = found(expected, ~np.isnan(expected[..., 0]), MAX_SHIFT, MIN_DIFFERENCE)
    outside_like = found(photo, outside, SURROUNDINGS, MAX_DIFFERENCE)
    wrong = np.zeros(inside.shape, np.uint8)
    wrong[inside] = outside_like & ~object_like
    wrong = cv2.morphologyEx(wrong, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    count, ids = cv2.connectedComponents(wrong)
    area = np.bincount(ids.ravel(), minlength=count)
    adjoins = np.bincount(ids[distance <= MAX_GAP * size], minlength=count) > 0
    chosen = adjoins & (area >= MIN_AREA * size**2)
    chosen[0] = False
    return chosen[np.asarray(ids, np.int64)]
