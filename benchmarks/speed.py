"""Where the time of stages 2 and 3 goes, and what each second buys.

`python -m benchmarks.speed CAPTURE... [--threads N]` reconstructs captures with truth and known poses by DRAFT, and
every few seconds scores the views of region shared; the clock stands still meanwhile. Writes `benchmarks/speed.json`
and `.md`.

Image: PSNR of the stage's own rendering of evaluation views over the foreground [dB, sRGB]; stage 3 draws none. Albedo:
foreground PSNR after the scale per channel, as everywhere [dB, sRGB].
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

EVERY = 10.0
"""Seconds of work between two looks."""
PARTS = {
    "refine": {
        "rendering": (refine, "render"),
        "losses": (refine, "_terms"),
        "densifying": (refine, "_densify"),
        "visibility": (refine, "_look_around"),
        "backward pass and Adam": (optim, "descend"),
    },
    "decompose": {
        "visibility": (decompose, "_look_around"),
        "rendering": (decompose, "buffers_of"),
        "shading": (decompose, "_shaded"),
        "backward pass and Adam": (optim, "descend"),
    },
}


class Clock:
    """Counts work, not scoring, and what parts of it take; a part within a part counts for the outer one alone."""

    def __init__(self) -> None:
        self.begun, self.paused, self.inside, self.parts = (
            time.perf_counter(),
            0.0,
            False,
            defaultdict[str, float](float),
        )

    def now(self) -> float:
        return time.perf_counter() - self.begun - self.paused

    @contextmanager
    def stopped(self) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self.paused += time.perf_counter() - begun

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **keywords: Any) -> Any:
            if self.inside:
                return function(*args, **keywords)
            self.inside, begun = True, time.perf_counter()
            try:
                return function(*args, **keywords)
            finally:
                self.inside = False
                self.parts[name] += time.perf_counter() - begun

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
        text = page(command, rows)
        files.write_whole(arguments.out.with_suffix(".md"), lambda partial, text=text: partial.write_text(text))
        print(page(command, rows[-1:]), flush=True)


def measure(path: Path) -> dict[str, Any]:
    """Both stages of one capture: seconds by part, and scores by second."""
    capture, truth = folder.load(path), folder.load_truth(path)
    assert truth is not None, "a capture with truth"
    assert capture.trajectory is not None, "a capture with known poses"
    inputs, clock, curve = refine.Inputs(capture, capture.trajectory), Clock(), []
    cfg = known_poses(DRAFT).refine
    refined, seconds = _staged(refine, cfg, inputs, clock, curve, lambda s: _of_refine(s, capture, truth))
    parts = {"refine": _shares(clock, seconds)}
    inputs = decompose.Inputs(capture, refined)
    _, last = _staged(
        decompose,
        DRAFT.decompose,
        inputs,
        clock,
        curve,
        lambda s: _of_decompose(decompose.shared_out(s.params), capture, truth),
    )
    parts["decompose"] = _shares(clock, last - seconds)
    return {
        "seconds": {"refine": round(seconds, 1), "decompose": round(last - seconds, 1)},
        "parts": parts,
        "curve": curve,
    }


def _staged(
    stage: Any,
    cfg: Any,
    inputs: Any,
    clock: Clock,
    curve: list[dict[str, Any]],
    scored: Callable[[Any], dict[str, float]],
) -> tuple[Any, float]:
    """A stage's outcome, and when it was there."""
    name = stage.__name__.rsplit(".", 1)[-1]

    def look(state: Any) -> None:
        with clock.stopped(), torch.no_grad():
            curve.append({"stage": name, "seconds": round(clock.now(), 1), "step": state.step, **scored(state)})

    clock.parts.clear()
    with ExitStack() as patches:
        for part, (module, attribute) in PARTS[name].items():
            patches.enter_context(patch.object(module, attribute, clock.timed(part, getattr(module, attribute))))
        state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
        due = clock.now()
        while state.step < cfg.steps:
            if clock.now() >= due:
                look(state)
                due = clock.now() + EVERY
            stage.step(cfg, inputs, state)
            state.step += 1
        outcome = stage.finish(cfg, inputs, state)
    look(state)
    return outcome, clock.now()


def _shares(clock: Clock, seconds: float) -> dict[str, float]:
    parts = {name: round(value, 1) for name, value in clock.parts.items()}
    return {**parts, "the rest": round(seconds - sum(clock.parts.values()), 1)}


def _of_refine(state: State, capture: Capture, truth: Truth) -> dict[str, float]:
    assert truth.trajectory is not None
    params, sky, image, full = state.params, refine.sky(state), [], []
    albedo = torch.sigmoid(params.points.albedo_logits)
    for number in truth.views("shared"):
        arguments = (truth.trajectory.T_cam_obj[number], truth.trajectory, capture.camera)
        view = refine.render(params.points, params.gamma, params.light, *arguments, sky=sky)
        rendered, photograph = srgb_from_linear(view.rgb).clamp(0, 1), truth.images[number] / 255
        image.append(metrics.psnr(rendered, photograph, truth.foreground[number]))
        full.append(metrics.psnr(rendered, photograph, torch.ones_like(truth.foreground[number])))
    gaussians = params.points.gaussians
    scores = {name: round(sum(x) / len(x), 2) for name, x in (("image", image), ("image_full", full))}
    return scores | _albedo(gaussians, params.gamma, albedo, capture, truth)


def _of_decompose(params: decompose.Params, capture: Capture, truth: Truth) -> dict[str, float]:
    return _albedo(params.gaussians, params.gamma, params.material.albedo, capture, truth)


def _albedo(gaussians: Any, gamma: Tensor, albedo: Tensor, capture: Capture, truth: Truth) -> dict[str, float]:
    assert truth.trajectory is not None
    corners = albedo if albedo.ndim == 3 else albedo[:, None].expand(-1, 4, -1)
    places = (truth.trajectory.T_cam_obj[number] for number in truth.views("shared"))
    views = [rasterize(gaussians, gamma, T_cam_obj, capture.camera, {"albedo": corners}) for T_cam_obj in places]
    return {"albedo": round(albedo_psnr(views, truth)[0], 2)}


def page(command: str, rows: list[dict[str, Any]]) -> str:
    """The figures as Markdown."""
    lines = [f"# Time of stages 2 and 3\n\n`{command}`: DRAFT, known poses, 128 x 128, 64 frames; 2-core x86_64 CPU.\n"]
    for row in rows:
        seconds = row["seconds"]
        lines += [f"## {row['capture']}, threads: {row['threads']}\n"]
        for stage, parts in row["parts"].items():
            listed = ", ".join(f"{name} {value:.1f}" for name, value in parts.items())
            lines += [f"- {stage} {seconds[stage]:.1f} s: {listed}"]
        lines += ["", "| s | stage | step | image fg / full [dB] | albedo fg [dB] |", "|---|---|---|---|---|"]
        for look in row["curve"]:
            image = f"{look['image']} / {look['image_full']}" if "image" in look else ""
            lines += [f"| {look['seconds']:.0f} | {look['stage']} | {look['step']} | {image} | {look['albedo']} |"]
        lines += [""]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
