"""CPU backend: kernels in C++ with SIMD and threads, called through a plain C ABI (see `native/`).

This file wraps the kernels in `autograd.Function`s.
"""

import ctypes
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor

from tumble.backends import (
    ALPHA_MAX,
    ALPHA_MIN,
    CORNER,
    FACING,
    NEAR,
    NEAR_SIGMAS,
    ROUGHNESS_MIN,
    T_MIN,
    TRACE_SIGMAS,
    TRACE_T_MIN,
    VISIBLE,
    BundleObservations,
    BundleVariables,
    GlossyGaussians,
    Hits,
    LightTables,
    Lobes,
    ReducedBundle,
    Rendering,
    SurfaceSamples,
    _native,
    threads,
)
from tumble.backends._cpu_terms import (
    bounce,
    corner_features,
    gaussian_terms,
    image_terms,
    material_terms,
    sh_shade,
)
from tumble.backends._structs import Bundle, Bvh, Lookup, Raster, Rays, Relight, Shade, scratch, set_pointers

__all__ = [
    "blockers",
    "bounce",
    "build",
    "bundle_cost",
    "bundle_move",
    "bundle_reduce",
    "corner_features",
    "gaussian_terms",
    "image_terms",
    "lookup",
    "material_terms",
    "rasterize",
    "ready",
    "relight",
    "sh_shade",
    "shade",
    "trace",
    "visible",
]

TILE = 8
"""Side of a tile in `native/raster.h` [pixels]."""
RECORD = 32
"""Numbers of a Gaussian's record in `native/raster.h`, without features."""
GEOMETRY = 16
"""Numbers of a Gaussian's gradient in `native/raster.h`, without colour, normal and features."""
SPAN = 5
"""Numbers of a Gaussian's footprint on screen in `native/raster.h`."""
CAMERA = 16
"""Numbers of the camera's gradient in `native/raster.h`."""
WIDE = 16
"""Children of a node, and Gaussians of a leaf, in `native/bvh.h`."""
LEVELS = 8
"""Maximum number of levels of the tree in `native/bvh.h`."""
LEAF = 20 * 16
"""Numbers of a leaf in `native/bvh.h`."""
LEAF_FIELDS = 15
"""Numbers of a Gaussian that are computed for its leaf."""
NODE = 10 * 16
"""Numbers of a node in `native/bvh.h`."""
BUNDLE_POINT = 12
"""Numbers of a point in `native/bundle.h`."""
FEATURES_PER_PASS = 16
"""Maximum number of features that the kernels blend in one pass; more are split into several passes."""
MAX_GRADIENT_SCRATCH = 1 << 28
"""Maximum size of the gradient sums of all threads (1 GiB) [numbers]; with many Gaussians fewer threads are used."""


def ready(device: torch.device, dtype: torch.dtype) -> str:
    """Empty if the kernels accept such tensors and are compiled, else the reason and the fix."""
    if device.type != "cpu" or dtype != torch.float32:
        return f"the kernels take float32 on the CPU, not {dtype} on {device}"
    try:
        _native.library()
    except _native.CannotCompile as reason:
        return str(reason)
    return ""


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
    sh: Float[Tensor, "n k 3"],
    corners: Float[Tensor, "n 4 c"],
    R_cam_obj: Float[Tensor, "3 3"],
    t_cam_obj: Float[Tensor, "3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    height: int,
    width: int,
    mask: Float[Tensor, "#h #w"],
) -> Rendering:
    """One view of the Gaussians; see `Backend.rasterize`."""
    geometry = (means, quats, scales, opacity, sh)
    camera = (R_cam_obj, t_cam_obj, fx_fy_cx_cy, height, width, mask)
    # Without slicing where possible, because the gradient of a full slice would be copied.
    group = corners if corners.shape[2] <= FEATURES_PER_PASS else corners[..., :FEATURES_PER_PASS]
    first = Rendering(*_Rasterize.apply(*geometry, group, *camera))
    if corners.shape[2] <= FEATURES_PER_PASS:
        return first
    rest = rasterize(*geometry, corners[..., FEATURES_PER_PASS:], *camera)
    return first._replace(features=torch.cat([first.features, rest.features], -1))


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        *inputs, height, width, mask = args
        inputs = [x.contiguous() for x in inputs]
        n, k, c = len(inputs[0]), inputs[4].shape[1], inputs[5].shape[2]
        mask = (mask if mask.numel() == 1 else mask.expand(height, width)).contiguous()
        r = _raster(n, k, c, height, width, mask.numel() > 1)
        kept = set_pointers(r, dict(zip(_INPUTS, inputs, strict=True)), mask=mask)
        n_tiles = -(-height // TILE) * -(-width // TILE)
        kept += set_pointers(
            r,
            record=torch.empty(n * r.record_size),
            span=torch.empty(n * SPAN),
            keys=_int32(n),
            ranks=_int32(n),
            ranks_2=_int32(n),
            counts=_int32(r.threads * n_tiles),
            tile_start=_int32(n_tiles + 1),
        )
        results = {
            "rgb": torch.empty(height, width, 3),
            "alpha": torch.empty(height, width),
            "depth": torch.empty(height, width),
            "depth_var": torch.empty(height, width),
            "normal": torch.empty(height, width, 3),
            "features": torch.empty(height, width, c),
            "weight": torch.empty(n),
            "touched": _int32(n),
            "dominant": _int32(height, width),
        }
        parts = set_pointers(r, weight_parts=torch.empty(r.threads * n), touched_parts=_int32(r.threads * n))
        kept += set_pointers(r, list=_int32(_native.library().raster_prepare(ctypes.byref(r))))
        set_pointers(r, results)
        _native.library().raster_forward(ctypes.byref(r))
        del parts
        ctx.raster, ctx.kept, ctx.n_inputs = r, kept, len(args)
        ctx.save_for_backward(*inputs, *(results[name] for name in _SEEDED))
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(results["weight"], results["touched"], results["dominant"])
        return tuple(results.values())

    @staticmethod
    def backward(ctx: Any, *v_results: Any) -> tuple[Tensor | None, ...]:
        r, inputs = ctx.raster, ctx.saved_tensors[: len(_INPUTS)]
        seeds = [None if v is None else v.contiguous() for v in v_results[: len(_SEEDED)]]
        # If only features need gradients, the kernel skips those of geometry and pose, half of the work.
        needs_geometry = any((*ctx.needs_input_grad[:5], *ctx.needs_input_grad[6:9]))
        gradients = [torch.empty_like(x) if needs_geometry or x is inputs[5] else None for x in inputs[:6]]
        camera = torch.empty(CAMERA)
        kept = set_pointers(r, dict(zip((f"v_{name}" for name in _SEEDED), seeds, strict=True)), v_camera=camera)
        kept += set_pointers(r, dict(zip((f"v_{name}" for name in _INPUTS[:6]), gradients, strict=True)))
        kept += set_pointers(
            r,
            parts=scratch(r.threads * r.n * r.gradient_size),
            camera_parts=torch.empty(r.threads * CAMERA),
        )
        _native.library().raster_adjoint(ctypes.byref(r))
        if not needs_geometry:
            return (*gradients, *(None for _ in range(6)))
        R, t, focal = camera.split([9, 3, 4])
        return (*gradients, R.view(3, 3), t, focal, None, None, None)


_INPUTS = ("means", "quats", "scales", "opacity", "sh", "corners", "R", "t", "focal")
"""Differentiable inputs of the rasterizer."""
_SEEDED = ("rgb", "alpha", "depth", "depth_var", "normal", "features")
"""Differentiable results of the rasterizer."""


def _raster(n: int, k: int, c: int, height: int, width: int, masked: bool) -> Raster:
    """Arguments of the rasterizer with the sizes and constants of one view."""
    lanes = _native.library().lanes()
    c_drawn = -(-c // 4) * 4
    fixed_width, corner_width = (-(-x // lanes) * lanes for x in (6, c_drawn))
    gradient_size = GEOMETRY + fixed_width + 4 * corner_width
    return Raster(
        n=n,
        k=k,
        c=c,
        height=height,
        width=width,
        threads=max(1, min(threads(), MAX_GRADIENT_SCRATCH // max(1, n * gradient_size))),
        alpha_max=ALPHA_MAX,
        alpha_min=ALPHA_MIN,
        T_min=T_MIN,
        facing=FACING,
        near=NEAR,
        near_sigmas=NEAR_SIGMAS,
        corner=CORNER,
        record_size=RECORD + 4 * c_drawn,
        gradient_size=gradient_size,
        fixed_width=fixed_width,
        corner_width=corner_width,
        mask_stride=int(masked),
    )


def _int32(*shape: int) -> Int32[Tensor, "..."]:
    return torch.empty(shape, dtype=torch.int32)


class CpuBvh(NamedTuple):
    """The result of `build`: a search tree and its memory."""

    bvh: Bvh
    memory: list[Tensor]
    """Leaves and nodes, to which `bvh` points."""


@torch.no_grad()
def build(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
) -> CpuBvh:
    """See `Backend.build`."""
    n = len(means)
    counts = [-(-n // WIDE)]
    while len(counts) < 2 or counts[-1] > 1:
        counts.append(max(1, -(-counts[-1] // WIDE)))
    first_node = [sum(counts[1:level]) for level in range(1, len(counts))]
    t = Bvh(
        n=n,
        n_leaves=counts[0],
        n_levels=len(first_node),
        first_node=(ctypes.c_int * LEVELS)(*first_node),
        sigmas=TRACE_SIGMAS,
        alpha_max=ALPHA_MAX,
        alpha_min=ALPHA_MIN,
        T_min=TRACE_T_MIN,
        visible=VISIBLE,
    )
    inputs = [x.contiguous() for x in (means, quats, scales, opacity)]
    set_pointers(t, dict(zip(_INPUTS[:4], inputs, strict=True)))
    memory = set_pointers(t, leaves=torch.empty(counts[0] * LEAF), nodes=torch.empty(sum(counts[1:]) * NODE))
    work = set_pointers(t, boxes=torch.empty(n * 6), normals=torch.empty(n * 3), order=_int32(n))
    fields = torch.empty(n * LEAF_FIELDS)
    _native.library().bvh_build(ctypes.byref(t), ctypes.c_void_p(fields.data_ptr()))
    del work
    return CpuBvh(t, memory)


@torch.no_grad()
def trace(
    bvh: CpuBvh,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "m 3"],
) -> Hits:
    """See `Backend.trace`."""
    r = len(origins)
    hits = Hits(torch.empty(r), torch.empty(r, 3), _int32(r))
    rays = _rays(bvh, origins, directions, radiance=radiance)
    set_pointers(rays.struct, transmittance=hits.transmittance, out=hits.radiance, hit=hits.hit)
    _native.library().rays_trace(ctypes.byref(rays.struct))
    return hits


@torch.no_grad()
def visible(
    bvh: CpuBvh,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
) -> Int32[Tensor, "p words"]:
    """See `Backend.visible`."""
    rays = _rays(bvh, points, directions, normals=normals)
    bits = _int32(len(points), rays.struct.words)
    set_pointers(rays.struct, bits=bits)
    _native.library().rays_visible(ctypes.byref(rays.struct))
    return bits


@torch.no_grad()
def blockers(
    bvh: CpuBvh,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "p words"],
) -> Int32[Tensor, "p d"]:
    """See `Backend.blockers`."""
    rays = _rays(bvh, points, directions, normals=normals, bits=visibility)
    hit = _int32(len(points), len(directions))
    set_pointers(rays.struct, hit=hit)
    _native.library().rays_blockers(ctypes.byref(rays.struct))
    return hit


class _RaysLaunch(NamedTuple):
    """Arguments of the tracer, and the tensors that they point to."""

    struct: Rays
    kept: list[Tensor]


def _rays(bvh: CpuBvh, origins: Tensor, directions: Tensor, **more: Tensor) -> _RaysLaunch:
    """Arguments of the tracer; `more` are further pointer fields of `Rays`."""
    struct = Rays(
        bvh=ctypes.addressof(bvh.bvh),
        n_rays=len(origins),
        n_directions=len(directions),
        words=-(-len(directions) // 32),
        threads=threads(),
        has_radiance=int("radiance" in more and len(more["radiance"]) > 0),
    )
    tensors = {"origins": origins, "directions": directions, **more}
    return _RaysLaunch(struct, set_pointers(struct, {name: x.contiguous() for name, x in tensors.items()}))


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
    rest = directions, visibility, blocker, rows
    return Lobes(*_ShadeFunction.apply(normal, roughness, view, radiance, blocker_radiance, *rest))


class _ShadeFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> tuple[Tensor, ...]:
        tensors = [x.contiguous() for x in args]
        diffuse, specular = torch.empty_like(tensors[0]), torch.empty_like(tensors[0])
        fraction = torch.empty_like(tensors[1])
        struct, kept = _shade_launch(tensors)
        set_pointers(struct, diffuse=diffuse, specular=specular, specular_visibility=fraction)
        _native.library().shade_forward(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(fraction)
        return diffuse, specular, fraction

    @staticmethod
    def backward(ctx: Any, *v_results: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        tensors = ctx.saved_tensors
        struct, kept = _shade_launch(tensors)
        *v_surface, v_radiance, v_blocker = (torch.empty_like(x) for x in tensors[:5])
        v_rows = torch.empty(3, struct.stride)
        kept += set_pointers(struct, dict(zip(("v_normal", "v_roughness", "v_view"), v_surface, strict=True)))
        kept += set_pointers(
            struct,
            v_diffuse=v_results[0].contiguous(),
            v_specular=v_results[1].contiguous(),
            v_radiance=v_rows,
            v_blocker_radiance=v_blocker,
            radiance_parts=torch.empty(struct.threads * v_rows.numel()),
            blocker_parts=torch.empty(struct.threads * v_blocker.numel()),
        )
        _native.library().shade_adjoint(ctypes.byref(struct))
        v_radiance = v_rows[:, : len(v_radiance)].T
        return (*v_surface, v_radiance, v_blocker, None, None, None, None)


def _shade_launch(tensors: Any) -> tuple[Shade, list[Tensor]]:
    """Arguments of shading and the tensors that they point to; directions and radiance become padded rows."""
    normal, roughness, view, radiance, blocker_radiance, directions, visibility, blocker, index = tensors
    lanes = _native.library().lanes()
    padding = -len(directions) % lanes
    rows = {"directions": directions, "radiance": radiance}
    rows = {name: torch.nn.functional.pad(x.T, (0, padding)).contiguous() for name, x in rows.items()}
    struct = Shade(
        n_points=len(normal),
        n_directions=len(directions),
        stride=len(directions) + padding,
        words=visibility.shape[1],
        n_blockers=len(blocker_radiance),
        threads=threads(),
        blocker_point_stride=blocker.stride(0) if blocker.shape[0] > 1 else 0,
        blocker_direction_stride=blocker.stride(1) if blocker.shape[1] > 1 else 0,
        roughness_min=ROUGHNESS_MIN,
    )
    rest = {"normal": normal, "roughness": roughness, "view": view, "visibility": visibility, "rows": index}
    kept = set_pointers(struct, {**rows, **rest}, blocker=blocker, blocker_radiance=blocker_radiance)
    return struct, kept


def lookup(
    stack: Float[Tensor, "levels h w 3"],
    directions: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
) -> Float[Tensor, "p 3"]:
    """See `Backend.lookup`."""
    return _LookupFunction.apply(stack, directions, roughness)


class _LookupFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        tensors = [x.contiguous() for x in args]
        out = torch.empty_like(tensors[1])
        struct, kept = _lookup_launch(tensors, out=out)
        _native.library().lookup_forward(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        gradients = [torch.empty_like(x) for x in ctx.saved_tensors]
        named = dict(zip(("v_stack", "v_directions", "v_roughness"), gradients, strict=True))
        struct, kept = _lookup_launch(ctx.saved_tensors, v_out=v_out.contiguous(), **named)
        _native.library().lookup_backward(ctypes.byref(struct))
        del kept
        return tuple(gradients)


def _lookup_launch(tensors: Any, **more: Tensor) -> tuple[Lookup, list[Tensor]]:
    """Arguments of lookups, and the tensors that they point to."""
    stack, directions, roughness = tensors
    levels, height, width, _ = stack.shape
    struct = Lookup(n=len(directions), levels=levels, height=height, width=width)
    named = {"stack": stack, "directions": directions, "roughness": roughness}
    return struct, set_pointers(struct, named | more)


@torch.no_grad()
def relight(
    bvh: CpuBvh,
    surface: SurfaceSamples,
    light: LightTables,
    gaussians: GlossyGaussians | None,
    R_env_obj: Float[Tensor, "3 3"],
    n_brdf: int,
    f0: float,
) -> Float[Tensor, "p 3"]:
    """See `RelightKernel`."""
    padded = torch.nn.functional.pad(surface.lattice.T, (0, _native.library().lanes()))
    out = torch.empty_like(surface.albedo)
    struct = Relight(
        bvh=ctypes.addressof(bvh.bvh),
        n_points=len(out),
        n_brdf=n_brdf,
        n_samples=len(surface.lattice),
        stride=padded.shape[1],
        threads=threads(),
        height=light.radiance.shape[0],
        width=light.radiance.shape[1],
        rows=light.density.shape[0],
        columns=light.density.shape[1],
        row_buckets=len(light.row_guide) - 1,
        column_buckets=light.column_guide.shape[1] - 1,
        f0=f0,
        roughness_min=ROUGHNESS_MIN,
    )
    named = {**surface._asdict(), **light._asdict(), "lattice": padded, "R": R_env_obj}
    named["light"] = named.pop("radiance")
    if gaussians is not None:
        struct.levels, struct.stack_height, struct.stack_width, _ = gaussians.stack.shape
        struct.table_size = len(gaussians.table)
        named |= {"gaussian_normals": gaussians.normals, "gaussian_roughness": gaussians.roughness}
        named |= {"radiance": gaussians.radiance, "stack": gaussians.stack, "table": gaussians.table}
    kept = set_pointers(struct, {name: x.contiguous() for name, x in named.items()}, out=out)
    _native.library().relight_points(ctypes.byref(struct))
    del kept
    return out


# Bundle adjustment ----------------------------------------------------------------------------------------------------


def bundle_cost(observations: BundleObservations, variables: BundleVariables) -> Float64[Tensor, " g"]:
    """See `BundleKernel.bundle_cost`."""
    struct, kept = _bundle(observations, variables)
    cost = variables.prior.new_empty(len(variables.prior))
    set_pointers(struct, cost=cost)
    _native.library().bundle_cost(ctypes.byref(struct))
    del kept
    return cost


def bundle_reduce(
    observations: BundleObservations,
    variables: BundleVariables,
    damping: Float64[Tensor, " g"],
    *,
    focal_free: bool,
) -> ReducedBundle:
    """See `BundleKernel.bundle_reduce`."""
    struct, kept = _bundle(observations, variables)
    g, f = struct.n_groups, struct.n_cameras
    row = -(-6 // (_native.library().lanes() // 2)) * (_native.library().lanes() // 2)
    empty = variables.X.new_empty
    camera_rows = {name: empty(g * f, 6) for name in ("g_camera", "e")}
    focal = {"focal_camera": empty(g * f, 6), "focal_e": empty(g * f, 6), "focal_sums": empty(g, 4)}
    results: dict[str, Any] = {"U": empty(g * f, 6, 6), "E": empty(g, 6 * f, 6 * f), **camera_rows}
    results |= focal if focal_free else dict.fromkeys(focal)
    points = empty(len(observations.camera), 3 * row), empty(len(variables.X), BUNDLE_POINT)
    memory = empty(struct.threads * ((f * f + f) * 6 * row + 4 * f * row))
    kept += set_pointers(struct, results, damping=damping, records=points[0], point_records=points[1], scratch=memory)
    _native.library().bundle_reduce(ctypes.byref(struct))
    del kept
    return ReducedBundle(**results, points=(variables, *points))


def bundle_move(
    observations: BundleObservations,
    reduced: ReducedBundle,
    d_camera: Float64[Tensor, "c 6"],
    d_focal: Float64[Tensor, " g"] | None,
) -> Float64[Tensor, "n 3"]:
    """See `BundleKernel.bundle_move`."""
    variables, records, point_records = reduced.points
    struct, kept = _bundle(observations, variables)
    moved = variables.X.new_empty(variables.X.shape)
    kept += set_pointers(struct, records=records, point_records=point_records, d_point=moved)
    kept += set_pointers(struct, d_camera=d_camera.contiguous(), d_focal=d_focal)
    _native.library().bundle_move(ctypes.byref(struct))
    del kept
    return moved


def _bundle(observations: BundleObservations, variables: BundleVariables) -> tuple[Bundle, list[Tensor]]:
    """Arguments that all functions of bundle adjustment have, and the tensors that they point to."""
    groups = len(variables.prior)
    (cx, cy), scale, min_depth = observations.principal, observations.scale, observations.min_depth
    sizes = {"n_groups": groups, "n_cameras": len(variables.t) // groups, "threads": min(threads(), groups)}
    struct = Bundle(**sizes, scale=scale, min_depth=min_depth, cx=cx, cy=cy)
    named = {name: x for name, x in observations._asdict().items() if isinstance(x, Tensor)} | variables._asdict()
    return struct, set_pointers(struct, {name: x.contiguous() for name, x in named.items()})
