"""Demo object and lights: valid geometry and textures, distinguishable sides, documented brightness."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tumble.maths.directions import direction_from_equirect, texel_directions, texel_solid_angles
from tumble.scene.environment import Environment
from tumble.synthetic import demo_object
from tumble.synthetic.demo_object import LAMP, SUN, WINDOW, pot

trimesh = pytest.importorskip("trimesh", reason="needs the extra `synth`")


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demo") / "pot.glb"
    demo_object.write_pot(path)
    return path


@pytest.fixture(scope="module")
def solids(glb: Path) -> dict[str, Any]:
    """The meshes of the file, as trimesh reads them."""
    return dict(trimesh.load_scene(glb, process=False).geometry)


@pytest.fixture(scope="module")
def room() -> Environment:
    return demo_object.room_environment(64)


@pytest.fixture(scope="module")
def sunset() -> Environment:
    return demo_object.sunset_environment(64)


# The object -----------------------------------------------------------------------------------------------------------


def test_the_object_fits_a_hand_and_a_triangle_budget(solids: dict[str, Any]) -> None:
    low = np.min([mesh.bounds[0] for mesh in solids.values()], 0)
    high = np.max([mesh.bounds[1] for mesh in solids.values()], 0)
    assert (high - low > 0.08).all()
    assert (high - low < 0.25).all(), "metres"
    assert abs(low[1]) < 1e-6, "the pot stands on y = 0"
    assert sum(len(mesh.faces) for mesh in solids.values()) < 15_000


def test_every_solid_is_watertight_and_oriented_outwards(solids: dict[str, Any]) -> None:
    """After merging the vertices that differ only in texture coordinates, at the borders of charts."""
    assert set(solids) == {"body", "lid", "knob", "spout", "handle"}
    for name, mesh in solids.items():
        merged = mesh.copy()
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        assert merged.is_watertight, name
        assert merged.is_winding_consistent, name
        assert merged.volume > 0, name


def test_normals_are_smooth_unit_vectors_on_the_outside_of_their_triangles(solids: dict[str, Any]) -> None:
    for name, mesh in solids.items():
        normals = mesh.vertex_normals
        # The file stores 32-bit floats.
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6, err_msg=name)
        corners = mesh.vertices[mesh.faces]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("fi,fci->fc", facing, normals[mesh.faces]) > 0).all(), name
        positions, index = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)
        for axis in range(3):
            low, high = np.full(len(positions), 2.0), np.full(len(positions), -2.0)
            np.minimum.at(low, index.reshape(-1), normals[:, axis])
            np.maximum.at(high, index.reshape(-1), normals[:, axis])
            assert (high - low).max() < 1e-5, f"{name}: no crease at the borders of charts"


def test_the_ends_of_spout_and_handle_are_inside_the_body() -> None:
    """There is no gap between the solids through which light could fall."""
    parts = pot.parts()
    body = parts["body"].vertices
    wall = body[body[:, 1] < 0.095]
    order = np.argsort(wall[:, 1], kind="stable")
    heights, radii = wall[order, 1], np.hypot(wall[order, 0], wall[order, 2])
    for name, chart in (("spout", "spout_end"), ("handle", "handle_start"), ("handle", "handle_end")):
        box = pot.CHARTS[chart]
        uv = parts[name].uv * pot.ATLAS - (box.left, box.top)
        x, y, z = parts[name].vertices[((uv >= 0) & (uv <= (box.width, box.height))).all(1)].T
        assert len(x) > 0
        # Rings of the body lie up to 6 mm apart, over which its radius changes by less than 3 %.
        outside = [radii[np.abs(heights - h) < 0.006].max() for h in y]
        assert (np.hypot(x, z) < 0.97 * np.array(outside)).all(), chart


def test_texture_coordinates_lie_in_the_atlas_and_do_not_overlap(solids: dict[str, Any]) -> None:
    """Brute force: the number of triangles over the centre of every texel."""
    width, height = pot.ATLAS
    count = np.zeros((height, width), int)
    for mesh in solids.values():
        uv = np.stack([mesh.visual.uv[:, 0], 1 - mesh.visual.uv[:, 1]], -1)
        assert uv.min() >= 0
        assert uv.max() <= 1
        for a, b, c in uv[mesh.faces] * (width, height) - 0.5:
            low = np.ceil(np.minimum(np.minimum(a, b), c)).astype(int)
            high = np.floor(np.maximum(np.maximum(a, b), c)).astype(int) + 1
            if (high <= low).any():
                continue
            x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
            edges = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
            # Strictly inside by a hundredth of a texel: a centre on a shared edge is not counted.
            inside = np.all([e < -1e-2 for e in edges], 0)
            count[low[1] : high[1], low[0] : high[0]] += inside
    assert count.max() == 1
    assert (count == 1).mean() > 0.7, "most of the atlas is used"


def test_the_texture_is_nowhere_mirrored(solids: dict[str, Any]) -> None:
    """Triangles that are counter-clockwise seen from outside are counter-clockwise in the texture."""
    for name, mesh in solids.items():
        # trimesh's v axis points up, so that counter-clockwise triangles have a positive area.
        a, b, c = np.moveaxis(mesh.visual.uv[mesh.faces], 1, 0)
        area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (area > 0).all(), name


def test_label_faces_the_front_and_stands_upright(solids: dict[str, Any]) -> None:
    body = solids["body"]
    label = np.linalg.norm(body.visual.uv - (0.745, 1 - 0.30), axis=1).argmin()
    x, _, z = body.vertices[label]
    assert z > 0.04
    assert abs(x) < 0.004, "one column of vertices"
    on_label = np.abs(body.visual.uv - (0.745, 1 - 0.30)).max(1) < 0.1
    assert np.corrcoef(body.visual.uv[on_label, 1], body.vertices[on_label, 1])[0, 1] > 0.99
    assert np.corrcoef(body.visual.uv[on_label, 0], body.vertices[on_label, 0])[0, 1] > 0.99


def test_textures_have_plausible_materials(solids: dict[str, Any]) -> None:
    material = solids["lid"].visual.material
    assert material.metallicFactor == 0
    assert material.baseColorTexture.size == material.metallicRoughnessTexture.size == (1024, 512)
    codes = np.asarray(material.baseColorTexture.convert("RGB")) / 255
    albedo = ((codes + 0.055) / 1.055) ** 2.4
    assert albedo.min() >= 0.04
    assert albedo.max() <= 0.85
    roughness = np.asarray(material.metallicRoughnessTexture.convert("RGB"))[..., 1] / 255
    # Values are rounded to one of 256 levels.
    assert roughness.min() == pytest.approx(0.15, abs=2e-3)
    assert roughness.max() == pytest.approx(0.80, abs=2e-3)
    assert len(np.unique(roughness)) > 8


def test_the_body_has_no_rotational_symmetry() -> None:
    """The autocorrelation of its texture is far below 1 for rotations by more than 20 degrees."""
    chart = pot.CHARTS["body"]
    texture = pot.atlas()[0][chart.top : chart.top + chart.height, chart.left : chart.left + chart.width]
    rows = texture.astype(float) - texture.mean(1, keepdims=True)
    spectrum = np.fft.rfft(rows, axis=1)
    correlation = np.fft.irfft((spectrum * spectrum.conj()).sum((0, 2)), n=chart.width)
    correlation /= correlation[0]
    far = round(chart.width * 20 / 360)
    assert correlation[far:-far].max() < 0.5


@pytest.mark.parametrize("name", ["body", "lid", "base", "spout", "handle", "knob"])
def test_every_side_is_textured(name: str) -> None:
    """The standard deviation of the code values is above 20 on all sides, so that features can be tracked."""
    chart = pot.CHARTS[name]
    grey = pot.atlas()[0].mean(-1)[chart.top : chart.top + chart.height, chart.left : chart.left + chart.width]
    assert grey.std() > 20


def test_the_object_file_is_reproducible_byte_for_byte(glb: Path, tmp_path: Path) -> None:
    demo_object.write_pot(tmp_path / "again.glb")
    assert (tmp_path / "again.glb").read_bytes() == glb.read_bytes()
    assert glb.stat().st_size < 1_000_000


# The lights -----------------------------------------------------------------------------------------------------------


def direction(d: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(d)


@pytest.mark.parametrize("d", [LAMP, WINDOW, SUN])
def test_documented_directions_have_unit_length(d: tuple[float, float, float]) -> None:
    """Up to the four digits with which they are written."""
    assert math.hypot(*d) == pytest.approx(1, abs=2e-4)


@pytest.mark.parametrize("light", ["room", "sunset"])
def test_lights_are_finite_positive_and_of_sensible_brightness(light: str, request: pytest.FixtureRequest) -> None:
    environment: Environment = request.getfixturevalue(light)
    assert environment.radiance.shape == (64, 128, 3)
    assert torch.isfinite(environment.radiance).all()
    assert environment.radiance.min() > 0
    mean = environment.integral() / (4 * math.pi)
    assert (mean > 0.2).all()
    assert (mean < 0.8).all()


def test_the_lamp_is_the_brightest_part_of_the_room_and_not_mirror_symmetric(room: Environment) -> None:
    lamp = direction(LAMP)
    assert 40 < room.lookup(lamp)[0] < 100
    assert room.lookup(lamp)[0] > 2 * room.lookup(lamp)[2], "warm"
    d_env = texel_directions(64, 128)
    elsewhere = (d_env @ lamp) < math.cos(math.radians(12))
    assert room.radiance[elsewhere].max() < 0.4 * room.lookup(lamp)[0]
    for mirror in ([-1, 1, 1], [1, -1, 1], [1, 1, -1]):
        assert room.lookup(lamp * torch.tensor(mirror)).max() < 0.1 * room.lookup(lamp)[0]


def test_the_window_is_bluish_and_has_the_documented_size(room: Environment) -> None:
    pane = room.lookup(direction(WINDOW))
    assert pane[2] > pane[0] > 2
    bright = (room.radiance[..., 2] > 5) & (texel_directions(64, 128)[..., 0] < 0)
    # 1.9 m by 1.4 m at a distance of 2.2 m and an inclination of 30 degrees: about 0.45 steradian.
    assert 0.25 < float((texel_solid_angles(64, 128) * bright).sum()) < 0.6


def test_the_room_illuminates_the_sides_differently(room: Environment) -> None:
    """Irradiance in six directions, by summation over the map, varies and differs between left and right."""
    d_env, area = texel_directions(64, 128), texel_solid_angles(64, 128)
    sides = torch.cat([torch.eye(3), -torch.eye(3)])
    cosine = (d_env[None] * sides[:, None, None]).sum(-1).clamp_min(0) * area
    irradiance = torch.einsum("shw,hwc->sc", cosine, room.radiance).mean(-1)
    assert irradiance.max() > 3 * irradiance.min()
    left, right = irradiance[3], irradiance[0]
    assert abs(left - right) > 0.1 * (left + right)


def test_the_sun_is_a_warm_disc_of_the_documented_size() -> None:
    """The texels above half the peak cover 2 pi (1 - cos 2.5 degrees) to within a tenth."""
    sunset = demo_object.sunset_environment(128)
    sun = direction(SUN)
    peak = sunset.lookup(sun)
    assert peak[0] > 300
    assert peak[0] > 2 * peak[2]
    disc = sunset.radiance[..., 0] > 0.5 * peak[0]
    size = float((texel_solid_angles(128, 256) * disc).sum())
    assert size == pytest.approx(2 * math.pi * (1 - math.cos(math.radians(2.5))), rel=0.1)
    assert (texel_directions(128, 256)[disc] @ sun).min() > math.cos(math.radians(3))


def test_the_sunset_has_a_dark_ground_and_a_violet_sky_opposite_to_the_sun(sunset: Environment) -> None:
    ground = sunset.lookup(direction((0.0, -1.0, 0.0)))
    assert ground[0] > ground[2]
    across = sunset.lookup(direction_from_equirect(torch.tensor([0.14, 0.45])))
    assert across[2] > across[1]
    assert ground.max() < across.max()


def test_lights_do_not_depend_on_the_number_of_rows(room: Environment) -> None:
    """Integrals at 32 and 64 rows differ by at most 2 %, although at 32 rows the lamp is only a few texels wide."""
    torch.testing.assert_close(demo_object.room_environment(32).integral(), room.integral(), rtol=0.02, atol=0)
