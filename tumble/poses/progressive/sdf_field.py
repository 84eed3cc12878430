"""Neural fields of one object: signed distance function (SDF), colour and sharpness (section 4.1; NeuS).

Networks are trees of named weights and functions of them. Every linear layer `l` is weight-normalised: `direction_l
[out in]` gives the direction of each row, `length_l [out]` its length, and `bias_l [out]` its bias. Points are in the
object frame [object radius]; the distance is negative inside. The gradient of the distance is computed analytically,
backwards through the layers, so that losses on it (eikonal, colour) need only one ordinary backward pass.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, relu, softplus

from tumble.poses.progressive import grid_field
from tumble.poses.progressive.grid_field import Grids

BETA = 100.0
"""Sharpness of softplus, which is then nearly a ReLU but twice differentiable (NeuS)."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of the two networks; the defaults are those of NeuS, which the paper adopts (section 4.1)."""

    width: int = 256
    """Units of the hidden layers of the distance network."""
    depth: int = 8
    """Number of hidden layers of the distance network."""
    skip: int = 4
    """Index of the layer that also takes the encoded point (skip connection); 0 for none."""
    features: int = 256
    """Number of features that the colour network takes from the distance network."""
    octaves: int = 6
    """Octaves of the positional encoding of points."""
    colour_width: int = 256
    """Units of the hidden layers of the colour network."""
    colour_depth: int = 4
    """Number of hidden layers of the colour network."""
    colour_octaves: int = 4
    """Octaves of the positional encoding of view directions."""
    radius: float = 0.5
    """Radius of the initial sphere [object radius]."""
    nodes: tuple[int, ...] = ()
    """Nodes per side of each of the voxel grids that replace the distance network (`grid_field`); none: the network."""
    bound: float = 1.1
    """Half the side of the cube that the grids cover [object radius]."""


@dataclass(frozen=True)
class Layers:
    """Weight-normalised linear layers, by name."""

    weights: dict[str, Tensor]
    """Directions, lengths and biases, see the module."""

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
    """Linear layers."""
    octaves: int
    """Octaves of the positional encoding of points."""
    skip: int
    """Index of the layer that also takes the encoded point; 0 for none."""


@dataclass(frozen=True)
class Colour:
    """Weights of the colour network."""

    layers: Layers
    """Linear layers."""
    octaves: int
    """Octaves of the positional encoding of view directions."""


@dataclass(frozen=True)
class Fields:
    """Distance network, colour network and sharpness of one object."""

    sdf: Sdf | Grids
    """Distance network, or voxel grids in its place."""
    colour: Colour
    """Colour network."""
    log_sharpness: Float[Tensor, ""]
    """A tenth of the logarithm of the sharpness, so that Adam's steps are of the size of other weights' (NeuS)."""

    @property
    def sharpness(self) -> Float[Tensor, ""]:
        """Sharpness of the logistic function that converts distance to opacity [1 / object radius]."""
        return (10 * self.log_sharpness).clamp(-13.8, 13.8).exp()


def sphere_initialised(sizes: Sizes, rng: torch.Generator) -> Fields:
    """Initial networks, whose shape is a sphere: `sdf ~ |x| - radius`.

    Geometric initialisation as in NeuS (Atzmon and Lipman 2020) gives a sphere only on average over random weights. The
    row of the last layer that outputs the distance is therefore corrected by ridge regression to fit the sphere.
    """
    if sizes.nodes:
        grids = grid_field.sphere(sizes.nodes, sizes.features, radius=sizes.radius, bound=sizes.bound, rng=rng)
        return Fields(grids, _colour_network(sizes, rng), torch.tensor(0.3))
    skip = sizes.skip if 0 < sizes.skip < sizes.depth else 0
    layers = _layers(_geometric_init(sizes, skip, rng))
    sdf = Sdf(layers, sizes.octaves, skip)
    x = normalize(torch.randn(2048, 3, generator=rng), dim=-1) * 1.2 * torch.rand(2048, 1, generator=rng)
    h = _last_hidden(sdf, x).double()
    correction = x.norm(dim=-1).double() - sizes.radius - _forward(sdf, x)[0][:, 0].double()
    ridge = 1e-3 * len(x) * h.square().mean() * torch.eye(h.shape[1], dtype=h.dtype)
    row = layers.linear(sizes.depth)[0][0] + torch.linalg.solve(h.T @ h + ridge, h.T @ correction).float()
    layers.weights[f"direction{sizes.depth}"][0] = row
    layers.weights[f"length{sizes.depth}"][0] = row.norm()
    return Fields(sdf, _colour_network(sizes, rng), torch.tensor(0.3))


def _colour_network(sizes: Sizes, rng: torch.Generator) -> Colour:
    """Initial colour network."""
    colour, n_in = [], 6 + 3 + 6 * sizes.colour_octaves + sizes.features
    for layer in range(sizes.colour_depth + 1):
        n_out = 3 if layer == sizes.colour_depth else sizes.colour_width
        limit = 1 / math.sqrt(n_in)
        matrix, bias = (limit * (2 * torch.rand(*s, generator=rng) - 1) for s in ((n_out, n_in), (n_out,)))
        colour.append((matrix, bias))
        n_in = n_out
    return Colour(_layers(colour), sizes.colour_octaves)


def _geometric_init(sizes: Sizes, skip: int, rng: torch.Generator) -> list[tuple[Tensor, Tensor]]:
    """Geometric initialisation of the distance network: matrices and biases of all layers."""
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
    """Weight-normalised layers from matrices and biases."""
    weights: dict[str, Tensor] = {}
    for i, (matrix, bias) in enumerate(pairs):
        weights |= {f"direction{i}": matrix, f"length{i}": matrix.norm(dim=-1), f"bias{i}": bias}
    return Layers(weights)


def distance(net: Sdf | Grids, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Signed distance without its gradient, for the extraction of surfaces."""
    if isinstance(net, Grids):
        return grid_field.distance(net, x)
    return _forward(net, x)[0][:, 0]


def distance_and_gradient(
    net: Sdf | Grids, x: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n f"]]:
    """Signed distance, its gradient, and the features for the colour network; all differentiable."""
    if isinstance(net, Grids):
        return grid_field.distance_and_gradient(net, x)
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
    return out[:, 0], _encoding_backward(gradient + direct, x, net.octaves), out[:, 1:]


def colour(
    net: Colour,
    x: Float[Tensor, "n 3"],
    view: Float[Tensor, "n 3"],
    normal: Float[Tensor, "n 3"],
    features: Float[Tensor, "n f"],
) -> Float[Tensor, "n 3"]:
    """Colour, sRGB in [0, 1], at points `x` for rays of direction `view`; `normal` is the distance's gradient."""
    h = torch.cat([x, encode(view, net.octaves), normal, features], -1)
    last = len(net.layers) - 1
    for layer in range(last):
        matrix, bias = net.layers.linear(layer)
        h = relu(torch.addmm(bias, h, matrix.T))
    matrix, bias = net.layers.linear(last)
    return torch.sigmoid(torch.addmm(bias, h, matrix.T))


def encode(x: Float[Tensor, "n 3"], octaves: int) -> Float[Tensor, "n e"]:
    """Positional encoding: the point, then the sines, then the cosines of its multiples by 1, 2, 4, ..."""
    angles = _angles(x, octaves)
    return torch.cat([x, angles.sin(), angles.cos()], -1)


def _angles(x: Tensor, octaves: int) -> Tensor:
    """Multiples of the coordinates by 1, 2, 4, ... [radians]."""
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    return (x[:, None] * frequencies[:, None]).flatten(1)


def _encoding_backward(v_encoded: Tensor, x: Tensor, octaves: int) -> Float[Tensor, "n 3"]:
    """Gradient with respect to `x` from that with respect to `encode(x)`."""
    if octaves == 0:
        return v_encoded
    n = 3 * octaves
    angles = _angles(x, octaves)
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    waves = v_encoded[:, 3 : 3 + n] * angles.cos() - v_encoded[:, 3 + n :] * angles.sin()
    return v_encoded[:, :3] + (waves.reshape(-1, octaves, 3) * frequencies[:, None]).sum(1)


def _last_hidden(net: Sdf, x: Tensor) -> Tensor:
    """Output of the distance network's last hidden layer."""
    return _forward(net, x, last=False)[0]


def _forward(net: Sdf, x: Tensor, *, last: bool = True) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Output of the last layer, or of the last hidden one; derivatives of all activations; matrices of all layers."""
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
