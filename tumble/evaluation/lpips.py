"""LPIPS v0.1: the distance of two pictures as a trained network feels it (Zhang et al. 2018).

Both pictures go through the convolutions of an image classifier. At five *taps* the features are normalised over
their channels, subtracted, squared, weighted by a learned *linear layer* and averaged over the picture; the five are
summed. AlexNet's weights come with the package (float16); VGG's are read from a file the user has (docs/metrics.md).
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tumble.io import BadFile

SHIPPED = Path(__file__).with_name("lpips_alex.safetensors")
SMALLEST = 64
"""Shorter side below which pictures are enlarged [pixels]: the linear layers were fitted to patches of 64 x 64,
and AlexNet's last tap is empty below 31."""
MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Colour statistics that the classifiers were trained with, for values in [-1, 1]."""


class Convolution(NamedTuple):
    """One step of a classifier: max-pool, convolve, ReLU."""

    pool: int = 0
    """Window of the max-pooling (stride 2) before the convolution; 0 for none."""
    stride: int = 1
    padding: int = 1
    tap: bool = True
    """Whether the distance looks at what comes out."""


PLANS = {
    "alex": (Convolution(0, 4, 2), Convolution(3, 1, 2), Convolution(3), Convolution(), Convolution()),
    "vgg": (
        *(Convolution(tap=False), Convolution()),
        *(Convolution(2, tap=False), Convolution()),
        *(Convolution(2, tap=False), Convolution(tap=False), Convolution()),
        *(Convolution(2, tap=False), Convolution(tap=False), Convolution()),
        *(Convolution(2, tap=False), Convolution(tap=False), Convolution()),
    ),
}


@dataclass(frozen=True)
class Network:
    """A classifier's convolutions and LPIPS's linear layers."""

    name: str
    """"alex" or "vgg"."""
    weights: dict[str, Tensor]
    """`convK.weight` [out, in, height, width], `convK.bias` [out], `linK.weight` [channels of tap K]."""


def read(path: Path = SHIPPED) -> Network:
    """The network in a .safetensors or .npz file, of either kind; without a path, AlexNet.

    Raises:
        BadFile: Missing, unreadable, or neither AlexNet nor VGG-16 with five linear layers.
    """
    if not path.is_file():
        raise BadFile(path, "is missing")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                weights = {name: torch.from_numpy(arrays[name]) for name in arrays}
        else:
            weights = safetensors.torch.load_file(path)
    except (OSError, ValueError, zipfile.BadZipFile, safetensors.SafetensorError) as error:
        raise BadFile(path, f"holds no weights: {error}") from None
    name = "alex" if "conv12.weight" not in weights else "vgg"
    wanted = {f"conv{k}.{part}" for k in range(len(PLANS[name])) for part in ("weight", "bias")}
    if missing := sorted((wanted | {f"lin{k}.weight" for k in range(5)}) - set(weights)):
        raise BadFile(path, f"lacks {', '.join(missing[:3])} of LPIPS's {name} network")
    flat = {name: value.reshape(-1) for name, value in weights.items() if name.startswith("lin")}
    # Files keep 16 bits; arithmetic is done in the pictures' precision, which is rarely that.
    return Network(name, {name: value.float() for name, value in {**weights, **flat}.items()})


def distance(network: Network, x: Float[Tensor, "*b h w 3"], y: Float[Tensor, "*b h w 3"]) -> Float[Tensor, "*b"]:
    """LPIPS of pictures in sRGB, [0, 1]; 0 where they are equal.

    Pictures whose shorter side is under `SMALLEST` are first enlarged bilinearly, by the least whole factor that
    reaches it. Differentiable in both pictures.
    """
    batch = x.shape[:-3]
    total = x.new_zeros(())
    for k, features in enumerate(_features(network, torch.stack([x, y]))):
        a, b = _unit(features).chunk(2)
        squared = (a - b).square().mean((2, 3))
        total = total + squared @ network.weights[f"lin{k}.weight"].to(x)
    return total.reshape(batch)


def _features(network: Network, picture: Float[Tensor, "*b h w 3"]) -> list[Float[Tensor, "n _c _h _w"]]:
    """What comes out at the taps."""
    x = ((2 * picture - 1) - picture.new_tensor(MEAN)) / picture.new_tensor(DEVIATION)
    x = _enlarged(x.reshape(-1, *x.shape[-3:]).permute(0, 3, 1, 2))
    taps = []
    for k, step in enumerate(PLANS[network.name]):
        weight, bias = (network.weights[f"conv{k}.{part}"].to(x) for part in ("weight", "bias"))
        x = functional.max_pool2d(x, step.pool, 2) if step.pool else x
        x = functional.conv2d(x, weight, bias, step.stride, step.padding).relu()
        taps += [x] if step.tap else []
    return taps


def _enlarged(x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 _h _w"]:
    factor = -(-SMALLEST // min(x.shape[-2:]))
    if factor <= 1:
        return x
    return functional.interpolate(x, scale_factor=float(factor), mode="bilinear", align_corners=False)


def _unit(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    # The floor of the published metric stands outside the root; the one inside is for the derivative at 0.
    length = (features.square().sum(1, keepdim=True) + 1e-20).sqrt()
    return features / (length + 1e-10)
