"""From footage to a capture: frames are chosen, the object is cut out of them, the lens undone; `check` judges first.

A film, or a folder of pictures, becomes a capture without poses; pictures with a COLMAP model become one with poses.
"""

from typing import TYPE_CHECKING

from tumble._lazy import lazily

if TYPE_CHECKING:
    from tumble.preprocess.box_picker import pick_box
    from tumble.preprocess.check import check_footage, passes
    from tumble.preprocess.options import FootageOptions
    from tumble.preprocess.source import FOOTAGE, input_kind, to_capture
    from tumble.preprocess.video_to_capture import PREVIEW, PROVENANCE, origin

__all__ = [
    "FOOTAGE",
    "FootageOptions",
    "PREVIEW",
    "PROVENANCE",
    "check_footage",
    "passes",
    "input_kind",
    "origin",
    "pick_box",
    "to_capture",
]

__getattr__ = lazily(
    __name__,
    {
        "box_picker": ("pick_box",),
        "check": ("check_footage", "passes"),
        "options": ("FootageOptions",),
        "source": ("FOOTAGE", "input_kind", "to_capture"),
        "video_to_capture": ("PREVIEW", "PROVENANCE", "origin"),
    },
)
