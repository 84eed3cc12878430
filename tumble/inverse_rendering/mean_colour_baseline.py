"""Baseline of stage 3 without inverse rendering: a point's albedo is its mean colour over all frames that show it.

Under a light from everywhere this is right up to one factor; under any other one, shading and tint of the light stay in
the albedo, the less the more ways the object was turned. The light of the asset is uniform white.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tumble.engine import State
from tumble.inverse_rendering.decompose import Inputs
from tumble.maths import linear_from_srgb
from tumble.rendering import rasterize
from tumble.scene import TEMPERATURE, Asset, Environment, Material, target_view

VERSION = 1


@dataclass(frozen=True)
class Config:
    """Nothing is learnt."""

    roughness: float = 0.5
    """Of the whole object."""


@dataclass(frozen=True)
class Sums:
    """Over the frames so far, for each corner of each Gaussian."""

    colour: Tensor
    """Linear radiance times compositing weight, `[n 4 3]`."""
    weight: Tensor
    """Compositing weight, `[n 4 3]`."""


def length(cfg: Config, inputs: Inputs) -> int:
    return len(inputs.capture)


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    n = len(inputs.refined.albedo)
    zero = inputs.refined.albedo.new_zeros(n, 4, 3)
    return State(0, Sums(zero, zero.clone()), None, rng)


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """Add one frame: the adjoint of compositing hands a photograph back to the corners it is made of."""
    refined, camera = inputs.refined, inputs.capture.camera
    T_cam_obj = refined.trajectory.T_cam_obj[state.step]
    share = torch.zeros_like(state.params.weight).requires_grad_()
    image = rasterize(refined.gaussians, refined.gamma, T_cam_obj, camera, {"share": share}).features["share"]
    truth = target_view(inputs.capture, state.step, image)
    certain = (truth.mask[..., None] * truth.valid).expand_as(image)
    for sums, seed in ((state.params.colour, linear_from_srgb(truth.image) * certain), (state.params.weight, certain)):
        (found,) = torch.autograd.grad(image, share, seed, retain_graph=True)
        sums += found
    return {}


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Asset:
    """Corners that no frame shows are middle grey."""
    refined, sums = inputs.refined, state.params
    mean = torch.where(sums.weight > 1e-4, sums.colour / sums.weight.clamp_min(1e-4), 0.5)
    material = Material.constant(len(mean), mean.new_full((3,), 0.5), cfg.roughness)
    logits = TEMPERATURE * torch.logit(mean.clamp(0.003, 0.98))
    return Asset(
        gaussians=refined.gaussians,
        gamma=refined.gamma,
        material=Material(logits, material.roughness_logits, material.normal_offset, material.f0_logit),
        environment=Environment.from_radiance(mean.new_ones(16, 32, 3)),
        trajectory=refined.trajectory,
        camera=inputs.capture.camera,
    )
