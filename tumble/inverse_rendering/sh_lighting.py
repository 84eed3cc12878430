"""Colour model of stage 2: shading by one spherical-harmonic light that is fixed in the env frame.

    c = albedo * E(R_env_obj n) + h f0 G(n.v) * S(R_env_obj r),    r = the reflection of the view direction

E is irradiance / pi and S the prefiltered radiance for a glossy lobe, both derived from one light of 16 spherical
harmonics in the env frame, shared by all Gaussians. G is the split-sum factor of a lobe of roughness 0.5. The specular
scale h is learnt, because the absolute level of the light is unknown.

This deviates from the paper, whose colour per Gaussian is static in the object frame: with a light that stands still
relative to the camera, a static colour can only fit the mean over all poses. Albedo and light initialise stage 3. Both
lobes share one light, because separate lights would leave the colour of each light undetermined.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from tumble import backends
from tumble.inverse_rendering.self_shadowing import DIRECTIONS, VisibilityTransfer
from tumble.maths import fibonacci_sphere, spherical_harmonics, texel_directions
from tumble.scene import DIELECTRIC, Environment, Gaussians

GLOSSY_FALLOFF = 0.08
"""Width of the glossy lobe: harmonics of degree l are scaled by exp(-GLOSSY_FALLOFF l (l + 1)), as by a lobe of
roughness about 0.5."""
SPLIT_SUM_POLYNOMIAL = (0.937, -0.296, 5.535, -11.654, 20.113, -9.978)
"""Coefficients of a polynomial in 1 - n.v that approximates `brdf.split_sum` at roughness 0.5 within 0.03: 0.9 at
normal incidence, 4.7 at grazing angles."""


@dataclass(frozen=True)
class SHLight:
    """Light as spherical harmonics up to degree 3, with the scale of the specular lobe; raw parameters, as trained."""

    coefficients: Float[Tensor, "16 3"]
    """Coefficients of linear radiance, env frame. Values convolved with a lobe pass through a softplus, since a
    truncated series can be negative."""
    log_specular_scale: Float[Tensor, ""]
    """Natural logarithm of the specular lobe's scale relative to a dielectric with F0 = 0.04."""

    @staticmethod
    def constant(level: float, like: Tensor) -> "SHLight":
        """Uniform light whose irradiance / pi and glossy radiance equal `level`, with specular scale 1."""
        coefficients = torch.zeros(16, 3, dtype=like.dtype, device=like.device)
        coefficients[0] = _inverse_softplus(level) / 0.28209479177387814
        return SHLight(coefficients, coefficients.new_zeros(()))

    def diffuse(self, n_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Irradiance / pi of surfaces with unit normals `n_env`, env frame."""
        return softplus(
            spherical_harmonics.basis(n_env, 3)
            @ (self.coefficients * _lobes(self.coefficients.dtype, self.coefficients.device)[0])
        )

    def glossy(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Radiance convolved with the glossy lobe around unit directions `d_env`, env frame."""
        return softplus(
            spherical_harmonics.basis(d_env, 3)
            @ (self.coefficients * _lobes(self.coefficients.dtype, self.coefficients.device)[1])
        )


def radiance(
    light: SHLight,
    points: Gaussians,
    albedo_logits: Float[Tensor, "n 3"],
    visibility: VisibilityTransfer | None,
    R_env_obj: Float[Tensor, "3 3"],
    position: Float[Tensor, "3"],
) -> Float[Tensor, "n 3"]:
    """Linear radiance of Gaussians towards the camera (exact in `Backend.sh_shade`).

    The gradient from shading to the normals is reduced, and the ratio of shadowed to unshadowed irradiance counts as a
    constant, so that the dependence on the normal remains in E.

    Args:
        light: Light and specular scale.
        points: Gaussians, of which centres and rotations are used.
        albedo_logits: Linear diffuse albedo before the sigmoid.
        visibility: For self-shadowing; no self-shadowing when None.
        R_env_obj: Rotation from the object frame to the env frame.
        position: Camera centre, object frame.
    """
    means, (cosine, gloss) = points.means, _lobes(light.coefficients.dtype, light.coefficients.device)
    both = torch.stack([light.coefficients * cosine, light.coefficients * gloss])
    directions, reflectance = _constants(means.dtype, means.device)
    none = means.new_zeros(0, 9)
    occluded, unoccluded = (none, none) if visibility is None else (visibility.occluded, visibility.unoccluded)
    own = (means, points.quats, albedo_logits, both, light.log_specular_scale.exp())
    rest = (occluded, unoccluded, directions, reflectance, R_env_obj, position)
    return backends.choose(means.device, means.dtype).sh_shade(*own, *rest)


@cache
def _constants(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "D 3"], Float[Tensor, " k"]]:
    """Directions over which the light is integrated, and the reflectance as a polynomial in 1 - n.v."""
    reflectance = DIELECTRIC * torch.tensor(SPLIT_SUM_POLYNOMIAL, dtype=torch.float64)
    return fibonacci_sphere(DIRECTIONS).to(device, dtype), reflectance.to(device, dtype)


@cache
def _lobes(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "2 16 1"]:
    """Factors per coefficient of a convolution with the clamped cosine over pi, and with the glossy lobe."""
    degrees = [l for l in range(4) for _ in range(2 * l + 1)]  # noqa: E741
    cosine = [spherical_harmonics.COSINE_LOBE[l] / math.pi for l in degrees]  # noqa: E741
    gloss = [math.exp(-GLOSSY_FALLOFF * l * (l + 1)) for l in degrees]  # noqa: E741
    return torch.tensor([cosine, gloss], dtype=dtype, device=device)[..., None]


def environment(light: SHLight, height: int) -> Environment:
    """Environment map with the glossy radiance of a spherical-harmonic light: the initial light of stage 3."""
    return Environment.from_radiance(light.glossy(texel_directions(height, 2 * height).to(light.coefficients)))


def _inverse_softplus(y: float) -> float:
    """The value whose softplus is `y`."""
    return float(torch.tensor(y, dtype=torch.float64).expm1().log())
