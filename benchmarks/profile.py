"""Time and number of operations per step of stages 2 and 3, by part.

`python -m benchmarks.profile CAPTURE [--steps N]` runs both stages of a capture with known poses and the DRAFT recipe,
with the schedule compressed to N steps, and measures steps of the last quarter. Steps in which visibility is traced or
Gaussians are split are left out. It prints a table and writes `benchmarks/profile.json`. The thread is timed by its
processor time, which other work on the machine hardly affects.

Operations are those of torch, without the ones that they call themselves, counted by torch's profiler in steps of
their own, since the profiler slows them down. A part that runs inside another one counts for itself only.
"""

import argparse
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch.profiler import ProfilerActivity, profile, record_function

from benchmarks.kernels import machine
from tumble.datasets import folder
from tumble.engine import optim
from tumble.inverse_rendering import decompose, losses, refine, sh_lighting
from tumble.io import files
from tumble.recipes import DRAFT, Recipe, known_poses

COUNTED = 5
"""Steps whose operations are counted."""
PARTS: dict[str, dict[str, list[tuple[Any, str]]]] = {
    "refine": {
        "render": [(refine, "render")],
        "colour": [(sh_lighting, "radiance")],
        "losses": [(refine, "_terms")],
        "backward": [(torch.autograd, "grad")],
        "optimizer": [(optim.Adam, "step")],
    },
    "decompose": {
        "render": [(decompose, "corner_features"), (decompose, "rasterize_material")],
        "colour": [(decompose, "_render_term")],
        "losses": [(losses, "light_smoothness"), (losses, "material_terms")],
        "backward": [(torch.autograd, "grad")],
        "optimizer": [(optim.Adam, "step")],
    },
}
"""Functions of each part; everything else is bookkeeping."""
BOOKKEEPING = "bookkeeping"
"""Name of the part of everything that no function of `PARTS` does."""
RARE = {
    "refine": [(refine, "_densify"), (refine, "_trace_visibility")],
    "decompose": [(decompose, "_trace_visibility"), (decompose, "_upsample_light")],
}
"""Functions after whose call a step is left out; they do nothing in most steps."""


class Stopwatch:
    """Processor time by part, without that of parts inside, while `on`."""

    def __init__(self) -> None:
        self.on, self.seconds = False, defaultdict[str, float](float)
        self._parts, self._since = [BOOKKEEPING], 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of the context for a part."""
        self._switch()
        self._parts.append(name)
        try:
            with record_function(f"part {name}"):
                yield
        finally:
            self._switch()
            self._parts.pop()

    def wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function as a part."""

        def call(*args: Any, **keywords: Any) -> Any:
            if not self.on:
                return function(*args, **keywords)
            with self.part(name):
                return function(*args, **keywords)

        return call

    def _switch(self) -> None:
        now = time.thread_time()
        self.seconds[self._parts[-1]] += now - self._since
        self._since = now

    @contextmanager
    def step(self) -> Iterator[None]:
        """Measure one step."""
        self.on, self._since = True, time.thread_time()
        self.seconds.clear()
        yield
        self._switch()
        self.on = False


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    capture = folder.load(arguments.capture)
    assert capture.trajectory is not None, "the capture needs known poses"
    recipe = compressed(known_poses(DRAFT), arguments.steps)
    refined, second = measure(refine, recipe.refine, refine.Inputs(capture, capture.trajectory))
    _, third = measure(decompose, recipe.decompose, decompose.Inputs(capture, refined))
    rows = {"refine": second, "decompose": third}
    command = f"python -m benchmarks.profile CAPTURE --steps {arguments.steps}"
    document = {"command": command, "machine": machine(), "capture": arguments.capture.name, "stages": rows}
    files.write_json(arguments.out, document)
    for stage, row in rows.items():
        print(f"{stage}: {row['ms']} ms and {row['operations']} operations per step")
        for name, part in row["parts"].items():
            print(f"  {name:12} {part['ms']:7.2f} ms {part['operations']:5} operations")


def compressed(recipe: Recipe, steps: int) -> Recipe:
    """The recipe with `steps` steps per stage and everything that happens at certain steps moved in proportion."""
    second, third = recipe.refine, recipe.decompose
    growth = replace(second.densification, refine_every=-(-second.densification.refine_every * steps // second.steps))
    second = replace(second, steps=steps, densification=growth)
    return replace(
        recipe, refine=second, decompose=replace(third, steps=steps, warmup=third.warmup * steps // third.steps)
    )


def measure(stage: Any, cfg: Any, inputs: Any) -> tuple[Any, dict[str, Any]]:
    """Run a stage; its output, and the medians of its steps."""
    name = stage.__name__.rsplit(".", 1)[-1]
    clock, rare, measured, counts = Stopwatch(), [False], [], Counter[str]()
    with ExitStack() as patches:
        for part, functions in PARTS[name].items():
            for owner, attribute in functions:
                patches.enter_context(patch.object(owner, attribute, clock.wrapped(part, getattr(owner, attribute))))
        state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
        for owner, attribute in RARE[name]:
            patches.enter_context(patch.object(owner, attribute, _marked(getattr(owner, attribute), state, rare)))
        while state.step < cfg.steps:
            rare[0] = False
            if state.step < 0.75 * cfg.steps:
                stage.step(cfg, inputs, state)
            elif state.step < cfg.steps - COUNTED:
                with clock.step():
                    stage.step(cfg, inputs, state)
                measured += [] if rare[0] else [dict(clock.seconds)]
            else:
                clock.on = True
                counts += operations(lambda: stage.step(cfg, inputs, state))
                clock.on = False
            state.step += 1
    parts = {}
    for part in (*PARTS[name], BOOKKEEPING):
        milliseconds = 1e3 * statistics.median(each.get(part, 0.0) for each in measured)
        parts[part] = {"ms": round(milliseconds, 2), "operations": round(counts[part] / COUNTED)}
    total = 1e3 * statistics.median(sum(each.values()) for each in measured)
    row = {"ms": round(total, 2), "operations": round(counts.total() / COUNTED), "parts": parts}
    return stage.finish(cfg, inputs, state), row


def _marked(function: Callable[..., Any], state: Any, rare: list[bool]) -> Callable[..., Any]:
    """The function, which sets `rare` if it changes the parameters' or the memory's tensors."""

    def call(*args: Any, **keywords: Any) -> Any:
        before = state.params, dict(state.memory)
        result = function(*args, **keywords)
        kept = state.memory.keys() == before[1].keys() and all(x is before[1][k] for k, x in state.memory.items())
        rare[0] |= state.params is not before[0] or not kept
        return result

    return call


def operations(run: Callable[[], Any]) -> Counter[str]:
    """Number of operations by part that torch executes, without those that they call themselves."""
    with profile(activities=[ProfilerActivity.CPU]) as trace:
        run()
    counts = Counter[str]()
    for event in trace.events() or []:
        if not event.name.startswith("aten::"):
            continue
        parent, part = event.cpu_parent, BOOKKEEPING
        while parent is not None and not parent.name.startswith(("aten::", "part ")):
            parent = parent.cpu_parent
        if parent is not None and parent.name.startswith("aten::"):
            continue
        if parent is not None:
            part = parent.name.removeprefix("part ")
        counts[part] += 1
    return counts


if __name__ == "__main__":
    main()
