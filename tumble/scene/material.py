"""Albedo, roughness and normal offsets at the four corners of the plane of every Gaussian (paper section 4.3), and its
metalness, which the paper does not have.

Corner order: (-,-), (+,-), (-,+), (+,+) along the first and second local axis of the Gaussian.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

DIELECTRIC = 0.04
"""Reflectance at normal incidence (f0) of most non-metals (paper section 4.3)."""
TEMPERATURE = 2.0
"""Temperature of the sigmoid activations (appendix A), taken as sigmoid(x / 2), whose gradient vanishes later."""


@dataclass(frozen=True)
class Material:
    """Raw material parameters, as trained; the activated values are properties."""

    albedo_logits: Float[Tensor, "n 4 3"]
    """Linear base colour before activation."""
    roughness_logits: Float[Tensor, "n 4"]
    """Perceptual roughness r before activation; GGX alpha = r^2."""
    normal_offset: Float[Tensor, "n 4 3"]
    """Offset added to the normal of the Gaussian before normalisation, object frame."""
    f0_logit: Float[Tensor, ""]
    """Reflectance at normal incidence before activation, shared by the whole object."""
    metal_logits: Float[Tensor, " n"] | None = None
    """Metalness of every Gaussian before activation; None for an object without metal."""

    @staticmethod
    def constant(n: int, albedo: Float[Tensor, "3"], roughness: float) -> "Material":
        """Uniform material of `n` Gaussians: linear albedo and roughness in (0, 1), no normal offset."""
        albedo_logits = (TEMPERATURE * torch.logit(albedo)).expand(n, 4, 3).clone()
        rough = TEMPERATURE * torch.logit(albedo.new_tensor(roughness))
        f0_logit = albedo.new_zeros(())
        return Material(albedo_logits, rough.expand(n, 4).clone(), torch.zeros_like(albedo_logits), f0_logit)

    def with_albedo(self, albedo: Float[Tensor, "n 4 3"]) -> "Material":
        """The material with another linear base colour in (0, 1)."""
        return replace(self, albedo_logits=TEMPERATURE * torch.logit(albedo))

    @property
    def albedo(self) -> Float[Tensor, "n 4 3"]:
        """Linear base colour in (0, 1)."""
        return torch.sigmoid(self.albedo_logits / TEMPERATURE)

    @property
    def roughness(self) -> Float[Tensor, "n 4"]:
        """Perceptual roughness in (0, 1)."""
        return torch.sigmoid(self.roughness_logits / TEMPERATURE)

    @property
    def metalness(self) -> Float[Tensor, " n"] | None:
        """Metalness in (0, 1): 1 where all light is reflected at the surface, in the base colour, as by a metal."""
        return None if self.metal_logits is None else torch.sigmoid(self.metal_logits / TEMPERATURE)

    @property
    def diffuse_albedo(self) -> Float[Tensor, "n 3"]:
        """Linear albedo of every Gaussian's diffuse lobe, mean of its corners; that of a metal is 0."""
        albedo = self.albedo.mean(1)
        return albedo if self.metalness is None else albedo * (1 - self.metalness[:, None])

    @property
    def f0(self) -> Float[Tensor, ""]:
        """Reflectance at normal incidence in (0, 2 * DIELECTRIC); a logit of 0 gives DIELECTRIC."""
        return 2 * DIELECTRIC * torch.sigmoid(self.f0_logit)
