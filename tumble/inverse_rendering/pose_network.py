"""Corrections of the initial poses: a tangent per frame, or one network with embeddings of the frames (section 4.2).

A network is a dict of tensors: `embeddings`, and the weights and biases of its three layers. The paper states no sizes;
these are those of FMOV's pose networks. Its last layer starts at zero, so that every pose starts at its initial value.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import gelu, linear

from tumble.maths import SE3, Index, entry

EMBEDDING = 32
"""Numbers in the embedding of a frame."""
WIDTH = 64
"""Units of each of the two hidden layers (FMOV)."""


def initial(n_frames: int, like: Tensor, rng: torch.Generator) -> dict[str, Tensor]:
    """Network with random embeddings and hidden layers, whose output is 0 for every frame."""
    network = {"embeddings": torch.randn(n_frames, EMBEDDING, generator=rng)}
    for layer, (rows, columns) in enumerate(((WIDTH, EMBEDDING), (WIDTH, WIDTH))):
        limit = 1 / math.sqrt(columns)
        network[f"weight{layer}"] = limit * (2 * torch.rand(rows, columns, generator=rng) - 1)
        network[f"bias{layer}"] = limit * (2 * torch.rand(rows, generator=rng) - 1)
    network |= {"weight2": torch.zeros(6, WIDTH), "bias2": torch.zeros(6)}
    return {name: x.to(like) for name, x in network.items()}


def tangents(network: dict[str, Tensor], frame: Index | slice) -> Float[Tensor, "*f 6"]:
    """Tangent of the correction of one frame, or of several."""
    hidden = _selected(network["embeddings"], frame)
    for layer in range(2):
        hidden = gelu(linear(hidden, network[f"weight{layer}"], network[f"bias{layer}"]))
    return linear(hidden, network["weight2"], network["bias2"])


def correction(
    poses: Float[Tensor, "t 6"],
    network: dict[str, Tensor],
    frame: Index | slice,
    *,
    before: dict[str, Tensor] | None = None,
) -> SE3:
    """Motion in the camera frame that corrects the initial pose of one frame, or of several.

    Args:
        poses: Tangents of all frames, which count if there is no network.
        network: A network, or an empty dict.
        frame: Index of the frame, or slice of the frames.
        before: A network whose corrections the initial pose has already, which are taken out of those of another one.
    """
    now = SE3.exp(tangents(network, frame) if network else _selected(poses, frame))
    return now @ SE3.exp(tangents(before, frame)).inverse() if network and before else now


def _selected(of_frames: Tensor, frame: Index | slice) -> Tensor:
    return of_frames[frame] if isinstance(frame, slice) else entry(of_frames, frame)
