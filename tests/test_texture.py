"""Texture against shading, noise and edges, each as a picture of its own."""

from dataclasses import replace

import torch

from tests.lopsided import tumbling
from tumble import texture
from tumble.capture import OBJECT
from tumble.tracks import Tracks

SIDE = 128
PLACES = torch.stack(torch.meshgrid(torch.arange(20.0, 108, 8), torch.arange(20.0, 108, 8), indexing="xy"), -1)
STEP = 3
"""By which what is painted on the object moves from frame to frame [pixels]."""


def told(pictures: torch.Tensor) -> torch.Tensor:
    """Information at places that move right by STEP; the second observation's is always zero."""
    uv = PLACES.flatten(0, 1).double() + 0.5
    n = len(uv)
    shifted = uv + torch.tensor([STEP, 0.0], dtype=torch.float64)
    tracks = Tracks(torch.arange(2).repeat_interleave(n), torch.arange(n).repeat(2), torch.cat([uv, shifted]))
    code = pictures.clamp(0, 255).round().to(torch.uint8)[..., None].expand(2, SIDE, SIDE, 3)
    masks = torch.full((2, SIDE, SIDE), OBJECT, dtype=torch.uint8)
    found = texture.information(replace(tumbling(2).capture, images=code, masks=masks), tracks)
    assert not found[n:].any()
    return found[:n]


def carried(picture: torch.Tensor) -> torch.Tensor:
    return torch.stack([picture, picture.roll(STEP, 1)])


def test_texture_that_moves_with_the_point_is_sharp() -> None:
    """Blobs of two pixels and 20 code values against 2 of noise: well under a pixel, in all directions."""
    blobs = torch.nn.functional.avg_pool2d(torch.randn(1, SIDE, SIDE, generator=seed()), 3, 1, 1)[0]
    strength = torch.linalg.eigvalsh(told(carried(128 + 60 * blobs)))
    assert strength[:, 0].median() > 25


def test_shading_that_stays_tells_nothing() -> None:
    column, row = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="xy")
    ball = 40 + 180 * (1 - ((column - 64) ** 2 + (row - 50) ** 2) / 12000)
    assert told(torch.stack([ball, ball])).diagonal(dim1=1, dim2=2).sum(-1).median() < 1


def test_noise_tells_nothing() -> None:
    noise = 128 + 10 * torch.randn(2, SIDE, SIDE, generator=seed())
    assert (told(noise).abs().amax((1, 2)) > 0).double().mean() < 0.02


def test_along_an_edge_nothing_is_known() -> None:
    edges = 100 + 50 * (torch.arange(SIDE) // 8 % 2).float()[None].expand(SIDE, -1)
    strength = torch.linalg.eigvalsh(told(carried(edges)))
    assert strength[:, 0].max() < 1e-3
    assert strength[:, 1].median() > 25


def seed() -> torch.Generator:
    return torch.Generator().manual_seed(0)
