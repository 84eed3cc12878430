"""Argument structures of the CPU kernels as ctypes, with the fields of those in `native/`.

Their sizes are compared with those of the library when it is loaded.
"""

import ctypes
import threading
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

LEVELS = 8
"""Maximum number of levels of a tree, enough for 16^8 leaves."""

MAX_KEPT_SCRATCH = 1 << 24
"""Maximum size of the scratch memory kept from one backward pass to the next (64 MiB) [numbers]."""


def _pointers(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_void_p) for name in names.split()]


def _ints(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int) for name in names.split()]


def _floats(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_float) for name in names.split()]


def _doubles(names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_double) for name in names.split()]


class Raster(ctypes.Structure):
    """`Raster` of `native/raster.h`: arguments of the rasterizer."""

    _fields_ = [
        *_pointers("means quats scales opacity sh corners R t focal mask"),
        *_ints("n k c height width threads"),
        *_floats("alpha_max alpha_min T_min facing near near_sigmas corner"),
        *_ints("record_size gradient_size corner_start corner_width mask_stride"),
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
        *_pointers("normal roughness view directions radiance visibility blocker rows blocker_radiance"),
        *_ints("n_points n_directions stride words n_blockers threads blocker_point_stride blocker_direction_stride"),
        *_floats("roughness_min"),
        *_pointers("diffuse specular specular_visibility v_diffuse v_specular radiance_parts blocker_parts"),
        *_pointers("v_normal v_roughness v_view v_radiance v_blocker_radiance"),
    ]


class ShShade(ctypes.Structure):
    """`ShShade` of `native/sh_shade.h`: arguments of shading under spherical harmonics."""

    _fields_ = [
        *_pointers("means quats albedo_logits light specular_scale occluded unoccluded"),
        *_pointers("directions reflectance R position"),
        *_ints("n n_directions n_terms shadowed threads"),
        *_floats("normal_gradient irradiance_floor ratio_max"),
        *_pointers("out v_out v_means v_quats v_albedo_logits parts"),
    ]


class Image(ctypes.Structure):
    """`Image` of `native/image.h`: arguments of the loss terms of an image."""

    _fields_ = [
        *_pointers("rgb alpha depth depth_var normal photo mask R focal taps"),
        *_ints("height width plane_size threads"),
        *_floats("ssim_weight crease saturated knee c1 c2"),
        ("weights", ctypes.c_float * 4),
        *_pointers("scratch terms g_rgb g_alpha g_depth g_depth_var g_normal g_R"),
    ]


class GaussianTerms(ctypes.Structure):
    """`GaussianTerms` of `native/gaussian_terms.h`: arguments of the loss terms of the Gaussians."""

    _fields_ = [
        *_pointers("means quats log_scales sdf gamma weight depth R t focal"),
        *_ints("n height width threads"),
        *_floats("floor reach"),
        ("weights", ctypes.c_float * 3),
        *_pointers("magnitudes terms g_means g_quats g_log_scales g_sdf g_gamma g_R g_t"),
    ]


class Lookup(ctypes.Structure):
    """`Lookup` of `native/lookup.h`: arguments of lookups in a stack of maps."""

    _fields_ = [
        *_pointers("stack directions roughness"),
        *_ints("n levels height width"),
        *_pointers("out v_out v_stack v_directions v_roughness"),
    ]


class Activation(ctypes.Structure):
    """`Activation` of `native/material.h`: arguments of the activation of materials."""

    _fields_ = [
        *_pointers("albedo_logits roughness_logits normal_offset"),
        *_ints("n threads"),
        *_floats("temperature"),
        *_pointers("corners albedo v_corners v_albedo v_albedo_logits v_roughness_logits v_normal_offset"),
    ]


class Indirect(ctypes.Structure):
    """`Indirect` of `native/material.h`: arguments of indirect light."""

    _fields_ = [
        *_pointers("albedo transfer directions radiance"),
        *_ints("n n_directions threads"),
        *_pointers("out v_out v_albedo v_radiance"),
    ]


class MaterialImage(ctypes.Structure):
    """`MaterialImage` of `native/material.h`: arguments of the loss terms of a rendered material."""

    _fields_ = [
        *_pointers("features alpha photo mask"),
        *_ints("height width n_features plane_size threads"),
        *_pointers("scratch terms g_features g_alpha"),
    ]


class Relight(ctypes.Structure):
    """`Relight` of `native/relight.h`: arguments of Monte Carlo shading."""

    _fields_ = [
        *_pointers("bvh origins normals views albedo roughness shift lattice"),
        *_pointers("light density cumulative cosines row_guide column_guide"),
        *_pointers("R radiance gaussian_normals gaussian_roughness stack table"),
        *_ints("n_points n_brdf n_samples stride threads"),
        *_ints("height width rows columns row_buckets column_buckets"),
        *_ints("levels stack_height stack_width table_size"),
        *_floats("f0 roughness_min"),
        *_pointers("out"),
    ]


class Fusion(ctypes.Structure):
    """`Fusion` of `native/maps.h`: arguments of depth fusion."""

    _fields_ = [
        *_pointers("points R t positions index planes"),
        *_ints("n n_views height width threads"),
        *_floats("fx fy cx cy cell reach distance"),
        *_pointers("out"),
    ]


class Baking(ctypes.Structure):
    """`Baking` of `native/maps.h`: arguments of texture baking."""

    _fields_ = [
        *_pointers("maps points normals R t position"),
        *_ints("n height width threads"),
        *_floats("fx fy cx cy min_cosine tolerance"),
        *_pointers("total weights"),
    ]


class GaussianActivation(ctypes.Structure):
    """`GaussianActivation` of `native/parameters.h`: arguments of the activation of Gaussians."""

    _fields_ = [
        *_pointers("log_scales sdf gamma"),
        *_ints("n threads"),
        *_pointers("scales opacity v_scales v_opacity v_log_scales v_sdf parts"),
    ]


class AdamLeaf(ctypes.Structure):
    """`AdamLeaf` of `native/parameters.h`: a leaf of the optimizer."""

    _fields_ = [*_pointers("value gradient first second"), ("n", ctypes.c_longlong), *_floats("rate root_correction")]


class AdamStep(ctypes.Structure):
    """`AdamStep` of `native/parameters.h`: arguments of the optimizer's step."""

    _fields_ = [*_pointers("leaves"), *_ints("n_leaves threads"), *_floats("beta_2 rest_1 rest_2 eps")]


class ShadingTerm(ctypes.Structure):
    """`ShadingTerm` of `native/shading_term.h`: arguments of the photometric term of shaded pixels."""

    _fields_ = [
        *_pointers("features alpha normal photo pixels dominant R_cam_obj R_env_obj focal stack f0 albedo transfer"),
        *_pointers("directions direction_rows visibility blocker table"),
        *_ints("n_points n_features width n_pixels n_directions stride words n_gaussians"),
        *_ints("blocker_point_stride blocker_direction_stride levels map_height map_width table_size threads"),
        *_floats("cell roughness_min narrow_from narrow_to saturated knee"),
        *_pointers("rows scratch term g_features g_alpha g_normal g_R_cam_obj g_R_env_obj g_stack g_f0 g_albedo"),
    ]


class Prefilter(ctypes.Structure):
    """`Prefilter` of `native/prefilter.h`: arguments of the convolution of maps."""

    _fields_ = [
        *_pointers("radiance lobes lobes_by_input waves"),
        *_ints("height width frequencies rows threads"),
        *_pointers("scratch out v_out v_radiance"),
    ]


class Bundle(ctypes.Structure):
    """`Bundle` of `native/bundle.h`: arguments of bundle adjustment, in double precision."""

    _fields_ = [
        *_pointers("R t focal X uv weight prior damping camera point first_observation first_point"),
        *_ints("n_groups n_cameras threads"),
        *_doubles("scale min_depth cx cy"),
        *_pointers("cost U g_camera E e focal_camera focal_e focal_sums records point_records scratch"),
        *_pointers("d_camera d_focal d_point"),
    ]


STRUCTURES = (
    *(Raster, Bvh, Rays, Shade, ShShade, Image, GaussianTerms),
    *(Lookup, Activation, Indirect, MaterialImage, Relight, GaussianActivation, AdamLeaf, AdamStep),
    *(ShadingTerm, Prefilter, Fusion, Baking, Bundle),
)
"""All structures, in the order of `sizes` in `native/kernels.cpp`."""


def set_pointers(
    struct: ctypes.Structure, tensors: Mapping[str, Tensor | None] | None = None, **more: Tensor | None
) -> list[Tensor]:
    """Set pointer fields to the data of tensors, or to null; returns the tensors, which must outlive the call."""
    for name, tensor in {**(tensors or {}), **more}.items():
        setattr(struct, name, None if tensor is None else tensor.data_ptr())
    return [x for x in [*(tensors or {}).values(), *more.values()] if x is not None]


def scratch(n: int) -> Tensor:
    """Uninitialised memory for n numbers, valid until the next call in this thread.

    It is reused because allocating new pages takes as long as rendering a small image.
    """
    if n > MAX_KEPT_SCRATCH:
        return torch.empty(n)
    if len(getattr(_memory, "scratch", ())) < n:
        _memory.scratch = torch.empty(n)
    return _memory.scratch


_memory = threading.local()
