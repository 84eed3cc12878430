"""From Gaussians to pictures: rasterizer, ray tracer, BRDF, deferred shading, relighting.

The only caller of `backends`. Knows no loss and no model.
"""

from tumble.backends import threads_for_kernels, usable_device
from tumble.rendering import relight
from tumble.rendering.gbuffer import antialiased, buffers_of
from tumble.rendering.prefiltered_light import Prefiltered, prefilter
from tumble.rendering.rasterizer import Buffers, rasterize
from tumble.rendering.shading import (
    AveragedBounce,
    Bounce,
    Surface,
    self_shadowed_irradiance,
    shade,
    shade_split,
    surface,
)
from tumble.rendering.trace import (
    Tracer,
    Visibility,
    build,
    displacement,
    surface_points,
    transfer,
    unoccluded,
    visibility,
)

__all__ = [
    "AveragedBounce",
    "Bounce",
    "Buffers",
    "Prefiltered",
    "Surface",
    "Tracer",
    "Visibility",
    "antialiased",
    "buffers_of",
    "build",
    "self_shadowed_irradiance",
    "displacement",
    "unoccluded",
    "prefilter",
    "rasterize",
    "relight",
    "shade",
    "shade_split",
    "surface",
    "surface_points",
    "threads_for_kernels",
    "transfer",
    "usable_device",
    "visibility",
]
