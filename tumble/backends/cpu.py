"""The contract of this folder on the processor: float32, SIMD and OpenMP, through a plain C ABI (see `native/`).

`autograd.Function`s around the kernels: save, launch, return. The number of threads is torch's.
"""

import ctypes
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int32
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
    Hits,
    Rendering,
    _native,
)

TILE, RECORD, GEOMETRY, SPAN, CAMERA = 8, 32, 16, 5, 16
"""Sizes in `native/raster.h`."""
WIDE, LEVELS, LEAF, NODE = 16, 8, 14 * 16, 10 * 16
"""Sizes in `native/bvh.h`, the last two in numbers."""
FEATURES_AT_ONCE = 16


def ready(device: torch.device, dtype: torch.dtype) -> str:
    """Empty if the kernels take such tensors and are compiled, else the reason and the fix."""
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
    groups = corners.split(FEATURES_AT_ONCE, 2)
    first, *rest = (Rendering(*_Rasterize.apply(*geometry, group, *camera)) for group in groups)
    if not rest:
        return first
    return first._replace(features=torch.cat([first.features, *(view.features for view in rest)], -1))


class _Raster(ctypes.Structure):
    """`struct Raster` of `native/raster.h`, field by field."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in "means quats scales opacity sh corners R t focal mask".split()),
        *((name, ctypes.c_int) for name in "n k c height width threads".split()),
        *((name, ctypes.c_float) for name in "alpha_max alpha_min T_min facing near near_sigmas corner".split()),
        *((name, ctypes.c_int) for name in "record_size gradient_size channel_vectors mask_stride".split()),
        *((name, ctypes.c_void_p) for name in "record span keys ranks ranks_2 counts tile_start list".split()),
        *((name, ctypes.c_int) for name in "n_drawn n_pairs".split()),
        *((name, ctypes.c_void_p) for name in "rgb alpha depth depth_var normal features weight".split()),
        *((name, ctypes.c_void_p) for name in "touched dominant weight_parts touched_parts".split()),
        *((name, ctypes.c_void_p) for name in "v_rgb v_alpha v_depth v_depth_var v_normal v_features".split()),
        *((name, ctypes.c_void_p) for name in "parts camera_parts v_means v_quats v_scales v_opacity".split()),
        *((name, ctypes.c_void_p) for name in "v_sh v_corners v_camera".split()),
    ]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        *inputs, height, width, mask = args
        inputs = [x.contiguous() for x in inputs]
        n, k, c = len(inputs[0]), inputs[4].shape[1], inputs[5].shape[2]
        mask = (mask if mask.numel() == 1 else mask.expand(height, width)).contiguous()
        r = _raster(n, k, c, height, width, mask.numel() > 1)
        kept = _point(r, dict(zip(_INPUTS, inputs, strict=True)), mask=mask)
        n_tiles = -(-height // TILE) * -(-width // TILE)
        kept += _point(
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
        parts = _point(r, weight_parts=torch.empty(r.threads * n), touched_parts=_int32(r.threads * n))
        kept += _point(r, list=_int32(_native.library().raster_prepare(ctypes.byref(r))))
        _point(r, results)
        _native.library().raster_forward(ctypes.byref(r))
        del parts
        ctx.raster, ctx.kept, ctx.n_inputs = r, kept, len(args)
        ctx.save_for_backward(*inputs, *(results[name] for name in _SEEDED))
        ctx.mark_non_differentiable(results["weight"], results["touched"], results["dominant"])
        return tuple(results.values())

    @staticmethod
    def backward(ctx: Any, *v_results: Any) -> tuple[Tensor | None, ...]:
        r, inputs = ctx.raster, ctx.saved_tensors[: len(_INPUTS)]
        seeds = [v.contiguous() for v in v_results[: len(_SEEDED)]]
        gradients = [torch.empty_like(x) for x in inputs[:6]]
        camera = torch.empty(CAMERA)
        kept = _point(r, dict(zip((f"v_{name}" for name in _SEEDED), seeds, strict=True)), v_camera=camera)
        kept += _point(r, dict(zip((f"v_{name}" for name in _INPUTS[:6]), gradients, strict=True)))
        kept += _point(
            r,
            parts=torch.empty(r.threads * r.n * r.gradient_size),
            camera_parts=torch.empty(r.threads * CAMERA),
        )
        _native.library().raster_adjoint(ctypes.byref(r))
        R, t, focal = camera.split([9, 3, 4])
        return (*gradients, R.view(3, 3), t, focal, None, None, None)


_INPUTS = ("means", "quats", "scales", "opacity", "sh", "corners", "R", "t", "focal")
_SEEDED = ("rgb", "alpha", "depth", "depth_var", "normal", "features")
"""The results that have a gradient."""


def _raster(n: int, k: int, c: int, height: int, width: int, masked: bool) -> _Raster:
    """Sizes and constants of one view."""
    lanes = _native.library().lanes()
    vectors = -(-(6 + -(-c // 4) * 4) // lanes)
    return _Raster(
        n=n,
        k=k,
        c=c,
        height=height,
        width=width,
        threads=torch.get_num_threads(),
        alpha_max=ALPHA_MAX,
        alpha_min=ALPHA_MIN,
        T_min=T_MIN,
        facing=FACING,
        near=NEAR,
        near_sigmas=NEAR_SIGMAS,
        corner=CORNER,
        record_size=RECORD + -(-c // 4) * 16,
        gradient_size=GEOMETRY + vectors * lanes * (4 if c else 1),
        channel_vectors=vectors,
        mask_stride=int(masked),
    )


def _point(struct: ctypes.Structure, tensors: dict[str, Tensor] | None = None, **more: Tensor) -> list[Tensor]:
    """Set pointer fields to tensors; these must outlive the call, so they are handed back."""
    for name, tensor in {**(tensors or {}), **more}.items():
        setattr(struct, name, tensor.data_ptr())
    return [*(tensors or {}).values(), *more.values()]


def _int32(*shape: int) -> Int32[Tensor, "..."]:
    return torch.empty(shape, dtype=torch.int32)


class _Bvh(ctypes.Structure):
    """`struct Bvh` of `native/bvh.h`, field by field."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in "means quats scales opacity".split()),
        *((name, ctypes.c_int) for name in "n n_leaves n_levels".split()),
        ("first_node", ctypes.c_int * LEVELS),
        *((name, ctypes.c_float) for name in "sigmas alpha_max alpha_min T_min visible".split()),
        *((name, ctypes.c_void_p) for name in "leaves nodes boxes normals order".split()),
    ]


class _Rays(ctypes.Structure):
    """`struct Rays` of `native/bvh.h`, field by field."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in "bvh origins directions radiance normals".split()),
        *((name, ctypes.c_int) for name in "n_rays n_directions words threads has_radiance".split()),
        *((name, ctypes.c_void_p) for name in "transmittance out hit bits".split()),
    ]


class Tree(NamedTuple):
    """What `build` hands to the tracing functions."""

    bvh: _Bvh
    memory: list[Tensor]
    """Leaves and nodes, to which the former points."""


@torch.no_grad()
def build(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
) -> Tree:
    """See `Backend.build`."""
    n = len(means)
    counts = [-(-n // WIDE)]
    while len(counts) < 2 or counts[-1] > 1:
        counts.append(max(1, -(-counts[-1] // WIDE)))
    first_node = [sum(counts[1:level]) for level in range(1, len(counts))]
    t = _Bvh(
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
    _point(t, dict(zip(_INPUTS[:4], inputs, strict=True)))
    memory = _point(t, leaves=torch.empty(counts[0] * LEAF), nodes=torch.empty(sum(counts[1:]) * NODE))
    work = _point(t, boxes=torch.empty(n * 6), normals=torch.empty(n * 3), order=_int32(n))
    W = torch.empty(n * 9)
    _native.library().bvh_build(ctypes.byref(t), ctypes.c_void_p(W.data_ptr()))
    del work
    return Tree(t, memory)


@torch.no_grad()
def trace(
    bvh: Tree,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "m 3"],
) -> Hits:
    """See `Backend.trace`."""
    r = len(origins)
    hits = Hits(torch.empty(r), torch.empty(r, 3), _int32(r))
    rays = _rays(bvh, origins, directions, radiance=radiance)
    _point(rays.struct, transmittance=hits.transmittance, out=hits.radiance, hit=hits.hit)
    _native.library().rays_trace(ctypes.byref(rays.struct))
    return hits


@torch.no_grad()
def visible(
    bvh: Tree,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
) -> Int32[Tensor, "p words"]:
    """See `Backend.visible`."""
    rays = _rays(bvh, points, directions, normals=normals)
    bits = _int32(len(points), rays.struct.words)
    _point(rays.struct, bits=bits)
    _native.library().rays_visible(ctypes.byref(rays.struct))
    return bits


@torch.no_grad()
def blockers(
    bvh: Tree,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "p words"],
) -> Int32[Tensor, "p d"]:
    """See `Backend.blockers`."""
    rays = _rays(bvh, points, directions, normals=normals, bits=visibility)
    hit = _int32(len(points), len(directions))
    _point(rays.struct, hit=hit)
    _native.library().rays_blockers(ctypes.byref(rays.struct))
    return hit


class _Launch(NamedTuple):
    struct: _Rays
    kept: list[Tensor]


def _rays(bvh: Tree, origins: Tensor, directions: Tensor, **more: Tensor) -> _Launch:
    """Arguments of a search, and the tensors they point to."""
    struct = _Rays(
        bvh=ctypes.addressof(bvh.bvh),
        n_rays=len(origins),
        n_directions=len(directions),
        words=-(-len(directions) // 32),
        threads=torch.get_num_threads(),
        has_radiance=int("radiance" in more and len(more["radiance"]) > 0),
    )
    tensors = {"origins": origins, "directions": directions, **more}
    return _Launch(struct, _point(struct, {name: x.contiguous() for name, x in tensors.items()}))


class _Shade(ctypes.Structure):
    """`struct Shade` of `native/shade.h`, field by field."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in "normal albedo roughness view directions radiance".split()),
        *((name, ctypes.c_void_p) for name in "visibility blocker blocker_radiance".split()),
        *((name, ctypes.c_int) for name in "n_points n_directions stride words n_blockers threads".split()),
        *((name, ctypes.c_int) for name in "blocker_point_stride blocker_direction_stride".split()),
        *((name, ctypes.c_float) for name in "f0 roughness_min".split()),
        *((name, ctypes.c_void_p) for name in "out v_out radiance_parts blocker_parts".split()),
        *((name, ctypes.c_void_p) for name in "v_normal v_albedo v_roughness v_view".split()),
        *((name, ctypes.c_void_p) for name in "v_radiance v_blocker_radiance".split()),
    ]


def shade(
    normal: Float[Tensor, "p 3"],
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, " p"],
    view: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "p words"],
    blocker: Int32[Tensor, "#p #d"],
    blocker_radiance: Float[Tensor, "m 3"],
    f0: float,
) -> Float[Tensor, "p 3"]:
    """See `Backend.shade`."""
    surface = (normal, albedo, roughness, view)
    return _ShadeFunction.apply(*surface, radiance, blocker_radiance, directions, visibility, blocker, f0)


class _ShadeFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        *tensors, f0 = args
        tensors = [x.contiguous() for x in tensors]
        out = torch.empty_like(tensors[0])
        struct, kept = _shade_launch(tensors, f0)
        _point(struct, out=out)
        _native.library().shade_forward(ctypes.byref(struct))
        ctx.f0 = f0
        ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        tensors = ctx.saved_tensors
        struct, kept = _shade_launch(tensors, ctx.f0)
        *v_surface, v_radiance, v_blocker = (torch.empty_like(x) for x in tensors[:6])
        v_rows = torch.empty(3, struct.stride)
        kept += _point(struct, dict(zip(("v_normal", "v_albedo", "v_roughness", "v_view"), v_surface, strict=True)))
        kept += _point(
            struct,
            v_out=v_out.contiguous(),
            v_radiance=v_rows,
            v_blocker_radiance=v_blocker,
            radiance_parts=torch.empty(struct.threads * v_rows.numel()),
            blocker_parts=torch.empty(struct.threads * v_blocker.numel()),
        )
        _native.library().shade_adjoint(ctypes.byref(struct))
        v_radiance = v_rows[:, : len(v_radiance)].T
        return (*v_surface, v_radiance, v_blocker, None, None, None, None)


def _shade_launch(tensors: Any, f0: float) -> tuple[_Shade, list[Tensor]]:
    """Arguments of a shading, and the tensors they point to. Directions and radiance become padded rows."""
    normal, albedo, roughness, view, radiance, blocker_radiance, directions, visibility, blocker = tensors
    lanes = _native.library().lanes()
    padding = -len(directions) % lanes
    rows = {"directions": directions, "radiance": radiance}
    rows = {name: torch.nn.functional.pad(x.T, (0, padding)) for name, x in rows.items()}
    struct = _Shade(
        n_points=len(normal),
        n_directions=len(directions),
        stride=len(directions) + padding,
        words=visibility.shape[1],
        n_blockers=len(blocker_radiance),
        threads=torch.get_num_threads(),
        blocker_point_stride=blocker.stride(0) if blocker.shape[0] > 1 else 0,
        blocker_direction_stride=blocker.stride(1) if blocker.shape[1] > 1 else 0,
        f0=f0,
        roughness_min=ROUGHNESS_MIN,
    )
    rest = {"normal": normal, "albedo": albedo, "roughness": roughness, "view": view, "visibility": visibility}
    kept = _point(struct, {**rows, **rest}, blocker=blocker, blocker_radiance=blocker_radiance)
    return struct, kept
