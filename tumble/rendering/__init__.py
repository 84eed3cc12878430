"""Rendering of Gaussians: rasterizer, ray tracer, BRDF, deferred shading and relighting.

It calls the rendering kernels of `backends`, and contains no losses and no training.
"""

from tumble.backends import threads_for_kernels, usable_device
from tumble.rendering import lit_frames, relight
from tumble.rendering.gbuffer import (
    antialiased_gbuffer,
    corner_features,
    rasterize_material,
    render_gbuffer,
    with_offset,
)
from tumble.rendering.prefiltered_light import Prefiltered, prefilter
from tumble.rendering.rasterizer import Buffers, rasterize
from tumble.rendering.shading import (
    AveragedBounce,
    Bounce,
    Surface,
    material_at,
    shade,
    shade_split,
    shading_light,
    split_lobes,
    surface,
)
from tumble.rendering.trace import (
    Tracer,
    Visibility,
    build_tracer,
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
    "antialiased_gbuffer",
    "build_tracer",
    "corner_features",
    "displacement",
    "lit_frames",
    "material_at",
    "prefilter",
    "rasterize",
    "rasterize_material",
    "relight",
    "render_gbuffer",
    "shade",
    "shade_split",
    "shading_light",
    "split_lobes",
    "surface",
    "surface_points",
    "threads_for_kernels",
    "transfer",
    "unoccluded",
    "usable_device",
    "visibility",
    "with_offset",
]
