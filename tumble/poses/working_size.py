"""The images from which poses of an object that is hidden in part are estimated: smaller ones, if its capture is large.

Segments and their joints have limits in pixels, and contours of such films err by a pixel or two of the images on which
these were chosen. Stages 2 and 3 see the capture itself.
"""

from dataclasses import replace

import torch
from jaxtyping import Shaped, UInt8
from torch import Tensor
from torch.nn import functional

from tumble.maths import resize_area, resize_srgb8
from tumble.poses.result import PoseResult
from tumble.poses.sfm import is_hidden, without_doubt
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Capture

SIDE = 256
"""Longer side of these images [pixels]."""


def reduced(capture: Capture) -> Capture:
    """The capture from which poses are estimated: with smaller images if something hides a part of the object."""
    scale = SIDE / max(capture.camera.height, capture.camera.width)
    if scale >= 1:
        return capture
    h, w = (max(round(side * scale), 1) for side in (capture.camera.height, capture.camera.width))
    masks = _majority(capture.masks, h, w)
    if not is_hidden(masks):
        return capture
    full_images = None if capture.full_images is None else resize_srgb8(capture.full_images, h, w)
    # At the border of the object the mean of its own colours and black is darker than the photo.
    images = resize_srgb8(capture.images, h, w) if full_images is None else full_images
    camera = capture.camera.resized(h, w)
    small = replace(capture, images=images, masks=masks, camera=camera, full_images=full_images)
    settled = without_doubt(capture)
    # Doubted background stays known by its black image.
    return (small if settled is capture else small.with_masks(_majority(settled.masks, h, w))).with_masks(masks)


def enlarged(result: PoseResult, whole: Capture, small: Capture) -> PoseResult:
    """The result for a capture of which it has seen what `reduced` has made of it: with a camera of the capture's size.

    A focal length that was not estimated stays the same to the bit.
    """
    factor = float(result.camera.fx_fy_cx_cy[0] / small.camera.fx_fy_cx_cy[0])
    return replace(result, camera=whole.camera.zoomed(factor))


def with_masks(whole: Capture, small: Capture, masked: Capture) -> Capture:
    """A capture with the masks that smaller images of it have got.

    Args:
        small: What `reduced` has made of the capture.
        masked: The same with other masks; what these leave as it was stays as it is in the capture.
    """
    if small is whole:
        return masked
    height, width = whole.camera.height, whole.camera.width
    changed, new = (_at_nearest(x, height, width) for x in (masked.masks != small.masks, masked.masks))
    full_images = None if masked.full_images is None else whole.full_images
    return replace(whole, full_images=full_images).with_masks(torch.where(changed, new, whole.masks))


def _majority(masks: UInt8[Tensor, "t i j"], h: int, w: int) -> UInt8[Tensor, "t {h} {w}"]:
    """The masks with the value of most of what a pixel covers."""
    values = torch.tensor([BACKGROUND, OBJECT, UNKNOWN], dtype=masks.dtype)
    shares = (resize_area((mask[..., None] == values).float(), h, w) for mask in masks)
    return torch.stack([values[each.argmax(-1)] for each in shares])


def _at_nearest(x: Shaped[Tensor, "t h w"], height: int, width: int) -> Shaped[Tensor, "t {height} {width}"]:
    """Every value at all pixels that lie in its own."""
    return functional.interpolate(x[:, None].float(), (height, width), mode="nearest-exact")[:, 0].to(x.dtype)
