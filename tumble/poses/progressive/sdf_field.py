"""Small networks that hold one object: signed distance, colour, and how sharp the surface is (section 4.1, NeuS).

Networks are trees of weights and functions of them; an optimizer sees leaves with names. Every linear layer `l` is
weight-normalised: `direction_l [out in]` gives each row its direction, `length_l [out]` its length, `bias_l [out]`.
Points are in the object frame [object radius]; the distance is negative inside. The gradient of the distance is
written out, backwards through the layers, so that terms on it (eikonal, shading) need one ordinary backward pass.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, relu, softplus

BETA = 100.0
"""Sharpness of softplus, nearly a ReLU with a second derivative (NeuS)."""


@dataclass(frozen=True)
class Sizes:
    """Of the two networks; values of NeuS, which the paper's section 4.1 takes over."""

    width: int = 256
    depth: int = 8
    """Hidden layers of the distance network."""
    skip: int = 4
    """Layer that sees the encoded point once more; 0 for none."""
    features: int = 256
    """What the distance network tells the colour network, besides the normal."""
    octaves: int = 6
    """Of the encoding of points."""
    colour_width: int = 256
    colour_depth: int = 4
    """Hidden layers of the colour network."""
    colour_octaves: int = 4
    """Of the encoding of view directions."""
    radius: float = 0.5
    """Of the sphere that the distance network starts as [object radius]."""


@dataclass(frozen=True)
class Layers:
    """Weight-normalised linear layers, by name."""

    weights: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.weights) // 3

    def linear(self, layer: int) -> tuple[Float[Tensor, "o i"], Float[Tensor, " o"]]:
        """Matrix and bias of one layer."""
        direction = normalize(self.weights[f"direction{layer}"], dim=-1)
        return direction * self.weights[f"length{layer}"][:, None], self.weights[f"bias{layer}"]


@dataclass(frozen=True)
class Sdf:
    """Weights of the distance network."""

    layers: Layers
    octaves: int
    skip: int


@dataclass(frozen=True)
class Colour:
    """Weights of the colour network."""

    layers: Layers
    octaves: int


@dataclass(frozen=True)
class Fields:
    """All that NeuS knows of an object."""

    sdf: Sdf
    colour: Colour
    log_sharpness: Float[Tensor, ""]
    """A tenth of the logarithm of the sharpness: Adam's steps are then those of the other weights (NeuS)."""

    @property
    def sharpness(self) -> Float[Tensor, ""]:
        """Of the logistic curve that turns distance into opacity [1 / object radius]."""
        return (10 * self.log_sharpness).clamp(-13.8, 13.8).exp()


def sphere(sizes: Sizes, rng: torch.Generator) -> Fields:
    """Networks that start as a grey sphere: `sdf ~ |x| - radius`.

    Random weights that come to it in the mean (geometric initialization, Atzmon and Lipman 2020), as in NeuS. That
    mean is off by a tenth at width 256 and by a quarter at 64; here the last row is then moved, as little as it takes,
    to where it fits the sphere.
    """
    skip = sizes.skip if 0 < sizes.skip < sizes.depth else 0
    layers = _layers(_geometric(sizes, skip, rng))
    sdf = Sdf(layers, sizes.octaves, skip)
    x = normalize(torch.randn(2048, 3, generator=rng), dim=-1) * 1.2 * torch.rand(2048, 1, generator=rng)
    h = _hidden(sdf, x).double()
    wanted = x.norm(dim=-1).double() - sizes.radius - _forward(sdf, x)[0][:, 0].double()
    ridge = 1e-3 * len(x) * h.square().mean() * torch.eye(h.shape[1], dtype=h.dtype)
    row = layers.linear(sizes.depth)[0][0] + torch.linalg.solve(h.T @ h + ridge, h.T @ wanted).float()
    layers.weights[f"direction{sizes.depth}"][0] = row
    layers.weights[f"length{sizes.depth}"][0] = row.norm()
    colour, n_in = [], 6 + 3 + 6 * sizes.colour_octaves + sizes.features
    for layer in range(sizes.colour_depth + 1):
        n_out = 3 if layer == sizes.colour_depth else sizes.colour_width
        reach = 1 / math.sqrt(n_in)
        matrix, bias = (reach * (2 * torch.rand(*s, generator=rng) - 1) for s in ((n_out, n_in), (n_out,)))
        colour.append((matrix, bias))
        n_in = n_out
    return Fields(sdf, Colour(_layers(colour), sizes.colour_octaves), torch.tensor(0.3))


def _geometric(sizes: Sizes, skip: int, rng: torch.Generator) -> list[tuple[Tensor, Tensor]]:
    """Matrices and biases of the distance network: each layer keeps lengths, the last one averages them."""
    encoded = 3 + 6 * sizes.octaves
    pairs: list[tuple[Tensor, Tensor]] = []
    n_in = encoded
    for layer in range(sizes.depth):
        n_out = sizes.width - encoded if skip and layer + 1 == skip else sizes.width
        matrix = math.sqrt(2 / n_out) * torch.randn(n_out, n_in, generator=rng)
        if layer == 0:
            matrix[:, 3:] = 0
        if skip and layer == skip:
            matrix[:, 3 - encoded :] = 0
        pairs.append((matrix, torch.zeros(n_out)))
        n_in = sizes.width
    matrix = math.sqrt(math.pi / n_in) + 1e-4 * torch.randn(1 + sizes.features, n_in, generator=rng)
    return [*pairs, (matrix, torch.full((1 + sizes.features,), -sizes.radius))]


def _layers(pairs: list[tuple[Tensor, Tensor]]) -> Layers:
    weights: dict[str, Tensor] = {}
    for i, (matrix, bias) in enumerate(pairs):
        weights |= {f"direction{i}": matrix, f"length{i}": matrix.norm(dim=-1), f"bias{i}": bias}
    return Layers(weights)


def distance(net: Sdf, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Signed distance alone, for marching along rays and for meshes."""
    return _forward(net, x)[0][:, 0]


def surface(
    net: Sdf, x: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n f"]]:
    """Signed distance, its gradient, and the features that the colour network reads; all differentiable."""
    out, slopes, matrices = _forward(net, x)
    encoded = 3 + 6 * net.octaves
    gradient = matrices[-1][0].expand(len(x), -1)
    direct = x.new_zeros(len(x), encoded)
    for layer in range(len(slopes) - 1, -1, -1):
        if layer + 1 == net.skip:
            gradient = gradient * math.sqrt(0.5)
            direct = gradient[:, -encoded:]
            gradient = gradient[:, :-encoded]
        gradient = (gradient * slopes[layer]) @ matrices[layer]
    return out[:, 0], _through_encoding(gradient + direct, x, net.octaves), out[:, 1:]


def colour(
    net: Colour,
    x: Float[Tensor, "n 3"],
    view: Float[Tensor, "n 3"],
    normal: Float[Tensor, "n 3"],
    features: Float[Tensor, "n f"],
) -> Float[Tensor, "n 3"]:
    """Colour in [0, 1] that the object shows at points `x` to rays of direction `view`."""
    h = torch.cat([x, encode(view, net.octaves), normal, features], -1)
    last = len(net.layers) - 1
    for layer in range(last):
        matrix, bias = net.layers.linear(layer)
        h = relu(torch.addmm(bias, h, matrix.T))
    matrix, bias = net.layers.linear(last)
    return torch.sigmoid(torch.addmm(bias, h, matrix.T))


def encode(x: Float[Tensor, "n 3"], octaves: int) -> Float[Tensor, "n e"]:
    """The point itself, then its sines, then its cosines, of frequencies 1, 2, 4, ..."""
    angles = _angles(x, octaves)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


def _angles(x: Tensor, octaves: int) -> Tensor:
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    return (x[:, None] * frequencies[:, None]).flatten(1)


def _through_encoding(v_encoded: Tensor, x: Tensor, octaves: int) -> Float[Tensor, "n 3"]:
    """The gradient for `x` from that for `encode(x)`."""
    if octaves == 0:
        return v_encoded
    n = 3 * octaves
    angles = _angles(x, octaves)
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    waves = v_encoded[:, 3 : 3 + n] * angles.cos() - v_encoded[:, 3 + n :] * angles.sin()
    return v_encoded[:, :3] + (waves.reshape(-1, octaves, 3) * frequencies[:, None]).sum(1)


def _hidden(net: Sdf, x: Tensor) -> Tensor:
    """What the last layer of the distance network reads."""
    return _forward(net, x, last=False)[0]


def _forward(net: Sdf, x: Tensor, *, last: bool = True) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Output of the (last) layer, the slopes of all softplus, and all matrices."""
    encoded = encode(x, net.octaves)
    h, slopes, matrices = encoded, [], []
    for layer in range(len(net.layers) - 1):
        if layer == net.skip and layer:
            h = torch.cat([h, encoded], -1) * math.sqrt(0.5)
        matrix, bias = net.layers.linear(layer)
        h = torch.addmm(bias, h, matrix.T)
        slopes.append(torch.sigmoid(BETA * h))
        matrices.append(matrix)
        h = softplus(h, beta=BETA)
    if not last:
        return h, slopes, matrices
    matrix, bias = net.layers.linear(len(net.layers) - 1)
    return torch.addmm(bias, h, matrix.T), slopes, [*matrices, matrix]
