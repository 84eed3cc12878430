"""Speed of the CPU kernels, mostly on a closed shell of Gaussians that fits the image.

`python -m benchmarks.kernels` prints a table of medians, beside a few of the reference backend, and writes
`benchmarks/kernels.json`. A single thread is timed by its processor time, which other work on the machine hardly
affects; several threads by the wall clock.
"""

import argparse
import json
import math
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from tumble import backends
from tumble.backends import Backend

RUNS = 9
"""Timed calls per figure, of which the median is taken."""
FEATURES = 16
"""Feature channels of the larger of the two rasterization cases."""
DIRECTIONS = 256
"""Directions of the visibility and shading cases."""
GAUSSIANS = 16_000
"""Gaussians of the kernels of a step, as in DRAFT."""
SIZES = [(10_000, 128), (10_000, 256), (10_000, 512), (50_000, 128), (50_000, 256), (50_000, 512)]
"""Rasterization cases: number of Gaussians, and image width [pixels]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument("--no-reference", action="store_true", help="skip the slow rows of the reference")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for threads in arguments.threads:
        torch.set_num_threads(threads)
        rows += measure(backends.load("cpu"), "cpu", threads, SIZES)
        rows += step_rows(backends.load("cpu"), "cpu", threads)
    machine_info = machine()  # Peak memory is read before the reference runs, which needs gigabytes.
    if not arguments.no_reference:
        torch.set_num_threads(1)
        # The reference stores every pair of a pixel and a nearby Gaussian: only one size fits into memory and time.
        rows += rasterize_rows(backends.load("reference"), "reference", 1, [(10_000, 256)], runs=3)
    document = {"command": "python -m benchmarks.kernels", "machine": machine_info, "rows": rows}
    arguments.out.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


CPU = torch.device("cpu")


def measure(
    backend: Backend, name: str, threads: int, sizes: list[tuple[int, int]], *, device: torch.device = CPU
) -> list[dict[str, Any]]:
    """All rows of a backend at a number of threads."""
    return [
        *rasterize_rows(backend, name, threads, sizes, device=device),
        *trace_rows(backend, name, threads, device=device),
        *shade_rows(backend, name, threads, device=device),
    ]


def rasterize_rows(
    backend: Backend,
    name: str,
    threads: int,
    sizes: list[tuple[int, int]],
    runs: int = RUNS,
    *,
    device: torch.device = CPU,
) -> list[dict[str, Any]]:
    """Milliseconds of rasterization, projection and binning included, with 0 and with FEATURES feature channels."""
    rows = []
    for n, size in sizes:
        for c in (0, FEATURES):
            tensors = [*shell(n), torch.rand(n, 1, 3) + 0.5, torch.rand(n, 4, c), *camera(size)]
            inputs: Any = [x.to(device).requires_grad_() for x in tensors]
            arguments: Any = [*inputs, size, size, torch.ones(1, 1, device=device)]
            with torch.no_grad():
                forward = median_seconds(partial(backend.rasterize, *arguments), threads, runs, device)
            view = backend.rasterize(*arguments)[:6]
            gradients = [torch.randn_like(x) for x in view]
            adjoint = partial(torch.autograd.grad, view, inputs, gradients, retain_graph=True)
            backward = median_seconds(adjoint, threads, runs, device)
            what = f"rasterize {n // 1000}k, {size} px, {c} features"
            rows.append(row(what, name, threads, "ms", forward * 1e3, backward * 1e3))
    return rows


def trace_rows(backend: Backend, name: str, threads: int, *, device: torch.device = CPU) -> list[dict[str, Any]]:
    """Million rays per second: random rays from outside, and visibility rays from surface points to the hemisphere.

    On a GPU ten times as many, which a run traces at once, too: fewer do not occupy it.
    """
    rows, million, points = [], *((0.1, 1000) if device.type == "cpu" else (1.0, 10_000))
    for n in (10_000, 50_000):
        means, quats, scales, opacity = (x.to(device) for x in shell(n))
        k = f"{n // 1000}k"
        build = median_seconds(partial(backend.build, means, quats, scales, opacity), threads, RUNS, device)
        rows.append(row(f"build {k}", name, threads, "ms", build * 1e3))
        bvh = backend.build(means, quats, scales, opacity)
        rng = torch.Generator().manual_seed(0)
        count = round(1e6 * million)
        origins = 2.5 * normalize(torch.randn(count, 3, generator=rng), dim=-1)
        targets = normalize(torch.randn(count, 3, generator=rng), dim=-1) * torch.rand(count, 1, generator=rng)
        rays = [x.to(device) for x in (origins, normalize(targets - origins, dim=-1), torch.rand(n, 3))]
        rate = million / median_seconds(partial(backend.trace, bvh, *rays), threads, RUNS, device)
        rows.append(row(f"trace {k}, ordered, all blocked", name, threads, "M rays/s", rate))
        normals = normalize(means[:: n // points], dim=-1)
        directions = fibonacci(DIRECTIONS).to(device)
        million_rays = (normals @ directions.T > 0).sum().item() / 1e6
        outside = 1.03 * normals, normals, directions
        rate = million_rays / median_seconds(partial(backend.visible, bvh, *outside), threads, RUNS, device)
        rows.append(row(f"visible {k}, open sky", name, threads, "M rays/s", rate))
        # From inside a shell whose normals point inwards, every ray is blocked.
        flipped = quats[:, [1, 0, 3, 2]] * quats.new_tensor([1.0, -1, 1, -1])
        inward_bvh = backend.build(means, flipped, scales, opacity)
        inside = 0.5 * normals, normals, directions
        rate = million_rays / median_seconds(partial(backend.visible, inward_bvh, *inside), threads, RUNS, device)
        rows.append(row(f"visible {k}, all blocked", name, threads, "M rays/s", rate))
    return rows


def shade_rows(backend: Backend, name: str, threads: int, *, device: torch.device = CPU) -> list[dict[str, Any]]:
    """Million evaluations of light and BRDF per second, for 2000 points and DIRECTIONS directions."""
    p = 2000
    rng = torch.Generator().manual_seed(0)
    normal = normalize(torch.randn(p, 3, generator=rng), dim=-1)
    view = normalize(normal + 0.3 * torch.randn(p, 3, generator=rng), dim=-1)
    tensors = [normal, 0.2 + 0.7 * torch.rand(p), view]
    surface = [x.to(device).requires_grad_() for x in tensors]
    light, directions = torch.rand(DIRECTIONS, 3).to(device).requires_grad_(), fibonacci(DIRECTIONS).to(device)
    visibility = torch.full((p, DIRECTIONS // 32), -1, dtype=torch.int32, device=device)
    no_blockers = visibility.new_full((1, 1), -1), torch.arange(p, device=device), light.new_zeros(0, 3)
    arguments: Any = [*surface, directions, light, visibility, *no_blockers]
    with torch.no_grad():
        forward = median_seconds(lambda: backend.shade(*arguments), threads, RUNS, device)
    lobes = backend.shade(*arguments)[:2]
    seeds = [torch.randn_like(x) for x in lobes]
    adjoint = partial(torch.autograd.grad, lobes, [*surface, light], seeds, retain_graph=True)
    backward = median_seconds(adjoint, threads, RUNS, device)
    million = p * DIRECTIONS / 1e6
    return [
        row("shade, forward", name, threads, "M evaluations/s", million / forward),
        row("shade, forward and backward", name, threads, "M evaluations/s", million / (forward + backward)),
    ]


def step_rows(backend: Backend, name: str, threads: int, *, device: torch.device = CPU) -> list[dict[str, Any]]:
    """Milliseconds of the other kernels of a step of stages 2 and 3, and of their gradients where they have any."""
    rows = []
    for what, call, tensors in [*_image_cases(backend), *_gaussian_cases(backend), *_light_cases(backend)]:
        inputs = [x.to(device) for x in tensors]
        leaves = [x.requires_grad_() for x in inputs if x.is_floating_point()]
        forward = median_seconds(lambda call=call, inputs=inputs: call(*inputs), threads, RUNS, device)
        total = sum((x.sum() for x in _tensors(call(*inputs))), torch.zeros((), device=device))
        adjoint = partial(torch.autograd.grad, total, leaves, retain_graph=True, allow_unused=True)
        backward = median_seconds(adjoint, threads, RUNS, device)
        rows.append(row(what, name, threads, "ms", forward * 1e3, backward * 1e3))
    zero = torch.zeros((), device=device)
    values = [torch.randn(GAUSSIANS, k, device=device) for k in (3, 4, 3, 12, 4, 12)]
    moved = [backends.Leaf(x, x.clone(), x * 0, x * 0, zero.clone(), 1e-3) for x in values]
    adam = median_seconds(lambda: backend.adam(moved, zero, zero.clone(), 0.9, 0.999, 1e-15), threads, RUNS, device)
    return [*rows, row(f"Adam {GAUSSIANS // 1000}k", name, threads, "ms", adam * 1e3)]


Kernel = tuple[str, Callable[..., Any], list[Tensor]]
"""A kernel for a row of the table: its title, a call, and the arguments of the call, of which the floating-point ones
get gradients."""


def _tensors(result: Any) -> list[Tensor]:
    """The tensors that a kernel returns."""
    return [result] if isinstance(result, Tensor) else list(result)


def _image_cases(backend: Backend) -> list[Kernel]:
    """Loss terms of images."""
    cases: list[Kernel] = []
    for size in (128, 256):
        photo = torch.randint(0, 256, (size, size, 3), dtype=torch.uint8)
        mask = torch.full((size, size), backends.OBJECT, dtype=torch.uint8)
        view = [torch.rand(size, size, *more) for more in ((3,), (), (), (), (3,))]
        image = partial(backend.image_terms, ssim_weight=0.2, crease=25.0)
        R, _, intrinsics = camera(size)
        cases.append((f"image terms, {size} px", image, [*view, photo, mask, R, intrinsics]))
        material = [torch.rand(size, size, 7), torch.ones(size, size), photo, mask]
        cases.append((f"material terms, {size} px", backend.material_terms, material))
    return cases


def _gaussian_cases(backend: Backend) -> list[Kernel]:
    """What is computed of every Gaussian."""
    n, rng = GAUSSIANS, torch.Generator().manual_seed(0)
    means, quats, scales, _ = shell(n)
    log_scales, sdf, gamma = scales.log(), 0.01 * torch.randn(n, generator=rng), torch.tensor(60.0)
    transfer, sky = torch.rand(n, 9, generator=rng), fibonacci(DIRECTIONS)
    harmonics = [
        means,
        quats,
        torch.randn(n, 3, generator=rng),
        torch.randn(2, 16, 3, generator=rng),
        torch.tensor(1.0),
    ]
    reflectance, T = torch.rand(6, generator=rng), camera(256)
    logits = [torch.randn(n, 4, *more, generator=rng) for more in ((3,), (), (3,))]
    terms = partial(backend.gaussian_terms, floor=0.005, reach=0.1)
    measured = [means, quats, log_scales, sdf, gamma, torch.rand(n, generator=rng), torch.full((256, 256), 2.0), *T]
    k = f"{n // 1000}k"
    return [
        (f"activate {k}", backend.activate, [log_scales, sdf, gamma]),
        (f"Gaussian terms {k}", terms, measured),
        (f"corner features {k}", partial(backend.corner_features, temperature=10.0), logits),
        (
            f"shade by harmonics {k}",
            backend.sh_shade,
            [*harmonics, transfer, transfer + 0.1, sky, reflectance, T[0], torch.tensor([0.0, 0, -3])],
        ),
        (f"bounce {k}", backend.bounce, [torch.rand(n, 3), transfer, sky, torch.rand(DIRECTIONS, 3)]),
    ]


def _light_cases(backend: Backend) -> list[Kernel]:
    """Prefiltered light, and the shading of pixels by it."""
    levels, h, p, size, n = 9, 16, 1024, 128, GAUSSIANS
    rng = torch.Generator().manual_seed(0)
    stack, sky = torch.rand(levels, h, 2 * h, 3, generator=rng), fibonacci(DIRECTIONS)
    lobes = torch.rand(h + 1, (levels - 1) * h, h, generator=rng)
    normal = normalize(torch.randn(size, size, 3, generator=rng) - torch.tensor([0, 0, 3.0]), dim=-1)
    view = [torch.rand(size, size, 7, generator=rng), torch.ones(size, size), normal]
    shown = [
        torch.randint(0, n, (size, size), generator=rng).int(),
        torch.randint(0, 256, (size, size, 3), generator=rng, dtype=torch.uint8),
        torch.randperm(size * size, generator=rng)[:p],
    ]
    visibility = torch.randint(-(2**31), 2**31, (n, DIRECTIONS // 32), generator=rng).int()  # half of the sky
    blocker = torch.randint(0, n, (n, DIRECTIONS), generator=rng).int()
    lit = [stack, sky, visibility, blocker, torch.rand(n, 3), torch.rand(n, 9), torch.rand(32, 32)]
    R, _, intrinsics = camera(size)

    def shading(*x: Tensor) -> Tensor:
        sampled, light = backends.SampledView(*x[:6]), backends.ShadingLight(*x[6:13])
        return backend.shading_term(sampled, light, *x[13:])

    rough = torch.rand(p, generator=rng)
    return [
        (f"prefilter {h} rows", backend.prefilter, [stack[0], lobes]),
        (f"lookup, {p} directions", backend.lookup, [stack, torch.randn(p, 3, generator=rng), rough]),
        (
            f"shading term, {p} pixels, {DIRECTIONS} directions",
            shading,
            [*view, *shown, *lit, R, R, intrinsics, torch.full((3,), 0.04)],
        ),
    ]


def row(what: str, name: str, threads: int, unit: str, value: float, backward: float | None = None) -> dict[str, Any]:
    """A row of the table, which is also printed."""
    text = f"{value:9.2f}" + (f" + {backward:7.2f}" if backward is not None else "")
    print(f"{what:42s} {name:10s} {threads} thread{'s' * (threads > 1):1s} {text} {unit}", flush=True)
    entry = {"what": what, "backend": name, "threads": threads, "unit": unit, "value": round(value, 3)}
    return entry if backward is None else {**entry, "backward": round(backward, 3)}


def median_seconds(run: Callable[[], Any], threads: int, runs: int = RUNS, device: torch.device = CPU) -> float:
    """Median duration of a call [s], after two warm-up calls; on a GPU, calls are synchronised."""
    on_gpu = device.type == "cuda"
    clock = time.thread_time if threads == 1 and not on_gpu else time.perf_counter
    seconds = []
    for i in range(runs + min(2, runs - 1)):
        start = clock()
        run()
        if on_gpu:
            torch.cuda.synchronize(device)
        if i >= min(2, runs - 1):
            seconds.append(clock() - start)
    return statistics.median(seconds)


def machine() -> dict[str, Any]:
    """Facts about machine and process that timings depend on."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    return {
        "class": f"{os.cpu_count()}-core {platform.machine()} CPU, {backends.vector_bits()}-bit vectors",
        "torch": torch.__version__,
        "load": round(load, 1),
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def fibonacci(n: int) -> Tensor:
    """n directions of equal solid angle on a Fibonacci spiral."""
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, azimuth = 1 - 2 * i / n, i * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    return torch.stack([r * azimuth.cos(), r * azimuth.sin(), z], -1).float()


def shell(n: int) -> list[Tensor]:
    """Means, quaternions, scales and opacity of flat Gaussians on a slightly rough unit sphere."""
    rng = torch.Generator().manual_seed(0)
    normals = fibonacci(n)
    w, x, y = 1 + normals[:, 2], -normals[:, 1], normals[:, 0]
    spread = math.sqrt(4 * math.pi / n) * torch.exp(0.3 * torch.randn(n, 3, generator=rng))
    means = normals * (1 + 0.01 * torch.randn(n, 1, generator=rng))
    opacity = 0.49 + 0.5 * torch.rand(n, generator=rng)
    return [means, torch.stack([w, x, y, 0 * w], -1), spread * torch.tensor([1, 1, 0.1]), opacity]


def camera(size: int) -> list[Tensor]:
    """Rotation, translation and intrinsics of a square image, of whose width the unit sphere covers nine tenths."""
    return [torch.eye(3), torch.tensor([0, 0, 3.0]), torch.tensor([1.3 * size, 1.3 * size, size / 2, size / 2])]


if __name__ == "__main__":
    main()
