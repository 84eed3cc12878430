"""CPU kernels of the steps of stages 2 and 3 besides rendering: materials, colour and loss terms (see `native/`)."""

import ctypes
import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.backends import (
    IRRADIANCE_FLOOR,
    KNEE,
    NARROW_ROUGHNESS,
    NORMAL_GRADIENT,
    RATIO_MAX,
    ROUGHNESS_MIN,
    SATURATED,
    SSIM_SIGMA,
    SSIM_STABILISERS,
    SSIM_WINDOW,
    Leaf,
    SampledView,
    ShadingLight,
    _native,
    reference,
    threads,
)
from tumble.backends._structs import (
    Activation,
    AdamLeaf,
    AdamStep,
    GaussianActivation,
    GaussianTerms,
    Image,
    Indirect,
    MaterialImage,
    Prefilter,
    ShadingTerm,
    ShShade,
    scratch,
    set_pointers,
)

PLANES = 11
"""Planes of scratch memory in `native/image.h` (per channel) and `native/material.h`."""
MAX_COLUMNS = 64
"""Maximum number of columns of a map in `native/prefilter.h`."""
MAX_SHARES = 64
"""Maximum number of threads of some kernels in `native/material.h`."""
POINT_SUMS = 22
"""Numbers of a share of the points in `native/shading_term.h`."""
LIGHT_SUMS = 109
"""Numbers of the gradient of light, specular scale, rotation and position in `native/sh_shade.h`."""


def sh_shade(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    albedo_logits: Float[Tensor, "n 3"],
    light: Float[Tensor, "2 16 3"],
    specular_scale: Float[Tensor, ""],
    occluded: Float[Tensor, "m 9"],
    unoccluded: Float[Tensor, "m 9"],
    directions: Float[Tensor, "d 3"],
    reflectance: Float[Tensor, " k"],
    R_env_obj: Float[Tensor, "3 3"],
    position: Float[Tensor, "3"],
) -> Float[Tensor, "n 3"]:
    """See `Backend.sh_shade`."""
    constants = (occluded, unoccluded, directions, reflectance)
    return _ShShadeFunction.apply(means, quats, albedo_logits, light, specular_scale, R_env_obj, position, *constants)


_SH_INPUTS: tuple[str, ...] = (
    *("means", "quats", "albedo_logits", "light", "specular_scale", "R", "position"),
    *("occluded", "unoccluded", "directions", "reflectance"),
)
"""Arguments of `sh_shade` by their names in `native/sh_shade.h`, the differentiable ones first."""


class _ShShadeFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        tensors = [x.contiguous() for x in args]
        out = torch.empty_like(tensors[0])
        struct, kept = _sh_launch(tensors, out=out)
        _native.library().sh_shade_forward(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        v_means, v_quats, v_albedo = (torch.empty_like(x) for x in ctx.saved_tensors[:3])
        gradients = {"v_out": v_out.contiguous(), "v_means": v_means, "v_quats": v_quats, "v_albedo_logits": v_albedo}
        parts = torch.empty(threads(), LIGHT_SUMS)
        struct, kept = _sh_launch(ctx.saved_tensors, **gradients, parts=parts)
        _native.library().sh_shade_adjoint(ctypes.byref(struct))
        del kept
        v_light, v_scale, v_R, v_position = parts.sum(0).split([96, 1, 9, 3])
        pose = v_R.view(3, 3), v_position
        return v_means, v_quats, v_albedo, v_light.view(2, 16, 3), v_scale[0], *pose, None, None, None, None


def _sh_launch(tensors: Any, **more: Tensor) -> tuple[ShShade, list[Tensor]]:
    """Arguments of shading under spherical harmonics, and the tensors that they point to."""
    named = dict(zip(_SH_INPUTS, tensors, strict=True))
    struct = ShShade(
        n=len(named["means"]),
        n_directions=len(named["directions"]),
        n_terms=len(named["reflectance"]),
        shadowed=int(len(named["occluded"]) > 0),
        threads=threads(),
        normal_gradient=NORMAL_GRADIENT,
        irradiance_floor=IRRADIANCE_FLOOR,
        ratio_max=RATIO_MAX,
    )
    return struct, set_pointers(struct, named, **more)


def image_terms(
    rgb: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    depth_var: Float[Tensor, "h w"],
    normal: Float[Tensor, "h w 3"],
    photo: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"],
    R_cam_obj: Float[Tensor, "3 3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    ssim_weight: float,
    crease: float,
    weights: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
) -> Float[Tensor, "4"]:
    """See `Backend.image_terms`."""
    inputs = (rgb, alpha, depth, depth_var, normal, R_cam_obj)
    return _ImageTermsFunction.apply(*inputs, photo, mask, fx_fy_cx_cy, ssim_weight, crease, weights)


_IMAGE_INPUTS: tuple[str, ...] = ("rgb", "alpha", "depth", "depth_var", "normal", "R")
"""Differentiable inputs of `image_terms` by their names in `native/image.h`."""
_IMAGE_TERM = (0, 1, 2, 3, 2, 2)
"""The term to which each of them belongs."""


class _ImageTermsFunction(torch.autograd.Function):
    """The kernel computes values and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        *tensors, ssim_weight, crease, weights = args
        tensors = [x.contiguous() for x in tensors]
        (height, width), lanes = tensors[1].shape, _native.library().lanes()
        plane_size = (height + SSIM_WINDOW) * (width + SSIM_WINDOW + 2 * lanes)
        struct = Image(
            height=height,
            width=width,
            plane_size=plane_size,
            threads=threads(),
            ssim_weight=ssim_weight,
            crease=crease,
            saturated=SATURATED,
            knee=KNEE,
            c1=SSIM_STABILISERS[0],
            c2=SSIM_STABILISERS[1],
            weights=(ctypes.c_float * 4)(*weights),
        )
        terms, gradients = torch.empty(4), [torch.empty_like(x) for x in tensors[:6]]
        named = dict(zip((*_IMAGE_INPUTS, "photo", "mask", "focal"), tensors, strict=True))
        kept = set_pointers(struct, named, taps=_taps(), terms=terms, scratch=scratch(3 * PLANES * plane_size))
        set_pointers(struct, dict(zip((f"g_{name}" for name in _IMAGE_INPUTS), gradients, strict=True)))
        _native.library().image_loss(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*gradients)
        return terms

    @staticmethod
    def backward(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return _scaled(ctx, v_terms, _IMAGE_TERM)


def _scaled(ctx: Any, v_terms: Tensor, term: tuple[int, ...]) -> tuple[Tensor | None, ...]:
    """Gradients of the inputs: the saved ones times that of the term to which each belongs; None for other inputs."""
    v, needed = v_terms.tolist(), ctx.needs_input_grad
    gradients = zip(ctx.saved_tensors, term, needed[: len(term)], strict=True)
    # In training every term counts once.
    scaled = ((x if v[k] == 1 else v[k] * x) if need else None for x, k, need in gradients)
    return (*scaled, *(None for _ in needed[len(term) :]))


@cache
def _taps() -> Float[Tensor, " taps"]:
    """Weights of SSIM's window along one axis."""
    weights = [math.exp(-0.5 * ((i - SSIM_WINDOW // 2) / SSIM_SIGMA) ** 2) for i in range(SSIM_WINDOW)]
    return torch.tensor(weights) / sum(weights)


def gaussian_terms(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    log_scales: Float[Tensor, "n 3"],
    sdf: Float[Tensor, " n"],
    gamma: Float[Tensor, ""],
    weight: Float[Tensor, " n"],
    depth: Float[Tensor, "h w"],
    R_cam_obj: Float[Tensor, "3 3"],
    t_cam_obj: Float[Tensor, "3"],
    fx_fy_cx_cy: Float[Tensor, "4"],
    floor: float,
    reach: float,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
) -> Float[Tensor, "3"]:
    """See `Backend.gaussian_terms`."""
    inputs = (means, quats, log_scales, sdf, gamma, R_cam_obj, t_cam_obj)
    return _GaussianTermsFunction.apply(*inputs, weight, depth, fx_fy_cx_cy, floor, reach, weights)


_GAUSSIAN_INPUTS: tuple[str, ...] = ("means", "quats", "log_scales", "sdf", "gamma", "R", "t")
"""Differentiable inputs of `gaussian_terms` by their names in `native/gaussian_terms.h`."""
_GAUSSIAN_TERM = (2, 2, 0, 2, 1, 2, 2)
"""The term to which each of them belongs."""


class _GaussianTermsFunction(torch.autograd.Function):
    """The kernel computes values and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        *tensors, floor, reach, weights = args
        tensors = [x.detach().contiguous() for x in tensors]
        named = dict(zip((*_GAUSSIAN_INPUTS, "weight", "depth", "focal"), tensors, strict=True))
        n, (height, width) = len(named["means"]), named["depth"].shape
        struct = GaussianTerms(n=n, height=height, width=width, threads=threads(), floor=floor, reach=reach)
        struct.weights = (ctypes.c_float * 3)(*weights)
        terms, gradients = torch.empty(3), [torch.empty_like(x) for x in tensors[:5]]
        gradients += [torch.zeros(3, 3), torch.zeros(3)]
        kept = set_pointers(struct, named, terms=terms, magnitudes=torch.empty(n, dtype=torch.int32))
        kept += set_pointers(struct, dict(zip((f"g_{x}" for x in _GAUSSIAN_INPUTS[:5]), gradients, strict=False)))
        set_pointers(struct, g_R=gradients[5][2], g_t=gradients[6][2:])
        _native.library().gaussian_loss(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*gradients)
        return terms

    @staticmethod
    def backward(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return _scaled(ctx, v_terms, _GAUSSIAN_TERM)


def corner_features(
    albedo_logits: Float[Tensor, "n 4 3"],
    roughness_logits: Float[Tensor, "n 4"],
    normal_offset: Float[Tensor, "n 4 3"],
    temperature: float,
) -> tuple[Float[Tensor, "n 4 7"], Float[Tensor, "n 3"]]:
    """See `Backend.corner_features`."""
    return _MaterialFunction.apply(albedo_logits, roughness_logits, normal_offset, temperature)


class _MaterialFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor]:
        *tensors, ctx.temperature = args
        inputs = [x.contiguous() for x in tensors]
        n = len(inputs[0])
        corners, albedo = torch.empty(n, 4, 7), torch.empty(n, 3)
        struct = Activation(n=n, threads=threads(), temperature=ctx.temperature)
        named = dict(zip(("albedo_logits", "roughness_logits", "normal_offset"), inputs, strict=True))
        kept = set_pointers(struct, {"corners": corners, "albedo": albedo, **named})
        _native.library().material_forward(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(corners)
        return corners, albedo

    @staticmethod
    def backward(ctx: Any, *v_results: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        corners, n = ctx.saved_tensors[0], len(ctx.saved_tensors[0])
        gradients = torch.empty(n, 4, 3), torch.empty(n, 4), torch.empty(n, 4, 3)
        struct = Activation(n=n, threads=threads(), temperature=ctx.temperature)
        v_corners, v_albedo = (v.contiguous() for v in v_results)
        kept = set_pointers(struct, corners=corners, v_corners=v_corners, v_albedo=v_albedo)
        names = ("v_albedo_logits", "v_roughness_logits", "v_normal_offset")
        kept += set_pointers(struct, dict(zip(names, gradients, strict=True)))
        _native.library().material_adjoint(ctypes.byref(struct))
        return (*gradients, None)


def bounce(
    albedo: Float[Tensor, "n 3"],
    transfer: Float[Tensor, "n 9"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
) -> Float[Tensor, "n 3"]:
    """See `Backend.bounce`."""
    return _BounceFunction.apply(albedo, transfer, directions, radiance)


class _BounceFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        tensors = [x.contiguous() for x in args]
        out = torch.empty_like(tensors[0])
        struct, kept = _bounce_launch(tensors, out=out)
        _native.library().bounce_forward(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        v_albedo, _, _, v_radiance = (torch.empty_like(x) for x in ctx.saved_tensors)
        gradients = {"v_out": v_out.contiguous(), "v_albedo": v_albedo, "v_radiance": v_radiance}
        struct, kept = _bounce_launch(ctx.saved_tensors, **gradients)
        _native.library().bounce_adjoint(ctypes.byref(struct))
        del kept
        return v_albedo, None, None, v_radiance


def _bounce_launch(tensors: Any, **more: Tensor) -> tuple[Indirect, list[Tensor]]:
    """Arguments of indirect light, and the tensors that they point to."""
    struct = Indirect(n=len(tensors[0]), n_directions=len(tensors[2]), threads=threads())
    named = dict(zip(("albedo", "transfer", "directions", "radiance"), tensors, strict=True))
    return struct, set_pointers(struct, named | more)


def material_terms(
    features: Float[Tensor, "h w c"],
    alpha: Float[Tensor, "h w"],
    photo: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"],
) -> Float[Tensor, "2"]:
    """See `Backend.material_terms`."""
    return _MaterialTermsFunction.apply(features, alpha, photo, mask)


_MATERIAL_TERM = (1, 0)
"""The term of `material_terms` to which features and alpha belong."""


class _MaterialTermsFunction(torch.autograd.Function):
    """The kernel computes values and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        tensors = [x.contiguous() for x in args]
        features, alpha = tensors[:2]
        height, width, n_features = features.shape
        plane_size = (height + 1) * (width + 2 * _native.library().lanes())
        sizes = {"height": height, "width": width, "n_features": n_features, "plane_size": plane_size}
        struct = MaterialImage(**sizes, threads=min(threads(), MAX_SHARES))
        terms, g_features, g_alpha = torch.empty(2), torch.empty_like(features), torch.empty_like(alpha)
        kept = set_pointers(struct, dict(zip(("features", "alpha", "photo", "mask"), tensors, strict=True)))
        kept += set_pointers(struct, scratch=scratch(PLANES * plane_size), terms=terms)
        set_pointers(struct, g_features=g_features, g_alpha=g_alpha)
        _native.library().material_loss(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(g_features, g_alpha)
        return terms

    @staticmethod
    def backward(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return _scaled(ctx, v_terms, _MATERIAL_TERM)


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
    return _ShadingTermFunction.apply(*moving, view.dominant, view.photo, view.pixels, *seen, fx_fy_cx_cy)


_SHADING_MOVING: tuple[str, ...] = ("features", "alpha", "normal", "stack", "albedo", "f0", "R_cam_obj", "R_env_obj")
"""Differentiable arguments of `shading_term` by their names in `native/shading_term.h`."""
_SHADING_REST: tuple[str, ...] = (
    *("dominant", "photo", "pixels", "directions", "visibility", "blocker", "transfer", "table", "focal"),
)
"""The other arguments by these names."""


class _ShadingTermFunction(torch.autograd.Function):
    """The kernel computes value and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        tensors = [x.contiguous() for x in args]
        named = dict(zip((*_SHADING_MOVING, *_SHADING_REST), tensors, strict=True))
        gradients = [torch.empty_like(x) for x in tensors[: len(_SHADING_MOVING)]]
        p, d, n, shares = len(named["pixels"]), len(named["directions"]), len(named["albedo"]), threads()
        rows = torch.nn.functional.pad(named["directions"].T, (0, -d % _native.library().lanes())).contiguous()
        stride, blocker, stack = rows.shape[1], named["blocker"], named["stack"]
        struct = ShadingTerm(
            n_points=p,
            n_features=named["features"].shape[2],
            width=named["alpha"].shape[1],
            n_pixels=named["alpha"].numel(),
            n_directions=d,
            stride=stride,
            words=named["visibility"].shape[1],
            n_gaussians=n,
            blocker_point_stride=blocker.stride(0) if blocker.shape[0] > 1 else 0,
            blocker_direction_stride=blocker.stride(1) if blocker.shape[1] > 1 else 0,
            levels=stack.shape[0],
            map_height=stack.shape[1],
            map_width=stack.shape[2],
            table_size=len(named["table"]),
            threads=shares,
            cell=d**-0.25,
            roughness_min=ROUGHNESS_MIN,
            narrow_from=NARROW_ROUGHNESS[0],
            narrow_to=NARROW_ROUGHNESS[1],
            saturated=SATURATED,
            knee=KNEE,
        )
        size = 43 * p + 14 * (d + p) + 3 * (2 + shares) * (stride + n) + 3 * d + POINT_SUMS * shares
        term, of_points = torch.empty(()), torch.empty(p, dtype=torch.int64)
        kept = set_pointers(struct, named, direction_rows=rows, rows=of_points, scratch=scratch(size), term=term)
        kept += set_pointers(struct, dict(zip((f"g_{x}" for x in _SHADING_MOVING), gradients, strict=True)))
        _native.library().shading_loss(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*gradients)
        return term

    @staticmethod
    def backward(ctx: Any, v_term: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return _scaled(ctx, v_term[None], (0,) * len(_SHADING_MOVING))


def prefilter(radiance: Float[Tensor, "h w 3"], lobes: Float[Tensor, "f rows h"]) -> Float[Tensor, "out w 3"]:
    """See `Backend.prefilter`. With more columns fast Fourier transforms are faster than the kernel's sums."""
    if radiance.shape[1] > MAX_COLUMNS:
        return reference.prefilter(radiance, lobes)
    return _PrefilterFunction.apply(radiance, lobes)


class _PrefilterFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        radiance, ctx.lobes = (x.contiguous() for x in args)
        height, width, _ = ctx.shape = radiance.shape
        out = torch.empty(height + ctx.lobes.shape[1], width, 3)
        struct, kept = _prefilter_launch(ctx, radiance=radiance, out=out)
        _native.library().prefilter_forward(ctypes.byref(struct))
        del kept
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        v_radiance = torch.empty(ctx.shape)
        struct, kept = _prefilter_launch(ctx, v_out=v_out.contiguous(), v_radiance=v_radiance)
        _native.library().prefilter_backward(ctypes.byref(struct))
        del kept
        return v_radiance, None


def _prefilter_launch(ctx: Any, **more: Tensor) -> tuple[Prefilter, list[Tensor]]:
    """Arguments of the convolution of maps, and the tensors that they point to."""
    (height, width, _), (frequencies, rows, _) = ctx.shape, ctx.lobes.shape
    lanes = _native.library().lanes()
    size = (width + 2 * frequencies) * (3 * height + lanes) + 6 * frequencies * (rows + lanes)
    struct = Prefilter(height=height, width=width, frequencies=frequencies, rows=rows, threads=threads())
    named = {"lobes": ctx.lobes, "lobes_by_input": _transposed(ctx.lobes), "waves": _waves(width)}
    return struct, set_pointers(struct, named, scratch=scratch(size), **more)


@cache
def _transposed(lobes: Float[Tensor, "f rows h"]) -> Float[Tensor, "f h rows"]:
    return lobes.mT.contiguous()


@cache
def _waves(width: int) -> Float[Tensor, "2 f {width}"]:
    """Cosines and sines of all frequencies at all columns."""
    turns = torch.arange(width // 2 + 1, dtype=torch.float64)[:, None] * torch.arange(width) / width
    return torch.stack([(2 * math.pi * turns).cos(), (2 * math.pi * turns).sin()]).float()


def activate(
    log_scales: Float[Tensor, "n 3"], sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """See `Backend.activate`."""
    return _ActivateFunction.apply(log_scales, sdf, gamma)


class _ActivateFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> tuple[Tensor, Tensor]:
        inputs = [x.contiguous() for x in args]
        results = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
        struct, kept = _activation_launch((*inputs, *results))
        _native.library().activation_forward(ctypes.byref(struct))
        del kept
        ctx.save_for_backward(*inputs, *results)
        return results

    @staticmethod
    def backward(ctx: Any, *v_results: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        v_log_scales, v_sdf, parts = (*(torch.empty_like(x) for x in ctx.saved_tensors[:2]), torch.empty(threads()))
        v_scales, v_opacity = (v.contiguous() for v in v_results)
        more = {"v_scales": v_scales, "v_opacity": v_opacity, "v_log_scales": v_log_scales, "v_sdf": v_sdf}
        struct, kept = _activation_launch(ctx.saved_tensors, parts=parts, **more)
        _native.library().activation_adjoint(ctypes.byref(struct))
        del kept
        return v_log_scales, v_sdf, parts.sum()


def _activation_launch(tensors: Any, **more: Tensor) -> tuple[GaussianActivation, list[Tensor]]:
    """Arguments of the activation of Gaussians, and the tensors that they point to."""
    struct = GaussianActivation(n=len(tensors[1]), threads=threads())
    return struct, set_pointers(struct, dict(zip(_ACTIVATION, tensors, strict=True)), **more)


_ACTIVATION = ("log_scales", "sdf", "gamma", "scales", "opacity")
"""Arguments and results of `activate` by their names in `native/parameters.h`."""


@torch.no_grad()
def adam(leaves: Sequence[Leaf], loss: Tensor, failed: Tensor, beta_1: float, beta_2: float, eps: float) -> None:
    """See `Backend.adam`."""
    if failed.item() or not math.isfinite(loss.item()):
        failed.fill_(1)
        return
    rows = []
    for leaf in leaves:
        count = int(leaf.count) + 1
        corrections = float(leaf.rate) / (1 - beta_1**count), math.sqrt(1 - beta_2**count)
        rows.append((*(x.data_ptr() for x in leaf[:4]), leaf.value.numel(), *corrections))
    rates = {"beta_2": beta_2, "rest_1": 1 - beta_1, "rest_2": 1 - beta_2, "eps": eps}
    struct = AdamStep(n_leaves=len(rows), threads=threads(), **rates)
    array = (AdamLeaf * len(rows))(*rows)
    struct.leaves = ctypes.addressof(array)
    if not _native.library().adam(ctypes.byref(struct)):
        failed.fill_(1)
        return
    for leaf in leaves:
        leaf.count.add_(1)
