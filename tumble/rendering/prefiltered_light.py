"""Prefiltered environment maps: the first factor of the split sum (the second one is `brdf.split_sum`).

*Level* l of the stack is the light convolved with a GGX lobe of roughness l / (LEVELS - 1), weighted by n.l, under the
usual assumption that view direction, normal and reflected direction are equal. Level 0 is the light itself.

The lobe is rotationally symmetric. On an equirectangular map the convolution is therefore a circular convolution along
the columns between each pair of rows: one small real matrix per frequency, computed once per map size.
"""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from tumble import backends
from tumble.maths import equirect_from_direction, texel_directions, texel_solid_angles
from tumble.scene import Environment, bilinear

LEVELS = 9
"""Number of levels, the unfiltered one included."""
ROWS = 64
"""Rows of the finest map that is convolved; finer maps are first averaged down. Its texels of 2.8 degrees are narrower
than all lobes, whose roughness is at least 1 / (LEVELS - 1)."""
SUBDIVISIONS = 4
"""Samples per texel and axis in the integration of a lobe."""


@dataclass(frozen=True)
class Prefiltered:
    """An environment map and its convolutions with specular lobes."""

    environment: Environment
    """The unfiltered light."""
    stack: Float[Tensor, "levels h w 3"]
    """Linear radiance of all levels, env frame."""
    radiance: Float[Tensor, "H W 3"]
    """Linear radiance of the unfiltered light, which may have a higher resolution than the stack."""

    @property
    def is_finer(self) -> bool:
        """Whether the unfiltered light has a higher resolution than the stack."""
        return self.radiance.shape != self.stack.shape[1:]

    def lookup(self, d_env: Float[Tensor, "p 3"], roughness: Float[Tensor, "p 1"]) -> Float[Tensor, "p 3"]:
        """Prefiltered radiance in reflected unit directions: linear between levels, bilinear on the map.

        Differentiable in texels, directions and roughness.
        """
        backend = backends.choose(d_env.device, d_env.dtype)
        values = backend.lookup(self.stack, d_env, roughness[:, 0])
        if not self.is_finer:
            return values
        uv = equirect_from_direction(d_env)
        weight = (1 - roughness.clamp(0, 1) * (len(self.stack) - 1)).clamp(min=0)
        return values + weight * (bilinear(self.radiance, uv) - bilinear(self.stack[0], uv))

    def cell_radiance(self, d_env: Float[Tensor, "D 3"]) -> Float[Tensor, "D 3"]:
        """Mean radiance of the cells of D evenly distributed directions."""
        return self.lookup(d_env, torch.full_like(d_env[:, :1], cell_roughness(len(d_env))))


def cell_roughness(count: int) -> float:
    """Roughness at which a lookup gives the mean radiance of the cells of `count` evenly distributed directions.

    So small bright lights are not missed. The lobe is about as wide as a cell, since its density of half vectors falls
    to a quarter of the peak at a distance of a = D^(-1/2).
    """
    return count**-0.25


def prefilter(environment: Environment) -> Prefiltered:
    """Convolve an environment map with the lobes of all levels; linear in its radiance and differentiable."""
    unfiltered = radiance = environment.radiance
    if radiance.shape[0] > ROWS:
        size, weight = (ROWS, 2 * ROWS), _weight_on(*radiance.shape[:2], radiance.dtype, radiance.device)
        total = adaptive_avg_pool2d((radiance * weight[..., None]).movedim(-1, 0), size)
        radiance = (total / adaptive_avg_pool2d(weight[None], size)).movedim(0, -1)
    h, w, _ = radiance.shape
    lobes = _lobes_on(h, w, radiance.dtype, radiance.device)
    stack = backends.choose(radiance.device, radiance.dtype).prefilter(radiance, lobes)
    return Prefiltered(environment, stack.view(LEVELS, h, w, 3), unfiltered)


@cache
def _weight_on(h: int, w: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "h w"]:
    """Solid angles of texels, copied to a device once: a step that is recorded must not copy."""
    return texel_solid_angles(h, w).to(device, dtype)


@cache
def _lobes_on(h: int, w: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "frequencies rows h"]:
    """`_lobes`, copied to a device once."""
    return _lobes(h, w).to(device, dtype)


@cache
def _lobes(h: int, w: int) -> Float[Tensor, "frequencies rows h"]:
    """Fourier transforms of all levels' lobes along the columns, from input row to `rows` = (level, output row)."""
    s = SUBDIVISIONS
    fine = texel_directions(h * s, w * s)
    area = texel_solid_angles(h * s, w * s)
    # Lobes around the centres of the first column are even along the columns, so their transform is real. Those of the
    # lower half of the map are the upper ones, mirrored.
    centre = texel_directions(h, w)[: (h + 1) // 2, 0]
    cosine = torch.einsum("id,jkd->ijk", centre, fine)
    levels = []
    for level in range(1, LEVELS):
        a2 = (level / (LEVELS - 1)) ** 4
        # GGX density of the half vector, whose angle is half that between light and reflected direction.
        t = 0.5 * (1 - cosine) + a2 * 0.5 * (1 + cosine)
        upper = (cosine.clamp(min=0) / t.square() * area).reshape(-1, h, s, w, s).sum((2, 4))
        lobe = torch.cat([upper, upper[: h // 2].flip(0, 1)])
        # Columns are counted from the centre of the lobe.
        spectrum = torch.fft.rfft(lobe / lobe.sum((1, 2), keepdim=True), dim=2)
        levels.append(spectrum.real.permute(2, 0, 1))
    return torch.cat(levels, 1).contiguous()
