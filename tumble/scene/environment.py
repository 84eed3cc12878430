"""Environment light: distant radiance as a function of direction, on an equirectangular map.

Convention (docs/format.md): for a unit direction d in the env frame
`u = atan2(d.x, -d.z) / 2pi + 1/2`, `v = acos(d.y) / pi`; the map's centre is -z, its right quarter +x, its top row +y.
Texel centres lie at +0.5. Radiance is linear RGB.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.io import BadFile, files, limits
from tumble.maths import equirect_from_direction, texel_directions, texel_solid_angles

MIN_RADIANCE = 1e-6
"""Lower limit of radiance, needed by the logarithm; it is invisible in 8-bit images."""


@dataclass(frozen=True)
class Environment:
    """An environment map; raw parameters, as trained."""

    log_radiance: Float[Tensor, "h w 3"]
    """Natural logarithm of linear RGB radiance per texel, env frame."""

    @staticmethod
    def from_radiance(radiance: Float[Tensor, "h w 3"]) -> "Environment":
        """The environment with the given linear radiance, clamped to at least `MIN_RADIANCE`."""
        return Environment(radiance.clamp_min(MIN_RADIANCE).log())

    @staticmethod
    def read(path: Path | str) -> "Environment":
        """The environment in an equirectangular .exr or .hdr image; of more than `MAX_LIGHT_ROWS` rows, averaged.

        Raises:
            BadFile: The image is not finite, non-negative RGB and twice as wide as high.
        """
        path = Path(path)
        pixels = files.read_radiance(path)
        if pixels.shape[2] != 3 or pixels.shape[1] != 2 * pixels.shape[0]:
            size = f"{pixels.shape[1]} x {pixels.shape[0]} x {pixels.shape[2]}"
            rule = f"an equirectangular environment map must be RGB and twice as wide as high, not {size}"
            raise BadFile(path, rule)
        if pixels.min() < 0:
            rule = f"an environment map must have no negative values, but the least is {pixels.min():.3g}"
            raise BadFile(path, rule, "clamp at 0")
        if pixels.shape[0] > limits.MAX_LIGHT_ROWS:
            size = 2 * limits.MAX_LIGHT_ROWS, limits.MAX_LIGHT_ROWS
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        return Environment.from_radiance(torch.from_numpy(pixels))

    def write(self, path: Path) -> None:
        """Write the radiance as .exr (32-bit floats) or .hdr, by the suffix of `path`."""
        pixels = self.radiance.detach().cpu().numpy()
        (files.write_hdr if path.suffix == ".hdr" else files.write_exr)(path, pixels)

    @property
    def radiance(self) -> Float[Tensor, "h w 3"]:
        """Linear RGB radiance per texel."""
        return self.log_radiance.exp()

    def lookup(self, d_env: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Radiance arriving from unit directions, env frame: bilinear, continuous across the seam and the poles.

        Differentiable in the texels and in the directions.
        """
        return bilinear(self.radiance, equirect_from_direction(d_env))

    def integral(self) -> Float[Tensor, "3"]:
        """Integral of the radiance over the sphere."""
        return (self.radiance * self._solid_angles()[..., None]).sum((0, 1))

    def directionality(self) -> float:
        """Length of the mean direction, weighted by luminance: 0 for uniform light, 1 for a single small lamp."""
        d_env = texel_directions(*self.log_radiance.shape[:2]).to(self.log_radiance)
        luminance = self.radiance @ d_env.new_tensor([0.2126, 0.7152, 0.0722]) * self._solid_angles()
        mean = (d_env * luminance[..., None]).sum((0, 1)) / luminance.sum()
        return float(torch.linalg.vector_norm(mean))

    def upsampled(self) -> "Environment":
        """The map with twice the resolution: bilinear in radiance, scaled so that `integral` is preserved exactly."""
        h, w, _ = self.log_radiance.shape
        finer = self.resampled(2 * h, 2 * w)
        return Environment(finer.log_radiance + (self.integral() / finer.integral()).log())

    def resampled(self, height: int, width: int) -> "Environment":
        """The map at another resolution: bilinear when finer, averaged over the area of texels when coarser."""
        h, w, _ = self.log_radiance.shape
        if (h, w) == (height, width):
            return self
        # A coarse texel is the mean, weighted by solid angle, of samples at least as dense as the fine map.
        down, across = max(1, -(-h // height)), max(1, -(-w // width))
        d_env = texel_directions(height * down, width * across, dtype=self._dtype, device=self._device)
        weight = texel_solid_angles(height * down, width * across).to(d_env)[..., None]
        blocks = (height, down, width, across, -1)
        total = (self.lookup(d_env) * weight).reshape(blocks).sum((1, 3))
        return Environment((total / weight.reshape(blocks).sum((1, 3))).log())

    def rotated(self, R_new_old: Float[Tensor, "3 3"]) -> "Environment":
        """The same light in a rotated frame, resampled: `new.lookup(R_new_old @ d) = old.lookup(d)`."""
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
    """Bilinear lookup in an equirectangular map at coordinates in [0, 1]^2, continuous across seam and poles."""
    h, w, c = texels.shape
    x, y = uv[..., 0] * w - 0.5, uv[..., 1] * h - 0.5
    left, top = x.detach().floor(), y.detach().floor()
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    left, top = left.int(), top.int()

    def at(row: Tensor, column: Tensor) -> Tensor:
        # The neighbour across a pole is the same row, half a revolution away.
        across_pole = (row < 0) | (row >= h)
        row, column = row.clamp(0, h - 1), torch.where(across_pole, column + w // 2, column) % w
        if texels.requires_grad:
            return texels[row, column]
        # The same in a tenth of the time; its gradient would be summed in another order.
        return texels.reshape(-1, c).index_select(0, (row * w + column).flatten()).reshape(*row.shape, c)

    upper = at(top, left) * (1 - fx) + at(top, left + 1) * fx
    lower = at(top + 1, left) * (1 - fx) + at(top + 1, left + 1) * fx
    return upper * (1 - fy) + lower * fy
