"""Albedo, roughness and normal detail at the four corners of every Gaussian's plane (paper section 4.3).

Corner order: (-,-), (+,-), (-,+), (+,+) along the Gaussian's first and second local axis.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

DIELECTRIC = 0.04
"""Reflectance at normal incidence of most things that are not metal (paper section 4.3)."""
TEMPERATURE = 2.0
"""Appendix A: sigmoid with temperature 2. Read as sigmoid(x / 2), whose tails keep a gradient further out."""


@dataclass(frozen=True)
class Material:
    """Raw material parameters, as trained; the activated values are properties."""

    albedo_logits: Float[Tensor, "n 4 3"]
    """Linear base colour before activation."""
    roughness_logits: Float[Tensor, "n 4"]
    """Perceptual roughness r before activation; GGX alpha = r^2."""
    normal_offset: Float[Tensor, "n 4 3"]
    """Added to the Gaussian's normal before it is normalised, object frame."""
    f0_logit: Float[Tensor, ""]
    """Reflectance at normal incidence before activation, one for the object."""

    @staticmethod
    def constant(n: int, albedo: Float[Tensor, "3"], roughness: float) -> "Material":
        """`n` Gaussians of one material: linear albedo and roughness in (0, 1), no normal detail."""
        albedo_logits = (TEMPERATURE * torch.logit(albedo)).expand(n, 4, 3).clone()
        rough = TEMPERATURE * torch.logit(albedo.new_tensor(roughness))
        f0_logit = albedo.new_zeros(())
        return Material(albedo_logits, rough.expand(n, 4).clone(), torch.zeros_like(albedo_logits), f0_logit)

    @property
    def albedo(self) -> Float[Tensor, "n 4 3"]:
        """Linear base colour in (0, 1)."""
        return torch.sigmoid(self.albedo_logits / TEMPERATURE)

    @property
    def roughness(self) -> Float[Tensor, "n 4"]:
        """Perceptual roughness in (0, 1)."""
        return torch.sigmoid(self.roughness_logits / TEMPERATURE)

    @property
    def f0(self) -> Float[Tensor, ""]:
        """Reflectance at normal incidence: 0.04, the paper's dielectric, where the logit is 0; at most twice that."""
        return 2 * DIELECTRIC * torch.sigmoid(self.f0_logit)
