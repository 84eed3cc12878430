"""Whether an object has no highlight at all, asked of its frames while stage 2 goes on.

A descent does not find out. A Lambertian object under a light that was shaped together with a highlight keeps most of
it, and bends its normals for it; stage 3 then finds that this light and that highlight belong together. So light and
albedos are trained for a moment with a highlight and without, from where they are, on geometry that stands still.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble import losses, optim
from tumble.buffers import Buffers
from tumble.coarse_light import CoarseLight
from tumble.photograph import Frame
from tumble.tree import detach

NONE = 1e-3
"""Strength of the highlight of a matte object."""
WORSE = 1.12
"""What a matte object leaves over without a highlight, at most, as a multiple of what it leaves with that of glass. At
a fifth of DRAFT's run it is 0.8 to 1.07 on diffuse objects of the benchmark, 1.22 to 1.41 on original ones; later a
geometry that has bent for its highlight defends it (1.23 at the end), earlier any is coarse (1.07 on the original
chess knight)."""
ROUNDS = 2
"""Times that every frame is seen; the last one counts."""
ALBEDO, LIGHT, DECAY = 0.05, 0.02, 0.05
"""Rates of the descent, and what becomes of them in its course."""
INNER = 0.99
"""Least coverage of pixels that are asked."""


@dataclass(frozen=True)
class Trial:
    """What the descent moves."""

    albedo_logits: Float[Tensor, "n 3"]
    light: CoarseLight


@torch.enable_grad()
def without_highlight(start: Trial, error: Callable[[Trial, int], Tensor], frames: int) -> Trial | None:
    """Light and albedos without a highlight, if the frames are explained about as well so; else None.

    Args:
        start: Not changed.
        error: What a trial leaves over of a frame, by its number.
        frames: How many there are.
    """
    ends = {strength: _descended(start, strength, error, frames) for strength in (NONE, 1.0)}
    (matte, left), (_, left_by_glass) = ends.values()
    return matte if left <= WORSE * left_by_glass else None


def left_over(view: Buffers, truth: Frame) -> Float[Tensor, ""]:
    """What a render leaves over of a photograph well inside its outline: mean absolute error, sRGB."""
    inner = (truth.mask * (view.alpha > INNER))[..., None]
    difference = (losses.developed(view.rgb, truth.image) - truth.image).abs()
    return (difference * inner).sum() / (3 * inner.sum()).clamp_min(1)


def _descended(
    start: Trial, strength: float, error: Callable[[Trial, int], Tensor], frames: int
) -> tuple[Trial, float]:
    """The trial after a descent at a strength that is kept, and what it left over meanwhile, mean over the frames."""
    logarithm = torch.full_like(start.light.log_highlight, strength).log()
    trial = optim.leaves(Trial(start.albedo_logits, replace(start.light, log_highlight=logarithm)))
    rates = {"albedo_logits": ALBEDO, "light.coefficients": LIGHT, "light.log_highlight": 0.0}
    optimizer = optim.adam(trial, rates)
    order = torch.randperm(frames, generator=torch.Generator().manual_seed(0)).tolist()
    left = 0.0
    for step, number in enumerate(ROUNDS * order):
        unexplained = error(trial, number)
        left += float(unexplained.detach()) / frames if step >= (ROUNDS - 1) * frames else 0.0
        optim.anneal(optimizer, DECAY ** (step / (ROUNDS * frames)))
        optim.descend(unexplained, optimizer, step=step)
    return detach(trial), left
