"""Why dark print comes out too light: how strong a highlight it takes to explain it, with truth and without.

`python -m benchmarks.dark CAPTURE... --runs FOLDER` takes DRAFT runs that `benchmarks.decomposition` left in a folder.
Of channels darker than 0.02 (linear), in the shared evaluation views, two pixels and more inside the outline:

    share        of the squared error of the albedo (sRGB, after the scale per channel) that lies in them
    found, true  middle of their albedo, linear, after that scale
    strength     of the highlight that explains them, their albedo being true, seen from less than 60 degrees off the
                 normal and from more: with true light, normals and roughness, and with those of the run, whose albedo
                 is brought to the level of its light. 1 is glass: if all were right, it would be 1.

Nothing shadows anything here: meant for convex objects.
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
from tumble.rendering import antialiased, prefilter, shade_split, surface, unoccluded
from tumble.scene import DIELECTRIC, Asset, env_from_obj

DARK, GRAZING = 0.02, 0.5
DIRECTIONS = 1024


@torch.no_grad()
def dark_print(path: Path, run: Path) -> dict[str, Any]:
    """The row of one capture and its run."""
    capture, asset = folder.load(path), tree.load(Asset, run / "3-decompose" / "out.safetensors")
    truth: Any = folder.load_truth(path)
    for part in (truth.trajectory, truth.albedo, truth.light, truth.normals, truth.roughness):
        assert part is not None, "a capture with all truth"
    numbers = truth.views("shared")
    lights = [prefilter(truth.light.resampled(64, 128)), prefilter(asset.environment)]
    parts = []
    for i in numbers:
        T_cam_obj = truth.trajectory.T_cam_obj[i]
        mine = antialiased(asset, T_cam_obj, capture.camera)
        maps = {**mine.features, "roughness": truth.roughness[i][..., None]}
        exact = replace(mine, normal=truth.normals[i], features=maps)
        inner = -max_pool2d(-truth.foreground[i][None].float(), 5, 1, 2)[0] > 0.5
        pixels = torch.where((inner & (mine.alpha > 0.5)).flatten())[0]
        R_env_obj = env_from_obj(T_cam_obj, truth.trajectory.light)
        sky = unoccluded(fibonacci_sphere(DIRECTIONS), len(pixels))
        lobes: list[Tensor] = []
        for view, light in zip((exact, mine), lights, strict=True):
            points = surface(view, T_cam_obj, capture.camera, pixels=pixels)
            rough, white = points.sample(view.features["roughness"]), torch.ones_like(points.normals)
            for albedo, f0 in ((white, 0.0), (0 * white, DIELECTRIC)):
                lobes.append(shade_split(points, albedo, rough, light, R_env_obj, sky, f0=f0))
        points = surface(exact, T_cam_obj, capture.camera, pixels=pixels)
        cosine = (points.normals * points.views).sum(-1, keepdim=True).expand(-1, 3)
        photograph = linear_from_srgb(points.sample(truth.images[i].float() / 255))
        albedos = points.sample(truth.albedo[i]), points.sample(mine.features["albedo"])
        parts.append(torch.stack([*lobes, photograph, *albedos, cosine]))
    return _row(*torch.cat(parts, 1))


def _row(
    E: Tensor, S: Tensor, my_E: Tensor, my_S: Tensor, seen: Tensor, true: Tensor, found: Tensor, cosine: Tensor
) -> dict[str, Any]:
    """From diffuse and specular radiance of white and black (true; of the run), photograph, albedos and cosines."""
    everywhere = torch.ones(1, 1, len(found), dtype=torch.bool)
    scale = metrics.albedo_scale(found[None, None], true[None, None], everywhere)
    found = found * scale
    error = (srgb_from_linear(found.clamp(0, 1)) - srgb_from_linear(true)).square()
    dark, grazing = true < DARK, cosine < GRAZING
    level = (my_E / E).median(0).values

    def strength(diffuse: Tensor, specular: Tensor, where: Tensor) -> float:
        return round(float((seen - diffuse)[where].sum() / specular[where].sum()), 2)

    def strengths(diffuse: Tensor, specular: Tensor) -> list[float]:
        return [strength(diffuse, specular, dark & ~grazing), strength(diffuse, specular, dark & grazing)]

    return {
        "share": round(float(error[dark].sum() / error.sum()), 2),
        "found": round(float(found[dark].median()), 4),
        "true": round(float(true[dark].median()), 4),
        "strength with truth": strengths(true * E, S),
        "strength in the run": strengths(true / level * my_E, my_S),
    }


if __name__ == "__main__":
    of_runs.main(__file__, __doc__ or "", dark_print)
