"""Growth of the cost of stages 2 and 3 with pixels, Gaussians, frames and directions.

`python -m benchmarks.scale` varies one quantity at a time from `BASE`, on a generated torus with known poses and the
settings of DRAFT, and writes processor times of one thread, peak memory and exponents of growth to
`benchmarks/scale.json`, and a plot to `benchmarks/scale.svg`. An exponent is the slope between the two largest values
in a plot with two logarithmic axes; a constant cost lowers it. Every point is a process of its own.

Only one thing grows faster than linearly: the visibility of stage 3 with the number of Gaussians, by a power of 1.1.
Every Gaussian sends the same number of rays, but through a deeper tree, which no longer fits into the caches.
"""

import argparse
import json
import math
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.kernels import machine
from tumble.engine import loop
from tumble.inverse_rendering import albedo_solve, decompose, refine
from tumble.io import files, tree
from tumble.maths import SE3, SO3, srgb_from_linear
from tumble.recipes import DRAFT, known_poses
from tumble.rendering import rasterize
from tumble.scene import (
    BACKGROUND,
    OBJECT,
    Camera,
    Capture,
    Gaussians,
    Trajectory,
    constant_sh,
    quats_from_normals,
    sdf_from_opacity,
    visual_hull,
)

AXES = {
    "pixels": (128**2, 256**2, 512**2),
    "gaussians": (8_000, 16_000, 32_000, 64_000, 128_000),
    "frames": (64, 128, 256, 400),
    "directions": (128, 256, 512, 1024),
}
"""Values of each quantity; pixels are those of an image."""
BASE = {"pixels": 256**2, "gaussians": 16_000, "frames": 64, "directions": 256}
"""Values of all other quantities."""
SETS = 2
"""Sets of directions of stage 3, to whose number its visibility is proportional; 8 in the recipes."""
STEPS = 9
"""Timed steps, of which the median is taken."""
LINEAR = 1.1
"""Largest exponent that counts as linear growth."""
MAJOR, MINOR = 0.66, 0.26
"""Radii of the torus [object radius]."""

Row = dict[str, float]
"""Milliseconds by what was timed, and MiB."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", choices=AXES, default=list(AXES))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument("--point", type=json.loads, help="measure one point in this process and print it")
    arguments = parser.parse_args()
    if arguments.point:
        torch.set_num_threads(1)
        print(json.dumps(measure(**arguments.point)))
        return
    measured: dict[str, Row] = {}
    for axis in arguments.axes:
        for value in AXES[axis]:
            point = json.dumps(BASE | {axis: value})
            measured[point] = measured.get(point) or in_a_process(point)
    axes = {}
    for axis in arguments.axes:
        rows = [measured[json.dumps(BASE | {axis: value})] for value in AXES[axis]]
        costs = {name: [row[name] for row in rows] for name in rows[0]}
        exponents = {name: exponent(AXES[axis], values) for name, values in costs.items()}
        axes[axis] = {"values": AXES[axis], "costs": costs, "exponents": exponents}
        faster = [f"{name} {p}" for name, p in exponents.items() if p > LINEAR]
        print(f"{axis}: faster than linear: {', '.join(faster) or 'nothing'}")
    document = {"command": "python -m benchmarks.scale", "machine": machine(), "base": BASE, "axes": axes}
    files.write_json(arguments.out, document)
    arguments.out.with_suffix(".svg").write_text(plot(axes), "utf-8")


def in_a_process(point: str) -> Row:
    """Costs at a point."""
    command = [sys.executable, "-m", "benchmarks.scale", "--point", point]
    row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    print(point, row, flush=True)
    return row


def exponent(x: tuple[int, ...], y: list[float]) -> float:
    """Slope between the last two points with logarithmic axes."""
    return round(math.log(y[-1] / y[-2]) / math.log(x[-1] / x[-2]), 2)


def measure(pixels: int, gaussians: int, frames: int, directions: int) -> Row:
    """Costs at a point."""
    capture, trajectory = scene(math.isqrt(pixels), frames)
    recipe, row = known_poses(DRAFT), {}
    growth = replace(recipe.refine.densification, max_gaussians=2 * gaussians)
    second = replace(recipe.refine, points=gaussians, diameter=0.0, densification=growth)
    third = replace(recipe.decompose, directions=directions, sets=SETS, try_matte=False)

    def hull() -> None:
        cells = visual_hull.carve(capture, trajectory, resolution=second.hull)
        visual_hull.sample_surface(cells, gaussians, torch.Generator().manual_seed(0))

    row["stage 2 hull"] = milliseconds(hull)
    inputs = refine.Inputs(capture, trajectory)
    with patch.object(refine, "_start", lambda *_: torus(gaussians)):
        state = refine.init(second, inputs, torch.Generator().manual_seed(0))
    row["stage 2 visibility"] = milliseconds(lambda: periodic(refine, "_trace_visibility")(inputs, state))
    row["stage 2 step"] = step_time(refine, second, inputs, state)
    inputs_3 = decompose.Inputs(capture, refine.finish(second, inputs, state))
    row["stage 2 densification"] = milliseconds(lambda: periodic(refine, "_densify")(second, inputs, state))
    state = decompose.init(third, inputs_3, torch.Generator().manual_seed(0))
    row["stage 3 visibility"] = milliseconds(lambda: periodic(decompose, "_trace_visibility")(third, inputs_3, state))
    row["stage 3 step"] = step_time(decompose, third, inputs_3, state)
    row["stage 3 state MiB"] = sum(x.nbytes for x in (*tensors(state.params), *state.memory.values())) / 2**20
    asset = decompose.finish(third, inputs_3, state)
    row["albedo solve"] = milliseconds(lambda: albedo_solve.solved(asset, capture))
    row["peak MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {name: round(value, 2) for name, value in row.items()}


def periodic(stage: Any, name: str) -> Callable[..., Any]:
    """What a stage does in some steps only."""
    return getattr(stage, name)


def step_time(stage: Any, cfg: Any, inputs: Any, state: loop.State) -> float:
    """Median of some late steps without anything periodic [ms]."""
    state.step = int(0.9 * cfg.steps) + 1
    times = []
    for _ in range(STEPS + 3):  # the first ones fill caches and refine the light
        times.append(milliseconds(lambda: stage.step(cfg, inputs, state)))
        state.step += 1
    return statistics.median(times[3:])


def milliseconds(run: Callable[[], Any]) -> float:
    """Processor time of a call."""
    started = time.process_time()
    run()
    return 1e3 * (time.process_time() - started)


def tensors(x: Any) -> list[Tensor]:
    """All tensors of a tree."""
    return list(tree.named_tensors(x).values())


def torus(n: int) -> visual_hull.OrientedPoints:
    """Evenly spaced points of a torus, which shadows itself."""
    i = torch.arange(n) + 0.5
    u, v = 2 * math.pi * ((i * (math.sqrt(5) - 1) / 2) % 1), 2 * math.pi * i / n
    # Equal areas: the circumference at v is proportional to MAJOR + MINOR cos v.
    for _ in range(8):
        v = 2 * math.pi * i / n - MINOR / MAJOR * v.sin()
    radial = torch.stack([u.cos(), u.sin(), 0 * u], -1)
    normals = v.cos()[:, None] * radial + v.sin()[:, None] * torch.tensor([0.0, 0.0, 1.0])
    spacing = torch.full_like(u, math.sqrt(4 * math.pi**2 * MAJOR * MINOR / n))
    return visual_hull.OrientedPoints(MAJOR * radial + MINOR * normals, normals, spacing)


def scene(side: int, frames: int) -> tuple[Capture, Trajectory]:
    """Square images of a coloured torus that tumbles, and its poses."""
    points = torus(20_000)
    colour = 0.4 + 0.3 * torch.sin(9 * points.positions @ torch.tensor([[1.0, 2, -1], [2, -1, 1], [-1, 1, 2]]))
    log_scales = (points.spacing[:, None] * torch.tensor([0.7, 0.7, 0.07])).log()
    gamma = torch.tensor(30.0)
    sdf = sdf_from_opacity(torch.full_like(points.spacing, 0.9), gamma)
    shape = Gaussians(points.positions, quats_from_normals(points.normals), log_scales, sdf, constant_sh(colour))
    turn = torch.linspace(0, 2 * math.pi, frames + 1)[:-1]
    tilt, about = torch.stack([0.9 * turn.cos(), 0 * turn, 0 * turn], -1), torch.stack([0 * turn, turn, 0 * turn], -1)
    xyz = torch.tensor([0.0, 0.0, 4.0]).expand(frames, 3).contiguous()
    T_cam_obj = SE3.from_rotation(SO3.exp(tilt) @ SO3.exp(about), xyz)
    camera, images, masks = Camera.from_fov(0.6, side, side), [], []
    for frame in range(frames):
        view = rasterize(shape, gamma, T_cam_obj[frame], camera, {})
        images.append((255 * srgb_from_linear(view.rgb).clamp(0, 1)).round().to(torch.uint8))
        masks.append(torch.where(view.alpha > 0.5, OBJECT, BACKGROUND).to(torch.uint8))
    names = tuple(f"{frame:04}.png" for frame in range(frames))
    trajectory = Trajectory(T_cam_obj, "camera")
    return Capture(torch.stack(images), torch.stack(masks), camera, names, "camera", trajectory), trajectory


PANEL, GAP = 260, 70
"""Side of a diagram, and the space between diagrams [SVG units]."""
COLOURS = ("#1b6ca8", "#d1495b", "#2e933c", "#e08e1b", "#6f4a8e", "#00798c", "#8d6a3f")


def plot(axes: dict[str, Any]) -> str:
    """One diagram per quantity, with logarithmic axes of the same scale, as SVG."""
    names = [name for name in next(iter(axes.values()))["costs"] if "MiB" not in name]
    costs = [y for axis in axes.values() for name in names for y in axis["costs"][name]]
    low, high = math.floor(math.log10(min(costs))), math.ceil(math.log10(max(costs)))
    parts = []
    for number, (title, axis) in enumerate(axes.items()):
        left, x = GAP + number * (PANEL + GAP), [math.log10(v) for v in axis["values"]]
        parts.append(f'<text x="{left}" y="24" font-weight="bold">{title}</text>')
        for power in range(low, high + 1):
            y = 40 + PANEL * (high - power) / (high - low)
            parts.append(f'<path d="M{left} {y:.0f}h{PANEL}" stroke="#ddd"/>')
            parts.append(f'<text x="{left - 6}" y="{y + 4:.0f}" text-anchor="end">{10.0**power:g}</text>')
        at = [left + PANEL * (v - x[0]) / (x[-1] - x[0]) for v in x]
        # Linear growth from the lowest line, cut where it leaves the diagram.
        rise = min(x[-1] - x[0], high - low)
        end = left + PANEL * rise / (x[-1] - x[0]), 40 + PANEL * (1 - rise / (high - low))
        parts.append(f'<path d="M{left} {40 + PANEL} L{end[0]:.1f} {end[1]:.1f}" stroke="#888" stroke-dasharray="4"/>')
        for value, place in zip(axis["values"], at, strict=True):
            parts.append(f'<text x="{place:.0f}" y="{PANEL + 58}" text-anchor="middle">{value}</text>')
        for name, colour in zip(names, COLOURS, strict=True):
            heights = [40 + PANEL * (high - math.log10(v)) / (high - low) for v in axis["costs"][name]]
            path = " L".join(f"{a:.1f} {b:.1f}" for a, b in zip(at, heights, strict=True))
            parts.append(f'<path d="M{path}" stroke="{colour}" fill="none" stroke-width="2"/>')
    for number, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
        slopes = ", ".join(f"{title} {axis['exponents'][name]}" for title, axis in axes.items())
        y = PANEL + 90 + 20 * number
        parts.append(f'<text x="{GAP}" y="{y}" fill="{colour}">{name} [ms]: grows with the power {slopes}</text>')
    parts.append(f'<text x="{GAP}" y="{PANEL + 90 + 20 * len(names)}" fill="#888">dashed: linear growth</text>')
    width, height = GAP + len(axes) * (PANEL + GAP), PANEL + 120 + 20 * len(names)
    body = "\n".join(['<rect width="100%" height="100%" fill="#fff"/>', *parts])
    frame = f'xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12"'
    return f"<svg {frame}>\n{body}\n</svg>\n"


if __name__ == "__main__":
    main()
