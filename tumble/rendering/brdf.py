"""BRDF of a Lambertian and a GGX lobe, its importance sampling, and the split-sum table.

Directions are unit vectors that point away from the surface, `wi` to the light and `wo` to the eye; `n` is the unit
normal. `h` is the half vector between both, `nol`, `nov`, `noh`, `voh` are cosines between n, wi (l), wo (v) and h.
`roughness` is perceptual, r; GGX's alpha is a = r^2. `f0` is the reflectance at normal incidence. BRDF values are per
steradian and do not include the cosine of the rendering equation. The Fresnel term is that of a dielectric of index 1.5
(f0 0.04), scaled to f0. Metals (`metal`) have Schlick's instead, as in glTF, with their base colour as f0.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from tumble.maths import GOLDEN_ANGLE, local_frame, reflect

MIN_ROUGHNESS = 0.05
"""Lower limit of r in all formulas, without gradient below; the peak of the lobe there, 1 / (pi r^4), is 5e4."""
SPLIT_SUM_SAMPLES = 4096
"""Half vectors per entry of the split-sum table; their mean is within 1e-3 of the integral."""


def lambert(albedo: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Lambertian lobe, albedo / pi (paper section 4.3)."""
    return albedo / math.pi


def ggx(
    wi: Float[Tensor, "*#b 3"],
    wo: Float[Tensor, "*#b 3"],
    n: Float[Tensor, "*#b 3"],
    *,
    roughness: float | Float[Tensor, "*#b 1"],
    f0: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 1"]:
    """Specular lobe D F G / (4 nol nov) (eq. 12), 0 where light or eye are below the horizon.

    D is GGX, F is f0 times `fresnel`, and G is Smith's masking-shadowing function for GGX (Walter 2007, as cited by the
    paper), whose nol nov cancel against the denominator. Related methods use Schlick's approximation of G with
    k = (r + 1)^2 / 8, which is made for point lights: under an environment map it halves the reflected radiance at
    grazing angles.
    """
    without_fresnel, voh = _without_fresnel(wi, wo, n, roughness)
    return without_fresnel * f0 * fresnel(voh)


def metal(
    wi: Float[Tensor, "*#b 3"],
    wo: Float[Tensor, "*#b 3"],
    n: Float[Tensor, "*#b 3"],
    *,
    albedo: Float[Tensor, "*#b 3"],
    roughness: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 3"]:
    """Specular lobe of a metal, like `ggx`, with the base colour `albedo` at normal incidence and 1 at grazing angles
    (Schlick 1994)."""
    without_fresnel, voh = _without_fresnel(wi, wo, n, roughness)
    return without_fresnel * torch.lerp(albedo, torch.ones_like(albedo), schlick(voh))


def _without_fresnel(wi: Tensor, wo: Tensor, n: Tensor, roughness: float | Tensor) -> tuple[Tensor, Tensor]:
    """D G / (4 nol nov), 0 where light or eye are below the horizon, and the cosine of the half vector and the eye."""
    rough = _rough(roughness, wo)
    nol, nov = cosine(n, wi), cosine(n, wo)
    h = _half_vector(wi, wo, n)
    value = _ndf(h, n, rough) * _visibility(nol, nov, rough)
    return torch.where((nol > 0) & (nov > 0), value, 0.0), cosine(wo, h)


def schlick(voh: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Part of the reflectance that grows to 1 at grazing angles: F = f0 + (1 - f0) * schlick (Schlick 1994)."""
    return (1 - voh).clamp(0, 1) ** 5


def fresnel(voh: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Fresnel reflectance relative to normal incidence: 1 at normal incidence, 25 at grazing angles.

    A polynomial fit to Fresnel's equations for an index of 1.5, within 0.4 %. Schlick's approximation, which related
    methods use, is a fifth too low around 50 degrees. The curve is multiplied by f0 as a whole, so a surface with f0 =
    0 does not reflect at grazing angles either.
    """
    m = (1 - voh).clamp(0, 1)
    return 1 + 24 * m**3 * (0.9878 + m * (-3.8886 + m * (9.1922 + m * (-9.6217 + m * 4.3303))))


def evaluate(
    wi: Float[Tensor, "*#b 3"],
    wo: Float[Tensor, "*#b 3"],
    n: Float[Tensor, "*#b 3"],
    *,
    albedo: Float[Tensor, "*#b 3"],
    roughness: float | Float[Tensor, "*#b 1"],
    f0: float | Float[Tensor, "*#b 1"],
    metalness: Float[Tensor, "*#b 1"] | None = None,
) -> Float[Tensor, "*#b 3"]:
    """Sum of both lobes (paper section 4.3), for `wi` above the horizon; mixed with `metal` by metalness, as in glTF.

    As in the paper, the diffuse lobe is not reduced by the specular reflectance, so energy is not conserved: with
    f0 = 0.04 a white surface reflects up to 1.40 of a uniform light at roughness 0.2, seen 8 degrees above its horizon,
    and 1.04 at normal incidence (test_a_white_surface_reflects_more_than_it_receives).
    """
    dielectric = lambert(albedo) + ggx(wi, wo, n, roughness=roughness, f0=f0)
    if metalness is None:
        return dielectric
    return torch.lerp(dielectric, metal(wi, wo, n, albedo=albedo, roughness=roughness), metalness)


def sample(
    u: Float[Tensor, "*#b 3"],
    wo: Float[Tensor, "*#b 3"],
    n: Float[Tensor, "*#b 3"],
    *,
    roughness: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 3"]:
    """Directions to the light with the density `pdf`, from uniform numbers `u` in [0, 1); not to be differentiated.

    `u[0]` chooses between a cosine-distributed direction and the reflection of `wo` at a GGX half vector, each with
    probability 1/2; `u[1:]` determines the direction. Reflected directions may be below the horizon; such samples must
    be kept, with a BRDF value of 0.
    """
    rough = _rough(roughness, wo)
    lobe, height, azimuth = u.split(1, -1)
    R_world_local = local_frame(n)

    def around_normal(sine2: Tensor) -> Tensor:
        sine, phi = sine2.sqrt(), 2 * math.pi * azimuth
        local = torch.cat([sine * phi.cos(), sine * phi.sin(), (1 - sine2).sqrt()], -1)
        return torch.einsum("...ij,...j->...i", R_world_local, local)

    h = around_normal(_sine2_of_half(height, rough))
    return torch.where(lobe < 0.5, around_normal(height), reflect(wo, h))


def pdf(
    wi: Float[Tensor, "*#b 3"],
    wo: Float[Tensor, "*#b 3"],
    n: Float[Tensor, "*#b 3"],
    *,
    roughness: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 1"]:
    """Density of `sample` [1 / steradian], also for directions below the horizon; its integral over the sphere is 1."""
    h = _half_vector(wi, wo, n)
    # For wi = -wo the half vector is perpendicular to wo, and the density has a pole.
    voh = cosine(wo, h).abs().clamp_min(1e-7)
    specular = _ndf(h, n, _rough(roughness, wo)) * cosine(n, h) / (4 * voh)
    return 0.5 * (cosine(n, wi).clamp_min(0) / math.pi + specular)


def split_sum_table(size: int = 64) -> Float[Tensor, "{size} {size}"]:
    """Directional albedo of the specular lobe divided by f0: the second factor of the split sum.

    First axis: nov from 0 to 1; second axis: roughness from `MIN_ROUGHNESS` to 1; both ends included.
    """
    return _directional_albedo(size, fresnel)


def metal_split_sum_tables(size: int = 64) -> Float[Tensor, "2 {size} {size}"]:
    """Directional albedo of a metal with the base colour c is c times the first table plus the second one.

    Axes as in `split_sum_table`.
    """
    grazing = _directional_albedo(size, schlick)
    return torch.stack([_directional_albedo(size, torch.ones_like) - grazing, grazing])


def _directional_albedo(size: int, fresnel: Callable[[Tensor], Tensor]) -> Float[Tensor, "{size} {size}"]:
    """Directional albedo of a specular lobe, over fixed half vectors with a density proportional to D noh."""
    rough = torch.linspace(MIN_ROUGHNESS, 1, size)[:, None]
    u = (torch.arange(SPLIT_SUM_SAMPLES) + 0.5) / SPLIT_SUM_SAMPLES
    azimuth = GOLDEN_ANGLE * torch.arange(SPLIT_SUM_SAMPLES)
    sine2 = _sine2_of_half(u, rough)
    noh = (1 - sine2).sqrt()
    along_eye = sine2.sqrt() * azimuth.cos()

    def directional_albedo(nov: Tensor) -> Tensor:
        voh = (1 - nov.square()).sqrt() * along_eye + nov * noh
        nol = 2 * voh * noh - nov
        # f nol divided by the density D noh / (4 voh), without F.
        weight = torch.where(nol > 0, 4 * _visibility(nol, nov, rough) * nol * voh / noh, 0.0)
        return (fresnel(voh) * weight).mean(-1)

    return torch.stack([directional_albedo(nov) for nov in torch.linspace(0, 1, size)])


def split_sum(
    table: Float[Tensor, "size size"],
    nov: Float[Tensor, "*#b 1"],
    roughness: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 1"]:
    """Directional albedo of the specular lobe divided by f0, bilinear in the table; differentiable in all arguments."""
    rough = _rough(roughness, nov)
    row, column = torch.broadcast_tensors(2 * nov - 1, 2 * (rough - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS) - 1)
    grid = torch.cat([column, row], -1).reshape(1, 1, -1, 2)
    values = grid_sample(table[None, None], grid, padding_mode="border", align_corners=True)
    return values[0, 0, 0].reshape(row.shape)


def _rough(roughness: float | Tensor, like: Tensor) -> Tensor:
    return torch.as_tensor(roughness, dtype=like.dtype, device=like.device).clamp_min(MIN_ROUGHNESS)


def cosine(a: Float[Tensor, "*#b 3"], b: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 1"]:
    """Dot product, the cosine of the angle between unit vectors."""
    # A matrix product takes a fraction of the time of a sum over three columns.
    return (a * b) @ a.new_ones(3, 1)


def _half_vector(wi: Tensor, wo: Tensor, n: Tensor) -> Tensor:
    """Half vector of wi and wo, flipped to the normal's side."""
    h = normalize(wi + wo, dim=-1)
    return torch.where(cosine(n, h) < 0, -h, h)


def _ndf(h: Tensor, n: Tensor, rough: Tensor) -> Tensor:
    """GGX normal distribution D [1 / steradian]; D noh integrates to 1 over the hemisphere."""
    a2 = rough**4
    # 1 - noh from the difference of both vectors: 1 - noh^2 would lose all digits at the peak of a smooth lobe.
    one_minus_noh = 0.5 * cosine(h - n, h - n)
    return a2 / (math.pi * (a2 * (1 - one_minus_noh).square() + one_minus_noh * (2 - one_minus_noh)).square())


def _sine2_of_half(u: Tensor, rough: Tensor) -> Tensor:
    """Squared sine between normal and half vectors of density D noh, from uniform numbers in [0, 1)."""
    a2 = rough**4
    return a2 * u / (1 + (a2 - 1) * u)


def _visibility(nol: Tensor, nov: Tensor, rough: Tensor) -> Tensor:
    """G / (4 nol nov), which is finite at the horizon; not valid below."""
    a2 = rough**4

    def smith(cosine: Tensor) -> Tensor:
        x = cosine.clamp_min(0)
        return x + (a2 + (1 - a2) * x.square()).sqrt()

    return 1 / (smith(nol) * smith(nov))
