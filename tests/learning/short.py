"""Short runs on the scene of `scene`, and their errors against Mitsuba's ground truth."""

import math
from dataclasses import dataclass, replace
from functools import cache

import torch

from tests.learning.scene import CAPTURE, PARTS
from tumble import recipes
from tumble.datasets import folder
from tumble.engine.loop import drive
from tumble.evaluation import metrics
from tumble.inverse_rendering import decompose, densify, mean_colour_baseline, refine
from tumble.maths import SO3, srgb_from_linear, texel_directions, texel_solid_angles
from tumble.recipes import Recipe
from tumble.rendering import antialiased_gbuffer
from tumble.scene import Asset, Capture, Environment, Truth

IDENTITY = metrics.Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
SPLIT = 0.5
"""Roughness between that of the glossy and that of the matte parts."""
SECOND, THIRD = recipes.DRAFT.refine, recipes.DRAFT.decompose
SHORT = replace(
    recipes.DRAFT,
    refine=replace(
        SECOND,
        steps=1_000,
        points=2_000,
        hull=64,
        densification=densify.Config(refine_every=100, max_gaussians=3_000),
    ),
    decompose=replace(
        THIRD,
        steps=600,
        warmup=60,
        directions=128,
        pixels=512,
        roughness=recipes.PAPER.decompose.roughness,
        weights=replace(THIRD.weights, material=0.1),
        rates=replace(THIRD.rates, roughness=0.3, light=0.1),
    ),
)
"""DRAFT for 64 x 64 pixels, in seconds. So few steps need larger rates of roughness and light, and the larger rate of
the roughness a larger weight of smoothness. Roughness starts between the two true values."""


@dataclass(frozen=True)
class Errors:
    """Errors over the evaluation views."""

    albedo: float
    """PSNR of the scaled albedo over the foreground, sRGB, mean over the views [dB]."""
    normal: float
    """Angle to the true normal, mean over the foreground [degrees]."""
    roughness: float
    """Root mean square error over the foreground."""
    contrast: float
    """Mean estimated roughness of the matte parts minus that of the glossy part."""
    light: float
    """Root mean square error of the light as in `metrics.light_scores`, clipped at 10."""
    lamp: float
    """Angle between the mean directions of the estimated and the true light, weighted by radiance [degrees]."""

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:.3g}" for name, value in vars(self).items())


@cache
def scene() -> tuple[Capture, Truth]:
    """The committed capture with its ground truth."""
    truth = folder.load_truth(CAPTURE)
    assert truth is not None
    assert sorted(part.roughness > SPLIT for part in PARTS.values()) == [False, True, True]
    return folder.load(CAPTURE), truth


def run(recipe: Recipe, seed: int, capture: Capture | None = None) -> tuple[Asset, refine.Refined]:
    """Stages 2 and 3 with given poses, on the committed capture or another one."""
    capture, known = capture or scene()[0], recipes.known_poses(recipe)
    assert capture.trajectory is not None
    refined = drive(refine, known.refine, refine.Inputs(capture, capture.trajectory), seed=seed)
    return drive(decompose, known.decompose, decompose.Inputs(capture, refined), seed=seed), refined


def averaged(refined: refine.Refined) -> Asset:
    """The mean colour of the photographs on the same geometry."""
    return drive(mean_colour_baseline, mean_colour_baseline.Config(), decompose.Inputs(scene()[0], refined), seed=0)


@torch.no_grad()
def errors(asset: Asset, capture: Capture, truth: Truth, alignment: metrics.Similarity = IDENTITY) -> Errors:
    """Errors of an asset; `alignment` leads from its object frame to the true one."""
    assert truth.trajectory is not None
    assert truth.albedo is not None
    assert truth.normals is not None
    assert truth.roughness is not None
    assert truth.light is not None
    poses = alignment.to_prediction(truth.trajectory).T_cam_obj
    views = [antialiased_gbuffer(asset, poses[i], capture.camera) for i in range(len(truth))]
    albedo = torch.stack([view.features["albedo"] for view in views])
    normals = alignment.R_true_pred @ torch.stack([view.normal for view in views])
    roughness = torch.stack([view.features["roughness"][..., 0] for view in views])
    scale = metrics.albedo_scale(albedo, truth.albedo, truth.foreground)
    found, true = (srgb_from_linear(x.clamp(0, 1)) for x in (albedo * scale, truth.albedo))
    matte = truth.roughness > SPLIT
    per_view = [
        (
            metrics.psnr(found[i], true[i], inside),
            float(metrics.normal_angles(normals[i], truth.normals[i])[inside].mean()),
            metrics.rmse(roughness[i], truth.roughness[i], inside),
        )
        for i, inside in enumerate(truth.foreground)
    ]
    return Errors(
        *torch.tensor(per_view).mean(0).tolist(),
        float(roughness[truth.foreground & matte].mean() - roughness[truth.foreground & ~matte].mean()),
        metrics.light_scores(asset.environment, truth.light, scale)["rmse_clip10"] or 0.0,
        math.degrees(float((mean_direction(asset.environment) @ mean_direction(truth.light)).clamp(-1, 1).acos())),
    )


def mean_direction(light: Environment) -> torch.Tensor:
    """Unit mean direction of a light, weighted by radiance."""
    size = light.log_radiance.shape[:2]
    weight = (light.radiance.sum(-1) * texel_solid_angles(*size))[..., None]
    return torch.nn.functional.normalize((texel_directions(*size) * weight).sum((0, 1)), dim=0)
