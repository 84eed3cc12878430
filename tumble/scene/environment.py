"""Light from far away: radiance as a function of direction, on an equirectangular map.

Convention (docs/format.md): for a unit direction d in the env frame
`u = atan2(d.x, -d.z) / 2pi + 1/2`, `v = acos(d.y) / pi`; the map's centre is -z, its right quarter +x, its top row +y.
Texel centres at +0.5. Linear RGB radiance.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.io import files
from tumble.maths import equirect_from_direction, texel_directions, texel_solid_angles

DARKEST = 1e-6
"""Radiance below which a texel counts as black: a logarithm needs a floor, and 8-bit pictures see nothing under it."""


@dataclass(frozen=True)
class Environment:
    """The light of a room; raw parameters, as trained."""

    log_radiance: Float[Tensor, "h w 3"]
    """Natural logarithm of linear RGB radiance per texel, env frame."""

    @staticmethod
    def from_radiance(radiance: Float[Tensor, "h w 3"]) -> "Environment":
        """The environment with the given linear radiance, lifted to at least `DARKEST`."""
        return Environment(radiance.clamp_min(DARKEST).log())

    @staticmethod
    def read(path: Path | str) -> "Environment":
        """A lat-long .exr or .hdr picture.

        Raises:
            BadFile: Not a finite, non-negative RGB picture twice as wide as high.
        """
        path = Path(path)
        pixels = files.read_radiance(path)
        if pixels.shape[2] != 3 or pixels.shape[1] != 2 * pixels.shape[0]:
            size = f"{pixels.shape[1]} x {pixels.shape[0]} x {pixels.shape[2]}"
            raise files.BadFile(path, f"a lat-long light map is RGB and twice as wide as high, this is {size}")
        if pixels.min() < 0:
            raise files.BadFile(path, f"a light has no negative values, this has {pixels.min():.3g}", "clamp at 0")
        return Environment.from_radiance(torch.from_numpy(pixels))

    def write(self, path: Path) -> None:
        """The radiance as .exr (32-bit floats) or .hdr, by the ending of `path`."""
        pixels = self.radiance.detach().cpu().numpy()
        (files.write_hdr if path.suffix == ".hdr" else files.write_exr)(path, pixels)

    @property
    def radiance(self) -> Float[Tensor, "h w 3"]:
        """Linear RGB radiance per texel."""
        return self.log_radiance.exp()

    def lookup(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Radiance arriving from unit directions, env frame: bilinear in radiance, continuous over seam and poles.

        Differentiable in the texels and in the directions.
        """
        return bilinear(self.radiance, equirect_from_direction(d_env))

    def integral(self) -> Float[Tensor, "3"]:
        """Radiance times solid angle, summed over the sphere."""
        return (self.radiance * self._solid_angles()[..., None]).sum((0, 1))

    def upsampled(self) -> "Environment":
        """Twice as many texels each way: bilinear in radiance, with the integral over the sphere kept exactly."""
        h, w, _ = self.log_radiance.shape
        finer = self.resampled(2 * h, 2 * w)
        return Environment(finer.log_radiance + (self.integral() / finer.integral()).log())

    def resampled(self, height: int, width: int) -> "Environment":
        """The map on another grid: bilinear when finer, averaged over the texels' area when coarser."""
        h, w, _ = self.log_radiance.shape
        if (h, w) == (height, width):
            return self
        # A coarse texel is the mean of samples at least as dense as the fine map, each weighted by its solid angle.
        down, across = max(1, -(-h // height)), max(1, -(-w // width))
        d_env = texel_directions(height * down, width * across, dtype=self._dtype, device=self._device)
        weight = texel_solid_angles(height * down, width * across).to(d_env)[..., None]
        blocks = (height, down, width, across, -1)
        total = (self.lookup(d_env) * weight).reshape(blocks).sum((1, 3))
        return Environment((total / weight.reshape(blocks).sum((1, 3))).log())

    def rotated(self, R_new_old: Float[Tensor, "3 3"]) -> "Environment":
        """The same light described in a rotated frame: `new.lookup(R_new_old @ d) = old.lookup(d)`, resampled."""
        if torch.equal(R_new_old, torch.eye(3).to(R_new_old)):
            return self
        h, w, _ = self.log_radiance.shape
        d_new = texel_directions(h, w, dtype=self._dtype, device=self._device)
        return Environment(self.lookup(d_new @ R_new_old).log())

    @property
    def _dtype(self) -> torch.dtype:
        return self.log_radiance.dtype

    @property
    def _device(self) -> torch.device:
        return self.log_radiance.device

    def _solid_angles(self) -> Float[Tensor, "h w"]:
        return texel_solid_angles(*self.log_radiance.shape[:2]).to(self.log_radiance)


def bilinear(texels: Float[Tensor, "h w c"], uv: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b c"]:
    """Values of a lat-long map at places in [0, 1]^2, texel centres at +0.5; continuous over seam and poles."""
    h, w, _ = texels.shape
    x, y = uv[..., 0] * w - 0.5, uv[..., 1] * h - 0.5
    left, top = x.detach().floor(), y.detach().floor()
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    left, top = left.long(), top.long()

    def at(row: Tensor, column: Tensor) -> Tensor:
        # Over a pole lies the same row on the far side of the map.
        beyond = (row < 0) | (row >= h)
        return texels[row.clamp(0, h - 1), torch.where(beyond, column + w // 2, column) % w]

    upper = at(top, left) * (1 - fx) + at(top, left + 1) * fx
    lower = at(top + 1, left) * (1 - fx) + at(top + 1, left + 1) * fx
    return upper * (1 - fy) + lower * fy
