"""Images and masks of the virtual camera, and the difference of two trajectories."""

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from tumble.maths.images import linear_from_srgb, to_srgb8
from tumble.poses.progressive.virtual_camera import Aim, aim_to_camera
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND
from tumble.scene.trajectory import Trajectory


def warp_images(images: UInt8[Tensor, "t h w 3"], camera: Camera, aim: Aim) -> UInt8[Tensor, "t size size 3"]:
    """Images of the virtual camera, sRGB code values; black outside the true camera's frame.

    Linear light is averaged: bilinearly, over as many points per pixel as the virtual frame is coarser.
    """
    steps = max(1, math.ceil(float(camera.fx_fy_cx_cy[0] / aim.camera.fx_fy_cx_cy[0]) - 0.01))
    fine = aim.camera.resized(steps * aim.camera.height, steps * aim.camera.width)
    warped = []
    for frame, image in enumerate(images):
        at, within = _grid(Aim(aim.R_cam_aim, fine), camera, frame, images.device)
        linear = linear_from_srgb(image.permute(2, 0, 1)[None] / 255)
        light = functional.grid_sample(linear, at, padding_mode="border", align_corners=False) * within
        warped.append(to_srgb8(functional.avg_pool2d(light, steps)[0].permute(1, 2, 0)))
    return torch.stack(warped)


def warp_masks(masks: UInt8[Tensor, "t h w"], camera: Camera, aim: Aim) -> UInt8[Tensor, "t size size"]:
    """Masks of the virtual camera by nearest-neighbour sampling; BACKGROUND outside the true camera's frame."""
    warped = []
    for frame, mask in enumerate(masks):
        at, within = _grid(aim, camera, frame, masks.device)
        nearest = functional.grid_sample(
            mask[None, None].float(), at, mode="nearest", padding_mode="border", align_corners=False
        )
        warped.append(torch.where(within, nearest[0, 0], BACKGROUND).to(torch.uint8))
    return torch.stack(warped)


def _grid(aim: Aim, camera: Camera, frame: int, device: torch.device) -> tuple[Float[Tensor, "1 h w 2"], Tensor]:
    """Positions of the virtual pixels' centres in the frame, in units of grid_sample, and which are inside."""
    uv = aim_to_camera(aim, camera, frame, aim.camera.pixel_centers())
    at = (2 * uv / uv.new_tensor([camera.width, camera.height]) - 1).to(device)
    return at[None], (at.abs() <= 1).all(-1)


def disagreement(a: Trajectory, b: Trajectory) -> tuple[float, float]:
    """Largest difference of two trajectories in rotation [degrees] and translation [object radius]."""
    between = a.T_cam_obj.inverse() @ b.T_cam_obj
    angle = float(between.rotation.angle().max())
    return math.degrees(angle), float((a.T_cam_obj.xyz - b.T_cam_obj.xyz).norm(dim=-1).max())
