"""Rotations, their averages, rigid motions, directions on the sphere, harmonics, images, least squares, points.

Pure functions of tensors, without cameras, scenes or files.
"""

from tumble.maths import spherical_harmonics
from tumble.maths.directions import (
    GOLDEN_ANGLE,
    direction_from_equirect,
    equirect_from_direction,
    fibonacci_sphere,
    local_frame,
    random_rotation,
    reflect,
    texel_directions,
    texel_solid_angles,
)
from tumble.maths.entries import Index, entry
from tumble.maths.images import (
    Box,
    crop,
    crop_box,
    filled_hull,
    gaussian_blur,
    iou,
    linear_from_srgb,
    resize_area,
    resize_srgb8,
    srgb_from_linear,
    ssim,
    to_srgb8,
)
from tumble.maths.levenberg_marquardt import Damping, Linearised, minimise, select_rows
from tumble.maths.points import morton_order, nearest, neighbours, smallest_enclosing_sphere
from tumble.maths.rotation_averaging import average_rotations
from tumble.maths.se3 import SE3, SO3, angle_between, interpolate, mean_rotation, umeyama

__all__ = [
    "Box",
    "Damping",
    "GOLDEN_ANGLE",
    "Index",
    "Linearised",
    "SE3",
    "SO3",
    "angle_between",
    "average_rotations",
    "crop",
    "crop_box",
    "direction_from_equirect",
    "entry",
    "equirect_from_direction",
    "fibonacci_sphere",
    "filled_hull",
    "gaussian_blur",
    "interpolate",
    "iou",
    "linear_from_srgb",
    "local_frame",
    "mean_rotation",
    "minimise",
    "morton_order",
    "nearest",
    "neighbours",
    "to_srgb8",
    "random_rotation",
    "reflect",
    "resize_area",
    "resize_srgb8",
    "select_rows",
    "smallest_enclosing_sphere",
    "spherical_harmonics",
    "srgb_from_linear",
    "ssim",
    "texel_directions",
    "texel_solid_angles",
    "umeyama",
]
