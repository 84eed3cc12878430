"""Albedo error of dark surfaces, and the specular scale that explains the radiance observed there.

`python -m benchmarks.dark CAPTURE... --runs FOLDER` evaluates DRAFT runs of `benchmarks.decomposition`.
The figures are about colour channels with a true albedo below `DARK`, at pixels of the shared evaluation views at least
two pixels inside the silhouette contour:

    share        fraction of the squared albedo error (sRGB, after the scale per channel) in these channels
    found, true  median of their estimated albedo (after that scale) and of their true albedo, linear
    strength     specular scale for which the shading of the true albedo equals the observed radiance: with true light,
                 normals and roughness, and with those of the run, where albedo is divided by the level of the run's
                 light. First value: view directions less than 60 degrees from the normal; second value: the others.
                 The scale of a dielectric with F0 = 0.04, the true one, is 1.

Self-shadowing and interreflection are ignored, so that only convex objects give meaningful figures.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from benchmarks import of_runs
from tumble.datasets import folder
from tumble.evaluation import metrics
from tumble.io import tree
from tumble.maths import fibonacci_sphere, linear_from_srgb, srgb_from_linear
from tumble.rendering import antialiased_gbuffer, prefilter, shade_split, surface, unoccluded
from tumble.scene import DIELECTRIC, Asset, env_from_obj

DARK = 0.02
"""Linear albedo below which a colour channel counts as dark."""
GRAZING = 0.5
"""Cosine between normal and view direction below which a view is grazing."""
DIRECTIONS = 1024
"""Directions of the visibility table, all unoccluded."""


@torch.no_grad()
def dark_surfaces(path: Path, run: Path) -> dict[str, Any]:
    """The row of one capture and its run."""
    capture, asset = folder.load(path), tree.load(Asset, run / "3-decompose" / "out.safetensors")
    truth: Any = folder.load_truth(path)
    for part in (truth.trajectory, truth.albedo, truth.light, truth.normals, truth.roughness):
        assert part is not None, "the capture needs poses, albedo, light, normals and roughness as ground truth"
    numbers = truth.views("shared")
    lights = [prefilter(truth.light.resampled(64, 128)), prefilter(asset.environment)]
    parts = []
    for i in numbers:
        T_cam_obj = truth.trajectory.T_cam_obj[i]
        estimate = antialiased_gbuffer(asset, T_cam_obj, capture.camera)
        maps = {**estimate.features, "roughness": truth.roughness[i][..., None]}
        exact = replace(estimate, normal=truth.normals[i], features=maps)
        inner = -max_pool2d(-truth.foreground[i][None].float(), 5, 1, 2)[0] > 0.5
        pixels = torch.where((inner & (estimate.alpha > 0.5)).flatten())[0]
        R_env_obj = env_from_obj(T_cam_obj, truth.trajectory.light)
        visibility = unoccluded(fibonacci_sphere(DIRECTIONS), len(pixels))
        lobes: list[Tensor] = []
        for view, light in zip((exact, estimate), lights, strict=True):
            points = surface(view, T_cam_obj, capture.camera, pixels=pixels)
            rough, white = points.sample(view.features["roughness"]), torch.ones_like(points.normals)
            for albedo, f0 in ((white, 0.0), (0 * white, DIELECTRIC)):
                lobes.append(shade_split(points, albedo, rough, light, R_env_obj, visibility, f0=f0))
        points = surface(exact, T_cam_obj, capture.camera, pixels=pixels)
        cosine = (points.normals * points.views).sum(-1, keepdim=True).expand(-1, 3)
        image = linear_from_srgb(points.sample(truth.images[i].float() / 255))
        albedos = points.sample(truth.albedo[i]), points.sample(estimate.features["albedo"])
        parts.append(torch.stack([*lobes, image, *albedos, cosine]))
    return _row(*torch.cat(parts, 1))


def _row(
    diffuse: Tensor,
    specular: Tensor,
    run_diffuse: Tensor,
    run_specular: Tensor,
    image: Tensor,
    true: Tensor,
    estimate: Tensor,
    cosine: Tensor,
) -> dict[str, Any]:
    """Figures of all pixels [n 3] together.

    Args:
        diffuse: Radiance of white Lambertian surfaces under the true light with true normals.
        specular: Radiance of black dielectric surfaces under the true light with true normals and roughness.
        run_diffuse: The same as `diffuse` with light and normals of the run.
        run_specular: The same as `specular` with light, normals and roughness of the run.
        image: Observed linear radiance.
        true: True albedo.
        estimate: Albedo of the run.
        cosine: Cosine between normal and view direction.
    """
    everywhere = torch.ones(1, 1, len(estimate), dtype=torch.bool)
    scale = metrics.albedo_scale(estimate[None, None], true[None, None], everywhere)
    estimate = estimate * scale
    error = (srgb_from_linear(estimate.clamp(0, 1)) - srgb_from_linear(true)).square()
    dark, grazing = true < DARK, cosine < GRAZING
    level = (run_diffuse / diffuse).median(0).values

    def specular_scale(lambertian: Tensor, dielectric: Tensor, where: Tensor) -> float:
        return round(float((image - lambertian)[where].sum() / dielectric[where].sum()), 2)

    def specular_scales(lambertian: Tensor, dielectric: Tensor) -> list[float]:
        return [
            specular_scale(lambertian, dielectric, dark & ~grazing),
            specular_scale(lambertian, dielectric, dark & grazing),
        ]

    return {
        "share": round(float(error[dark].sum() / error.sum()), 2),
        "found": round(float(estimate[dark].median()), 4),
        "true": round(float(true[dark].median()), 4),
        "strength with truth": specular_scales(true * diffuse, specular),
        "strength in the run": specular_scales(true / level * run_diffuse, run_specular),
    }


if __name__ == "__main__":
    of_runs.main(__file__, __doc__ or "", dark_surfaces)
