"""All stages on a few small frames: interrupted equals whole, truth is never read, scores come out."""

import dataclasses
import math
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.lopsided import Tumble, truth, tumbling
from tests.poses.sfm.test_stage import QUICK, matches
from tests.poses.test_background_removal import PRINT, N, film, result
from tests.scene.test_visual_hull import silhouettes
from tumble import actions, matching, pipeline, recipes
from tumble.datasets import _capture_folder, folder
from tumble.engine import loop
from tumble.engine import run as runs
from tumble.export import asset as export
from tumble.export.asset import Preset
from tumble.inverse_rendering import decompose, mean_colour_baseline, refine
from tumble.io import files, tree, video
from tumble.io.files import BadFile
from tumble.maths.se3 import SE3
from tumble.rendering import gbuffer
from tumble.scene import visual_hull
from tumble.scene.asset import Asset
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture, Truth, content_key, truth_without_views
from tumble.scene.environment import Environment

RECIPE = dataclasses.replace(recipes.SMOKE, seed=3)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grey ellipsoid with a bright half, as a capture of eight frames and two evaluation views."""
    torch.manual_seed(0)
    frames, trajectory = silhouettes(10, 32)
    shade = torch.linspace(60, 220, 32).to(torch.uint8)[None, None, :, None]
    images = torch.where(frames.masks[..., None] == OBJECT, shade, 0).to(torch.uint8).repeat(1, 1, 1, 3)
    train, views = list(range(8)), [8, 9]
    taken = Capture(
        images[train], frames.masks[train], frames.camera, frames.names[:8], "camera", trajectory.select(train)
    )
    truth = Truth(
        images=images[views],
        masks=frames.masks[views],
        names=frames.names[8:],
        regions=("shared", "sphere"),
        trajectory=trajectory.select(views),
        albedo=torch.rand(2, 32, 32, 3) * (frames.masks[views] == OBJECT)[..., None],
        normals=torch.nn.functional.normalize(torch.randn(2, 32, 32, 3), dim=-1),
        relit={"sun": images[views]},
        light=Environment.from_radiance(torch.rand(8, 16, 3)),
        lights={"sun": Environment.from_radiance(torch.rand(8, 16, 3))},
        poses=trajectory.select(train),
    )
    path = tmp_path_factory.mktemp("capture") / "c"
    _capture_folder.save_capture(path, taken, truth, setting="handheld")
    return path


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Asset]:
    out = tmp_path_factory.mktemp("runs") / "r"
    return out, pipeline.reconstruct(capture, out, RECIPE)


def assert_same(a: Asset, b: Asset) -> None:
    one, other = tree.named_tensors(a), tree.named_tensors(b)
    assert list(one) == list(other)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_run_leaves_an_asset_a_light_and_poses(finished: tuple[Path, Asset], capture: Path) -> None:
    out, asset = finished
    assert_same(tree.load(Asset, out / "asset.safetensors"), asset)
    assert all(torch.isfinite(x).all() for x in tree.named_tensors(asset).values())
    assert Environment.read(out / "light.exr").log_radiance.shape == asset.environment.log_radiance.shape
    poses = folder.read_poses(out / "poses.json", folder.load(capture).names)
    torch.testing.assert_close(poses, folder.load(capture).trajectory.camera_to_object(), atol=1e-5, rtol=0)
    assert len(asset.gaussians) > 50


def test_a_run_without_truth_makes_the_same_asset(finished: tuple[Path, Asset], capture: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare)
    shutil.rmtree(bare / "truth")
    assert_same(pipeline.reconstruct(bare, tmp_path / "run", RECIPE), finished[1])


def test_an_interrupted_run_ends_the_same(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the middle of stage 2, after a densification; then the same command again."""
    step = refine.step

    def interrupted(cfg, inputs, state):
        result = step(cfg, inputs, state)
        if state.step == 17:
            import signal

            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(refine, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pipeline.reconstruct(capture, tmp_path / "run", RECIPE)
    monkeypatch.setattr(refine, "step", step)
    assert_same(pipeline.reconstruct(capture, tmp_path / "run", RECIPE), finished[1])


@pytest.mark.gpu
def test_a_run_on_a_gpu_makes_an_asset(capture: Path, finished: tuple[Path, Asset], tmp_path: Path) -> None:
    """Densification decides by thresholds, so the number of Gaussians may differ a little."""
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    asset = pipeline.reconstruct(capture, tmp_path / "run", RECIPE, device="cuda")
    assert all(torch.isfinite(x).all() and x.device.type == "cpu" for x in tree.named_tensors(asset).values())
    assert len(asset.gaussians) == pytest.approx(len(finished[1].gaussians), rel=0.1)
    here, there = (float(x.environment.radiance.mean()) for x in (finished[1], asset))
    assert there == pytest.approx(here, rel=0.1)


def test_finished_stages_are_not_run_again(
    finished: tuple[Path, Asset], capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("ran again")

    monkeypatch.setattr(refine, "step", never)
    assert_same(pipeline.reconstruct(capture, finished[0], RECIPE), finished[1])


def test_a_run_is_scored_with_known_poses_as_they_are(
    finished: tuple[Path, Asset], capture: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "tumble")
    report = actions.evaluate_run(finished[0], capture)
    told = [message.partition(" (")[0] for message in caplog.messages]
    assert told[:2] == ["rendering maps of the evaluation views", "rendering views under the estimated light"]
    assert told[-1] == "scoring views"
    assert set(report["regions"]) == {"shared", "sphere"}
    shared = report["regions"]["shared"]
    for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_full_srgb", "normal.mean_fg_degrees"):
        assert math.isfinite(shared[key])
    assert report["poses"]["poses.rotation_mean_degrees"] < 0.01
    assert (finished[0] / "sheet.png").is_file()


def test_a_run_is_scored_into_itself_or_elsewhere_and_an_input_is_never_written_to(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A prediction folder and a capture are inputs; a run is our own output."""
    for name, path in (("run", finished[0]), ("truth", capture)):
        shutil.copytree(path, tmp_path / name)
    monkeypatch.chdir(tmp_path)

    def changed(*where: Path) -> set[Path]:
        """Folders of the files that scoring changes."""
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        actions.evaluate_folder(*where)
        after = [path for path in tmp_path.rglob("*") if before.get(path) != path.stat().st_mtime_ns]
        return {path.parent.relative_to(tmp_path) for path in after if path.is_file()}

    elsewhere = changed(Path("run"), Path("truth"), Path("other"))
    assert {path.parts[0] for path in elsewhere} == {"other"}
    assert {path.parts[0] for path in changed(Path("run"), Path("truth"))} == {"run"}
    shutil.move("other/prediction", "method")
    scores = Path("runs/evaluate/method")
    for _ in range(2):
        assert changed(Path("method"), Path("truth")) == {scores}
        assert actions.score_folder(Path("method")) == scores
    for taken in ("method", "truth"):
        with pytest.raises(BadFile, match=f"{taken}: holds other files"):
            actions.evaluate_folder(Path("method"), Path("truth"), Path(taken))
    with pytest.raises(BadFile, match="run: is a run, whose own scores these would replace"):
        actions.evaluate_folder(Path("method"), Path("truth"), Path("run"))


def test_a_run_is_scored_in_the_true_frame_when_its_capture_has_no_poses(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same run against the same truth, with and without given poses: its trajectory is the true one, nearly."""
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare)
    document = files.read_json(bare / folder.TRANSFORMS)
    for frame in document["frames"]:
        if frame["split"] == "train":
            del frame["transform_matrix"]
    files.write_json(bare / folder.TRANSFORMS, document)
    run = tmp_path / "run"
    shutil.copytree(finished[0], run)
    loads: list[Path] = []
    load = folder.load
    monkeypatch.setattr(folder, "load", lambda path: loads.append(path) or load(path))
    free = actions.evaluate_run(run, bare, run)
    assert loads == [bare], "a capture is read once"
    given = actions.evaluate_run(run, capture, run)
    assert "first the rotation" in free["notes"][0]
    assert "poses were given" in given["notes"][0]
    (run / runs.TRACK).mkdir()
    found = actions.evaluate_run(run, capture, run)
    assert "first the rotation" in found["notes"][0], "a run that estimated poses has a frame of its own"
    for region, scores in given["regions"].items():
        for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb"):
            # Rays are drawn anew.
            assert free["regions"][region][key] == pytest.approx(scores[key], abs=0.3), key
        key = "normal.mean_fg_degrees"
        assert free["regions"][region][key] == pytest.approx(scores[key], abs=0.5)


def test_a_run_from_poses_of_stage_1_is_aligned_before_it_is_scored(capture: Path, tmp_path: Path) -> None:
    """It has an object frame of its own, though no stage of it estimated poses."""
    known = folder.load(capture)
    found = result(known.camera, known.trajectory.T_cam_obj)
    pipeline.reconstruct(capture, tmp_path / "run", RECIPE, poses=found)
    assert "first the rotation" in actions.evaluate_run(tmp_path / "run", capture)["notes"][0]
    pipeline.reconstruct(capture, tmp_path / "given", RECIPE, poses=known.trajectory)
    assert "poses were given" in actions.evaluate_run(tmp_path / "given", capture)["notes"][0]


def test_a_run_goes_on_with_the_focal_length_that_it_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A capture whose focal length is a guess, a fifth too short, and its twin with the true one, to score against."""
    scene = tumbling(16, size=96, points=150)
    true = scene.capture.camera
    guess = dataclasses.replace(scene.capture, camera=true.zoomed(0.8), focal_assumed=True)
    _capture_folder.save_capture(tmp_path / "guess", guess)
    _capture_folder.save_capture(
        tmp_path / "true", scene.capture, dataclasses.replace(truth_without_views(true), poses=truth(scene))
    )
    monkeypatch.setattr(matching, "match_pairs", lambda *_, **__: matches(scene))
    recipe = dataclasses.replace(RECIPE, track=QUICK)
    run = tmp_path / "run"
    asset = pipeline.reconstruct(tmp_path / "guess", run, recipe, poses="estimate")
    focal = float(asset.camera.fx_fy_cx_cy[0])
    assert focal == pytest.approx(float(true.fx_fy_cx_cy[0]), rel=0.1)
    said = [record["said"] for record in runs.log_records(run) if record.get("event") == "focal"]
    begun = float(guess.camera.fx_fy_cx_cy[0])
    assert said == [f"focal length {focal:.0f} pixels (estimated; {begun:.0f} was assumed)"]
    assert_same(pipeline.reconstruct(tmp_path / "guess", run, recipe, poses="estimate"), asset)
    _check_up(scene, run, recipe, asset, monkeypatch)
    # Scored through the true camera: a folder, a film, a window of a film, a film whose lens is known.
    ratio = float(true.fx_fy_cx_cy[0]) / focal
    report = actions.evaluate_run(run, tmp_path / "true", run)
    assert f"depths times {ratio:.4g}" in report["notes"][0]
    note = {"focal_source": "guess", "window_top_left_height_width": [0, 0, 192, 192], "frames": []}
    assert actions._focal_ratio(run, asset, guess) == pytest.approx(begun / focal)
    files.write_json(run / "capture" / "ingest.json", note)
    assert actions._focal_ratio(run, asset, scene.capture) == pytest.approx(ratio)
    window = dataclasses.replace(asset, camera=asset.camera.resized(192, 192).cropped(20, 30, 120, 100).resized(60, 50))
    files.write_json(run / "capture" / "ingest.json", note | {"window_top_left_height_width": [20, 30, 120, 100]})
    assert actions._focal_ratio(run, window, scene.capture) == pytest.approx(ratio)
    files.write_json(run / "capture" / "ingest.json", note | {"focal_source": "given"})
    assert actions._focal_ratio(run, asset, scene.capture) == 1


def _check_up(scene: Tumble, run: Path, recipe: recipes.Recipe, asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    """The exported mesh stands as the object in the first image, or as `up` says, which the scores do not depend on."""
    trimesh = pytest.importorskip("trimesh")
    small = Preset(triangles=800, texture=64, cells=32, views=12, pixels=64)
    monkeypatch.setitem(export.PRESETS, "web", small)

    def row_of_top(asset: Asset, frame: int, vertices: torch.Tensor) -> float:
        """Row of the highest vertex in the image of a frame, from 0 at the object's top to 1 at its bottom."""
        row = asset.camera.project((asset.trajectory.T_cam_obj[frame] @ vertices[vertices[:, 1].argmax()])[None])[0, 1]
        rows = (scene.capture.masks[frame] == OBJECT).any(1).nonzero()[:, 0]
        return float((row - rows[0]) / (rows[-1] - rows[0]))

    def turned(up: str) -> Asset:
        return pipeline.reconstruct(run.parent / "guess", run, recipe, poses="estimate", up=up)

    glb = trimesh.load_scene(actions.export_run(run, None, "web", None) / "asset.glb")
    vertices = torch.tensor(np.concatenate([shape.vertices for shape in glb.geometry.values()])).float()
    # The few steps blur the ends by a tenth.
    assert abs(row_of_top(asset, 0, vertices)) < 0.15
    error = actions.evaluate_run(run, run.parent / "true", run)["poses"]["poses.rotation_mean_degrees"]
    old = "export shows the object before this run; repeat tumble export"
    scored = "prediction shows the object before this run; repeat tumble evaluate"
    with pytest.warns(UserWarning, match=old), pytest.warns(UserWarning, match=scored):
        upright_in_frame_9 = turned("9.png")
    assert_same(turned("9.png"), upright_in_frame_9)  # nothing changes, and there is no warning
    assert abs(row_of_top(upright_in_frame_9, 9, upright_in_frame_9.gaussians.means)) < 0.15
    with pytest.warns(UserWarning, match=old), pytest.warns(UserWarning, match=scored):
        over = turned("-y")
    assert abs(row_of_top(over, 0, over.gaussians.means) - 1) < 0.15
    again = actions.evaluate_run(run, run.parent / "true", run)["poses"]
    assert again["poses.rotation_mean_degrees"] == pytest.approx(error, abs=1e-3)
    with pytest.raises(ValueError, match="neither a direction nor a frame; choose auto, x, -x"):
        turned("up")
    with pytest.raises(ValueError, match="the poses of this capture define its frame"):
        pipeline.reconstruct(dataclasses.replace(scene.capture, trajectory=truth(scene)), up="z")
    for name in pipeline.MADE_OF_ASSET:
        shutil.rmtree(run / name, ignore_errors=True)
    assert_same(turned("auto"), asset)


def test_frames_of_a_film_are_found_in_its_capture_by_their_numbers(capture: Path, tmp_path: Path) -> None:
    """A film of eight frames of which the second to last and the third were kept, and one that the capture lacks."""
    kept = {"0000.png": 6, "0001.png": 2, "0002.png": 8}
    files.write_json(tmp_path / runs.POSES, dict.fromkeys(kept, np.eye(4).tolist()))
    known = folder.load(capture)
    assert actions.source_names(tmp_path, known) == tuple(kept)
    said = [{"name": name, "source_frame": number} for name, number in kept.items()]
    files.write_json(tmp_path / "capture" / "ingest.json", {"frames": said})
    assert actions.source_names(tmp_path, known) == (known.names[6], known.names[2], "0002.png")
    # Pictures with a model have names, not numbers.
    files.write_json(tmp_path / "capture" / "ingest.json", {"frames": [{"name": "0000.png", "source": "a.jpg"}]})
    assert actions.source_names(tmp_path, known) == tuple(kept)


def test_stage_2_runs_again_from_other_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses that are given as a result of stage 1 are part of the key of stage 2, as are its camera and lost frames."""
    scene = tumbling(N, size=64, points=10)
    camera, T_cam_obj = scene.capture.camera, scene.T_cam_obj
    moved = SE3(T_cam_obj.wxyz, T_cam_obj.xyz * 1.01)
    first = result(camera, T_cam_obj)
    others = result(camera, moved), result(camera.zoomed(1.01), T_cam_obj), result(camera, T_cam_obj, (3,))
    keys: list[list[str]] = []

    def stage(*arguments: Any) -> Any:
        keys.append(arguments[-1])
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "stage", stage)
    for found in (first, first, *others):
        with pytest.raises(KeyboardInterrupt):
            pipeline.reconstruct(scene.capture, recipe=RECIPE, poses=found)
    assert keys[0] == keys[1]
    assert len({str(key) for key in keys}) == 4


def test_background_in_the_masks_of_a_held_object_is_removed_after_stage_1(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only with photos of the background, which captures of films without hands lack; then the masks need a new key."""
    held, objects, T_cam_obj = film(PRINT)
    wall = (held.masks == OBJECT) & ~objects
    monkeypatch.setattr(pipeline, "_track", lambda *_: (result(held.camera, T_cam_obj), "key"))
    opened = runs.Run(None, RECIPE, None)
    _, cut, key = pipeline._poses_of(opened, held, Path("film"), "content", "cpu")
    assert (cut.masks[wall] == BACKGROUND).float().mean() > 0.7
    assert key == ""
    without = dataclasses.replace(held, full_images=None)
    _, same, key = pipeline._poses_of(opened, without, Path("film"), "content", "cpu")
    assert content_key(same) == content_key(without)
    assert key == "key"


def test_a_gpu_that_the_progressive_route_does_not_use_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tumbling(N, size=64, points=10)
    monkeypatch.setattr(pipeline, "_track", lambda *_: (result(scene.capture.camera, scene.T_cam_obj), "key"))
    for recipe, device, said in ((recipes.PAPER, "cuda", 1), (recipes.PAPER, "cpu", 0), (RECIPE, "cuda", 0)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pipeline._poses_of(runs.Run(None, recipe, None), scene.capture, Path("film"), "content", device)
        assert sum("runs on the CPU" in str(each.message) for each in caught) == said


def test_what_cannot_be_done_is_said(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = folder.load(capture)
    few = taken.select([0, 1, 2])
    _capture_folder.save_capture(tmp_path / "few", few)
    with pytest.raises(BadFile, match="has 3 frames, too few"):
        pipeline.reconstruct(tmp_path / "few", tmp_path / "run", RECIPE, poses="estimate")
    stage = runs.stage

    def loses_one(*arguments: Any) -> Any:
        tracked, key = stage(*arguments)
        lost = torch.arange(len(tracked.quality.lost)) == 5
        quality = dataclasses.replace(tracked.quality, lost=lost)
        return dataclasses.replace(tracked, quality=quality), key

    monkeypatch.setattr(runs, "stage", loses_one)
    quick = dataclasses.replace(RECIPE, track=QUICK)
    with pytest.raises(BadFile, match="could not be tracked: 1 of 8 frames"):
        pipeline.reconstruct(capture, tmp_path / "lost", quick, poses="estimate")
    with pytest.raises(BadFile, match="finish the run first"):
        actions.evaluate_run(tmp_path / "nowhere", capture)

    def contradicts(*arguments: Any) -> Any:
        if arguments[1] == runs.REFINE:
            raise visual_hull.EmptyHull("is empty")
        return stage(*arguments)

    monkeypatch.setattr(runs, "stage", contradicts)
    said = r"no shape has these silhouettes .* \(see whether the masks show the object\. "
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the poses of so few frames are rated bad
        with pytest.raises(BadFile, match=said):
            pipeline.reconstruct(capture, tmp_path / "empty", quick, poses="estimate")
    with pytest.raises(visual_hull.EmptyHull):
        pipeline.reconstruct(capture, tmp_path / "given", quick, poses="given")


@pytest.mark.parametrize("fast", [True, False])
def test_a_run_can_be_put_under_another_light(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, fast: bool
) -> None:
    actions.relight_run(finished[0], capture / "truth" / "lights" / "sun.hdr", tmp_path, fast=fast)
    pictures = [files.read_image(path) for path in sorted(tmp_path.glob("*.png"))]
    assert len(pictures) == 8
    assert all(0 < picture.mean() < 255 for picture in pictures)


def test_a_turning_object_is_in_the_middle_of_its_film(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of a run whose pictures are a window beside the middle of a film."""
    monkeypatch.setattr(actions, "TURNTABLE_FRAMES", 2)
    monkeypatch.setattr(actions, "TURNTABLE_SIDE", 64)
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    beside = finished[1].camera.cropped(0, 40, finished[1].camera.height, finished[1].camera.width)
    tree.save(dataclasses.replace(finished[1], camera=beside), out / runs.ASSET)
    light = capture / "truth" / "lights" / "sun.hdr"
    for number, run in enumerate((finished[0], out)):
        actions.relight_turntable(run, light, tmp_path / f"{number}.mp4", fast=True)
    films = [np.stack(list(video.read_clip(tmp_path / f"{number}.mp4"))) for number in range(2)]
    assert films[0].max() > 60
    assert (films[0] == films[1]).all()


def test_a_finished_run_is_recoloured_by_a_known_white(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No stage runs again. Albedo times light stays the same in each channel, and the pixel becomes neutral."""
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    monkeypatch.setattr(loop, "drive", None)
    white = (16, 16, "0.png")
    asset = pipeline.reconstruct(capture, out, RECIPE, white=white)
    products = [x.material.albedo.mean((0, 1)) * x.environment.integral() for x in (finished[1], asset)]
    torch.testing.assert_close(products[1], products[0], rtol=1e-3, atol=0)
    shown = gbuffer.render_gbuffer(asset, asset.trajectory.T_cam_obj[0], asset.camera).features["albedo"][14:19, 14:19]
    middle = shown.flatten(0, 1).median(0).values
    # The known white has a standard deviation of 0.03, and other cues pull at it with theirs.
    torch.testing.assert_close(middle, middle.mean().expand(3), rtol=0.05, atol=0)
    estimates = [r for r in runs.log_records(out) if r.get("event") == "colour"]
    before, after = estimates[-2:]
    assert [before["white"], after["white"]] == [False, True]
    assert max(after["deviation"]) < max(before["deviation"])
    assert_same(pipeline.reconstruct(capture, out, RECIPE), finished[1])


def test_an_exported_glb_is_scored_like_its_run(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mitsuba")
    pytest.importorskip("xatlas")
    small = Preset(triangles=400, texture=64, cells=32, views=8, pixels=64)
    monkeypatch.setitem(export.PRESETS, "web", small)
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    glb = actions.export_run(out, None, "web", None) / "asset.glb"
    scores = actions.evaluate_glb(out, glb, capture)["regions"]["shared"]
    assert {"albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "silhouette.iou"} <= set(scores)
    stretched = tmp_path / "stretched"
    shutil.copytree(capture, stretched)
    document = files.read_json(stretched / folder.TRANSFORMS)
    files.write_json(stretched / folder.TRANSFORMS, document | {"fl_y": document["fl_x"] + 1})
    with pytest.raises(BadFile, match="stretched: has pixels that are not square"):
        actions.evaluate_glb(out, glb, stretched)
    for broken, rule in (({}, "missing required field"), ({"metres_per_object_radius": 0.0}, "> 0")):
        files.write_json(glb.parent / export.EXPORT_FILE, broken)
        with pytest.raises(BadFile, match=f"export.json: .*{rule}.*where `tumble export` wrote it"):
            actions.evaluate_glb(out, glb, capture)


def test_a_card_beside_the_object_is_seen_in_the_whole_photos(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The images that the stages see are black there."""
    out, held = tmp_path / "run", pipeline.read_capture(capture)
    photos = held.images.clone()
    photos[0, :6, :6] = torch.tensor([200, 190, 120], dtype=torch.uint8)
    held = dataclasses.replace(held, full_images=photos)
    pipeline.reconstruct(held, out, RECIPE)
    monkeypatch.setattr(loop, "drive", None)
    before = runs.log_records(out)[-1]
    pipeline.reconstruct(held, out, RECIPE, white=(2, 2, "0.png"))
    after = [r for r in runs.log_records(out) if r.get("event") == "colour"][-1]
    assert after["white"], before
    with pytest.raises(ValueError, match="too dark"):
        pipeline.reconstruct(held, out, RECIPE, white=(20, 0, "0.png"))


@pytest.mark.parametrize(
    ("white", "rule"),
    [((3, 3, "9999.png"), "no such frame"), ((32, 3, "0.png"), "outside"), ((0, 0, "0.png"), "is background")],
)
def test_an_unsuitable_white_is_refused(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, white: tuple[int, int, str], rule: str
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    with pytest.raises(ValueError, match=rule):
        pipeline.reconstruct(capture, out, RECIPE, white=white)
    assert_same(tree.load(Asset, out / "asset.safetensors"), finished[1])


def test_the_third_axis_is_the_smallest_after_training(finished: tuple[Path, Asset]) -> None:
    """Our normal is the third axis by construction; the paper's is that of the smallest scale."""
    scales = finished[1].gaussians.scales
    assert (scales.argmin(-1) == 2).double().mean() > 0.99


def test_visibility_is_traced_again_only_when_geometry_has_moved(
    finished: tuple[Path, Asset], capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = folder.load(capture)
    refined = tree.load(refine.Refined, finished[0] / "2-refine" / "out.safetensors")
    inputs = decompose.Inputs(taken, refined)
    cfg = dataclasses.replace(RECIPE.decompose, warmup=0, try_matte=False)
    state = decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    looks: list[int] = []
    monkeypatch.setattr(decompose, "_trace_visibility", lambda cfg, inputs, state: looks.append(state.step))
    decompose._retrace_if_moved(cfg, inputs, state)
    assert looks == []
    with torch.no_grad():
        state.params.gaussians.means.add_(0.5 * state.params.gaussians.scales.amax(-1, keepdim=True))
    decompose._retrace_if_moved(cfg, inputs, state)
    assert looks == [0]
    state.step = 7
    decompose._retrace_if_moved(cfg, inputs, state)
    assert looks == [0], "the displacement is checked every DISPLACEMENT_CHECK_EVERY steps"


def test_averaging_finds_the_colour_that_every_frame_shows(finished: tuple[Path, Asset], capture: Path) -> None:
    """A surface that looks the same in all frames has that look as its albedo."""
    taken = folder.load(capture)
    grey = torch.where(taken.masks[..., None] == OBJECT, 128, 0).to(torch.uint8).repeat(1, 1, 1, 3)
    flat = dataclasses.replace(taken, images=grey)
    refined = tree.load(refine.Refined, finished[0] / "2-refine" / "out.safetensors")
    asset = loop.drive(mean_colour_baseline, mean_colour_baseline.Config(), decompose.Inputs(flat, refined), seed=0)
    found = gbuffer.render_gbuffer(asset, refined.trajectory.T_cam_obj[0], taken.camera)
    # The linear value of code 128; an eighth of a frame's colour may come from its soft edge.
    inside = found.alpha > 0.99
    assert inside.sum() > 20
    torch.testing.assert_close(found.features["albedo"][inside].median(), torch.tensor(0.2159), atol=0.01, rtol=0)


def test_without_corners_a_gaussian_has_one_material(finished: tuple[Path, Asset], capture: Path) -> None:
    refined = tree.load(refine.Refined, finished[0] / "2-refine" / "out.safetensors")
    cfg = dataclasses.replace(RECIPE.decompose, corners=False)
    asset = loop.drive(decompose, cfg, decompose.Inputs(folder.load(capture), refined), seed=0)
    albedo = asset.material.albedo
    assert torch.equal(albedo, albedo[:, :1].expand_as(albedo))
    assert finished[1].material.albedo.std(1).max() > 1e-3


def test_a_frame_that_hides_the_object_does_not_end_a_run(finished: tuple[Path, Asset], capture: Path) -> None:
    """All that its mask says for sure is one pixel, beside the object."""
    taken = folder.load(capture).select([0])
    masks = torch.full_like(taken.masks, UNKNOWN)
    masks[0, 0, 0] = OBJECT
    refined = tree.load(refine.Refined, finished[0] / "2-refine" / "out.safetensors")
    refined = dataclasses.replace(refined, trajectory=refined.trajectory.select([0]))
    inputs = decompose.Inputs(dataclasses.replace(taken, masks=masks), refined)
    cfg = dataclasses.replace(RECIPE.decompose, warmup=0)
    state = decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    for state.step in range(3):
        terms = decompose.step(cfg, inputs, state)
        assert terms["render"] == 0
    assert all(x.isfinite().all() for x in tree.named_tensors(state.params).values())


def test_without_visibility_nothing_is_lit_by_another_part(finished: tuple[Path, Asset], capture: Path) -> None:
    refined = tree.load(refine.Refined, finished[0] / "2-refine" / "out.safetensors")
    inputs = decompose.Inputs(folder.load(capture), refined)
    cfg = dataclasses.replace(RECIPE.decompose, visibility=False)
    state = decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    assert math.isfinite(float(decompose.step(cfg, inputs, state)["render"]))


@pytest.mark.parametrize(("with_lobe", "kept"), [(0.6, True), (0.9, True), (0.96, False), (1.2, False)])
def test_a_specular_lobe_must_explain_a_part_of_the_error(
    finished: tuple[Path, Asset], capture: Path, monkeypatch: pytest.MonkeyPatch, with_lobe: float, kept: bool
) -> None:
    """Without one the albedos are brighter, F0 stays 0, and the roughness does not drift."""
    refined = tree.load(refine.Refined, finished[0] / "2-refine" / "out.safetensors")
    errors, trial = iter([with_lobe, 1.0, 2.0]), decompose._trial  # the last with half the contrast
    monkeypatch.setattr(decompose, "_trial", lambda *inputs: (trial(*inputs)[0], next(errors)))
    no_metal = dataclasses.replace(RECIPE.decompose.rates, metalness=0.0)
    cfg = dataclasses.replace(RECIPE.decompose, steps=5, rates=no_metal)
    inputs = decompose.Inputs(folder.load(capture), refined)
    before = decompose.init(dataclasses.replace(cfg, try_matte=False), inputs, torch.Generator().manual_seed(0)).params
    state = decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    brighter = state.params.material.albedo.mean() > before.material.albedo.mean()
    assert kept or brighter
    while state.step < cfg.steps:
        decompose.step(cfg, inputs, state)
        state.step += 1
    asset = decompose.finish(cfg, inputs, state)
    assert (asset.material.f0 > 1e-3) == kept
    assert kept or asset.material.roughness.mean().item() == pytest.approx(0.5, abs=0.01)


def test_given_poses_stay_in_every_stage() -> None:
    loose = dataclasses.replace(RECIPE.decompose, rates=dataclasses.replace(RECIPE.decompose.rates, poses=1e-2))
    known = recipes.known_poses(dataclasses.replace(RECIPE, decompose=loose))
    assert (known.refine.rates.poses, known.refine.realignments, known.decompose.rates.poses) == (0, 0, 0)
    assert recipes.known_poses(recipes.mean_colour(RECIPE)).decompose == mean_colour_baseline.Config()


@pytest.mark.parametrize("name", recipes.ABLATIONS)
def test_every_ablation_runs_and_changes_the_asset(finished: tuple[Path, Asset], capture: Path, name: str) -> None:
    asset = pipeline.reconstruct(capture, recipe=recipes.ABLATIONS[name](RECIPE))
    changed, method = tree.named_tensors(asset), tree.named_tensors(finished[1])
    assert all(torch.isfinite(x).all() for x in changed.values())
    # The object is convex: no part of it lights another.
    if "indirect" not in name:
        assert any(not torch.equal(x, method[key]) for key, x in changed.items())


@pytest.mark.parametrize("name", ["recap-10", "svg-ir", "irgs"])
def test_every_baseline_runs_with_given_poses(capture: Path, name: str) -> None:
    """The poses do not change in stage 3."""
    loaded = folder.load(capture)
    asset = pipeline.reconstruct(loaded, recipe=recipes.METHODS[name](RECIPE))
    assert all(torch.isfinite(x).all() for x in tree.named_tensors(asset).values())
    assert asset.trajectory.light == "camera"
    assert loaded.trajectory is not None
    torch.testing.assert_close(asset.trajectory.T_cam_obj.xyz, loaded.trajectory.T_cam_obj.xyz)


@pytest.mark.parametrize("name", recipes.QUALITIES)
def test_every_quality_runs_scaled_down(capture: Path, tmp_path: Path, name: str) -> None:
    """Into a run directory, with given poses, which stay."""
    recipe = recipes.scaled(recipes.QUALITIES[name], 1 / 10_000)
    asset = pipeline.reconstruct(capture, tmp_path / "run", recipe)
    assert all(torch.isfinite(x).all() for x in tree.named_tensors(asset).values())
    given = folder.load(capture).trajectory
    assert given is not None
    torch.testing.assert_close(asset.trajectory.T_cam_obj.matrix(), given.T_cam_obj.matrix(), atol=1e-6, rtol=0)
