"""Symmetries of the object, and the rotations that silhouettes therefore do not show.

The silhouettes of a body of revolution (`mirror`) hide its rotation about the axis (`spin`), those of a box or a prism
hide the turns that leave the visual hull as it is (`turns`). Texture and colours show both, if there is enough of them
(`texture_information`). Points of the surface that all frames locate by their texture limit drift, and that all frames
agree about them tells how a body of revolution turns on a turntable (`texture_tracks`).
"""

from tumble.poses.sfm.symmetry import texture_information
from tumble.poses.sfm.symmetry.mirror import MirrorSymmetry, mirror_symmetry
from tumble.poses.sfm.symmetry.spin import (
    Spin,
    SurfaceOfRevolution,
    axis_deviation,
    estimate_spin,
    steady_observations,
    surface_of_revolution,
)
from tumble.poses.sfm.symmetry.texture_tracks import Agreement, texture_agreement, texture_tracks
from tumble.poses.sfm.symmetry.turns import Turns, estimate_turns

__all__ = [
    "Agreement",
    "MirrorSymmetry",
    "Spin",
    "SurfaceOfRevolution",
    "Turns",
    "axis_deviation",
    "estimate_spin",
    "estimate_turns",
    "mirror_symmetry",
    "steady_observations",
    "surface_of_revolution",
    "texture_agreement",
    "texture_information",
    "texture_tracks",
]
