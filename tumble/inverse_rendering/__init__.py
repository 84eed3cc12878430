"""Stages 2 and 3: Gaussians, poses and a coarse light from the frames; then albedo, roughness and the light.

With their losses, densification, and the baseline that needs no inverse rendering.
"""

from tumble.inverse_rendering import decompose, densify, losses, mean_colour_baseline, refine, sh_lighting, specular_fit
from tumble.inverse_rendering.refine import Refined

__all__ = [
    "Refined",
    "decompose",
    "densify",
    "losses",
    "mean_colour_baseline",
    "refine",
    "sh_lighting",
    "specular_fit",
]
