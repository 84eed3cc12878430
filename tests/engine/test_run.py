"""Run directories: finished stages are kept, differing settings are errors, and results do not depend on interrupts."""

import errno
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.engine import test_loop as toy
from tests.engine.test_loop import full_disk, press_ctrl_c
from tumble.datasets import _capture_folder
from tumble.datasets import folder as datasets_folder
from tumble.engine import run
from tumble.io import files
from tumble.io.files import BadFile
from tumble.maths.se3 import SE3
from tumble.preprocess import footage
from tumble.scene.camera import Camera
from tumble.scene.capture import Capture, content_key
from tumble.scene.trajectory import Trajectory


@dataclass(frozen=True)
class Recipe:
    first: toy.Config = field(default_factory=toy.Config)
    second: toy.Config = field(default_factory=lambda: toy.Config(steps=12))
    until: float = float("inf")
    seed: int = 0


Steps = list[int]
"""Steps that were made."""


def counting_inputs(steps: Steps, events: dict[int, Callable[..., Any]] | None = None) -> toy.Inputs:
    at = {n: lambda state, n=n: steps.append(n) for n in range(100)}
    return toy.Inputs(at=at | (events or {}))


def pipeline(path: Path, recipe: Recipe, steps: Steps, **events: dict[int, Callable[..., Any]]) -> Any:
    """Two stages, the second of which reads the first's output."""
    opened = run.open(path, Path("clip"), recipe)
    first, own = run.stage(opened, "1-first", toy, recipe.first, counting_inputs(steps, events.get("first")), ["clip"])
    target = first.params.points.mean(0)
    inputs = replace(counting_inputs(steps, events.get("second")), target=target)
    return run.stage(opened, "2-second", toy, recipe.second, inputs, [own])[0]


# Stages ---------------------------------------------------------------------------------------------------------------


def test_a_finished_stage_is_not_run_again_and_its_output_is_loaded(tmp_path: Path) -> None:
    steps: Steps = []
    once = pipeline(tmp_path / "run", Recipe(), steps)
    assert len(steps) == 30 + 12
    again = pipeline(tmp_path / "run", Recipe(), steps)
    assert len(steps) == 30 + 12
    assert toy.bits(again) == toy.bits(once)
    made = sorted(str(p.relative_to(tmp_path / "run")) for p in (tmp_path / "run").rglob("*") if p.is_file())
    stages = [f"{name}/{file}" for name in ("1-first", "2-second") for file in ("out.safetensors", "stage.json")]
    assert made == sorted([*stages, "log.jsonl", "recipe.json"])


@pytest.mark.parametrize("stage", ["first", "second"])
def test_a_resumed_pipeline_equals_an_uninterrupted_one_bit_for_bit(tmp_path: Path, stage: str) -> None:
    whole = pipeline(tmp_path / "whole", Recipe(), [])
    with pytest.raises(KeyboardInterrupt, match=f"{stage} stopped at step 8 of .*; run the same command again"):
        pipeline(tmp_path / "run", Recipe(), [], **{stage: {7: press_ctrl_c}})
    steps: Steps = []
    assert toy.bits(pipeline(tmp_path / "run", Recipe(), steps)) == toy.bits(whole)
    assert len(steps) == (42 - 8 if stage == "first" else 12 - 8)
    same = ("1-first/stage.json", "2-second/stage.json")
    assert all((tmp_path / "whole" / x).read_text() == (tmp_path / "run" / x).read_text() for x in same)
    # The time of a stage includes that of interrupted processes.
    records = [record for record in run.log_records(tmp_path / "run") if record.get("name") == stage]
    last, done = (next(x for x in reversed(records) if key in x) for key in ("step", "event"))
    assert done["seconds"] >= last["seconds"]


def test_every_stage_has_its_own_seed(tmp_path: Path) -> None:
    seeds = [run.stage_seed(seed, name) for seed in (0, 1) for name in ("refine", "decompose")]
    assert len(set(seeds)) == 4
    one, other = (pipeline(tmp_path / str(seed), Recipe(seed=seed), []) for seed in (0, 1))
    assert toy.bits(one) != toy.bits(other)


def test_the_key_depends_on_everything_that_affects_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = ("refine", toy, toy.Config(), ["capture"])
    variants = [
        ("decompose", *usual[1:]),
        ("refine", toy, toy.Config(rate=0.1), ["capture"]),
        ("refine", toy, toy.Config(), ["another"]),
        ("refine", toy, toy.Config(), ["capture", "poses"]),
    ]
    keys = [run.key(*usual), *(run.key(*variant) for variant in variants)]
    for name, value in (("VERSION", 2), ("NOISE", 0.2)):
        with monkeypatch.context() as patch:
            patch.setattr(toy, name, value)
            keys.append(run.key(*usual))
    assert len(set(keys)) == len(keys)
    assert run.key(*usual) == keys[0]


def test_a_stage_with_changed_inputs_is_run_again(tmp_path: Path) -> None:
    opened, steps = run.open(tmp_path / "run", Path("clip"), Recipe()), []
    for keys in (["a"], ["b"], ["b"]):
        run.stage(opened, "1-first", toy, toy.Config(), counting_inputs(steps), keys)
    assert len(steps) == 60


def test_a_stage_with_another_seed_is_run_again(tmp_path: Path) -> None:
    steps: Steps = []
    for seed in (0, 1, 1):
        opened = run.Run(tmp_path, Recipe(seed=seed))
        run.stage(opened, "1-first", toy, toy.Config(), counting_inputs(steps), ["a"])
    assert len(steps) == 60


def test_a_stored_output_is_loaded_to_the_device_of_the_inputs() -> None:
    on_meta = toy.Inputs(target=torch.zeros(2, device="meta"))
    assert run._device((Recipe(), (on_meta, make_capture()))).type == "meta"
    assert run._device(()).type == "cpu"


def test_a_stored_key_always_matches_the_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A crash between writing the two files of a stage, followed by a run with the old settings."""
    opened, steps = run.open(tmp_path / "run", Path("clip"), Recipe()), []
    inputs = counting_inputs(steps)
    once = run.stage(opened, "1-first", toy, toy.Config(), inputs, ["a"])[0]
    monkeypatch.setattr(files, "write_json", lambda *_: (_ for _ in ()).throw(RuntimeError("power cut")))
    with pytest.raises(RuntimeError, match="power cut"):
        run.stage(opened, "1-first", toy, toy.Config(rate=0.2), inputs, ["a"])
    monkeypatch.undo()
    again = run.stage(opened, "1-first", toy, toy.Config(), inputs, ["a"])[0]
    assert len(steps) == 90
    assert toy.bits(again) == toy.bits(once)


def test_a_full_disk_is_an_error_and_finished_stages_are_kept(tmp_path: Path) -> None:
    steps: Steps = []
    whole = pipeline(tmp_path / "whole", Recipe(), [])
    path = tmp_path / "run"
    with pytest.raises(RuntimeError, match="power cut"):
        pipeline(path, Recipe(), steps, second={0: toy.crash})
    assert len(steps) == 30
    with full_disk(3000), pytest.raises(OSError, match=r"2-second/state\.safetensors: cannot be written"):
        pipeline(path, Recipe(), steps)
    assert not list(path.rglob("*partial*"))
    assert len(steps) == 30 + 12
    assert toy.bits(pipeline(path, Recipe(), steps)) == toy.bits(whole)
    assert len(steps) == 30 + 24, "the finished stage must be kept"


def test_an_output_that_does_not_fit_on_the_disk_leaves_no_file(tmp_path: Path) -> None:
    class Big(toy.Previewed):
        @staticmethod
        def finish(cfg: toy.Config, inputs: toy.Inputs, state: toy.State) -> toy.Output:
            return toy.Output(toy.finish(cfg, inputs, state).params, {"big": torch.zeros(100_000)})

    opened, steps = run.open(tmp_path / "run", Path("clip"), Recipe()), []
    inputs = counting_inputs(steps)
    with full_disk(100_000), pytest.raises(OSError, match=r"out\.safetensors: cannot be written"):
        run.stage(opened, "1-big", Big, toy.Config(), inputs, [])
    names = sorted(p.name for p in (tmp_path / "run" / "1-big").iterdir())
    assert names == ["preview.png", "state.safetensors"]
    run.stage(opened, "1-big", Big, toy.Config(), inputs, [])
    assert len(steps) == 30, "training must not be repeated"


def test_stages_without_steps_work_and_stages_without_an_output_class_are_rejected(tmp_path: Path) -> None:
    class WithoutAnnotation(toy.Previewed):
        @staticmethod
        def finish(cfg: toy.Config, inputs: toy.Inputs, state: toy.State):
            return toy.finish(cfg, inputs, state)

    opened = run.open(tmp_path / "run", Path("clip"), Recipe())
    output = run.stage(opened, "1-none", toy, toy.Config(steps=0), toy.Inputs(), [])[0]
    assert output.params.points.shape == (6, 2)
    with pytest.raises(TypeError, match="return annotation"):
        run.stage(opened, "2-bare", WithoutAnnotation, toy.Config(), toy.Inputs(), [])


def test_the_log_has_one_json_document_per_line(tmp_path: Path) -> None:
    pipeline(tmp_path / "run", Recipe(), [])
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert all("time" in line for line in lines)
    assert [(x["name"], x["event"]) for x in lines if "event" in x] == [
        (name, event) for name in ("first", "second") for event in ("start", "done")
    ]
    last = next(x for x in lines if x.get("step") == 30)
    assert last["metrics"].keys() == {"loss", "points"}


# The folder -----------------------------------------------------------------------------------------------------------


def test_the_recipe_is_saved_and_the_same_recipe_continues_the_run(tmp_path: Path) -> None:
    for _ in range(2):
        opened = run.open(tmp_path / "runs" / "mug", tmp_path / "clip.mp4", Recipe())
        assert opened.recipe == Recipe()
    document = files.read_json(tmp_path / "runs" / "mug" / "recipe.json")
    assert document["recipe"]["second"]["steps"] == 12
    assert document["capture"]["path"] == str(tmp_path / "clip.mp4")


def test_another_recipe_is_rejected_with_the_differences(tmp_path: Path) -> None:
    run.open(tmp_path, Path("clip"), Recipe())
    write_result(tmp_path)
    other = Recipe(second=toy.Config(steps=13), seed=5)
    with pytest.raises(
        BadFile,
        match=r"second\.steps is 12 in the folder, 13 was requested; recipe\.seed is 0 in the folder, 5 was requested",
    ):
        run.open(tmp_path, Path("clip"), other)


def test_a_run_without_results_accepts_another_recipe(tmp_path: Path) -> None:
    run.open(tmp_path, Path("clip"), Recipe(seed=5))
    run.open(tmp_path, Path("clip"), Recipe())
    write_result(tmp_path)
    run.open(tmp_path, Path("clip"), Recipe())
    with pytest.raises(BadFile, match=r"recipe\.seed is 0 in the folder, 5 was requested"):
        run.open(tmp_path, Path("clip"), Recipe(seed=5))


def write_result(path: Path) -> None:
    """Write a checkpoint, as a stage does."""
    files.write_atomically(path / "1-first" / run.CHECKPOINT, lambda partial: partial.write_bytes(b"a state"))


def test_captures_are_compared_by_content_if_known_else_by_path(tmp_path: Path) -> None:
    run.open(tmp_path / "a", Path("clip"), Recipe(), content="key")
    write_result(tmp_path / "a")
    run.open(tmp_path / "a", Path("moved"), Recipe(), content="key")
    with pytest.raises(BadFile, match=r"capture\.content is 'key' in the folder, 'other' was requested"):
        run.open(tmp_path / "a", Path("clip"), Recipe(), content="other")
    assert run.capture_source(tmp_path / "a") == Path("moved").resolve()
    run.open(tmp_path / "a", Path("moved"), Recipe())
    with pytest.raises(BadFile, match=r"capture\.path is '.*moved' in the folder, '.*clip' was requested"):
        run.open(tmp_path / "a", Path("clip"), Recipe())


def test_a_capture_in_the_run_moves_with_it(tmp_path: Path) -> None:
    (tmp_path / "a" / run.CAPTURE).mkdir(parents=True)
    run.open(tmp_path / "a", tmp_path / "a" / run.CAPTURE, Recipe(), content="key")
    (tmp_path / "a").rename(tmp_path / "b")
    assert run.capture_source(tmp_path / "b") == tmp_path / "b" / run.CAPTURE


def test_folders_of_something_else_are_not_changed(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").write_bytes(b"cat")
    with pytest.raises(BadFile, match="exists and is not a run directory"):
        run.open(tmp_path / "photos", Path("clip"), Recipe())
    with pytest.raises(BadFile, match="is a file"):
        run.open(tmp_path / "photos" / "cat.png", Path("clip"), Recipe())
    with pytest.raises(BadFile, match="exists and is not a run directory"), run.exclusive_access(tmp_path / "photos"):
        raise AssertionError("the folder must not be opened")
    (tmp_path / "photos" / "recipe.json").write_text('{"eggs": 3}')
    with pytest.raises(BadFile, match="is not the recipe of a run"):
        run.open(tmp_path / "photos", Path("clip"), Recipe())
    assert sorted(p.name for p in (tmp_path / "photos").iterdir()) == ["cat.png", "recipe.json"]


def test_a_read_only_folder_is_an_error_with_the_fix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(tempfile, "mkstemp", refuse)
    with pytest.raises(OSError, match=r"recipe\.json: cannot be written: Read-only file system \(choose a folder") as e:
        run.open(tmp_path / "run", Path("clip"), Recipe())
    assert e.value.errno == errno.EROFS


def test_a_finished_run_can_be_read_from_a_read_only_file_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    once = pipeline(tmp_path / "run", Recipe(), [])

    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    for module, name in ((tempfile, "mkstemp"), (run, "log"), (Path, "mkdir"), (Path, "unlink")):
        monkeypatch.setattr(module, name, refuse)
    assert toy.bits(pipeline(tmp_path / "run", Recipe(), [])) == toy.bits(once)


# Keys of captures -----------------------------------------------------------------------------------------------------


def make_capture() -> Capture:
    torch.manual_seed(0)
    images, masks = torch.randint(0, 255, (2, 6, 8, 3)).to(torch.uint8), torch.full((2, 6, 8), 255, dtype=torch.uint8)
    poses = Trajectory(SE3.exp(torch.randn(2, 6)), "camera")
    return Capture(images, masks, Camera.from_fov(0.5, 6, 8), ("0.png", "1.png"), "camera", poses)


def changed(x: Tensor) -> Tensor:
    y = x.clone()
    y.view(-1)[3] = y.view(-1)[3] + 1
    return y


def test_the_key_of_a_capture_depends_on_every_field() -> None:
    capture = make_capture()
    poses, camera = capture.trajectory, capture.camera
    assert poses is not None
    variants = [
        capture,
        replace(capture, images=changed(capture.images)),
        replace(capture, masks=changed(capture.masks)),
        replace(capture, camera=replace(camera, fx_fy_cx_cy=changed(camera.fx_fy_cx_cy))),
        replace(capture, trajectory=None),
        replace(
            capture, trajectory=replace(poses, T_cam_obj=replace(poses.T_cam_obj, xyz=changed(poses.T_cam_obj.xyz)))
        ),
        replace(capture, light="object", trajectory=replace(poses, light="object")),
        replace(capture, names=("0.png", "2.png")),
        replace(capture, focal_assumed=True),
    ]
    keys = [content_key(variant) for variant in variants]
    assert len(set(keys)) == len(keys)
    assert content_key(make_capture()) == keys[0]


def test_the_key_of_a_capture_does_not_depend_on_ground_truth(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(1, 255, (6, 8, 3), dtype=np.uint8)
    pose = np.eye(4)
    pose[2, 3] = 4.0
    mask = np.full((6, 8, 1), 255, np.uint8)
    mask[0] = 0
    for n in range(2):
        files.write_png(tmp_path / "images" / f"{n}.png", pixels)
        files.write_png(tmp_path / "masks" / f"{n}.png", mask)
    files.write_exr(tmp_path / "truth" / "albedo" / "1.exr", np.full((6, 8, 3), 0.5, np.float32))
    frames = [
        _capture_folder.training_frame("0.png", pose.tolist()),
        _capture_folder.evaluation_frame("1.png", pose.tolist(), "shared", maps=("albedo",), lights=()),
    ]
    document = _capture_folder.capture_document(
        Camera.from_fov(0.5, 6, 8), "camera", frames, setting="handheld", with_light=False
    )
    files.write_json(tmp_path / "transforms.json", document)
    before = content_key(datasets_folder.load(tmp_path))
    shutil.rmtree(tmp_path / "truth")
    assert content_key(datasets_folder.load(tmp_path)) == before
    files.write_png(tmp_path / "images" / "1.png", 255 - pixels)
    assert content_key(datasets_folder.load(tmp_path)) == before, "evaluation views belong to the ground truth"
    files.write_png(tmp_path / "images" / "0.png", 255 - pixels)
    assert content_key(datasets_folder.load(tmp_path)) != before


def test_records_of_the_log_with_values_of_the_wrong_type_are_left_out(tmp_path: Path) -> None:
    """A run may come from somebody else, and readers of the log compute with its numbers."""
    good = [
        {"name": "refine", "event": "start"},
        {"name": "refine", "step": 1, "of": 2, "seconds": 1.5, "eta": 1, "metrics": {"render": 0.5, "psnr": None}},
    ]
    bad = [
        *({"name": wrong} for wrong in (1, None, ["refine"])),
        *({"name": "refine", key: "x"} for key in ("seconds", "step", "of", "eta", "metrics")),
        {"name": "refine", "metrics": {"render": "<script>"}},
        {"name": "refine", "event": 3},
        {"name": "refine \ud800", "event": "start"},
        ["refine"],
    ]
    lines = [json.dumps(record) for record in [*bad, *good, *bad]]
    (tmp_path / run.LOG).write_text("\n".join([*lines, "[" * 100_000, f'{{"step": {"9" * 5000}}}']))
    assert run.log_records(tmp_path) == good


def test_of_a_log_of_any_size_the_end_is_read(tmp_path: Path) -> None:
    """A log may come from somebody else, and be larger than the memory; here a sparse file of 8 GiB."""
    record = {"name": "refine", "event": "start"}
    with (tmp_path / run.LOG).open("wb") as file:
        file.write(json.dumps({"name": "first"}).encode())
        file.seek(8 << 30)
        file.write(f"\n{json.dumps(record)}\n".encode())
    assert run.log_records(tmp_path) == [record]
    (tmp_path / run.LOG).unlink()
    (tmp_path / run.LOG).mkdir()
    assert run.log_records(tmp_path) == []


@pytest.mark.parametrize("content", [b"", b"[]", b'{"capture": "x", "a": 1, "frames": 3', b'{"frames": 3, "key": []}'])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        (run.RECIPE, run.recipe),
        (run.RECIPE, lambda path: run.open(path, path, Recipe())),
        (run.POSES, run.frame_names),
        (f"1-first/{run.DONE}", lambda path: pipeline(path, Recipe(), [])),
        (footage.PROVENANCE, footage.read_provenance),
    ],
)
def test_a_damaged_document_of_a_run_is_named_with_the_fix(
    tmp_path: Path, name: str, read: Callable[[Path], object], content: bytes
) -> None:
    path = tmp_path / "run"
    pipeline(path, Recipe(), [])
    (path / name).write_bytes(content)
    if name.endswith(run.DONE) and content.endswith(b"}"):
        read(path)  # another key: the stage runs again
        return
    with pytest.raises(BadFile, match=rf"{name}: .* \((give|repeat|remove) .*\)$"):
        read(path)
