"""The frames whose masks or poses are worst, with reasons and pictures.

All frames of the capture are considered, also those without a pose, which the reconstruction leaves out. A picture
shows the photo with two contours: the mask, and, if the frame has a pose, the silhouette of the reconstruction. Where a
later round of stage 1 trimmed the mask, there is a picture of the mask before, too.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from torch import Tensor

from tumble.maths import Box, crop
from tumble.report.training_views import RenderedFrame, window
from tumble.scene import BACKGROUND, OBJECT, Capture

N_WORST = 8
"""Maximum number of frames on the page."""
N_LOST = 3
"""Maximum number of frames on the page that only lack a pose; there may be many."""
SPACING = 0.04
"""Minimum distance of two frames on the page, as a fraction of the number of frames; neighbours mostly have the same
fault."""
MIN_IOU = 0.9
"""IoU of mask and rendered silhouette below which a frame is suspicious."""
MAX_HAND_COLOURED = 0.08
"""Fraction of a mask with the colours of a hand above which a frame is suspicious."""
AREA_NEIGHBOURS = 2
"""Number of frames before and after one with whose masks its area is compared."""
MAX_AREA_CHANGE = 1.8
"""Ratio of the area of a mask to all of its neighbours above which, or below the inverse of which, it jumps; a flat
object that turns changes its area between selected frames."""
LOST_SEVERITY = 0.5
"""Severity of a frame without a pose, as compared with 1 - IoU."""
MIN_TRIMMED = 0.01
"""Fraction of the mask that differs before the rounds, above which the page shows it."""
PICTURE_SIDE = 256
"""Longer side of a picture [pixels]."""
MASK_COLOUR = (255, 255, 255)
"""Colour of the contour of the mask, sRGB."""
SILHOUETTE_COLOUR = (255, 140, 0)
"""Colour of the contour of the rendered silhouette, sRGB."""


@dataclass(frozen=True)
class AllFrames:
    """All frames of the capture of a run, also those without a pose."""

    before: Capture
    """With the masks of the capture."""
    after: Capture
    """With the masks of the last round of stage 1."""
    hand_coloured: Mapping[str, float] = field(default_factory=dict)
    """Fraction of the mask with the colours of the hands, by the name of the frame."""


@dataclass(frozen=True)
class WorstFrame:
    """A frame on the page."""

    name: str
    reasons: tuple[str, ...]
    pictures: tuple[tuple[str, UInt8[np.ndarray, "h w 3"]], ...]
    """Titles and pictures."""


def worst_frames(capture: AllFrames, rendered: Sequence[RenderedFrame]) -> list[WorstFrame]:
    """The worst frames in order of decreasing severity; empty if none is suspicious.

    Args:
        rendered: Renders of the frames that have a pose, in windows around the masks after the rounds.
    """
    with_pose = {frame.name: frame for frame in rendered}
    names = capture.before.names
    faults = [_faults(capture, i, with_pose.get(name)) for i, name in enumerate(names)]
    severity = [sum(fault.values()) for fault in faults]
    only_lost = [name not in with_pose and len(fault) == 1 for name, fault in zip(names, faults, strict=True)]
    chosen: list[int] = []
    for i in sorted(range(len(names)), key=lambda i: -severity[i]):
        apart = all(abs(i - j) > SPACING * len(names) for j in chosen)
        enough = len(chosen) >= N_WORST or (only_lost[i] and sum(only_lost[j] for j in chosen) >= N_LOST)
        if severity[i] > 0 and apart and not enough:
            chosen.append(i)
    return [
        WorstFrame(names[i], tuple(faults[i]), tuple(_pictures(capture, i, with_pose.get(names[i])))) for i in chosen
    ]


def _faults(capture: AllFrames, i: int, rendered: RenderedFrame | None) -> dict[str, float]:
    """What is suspicious about a frame, in words, and how severe it is."""
    faults = {}
    if rendered is None:
        faults["no pose was found; the frame was left out"] = LOST_SEVERITY
    elif rendered.iou < MIN_IOU:
        faults[f"mask and reconstruction overlap by {rendered.iou:.0%} only"] = 1 - rendered.iou
    hand = capture.hand_coloured.get(capture.before.names[i], 0.0)
    if hand > MAX_HAND_COLOURED:
        faults[f"{hand:.0%} of the mask has the colours of the hand"] = 2 * hand
    area, *around = (int((capture.after.masks[j] == OBJECT).sum()) for j in (i, *_neighbours(i, len(capture.after))))
    if around and area > 0:
        ratio = area / max(statistics.median(around), 1)
        jumps = area > MAX_AREA_CHANGE * max(around) or area * MAX_AREA_CHANGE < min(around)
        if jumps:
            faults[f"{ratio:.1f} times the area of the frames around it"] = abs(math.log(ratio)) / 2
    return faults


def _neighbours(i: int, n: int) -> list[int]:
    return [j for j in range(max(i - AREA_NEIGHBOURS, 0), min(i + AREA_NEIGHBOURS + 1, n)) if j != i]


def _pictures(capture: AllFrames, i: int, rendered: RenderedFrame | None) -> list[tuple[str, np.ndarray]]:
    """Pictures of a frame: with the mask before the rounds, if that differs, and with the last one."""
    before, after = (each.masks[i] for each in (capture.before, capture.after))
    inside = after == OBJECT if rendered is not None or (after == OBJECT).any() else before != BACKGROUND
    box = window(inside)
    silhouette = None if rendered is None else rendered.silhouette
    photo = capture.before.images[i]
    changed = float((before != after).sum()) / max(float((before == OBJECT).sum()), 1)
    pictures = [("mask", _picture(photo, after == OBJECT, silhouette, box))]
    if changed > MIN_TRIMMED:
        pictures = [("mask before", _picture(photo, before == OBJECT, None, box)), ("mask after", pictures[0][1])]
    return pictures


def _picture(photo: Tensor, mask: Tensor, silhouette: Tensor | None, box: Box) -> UInt8[np.ndarray, "h w 3"]:
    """A window of a photo with the contours of mask and silhouette."""
    image = crop(photo, box).cpu().numpy()
    scale = PICTURE_SIDE / max(image.shape[:2])
    size = max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0]))
    picture = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))
    if silhouette is not None:
        _outline(picture, silhouette.cpu().numpy(), SILHOUETTE_COLOUR)
    _outline(picture, crop(mask, box).cpu().numpy(), MASK_COLOUR)
    return picture


def _outline(picture: np.ndarray, mask: Bool[np.ndarray, "h w"], colour: tuple[int, int, int]) -> None:
    """Draw the contour of a mask of any size onto a picture."""
    large = cv2.resize(mask.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(large, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, 1)
