"""Accuracy of the poses of stage 1 on synthetic captures, and its rating of them.

`python -m benchmarks.poses FOLDER [--only WORD...] [--route ROUTE] [--refined]` renders the captures of
`pose_captures` in FOLDER (a minute each, unless they exist), runs matching and stage 1 on each as
`tumble run --poses estimate` does, scores rotations and positions, and writes `benchmarks/poses.json` and the table
`benchmarks/poses.md`. Existing rows are kept. `--refined` also runs stage 2 on the twenty plain captures, and measures
again the rows without it; with route "progressive" it runs stage 2 both after the last frame was tracked and after the
closing rounds, in which all frames and the neural shape are refined. Route "graph" is `tumble.poses.sfm`, route
"progressive" the paper's; "colmap" is the program of that name (`pip install pycolmap`), on the same masked frames.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks import colmap
from benchmarks.kernels import machine
from benchmarks.pose_captures import (
    COMPARED,
    DIFFICULT,
    FRAMES,
    LARGE,
    NEW,
    OTHER_OBJECTS,
    OTHERS,
    PLAIN,
    TABLE_4,
    TEXTURED,
    Case,
    load,
)
from tumble import matching
from tumble.bench import current_code
from tumble.engine import drive
from tumble.evaluation import metrics
from tumble.inverse_rendering import refine
from tumble.io import files
from tumble.poses import PoseResult, neighbours
from tumble.poses.progressive import stage as progressive
from tumble.poses.sfm import stage as sfm
from tumble.recipes import DRAFT, Recipe, progressive_poses
from tumble.scene import Capture, Trajectory

COMMAND = "python -m benchmarks.poses FOLDER [--only WORD..., --route ROUTE, --refined]"
TOLERANCE = 0.1
"""Largest position error in the AUC of the absolute trajectory error [mean distance of camera and object]."""
Row = dict[str, Any]
SCORES = {
    "rotation_median_degrees": "median [deg]",
    "rotation_mean_degrees": "mean [deg]",
    "rotation_below_10_percent": "< 10 deg [%]",
    "auc_percent": "AUC_ATE [%]",
    "seconds": "time [s]",
    "lost": "lost frames",
    "claimed_degrees": "estimated error [deg]",
    "verdict": "rating",
    "code": "code",
}
"""Column titles of stage 1, by the key of a row."""
REFINED = {
    "rotation_median_degrees": "stage 1: median [deg]",
    "rotation_below_10_percent": "< 10 deg [%]",
    "auc_percent": "AUC_ATE [%]",
    "refined_rotation_median_degrees": "stage 2: median [deg]",
    "refined_rotation_below_10_percent": "< 10 deg [%]",
    "refined_auc_percent": "AUC_ATE [%]",
    "refined_seconds": "time [s]",
    "code": "code",
}
"""Column titles of the comparison with stage 2, by the key of a row."""
REFINEMENTS = {
    "rotation_median_degrees": "median [deg]",
    "rotation_below_10_percent": "< 10 deg [%]",
    "auc_percent": "AUC_ATE [%]",
    "rpe_rotation_degrees": "RPE rotation [deg]",
    "rpe_translation_percent": "RPE translation [%]",
}
"""Column titles of the comparison of refinements, by the key of a row without its prefix."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the captures; matches are not cached, since time counts")
    parser.add_argument("--only", nargs="+", default=[""], help="captures whose names contain one of these")
    parser.add_argument("--route", choices=["graph", "progressive", "colmap"], default="graph")
    parser.add_argument("--refined", action="store_true", help="also run stage 2 of the draft recipe")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    every = (*PLAIN, *OTHER_OBJECTS, *LARGE, *DIFFICULT)
    of_routes = {"graph": PLAIN if arguments.refined else every}
    cases = of_routes.get(arguments.route, TABLE_4 if arguments.refined else COMPARED)
    for case in cases:
        same = [row for row in rows if (row["name"], row["route"]) == (case.name, arguments.route)]
        complete = same and ("refined_seconds" in same[0] or not arguments.refined)
        if complete or not any(word in case.name for word in arguments.only):
            continue
        rows = [row for row in rows if row not in same]
        rows.append(measure(case, arguments.folder, arguments.route, refined=arguments.refined))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
        arguments.out.with_suffix(".md").write_text(report(rows))
        print(line(["name", "route", *SCORES], rows[-1]), flush=True)


def measure(case: Case, root: Path, route: str, *, refined: bool) -> Row:
    """A row: matching, stage 1, its scores, and those of stage 2 if `refined`."""
    capture, truth = load(case, root)
    code = (current_code()["commit"] or "")[:8]
    about = {"name": case.name, "route": route, **asdict(case), "frames": len(capture), "code": code}
    if route == "colmap":
        assert truth is not None, "a capture with true poses"
        return about | colmap_scores(capture, truth)
    started = time.perf_counter()
    hidden = sfm.is_hidden(capture.masks)
    views = matching.views_of(sfm.shown(capture) if hidden else capture)
    matches = matching.match_pairs(views, neighbours(len(capture)), DRAFT.matcher)
    matched = time.perf_counter()
    inputs = sfm.gather(capture, matches, hidden=hidden)
    if route == "graph":
        tracked, unclosed = drive(sfm, DRAFT.track, inputs, seed=0), None
    else:
        tracked, unclosed = progressive_results(
            progressive.gather(capture, inputs.matches, partial(sfm.assess, inputs), inputs.failed)
        )
    seconds = time.perf_counter() - started
    quality = tracked.quality
    scores = {}
    if truth is not None:
        scores = stage_1_scores(tracked, truth)
        if unclosed is not None:
            scores |= named("tracked", stage_1_scores(unclosed, truth))
        if refined:
            recipe = DRAFT if route == "graph" else progressive_poses(DRAFT)
            scores |= named("refined", stage_2_scores(recipe, tracked, capture, truth))
            if unclosed is not None:
                scores |= named("tracked_refined", stage_2_scores(recipe, unclosed, capture, truth))
    return {
        **about,
        **scores,
        "seconds": round(seconds, 1),
        "matching_seconds": round(matched - started, 1),
        "lost": int(quality.lost.sum()),
        "claimed_degrees": round(math.degrees(quality.uncertainty), 2),
        "verdict": quality.rating,
        "sentence": quality.sentence,
    }


def progressive_results(inputs: progressive.Inputs) -> tuple[PoseResult, PoseResult]:
    """Poses of the progressive route after its closing rounds, and before them."""
    cfg = progressive_poses(DRAFT).track
    state = progressive.init(cfg, inputs, torch.Generator().manual_seed(0))
    tracked_steps = progressive.length(replace(cfg, closing=0), inputs)
    unclosed = None
    while state.step < progressive.length(cfg, inputs):
        if state.step == tracked_steps:
            unclosed = progressive.finish(cfg, inputs, state)
        progressive.step(cfg, inputs, state)
        state.step += 1
    assert unclosed is not None, "a recipe with closing rounds"
    return progressive.finish(cfg, inputs, state), unclosed


def named(prefix: str, scores: dict[str, float]) -> dict[str, float]:
    """Scores with a prefix to their names."""
    return {f"{prefix}_{name}": value for name, value in scores.items()}


def colmap_scores(capture: Capture, truth: Trajectory) -> Row:
    """Scores of the frames that COLMAP's largest reconstruction holds, and the number of the others."""
    started = time.perf_counter()
    found = colmap.poses(capture)
    seconds = round(time.perf_counter() - started, 1)
    if found is None:
        return {"lost": len(capture), "seconds": seconds}
    estimate, frames = found
    true = truth.select(frames)
    try:
        scores = pose_scores(estimate, true, frames)
    except ValueError:  # The positions of a few frames lie nearly on a line, by which nothing can be aligned.
        scores = metrics.rotation_scores(estimate, true)
    scores = {name: round(value, 3) for name, value in scores.items()}
    return {**scores, "lost": len(capture) - len(frames), "seconds": seconds}


def stage_1_scores(tracked: PoseResult, truth: Trajectory) -> dict[str, float]:
    """Scores of all frames against the true poses, and rotation scores of the frames that are not lost."""
    estimate = tracked.trajectory
    values = pose_scores(estimate, truth)
    kept = (~tracked.quality.lost).nonzero()[:, 0]
    if len(kept):
        kept_scores = metrics.rotation_scores(estimate.select(kept), truth.select(kept))
        values |= {f"kept_{name}": value for name, value in kept_scores.items()}
    return {name: round(value, 3) for name, value in values.items()}


def stage_2_scores(recipe: Recipe, tracked: PoseResult, capture: Capture, truth: Trajectory) -> dict[str, float]:
    """Scores of the poses after stage 2 of a recipe, for the frames that are not lost."""
    started = time.perf_counter()
    kept = (~tracked.quality.lost).nonzero()[:, 0]
    inputs = refine.Inputs(capture.select(kept.tolist()), tracked.trajectory.select(kept))
    estimate = drive(refine, recipe.refine, inputs, seed=0).trajectory
    values = pose_scores(estimate, truth.select(kept), kept.tolist()) | {"seconds": time.perf_counter() - started}
    return {name: round(value, 3) for name, value in values.items()}


def pose_scores(estimate: Trajectory, truth: Trajectory, frames: Sequence[int] | None = None) -> dict[str, float]:
    """Rotation scores after alignment by a rotation, position scores after alignment by a similarity, and the error of
    the motion between consecutive frames; its translation is a percentage of the mean distance.

    Args:
        frames: Index of each pose's frame in the capture; by default 0, 1, ...
    """
    similarity, distance = metrics.align(estimate, truth), float(truth.camera_positions.norm(dim=-1).mean())
    scores = metrics.rotation_scores(estimate, truth)
    scores |= metrics.position_scores(similarity.to_truth(estimate), truth, tolerance=TOLERANCE * distance)
    relative = metrics.relative_scores(estimate, truth, frames or range(len(truth)), scale=float(similarity.scale))
    translation, rotation = relative["rpe_translation"], relative["rpe_rotation_degrees"]
    assert translation is not None, "consecutive frames"
    assert rotation is not None, "consecutive frames"
    return scores | {"rpe_translation_percent": 100 * translation / distance, "rpe_rotation_degrees": rotation}


# The table ------------------------------------------------------------------------------------------------------------


def report(rows: Sequence[Row]) -> str:
    """The tables in Markdown."""
    plain, others, large, difficult = (
        [case.name for case in cases] for cases in (PLAIN, OTHER_OBJECTS, LARGE, DIFFICULT)
    )
    sfm_rows = [row for row in rows if row["route"] == "graph"]
    plain_rows = [row for row in sfm_rows if row["name"] in plain]
    other_rows = [row for row in sfm_rows if row["name"] in others]
    refined = [row for row in plain_rows if "refined_seconds" in row]
    parts = [
        "# Poses from RGB\n",
        f"`{COMMAND}`; captures of {FRAMES} frames of 128 x 128 pixels, 5 to 12 degrees apart, rendered by "
        "`tumble synth` from the meshes and light maps in `$TUMBLE_BENCH_DATA` unless FOLDER has them. Median, mean "
        'and "< 10 deg" are of the rotation errors. AUC_ATE: area under the recall curve of camera position errors up '
        f"to {TOLERANCE:.0%} of the mean camera distance. Lost frames have no consistent pose. Estimated error and "
        "rating are stage 1's own, without ground truth: the expected median rotation error, and good, warn or bad. "
        "Time: matching and stage 1, on one thread of a 2-core x86_64 CPU shared with other work. Code: the commit; "
        "rows without it were measured before surface points were located by their texture (docs/method.md). All "
        "tables except the last are of route `graph`, that is `tumble.poses.sfm`.\n",
        table(["model", "light", "seed", *SCORES], plain_rows, TEXTURED, OTHERS),
        "## After stage 2\n",
        "Poses of stage 1, and after stage 2 of the draft recipe. Stage 1 estimates all six degrees of freedom, so "
        "that no PnP is needed in between.\n",
        table(["model", "light", "seed", *REFINED], refined, TEXTURED, OTHERS),
        *(
            [
                "## Nine other objects\n",
                "On these nothing was chosen, but boom box, corset, water bottle and bell pepper, the worst of them, "
                "were seen when stage 1 was designed.\n",
                table(["model", "light", "seed", *SCORES], other_rows, NEW),
            ]
            if other_rows
            else []
        ),
        "## At 256 x 256\n",
        table(["model", "light", "seed", *SCORES], [row for row in sfm_rows if row["name"] in large]),
        "## Difficult captures\n",
        "`exposure`: the exposure rises by a factor of 1.3 over the video. `wrong masks`: every tenth mask is wrong. "
        "`spliced`: the second half shows another object. `bare_can` and `grey_sphere` have no texture. `turntable`: "
        "rotation about a single axis. The spliced capture and those without texture have no scores. Below the table: "
        "stage 1's message to the user.\n",
        table(["name", *SCORES], [row for row in sfm_rows if row["name"] in difficult]),
        *(f"- {row['name']}: {row['sentence']}" for row in sfm_rows if row["name"] in difficult),
    ]
    compared = {row["name"] for row in rows if row["route"] != "graph"}
    if compared:
        both = sorted((row for row in rows if row["name"] in compared), key=lambda row: (row["name"], row["route"]))
        parts += [
            "\n## The paper's stage 1 (route `progressive`), route `graph`, and COLMAP\n",
            "Route `progressive` is `tumble.poses.progressive` with `recipes.QUICK_TRACK`: voxel grids in place of the "
            "paper's networks, and initial poses from matches. Its constants were chosen on the knight, the cracker "
            "box, the mustard bottle and the soup can, not on the others. The paper's own form takes days on a CPU and "
            "has not been run: the table is no evidence about that. COLMAP (pycolmap 4.2.1, its own settings, known "
            f"camera) sees the masked frames enlarged {colmap.ENLARGED} times; its scores are of the frames in its "
            "largest reconstruction only, and the others are lost.\n",
            table(["name", "route", *SCORES], both),
        ]
    refinements = [row for row in rows if row["route"] == "progressive" and "tracked_refined_seconds" in row]
    if refinements:
        parts += [
            "## Refinement of the progressive route's poses\n",
            "The paper's Table 4 in kind, on the same captures: poses after the last frame was tracked; after rounds "
            "in which all frames and the neural shape are refined (as in FMOV; `QUICK_TRACK.closing`); after stage 2 "
            "of the draft recipe, which refines poses against Gaussians, in place of these rounds; after both; and "
            "route `graph` without and with stage 2. Nine alignments (`recipes.REALIGNMENTS`) in rows of code 80c668b, "
            "four in the others and after route `graph`. RPE: mean error of the motion between consecutive frames, its "
            "translation in per cent of the mean distance.\n",
            refinement_table(refinements, [row for row in sfm_rows if "refined_seconds" in row]),
        ]
    return "\n".join(parts) + "\n"


def refinement_table(progressive_rows: Sequence[Row], graph_rows: Sequence[Row]) -> str:
    """A Markdown table with a line for every capture and way of refinement."""
    ways = [
        ("tracked", "tracked_", progressive_rows),
        ("tracked, neural refinement", "", progressive_rows),
        ("tracked, Gaussian refinement", "tracked_refined_", progressive_rows),
        ("tracked, neural and Gaussian refinement", "refined_", progressive_rows),
        ("graph", "", graph_rows),
        ("graph, Gaussian refinement", "refined_", graph_rows),
    ]
    columns = ["name", "poses", *REFINEMENTS]
    lines = [line(columns, {"name": "name", "poses": "poses"} | REFINEMENTS), "|" + " --- |" * len(columns)]
    for name in sorted(row["name"] for row in progressive_rows):
        for title, prefix, rows in ways:
            same = [row for row in rows if row["name"] == name]
            values = {key: same[0].get(prefix + key, "") for key in REFINEMENTS} if same else {}
            lines.append(line(columns, {"name": name, "poses": title} | values))
    return "\n".join(lines) + "\n"


def table(columns: Sequence[str], rows: Sequence[Row], *classes: tuple[str, ...]) -> str:
    """A Markdown table of rows, with the mean over each class of objects."""
    titles = REFINED if "refined_seconds" in columns else SCORES
    lines = [line(columns, {name: titles.get(name, name) for name in columns}), "|" + " --- |" * len(columns)]
    ordered = sorted(rows, key=lambda row: tuple(str(row[name]) for name in columns if name not in titles))
    lines += [line(columns, row) for row in ordered]
    for objects in classes:
        group = [row for row in rows if row["model"] in objects]
        means = {name: _mean(group, name) for name in titles if group and isinstance(group[0].get(name), int | float)}
        label = {TEXTURED: "mean, textured", OTHERS: "mean, others", NEW: "mean"}[objects]
        lines += [line(columns, {"model": f"**{label}**", **means})] if group else []
    return "\n".join(lines) + "\n"


def _mean(rows: Sequence[Row], name: str) -> float:
    return round(statistics.fmean(row[name] for row in rows), 2)


def line(columns: Sequence[str], row: Row) -> str:
    """A row as a line of a Markdown table."""
    return "| " + " | ".join(str(row.get(name, "")) for name in columns) + " |"


if __name__ == "__main__":
    main()
