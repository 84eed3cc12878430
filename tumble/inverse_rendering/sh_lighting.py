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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from tumble.maths import spherical_harmonics, texel_directions
from tumble.scene import DIELECTRIC, Environment

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
        return softplus(spherical_harmonics.basis(n_env, 3) @ (self.coefficients * _lobes(self.coefficients)[0]))

    def glossy(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Radiance convolved with the glossy lobe around unit directions `d_env`, env frame."""
        return softplus(spherical_harmonics.basis(d_env, 3) @ (self.coefficients * _lobes(self.coefficients)[1]))


def radiance(
    light: SHLight,
    albedo: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    view: Float[Tensor, "n 3"],
    R_env_obj: Float[Tensor, "3 3"],
) -> Float[Tensor, "n 3"]:
    """Linear radiance of surface points towards the camera; differentiable in all arguments.

    Args:
        light: Light and specular scale.
        albedo: Linear diffuse albedo.
        normals: Outward unit normals, object frame.
        view: Unit directions from the points to the camera, object frame.
        R_env_obj: Rotation from the object frame to the env frame.
    """
    return _Radiance.apply(light.coefficients, light.log_specular_scale, albedo, normals, view, R_env_obj)


class _Radiance(torch.autograd.Function):
    """`radiance` with an explicit backward pass, which takes a third of the time of automatic differentiation.

    Tensors are transposed to `[3 n]` inside, since sums over many short rows are slow.
    """

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        coefficients, log_specular_scale, R_env_obj = args[0], args[1], args[5]
        albedo, normals, view = (x.mT.contiguous() for x in args[2:5])
        n_v = (normals * view).sum(0)
        reflectance = DIELECTRIC * _polynomial(SPLIT_SUM_POLYNOMIAL, 1 - n_v.clamp(0, 1))
        mirrored = 2 * n_v * normals - view
        lobes, scale = _lobes(coefficients), log_specular_scale.exp()
        diffuse, at_normals = spherical_harmonics.sum_series(coefficients * lobes[0], R_env_obj @ normals)
        glossy, at_mirrored = spherical_harmonics.sum_series(coefficients * lobes[1], R_env_obj @ mirrored)
        diffuse, glossy = softplus(diffuse), softplus(glossy)
        saved = (coefficients, scale, R_env_obj, albedo, normals, view, mirrored, n_v, reflectance)
        ctx.save_for_backward(*saved, diffuse, at_normals, glossy, at_mirrored)
        return (albedo * diffuse + scale * reflectance * glossy).mT

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        coefficients, scale, R, albedo, normals, view, mirrored, n_v, reflectance, *lights = ctx.saved_tensors
        diffuse, at_normals, glossy, at_mirrored = lights
        lobes, v = _lobes(coefficients), v.mT.contiguous()
        v_lobe = v * scale
        # The derivative of y = softplus(x) is 1 - exp(-y).
        v_diffuse, v_glossy = -v * albedo * torch.expm1(-diffuse), -v_lobe * reflectance * torch.expm1(-glossy)
        v_first, v_n_env = spherical_harmonics.series_adjoint(coefficients * lobes[0], at_normals, v_diffuse)
        v_second, v_mirrored_env = spherical_harmonics.series_adjoint(coefficients * lobes[1], at_mirrored, v_glossy)
        v_mirrored = R.mT @ v_mirrored_env
        v_reflectance = torch.where((n_v >= 0) & (n_v <= 1), (v_lobe * glossy).sum(0), 0.0)
        slope = _polynomial([k * c for k, c in enumerate(SPLIT_SUM_POLYNOMIAL)][1:], 1 - n_v.clamp(0, 1))
        v_n_v = 2 * (v_mirrored * normals).sum(0) - DIELECTRIC * slope * v_reflectance
        v_normals = R.mT @ v_n_env + 2 * n_v * v_mirrored + v_n_v * view
        return (
            v_first * lobes[0] + v_second * lobes[1],
            (v_lobe * glossy * reflectance).sum(),
            (v * diffuse).mT,
            v_normals.mT,
            (v_n_v * normals - v_mirrored).mT,
            v_n_env @ normals.mT + v_mirrored_env @ mirrored.mT,
        )


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """Sum of c_k x^k by Horner's scheme."""
    total = torch.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def _lobes(like: Tensor) -> Float[Tensor, "2 16 1"]:
    """Factors per coefficient of a convolution with the clamped cosine over pi, and with the glossy lobe."""
    degrees = [l for l in range(4) for _ in range(2 * l + 1)]  # noqa: E741
    cosine = [spherical_harmonics.COSINE_LOBE[l] / math.pi for l in degrees]  # noqa: E741
    gloss = [math.exp(-GLOSSY_FALLOFF * l * (l + 1)) for l in degrees]  # noqa: E741
    return like.new_tensor([cosine, gloss])[..., None]


def environment(light: SHLight, height: int) -> Environment:
    """Environment map with the glossy radiance of a spherical-harmonic light: the initial light of stage 3."""
    return Environment.from_radiance(light.glossy(texel_directions(height, 2 * height).to(light.coefficients)))


def _inverse_softplus(y: float) -> float:
    """The value whose softplus is `y`."""
    return float(torch.tensor(y, dtype=torch.float64).expm1().log())
