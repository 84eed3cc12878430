"""Ground truth from Mitsuba: each convention is tested on an asymmetric case with an independently known result."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

mi = pytest.importorskip("mitsuba", reason="needs the extra `synth`")
trimesh = pytest.importorskip("trimesh", reason="needs the extra `synth`")

from tumble.datasets import folder  # noqa: E402
from tumble.io import files, video  # noqa: E402
from tumble.io.files import BadFile  # noqa: E402
from tumble.maths import images  # noqa: E402
from tumble.maths.directions import fibonacci_sphere, texel_directions, texel_solid_angles  # noqa: E402
from tumble.maths.images import linear_from_srgb  # noqa: E402
from tumble.maths.se3 import SE3, SO3  # noqa: E402
from tumble.scene.camera import Camera  # noqa: E402
from tumble.scene.environment import Environment  # noqa: E402
from tumble.scene.trajectory import Trajectory  # noqa: E402
from tumble.synthetic import pathtracer, synthesize, trajectories  # noqa: E402
from tumble.synthetic.options import SynthOptions  # noqa: E402

# Dr.Jit emits deprecation warnings about its own code when it is imported.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

CAMERA = Camera.from_fov(math.radians(30), 48, 48)
DISTANCE = trajectories.distance_for(math.radians(30))


def export(path: Path, mesh: "trimesh.Trimesh", texture: np.ndarray, roughness: float, uv: np.ndarray) -> Path:
    """A GLB with one texture; the origin of `uv` is the texture's top left corner, as in glTF."""
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(texture), roughnessFactor=roughness, metallicFactor=0.0
    )
    v_up = np.stack([uv[:, 0], 1 - uv[:, 1]], 1)  # trimesh's v axis points up
    mesh.visual = trimesh.visual.TextureVisuals(uv=v_up, material=material)
    path.write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    return path


@pytest.fixture(scope="module")
def pebble(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A convex ellipsoid whose colour varies with position: redder towards +x, greener towards +y."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    normals = mesh.vertices / [1.0, 0.7, 0.5]
    mesh = trimesh.Trimesh(mesh.vertices * [1.0, 0.7, 0.5], mesh.faces, vertex_normals=normals, process=False)
    ramp = np.linspace(40, 220, 64)
    texture = np.stack([*np.meshgrid(ramp, ramp[::-1]), np.full((64, 64), 90.0)], -1).astype(np.uint8)
    uv = np.stack([mesh.vertices[:, 0] * 0.49 + 0.5, 0.5 - mesh.vertices[:, 1] / 0.7 * 0.49], 1)
    return export(tmp_path_factory.mktemp("pebble") / "pebble.glb", mesh, texture, 0.4, uv)


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = trimesh.creation.icosphere(subdivisions=5)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.vertices, process=False)
    grey = np.full((4, 4, 3), 60, np.uint8)
    return export(tmp_path_factory.mktemp("sphere") / "sphere.glb", mesh, grey, 0.25, np.zeros((len(mesh.vertices), 2)))


def room(h: int = 32) -> Environment:
    """A smooth light with a bright side at +x, a warm top and a dim red floor."""
    d = texel_directions(h, 2 * h)
    warm = torch.tensor([1.0, 0.8, 0.5])
    return Environment.from_radiance(
        0.05 + 6 * ((d[..., :1] - 0.5).clamp_min(0) ** 2) + warm * (d[..., 1:2] + 1) ** 2 / 4
    )


def a_pose(*omega: float) -> SE3:
    return SE3.from_rotation(SO3.exp(torch.tensor(omega)), torch.tensor([0.05, -0.03, DISTANCE]))


def env_from_obj(T_cam_obj: SE3) -> torch.Tensor:
    return Trajectory(SE3(T_cam_obj.wxyz[None], T_cam_obj.xyz[None]), "camera").R_env_obj[0]


# Conventions ----------------------------------------------------------------------------------------------------------


def test_a_handheld_frame_is_a_dome_frame_under_the_counter_rotated_light(pebble: Path) -> None:
    shapes = pathtracer.mitsuba_shapes(pathtracer.read_model(pebble), "original", None)
    T_cam_obj = a_pose(0.7, -1.1, 0.4)
    R_env_obj = env_from_obj(T_cam_obj)
    counter_rotated = room(64).rotated(R_env_obj.T)

    def render(light: Environment, R: torch.Tensor) -> np.ndarray:
        return pathtracer.radiance(pathtracer.lit_scene(shapes, light, 3), T_cam_obj, CAMERA, R, samples=64, seed=0)[0]

    handheld, dome, wrong = (
        render(room(64), R_env_obj),
        render(counter_rotated, torch.eye(3)),
        render(room(64), torch.eye(3)),
    )
    # Both images have the same noise; resampling a map of 64 rows adds an error of some thousandths.
    scale = handheld.mean()
    assert np.abs(handheld - dome).mean() < 0.02 * scale
    assert np.abs(handheld - wrong).mean() > 0.2 * scale


def test_depth_reprojects_from_one_view_to_another(pebble: Path) -> None:
    unlit = pathtracer.unlit_scenes(pathtracer.read_model(pebble), "original", None)
    T_a_obj, T_b_obj = a_pose(0.3, 0.2, 0.1), a_pose(0.5, 0.5, -0.3)
    a, b = (pathtracer.maps(unlit, T, CAMERA, samples=64) for T in (T_a_obj, T_b_obj))
    depth = torch.from_numpy(a.depth[..., 0])
    solid = torch.from_numpy(a.coverage > 0.999)
    x_a = CAMERA.unproject(CAMERA.pixel_centers(), depth)[solid]
    x_obj = T_a_obj.inverse() @ x_a
    x_b = T_b_obj @ x_obj
    normal_obj = torch.from_numpy(a.normal)[solid]
    to_b = torch.nn.functional.normalize(T_b_obj.inverse().xyz - x_obj, dim=-1)
    uv = CAMERA.project(x_b)
    # Points that both cameras see, away from b's silhouette; the nearest pixel centre of b is up to 0.7 pixel away.
    column, row = uv[:, 0].long(), uv[:, 1].long()
    known = torch.from_numpy(b.coverage > 0.999)[row, column] & ((normal_obj * to_b).sum(-1) > 0.6)
    assert known.sum() > 150
    error = torch.from_numpy(b.depth[..., 0])[row, column] - x_b[:, 2]
    pixel = DISTANCE / float(CAMERA.fx_fy_cx_cy[0])
    assert error[known].abs().max() < pixel
    assert error[known].mean().abs() < 0.1 * pixel
    # The same points have the same colour and normal. The albedo changes by 0.03 per texel.
    albedo_error = torch.from_numpy(b.albedo)[row, column] - torch.from_numpy(a.albedo)[solid]
    assert albedo_error[known].abs().max() < 0.06
    cosine = (torch.from_numpy(b.normal)[row, column] * normal_obj).sum(-1)
    assert cosine[known].min() > math.cos(math.radians(8))


@pytest.mark.parametrize(("row", "column"), [(8, 20), (5, 38), (14, 58)])
def test_the_highlight_of_a_bright_texel_is_at_the_computed_pixel(sphere: Path, row: int, column: int) -> None:
    h, w = 32, 64
    radiance = torch.full((h, w, 3), 1e-6)
    radiance[row, column] = 1000.0
    v, u = (row + 0.5) / h, (column + 0.5) / w
    azimuth = 2 * math.pi * (u - 0.5)
    # d = (sin(theta) sin(phi), cos(theta), -sin(theta) cos(phi)): format.md, solved for the direction by hand.
    light_env = torch.tensor(
        [math.sin(math.pi * v) * math.sin(azimuth), math.cos(math.pi * v), -math.sin(math.pi * v) * math.cos(azimuth)]
    )
    T_cam_obj = a_pose(0.2, 2.0, -0.8)
    R_env_obj = env_from_obj(T_cam_obj)
    model = pathtracer.read_model(sphere)
    scene = pathtracer.lit_scene(
        pathtracer.mitsuba_shapes(model, "original", None), Environment.from_radiance(radiance), 2
    )
    pixels, _ = pathtracer.radiance(scene, T_cam_obj, CAMERA, R_env_obj, samples=256, seed=0)
    # At the highlight the normal bisects the directions to camera and light.
    centers, brightness = CAMERA.pixel_centers(), torch.from_numpy(pixels.sum(-1))
    weight = (brightness - 0.5 * brightness.max()).clamp_min(0)
    rendered_uv = (centers * weight[..., None]).sum((0, 1)) / weight.sum()
    light_obj = R_env_obj.T @ light_env
    x_obj = torch.zeros(3)
    for _ in range(50):  # fixed point, since the direction to the camera depends on the point
        view_obj = torch.nn.functional.normalize(T_cam_obj.inverse().xyz - x_obj, dim=-1)
        x_obj = torch.nn.functional.normalize(view_obj + light_obj, dim=-1)
    expected_uv = CAMERA.project(T_cam_obj @ x_obj)
    # A texel is 5.6 degrees wide; half of that on a sphere of radius 21 pixels is one pixel.
    assert (rendered_uv - expected_uv).norm() < 1.0


def test_normals_and_albedo_are_in_the_object_frame(sphere: Path, pebble: Path) -> None:
    T_cam_obj = a_pose(0.4, 0.9, -0.5)
    view = pathtracer.maps(
        pathtracer.unlit_scenes(pathtracer.read_model(sphere), "original", None), T_cam_obj, CAMERA, samples=16
    )
    x_obj = T_cam_obj.inverse() @ CAMERA.unproject(CAMERA.pixel_centers(), torch.from_numpy(view.depth[..., 0]))
    solid = view.coverage == 1
    # On the unit sphere the normal equals the position; a pixel at the contour spans several degrees.
    outward = torch.nn.functional.normalize(x_obj, dim=-1).numpy()
    cosine = (outward * view.normal).sum(-1)[solid]
    assert cosine.min() > math.cos(math.radians(6))
    assert np.median(cosine) > math.cos(math.radians(0.5))
    assert np.allclose(view.roughness[solid], 0.25, atol=1e-3)
    view = pathtracer.maps(
        pathtracer.unlit_scenes(pathtracer.read_model(pebble), "original", None), T_cam_obj, CAMERA, samples=64
    )
    x_obj = T_cam_obj.inverse() @ CAMERA.unproject(CAMERA.pixel_centers(), torch.from_numpy(view.depth[..., 0]))
    for axis, channel, half in ((0, 0, 1.0), (1, 1, 0.7)):
        code = 130 + 90 * (x_obj[..., axis].numpy() / half * 0.98)
        linear = ((code / 255 + 0.055) / 1.055) ** 2.4
        # The ramp has 64 steps over 180 code values.
        assert np.abs(view.albedo[..., channel] - linear)[view.coverage == 1].max() < 0.03


def test_a_texture_is_neither_mirrored_nor_upside_down(tmp_path: Path) -> None:
    """A square that faces +z: seen from +z, the texture's top left corner is at the top left of the image."""
    corners = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    mesh = trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 0], texture[0, 1], texture[1, 0] = [255, 0, 0], [0, 255, 0], [0, 0, 255]
    path = export(tmp_path / "x.glb", mesh, texture, 0.5, np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))
    T_cam_obj = trajectories.look_at_object(torch.tensor([[0.0, 0.0, DISTANCE]]))
    view = pathtracer.maps(
        pathtracer.unlit_scenes(pathtracer.read_model(path), "original", None),
        SE3(T_cam_obj.wxyz[0], T_cam_obj.xyz[0]),
        CAMERA,
        samples=16,
    )
    rows, columns = np.nonzero(view.coverage > 0.99)
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    assert view.albedo[top, left].argmax() == 0
    assert view.albedo[top, right].argmax() == 1
    assert view.albedo[bottom, left].argmax() == 2


def test_a_file_is_rendered_with_its_metalness_if_that_is_asked_for(tmp_path: Path) -> None:
    """A square that faces +z, the left half of it metal, under a dome that is bright behind the camera alone."""
    corners = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    mesh = trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)
    packed = np.zeros((16, 16, 3), np.uint8)
    packed[..., 1], packed[:, :8, 2] = 51, 255  # roughness 0.2
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[0.5, 0.5, 0.5, 1.0], metallicRoughnessTexture=Image.fromarray(packed)
    )
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    (tmp_path / "x.glb").write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    model = pathtracer.read_model(tmp_path / "x.glb")
    pose = trajectories.look_at_object(torch.tensor([[0.0, 0.0, DISTANCE]]))
    T_cam_obj = SE3(pose.wxyz[0], pose.xyz[0])
    behind = Environment.from_radiance((texel_directions(32, 64)[..., 2:] > 0.9).float().expand(32, 64, 3))
    left, right = (slice(18, 30), slice(12, 20)), (slice(18, 30), slice(28, 36))
    for shading, metal, ratio in (("gltf", (1, 0), 3.0), ("original", (0, 0), 1.0), ("metal", (1, 1), 1.0)):
        view = pathtracer.maps(pathtracer.unlit_scenes(model, shading, None), T_cam_obj, CAMERA, samples=16)
        found = tuple(float(view.metalness[x].mean()) for x in (left, right))
        assert found == pytest.approx(metal, abs=1e-3)
        assert view.roughness[left].mean() == pytest.approx(0.2, abs=1e-3)
        scene = pathtracer.lit_scene(pathtracer.mitsuba_shapes(model, shading, None), behind, 2)
        image = pathtracer.radiance(scene, T_cam_obj, CAMERA, torch.eye(3), samples=64, seed=0)[0]
        assert image[left].mean() / image[right].mean() >= 0.9 * ratio
        assert ratio > 1 or image[left].mean() / image[right].mean() == pytest.approx(1, abs=0.1)


def test_a_z_up_file_stands_upright_in_the_object_frame(tmp_path: Path) -> None:
    tall = trimesh.creation.box([0.2, 0.4, 2.0])
    tall.apply_translation([5.0, 1.0, 3.0])
    path = export(tmp_path / "x.glb", tall, np.full((2, 2, 3), 99, np.uint8), 0.5, np.zeros((8, 2)))
    model = pathtracer.read_model(path, up="z")
    size = np.ptp(model.parts[0].vertices, axis=0)
    np.testing.assert_allclose(size / size[1], [0.1, 1.0, 0.2], atol=1e-6)
    assert np.linalg.norm(model.parts[0].vertices, axis=1).max() == pytest.approx(1.0)
    synthesize.pathtracer.write_model(path, model, tmp_path / "y.glb")
    again = pathtracer.read_model(tmp_path / "y.glb")
    np.testing.assert_allclose(again.T_obj_file, np.eye(4), atol=1e-6)


# Settings -------------------------------------------------------------------------------------------------------------


def steps(T_cam_obj: SE3) -> torch.Tensor:
    R = T_cam_obj.rotation
    return torch.rad2deg((SO3(R.wxyz[1:]) @ SO3(R.wxyz[:-1]).inverse()).angle())


@pytest.mark.parametrize("seed", range(4))
def test_a_handheld_trajectory_rotates_5_to_12_degrees_per_frame_and_shows_all_sides(seed: int) -> None:
    T_cam_obj = trajectories.handheld(64, DISTANCE, seed=seed)
    assert steps(T_cam_obj).min() >= 5 - 1e-6
    assert steps(T_cam_obj).max() <= 12 + 1e-6
    views = T_cam_obj.inverse().xyz / T_cam_obj.inverse().xyz.norm(dim=-1, keepdim=True)
    nearest = (views @ fibonacci_sphere(200).double().T).amax(0)
    # The view nearest to each direction is within 60 degrees, mostly much closer, also for directions from below.
    assert nearest.min() > math.cos(math.radians(60))
    assert nearest.median() > math.cos(math.radians(25))
    assert views[:, 1].min() < -0.7
    assert not torch.equal(T_cam_obj.wxyz, trajectories.handheld(64, DISTANCE, seed=seed + 1).wxyz)
    assert torch.equal(T_cam_obj.wxyz, trajectories.handheld(64, DISTANCE, seed=seed).wxyz)
    axes = SO3(T_cam_obj.wxyz[1:]) @ SO3(T_cam_obj.wxyz[:-1]).inverse()
    bend = torch.nn.functional.cosine_similarity(axes.log()[1:], axes.log()[:-1], dim=-1)
    assert bend.median() > math.cos(math.radians(30)), "the axis of a smooth trajectory changes slowly"


def test_a_stride_takes_few_frames_of_a_long_motion_which_then_show_more_sides() -> None:
    few = trajectories.trajectory("handheld", 10, DISTANCE, seed=3, stride=16)
    assert torch.equal(few.wxyz, trajectories.handheld(160, DISTANCE, seed=3).wxyz[::16])
    directions = fibonacci_sphere(200).double()

    def largest_gap(T_cam_obj: SE3) -> float:
        positions = torch.nn.functional.normalize(T_cam_obj.inverse().xyz, dim=-1)
        return math.degrees(math.acos(float((positions @ directions.T).amax(0).min())))

    assert largest_gap(few) < 70 < 100 < largest_gap(trajectories.handheld(10, DISTANCE, seed=3))


def test_the_turntable_rotates_about_the_vertical_seen_from_25_degrees_above() -> None:
    T_cam_obj = trajectories.turntable(36, DISTANCE)
    torch.testing.assert_close(steps(T_cam_obj), torch.full((35,), 10.0, dtype=torch.float64))
    camera = T_cam_obj.inverse().xyz / DISTANCE
    torch.testing.assert_close(camera[:, 1], torch.full((36,), math.sin(math.radians(25)), dtype=torch.float64))


def test_the_dome_covers_the_upper_hemisphere_and_nothing_below() -> None:
    camera = trajectories.dome(64, DISTANCE).inverse().xyz / DISTANCE
    assert camera[:, 1].min() > 0
    assert camera[:, 1].max() > 0.95
    torch.testing.assert_close(camera[:, 1].mean(), torch.tensor(0.5, dtype=torch.float64))
    assert camera[:, [0, 2]].mean(0).norm() < 0.05


def test_shared_views_lie_between_15_and_35_degrees_and_look_at_the_object_upright() -> None:
    T_cam_obj = trajectories.shared_views(12, DISTANCE)
    camera = T_cam_obj.inverse().xyz / DISTANCE
    elevation = torch.rad2deg(torch.asin(camera[:, 1]))
    assert elevation.min() >= 15 - 1e-9
    assert elevation.max() <= 35 + 1e-9
    assert elevation.std() > 4
    azimuth = torch.rad2deg(torch.atan2(camera[:, 0], camera[:, 2])).sort().values
    torch.testing.assert_close(azimuth.diff(), torch.full((11,), 30.0, dtype=torch.float64))
    torch.testing.assert_close(T_cam_obj.xyz, torch.tensor([0, 0, DISTANCE], dtype=torch.float64).expand(12, 3))
    up_cam = T_cam_obj.rotation @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    assert (up_cam[:, 1] < -0.8).all()
    torch.testing.assert_close(up_cam[:, 0], torch.zeros(12, dtype=torch.float64))


def test_the_light_of_a_turntable_capture_is_pitched_by_the_cameras_elevation(tmp_path: Path) -> None:
    """The camera looks 25 degrees down, so that the zenith is 25 degrees behind the up direction of its frame."""
    h = 64
    radiance = torch.full((h, 2 * h, 3), 0.01)
    radiance[:3] = 50.0
    Environment.from_radiance(radiance).write(tmp_path / "room.hdr")
    light = synthesize._capture_light(SynthOptions(env=str(tmp_path / "room.hdr"), setting="turntable"))
    e = math.radians(25)
    assert light.lookup(torch.tensor([0.0, math.cos(e), math.sin(e)])).min() > 25
    assert light.lookup(torch.tensor([0.0, math.cos(e), -math.sin(e)])).max() < 1


# Captures -------------------------------------------------------------------------------------------------------------


TINY = {"views": 3, "resolution": 24, "samples": 16, "truth_samples": 16, "eval_shared": 2, "eval_sphere": 1}


@pytest.fixture(scope="module")
def captures(pebble: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("captures")
    room().write(root / "room.hdr")
    room(16).write(root / "other.hdr")
    return {
        setting: synthesize.render_capture(
            pebble,
            root / setting,
            SynthOptions(env=str(root / "room.hdr"), setting=setting, relight=(str(root / "other.hdr"),), **TINY),
        )
        for setting in trajectories.SETTINGS
    }


def test_ground_truth_is_the_same_in_all_settings(captures: dict[str, Path]) -> None:
    truths = {setting: folder.load_truth(path) for setting, path in captures.items()}
    first, *others = truths.values()
    assert first.regions == ("shared", "shared", "sphere")
    for other in others:
        for name in ("albedo", "normals", "depth", "roughness", "masks"):
            assert torch.equal(getattr(first, name), getattr(other, name)), name
        assert torch.equal(first.relit["other"], other.relit["other"])
        torch.testing.assert_close(first.trajectory.T_cam_obj.matrix(), other.trajectory.T_cam_obj.matrix())
    # Only the light in the images differs.
    assert not torch.equal(truths["dome"].images, truths["handheld"].images)
    assert truths["dome"].trajectory.light == "object"
    assert truths["handheld"].trajectory.light == truths["turntable"].trajectory.light == "camera"


def test_the_exposure_saturates_about_one_percent_of_the_object(captures: dict[str, Path]) -> None:
    for path in captures.values():
        capture = folder.load(path)
        brightest = capture.images[capture.masks == 255].amax(-1)
        assert 0.001 < (brightest == 255).double().mean() < 0.06


def test_the_stored_light_is_the_light_of_the_images(captures: dict[str, Path], pebble: Path) -> None:
    """Rendering with the stored light, pose and camera reproduces the stored image."""
    capture, truth = folder.load(captures["handheld"]), folder.load_truth(captures["handheld"])
    scene = pathtracer.lit_scene(
        pathtracer.mitsuba_shapes(pathtracer.read_model(pebble), "original", None), truth.light, 5
    )
    pose = SE3(capture.trajectory.T_cam_obj.wxyz[1], capture.trajectory.T_cam_obj.xyz[1])
    pixels, _ = pathtracer.radiance(scene, pose, capture.camera, capture.trajectory.R_env_obj[1], samples=64, seed=5)
    solid = capture.masks[1].numpy() == 255
    error = images.to_srgb8(torch.from_numpy(pixels)).numpy()[solid].astype(float) - capture.images[1].numpy()[solid]
    # Sixteen samples per pixel leave noise of some code values, but no bias.
    assert abs(error.mean()) < 1.5
    assert np.abs(error).mean() < 12


def test_a_resumed_capture_equals_an_uninterrupted_one(captures: dict[str, Path], pebble: Path) -> None:
    path = captures["turntable"]
    before = {p: p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}
    for missing in ("images/0001.png", "masks/0001.png", "images/0004.png", "transforms.json"):
        (path / missing).unlink()
    timestamp = (path / "images" / "0000.png").stat().st_mtime_ns
    root = path.parent
    options = SynthOptions(env=str(root / "room.hdr"), setting="turntable", relight=(str(root / "other.hdr"),), **TINY)
    synthesize.render_capture(pebble, path, options)
    assert (path / "images" / "0000.png").stat().st_mtime_ns == timestamp
    assert {p: p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()} == before


def test_a_folder_with_other_content_raises_and_is_unchanged(
    captures: dict[str, Path], pebble: Path, tmp_path: Path
) -> None:
    options = SynthOptions(env="white", setting="dome", **TINY)
    with pytest.raises(BadFile, match="other options"):
        synthesize.render_capture(pebble, captures["dome"], options)
    (tmp_path / "diary.txt").write_text("mine")
    with pytest.raises(BadFile, match=r"holds other files, and no synth\.json"):
        synthesize.render_capture(pebble, tmp_path, options)
    assert [p.name for p in tmp_path.iterdir()] == ["diary.txt"]


def test_a_pose_free_video_under_a_white_light(pebble: Path, tmp_path: Path) -> None:
    options = SynthOptions(env="white", material="diffuse", pose_free=True, video=True, **TINY)
    path = synthesize.render_capture(pebble, tmp_path / "clip", options)
    capture, truth = folder.load(path), folder.load_truth(path)
    assert capture.trajectory is None
    assert truth.poses is not None
    assert not any("transform_matrix" in f for f in json.loads((path / "transforms.json").read_text())["frames"][:3])
    frames = np.stack(list(video.read_clip(path / "clip.mp4")))
    assert frames.shape == capture.images.shape
    # The frames equal the images up to compression: the video's halved colour resolution blurs the contour.
    assert np.abs(frames.astype(float) - capture.images.numpy()).mean() < 6
    # For a convex Lambertian object in uniform light, radiance is albedo times the light. Pixels at the contour are
    # excluded, because they mix with the background.
    solid = -torch.nn.functional.max_pool2d(-(truth.masks == 255).float(), 3, 1, 1) == 1
    light = truth.light.radiance[0, 0]
    expected = images.to_srgb8(truth.albedo[solid] * light).numpy()
    assert np.abs(expected.astype(float) - truth.images[solid].numpy()).mean() < 2


def test_a_light_to_relight_under_may_have_any_name(pebble: Path, tmp_path: Path) -> None:
    """Two of them were names of scenes of the program."""
    lights = [tmp_path / f"{name}.hdr" for name in ("probe", "surrounded", "other")]
    for channel, light in enumerate(lights):
        Environment.from_radiance(0.01 + torch.eye(3)[channel].expand(8, 16, 3)).write(light)
    options = SynthOptions(env="white", background="wall", relight=tuple(map(str, lights)), **TINY)
    truth = folder.load_truth(synthesize.render_capture(pebble, tmp_path / "out", options))
    assert [int(truth.relit[light.stem].sum((0, 1, 2)).argmax()) for light in lights] == [0, 1, 2]


def test_a_roughness_sweep_changes_only_roughness(pebble: Path, tmp_path: Path) -> None:
    low, high = synthesize.render_captures(pebble, tmp_path, SynthOptions(env="white", **TINY), (0.2, 0.8))
    assert (low.name, high.name) == ("r0.20", "r0.80")
    a, b = folder.load_truth(low), folder.load_truth(high)
    assert torch.equal(a.albedo, b.albedo)
    solid = a.masks == 255
    torch.testing.assert_close(a.roughness[solid], torch.full_like(a.roughness[solid], 0.2), atol=1e-3, rtol=0)
    torch.testing.assert_close(b.roughness[solid], torch.full_like(b.roughness[solid], 0.8), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": 33}, "resolution is out of range: 33"),
        ({"relight": ("a/sun.hdr", "b/sun.hdr")}, "the file names of the relight maps must differ"),
        ({"roughness": 0.0}, "roughness"),
        ({"views": 0}, "views"),
        ({"stride": 0}, "stride"),
        ({"stride": 2, "setting": "dome"}, "a stride needs --setting handheld"),
        ({"stride": 2, "hand": True}, "a stride needs --setting handheld"),
    ],
)
def test_the_error_for_an_invalid_option_has_its_name(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SynthOptions(env="white", **change)


def test_an_unreadable_source_raises_before_anything_is_written(pebble: Path, tmp_path: Path) -> None:
    (tmp_path / "x.glb").write_bytes(b"glTFjunk")
    for model, env, message in (
        (tmp_path / "x.glb", "white", "not a readable GLB"),
        (tmp_path / "y.glb", "white", r"y\.glb: is missing"),
        (pebble, str(tmp_path / "z.hdr"), r"z\.hdr: is missing"),
    ):
        with pytest.raises(BadFile, match=message):
            synthesize.render_capture(model, tmp_path / "out", SynthOptions(env=env, **TINY))
        assert not (tmp_path / "out").exists()


# The variant ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "version"),
    [("libLLVM-15.so.1", 15), ("libLLVM.so.19.1", 19), ("libLLVM-17.so", 17), ("libLLVM-14.0.6.so.1", 14)],
)
def test_the_version_of_llvm_is_read_from_its_name_without_loading_it(name: str, version: int) -> None:
    assert pathtracer.llvm_version(Path("/nowhere") / name) == version


def test_old_versions_of_llvm_are_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(pathtracer, "LLVM_FOLDERS", (str(tmp_path),))
    (tmp_path / "libLLVM-14.so.1").touch()
    (tmp_path / "libLLVM-13.so").touch()
    assert pathtracer.find_llvm() is None
    (tmp_path / "libLLVM.so.18.1").touch()
    (tmp_path / "libLLVM-17.so").touch()
    assert pathtracer.find_llvm() == (tmp_path / "libLLVM.so.18.1", 18)


@pytest.mark.slow
def test_depth_of_a_scanned_object_is_consistent_between_views(shared_data: Path, tmp_path: Path) -> None:
    options = SynthOptions(env=str(shared_data / "hdri" / "st_fagans_interior_1k.hdr"), views=4, up="z", samples=64)
    path = synthesize.render_capture(shared_data / "meshes" / "ycb_006_mustard_bottle.glb", tmp_path / "out", options)
    truth = folder.load_truth(path)
    pixel = DISTANCE / float(folder.load(path).camera.fx_fy_cx_cy[0])
    T = truth.trajectory.T_cam_obj
    camera = folder.load(path).camera
    a, b = 0, 1
    x_obj = (
        SE3(T.wxyz[a], T.xyz[a]).inverse()
        @ camera.unproject(camera.pixel_centers(), truth.depth[a])[truth.foreground[a]]
    )
    x_b = SE3(T.wxyz[b], T.xyz[b]) @ x_obj
    column, row = camera.project(x_b).long().unbind(-1)
    error = truth.depth[b][row, column] - x_b[:, 2]
    facing = (truth.normals[a][truth.foreground[a]] * (SE3(T.wxyz[b], T.xyz[b]).inverse().xyz - x_obj)).sum(-1) > 2.5
    assert error[facing].abs().median() < 0.5 * pixel


def test_white_and_files_are_read_as_lights(tmp_path: Path) -> None:
    assert torch.equal(synthesize._read_light("white").radiance, torch.ones(16, 32, 3))
    files.write_exr(tmp_path / "x.exr", np.ones((4, 4, 3), np.float32))
    with pytest.raises(BadFile, match="twice as wide"):
        synthesize._read_light(str(tmp_path / "x.exr"))


def test_a_turned_light_is_the_one_that_the_trajectory_of_the_folder_says(tmp_path: Path) -> None:
    """The shading of a Lambertian sphere is the irradiance of the stored light at the normal, in the turned frame."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    mesh = trimesh.Trimesh(sphere.vertices, sphere.faces, vertex_normals=sphere.vertices, process=False)
    path = export(
        tmp_path / "sphere.glb", mesh, np.full((4, 4, 3), 180, np.uint8), 1.0, np.zeros((len(mesh.vertices), 2))
    )
    room(16).write(tmp_path / "room.hdr")
    few = {"views": 12, "resolution": 32, "samples": 64, "eval_shared": 1, "eval_sphere": 0, "truth_samples": 4}
    options = SynthOptions(env=str(tmp_path / "room.hdr"), setting="turned", turns=3, material="diffuse", **few)
    out = synthesize.render_capture(path, tmp_path / "out", options)
    capture, truth = folder.load(out), folder.load_truth(out)
    assert truth is not None
    assert truth.light is not None
    assert truth.trajectory is not None
    trajectory = capture.trajectory
    assert trajectory is not None
    assert trajectory.light_turns is not None
    torch.testing.assert_close(trajectory.light_turns[3], torch.eye(3))  # the first of three turns again
    dome = trajectories.dome(12, trajectories.distance_for(math.radians(30)))
    torch.testing.assert_close(trajectory.T_cam_obj.xyz, dome.xyz.float())

    def mismatch(view: Trajectory, i: int, image: torch.Tensor, R_env_obj: torch.Tensor) -> float:
        """1 - correlation between the image and the irradiance."""
        T_obj_cam = view.T_cam_obj[i].inverse()
        d = T_obj_cam.rotation @ capture.camera.directions()
        along = d @ T_obj_cam.xyz
        inside = along.square() - T_obj_cam.xyz @ T_obj_cam.xyz + 1
        normals = (T_obj_cam.xyz + (-along - inside.clamp_min(0).sqrt())[..., None] * d)[inside > 0.1]
        light = truth.light  # type: ignore
        d_env = texel_directions(*light.log_radiance.shape[:2]).reshape(-1, 3)
        weight = texel_solid_angles(*light.log_radiance.shape[:2]).reshape(-1, 1)
        cosines = (normals @ R_env_obj.T @ d_env.T).clamp_min(0)
        irradiance = cosines @ (light.radiance.reshape(-1, 3) * weight)
        photo = linear_from_srgb(image[inside > 0.1] / 255)
        return 1 - float(torch.corrcoef(torch.stack([irradiance.flatten(), photo.flatten()]))[0, 1])

    for i in range(4):
        assert mismatch(trajectory, i, capture.images[i], trajectory.R_env_obj[i]) < 0.003
    for i in (1, 2):
        wrong = trajectory.light_turns[i].T
        assert mismatch(trajectory, i, capture.images[i], wrong) > 0.03
        assert mismatch(trajectory, i, capture.images[i], torch.eye(3)) > 0.03
    # An evaluation view is under the light of the first frame.
    assert mismatch(truth.trajectory, 0, truth.images[0], torch.eye(3)) < 0.003


def test_the_light_turns_by_as_many_poses_as_asked() -> None:
    turns = trajectories.light_turns(12, 4, seed=3)
    torch.testing.assert_close(turns[0], torch.eye(3).double())
    torch.testing.assert_close(turns[4:8], turns[:4])
    angles = torch.linalg.matrix_norm(turns[:4, None] - turns[None, :4])
    assert (angles + 9 * torch.eye(4)).min() > 0.3
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).double().expand_as(turns))


def test_a_light_is_turned_only_in_its_setting() -> None:
    for wrong, message in (
        ({"turns": 3}, "not turned in the setting handheld"),
        ({"setting": "turned", "turns": 65}, "turns is out of range"),
        ({"setting": "turned", "pose_free": True}, "leave out --pose-free"),
        ({"setting": "turned", "film": True}, "the camera of a dome moves"),
    ):
        with pytest.raises(ValueError, match=message):
            SynthOptions(env="white", **wrong)  # type: ignore[arg-type]
