"""Readers of benchmarks with given poses: poses, normals and lights agree with the photos, and damage is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tests import spheres
from tumble import datasets
from tumble.datasets import stanford_orb, tensoir
from tumble.io import plugins
from tumble.io.files import BadFile
from tumble.maths.images import linear_from_srgb, srgb_from_linear
from tumble.scene.camera import Camera
from tumble.scene.capture import OBJECT, Capture, Truth, content_key
from tumble.scene.trajectory import Trajectory

of_every_layout = pytest.mark.parametrize("name", spheres.WRITERS)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A dataset of each layout, not to be changed."""
    return {name: write(tmp_path_factory.mktemp(name)) for name, write in spheres.WRITERS.items()}


def read(path: Path) -> tuple[Capture, Truth]:
    reader = datasets.reader_for(path)
    truth = reader.load_truth(path)
    assert isinstance(truth, Truth)
    return reader.load(path), truth


def normals_of_unit_sphere(camera: Camera, poses: Trajectory, i: int) -> tuple[Tensor, Tensor]:
    """Normals of a sphere around the origin, object frame, and pixels that are well inside of it."""
    T_obj_cam = poses.T_cam_obj[i].inverse()
    d = T_obj_cam.rotation @ camera.directions()
    x = T_obj_cam.xyz
    along = d @ x
    inside = along.square() - x @ x + 1
    return normalize(x + (-along - inside.clamp_min(0).sqrt())[..., None] * d, dim=-1), inside > 0.2


@of_every_layout
def test_the_object_is_the_unit_sphere_and_normals_and_light_are_in_its_frame(name: str, written: Any) -> None:
    """Poses, field of view and normals agree, and the map of the light at a pixel's normal explains the pixel."""
    capture, truth = read(written[name])
    assert datasets.reader_for(written[name]) is plugins.load_plugin("datasets", name)
    datasets.check_plausible(capture, written[name])
    assert capture.light == "object"
    assert len(capture) == 8
    assert truth.trajectory is not None
    assert truth.normals is not None
    assert truth.albedo is not None
    assert truth.light is not None
    for i in range(len(truth)):
        n_obj, sure = normals_of_unit_sphere(capture.camera, truth.trajectory, i)
        assert (truth.masks[i][sure] == OBJECT).all()
        # The silhouettes of 48 pixels give the radius to a few percent; another convention is wrong by 90 degrees.
        assert (n_obj[sure] * truth.normals[i][sure]).sum(-1).mean() > 0.998
        expected = truth.albedo[i] * truth.light.lookup(truth.normals[i])
        photo = linear_from_srgb(truth.images[i] / 255)
        # Of 8 bits, maps of 32 rows, and RGBE.
        torch.testing.assert_close(photo[sure], expected[sure], atol=0.02, rtol=0.03)
    assert truth.poses is not None
    torch.testing.assert_close(truth.poses.T_cam_obj.matrix(), capture.trajectory.T_cam_obj.matrix())  # type: ignore


def test_relit_views_of_tensoir_are_those_of_its_test_lights(written: Any) -> None:
    capture, truth = read(written["tensoir"])
    assert truth.benchmark == "tensoir"
    assert list(truth.relit) == list(truth.lights) == ["bridge", "city"]
    assert truth.albedo is not None
    assert truth.normals is not None
    for light, images in truth.relit.items():
        expected = truth.albedo * truth.lights[light].lookup(truth.normals)
        inside = truth.foreground
        torch.testing.assert_close(linear_from_srgb(images / 255)[inside], expected[inside], atol=0.02, rtol=0.03)
    assert truth.names == ("test_000.png", "test_001.png", "test_002.png")
    assert capture.names[0] == "train_000.png"


def test_without_maps_and_test_views_only_poses_are_known(tmp_path: Path) -> None:
    path = spheres.write_tensoir(tmp_path)
    shutil.rmtree(tmp_path / "Environment_Maps")
    _, truth = read(path)
    assert len(truth) == 3
    assert truth.light is None
    assert truth.lights == {}
    for folder in path.glob("test_*"):
        shutil.rmtree(folder)
    _, truth = read(path)
    assert len(truth) == 0
    assert truth.poses is not None


def test_of_many_test_views_evenly_spaced_ones_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = spheres.write_tensoir(tmp_path, n_test=5)
    for n, numbers in ((2, (0, 2)), (3, (0, 1, 3)), (4, (0, 1, 2, 3)), (5, range(5))):
        monkeypatch.setattr(tensoir, "MAX_VIEWS", n)
        truth = tensoir.load_truth(path)
        assert truth is not None
        assert truth.names == tuple(f"test_{i:03}.png" for i in numbers)


def test_views_elsewhere_have_lenses_and_lights_of_their_own(written: Any) -> None:
    capture, truth = read(written["stanford_orb"])
    views = truth.elsewhere
    assert views is not None
    assert truth.benchmark == "stanford-orb"
    assert len(views) == 3
    for i in range(3):
        assert views.cameras[i].fov_x == pytest.approx(0.9 * spheres.ANGLE)
        assert capture.camera.fov_x == pytest.approx(spheres.ANGLE)
        n_obj, sure = normals_of_unit_sphere(views.cameras[i], Trajectory(views.T_cam_obj, "object"), i)
        assert views.foreground[i][sure].all()
        n_world = n_obj @ torch.tensor([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
        expected = torch.from_numpy(spheres.albedo(n_world.numpy())) * views.lights[i].lookup(n_obj)
        torch.testing.assert_close(views.radiance[i][sure], expected[sure].float(), atol=0.03, rtol=0.1)


def test_radiance_and_photos_of_stanford_orb_agree(tmp_path: Path) -> None:
    spheres.write_orb(tmp_path)
    low, high = (read(tmp_path / f"blender_{kind}" / "ball_scene001") for kind in ("LDR", "HDR"))
    assert torch.equal(low[0].images, high[0].images)
    assert low[1].radiance is not None
    inside = low[1].foreground
    torch.testing.assert_close(
        linear_from_srgb(low[1].images / 255)[inside], low[1].radiance[inside].clamp(0, 1), atol=0.005, rtol=0
    )
    shutil.rmtree(tmp_path / "blender_HDR")
    _, truth = read(tmp_path / "blender_LDR" / "ball_scene001")
    assert truth.radiance is None
    assert truth.elsewhere is None


def test_large_images_are_averaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = spheres.write_orb(tmp_path)
    whole, _ = read(path)
    monkeypatch.setattr(stanford_orb, "SIDE", spheres.SIZE // 2)
    half, truth = read(path)
    assert half.camera.fov_x == pytest.approx(whole.camera.fov_x)
    linear = linear_from_srgb(whole.images.movedim(-1, 1) / 255)
    pooled = 255 * srgb_from_linear(torch.nn.functional.avg_pool2d(linear, 2).movedim(1, -1))
    inside = half.masks == OBJECT
    known = torch.nn.functional.avg_pool2d((whole.masks == OBJECT).float(), 2) == 1
    assert (pooled - half.images)[inside & known].abs().max() <= 0.501
    assert truth.normals is not None
    assert truth.elsewhere is not None


@of_every_layout
def test_a_capture_does_not_depend_on_its_truth(name: str, tmp_path: Path) -> None:
    path = spheres.WRITERS[name](tmp_path)
    reader = plugins.load_plugin("datasets", name)
    before = content_key(reader.load(path))
    for folder in [tmp_path / "Environment_Maps", tmp_path / "ground_truth", *path.glob("test*")]:
        shutil.rmtree(folder, ignore_errors=True)
    for document in ("transforms_test.json", "transforms_novel.json"):
        (path / document).unlink(missing_ok=True)
    assert content_key(reader.load(path)) == before


def edit(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def edited(path: Path) -> None:
        document = json.loads((path / name).read_text())
        change(document)
        (path / name).write_text(json.dumps(document))

    return edited


def link(path: Path) -> None:
    """A photo that is a link to a file outside of the scene."""
    (path / "train_001" / "rgba_sunset.png").rename(path.parent / "elsewhere.png")
    (path / "train_001" / "rgba_sunset.png").symlink_to(path.parent / "elsewhere.png")


def grey(path: Path) -> None:
    spheres.save(path / "train_001" / "rgba_sunset.png", np.zeros((spheres.SIZE, spheres.SIZE), np.uint8))


META = "train_002/metadata.json"
BROKEN_TENSOIR: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no metadata": (lambda path: (path / META).unlink(), r"train_002/metadata\.json: is missing"),
    "15 numbers": (
        edit(META, lambda d: d.update(cam_transform_mat="1," * 14 + "1")),
        '"cam_transform_mat" is .*16 num',
    ),
    "words": (edit(META, lambda d: d.update(cam_transform_mat="a,b")), '"cam_transform_mat" is .a,b.'),
    "a scaled pose": (
        edit(META, lambda d: d.update(cam_transform_mat=",".join(str(x) for x in (2 * np.eye(4)).ravel()))),
        r"train_002/metadata\.json: frame train_002: .* is not a rotation",
    ),
    "poses of other images": (
        edit(META, lambda d: d.update(cam_transform_mat=",".join(map(str, spheres.camera_matrix(0, 0, -5).ravel())))),
        "has poses that contradict the masks",
    ),
    "an impossible field of view": (edit(META, lambda d: d.update(cam_angle_x=9.0)), "that other views do not have"),
    "no field of view": (edit(META, lambda d: d.pop("cam_angle_x")), "missing required field cam_angle_x"),
    "no photo": (lambda path: (path / "train_001" / "rgba_sunset.png").unlink(), r"rgba_sunset\.png: is missing"),
    "a photo without alpha": (grey, r"rgba_sunset\.png: has the shape 48 x 48 x 1 instead of 48 x 48 x 4"),
    "an empty mask": (
        lambda path: spheres.save(
            path / "train_001" / "rgba_sunset.png", np.zeros((spheres.SIZE, spheres.SIZE, 4), np.uint8)
        ),
        "has a training view that does not show the object",
    ),
    "a link that leaves the scene": (link, "is a link to .*outside of"),
    "no relit image": (lambda path: (path / "test_001" / "rgba_city.png").unlink(), r"rgba_city\.png: is missing"),
    "no normals": (lambda path: (path / "test_001" / "normal.png").unlink(), r"normal\.png: is missing"),
}


def novel(**changes: Any) -> Callable[[Path], None]:
    return edit("transforms_novel.json", lambda d: d["frames"][1].update(changes))


def array(values: np.ndarray) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        np.save(path.parents[1] / "ground_truth" / path.name / "surface_normal" / "0001.npy", values, allow_pickle=True)

    return write


BROKEN_ORB: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a pickle": (array(np.array([[[print]]])), r"0001\.npy: is not an array of numpy"),
    "whole numbers": (array(np.zeros((4, 4, 3), int)), r"0001\.npy: holds no floating-point numbers of the shape"),
    "NaN": (array(np.full((48, 48, 3), np.nan)), r"0001\.npy: holds NaN"),
    "another size": (array(np.zeros((4, 4, 3))), r"0001\.npy: has another size than 0000\.npy"),
    "a path that leaves the dataset": (novel(scene_name="../../x"), '"scene_name" that is no name'),
    "a file that leaves the dataset": (novel(file_path="../../../x"), "leaves the folder"),
    "no such scene": (novel(scene_name="ball_scene009"), r"ball_scene009.*is missing"),
    "no frames": (edit("transforms_train.json", lambda d: d.update(frames=[])), '"frames": expected array of length'),
    "a training frame elsewhere": (
        edit("transforms_train.json", lambda d: d["frames"][0].update(file_path="../../0000")),
        "leaves the folder",
    ),
    "no field of view": (
        edit("transforms_train.json", lambda d: d.pop("camera_angle_x")),
        "has a field of view of nan",
    ),
    "another camera": (edit("transforms_test.json", lambda d: d.update(camera_angle_x=0.5)), "has another camera than"),
    "no mask": (lambda path: (path / "train_mask" / "0003.png").unlink(), r"train_mask/0003\.png: is missing"),
    "no photo": (lambda path: (path / "train" / "0003.png").unlink(), r"train/0003\.exr: is missing"),
    "two names": (
        edit("transforms_train.json", lambda d: d["frames"].append(d["frames"][0])),
        "has two frames of one name",
    ),
    "no light": (
        lambda path: shutil.rmtree(path.parents[1] / "ground_truth" / "ball_scene002" / "env_map"),
        "env_map: has no light maps",
    ),
}
BROKEN = {"tensoir": BROKEN_TENSOIR, "stanford_orb": BROKEN_ORB}
"""How a dataset is damaged, and the message."""


@pytest.mark.parametrize(("name", "damage"), [(name, damage) for name in BROKEN for damage in BROKEN[name]])
def test_a_broken_dataset_is_refused_with_file_and_rule(name: str, damage: str, written: Any, tmp_path: Path) -> None:
    root = written[name].parents[1]
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    path = tmp_path / written[name].relative_to(root)
    change, message = BROKEN[name][damage]
    change(path)
    with pytest.raises(BadFile, match=message):
        read(path)
