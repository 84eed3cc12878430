"""How footage becomes a capture: the options of `tumble check` and `tumble run`. Loads nothing, for `--help`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SURVEYED = 400
"""Frames that the survey keeps at most: every second, every fourth, ... of a longer film."""
LEAST_SIDE = 64
"""Smaller footage shows nothing to reconstruct [pixels]."""
LEAST_FRAMES = 3
"""A capture has at least this many."""


@dataclass(frozen=True)
class FootageOptions:
    """How footage becomes a capture."""

    box: tuple[int, int, int, int] | None = None
    """Left, top, width, height around the object on frame `at` [pixels]. Left out: what moves and is no skin."""
    click: tuple[int, int] | None = None
    """A pixel on the object on frame `at`, instead of a box: column, row."""
    at: int = 0
    """The frame that box or click are on, counted from 0."""
    masks: Path | None = None
    """Folder of masks: white object, black background, grey unknown; one per frame, in order or by name."""
    invert_masks: bool = False
    """The masks' object is black."""
    segmenter: Literal["grabcut", "sam2", "sam3"] = "grabcut"
    """Who makes masks when none are given; sam2 and sam3 are your own installation, with `weights`."""
    weights: Path | None = None
    """Checkpoint of sam2 or sam3."""
    focal: float | None = None
    """Focal length in pixels of the film. Left out: from `fov`, else the metadata, else found with the poses, from a
    guess (a phone's 28 mm)."""
    fov: float | None = None
    """Horizontal field of view [degrees]."""
    fisheye: tuple[float, float, float, float] | None = None
    """A fisheye lens: OpenCV's k1 k2 k3 k4, zeros for the ideal one."""
    distortion: tuple[float, ...] | None = None
    """A normal lens that bends lines: OpenCV's k1 k2 p1 p2 [k3]."""
    light: Literal["object", "camera"] = "object"
    """Pictures with poses by COLMAP: what the light stood still with. object: the camera went round the object; camera:
    the object turned, and the background was masked. (A film's light always stands still with the camera.)"""
    frames: int = 144
    """Frames to keep at most."""
    size: int = 256
    """Longer side of the frames to write [pixels]; never more than the film has."""

    def __post_init__(self) -> None:
        if self.box is not None and self.click is not None:
            raise ValueError("--box and --click are two ways to say the same: give one")
        if self.box is not None and min(self.box[2:]) < 2:
            raise ValueError(f"--box is left, top, width, height; this one is {self.box[2]} x {self.box[3]}")
        if self.segmenter != "grabcut" and self.weights is None:
            raise ValueError(f"--segmenter {self.segmenter} needs --weights, the path of its checkpoint")
        if not LEAST_FRAMES <= self.frames <= SURVEYED or not LEAST_SIDE <= self.size <= 4096:
            raise ValueError(f"--frames is {LEAST_FRAMES} to {SURVEYED}, --size {LEAST_SIDE} to 4096")
