"""How well stage 1 finds the poses of captures whose true ones are known, and what it says where it cannot.

`python -m benchmarks.poses FOLDER [--only WORD...] [--route progressive]` makes the captures of `pose_captures` in
FOLDER (a minute each, kept), matches and tracks each as `tumble run --poses estimate` does, scores the rotations and
positions, and writes `benchmarks/poses.json` and the table `benchmarks/poses.md`. Rows that are there are kept.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.kernels import machine
from benchmarks.pose_captures import COMPARED, FRAMES, LARGE, ODD, OTHERS, PLAIN, TEXTURED, Case, load
from tumble import files, graph, matching, metrics, progressive
from tumble.gauge import Tracked
from tumble.loop import drive
from tumble.pairs import neighbours
from tumble.recipes import DRAFT, progressive_poses
from tumble.trajectory import Trajectory

COMMAND = "python -m benchmarks.poses FOLDER [--only WORD..., --route progressive]"
TOLERANCE = 0.1
"""Of AUC_ATE [mean distance of camera and object]."""
Row = dict[str, Any]
SCORES = {
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
    parser.add_argument("folder", type=Path, help="of the captures; matches are not kept: their time counts")
    parser.add_argument("--only", nargs="+", default=[""], help="captures whose names contain one of these")
    parser.add_argument("--route", choices=["graph", "progressive"], default="graph")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for case in (*PLAIN, *LARGE, *ODD) if arguments.route == "graph" else COMPARED:
        known = (case.name, arguments.route) in [(row["name"], row["route"]) for row in rows]
        if known or not any(word in case.name for word in arguments.only):
            continue
        rows.append(measure(case, arguments.folder, arguments.route))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
        arguments.out.with_suffix(".md").write_text(report(rows))
        print(line(["name", "route", *SCORES], rows[-1]), flush=True)


def measure(case: Case, root: Path, route: str) -> Row:
    """One row: match, track, score."""
    capture, truth = load(case, root)
    begun = time.perf_counter()
    matches = matching.match_pairs(matching.views_of(capture), neighbours(len(capture)), DRAFT.matcher)
    matched = time.perf_counter()
    if route == "graph":
        tracked = drive(graph, DRAFT.track, graph.gather(capture, matches), seed=0)
    else:
        recipe = progressive_poses(DRAFT)
        tracked = drive(progressive, recipe.track, progressive.gather(capture, matches), seed=0)
    seconds = time.perf_counter() - begun
    health = tracked.health
    return {
        "name": case.name,
        "route": route,
        **asdict(case),
        "frames": len(capture),
        **(scores(tracked, truth) if truth is not None else {}),
        "seconds": round(seconds, 1),
        "matching_seconds": round(matched - begun, 1),
        "lost": int(health.lost.sum()),
        "claimed_degrees": round(math.degrees(health.uncertainty), 2),
        "verdict": health.verdict,
        "sentence": health.sentence,
    }


def scores(tracked: Tracked, truth: Trajectory) -> dict[str, float]:
    """Against the true poses, of all frames, and of those that are not lost."""
    found = tracked.trajectory
    aligned = metrics.align(found, truth).to_truth(found)
    reach = TOLERANCE * float(truth.camera_positions.norm(dim=-1).mean())
    values = metrics.rotation_scores(found, truth) | metrics.position_scores(aligned, truth, tolerance=reach)
    kept = (~tracked.health.lost).nonzero()[:, 0]
    if len(kept):
        those = metrics.rotation_scores(found.select(kept), truth.select(kept))
        values |= {f"kept_{name}": value for name, value in those.items()}
    return {name: round(value, 3) for name, value in values.items()}


# The table ------------------------------------------------------------------------------------------------------------


def report(rows: Sequence[Row]) -> str:
    """Tables in Markdown."""
    plain, large, odd = ([case.name for case in cases] for cases in (PLAIN, LARGE, ODD))
    graph_rows = [row for row in rows if row["route"] == "graph"]
    made = [row for row in graph_rows if row["name"] in plain]
    parts = [
        "# Poses from RGB\n",
        f"`{COMMAND}`; captures of {FRAMES} frames by `tumble synth`, 5 to 12 degrees apart. AUC_ATE at "
        f"{TOLERANCE:.0%} of the mean distance. Time: matching and stage 1, on one thread of a machine that had other "
        "work; the graph route finds all six degrees of freedom itself.\n",
        table(["model", "light", "seed", *SCORES], made, TEXTURED, OTHERS),
        "## At 256 x 256\n",
        table(["model", "light", "seed", *SCORES], [row for row in graph_rows if row["name"] in large]),
        "## Odd captures\n",
        table(["name", *SCORES], [row for row in graph_rows if row["name"] in odd]),
        *(f"- {row['name']}: {row['sentence']}" for row in graph_rows if row["name"] in odd),
    ]
    others = {row["name"] for row in rows if row["route"] == "progressive"}
    if others:
        both = sorted((row for row in rows if row["name"] in others), key=lambda row: (row["name"], row["route"]))
        parts += [
            "\n## The paper's progressive route against the graph\n",
            "With the network, rays and steps of `recipes.QUICK_TRACK`, a hundredth of the paper's work: it says "
            "nothing of the route at full size, which takes days on a CPU and has not been run.\n",
            table(["name", "route", *SCORES], both),
        ]
    return "\n".join(parts) + "\n"


def table(columns: Sequence[str], rows: Sequence[Row], *classes: tuple[str, ...]) -> str:
    """Rows, and their means by class of objects."""
    lines = [line(columns, {name: SCORES.get(name, name) for name in columns}), "|" + " --- |" * len(columns)]
    ordered = sorted(rows, key=lambda row: tuple(str(row[name]) for name in columns if name not in SCORES))
    lines += [line(columns, row) for row in ordered]
    for objects in classes:
        found = [row for row in rows if row["model"] in objects]
        means = {name: _mean(found, name) for name in SCORES if found and isinstance(found[0].get(name), int | float)}
        label = "mean, textured" if objects == TEXTURED else "mean, others"
        lines += [line(columns, {"model": f"**{label}**", **means})] if found else []
    return "\n".join(lines) + "\n"


def _mean(rows: Sequence[Row], name: str) -> float:
    return round(statistics.fmean(row[name] for row in rows), 2)


def line(columns: Sequence[str], row: Row) -> str:
    return "| " + " | ".join(str(row.get(name, "")) for name in columns) + " |"


if __name__ == "__main__":
    main()
