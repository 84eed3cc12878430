"""What poses come from: networks, or plain numbers, behind one function of the frames' numbers.

A *pose source* is a tree of weights with `raw(source, frames) -> [f k]`. What the numbers mean is a second choice:
`orbit` turns the object about its centre, scales its distance and shifts it across (stage 1), `delta` is a small
bounded motion in the camera frame (stages 2 and 3, `delta(raw, ...) @ base`). All start (nearly) at "no change".
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import gelu, pad

from tumble.maths import SE3, SO3

CODE_SPREAD = 10.0
"""Standard deviation of the frequencies of a frame's code (FMOV): neighbours in time have unrelated codes."""
HEAD_SPREAD = 0.01
"""Standard deviation of the last layer's weights at the start (FMOV)."""


@dataclass(frozen=True)
class Vectors:
    """Plain numbers per frame: the fastest to train, and no frame disturbs another."""

    values: dict[str, Tensor]
    """`[k]` by frame: a leaf each, so that an optimizer leaves frames alone that a loss does not reach."""


@dataclass(frozen=True)
class FrameMlps:
    """One small network per frame, fed with a fixed random code of the frame (section 4.1; FMOV)."""

    codes: Float[Tensor, "t c"]
    """Not trained."""
    values: dict[str, Tensor]
    """All weights of a frame's network in one vector, by frame."""
    width: int
    out: int


@dataclass(frozen=True)
class GlobalMlp:
    """One network for all frames, fed with a learned embedding of each (section 4.2)."""

    embeddings: Float[Tensor, "t e"]
    layers: dict[str, Tensor]
    """Weights of one network, under one name."""
    width: int
    out: int


PoseSource = Vectors | FrameMlps | GlobalMlp


def vectors(n_frames: int, out: int) -> Vectors:
    """No change in any frame."""
    return Vectors({str(i): torch.zeros(out) for i in range(n_frames)})


def frame_mlps(n_frames: int, out: int, rng: torch.Generator, *, width: int = 64, code: int = 256) -> FrameMlps:
    """Networks of two hidden layers over codes `[sin(2 pi i b), cos(2 pi i b)]`; sizes of FMOV.

    FMOV draws the frequencies `b` once per network from NumPy's global generator; here from the given one.
    """
    b = CODE_SPREAD * torch.randn(n_frames, code // 2, generator=rng)
    phase = 2 * math.pi * torch.arange(n_frames)[:, None] * b
    codes = torch.cat([phase.sin(), phase.cos()], -1) / math.sqrt(code // 2)
    return FrameMlps(codes, {str(i): _mlp(code, width, out, rng) for i in range(n_frames)}, width, out)


def global_mlp(n_frames: int, out: int, rng: torch.Generator, *, width: int = 64, embedding: int = 32) -> GlobalMlp:
    """Sizes are not stated in the paper."""
    embeddings = HEAD_SPREAD * torch.randn(n_frames, embedding, generator=rng)
    return GlobalMlp(embeddings, {"mlp": _mlp(embedding, width, out, rng)}, width, out)


def raw(source: PoseSource, frames: Sequence[int]) -> Float[Tensor, "f k"]:
    """What a source says of some frames, about 0 at the start."""
    if isinstance(source, Vectors):
        return torch.stack([source.values[str(i)] for i in frames])
    if isinstance(source, FrameMlps):
        weights = torch.stack([source.values[str(i)] for i in frames])
        return _through(weights, source.codes[list(frames)], source.width, source.out)
    inputs = source.embeddings[list(frames)]
    weights = source.layers["mlp"].expand(len(inputs), -1)
    return _through(weights, inputs, source.width, source.out)


def orbit(base: SE3, raw: Float[Tensor, "*b 6"]) -> SE3:
    """Turn the object about its own centre by `pi raw[:3]` (object axes), scale its distance by `1 + raw[3]`, and shift
    it across the view by `raw[4:]` [object radius].

    The first four are FMOV's. Its camera orbits, `[Exp | 0] @ [R | s c]` for camera to object; this is the same motion
    seen from the camera: without a shift, the direction in which the object's centre is seen stays.
    """
    turned = base.rotation @ SO3.exp(-math.pi * raw[..., :3])
    return SE3.from_rotation(turned, base.xyz * (1 + raw[..., 3:4]) + pad(raw[..., 4:], (0, 1)))


def delta(raw: Float[Tensor, "*b 6"], *, rotation: float, translation: float) -> SE3:
    """A motion in the camera frame of at most `rotation` [radians] and `translation` [object radius] per axis.

    `delta(raw, ...) @ base` is a refined pose. With the bounds as scale, 0.01 moves by a hundredth of them.
    """
    v, omega = raw.tanh().split(3, -1)
    return SE3.exp(torch.cat([translation * v, rotation * omega], -1))


def _mlp(n_in: int, width: int, out: int, rng: torch.Generator) -> Float[Tensor, " w"]:
    """Weights of two hidden layers as one vector; torch's own start for these, nearly 0 for the last layer."""
    parts = []
    for rows, columns in ((width, n_in), (width, width)):
        reach = 1 / math.sqrt(columns)
        parts += [reach * (2 * torch.rand(rows * columns + rows, generator=rng) - 1)]
    return torch.cat([*parts, HEAD_SPREAD * torch.randn(out * width, generator=rng), torch.zeros(out)])


def _through(weights: Float[Tensor, "f w"], x: Float[Tensor, "f i"], width: int, out: int) -> Float[Tensor, "f o"]:
    """One network per row."""
    h, start = x, 0
    for layer, rows in enumerate((width, width, out)):
        columns = h.shape[-1]
        matrix = weights[:, start : start + rows * columns].reshape(-1, rows, columns)
        start += rows * columns
        h = torch.einsum("foi,fi->fo", matrix, h) + weights[:, start : start + rows]
        start += rows
        h = gelu(h) if layer < 2 else h
    return h
