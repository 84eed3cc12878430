"""Conversion of footage to a capture: frames are selected, segmented and undistorted; `check_footage` assesses footage.

A video or a folder of images becomes a capture without poses; images with a COLMAP model become one with poses.
"""

from typing import TYPE_CHECKING

from tumble._lazy import lazy_getattr

if TYPE_CHECKING:
    from tumble.preprocess.check import check_footage, passes
    from tumble.preprocess.footage import PROVENANCE, read_provenance
    from tumble.preprocess.options import FootageOptions, Quality, at_quality
    from tumble.preprocess.picker import pick_box
    from tumble.preprocess.source import FOOTAGE, input_kind, to_capture
    from tumble.preprocess.survey import Survey, survey_footage
    from tumble.preprocess.video_to_capture import PREVIEW, footage_fingerprint

__all__ = [
    "FOOTAGE",
    "FootageOptions",
    "PREVIEW",
    "PROVENANCE",
    "Quality",
    "Survey",
    "at_quality",
    "check_footage",
    "passes",
    "input_kind",
    "footage_fingerprint",
    "pick_box",
    "read_provenance",
    "survey_footage",
    "to_capture",
]

__getattr__ = lazy_getattr(
    __name__,
    {
        "picker": ("pick_box",),
        "check": ("check_footage", "passes"),
        "options": ("FootageOptions", "Quality", "at_quality"),
        "source": ("FOOTAGE", "input_kind", "to_capture"),
        "survey": ("Survey", "survey_footage"),
        "footage": ("PROVENANCE", "read_provenance"),
        "video_to_capture": ("PREVIEW", "footage_fingerprint"),
    },
)
