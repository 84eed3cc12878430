"""Data types of the project: camera, trajectory, Gaussians, material, environment, capture, match, asset, visual hull.

They are frozen dataclasses of tensors; methods compute from the fields and never modify them.
"""

from tumble.scene import visual_hull
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera, undistortion
from tumble.scene.capture import (
    BACKGROUND,
    OBJECT,
    REGIONS,
    UNKNOWN,
    Benchmark,
    Capture,
    RelitViews,
    TargetView,
    Truth,
    Units,
    content_key,
    decode_mask,
    mask_from_alpha,
    target_view,
    truth_without_views,
)
from tumble.scene.environment import MIN_RADIANCE, Environment, bilinear
from tumble.scene.gaussians import Gaussians, constant_sh, opacity, quats_from_normals, sdf_from_opacity
from tumble.scene.match import Match, View, empty_match
from tumble.scene.material import DIELECTRIC, TEMPERATURE, Material
from tumble.scene.trajectory import Light, Trajectory, env_from_obj, opengl_from_opencv

__all__ = [
    "Asset",
    "BACKGROUND",
    "Benchmark",
    "Camera",
    "Capture",
    "DIELECTRIC",
    "Environment",
    "Gaussians",
    "Light",
    "Match",
    "MIN_RADIANCE",
    "Material",
    "OBJECT",
    "REGIONS",
    "RelitViews",
    "TEMPERATURE",
    "TargetView",
    "Trajectory",
    "Truth",
    "Units",
    "UNKNOWN",
    "View",
    "bilinear",
    "constant_sh",
    "content_key",
    "decode_mask",
    "env_from_obj",
    "quats_from_normals",
    "mask_from_alpha",
    "empty_match",
    "truth_without_views",
    "opacity",
    "opengl_from_opencv",
    "sdf_from_opacity",
    "target_view",
    "undistortion",
    "visual_hull",
]
