"""Light of the photographs: a convex object under uniform light, whose irradiance is known; metal beside paint."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.export.test_bake import RADIUS, painted
from tests.surfaces import GAMMA, look_at, sphere, torus
from tumble.export import asset as export
from tumble.export.asset import Preset
from tumble.maths.se3 import SE3
from tumble.rendering import lit_frames, render_gbuffer
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.capture import OBJECT, Capture
from tumble.scene.environment import Environment
from tumble.scene.material import Material
from tumble.scene.trajectory import Trajectory


@pytest.fixture(scope="module")
def asset() -> Asset:
    light = Environment.from_radiance(torch.full((8, 16, 3), 0.7))
    return replace(painted(sphere(3000, radius=RADIUS)), environment=light)


def capture(asset: Asset, value: int) -> Capture:
    """Photographs of one code value in which every pixel is known to show the object."""
    shape = (len(asset.trajectory), asset.camera.height, asset.camera.width)
    names = tuple(f"{i:04}.png" for i in range(len(asset.trajectory)))
    images = torch.full((*shape, 3), value, dtype=torch.uint8)
    return Capture(images, torch.full(shape, OBJECT, dtype=torch.uint8), asset.camera, names, "camera")


def test_a_convex_object_under_uniform_light_has_the_radiance_of_the_light(asset: Asset) -> None:
    """A white surface sends back all the light, 0.7; a highlight is a few per cent of it."""
    frames = list(lit_frames.lit_frames(asset, capture(asset, 188)))
    assert len(frames) == 3
    assert sum(frame.usable.sum() for frame in frames) > 100
    for number, frame in enumerate(frames):
        if not frame.usable.any():
            continue  # the object is at the border of this frame
        assert torch.equal(frame.T_cam_obj.xyz, asset.trajectory.T_cam_obj[number].xyz)
        # The sums over 256 directions are off by a few per cent.
        assert np.abs(frame.diffuse[frame.usable] / 0.7 - 1).max() < 0.06
        assert frame.specular[frame.usable].min() > 0
        assert frame.specular[frame.usable].max() < 0.1
        # sRGB 188 is linear 0.503.
        assert np.allclose(frame.photo, 0.503, atol=1e-3)


def test_metal_lights_its_surroundings_no_more_than_a_black_surface() -> None:
    """A white torus, one half of which is white metal, or black: the other half lies in the same light."""
    gaussians, T_cam_obj = torus(2000), look_at([1.5, 1.5, 4.0])
    half = gaussians.means[:, 0] > 0
    plain = Material.constant(2000, torch.full((3,), 0.9), 0.5)
    metal = replace(plain, metal_logits=torch.where(half, 200.0, -200.0))
    black = plain.with_albedo(torch.where(half[:, None, None], 1e-5, plain.albedo))
    path = Trajectory(SE3(T_cam_obj.wxyz[None], T_cam_obj.xyz[None]), "camera")
    light, camera = Environment.from_radiance(torch.ones(8, 16, 3)), Camera.from_fov(0.5, 48, 48)
    assets = [Asset(gaussians, GAMMA, material, light, path, camera) for material in (metal, black)]
    beside_metal, beside_black = (next(lit_frames.lit_frames(each, capture(each, 188))) for each in assets)
    view = render_gbuffer(assets[0], T_cam_obj, camera)
    white = beside_metal.usable & (view.features["metalness"][..., 0] < 1e-3).numpy()
    assert white.sum() > 100
    assert np.abs(beside_metal.diffuse - beside_black.diffuse)[white].max() < 1e-3


def test_an_export_with_a_capture_has_the_colour_of_the_photographs(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Linear 0.503 under light of 0.7 with highlights of 0.03: an albedo of 0.68 where photographs show a texel."""
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setitem(export.PRESETS, "web", Preset(triangles=400, texture=64, cells=24, views=12, pixels=64))
    caplog.set_level("INFO", "tumble")
    export.write_asset(asset, ["0.png", "1.png", "2.png"], tmp_path, "web", capture=capture(asset, 188))
    assert "solving the albedo" in caplog.messages
    (shape,) = trimesh.load_scene(tmp_path / "asset.glb", process=False).geometry.values()
    image = np.asarray(shape.visual.material.baseColorTexture.convert("RGB")).reshape(-1, 3)
    grey = (np.abs(image.astype(int) - 215).max(1) < 12).mean()
    export.write_asset(asset, ["0.png", "1.png", "2.png"], tmp_path, "web")
    (shape,) = trimesh.load_scene(tmp_path / "asset.glb", process=False).geometry.values()
    image = np.asarray(shape.visual.material.baseColorTexture.convert("RGB")).reshape(-1, 3)
    assert grey > 0.05
    assert (np.abs(image.astype(int) - 215).max(1) < 12).mean() < 0.02
