"""Error of the albedo if other unknowns are replaced by their true values, for captures with known poses.

`python -m benchmarks.swap CAPTURE...` reconstructs each capture with DRAFT, and prints a row per replacement. Replaced
quantities stay fixed:

    nothing      the method without replacement
    roughness    the true mean roughness
    light        the true environment map at 32 rows
    both         roughness and light
    geometry     Gaussians on the true surface with its normals (their size and opacity are still optimised)
    all          roughness, light and geometry: only the albedo is unknown

A row has the foreground PSNR of the sRGB albedo over the shared evaluation views after the scale per channel, this
scale (1 if the product of albedo and light is split as in the ground truth), and the mean error of the normals [deg].
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.kernels import machine
from tumble.datasets import folder
from tumble.engine import State, loop
from tumble.evaluation import metrics
from tumble.inverse_rendering import decompose, refine
from tumble.io import files
from tumble.maths import srgb_from_linear
from tumble.recipes import DRAFT, known_poses
from tumble.rendering import Buffers, antialiased_gbuffer
from tumble.scene import TEMPERATURE, Asset, Capture, Environment, visual_hull

GIVEN = ("nothing", "roughness", "light", "both", "geometry", "all")
"""Replacements by true values, one per row."""
ROWS = 32
"""Rows of the environment map, as at the end of DRAFT."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--given", choices=GIVEN, nargs="+", default=GIVEN)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows = []
    for path in arguments.captures:
        capture, truth = folder.load(path), folder.load_truth(path)
        refined = loop.drive(refine, known_poses(DRAFT).refine, refine.Inputs(capture, _poses(capture)), seed=0)
        true_surface = refine_on_true_surface(path, capture) if {"geometry", "all"} & set(arguments.given) else refined
        for given in arguments.given:
            surface = true_surface if given in ("geometry", "all") else refined
            scores = score(decompose_given(capture, truth, surface, given), truth, capture)
            rows.append({"capture": path.name, "given": given, **scores})
            print(rows[-1], flush=True)
            command = "python -m benchmarks.swap CAPTURE..."
            files.write_json(arguments.out, {"command": command, "machine": machine(), "rows": rows})


def _poses(capture: Capture) -> Any:
    assert capture.trajectory is not None, "the capture needs known poses"
    return capture.trajectory


def decompose_given(capture: Capture, truth: Any, refined: refine.Refined, given: str) -> Asset:
    """Result of stage 3 with roughness and light fixed at their true values if `given` names them."""
    cfg = DRAFT.decompose
    assert isinstance(cfg, decompose.Config), "DRAFT is the method, not a baseline"
    rates = cfg.rates
    if given in ("roughness", "both", "all"):
        rough = float(truth.roughness[truth.foreground].mean())
        cfg, rates = replace(cfg, roughness=rough), replace(rates, roughness=0.0, roughness_shift=0.0)
    if given in ("light", "both", "all"):
        cfg, rates = replace(cfg, rows=ROWS, doublings=0), replace(rates, light=0.0)
    if given in ("geometry", "all"):
        cfg = replace(cfg, warmup=cfg.steps)
    light: Environment = truth.light.resampled(ROWS, 2 * ROWS)

    def init(cfg: decompose.Config, inputs: decompose.Inputs, rng: torch.Generator) -> State:
        lit = given in ("light", "both", "all")
        state = decompose.init(replace(cfg, try_matte=not lit), inputs, rng)
        if lit:
            with torch.no_grad():
                environment, albedo_logits = state.params.environment, state.params.material.albedo_logits
                # The product of albedo and light stays the same in each channel.
                albedo = state.params.material.albedo * environment.integral() / light.integral()
                albedo_logits.copy_(TEMPERATURE * torch.logit(albedo.clamp(*decompose.ALBEDO_RANGE)))
                environment.log_radiance.copy_(light.log_radiance)
            state = decompose.choose_start(cfg, inputs, state)
        return state

    stage: Any = SimpleNamespace(**vars(decompose) | {"init": init})
    return loop.drive(stage, replace(cfg, rates=rates), decompose.Inputs(capture, refined), seed=0)


def refine_on_true_surface(path: Path, capture: Capture) -> refine.Refined:
    """Result of stage 2 with the centres and normals of the Gaussians fixed on the true mesh."""
    import trimesh

    mesh: Any = trimesh.load(path / "truth" / "mesh.glb", force="mesh")

    def sample_mesh(inside: Tensor, n: int, rng: torch.Generator) -> visual_hull.OrientedPoints:
        samples: Any = trimesh.sample.sample_surface(mesh, n, seed=0)
        positions, faces = samples[:2]
        barycentric = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], positions)
        normals = (mesh.vertex_normals[mesh.faces[faces]] * barycentric[..., None]).sum(1)
        points = torch.tensor(positions, dtype=torch.float32)
        return visual_hull.OrientedPoints(
            points, normalize(torch.tensor(normals).float(), dim=-1), visual_hull.neighbour_spacing(points)
        )

    cfg = known_poses(DRAFT).refine
    rates = replace(cfg.rates, means=0.0, quats=0.0, sdf=0.0)
    densify = cfg.densification
    cfg = replace(
        cfg, points=densify.max_gaussians, densification=replace(densify, refine_every=cfg.steps), rates=rates
    )
    with patch.object(visual_hull, "sample_surface", sample_mesh):
        return loop.drive(refine, cfg, refine.Inputs(capture, _poses(capture)), seed=0)


@torch.no_grad()
def score(asset: Asset, truth: Any, capture: Capture) -> dict[str, Any]:
    """Scores of the shared evaluation views."""
    numbers = truth.views("shared")
    views = [antialiased_gbuffer(asset, truth.trajectory.T_cam_obj[i], capture.camera) for i in numbers]
    normals = torch.stack([normalize(view.normal, dim=-1) for view in views])
    psnr, scale = albedo_psnr(views, truth)
    angles = metrics.normal_angles(normals, truth.normals[numbers])[truth.foreground[numbers]]
    return {
        "albedo_fg": round(psnr, 2),
        "scale": [round(float(x), 2) for x in scale],
        "normal_degrees": round(float(angles.mean()), 2),
    }


def albedo_psnr(views: Sequence[Buffers], truth: Any) -> tuple[float, Tensor]:
    """Foreground PSNR [dB] of the sRGB albedo over the shared evaluation views, and the scale per channel before it."""
    numbers, alpha_min = truth.views("shared"), DRAFT.relight.alpha_min
    estimate = torch.stack([view.features["albedo"] * (view.alpha >= alpha_min)[..., None] for view in views])
    foreground, albedo = truth.foreground[numbers], truth.albedo[numbers]
    scale = metrics.albedo_scale(estimate, albedo, foreground)
    images = zip(srgb_from_linear((estimate * scale).clamp(0, 1)), srgb_from_linear(albedo), foreground, strict=True)
    psnr = [metrics.psnr(a, b, mask) for a, b, mask in images]
    return sum(psnr) / len(psnr), scale


if __name__ == "__main__":
    main()
