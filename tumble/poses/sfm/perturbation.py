"""Random changes of a part of the motion: in a local minimum of bundle adjustment often only few parts are wrong.

They are of the kinds that such minima have: shading that stays in place while a surface turns below it shows too small
a rotation, a mirror image has the same contours, and two parts that are right can be joined wrongly.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SO3

LONGEST_PART = 32
"""Largest number of frames of a part."""
SCALE_SIGMA = 0.5
"""Standard deviation of the logarithm of the factor on the rotations within a part."""
SMALLEST_TURN, LARGEST_TURN = math.radians(15), math.radians(75)
"""Angles between which a part is turned additionally [radians]."""


def perturbed(R: Float[Tensor, "t 3 3"], rng: torch.Generator) -> Float[Tensor, "t 3 3"]:
    """Rotations `R_cam_obj` of which one part, chosen at random, is rotated otherwise; the frames behind it follow.

    The rotations between its frames are scaled, or mirrored in depth, or a turn about a random axis is added to them,
    spread over the part.
    """
    n = len(R)
    length = int(torch.randint(1, min(LONGEST_PART, n - 1) + 1, (1,), generator=rng))
    first = int(torch.randint(0, n - length, (1,), generator=rng))
    part = slice(first, first + length)
    steps = R[1:] @ R[:-1].mT
    kind = int(torch.randint(0, 3, (1,), generator=rng))
    if kind == 0:
        factor = math.exp(SCALE_SIGMA * float(torch.randn(1, generator=rng)))
        steps[part] = SO3.exp(factor * SO3.from_matrix(steps[part]).log()).matrix()
    elif kind == 1:
        image = mirrored(R[first : first + length + 1])
        steps[part] = image[1:] @ image[:-1].mT
    else:
        axis = torch.nn.functional.normalize(torch.randn(3, generator=rng, dtype=R.dtype), dim=0)
        angle = SMALLEST_TURN + (LARGEST_TURN - SMALLEST_TURN) * float(torch.rand(1, generator=rng))
        steps[part] = SO3.exp(axis * angle / length).matrix() @ steps[part]
    return chained(R[0], steps)


def stretched(R: Float[Tensor, "t 3 3"], factor: float) -> Float[Tensor, "t 3 3"]:
    """Rotations `R_cam_obj` whose rotations between consecutive frames are larger by a factor."""
    return chained(R[0], SO3.exp(factor * SO3.from_matrix(R[1:] @ R[:-1].mT).log()).matrix())


def mirrored(R: Float[Tensor, "*b f 3 3"]) -> Float[Tensor, "*b f 3 3"]:
    """The rotations whose contours are the same up to perspective (Necker reversal): depth is reversed in the rotations
    relative to the middle frame."""
    middle = R[..., R.shape[-3] // 2, None, :, :]
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=R.dtype))
    return flip @ R @ middle.mT @ flip @ middle


def chained(first: Float[Tensor, "3 3"], steps: Float[Tensor, "s 3 3"]) -> Float[Tensor, "t 3 3"]:
    """Rotations of all frames from that of the first and the rotations between consecutive ones."""
    R = [first]
    for step in steps:
        R.append(step @ R[-1])
    return torch.stack(R)
