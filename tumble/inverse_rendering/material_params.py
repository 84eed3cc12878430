"""The parameters of stage 3, their learning rates, and equal or simpler parameters."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.inverse_rendering import specular_fit
from tumble.scene import TEMPERATURE, Environment, Gaussians, Material

ALBEDO_RANGE = (0.003, 0.98)
"""Range of the initial albedo. The lower limit is that of saturated colours: logits would need long to reach it."""
LIKELY_METAL = 0.9
"""First metalness of what may be metal; that of the rest is 1 minus this."""
NO_LOBE = -200.0
"""Logarithmic specular scale of an object without a specular lobe: its exponential is 0, as are all gradients."""


@dataclass(frozen=True)
class Params:
    """Parameters of stage 3."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    """Sharpness of the opacity [1 / object radius]."""
    material: Material
    environment: Environment
    poses: Float[Tensor, "t 6"]
    """Tangents of the pose corrections: `T_cam_obj = exp(poses) @ base`."""
    log_specular_scale: Float[Tensor, "3"]
    """Natural logarithm of the specular lobe's scale per channel. The diffuse lobe determines only the product of
    albedo and light; the specular lobe depends on the light alone and so resolves the ambiguity. As one parameter per
    channel it converges faster than the texels of the light would."""
    roughness_shift: Float[Tensor, ""]
    """Added to all roughness logits: the roughness of the object. Every pixel contributes to its gradient, so it moves
    at once, while the logits of a corner, which few pixels show, hardly leave their start."""
    pose_network: dict[str, Tensor] = field(default_factory=dict)
    """Network that predicts the tangents of the poses (`pose_network`); empty if there is none."""


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates; material and light from appendix A. For geometry the paper refers to SVG-IR."""

    albedo: float = 0.025
    """Learning rate of the albedo logits."""
    roughness: float = 0.025
    """Learning rate of the roughness logits."""
    roughness_shift: float = 0.0
    """Learning rate of the common shift of all roughness logits; the paper has none."""
    metalness: float = 0.0
    """Learning rate of the metalness logits. If it is 0, no object has metal, as in the paper."""
    normal: float = 1e-3
    """Learning rate of the normal offsets."""
    specular_scale: float = 0.0
    """Learning rate of the logarithmic specular scale. If it is 0, F0 is 0.04, as in the paper."""
    light: float = 0.01
    """Learning rate of the logarithmic radiance of the environment map."""
    means: float = 1.6e-5
    """Learning rate of the centres after the warm-up [object radius]."""
    quats: float = 1e-4
    """Learning rate of the rotations after the warm-up."""
    log_scales: float = 5e-4
    """Learning rate of the logarithmic scales after the warm-up."""
    sdf: float = 5e-3
    """Learning rate of the signed distances after the warm-up [object radius]."""
    poses: float = 0.0
    """Learning rate of the tangents of all poses after the warm-up, or of the network that predicts them; 0 keeps the
    poses of stage 2."""
    decay: float = 0.1
    """Factor by which all learning rates decay over the run."""


@torch.no_grad()
def with_lobe(params: Params, brighter: Float[Tensor, "n 3"], log_scale: float) -> Params:
    """The parameters with brighter albedos and another scale of the specular lobe."""
    albedo = (params.material.albedo + brighter[:, None]).clamp(*ALBEDO_RANGE)
    material = params.material.with_albedo(albedo)
    return replace(params, material=material, log_specular_scale=torch.full_like(params.log_specular_scale, log_scale))


@torch.no_grad()
def with_metal(params: Params, regions: Bool[Tensor, " n"]) -> Params:
    """The parameters of an object some of whose Gaussians are rather metal; the others are rather not."""
    logit = TEMPERATURE * math.log(LIKELY_METAL / (1 - LIKELY_METAL))
    logits = logit * (2 * regions.to(params.gamma) - 1)
    return replace(params, material=replace(params.material, metal_logits=logits))


@torch.no_grad()
def with_half_the_contrast(params: Params) -> Params:
    """The parameters with half the contrast of the albedo about its geometric mean."""
    log_albedo = params.material.albedo.log()
    albedo = (0.5 * (log_albedo + log_albedo.mean((0, 1)))).exp().clamp(*ALBEDO_RANGE)
    return replace(params, material=params.material.with_albedo(albedo))


def without_corners(params: Params) -> Params:
    """The parameters with one material per Gaussian: the mean of its corners."""

    def mean(x: Tensor) -> Tensor:
        return x.mean(1, keepdim=True).expand_as(x)

    m = params.material
    means = {name: mean(getattr(m, name)) for name in ("albedo_logits", "roughness_logits", "normal_offset")}
    return replace(params, material=replace(m, **means))


def shifted_material(params: Params) -> Material:
    """The material with the common shift of its roughness, which an object without a specular lobe does not have."""
    material, has_lobe = params.material, (params.log_specular_scale.detach() > NO_LOBE).any()
    return replace(material, roughness_logits=material.roughness_logits + has_lobe * params.roughness_shift)


def absorbed(params: Params) -> Params:
    """Equivalent parameters without shift of the roughness and with a specular scale of 1.

    See `specular_fit.absorb_specular_scale`.
    """
    material, log_gain = specular_fit.absorb_specular_scale(shifted_material(params), params.log_specular_scale)
    environment = Environment(params.environment.log_radiance + log_gain)
    none = {"log_specular_scale": torch.zeros_like(log_gain), "roughness_shift": torch.zeros_like(params.gamma)}
    return replace(params, material=material, environment=environment, **none)
