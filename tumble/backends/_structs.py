"""Argument structures of the CPU kernels as ctypes, with the fields of those in `native/`.

Their sizes are compared with those of the library when it is loaded.
"""

import ctypes
from collections.abc import Mapping
from typing import Any

from torch import Tensor

LEVELS = 8
"""Maximum number of levels of a tree, enough for 16^8 leaves."""


def _pointers(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_void_p) for name in names.split()]


def _ints(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int) for name in names.split()]


def _floats(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_float) for name in names.split()]


class Raster(ctypes.Structure):
    """`Raster` of `native/raster.h`: arguments of the rasterizer."""

    _fields_ = [
        *_pointers("means quats scales opacity sh corners R t focal mask"),
        *_ints("n k c height width threads"),
        *_floats("alpha_max alpha_min T_min facing near near_sigmas corner"),
        *_ints("record_size gradient_size fixed_width corner_width mask_stride"),
        *_pointers("record span keys ranks ranks_2 counts tile_start list"),
        *_ints("n_drawn n_pairs"),
        *_pointers("rgb alpha depth depth_var normal features weight touched dominant weight_parts touched_parts"),
        *_pointers("v_rgb v_alpha v_depth v_depth_var v_normal v_features parts camera_parts"),
        *_pointers("v_means v_quats v_scales v_opacity v_sh v_corners v_camera"),
    ]


class Bvh(ctypes.Structure):
    """`Bvh` of `native/bvh.h`: the search tree."""

    _fields_ = [
        *_pointers("means quats scales opacity"),
        *_ints("n n_leaves n_levels"),
        ("first_node", ctypes.c_int * LEVELS),
        *_floats("sigmas alpha_max alpha_min T_min visible"),
        *_pointers("leaves nodes boxes normals order"),
    ]


class Rays(ctypes.Structure):
    """`Rays` of `native/bvh.h`: arguments of the tracer."""

    _fields_ = [
        *_pointers("bvh origins directions radiance normals"),
        *_ints("n_rays n_directions words threads has_radiance"),
        *_pointers("transmittance out hit bits"),
    ]


class Shade(ctypes.Structure):
    """`Shade` of `native/shade.h`: arguments of shading."""

    _fields_ = [
        *_pointers("normal albedo roughness view directions radiance visibility blocker blocker_radiance"),
        *_ints("n_points n_directions stride words n_blockers threads blocker_point_stride blocker_direction_stride"),
        *_floats("f0 roughness_min"),
        *_pointers("out v_out radiance_parts blocker_parts"),
        *_pointers("v_normal v_albedo v_roughness v_view v_radiance v_blocker_radiance"),
    ]


STRUCTURES = (Raster, Bvh, Rays, Shade)
"""All structures, in the order of `sizes` in `native/kernels.cpp`."""


def set_pointers(
    struct: ctypes.Structure, tensors: Mapping[str, Tensor | None] | None = None, **more: Tensor | None
) -> list[Tensor]:
    """Set pointer fields to the data of tensors, or to null; returns the tensors, which must outlive the call."""
    for name, tensor in {**(tensors or {}), **more}.items():
        setattr(struct, name, None if tensor is None else tensor.data_ptr())
    return [x for x in [*(tensors or {}).values(), *more.values()] if x is not None]
