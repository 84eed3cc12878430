"""Stage 2's colour: it knows that the light does not turn with the object (deviation from the paper's static colour).

    c = albedo * E(R_env_obj n) + F(n.v) * S(R_env_obj r),    r = the reflection of the view direction

where E is irradiance / pi and S the light that a glossy surface mirrors, both of one light: 16 spherical harmonics in
the env frame, shared by all Gaussians. On hand-held captures a static colour per Gaussian can only fit the mean over
poses; and albedo and light found here are where stage 3 starts. Two free lights, one for each lobe, would leave their
tints to chance.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, softplus

from tumble import harmonics
from tumble.directions import reflect, texel_directions
from tumble.environment import Environment
from tumble.material import DIELECTRIC

GLOSS = 0.08
"""Width of the mirrored lobe: degree l is dimmed by exp(-GLOSS l (l + 1)), as by a lobe of roughness about 0.5."""


@dataclass(frozen=True)
class CoarseLight:
    """Low-order light, as trained."""

    coefficients: Float[Tensor, "16 3"]
    """Of radiance, env frame. What a lobe makes of it goes through softplus, for a short series rings below zero."""

    @staticmethod
    def constant(level: float, like: Tensor) -> "CoarseLight":
        """The same light from everywhere: irradiance / pi and mirrored light are `level`."""
        coefficients = torch.zeros(16, 3, dtype=like.dtype, device=like.device)
        coefficients[0] = _inverse_softplus(level) / 0.28209479177387814
        return CoarseLight(coefficients)

    def diffuse(self, n_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Irradiance / pi on surfaces with env-frame normals."""
        lobe = harmonics.irradiance_coefficients(self.coefficients) / math.pi
        return softplus(harmonics.basis(n_env, 3) @ lobe)

    def glossy(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Mirrored light from env-frame directions."""
        dimmed = [math.exp(-GLOSS * l * (l + 1)) for l in range(4) for _ in range(2 * l + 1)]  # noqa: E741
        return softplus(harmonics.basis(d_env, 3) @ (self.coefficients * self.coefficients.new_tensor(dimmed)[:, None]))


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


def environment(light: CoarseLight, height: int) -> Environment:
    """The light map that a coarse light stands for, as a glossy surface mirrors it: the start of stage 3."""
    return Environment.from_radiance(light.glossy(texel_directions(height, 2 * height).to(light.coefficients)))


def _inverse_softplus(y: float) -> float:
    return float(torch.tensor(y, dtype=torch.float64).expm1().log())
