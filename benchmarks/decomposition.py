"""The paper's central comparison: hand-held, turntable and dome captures with ground truth and known poses.

`python -m benchmarks.decomposition CAPTURE... --runs FOLDER` reconstructs and scores each capture (`tumble run`,
`tumble evaluate`) and adds a row to `benchmarks/decomposition.json`; finished runs are only scored. The captures are
made by `tumble synth`, whose options the row contains. `--change NAME=VALUE` measures the effect of one value of the
recipe, for example `--change refine.weights.proj=1`.
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
"""Scores that are stored in a row."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--quality", choices=QUALITIES, default="draft")
    variants = parser.add_mutually_exclusive_group()
    variants.add_argument("--ablation", choices=ABLATIONS)
    variants.add_argument("--change", metavar="NAME=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for capture in arguments.captures:
        recipe = replace(QUALITIES[arguments.quality], seed=arguments.seed)
        labels = {"quality": arguments.quality, "seed": arguments.seed}
        if arguments.ablation:
            recipe, labels = ABLATIONS[arguments.ablation](recipe), labels | {"ablation": arguments.ablation}
        if arguments.change:
            name, _, value = arguments.change.partition("=")
            recipe, labels = with_value(recipe, name, json.loads(value)), labels | {"ablation": arguments.change}
        row = measure(capture, arguments.runs / "-".join([capture.name, *map(str, labels.values())]), recipe, labels)
        rows = [old for old in rows if old["made_by"] != row["made_by"] or old["recipe"] != row["recipe"]] + [row]
        command = "python -m benchmarks.decomposition CAPTURE... --runs FOLDER [--ablation, --change, --seed]"
        files.write_json(arguments.out, {"command": command, "machine": machine(), "rows": rows})
        shared = row["shared"]
        scores = f"albedo {shared[KEPT[0]]:6.2f}  relit {shared[KEPT[3]]:6.2f}"
        print(f"{capture.name:60} {scores}  {row['run_seconds']:.0f} s", flush=True)


def with_value(recipe: Any, name: str, value: object) -> Any:
    """The recipe with another value of the field with a dotted name."""
    first, _, rest = name.partition(".")
    return replace(recipe, **{first: with_value(getattr(recipe, first), rest, value) if rest else value})


def measure(capture: Path, run: Path, recipe: Recipe, labels: dict[str, Any]) -> dict[str, Any]:
    """A row: reconstruct the capture unless the run is finished, predict its views and score them.

    Args:
        capture: The capture folder.
        run: The run directory.
        recipe: The recipe of the run.
        labels: Quality, seed and ablation, to be stored in the row.
    """
    reconstruct(capture, run, recipe)
    seconds = sum({r["name"]: r["seconds"] for r in runs.log_records(run) if r.get("event") == "done"}.values())
    started = time.perf_counter()
    report = evaluate_run(run, capture)
    synthesis = files.read_json(capture / SETTINGS_FILE)
    regions = {
        region: {key: round(scores[key], 4) for key in KEPT if key in scores}
        for region, scores in report["regions"].items()
    }
    return {
        "made_by": {"model": synthesis["model"], **synthesis["options"]},
        "recipe": labels,
        "run_seconds": round(seconds, 1),
        "score_seconds": round(time.perf_counter() - started, 1),
        "peak_memory_MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        **regions,
        "light": {key: value for key, value in report["light"].items() if value is not None},
        "albedo_scale": report["albedo_scale"],
    }


if __name__ == "__main__":
    main()
