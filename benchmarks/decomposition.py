"""The paper's central table: hand-held against turntable against dome, on captures with truth and known poses.

`python -m benchmarks.decomposition CAPTURE... --runs FOLDER` reconstructs and scores each capture (`tumble run`,
`tumble evaluate`) and adds a row to `benchmarks/decomposition.json`; finished runs are only scored. Each capture is
made by `tumble synth`; what made it stands in the row. What a number of a recipe is worth: `--change NAME=VALUE`, as
`--change refine.weights.proj=1`.
"""

import argparse
import json
import resource
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.kernels import machine
from tumble.actions import evaluate_run
from tumble.engine import run as runs
from tumble.io import files
from tumble.pipeline import reconstruct
from tumble.recipes import ABLATIONS, QUALITIES, Recipe
from tumble.synthetic import SETTINGS_FILE

KEPT = (
    "albedo.psnr_fg_srgb",
    "albedo.psnr_fg_linear",
    "albedo.psnr_full_srgb",
    "relit.psnr_fg_srgb",
    "relit.psnr_full_srgb",
    "image.psnr_fg_srgb",
    "image.psnr_full_srgb",
    "normal.mean_fg_degrees",
    "roughness.rmse_fg",
    "silhouette.iou",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--quality", choices=QUALITIES, default="draft")
    altered = parser.add_mutually_exclusive_group()
    altered.add_argument("--ablation", choices=ABLATIONS)
    altered.add_argument("--change", metavar="NAME=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for capture in arguments.captures:
        recipe = replace(QUALITIES[arguments.quality], seed=arguments.seed)
        about = {"quality": arguments.quality, "seed": arguments.seed}
        if arguments.ablation:
            recipe, about = ABLATIONS[arguments.ablation](recipe), about | {"ablation": arguments.ablation}
        if arguments.change:
            name, _, value = arguments.change.partition("=")
            recipe, about = changed(recipe, name, json.loads(value)), about | {"ablation": arguments.change}
        row = measure(capture, arguments.runs / "-".join([capture.name, *map(str, about.values())]), recipe, about)
        rows = [old for old in rows if old["made_by"] != row["made_by"] or old["recipe"] != row["recipe"]] + [row]
        command = "python -m benchmarks.decomposition CAPTURE... --runs FOLDER [--ablation, --change, --seed]"
        files.write_json(arguments.out, {"command": command, "machine": machine(), "rows": rows})
        shared = row["shared"]
        scores = f"albedo {shared[KEPT[0]]:6.2f}  relit {shared[KEPT[3]]:6.2f}"
        print(f"{capture.name:60} {scores}  {row['run_seconds']:.0f} s", flush=True)


def changed(recipe: Any, name: str, value: object) -> Any:
    """The recipe with another value of the field that a dotted name leads to."""
    first, _, rest = name.partition(".")
    return replace(recipe, **{first: changed(getattr(recipe, first), rest, value) if rest else value})


def measure(capture: Path, run: Path, recipe: Recipe, about: dict[str, Any]) -> dict[str, Any]:
    """One row: reconstruct if need be, predict, score."""
    reconstruct(capture, run, recipe)
    seconds = sum({r["name"]: r["seconds"] for r in runs.records(run) if r.get("event") == "done"}.values())
    begun = time.perf_counter()
    report = evaluate_run(run, capture)
    note = files.read_json(capture / SETTINGS_FILE)
    regions = {
        region: {key: round(scores[key], 4) for key in KEPT if key in scores}
        for region, scores in report["regions"].items()
    }
    return {
        "made_by": {"model": note["model"], **note["options"]},
        "recipe": about,
        "run_seconds": round(seconds, 1),
        "score_seconds": round(time.perf_counter() - begun, 1),
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        **regions,
        "light": {key: value for key, value in report["light"].items() if value is not None},
        "albedo_scale": report["albedo_scale"],
    }


if __name__ == "__main__":
    main()
