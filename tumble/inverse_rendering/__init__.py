"""Inverse rendering: stage 2 (`refine`) and stage 3 (`decompose`) with their losses and densification.

`refine` optimises Gaussians, poses and a low-order light; `decompose` then optimises albedo, roughness and an
environment map. `absolute_colour` then estimates the factor per channel that pictures leave open between albedo and
light, and `albedo_solve` finds the albedo that explains the photographs with it. `mean_colour_baseline` takes the place
of stage 3 as a baseline without inverse rendering, `separate_lights` as one that does not know how the light moves.
"""

from tumble.inverse_rendering import (
    absolute_colour,
    albedo_solve,
    decompose,
    densify,
    losses,
    mean_colour_baseline,
    refine,
    separate_lights,
    sh_lighting,
    specular_fit,
)
from tumble.inverse_rendering.refine import Refined

__all__ = [
    "Refined",
    "absolute_colour",
    "albedo_solve",
    "decompose",
    "densify",
    "losses",
    "mean_colour_baseline",
    "refine",
    "separate_lights",
    "sh_lighting",
    "specular_fit",
]
