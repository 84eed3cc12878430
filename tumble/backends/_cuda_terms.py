"""CUDA kernels of the steps of stages 2 and 3 besides rendering: materials, colour and loss terms (see `_warp/`).

A kernel that adds to a result needs whole warps of threads and a result of zeros.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import accumulate
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.backends import Leaf


def activate(
    log_scales: Float[Tensor, "n 3"], sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """See `Backend.activate`."""
    return _Activate.apply(log_scales, sdf, gamma)


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> tuple[Tensor, Tensor]:
        from tumble.backends._warp import parameters, runtime

        log_scales, sdf, gamma = (x.contiguous() for x in args)
        scales, opacity = torch.empty_like(log_scales), torch.empty_like(sdf)
        with runtime.stream(sdf.device):
            inputs = log_scales, sdf, gamma
            runtime.launch(parameters.activate_forward, len(sdf), *inputs, scales, opacity)
        ctx.save_for_backward(scales, sdf, gamma)
        return scales, opacity

    @staticmethod
    def backward(ctx: Any, *v_results: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        from tumble.backends._warp import parameters, runtime

        scales, sdf, gamma = ctx.saved_tensors
        gradients = torch.empty_like(scales), torch.empty_like(sdf), torch.zeros_like(gamma)
        with runtime.stream(sdf.device):
            seeds = (x.contiguous() for x in v_results)
            threads = runtime.whole_warps(len(sdf))
            runtime.launch(parameters.activate_adjoint, threads, scales, sdf, gamma, *seeds, *gradients)
        return gradients


def corner_features(
    albedo_logits: Float[Tensor, "n 4 3"],
    roughness_logits: Float[Tensor, "n 4"],
    normal_offset: Float[Tensor, "n 4 3"],
    temperature: float,
) -> tuple[Float[Tensor, "n 4 7"], Float[Tensor, "n 3"]]:
    """See `Backend.corner_features`."""
    return _CornerFeatures.apply(albedo_logits, roughness_logits, normal_offset, temperature)


class _CornerFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor]:
        from tumble.backends._warp import parameters, runtime

        *tensors, ctx.temperature = args
        inputs = [x.contiguous() for x in tensors]
        n = len(inputs[0])
        corners, albedo = inputs[0].new_empty(n, 4, 7), inputs[0].new_empty(n, 3)
        with runtime.stream(corners.device):
            runtime.launch(parameters.corners_forward, n, *inputs, ctx.temperature, corners, albedo)
        ctx.save_for_backward(corners)
        return corners, albedo

    @staticmethod
    def backward(ctx: Any, *v_results: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        from tumble.backends._warp import parameters, runtime

        (corners,) = ctx.saved_tensors
        n = len(corners)
        gradients = corners.new_empty(n, 4, 3), corners.new_empty(n, 4), corners.new_empty(n, 4, 3)
        with runtime.stream(corners.device):
            seeds = (x.contiguous() for x in v_results)
            runtime.launch(parameters.corners_adjoint, n, corners, ctx.temperature, *seeds, *gradients)
        return (*gradients, None)


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
    return _ShShade.apply(means, quats, albedo_logits, light, specular_scale, R_env_obj, position, *constants)


_SH_INPUTS: tuple[str, ...] = (
    *("means", "quats", "albedo_logits", "light", "specular_scale", "R", "position"),
    *("occluded", "unoccluded", "coefficients", "reflectance"),
)
"""Fields of `sh_lighting.ShInputs`."""


class _ShShade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import runtime, sh_lighting

        *tensors, directions, reflectance = (x.contiguous() for x in args)
        light, R, position, occluded = tensors[3], tensors[5], tensors[6], tensors[7]
        tensors[6] = position[None]
        shadowed, out = len(occluded) > 0, torch.empty_like(tensors[0])
        coefficients = light.new_zeros(1, sh_lighting.COEFFICIENTS) if shadowed else light.new_empty(1, 1)
        with runtime.stream(out.device):
            if shadowed:
                threads = runtime.whole_warps(len(directions))
                runtime.launch(sh_lighting.project_light, threads, light, directions, R, coefficients)
            inputs = dict(zip(_SH_INPUTS, (*tensors, coefficients, reflectance), strict=True))
            runtime.launch(sh_lighting.sh_forward, len(out), inputs, out)
        ctx.save_for_backward(*inputs.values())
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        from tumble.backends._warp import runtime, sh_lighting

        inputs = dict(zip(_SH_INPUTS, ctx.saved_tensors, strict=True))
        own = {name: torch.empty_like(inputs[name]) for name in ("means", "quats", "albedo_logits")}
        sums = v_out.new_zeros(-(-sh_lighting.LIGHT_SUMS // runtime.LANES), runtime.LANES)
        with runtime.stream(v_out.device):
            threads = runtime.whole_warps(len(v_out))
            runtime.launch(sh_lighting.sh_adjoint, threads, inputs, v_out.contiguous(), own | {"light": sums})
        v_light, v_scale, v_R, v_position = sums.flatten()[: sh_lighting.LIGHT_SUMS].split([96, 1, 9, 3])
        of_light = v_light.view(2, 16, 3), v_scale[0], v_R.view(3, 3), v_position
        return *own.values(), *of_light, None, None, None, None


def bounce(
    albedo: Float[Tensor, "n 3"],
    transfer: Float[Tensor, "n 9"],
    directions: Float[Tensor, "d 3"],
    radiance: Float[Tensor, "d 3"],
) -> Float[Tensor, "n 3"]:
    """See `Backend.bounce`."""
    return _Bounce.apply(albedo, transfer, directions, radiance)


class _Bounce(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import runtime, sh_lighting

        albedo, transfer, directions, radiance = (x.contiguous() for x in args)
        out, coefficients = torch.empty_like(albedo), albedo.new_zeros(1, sh_lighting.COEFFICIENTS)
        with runtime.stream(out.device):
            threads = runtime.whole_warps(len(directions))
            runtime.launch(sh_lighting.project_radiance, threads, directions, radiance, coefficients)
            runtime.launch(sh_lighting.bounce_forward, len(albedo), albedo, transfer, coefficients, out)
        ctx.save_for_backward(albedo, transfer, directions, coefficients)
        return out

    @staticmethod
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        from tumble.backends._warp import runtime, sh_lighting

        albedo, transfer, directions, coefficients = ctx.saved_tensors
        v_albedo, v_coefficients = torch.empty_like(albedo), torch.zeros_like(coefficients)
        v_radiance = torch.zeros_like(directions)
        with runtime.stream(v_out.device):
            threads, inputs = runtime.whole_warps(len(albedo)), (albedo, transfer, coefficients, v_out.contiguous())
            runtime.launch(sh_lighting.bounce_adjoint, threads, *inputs, v_albedo, v_coefficients)
            runtime.launch(sh_lighting.radiance_adjoint, len(directions), directions, v_coefficients, v_radiance)
        return v_albedo, None, None, v_radiance


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
    images = (rgb, alpha, depth, depth_var, normal)
    return _ImageTerms.apply(*images, R_cam_obj, photo, mask, fx_fy_cx_cy, ssim_weight, crease, weights)


_IMAGE_INPUTS: tuple[str, ...] = ("rgb", "alpha", "depth", "depth_var", "normal", "R", "photo", "mask", "focal")
"""Tensors of `image_losses.ImageInputs`; the first six are differentiable."""


class _ImageTerms(torch.autograd.Function):
    """The kernels compute values and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        from tumble.backends._warp import image_losses, runtime

        *tensors, ssim_weight, crease, weights = args
        inputs: dict[str, Any] = dict(zip(_IMAGE_INPUTS, (by_pixel(x) for x in tensors), strict=True))
        rgb, (height, width) = inputs["rgb"], inputs["alpha"].shape
        inputs |= {"weights": [x / (height * width) for x in weights], "ssim_weight": ssim_weight, "crease": crease}
        less_high, less_wide = (x - image_losses.MARGIN for x in (height, width))
        terms, kept, gradients = gradient_buffer(ctx, 4, {x: inputs[x] for x in _IMAGE_INPUTS[:6]}, "R", "depth")
        shapes = {"x": (height, width), "y": (height, width), "slope": (height, width)}
        shapes |= {"rows": (4, height, less_wide), "maps": (3, less_high, less_wide), "blurred": (3, less_high, width)}
        planes = {name: rgb.new_empty(*shape, 3) for name, shape in shapes.items()}
        of_l1 = weights[0] * (1 - ssim_weight) / (3 * height * width)
        of_ssim = weights[0] * ssim_weight / (3 * less_high * less_wide)
        with runtime.stream(rgb.device):
            threads = runtime.whole_warps(height * width)
            runtime.launch(image_losses.pixel_terms, threads, inputs, planes, terms[None], gradients)
            runtime.launch(image_losses.sum_rows, (height, less_wide), planes)
            runtime.launch(image_losses.similarity, runtime.whole_warps(less_high * less_wide), planes, of_ssim, terms)
            runtime.launch(image_losses.sum_maps, (less_high, width), planes)
            scales = of_l1, of_ssim, gradients["rgb"]
            runtime.launch(image_losses.photometric_adjoint, (height, width), planes, *scales)
        ctx.save_for_backward(kept)
        ctx.of_term = {"rgb": 0, "alpha": 1, "depth": 2, "depth_var": 3, "normal": 2, "R": 2}
        return terms

    @staticmethod
    def backward(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return scaled(ctx, v_terms)


def by_pixel(x: Tensor) -> Tensor:
    """The tensor, copied only if it may be one of vectors whose numbers do not lie side by side."""
    is_dense = x.ndim < 2 or x.stride(-1) == 1
    return x if is_dense or (x.ndim == 2 and x.shape[1] not in (3, 4)) else x.contiguous()


def gradient_buffer(
    ctx: Any, n_sums: int, inputs: dict[str, Tensor], *zeroed: str
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Memory for `n_sums` sums and the gradients of all inputs, in one piece.

    Returns:
        Sums, with zeros; all gradients as one tensor for `scaled`; and these by name, with zeros for the named ones.
    """
    order = [*zeroed, *(name for name in inputs if name not in zeroed)]
    ctx.shapes = {name: inputs[name].shape for name in order}
    ctx.order = list(inputs)
    n_zeros = sum(inputs[name].numel() for name in zeroed)
    whole = inputs[order[0]].new_empty(n_sums + sum(x.numel() for x in inputs.values()))
    whole[: n_sums + n_zeros].zero_()
    kept = whole[n_sums:]
    return whole[:n_sums], kept, split_by_name(kept, ctx.shapes)


def split_by_name(flat: Tensor, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Views of consecutive parts of a one-dimensional tensor, with these shapes."""
    parts = flat.split([math.prod(shape) for shape in shapes.values()])
    return {name: part.view(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}


def scaled(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:
    """Gradients of all inputs: the saved ones times that of the term to which each belongs; None for other inputs."""
    from tumble.backends._warp import image_losses, runtime

    (kept,) = ctx.saved_tensors
    out, ends = torch.empty_like(kept), list(accumulate(shape.numel() for shape in ctx.shapes.values()))
    terms = [ctx.of_term[name] for name in ctx.shapes]
    with runtime.stream(kept.device):
        runtime.launch(image_losses.scale, len(kept), kept, ends, terms, v_terms.contiguous(), out)
    gradients = split_by_name(out, ctx.shapes)
    return *(gradients[name] for name in ctx.order), *[None] * (len(ctx.needs_input_grad) - len(ctx.order))


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
    if not len(means):
        return means.sum() + means.new_zeros(3)
    own = (means, quats, log_scales, sdf, gamma)
    return _GaussianTerms.apply(*own, R_cam_obj, t_cam_obj, weight, depth, fx_fy_cx_cy, floor, reach, weights)


_GAUSSIAN_INPUTS: tuple[str, ...] = (
    *("means", "quats", "log_scales", "sdf", "gamma", "R", "t"),
    *("weight", "depth", "focal", "floor", "reach", "weights"),
)
"""Arguments of `gaussian_terms` as fields of `gaussian_losses.GaussianInputs`; the first seven are differentiable."""


class _GaussianTerms(torch.autograd.Function):
    """The kernels compute values and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        from tumble.backends._warp import gaussian_losses, runtime

        inputs = dict(zip(_GAUSSIAN_INPUTS, args, strict=True))
        inputs |= {name: by_pixel(x) for name, x in inputs.items() if isinstance(x, Tensor)}
        inputs["t"] = inputs["t"][None]
        sdf, threads = inputs["sdf"], runtime.whole_warps(len(inputs["sdf"]))
        sums, kept, gradients = gradient_buffer(ctx, 4, {x: inputs[x] for x in _GAUSSIAN_INPUTS[:7]}, "R", "t")
        terms, seen, magnitudes = sums[:3], sums[3:].view(torch.int32), torch.empty_like(sdf)
        with runtime.stream(sdf.device):
            runtime.launch(gaussian_losses.count_seen, threads, sdf, inputs["weight"], magnitudes, seen)
            inputs |= {"median": magnitudes.median(), "seen": seen}
            runtime.launch(gaussian_losses.all_terms, threads, inputs, terms[None], gradients)
        ctx.save_for_backward(kept)
        ctx.of_term = {"means": 2, "quats": 2, "log_scales": 0, "sdf": 2, "gamma": 1, "R": 2, "t": 2}
        return terms

    @staticmethod
    def backward(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return scaled(ctx, v_terms)


def material_terms(
    features: Float[Tensor, "h w c"],
    alpha: Float[Tensor, "h w"],
    photo: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"],
) -> Float[Tensor, "2"]:
    """See `Backend.material_terms`."""
    return _MaterialTerms.apply(features, alpha, photo, mask)


class _MaterialTerms(torch.autograd.Function):
    """The kernel computes values and gradients at once."""

    @staticmethod
    def forward(ctx: Any, *args: Tensor) -> Tensor:
        from tumble.backends._warp import image_losses, runtime

        names = ("features", "alpha", "photo", "mask")
        inputs: dict[str, Tensor] = dict(zip(names, (by_pixel(x) for x in args), strict=True))
        alpha, (height, width) = inputs["alpha"], inputs["alpha"].shape
        terms, kept, gradients = gradient_buffer(ctx, 2, {x: inputs[x] for x in names[:2]})
        scales = 1 / max(1, 4 * height * (width - 1)), 1 / max(1, 4 * (height - 1) * width)
        with runtime.stream(alpha.device):
            threads = runtime.whole_warps(height * width)
            runtime.launch(image_losses.material_pixels, threads, inputs, *scales, terms[None], *gradients.values())
        ctx.save_for_backward(kept)
        ctx.of_term = {"features": 1, "alpha": 0}
        return terms

    @staticmethod
    def backward(ctx: Any, v_terms: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return scaled(ctx, v_terms)


@torch.no_grad()
def adam(leaves: Sequence[Leaf], loss: Tensor, failed: Tensor, beta_1: float, beta_2: float, eps: float) -> None:
    """See `Backend.adam`."""
    from tumble.backends._warp import parameters, runtime

    with runtime.stream(loss.device):
        for group in _groups([loss, *(leaf.gradient for leaf in leaves)]):
            ends = _ends(group)
            runtime.launch(parameters.find_not_finite, ends[-1], group, ends, failed)
        for group in _groups(leaves):
            corrections = loss.new_empty(len(group), 2)
            values, gradients, firsts, seconds, counts, rates = zip(*group, strict=True)
            ends, one = _ends(values), _one(loss.device)
            factors = [x if isinstance(x, Tensor) else one for x in rates]
            numbers = [1.0 if isinstance(x, Tensor) else x for x in rates]
            counted = counts, numbers, factors, beta_1, beta_2, failed, corrections
            runtime.launch(parameters.count_step, len(group), *counted)
            moved = values, gradients, firsts, seconds, ends, corrections
            runtime.launch(parameters.adam_step, ends[-1], *moved, beta_2, 1 - beta_1, 1 - beta_2, eps, failed)


@cache
def _one(device: torch.device) -> Float[Tensor, ""]:
    """The number 1 on a device."""
    return torch.ones((), device=device)


def _groups(items: Sequence[Any]) -> Iterator[Sequence[Any]]:
    from tumble.backends._warp.parameters import LEAVES

    return (items[k : k + LEAVES] for k in range(0, len(items), LEAVES))


def _ends(tensors: Sequence[Tensor]) -> list[int]:
    """Number of numbers of each tensor and those before it."""
    return list(accumulate(x.numel() for x in tensors))
