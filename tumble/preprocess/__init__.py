"""From footage to a capture: frames are chosen, the object is cut out of them, the lens undone; `check` judges first.

A film, or a folder of pictures, becomes a capture without poses; pictures with a COLMAP model become one with poses.
"""

from typing import TYPE_CHECKING

from tumble._lazy import lazily

if TYPE_CHECKING:
    from tumble.preprocess.box_picker import picked
    from tumble.preprocess.check import check_footage, go
    from tumble.preprocess.options import FootageOptions
    from tumble.preprocess.source import FOOTAGE, kind_of, to_capture
    from tumble.preprocess.video_to_capture import PREVIEW, PROVENANCE, origin

__all__ = [
    "FOOTAGE",
    "FootageOptions",
    "PREVIEW",
    "PROVENANCE",
    "check_footage",
    "go",
    "kind_of",
    "origin",
    "picked",
    "to_capture",
]

__getattr__ = lazily(
    __name__,
    {
        "box_picker": ("picked",),
        "check": ("check_footage", "go"),
        "options": ("FootageOptions",),
        "source": ("FOOTAGE", "kind_of", "to_capture"),
        "video_to_capture": ("PREVIEW", "PROVENANCE", "origin"),
    },
)
