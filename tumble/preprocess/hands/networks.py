"""The two networks of MediaPipe's hand tracker (Zhang et al. 2020): one finds palms, one the landmarks of a hand.

Both are convolutional networks with float16 weights that come with the package (`docs/make_hand_networks.py` makes the
file); they are computed in float32. TensorFlow pads a convolution of stride 2 with one row and column less on the left
and at the top than on the right and at the bottom.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

WEIGHTS = Path(__file__).with_name("networks.safetensors")
"""Weights that come with the package."""
PALM_SIDE = 192
"""Side of the images in which palms are found [pixels]."""
LANDMARK_SIDE = 224
"""Side of the images in which landmarks are found [pixels]."""
STRIDES = (2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1, 1, 1)
"""Strides of the inverted residual blocks of the landmark network."""


@dataclass(frozen=True)
class Layer:
    """A convolution, depthwise if its weight has one input channel, or a linear layer."""

    weight: Tensor
    """[out, in, height, width], or [out, in] for a linear layer."""
    bias: Tensor
    """[out]"""
    slope: Tensor | None
    """Slopes of the PReLU that follows, for negative values, per channel."""


@cache
def layers(network: str) -> tuple[Layer, ...]:
    """The layers of the network "palm" or "hand", in the order in which they run."""
    tensors = {k: v.float() for k, v in safetensors.torch.load_file(WEIGHTS).items() if k.startswith(network)}
    names = sorted(name.removesuffix(".bias") for name in tensors if name.endswith(".bias"))
    return tuple(Layer(_fast(tensors[f"{n}.weight"]), tensors[f"{n}.bias"], tensors.get(f"{n}.slope")) for n in names)


def _fast(weight: Tensor) -> Tensor:
    """A weight in the memory layout that convolutions of images with channels last are fastest in."""
    return weight.contiguous(memory_format=torch.channels_last) if weight.ndim == 4 else weight


def convolve(x: Float[Tensor, "n c h w"], layer: Layer, stride: int = 1) -> Float[Tensor, "n d i j"]:
    """Convolution with TensorFlow's padding "same": ceil(size / stride) outputs, the odd row and column at the end."""
    kernel = layer.weight.shape[-1]
    before = (kernel - stride) // 2
    if kernel - stride > 2 * before:
        x, before = functional.pad(x, (before, before + 1, before, before + 1)), 0
    groups = x.shape[1] if layer.weight.shape[1] == 1 else 1
    return functional.conv2d(x, layer.weight, layer.bias, stride, before, groups=groups)


def _prelu(x: Tensor, layer: Layer) -> Tensor:
    assert layer.slope is not None
    return functional.prelu(x, layer.slope)


def _block(x: Tensor, todo: Iterator[Layer], stride: int = 1) -> Tensor:
    """Residual block of the palm network: depthwise and pointwise convolution, sum with the input, PReLU."""
    y = convolve(x, next(todo), stride)
    last = next(todo)
    y = convolve(y, last)
    if stride == 2:
        x = functional.max_pool2d(x, 2)
        x = functional.pad(x, (0, 0, 0, 0, 0, y.shape[1] - x.shape[1]))
    return _prelu(y.add_(x), last)


def _blocks(x: Tensor, todo: Iterator[Layer], n: int) -> Tensor:
    for _ in range(n):
        x = _block(x, todo)
    return x


def _enlarge(x: Tensor, finer: Tensor, todo: Iterator[Layer]) -> Tensor:
    """A coarse feature map at twice its size, added to a finer one."""
    layer = next(todo)
    x = functional.interpolate(x, scale_factor=2, mode="bilinear")
    return _prelu(convolve(x, layer), layer) + finer


def _per_anchor(x: Tensor, layer: Layer, n_values: int) -> Tensor:
    """Outputs of a feature map as rows, one per anchor: cells by row and column, then the anchors of a cell."""
    return convolve(x, layer).permute(0, 2, 3, 1).reshape(len(x), -1, n_values)


@torch.inference_mode()
def palms(x: Float[Tensor, "n 3 192 192"]) -> tuple[Float[Tensor, "n 2016"], Float[Tensor, "n 2016 18"]]:
    """Logits of a palm at each anchor, and its box and seven keypoints as offsets from the anchor [pixels].

    Anchors are those of a grid of 24 x 24 cells with two anchors each, then of 12 x 12 cells with six each. The values
    are x and y of the centre, width and height, then x and y of the keypoints. Input: RGB in [0, 1].
    """
    todo = iter(layers("palm"))
    first = next(todo)
    x = _prelu(convolve(x.contiguous(memory_format=torch.channels_last), first, 2), first)
    maps = [_blocks(x, todo, 4)]
    for _ in range(4):
        maps.append(_blocks(_block(maps[-1], todo, 2), todo, 4))
    coarse = _blocks(_enlarge(maps[4], maps[3], todo), todo, 2)
    coarse_logits, coarse_values = _per_anchor(coarse, next(todo), 1), _per_anchor(coarse, next(todo), 18)
    fine = _blocks(_enlarge(coarse, maps[2], todo), todo, 2)
    fine_logits, fine_values = _per_anchor(fine, next(todo), 1), _per_anchor(fine, next(todo), 18)
    return torch.cat([fine_logits, coarse_logits], 1)[..., 0], torch.cat([fine_values, coarse_values], 1)


@torch.inference_mode()
def landmarks(
    x: Float[Tensor, "n 3 224 224"],
) -> tuple[Float[Tensor, "n 21 3"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Landmarks of a hand [pixels], probability that there is one, and probability that it is a right hand.

    The third coordinate of a landmark is its depth relative to the wrist, in the same unit. Input: RGB in [0, 1].
    """
    *convolutions, right, presence, positions = layers("hand")
    todo = iter(convolutions)
    x = convolve(x.contiguous(memory_format=torch.channels_last), next(todo), 2).clamp_(0, 6)
    x = convolve(x, next(todo)).clamp_(0, 6)
    x = convolve(x, next(todo))
    for stride in STRIDES:
        y = convolve(x, next(todo)).clamp_(0, 6)
        y = convolve(y, next(todo), stride).clamp_(0, 6)
        y = convolve(y, next(todo))
        x = y.add_(x) if y.shape == x.shape else y
    x = convolve(x, next(todo)).clamp_(0, 6)
    x = convolve(x, next(todo)).clamp_(0, 6)
    features = x.mean((2, 3))

    def dense(layer: Layer) -> Tensor:
        return functional.linear(features, layer.weight, layer.bias)

    return dense(positions).reshape(-1, 21, 3), dense(presence).sigmoid()[:, 0], dense(right).sigmoid()[:, 0]
