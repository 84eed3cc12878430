"""Depth fusion, texture baking and bundle adjustment on the CPU (`native/maps.h`, `native/bundle.h`)."""

import ctypes
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from tumble.backends import _native, threads
from tumble.backends._geometry.contract import BundleObservations, BundleVariables, Cameras, DepthMaps, ReducedBundle
from tumble.backends._structs import Baking, Bundle, Fusion, set_pointers

BUNDLE_POINT = 12
"""Numbers of a point in `native/bundle.h`."""


@torch.no_grad()
def fuse(
    points: Float[Tensor, "n 3"], maps: DepthMaps, cameras: Cameras, *, cell: float, reach: float, distance: float
) -> Float[Tensor, "5 n"]:
    """See `FuseKernel`."""
    out = points.new_empty(5, len(points))
    views, height, width = maps.index.shape
    struct = Fusion(
        n=len(points), n_views=views, cell=cell, reach=reach, distance=distance, **_size(height, width, cameras)
    )
    named = {"points": points, **maps._asdict(), **cameras._asdict()}
    del named["fx_fy_cx_cy"]
    kept = set_pointers(struct, {name: x.contiguous() for name, x in named.items()}, out=out)
    _native.library().maps_fuse(ctypes.byref(struct))
    del kept
    return out


@torch.no_grad()
def blend(
    total: Float[Tensor, "n 7"],
    weights: Float[Tensor, " n"],
    maps: Float[Tensor, "h w 9"],
    camera: Cameras,
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    *,
    min_cosine: float,
    tolerance: float,
) -> None:
    """See `BlendKernel`."""
    size = _size(maps.shape[0], maps.shape[1], camera)
    struct = Baking(n=len(points), min_cosine=min_cosine, tolerance=tolerance, **size)
    named = {"maps": maps, "points": points, "normals": normals, "R": camera.R, "t": camera.t}
    named["position"] = camera.positions
    kept = set_pointers(struct, {name: x.contiguous() for name, x in named.items()}, total=total, weights=weights)
    _native.library().maps_blend(ctypes.byref(struct))
    del kept


def _size(height: int, width: int, cameras: Cameras) -> dict[str, Any]:
    """Size of maps, intrinsics of their cameras, and number of threads, as fields of a structure."""
    intrinsics = dict(zip(("fx", "fy", "cx", "cy"), cameras.fx_fy_cx_cy.tolist(), strict=True))
    return {"height": height, "width": width, "threads": threads(), **intrinsics}


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
