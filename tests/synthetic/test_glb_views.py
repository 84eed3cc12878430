"""An exported GLB, read back and rendered: a square of two colours in front of a camera."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tumble.export import gltf
from tumble.export.atlas import UnwrappedMesh
from tumble.export.bake import Textures
from tumble.maths.images import linear_from_srgb
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment

pytest.importorskip("mitsuba")

LEFT, RIGHT = [200, 60, 30], [20, 90, 220]
"""sRGB code values of the square's halves x < 0 and x > 0."""
RADIUS = 0.05
"""Metres per object radius."""


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The square |x|, |y| < 0.5 of the plane z = 0, facing +z, roughness 0.6."""
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    flat = UnwrappedMesh(
        corners, np.tile([0.0, 0, 1], (4, 1)), np.tile([1.0, 0, 0, 1], (4, 1)), uv, np.array([[0, 1, 2], [0, 2, 3]])
    )
    color = np.full((64, 64, 3), LEFT, np.uint8)
    color[:, 32:] = RIGHT
    rough, normal = np.full((64, 64), 153, np.uint8), np.full((64, 64, 3), [128, 128, 255], np.uint8)
    path = tmp_path_factory.mktemp("glb") / "asset.glb"
    gltf.write_glb(path, flat, Textures(color, rough, normal), f0=0.02, metres=RADIUS)
    return path


def test_maps_and_images_of_an_exported_glb(glb: Path) -> None:
    """In the asset's unit the square is 10 of 40 pixels wide; a factor on the albedo is one on its light."""
    from tumble.synthetic import glb_images, glb_maps, read_glb

    model = read_glb(glb, RADIUS)
    camera = Camera.from_fov(2 * math.atan(0.5), 40, 40)
    pose = SE3(SO3.exp(torch.tensor([math.pi, 0.0, 0.0])).wxyz, torch.tensor([0.0, 0.0, 4.0]))
    maps = glb_maps(model, [pose], camera)
    expected = np.zeros((40, 40), bool)
    expected[15:25, 15:25] = True
    assert (maps.mask[0] == expected).all()
    for columns, color in ((np.s_[13:19], LEFT), (np.s_[21:27], RIGHT)):
        linear = linear_from_srgb(torch.tensor(color).float() / 255).numpy()
        # Two pixels beyond the border are those of the border, where Mitsuba blends in the other end of the texture.
        assert np.allclose(maps.albedo[0, 15:25, columns], linear, atol=0.02)
    assert not maps.albedo[0, :12].any()
    assert np.allclose(maps.roughness[0, 15:25, 15:25], 0.6, atol=2e-3)
    assert np.allclose(maps.normal[0, 15:25, 15:25], [0, 0, 1], atol=2e-3)
    white = Environment.from_radiance(torch.ones(8, 16, 3))
    bright, dim = (
        glb_images(model, [pose], camera, white, albedo_scale=np.full(3, scale), f0=0.02, samples=64)[0, 20, 17, 0]
        for scale in (1.0, 0.5)
    )
    # Under white light a square shows its albedo, and a highlight of a few per cent.
    albedo = maps.albedo[0, 20, 17, 0]
    assert bright - dim == pytest.approx(0.5 * albedo, rel=0.05)
    assert 0 < bright - albedo < 0.06


def test_the_principal_point_may_be_off_the_centre(glb: Path) -> None:
    """As in a capture that is cut out of larger frames: the square is 5 pixels further right and 8 further up."""
    from tumble.synthetic import glb_maps, read_glb

    pose = SE3(SO3.exp(torch.tensor([math.pi, 0.0, 0.0])).wxyz, torch.tensor([0.0, 0.0, 4.0]))
    maps = glb_maps(read_glb(glb, RADIUS), [pose], Camera(torch.tensor([40.0, 40.0, 25.0, 12.0]), 40, 40))
    expected = np.zeros((40, 40), bool)
    expected[7:17, 20:30] = True
    assert (maps.mask[0] == expected).all()
