"""The capture folder of docs/format.md: saved captures are loaded unchanged, violations are reported with the file."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tumble.datasets import _capture_folder, folder
from tumble.io import files
from tumble.io.files import BadFile
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture, Truth
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Trajectory

CAMERA = Camera(torch.tensor([12.0, 13.0, 4.5, 2.5]), height=6, width=8)


def example_capture() -> tuple[Capture, Truth]:
    torch.manual_seed(0)

    def images_and_masks(n: int) -> tuple[torch.Tensor, torch.Tensor]:
        masks = torch.tensor([OBJECT, UNKNOWN, BACKGROUND], dtype=torch.uint8)[torch.randint(3, (n, 6, 8))]
        return torch.randint(256, (n, 6, 8, 3), dtype=torch.uint8), masks

    def poses(n: int) -> Trajectory:
        return Trajectory(SE3.from_rotation(SO3.exp(torch.randn(n, 3)), torch.randn(n, 3)), "camera")

    images, masks = images_and_masks(3)
    capture = Capture(images, masks, CAMERA, ("a.png", "b.png", "c.png"), "camera", poses(3))
    images, masks = images_and_masks(2)
    truth = Truth(
        images=images,
        masks=masks,
        names=("d.png", "e.png"),
        regions=("shared", "sphere"),
        trajectory=poses(2),
        albedo=torch.rand(2, 6, 8, 3),
        roughness=torch.rand(2, 6, 8),
        normals=torch.nn.functional.normalize(torch.randn(2, 6, 8, 3), dim=-1),
        depth=torch.rand(2, 6, 8) + 3,
        relit={"sun": images_and_masks(2)[0]},
        light=Environment.from_radiance(torch.rand(4, 8, 3)),
        lights={"sun": Environment.from_radiance(torch.rand(4, 8, 3))},
        poses=capture.trajectory,
    )
    return capture, truth


@pytest.fixture
def written(tmp_path: Path) -> Path:
    _capture_folder.save_capture(tmp_path / "capture", *example_capture(), setting="handheld")
    return tmp_path / "capture"


def edit(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    document = json.loads((root / "transforms.json").read_text())
    change(document)
    (root / "transforms.json").write_text(json.dumps(document))


def assert_same_poses(a: Trajectory | None, b: Trajectory | None) -> None:
    assert a is not None
    assert b is not None
    assert a.light == b.light
    torch.testing.assert_close(a.T_cam_obj.matrix(), b.T_cam_obj.matrix(), atol=1e-5, rtol=0)


def test_a_capture_is_loaded_as_it_was_saved(written: Path) -> None:
    capture, truth = example_capture()
    loaded, loaded_truth = folder.load(written), folder.load_truth(written)
    assert loaded_truth is not None
    assert torch.equal(loaded.images, capture.images)
    assert torch.equal(loaded.masks, capture.masks)
    assert loaded.names == capture.names
    assert loaded.light == "camera"
    torch.testing.assert_close(loaded.camera.fx_fy_cx_cy, CAMERA.fx_fy_cx_cy)
    assert_same_poses(loaded.trajectory, capture.trajectory)
    assert_same_poses(loaded_truth.trajectory, truth.trajectory)
    assert_same_poses(loaded_truth.poses, truth.poses)
    assert (loaded_truth.names, loaded_truth.regions) == (truth.names, truth.regions)
    assert (loaded_truth.views("shared"), loaded_truth.views("sphere")) == ([0], [1])
    for name in ("images", "masks", "albedo", "roughness", "depth"):
        assert torch.equal(getattr(loaded_truth, name), getattr(truth, name)), name
    torch.testing.assert_close(loaded_truth.normals, truth.normals)
    assert torch.equal(loaded_truth.relit["sun"], truth.relit["sun"])
    # Radiance HDR keeps eight bits of the brightest channel.
    torch.testing.assert_close(loaded_truth.light.radiance, truth.light.radiance, atol=1 / 128, rtol=0)
    torch.testing.assert_close(loaded_truth.lights["sun"].radiance, truth.lights["sun"].radiance, atol=1 / 128, rtol=0)


def test_full_images_are_loaded_as_they_were_saved(tmp_path: Path) -> None:
    capture = example_capture()[0]
    assert folder_of(capture, tmp_path / "without").full_images is None
    full = torch.randint(256, capture.images.shape, dtype=torch.uint8)
    loaded = folder_of(replace(capture, full_images=full), tmp_path / "with")
    assert loaded.full_images is not None
    assert torch.equal(loaded.full_images, full)
    assert torch.equal(loaded.select([2, 0]).full_images, full[[2, 0]])
    files.write_png(tmp_path / "with" / "full_images" / "b.png", np.zeros((6, 8, 1), np.uint8))
    with pytest.raises(BadFile, match=r"full_images/b\.png: has 1 channels instead of 3"):
        folder.load(tmp_path / "with")
    files.write_png(tmp_path / "with" / "full_images" / "b.png", np.zeros((5, 8, 3), np.uint8))
    with pytest.raises(BadFile, match=r"full_images/b\.png: has 8 x 5 pixels"):
        folder.load(tmp_path / "with")


def folder_of(capture: Capture, path: Path) -> Capture:
    """The capture, saved and loaded."""
    _capture_folder.save_capture(path, capture)
    return folder.load(path)


def test_a_capture_loads_when_its_truth_is_deleted(written: Path) -> None:
    capture = folder.load(written)
    for path in sorted((written / "truth").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    assert torch.equal(folder.load(written).images, capture.images)


def test_the_true_poses_of_a_capture_without_poses_are_part_of_its_truth(tmp_path: Path) -> None:
    capture, truth = example_capture()
    without_poses = Capture(capture.images, capture.masks, capture.camera, capture.names, capture.light)
    _capture_folder.save_capture(tmp_path / "capture", without_poses, truth)
    loaded = folder.load_truth(tmp_path / "capture")
    assert folder.load(tmp_path / "capture").trajectory is None
    assert loaded is not None
    assert_same_poses(loaded.poses, truth.poses)


def test_an_assumed_focal_length_is_marked_as_assumed(tmp_path: Path) -> None:
    capture, truth = example_capture()
    _capture_folder.save_capture(tmp_path / "assumed", replace(capture, focal_assumed=True), truth)
    _capture_folder.save_capture(tmp_path / "known", capture, truth)
    assert folder.load(tmp_path / "assumed").focal_assumed
    assert folder.load(tmp_path / "assumed").select([1]).focal_assumed
    assert not folder.load(tmp_path / "known").focal_assumed


def test_saving_over_a_folder_is_refused(written: Path) -> None:
    with pytest.raises(BadFile, match="exists already"):
        _capture_folder.save_capture(written, *example_capture())


def test_true_poses_are_stored_with_the_names_that_they_belong_to(tmp_path: Path) -> None:
    capture, truth = example_capture()
    assert truth.poses is not None
    posed = replace(truth, poses=truth.poses.select([2, 0, 1]), pose_names=("c.png", "a.png", "b.png"), units="m")
    _capture_folder.save_capture(tmp_path / "capture", capture, posed)
    loaded = folder.load_truth(tmp_path / "capture")
    assert loaded is not None
    assert_same_poses(loaded.poses, truth.poses)
    assert loaded.units == "m"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": ("d.png", "b.png")}, r"several frames b\.png"),
        ({"pose_names": ("a.png", "b.png", "x.png")}, r"no true pose of the frame c\.png"),
        ({"pose_names": ("a.png", "b.png")}, "3 true poses for 2 frames"),
    ],
)
def test_frames_without_names_or_poses_of_their_own_are_refused_before_anything_is_written(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    capture, truth = example_capture()
    with pytest.raises(BadFile, match=message):
        _capture_folder.save_capture(tmp_path / "capture", capture, replace(truth, **change))
    assert not (tmp_path / "capture").exists()


# Folders of other tools -----------------------------------------------------------------------------------------------


def test_a_plain_instant_ngp_folder_is_a_static_capture(tmp_path: Path) -> None:
    files.write_png(tmp_path / "images" / "r_0.png", np.full((4, 6, 3), 9, np.uint8))
    document = {
        "camera_angle_x": 0.8,
        "aabb_scale": 4,
        "frames": [{"file_path": "./images/r_0.png", "sharpness": 30.1}],
    }
    document["frames"][0]["transform_matrix"] = np.eye(4).tolist()
    files.write_json(tmp_path / "transforms.json", document)
    capture = folder.load(tmp_path)
    focal = 0.5 * 6 / math.tan(0.4)
    assert capture.light == "object"
    torch.testing.assert_close(capture.camera.fx_fy_cx_cy, torch.tensor([focal, focal, 3.0, 2.0]))
    assert (capture.masks == OBJECT).all()
    assert folder.load_truth(tmp_path) is None or folder.load_truth(tmp_path).poses is not None


def test_alpha_becomes_a_mask_and_colour_over_black(tmp_path: Path) -> None:
    rgba = np.zeros((2, 3, 4), np.uint8)
    rgba[0, 0] = [200, 100, 50, 255]
    rgba[0, 1] = [200, 100, 50, 128]
    rgba[0, 2] = [200, 100, 50, 0]
    files.write_png(tmp_path / "r_0.png", rgba)
    # NeRF's synthetic scenes omit the file ending.
    files.write_json(tmp_path / "transforms.json", {"camera_angle_x": 0.8, "frames": [{"file_path": "r_0"}]})
    capture = folder.load(tmp_path)
    assert capture.masks[0, 0].tolist() == [OBJECT, UNKNOWN, BACKGROUND]
    assert capture.images[0, 0, 0].tolist() == [200, 100, 50]
    assert capture.images[0, 0, 2].tolist() == [0, 0, 0]
    # Half the light of sRGB 200 (0.578 linear) is 0.290 linear, which is sRGB 147; half the code value would be 100.
    assert abs(int(capture.images[0, 0, 1, 0]) - 147) <= 1


def test_a_background_that_is_not_black_is_blackened() -> None:
    """An image over black keeps faint pixels beyond its mask; an image in front of a wall does not."""
    mask = np.full((20, 30), BACKGROUND, np.uint8)
    mask[5:15, 5:15] = OBJECT
    image = np.zeros((20, 30, 3), np.uint8)
    image[5:15, 4:16] = 90
    assert folder.blacken_background(image, mask) is image
    image[:, 25:] = 60
    blackened = folder.blacken_background(image, mask)
    assert (blackened[mask == OBJECT] == 90).all()
    assert not blackened[mask == BACKGROUND].any()


def test_a_distorted_image_is_undistorted(tmp_path: Path) -> None:
    camera = Camera(torch.tensor([60.0, 60.0, 32.0, 24.0]), 48, 64)
    k1 = 0.3
    # Grey values encode where each pixel's ray through the distorted lens crosses the plane z = 1.
    uv = camera.pixel_centers().double()
    xy = (uv - torch.tensor([32.0, 24.0])) / 60
    undistorted = xy.clone()
    for _ in range(50):
        undistorted = xy / (1 + k1 * (undistorted**2).sum(-1, keepdim=True))
    values = ((undistorted[..., 0] + 0.6) / 1.2 * 255).clamp(0, 255)
    image = torch.stack([values, values, values], -1).round().to(torch.uint8).numpy()
    files.write_png(tmp_path / "x.png", image)
    document = {"fl_x": 60.0, "cx": 32.0, "cy": 24.0, "k1": k1, "frames": [{"file_path": "x.png"}]}
    files.write_json(tmp_path / "transforms.json", document)
    loaded_values = folder.load(tmp_path).images[0, 4:-4, 4:-4, 0].double()
    expected = ((xy[..., 0] + 0.6) / 1.2 * 255)[4:-4, 4:-4]
    # A pixel is 3.5 code values wide; half a pixel (OpenCV's convention of pixel centres) would be an error of 1.8.
    assert (loaded_values - expected).abs().max() < 1.0


# Broken folders -------------------------------------------------------------------------------------------------------


def first(document: dict[str, Any]) -> dict[str, Any]:
    return document["frames"][0]


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "missing image": (lambda d: first(d).update(file_path="images/zzz.png"), r"zzz\.png: is missing"),
    "missing mask": (lambda d: first(d).update(mask_path="masks/zzz.png"), r"zzz\.png: is missing"),
    "stated size": (lambda d: d.update(w=9), r"a\.png: has 8 x 6 pixels, but transforms\.json has w = 9"),
    "non-rigid matrix": (
        lambda d: first(d)["transform_matrix"][0].__setitem__(0, 3.0),
        r"frame a\.png.*not a rotation",
    ),
    "mirrored matrix": (
        lambda d: first(d).update(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()),
        "not a rotation and a translation",
    ),
    "matrix of words": (
        lambda d: first(d).update(transform_matrix="eye"),
        r"frames\[0\]\.transform_matrix.*expected array",
    ),
    "matrix with NaN": (lambda d: first(d)["transform_matrix"][0].__setitem__(3, math.nan), "JSON has no NaN"),
    "unknown light": (lambda d: d.update(light="room"), r"\"light\": invalid enum value 'room'"),
    "duplicate frame": (lambda d: d["frames"].append(dict(first(d))), r"images/a\.png is there twice"),
    "two frames of one name": (lambda d: first(d).update(file_path="masks/b.png"), r"b\.png is there twice"),
    "path leaving the folder": (lambda d: first(d).update(file_path="../a.png"), "leaves the folder"),
    "absolute path": (lambda d: first(d).update(mask_path="/etc/hostname"), "leaves the folder"),
    "only some poses": (lambda d: first(d).pop("transform_matrix"), r"a\.png has no pose, but others have"),
    "no frames": (lambda d: d.update(frames=[]), '"frames": expected array of length >= 1'),
    "no training frame": (lambda d: d.update(frames=d["frames"][3:]), "no training frame"),
    "no focal length": (lambda d: d.pop("fl_x"), 'positive "fl_x"'),
    "focal length of words": (lambda d: d.update(fl_x="long"), "fl_x.*expected float"),
    "unknown split": (lambda d: first(d).update(split="test"), r"frames\[0\]\.split\": invalid enum value 'test'"),
    "unknown camera model": (lambda d: d.update(camera_model="MOEBIUS"), "MOEBIUS"),
}


@pytest.mark.parametrize("name", ["../../elsewhere", "hdr/sun", "..", "", "a\\b"])
def test_a_light_whose_name_is_no_valid_folder_name_is_refused(written: Path, name: str) -> None:
    """A prediction is written to one folder per light, and a name with a path would be outside."""

    def rename(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            if "relit" in frame:
                frame["relit"] = {name: frame["relit"]["sun"]}

    edit(written, rename)
    with pytest.raises(BadFile, match=r'"relit" has a light .* which is no valid folder name'):
        folder.load_truth(written)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_document_is_refused_with_file_and_rule(written: Path, name: str) -> None:
    change, message = BROKEN[name]
    edit(written, change)
    with pytest.raises(BadFile, match=message):
        folder.load(written)


def test_an_image_of_another_size_is_refused(written: Path) -> None:
    files.write_png(written / "images" / "b.png", np.zeros((5, 8, 3), np.uint8))
    with pytest.raises(BadFile, match=r"b\.png: has 8 x 5 pixels, but the capture has 8 x 6"):
        folder.load(written)


def test_an_empty_mask_is_refused(written: Path) -> None:
    files.write_png(written / "masks" / "b.png", np.zeros((6, 8, 1), np.uint8))
    with pytest.raises(BadFile, match=r"masks/b\.png: is an empty mask"):
        folder.load(written)


def test_a_negative_light_is_refused(written: Path) -> None:
    files.write_exr(written / "truth" / "light.exr", np.full((4, 8, 3), -1.0, np.float32))
    edit(written, lambda d: d.update(light_path="truth/light.exr"))
    with pytest.raises(BadFile, match=r"light\.exr: .*negative values"):
        folder.load_truth(written)


def test_truth_with_nan_or_of_another_size_is_refused(written: Path) -> None:
    files.write_exr(written / "truth" / "albedo" / "d.exr", np.full((6, 8, 3), np.nan, np.float32))
    with pytest.raises(BadFile, match=r"albedo/d\.exr: holds NaN"):
        folder.load_truth(written)
    files.write_exr(written / "truth" / "albedo" / "d.exr", np.ones((6, 7, 3), np.float32))
    with pytest.raises(BadFile, match=r"albedo/d\.exr: has 7 x 6 pixels"):
        folder.load_truth(written)


def test_a_missing_document_or_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"transforms\.json: is missing"):
        folder.load(tmp_path)
    with pytest.raises(BadFile, match="nowhere: is not a folder"):
        folder.load(tmp_path / "nowhere")
