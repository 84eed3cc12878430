"""Roughness and specular scale of an object by grid search, with all albedos eliminated.

    radiance of a pixel that shows Gaussian i = albedo_i * diffuse + specular_scale * specular(roughness)

The *specular scale* is the strength of the specular lobe relative to a dielectric with F0 = 0.04. Albedo and specular
scale are strongly correlated, so gradient descent on both converges slowly, and roughness hardly moves at all.
Therefore every pair of roughness and scale of a grid is evaluated with the best albedo of every Gaussian (variable
projection, Golub and Pereyra 1973). One pair is chosen for the whole object.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.scene import DIELECTRIC, TEMPERATURE, Material

MAX_ALBEDO = 0.9
"""Upper limit of the 95 % quantile of an object's albedo."""
CLIPPED = 0.95
"""Linear radiance from which a pixel counts as clipped and is ignored."""
MIN_INDEPENDENT_FRACTION = 0.02
"""Minimum fraction of the specular lobe's weighted energy that the diffuse lobe does not explain: below it, the scale
is not observable."""
ROUGHNESSES = (0.3, 0.4, 0.5, 0.6)
"""Grid of roughness values."""
SPECULAR_SCALES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.4)
"""Grid of specular scales, the same for all colour channels. An optimum at either end of the grid is rejected."""
MIN_IMPROVEMENT = 0.01
"""Minimum relative decrease of the error against the initial pair: errors of shape and light alone cause smaller
ones."""
MIN_REFINED_SCALE = 0.87
"""Specular scale after stage 2 above which the grid search is run: matte objects stay below it."""
REWEIGHTINGS = 6
"""Iterations of reweighted least squares, which converge to least absolute errors."""
ERROR_FLOOR = 0.005
"""Absolute error below which all residuals have the same weight [sRGB]."""


@dataclass(frozen=True)
class Samples:
    """Pixels of several frames with their lobes, in linear radiance."""

    gaussian: Int64[Tensor, " p"]
    """Index of the Gaussian that each pixel shows."""
    diffuse: Float[Tensor, "p 3"]
    """Radiance of a white Lambertian surface."""
    specular: Float[Tensor, "r p 3"]
    """Radiance of the specular lobe at scale 1, for each of the `r` candidate roughness values."""
    photo: Float[Tensor, "p 3"]
    """Radiance of the input image."""


@dataclass(frozen=True)
class SpecularFit:
    """The best pair of roughness and specular scale, and how the albedos depend on the scale."""

    roughness_index: int
    """Index into the candidate roughness values of the samples."""
    specular_scale: float
    """Strength of the specular lobe relative to F0 = 0.04."""
    albedo_per_scale: Float[Tensor, "r n 3"]
    """Decrease of each Gaussian's best albedo per unit of specular scale, at each roughness; 0 for Gaussians without
    samples."""


@torch.no_grad()
def fit(samples: Samples, n: int, roughness_index: int, specular_scale: float) -> SpecularFit | None:
    """The pair of the grid with the smallest error, or None if it is not clearly better than the initial pair.

    Errors are absolute errors in sRGB, so that edges and texture that the Gaussians do not resolve count little.
    Roughness is chosen with albedos limited to be non-negative, since too wide a lobe would need negative ones. The
    scale is then chosen without this limit, which would bias it downwards on dark texture.

    Args:
        samples: Pixels with their lobes.
        n: Number of Gaussians.
        roughness_index: Initial roughness, as an index into the candidates of the samples.
        specular_scale: Initial specular scale.
    """

    # Sums by Gaussian are faster if its pixels are neighbours in memory.
    order = samples.gaussian.argsort(stable=True)
    gaussian, diffuse, photo = (x[order] for x in (samples.gaussian, samples.diffuse, samples.photo))
    samples = Samples(gaussian, diffuse, samples.specular[:, order], photo)
    counts = torch.bincount(gaussian, minlength=n)

    def errors(specular: Tensor, min_albedo: float) -> Tensor:
        return torch.stack([fit_error(samples, specular, scale, counts, min_albedo)[0] for scale in SPECULAR_SCALES])

    grid = torch.stack([errors(specular, 0.0) for specular in samples.specular])
    initial_error = fit_error(samples, samples.specular[roughness_index], specular_scale, counts, 0.0)[0]
    if grid.min() > (1 - MIN_IMPROVEMENT) * initial_error:
        return None
    best_roughness = int(grid.amin(1).argmin())
    best_scale = int(errors(samples.specular[best_roughness], -math.inf).argmin())
    if best_scale in (0, len(SPECULAR_SCALES) - 1):
        return None  # errors of light and shape can make the optimal scale grow without limit
    scale = SPECULAR_SCALES[best_scale]
    x, s = samples.diffuse, samples.specular[best_roughness]
    _, weight = fit_error(samples, s, scale, counts, -math.inf)
    albedo_per_scale = torch.stack([_albedos(samples, weight, y, counts) for y in samples.specular])
    independent = s - albedo_per_scale[best_roughness][samples.gaussian] * x
    fraction = ((weight * independent.square()).sum(0) / (weight * s.square()).sum(0).clamp_min(1e-12)).mean()
    return SpecularFit(best_roughness, scale, albedo_per_scale) if fraction > MIN_INDEPENDENT_FRACTION else None


def fit_error(
    samples: Samples, specular: Float[Tensor, "p 3"], scale: float, counts: Int64[Tensor, " n"], min_albedo: float
) -> tuple[Float[Tensor, ""], Float[Tensor, "p 3"]]:
    """Mean absolute error in sRGB with the best albedo of every Gaussian, and the final weights of the pixels.

    Args:
        samples: Pixels with their lobes, sorted by Gaussian.
        specular: Specular lobe at scale 1, of one roughness.
        scale: Specular scale.
        counts: Number of pixels of every Gaussian.
        min_albedo: Lower limit of the albedos.
    """
    y = samples.photo
    # The derivative of sRGB's curve, finite at black.
    sensitivity = 1.055 / 2.4 * y.clamp(0.004, 1) ** (1 / 2.4 - 1) * (y < CLIPPED)
    squared, diffuse = sensitivity.square(), y - scale * specular
    weight, error = squared, y
    for _ in range(REWEIGHTINGS):
        albedo = _albedos(samples, weight, diffuse, counts).clamp_min(min_albedo)
        modelled = albedo.index_select(0, samples.gaussian).mul_(samples.diffuse)
        error = torch.sub(diffuse, modelled, out=modelled).mul_(sensitivity).abs_()
        weight = squared / (error + ERROR_FLOOR)
    return error.mean(), weight


def _albedos(
    samples: Samples, weight: Float[Tensor, "p 3"], radiance: Float[Tensor, "p 3"], counts: Int64[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    """Weighted least-squares albedo of each Gaussian for a given diffuse radiance of the pixels."""

    def sum_by_gaussian(values: Tensor) -> Tensor:
        return torch.segment_reduce(values, "sum", lengths=counts, unsafe=True)

    weighted = weight * samples.diffuse
    return sum_by_gaussian(weighted * radiance) / sum_by_gaussian(weighted * samples.diffuse).clamp_min(1e-9)


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
    f0 = (material.f0 * (log_specular_scale - gain).exp()).mean().clamp(max=DIELECTRIC)
    scaled_albedo = (albedo / gain.exp()).clamp(max=0.98)
    albedo_logits = TEMPERATURE * torch.logit(scaled_albedo)
    return replace(material, albedo_logits=albedo_logits, f0_logit=torch.logit(f0 / (2 * DIELECTRIC))), gain
