"""The bundled clip: it unpacks to a capture with ground truth, and its report page needs no network."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from tumble import demo, recipes
from tumble.datasets import folder
from tumble.io import BadFile, files, video
from tumble.synthetic import trajectories


def test_the_bundled_folder_is_below_3_megabytes() -> None:
    size = sum(path.stat().st_size for path in demo.bundled_folder().rglob("*") if path.is_file())
    assert size < 3_000_000


def test_a_package_that_is_installed_read_only_unpacks_to_files_that_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(demo.bundled_folder(), tmp_path / "locked")
    for path in (tmp_path / "locked", *(tmp_path / "locked").rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    monkeypatch.setattr(demo, "bundled_folder", lambda: tmp_path / "locked")
    out = demo.unpack(tmp_path / "capture")
    assert all(path.stat().st_mode & 0o200 for path in (out, *out.rglob("*")))


def test_the_clip_unpacks_to_a_pose_free_capture_with_truth(tmp_path: Path) -> None:
    path = demo.unpack(tmp_path / "capture")
    capture, truth = folder.load(path), folder.load_truth(path)
    assert capture.trajectory is None
    assert capture.light == "camera"
    assert len(capture) == 96
    assert truth is not None
    assert {truth.regions.count("shared"), truth.regions.count("sphere")} == {8, 2}
    for part in (truth.albedo, truth.roughness, truth.normals, truth.depth, truth.light, truth.poses):
        assert part is not None
    # Frames and masks belong together: outside the masks the frames are black, up to compression.
    outside = capture.images[capture.masks == 0].double()
    assert outside.mean() < 2
    T = truth.poses.T_cam_obj
    steps = torch.rad2deg((T.rotation[1:] @ T.rotation[:-1].inverse()).angle())
    low, high = (np.rad2deg(angle) for angle in trajectories.TUMBLE_STEP)
    # Poses are written with all digits and read as 32-bit floats.
    assert steps.min() > low - 0.05
    assert steps.max() < high + 0.05
    # A second call changes nothing.
    stamp = (path / "images" / "0000.png").stat().st_mtime_ns
    assert demo.unpack(path) == path
    assert (path / "images" / "0000.png").stat().st_mtime_ns == stamp


def test_a_capture_of_somebody_else_is_not_taken_for_the_clip(tmp_path: Path) -> None:
    document = files.read_json(demo.bundled_folder() / "transforms.json")
    files.write_json(tmp_path / "capture" / "transforms.json", document | {"frames": document["frames"][1:]})
    with pytest.raises(BadFile, match="capture: holds a capture other than the bundled clip"):
        demo.reconstruct_clip(tmp_path)
    assert [path.name for path in (tmp_path / "capture").iterdir()] == ["transforms.json"]


@pytest.mark.slow
def test_the_demo_reaches_its_scores_and_writes_its_report(tmp_path: Path) -> None:
    """Runs with three seeds scored 24.37 to 24.58 dB of albedo, 26.31 (this seed) to 26.85 dB relit, 4.22 to 4.28
    degrees of normals, 0.730 of light, and rotations 0.197 degrees off. The limits leave at least half that spread.
    With the roughness of the object as one parameter, this seed has 24.40, 27.42, 4.20, 0.746 and 0.179, which
    docs/first-ten-minutes.md prints."""
    scores, page_path = demo.reconstruct_clip(tmp_path / "demo", recipes.DRAFT)
    shared = scores["regions"]["shared"]
    assert shared["albedo.psnr_fg_srgb"] > 24.0
    assert shared["relit.psnr_fg_srgb"] > 26.0
    assert shared["normal.mean_fg_degrees"] < 4.5
    assert scores["light"]["light.rmse_clip10"] < 0.855
    assert scores["poses"]["poses.rotation_median_degrees"] < 0.22
    page = page_path.read_text("utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)


def test_a_written_video_is_read_back_in_frame_order(tmp_path: Path) -> None:
    frames = np.zeros((6, 32, 48, 3), np.uint8)
    for i in range(6):
        frames[i, :, 8 * i : 8 * i + 8] = [30 * i + 40, 90, 200 - 30 * i]
    video.write_clip(tmp_path / "x.mp4", iter(frames))
    decoded = np.stack(list(video.read_clip(tmp_path / "x.mp4")))
    assert decoded.shape == frames.shape
    assert np.abs(decoded.astype(float) - frames).mean() < 4
    for i in range(6):
        assert decoded[i].sum((0, 2)).argmax() // 8 == i
