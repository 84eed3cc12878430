"""Albedos of all Gaussians by least squares under a given light and specular lobe, the roughness of regions, and the
specular scale in the end.

    radiance of a pixel that shows Gaussian i = albedo_i * diffuse + specular_scale * specular

The *specular scale* is the strength of the specular lobe relative to a dielectric with F0 = 0.04. Albedo and specular
scale are strongly correlated, so that gradient descent from a wrong scale has to move all albedos. Stage 3 therefore
starts from the best albedos for its lobe (variable projection, Golub and Pereyra 1973).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import neighbours
from tumble.scene import DIELECTRIC, TEMPERATURE, Material

MAX_ALBEDO = 0.9
"""Upper limit of the 95 % quantile of an object's albedo."""
MIN_F0 = 1e-7
"""Reflectance of an object without a specular lobe; more than 0, so that its logit is finite."""
MIN_SCALE = 0.01
"""Lower limit of the fitted specular scale, which has a logarithm."""
CLIPPED = 0.95
"""Linear radiance from which a pixel counts as clipped and is ignored."""
REWEIGHTINGS = 6
"""Iterations of reweighted least squares, which converge to least absolute errors."""
NEIGHBOURS = 256
"""Number of neighbouring Gaussians that are judged together: about a fiftieth of the surface."""
MAX_ERROR_RATIO = math.sqrt(2)
"""Largest error as metal, relative to that as a dielectric, of a region that may be metal. Under the blurred light of
stage 2 the ratio is about 1 where there is metal, and 2 where there is none."""
ROUGHNESSES = tuple(i / 10 for i in range(1, 10))
"""Roughnesses that are tried for a region."""
ALBEDO_DISTANCE = 0.2
"""How far apart Gaussians count whose albedos differ by a factor of e [object radius]: one material has one colour
more often than not, but print also lies on one material."""
PRIOR = 0.1
"""Weight of the whole object's error per pixel beside that of a region, whose own highlights may say nothing."""
MIN_SPREAD = 0.08
"""Standard deviation of the roughness over all pixels above which regions count as different. That of an object of one
roughness is 0.03 to 0.06, since errors of light and shape differ from region to region."""
ERROR_FLOOR = 0.005
"""Absolute error below which all residuals have the same weight [sRGB]."""


@dataclass(frozen=True)
class Samples:
    """Pixels of several frames with their lobes, in linear radiance."""

    gaussian: Int64[Tensor, " p"]
    """Index of the Gaussian that each pixel shows."""
    diffuse: Float[Tensor, "p 3"]
    """Radiance of a white Lambertian surface."""
    specular: Float[Tensor, "p 3"]
    """Radiance of the specular lobe at scale 1."""
    photo: Float[Tensor, "p 3"]
    """Radiance of the input image."""


@dataclass(frozen=True)
class SpecularFit:
    """The best specular scale, and how the albedos depend on it."""

    specular_scale: float
    """Strength of the specular lobe relative to F0 = 0.04."""
    albedo_per_scale: Float[Tensor, "n 3"]
    """Decrease of each Gaussian's best albedo per unit of specular scale; 0 where no usable pixel shows it."""
    error: Float[Tensor, " n"]
    """Absolute error of each Gaussian's pixels as a dielectric [sRGB, sum]."""
    error_as_metal: Float[Tensor, " n"]
    """Likewise as a metal: with a specular lobe in its best colour, and no diffuse one."""


@torch.no_grad()
def fit(samples: Samples, n: int) -> SpecularFit:
    """The specular scale with the least absolute error in sRGB, each of `n` Gaussians having its best albedo.

    Absolute errors let edges and texture that the Gaussians do not resolve count little. Albedos may be negative here:
    a limit of 0 would bias the scale downwards on dark texture.
    """
    x, s, y = samples.diffuse, samples.specular, samples.photo
    sensitivity = _sensitivity(y)
    scale, of_lobe, weight, rest, lobe = y.new_zeros(()), y.new_zeros(n, 3), sensitivity.square(), y, s

    def sum_by_gaussian(values: Tensor) -> Tensor:
        return _sums(samples.gaussian, values, n)

    for _ in range(REWEIGHTINGS):
        energy = sum_by_gaussian(weight * x.square()).clamp_min(1e-9)
        of_photo, of_lobe = (sum_by_gaussian(weight * x * z) / energy for z in (y, s))
        # What the diffuse lobe explains of neither determines the scale.
        rest, lobe = (z - albedo[samples.gaussian] * x for z, albedo in ((y, of_photo), (s, of_lobe)))
        scale = (weight * lobe * rest).sum() / (weight * lobe.square()).sum().clamp_min(1e-12)
        weight = sensitivity.square() / ((rest - scale * lobe).mul(sensitivity).abs() + ERROR_FLOOR)
    as_dielectric = sum_by_gaussian(((rest - scale * lobe) * sensitivity).abs()).sum(-1)
    as_metal = _least_error(samples.gaussian, s, y, sensitivity, n)
    return SpecularFit(max(float(scale), MIN_SCALE), of_lobe, as_dielectric, as_metal)


@torch.no_grad()
def metal_regions(fitted: SpecularFit, means: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Gaussians in whose neighbourhood metal explains the pixels about as well as a dielectric (`MAX_ERROR_RATIO`).

    Args:
        fitted: Result of `fit`.
        means: Centres of the Gaussians.
    """
    errors = torch.stack([fitted.error, fitted.error_as_metal], -1)
    parts = [errors[near].sum(1) for near in neighbours(means, min(NEIGHBOURS, len(means)))]
    as_dielectric, as_metal = torch.cat(parts).unbind(-1)
    return as_metal < MAX_ERROR_RATIO * as_dielectric


@torch.no_grad()
def of_regions(
    samples: Sequence[Samples], means: Float[Tensor, "n 3"], albedo: Float[Tensor, "n 3"], before: Float[Tensor, " n"]
) -> Float[Tensor, " n"] | None:
    """Roughness logits with the least absolute error of every region in sRGB, each Gaussian having its best albedo.

    A region is made of the `NEIGHBOURS` nearest Gaussians of similar albedo. The mean over all pixels is kept.

    Args:
        samples: The same pixels with the lobes of each of `ROUGHNESSES`.
        means: Centres of the Gaussians.
        albedo: Their linear albedos.
        before: Their roughness logits, which stay where no pixel shows a Gaussian.

    Returns:
        The logits; None if there are no pixels, or regions differ by no more than `MIN_SPREAD`.
    """
    gaussian, sensitivity = samples[0].gaussian, _sensitivity(samples[0].photo)
    without_lobes = ((x.diffuse, x.photo - x.specular) for x in samples)
    errors = torch.stack([_least_error(gaussian, *lit, sensitivity, len(means)) for lit in without_lobes])
    pixels = torch.bincount(gaussian, minlength=len(means)).to(errors)
    seen = torch.where(pixels > 0)[0]
    if not len(seen):
        return None
    of_object = errors.sum(1) / pixels.sum()
    features = torch.cat([means, ALBEDO_DISTANCE * albedo.clamp_min(0.01).log()], -1)[seen]
    own = errors[:, seen] + PRIOR * pixels[seen] * of_object[:, None]
    of_region = torch.cat([own[:, near].sum(-1) for near in neighbours(features, min(NEIGHBOURS, len(seen)))], -1)
    roughness, weight = _lowest(of_region), pixels[seen] / pixels.sum()
    if (weight * (roughness - (weight * roughness).sum()).square()).sum().sqrt() < MIN_SPREAD:
        return None
    logits = TEMPERATURE * torch.logit(roughness)
    return before.index_copy(0, seen, logits + (weight * (before[seen] - logits)).sum())


def _least_error(
    gaussian: Int64[Tensor, " p"],
    lobe: Float[Tensor, "p 3"],
    radiance: Float[Tensor, "p 3"],
    sensitivity: Float[Tensor, "p 3"],
    n: int,
) -> Float[Tensor, " n"]:
    """Sum of the absolute errors of each Gaussian's pixels with a lobe in its best colour [sRGB]."""
    weight, residual = sensitivity.square(), radiance
    for _ in range(REWEIGHTINGS):
        energy = _sums(gaussian, weight * lobe.square(), n).clamp_min(1e-9)
        colour = _sums(gaussian, weight * lobe * radiance, n) / energy
        residual = ((radiance - colour[gaussian] * lobe) * sensitivity).abs()
        weight = sensitivity.square() / (residual + ERROR_FLOOR)
    return _sums(gaussian, residual, n).sum(-1)


def _sums(gaussian: Int64[Tensor, " p"], values: Float[Tensor, "p 3"], n: int) -> Float[Tensor, "n 3"]:
    """Sums of the values of each Gaussian's pixels."""
    return values.new_zeros(n, 3).index_add_(0, gaussian, values)


def _lowest(errors: Float[Tensor, "r m"]) -> Float[Tensor, " m"]:
    """Roughness at the lowest point of the parabola through the lowest error and its neighbours, of each column."""
    middle = errors.argmin(0).clamp(1, len(errors) - 2)
    low, mid, high = (errors.gather(0, (middle + i)[None])[0] for i in (-1, 0, 1))
    offset = (0.5 * (low - high) / (low - 2 * mid + high).clamp_min(1e-12)).clamp(-1, 1)
    first, second = ROUGHNESSES[:2]
    return first + (middle + offset) * (second - first)


def _sensitivity(photo: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
    """The derivative of sRGB's curve, finite at black; 0 where the photo is clipped."""
    return 1.055 / 2.4 * photo.clamp(0.004, 1) ** (1 / 2.4 - 1) * (photo < CLIPPED)


@torch.no_grad()
def absorb_specular_scale(
    material: Material, log_specular_scale: Float[Tensor, "3"]
) -> tuple[Material, Float[Tensor, "3"]]:
    """Material, and log gain of the light, that render (almost) the same with a specular scale of 1.

    The specular lobe of a dielectric is grey, so the scale per channel is moved into the light and divided out of the
    albedo. Where this would make the albedo exceed `MAX_ALBEDO`, the object has a lower F0 instead; the fainter its
    lobe, the less the colour of the scale is used.
    """
    albedo = material.albedo
    min_gain = (albedo.flatten(0, 1).quantile(0.95, dim=0) / MAX_ALBEDO).log()
    deficit = (min_gain - log_specular_scale).max().clamp(min=0)
    mean = log_specular_scale.mean()
    gain = mean + (-deficit).exp() * (log_specular_scale - mean)
    gain = gain + (min_gain - gain).max().clamp(min=0)
    f0 = (material.f0 * (log_specular_scale - gain).exp()).mean().clamp(MIN_F0, DIELECTRIC)
    scaled_albedo = (albedo / gain.exp()).clamp(max=0.98)
    return replace(material.with_albedo(scaled_albedo), f0_logit=torch.logit(f0 / (2 * DIELECTRIC))), gain
