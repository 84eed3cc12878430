"""LightGlue (Lindenberger et al. 2023): matching of keypoints, as a function of the published weights.

Implemented from the paper. Instead of its early exit and pruning, pairs that show no common surface are given up after
four of nine layers.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

HEADS = 4
"""Number of attention heads."""

MIN_EXPECTED = 4.0
"""Sum of the best probabilities of all keypoints after an earlier layer below which a pair is given up."""

Parameters = dict[str, Tensor]
"""Published weights by name, with outputs (`log_assignment`) of the last layer and of any earlier ones."""


@dataclass(frozen=True)
class DescribedKeypoints:
    """Keypoints of a frame."""

    at: Float[Tensor, "n 2"]
    """Positions (x, y) in the network's input, in [-1, 1] along its longer side."""
    descriptors: Float[Tensor, "n c"]
    """Unit descriptors."""


def assignment(i: DescribedKeypoints, j: DescribedKeypoints, p: Parameters) -> Float[Tensor, "n m"]:
    """Probability that two keypoints show the same point, for every pair (section 3.1 of the paper); 0 if given up."""
    for probability, is_last in _outputs(i, j, p):
        if is_last:
            return probability
        if expected_matches(probability) < MIN_EXPECTED:
            return torch.zeros_like(probability)
    raise AssertionError("the last layer has an output")


def first_assignment(i: DescribedKeypoints, j: DescribedKeypoints, p: Parameters) -> Float[Tensor, "n m"]:
    """The probabilities of the first layer that has an output."""
    return next(_outputs(i, j, p))[0]


def expected_matches(probability: Float[Tensor, "n m"]) -> float:
    """Sum of the best probabilities of all keypoints."""
    return float(probability.amax(1).sum())


def _outputs(
    i: DescribedKeypoints, j: DescribedKeypoints, p: Parameters
) -> Iterator[tuple[Float[Tensor, "n m"], bool]]:
    """Probabilities after every layer that has an output, and whether it is the last layer."""
    x_i, x_j = (_linear(each.descriptors, p, "input_proj") for each in (i, j))
    rotary_i, rotary_j = (_rotary(each.at, p) for each in (i, j))
    for layer in itertools.count():
        x_i, x_j = (
            _self_attention(x, rotary, p, f"transformers.{layer}.self_attn")
            for x, rotary in ((x_i, rotary_i), (x_j, rotary_j))
        )
        x_i, x_j = _cross_attention(x_i, x_j, p, f"transformers.{layer}.cross_attn")
        is_last = f"transformers.{layer + 1}.self_attn.Wqkv.weight" not in p
        if is_last or f"log_assignment.{layer}.final_proj.weight" in p:
            yield _probability(x_i, x_j, p, f"log_assignment.{layer}"), is_last
        if is_last:
            return


def _probability(x_i: Float[Tensor, "n c"], x_j: Float[Tensor, "m c"], p: Parameters, name: str) -> Tensor:
    """Probabilities of all pairs from the features after a layer."""
    y_i, y_j = (_linear(x, p, f"{name}.final_proj") for x in (x_i, x_j))
    similarity = y_i @ y_j.T / y_i.shape[-1] ** 0.5
    matchable_i, matchable_j = (_linear(x, p, f"{name}.matchability").sigmoid() for x in (x_i, x_j))
    return similarity.softmax(1) * similarity.softmax(0) * matchable_i * matchable_j.T


def _linear(x: Tensor, p: Parameters, name: str) -> Tensor:
    return functional.linear(x, p[f"{name}.weight"], p[f"{name}.bias"])


def _rotary(at: Tensor, p: Parameters) -> tuple[Tensor, Tensor]:
    """Rotary position encoding: cosines and sines that rotate pairs of channels, the same for all heads."""
    phase = (at @ p["posenc.Wr.weight"].T).repeat_interleave(2, -1)
    return phase.cos(), phase.sin()


def _rotate(x: Float[Tensor, "heads n c"], rotary: tuple[Tensor, Tensor]) -> Float[Tensor, "heads n c"]:
    """Channels rotated by the position encoding."""
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    return x * rotary[0] + torch.stack([-odd, even], -1).flatten(-2) * rotary[1]


def _self_attention(
    x: Float[Tensor, "n c"], rotary: tuple[Tensor, Tensor], p: Parameters, name: str
) -> Float[Tensor, "n c"]:
    """Features of one frame's keypoints after self-attention."""
    # Channels of the joint projection: head, then channel, then query, key, value.
    q, k, v = _linear(x, p, f"{name}.Wqkv").unflatten(-1, (HEADS, -1, 3)).permute(3, 1, 0, 2).unbind(0)
    message = functional.scaled_dot_product_attention(_rotate(q, rotary)[None], _rotate(k, rotary)[None], v[None])[0]
    return _update(x, _linear(message.transpose(0, 1).flatten(1), p, f"{name}.out_proj"), p, name)


def _cross_attention(x_i: Tensor, x_j: Tensor, p: Parameters, name: str) -> tuple[Tensor, Tensor]:
    """Features of both frames' keypoints after cross-attention."""

    def heads(x: Tensor, of: str) -> Tensor:
        return _linear(x, p, f"{name}.{of}").unflatten(-1, (HEADS, -1)).transpose(0, 1)[None]

    qk_i, qk_j, v_i, v_j = heads(x_i, "to_qk"), heads(x_j, "to_qk"), heads(x_i, "to_v"), heads(x_j, "to_v")
    to_i = functional.scaled_dot_product_attention(qk_i, qk_j, v_j)[0]
    to_j = functional.scaled_dot_product_attention(qk_j, qk_i, v_i)[0]
    out_i, out_j = (_linear(m.transpose(0, 1).flatten(1), p, f"{name}.to_out") for m in (to_i, to_j))
    return _update(x_i, out_i, p, name), _update(x_j, out_j, p, name)


def _update(x: Tensor, message: Tensor, p: Parameters, name: str) -> Tensor:
    """Features plus a network's output for features and message."""
    y = _linear(torch.cat([x, message], -1), p, f"{name}.ffn.0")
    y = functional.layer_norm(y, y.shape[-1:], p[f"{name}.ffn.1.weight"], p[f"{name}.ffn.1.bias"])
    return x + _linear(functional.gelu(y), p, f"{name}.ffn.3")
