"""All measurements that need an NVIDIA GPU, in one command of at most nine minutes: tests, speed, scores and memory.

`make gpu`, which is `python -m benchmarks.gpu [--capture CAPTURE...] [--quality NAME...] [--scale FACTOR]
[--only PART...]`, writes `gpu.json`, images and the output of the tests into `$OUT`, or `build/gpu`. It needs no
network, only the packages on Python's path: those of the package, its extra `cuda`, and pytest;
`python -m benchmarks.requirements` names the missing ones. The parts run in this order:

    tests     the tests that are marked `gpu`
    kernels   milliseconds of each kernel: on the GPU, in plain torch on the GPU, and on the CPU
    draft     DRAFT on the bundled clip with its true poses, on the GPU and on the CPU: seconds, scores, difference
    profile   kernel launches, synchronisations and copies in one step of stages 2 and 3
    standard  STANDARD on the bundled clip with 200 frames of 512 x 512: seconds, memory, scores; with `--capture`,
              the recipes `--quality` (draft and standard) on each of those captures, in as many times its limit, with
              `--scale` at a fraction of their computation (`recipes.scaled`)
    graphs    milliseconds of a step of stages 2 and 3 with and without a CUDA graph

Each part is a process of its own with a limit of time. A part that fails, or is stopped at its limit, is marked in
`gpu.json` beside what it measured until then, and the next part runs. `--dry` runs everything on the CPU with tiny
settings, to test this command on a machine without a GPU; its figures mean nothing.
"""

import argparse
import contextlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import torch

from benchmarks import kernels
from tumble import backends, demo
from tumble.datasets import folder, save_capture
from tumble.engine import graph, loop, run
from tumble.evaluation import align_views, predict_views, read_with_truth, score
from tumble.inverse_rendering import decompose, refine
from tumble.io import files, tree
from tumble.pipeline import reconstruct
from tumble.recipes import DRAFT, QUALITIES, SMOKE, STANDARD, Recipe, known_poses, scaled
from tumble.scene import Asset, Capture, Truth

SIZES = [(10_000, 128), (10_000, 256), (10_000, 512), (100_000, 256), (100_000, 512), (100_000, 1024)]
"""Rasterization cases on a GPU: number of Gaussians, and image width [pixels]."""
LIMITS = {"tests": 120.0, "kernels": 50.0, "draft": 120.0, "profile": 30.0, "standard": 180.0, "graphs": 20.0}
"""Time of each part, without what earlier parts leave of theirs [s]."""
GRACE = 20.0
"""Time in which a stopped part writes its results before it is killed [s]."""
MAX_DIFFERENCE = 0.2
"""Difference of the PSNR of the DRAFT runs on GPU and CPU above which the part fails [dB]."""
STANDARD_FRAMES, STANDARD_SIDE = 200, 512
"""Number of frames and side of the images [pixels] of the STANDARD run on the bundled clip."""
WARMUP_STEPS = 20
"""Steps before the profile."""
PROFILED_STEPS = 10
"""Steps of the profile."""
TIMED_STEPS = 50
"""Steps that are timed with and without a CUDA graph."""

Row = dict[str, Any]
"""Results of a part, which the part fills in as it goes on."""


@dataclass(frozen=True)
class Plan:
    """What the parts measure."""

    out: Path
    """Folder of all results."""
    captures: tuple[Path, ...]
    """Captures of the STANDARD runs; none for the bundled clip."""
    dry: bool
    """Whether everything runs on the CPU with tiny settings."""

    qualities: tuple[str, ...] = ("draft", "standard")
    """Recipes for `captures`."""
    scale: float = 1.0
    """Fraction of the computation of `qualities`."""

    @property
    def device(self) -> torch.device:
        """The GPU, or what takes its place."""
        return torch.device("cpu" if self.dry else "cuda")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, nargs="+", default=(), help="captures to run, with known poses")
    parser.add_argument("--quality", nargs="+", choices=QUALITIES, default=Plan.qualities, help="recipes for them")
    parser.add_argument("--scale", type=float, default=Plan.scale, help="fraction of these recipes' computation")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT") or "build/gpu"))
    parser.add_argument("--dry", action="store_true", help="on the CPU with tiny settings, to test the command")
    parser.add_argument("--here", action="store_true", help="run the only part in this process, without a limit")
    arguments = parser.parse_args()
    if not (arguments.dry or torch.cuda.is_available()):
        sys.exit("torch finds no NVIDIA GPU on this machine; `tumble doctor` lists what it finds")
    plan = Plan(arguments.out, tuple(arguments.capture), arguments.dry, tuple(arguments.quality), arguments.scale)
    plan.out.mkdir(parents=True, exist_ok=True)
    if arguments.here:
        sys.exit(not run_part(plan, arguments.only[0]))
    document: Row = {"command": " ".join(["python -m benchmarks.gpu", *sys.argv[1:]]), "machine": machine()}
    limits = LIMITS | {"standard": LIMITS["standard"] * max(1, len(plan.captures))}
    end = time.perf_counter() + sum(limits[name] for name in arguments.only)
    for number, name in enumerate(arguments.only):
        later = sum(limits[other] for other in arguments.only[number + 1 :])
        document[name] = result_of_process(plan, name, end - time.perf_counter() - later)
        files.write_json(plan.out / "gpu.json", document)
    print(json.dumps(document, indent=1))
    failed = {name: document[name]["failed"] for name in arguments.only if "failed" in document[name]}
    sys.exit("\n".join(f"{name} failed: {reason}" for name, reason in failed.items()) or 0)


def result_of_process(plan: Plan, name: str, limit: float) -> Row:
    """Result of a part that runs in a process of its own for at most `limit` seconds."""
    print(f"== {name}, at most {limit:.0f} s", flush=True)
    file, started = plan.out / f"{name}.json", time.perf_counter()
    file.unlink(missing_ok=True)
    command = [sys.executable, "-m", "benchmarks.gpu", "--here", "--only", name, "--out", str(plan.out)]
    command += ["--dry"] * plan.dry + ["--quality", *plan.qualities, "--scale", str(plan.scale)]
    command += ["--capture", *map(str, plan.captures)] if plan.captures else []
    # As `tumble` does: threads that spin while they wait delay those of the backward pass by milliseconds.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}
    process = subprocess.Popen(command, start_new_session=True, env=environment)
    in_time = False
    try:
        process.wait(limit)
        in_time = True
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    row: Row = files.read_json(file, Row) if file.is_file() else {"failed": f"exit status {process.returncode}"}
    if not in_time:
        row["failed"] = f"stopped at its limit of {limit:.0f} s"
    return row | {"wall_seconds": round(time.perf_counter() - started, 1)}


def run_part(plan: Plan, name: str) -> bool:
    """Run a part and write its results, also if it fails or is stopped; returns whether it succeeded."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    row: Row = {}
    try:
        PARTS[name](plan, row)
    except (Exception, KeyboardInterrupt) as error:
        traceback.print_exc()
        row["failed"] = f"{type(error).__name__}: {error}"
    files.write_json(plan.out / f"{name}.json", row)
    return "failed" not in row


def machine() -> Row:
    """Hardware and versions that the figures depend on."""
    return {
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cpu": f"{os.cpu_count()}-core {platform.machine()}",
        "torch": torch.__version__,
        "warp": importlib.metadata.version("warp-lang") if importlib.util.find_spec("warp") else None,
    }


def tests(plan: Plan, row: Row) -> None:
    """Summary of pytest for the tests marked `gpu`; its output goes to tests.txt."""
    # Without conftest.py, which checks shapes by packages that may be missing there.
    options = ["-m", "gpu", "-v", "-rfs", "--noconftest", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *options, *GPU_TESTS]
    with (plan.out / "tests.txt").open("w", encoding="utf-8") as output:
        done = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, check=False)
    lines = (plan.out / "tests.txt").read_text("utf-8").strip().splitlines()
    print("\n".join(lines[-20:]), flush=True)
    row["summary"] = lines[-1] if lines else ""
    if done.returncode:
        row["failed"] = f"pytest ended with status {done.returncode}"
    elif " passed" not in row["summary"] and not plan.dry:
        row["failed"] = "every test was skipped; see tests.txt"


GPU_TESTS = ("tests/backends/test_backends_cuda.py", "tests/test_device.py", "tests/test_pipeline.py")
"""Files with tests marked `gpu`: the others are not collected, since they import packages that may be missing there."""


def kernel_times(plan: Plan, row: Row) -> None:
    """The rows of `benchmarks.kernels` for three backends."""
    fast = "cpu" if plan.dry else "cuda"
    sizes = [(1000, 64)] if plan.dry else SIZES
    where: Row = {"device": plan.device}
    rows = row["rows"] = kernels.measure(backends.load(fast), fast, 1, sizes, **where)
    rows += kernels.step_rows(backends.load(fast), fast, 1, **where)
    # Plain torch stores every pair of a pixel and a nearby Gaussian, hence the single size.
    reference = backends.load("reference")
    one = [(1000, 64)] if plan.dry else [(10_000, 256)]
    rows += kernels.rasterize_rows(reference, "reference", 1, one, runs=3, **where)
    rows += kernels.shade_rows(reference, "reference", 1, **where)
    threads = os.cpu_count() or 1
    rows += kernels.measure(backends.load("cpu"), "cpu", threads, sizes)
    rows += kernels.step_rows(backends.load("cpu"), "cpu", threads)


def draft(plan: Plan, row: Row) -> None:
    """The DRAFT run of the bundled clip on GPU and CPU, and the difference of their scores."""
    clip = posed_clip(plan.out / "clip")
    for name, device in (("gpu", plan.device), ("cpu", torch.device("cpu"))):
        row[name] = {}
        measure_run(row[name], folder.load(clip), clip, plan.out / f"draft-{name}", draft_recipe(plan), device)
    scores = row["gpu"]["scores"], row["cpu"]["scores"]
    row["gpu_minus_cpu"] = {key: round(scores[0][key] - value, 3) for key, value in scores[1].items()}
    worst = max(abs(value) for key, value in row["gpu_minus_cpu"].items() if "psnr" in key)
    if worst > MAX_DIFFERENCE:
        row["failed"] = f"scores on GPU and CPU differ by {worst} dB"


def draft_recipe(plan: Plan) -> Recipe:
    """DRAFT, or SMOKE in a dry run."""
    return SMOKE if plan.dry else DRAFT


def standard(plan: Plan, row: Row) -> None:
    """Runs of the captures on the GPU, or STANDARD on the bundled clip."""
    for path in plan.captures:
        for name in plan.qualities:
            rows, recipe = row.setdefault(path.name, {}), SMOKE if plan.dry else scaled(QUALITIES[name], plan.scale)
            out = plan.out / f"{path.name}-{name}"
            measure_run(rows.setdefault(name, {}), folder.load(path), path, out, recipe, plan.device)
    if not plan.captures:
        clip, (frames, side) = posed_clip(plan.out / "clip"), (12, 96) if plan.dry else (STANDARD_FRAMES, STANDARD_SIDE)
        capture = enlarged(folder.load(clip), frames, side)
        measure_run(row, capture, clip, plan.out / "standard", SMOKE if plan.dry else STANDARD, plan.device)


def enlarged(capture: Capture, n: int, side: int) -> Capture:
    """A capture with `n` frames, the first again after the last, and with square images of another size.

    Repeated frames cost as much time and memory as others.
    """
    index = [i % len(capture) for i in range(n)]
    images = [cv2.resize(x.numpy(), (side, side), interpolation=cv2.INTER_CUBIC) for x in capture.images[:n]]
    masks = [cv2.resize(x.numpy(), (side, side), interpolation=cv2.INTER_NEAREST) for x in capture.masks[:n]]
    assert capture.trajectory is not None
    return replace(
        capture,
        images=torch.stack([torch.from_numpy(images[i]) for i in index]),
        masks=torch.stack([torch.from_numpy(masks[i]) for i in index]),
        camera=capture.camera.resized(side, side),
        names=tuple(f"{number:04}.png" for number in range(n)),
        trajectory=capture.trajectory.select(index),
    )


def measure_run(row: Row, capture: Capture, subject: Path, out: Path, recipe: Recipe, device: torch.device) -> None:
    """Seconds by stage, peak memory and scores of a run with known poses; the run and its images are written to `out`.

    Args:
        row: Filled in.
        capture: What is reconstructed.
        subject: Capture with ground truth of the same object and poses, for the scores.
    """
    on_gpu = device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    row |= {"frames": len(capture), "size": list(capture.images.shape[1:3])}
    shutil.rmtree(out, ignore_errors=True)  # a finished run would not run again
    started = time.perf_counter()
    try:
        asset = reconstruct(capture, out / "run", recipe, device=device)
    finally:
        row["run_seconds"] = round(time.perf_counter() - started, 1)
        row["stages"] = stages(out / "run")
        row["peak_MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        if on_gpu:
            row["peak_MiB_gpu"] = torch.cuda.max_memory_allocated() // 2**20
            row["peak_MiB_gpu_reserved"] = torch.cuda.max_memory_reserved() // 2**20
    row["gaussians"] = len(asset.gaussians)
    started = time.perf_counter()
    row["scores"] = shared_scores(subject, asset, out / "prediction", recipe, device)
    row["score_seconds"] = round(time.perf_counter() - started, 1)
    print(json.dumps(row), flush=True)


def stages(path: Path) -> dict[str, Row]:
    """Steps, seconds and steps per second of every stage of a run so far, by name, from its log."""
    rows: dict[str, Row] = {}
    for record in run.log_records(path):
        if "step" in record:
            steps, seconds = record["step"], record["seconds"]
            rows[record["name"]] = {"steps": steps, "of": record["of"], "seconds": seconds}
            rows[record["name"]]["steps_per_second"] = round(steps / max(seconds, 1e-3), 1)
        elif record.get("event") == "done" and record["name"] in rows:
            rows[record["name"]]["seconds_with_output"] = record["seconds"]
    return rows


def shared_scores(path: Path, asset: Asset, out: Path, recipe: Recipe, device: torch.device) -> dict[str, float]:
    """Scores of the evaluation views of region "shared", which are rendered on the device and written to `out`."""
    subject = read_with_truth(path)
    known = subject.capture
    assert known.trajectory is not None
    moved = tree.to(replace(asset, trajectory=known.trajectory, camera=known.camera), device)
    capture, truth = tree.to(known, device), tree.to(subject.truth, device)
    alignment, _ = align_views(moved.trajectory, capture.names, capture, truth, known_poses=True)
    prediction = predict_views(recipe.relight, moved, capture, truth, alignment, names=capture.names)
    tree.to(prediction, "cpu").write(out)
    scores = score(out, subject, out)["regions"]["shared"]
    return {key: round(scores[key], 3) for key in SCORES if scores.get(key) is not None}


SCORES = ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb", "normal.mean_fg_degrees", "silhouette.iou")
"""Scores that are stored in a row."""


def profile(plan: Plan, row: Row) -> None:
    """Profiles of both stages: DRAFT on the bundled clip, and STANDARD on the first of `--capture`."""
    cases = {"draft": (posed_clip(plan.out / "clip"), draft_recipe(plan))}
    if plan.captures:
        cases["standard"] = (plan.captures[0], STANDARD)
    for name, (path, recipe) in cases.items():
        row[name] = profile_stages(path, known_poses(recipe), plan.device)


def graphs(plan: Plan, row: Row) -> None:
    """Milliseconds of a step of DRAFT on the bundled clip, by stage; `replayed` is that with a CUDA graph."""
    recipe = known_poses(draft_recipe(plan))
    capture = tree.to(folder.load(posed_clip(plan.out / "clip")), plan.device)
    assert capture.trajectory is not None
    inputs = refine.Inputs(capture, capture.trajectory)
    state = time_steps(plan, row, refine, recipe.refine, inputs)
    third = decompose.Inputs(capture, refine.finish(recipe.refine, inputs, state))
    time_steps(plan, row, decompose, untried(recipe), third)


def time_steps(plan: Plan, row: Row, stage: Any, cfg: Any, inputs: Any) -> loop.State:
    """Fill in the times of a stage's steps; returns its state after those that were launched one by one."""
    wait = (lambda: None) if plan.dry else torch.cuda.synchronize
    times = row[stage.__name__.rpartition(".")[2]] = {}

    def timed(step: Callable[[], None], n: int) -> float:
        wait()
        started = time.perf_counter()
        for _ in range(n):
            step()
        wait()
        return round((time.perf_counter() - started) / n * 1e3, 3)

    state = state_after(stage, cfg, inputs, WARMUP_STEPS)
    times["usual"] = timed(lambda: run_step(stage, cfg, inputs, state), TIMED_STEPS)
    if not plan.dry:
        other = state_after(stage, cfg, inputs, WARMUP_STEPS)
        with graph.steps(stage, cfg, inputs, other) as step:
            replayed = SimpleNamespace(step=step)
            times["until_replayed"] = timed(lambda: run_step(replayed, cfg, inputs, other), graph.WARMUP + 1)
            times["replayed"] = timed(lambda: run_step(replayed, cfg, inputs, other), TIMED_STEPS)
    return state


def profile_stages(path: Path, recipe: Recipe, device: torch.device) -> Row:
    """Profile of a step of each stage."""
    capture = tree.to(folder.load(path), device)
    assert capture.trajectory is not None
    inputs = refine.Inputs(capture, capture.trajectory)
    state = state_after(refine, recipe.refine, inputs, WARMUP_STEPS)
    profiles = {"refine": profile_step(lambda: run_step(refine, recipe.refine, inputs, state))}
    inputs_3 = decompose.Inputs(capture, refine.finish(recipe.refine, inputs, state))
    cfg_3 = untried(recipe)
    state_3 = state_after(decompose, cfg_3, inputs_3, WARMUP_STEPS)
    return profiles | {"decompose": profile_step(lambda: run_step(decompose, cfg_3, inputs_3, state_3))}


def untried(recipe: Recipe) -> Any:
    """Settings of stage 3 without its trials, which take the first steps of stage 2 for metal, whose step is longer."""
    return replace(recipe.decompose, try_matte=False)


def state_after(stage: Any, cfg: Any, inputs: Any, n: int) -> loop.State:
    """The state of a stage after `n` steps."""
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    for _ in range(n):
        run_step(stage, cfg, inputs, state)
    return state


def run_step(stage: Any, cfg: Any, inputs: Any, state: loop.State) -> None:
    """Advance the state of a stage by a step."""
    stage.step(cfg, inputs, state)
    state.step += 1


def profile_step(step: Callable[[], None]) -> Row:
    """Figures per step: wall time, busy time of the GPU, driver calls, and the kernels with the longest times."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as torch_profile

    on_gpu = torch.cuda.is_available()
    wait = torch.cuda.synchronize if on_gpu else (lambda: None)
    wait()
    started = time.perf_counter()
    for _ in range(PROFILED_STEPS):
        step()
    wait()
    wall = (time.perf_counter() - started) / PROFILED_STEPS
    with torch_profile(activities=[ProfilerActivity.CPU, *[ProfilerActivity.CUDA] * on_gpu]) as events:
        for _ in range(PROFILED_STEPS):
            step()
        wait()
    calls, busy = Counter[str](), Counter[str]()
    for event in events.key_averages():
        if event.key.startswith("cuda"):
            calls[event.key] += event.count
        busy[event.key] += event.self_device_time_total
    longest = {key[:60]: round(us / 1e3 / PROFILED_STEPS, 3) for key, us in busy.most_common(14) if us}
    operations = sum(event.count for event in events.key_averages() if event.key.startswith("aten::"))
    return {
        "ms": round(wall * 1e3, 2),
        "device_busy_ms": round(sum(busy.values()) / 1e3 / PROFILED_STEPS, 2),
        "operations": round(operations / PROFILED_STEPS),
        "driver_calls": {key: round(n / PROFILED_STEPS, 1) for key, n in calls.most_common()},
        "longest_ms": longest,
    }


def posed_clip(out: Path) -> Path:
    """The folder of the bundled clip as a capture with its true poses, written if it does not exist."""
    if not (out / folder.TRANSFORMS).exists():
        unposed = demo.unpack(out.with_name("bare"))
        capture, truth = folder.load(unposed), folder.load_truth(unposed)
        assert truth is not None
        save_capture(out, with_true_poses(capture, truth), truth, setting="handheld")
    return out


def with_true_poses(capture: Capture, truth: Truth) -> Capture:
    """The capture with the poses of the ground truth."""
    return replace(capture, trajectory=truth.poses)


PARTS: dict[str, Callable[[Plan, Row], None]] = {
    "tests": tests,
    "kernels": kernel_times,
    "draft": draft,
    "profile": profile,
    "standard": standard,
    "graphs": graphs,
}
"""The parts, by name and in their order."""


if __name__ == "__main__":
    main()
