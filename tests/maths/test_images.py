"""Colour curves against published values, similarity against scikit-image, resampling against slow loops."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from skimage import color, metrics
from torch import Tensor

from tumble.maths.images import (
    crop,
    crop_box,
    filled_hull,
    linear_from_srgb,
    resize,
    resize_area,
    srgb_from_linear,
    ssim,
    ssim_map,
    to_srgb8,
)

DOUBLE = torch.float64


def random_image(height: int, width: int, channels: int = 3, seed: int = 0) -> Tensor:
    """Smooth blobs and noise in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, channels, 5, 6, generator=generator, dtype=DOUBLE)
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic")[0].permute(1, 2, 0)
    return (smooth + 0.05 * torch.randn(height, width, channels, generator=generator, dtype=DOUBLE)).clamp(0, 1)


@pytest.mark.parametrize(
    ("linear", "srgb"), [(0.0, 0.0), (1.0, 1.0), (0.5, 0.735356983052), (0.001, 0.01292), (0.18, 0.461356129500)]
)
def test_the_srgb_curve_has_its_published_values(linear: float, srgb: float) -> None:
    assert srgb_from_linear(torch.tensor(linear, dtype=DOUBLE)).item() == pytest.approx(srgb, abs=1e-9)
    assert linear_from_srgb(torch.tensor(srgb, dtype=DOUBLE)).item() == pytest.approx(linear, abs=1e-9)


def test_the_srgb_curve_agrees_with_scikit_image() -> None:
    # scikit-image's private curve is reached through its conversion to CIE XYZ and back.
    srgb = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    matrix = torch.from_numpy(np.asarray(color.rgb2xyz(np.eye(3)[None])[0]))
    xyz = torch.from_numpy(color.rgb2xyz(srgb.numpy()))
    # Its matrices are printed to six digits.
    torch.testing.assert_close(linear_from_srgb(srgb) @ matrix, xyz, rtol=0, atol=2e-6)


def test_the_srgb_curves_are_inverse_to_each_other() -> None:
    x = torch.cat([torch.linspace(0, 2, 1001, dtype=DOUBLE), torch.tensor([0.0031307, 0.0031309], dtype=DOUBLE)])
    # At the knee the standard's rounded constants leave a step of 1e-8 relative to a slope of 12.92.
    torch.testing.assert_close(linear_from_srgb(srgb_from_linear(x)), x, rtol=0, atol=1e-8)


@pytest.mark.parametrize("curve", [srgb_from_linear, linear_from_srgb])
def test_colour_curves_clamp_negatives_and_have_finite_gradients(curve) -> None:
    x = torch.tensor([-0.5, -1e-8, 0.0, 1e-8, 0.003, 0.5, 4.0], requires_grad=True)
    y = curve(x)
    y.sum().backward()
    assert y[0] == 0 == y[1]
    assert x.grad is not None
    assert x.grad.isfinite().all()
    assert x.grad[0] == 0 < x.grad[2]
    inner = torch.tensor([0.001, 0.1, 0.9, 2.0], dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(curve, inner)


def scikit_ssim(x: Tensor, y: Tensor) -> tuple[float, Tensor]:
    """Mean over the inner region, and the uncropped map, by scikit-image."""
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    mean, full_map = metrics.structural_similarity(x.numpy(), y.numpy(), data_range=1, channel_axis=-1, **options)
    return float(mean), torch.from_numpy(full_map)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("height", "width", "channels"), [(40, 57, 3), (11, 11, 1), (64, 12, 3)])
def test_ssim_is_that_of_scikit_image(height: int, width: int, channels: int, dtype: torch.dtype) -> None:
    x, y = random_image(height, width, channels), random_image(height, width, channels, seed=1)
    y = 0.6 * x + 0.4 * y
    expected, whole = scikit_ssim(x, y)
    # float32 loses 1e-7 of squares of order one to a difference next to a stabiliser of 9e-4.
    tolerance = 1e-10 if dtype == DOUBLE else 1e-5
    assert ssim(x.to(dtype), y.to(dtype)).item() == pytest.approx(expected, abs=tolerance)
    torch.testing.assert_close(ssim_map(x, y), whole[5 : height - 5, 5 : width - 5])


def test_ssim_of_equal_images_is_one_and_of_its_negative_less_than_zero() -> None:
    x = random_image(32, 32)
    assert ssim(x, x).item() == pytest.approx(1.0)
    assert ssim(x, 1 - x).item() < 0


def test_ssim_does_not_depend_on_the_unit() -> None:
    x, y = random_image(32, 32), random_image(32, 32, seed=1)
    assert ssim(255 * x, 255 * y, range=255.0).item() == pytest.approx(ssim(x, y).item(), rel=1e-12)


def test_ssim_is_differentiable() -> None:
    x, y = (random_image(13, 12, 1, seed).requires_grad_() for seed in (0, 1))
    assert torch.autograd.gradcheck(ssim, (x, y))
    assert torch.autograd.gradcheck(lambda y: ssim(x.detach(), y), y)


def test_ssim_rejects_images_smaller_than_its_window() -> None:
    with pytest.raises(ValueError, match="smaller than the window"):
        ssim(random_image(10, 30), random_image(10, 30))


@pytest.mark.parametrize("change", [resize, resize_area])
@pytest.mark.parametrize(("height", "width"), [(12, 16), (24, 32), (3, 4), (5, 40), (7, 9)])
def test_resizing_keeps_a_ramp_in_place(change, height: int, width: int) -> None:
    """Pixel-centre convention: away from the border, a ramp over [0, 1] keeps its value at each position."""
    ramp = ((torch.arange(16, dtype=DOUBLE) + 0.5) / 16).expand(12, 16)[..., None]
    resized = change(ramp, height, width)[height // 2, :, 0]
    position = (torch.arange(width, dtype=DOUBLE) + 0.5) / width
    reach = max(1 / 16, 1 / width) * 1.01
    inner = (position > reach) & (position < 1 - reach)
    # A shift by half a pixel, the error to detect, would be 0.5 / 16. Bilinear enlarging of a ramp is exact; a
    # filter sampled at uneven positions is not, and the area mean treats the ramp as a staircase.
    exact = change is resize and (width >= 16 or 16 % width == 0)
    tolerance = 1e-12 if exact else 0.13 / 16 if width < 16 else 0.51 / 16
    torch.testing.assert_close(resized[inner], position[inner], rtol=0, atol=tolerance)


def test_enlarging_is_bilinear() -> None:
    x = random_image(5, 7)
    enlarged = resize(x, 10, 14)
    i, j = 4, 9
    top, left = (i + 0.5) / 2 - 0.5, (j + 0.5) / 2 - 0.5
    a, b = int(top), int(left)
    p, q = top - a, left - b
    byhand = (1 - p) * ((1 - q) * x[a, b] + q * x[a, b + 1]) + p * ((1 - q) * x[a + 1, b] + q * x[a + 1, b + 1])
    torch.testing.assert_close(enlarged[i, j], byhand)


def test_shrinking_does_not_alias() -> None:
    """A checkerboard of single pixels averages to grey; every third pixel alone would be black or white."""
    checker = (torch.arange(33)[:, None] + torch.arange(33)).remainder(2).to(DOUBLE)[..., None]
    # A triangle over five pixels gives 5/9 and 4/9 to the two colours of a row: (5/9)^2 + (4/9)^2 = 0.506.
    torch.testing.assert_close(
        resize(checker, 11, 11)[1:-1, 1:-1], torch.full((9, 9, 1), 0.5).double(), atol=0.01, rtol=0
    )


@pytest.mark.parametrize(("height", "width"), [(3, 4), (4, 6), (5, 9), (24, 24), (17, 5)])
def test_area_resizing_averages_over_each_pixel(height: int, width: int) -> None:
    x = random_image(12, 12)
    resized = resize_area(x, height, width)
    # The finest common grid, summed in blocks.
    fine = x.repeat_interleave(height, 0).repeat_interleave(width, 1)
    byhand = fine.reshape(height, 12, width, 12, 3).mean((1, 3))
    torch.testing.assert_close(resized, byhand)
    torch.testing.assert_close(resized.mean((0, 1)), x.mean((0, 1)))


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.float32])
def test_crop_box_fits_the_mask_and_stays_in_the_image(dtype: torch.dtype) -> None:
    mask = torch.zeros(10, 20, dtype=dtype)
    mask[3:5, 12:17] = 1
    assert crop_box(mask, 0) == (3, 12, 2, 5)
    assert crop_box(mask, 2) == (1, 10, 6, 9)
    assert crop_box(mask, 5) == (0, 7, 10, 13)
    assert (crop(mask, crop_box(mask, 0)) == 1).all()
    assert crop(mask[..., None].expand(10, 20, 3), (1, 10, 6, 9)).shape == (6, 9, 3)


@pytest.mark.parametrize("border", [1, 9])
def test_the_convex_hull_of_pixels_is_that_by_half_planes(border: int) -> None:
    """Some pixels lie outside of the image. OpenCV's lines are up to 2 wider."""
    pixels = np.random.default_rng(0).integers(-5, 50, (12, 2)).astype(np.int32)
    column, row = np.meshgrid(np.arange(60), np.arange(40))
    planes = ConvexHull(pixels).equations
    outside = (planes[:, 0, None, None] * column + planes[:, 1, None, None] * row + planes[:, 2, None, None]).max(0)
    found = filled_hull(pixels, (40, 60), border)
    assert found[outside <= border // 2 - 1].all()
    assert not found[outside > border // 2 + 2].any()
    assert not filled_hull(pixels[:0], (40, 60), border).any()


def test_crop_box_of_an_empty_mask_is_an_error() -> None:
    with pytest.raises(ValueError, match="empty"):
        crop_box(torch.zeros(4, 4), 1)


def test_to_srgb8_clamps_and_rounds() -> None:
    linear = torch.tensor([-0.1, 0.0, 0.2158605, 1.0, 7.0])
    # 128 / 255 is 0.502 in sRGB, and ((0.502 + 0.055) / 1.055)^2.4 = 0.21586.
    assert to_srgb8(linear).tolist() == [0, 0, 128, 255, 255]
