"""What all rooms speak of: camera, trajectory, Gaussians, material, environment, capture, match, asset, visual hull.

Frozen dataclasses of tensors; a method computes from them and never writes to them.
"""

from tumble.scene import visual_hull
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera, undistortion
from tumble.scene.capture import (
    BACKGROUND,
    OBJECT,
    REGIONS,
    UNITS,
    UNKNOWN,
    Capture,
    TargetView,
    Truth,
    content_key,
    decoded_mask,
    mask_from_alpha,
    no_views,
    target_view,
)
from tumble.scene.environment import Environment, bilinear
from tumble.scene.gaussians import Gaussians, constant_sh, facing, opacity, sdf_from_opacity
from tumble.scene.match import Match, View, no_match
from tumble.scene.material import DIELECTRIC, TEMPERATURE, Material
from tumble.scene.trajectory import LIGHTS, Light, Trajectory, env_from_obj, opengl_from_opencv

__all__ = [
    "Asset",
    "BACKGROUND",
    "Camera",
    "Capture",
    "DIELECTRIC",
    "Environment",
    "Gaussians",
    "LIGHTS",
    "Light",
    "Match",
    "Material",
    "OBJECT",
    "REGIONS",
    "TEMPERATURE",
    "TargetView",
    "Trajectory",
    "Truth",
    "UNITS",
    "UNKNOWN",
    "View",
    "bilinear",
    "constant_sh",
    "content_key",
    "decoded_mask",
    "env_from_obj",
    "facing",
    "mask_from_alpha",
    "no_match",
    "no_views",
    "opacity",
    "opengl_from_opencv",
    "sdf_from_opacity",
    "target_view",
    "undistortion",
    "visual_hull",
]
