"""Pose parametrisations: per-frame vectors or networks, and the motion that their outputs stand for.

A *pose source* is a tree of weights from which `raw_outputs(source, frames)` computes `k` numbers per frame, about zero
at the start. `orbit` converts these to a motion: it rotates the object about its centre, scales its distance and shifts
it across the view.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import gelu, pad

from tumble.maths import SE3, SO3

CODE_STD = 10.0
"""Standard deviation of the frequencies in the frames' codes (FMOV); neighbouring frames get unrelated codes."""
HEAD_STD = 0.01
"""Standard deviation of the initial weights of the last layer (FMOV)."""


@dataclass(frozen=True)
class Vectors:
    """Independent numbers per frame, which converge fastest."""

    values: dict[str, Tensor]
    """Tensors `[k]` by frame, one leaf each, so that an optimizer does not move frames without a gradient."""


@dataclass(frozen=True)
class FrameMlps:
    """One small network per frame over a fixed random code of the frame (section 4.1; FMOV)."""

    codes: Float[Tensor, "t c"]
    """Codes of the frames, not trained."""
    values: dict[str, Tensor]
    """All weights of a frame's network in one vector, by frame."""
    width: int
    """Units of the hidden layers."""
    out: int
    """Number of outputs."""


PoseSource = Vectors | FrameMlps


def vectors(n_frames: int, out: int) -> Vectors:
    """Zeros in every frame."""
    return Vectors({str(i): torch.zeros(out) for i in range(n_frames)})


def frame_mlps(n_frames: int, out: int, rng: torch.Generator, *, width: int = 64, code: int = 256) -> FrameMlps:
    """Per-frame networks with two hidden layers over codes `[sin(2 pi i b), cos(2 pi i b)]`, sizes as in FMOV.

    The frequencies `b` are drawn once per network, as in FMOV, but from the given generator.
    """
    b = CODE_STD * torch.randn(n_frames, code // 2, generator=rng)
    phase = 2 * math.pi * torch.arange(n_frames)[:, None] * b
    codes = torch.cat([phase.sin(), phase.cos()], -1) / math.sqrt(code // 2)
    return FrameMlps(codes, {str(i): _initial_weights(code, width, out, rng) for i in range(n_frames)}, width, out)


def raw_outputs(source: PoseSource, frames: Sequence[int]) -> Float[Tensor, "f k"]:
    """Outputs of a pose source for some frames, about 0 at the start."""
    if isinstance(source, Vectors):
        return torch.stack([source.values[str(i)] for i in frames])
    weights = torch.stack([source.values[str(i)] for i in frames])
    return _apply_mlps(weights, source.codes[list(frames)], source.width, source.out)


def orbit(base: SE3, raw: Float[Tensor, "*b 6"]) -> SE3:
    """Pose after a rotation about the object's centre, a scaling of its distance, and a shift across the view.

    The first four parameters are FMOV's, which orbits the camera around the object: `[Exp | 0] @ [R | s c]` for camera
    to object. Without a shift, the projection of the object's centre does not change.

    Args:
        base: `T_cam_obj` before the motion.
        raw: `-pi raw[:3]` is the rotation vector in object axes [radians], `1 + raw[3]` the factor on the distance, and
            `raw[4:]` the shift [object radius].
    """
    rotated = base.rotation @ SO3.exp(-math.pi * raw[..., :3])
    return SE3.from_rotation(rotated, base.xyz * (1 + raw[..., 3:4]) + pad(raw[..., 4:], (0, 1)))


def _initial_weights(n_in: int, width: int, out: int, rng: torch.Generator) -> Float[Tensor, " w"]:
    """Initial weights of a network in one vector: PyTorch's defaults for the hidden layers, about 0 for the last."""
    parts = []
    for rows, columns in ((width, n_in), (width, width)):
        limit = 1 / math.sqrt(columns)
        parts += [limit * (2 * torch.rand(rows * columns + rows, generator=rng) - 1)]
    return torch.cat([*parts, HEAD_STD * torch.randn(out * width, generator=rng), torch.zeros(out)])


def _apply_mlps(weights: Float[Tensor, "f w"], x: Float[Tensor, "f i"], width: int, out: int) -> Float[Tensor, "f o"]:
    """Outputs of one network per row, each for its own input."""
    h, start = x, 0
    for layer, rows in enumerate((width, width, out)):
        columns = h.shape[-1]
        matrix = weights[:, start : start + rows * columns].reshape(-1, rows, columns)
        start += rows * columns
        h = torch.einsum("foi,fi->fo", matrix, h) + weights[:, start : start + rows]
        start += rows
        h = gelu(h) if layer < 2 else h
    return h
