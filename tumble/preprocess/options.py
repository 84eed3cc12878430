"""Options of `tumble check` and `tumble run` for converting footage to a capture.

The docstrings of the fields are the help texts of the command line; each line of a docstring is a line there. The
module imports nothing heavy, so that `--help` is fast.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Suppress, UseAppendAction, arg

MAX_SURVEY_FRAMES = 400
"""Maximum number of frames that the survey keeps; of a longer video every second, every fourth, ... frame is kept."""
MIN_SIDE = 64
"""Minimum of width and height of footage, and minimum of `--size` [pixels]."""
MIN_FRAMES = 3
"""Minimum number of frames of a capture."""
MARKS = ("box", "click", "object", "not_object")
"""Options that mark the object, where its masks are found."""

Quality = Literal["draft", "standard", "full", "paper"]
"""Values of `--quality`, which `recipes.QUALITIES` maps to recipes."""
FRAMES_AND_SIZE: dict[Quality, tuple[int, int]] = {
    "draft": (144, 256),
    "standard": (200, 512),
    "full": (400, 800),
    "paper": (400, 800),
}
"""Per quality, the maximum number of frames of a capture made from footage, and the `size` of its images [pixels].
The paper's captures have 400 frames (its appendix B); it prints no size, and 800 pixels are TensoIR's."""

Clicks = Annotated[
    UseAppendAction[tuple[tuple[int, int, int], ...]], arg(metavar="X Y FRAME", help_behavior_hint="(repeatable)")
]
"""Column and row of pixels [pixels], each with the number of its frame."""


@dataclass(frozen=True)
class FootageOptions:
    """How a video or images are converted to a capture."""

    box: Annotated[tuple[int, int, int, int] | None, arg(metavar="X Y WIDTH HEIGHT", help_behavior_hint="")] = None
    """Box around the object on frame `--at`: left, top, width, height [pixels]. Default: found by its motion."""
    click: Annotated[tuple[int, int] | None, arg(metavar="X Y", help_behavior_hint="")] = None
    """A pixel on the object on frame `--at`, in place of a box: column, row [pixels]."""
    at: int = 0
    """Number of the frame to which the box or the click refers, counted from 0."""
    part: Annotated[tuple[int, int] | None, arg(metavar="FIRST LAST", help_behavior_hint="")] = None
    """Numbers of the first and the last frame that are used, counted from 0. Default: all frames. `--at` and clicks
    still count from the beginning."""
    object: Clicks = ()
    """A pixel on the object where the mask lacks it: column, row [pixels], frame. The mask is cut again there."""
    not_object: Clicks = ()
    """A pixel on something else that the mask contains, such as a hand: column, row [pixels], frame."""
    masks: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of mask images, one per frame in order or by name: white object, black background, grey unknown."""
    invert_masks: bool = False
    """Invert the masks: black object, white background."""
    segmenter: Literal["grabcut", "sam2", "sam3"] = "grabcut"
    """Segmentation method if there are no masks. sam2, sam3: packages that you install; they need `--weights`."""
    weights: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Checkpoint file of sam2 or sam3."""
    focal: Annotated[float | None, arg(metavar="PIXELS", help_behavior_hint="")] = None
    """Focal length [pixels of the video]. Default: from `--fov` or the metadata, else estimated, starting at 28 mm."""
    fov: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="")] = None
    """Horizontal field of view of the video [degrees]; an alternative to `--focal`."""
    fisheye: Annotated[tuple[float, float, float, float] | None, arg(metavar="K1 K2 K3 K4", help_behavior_hint="")] = (
        None
    )
    """Fisheye lens: OpenCV's coefficients; four zeros are an ideal equidistant lens."""
    distortion: Annotated[tuple[float, ...] | None, arg(metavar="K1 K2 P1 P2 [K3]", help_behavior_hint="")] = None
    """Lens distortion, if the lens is not a fisheye: OpenCV's coefficients."""
    light: Literal["object", "camera"] = "object"
    """Only for images with a COLMAP model: what the light was fixed to.
    object: the camera moved around the object.
    camera: the object was turned in front of the camera, and the background was masked. (Videos: always the camera.)"""
    frames: Suppress[int] = 144
    """Maximum number of frames in the capture. The default is that of the quality "draft", see `at_quality`."""
    size: Suppress[int] = 256
    """Longer side of a window around the object in the capture's images [pixels]. Where the object moves about, the
    images are up to twice as large, but never larger than in the video. Default: as for frames."""

    @property
    def first(self) -> int:
        """Number of the first frame that is used."""
        return self.part[0] if self.part else 0

    @property
    def marks(self) -> list[str]:
        """The given options that mark the object: a box or a click, and clicks that correct the masks."""
        return [f"--{name.replace('_', '-')}" for name in MARKS if getattr(self, name)]

    def __post_init__(self) -> None:
        if self.box is not None and self.click is not None:
            raise ValueError("--box and --click both mark the object: give only one of them")
        if self.marks and self.masks is not None:
            marks = "--box, --click, --object and --not-object"
            raise ValueError(f"{marks} are for masks that are found: leave them out, or --masks")
        if self.box is not None and min(self.box[2:]) < 2:
            raise ValueError(
                f"--box is left, top, width, height, at least 2 x 2 pixels; this one is {self.box[2]} x {self.box[3]}"
            )
        if self.part is not None and not 0 <= self.part[0] < self.part[1]:
            raise ValueError(f"--part is the first and the last frame, in this order; these are {self.part}")
        if self.segmenter != "grabcut" and self.weights is None:
            raise ValueError(f"--segmenter {self.segmenter} needs --weights, the path of its checkpoint file")
        if not MIN_FRAMES <= self.frames <= MAX_SURVEY_FRAMES or not MIN_SIDE <= self.size <= 4096:
            raise ValueError(f"--frames must be {MIN_FRAMES} to {MAX_SURVEY_FRAMES}, and --size {MIN_SIDE} to 4096")


def at_quality(options: FootageOptions, quality: Quality, *, frames: int | None, size: int | None) -> FootageOptions:
    """The options with the number of frames and the size of images that a quality asks for.

    Args:
        frames: Maximum number of frames instead of the quality's; None for the quality's.
        size: Size of the images instead of the quality's [pixels]; None for the quality's.

    Raises:
        ValueError: A number is out of range.
    """
    usual_frames, usual_size = FRAMES_AND_SIZE[quality]
    return replace(
        options, frames=usual_frames if frames is None else frames, size=usual_size if size is None else size
    )
