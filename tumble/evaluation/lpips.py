"""LPIPS v0.1: learned perceptual distance of two images (Zhang et al. 2018).

Both images pass through the convolutions of an image classifier. The features of five layers are normalised over
their channels, subtracted, squared, weighted per channel by a learned *linear layer*, and averaged over the image; the
distance is the sum over the five layers. AlexNet's weights come with the package (float16); VGG's weights are read from
a file that the user provides (docs/metrics.md).
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

ALEXNET_WEIGHTS = Path(__file__).with_name("lpips_alex.safetensors")
"""Weights that come with the package."""
MIN_SIDE = 64
"""Shorter side below which images are enlarged [pixels]: the linear layers were trained on patches of 64 x 64, and
AlexNet's last feature map is empty below 31."""
MEAN = (-0.030, -0.088, -0.188)
"""Mean colour of the classifiers' training images, for values in [-1, 1]."""
STANDARD_DEVIATION = (0.458, 0.448, 0.450)
"""Standard deviation of the same colours."""


class Convolution(NamedTuple):
    """One layer of a classifier: max-pooling, convolution, ReLU."""

    pool: int = 0
    """Window of the max-pooling (stride 2) before the convolution; 0 for none."""
    stride: int = 1
    padding: int = 1
    compared: bool = True
    """Whether the layer's output enters the distance."""


ARCHITECTURES = {
    "alex": (Convolution(0, 4, 2), Convolution(3, 1, 2), Convolution(3), Convolution(), Convolution()),
    "vgg": (
        *(Convolution(compared=False), Convolution()),
        *(Convolution(2, compared=False), Convolution()),
        *(Convolution(2, compared=False), Convolution(compared=False), Convolution()),
        *(Convolution(2, compared=False), Convolution(compared=False), Convolution()),
        *(Convolution(2, compared=False), Convolution(compared=False), Convolution()),
    ),
}
"""Convolutions of AlexNet and VGG-16, in order."""


@dataclass(frozen=True)
class Network:
    """A classifier's convolutions and the linear layers of LPIPS."""

    name: str
    """"alex" or "vgg"."""
    weights: dict[str, Tensor]
    """`convK.weight` [out, in, height, width], `convK.bias` [out], `linK.weight` [channels of compared layer K]."""


def read(path: Path = ALEXNET_WEIGHTS) -> Network:
    """The network in a .safetensors or .npz file, either AlexNet or VGG-16; AlexNet by default.

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
    required = {f"conv{k}.{part}" for k in range(len(ARCHITECTURES[name])) for part in ("weight", "bias")}
    if missing := sorted((required | {f"lin{k}.weight" for k in range(5)}) - set(weights)):
        raise BadFile(path, f"lacks {', '.join(missing[:3])} of LPIPS's {name} network")
    flat = {name: value.reshape(-1) for name, value in weights.items() if name.startswith("lin")}
    # Weights are stored with 16 bits; the arithmetic needs at least 32.
    return Network(name, {name: value.float() for name, value in {**weights, **flat}.items()})


def distance(network: Network, x: Float[Tensor, "*b h w 3"], y: Float[Tensor, "*b h w 3"]) -> Float[Tensor, "*b"]:
    """LPIPS distance of sRGB images in [0, 1]; 0 where they are equal.

    Images whose shorter side is below `MIN_SIDE` are first enlarged bilinearly, by the smallest integer factor that
    reaches it. Differentiable in both images.
    """
    batch = x.shape[:-3]
    total = x.new_zeros(())
    for k, features in enumerate(_features(network, torch.stack([x, y]))):
        a, b = _normalized(features).chunk(2)
        squared = (a - b).square().mean((2, 3))
        total = total + squared @ network.weights[f"lin{k}.weight"].to(x)
    return total.reshape(batch)


def _features(network: Network, image: Float[Tensor, "*b h w 3"]) -> list[Float[Tensor, "n _c _h _w"]]:
    """Outputs of the compared layers."""
    x = ((2 * image - 1) - image.new_tensor(MEAN)) / image.new_tensor(STANDARD_DEVIATION)
    x = _enlarged(x.reshape(-1, *x.shape[-3:]).permute(0, 3, 1, 2))
    features = []
    for k, layer in enumerate(ARCHITECTURES[network.name]):
        weight, bias = (network.weights[f"conv{k}.{part}"].to(x) for part in ("weight", "bias"))
        x = functional.max_pool2d(x, layer.pool, 2) if layer.pool else x
        x = functional.conv2d(x, weight, bias, layer.stride, layer.padding).relu()
        features += [x] if layer.compared else []
    return features


def _enlarged(x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 _h _w"]:
    factor = -(-MIN_SIDE // min(x.shape[-2:]))
    if factor <= 1:
        return x
    return functional.interpolate(x, scale_factor=float(factor), mode="bilinear", align_corners=False)


def _normalized(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    # The published metric adds 1e-10 outside the root; 1e-20 inside keeps the derivative at 0 finite.
    length = (features.square().sum(1, keepdim=True) + 1e-20).sqrt()
    return features / (length + 1e-10)
