"""Renders of the training frames from the finished asset, each in a window around the object.

Photo and render of a frame are compared within this window only; outside it both are black.
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
    antialiased_gbuffer,
    build_tracer,
    material_at,
    prefilter,
    shade_split,
    surface,
    visibility,
)
from tumble.scene import OBJECT, UNKNOWN, Asset, Camera, Capture

MAX_SIDE = 256
"""Maximum longer side of a window's images [pixels]: enough for display, and for scores close to those at full size."""
N_DIRECTIONS = 256
"""Number of directions in which visibility is traced."""
MIN_OBJECT_COVERAGE = 0.5
"""Coverage from which a pixel belongs to the object."""


@dataclass(frozen=True)
class RenderedFrame:
    """One training frame and its render from the asset, in the same window."""

    number: int
    """Index in the asset's trajectory."""
    name: str
    camera: Camera
    """Intrinsics of the window at the photo's full resolution."""
    photo: Float[Tensor, "h w 3"]
    """sRGB in [0, 1]."""
    mask: Bool[Tensor, "h w"]
    """Pixels that the capture's mask assigns to the object."""
    valid: Bool[Tensor, "h w"]
    """Pixels whose mask is known."""
    rendered: Float[Tensor, "h w 3"]
    """sRGB in [0, 1], over black."""
    alpha: Float[Tensor, "h w"]
    """Coverage by the rendered asset."""

    @property
    def silhouette(self) -> Bool[Tensor, "h w"]:
        """Pixels that the rendered asset covers."""
        return self.alpha >= MIN_OBJECT_COVERAGE

    @property
    def psnr(self) -> float:
        """PSNR over the object's pixels [dB]; NaN if the mask is empty."""
        if not self.mask.any():
            return float("nan")
        return metrics.psnr(self.rendered, self.photo, self.mask)

    @property
    def iou(self) -> float:
        """Intersection over union of the rendered silhouette and the mask; NaN if the mask is empty."""
        return metrics.iou(self.silhouette, self.mask, self.valid) if self.mask.any() else float("nan")

    @property
    def exposure_stops(self) -> float:
        """Exposure of the photo relative to the render, over unclipped pixels [stops]; NaN without such pixels."""
        x, y = self.photo, self.rendered
        unclipped = (self.mask & self.silhouette & (x < 0.98).all(-1) & (y < 0.98).all(-1))[..., None].expand_as(x)
        if not unclipped.any():
            return float("nan")
        ratio = linear_from_srgb(x[unclipped]).mean() / linear_from_srgb(y[unclipped]).mean().clamp(min=1e-6)
        return float(ratio.clamp(min=1e-6).log2())


def window(mask: Tensor) -> Box:
    """A square around the object with a margin of a tenth, clipped to the image; the whole image for an empty mask."""
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
    """An asset with the structures for rendering it under its own light."""

    asset: Asset
    tracer: Tracer
    """Ray tracer for visibility."""
    prefiltered: Prefiltered
    """The asset's light, prefiltered for shading."""


def prepare(asset: Asset) -> LitScene:
    """Build the tracer and prefilter the light of an asset, which needs material and light."""
    return LitScene(asset, build_tracer(asset.gaussians, asset.gamma), prefilter(asset.environment))


@torch.no_grad()
def render(scene: LitScene, number: int, camera: Camera) -> tuple[Float[Tensor, "h w 3"], Buffers]:
    """Linear radiance over black of a training pose through any camera, with shadows but without indirect light."""
    material, trajectory = scene.asset.material, scene.asset.trajectory
    T_cam_obj = trajectory.T_cam_obj[number]
    view = antialiased_gbuffer(scene.asset, T_cam_obj, camera)
    points = surface(view, T_cam_obj, camera, alpha_min=0.1)
    directions = fibonacci_sphere(N_DIRECTIONS).to(view.alpha)
    albedo, roughness, metalness = material_at(view, points)
    shaded = shade_split(
        points,
        albedo,
        roughness,
        scene.prefiltered,
        trajectory.R_env_obj_at(number, T_cam_obj),
        visibility(scene.tracer, points.points, points.normals, directions),
        f0=float(material.f0),
        metalness=metalness,
    )
    return points.paint(shaded, camera.height, camera.width) * view.alpha[..., None], view


@torch.no_grad()
def frames(scene: LitScene, capture: Capture) -> Iterator[RenderedFrame]:
    """Renders of all frames of a capture, which must be those of the asset's trajectory."""
    for number, name in enumerate(capture.names):
        mask = capture.masks[number]
        box = window(mask == OBJECT)
        camera = scene.asset.camera.cropped(*box)
        scale = min(1.0, MAX_SIDE / max(camera.height, camera.width))
        size = (round(scale * camera.height), round(scale * camera.width))
        linear, view = render(scene, number, camera.resized(*size))
        is_object, unknown = (
            resize_area((crop(mask, box) == value).float()[..., None], *size)[..., 0] for value in (OBJECT, UNKNOWN)
        )
        photo = linear_from_srgb(crop(capture.images[number], box).float() / 255)
        yield RenderedFrame(
            number=number,
            name=name,
            camera=camera,
            photo=srgb_from_linear(resize_area(photo, *size)).clamp(0, 1),
            mask=is_object >= MIN_OBJECT_COVERAGE,
            valid=unknown == 0,
            rendered=srgb_from_linear(linear).clamp(0, 1).cpu(),
            alpha=view.alpha.cpu(),
        )
