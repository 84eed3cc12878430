"""GMFlow (Xu et al. 2022): optical flow by global matching, as functions of the published weights.

Implemented from the paper. Features at 1/8 of the image size are matched globally, and those at 1/4 locally around the
resulting flow. At both scales a transformer first exchanges information between the two images; self-attention then
propagates flow to regions without matches. Both directions are computed in one pass. `p` holds the weights by their
published names.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

MEAN = (0.485, 0.456, 0.406)
"""Mean colour of the training images, RGB."""
STD = (0.229, 0.224, 0.225)
"""Standard deviation of the colours of the training images, RGB."""
LAYERS = 6
"""Number of transformer layers."""
WINDOW_SPLITS = (2, 8)
"""Attention windows per side, at 1/8 and at 1/4 of the image size."""
RADIUS = 4
"""Search radius of the local refinement around the first flow [pixels at 1/4 of the image size]."""
MULTIPLE = 32
"""Divisor of height and width of input images [pixels]."""

Weights = dict[str, Tensor]
"""Published weights by name."""


def flow(first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h w"], p: Weights) -> Float[Tensor, "2 2 h w"]:
    """Optical flow (x, y) from the first image to the second, and from the second to the first [pixels].

    Args:
        first: RGB in [0, 1], height and width multiples of MULTIPLE.
        second: Image of the same size.
        p: Weights.
    """
    mean, std = (first.new_tensor(v)[:, None, None] for v in (MEAN, STD))
    fine, coarse = _features((torch.stack([first, second]) - mean) / std, p)
    estimate = _match_globally(features := _transform(coarse, WINDOW_SPLITS[0], p))
    estimate = _propagate(features, estimate, None, p)
    estimate = 2 * functional.interpolate(estimate, scale_factor=2, mode="bilinear", align_corners=True)
    # Each image with the other one warped onto it.
    both = torch.stack([_refine_locally(fine[k], fine[1 - k], estimate[k], p) for k in range(2)])
    estimate, features = estimate + both[:, :2], both[:, 2:]
    return _upsample(_propagate(features, estimate, 1, p), features, p)


def _features(x: Float[Tensor, "b 3 h w"], p: Weights) -> tuple[Float[Tensor, "b c hf wf"], Float[Tensor, "b c hc wc"]]:
    """Features at 1/4 and at 1/8 of the image size."""
    x = functional.relu(functional.instance_norm(functional.conv2d(x, p["backbone.conv1.weight"], stride=2, padding=3)))
    for layer, stride in ((1, 1), (2, 2), (3, 1)):
        for block in range(2):
            x = _residual_block(x, f"backbone.layer{layer}.{block}", stride if block == 0 else 1, p)
    x = functional.conv2d(x, p["backbone.conv2.weight"], p["backbone.conv2.bias"])
    fine, coarse = (functional.conv2d(x, p["backbone.trident_conv.weight"], stride=s, padding=1) for s in (1, 2))
    return fine, coarse


def _residual_block(x: Tensor, name: str, stride: int, p: Weights) -> Tensor:
    """Residual block with instance normalisation."""
    y = functional.conv2d(x, p[f"{name}.conv1.weight"], stride=stride, padding=1)
    y = functional.relu(functional.instance_norm(y))
    y = functional.relu(functional.instance_norm(functional.conv2d(y, p[f"{name}.conv2.weight"], padding=1)))
    if f"{name}.downsample.0.weight" in p:
        weight, bias = (p[f"{name}.downsample.0.{k}"] for k in ("weight", "bias"))
        x = functional.instance_norm(functional.conv2d(x, weight, bias, stride=stride))
    return functional.relu(x + y)


# The transformer ------------------------------------------------------------------------------------------------------


def _transform(x: Float[Tensor, "2 c h w"], splits: int, p: Weights) -> Float[Tensor, "2 c h w"]:
    """Features of two images after layers of self-attention and cross-attention."""
    _, _, h, w = x.shape
    x = x + _position_encoding(x, h // splits, w // splits).repeat(1, splits, splits)
    x = x.permute(0, 2, 3, 1)
    for layer in range(LAYERS):
        shift = (h // splits // 2, w // splits // 2) if layer % 2 else (0, 0)
        name = f"transformer.layers.{layer}"
        other = x.flip(0)  # before self-attention
        message = _attention(x, x, f"{name}.self_attn", splits, shift, p)
        x = x + _layer_norm(message, f"{name}.self_attn.norm1", p)
        name = f"{name}.cross_attn_ffn"
        message = _layer_norm(_attention(x, other, name, splits, shift, p), f"{name}.norm1", p)
        message = functional.linear(torch.cat([x, message], -1), p[f"{name}.mlp.0.weight"])
        message = functional.linear(functional.gelu(message), p[f"{name}.mlp.2.weight"])
        x = x + _layer_norm(message, f"{name}.norm2", p)
    return x.permute(0, 3, 1, 2)


def _position_encoding(like: Tensor, h: int, w: int) -> Float[Tensor, "c h w"]:
    """Position encoding of DETR: sines and cosines of row and column within a window."""
    half = like.shape[1] // 2
    rate = 10000 ** (2 * torch.div(torch.arange(half), 2, rounding_mode="floor") / half)
    parts = []
    for size, dim in ((h, 0), (w, 1)):
        at = 2 * math.pi * torch.arange(1, size + 1) / (size + 1e-6)
        phase = at[:, None] / rate
        waves = torch.stack([phase[:, 0::2].sin(), phase[:, 1::2].cos()], -1).flatten(1)
        parts.append(waves.T[:, :, None].expand(-1, h, w) if dim == 0 else waves.T[:, None].expand(-1, h, w))
    return torch.cat(parts).to(like)


def _layer_norm(x: Tensor, name: str, p: Weights) -> Tensor:
    """Layer normalisation with learned scale and bias."""
    return functional.layer_norm(x, x.shape[-1:], p[f"{name}.weight"], p[f"{name}.bias"])


def _attention(
    x: Float[Tensor, "b h w c"], other: Tensor, name: str, splits: int, shift: tuple[int, int], p: Weights
) -> Float[Tensor, "b h w c"]:
    """Attention from one image to another in shifted windows (Swin)."""
    q, k, v = (functional.linear(s, p[f"{name}.{n}_proj.weight"]) for n, s in (("q", x), ("k", other), ("v", other)))
    if any(shift):
        q, k, v = (y.roll((-shift[0], -shift[1]), (1, 2)) for y in (q, k, v))
    mask = _shift_mask(x.shape[1], x.shape[2], splits, shift).to(x) if any(shift) else None
    q, k, v = (_split(y, splits) for y in (q, k, v))
    if mask is not None:
        mask = mask.repeat(len(x), 1, 1)
    out = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    out = _merge(out, splits, x.shape[1], x.shape[2])
    out = out.roll(shift, (1, 2)) if any(shift) else out
    return functional.linear(out, p[f"{name}.merge.weight"])


def _split(x: Float[Tensor, "b h w c"], splits: int) -> Float[Tensor, "bs n c"]:
    """Windows of an image as separate batch elements."""
    b, h, w, c = x.shape
    x = x.reshape(b, splits, h // splits, splits, w // splits, c)
    return x.permute(0, 1, 3, 2, 4, 5).reshape(b * splits * splits, -1, c)


def _merge(x: Float[Tensor, "bs n c"], splits: int, h: int, w: int) -> Float[Tensor, "b h w c"]:
    x = x.reshape(-1, splits, splits, h // splits, w // splits, x.shape[-1])
    return x.permute(0, 1, 3, 2, 4, 5).reshape(-1, h, w, x.shape[-1])


def _shift_mask(h: int, w: int, splits: int, shift: tuple[int, int]) -> Float[Tensor, "s n n"]:
    """Attention mask: large and negative between pixels that are in one window only because of the shift."""
    part = torch.zeros(1, h, w, 1)
    for number_y, rows in enumerate(_bands(h, h // splits, shift[0])):
        for number_x, columns in enumerate(_bands(w, w // splits, shift[1])):
            part[:, rows, columns] = 3 * number_y + number_x
    part = _split(part, splits)[..., 0]
    return torch.where(part[:, None] == part[:, :, None], 0.0, -100.0)


def _bands(size: int, window: int, shift: int) -> tuple[slice, slice, slice]:
    """Ranges of rows or columns that do not attend to each other after the shift."""
    return slice(0, size - window), slice(size - window, size - shift), slice(size - shift, size)


# From features to flow ------------------------------------------------------------------------------------------------


def _grid(h: int, w: int, like: Tensor) -> Float[Tensor, "2 h w"]:
    """Positions (x, y) of all pixels, the first centre at 0."""
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    return torch.stack([x, y]).to(like)


def _match_globally(features: Float[Tensor, "2 c h w"]) -> Float[Tensor, "2 2 h w"]:
    """Flow in both directions: mean position in the other image, weighted by similarity, minus the pixel's own."""
    _, c, h, w = features.shape
    grid, flat = _grid(h, w, features), features.flatten(2)
    similarity = flat[0].T @ flat[1] / math.sqrt(c)
    forward, backward = (a.softmax(-1) @ grid.flatten(1).T for a in (similarity, similarity.T))
    return torch.stack([forward, backward]).transpose(1, 2).reshape(2, 2, h, w) - grid


def _refine_locally(
    own: Float[Tensor, "c h w"], other: Float[Tensor, "c h w"], estimate: Float[Tensor, "2 h w"], p: Weights
) -> Float[Tensor, "2+c h w"]:
    """Correction of a flow estimate by matching in a window around it, and this image's transformed features."""
    c, h, w = own.shape
    warped = _sample(other, _grid(h, w, own) + estimate)
    features = _transform(torch.stack([own, warped]), WINDOW_SPLITS[1], p)
    side = 2 * RADIUS + 1
    offset = _grid(side, side, own).flatten(1).T - RADIUS
    padded, inside = (
        functional.pad(x, (RADIUS,) * 4)
        for x in (features[1], torch.ones(1, h, w, dtype=torch.bool, device=own.device))
    )
    similarity = []
    for n in range(side * side):
        rows, columns = slice(n // side, n // side + h), slice(n % side, n % side + w)
        score = (features[0] * padded[:, rows, columns]).sum(0) / math.sqrt(c)
        similarity.append(torch.where(inside[0, rows, columns], score, -1e9))
    weights = torch.stack(similarity).softmax(0)
    return torch.cat([torch.einsum("nhw,nd->dhw", weights, offset), features[0]])


def _sample(x: Float[Tensor, "c h w"], positions: Float[Tensor, "2 h w"]) -> Float[Tensor, "c h w"]:
    """Bilinear interpolation at positions (x, y), first centre at 0; 0 outside the image."""
    size = x.new_tensor([x.shape[2] - 1, x.shape[1] - 1])
    at = 2 * positions.permute(1, 2, 0) / size - 1
    return functional.grid_sample(x[None], at[None], align_corners=True)[0]


def _propagate(features: Float[Tensor, "b c h w"], estimate: Tensor, radius: int | None, p: Weights) -> Tensor:
    """Flow averaged over similar pixels of the same image, in all of it or within a radius [pixels].

    In the global case keys are computed from the queries instead of the features, as in the published network, whose
    weights were trained that way.
    """
    b, c, h, w = features.shape
    name = "feature_flow_attn"
    flat = features.flatten(2).transpose(1, 2)
    q = functional.linear(flat, p[f"{name}.q_proj.weight"], p[f"{name}.q_proj.bias"])
    if radius is None:
        k = functional.linear(q, p[f"{name}.k_proj.weight"], p[f"{name}.k_proj.bias"])
        out = functional.scaled_dot_product_attention(q, k, estimate.flatten(2).transpose(1, 2))
        return out.transpose(1, 2).reshape(b, 2, h, w)
    k = functional.linear(flat, p[f"{name}.k_proj.weight"], p[f"{name}.k_proj.bias"])
    k = k.transpose(1, 2).reshape(b, c, h, w)
    side = 2 * radius + 1
    keys, values = (
        functional.unfold(x, side, padding=radius).reshape(b, -1, side * side, h * w) for x in (k, estimate)
    )
    similarity = torch.einsum("bnc,bcsn->bsn", q, keys) / math.sqrt(c)
    return torch.einsum("bsn,bdsn->bdn", similarity.softmax(1), values).reshape(b, 2, h, w)


def _upsample(
    estimate: Float[Tensor, "b 2 h w"], features: Float[Tensor, "b c h w"], p: Weights
) -> Float[Tensor, "b 2 hh ww"]:
    """Flow at four times the size, each pixel a learned convex combination of nine neighbours."""
    x = torch.cat([estimate, features], 1)
    x = functional.relu(functional.conv2d(x, p["upsampler.0.weight"], p["upsampler.0.bias"], padding=1))
    x = functional.conv2d(x, p["upsampler.2.weight"], p["upsampler.2.bias"])
    b, _, h, w = estimate.shape
    weights = x.reshape(b, 1, 9, 4, 4, h, w).softmax(2)
    near = functional.unfold(4 * estimate, 3, padding=1).reshape(b, 2, 9, 1, 1, h, w)
    return (weights * near).sum(2).permute(0, 1, 4, 2, 5, 3).reshape(b, 2, 4 * h, 4 * w)
