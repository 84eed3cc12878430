"""How well stage 1 finds the poses of captures whose true ones are known, and what it says where it cannot.

`python -m benchmarks.poses FOLDER [--only WORD...] [--route progressive] [--refined]` makes the captures of
`pose_captures` in FOLDER (a minute each, kept), matches and tracks each as `tumble run --poses estimate` does, scores
the rotations and positions, and writes `benchmarks/poses.json` and the table `benchmarks/poses.md`. Rows that are there
are kept; `--refined` goes on to stage 2, on the twenty plain captures, and measures the rows anew that lack it.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.kernels import machine
from benchmarks.pose_captures import COMPARED, FRAMES, LARGE, ODD, OTHERS, PLAIN, TEXTURED, Case, load
from tumble import matching
from tumble.engine import drive
from tumble.evaluation import metrics
from tumble.inverse_rendering import refine
from tumble.io import files
from tumble.poses import PoseResult, neighbours
from tumble.poses.progressive import stage as progressive
from tumble.poses.sfm import stage as graph
from tumble.recipes import DRAFT, progressive_poses
from tumble.scene import Capture, Trajectory

COMMAND = "python -m benchmarks.poses FOLDER [--only WORD..., --route progressive, --refined]"
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
REFINED = {
    "rotation_median_degrees": "stage 1: median [deg]",
    "rotation_below_10_percent": "< 10 deg [%]",
    "auc_percent": "AUC_ATE [%]",
    "refined_rotation_median_degrees": "stage 2: median [deg]",
    "refined_rotation_below_10_percent": "< 10 deg [%]",
    "refined_auc_percent": "AUC_ATE [%]",
    "refined_seconds": "time [s]",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of the captures; matches are not kept: their time counts")
    parser.add_argument("--only", nargs="+", default=[""], help="captures whose names contain one of these")
    parser.add_argument("--route", choices=["graph", "progressive"], default="graph")
    parser.add_argument("--refined", action="store_true", help="stage 2 of the draft recipe as well")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    cases = COMPARED if arguments.route == "progressive" else PLAIN if arguments.refined else (*PLAIN, *LARGE, *ODD)
    for case in cases:
        same = [row for row in rows if (row["name"], row["route"]) == (case.name, arguments.route)]
        known = same and ("refined_seconds" in same[0] or not arguments.refined)
        if known or not any(word in case.name for word in arguments.only):
            continue
        rows = [row for row in rows if row not in same]
        rows.append(measure(case, arguments.folder, arguments.route, refined=arguments.refined))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
        arguments.out.with_suffix(".md").write_text(report(rows))
        print(line(["name", "route", *SCORES], rows[-1]), flush=True)


def measure(case: Case, root: Path, route: str, *, refined: bool) -> Row:
    """One row: match, track, score; then stage 2, too."""
    capture, truth = load(case, root)
    begun = time.perf_counter()
    matches = matching.match_pairs(matching.views_of(capture), neighbours(len(capture)), DRAFT.matcher)
    matched = time.perf_counter()
    if route == "graph":
        tracked = drive(graph, DRAFT.track, graph.gather(capture, matches, DRAFT.matcher), seed=0)
    else:
        recipe = progressive_poses(DRAFT)
        assess = partial(graph.assess, graph.gather(capture, matches, DRAFT.matcher))
        tracked = drive(progressive, recipe.track, progressive.gather(capture, matches, assess), seed=0)
    seconds = time.perf_counter() - begun
    health = tracked.quality
    return {
        "name": case.name,
        "route": route,
        **asdict(case),
        "frames": len(capture),
        **(scores(tracked, truth) if truth is not None else {}),
        **(after_stage_2(tracked, capture, truth) if refined and truth is not None else {}),
        "seconds": round(seconds, 1),
        "matching_seconds": round(matched - begun, 1),
        "lost": int(health.lost.sum()),
        "claimed_degrees": round(math.degrees(health.uncertainty), 2),
        "verdict": health.verdict,
        "sentence": health.sentence,
    }


def scores(tracked: PoseResult, truth: Trajectory) -> dict[str, float]:
    """Against the true poses, of all frames, and of those that are not lost."""
    found = tracked.trajectory
    values = against(found, truth)
    kept = (~tracked.quality.lost).nonzero()[:, 0]
    if len(kept):
        those = metrics.rotation_scores(found.select(kept), truth.select(kept))
        values |= {f"kept_{name}": value for name, value in those.items()}
    return {name: round(value, 3) for name, value in values.items()}


def after_stage_2(tracked: PoseResult, capture: Capture, truth: Trajectory) -> dict[str, float]:
    """The same of the poses that the draft recipe's stage 2 makes of these, of the frames that are not lost."""
    begun = time.perf_counter()
    kept = (~tracked.quality.lost).nonzero()[:, 0]
    inputs = refine.Inputs(capture.select(kept.tolist()), tracked.trajectory.select(kept))
    found = drive(refine, DRAFT.refine, inputs, seed=0).trajectory
    values = against(found, truth.select(kept)) | {"seconds": time.perf_counter() - begun}
    return {f"refined_{name}": round(value, 3) for name, value in values.items()}


def against(found: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Rotations after the best rotation, positions after the best similarity."""
    aligned = metrics.align(found, truth).to_truth(found)
    reach = TOLERANCE * float(truth.camera_positions.norm(dim=-1).mean())
    return metrics.rotation_scores(found, truth) | metrics.position_scores(aligned, truth, tolerance=reach)


# The table ------------------------------------------------------------------------------------------------------------


def report(rows: Sequence[Row]) -> str:
    """Tables in Markdown."""
    plain, large, odd = ([case.name for case in cases] for cases in (PLAIN, LARGE, ODD))
    graph_rows = [row for row in rows if row["route"] == "graph"]
    made = [row for row in graph_rows if row["name"] in plain]
    refined = [row for row in made if "refined_seconds" in row]
    parts = [
        "# Poses from RGB\n",
        f"`{COMMAND}`; captures of {FRAMES} frames by `tumble synth`, 5 to 12 degrees apart, "
        "made from the meshes and light maps in `../shared/data` where FOLDER lacks them. AUC_ATE at "
        f"{TOLERANCE:.0%} of the mean distance. Time: matching and stage 1, on one thread of a 2-core x86_64 CPU that "
        "had other work; the graph route finds all six degrees of freedom itself.\n",
        table(["model", "light", "seed", *SCORES], made, TEXTURED, OTHERS),
        "## After stage 2\n",
        "Stage 1 again, and the poses after stage 2 of the draft recipe. The graph route's poses have six degrees of "
        "freedom already: nothing is lifted in between.\n",
        table(["model", "light", "seed", *REFINED], refined, TEXTURED, OTHERS),
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
    titles = REFINED if "refined_seconds" in columns else SCORES
    lines = [line(columns, {name: titles.get(name, name) for name in columns}), "|" + " --- |" * len(columns)]
    ordered = sorted(rows, key=lambda row: tuple(str(row[name]) for name in columns if name not in titles))
    lines += [line(columns, row) for row in ordered]
    for objects in classes:
        found = [row for row in rows if row["model"] in objects]
        means = {name: _mean(found, name) for name in titles if found and isinstance(found[0].get(name), int | float)}
        label = "mean, textured" if objects == TEXTURED else "mean, others"
        lines += [line(columns, {"model": f"**{label}**", **means})] if found else []
    return "\n".join(lines) + "\n"


def _mean(rows: Sequence[Row], name: str) -> float:
    return round(statistics.fmean(row[name] for row in rows), 2)


def line(columns: Sequence[str], row: Row) -> str:
    return "| " + " | ".join(str(row.get(name, "")) for name in columns) + " |"


if __name__ == "__main__":
    main()
