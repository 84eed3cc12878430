"""Effect of stage 3: a stage in its place that keeps albedo and light of stage 2 is compared with it.

A stage is a module with VERSION, Config, length, init, step and finish. This file is such a module; a recipe selects it
by its Config.

$ python -m examples.swap_a_stage OUT                   (minutes on two CPU cores)
$ tumble bench run smoke --method examples/swap_a_stage.py
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import tumble
from tumble.engine import State
from tumble.inverse_rendering import decompose, sh_lighting
from tumble.scene import TEMPERATURE, Material

VERSION = 1


@dataclass(frozen=True)
class Config:
    roughness: float = 0.4
    """Roughness of the whole object."""
    rows: int = 16
    """Rows of the environment map."""


def length(cfg: Config, inputs: decompose.Inputs) -> int:
    return 0


def init(cfg: Config, inputs: decompose.Inputs, rng: torch.Generator) -> State:
    return State(0, {}, None, rng)


def step(cfg: Config, inputs: decompose.Inputs, state: State) -> dict[str, Tensor | float]:
    return {}


def finish(cfg: Config, inputs: decompose.Inputs, state: State) -> tumble.Asset:
    refined = inputs.refined
    material = Material.constant(len(refined.albedo), torch.full((3,), 0.5), cfg.roughness)
    logits = TEMPERATURE * torch.logit(refined.albedo.clamp(0.003, 0.98))
    return tumble.Asset(
        gaussians=refined.gaussians,
        gamma=refined.gamma,
        material=replace(material, albedo_logits=logits[:, None].repeat(1, 4, 1)),
        environment=sh_lighting.environment(refined.light, cfg.rows),
        trajectory=refined.trajectory,
        camera=inputs.capture.camera,
    )


def method(recipe: tumble.Recipe) -> tumble.Recipe:
    """The recipe with this stage in it, for benchmark suites."""
    return replace(recipe, decompose=Config())


def main(out: Path, recipe: tumble.Recipe = tumble.DRAFT) -> dict[str, float]:
    clip = tumble.demo_clip(out / "clip")
    capture = tumble.read_capture(clip)
    poses = tumble.estimate_poses(capture, recipe)
    # Imported by its full name: run as a script, this module is called __main__, which a stored run could not import.
    this: Any = __import__("examples.swap_a_stage", fromlist=["Config"])
    stages = {"ours": recipe.decompose, "stage 2 alone": this.Config()}
    psnr = {}
    for name, stage in stages.items():
        asset = tumble.reconstruct(capture, recipe=replace(recipe, decompose=stage), poses=poses)
        scores = tumble.evaluate(asset, clip, poses_given=False, cfg=recipe.relight)
        psnr[name] = scores["regions"]["shared"]["albedo.psnr_fg_srgb"]
        print(f"{name:14} albedo {psnr[name]:.1f} dB on the object")
    return psnr


if __name__ == "__main__":
    main(Path(sys.argv[1]))
