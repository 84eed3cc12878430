"""`ingest.json`: the record of how a capture folder was made from footage (docs/format.md)."""

from pathlib import Path
from typing import Any

import msgspec

from tumble.io import files

PROVENANCE = "ingest.json"
"""File name, in a capture, of the record of how it was made."""


class SourceFrame(msgspec.Struct, frozen=True):
    """One frame of the capture."""

    name: str
    source_frame: int | None = None
    """Number of the frame in the video; None for images with a COLMAP model."""


class Provenance(msgspec.Struct, frozen=True):
    """The entries of `ingest.json` that are read again."""

    footage: str = ""
    """SHA-256 of the footage."""
    options: dict[str, Any] = {}
    """The `FootageOptions`, by name."""
    frames: tuple[SourceFrame, ...] = ()
    focal_source: str = ""
    window_top_left_height_width: tuple[float, float, float, float] | None = None
    """Crop window [pixels of the footage]; None for images with a COLMAP model."""


def read_provenance(capture: Path) -> Provenance | None:
    """The record in a capture folder; None if there is none.

    Raises:
        BadFile: The record is damaged.
    """
    path = capture / PROVENANCE
    return files.read_json(path, Provenance) if path.is_file() else None
