"""Captures with exact truth: any GLB under any light map in one of the three settings, path traced by Mitsuba."""

from typing import TYPE_CHECKING

from tumble._lazy import lazily

if TYPE_CHECKING:
    from tumble.synthetic.demo_object import environment, other_environment, write_object
    from tumble.synthetic.options import SynthOptions
    from tumble.synthetic.pathtracer import OLDEST_LLVM, find_llvm
    from tumble.synthetic.synthesize import SETTINGS_FILE, render_capture, render_captures

__all__ = [
    "SETTINGS_FILE",
    "OLDEST_LLVM",
    "SynthOptions",
    "environment",
    "find_llvm",
    "other_environment",
    "render_capture",
    "render_captures",
    "write_object",
]

__getattr__ = lazily(
    __name__,
    {
        "demo_object": ("environment", "other_environment", "write_object"),
        "options": ("SynthOptions",),
        "pathtracer": ("OLDEST_LLVM", "find_llvm"),
        "synthesize": ("SETTINGS_FILE", "render_capture", "render_captures"),
    },
)
