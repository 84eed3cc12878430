"""The kind of an input path (capture or footage), and the conversion of footage to a capture."""

from pathlib import Path
from typing import Literal

from tumble import datasets
from tumble.io import outputs
from tumble.preprocess import colmap
from tumble.preprocess.colmap_to_capture import capture_from_model
from tumble.preprocess.footage import IMAGE_SUFFIXES
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.video_to_capture import capture_from_video

SourceKind = Literal["capture", "posed images", "images", "video", "unknown"]
"""Kinds of input; see `input_kind`."""
FOOTAGE = ("posed images", "images", "video")
"""Kinds of input that must be converted to a capture."""


def input_kind(path: Path) -> SourceKind:
    """Kind of the input at a path.

    capture: a folder in a layout that `datasets` reads. posed images: images with a sparse COLMAP model. images: a
    folder of images, or one with a subfolder `images`. video: any file. unknown: anything else, or nothing.
    """
    if not path.is_dir():
        return "video" if path.is_file() else "unknown"
    if datasets.matching_layouts(path):
        return "capture"
    if colmap.recognises(path):
        return "posed images"
    inside = path / "images" if (path / "images").is_dir() else path
    return "images" if any(p.suffix.lower() in IMAGE_SUFFIXES for p in inside.iterdir()) else "unknown"


def to_capture(path: Path, out: Path, options: FootageOptions) -> Path:
    """Convert footage to a capture folder (docs/format.md), with poses if it has a COLMAP model; returns `out`.

    Raises:
        BadFile: The footage cannot be converted, or `out` lies in it or is not empty; nothing is written then.
    """
    outputs.require_outside(out, path)
    make = capture_from_model if input_kind(path) == "posed images" else capture_from_video
    return make(path, out, options)
