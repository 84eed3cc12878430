"""Stage 2's colour: it knows that the light does not turn with the object (deviation from the paper's static colour).

    c = albedo * E(R_env_obj n) + h f0 G(n.v) * S(R_env_obj r),    r = the reflection of the view direction

where E is irradiance / pi and S the light that a glossy surface mirrors, both of one light: 16 spherical harmonics in
the env frame, shared by all Gaussians. G is the share that the split sum gives to a lobe of roughness 0.5, and h says
how much of such a highlight there is, under a light whose level is a guess: without it a Lambertian box bends its
normals by 8 degrees to hide the highlight that it lacks, with it by 3.

On hand-held captures a static colour per Gaussian can only fit the mean over poses; and albedo and light found here are
where stage 3 starts. Two free lights, one for each lobe, would leave their tints to chance.
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

GLOSS = 0.08
"""Width of the mirrored lobe: degree l is dimmed by exp(-GLOSS l (l + 1)), as by a lobe of roughness about 0.5."""
LOBE = (0.937, -0.296, 5.535, -11.654, 20.113, -9.978)
"""`brdf.split_sum` at roughness 0.5, a polynomial in 1 - n.v within 0.03: 0.9 face to face, 4.7 at grazing."""


@dataclass(frozen=True)
class CoarseLight:
    """Low-order light, as trained."""

    coefficients: Float[Tensor, "16 3"]
    """Of radiance, env frame. What a lobe makes of it goes through softplus, for a short series rings below zero."""
    log_highlight: Float[Tensor, ""]
    """How much brighter the highlight is than that of glass under this light."""

    @staticmethod
    def constant(level: float, like: Tensor) -> "CoarseLight":
        """The same light from everywhere, and glass: irradiance / pi and mirrored light are `level`."""
        coefficients = torch.zeros(16, 3, dtype=like.dtype, device=like.device)
        coefficients[0] = _inverse_softplus(level) / 0.28209479177387814
        return CoarseLight(coefficients, coefficients.new_zeros(()))

    def diffuse(self, n_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Irradiance / pi on surfaces with env-frame normals."""
        return softplus(spherical_harmonics.basis(n_env, 3) @ (self.coefficients * _lobes(self.coefficients)[0]))

    def glossy(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Mirrored light from env-frame directions."""
        return softplus(spherical_harmonics.basis(d_env, 3) @ (self.coefficients * _lobes(self.coefficients)[1]))


def radiance(
    light: CoarseLight,
    albedo: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    view: Float[Tensor, "n 3"],
    R_env_obj: Float[Tensor, "3 3"],
) -> Float[Tensor, "n 3"]:
    """Linear radiance of surface points towards the eye.

    Args:
        normals: Outward unit normals, object frame.
        view: Unit directions from the points to the camera, object frame.
    """
    return _Radiance.apply(light.coefficients, light.log_highlight, albedo, normals, view, R_env_obj)


class _Radiance(torch.autograd.Function):
    """`radiance` with its derivative written out: a third of the time, of what is half of a step's small tensors.

    x, y and z (and red, green and blue) are rows: sums over many short rows are slow.
    """

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        coefficients, log_highlight, R_env_obj = args[0], args[1], args[5]
        albedo, normals, view = (x.mT.contiguous() for x in args[2:5])
        n_v = (normals * view).sum(0)
        share = DIELECTRIC * _polynomial(LOBE, 1 - n_v.clamp(0, 1))
        mirrored = 2 * n_v * normals - view
        lobes, strength = _lobes(coefficients), log_highlight.exp()
        diffuse, at_normals = spherical_harmonics.sum_series(coefficients * lobes[0], R_env_obj @ normals)
        glossy, at_mirrored = spherical_harmonics.sum_series(coefficients * lobes[1], R_env_obj @ mirrored)
        diffuse, glossy = softplus(diffuse), softplus(glossy)
        kept = (coefficients, strength, R_env_obj, albedo, normals, view, mirrored, n_v, share)
        ctx.save_for_backward(*kept, diffuse, at_normals, glossy, at_mirrored)
        return (albedo * diffuse + strength * share * glossy).mT

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        coefficients, strength, R, albedo, normals, view, mirrored, n_v, share, *lights = ctx.saved_tensors
        diffuse, at_normals, glossy, at_mirrored = lights
        lobes, v = _lobes(coefficients), v.mT.contiguous()
        v_lobe = v * strength
        # The derivative of y = softplus(x) is 1 - exp(-y).
        v_diffuse, v_glossy = -v * albedo * torch.expm1(-diffuse), -v_lobe * share * torch.expm1(-glossy)
        v_first, v_n_env = spherical_harmonics.series_adjoint(coefficients * lobes[0], at_normals, v_diffuse)
        v_second, v_mirrored_env = spherical_harmonics.series_adjoint(coefficients * lobes[1], at_mirrored, v_glossy)
        v_mirrored = R.mT @ v_mirrored_env
        v_share = torch.where((n_v >= 0) & (n_v <= 1), (v_lobe * glossy).sum(0), 0.0)
        slope = _polynomial([k * c for k, c in enumerate(LOBE)][1:], 1 - n_v.clamp(0, 1))
        v_n_v = 2 * (v_mirrored * normals).sum(0) - DIELECTRIC * slope * v_share
        v_normals = R.mT @ v_n_env + 2 * n_v * v_mirrored + v_n_v * view
        return (
            v_first * lobes[0] + v_second * lobes[1],
            (v_lobe * glossy * share).sum(),
            (v * diffuse).mT,
            v_normals.mT,
            (v_n_v * normals - v_mirrored).mT,
            v_n_env @ normals.mT + v_mirrored_env @ mirrored.mT,
        )


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    """The sum of c_k x^k, after Horner."""
    total = torch.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def _lobes(like: Tensor) -> Float[Tensor, "2 16 1"]:
    """What the clamped cosine over pi, and the mirrored lobe, make of each coefficient."""
    degrees = [l for l in range(4) for _ in range(2 * l + 1)]  # noqa: E741
    cosine = [spherical_harmonics.COSINE_LOBE[l] / math.pi for l in degrees]  # noqa: E741
    gloss = [math.exp(-GLOSS * l * (l + 1)) for l in degrees]  # noqa: E741
    return like.new_tensor([cosine, gloss])[..., None]


def environment(light: CoarseLight, height: int) -> Environment:
    """The light map that a coarse light stands for, as a glossy surface mirrors it: the start of stage 3."""
    return Environment.from_radiance(light.glossy(texel_directions(height, 2 * height).to(light.coefficients)))


def _inverse_softplus(y: float) -> float:
    return float(torch.tensor(y, dtype=torch.float64).expm1().log())
