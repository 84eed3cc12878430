"""How a surface scatters light: a Lambertian lobe and a GGX lobe, their samples, and the split-sum table.

Directions are unit vectors that point away from the surface, `wi` to the light and `wo` to the eye; `n` is the unit
normal. `h` is the half vector between both, `nol`, `nov`, `noh`, `voh` are cosines between n, wi (l), wo (v) and h.
`roughness` is perceptual, r; GGX's alpha is a = r^2. `f0` is the reflectance at normal incidence. All values per
steradian; the cosine of the rendering equation is the caller's. Fresnel's curve is that of glass (index 1.5, f0 0.04),
scaled to f0: what `fresnel` says.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from tumble.maths import GOLDEN_ANGLE, local_frame, reflect

MIN_ROUGHNESS = 0.05
"""Floor of r wherever it enters a formula, without gradient below: the peak of the lobe, 1 / (pi r^4), is 5e4 there."""
SPLIT_SUM_SAMPLES = 4096
"""Half vectors per entry of the table: their mean is within 1e-3 of the integral."""


def lambert(albedo: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Diffuse lobe, albedo / pi, the same in all directions (paper section 4.3)."""
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

    D is GGX, F is `fresnel`, and G is Smith's for GGX (Walter 2007, which the paper cites), whose nol nov cancel
    against the denominator. Its relatives take Schlick's fit of G with k = (r + 1)^2 / 8, made for lamps: under a sky
    it halves what a surface sends back at grazing angles.
    """
    rough = _rough(roughness, wo)
    nol, nov = _cosine(n, wi), _cosine(n, wo)
    above = (nol > 0) & (nov > 0)
    h = _half_vector(wi, wo, n)
    value = _ndf(h, n, rough) * f0 * fresnel(_cosine(wo, h)) * _visibility(nol, nov, rough)
    return torch.where(above, value, 0.0)


def fresnel(voh: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """What a smooth surface reflects at an angle, relative to what it reflects face to face: 1 there, 25 at grazing.

    Fresnel's equations for an index of 1.5, within 0.4 %. Schlick's fit, which the paper's relatives take, is a fifth
    too low around 50 degrees: a dark print, where the highlight is a third of the light, takes up the rest as albedo
    (24.2 instead of 25.6 dB on a box). Scaled by f0 as a whole: a surface that does not reflect has no rim either.
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
) -> Float[Tensor, "*#b 3"]:
    """Sum of both lobes (paper section 4.3), for `wi` above the horizon.

    The paper does not take the specular share from the diffuse one: with f0 = 0.04 a white surface sends back up to
    1.40 of a uniform light at roughness 0.2, seen 8 degrees above its horizon, and 1.04 face to face
    (test_a_white_surface_returns_more_than_it_gets).
    """
    return lambert(albedo) + ggx(wi, wo, n, roughness=roughness, f0=f0)


def sample(
    u: Float[Tensor, "*#b 3"],
    wo: Float[Tensor, "*#b 3"],
    n: Float[Tensor, "*#b 3"],
    *,
    roughness: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 3"]:
    """Directions to the light, drawn with the density `pdf` from uniform numbers in [0, 1).

    `u[0]` picks the cosine lobe or the mirror image of `wo` in a half vector of GGX, each half of the time; `u[1:]`
    draws from it. The latter may lie below the horizon, where the surface reflects nothing: such a sample counts, with
    the value 0. Not meant to be differentiated.
    """
    rough = _rough(roughness, wo)
    lobe, height, turn = u.split(1, -1)
    R_world_local = local_frame(n)

    def around_normal(sine2: Tensor) -> Tensor:
        across, phi = sine2.sqrt(), 2 * math.pi * turn
        local = torch.cat([across * phi.cos(), across * phi.sin(), (1 - sine2).sqrt()], -1)
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
    # wi = -wo is the mirror image in half vectors at right angles to wo; the density has a pole there.
    voh = _cosine(wo, h).abs().clamp_min(1e-7)
    specular = _ndf(h, n, _rough(roughness, wo)) * _cosine(n, h) / (4 * voh)
    return 0.5 * (_cosine(n, wi).clamp_min(0) / math.pi + specular)


def split_sum_table(size: int = 64) -> Float[Tensor, "{size} {size}"]:
    """The specular lobe's share of a uniform light, over f0.

    First axis: nov from 0 to 1; second: roughness from `MIN_ROUGHNESS` to 1; both ends are entries. Integrated with
    one fixed set of half vectors, drawn in proportion to D noh.
    """
    rough = torch.linspace(MIN_ROUGHNESS, 1, size)[:, None]
    u = (torch.arange(SPLIT_SUM_SAMPLES) + 0.5) / SPLIT_SUM_SAMPLES
    azimuth = GOLDEN_ANGLE * torch.arange(SPLIT_SUM_SAMPLES)
    sine2 = _sine2_of_half(u, rough)
    noh = (1 - sine2).sqrt()
    along_eye = sine2.sqrt() * azimuth.cos()

    def shares(nov: Tensor) -> Tensor:
        voh = (1 - nov.square()).sqrt() * along_eye + nov * noh
        nol = 2 * voh * noh - nov
        # f nol over the density D noh / (4 voh), without F.
        weight = torch.where(nol > 0, 4 * _visibility(nol, nov, rough) * nol * voh / noh, 0.0)
        return (fresnel(voh) * weight).mean(-1)

    return torch.stack([shares(nov) for nov in torch.linspace(0, 1, size)])


def split_sum(
    table: Float[Tensor, "size size"],
    nov: Float[Tensor, "*#b 1"],
    roughness: float | Float[Tensor, "*#b 1"],
) -> Float[Tensor, "*#b 1"]:
    """The lobe's share of a uniform light, over f0, bilinear in the table; differentiable in all three."""
    rough = _rough(roughness, nov)
    row, column = torch.broadcast_tensors(2 * nov - 1, 2 * (rough - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS) - 1)
    places = torch.cat([column, row], -1).reshape(1, 1, -1, 2)
    found = grid_sample(table[None, None], places, padding_mode="border", align_corners=True)
    return found[0, 0, 0].reshape(row.shape)


def _rough(roughness: float | Tensor, like: Tensor) -> Tensor:
    return torch.as_tensor(roughness, dtype=like.dtype, device=like.device).clamp_min(MIN_ROUGHNESS)


def _cosine(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _half_vector(wi: Tensor, wo: Tensor, n: Tensor) -> Tensor:
    """The axis that mirrors wi and wo on each other, on the normal's side."""
    h = normalize(wi + wo, dim=-1)
    return torch.where(_cosine(n, h) < 0, -h, h)


def _ndf(h: Tensor, n: Tensor, rough: Tensor) -> Tensor:
    """GGX density D of half vectors per steradian, over the cosine-weighted hemisphere."""
    a2 = rough**4
    # 1 - noh, as the length of a difference: 1 - noh^2 from noh has no digits left where a smooth lobe peaks.
    short = 0.5 * (h - n).square().sum(-1, keepdim=True)
    return a2 / (math.pi * (a2 * (1 - short).square() + short * (2 - short)).square())


def _sine2_of_half(u: Tensor, rough: Tensor) -> Tensor:
    """Squared sine between normal and half vectors in proportion to D noh, from uniform numbers in [0, 1)."""
    a2 = rough**4
    return a2 * u / (1 + (a2 - 1) * u)


def _visibility(nol: Tensor, nov: Tensor, rough: Tensor) -> Tensor:
    """G / (4 nol nov), finite down to the horizon and not used below."""
    a2 = rough**4

    def stretched(cosine: Tensor) -> Tensor:
        x = cosine.clamp_min(0)
        return x + (a2 + (1 - a2) * x.square()).sqrt()

    return 1 / (stretched(nol) * stretched(nov))
