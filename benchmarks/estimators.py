"""Error of the shading estimators used in training, on an unoccluded sphere: a sum over directions, and the split sum.

`python -m benchmarks.estimators LIGHT.hdr ...` prints a table and writes `benchmarks/estimators.json`. Errors are root
mean squares over points of the sphere, relative to the root mean square of a sum over very many directions:

    sum          `shade` with 256 randomly rotated directions: noise without bias
    split        `shade_split` with the same directions
    split mean   the mean of `split` over all rotations: its bias
    specular     the specular lobe of `split`, relative to the true specular lobe
"""

import argparse
import json
from pathlib import Path

import torch
from torch import Tensor

from tumble.maths import fibonacci_sphere, random_rotation
from tumble.rendering import Surface, prefilter, shade, shade_split, unoccluded
from tumble.scene import Environment

ROUGHNESS = (0.1, 0.2, 0.3, 0.5, 0.8)
"""Roughness of each row of the table."""
DIRECTIONS = 256
"""Directions of an estimate."""
ROTATIONS = 32
"""Random rotations of the directions over which errors are averaged."""
POINTS = 800
"""Approximate number of visible points of the sphere."""
ALBEDO = 0.5
"""Albedo of the sphere."""
F0 = 0.04
"""Reflectance of the sphere at normal incidence."""
ROWS = 32
"""Rows of the environment map, as in training."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lights", type=Path, nargs="+", help="lat-long environment maps")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows = []
    for path in arguments.lights:
        environment = Environment.read(path).resampled(ROWS, 2 * ROWS)
        for roughness in ROUGHNESS:
            rows.append({"light": path.stem, "roughness": roughness, **errors(environment, roughness)})
            print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    names = " ".join(path.name for path in arguments.lights)
    setting = {
        "directions": DIRECTIONS,
        "turns": ROTATIONS,
        "points": POINTS,
        "light_rows": ROWS,
        "f0": F0,
        "albedo": ALBEDO,
    }
    document = {"command": f"python -m benchmarks.estimators {names}", "setting": setting, "rows": rows}
    arguments.out.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


@torch.no_grad()
def errors(environment: Environment, roughness: float) -> dict[str, float]:
    """The errors of one row of the table."""
    points, R, prefiltered = sphere(), torch.eye(3), prefilter(environment)
    albedo, rough = torch.full((len(points.pixels), 3), ALBEDO), torch.full((len(points.pixels), 1), roughness)

    def dense_sum(albedo_factor: float) -> Tensor:
        total, n = torch.zeros_like(albedo), 1 << (20 if roughness < 0.25 else 17)
        for part in fibonacci_sphere(n).split(1 << 15):
            visibility = unoccluded(part, len(albedo))
            total += len(part) / n * shade(points, albedo_factor * albedo, rough, environment, R, visibility, f0=F0)
        return total

    truth, specular = dense_sum(1.0), dense_sum(0.0)
    generator, estimates = torch.Generator().manual_seed(0), {"sum": [], "split": [], "specular": []}
    for _ in range(ROTATIONS):
        visibility = unoccluded(fibonacci_sphere(DIRECTIONS) @ random_rotation(generator).mT, len(albedo))
        estimates["sum"].append(shade(points, albedo, rough, environment, R, visibility, f0=F0))
        estimates["split"].append(shade_split(points, albedo, rough, prefiltered, R, visibility, f0=F0))
        estimates["specular"].append(shade_split(points, 0 * albedo, rough, prefiltered, R, visibility, f0=F0))
    errors = {name: sum(rms(x - truth) for x in estimates[name]) / ROTATIONS / rms(truth) for name in ("sum", "split")}
    errors["split mean"] = rms(torch.stack(estimates["split"]).mean(0) - truth) / rms(truth)
    errors["specular"] = rms(estimates["specular"][0] - specular) / rms(specular)
    return {name: round(value, 4) for name, value in errors.items()}


def sphere() -> Surface:
    """Points of the unit sphere that are visible from a camera at a distance of 3.4 radii."""
    normals = fibonacci_sphere(2 * POINTS)
    eye = torch.nn.functional.normalize(torch.tensor([0.5, 0.3, 0.8]), dim=-1) * 3.4
    normals = normals[((eye - normals) * normals).sum(-1) > 0.02]
    views = torch.nn.functional.normalize(eye - normals, dim=-1)
    return Surface(torch.arange(len(normals)), normals, normals, views)


def rms(x: Tensor) -> float:
    """Root mean square."""
    return x.square().mean().sqrt().item()


if __name__ == "__main__":
    main()
