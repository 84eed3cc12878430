"""Exported files, read back by code of the tests and by an independent library."""

import json
import math
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.export.test_bake import RADIUS, colour, painted, roughness
from tests.surfaces import sphere
from tumble.export import asset as export
from tumble.export import atlas, bake, gltf, mesh, ply
from tumble.export import poses as pose_files
from tumble.export.asset import Preset
from tumble.io import files
from tumble.maths.directions import fibonacci_sphere
from tumble.maths.images import linear_from_srgb
from tumble.maths.se3 import SE3
from tumble.rendering import relight
from tumble.scene.asset import Asset
from tumble.scene.environment import Environment
from tumble.scene.gaussians import opacity
from tumble.scene.trajectory import Trajectory

SMALL = Preset(triangles=1500, texture=192, cells=32, views=24, pixels=128)
NAMES = ["0003.png", "0004.png", "0009.png"]
SCALE_MM = 95.0


@pytest.fixture(scope="module")
def asset() -> Asset:
    return painted(sphere(3000, radius=RADIUS))


@pytest.fixture(scope="module")
def folder(asset: Asset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export of a sphere of 95 mm with small settings for the preset "web"."""
    out = tmp_path_factory.mktemp("export")
    patch = pytest.MonkeyPatch()
    patch.setitem(export.PRESETS, "web", SMALL)
    export.write_asset(asset, NAMES, out, "web", SCALE_MM)
    patch.undo()
    return out


def chunks(path: Path) -> tuple[dict, bytes]:
    """JSON document and binary chunk of a GLB (glTF 2.0, section 4)."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert 28 + size + binary_size == len(data)
    assert binary_size % 4 == 0
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a binary PLY of floats, by name."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    assert all(line.startswith("property float ") for line in lines[3:])
    names = [line.split()[-1] for line in lines[3:]]
    assert len(body) == 4 * count * len(names)
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(count, -1).T, strict=True))


def test_the_glb_follows_the_gltf_layout(folder: Path) -> None:
    document, binary = chunks(folder / "asset.glb")
    assert document["buffers"] == [{"byteLength": len(binary)}]
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
    primitive = document["meshes"][0]["primitives"][0]
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    view = document["bufferViews"][position["bufferView"]]
    vertices = np.frombuffer(binary, "<f4", 3 * position["count"], view["byteOffset"]).reshape(-1, 3)
    assert vertices.min(0).tolist() == position["min"]
    assert vertices.max(0).tolist() == position["max"]
    # The sphere is 95 mm wide, in metres.
    assert mesh.diameter(vertices.astype(np.float64)) == pytest.approx(SCALE_MM / 1000, rel=1e-5)
    indices = document["accessors"][primitive["indices"]]
    assert 900 < indices["count"] / 3 <= SMALL.triangles
    starts = [document["bufferViews"][image["bufferView"]]["byteOffset"] for image in document["images"]]
    assert all(binary[start : start + 8] == b"\x89PNG\r\n\x1a\n" for start in starts)
    # The header of the compressed data (RFC 1950) tells the effort: 0 for runs only, 2 for level 6.
    assert all(binary[binary.index(b"IDAT", start) + 5] >> 6 == 0 for start in starts)
    assert document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_a_viewer_finds_the_true_normals_through_the_tangents_of_the_file(asset: Asset, tmp_path: Path) -> None:
    """By the rule of glTF 2.0 (section 3.7.2.1): the bitangent is the normal x the tangent, times its fourth number."""
    values = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 25)] * 3, indexing="ij"), -1), axis=-1) - RADIUS
    shape = mesh.simplify(mesh.marching_tetrahedra(values, -1.0, 2 / 24), 300)
    flat = atlas.unwrap(shape, 96)
    tilt = torch.tensor([0.3, -0.2, 0.25])
    tilted = replace(asset, material=replace(asset.material, normal_offset=asset.material.normal_offset + tilt))
    textures = bake.bake(tilted, flat, resolution=96, views=12, pixels=64)
    gltf.write_glb(tmp_path / "x.glb", flat, textures, f0=0.04, metres=1.0)
    document, binary = chunks(tmp_path / "x.glb")

    def vertices(name: str, width: int) -> torch.Tensor:
        accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        numbers = np.frombuffer(binary, "<f4", width * accessor["count"], start).reshape(-1, width)
        return torch.from_numpy(numbers.copy())

    view = document["bufferViews"][document["images"][2]["bufferView"]]
    png = np.frombuffer(binary, np.uint8, view["byteLength"], view["byteOffset"])
    normal_map = torch.from_numpy(cv2.imdecode(png, cv2.IMREAD_COLOR_RGB)) / 127.5 - 1
    normals, tangents, uv = vertices("NORMAL", 3), vertices("TANGENT", 4), vertices("TEXCOORD_0", 2)
    column, row = (uv * 96).long().clamp(0, 95).unbind(-1)
    bitangents = torch.linalg.cross(normals, tangents[:, :3]) * tangents[:, 3:]
    found = (normal_map[row, column][:, None] * torch.stack([tangents[:, :3], bitangents, normals], -1)).sum(-1)
    true = torch.nn.functional.normalize(vertices("POSITION", 3) / RADIUS + tilt, dim=-1)
    cosine = (torch.nn.functional.normalize(found, dim=-1) * true).sum(-1)
    # Texels are up to three degrees away from the vertices.
    assert cosine.quantile(0.01) > math.cos(math.radians(5))


def test_metalness_is_in_the_blue_channel_and_in_the_columns(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The half of the sphere towards +x is metal."""
    trimesh = pytest.importorskip("trimesh")
    logits = torch.where(asset.gaussians.means[:, 0] > 0, 20.0, -20.0)
    half = replace(asset, material=replace(asset.material, metal_logits=logits))
    monkeypatch.setitem(export.PRESETS, "web", SMALL)
    export.write_asset(half, NAMES, tmp_path, "web", SCALE_MM)
    document, _ = chunks(tmp_path / "asset.glb")
    assert document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 1
    (shape,) = trimesh.load_scene(tmp_path / "asset.glb", process=False).geometry.values()
    packed = np.asarray(shape.visual.material.metallicRoughnessTexture.convert("RGB"))
    x = shape.triangles_center[:, 0] / (SCALE_MM / 2000)
    uv = shape.visual.uv[shape.faces].mean(1)
    row, column = ((1 - uv[:, 1]) * len(packed)).astype(int), (uv[:, 0] * len(packed)).astype(int)
    clear = (np.abs(x) > 0.15) & (shape.area_faces > 1e-8)
    assert ((packed[row, column, 2] > 127) == (x > 0))[clear].mean() > 0.99
    columns = table(tmp_path / "asset_material.ply")
    assert np.array_equal(columns["metalness"] > 0.5, columns["x"] > 0)


def test_an_independent_reader_finds_each_colour_in_its_place(folder: Path) -> None:
    """trimesh reads the file; colours differ along all axes, so a flip of u, v or an axis would be noticed."""
    trimesh = pytest.importorskip("trimesh")
    (shape,) = trimesh.load_scene(folder / "asset.glb", process=False).geometry.values()
    material = shape.visual.material
    image = np.asarray(material.baseColorTexture.convert("RGB")) / 255.0
    roughness_map = np.asarray(material.metallicRoughnessTexture.convert("RGB"))[..., 1] / 255.0
    # Faces without area have no texels.
    faces = np.random.default_rng(0).choice(np.nonzero(shape.area_faces > 1e-8)[0], 400)
    points = torch.from_numpy(shape.triangles_center[faces]).float()
    x = RADIUS * torch.nn.functional.normalize(points, dim=-1)
    uv = shape.visual.uv[shape.faces[faces]].mean(1)
    # The v of trimesh starts at the bottom.
    column, row = (np.floor(u * SMALL.texture).astype(int) for u in (uv[:, 0], 1 - uv[:, 1]))
    error = (linear_from_srgb(torch.from_numpy(image[row, column]).float()) - colour(x)).abs()
    assert error.max() < 0.06
    assert np.abs(roughness_map[row, column] - roughness(x).numpy()).max() < 0.05
    assert shape.is_winding_consistent
    assert (shape.face_normals[faces] * x.numpy()).sum(1).min() > 0.9 * RADIUS


def test_f0_below_004_is_a_specular_factor_and_above_an_index_of_refraction() -> None:
    assert gltf.reflectance_extension(0.02) == ("KHR_materials_specular", {"specularFactor": 0.5})
    name, value = gltf.reflectance_extension(0.0625)
    # ((n - 1) / (n + 1))^2 = 1/16.
    assert name == "KHR_materials_ior"
    assert value["ior"] == pytest.approx(5 / 3)


def test_the_ply_has_the_common_layout(folder: Path, asset: Asset) -> None:
    columns = table(folder / "asset.ply")
    rest = [f"f_rest_{i}" for i in range(45)]
    assert list(columns) == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(*rest, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    metres = files.read_json(folder / "export.json")["metres_per_object_radius"]
    gaussians = asset.gaussians
    assert np.allclose([columns["x"], columns["y"], columns["z"]], gaussians.means.T * metres, atol=1e-7)
    assert np.allclose(np.exp(columns["scale_2"]), gaussians.scales[:, 2] * metres, rtol=1e-5)
    alpha = opacity(gaussians.sdf, asset.gamma).clamp(max=1 - 1e-4)
    assert np.allclose(1 / (1 + np.exp(-columns["opacity"])), alpha, atol=1e-5)
    # The quaternion w, x, y, z rotates +z to the normal.
    w, x, y, z = (columns[f"rot_{i}"] for i in range(4))
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert np.allclose(axis, [columns["nx"], columns["ny"], columns["nz"]], atol=1e-5)


def test_splat_colours_are_those_of_the_first_frame(folder: Path, asset: Asset) -> None:
    """Under white light a viewer's colour, 1/2 + 0.282 f_dc, is the sRGB of light times albedo plus 4 % specular."""
    lit = Asset(
        **{
            **{name: getattr(asset, name) for name in ("gaussians", "gamma", "material", "trajectory", "camera")},
            "environment": Environment.from_radiance(torch.full((8, 16, 3), 0.8)),
        }
    )
    columns = ply.splat_columns(lit, 1.0)
    displayed = torch.tensor(np.stack([columns[f"f_dc_{i}"] for i in range(3)], -1)) * 0.28209479 + 0.5
    expected = 0.8 * colour(asset.gaussians.means)
    error = linear_from_srgb(displayed) - expected
    assert error.min() > 0.0
    assert error.max() < 0.08


def test_the_other_ply_adds_the_material(folder: Path, asset: Asset) -> None:
    columns = table(folder / "asset_material.ply")
    albedo = np.stack([columns[f"albedo_{i}"] for i in range(3)], -1)
    assert np.allclose(albedo, colour(asset.gaussians.means), atol=0.01)
    assert np.allclose(columns["roughness"], roughness(asset.gaussians.means), atol=0.01)
    assert asset.material is not None
    assert np.allclose(columns["f0"], asset.material.f0)


def test_poses_are_the_same_in_all_three_formats(folder: Path, asset: Asset) -> None:
    """In each, a point of the object projects to the same pixel."""
    metres = files.read_json(folder / "export.json")["metres_per_object_radius"]
    x_obj = 0.5 * fibonacci_sphere(20, dtype=torch.float64)
    doubled = SE3(asset.trajectory.T_cam_obj.wxyz.double(), asset.trajectory.T_cam_obj.xyz.double())
    uv = torch.stack([asset.camera.project((doubled[i] @ x_obj).float()) for i in range(3)])
    matrices = files.read_json(folder / "poses.json")
    assert list(matrices) == NAMES
    back = Trajectory.from_camera_to_object(torch.tensor(list(matrices.values()), dtype=torch.float64), "camera")
    truth, cameras = (files.read_json(folder / "bop" / f"scene_{name}.json") for name in ("gt", "camera"))
    lines = [line.split() for line in (folder / "poses_tum.txt").read_text().splitlines() if line[0] != "#"]
    assert list(truth) == list(cameras) == [line[0] for line in lines] == ["3", "4", "9"]
    for i, (number, line) in enumerate(zip(truth, lines, strict=True)):
        assert torch.allclose(asset.camera.project((back.T_cam_obj[i] @ (x_obj * metres)).float()), uv[i], atol=1e-3)
        (pose,) = truth[number]
        R, t = np.reshape(pose["cam_R_m2c"], (3, 3)), np.array(pose["cam_t_m2c"])
        projected = (x_obj.numpy() * metres * 1000 @ R.T + t) @ np.reshape(cameras[number]["cam_K"], (3, 3)).T
        # Pixel centres of BOP have integer coordinates.
        assert np.allclose(projected[:, :2] / projected[:, 2:] + 0.5, uv[i], atol=1e-3)
        tx, ty, tz, qx, qy, qz, qw = (float(word) for word in line[1:])
        T_obj_cam = SE3(torch.tensor([qw, qx, qy, qz]).double(), torch.tensor([tx, ty, tz]).double())
        x_cam = T_obj_cam.inverse() @ (x_obj * metres)
        assert torch.allclose(asset.camera.project(x_cam.float()), uv[i], atol=1e-2)


def test_frames_without_distinct_numbers_are_numbered_from_0() -> None:
    assert pose_files._frame_numbers(["b.png", "a.png"]) == [0, 1]
    assert pose_files._frame_numbers(["7.png", "007.png"]) == [0, 1]


def test_the_light_file_documents_its_orientation(folder: Path, asset: Asset) -> None:
    facts = files.read_json(folder / "light.json")
    assert facts["first_frame"] == NAMES[0]
    assert facts["up"].startswith("+y")
    assert facts["zero_azimuth"].startswith("-z")
    for name, tolerance in (("light.exr", 1e-5), ("light.hdr", 0.01)):
        back = Environment.read(folder / name).radiance
        assert ((back - asset.environment.radiance).abs() < tolerance * asset.environment.radiance.max()).all()
    # R takes the camera's view direction of the first frame to the map's centre, -z.
    forward_obj = asset.trajectory.T_cam_obj[0].rotation.matrix().T @ torch.tensor([0.0, 0, 1])
    R = torch.tensor(facts["R_light_object_of_first_frame"])
    assert torch.allclose(R @ forward_obj, torch.tensor([0.0, 0, -1]), atol=1e-5)


def test_every_part_of_an_export_that_takes_long_is_a_line_of_the_log(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(export.PRESETS, "web", Preset(triangles=100, texture=32, cells=12, views=4, pixels=32))
    caplog.set_level("INFO", "tumble")
    export.write_asset(asset, NAMES, tmp_path, "web")
    first = ["fusing depth maps", "extracting the mesh", "texture coordinates", "baking textures"]
    assert [text for text in caplog.messages if text in first] == first
    assert "confidence of the material" in caplog.messages, "it is found beside the mesh"


def test_splats_alone_need_no_mesh(asset: Asset, tmp_path: Path) -> None:
    export.write_asset(asset, NAMES, tmp_path, "splat")
    assert not (tmp_path / "asset.glb").exists()
    assert files.read_json(tmp_path / "export.json")["metres_per_object_radius"] == 1.0
    assert np.allclose(table(tmp_path / "asset.ply")["x"], asset.gaussians.means[:, 0])


def test_an_export_takes_the_place_of_one_with_another_preset_as_a_whole(
    asset: Asset, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or not at all, if writing fails. What is not of an export stays."""

    def content(path: Path) -> dict[str, bytes]:
        return {str(each.relative_to(path)): each.read_bytes() for each in path.rglob("*") if each.is_file()}

    out, foreign, fresh = tmp_path / "out", tmp_path / "foreign", tmp_path / "fresh"
    shutil.copytree(folder, out)
    (out / "notes.txt").write_text("mine")
    before = content(out)
    with monkeypatch.context() as patch:
        patch.setattr(export, "write_poses", lambda *about: files.write_json(about[-1] / "asset.ply" / "poses.json", 0))
        with pytest.raises(files.WriteError, match=r"poses\.json: cannot be written"):
            export.write_asset(asset, NAMES, out, "splat")
    assert content(out) == before
    export.write_asset(asset, NAMES, out, "splat")
    assert content(out).keys() == before.keys() - {"asset.glb", "confidence.png"}
    assert files.read_json(out / "export.json")["preset"] == "splat"
    foreign.mkdir()
    (foreign / "asset.glb").write_text("mine")
    export.write_asset(asset, NAMES, foreign, "splat")
    assert (foreign / "asset.glb").read_text() == "mine"
    export.write_asset(asset, NAMES, fresh, "splat")
    assert content(fresh) == {name: data for name, data in content(out).items() if name != "notes.txt"}


def test_a_turntable_rotates_about_the_vertical_under_a_fixed_light(asset: Asset) -> None:
    shift = torch.tensor([0.3, -0.2, 0.1])
    gaussians = replace(asset.gaussians, means=asset.gaussians.means + shift)
    moved, camera = replace(asset, gaussians=gaussians), asset.camera.centred()
    R_gl_obj, turning = relight.turntable(moved, camera, 8, math.radians(20))
    at_left = asset.gaussians.means.amin(0) + shift
    middle = 0.5 * (at_left + asset.gaussians.means.amax(0) + shift)
    centre = turning.T_cam_obj @ middle
    assert torch.allclose(centre[:, :2], torch.zeros(8, 2), atol=1e-4), "the object's centre stays in the middle"
    narrow = replace(camera, fx_fy_cx_cy=camera.fx_fy_cx_cy * torch.tensor([6.0, 6.0, 1.0, 1.0]))
    far = relight.turntable(moved, narrow, 2, 0.0)[1].T_cam_obj
    uv = torch.stack([narrow.project(T @ gaussians.means) for T in (far[0], far[1])])
    assert uv.min() > 0, "all of it is in the image"
    assert (uv < torch.tensor([camera.width, camera.height])).all()
    positions = turning.camera_positions - middle
    distance = (asset.trajectory.camera_positions - middle).norm(dim=-1).median()
    assert torch.allclose(positions.norm(dim=-1), distance.expand(8), atol=1e-4)
    assert torch.allclose(positions[:, 1], (distance * math.sin(math.radians(20))).expand(8), atol=1e-4)
    assert torch.allclose(positions[0, [0]], torch.zeros(1), atol=1e-5)
    assert positions[0, 2] > 0, "first from +z"
    # The object's axis is vertical in each image; after a quarter revolution +x points where -z did.
    up = turning.T_cam_obj @ torch.tensor([0.0, 1, 0]) - turning.T_cam_obj.xyz
    assert torch.allclose(up, up[:1].expand(8, 3), atol=1e-5)
    assert up[0, 1] < -0.9, "OpenCV's y points down"
    R = turning.R_env_obj
    assert torch.allclose(R[0], R_gl_obj, atol=1e-6), "at first the light's frame is the object's"
    assert torch.allclose(R[2] @ torch.tensor([1.0, 0, 0]), R_gl_obj @ torch.tensor([0.0, 0, -1]), atol=1e-5)
