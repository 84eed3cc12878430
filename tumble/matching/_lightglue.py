"""LightGlue (Lindenberger et al. 2023) as one function of its published weights: which keypoints of two frames are one.

Written from the paper; all layers run, without its early exit and pruning: there are few keypoints here.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

HEADS = 4

Parameters = dict[str, Tensor]


def assignment(
    at_i: Float[Tensor, "n 2"],
    at_j: Float[Tensor, "m 2"],
    descriptors_i: Float[Tensor, "n c"],
    descriptors_j: Float[Tensor, "m c"],
    p: Parameters,
) -> Float[Tensor, "n m"]:
    """How likely every pair of keypoints shows one point, in [0, 1] (section 3.1 of the paper).

    Args:
        at_i: Keypoints of one frame, in [-1, 1] along its longer side.
        at_j: Of the other.
        descriptors_i: Of the keypoints.
        descriptors_j: Of the other frame's.
        p: The published weights.
    """
    x_i, x_j = (_linear(d, p, "input_proj") for d in (descriptors_i, descriptors_j))
    turn_i, turn_j = (_rotary(at, p) for at in (at_i, at_j))
    last = -1
    while f"transformers.{last + 1}.self_attn.Wqkv.weight" in p:
        last += 1
        x_i, x_j = (_self(x, turn, p, f"transformers.{last}.self_attn") for x, turn in ((x_i, turn_i), (x_j, turn_j)))
        x_i, x_j = _cross(x_i, x_j, p, f"transformers.{last}.cross_attn")
    name = f"log_assignment.{last}"
    y_i, y_j = (_linear(x, p, f"{name}.final_proj") for x in (x_i, x_j))
    alike = y_i @ y_j.T / y_i.shape[-1] ** 0.5
    able_i, able_j = (_linear(x, p, f"{name}.matchability").sigmoid() for x in (x_i, x_j))
    return alike.softmax(1) * alike.softmax(0) * able_i * able_j.T


def _linear(x: Tensor, p: Parameters, name: str) -> Tensor:
    return functional.linear(x, p[f"{name}.weight"], p[f"{name}.bias"])


def _rotary(at: Tensor, p: Parameters) -> tuple[Tensor, Tensor]:
    """Cosines and sines by which a position turns pairs of channels (its rotary encoding), the same for all heads."""
    phase = (at @ p["posenc.Wr.weight"].T).repeat_interleave(2, -1)
    return phase.cos(), phase.sin()


def _turned(x: Float[Tensor, "heads n c"], turn: tuple[Tensor, Tensor]) -> Float[Tensor, "heads n c"]:
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    return x * turn[0] + torch.stack([-odd, even], -1).flatten(-2) * turn[1]


def _self(x: Float[Tensor, "n c"], turn: tuple[Tensor, Tensor], p: Parameters, name: str) -> Float[Tensor, "n c"]:
    # Channels of the joint projection: head, then channel, then query, key, value.
    q, k, v = _linear(x, p, f"{name}.Wqkv").unflatten(-1, (HEADS, -1, 3)).permute(3, 1, 0, 2).unbind(0)
    message = functional.scaled_dot_product_attention(_turned(q, turn)[None], _turned(k, turn)[None], v[None])[0]
    return _updated(x, _linear(message.transpose(0, 1).flatten(1), p, f"{name}.out_proj"), p, name)


def _cross(x_i: Tensor, x_j: Tensor, p: Parameters, name: str) -> tuple[Tensor, Tensor]:
    def heads(x: Tensor, of: str) -> Tensor:
        return _linear(x, p, f"{name}.{of}").unflatten(-1, (HEADS, -1)).transpose(0, 1)[None]

    qk_i, qk_j, v_i, v_j = heads(x_i, "to_qk"), heads(x_j, "to_qk"), heads(x_i, "to_v"), heads(x_j, "to_v")
    to_i = functional.scaled_dot_product_attention(qk_i, qk_j, v_j)[0]
    to_j = functional.scaled_dot_product_attention(qk_j, qk_i, v_i)[0]
    out_i, out_j = (_linear(m.transpose(0, 1).flatten(1), p, f"{name}.to_out") for m in (to_i, to_j))
    return _updated(x_i, out_i, p, name), _updated(x_j, out_j, p, name)


def _updated(x: Tensor, message: Tensor, p: Parameters, name: str) -> Tensor:
    y = _linear(torch.cat([x, message], -1), p, f"{name}.ffn.0")
    y = functional.layer_norm(y, y.shape[-1:], p[f"{name}.ffn.1.weight"], p[f"{name}.ffn.1.bias"])
    return x + _linear(functional.gelu(y), p, f"{name}.ffn.3")
