"""Light seen in a rough mirror: the specular half of the split sum (the other half is `brdf.split_sum`).

A few hundred shared directions cannot resolve a lobe of roughness below 0.3; a map that was convolved with the lobe
beforehand can. *Level* l of a stack is the light convolved with GGX of roughness l / (LEVELS - 1) as a mirror seen
head-on would show it (eye, normal and mirrored direction taken as one), weighted by n.l. Level 0 is the light itself.

The lobe is round, so on an equirectangular map the convolution mixes rows by a matrix and runs along columns: one
small real matrix per frequency, the same linear map of the texels each time, computed once per size of map.
"""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from tumble.maths import equirect_from_direction, texel_directions, texel_solid_angles
from tumble.scene import Environment, bilinear

LEVELS = 9
ROWS = 64
"""Rows of the finest map that is convolved; finer ones are averaged down first. Its texels are 2.8 degrees: lobes of
roughness 1 / (LEVELS - 1) and more are wider."""
SUBDIVISIONS = 4
"""A lobe is integrated over a texel with this many samples each way."""


@dataclass(frozen=True)
class Prefiltered:
    """A light, and the same for rough mirrors."""

    environment: Environment
    stack: Float[Tensor, "levels h w 3"]
    """Linear radiance, env frame."""
    radiance: Float[Tensor, "H W 3"]
    """Of the light itself, which may be finer than the stack."""

    def lookup(self, d_env: Float[Tensor, "p 3"], roughness: Float[Tensor, "p 1"]) -> Float[Tensor, "p 3"]:
        """Radiance in mirrored unit directions: linear between levels, bilinear on the map.

        Differentiable in texels, directions and roughness.
        """
        levels, h, w, _ = self.stack.shape
        # One texel more on all sides: round the seam, and over the pole the same row on the far side of the map.
        rows = torch.cat([self.stack[:, :1].roll(w // 2, 2), self.stack, self.stack[:, -1:].roll(w // 2, 2)], 1)
        padded = torch.cat([rows[:, :, -1:], rows, rows[:, :, :1]], 2)
        uv = equirect_from_direction(d_env)
        u, v = uv.split(1, -1)
        level = roughness.clamp(0, 1) * (levels - 1)
        places = [(2 * u * w + 2) / (w + 2) - 1, (2 * v * h + 2) / (h + 2) - 1, (2 * level + 1) / levels - 1]
        volume, grid = padded.permute(3, 0, 1, 2)[None], torch.cat(places, -1)[None, None, None]
        found = grid_sample(volume, grid, padding_mode="border", align_corners=False)
        found = found[0, :, 0, 0].mT
        if len(self.radiance) == h:
            return found
        share = (1 - level).clamp(min=0)
        return found + share * (bilinear(self.radiance, uv) - bilinear(self.stack[0], uv))

    def cells(self, d_env: Float[Tensor, "D 3"]) -> Float[Tensor, "D 3"]:
        """Radiance of the cells that directions of equal area stand for, rather than of a point of each.

        A lobe of roughness D^(-1/4) is about as wide as a D-th of the sphere: its half vectors fall to a quarter of
        their peak a distance a = D^(-1/2) away. What 256 points miss of a sun makes the sum over them err five times
        as much (`benchmarks.estimators`).
        """
        return self.lookup(d_env, torch.full_like(d_env[:, :1], len(d_env) ** -0.25))


def prefilter(environment: Environment) -> Prefiltered:
    """The stack of a light; linear in its radiance and differentiable."""
    light = radiance = environment.radiance
    if radiance.shape[0] > ROWS:
        size, weight = (ROWS, 2 * ROWS), texel_solid_angles(*radiance.shape[:2]).to(radiance)
        total = adaptive_avg_pool2d((radiance * weight[..., None]).movedim(-1, 0), size)
        radiance = (total / adaptive_avg_pool2d(weight[None], size)).movedim(0, -1)
    h, w, _ = radiance.shape
    waves = torch.view_as_real(torch.fft.rfft(radiance, dim=1).transpose(0, 1)).flatten(2)
    mixed = _lobes(h, w).to(radiance) @ waves
    mixed = torch.view_as_complex(mixed.unflatten(2, (3, 2))).unflatten(1, (LEVELS - 1, h))
    rough = torch.fft.irfft(mixed, n=w, dim=0).permute(1, 2, 0, 3)
    return Prefiltered(environment, torch.cat([radiance[None], rough]), light)


@cache
def _lobes(h: int, w: int) -> Float[Tensor, "waves rows h"]:
    """Real Fourier transforms along the columns of all levels' lobes: (level, output row) from input row."""
    s = SUBDIVISIONS
    fine = texel_directions(h * s, w * s)
    area = texel_solid_angles(h * s, w * s)
    # Lobes around the centres of the first column; being even about it, their transform is real.
    centre = texel_directions(h, w)[:, 0]
    cosine = torch.einsum("id,jkd->ijk", centre, fine)
    levels = []
    for level in range(1, LEVELS):
        a2 = (level / (LEVELS - 1)) ** 4
        # GGX in the half vector, whose angle is half that between light and mirrored direction.
        t = 0.5 * (1 - cosine) + a2 * 0.5 * (1 + cosine)
        lobe = (cosine.clamp(min=0) / t.square() * area).reshape(h, h, s, w, s).sum((2, 4))
        # Columns count from the lobe's own.
        wave = torch.fft.rfft(lobe / lobe.sum((1, 2), keepdim=True), dim=2)
        levels.append(wave.real.permute(2, 0, 1))
    return torch.cat(levels, 1).contiguous()
