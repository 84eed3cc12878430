"""GMFlow (Xu et al. 2022), flow as matching of all pixels with all: the network, from the paper and the weights' names.

Two scales: features at an eighth of the picture are matched globally, those at a quarter around where that leads. At
both, a transformer first lets the two pictures see each other, and attention within the one then carries flow to where
nothing matched. Both directions come from one pass. `p` holds the weights by their published names.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the colours that the network was trained on."""
LAYERS = 6
SPLITS = (2, 8)
"""Windows per side in which attention looks, at an eighth and at a quarter."""
RADIUS = 4
"""Pixels around the first answer in which the second is looked for."""
MULTIPLE = 32
"""Height and width of a picture are multiples of it."""

Weights = dict[str, Tensor]


def flow(first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h w"], p: Weights) -> Float[Tensor, "2 2 h w"]:
    """Where every pixel of the first picture goes in the second, and the other way round (x, y) [pixels].

    Args:
        first: RGB in [0, 1], height and width multiples of MULTIPLE.
        second: Likewise, of the same size.
        p: Weights.
    """
    mean, spread = (first.new_tensor(v)[:, None, None] for v in (MEAN, SPREAD))
    fine, coarse = _features((torch.stack([first, second]) - mean) / spread, p)
    found = _global(seen := _transformed(coarse, SPLITS[0], p))
    found = _propagated(seen, found, None, p)
    found = 2 * functional.interpolate(found, scale_factor=2, mode="bilinear", align_corners=True)
    # Each picture with the other one moved onto it.
    both = torch.stack([_local(fine[k], fine[1 - k], found[k], p) for k in range(2)])
    found, seen = found + both[:, :2], both[:, 2:]
    return _enlarged(_propagated(seen, found, 1, p), seen, p)


def _features(x: Float[Tensor, "b 3 h w"], p: Weights) -> tuple[Float[Tensor, "b c hf wf"], Float[Tensor, "b c hc wc"]]:
    """At a quarter and at an eighth of the picture."""
    x = functional.relu(functional.instance_norm(functional.conv2d(x, p["backbone.conv1.weight"], stride=2, padding=3)))
    for layer, stride in ((1, 1), (2, 2), (3, 1)):
        for block in range(2):
            x = _block(x, f"backbone.layer{layer}.{block}", stride if block == 0 else 1, p)
    x = functional.conv2d(x, p["backbone.conv2.weight"], p["backbone.conv2.bias"])
    fine, coarse = (functional.conv2d(x, p["backbone.trident_conv.weight"], stride=s, padding=1) for s in (1, 2))
    return fine, coarse


def _block(x: Tensor, name: str, stride: int, p: Weights) -> Tensor:
    y = functional.conv2d(x, p[f"{name}.conv1.weight"], stride=stride, padding=1)
    y = functional.relu(functional.instance_norm(y))
    y = functional.relu(functional.instance_norm(functional.conv2d(y, p[f"{name}.conv2.weight"], padding=1)))
    if f"{name}.downsample.0.weight" in p:
        weight, bias = (p[f"{name}.downsample.0.{k}"] for k in ("weight", "bias"))
        x = functional.instance_norm(functional.conv2d(x, weight, bias, stride=stride))
    return functional.relu(x + y)


# The transformer ------------------------------------------------------------------------------------------------------


def _transformed(x: Float[Tensor, "2 c h w"], splits: int, p: Weights) -> Float[Tensor, "2 c h w"]:
    """Features of two pictures after each has looked at itself and at the other."""
    _, _, h, w = x.shape
    x = x + _position(x, h // splits, w // splits).repeat(1, splits, splits)
    x = x.permute(0, 2, 3, 1)
    for layer in range(LAYERS):
        shift = (h // splits // 2, w // splits // 2) if layer % 2 else (0, 0)
        name = f"transformer.layers.{layer}"
        other = x.flip(0)  # as it was before it looked at itself
        message = _message(x, x, f"{name}.self_attn", splits, shift, p)
        x = x + _normed(message, f"{name}.self_attn.norm1", p)
        name = f"{name}.cross_attn_ffn"
        message = _normed(_message(x, other, name, splits, shift, p), f"{name}.norm1", p)
        message = functional.linear(torch.cat([x, message], -1), p[f"{name}.mlp.0.weight"])
        message = functional.linear(functional.gelu(message), p[f"{name}.mlp.2.weight"])
        x = x + _normed(message, f"{name}.norm2", p)
    return x.permute(0, 3, 1, 2)


def _position(like: Tensor, h: int, w: int) -> Float[Tensor, "c h w"]:
    """Sines and cosines of row and column, as shares of a full turn over a window (DETR)."""
    half = like.shape[1] // 2
    rate = 10000 ** (2 * torch.div(torch.arange(half), 2, rounding_mode="floor") / half)
    parts = []
    for size, dim in ((h, 0), (w, 1)):
        at = 2 * math.pi * torch.arange(1, size + 1) / (size + 1e-6)
        phase = at[:, None] / rate
        wave = torch.stack([phase[:, 0::2].sin(), phase[:, 1::2].cos()], -1).flatten(1)
        parts.append(wave.T[:, :, None].expand(-1, h, w) if dim == 0 else wave.T[:, None].expand(-1, h, w))
    return torch.cat(parts).to(like)


def _normed(x: Tensor, name: str, p: Weights) -> Tensor:
    return functional.layer_norm(x, x.shape[-1:], p[f"{name}.weight"], p[f"{name}.bias"])


def _message(
    x: Float[Tensor, "b h w c"], other: Tensor, name: str, splits: int, shift: tuple[int, int], p: Weights
) -> Float[Tensor, "b h w c"]:
    """What attention in shifted windows tells a picture of another (Swin)."""
    q, k, v = (functional.linear(s, p[f"{name}.{n}_proj.weight"]) for n, s in (("q", x), ("k", other), ("v", other)))
    if any(shift):
        q, k, v = (y.roll((-shift[0], -shift[1]), (1, 2)) for y in (q, k, v))
    mask = _apart(x.shape[1], x.shape[2], splits, shift).to(x) if any(shift) else None
    q, k, v = (_windows(y, splits) for y in (q, k, v))
    if mask is not None:
        mask = mask.repeat(len(x), 1, 1)
    out = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    out = _whole(out, splits, x.shape[1], x.shape[2])
    out = out.roll(shift, (1, 2)) if any(shift) else out
    return functional.linear(out, p[f"{name}.merge.weight"])


def _windows(x: Float[Tensor, "b h w c"], splits: int) -> Float[Tensor, "bs n c"]:
    b, h, w, c = x.shape
    x = x.reshape(b, splits, h // splits, splits, w // splits, c)
    return x.permute(0, 1, 3, 2, 4, 5).reshape(b * splits * splits, -1, c)


def _whole(x: Float[Tensor, "bs n c"], splits: int, h: int, w: int) -> Float[Tensor, "b h w c"]:
    x = x.reshape(-1, splits, splits, h // splits, w // splits, x.shape[-1])
    return x.permute(0, 1, 3, 2, 4, 5).reshape(-1, h, w, x.shape[-1])


def _apart(h: int, w: int, splits: int, shift: tuple[int, int]) -> Float[Tensor, "s n n"]:
    """Large and negative between pixels that only the roll brought into one window."""
    part = torch.zeros(1, h, w, 1)
    for number_y, rows in enumerate(_bands(h, h // splits, shift[0])):
        for number_x, columns in enumerate(_bands(w, w // splits, shift[1])):
            part[:, rows, columns] = 3 * number_y + number_x
    part = _windows(part, splits)[..., 0]
    return torch.where(part[:, None] == part[:, :, None], 0.0, -100.0)


def _bands(size: int, window: int, shift: int) -> tuple[slice, slice, slice]:
    return slice(0, size - window), slice(size - window, size - shift), slice(size - shift, size)


# From features to flow ------------------------------------------------------------------------------------------------


def _grid(h: int, w: int, like: Tensor) -> Float[Tensor, "2 h w"]:
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    return torch.stack([x, y]).to(like)


def _global(seen: Float[Tensor, "2 c h w"]) -> Float[Tensor, "2 2 h w"]:
    """Both ways: the mean place of what looks alike in all of the other picture, minus one's own."""
    _, c, h, w = seen.shape
    grid, flat = _grid(h, w, seen), seen.flatten(2)
    alike = flat[0].T @ flat[1] / math.sqrt(c)
    there, back = (a.softmax(-1) @ grid.flatten(1).T for a in (alike, alike.T))
    return torch.stack([there, back]).transpose(1, 2).reshape(2, 2, h, w) - grid


def _local(
    mine: Float[Tensor, "c h w"], other: Float[Tensor, "c h w"], found: Float[Tensor, "2 h w"], p: Weights
) -> Float[Tensor, "2+c h w"]:
    """What is missing to a flow, from a window about where it leads; and this picture's features by then."""
    c, h, w = mine.shape
    moved = _sampled(other, _grid(h, w, mine) + found)
    seen = _transformed(torch.stack([mine, moved]), SPLITS[1], p)
    side = 2 * RADIUS + 1
    offset = _grid(side, side, mine).flatten(1).T - RADIUS
    padded, inside = (
        functional.pad(x, (RADIUS,) * 4) for x in (seen[1], torch.ones(1, h, w, dtype=torch.bool, device=mine.device))
    )
    alike = []
    for n in range(side * side):
        rows, columns = slice(n // side, n // side + h), slice(n % side, n % side + w)
        score = (seen[0] * padded[:, rows, columns]).sum(0) / math.sqrt(c)
        alike.append(torch.where(inside[0, rows, columns], score, -1e9))
    share = torch.stack(alike).softmax(0)
    return torch.cat([torch.einsum("nhw,nd->dhw", share, offset), seen[0]])


def _sampled(x: Float[Tensor, "c h w"], places: Float[Tensor, "2 h w"]) -> Float[Tensor, "c h w"]:
    """Values at positions counted from the first pixel's centre, 0 outside."""
    size = x.new_tensor([x.shape[2] - 1, x.shape[1] - 1])
    at = 2 * places.permute(1, 2, 0) / size - 1
    return functional.grid_sample(x[None], at[None], align_corners=True)[0]


def _propagated(seen: Float[Tensor, "b c h w"], found: Tensor, radius: int | None, p: Weights) -> Tensor:
    """Flow as a mean over what looks alike in the same picture, everywhere or within a radius.

    The published network takes its keys from the queries, not from the features: its weights want that.
    """
    b, c, h, w = seen.shape
    name = "feature_flow_attn"
    flat = seen.flatten(2).transpose(1, 2)
    q = functional.linear(flat, p[f"{name}.q_proj.weight"], p[f"{name}.q_proj.bias"])
    if radius is None:
        k = functional.linear(q, p[f"{name}.k_proj.weight"], p[f"{name}.k_proj.bias"])
        out = functional.scaled_dot_product_attention(q, k, found.flatten(2).transpose(1, 2))
        return out.transpose(1, 2).reshape(b, 2, h, w)
    k = functional.linear(flat, p[f"{name}.k_proj.weight"], p[f"{name}.k_proj.bias"])
    k = k.transpose(1, 2).reshape(b, c, h, w)
    side = 2 * radius + 1
    keys, values = (functional.unfold(x, side, padding=radius).reshape(b, -1, side * side, h * w) for x in (k, found))
    alike = torch.einsum("bnc,bcsn->bsn", q, keys) / math.sqrt(c)
    return torch.einsum("bsn,bdsn->bdn", alike.softmax(1), values).reshape(b, 2, h, w)


def _enlarged(
    found: Float[Tensor, "b 2 h w"], seen: Float[Tensor, "b c h w"], p: Weights
) -> Float[Tensor, "b 2 hh ww"]:
    """Four times the size; every pixel a learned mean of the nine around."""
    x = torch.cat([found, seen], 1)
    x = functional.relu(functional.conv2d(x, p["upsampler.0.weight"], p["upsampler.0.bias"], padding=1))
    x = functional.conv2d(x, p["upsampler.2.weight"], p["upsampler.2.bias"])
    b, _, h, w = found.shape
    share = x.reshape(b, 1, 9, 4, 4, h, w).softmax(2)
    near = functional.unfold(4 * found, 3, padding=1).reshape(b, 2, 9, 1, 1, h, w)
    return (share * near).sum(2).permute(0, 1, 4, 2, 5, 3).reshape(b, 2, 4 * h, 4 * w)
