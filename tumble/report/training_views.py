"""The training frames rendered again from the finished asset, each in a window around the object.

Photograph and render of a frame are compared in that window alone: what lies outside is black in both.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.evaluation import metrics
from tumble.maths import Box, crop, crop_box, fibonacci_sphere, linear_from_srgb, resize_area, srgb_from_linear
from tumble.rendering import (
    Buffers,
    Prefiltered,
    Tracer,
    antialiased,
    build,
    prefilter,
    shade_split,
    surface,
    visibility,
)
from tumble.scene import OBJECT, UNKNOWN, Asset, Camera, Capture, env_from_obj

SIDE = 256
"""Longer side of a window, at most [pixels]: enough for a page, and for numbers of a whole frame."""
DIRECTIONS = 256
SOLID = 0.5
"""Coverage from which a pixel counts as object."""


@dataclass(frozen=True)
class RenderedFrame:
    """One training frame and what the asset says of it, in one window."""

    number: int
    name: str
    camera: Camera
    """That sees the window, at the photograph's resolution."""
    photograph: Float[Tensor, "h w 3"]
    """sRGB in [0, 1]."""
    mask: Bool[Tensor, "h w"]
    counted: Bool[Tensor, "h w"]
    """Pixels whose mask is known."""
    rendered: Float[Tensor, "h w 3"]
    """sRGB in [0, 1], over black."""
    alpha: Float[Tensor, "h w"]
    """Coverage by the asset."""

    @property
    def solid(self) -> Bool[Tensor, "h w"]:
        """Pixels that the asset covers."""
        return self.alpha >= SOLID

    @property
    def psnr(self) -> float:
        """Of the object's pixels [dB]; NaN where the mask shows none."""
        if not self.mask.any():
            return float("nan")
        return metrics.psnr(self.rendered, self.photograph, self.mask)

    @property
    def iou(self) -> float:
        """Agreement of silhouette and mask; NaN where the mask shows nothing."""
        return metrics.iou(self.solid, self.mask, self.counted) if self.mask.any() else float("nan")

    @property
    def stops(self) -> float:
        """How much brighter the photograph is than the render, over the pixels that neither clips [stops]."""
        x, y = self.photograph, self.rendered
        fair = (self.mask & self.solid & (x < 0.98).all(-1) & (y < 0.98).all(-1))[..., None].expand_as(x)
        if not fair.any():
            return float("nan")
        ratio = linear_from_srgb(x[fair]).mean() / linear_from_srgb(y[fair]).mean().clamp(min=1e-6)
        return float(ratio.clamp(min=1e-6).log2())


def window(mask: Tensor) -> Box:
    """A square around the object with a tenth to spare, as far as the picture reaches; all of it for an empty mask."""
    h, w = mask.shape
    if not mask.any():
        return 0, 0, h, w
    top, left, height, width = crop_box(mask, 0)
    side = int(1.2 * max(height, width)) + 2
    rows, columns = min(side, h), min(side, w)
    top = min(max(top + height // 2 - rows // 2, 0), h - rows)
    left = min(max(left + width // 2 - columns // 2, 0), w - columns)
    return top, left, rows, columns


@dataclass(frozen=True)
class LitScene:
    """An asset made ready to be rendered under its own light."""

    asset: Asset
    tracer: Tracer
    prefiltered: Prefiltered


def scene(asset: Asset) -> LitScene:
    """Of an asset with material and light."""
    return LitScene(asset, build(asset.gaussians, asset.gamma), prefilter(asset.environment))


@torch.no_grad()
def render(scene: LitScene, number: int, camera: Camera) -> tuple[Float[Tensor, "h w 3"], Buffers]:
    """One training pose through any camera, with shadows and without bounce: linear radiance over black."""
    material, trajectory = scene.asset.material, scene.asset.trajectory
    T_cam_obj = trajectory.T_cam_obj[number]
    view = antialiased(scene.asset, T_cam_obj, camera)
    points = surface(view, T_cam_obj, camera, alpha_min=0.1)
    directions = fibonacci_sphere(DIRECTIONS).to(view.alpha)
    shaded = shade_split(
        points,
        points.sample(view.features["albedo"]),
        points.sample(view.features["roughness"]),
        scene.prefiltered,
        env_from_obj(T_cam_obj, trajectory.light),
        visibility(scene.tracer, points.points, points.normals, directions),
        f0=float(material.f0),
    )
    return points.paint(shaded, camera.height, camera.width) * view.alpha[..., None], view


@torch.no_grad()
def frames(scene: LitScene, capture: Capture) -> Iterator[RenderedFrame]:
    """All training frames of a capture whose frames are those of the asset's trajectory."""
    for number, name in enumerate(capture.names):
        mask = capture.masks[number]
        box = window(mask == OBJECT)
        camera = scene.asset.camera.cropped(*box)
        scale = min(1.0, SIDE / max(camera.height, camera.width))
        size = (round(scale * camera.height), round(scale * camera.width))
        linear, view = render(scene, number, camera.resized(*size))
        is_object, unknown = (
            resize_area((crop(mask, box) == value).float()[..., None], *size)[..., 0] for value in (OBJECT, UNKNOWN)
        )
        yield RenderedFrame(
            number=number,
            name=name,
            camera=camera,
            photograph=resize_area(crop(capture.images[number], box).float() / 255, *size),
            mask=is_object >= SOLID,
            counted=unknown == 0,
            rendered=srgb_from_linear(linear).clamp(0, 1).cpu(),
            alpha=view.alpha.cpu(),
        )
