"""Everything that wants an NVIDIA GPU, in one command: what is right there, how fast, and how good a run comes out.

`make gpu` (or `python -m benchmarks.gpu [--capture CAPTURE] [--only PART...]`) writes JSON and pictures into `$OUT`, or
`build/gpu`. Its parts, in order, each kept as soon as it is there:

    tests     the tests that are marked `gpu`
    kernels   milliseconds of each kernel: the GPU's, plain torch on the same GPU, and the CPU's
    draft     DRAFT on the bundled clip with its true poses, on the GPU and on the CPU: seconds, scores, difference
    profile   launches, waits for the device and copies in one step of stages 2 and 3
    standard  STANDARD on `--capture` (the bundled clip without one): seconds, steps per second, memory, scores
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
from tumble.evaluation import align_views, predict_views, read_subject, score
from tumble.inverse_rendering import decompose, refine
from tumble.io import files, tree
from tumble.pipeline import reconstruct
from tumble.recipes import DRAFT, STANDARD, Recipe, known_poses
from tumble.scene import Asset, Capture, Truth

GPU = torch.device("cuda")
SIZES = [(10_000, 128), (10_000, 256), (10_000, 512), (100_000, 256), (100_000, 512), (100_000, 1024)]
"""Gaussians and pixels across, on a GPU."""
WARM, PROFILED = 20, 10
"""Steps before the profile, and in it."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, help="of the STANDARD run; with known poses")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT") or "build/gpu"))
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit("torch sees no NVIDIA GPU here; tumble doctor says what it sees")
    arguments.out.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {"command": " ".join(["python -m benchmarks.gpu", *sys.argv[1:]]), "machine": machine()}
    failed = False
    for name in arguments.only:
        print(f"== {name}", flush=True)
        begun = time.perf_counter()
        try:
            document[name] = PARTS[name](arguments)
        except Exception as error:
            traceback.print_exc()
            document[name] = {"failed": f"{type(error).__name__}: {error}"}
        failed |= "failed" in document[name]
        document[name]["wall_seconds"] = round(time.perf_counter() - begun, 1)
        files.write_json(arguments.out / "gpu.json", document)
    print(json.dumps(document, indent=1))
    sys.exit(failed)


def machine() -> dict[str, Any]:
    """What a number depends on."""
    import warp

    return {
        "gpu": torch.cuda.get_device_name(),
        "cpu": f"{os.cpu_count()}-core {platform.machine()}",
        "torch": torch.__version__,
        "warp": warp.__version__,
    }


def tests(arguments: argparse.Namespace) -> dict[str, Any]:
    """What pytest says of the tests marked `gpu`."""
    command = [sys.executable, "-m", "pytest", "-m", "gpu", "-q", "-p", "no:cacheprovider", "-rf", *GPU_TESTS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (arguments.out / "tests.txt").write_text(done.stdout + done.stderr, "utf-8")
    said = (done.stdout + done.stderr)[-3000:]
    print(said, flush=True)
    return {"summary": said.strip().splitlines()[-1]} | ({"failed": "tests"} if done.returncode else {})


GPU_TESTS = ("tests/test_backends_cuda.py", "tests/test_backends.py", "tests/test_reconstruct.py")
"""Files with tests marked `gpu`, so that nothing else has to be importable there."""


def kernel_times(arguments: argparse.Namespace) -> dict[str, Any]:
    """The rows of `benchmarks.kernels` for three renderers."""
    rows = kernels.measure(backends.load("cuda"), "cuda", 1, SIZES, device=GPU)
    # Plain torch holds every pair of a pixel and a Gaussian nearby.
    rows += kernels.rasterizing(backends.load("reference"), "reference", 1, [(10_000, 256)], runs=3, device=GPU)
    rows += kernels.comparing(1, device=GPU)
    threads = os.cpu_count() or 1
    rows += kernels.measure(backends.load("cpu"), "cpu", threads, SIZES)
    return {"rows": rows}


def draft(arguments: argparse.Namespace) -> dict[str, Any]:
    """One capture, one recipe, two devices."""
    capture = posed_clip(arguments.out / "clip")
    rows = {name: measured(capture, arguments.out, DRAFT, device) for name, device in (("gpu", GPU), ("cpu", "cpu"))}
    differences = {key: round(rows["gpu"]["scores"][key] - value, 3) for key, value in rows["cpu"]["scores"].items()}
    return {**rows, "gpu_minus_cpu": differences}


def standard(arguments: argparse.Namespace) -> dict[str, Any]:
    """A full-scale run."""
    capture = arguments.capture or posed_clip(arguments.out / "clip")
    return {"gpu": measured(capture, arguments.out, STANDARD, GPU)}


def measured(path: Path, out: Path, recipe: Recipe, device: torch.device | str) -> dict[str, Any]:
    """A run with known poses: seconds by stage, peak memory, scores, and a sheet of pictures."""
    name = f"{path.name}-{recipe.refine.steps}-{torch.device(device).type}"
    torch.cuda.reset_peak_memory_stats()
    begun = time.perf_counter()
    asset = reconstruct(path, out / "runs" / name, recipe, device=device)
    seconds = {r["name"]: r["seconds"] for r in run.records(out / "runs" / name) if r.get("event") == "done"}
    steps = recipe.decompose.steps if isinstance(recipe.decompose, decompose.Config) else 0
    row: dict[str, Any] = {
        "capture": path.name,
        "seconds": seconds,
        "run_seconds": round(time.perf_counter() - begun, 1),
        "steps_per_second": {
            "refine": round(recipe.refine.steps / seconds["refine"], 1),
            "decompose": round(steps / seconds["decompose"], 1),
        },
        "gaussians": len(asset.gaussians),
        "peak_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }
    if torch.device(device).type == "cuda":
        row["peak_MiB_gpu"] = torch.cuda.max_memory_allocated() // 2**20
    begun = time.perf_counter()
    row["scores"] = scored(path, asset, out / name, recipe)
    row["score_seconds"] = round(time.perf_counter() - begun, 1)
    tree.save(asset, out / f"{name}.safetensors")
    print(json.dumps(row), flush=True)
    return row


def scored(path: Path, asset: Asset, where: Path, recipe: Recipe) -> dict[str, float]:
    """Scores of the views of region shared; pictures are drawn on the GPU."""
    known = read_subject(path)
    there = tree.to(asset, GPU)
    capture, truth = tree.to(known.capture, GPU), tree.to(known.truth, GPU)
    alignment, _ = align_views(there.trajectory, capture.names, capture, truth, given=True)
    answer = predict_views(recipe.relight, there, capture, truth, alignment, names=capture.names)
    tree.to(answer, "cpu").write(where)
    scores = score(where, known, where)["regions"]["shared"]
    return {key: round(scores[key], 3) for key in SCORES if scores.get(key) is not None}


SCORES = ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb", "normal.mean_fg_degrees", "silhouette.iou")


def profile(arguments: argparse.Namespace) -> dict[str, Any]:
    """Of both stages, at DRAFT's size and at `--capture`'s under STANDARD."""
    cases = {"draft": (posed_clip(arguments.out / "clip"), DRAFT)}
    if arguments.capture:
        cases["standard"] = (arguments.capture, STANDARD)
    return {name: profiled(path, known_poses(recipe)) for name, (path, recipe) in cases.items()}


def profiled(path: Path, recipe: Recipe) -> dict[str, Any]:
    """Launches, waits and milliseconds of a step of each stage."""
    capture = tree.to(folder.load(path), GPU)
    assert capture.trajectory is not None
    inputs = refine.Inputs(capture, capture.trajectory)
    state = stepped(refine, recipe.refine, inputs, WARM)
    found = {"refine": counted(lambda: one_step(refine, recipe.refine, inputs, state))}
    later = decompose.Inputs(capture, refine.finish(recipe.refine, inputs, state))
    after = stepped(decompose, recipe.decompose, later, WARM)
    return found | {"decompose": counted(lambda: one_step(decompose, recipe.decompose, later, after))}


def stepped(stage: Any, cfg: Any, inputs: Any, n: int) -> loop.State:
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    for _ in range(n):
        one_step(stage, cfg, inputs, state)
    return state


def one_step(stage: Any, cfg: Any, inputs: Any, state: loop.State) -> None:
    stage.step(cfg, inputs, state)
    state.step += 1


def counted(step: Callable[[], None]) -> dict[str, Any]:
    """Per step: wall time, busy time of the device, calls of the driver, and the kernels that take longest."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as recording

    torch.cuda.synchronize()
    begun = time.perf_counter()
    for _ in range(PROFILED):
        step()
    torch.cuda.synchronize()
    wall = (time.perf_counter() - begun) / PROFILED
    with recording(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
        for _ in range(PROFILED):
            step()
        torch.cuda.synchronize()
    calls, busy = Counter[str](), Counter[str]()
    for event in seen.key_averages():
        if event.key.startswith("cuda"):
            calls[event.key] += event.count
        busy[event.key] += event.self_device_time_total
    longest = {key[:60]: round(us / 1e3 / PROFILED, 3) for key, us in busy.most_common(14) if us}
    operations = sum(event.count for event in seen.key_averages() if event.key.startswith("aten::"))
    return {
        "ms": round(wall * 1e3, 2),
        "device_busy_ms": round(sum(busy.values()) / 1e3 / PROFILED, 2),
        "operations": round(operations / PROFILED),
        "driver_calls": {key: round(n / PROFILED, 1) for key, n in calls.most_common()},
        "longest_ms": longest,
    }


def posed_clip(out: Path) -> Path:
    """The bundled clip as a capture with its true poses."""
    if not (out / folder.TRANSFORMS).exists():
        bare = demo.unpack(out.with_name("bare"))
        capture, truth = folder.load(bare), folder.load_truth(bare)
        assert truth is not None
        save_capture(out, with_poses(capture, truth), truth, setting="handheld")
    return out


def with_poses(capture: Capture, truth: Truth) -> Capture:
    return replace(capture, trajectory=truth.poses)


PARTS = {"tests": tests, "kernels": kernel_times, "draft": draft, "profile": profile, "standard": standard}


if __name__ == "__main__":
    main()
