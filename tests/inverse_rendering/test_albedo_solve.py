"""The albedo that photographs determine: a convex object under uniform light, whose radiance is known."""

from dataclasses import replace

import pytest
import torch

from tests.export.test_bake import RADIUS, painted
from tests.rendering.test_lit_frames import capture
from tests.surfaces import sphere
from tumble.inverse_rendering import albedo_solve
from tumble.maths import to_srgb8
from tumble.rendering import render_gbuffer
from tumble.rendering.lit_frames import LitFrame, lit_frames
from tumble.scene.asset import Asset
from tumble.scene.environment import Environment
from tumble.scene.material import Material


@pytest.fixture(scope="module")
def asset() -> Asset:
    light = Environment.from_radiance(torch.full((8, 16, 3), 0.7))
    bare = painted(sphere(3000, radius=RADIUS))
    material = Material.constant(len(bare.gaussians.means), torch.tensor([0.6, 0.7, 0.05]), 0.5)
    return replace(bare, environment=light, material=material)


def shown(asset: Asset, frames: list[LitFrame]) -> torch.Tensor:
    """Whether a Gaussian dominates a usable pixel of some frame."""
    seen = torch.zeros(len(asset.gaussians.means), dtype=torch.bool)
    for frame in frames:
        index = render_gbuffer(asset, frame.T_cam_obj, asset.camera).dominant[torch.from_numpy(frame.usable)]
        seen[index[index >= 0].long()] = True
    return seen


def test_a_white_object_gets_the_albedo_of_its_photographs_and_the_rest_keeps_its_own(asset: Asset) -> None:
    """sRGB 188 is linear 0.503; under radiance 0.7 and with highlights of 0.03 that is an albedo of 0.68."""
    photos = capture(asset, 188)
    solved = albedo_solve.solved(asset, photos).material.albedo.mean(1)
    seen = shown(asset, list(lit_frames(asset, photos)))
    assert 100 < seen.sum() < len(seen) - 100
    assert (solved[seen, :2] / 0.68 - 1).abs().median() < 0.04
    behind = ~seen & ((solved - asset.material.albedo.mean(1)).abs().amax(-1) < 1e-4)
    assert behind.sum() > 0.5 * (~seen).sum()


def test_what_highlights_explain_is_no_albedo(asset: Asset) -> None:
    """A photograph whose blue is as bright as the highlights alone shows paint without any blue."""
    photos = capture(asset, 188)
    bright = [frame.specular[frame.usable][..., 2].mean() for frame in lit_frames(asset, photos) if frame.usable.any()]
    images = photos.images.clone()
    images[..., 2] = to_srgb8(torch.tensor(sum(bright) / len(bright)))
    solved = albedo_solve.solved(asset, replace(photos, images=images)).material.albedo.mean(1)
    seen = shown(asset, list(lit_frames(asset, photos)))
    assert solved[seen, 2].median() < 0.01
    assert (solved[seen, 0] / 0.68 - 1).abs().median() < 0.04
