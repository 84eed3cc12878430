"""Time of the parts of stages 2 and 3, and scores over time.

`python -m benchmarks.speed CAPTURE... [--threads N]` reconstructs captures with ground truth and known poses with the
DRAFT recipe, and scores the views of region "shared" every few seconds with the clock stopped. It writes
`benchmarks/speed.json` and `benchmarks/speed.md`.

Image: PSNR of the stage's own rendering of the evaluation views over the foreground [dB, sRGB]; only in stage 2.
Albedo: foreground PSNR after the scale per channel [dB, sRGB].
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.kernels import machine
from benchmarks.swap import albedo_psnr
from tumble.datasets import folder
from tumble.engine import State, optim
from tumble.evaluation import metrics
from tumble.inverse_rendering import decompose, refine
from tumble.io import files
from tumble.maths import srgb_from_linear
from tumble.recipes import DRAFT, known_poses
from tumble.rendering import rasterize
from tumble.scene import Capture, Truth

INTERVAL = 10.0
"""Time between two measurements of the scores [s]."""
PARTS = {
    "refine": {
        "rendering": (refine, "render"),
        "losses": (refine, "_terms"),
        "densifying": (refine, "_densify"),
        "visibility": (refine, "_trace_visibility"),
        "backward pass and Adam": (optim, "descend"),
    },
    "decompose": {
        "visibility": (decompose, "_trace_visibility"),
        "rendering": (decompose, "rasterize_material"),
        "shading": (decompose, "_render_term"),
        "backward pass and Adam": (optim, "descend"),
    },
}


class Clock:
    """Stopwatch that is paused while scores are measured, and times parts of the work; a part that runs inside another
    one counts as the outer one."""

    def __init__(self) -> None:
        self.begun, self.paused, self.inside, self.parts = (
            time.perf_counter(),
            0.0,
            False,
            defaultdict[str, float](float),
        )

    def now(self) -> float:
        """Time since the start without pauses [s]."""
        return time.perf_counter() - self.begun - self.paused

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Pause the clock."""
        started = time.perf_counter()
        yield
        self.paused += time.perf_counter() - started

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time added to the part `name`."""

        def call(*args: Any, **keywords: Any) -> Any:
            if self.inside:
                return function(*args, **keywords)
            self.inside, started = True, time.perf_counter()
            try:
                return function(*args, **keywords)
            finally:
                self.inside = False
                self.parts[name] += time.perf_counter() - started

        return call


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    rows = []
    for path in arguments.captures:
        rows.append({"capture": path.name, "threads": arguments.threads, **measure(path)})
        command = "python -m benchmarks.speed CAPTURE... [--threads N]"
        files.write_json(arguments.out, {"command": command, "machine": machine(), "rows": rows})
        text = report(command, rows)
        files.write_atomically(arguments.out.with_suffix(".md"), lambda partial, text=text: partial.write_text(text))
        print(report(command, rows[-1:]), flush=True)


def measure(path: Path) -> dict[str, Any]:
    """Both stages of a capture: seconds by part, and scores over time."""
    capture, truth = folder.load(path), folder.load_truth(path)
    assert truth is not None, "the capture needs ground truth"
    assert capture.trajectory is not None, "the capture needs known poses"
    inputs, clock, curve = refine.Inputs(capture, capture.trajectory), Clock(), []
    cfg = known_poses(DRAFT).refine
    refined, seconds = _run_stage(refine, cfg, inputs, clock, curve, lambda s: _refine_scores(s, capture, truth))
    parts = {"refine": _part_seconds(clock, seconds)}
    inputs = decompose.Inputs(capture, refined)
    _, total = _run_stage(
        decompose,
        DRAFT.decompose,
        inputs,
        clock,
        curve,
        lambda s: _decompose_scores(decompose.absorbed(s.params), capture, truth),
    )
    parts["decompose"] = _part_seconds(clock, total - seconds)
    return {
        "seconds": {"refine": round(seconds, 1), "decompose": round(total - seconds, 1)},
        "parts": parts,
        "curve": curve,
    }


def _run_stage(
    stage: Any,
    cfg: Any,
    inputs: Any,
    clock: Clock,
    curve: list[dict[str, Any]],
    scores: Callable[[Any], dict[str, float]],
) -> tuple[Any, float]:
    """Run a stage and append its scores to `curve`; its output, and the time at its end [s]."""
    name = stage.__name__.rsplit(".", 1)[-1]

    def measure_scores(state: Any) -> None:
        with clock.stopped(), torch.no_grad():
            curve.append({"stage": name, "seconds": round(clock.now(), 1), "step": state.step, **scores(state)})

    clock.parts.clear()
    with ExitStack() as patches:
        for part, (module, attribute) in PARTS[name].items():
            patches.enter_context(patch.object(module, attribute, clock.timed(part, getattr(module, attribute))))
        state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
        due = clock.now()
        while state.step < cfg.steps:
            if clock.now() >= due:
                measure_scores(state)
                due = clock.now() + INTERVAL
            stage.step(cfg, inputs, state)
            state.step += 1
        output = stage.finish(cfg, inputs, state)
    measure_scores(state)
    return output, clock.now()


def _part_seconds(clock: Clock, seconds: float) -> dict[str, float]:
    """Seconds of each part, and of the rest."""
    parts = {name: round(value, 1) for name, value in clock.parts.items()}
    return {**parts, "the rest": round(seconds - sum(clock.parts.values()), 1)}


def _refine_scores(state: State, capture: Capture, truth: Truth) -> dict[str, float]:
    assert truth.trajectory is not None
    params, visibility, image, full = state.params, refine.cached_visibility(state), [], []
    albedo = torch.sigmoid(params.points.albedo_logits)
    for number in truth.views("shared"):
        arguments = (truth.trajectory.T_cam_obj[number], truth.trajectory.R_env_obj[number], capture.camera)
        view = refine.render(params.points, params.gamma, params.light, *arguments, visibility=visibility)
        rendered, true_image = srgb_from_linear(view.rgb).clamp(0, 1), truth.images[number] / 255
        image.append(metrics.psnr(rendered, true_image, truth.foreground[number]))
        full.append(metrics.psnr(rendered, true_image, torch.ones_like(truth.foreground[number])))
    gaussians = params.points.gaussians
    scores = {name: round(sum(x) / len(x), 2) for name, x in (("image", image), ("image_full", full))}
    return scores | _albedo_scores(gaussians, params.gamma, albedo, capture, truth)


def _decompose_scores(params: decompose.Params, capture: Capture, truth: Truth) -> dict[str, float]:
    return _albedo_scores(params.gaussians, params.gamma, params.material.albedo, capture, truth)


def _albedo_scores(gaussians: Any, gamma: Tensor, albedo: Tensor, capture: Capture, truth: Truth) -> dict[str, float]:
    assert truth.trajectory is not None
    corners = albedo if albedo.ndim == 3 else albedo[:, None].expand(-1, 4, -1)
    poses = (truth.trajectory.T_cam_obj[number] for number in truth.views("shared"))
    views = [rasterize(gaussians, gamma, T_cam_obj, capture.camera, {"albedo": corners}) for T_cam_obj in poses]
    return {"albedo": round(albedo_psnr(views, truth)[0], 2)}


def report(command: str, rows: list[dict[str, Any]]) -> str:
    """The figures in Markdown."""
    lines = [
        f"# Time of stages 2 and 3\n\n`{command}`: recipe DRAFT, known poses, 64 frames of 128 x 128; 2-core x86_64 "
        "CPU. First the time of each part of stage 2 (refine) and stage 3 (decompose), then scores over time, measured "
        "with the clock stopped. Image: PSNR of the stage's own rendering of the evaluation views, only in stage 2. "
        "fg: over the object, full: over the whole image, sRGB.\n"
    ]
    for row in rows:
        seconds = row["seconds"]
        lines += [f"## {row['capture']}, threads: {row['threads']}\n"]
        for stage, parts in row["parts"].items():
            listed = ", ".join(f"{name} {value:.1f}" for name, value in parts.items())
            lines += [f"- {stage} {seconds[stage]:.1f} s: {listed}"]
        lines += ["", "| s | stage | step | image fg / full [dB] | albedo fg [dB] |", "|---|---|---|---|---|"]
        for point in row["curve"]:
            image = f"{point['image']} / {point['image_full']}" if "image" in point else ""
            lines += [f"| {point['seconds']:.0f} | {point['stage']} | {point['step']} | {image} | {point['albedo']} |"]
        lines += [""]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
