"""Scores of whole predictions: perfect for the truth, as computed for known errors, clear messages for broken files.

The capture is a sphere of radius 1 rendered in closed form: 6 training frames, 3 views of region "shared" and 2 of
region "sphere".
"""

import dataclasses
import functools
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tumble.datasets import _capture_folder, folder
from tumble.evaluation import evaluate
from tumble.evaluation.prediction import PARTS, Prediction
from tumble.io import files
from tumble.io.files import BadFile
from tumble.maths.images import srgb_from_linear
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture, Truth
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Trajectory

SIZE = 40
CAMERA = Camera.from_fov(math.radians(40), SIZE, SIZE)
REGIONS = ("shared", "sphere", "shared", "shared", "sphere")


def poses(n: int, seed: int) -> Trajectory:
    generator = torch.Generator().manual_seed(seed)
    turns = SO3.exp(torch.randn(n, 3, generator=generator))
    return Trajectory(SE3.from_rotation(turns, torch.tensor([0.0, 0.0, 4.0])), "camera")


def sphere(path: Trajectory) -> dict[str, Tensor]:
    """Maps of the unit sphere, closed form."""
    R_cam_obj = path.T_cam_obj.rotation
    d_cam, centre = CAMERA.directions(), torch.tensor([0.0, 0.0, 4.0])
    along = d_cam @ centre
    inside = along.square() - 15  # |centre|^2 - 1
    mask = inside > 0
    hit_cam = (along - inside.clamp_min(0).sqrt())[..., None] * d_cam
    n_cam = (hit_cam - centre) * mask[..., None]
    n_obj = R_cam_obj.inverse()[:, None, None] @ n_cam
    albedo = (0.45 + 0.35 * (4 * n_obj + torch.tensor([0.0, 1.0, 2.0])).sin()) * mask[..., None]
    return {
        "normals": n_obj,
        "albedo": albedo,
        "roughness": (0.5 + 0.3 * n_obj[..., 0]) * mask,
        "metalness": (0.5 - 0.4 * n_obj[..., 1]) * mask,
        "masks": torch.where(mask, OBJECT, BACKGROUND).to(torch.uint8).expand(len(path), -1, -1).contiguous(),
        "shading": (0.6 - 0.4 * n_cam[..., 1:2]).expand(len(path), -1, -1, -1),
    }


def code_values(linear: Tensor) -> Tensor:
    return (srgb_from_linear(linear) * 255).round().to(torch.uint8)


def synthetic() -> tuple[Capture, Truth]:
    train, views = poses(6, seed=0), poses(5, seed=1)
    frames, maps = sphere(train), sphere(views)
    names = tuple(f"{i:04}.png" for i in range(11))
    images = code_values(frames["albedo"] * frames["shading"])
    truth = Truth(
        images=code_values(maps["albedo"] * maps["shading"]),
        masks=maps["masks"],
        names=names[6:],
        regions=REGIONS,
        trajectory=views,
        albedo=maps["albedo"],
        roughness=maps["roughness"],
        metalness=maps["metalness"],
        normals=maps["normals"],
        relit={light: code_values(k * maps["albedo"]) for light, k in (("sun", 0.9), ("shade", 0.4))},
        light=Environment.from_radiance(0.2 + torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(2))),
        lights={
            light: Environment.from_radiance(torch.full((8, 16, 3), k)) for light, k in (("sun", 0.9), ("shade", 0.4))
        },
        poses=train,
    )
    return Capture(images, frames["masks"], CAMERA, names[:6], "camera", train), truth


@pytest.fixture(scope="module")
def capture_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("captures") / "sphere"
    _capture_folder.save_capture(path, *synthetic(), setting="handheld")
    return path


@pytest.fixture(scope="module")
def perfect_path(capture_path: Path) -> Path:
    """The truth as a prediction folder, shared by tests: copy it before changing it."""
    perfect_prediction(capture_path).write(capture_path.parent / "perfect")
    return capture_path.parent / "perfect"


@functools.cache
def load(path: Path) -> tuple[Capture, Truth]:
    truth = folder.load_truth(path)
    assert truth is not None
    return folder.load(path), truth


def perfect_prediction(path: Path) -> Prediction:
    """The prediction that equals the truth in all parts."""
    capture, truth = load(path)
    return Prediction(
        albedo=truth.albedo,
        normals=truth.normals,
        roughness=truth.roughness,
        metalness=truth.metalness,
        masks=truth.foreground,
        images=truth.images,
        relit=truth.relit,
        light=truth.light,
        poses=truth.poses,
        pose_names=capture.names,
    )


def score(capture_path: Path, **changes: Any) -> dict[str, Any]:
    """Scores of the truth with some parts changed; without LPIPS, which takes most of the time."""
    changed = dataclasses.replace(perfect_prediction(capture_path), **changes)
    return evaluate.compare(changed, *load(capture_path), [])


def all_scores(report: dict[str, Any]) -> dict[str, float]:
    """All scores of the report except those of single views."""
    parts = {**report["regions"], "light": report["light"], "poses": report["poses"]}
    return {f"{part}: {key}": value for part, scores in parts.items() for key, value in scores.items()}


def perfect(key: str) -> float | None:
    """The best value of a score, by its key; None for numbers that are no scores."""
    high = {"psnr": 100.0, "ssim": 1.0, "iou": 1.0, "correlation": 1.0, "percent": 100.0, "lost": 0.0}
    best = {**high, "lpips": 0.0, "degrees": 0.0, "rmse": 0.0, "ate": 0.0, "rpe": 0.0}
    return next((value for word, value in best.items() if word in key), None)


def assert_perfect(report: dict[str, Any], *, except_for: tuple[str, ...] = ()) -> None:
    for key, value in all_scores(report).items():
        if not any(word in key for word in except_for) and perfect(key) is not None:
            # Poses are converted between quaternions and matrices in float32, which rounds at 1e-6 degrees.
            assert value == pytest.approx(perfect(key), abs=2e-4), key


# Scores ---------------------------------------------------------------------------------------------------------------


def test_the_truth_is_a_perfect_prediction(capture_path: Path, perfect_path: Path, tmp_path: Path) -> None:
    report = evaluate.score(perfect_path, capture_path, tmp_path)
    assert_perfect(report)
    assert report["albedo_scale"] == [1, 1, 1]
    assert report["notes"] == []
    assert report["poses"]["poses.alignment"]["identity"] is True
    assert report["regions"].keys() == {"shared", "sphere"}
    assert [row["region"] for row in report["views"]] == list(REGIONS)
    assert len(all_scores(report)) > 60


def test_a_brighter_albedo_under_a_darker_light_is_perfect_after_the_scale(capture_path: Path) -> None:
    _, truth = load(capture_path)
    assert truth.albedo is not None
    assert truth.light is not None
    darker = Environment.from_radiance(truth.light.radiance / 1.1)
    report = score(capture_path, albedo=truth.albedo * 1.1, light=darker)
    assert report["albedo_scale"] == pytest.approx([1 / 1.1] * 3, rel=1e-6)
    assert_perfect(report, except_for=("unscaled",))
    for region in ("shared", "sphere"):
        errors = [(0.1 * truth.albedo[i][truth.foreground[i]]).square().mean() for i in truth.views(region)]
        expected = np.mean([-10 * math.log10(error) for error in errors])
        assert report["regions"][region]["albedo.psnr_fg_linear_unscaled"] == pytest.approx(expected, abs=1e-4)


def test_normals_turned_by_two_degrees_score_two_degrees(capture_path: Path) -> None:
    _, truth = load(capture_path)
    assert truth.normals is not None
    axes = torch.nn.functional.normalize(torch.linalg.cross(truth.normals, truth.normals.roll(1, -1)), dim=-1)
    turned = SO3.exp(math.radians(2) * axes) @ truth.normals
    report = score(capture_path, normals=turned)
    share = float(truth.foreground[0].float().mean())
    for scores in report["regions"].values():
        assert scores["normal.mean_fg_degrees"] == pytest.approx(2, abs=1e-4)
        assert scores["normal.median_fg_degrees"] == pytest.approx(2, abs=1e-4)
        assert scores["normal.mean_all_degrees"] == pytest.approx(2 * share, abs=1e-4)
    assert_perfect(report, except_for=("normal",))


def test_damage_in_one_region_leaves_the_other_perfect(capture_path: Path) -> None:
    truth = perfect_prediction(capture_path)
    assert truth.roughness is not None
    assert truth.metalness is not None
    assert truth.images is not None
    roughness, images = truth.roughness.clone(), truth.images.clone()
    metalness = truth.metalness * torch.tensor([1, 1, 1, 1, 0])[:, None, None]
    roughness[1] = (roughness[1] + 0.1) * (roughness[1] > 0)
    images[4] //= 2
    report = score(capture_path, roughness=roughness, metalness=metalness, images=images)
    assert report["regions"]["shared"]["metalness.mae_fg"] == 0
    assert report["regions"]["sphere"]["metalness.mae_fg"] > 0.1
    assert report["regions"]["shared"]["roughness.rmse_fg"] == report["regions"]["shared"]["roughness.mae_fg"] == 0
    assert report["regions"]["shared"]["image.psnr_full_srgb"] == 100
    # The mean over two views, one of which is perfect.
    for name in ("rmse_fg", "mae_fg"):
        assert report["regions"]["sphere"][f"roughness.{name}"] == pytest.approx(0.05, abs=1e-6)
    assert report["regions"]["sphere"]["image.psnr_full_srgb"] < 70


def test_relit_images_are_scored_unscaled_and_averaged_over_lights(capture_path: Path) -> None:
    """Ten code values off under one of two lights: 20 log10(255 / 10) dB there, and the mean of that and 100 dB."""
    truth = perfect_prediction(capture_path)
    off = {**truth.relit, "sun": truth.relit["sun"] + 10 * truth.masks[..., None].to(torch.uint8)}
    report = score(capture_path, relit=off, albedo=truth.albedo * 0.5)
    shared = report["regions"]["shared"]
    assert shared["relit.sun.psnr_fg_srgb"] == pytest.approx(20 * math.log10(25.5), abs=1e-4)
    assert shared["relit.psnr_fg_srgb"] == pytest.approx(0.5 * (100 + 20 * math.log10(25.5)), abs=1e-4)
    assert "albedo times albedo_scale" in report["protocol"]["relit.psnr_fg_srgb"]


def test_without_masks_the_silhouette_is_where_the_albedo_is_not_black(capture_path: Path) -> None:
    truth = perfect_prediction(capture_path)
    assert truth.albedo is not None
    albedo = truth.albedo.clone()
    albedo[:, :, SIZE // 2 :] = 0
    report = score(capture_path, albedo=albedo, masks=None)
    assert report["regions"]["shared"]["silhouette.iou"] == pytest.approx(0.5, abs=1e-6)


def turned(path: Trajectory, omega: Tensor) -> Trajectory:
    """Poses rotated in the object frame."""
    turns = SE3.from_rotation(SO3.exp(omega), torch.zeros(len(path), 3))
    return Trajectory(path.T_cam_obj @ turns, path.light)


def test_poses_turned_by_three_degrees_each_are_off_by_nearly_that(capture_path: Path) -> None:
    """The mean of rotations about six opposite axes is the identity, so alignment leaves every error at 3 degrees."""
    truth = perfect_prediction(capture_path)
    assert truth.poses is not None
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    report = score(capture_path, poses=turned(truth.poses, math.radians(3) * axes))
    poses = report["poses"]
    assert poses["poses.rotation_mean_degrees"] == pytest.approx(3, abs=1e-3)
    assert poses["poses.rotation_median_degrees"] == pytest.approx(3, abs=1e-3)
    assert poses["poses.rotation_below_2_percent"] == 0
    assert poses["poses.rotation_below_5_percent"] == 100
    # A camera 4 away moves by 4 * 2 sin(1.5 deg) = 0.209 at most, and alignment can only reduce it.
    assert 0.05 < poses["poses.ate"] < 0.21
    assert poses["poses.tolerance"] == pytest.approx(0.4, abs=1e-5)
    assert_perfect(report, except_for=("poses",))


def test_a_common_rotation_and_unit_of_all_poses_are_no_error(capture_path: Path) -> None:
    truth = perfect_prediction(capture_path)
    assert truth.poses is not None
    poses = turned(truth.poses, torch.tensor([0.0, math.radians(3), 0.0]).expand(6, 3))
    poses = Trajectory(SE3(poses.T_cam_obj.wxyz, 0.25 * poses.T_cam_obj.xyz), "camera")
    report = score(capture_path, poses=poses)
    assert_perfect(report)
    alignment = report["poses"]["poses.alignment"]
    assert alignment["identity"] is False
    assert alignment["scale"] == pytest.approx(4, rel=1e-4)
    assert alignment["rotation_degrees"] == pytest.approx(3, abs=1e-3)


def test_lost_frames_are_counted(capture_path: Path) -> None:
    truth = perfect_prediction(capture_path)
    assert truth.poses is not None
    kept = [0, 1, 2, 5]
    names = tuple(truth.pose_names[i] for i in kept)
    report = score(capture_path, poses=truth.poses.select(kept), pose_names=names)
    poses = report["poses"]
    assert (poses["poses.posed_frames"], poses["poses.lost_frames"]) == (4, 2)
    assert poses["poses.auc_percent"] == pytest.approx(100 * 4 / 6, abs=1e-3)
    assert poses["poses.rotation_below_10_percent"] == pytest.approx(100 * 4 / 6)
    assert poses["poses.ate"] == pytest.approx(0, abs=1e-5)


def rewritten(root: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of the capture with a changed transforms.json."""
    capture, truth = synthetic()
    _capture_folder.save_capture(root / "sphere", capture, truth, setting="handheld")
    document = json.loads((root / "sphere" / "transforms.json").read_text())
    change(document)
    (root / "sphere" / "transforms.json").write_text(json.dumps(document))
    return root / "sphere"


def test_in_metres_the_tolerance_is_ten_centimetres(tmp_path: Path) -> None:
    metric = rewritten(tmp_path, lambda document: document.update(units="m"))
    truth = perfect_prediction(metric)
    Prediction(poses=truth.poses, pose_names=truth.pose_names).write(tmp_path / "mine")
    report = evaluate.score(tmp_path / "mine", metric, tmp_path / "out")
    assert report["poses"]["poses.tolerance"] == 0.1
    assert report["capture"]["units"] == "m"


def test_an_unknown_unit_is_refused(tmp_path: Path, perfect_path: Path) -> None:
    inches = rewritten(tmp_path, lambda document: document.update(units="inch"))
    with pytest.raises(BadFile, match=r"transforms\.json: \"units\": invalid enum value 'inch'"):
        evaluate.score(perfect_path, inches, tmp_path / "out")


def test_positions_on_a_line_are_not_scored_and_a_note_gives_the_reason(tmp_path: Path) -> None:
    capture, truth = synthetic()
    xyz = torch.tensor([0.0, 0.0, 4.0]) + torch.linspace(0, 1, 6)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    line = Trajectory(SE3.from_rotation(SO3.identity((6,)), xyz), "camera")
    capture, truth = (
        dataclasses.replace(capture, trajectory=line),
        dataclasses.replace(truth, poses=line),
    )
    _capture_folder.save_capture(tmp_path / "sphere", capture, truth)
    report = score(tmp_path / "sphere")
    assert report["poses"]["poses.ate"] is None
    assert report["poses"]["poses.auc_percent"] is None
    assert report["poses"]["poses.rpe_translation"] is None
    assert report["poses"]["poses.rotation_mean_degrees"] == pytest.approx(0, abs=1e-3)
    assert any("nearly on a line" in note for note in report["notes"])


def test_unknown_pixels_change_no_score(tmp_path: Path) -> None:
    capture, truth = synthetic()
    masks = truth.masks.clone()
    masks[:, 10:14] = UNKNOWN
    _capture_folder.save_capture(tmp_path / "sphere", capture, dataclasses.replace(truth, masks=masks))
    good = perfect_prediction(tmp_path / "sphere")
    assert good.albedo is not None
    assert good.normals is not None
    damaged = {"albedo": good.albedo.clone(), "normals": good.normals.clone()}
    for values in damaged.values():
        values[:, 10:14] = 0.3
    assert_perfect(score(tmp_path / "sphere", **damaged, masks=None))


# Absent and broken parts ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["albedo", "normals", "roughness", "metalness", "images", "relit", "light", "poses"])
def test_an_absent_part_is_noted_and_the_rest_is_scored(capture_path: Path, part: str) -> None:
    changes: dict[str, Any] = {part: {} if part == "relit" else None}
    if part == "poses":
        changes["pose_names"] = ()
    report = score(capture_path, **changes)
    word = {"normals": "normal", "images": "image"}.get(part, part)
    assert any(note.startswith(word) and "absent from the prediction" in note for note in report["notes"])
    assert not any(key.split(": ")[1].startswith(word) for key in all_scores(report))
    assert_perfect(report)


def test_a_single_part_is_enough(capture_path: Path, tmp_path: Path) -> None:
    Prediction(light=perfect_prediction(capture_path).light).write(tmp_path / "mine")
    report = evaluate.score(tmp_path / "mine", capture_path, tmp_path / "out")
    assert report["light"]["light.rmse_clip10"] == pytest.approx(0, abs=1e-6)
    assert report["regions"] == {"shared": {}, "sphere": {}}
    assert any("no albedo scale" in note for note in report["notes"])
    assert (tmp_path / "out" / "sheet.png").exists()


def test_a_capture_without_evaluation_views_still_scores_poses(tmp_path: Path) -> None:
    capture, _ = synthetic()
    _capture_folder.save_capture(tmp_path / "sphere", capture)
    Prediction(poses=capture.trajectory, pose_names=capture.names).write(tmp_path / "mine")
    report = evaluate.score(tmp_path / "mine", tmp_path / "sphere", tmp_path / "out")
    assert report["poses"]["poses.ate"] == pytest.approx(0, abs=1e-5)
    assert report["regions"] == {}


def break_size(root: Path) -> None:
    files.write_exr(root / "normal" / "0002.exr", np.zeros((SIZE, SIZE + 1, 3), np.float32))


def break_nan(root: Path) -> None:
    files.write_exr(root / "albedo" / "0001.exr", np.full((SIZE, SIZE, 3), np.nan, np.float32))


def break_negative(root: Path) -> None:
    files.write_exr(root / "albedo" / "0001.exr", np.full((SIZE, SIZE, 3), -0.5, np.float32))


def break_roughness(root: Path) -> None:
    files.write_exr(root / "roughness" / "0000.exr", np.full((SIZE, SIZE, 1), 1.5, np.float32))


def break_channels(root: Path) -> None:
    files.write_exr(root / "roughness" / "0000.exr", np.ones((SIZE, SIZE, 3), np.float32))


def break_surplus(root: Path) -> None:
    files.write_png(root / "image" / "0005.png", np.zeros((SIZE, SIZE, 3), np.uint8))


def break_grey(root: Path) -> None:
    files.write_png(root / "relit" / "sun" / "0003.png", np.zeros((SIZE, SIZE, 1), np.uint8))


def break_light(root: Path) -> None:
    files.write_exr(root / "light.exr", np.ones((8, 8, 3), np.float32))


def break_pose(root: Path) -> None:
    files.write_json(root / "poses.json", {"0000.png": (2 * np.eye(4)).tolist()})


def break_name(root: Path) -> None:
    files.write_json(root / "poses.json", {"0006.png": np.eye(4).tolist()})


BROKEN = {
    r"normal/0002\.exr: is 41 x 40 pixels, the capture is 40 x 40": break_size,
    r"albedo/0001\.exr: holds NaN": break_nan,
    r"albedo/0001\.exr: holds a negative albedo, -0\.5": break_negative,
    r"roughness/0000\.exr: holds roughness from 1\.5": break_roughness,
    r"roughness/0000\.exr: has 3 channels, roughness needs 1": break_channels,
    r"image/0005\.png: is not one of the 5 evaluation views": break_surplus,
    r"relit/sun/0003\.png: has 1 channels, sun needs 3": break_grey,
    r"image/0004\.png: is missing": lambda root: (root / "image" / "0004.png").unlink(),
    r"light\.exr: an equirectangular environment map must be RGB and twice as wide as high": break_light,
    r"poses\.json: frame 0000\.png: .* not a rotation": break_pose,
    r"poses\.json: has a pose for 0006\.png, which is not a training frame": break_name,
}


@pytest.mark.parametrize("message", BROKEN)
def test_the_error_names_the_broken_file_and_its_rule_and_nothing_is_written(
    capture_path: Path, perfect_path: Path, tmp_path: Path, message: str
) -> None:
    shutil.copytree(perfect_path, tmp_path / "mine")
    BROKEN[message](tmp_path / "mine")
    with pytest.raises(BadFile, match=message):
        evaluate.score(tmp_path / "mine", capture_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_empty_folder_and_no_folder_are_refused(capture_path: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadFile, match="holds no part of a prediction, none of: albedo"):
        evaluate.score(tmp_path / "empty", capture_path, tmp_path / "out")
    with pytest.raises(BadFile, match="is not a folder"):
        evaluate.score(tmp_path / "none", capture_path, tmp_path / "out")


def test_a_capture_without_truth_is_refused(tmp_path: Path) -> None:
    capture, _ = synthetic()
    _capture_folder.save_capture(tmp_path / "sphere", dataclasses.replace(capture, trajectory=None))
    with pytest.raises(BadFile, match="has no truth"):
        evaluate.score(tmp_path / "mine", tmp_path / "sphere", tmp_path / "out")


# Files ----------------------------------------------------------------------------------------------------------------


def test_a_prediction_comes_back_as_it_was_written(capture_path: Path, tmp_path: Path) -> None:
    written = perfect_prediction(capture_path)
    written.write(tmp_path / "mine")
    again = Prediction.read(tmp_path / "mine", *load(capture_path))
    for name in ("albedo", "normals", "roughness", "masks", "images"):
        assert torch.equal(getattr(again, name), getattr(written, name)), name
    assert again.relit.keys() == written.relit.keys()
    assert all(torch.equal(again.relit[light], written.relit[light]) for light in again.relit)
    assert again.pose_names == written.pose_names
    assert written.light is not None
    assert again.light is not None
    torch.testing.assert_close(again.light.radiance, written.light.radiance)
    assert written.poses is not None
    assert again.poses is not None
    torch.testing.assert_close(again.poses.T_cam_obj.matrix(), written.poses.T_cam_obj.matrix())


def test_writing_again_replaces_all_parts_and_leaves_other_files(capture_path: Path, tmp_path: Path) -> None:
    written = perfect_prediction(capture_path)
    written.write(tmp_path / "mine")
    (tmp_path / "mine" / "notes.txt").write_text("keep me")
    Prediction(roughness=written.roughness).write(tmp_path / "mine")
    assert sorted(p.name for p in (tmp_path / "mine").iterdir()) == ["notes.txt", "roughness"]
    assert {p.name for p in (tmp_path / "mine").iterdir()} & set(PARTS) == {"roughness"}


def test_the_report_on_disk_is_the_one_returned_and_the_same_every_time(
    capture_path: Path, perfect_path: Path, tmp_path: Path
) -> None:
    report = evaluate.score(perfect_path, capture_path, tmp_path / "once")
    text = (tmp_path / "once" / "report.json").read_text()
    assert json.loads(text) == report
    assert str(tmp_path) not in text
    evaluate.score(perfect_path, capture_path, tmp_path / "again")
    for name in ("report.json", "sheet.png"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "once" / name).read_bytes()


def test_every_score_has_a_protocol(capture_path: Path, perfect_path: Path, tmp_path: Path) -> None:
    report = evaluate.score(perfect_path, capture_path, tmp_path)
    facts = {"poses.posed_frames", "poses.lost_frames", "poses.tolerance", "poses.alignment"}
    keys = {key.split(": ")[1] for key in all_scores(report)}
    assert keys - facts == set(report["protocol"])
    assert "foreground pixels only" in report["protocol"]["albedo.psnr_fg_linear"]
    assert "alex features" in report["protocol"]["relit.sun.lpips_full_srgb_alex"]


def test_the_documentation_names_every_score() -> None:
    text = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text()
    for key in evaluate.PROTOCOLS:
        word = key.replace("_full_", "_*_").replace("_crop_", "_*_")
        assert any(name in text for name in (key, word, key.partition("_below")[0])), key


def test_vgg_scores_are_added_to_those_of_alexnet(capture_path: Path, tmp_path: Path, shared_data: Path) -> None:
    Prediction(images=perfect_prediction(capture_path).images).write(tmp_path / "mine")
    weights = shared_data / "lpips" / "lpips_vgg_v01_f16.npz"
    report = evaluate.score(tmp_path / "mine", capture_path, tmp_path / "out", vgg=weights)
    assert report["regions"]["shared"]["image.lpips_full_srgb_vgg"] == 0
    assert "vgg features" in report["protocol"]["image.lpips_full_srgb_vgg"]


def test_folders_of_a_run_are_reported_under_the_name_of_the_run(capture_path: Path, tmp_path: Path) -> None:
    """The names `prediction` and `capture` would not identify the run."""
    shutil.copytree(capture_path, tmp_path / "runs" / "pot" / "capture")
    Prediction(light=perfect_prediction(capture_path).light).write(tmp_path / "runs" / "mug" / "prediction")
    report = evaluate.score(
        tmp_path / "runs" / "mug" / "prediction", tmp_path / "runs" / "pot" / "capture", tmp_path / "out"
    )
    assert (report["prediction"], report["capture"]["name"]) == ("mug", "pot")
