"""Texture information of images that show only texture, shading, noise or an edge."""

from dataclasses import replace

import torch

from tests.lopsided import tumbling
from tumble.poses.sfm.symmetry import texture_information
from tumble.poses.sfm.tracks import Tracks
from tumble.scene.capture import OBJECT

SIDE = 128
POSITIONS = torch.stack(torch.meshgrid(torch.arange(20.0, 108, 8), torch.arange(20.0, 108, 8), indexing="xy"), -1)
STEP = 3
"""Displacement of the object's texture from frame to frame [pixels]."""


def information_of(images: torch.Tensor) -> torch.Tensor:
    """Information at positions that move right by STEP per frame, in the first of three frames; in others it is 0."""
    uv = POSITIONS.flatten(0, 1).double() + 0.5
    n = len(uv)
    shift = torch.tensor([STEP, 0.0], dtype=torch.float64)
    uv_all = torch.cat([uv + k * shift for k in range(3)])
    tracks = Tracks(torch.arange(3).repeat_interleave(n), torch.arange(n).repeat(3), uv_all)
    code = images.clamp(0, 255).round().to(torch.uint8)[..., None].expand(3, SIDE, SIDE, 3)
    masks = torch.full((3, SIDE, SIDE), OBJECT, dtype=torch.uint8)
    found = texture_information.information(replace(tumbling(3).capture, images=code, masks=masks), tracks)
    assert not found[n:].any()
    return found[:n]


def moving(image: torch.Tensor) -> torch.Tensor:
    return torch.stack([image.roll(k * STEP, 1) for k in range(3)])


def blobs_of_contrast(contrast: float) -> torch.Tensor:
    """Blobs of about three pixels, with this standard deviation [code values]."""
    white = torch.randn(1, SIDE, SIDE, generator=seed())
    blobs = torch.nn.functional.avg_pool2d(torch.nn.functional.avg_pool2d(white, 3, 1, 1), 3, 1, 1)[0]
    return contrast * blobs / blobs.std()


def grain(deviation: float, shape: tuple[int, ...] = (3, SIDE, SIDE)) -> torch.Tensor:
    return deviation * torch.randn(shape, generator=torch.Generator().manual_seed(1))


def fraction_determined(information: torch.Tensor) -> float:
    """Fraction of positions that are determined in two directions."""
    return float((torch.linalg.eigvalsh(information)[:, 0] > 0.01).double().mean())


def test_texture_that_moves_with_the_point_is_informative() -> None:
    """Blobs of two pixels and 20 code values, with noise of 2, determine all directions to well under a pixel."""
    blobs = torch.nn.functional.avg_pool2d(torch.randn(1, SIDE, SIDE, generator=seed()), 3, 1, 1)[0]
    strength = torch.linalg.eigvalsh(information_of(moving(128 + 60 * blobs)))
    assert strength[:, 0].median() > 25


def test_static_shading_is_not_informative() -> None:
    column, row = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="xy")
    shading = 40 + 180 * (1 - ((column - 64) ** 2 + (row - 50) ** 2) / 12000)
    assert information_of(torch.stack([shading, shading, shading])).diagonal(dim1=1, dim2=2).sum(-1).median() < 1


def test_noise_is_not_informative() -> None:
    noise = 128 + 10 * torch.randn(3, SIDE, SIDE, generator=seed())
    assert (information_of(noise).abs().amax((1, 2)) > 0).double().mean() < 0.02


def test_texture_is_informative_under_equally_strong_grain() -> None:
    """With contrast and grain of 20 code values, single pixels of two frames have a correlation of one half."""
    clean, grainy = moving(128 + blobs_of_contrast(20)), moving(128 + blobs_of_contrast(20)) + grain(20)
    assert fraction_determined(information_of(clean)) > 0.9
    assert fraction_determined(information_of(grainy)) > 0.5
    # The noise variance is a hundred times the minimum that is assumed, with the same gradients.
    assert information_of(grainy).sum() < 0.1 * information_of(clean).sum()


def test_grain_carried_along_by_the_codec_is_not_informative() -> None:
    """Grain that moves along has a correlation of 0.6 between consecutive frames, and of 0.36 over two frames.

    By chance, a few of 121 patches have a higher one.
    """
    own = grain(20)
    frames = [own[0]]
    for fresh in own[1:]:
        frames.append(0.6 * frames[-1].roll(STEP, 1) + 0.8 * fresh)
    assert fraction_determined(information_of(128 + torch.stack(frames))) < 0.03


def test_an_edge_is_informative_only_across_it() -> None:
    edges = 100 + 50 * (torch.arange(SIDE) // 8 % 2).float()[None].expand(SIDE, -1)
    strength = torch.linalg.eigvalsh(information_of(moving(edges)))
    assert strength[:, 0].max() < 1e-3
    assert strength[:, 1].median() > 25


def seed() -> torch.Generator:
    return torch.Generator().manual_seed(0)
