"""CUDA kernels of shading: lobes, lookups of light, and the photometric term of shaded pixels (see `_warp/`)."""

import math
from functools import cache
from typing import Any

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from tumble.backends import Lobes, SampledView, ShadingLight, reference
from tumble.backends._cuda_terms import by_pixel, gradient_buffer, scaled, split_by_name


def shade(
    normal: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
    view: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "q words"],
    blocker: Int32[Tensor, "#q #d"],
    rows: Int64[Tensor, " p"],
    blocker_radiance: Float[Tensor, "m 3"],
) -> Lobes:
    """See `Backend.shade`."""
    rest = directions, radiance, visibility, blocker, rows, blocker_radiance
    values = _Shade.apply(normal, roughness, view, *rest)
    visible, total = values[:, 6:].detach().unbind(1)
    return Lobes(values[:, :3], values[:, 3:6], visible / total.clamp(min=torch.finfo(total.dtype).tiny))


class _Shade(torch.autograd.Function):
    """`shade` with positional arguments in the same order; the last two results are visible and total weight."""

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import runtime, shading

        tensors = [x.contiguous() for x in args]
        n, d, visibility = len(tensors[0]), len(tensors[3]), tensors[5]
        tensors[6] = tensors[6].expand(len(visibility), d)
        out = tensors[0].new_zeros(n, 8)
        with runtime.stream(out.device):
            runtime.launch(shading.shade_forward, (n, runtime.LANES), *tensors, out)
        ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        from tumble.backends._warp import runtime

        radiance, blocker_radiance = ctx.saved_tensors[4], ctx.saved_tensors[8]
        seeds = v_out[:, :3].contiguous(), v_out[:, 3:6].contiguous()
        v_points = v_out.new_zeros(len(v_out), 7)
        gradients = v_points, torch.zeros_like(radiance), torch.zeros_like(blocker_radiance)
        with runtime.stream(v_out.device):
            _shade_adjoint(ctx.saved_tensors, seeds, gradients)
        v_normal, v_view, v_roughness = v_points.split([3, 3, 1], 1)
        return v_normal, v_roughness[:, 0], v_view, None, gradients[1], None, None, None, gradients[2]


def _shade_adjoint(
    inputs: tuple[Tensor, ...], seeds: tuple[Tensor, Tensor], gradients: tuple[Tensor, Tensor, Tensor]
) -> None:
    """Add the gradients of points, radiance and radiance of blockers to those given."""
    from tumble.backends._warp import runtime, shading

    *surface, directions, _, visibility, blocker, rows, _ = inputs
    n, groups = len(rows), -(-len(rows) // shading.POINTS)
    runtime.launch(shading.shade_adjoint, (n, runtime.LANES), *inputs, *seeds, gradients[0])
    seen = *surface, directions, visibility, blocker, rows
    runtime.launch(shading.light_adjoint, (groups, len(directions)), *seen, *seeds, *gradients[1:])


def lookup(
    stack: Float[Tensor, "levels h w 3"],
    directions: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
) -> Float[Tensor, "p 3"]:
    """See `Backend.lookup`."""
    return _Lookup.apply(stack, directions, roughness)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import lookups, runtime

        inputs = [x.contiguous() for x in args]
        out = torch.empty_like(inputs[1])
        with runtime.stream(out.device):
            runtime.launch(lookups.lookup_forward, len(out), *inputs, out)
        ctx.save_for_backward(*inputs)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        from tumble.backends._warp import lookups, runtime

        stack, directions, roughness = ctx.saved_tensors
        gradients = torch.zeros_like(stack), torch.empty_like(directions), torch.empty_like(roughness)
        with runtime.stream(v_out.device):
            runtime.launch(lookups.lookup_adjoint, len(v_out), *ctx.saved_tensors, v_out.contiguous(), *gradients)
        return gradients


def shading_term(
    view: SampledView,
    light: ShadingLight,
    R_cam_obj: Float[Tensor, "3 3"],
    R_env_obj: Float[Tensor, "3 3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    f0: Float[Tensor, "3"],
) -> Float[Tensor, ""]:
    """See `Backend.shading_term`."""
    moving = (view.features, view.alpha, view.normal, light.stack, light.albedo, f0, R_cam_obj, R_env_obj)
    seen = (light.directions, light.visibility, light.blocker, light.transfer, light.table)
    return _ShadingTerm.apply(*moving, view.dominant, view.photo, view.pixels, *seen, fx_fy_cx_cy)


_MOVING: tuple[str, ...] = ("features", "alpha", "normal", "stack", "albedo", "f0", "R_cam_obj", "R_env_obj")
"""Differentiable arguments of `shading_term`."""
_REST: tuple[str, ...] = (
    *("dominant", "photo", "pixels", "directions", "visibility", "blocker", "transfer", "table", "focal"),
)
"""The other arguments."""


class _ShadingTerm(torch.autograd.Function):
    """The kernels compute value and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import runtime

        inputs = dict(zip((*_MOVING, *_REST), (by_pixel(x) for x in args), strict=True))
        others = [name for name in _MOVING if name != "albedo"]
        term, kept, gradients = gradient_buffer(ctx, 1, {name: inputs[name] for name in _MOVING}, *others)
        with runtime.stream(kept.device):
            _shade_pixels(inputs, term[None], gradients)
        ctx.save_for_backward(kept)
        ctx.of_term = dict.fromkeys(_MOVING, 0)
        return term[0]

    @staticmethod
    def backward(ctx: Any, v_term: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return scaled(ctx, v_term[None])


def _shade_pixels(x: dict[str, Tensor], term: Tensor, gradients: dict[str, Tensor]) -> None:
    """Add the term, and write its gradients."""
    from tumble.backends._warp import lookups, pixel_shading, runtime, sh_lighting, shading

    p, d = len(x["pixels"]), len(x["directions"])
    names = {"features", "alpha", "normal", "photo", "dominant"}
    inputs: dict[str, Any] = x | {name: x[name].flatten(0, 1) for name in names}
    inputs |= {"width": x["alpha"].shape[1], "cell": d**-0.25}
    to = {name: gradients[name].flatten(0, 1) for name in ("features", "alpha", "normal")}
    to |= {"f0": gradients["f0"][None], **{name: gradients[name] for name in ("R_cam_obj", "R_env_obj")}}
    n = len(x["albedo"])
    a = _arrays(p, d, n, term)
    runtime.launch(pixel_shading.find_points, d + p, inputs, a)
    runtime.launch(lookups.lookup_forward, d + p, x["stack"], a["looked"], a["levels"], a["light"])
    directions = x["directions"], a["light"][:d]
    if n:
        runtime.launch(sh_lighting.project_radiance, runtime.whole_warps(d), *directions, a["coefficients"])
        bounce = x["albedo"], x["transfer"], a["coefficients"]
        runtime.launch(sh_lighting.bounce_forward, n, *bounce, a["bounced"])
    lobes = *(a[name] for name in ("normal", "roughness", "view")), *directions, x["visibility"]
    lobes += x["blocker"].expand(len(x["visibility"]), d), a["rows"], a["bounced"]
    runtime.launch(shading.shade_forward, (p, runtime.LANES), *lobes, a["lobes"])
    runtime.launch(pixel_shading.compare, runtime.whole_warps(p), inputs, a, term, to)
    _shade_adjoint(lobes, (a["v_diffuse"], a["v_specular"]), (a["v_points"], a["v_light"][:d], a["v_bounced"]))
    if n:
        into = gradients["albedo"], a["v_coefficients"]
        runtime.launch(sh_lighting.bounce_adjoint, runtime.whole_warps(n), *bounce, a["v_bounced"], *into)
        runtime.launch(sh_lighting.radiance_adjoint, d, x["directions"], a["v_coefficients"], a["v_light"])
    of_lookups = gradients["stack"], a["v_looked"], a["v_levels"]
    runtime.launch(lookups.lookup_adjoint, d + p, x["stack"], a["looked"], a["levels"], a["v_light"], *of_lookups)
    runtime.launch(pixel_shading.points_adjoint, runtime.whole_warps(d + p), inputs, a, to)


def _arrays(p: int, d: int, n: int, like: Tensor) -> dict[str, Tensor]:
    """Arrays of p points, d directions and n Gaussians: those to which kernels add, with zeros, and others."""
    from tumble.backends._warp.sh_lighting import COEFFICIENTS

    sums = {"lobes": (p, 8), "v_points": (p, 7), "v_light": (d + p, 3), "v_bounced": (n, 3)}
    sums |= {"coefficients": (1, COEFFICIENTS), "v_coefficients": (1, COEFFICIENTS)}
    arrays = split_by_name(like.new_zeros(sum(a * b for a, b in sums.values())), sums)
    others = {name: (p, 3) for name in ("normal", "view", "v_diffuse", "v_specular")}
    others |= {"roughness": (p,), "v_own": (p, 2), "bounced": (n, 3)}
    others |= {"looked": (d + p, 3), "light": (d + p, 3), "v_looked": (d + p, 3)}
    others |= {"levels": (d + p,), "v_levels": (d + p,)}
    arrays |= {name: like.new_empty(shape) for name, shape in others.items()}
    return arrays | {"rows": torch.empty(p, dtype=torch.int64, device=like.device)}


MAX_COLUMNS = 64
"""Number of columns of a map above which fast Fourier transforms are faster than sums."""


def prefilter(radiance: Float[Tensor, "h w 3"], lobes: Float[Tensor, "f rows h"]) -> Float[Tensor, "out w 3"]:
    """See `Backend.prefilter`."""
    if radiance.shape[1] > MAX_COLUMNS:
        return reference.prefilter(radiance, lobes)
    return _Prefilter.apply(radiance, lobes)


class _Prefilter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import prefiltering, runtime

        radiance, ctx.lobes = (x.contiguous() for x in args)
        (height, width, _), (frequencies, rows, _) = radiance.shape, ctx.lobes.shape
        spectrum, filtered = (radiance.new_empty(2, frequencies, x, 3) for x in (height, rows))
        out, waves = radiance.new_empty(height + rows, width, 3), _waves(width, radiance.device)
        with runtime.stream(out.device):
            runtime.launch(prefiltering.transform, (frequencies, height), radiance, 0, 0, waves, spectrum)
            runtime.launch(prefiltering.multiply, (frequencies, rows), spectrum, ctx.lobes, filtered)
            threads = height + rows, width
            runtime.launch(prefiltering.transform_back, threads, radiance, height, 1, filtered, waves, out)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        from tumble.backends._warp import prefiltering, runtime

        (frequencies, rows, height), width, v_out = ctx.lobes.shape, v_out.shape[1], v_out.contiguous()
        v_spectrum, v_filtered = (v_out.new_empty(2, frequencies, x, 3) for x in (height, rows))
        v_radiance, waves = v_out.new_empty(height, width, 3), _waves(width, v_out.device)
        with runtime.stream(v_out.device):
            runtime.launch(prefiltering.transform, (frequencies, rows), v_out, height, 1, waves, v_filtered)
            runtime.launch(prefiltering.multiply, (frequencies, height), v_filtered, ctx.lobes.mT, v_spectrum)
            threads = height, width
            runtime.launch(prefiltering.transform_back, threads, v_out, height, 0, v_spectrum, waves, v_radiance)
        return v_radiance, None


@cache
def _waves(width: int, device: torch.device) -> Float[Tensor, "2 f {width}"]:
    """Cosines and sines of all frequencies at all columns."""
    turns = torch.arange(width // 2 + 1, dtype=torch.float64)[:, None] * torch.arange(width) / width
    return torch.stack([(2 * math.pi * turns).cos(), (2 * math.pi * turns).sin()]).float().to(device)
