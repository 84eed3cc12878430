"""Masks without what the shape of the object contradicts: an arm, a sleeve, a wall that moved with it for a while.

Such parts stand at another place of the object's frame as soon as the object is held in another way, so other frames
show background there. The visual hull by a vote of all frames lacks them, and its silhouettes trim the masks. Stage 1
is then repeated; the new result is kept only if it explains more.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tumble.engine import run
from tumble.maths import SE3
from tumble.poses import working_size
from tumble.poses.result import MAX_USABLE_UNCERTAINTY, PoseResult
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture

RESOLUTION = 96
"""Cells of the visual hull along each axis."""
EXTENT = 1.15
"""Half the side of the cube of cells [object radius]; the radius was estimated from untrimmed masks."""
MAX_BACKGROUND_FRACTION = 0.05
"""Maximum fraction of frames that show background at a cell of the hull; a wrong pose or mask does not carve."""
MARGIN = 0.03
"""Distance from the predicted silhouette up to which a pixel may show the object, as a fraction of its diameter."""
MIN_OVERLAP = 0.5
"""Minimum median overlap of silhouettes and hull; below it, poses and hull are too wrong to trim masks."""
MIN_TRIMMED = 0.01
"""Fraction of the masks' pixels that trimming has to remove for stage 1 to be repeated. Less is a fraction of a pixel
along the silhouettes, by which masks err anyway: 0.01 to 0.1 % where nothing touches the object, 2 to 45 % of hands."""
ROUNDS = 3
"""Maximum number of times that stage 1 is run."""
FEW_FRAMES = 0.05
"""Fraction of all frames by which one result may have more frames with a pose than another that is better."""


def folder(round: int) -> str:
    """Folder, in a run directory, of the poses of a round, counted from 1."""
    return run.TRACK if round == 1 else f"{run.TRACK}-{round}"


def stored_result(out: Path, capture: Capture) -> tuple[PoseResult | None, Capture]:
    """The poses of a run, None if there are none, and its capture with the masks from which they were estimated."""
    small = working_size.reduced(capture)
    best, trimmed = stored_rounds(out, small)
    return best and working_size.enlarged(best, capture, small), working_size.with_masks(capture, small, trimmed)


def stored_rounds(out: Path, capture: Capture) -> tuple[PoseResult | None, Capture]:
    """The same for the capture that was reduced to the size at which poses are estimated."""
    best = run.output(out, folder(1), PoseResult)
    for number in range(2, ROUNDS + 1):
        new = run.output(out, folder(number), PoseResult)
        if best is None or new is None or not explains_more(new, best):
            break
        if (trimmed := trimmed_further(capture, best)) is None:
            break
        capture, best = trimmed, new
    return best, capture


def trimmed_further(capture: Capture, result: PoseResult) -> Capture | None:
    """The capture with trimmed masks for another round; None if the masks are not doubtful, or change too little."""
    if not _can_be_trimmed(capture, result):
        return None
    trimmed = trim_masks(capture, result)
    before, after = (int((each.masks != BACKGROUND).sum()) for each in (capture, trimmed))
    return trimmed if before - after >= MIN_TRIMMED * before else None


def _can_be_trimmed(capture: Capture, result: PoseResult) -> bool:
    """Whether masks are doubtful, as they have unknown pixels and contradict each other, but the hull is usable."""
    quality = result.quality
    if quality.rating == "good" or not bool((capture.masks == UNKNOWN).any()):
        return False
    return not bool(quality.lost.all()) and float(quality.overlap[~quality.lost].median()) > MIN_OVERLAP


def trim_masks(capture: Capture, result: PoseResult) -> Capture:
    """The capture with trimmed masks; the frames without a pose stay as they are.

    Pixels outside the silhouette of the hull become background, and black as everywhere in a capture; those near its
    border that were object become unknown.
    """
    kept = torch.nonzero(~result.quality.lost)[:, 0].tolist()
    camera, T_cam_obj = result.camera, result.trajectory.T_cam_obj
    cells = hull_by_vote(replace(capture, camera=camera), T_cam_obj, kept)
    masks = capture.masks.clone()
    for k in kept:
        silhouette = silhouette_of(camera, T_cam_obj[k] @ cells)
        outside, labels = beyond(silhouette), masks[k].numpy()
        trimmed = np.where(outside, np.uint8(BACKGROUND), labels)
        trimmed[(labels == OBJECT) & ~outside & ~silhouette] = UNKNOWN
        masks[k] = torch.from_numpy(trimmed)
    return capture.with_masks(masks)


def explains_more(new: PoseResult, old: PoseResult) -> bool:
    """Whether poses from trimmed masks are better: by their rating, else by their accuracy if only one result is usable
    by that and has at least half as many frames as the other, else by the number of frames with a pose if that differs
    clearly, else by the number of matches that agree with them.

    A few frames do not count: better poses of all would be refused for the sake of a single one. Many do: where frames
    are lost, more frames are matched by a network, so that the others have more matches. Poses of less than half of the
    frames are rated bad, as inconsistent ones are, but give an asset of what these frames show.
    """
    order = ("bad", "warn", "good")
    ratings = [order.index(each.quality.rating) for each in (new, old)]
    if ratings[0] != ratings[1]:
        return ratings[0] > ratings[1]
    frames = [int((~each.quality.lost).sum()) for each in (new, old)]
    accurate = [each.quality.uncertainty <= MAX_USABLE_UNCERTAINTY for each in (new, old)]
    if accurate[0] != accurate[1] and 2 * frames[accurate.index(True)] >= frames[accurate.index(False)]:
        return accurate[0]
    if abs(frames[0] - frames[1]) > FEW_FRAMES * len(new.quality.lost):
        return frames[0] > frames[1]
    matches = [float(each.quality.inliers[~each.quality.lost].sum()) for each in (new, old)]
    return matches[0] > matches[1]


def hull_by_vote(capture: Capture, T_cam_obj: SE3, frames: list[int]) -> Float[Tensor, "n 3"]:
    """Centres of the cells at which few frames show background, object frame."""
    ticks = ((torch.arange(RESOLUTION) + 0.5) / RESOLUTION * 2 - 1) * EXTENT
    cells = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    size = torch.tensor([capture.camera.width, capture.camera.height])
    background, seen = torch.zeros(2, len(cells))
    for k in frames:
        uv = capture.camera.project(T_cam_obj[k] @ cells).floor().long()
        inside = ((uv >= 0) & (uv < size)).all(-1)
        column, row = uv.clamp(min=torch.zeros_like(size), max=size - 1).unbind(-1)
        background += inside & (capture.masks[k][row, column] == BACKGROUND)
        seen += inside
        left = background <= MAX_BACKGROUND_FRACTION * len(frames)  # the others have lost the vote already
        cells, background, seen = cells[left], background[left], seen[left]
    return cells[(seen > 0) & (background <= MAX_BACKGROUND_FRACTION * seen)]


def beyond(silhouette: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that lie clearly outside of a silhouette."""
    return ~_dilated(silhouette, max(2, round(MARGIN * float(np.sqrt(silhouette.sum())))))


def silhouette_of(camera: Camera, cells: Float[Tensor, "n 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that show cells of the hull, camera frame."""
    mask = np.zeros((camera.height, camera.width), np.uint8)
    if not len(cells):
        return mask > 0
    column, row = camera.project(cells).floor().long().numpy().T
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    mask[row[inside], column[inside]] = 1
    # Neighbouring cells are further apart than pixels where the object is large in the image.
    spacing = float(camera.fx_fy_cx_cy[0]) * 2 * EXTENT / RESOLUTION / float(cells[:, 2].mean())
    radius = max(1, int(np.ceil(spacing)))
    return cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(radius)) > 0


def _dilated(mask: Bool[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    return cv2.dilate(mask.astype(np.uint8), _disc(radius)) > 0


def _disc(radius: int) -> UInt8[np.ndarray, "i j"]:
    """A disc of ones."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
