"""Conventions of the environment map, and invariants of resampling."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tumble.io import files, limits
from tumble.io.files import BadFile
from tumble.maths.directions import texel_directions
from tumble.maths.se3 import SO3
from tumble.scene.environment import Environment


def one_texel(row: int, column: int, h: int = 16, w: int = 32) -> Environment:
    radiance = torch.zeros(h, w, 3, dtype=torch.float64)
    radiance[row, column] = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    return Environment.from_radiance(radiance)


@pytest.mark.parametrize(
    ("row", "column", "direction"),
    [
        # Computed by hand from u = atan2(x, -z) / 2pi + 1/2, v = acos(y) / pi, for the texel whose centre is there.
        (7, 15, (-math.sin(math.pi / 32), math.sin(math.pi / 32), -1)),  # left of and above the centre, which is -z
        (7, 23, (1, math.sin(math.pi / 32), -math.sin(math.pi / 32))),  # the right quarter is +x, from the -z side
        (7, 8, (-1, math.sin(math.pi / 32), -math.sin(math.pi / 32))),  # the left quarter is -x
        (7, 0, (-math.sin(math.pi / 32), math.sin(math.pi / 32), 1)),  # the left edge is +z
        (0, 15, (-0.0096, 1, -0.0976)),  # the top row is +y
        (15, 15, (-0.0096, -1, -0.0976)),  # the bottom row is -y
    ],
)
def test_a_bright_texel_is_found_in_the_direction_of_the_formula(
    row: int, column: int, direction: tuple[float, float, float]
) -> None:
    d = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=-1)
    radiance = one_texel(row, column).lookup(d)
    # The directions above are rounded, so the lookup may sit a few percent off the texel's centre.
    torch.testing.assert_close(radiance, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), rtol=0.05, atol=0)


def test_texel_centres_look_up_their_own_texel() -> None:
    torch.manual_seed(0)
    environment = Environment.from_radiance(torch.rand(8, 16, 3, dtype=torch.float64))
    d = texel_directions(8, 16, dtype=torch.float64)
    torch.testing.assert_close(environment.lookup(d), environment.radiance)


def test_the_light_is_continuous_across_the_seam_and_the_poles() -> None:
    torch.manual_seed(1)
    environment = Environment.from_radiance(torch.rand(8, 16, 3, dtype=torch.float64))
    tiny = 1e-7
    left, right = torch.tensor([[-tiny, 0.3, 1.0], [tiny, 0.3, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(environment.lookup(left), environment.lookup(right), atol=1e-5, rtol=0)
    # Straight over the pole: a step from one side of it to the other.
    here, there = torch.tensor([[0.1, 1e6, 0.2], [-0.1, 1e6, -0.2]], dtype=torch.float64)
    here, there = torch.nn.functional.normalize(torch.stack([here, there]), dim=-1)
    torch.testing.assert_close(environment.lookup(here), environment.lookup(there), atol=1e-5, rtol=0)


def test_upsampling_keeps_the_integral_and_the_seam() -> None:
    torch.manual_seed(2)
    environment = Environment.from_radiance(torch.rand(8, 16, 3, dtype=torch.float64) ** 4)
    finer = environment.upsampled()
    assert finer.log_radiance.shape == (16, 32, 3)
    torch.testing.assert_close(finer.integral(), environment.integral())
    # Rolling before or after upsampling is the same: the seam has no effect.
    rolled = Environment(environment.log_radiance.roll(5, 1)).upsampled()
    torch.testing.assert_close(rolled.log_radiance, finer.log_radiance.roll(10, 1))


def test_a_coarser_map_keeps_the_integral() -> None:
    torch.manual_seed(3)
    environment = Environment.from_radiance(torch.rand(32, 64, 3, dtype=torch.float64) ** 4)
    coarser = environment.resampled(8, 16)
    # Bilinear lookups of a map have the map's integral up to the curvature of the sine over one texel.
    torch.testing.assert_close(coarser.integral(), environment.integral(), rtol=2e-3, atol=0)


def test_a_constant_light_integrates_to_four_pi() -> None:
    environment = Environment.from_radiance(torch.full((6, 12, 3), 2.0, dtype=torch.float64))
    torch.testing.assert_close(environment.integral(), torch.full((3,), 8 * math.pi, dtype=torch.float64))


def test_a_rotated_map_is_the_same_light_in_another_frame() -> None:
    R_new_old = SO3.exp(torch.tensor([0.3, -1.0, 0.5], dtype=torch.float64)).matrix()
    d_old = torch.nn.functional.normalize(torch.tensor([0.3, 0.4, -0.8], dtype=torch.float64), dim=-1)
    smooth = texel_directions(64, 128, dtype=torch.float64)[..., [0, 1, 2]] * 0.4 + 1
    environment = Environment.from_radiance(smooth)
    # Two bilinear interpolations of a smooth map on 64 rows err by the square of the texel's 0.05 radians.
    torch.testing.assert_close(
        environment.rotated(R_new_old).lookup(R_new_old @ d_old), environment.lookup(d_old), atol=2e-3, rtol=0
    )


def test_a_lookup_without_a_gradient_has_the_same_bits() -> None:
    light = Environment.from_radiance(torch.rand(6, 12, 3, generator=torch.Generator().manual_seed(0)))
    d_env = torch.cat([texel_directions(9, 17).flatten(0, 1), torch.tensor([[0.0, 1, 0], [0, -1, 0], [0, 0, 1]])])
    trained = Environment(light.log_radiance.clone().requires_grad_())
    assert torch.equal(trained.lookup(d_env), light.lookup(d_env))
    assert light.lookup(d_env[None]).shape == (1, len(d_env), 3)


def test_lookup_has_a_gradient_to_texels_and_direction() -> None:
    torch.manual_seed(4)
    d = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64), dim=-1).requires_grad_()
    log_radiance = torch.randn(4, 8, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, y: Environment(x).lookup(y), (log_radiance, d))


@pytest.mark.parametrize("name", ["light.exr", "light.hdr"])
def test_environments_are_written_and_read(tmp_path: Path, name: str) -> None:
    radiance = torch.rand(4, 8, 3) + 0.5
    Environment.from_radiance(radiance).write(tmp_path / name)
    # Radiance HDR keeps eight bits of the brightest channel, here up to three times another.
    rtol = 1e-5 if name.endswith("exr") else 3 / 128
    torch.testing.assert_close(Environment.read(tmp_path / name).radiance, radiance, rtol=rtol, atol=0)


@pytest.mark.parametrize("name", ["sun.exr", "sun.hdr"])
def test_a_large_map_is_averaged_when_it_is_read(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a map of 8k x 4k pixels, one rotation took 5 GiB. A sun of one texel keeps its energy."""
    monkeypatch.setattr(limits, "MAX_LIGHT_ROWS", 64)
    pixels = np.full((128, 256, 3), 0.5, np.float32)
    pixels[41, 100] = 1000.0
    (files.write_exr if name == "sun.exr" else files.write_hdr)(tmp_path / name, pixels)
    radiance = Environment.read(tmp_path / name).radiance
    assert radiance.shape == (64, 128, 3)
    # Radiance HDR keeps 8 bits of a colour.
    torch.testing.assert_close(radiance[20, 50], torch.full((3,), (3 * 0.5 + 1000) / 4), rtol=0.01, atol=0)
    assert radiance.min() == pytest.approx(0.5, rel=0.01)
    files.write_exr(tmp_path / "odd.exr", pixels[:126, :252])
    assert Environment.read(tmp_path / "odd.exr").radiance.shape == (64, 128, 3)


@pytest.mark.parametrize(
    ("pixels", "rule"),
    [
        (np.full((4, 8, 3), -1.0, np.float32), "no negative values"),
        (np.ones((4, 4, 3), np.float32), "twice as wide as high"),
        (np.ones((4, 8, 1), np.float32), "twice as wide as high"),
        (np.full((4, 8, 3), np.nan, np.float32), "NaN"),
    ],
)
def test_invalid_maps_are_rejected_with_the_rule(tmp_path: Path, pixels: np.ndarray, rule: str) -> None:
    files.write_exr(tmp_path / "light.exr", pixels)
    with pytest.raises(BadFile, match=rf"light\.exr: .*{rule}"):
        Environment.read(tmp_path / "light.exr")


def test_directionality_is_0_for_uniform_light_a_third_for_1_plus_y_and_1_for_a_lamp() -> None:
    """The mean direction of 1 + y: the integral of y (1 + y) over the sphere is 4 pi / 3, that of 1 + y is 4 pi."""
    y = texel_directions(64, 128)[..., 1:2].expand(-1, -1, 3)
    lamp = torch.zeros(64, 128, 3)
    lamp[20, 30] = 1e6
    for radiance, expected in ((torch.ones(8, 16, 3), 0.0), (1 + y, 1 / 3), (lamp, 1.0)):
        assert Environment.from_radiance(radiance).directionality() == pytest.approx(expected, abs=1e-3)
