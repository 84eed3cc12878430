"""A camera that turns about its own centre to keep looking at the object, so that two unknowns fall away.

The *aim* frame shares its origin with `cam`; its z axis points at the middle of the silhouette's bounding box. Turning
a pinhole camera about its centre is an exact homography, `K_aim R_aim_cam K^-1`, whatever the depth:
nothing is approximated, unlike by a shift of the picture, and the way back is as exact. With poses found in the aim
frame, those of the camera follow in closed form, translation included: `T_cam_obj = R_cam_aim @ T_aim_obj`.

In the aim frame neither the object nor the light of a still camera stands still: shade in `cam`, only track in here.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from tumble.maths.images import linear_from_srgb, photograph
from tumble.maths.se3 import SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT

FILL = 0.8
"""Part of the virtual frame that the largest silhouette takes: room for what its bounding box cuts off-centre."""


@dataclass(frozen=True)
class Aim:
    """Where the virtual camera looks in every frame, and its lens, the same for all: sizes stay comparable."""

    R_cam_aim: SO3
    """One per frame: the shortest turn from the camera's axis to the middle of the silhouette."""
    camera: Camera
    """Square, centred."""

    def __len__(self) -> int:
        return self.R_cam_aim.wxyz.shape[0]


def aim_at(masks: UInt8[Tensor, "t h w"], camera: Camera, *, size: int, fill: float = FILL) -> Aim:
    """Aim at the silhouettes of a capture.

    A frame without a sure object pixel keeps the aim of the closest frame that has one.

    Args:
        masks: OBJECT, UNKNOWN or BACKGROUND; only what is surely object is aimed at.
        camera: That of the frames.
        size: Height and width of the virtual frames [pixels].
        fill: Part of the virtual frame's width or height that the largest silhouette takes.

    Raises:
        ValueError: No frame shows the object.
    """
    seen = [i for i, mask in enumerate(masks) if bool((mask == OBJECT).any())]
    if not seen:
        raise ValueError("no mask has an object pixel: nothing to aim the virtual camera at")
    lens = camera.fx_fy_cx_cy
    centres, reach = [], 0.0
    for mask in masks[seen]:
        pixels = torch.nonzero(mask == OBJECT).flip(-1).to(lens)
        middle = (pixels.amin(0) + pixels.amax(0) + 1) / 2
        centres.append(camera.unproject(middle, torch.ones_like(middle[0])))
        corners = pixels[:, None] + lens.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
        x_aim = _turn(centres[-1]).inverse() @ camera.unproject(corners, torch.ones_like(corners[..., 0]))
        reach = max(reach, float((x_aim[..., :2] / x_aim[..., 2:]).abs().max()))
    closest = [min(range(len(seen)), key=lambda k: abs(seen[k] - i)) for i in range(len(masks))]
    focal = 0.5 * size * fill / reach
    virtual = Camera(lens.new_tensor([focal, focal, size / 2, size / 2]), size, size)
    return Aim(_turn(torch.stack([centres[k] for k in closest])), virtual)


def into_aim(aim: Aim, camera: Camera, frame: int, uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Where the virtual camera sees what `camera` sees at `uv` in a frame [pixels]; exact, differentiable."""
    return aim.camera.project(aim.R_cam_aim[frame].inverse() @ camera.unproject(uv, torch.ones_like(uv[..., 0])))


def out_of_aim(aim: Aim, camera: Camera, frame: int, uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Where `camera` sees what the virtual camera sees at `uv` in a frame [pixels]; the inverse of `into_aim`."""
    return camera.project(aim.R_cam_aim[frame] @ aim.camera.unproject(uv, torch.ones_like(uv[..., 0])))


def warp_images(images: UInt8[Tensor, "t h w 3"], camera: Camera, aim: Aim) -> UInt8[Tensor, "t size size 3"]:
    """The virtual camera's photographs, sRGB code values over black; black where the camera did not look.

    Light is averaged, not code values: bilinear, over as many points per pixel as the virtual frame is coarser.
    """
    steps = max(1, math.ceil(float(camera.fx_fy_cx_cy[0] / aim.camera.fx_fy_cx_cy[0]) - 0.01))
    fine = aim.camera.resized(steps * aim.camera.height, steps * aim.camera.width)
    warped = []
    for frame, image in enumerate(images):
        at, within = _grid(Aim(aim.R_cam_aim, fine), camera, frame, images.device)
        linear = linear_from_srgb(image.permute(2, 0, 1)[None] / 255)
        light = functional.grid_sample(linear, at, padding_mode="border", align_corners=False) * within
        warped.append(photograph(functional.avg_pool2d(light, steps)[0].permute(1, 2, 0)))
    return torch.stack(warped)


def warp_masks(masks: UInt8[Tensor, "t h w"], camera: Camera, aim: Aim) -> UInt8[Tensor, "t size size"]:
    """The virtual camera's masks by the nearest pixel, so of the same three values; BACKGROUND off the frame."""
    warped = []
    for frame, mask in enumerate(masks):
        at, within = _grid(aim, camera, frame, masks.device)
        nearest = functional.grid_sample(
            mask[None, None].float(), at, mode="nearest", padding_mode="border", align_corners=False
        )
        warped.append(torch.where(within, nearest[0, 0], BACKGROUND).to(torch.uint8))
    return torch.stack(warped)


def _turn(toward: Float[Tensor, "*b 3"]) -> SO3:
    """The shortest rotation that takes the z axis to directions in front of it."""
    x, y, z = functional.normalize(toward, dim=-1).unbind(-1)
    return SO3.from_wxyz(torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1))


def _grid(aim: Aim, camera: Camera, frame: int, device: torch.device) -> tuple[Float[Tensor, "1 h w 2"], Tensor]:
    """Where the centres of the virtual pixels lie in the frame, in grid_sample's units, and whether they do."""
    uv = out_of_aim(aim, camera, frame, aim.camera.pixel_centers())
    at = (2 * uv / uv.new_tensor([camera.width, camera.height]) - 1).to(device)
    return at[None], (at.abs() <= 1).all(-1)
