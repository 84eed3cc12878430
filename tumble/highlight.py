"""How strong the highlight is, and what that says of light and albedo.

Its strength comes in closed form: the least-squares fit in which every Gaussian's albedo is free.

    photograph = albedo_i * diffuse + strength * specular        at a pixel that shows Gaussian i

Albedo and strength trade against each other: what a highlight lacks, dark print takes up, and a descent on both moves
along that valley for thousands of steps (a red whose green is 0.009 stays at 0.02). Eliminating the albedos leaves one
equation per channel (variable projection, Golub and Pereyra 1973).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.material import DIELECTRIC, TEMPERATURE, Material

BRIGHTEST = 0.9
"""Albedo that 95 % of a surface stays below."""
CLIPPED = 0.95
"""Linear radiance from which a pixel may be clipped and says nothing."""
TOLD = 0.02
"""Share of the highlight that must differ from diffuse light for a fit: 0.1 to 0.3 on objects of the benchmark."""
ROUNDS = 12
"""Of reweighting, towards least absolute errors."""
NOISE = 0.005
"""Error under which all residuals weigh the same, sRGB."""
LEAST = 0.02
"""Strength found where the fit asks for less."""
SHARED = 0.1
"""Weight of the channels' common strength, in units of the evidence for it: a bright channel says little."""


@dataclass(frozen=True)
class Samples:
    """Pixels of several frames, linear."""

    gaussian: Int64[Tensor, " p"]
    """Which Gaussian a pixel shows."""
    diffuse: Float[Tensor, "p 3"]
    """Radiance of a white surface without highlight."""
    specular: Float[Tensor, "p 3"]
    """Radiance of a black surface with the highlight of strength 1."""
    photograph: Float[Tensor, "p 3"]


@dataclass(frozen=True)
class Fit:
    """Strengths, and what they mean for the albedos."""

    strength: Float[Tensor, "3"]
    slope: Float[Tensor, "n 3"]
    """How much of each Gaussian's albedo a unit of strength replaces; 0 where no sample shows it."""


@torch.no_grad()
def fit(samples: Samples, n: int) -> Fit | None:
    """The strength of the highlight per channel, of an object of `n` Gaussians; None where the frames do not tell.

    Errors count as they would in sRGB, and by their absolute value rather than their square: edges and print that the
    Gaussians cannot follow are no evidence. Channels share what evidence they have.
    """
    x, s, y = samples.diffuse, samples.specular, samples.photograph
    # The derivative of sRGB's curve, finite at black.
    sensitivity = 1.055 / 2.4 * y.clamp(0.004, 1) ** (1 / 2.4 - 1) * (y < CLIPPED)
    weight = sensitivity.square()

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(n, 3).index_add(0, samples.gaussian, values)

    strength, slope, evidence = y.new_ones(3), y.new_zeros(n, 3), y.new_zeros(3)
    for _ in range(ROUNDS):
        squared = summed(weight * x * x).clamp_min(1e-9)
        slope, albedo = summed(weight * x * s) / squared, summed(weight * x * y) / squared
        s_rest, y_rest = s - slope[samples.gaussian] * x, y - albedo[samples.gaussian] * x
        products, evidence = (weight * s_rest * y_rest).sum(0), (weight * s_rest.square()).sum(0)
        shared = SHARED * evidence.mean()
        common = products.sum() / evidence.sum().clamp_min(1e-12)
        strength = ((products + shared * common) / (evidence + shared).clamp_min(1e-12)).clamp_min(LEAST)
        albedo = (albedo - strength * slope).clamp_min(0)
        error = (y - albedo[samples.gaussian] * x - strength * s) * sensitivity
        weight = sensitivity.square() / (error.abs() + NOISE)
    told = (evidence / (weight * s.square()).sum(0).clamp_min(1e-12)).mean()
    return Fit(strength, slope) if told > TOLD else None


@torch.no_grad()
def shared_out(material: Material, log_tint: Float[Tensor, "3"]) -> tuple[Material, Float[Tensor, "3"]]:
    """Material and logarithmic gain of the light that look the same without a tint of the highlight.

    The highlight of a dielectric is grey: its tint belongs into the light, and out of the albedo. Where that would
    leave an albedo above 1, it is the object that has less of a highlight than glass, and the fainter that is, the less
    its colour counts.
    """
    albedo = material.albedo
    bound = (albedo.flatten(0, 1).quantile(0.95, dim=0) / BRIGHTEST).log()
    faint = (bound - log_tint).max().clamp(min=0)
    mean = log_tint.mean()
    gain = mean + (-faint).exp() * (log_tint - mean)
    gain = gain + (bound - gain).max().clamp(min=0)
    f0 = (material.f0 * (log_tint - gain).exp()).mean().clamp(max=DIELECTRIC)
    lit = (albedo / gain.exp()).clamp(max=0.98)
    albedo_logits = TEMPERATURE * torch.logit(lit)
    return replace(material, albedo_logits=albedo_logits, f0_logit=torch.logit(f0 / (2 * DIELECTRIC))), gain
