"""How well the training estimators shade a sphere: directions summed, or the split sum for the specular lobe.

`python -m benchmarks.estimators LIGHT.hdr ...` prints a table and writes `benchmarks/estimators.json`. An error is the
root mean square over the points of a sphere, nothing in the way, relative to that of the brute-force sum.

    sum          `shade` with 256 directions, turned at random: unbiased noise
    split        `shade_split` with the same directions
    split mean   the same, averaged over all turns: what no averaging removes
    specular     the specular lobe of `split`, relative to the specular lobe
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
DIRECTIONS, TURNS, POINTS = 256, 32, 800
ALBEDO, F0 = 0.5, 0.04
ROWS = 32
"""Rows of the light while training."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lights", type=Path, nargs="+", help="lat-long pictures")
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
        "turns": TURNS,
        "points": POINTS,
        "light_rows": ROWS,
        "f0": F0,
        "albedo": ALBEDO,
    }
    document = {"command": f"python -m benchmarks.estimators {names}", "setting": setting, "rows": rows}
    arguments.out.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


@torch.no_grad()
def errors(environment: Environment, roughness: float) -> dict[str, float]:
    """One row of the table."""
    seen, R, prefiltered = sphere(), torch.eye(3), prefilter(environment)
    albedo, rough = torch.full((len(seen.pixels), 3), ALBEDO), torch.full((len(seen.pixels), 1), roughness)

    def dense(black: float) -> Tensor:
        total, n = torch.zeros_like(albedo), 1 << (20 if roughness < 0.25 else 17)
        for part in fibonacci_sphere(n).split(1 << 15):
            sky = unoccluded(part, len(albedo))
            total += len(part) / n * shade(seen, black * albedo, rough, environment, R, sky, f0=F0)
        return total

    truth, specular = dense(1.0), dense(0.0)
    generator, found = torch.Generator().manual_seed(0), {"sum": [], "split": [], "shine": []}
    for _ in range(TURNS):
        sky = unoccluded(fibonacci_sphere(DIRECTIONS) @ random_rotation(generator).mT, len(albedo))
        found["sum"].append(shade(seen, albedo, rough, environment, R, sky, f0=F0))
        found["split"].append(shade_split(seen, albedo, rough, prefiltered, R, sky, f0=F0))
        found["shine"].append(shade_split(seen, 0 * albedo, rough, prefiltered, R, sky, f0=F0))
    errors = {name: sum(rms(x - truth) for x in found[name]) / TURNS / rms(truth) for name in ("sum", "split")}
    errors["split mean"] = rms(torch.stack(found["split"]).mean(0) - truth) / rms(truth)
    errors["specular"] = rms(found["shine"][0] - specular) / rms(specular)
    return {name: round(value, 4) for name, value in errors.items()}


def sphere() -> Surface:
    """Points of the unit sphere that a camera 3.4 radii away sees."""
    normals = fibonacci_sphere(2 * POINTS)
    eye = torch.nn.functional.normalize(torch.tensor([0.5, 0.3, 0.8]), dim=-1) * 3.4
    normals = normals[((eye - normals) * normals).sum(-1) > 0.02]
    views = torch.nn.functional.normalize(eye - normals, dim=-1)
    return Surface(torch.arange(len(normals)), normals, normals, views)


def rms(x: Tensor) -> float:
    return x.square().mean().sqrt().item()


if __name__ == "__main__":
    main()
