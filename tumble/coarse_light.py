"""Stage 2's colour: it knows that the light does not turn with the object (deviation from the paper's static colour).

    c = albedo * E(R_env_obj n) + F(n.v) * S(R_env_obj r),    r = the reflection of the view direction

with irradiance E / pi and glossy light S shared by all Gaussians, each 16 spherical harmonics in the env frame. On
hand-held captures a static colour per Gaussian can only fit the mean over poses; and albedo and light found here are
where stage 3 starts.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, softplus

from tumble import harmonics
from tumble.directions import reflect, texel_directions
from tumble.environment import Environment
from tumble.material import DIELECTRIC


@dataclass(frozen=True)
class CoarseLight:
    """Low-order light, as trained: radiances are softplus of these expansions."""

    irradiance: Float[Tensor, "16 3"]
    """Of (irradiance / pi) before softplus, by the env-frame normal."""
    specular: Float[Tensor, "16 3"]
    """Of the light that a glossy surface mirrors before softplus, by the env-frame reflection."""

    @staticmethod
    def constant(level: float, like: Tensor) -> "CoarseLight":
        """The same light from everywhere: irradiance / pi = `level`, nothing mirrored to speak of."""
        coefficients = torch.zeros(16, 3, dtype=like.dtype, device=like.device)
        dc = 0.28209479177387814
        irradiance, specular = coefficients.clone(), coefficients.clone()
        irradiance[0] = _inverse_softplus(level) / dc
        specular[0] = _inverse_softplus(level) / dc
        return CoarseLight(irradiance, specular)

    def diffuse(self, n_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Irradiance / pi on surfaces with env-frame normals."""
        return softplus(harmonics.basis(n_env, 3) @ self.irradiance)

    def glossy(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Mirrored light from env-frame directions."""
        return softplus(harmonics.basis(d_env, 3) @ self.specular)


def radiance(
    light: CoarseLight,
    albedo: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    view: Float[Tensor, "n 3"],
    R_env_obj: Float[Tensor, "3 3"],
) -> Float[Tensor, "n 3"]:
    """Linear radiance of surface points towards the eye.

    Args:
        normals: Outward, object frame.
        view: Unit directions from the points to the camera, object frame.
    """
    n_v = (normals * view).sum(-1, keepdim=True).clamp(0, 1)
    fresnel = DIELECTRIC + (1 - DIELECTRIC) * (1 - n_v) ** 5
    mirrored = normalize(reflect(view, normals), dim=-1)
    return albedo * light.diffuse(normals @ R_env_obj.T) + fresnel * light.glossy(mirrored @ R_env_obj.T)


def environment(light: CoarseLight, height: int, *, floor: float = 0.15) -> Environment:
    """A light map whose irradiance is about that of a coarse light: the start of stage 3.

    The cosine lobe is divided out to degree 2 (irradiance says little beyond), and the result is kept above `floor`
    times its mean, for a low-order expansion rings below zero opposite a lamp.
    """
    directions = texel_directions(height, 2 * height).to(light.irradiance)
    irradiance = light.diffuse(directions)
    coefficients = harmonics.project(irradiance)
    sharpen = torch.tensor([1.0, *[1.5] * 3, *[4.0] * 5, *[0.0] * 7]).to(coefficients)
    expanded = harmonics.basis(directions, 3) @ (coefficients * sharpen[:, None])
    return Environment.from_radiance(torch.maximum(expanded, floor * irradiance.mean((0, 1))))


def _inverse_softplus(y: float) -> float:
    return float(torch.tensor(y, dtype=torch.float64).expm1().log())
