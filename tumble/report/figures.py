"""The pictures of a report, as marks of a page: pairs of photograph and render, maps, confidence, panoramas.

A *strip* is one row of pictures under a title. Pictures are embedded as WebP; what shows the object alone has coverage,
so that the page's own colour lies behind it.
"""

import base64
import html
import io
import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from tumble.export import Confidence
from tumble.maths import srgb_from_linear, texel_directions
from tumble.rendering import buffers_of, rasterize
from tumble.report import training_views
from tumble.report.training_views import RenderedFrame
from tumble.scene import Asset, Camera, Environment, opengl_from_opencv

SHOWN, HERO = 320, 448
"""Sides of rendered maps and of the picture at the top [pixels]."""
GREY = 0.18
"""Mean luminance of a panorama once it is tone-mapped."""
STOPS = (0, 64, 128, 192, 255)
"""Code values at which a colour bar is written down."""


def spread(asset: Asset, frames: Sequence[RenderedFrame], n: int) -> list[RenderedFrame]:
    """At most `n` frames that show the object from sides as different as can be, the clearest first."""
    usable = [frame for frame in frames if frame.mask.any()] or list(frames)
    d = normalize(asset.trajectory.camera_positions, dim=-1)
    chosen = [max(usable, key=lambda frame: float(frame.photograph[frame.mask].sum()))]
    while len(chosen) < min(n, len(usable)):
        rest = [frame for frame in usable if frame not in chosen]
        near = {frame.number: max(float(d[frame.number] @ d[c.number]) for c in chosen) for frame in rest}
        chosen.append(min(rest, key=lambda frame: near[frame.number]))
    return chosen


def resized(camera: Camera, side: int) -> Camera:
    scale = side / max(camera.height, camera.width)
    return camera.resized(max(1, round(scale * camera.height)), max(1, round(scale * camera.width)))


def small_camera(camera: Camera) -> Camera:
    return resized(camera, min(training_views.SIDE, max(camera.height, camera.width)))


def hero(scene: training_views.LitScene, frame: RenderedFrame) -> UInt8[np.ndarray, "h w 4"]:
    linear, view = training_views.render(scene, frame.number, resized(frame.camera, HERO))
    return _cutout(srgb_from_linear(linear / view.alpha.clamp(min=1e-3)[..., None]), view.alpha)


def pair(frame: RenderedFrame) -> str:
    name = html.escape(frame.name)
    images = f'<img src="{webp(_codes(frame.photograph))}" alt="Photograph {name}">'
    images += f'<img src="{webp(_codes(frame.rendered))}" alt="Render of {name}">'
    return (
        f'<figure><div class="pair">{images}</div><figcaption class="under"><span>{name}</span>'
        f"<b>{frame.psnr:.1f} dB</b></figcaption></figure>"
    )


def _strip(title: str, about: str, pictures: Sequence[UInt8[np.ndarray, "h w c"]], scale: str = "") -> str:
    images = "".join(f'<img src="{webp(picture)}" alt="{title}, view {i + 1}">' for i, picture in enumerate(pictures))
    return f'<div class="strip"><div><p>{title}<small>{about}</small></p>{scale}</div>{images}</div>'


def maps(asset: Asset, views: Sequence[RenderedFrame]) -> str:
    albedo, roughness, normals = [], [], []
    for frame in views:
        T_cam_obj = asset.trajectory.T_cam_obj[frame.number]
        view = buffers_of(asset, T_cam_obj, resized(frame.camera, SHOWN))
        R_gl_obj = opengl_from_opencv(view.normal) @ T_cam_obj.rotation.matrix()
        albedo.append(_cutout(srgb_from_linear(view.features["albedo"]), view.alpha))
        roughness.append(_cutout(view.features["roughness"].expand(-1, -1, 3), view.alpha))
        normals.append(_cutout(0.5 + 0.5 * normalize(view.normal, dim=-1) @ R_gl_obj.T, view.alpha))
    grey = _scale("linear-gradient(90deg,#000,#fff)", "0 mirror", "1 matt")
    return (
        _strip("Albedo", "base colour, sRGB", albedo)
        + _strip("Roughness", "perceptual", roughness, grey)
        + _strip("Normals", "camera axes: red right, green up, blue to the viewer", normals)
    )


def confidence(asset: Asset, views: Sequence[RenderedFrame], seen: Confidence) -> str:
    n = len(asset.gaussians)
    rows = [
        ("Frames", "that show the point", 100 * seen.views, " %"),
        ("Light directions", "from which one of the brightest lights reached it", seen.lights, ""),
        ("Half-vectors", "under which it was seen", seen.halves, ""),
    ]
    tops = [max(1.0, math.ceil(float(values.quantile(0.98)))) for _, _, values, _ in rows]
    pictures: list[list[np.ndarray]] = [[] for _ in rows]
    for frame in views:
        features = {title: values[:, None, None].expand(n, 4, 1) for title, _, values, _ in rows}
        T_cam_obj, camera = asset.trajectory.T_cam_obj[frame.number], resized(frame.camera, SHOWN)
        view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, camera, features)
        for (title, *_), top, into in zip(rows, tops, pictures, strict=True):
            into.append(np.dstack([_viridis(_codes(view.features[title] / top)), _codes(view.alpha[..., None])]))
    stops = ",".join("#{:02x}{:02x}{:02x}".format(*_viridis(np.full((1, 1, 1), v, np.uint8))[0, 0]) for v in STOPS)
    return "".join(
        _strip(title, about, shown, _scale(f"linear-gradient(90deg,{stops})", "0", f"{top:.0f}{unit}"))
        for (title, about, _, unit), top, shown in zip(rows, tops, pictures, strict=True)
    )


def _viridis(codes: UInt8[np.ndarray, "h w 1"]) -> UInt8[np.ndarray, "h w 3"]:
    return cv2.applyColorMap(codes, cv2.COLORMAP_VIRIDIS)[..., ::-1]


def _scale(gradient: str, low: str, high: str) -> str:
    return (
        f'<span class="scale" style="background:{gradient}"></span>'
        f'<span class="ends"><span>{low}</span><span>{high}</span></span>'
    )


def panorama(environment: Environment, height: int) -> UInt8[np.ndarray, "{height} {2*height} 3"]:
    """A light map for the eye: mean luminance at `GREY`, highlights rolled off, sRGB."""
    linear = environment.lookup(texel_directions(height, 2 * height).to(environment.log_radiance))
    mean = float(environment.integral().mean()) / (4 * math.pi)
    x = linear * (GREY / (1 - GREY) / max(mean, 1e-9))
    return _codes(srgb_from_linear(x / (1 + x)))


def webp(picture: UInt8[np.ndarray, "h w c"]) -> str:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "WEBP", quality=90, method=4)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


def _codes(values: Float[Tensor, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def _cutout(srgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """Colours with coverage: whatever the page shows behind it shines through."""
    return _codes(torch.cat([srgb, alpha[..., None]], -1))
