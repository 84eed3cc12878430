"""All measurements that need an NVIDIA GPU, in one command: tests, speed, and the scores of runs.

`python -m benchmarks.gpu [--capture CAPTURE] [--only PART...]` writes JSON and images into `$OUT`, or `build/gpu`. The
parts run in this order, and the result of each is written as soon as it ends:

    tests     the tests that are marked `gpu`
    kernels   milliseconds of each kernel: on the GPU, in plain torch on the GPU, and on the CPU
    draft     DRAFT on the bundled clip with its true poses, on the GPU and on the CPU: seconds, scores, difference
    profile   kernel launches, synchronisations and copies in one step of stages 2 and 3
    standard  STANDARD on `--capture` (default: the bundled clip): seconds, steps per second, memory, scores
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks import kernels
from tumble import backends, demo
from tumble.datasets import folder, save_capture
from tumble.engine import loop, run
from tumble.evaluation import align_views, predict_views, read_with_truth, score
from tumble.inverse_rendering import decompose, refine
from tumble.io import files, tree
from tumble.pipeline import reconstruct
from tumble.recipes import DRAFT, STANDARD, Recipe, known_poses
from tumble.scene import Asset, Capture, Truth

GPU = torch.device("cuda")
SIZES = [(10_000, 128), (10_000, 256), (10_000, 512), (100_000, 256), (100_000, 512), (100_000, 1024)]
"""Rasterization cases on a GPU: number of Gaussians, and image width [pixels]."""
WARMUP_STEPS = 20
"""Steps before the profile."""
PROFILED_STEPS = 10
"""Steps of the profile."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, help="capture of the STANDARD run, with known poses")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT") or "build/gpu"))
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit("torch finds no NVIDIA GPU on this machine; `tumble doctor` lists what it finds")
    arguments.out.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {"command": " ".join(["python -m benchmarks.gpu", *sys.argv[1:]]), "machine": machine()}
    failed = False
    for name in arguments.only:
        print(f"== {name}", flush=True)
        started = time.perf_counter()
        try:
            document[name] = PARTS[name](arguments)
        except Exception as error:
            traceback.print_exc()
            document[name] = {"failed": f"{type(error).__name__}: {error}"}
        failed |= "failed" in document[name]
        document[name]["wall_seconds"] = round(time.perf_counter() - started, 1)
        files.write_json(arguments.out / "gpu.json", document)
    print(json.dumps(document, indent=1))
    sys.exit(failed)


def machine() -> dict[str, Any]:
    """Hardware and versions that the figures depend on."""
    import warp

    return {
        "gpu": torch.cuda.get_device_name(),
        "cpu": f"{os.cpu_count()}-core {platform.machine()}",
        "torch": torch.__version__,
        "warp": warp.__version__,
    }


def tests(arguments: argparse.Namespace) -> dict[str, Any]:
    """Summary of pytest for the tests marked `gpu`; its output goes to tests.txt."""
    command = [sys.executable, "-m", "pytest", "-m", "gpu", "-q", "-p", "no:cacheprovider", "-rf", *GPU_TESTS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (arguments.out / "tests.txt").write_text(done.stdout + done.stderr, "utf-8")
    output = (done.stdout + done.stderr)[-3000:]
    print(output, flush=True)
    return {"summary": output.strip().splitlines()[-1]} | ({"failed": "tests"} if done.returncode else {})


GPU_TESTS = ("tests/backends/test_backends_cuda.py", "tests/backends/test_backends.py", "tests/test_pipeline.py")
"""Files with tests marked `gpu`: the others are not collected, since they import packages that may be missing there."""


def kernel_times(arguments: argparse.Namespace) -> dict[str, Any]:
    """The rows of `benchmarks.kernels` for three backends."""
    rows = kernels.measure(backends.load("cuda"), "cuda", 1, SIZES, device=GPU)
    # Plain torch stores every pair of a pixel and a nearby Gaussian, hence the single size.
    rows += kernels.rasterize_rows(backends.load("reference"), "reference", 1, [(10_000, 256)], runs=3, device=GPU)
    rows += kernels.image_loss_rows(backends.load("cuda"), "cuda", 1, device=GPU)
    threads = os.cpu_count() or 1
    rows += kernels.measure(backends.load("cpu"), "cpu", threads, SIZES)
    return {"rows": rows}


def draft(arguments: argparse.Namespace) -> dict[str, Any]:
    """The DRAFT run of the bundled clip on GPU and CPU, and the difference of their scores."""
    capture = posed_clip(arguments.out / "clip")
    rows = {name: measure_run(capture, arguments.out, DRAFT, device) for name, device in (("gpu", GPU), ("cpu", "cpu"))}
    differences = {key: round(rows["gpu"]["scores"][key] - value, 3) for key, value in rows["cpu"]["scores"].items()}
    return {**rows, "gpu_minus_cpu": differences}


def standard(arguments: argparse.Namespace) -> dict[str, Any]:
    """A STANDARD run on the GPU."""
    capture = arguments.capture or posed_clip(arguments.out / "clip")
    return {"gpu": measure_run(capture, arguments.out, STANDARD, GPU)}


def measure_run(path: Path, out: Path, recipe: Recipe, device: torch.device | str) -> dict[str, Any]:
    """A row of a run with known poses: seconds by stage, peak memory, scores; predicted images are written to `out`."""
    name = f"{path.name}-{recipe.refine.steps}-{torch.device(device).type}"
    torch.cuda.reset_peak_memory_stats()
    started = time.perf_counter()
    asset = reconstruct(path, out / "runs" / name, recipe, device=device)
    seconds = {r["name"]: r["seconds"] for r in run.log_records(out / "runs" / name) if r.get("event") == "done"}
    steps = recipe.decompose.steps if isinstance(recipe.decompose, decompose.Config) else 0
    row: dict[str, Any] = {
        "capture": path.name,
        "seconds": seconds,
        "run_seconds": round(time.perf_counter() - started, 1),
        "steps_per_second": {
            "refine": round(recipe.refine.steps / seconds["refine"], 1),
            "decompose": round(steps / seconds["decompose"], 1),
        },
        "gaussians": len(asset.gaussians),
        "peak_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }
    if torch.device(device).type == "cuda":
        row["peak_MiB_gpu"] = torch.cuda.max_memory_allocated() // 2**20
    started = time.perf_counter()
    row["scores"] = shared_scores(path, asset, out / name, recipe)
    row["score_seconds"] = round(time.perf_counter() - started, 1)
    tree.save(asset, out / f"{name}.safetensors")
    print(json.dumps(row), flush=True)
    return row


def shared_scores(path: Path, asset: Asset, out: Path, recipe: Recipe) -> dict[str, float]:
    """Scores of the evaluation views of region "shared", which are rendered on the GPU and written to `out`."""
    subject = read_with_truth(path)
    gpu_asset = tree.to(asset, GPU)
    capture, truth = tree.to(subject.capture, GPU), tree.to(subject.truth, GPU)
    alignment, _ = align_views(gpu_asset.trajectory, capture.names, capture, truth, known_poses=True)
    prediction = predict_views(recipe.relight, gpu_asset, capture, truth, alignment, names=capture.names)
    tree.to(prediction, "cpu").write(out)
    scores = score(out, subject, out)["regions"]["shared"]
    return {key: round(scores[key], 3) for key in SCORES if scores.get(key) is not None}


SCORES = ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb", "normal.mean_fg_degrees", "silhouette.iou")
"""Scores that are stored in a row."""


def profile(arguments: argparse.Namespace) -> dict[str, Any]:
    """Profiles of both stages: DRAFT on the bundled clip, and STANDARD on `--capture` if that is given."""
    cases = {"draft": (posed_clip(arguments.out / "clip"), DRAFT)}
    if arguments.capture:
        cases["standard"] = (arguments.capture, STANDARD)
    return {name: profile_stages(path, known_poses(recipe)) for name, (path, recipe) in cases.items()}


def profile_stages(path: Path, recipe: Recipe) -> dict[str, Any]:
    """Profile of a step of each stage."""
    capture = tree.to(folder.load(path), GPU)
    assert capture.trajectory is not None
    inputs = refine.Inputs(capture, capture.trajectory)
    state = state_after(refine, recipe.refine, inputs, WARMUP_STEPS)
    profiles = {"refine": profile_step(lambda: run_step(refine, recipe.refine, inputs, state))}
    inputs_3 = decompose.Inputs(capture, refine.finish(recipe.refine, inputs, state))
    state_3 = state_after(decompose, recipe.decompose, inputs_3, WARMUP_STEPS)
    return profiles | {"decompose": profile_step(lambda: run_step(decompose, recipe.decompose, inputs_3, state_3))}


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


def profile_step(step: Callable[[], None]) -> dict[str, Any]:
    """Figures per step: wall time, busy time of the GPU, driver calls, and the kernels with the longest times."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as torch_profile

    torch.cuda.synchronize()
    started = time.perf_counter()
    for _ in range(PROFILED_STEPS):
        step()
    torch.cuda.synchronize()
    wall = (time.perf_counter() - started) / PROFILED_STEPS
    with torch_profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as events:
        for _ in range(PROFILED_STEPS):
            step()
        torch.cuda.synchronize()
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


PARTS = {"tests": tests, "kernels": kernel_times, "draft": draft, "profile": profile, "standard": standard}


if __name__ == "__main__":
    main()
