"""Figures of the report as HTML: photos beside renders, material maps, confidence maps, panoramas.

A *strip* is one row of images under a title. Images are embedded as WebP. Images of the object alone have an alpha
channel, so that the page's background shows behind it.
"""

import base64
import io
import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from markupsafe import Markup
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from tumble.export import Confidence
from tumble.io import tree
from tumble.maths import srgb_from_linear, texel_directions
from tumble.rendering import corner_features, rasterize, render_gbuffer
from tumble.report import training_views
from tumble.report.coverage import Coverage, best_direction, nearest_oriented, outside_view
from tumble.report.training_views import RenderedFrame
from tumble.report.worst_frames import WorstFrame
from tumble.scene import Asset, Camera, Environment, opengl_from_opencv

MAP_SIDE = 320
"""Longer side of rendered maps [pixels]."""
HERO_SIDE = 448
"""Longer side of the image at the top of the page [pixels]."""
PANORAMA_LUMINANCE = 0.18
"""Mean linear value to which a panorama is scaled by its tone mapping: middle grey."""
REGION_COLOUR = (240, 110, 0)
"""Colour of a marked region of the surface (orange), sRGB."""
COLOUR_BAR_CODES = (0, 64, 128, 192, 255)
"""8-bit values at which a colour bar's gradient has its stops."""


def select_diverse(asset: Asset, frames: Sequence[RenderedFrame], n: int) -> list[RenderedFrame]:
    """At most `n` frames from the most different directions (farthest-point sampling), the brightest object first."""
    usable = [frame for frame in frames if frame.mask.any()] or list(frames)
    d = normalize(asset.trajectory.camera_positions, dim=-1)
    selected = [max(usable, key=lambda frame: float(frame.photo[frame.mask].sum()))]
    while len(selected) < min(n, len(usable)):
        rest = [frame for frame in usable if frame not in selected]
        cosine = {frame.number: max(float(d[frame.number] @ d[c.number]) for c in selected) for frame in rest}
        selected.append(min(rest, key=lambda frame: cosine[frame.number]))
    return selected


def resized(camera: Camera, side: int) -> Camera:
    """The camera with images whose longer side is `side` [pixels]."""
    scale = side / max(camera.height, camera.width)
    return camera.resized(max(1, round(scale * camera.height)), max(1, round(scale * camera.width)))


def small_camera(camera: Camera) -> Camera:
    """The camera with images of at most `training_views.MAX_SIDE` pixels per side."""
    return resized(camera, min(training_views.MAX_SIDE, max(camera.height, camera.width)))


def hero_image(scene: training_views.LitScene, frame: RenderedFrame) -> UInt8[np.ndarray, "h w 4"]:
    """Image of the object for the top of the page, sRGB with alpha."""
    linear, view = training_views.render(scene, frame.number, resized(frame.camera, HERO_SIDE))
    return _with_alpha(srgb_from_linear(linear / view.alpha.clamp(min=1e-3)[..., None]), view.alpha)


def comparison(frame: RenderedFrame) -> Markup:
    """Photo and render of a frame side by side, with the PSNR."""
    template = (
        '<figure><div class="pair"><img src="{photo}" alt="Photo {name}"><img src="{rendered}" alt="Render of {name}">'
        '</div><figcaption class="under"><span>{name}</span><b>{psnr:.1f} dB</b></figcaption></figure>'
    )
    photo, rendered = (webp(_code_values(image)) for image in (frame.photo, frame.rendered))
    return Markup(template).format(name=frame.name, photo=photo, rendered=rendered, psnr=frame.psnr)


def worst_frames(frames: Sequence[WorstFrame]) -> Markup:
    """Pictures of the worst frames with the reasons; empty without any."""
    template = Markup(
        '<figure><div class="{}">{}</div><figcaption class="under"><span>{}</span></figcaption>'
        "<figcaption>{}</figcaption></figure>"
    )
    image = Markup('<img src="{}" alt="{} of {}">')
    drawn = []
    for frame in frames:
        cells = Markup("").join(image.format(webp(picture), title, frame.name) for title, picture in frame.pictures)
        titles = ", ".join(title for title, _ in frame.pictures) if len(frame.pictures) > 1 else ""
        name = f"{frame.name} ({titles})" if titles else frame.name
        drawn.append(template.format("pair" if titles else "single", cells, name, "; ".join(frame.reasons)))
    return Markup("").join(drawn)


def _strip(
    title: str, subtitle: str, images: Sequence[UInt8[np.ndarray, "h w c"]], colour_bar: Markup | str = ""
) -> Markup:
    cell = Markup('<img src="{}" alt="{}, view {}">')
    cells = Markup("").join(cell.format(webp(image), title, i + 1) for i, image in enumerate(images))
    head = Markup('<div class="strip"><div><p>{}<small>{}</small></p>{}</div>{}</div>')
    return head.format(title, subtitle, colour_bar, cells)


def material_maps(asset: Asset, views: Sequence[RenderedFrame]) -> Markup:
    """Strips of albedo, roughness, metalness if there is metal, and normals, seen from some frames."""
    albedo, roughness, metalness, normals = [], [], [], []
    for frame in views:
        T_cam_obj = asset.trajectory.T_cam_obj[frame.number]
        view = render_gbuffer(asset, T_cam_obj, resized(frame.camera, MAP_SIDE))
        R_gl_obj = opengl_from_opencv(view.normal) @ T_cam_obj.rotation.matrix()
        albedo.append(_with_alpha(srgb_from_linear(view.features["albedo"]), view.alpha))
        roughness.append(_with_alpha(view.features["roughness"].expand(-1, -1, 3), view.alpha))
        if "metalness" in view.features:
            metalness.append(_with_alpha(view.features["metalness"].expand(-1, -1, 3), view.alpha))
        normals.append(_with_alpha(0.5 + 0.5 * normalize(view.normal, dim=-1) @ R_gl_obj.T, view.alpha))
    grey, metal = (
        _colour_bar("linear-gradient(90deg,#000,#fff)", *ends)
        for ends in (("0 mirror", "1 matte"), ("0 dielectric", "1 metal"))
    )
    return (
        _strip("Albedo", "base colour, sRGB", albedo)
        + _strip("Roughness", "perceptual", roughness, grey)
        + (_strip("Metalness", "1: reflects in its colour", metalness, metal) if metalness else Markup(""))
        + _strip("Normals", "camera axes: red right, green up, blue to the viewer", normals)
    )


def region_image(asset: Asset, coverage: Coverage, region: Bool[Tensor, " n"]) -> UInt8[np.ndarray, "h w 4"]:
    """The object's albedo, seen from where most of a region of its surface is visible, with the region in orange."""
    T_cam_obj, camera = outside_view(best_direction(coverage, region), coverage.points)
    # A Gaussian belongs to the region if the nearest point with a similar normal does.
    marked = region[nearest_oriented(asset.gaussians.means, asset.gaussians.normals, coverage)]
    features = {
        "albedo": corner_features(asset.material)[0][..., :3],
        "marked": marked.float()[:, None, None].expand(-1, 4, 1).contiguous(),
    }
    fitting = resized(camera, MAP_SIDE)
    view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, tree.to(fitting, asset.gamma.device), features)
    colour = torch.tensor(REGION_COLOUR).to(view.alpha) / 255
    share = 0.75 * view.features["marked"].clamp(0, 1)
    return _with_alpha((1 - share) * srgb_from_linear(view.features["albedo"]) + share * colour, view.alpha)


def confidence_maps(asset: Asset, views: Sequence[RenderedFrame], confidence: Confidence) -> Markup:
    """Strips of the observation counts behind the confidence, seen from some frames."""
    n = len(asset.gaussians)
    rows = [
        ("Frames", "in which the point is visible", 100 * confidence.views, " %"),
        ("Light directions", "from which a bright light reached the point", confidence.lights, ""),
        ("Half vectors", "halfway between camera and bright light", confidence.half_vectors, ""),
    ]
    tops = [max(1.0, math.ceil(float(values.quantile(0.98)))) for _, _, values, _ in rows]
    images: list[list[np.ndarray]] = [[] for _ in rows]
    for frame in views:
        features = {title: values[:, None, None].expand(n, 4, 1) for title, _, values, _ in rows}
        T_cam_obj, camera = asset.trajectory.T_cam_obj[frame.number], resized(frame.camera, MAP_SIDE)
        view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, camera, features)
        for (title, *_), top, strip in zip(rows, tops, images, strict=True):
            strip.append(
                np.dstack([_viridis(_code_values(view.features[title] / top)), _code_values(view.alpha[..., None])])
            )
    stops = ",".join(
        "#{:02x}{:02x}{:02x}".format(*_viridis(np.full((1, 1, 1), v, np.uint8))[0, 0]) for v in COLOUR_BAR_CODES
    )
    return Markup("").join(
        _strip(title, subtitle, strip, _colour_bar(f"linear-gradient(90deg,{stops})", "0", f"{top:.0f}{unit}"))
        for (title, subtitle, _, unit), top, strip in zip(rows, tops, images, strict=True)
    )


def _viridis(codes: UInt8[np.ndarray, "h w 1"]) -> UInt8[np.ndarray, "h w 3"]:
    return cv2.applyColorMap(codes, cv2.COLORMAP_VIRIDIS)[..., ::-1]


def _colour_bar(gradient: str, low: str, high: str) -> Markup:
    template = (
        '<span class="scale" style="background:{}"></span><span class="ends"><span>{}</span><span>{}</span></span>'
    )
    return Markup(template).format(gradient, low, high)


def panorama(environment: Environment, height: int) -> UInt8[np.ndarray, "{height} {2*height} 3"]:
    """A light map tone-mapped for display: mean at `PANORAMA_LUMINANCE`, highlights compressed (Reinhard), sRGB."""
    linear = environment.lookup(texel_directions(height, 2 * height).to(environment.log_radiance))
    mean = float(environment.integral().mean()) / (4 * math.pi)
    x = linear * (PANORAMA_LUMINANCE / (1 - PANORAMA_LUMINANCE) / max(mean, 1e-9))
    return _code_values(srgb_from_linear(x / (1 + x)))


def webp(image: UInt8[np.ndarray, "h w c"]) -> str:
    """An image as a data URL."""
    return "data:image/webp;base64," + base64.b64encode(webp_file(image)).decode()


def webp_file(image: UInt8[np.ndarray, "h w c"]) -> bytes:
    """An image as a WebP file."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", quality=90, method=4)
    return file.getvalue()


def _code_values(values: Float[Tensor, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def _with_alpha(srgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """sRGB image with coverage as its alpha channel."""
    return _code_values(torch.cat([srgb, alpha[..., None]], -1))
