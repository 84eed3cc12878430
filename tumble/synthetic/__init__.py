"""Synthetic captures with ground truth: a GLB model under an environment map in one of the three capture settings,
path traced by Mitsuba; on request held by a hand, before a background, and as a film."""

from typing import TYPE_CHECKING

from tumble._lazy import lazy_getattr

if TYPE_CHECKING:
    from tumble.synthetic.demo_object import room_environment, sunset_environment, write_pot
    from tumble.synthetic.glb_views import glb_images, glb_maps, read_glb
    from tumble.synthetic.options import SynthOptions
    from tumble.synthetic.pathtracer import MIN_LLVM, find_llvm
    from tumble.synthetic.synthesize import SETTINGS_FILE, render_capture, render_captures

__all__ = [
    "MIN_LLVM",
    "SETTINGS_FILE",
    "SynthOptions",
    "find_llvm",
    "glb_images",
    "glb_maps",
    "read_glb",
    "render_capture",
    "render_captures",
    "room_environment",
    "sunset_environment",
    "write_pot",
]

__getattr__ = lazy_getattr(
    __name__,
    {
        "demo_object": ("room_environment", "sunset_environment", "write_pot"),
        "glb_views": ("glb_images", "glb_maps", "read_glb"),
        "options": ("SynthOptions",),
        "pathtracer": ("MIN_LLVM", "find_llvm"),
        "synthesize": ("SETTINGS_FILE", "render_capture", "render_captures"),
    },
)
