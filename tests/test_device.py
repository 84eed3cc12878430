"""Steps and commands on another device than the CPU: on the one that `tests.simulated_gpu` simulates, and, as far as
they are marked `gpu`, on an NVIDIA GPU.
"""

import dataclasses
import importlib.util
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests import test_pipeline
from tests.inverse_rendering.test_refine import textured_sphere
from tests.simulated_gpu import DEVICE, WITH_WARP, SimulatedGpu, simulated_gpu
from tests.simulated_graph import SimulatedRecorder, simulated_graphs
from tumble import actions, backends, pipeline, recipes
from tumble.engine import graph, loop, optim
from tumble.engine import run as runs
from tumble.export import asset as export
from tumble.export.asset import Preset
from tumble.inverse_rendering import decompose, refine
from tumble.io import files, tree, video
from tumble.maths import SO3
from tumble.rendering import prefiltered_light
from tumble.report import page
from tumble.scene.asset import Asset
from tumble.scene.trajectory import Trajectory

RECIPE, capture, finished = test_pipeline.RECIPE, test_pipeline.capture, test_pipeline.finished
SMALL = Preset(triangles=200, texture=32, cells=16, views=4, pixels=32)
"""A mesh that is made in no time."""


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedGpu]:
    """The simulated device, as `--device cuda`."""

    def device(name: str) -> torch.device:
        return DEVICE if name == "cuda" else backends.usable_device(name)

    monkeypatch.setattr(actions, "usable_device", device)
    monkeypatch.setattr(actions, "TURNTABLE_FRAMES", 2)
    monkeypatch.setattr(actions, "TURNTABLE_SIDE", 32)
    monkeypatch.setattr(page, "MESH", SMALL)
    monkeypatch.setitem(export.PRESETS, "web", SMALL)
    with simulated_gpu() as simulated:
        yield simulated


@pytest.fixture(params=["simulated", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """The simulated device, and an NVIDIA GPU if there is one."""
    if request.param == "cuda":
        gpu = torch.device("cuda")
        if reason := backends.load("cuda").ready(gpu, torch.float32):
            pytest.skip(reason)
        yield gpu
        return
    with simulated_gpu():
        yield DEVICE


def on_device(inputs: Any, device: torch.device = DEVICE) -> Any:
    """The inputs of a stage, on a device."""
    return type(inputs)(*(tree.to(x, device) for x in vars(inputs).values()))


def in_one_part(stage: Any, **others: Any) -> Any:
    """The stage without the parts of its step, which is therefore never recorded; with other functions, if given."""
    names = ("VERSION", "Config", "length", "init", "blank", "step", "finish")
    return SimpleNamespace(**{name: getattr(stage, name) for name in names if hasattr(stage, name)} | others)


def steps(stage: Any, cfg: Any, inputs: Any, n: int) -> tuple[Any, list[dict[str, float]]]:
    """The output of a stage after `n` steps, and the terms of each."""
    state, seen = stage.init(cfg, inputs, torch.Generator().manual_seed(0)), []
    for _ in range(n):
        seen.append({name: float(value) for name, value in stage.step(cfg, inputs, state).items()})
        state.step += 1
    return stage.finish(cfg, inputs, state), seen


@pytest.fixture(scope="module")
def stages() -> list[tuple[Any, Any, Any, list[dict[str, float]]]]:
    """Stages 2 and 3 of a textured sphere: the module, its settings and inputs, and the terms of two steps."""
    _, true, taken = textured_sphere()
    second = refine.Inputs(taken, Trajectory(true, "camera"))
    # No hull: whether a cell belongs to it may depend on rounding, and then every later draw.
    cfg_2 = dataclasses.replace(recipes.known_poses(RECIPE).refine, points=200, start="sphere")
    refined, of_second = steps(refine, cfg_2, second, 2)
    third = decompose.Inputs(taken, refined)
    cfg_3 = dataclasses.replace(recipes.known_poses(RECIPE).decompose, warmup=1, try_matte=False)
    _, of_third = steps(decompose, cfg_3, third, 2)
    return [(refine, cfg_2, second, of_second), (decompose, cfg_3, third, of_third)]


each_stage = pytest.mark.parametrize("number", [0, 1], ids=["refine", "decompose"])


@each_stage
def test_steps_on_a_device_are_those_of_the_cpu(number: int, stages: list[Any], device: torch.device) -> None:
    stage, cfg, inputs, here = stages[number]
    output, there = steps(stage, cfg, on_device(inputs, device), 2)
    # Sums in another order, and what Adam makes of their rounding.
    for a, b in zip(here, there, strict=True):
        assert b == pytest.approx(a, rel=2e-3, abs=1e-5)
    assert {x.device.type for x in tree.named_tensors(output).values()} == {device.type}


@each_stage
def test_a_stage_on_a_device_goes_on_from_its_checkpoint(
    number: int, stages: list[Any], device: torch.device, tmp_path: Path
) -> None:
    """As if it had not been interrupted, on average; Adam turns rounding of gradients near zero into whole steps."""
    stage, cfg, inputs, _ = stages[number]
    cfg, inputs = dataclasses.replace(cfg, steps=3), on_device(inputs, device)
    made = []

    def stopped(cfg: Any, inputs: Any, state: Any) -> dict[str, Any]:
        made.append(state.step)
        if len(made) == 3:
            raise InterruptedError
        return stage.step(cfg, inputs, state)

    stopping = in_one_part(stage, step=stopped)
    checkpoint = tmp_path / "state.safetensors"
    whole = loop.drive(stage, cfg, inputs, seed=1)
    with pytest.raises(InterruptedError):
        loop.drive(stopping, cfg, inputs, seed=1, checkpoint=checkpoint, every=2)
    resumed = loop.drive(stopping, cfg, inputs, seed=1, checkpoint=checkpoint, every=2)
    assert made == [0, 1, 2, 2]
    for (name, a), b in zip(tree.named_tensors(whole).items(), tree.named_tensors(resumed).values(), strict=True):
        assert a.device.type == b.device.type == device.type
        difference = (b.double() - a.double()).abs().mean()
        assert difference <= 1e-3 * a.double().abs().mean() + 1e-6, name


@pytest.mark.gpu
def test_steps_on_a_gpu_run_ahead_of_it(stages: list[Any]) -> None:
    """The tests of the simulated device count the same."""
    gpu = torch.device("cuda")
    if reason := backends.load("cuda").ready(gpu, torch.float32):
        pytest.skip(reason)
    for stage, cfg, inputs, _ in stages:
        inputs = on_device(inputs, gpu)
        state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
        for _ in range(3):  # the first steps fill caches, and the host looks at the lengths of lists
            stage.step(cfg, inputs, state)
            state.step += 1
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                stage.step(cfg, inputs, state)
            finally:
                torch.cuda.set_sync_debug_mode("default")
        assert not [f"{w.filename}:{w.lineno}" for w in caught if "called a synchronizing" in str(w.message)]


@each_stage
def test_steps_with_the_kernels_for_a_gpu_are_those_of_the_cpu(
    number: int, stages: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernels in Warp run on the CPU here."""
    if importlib.util.find_spec("warp") is None:
        pytest.skip("needs NVIDIA Warp: pip install 'tumble[cuda]'")
    monkeypatch.setattr(backends, "choose", lambda device, dtype: backends.load("cuda"))
    stage, cfg, inputs, here = stages[number]
    for a, b in zip(here, steps(stage, cfg, inputs, 2)[1], strict=True):
        assert b == pytest.approx(a, rel=2e-3, abs=1e-5)


def test_steps_never_wait_for_the_device_copy_nothing_to_it_and_ask_it_for_little(gpu: SimulatedGpu) -> None:
    """Steps with everything that the recipes switch on; in plain torch they are ten times as many operations."""
    if not WITH_WARP:
        pytest.skip("needs NVIDIA Warp: pip install 'tumble[cuda]'")
    _, true, taken = textured_sphere()
    inputs = on_device(refine.Inputs(taken, Trajectory(true, "camera")))
    recipe = recipes.known_poses(recipes.DRAFT)
    cfg = dataclasses.replace(recipe.refine, points=200, shadow_start=0.0)
    state = refine.init(cfg, inputs, torch.Generator().manual_seed(0))

    def recorded(stage: Any, cfg: Any, inputs: Any, state: Any) -> int:
        for _ in range(3):  # the first steps fill caches, and the host looks at the lengths of lists
            stage.step(cfg, inputs, state)
            state.step += 1
        forget()
        stage.step(cfg, inputs, state)
        assert ([x.split()[-1] for x in gpu.waits], [x.split()[-1] for x in gpu.copies]) == ([], [])
        usual = gpu.operations.total()
        # The same with the numbers of the step on the device, as it is recorded for a graph.
        numbers = stage.prepare(cfg, inputs, state)
        forget()
        numbers = graph.Replayed(stage, SimulatedRecorder()).sent(numbers, state.optimizer)
        assert ([x.split()[-1] for x in gpu.waits], [x.split()[-1] for x in gpu.copies]) == ([], ["sent"])
        forget()
        with backends.as_recording():
            stage.advance(cfg, inputs, state, numbers)
        assert ([x.split()[-1] for x in gpu.waits], [x.split()[-1] for x in gpu.copies]) == ([], [])
        assert gpu.operations.total() <= usual + 12
        state.optimizer.rates = None
        return usual

    def forget() -> None:
        for seen in (gpu.waits, gpu.copies, gpu.operations):
            seen.clear()

    assert recorded(refine, cfg, inputs, state) <= 100
    third = decompose.Inputs(inputs.capture, refine.finish(cfg, inputs, state))
    cfg = dataclasses.replace(recipe.decompose, try_matte=False, warmup=0)
    state = decompose.init(cfg, third, torch.Generator().manual_seed(0))
    assert recorded(decompose, cfg, third, state) <= 155
    cfg = dataclasses.replace(cfg, rows=2 * prefiltered_light.ROWS)
    recorded(decompose, cfg, third, decompose.init(cfg, third, torch.Generator().manual_seed(0)))


def changing(number: int, stages: list[Any], monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any, Any]:
    """A stage with settings by which everything that a recording depends on changes within 40 steps."""
    stage, cfg, inputs, _ = stages[number]
    if stage is refine:
        growth = dataclasses.replace(cfg.densification, refine_every=10, refine_stop=0.7)
        more = {"realignments": 1, "shadow_start": 0.2, "ramp": 0.0, "densification": growth}
        return stage, dataclasses.replace(cfg, steps=40, **more), inputs
    monkeypatch.setattr(decompose, "DISPLACEMENT_CHECK_EVERY", 10)
    monkeypatch.setattr(decompose, "MAX_DISPLACEMENT", -1.0)
    return stage, dataclasses.replace(cfg, steps=40, warmup=15, doublings=1), inputs


@each_stage
def test_replayed_steps_are_those_that_nobody_recorded(
    number: int, stages: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit: Gaussians are split, poses aligned, shadows traced and the light doubled between the recordings."""
    stage, cfg, inputs = changing(number, stages, monkeypatch)
    with simulated_graphs() as recorder:
        usual = loop.drive(in_one_part(stage), cfg, inputs, seed=1)
        replayed = loop.drive(stage, cfg, inputs, seed=1)
    test_pipeline.assert_same(usual, replayed)
    assert recorder.sent == 40
    # A recording after three usual steps; a fourth one is the first of all, and the first that moves the Gaussians.
    assert (len(recorder.tapes), recorder.replays) == ((4, 40 - 4 * 3 - 1), (4, 40 - 4 * 3 - 2))[number]


OTHERS: list[tuple[int, dict[str, Any]]] = [
    (0, {"rates": {"poses": 1e-3}}),
    (0, {"rates": {"poses": 1e-3}, "pose_model": "network", "mask_loss": "entropy"}),
    (0, {"colour": "sh", "crease": 1.0}),
    (1, {"rates": {"poses": 1e-3}, "pose_model": "network", "corners": False}),
    (1, {"lobes": "sum", "bounce": "average"}),
    (1, {"visibility": False, "smooth_light": "radiance", "rows": 64}),
]
"""Settings of other parts of the steps, by stage."""


@pytest.mark.parametrize(("number", "settings"), OTHERS)
def test_replayed_steps_of_other_settings_are_those_that_nobody_recorded(
    number: int, settings: dict[str, Any], stages: list[Any]
) -> None:
    """Bit for bit, also under a light that turns."""
    stage, cfg, inputs, _ = stages[number]
    rates = dataclasses.replace(cfg.rates, **settings.get("rates", {}))
    cfg = dataclasses.replace(cfg, **settings | {"steps": 8, "rates": rates})
    cfg = dataclasses.replace(cfg, **({"ramp": 0.0} if stage is refine else {"warmup": 0, "doublings": 0}))
    if stage is refine:
        turns = SO3.exp(0.1 * torch.arange(12.0).view(4, 3)).matrix()
        inputs = dataclasses.replace(inputs, trajectory=dataclasses.replace(inputs.trajectory, light_turns=turns))
    with simulated_graphs() as recorder:
        usual = loop.drive(in_one_part(stage), cfg, inputs, seed=1)
        test_pipeline.assert_same(usual, loop.drive(stage, cfg, inputs, seed=1))
    assert recorder.replays >= 3


def test_trials_of_stage_3_are_replayed(stages: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit; the third of 24 steps in every trial."""
    stage, cfg, inputs, _ = stages[1]
    cfg = dataclasses.replace(cfg, steps=24, try_matte=True)
    with simulated_graphs() as recorder:
        replayed = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
        assert recorder.replays >= 3 * 4
        monkeypatch.setattr(graph, "WARMUP", cfg.steps)
        never = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    test_pipeline.assert_same(never.params, replayed.params)


def test_replayed_steps_with_rising_weights_are_usual_ones_with_their_numbers_on_the_device(
    stages: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit; without a graph a weight is multiplied within the kernel, which rounds in another place."""
    stage, cfg, inputs = changing(0, stages, monkeypatch)
    cfg = dataclasses.replace(cfg, ramp=0.8)
    with simulated_graphs() as recorder:
        replayed = loop.drive(stage, cfg, inputs, seed=1)
        assert recorder.replays > 20
        monkeypatch.setattr(graph, "WARMUP", cfg.steps)
        never = loop.drive(stage, cfg, inputs, seed=1)
        assert recorder.sent == 80
    test_pipeline.assert_same(never, replayed)


@pytest.mark.gpu
@each_stage
def test_replayed_steps_on_a_gpu_are_those_that_nobody_recorded(
    number: int, stages: list[Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Sums on a GPU have no order, and Adam turns rounding of gradients near zero into whole steps."""
    gpu = torch.device("cuda")
    if reason := backends.load("cuda").ready(gpu, torch.float32):
        pytest.skip(reason)
    stage, cfg, inputs = changing(number, stages, monkeypatch)
    advance = stage.advance

    def copying(cfg: Any, inputs: Any, state: Any, numbers: Any) -> Any:
        terms = advance(cfg, inputs, state, numbers)
        if backends.recording():
            torch.ones(3).to(gpu)  # from memory that is not pinned
        return terms

    def last(stage: Any) -> dict[str, float]:
        seen: list[loop.Progress] = []
        loop.drive(stage, cfg, on_device(inputs, gpu), seed=1, report=seen.append)
        return seen[-1].metrics

    usual = last(in_one_part(stage))
    assert last(stage) == pytest.approx(usual, rel=0.1, abs=1e-3)
    assert not caplog.messages
    monkeypatch.setattr(stage, "advance", copying)
    assert last(stage) == pytest.approx(usual, rel=0.1, abs=1e-3)
    assert "steps are not replayed as a CUDA graph" in caplog.text


def test_a_gradient_on_a_device_that_is_not_finite_changes_nothing_and_is_named_later(gpu: SimulatedGpu) -> None:
    x = optim.leaves({"x": torch.ones(3), "y": torch.ones(2)})
    x = optim.leaves(tree.to(x, DEVICE))
    optimizer = optim.adam(x, {"": 0.1})
    optim.descend(x["x"].sum() + x["y"].sum(), optimizer, step=0)
    before = x["x"].tolist()
    assert before == pytest.approx([0.9] * 3)
    optim.descend((x["x"] - x["x"].detach()).sqrt().sum() + x["y"].sum(), optimizer, step=1)
    optim.descend(x["x"].sum() + x["y"].sum(), optimizer, step=2)
    assert x["x"].tolist() == before
    state = loop.State(3, x, optimizer, torch.Generator())
    with pytest.raises(optim.NotFinite, match="in one of the last 50 steps is not finite at step 3"):
        loop._check(state, None)
    with pytest.raises(optim.NotFinite, match="the gradient of x is not finite at step 49"):
        optim.descend((x["x"] - x["x"].detach()).sqrt().sum(), optimizer, step=49)


def test_relit_images_and_videos_are_those_of_the_cpu(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, gpu: SimulatedGpu
) -> None:
    light = capture / "truth" / "lights" / "sun.hdr"
    for fast in (False, True):
        here, there = (
            actions.relight_run(finished[0], light, tmp_path / f"{device}-{fast}", fast=fast, device=device)
            for device in ("cpu", "cuda")
        )
        for path in here.glob("*.png"):
            a, b = (files.read_image(folder / path.name).astype(int) for folder in (here, there))
            assert np.abs(a - b).max() <= 1
    clip = actions.relight_turntable(finished[0], light, tmp_path / "turn.mp4", fast=True, device="cuda")
    assert len(list(video.read_clip(clip))) == 2


def test_scores_are_those_of_the_cpu(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, gpu: SimulatedGpu
) -> None:
    here, there = (
        actions.evaluate_run(finished[0], capture, tmp_path / name, device=name)["regions"]["shared"]
        for name in ("cpu", "cuda")
    )
    assert there == pytest.approx(here, rel=1e-4)


def test_scores_of_a_run_with_estimated_poses_are_those_of_the_cpu(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, gpu: SimulatedGpu
) -> None:
    """Its object frame is aligned with that of the truth, and its report compares the poses."""
    run = shutil.copytree(finished[0], tmp_path / "run")
    (run / runs.TRACK).mkdir()
    here, there = (actions.evaluate_run(run, capture, tmp_path / name, device=name) for name in ("cpu", "cuda"))
    assert "first the rotation" in there["notes"][0]
    assert there["regions"]["shared"] == pytest.approx(here["regions"]["shared"], rel=1e-3)
    assert page.write_report(run, capture=capture, device=DEVICE).is_file()


def test_exported_files_are_those_of_the_cpu(finished: tuple[Path, Asset], tmp_path: Path, gpu: SimulatedGpu) -> None:
    here, there = (
        actions.export_run(finished[0], tmp_path / name, "splat", None, device=name) for name in ("cpu", "cuda")
    )
    assert {path.name for path in here.iterdir()} == {path.name for path in there.iterdir()}
    for path in (*here.glob("*.json"), *here.glob("*.ply")):
        if path.name != "export.json":
            assert path.read_bytes() == (there / path.name).read_bytes(), path.name
    mesh = actions.export_run(finished[0], tmp_path / "mesh", "web", None, device="cuda")
    assert (mesh / "asset.glb").is_file()


def test_the_key_of_a_stage_names_the_kind_of_device(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, gpu: SimulatedGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stage that was finished on the CPU is run again on a device, and starts from its first step."""

    def stop(*_: Any) -> None:
        raise InterruptedError

    monkeypatch.setattr(refine, "step", stop)
    run = shutil.copytree(finished[0], tmp_path / "run")
    pipeline.reconstruct(capture, run, RECIPE)
    with pytest.raises(InterruptedError):
        pipeline.reconstruct(capture, run, RECIPE, device=DEVICE)


@pytest.mark.slow
def test_a_run_with_its_report_is_made_on_a_device(
    finished: tuple[Path, Asset], capture: Path, tmp_path: Path, gpu: SimulatedGpu
) -> None:
    asset = pipeline.reconstruct(capture, tmp_path / "run", RECIPE, device=DEVICE)
    assert len(asset.gaussians) == pytest.approx(len(finished[1].gaussians), rel=0.1)
    assert page.write_report(tmp_path / "run", capture=capture, device=DEVICE).is_file()


def test_auto_is_the_cpu_unless_a_gpu_and_its_kernels_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends.load("cuda"), "ready", lambda device, dtype: "")
    assert backends.usable_device("auto") == torch.device("cuda")
    monkeypatch.setattr(backends.load("cuda"), "ready", lambda device, dtype: "no driver")
    assert backends.usable_device("auto") == torch.device("cpu")
