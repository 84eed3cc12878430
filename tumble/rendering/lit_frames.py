"""Photographs with the light of each pixel, as stage 3 found it: photograph = albedo * diffuse + specular.

On metal the albedo is the reflectance at normal incidence, and "diffuse" the mirrored light that it colours. Light,
normals, roughness and shadows are those of the Gaussians. Radiance is linear RGB.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from tumble.maths import SE3, fibonacci_sphere, linear_from_srgb
from tumble.rendering.gbuffer import render_gbuffer
from tumble.rendering.prefiltered_light import prefilter
from tumble.rendering.shading import Bounce, coloured_lobes, material_at, surface
from tumble.rendering.trace import build_tracer, surface_points, transfer, visibility
from tumble.scene import OBJECT, Asset, Camera, Capture

MAX_FRAMES = 72
"""Maximum number of photographs that are used, evenly spaced over the capture; time and memory are linear in it."""
DIRECTIONS = 256
"""Number of directions over which the light of a pixel is integrated."""
BORDER = 2
"""Distance to the contour of the mask, to its unknown pixels and to the Gaussians' contour up to which pixels are left
out, since they show more than one surface [pixels]."""
MIN_COVERAGE = 0.9
"""Minimum coverage by the Gaussians of a pixel that is used."""
SATURATED = 250
"""Code value from which a channel may be clipped; such pixels are left out."""


@dataclass(frozen=True)
class MaskedFrame:
    """The mask of a photograph, and its view."""

    mask: UInt8[np.ndarray, "h w"]
    """Mask of the capture."""
    T_cam_obj: SE3
    camera: Camera


@dataclass(frozen=True)
class LitFrame(MaskedFrame):
    """One photograph, the light of its pixels, and its view."""

    photo: Float[np.ndarray, "h w 3"]
    """Linear radiance."""
    usable: Bool[np.ndarray, "h w"]
    """Pixels that show one surface of the object for certain, unsaturated."""
    diffuse: Float[np.ndarray, "h w 3"]
    """Radiance per albedo; on a dielectric that of a white surface without highlights."""
    specular: Float[np.ndarray, "h w 3"]
    """Radiance of the highlights."""


def usable_pixels(
    photo: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], coverage: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Unsaturated pixels of the object, away from background, unknown pixels and the Gaussians' contour.

    Args:
        photo: Code values of the photograph.
        mask: Mask of the capture.
        coverage: Coverage by the Gaussians.
    """
    inside = ((mask == OBJECT) & (coverage > MIN_COVERAGE)).astype(np.uint8)
    kernel = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    inner = cv2.erode(inside, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    return inner & (photo.max(-1) < SATURATED)


def frame_numbers(capture: Capture) -> list[int]:
    """Indices of the frames that are used."""
    return torch.linspace(0, len(capture) - 1, min(MAX_FRAMES, len(capture))).round().long().tolist()


def masked_frames(asset: Asset, capture: Capture) -> list[MaskedFrame]:
    """Up to `MAX_FRAMES` masks with their views; the capture's frames are those of the asset's trajectory."""
    T_cam_obj, camera = asset.trajectory.T_cam_obj, asset.camera
    lens = Camera(camera.fx_fy_cx_cy.cpu(), camera.height, camera.width)
    wxyz, xyz = T_cam_obj.wxyz.cpu(), T_cam_obj.xyz.cpu()
    numbers = frame_numbers(capture)
    return [MaskedFrame(capture.masks[i].cpu().numpy(), SE3(wxyz[i], xyz[i]), lens) for i in numbers]


@torch.no_grad()
def lit_frames(asset: Asset, capture: Capture) -> Iterator[LitFrame]:
    """Up to `MAX_FRAMES` photographs with their light; the capture's frames are those of the asset's trajectory."""
    frames, masked = frame_numbers(capture), masked_frames(asset, capture)
    gaussians, material, camera = asset.gaussians, asset.material, asset.camera
    poses = [asset.trajectory.T_cam_obj[i] for i in frames]
    light, directions = prefilter(asset.environment), fibonacci_sphere(DIRECTIONS).to(gaussians.means)
    points = surface_points(gaussians, asset.gamma, poses, camera)
    tracer = build_tracer(gaussians, asset.gamma)
    traced = visibility(tracer, points, gaussians.normals, directions, blockers=True)
    bounce = Bounce(material.diffuse_albedo, transfer([traced], gaussians.normals))
    for i, T_cam_obj, frame in zip(frames, poses, masked, strict=True):
        view = render_gbuffer(asset, T_cam_obj, camera)
        usable = usable_pixels(capture.images[i].cpu().numpy(), frame.mask, view.alpha.cpu().numpy())
        pixels = torch.where(torch.from_numpy(usable).to(view.alpha.device).flatten())[0]
        shown = surface(view, T_cam_obj, camera, pixels=pixels)
        gaussian = view.dominant.flatten()[pixels].clamp_min(0).long()
        _, rough, metalness = material_at(view, shown)
        lit = (shown, rough, light, asset.trajectory.R_env_obj[i], traced.gather(gaussian))
        lobes = coloured_lobes(*lit, f0=float(material.f0), bounce=bounce, metalness=metalness)
        diffuse, specular = (shown.paint(x, camera.height, camera.width).cpu().numpy() for x in lobes)
        photo = linear_from_srgb(capture.images[i].float() / 255).cpu().numpy()
        yield LitFrame(frame.mask, frame.T_cam_obj, frame.camera, photo, usable, diffuse, specular)
