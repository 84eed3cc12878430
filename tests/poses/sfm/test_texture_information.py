"""Texture against shading, noise and edges, each as a picture of its own."""

from dataclasses import replace

import torch

from tests.lopsided import tumbling
from tumble.poses.sfm import texture_information
from tumble.poses.sfm.tracks import Tracks
from tumble.scene.capture import OBJECT

SIDE = 128
PLACES = torch.stack(torch.meshgrid(torch.arange(20.0, 108, 8), torch.arange(20.0, 108, 8), indexing="xy"), -1)
STEP = 3
"""By which what is painted on the object moves from frame to frame [pixels]."""


def told(pictures: torch.Tensor) -> torch.Tensor:
    """Information at places that move right by STEP a frame, in three frames; that of the last two is always zero."""
    uv = PLACES.flatten(0, 1).double() + 0.5
    n = len(uv)
    shift = torch.tensor([STEP, 0.0], dtype=torch.float64)
    places = torch.cat([uv + k * shift for k in range(3)])
    tracks = Tracks(torch.arange(3).repeat_interleave(n), torch.arange(n).repeat(3), places)
    code = pictures.clamp(0, 255).round().to(torch.uint8)[..., None].expand(3, SIDE, SIDE, 3)
    masks = torch.full((3, SIDE, SIDE), OBJECT, dtype=torch.uint8)
    found = texture_information.information(replace(tumbling(3).capture, images=code, masks=masks), tracks)
    assert not found[n:].any()
    return found[:n]


def carried(picture: torch.Tensor) -> torch.Tensor:
    return torch.stack([picture.roll(k * STEP, 1) for k in range(3)])


def print_of(contrast: float) -> torch.Tensor:
    """Blobs of about three pixels [code values]."""
    white = torch.randn(1, SIDE, SIDE, generator=seed())
    blobs = torch.nn.functional.avg_pool2d(torch.nn.functional.avg_pool2d(white, 3, 1, 1), 3, 1, 1)[0]
    return contrast * blobs / blobs.std()


def grain(deviation: float, shape: tuple[int, ...] = (3, SIDE, SIDE)) -> torch.Tensor:
    return deviation * torch.randn(shape, generator=torch.Generator().manual_seed(1))


def share(information: torch.Tensor) -> float:
    """Of places that are known in two directions."""
    return float((torch.linalg.eigvalsh(information)[:, 0] > 0.01).double().mean())


def test_texture_that_moves_with_the_point_is_sharp() -> None:
    """Blobs of two pixels and 20 code values against 2 of noise: well under a pixel, in all directions."""
    blobs = torch.nn.functional.avg_pool2d(torch.randn(1, SIDE, SIDE, generator=seed()), 3, 1, 1)[0]
    strength = torch.linalg.eigvalsh(told(carried(128 + 60 * blobs)))
    assert strength[:, 0].median() > 25


def test_shading_that_stays_tells_nothing() -> None:
    column, row = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="xy")
    ball = 40 + 180 * (1 - ((column - 64) ** 2 + (row - 50) ** 2) / 12000)
    assert told(torch.stack([ball, ball, ball])).diagonal(dim1=1, dim2=2).sum(-1).median() < 1


def test_noise_tells_nothing() -> None:
    noise = 128 + 10 * torch.randn(3, SIDE, SIDE, generator=seed())
    assert (told(noise).abs().amax((1, 2)) > 0).double().mean() < 0.02


def test_a_print_is_seen_through_grain_as_strong() -> None:
    """Contrast of blobs and deviation of grain 20 code values: single pixels of two frames correlate to one half."""
    clean, grainy = carried(128 + print_of(20)), carried(128 + print_of(20)) + grain(20)
    assert share(told(clean)) > 0.9
    assert share(told(grainy)) > 0.5
    # The variance of the noise is a hundred times the least that is assumed, and the slopes stay.
    assert told(grainy).sum() < 0.1 * told(clean).sum()


def test_grain_that_the_codec_carries_on_tells_nothing() -> None:
    """It moves along with the point and correlates from frame to frame by 0.6: over two frames by 0.36, and by chance
    more in a few of 121 patches."""
    own = grain(20)
    frames = [own[0]]
    for fresh in own[1:]:
        frames.append(0.6 * frames[-1].roll(STEP, 1) + 0.8 * fresh)
    assert share(told(128 + torch.stack(frames))) < 0.03


def test_along_an_edge_nothing_is_known() -> None:
    edges = 100 + 50 * (torch.arange(SIDE) // 8 % 2).float()[None].expand(SIDE, -1)
    strength = torch.linalg.eigvalsh(told(carried(edges)))
    assert strength[:, 0].max() < 1e-3
    assert strength[:, 1].median() > 25


def seed() -> torch.Generator:
    return torch.Generator().manual_seed(0)
