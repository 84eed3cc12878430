"""How well stage 1 finds the poses of captures whose true ones are known.

`python -m benchmarks.poses CAPTURE... [--seeds 0 1] [--cache FOLDER]` matches and tracks each capture as
`tumble run --poses estimate` does, scores the rotations and positions, adds a row to `benchmarks/poses.json` and writes
the table `benchmarks/poses.md`. Each capture is made by `tumble synth`; what made it stands in the row.
"""

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.kernels import machine
from tumble import files, graph, matching, metrics
from tumble.datasets import folder
from tumble.loop import drive
from tumble.pairs import neighbours
from tumble.recipes import Recipe
from tumble.synthesize import NOTE

COMMAND = "python -m benchmarks.poses CAPTURE... [--seeds, --cache]"
TOLERANCE = 0.1
"""Of AUC_ATE [mean distance of camera and object]."""
COLUMNS = {
    "object": "object",
    "light": "light",
    "setting": "setting",
    "seed": "seed",
    "frames": "frames",
    "rotation_median_degrees": "median [deg]",
    "rotation_mean_degrees": "mean [deg]",
    "rotation_below_10_percent": "< 10 deg [%]",
    "auc_percent": "AUC_ATE [%]",
    "seconds": "time [s]",
    "lost": "lost",
    "claimed_degrees": "health says [deg]",
    "verdict": "verdict",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--cache", type=Path, help="folder for matches; time then only counts what is new")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for capture in arguments.captures:
        for seed in arguments.seeds:
            row = measure(capture, seed, arguments.cache)
            rows = [old for old in rows if (old["made_by"], old["seed"]) != (row["made_by"], seed)] + [row]
            files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
            arguments.out.with_suffix(".md").write_text(table(rows))
            print(line(row), flush=True)


def measure(path: Path, seed: int, cache: Path | None) -> dict[str, Any]:
    """One row: match, track, score."""
    truth = folder.load_truth(path)
    assert truth is not None, f"{path} has no truth"
    assert truth.poses is not None, f"{path} has no true poses"
    capture, recipe = replace(folder.load(path), trajectory=None), Recipe()
    begun = time.perf_counter()
    pairs = neighbours(len(capture))
    matches = matching.match_pairs(matching.views_of(capture), pairs, recipe.matcher, cache=cache)
    tracked = drive(graph, recipe.track, graph.gather(capture, matches), seed=seed)
    seconds = time.perf_counter() - begun
    found, health = tracked.trajectory, tracked.health
    aligned = metrics.align(found, truth.poses).to_truth(found)
    reach = TOLERANCE * float(truth.poses.camera_positions.norm(dim=-1).mean())
    scores = metrics.rotation_scores(found, truth.poses)
    scores |= metrics.position_scores(aligned, truth.poses, tolerance=reach)
    note = files.read_json(path / NOTE)
    return {
        "made_by": {"model": note["model"], **note["options"]},
        "object": Path(note["model"]).stem,
        "light": Path(note["options"]["env"]).stem,
        "setting": note["options"]["setting"],
        "seed": seed,
        "frames": len(capture),
        **{name: round(value, 3) for name, value in scores.items()},
        "seconds": round(seconds, 1),
        "lost": int(health.lost.sum()),
        "claimed_degrees": round(math.degrees(health.uncertainty), 2),
        "verdict": health.verdict,
        "sentence": health.sentence,
    }


def line(row: dict[str, Any]) -> str:
    return "| " + " | ".join(str(row[name]) for name in COLUMNS) + " |"


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    head = "| " + " | ".join(COLUMNS.values()) + " |"
    ordered = sorted(rows, key=lambda row: (row["object"], row["light"], row["setting"], row["seed"]))
    return "\n".join([head, "|" + " --- |" * len(COLUMNS), *map(line, ordered)]) + "\n"


if __name__ == "__main__":
    main()
