"""Baseline of stage 3 without inverse rendering: mean colour over all frames as albedo, under uniform white light.
white.

Under uniform light this is correct up to one factor. Under any other light, shading and the colour of the light remain
in the albedo; the more orientations the object is seen in, the less shading remains.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tumble.engine import State
from tumble.inverse_rendering.decompose import Inputs
from tumble.maths import linear_from_srgb
from tumble.rendering import rasterize
from tumble.scene import Asset, Environment, Material, target_view

VERSION = 1


@dataclass(frozen=True)
class Config:
    """Settings of the baseline."""

    roughness: float = 0.5
    """Roughness of the whole object."""


@dataclass(frozen=True)
class Sums:
    """Sums over the frames so far, for each corner of each Gaussian."""

    colour: Tensor
    """Sum of linear radiance times compositing weight, `[n 4 3]`."""
    weight: Tensor
    """Sum of compositing weights, `[n 4 3]`."""


def length(cfg: Config, inputs: Inputs) -> int:
    """Number of steps: one per frame."""
    return len(inputs.capture)


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """The initial state: sums of zero."""
    n = len(inputs.refined.albedo)
    zero = inputs.refined.albedo.new_zeros(n, 4, 3)
    return State(0, Sums(zero, zero.clone()), None, rng)


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """Add one frame: the adjoint of compositing distributes the input image over the corners of the Gaussians."""
    refined, camera = inputs.refined, inputs.capture.camera
    T_cam_obj = refined.trajectory.T_cam_obj[state.step]
    values = torch.zeros_like(state.params.weight).requires_grad_()
    image = rasterize(refined.gaussians, refined.gamma, T_cam_obj, camera, {"values": values}).features["values"]
    truth = target_view(inputs.capture, state.step, image)
    object_mask = (truth.mask[..., None] * truth.valid).expand_as(image)
    colour = linear_from_srgb(truth.image) * object_mask
    for total, v_image in ((state.params.colour, colour), (state.params.weight, object_mask)):
        (v_values,) = torch.autograd.grad(image, values, v_image, retain_graph=True)
        total += v_values
    return {}


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Asset:
    """The asset with the mean colours as albedo; corners that no frame shows are middle grey."""
    refined, sums = inputs.refined, state.params
    mean = torch.where(sums.weight > 1e-4, sums.colour / sums.weight.clamp_min(1e-4), 0.5)
    material = Material.constant(len(mean), mean.new_full((3,), 0.5), cfg.roughness)
    return Asset(
        gaussians=refined.gaussians,
        gamma=refined.gamma,
        material=material.with_albedo(mean.clamp(0.003, 0.98)),
        environment=Environment.from_radiance(mean.new_ones(16, 32, 3)),
        trajectory=refined.trajectory,
        camera=inputs.capture.camera,
    )
