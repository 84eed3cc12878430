"""What a path is that somebody wants reconstructed, asked in this one place, and the capture that it becomes."""

from pathlib import Path
from typing import Literal

from tumble import datasets
from tumble.preprocess import colmap
from tumble.preprocess.colmap_to_capture import capture_from_model
from tumble.preprocess.footage import PICTURES
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.video_to_capture import capture_from_video

SourceKind = Literal["capture", "posed pictures", "pictures", "film", "unknown"]
FOOTAGE = ("posed pictures", "pictures", "film")
"""What has to become a capture first."""


def input_kind(path: Path) -> SourceKind:
    """What lies at a path.

    capture: a folder of a layout that `datasets` reads. posed pictures: pictures with a sparse COLMAP model.
    pictures: a folder of pictures, or one with a subfolder `images`. film: any file. unknown: anything else, or
    nothing.
    """
    if not path.is_dir():
        return "film" if path.is_file() else "unknown"
    if datasets.layouts(path):
        return "capture"
    if colmap.recognises(path):
        return "posed pictures"
    inside = path / "images" if (path / "images").is_dir() else path
    return "pictures" if any(p.suffix.lower() in PICTURES for p in inside.iterdir()) else "unknown"


def to_capture(path: Path, out: Path, options: FootageOptions) -> Path:
    """A capture folder (docs/format.md) from footage, with poses where it has a COLMAP model; returns `out`.

    Raises:
        BadFile: The footage cannot become a capture, or `out` is there already; nothing is written then.
    """
    make = capture_from_model if input_kind(path) == "posed pictures" else capture_from_video
    return make(path, out, options)
