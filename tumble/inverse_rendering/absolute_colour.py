"""Absolute scale of albedo and light per colour channel, estimated from several cues after stage 3.

    radiance = albedo * irradiance / pi + F0 * specular lobe of the light

A factor exp(g) on the albedo, with exp(-g) on the light, changes no picture of the diffuse lobe. So `g` (natural
logarithm, one value per channel) is the maximum a posteriori estimate from independent cues with Gaussian errors:

- *neutral light*: a camera's white balance makes the light neutral that falls on the visible surface, on average;
- *highlights*: the specular lobe, whose scale is known, has set the scale of stage 3, more reliably the stronger the
  lobe and the more directional the light;
- *white paint*: the brightest parts of most objects with print are neutral (white-patch assumption);
- *lightness*: objects have a typical mean reflectance, and no paint reflects more than nine tenths;
- *known white*: the user names a pixel that shows a neutral colour.

Brightness has no cue from the exposure, which is unknown.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.maths import fibonacci_sphere, linear_from_srgb, texel_directions, texel_solid_angles
from tumble.rendering import prefilter, render_gbuffer, shade_split, surface, unoccluded
from tumble.scene import DIELECTRIC, OBJECT, Asset, Capture, Environment

FRAMES = 16
"""Maximum number of frames whose pixels are shaded."""
PIXELS = 1024
"""Maximum number of pixels shaded per frame."""
DIRECTIONS = 256
"""Number of directions over which light is integrated."""
NEUTRAL_SD = 0.15
"""Standard deviation of the light's colour from neutral after a camera's white balance [log radiance]."""
SHADING_ERROR = 0.1
"""Relative error of the diffuse lobe that may look like a specular lobe: what the error of a highlight's colour scales
with."""
HIGHLIGHT_SD = 0.1
"""Standard deviation of the brightness of stage 3 under diffuse light of contrast 1; it is inversely proportional to
this contrast (standard deviation over mean), since a flat light hardly separates the lobes [log radiance]."""
WHITE_QUANTILE = 0.99
"""Quantile of the albedo per channel that counts as the object's brightest paint."""
WHITE_SD = 0.2
"""Standard deviation of the brightest paint's colour from neutral, if it is white [log albedo]."""
WHITE_CUTOFF = 0.6
"""Length of the deviation from which the brightest paint rather counts as coloured (Geman-McClure) [log albedo]."""
MEAN_ALBEDO = 0.25
"""Typical mean albedo of an object."""
MEAN_METAL = 0.6
"""Typical reflectance of a metal at normal incidence: about 0.5 (iron, titanium) to 0.9 (aluminium)."""
MEAN_ALBEDO_SD = 0.4
"""Standard deviation of the logarithm of the mean albedo."""
MAX_ALBEDO = 0.9
"""Albedo of the brightest paints: the limit of `WHITE_QUANTILE` in every channel."""
MAX_ALBEDO_SD = 0.1
"""Standard deviation of the logarithm of this limit."""
KNOWN_WHITE_SD = 0.03
"""Standard deviation of the colour of a pixel that the user calls white or grey [log albedo]."""
WHITE_RADIUS = 2
"""Half the side of the square around a pixel named by the user whose median counts, less half a pixel [pixels]."""
WHITE_RANGE = (10, 250)
"""Code values between which a pixel named by the user must lie: below is noise, above it may be saturated."""
REWEIGHTINGS = 30
"""Iterations of reweighted least squares."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Luminance of linear sRGB primaries."""


@dataclass(frozen=True)
class ShadedPixels:
    """Pixels of several frames with the lobes of an asset under its own light, in linear radiance."""

    albedo: Float[Tensor, "p 3"]
    diffuse: Float[Tensor, "p 3"]
    """Radiance of a white Lambertian surface."""
    specular: Float[Tensor, "p 3"]
    """Radiance of the specular lobe of a dielectric."""


@dataclass(frozen=True)
class Estimate:
    """Factor per channel between the albedo of stage 3 and the absolute albedo."""

    log_factor: Float[Tensor, "3"]
    """Natural logarithm of the factor on the albedo; the light is divided by the factor."""
    deviation: Float[Tensor, "3"]
    """Standard deviation of `log_factor`, about the relative error of the albedo. The limit of the brightest paint does
    not lower it, since below the limit the other cues alone decide."""


@torch.no_grad()
def shaded_pixels(asset: Asset, capture: Capture) -> ShadedPixels:
    """Pixels of the object in some frames, without shadows.

    Args:
        asset: The result of stage 3.
        capture: The asset's training frames, in the order of its trajectory.
    """
    rng, light, rows = torch.Generator().manual_seed(0), prefilter(asset.environment), []
    directions = fibonacci_sphere(DIRECTIONS).to(asset.environment.log_radiance)
    for frame in range(0, len(capture), -(-len(capture) // FRAMES)):
        T_cam_obj = asset.trajectory.T_cam_obj[frame]
        view = render_gbuffer(asset, T_cam_obj, capture.camera)
        shown = (view.alpha > 0.5) & (capture.masks[frame].to(view.alpha.device) == OBJECT)
        solid = torch.where(shown.flatten())[0]
        solid = solid[torch.randperm(len(solid), generator=rng)[:PIXELS].to(solid.device)]
        points = surface(view, T_cam_obj, capture.camera, pixels=solid)
        albedo, rough = points.sample(view.features["albedo"]), points.sample(view.features["roughness"])
        R_env_obj = asset.trajectory.R_env_obj_at(frame, T_cam_obj)
        seen = unoccluded(directions, len(solid))
        lobes = [(torch.ones_like(albedo), 0.0), (torch.zeros_like(albedo), DIELECTRIC)]
        shaded = [shade_split(points, white, rough, light, R_env_obj, seen, f0=f0) for white, f0 in lobes]
        rows.append((albedo, *shaded))
    return ShadedPixels(*(torch.cat(x) for x in zip(*rows, strict=True)))


@torch.no_grad()
def estimate(
    pixels: ShadedPixels, f0: float, known_white: Float[Tensor, "3"] | None = None, *, metalness: float = 0.0
) -> Estimate:
    """The most likely factor per channel, and its uncertainty.

    Args:
        pixels: From `shaded_pixels`.
        f0: Reflectance at normal incidence of the asset.
        known_white: From `known_white`, if the user has named a pixel; its mean does not count.
        metalness: Mean metalness of the asset. Metal has no highlight beside its own colour that would tell its
            brightness from that of the light.
    """
    if not len(pixels.albedo):
        return Estimate(torch.zeros(3).to(pixels.albedo), torch.full((3,), MEAN_ALBEDO_SD).to(pixels.albedo))
    albedo, light = pixels.albedo.double(), pixels.diffuse.double().mean(0).log()
    eye, ones = torch.eye(3).to(albedo), torch.ones(3, 3).to(albedo)
    colour = eye - ones / 3
    paint = albedo.quantile(WHITE_QUANTILE, dim=0).clamp_min(1e-3).log()
    lightness = (albedo @ albedo.new_tensor(LUMINANCE)).mean().log()
    dielectric = max(1 - metalness, 1e-3)
    highlights = f0 / DIELECTRIC * dielectric * pixels.specular.double().mean(0)
    ratio = (albedo * pixels.diffuse).mean(0) / highlights.clamp_min(1e-6)
    contrast = pixels.diffuse.mean(-1).std() / pixels.diffuse.mean()
    grey = HIGHLIGHT_SD / contrast.clamp_min(0.01) / dielectric
    mean_albedo = MEAN_ALBEDO ** (1 - metalness) * MEAN_METAL**metalness
    hue = colour @ (SHADING_ERROR * ratio).square().reciprocal().diag() @ colour
    fixed = [
        (colour / NEUTRAL_SD**2, light),
        (hue + ones / (3 * grey) ** 2, torch.zeros_like(light)),
        (ones / (3 * MEAN_ALBEDO_SD) ** 2, (math.log(mean_albedo) - lightness).expand(3)),
    ]
    if known_white is not None:
        fixed.append((colour / KNOWN_WHITE_SD**2, known_white.to(albedo)))
    factor, precision = torch.zeros_like(light), eye
    for _ in range(REWEIGHTINGS):
        tint = (colour @ (paint + factor)).square().sum() / WHITE_CUTOFF**2
        too_bright = (paint + factor > math.log(MAX_ALBEDO)).double()
        cues = [*fixed, (colour / (WHITE_SD * (1 + tint)) ** 2, -paint)]
        precision = torch.stack([weight for weight, _ in cues]).sum(0)
        limit = (too_bright / MAX_ALBEDO_SD**2).diag()
        target = torch.stack([weight @ target for weight, target in cues]).sum(0)
        factor = torch.linalg.solve(precision + limit, target + limit @ (math.log(MAX_ALBEDO) - paint))
    deviation = torch.linalg.inv(precision).diagonal().sqrt()
    return Estimate(factor.to(pixels.albedo), deviation.to(pixels.albedo))


def code_values(photo: UInt8[Tensor, "h w 3"], column: int, row: int) -> UInt8[Tensor, "3"]:
    """sRGB code values of a pixel that the user calls white or grey: the median of its neighbourhood.

    Raises:
        ValueError: The pixel is too dark or saturated.
    """
    found = photo[_near(row), _near(column)].flatten(0, 1).median(0).values
    if found.min() < WHITE_RANGE[0] or found.max() > WHITE_RANGE[1]:
        rule = f"has the code values {', '.join(map(str, found.tolist()))}, too dark or saturated for a white"
        raise ValueError(f"the pixel of --white {column} {row} {rule}; choose another")
    return found


def _near(place: int) -> slice:
    """Rows or columns around one."""
    return slice(max(0, place - WHITE_RADIUS), place + WHITE_RADIUS + 1)


@torch.no_grad()
def known_white(
    asset: Asset, capture: Capture, frame: int, column: int, row: int, shown: UInt8[Tensor, "3"]
) -> Float[Tensor, "3"]:
    """Logarithm of the factor, up to its mean, for which a pixel shows a neutral colour.

    On the object, the albedo of stage 3 must become neutral. Beside it, the pixel shows a card that faces the camera.

    Args:
        asset: The result of stage 3.
        capture: The asset's training frames, in the order of its trajectory.
        frame: Index of a frame.
        column: Column of the pixel.
        row: Row of the pixel.
        shown: Its `code_values`.
    """
    rows, columns = _near(row), _near(column)
    T_cam_obj = asset.trajectory.T_cam_obj[frame]
    view = render_gbuffer(asset, T_cam_obj, capture.camera)
    covered = view.alpha[rows, columns].flatten() > 0.5
    if capture.masks[frame, row, column] == OBJECT and covered.any():
        return -view.features["albedo"][rows, columns].flatten(0, 1)[covered].median(0).values.log()
    to_camera = -T_cam_obj.rotation.matrix()[2]
    n_env = asset.trajectory.R_env_obj_at(frame, T_cam_obj) @ to_camera
    card = linear_from_srgb(shown.to(n_env) / 255)
    return (_irradiance(asset.environment, n_env) / card).log()


def _irradiance(light: Environment, n_env: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Irradiance of a surface with unit normal `n_env`, env frame."""
    height, width = light.log_radiance.shape[:2]
    cosine = (texel_directions(height, width).to(n_env) @ n_env).clamp_min(0)
    return (light.radiance * (cosine * texel_solid_angles(height, width).to(n_env))[..., None]).sum((0, 1))


@torch.no_grad()
def apply(asset: Asset, log_factor: Float[Tensor, "3"]) -> Asset:
    """The asset with its albedo times a factor per channel and its light divided by it.

    The diffuse lobe stays the same, but for interreflections and albedos limited to 0.999. F0 is scaled by the mean
    factor, so that highlights stay as bright; their colour remains that of the light.
    """
    material, environment = asset.material, asset.environment
    albedo = (material.albedo * log_factor.exp()).clamp(1e-5, 0.999)
    f0 = (material.f0 * log_factor.mean().exp()).clamp(max=0.999 * 2 * DIELECTRIC)
    material = replace(material.with_albedo(albedo), f0_logit=torch.logit(f0 / (2 * DIELECTRIC)))
    return replace(asset, material=material, environment=Environment(environment.log_radiance - log_factor))
