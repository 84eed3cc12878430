"""What a wrong focal length costs stage 1, whether the frames say so, and how well it is found where it was a guess.

`python -m benchmarks.focal FOLDER [--only WORD...]` tracks captures of `pose_captures` (in FOLDER, made where they are
missing) as `benchmarks.poses` does, with the focal length times a factor: once taken for known, once for a guess. From
the poses found with the true one it also adjusts all frames anew at other focal lengths, which are then kept. Writes
`benchmarks/focal.json` and the tables `benchmarks/focal.md`; rows that are there are kept.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.kernels import machine
from benchmarks.pose_captures import OTHERS, TEXTURED, Case, load
from benchmarks.poses import against, table
from tumble import matching
from tumble.engine import drive
from tumble.io import files
from tumble.poses import neighbours
from tumble.poses.sfm import stage
from tumble.recipes import DRAFT
from tumble.scene import Capture, Match, Trajectory

COMMAND = "python -m benchmarks.focal FOLDER"
CASES = (Case(TEXTURED[1]), Case(TEXTURED[0]), Case(OTHERS[0]))
UNSEEN = (Case(TEXTURED[0], setting="turntable"), Case("bare_can"), Case("grey_sphere"))
"""Of which frames say less: turned about one axis, and, without poses to find, without texture."""
POSES = stage.Config()
WRONG = (0.5, 0.8, 1.25)
"""A phone's main camera where a lens twice as long was used, and usual errors of a guess."""
CURVE = (0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4)
SETTLING = (1.0, 0.7, *[0.5] * 6)
"""Residuals at which the loss starts to forgive, of the rounds that adjust at another focal length [pixels]."""
COLUMNS = ["capture", "taken for", "start", "found", "median [deg]", "AUC_ATE [%]", "health says [deg]", "verdict"]
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of the captures")
    parser.add_argument("--only", nargs="+", default=[""], help="captures whose names contain one of these")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    known = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"rows": [], "curves": []}
    rows, curves = known["rows"], known["curves"]
    for case in (*CASES, *UNSEEN):
        starts = [(factor, True) for factor in WRONG[1:]]
        if case in CASES:
            starts = [(1.0, False), *((factor, guess) for factor in WRONG for guess in (False, True))]
        there = {(row["start"], row["taken for"] == "a guess") for row in rows if row["capture"] == case.name}
        starts = [start for start in starts if start not in there]
        if not starts or not any(word in case.name for word in arguments.only):
            continue
        capture, truth = load(case, arguments.folder)
        matches = matching.match_pairs(matching.views_of(capture), neighbours(len(capture)), DRAFT.matcher)
        rows += [measure(case, capture, truth, matches, *start) for start in starts]
        if case in CASES and case.name not in {row["capture"] for row in curves}:
            curves.append(curve(case, capture, matches))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows, "curves": curves})
        arguments.out.with_suffix(".md").write_text(report(rows, curves))
        print(table(COLUMNS, [row for row in rows if row["capture"] == case.name]), flush=True)


def measure(
    case: Case, capture: Capture, truth: Trajectory | None, matches: Sequence[Match], factor: float, guess: bool
) -> Row:
    """Stage 1 with the true focal length times a factor, which stays as it is unless it is called a guess."""
    told = replace(capture, camera=capture.camera.zoomed(factor), focal_guessed=guess)
    tracked = drive(stage, POSES, stage.gather(told, matches, "mixed"), seed=0)
    scores = {} if truth is None else against(tracked.trajectory, truth)
    return {
        "capture": case.name,
        "taken for": "a guess" if guess else "known",
        "start": factor,
        "found": round(float(tracked.camera.fx_fy_cx_cy[0] / capture.camera.fx_fy_cx_cy[0]), 3),
        "median [deg]": round(scores["rotation_median_degrees"], 2) if scores else "",
        "AUC_ATE [%]": round(scores["auc_percent"], 1) if scores else "",
        "health says [deg]": round(float(torch.rad2deg(torch.tensor(tracked.quality.uncertainty))), 2),
        "verdict": tracked.quality.verdict,
    }


@torch.no_grad()
def curve(case: Case, capture: Capture, matches: Sequence[Match]) -> Row:
    """The loss per observation of all frames adjusted anew at other focal lengths [pixels^2]."""
    inputs = stage.gather(capture, matches, "mixed")
    state = stage.init(POSES, inputs, torch.Generator().manual_seed(0))
    for state.step in range(stage.length(POSES, inputs)):
        stage.step(POSES, inputs, state)
    row: Row = {"capture": case.name}
    found = state.params
    for factor in CURVE:
        seen = stage.through(inputs, torch.tensor(factor).log())
        t = found.t / torch.tensor([factor, factor, 1.0])
        alone = stage.State(0, replace(found, t=t), None, torch.Generator(), state.memory)
        for scale in SETTLING:
            alone.rng.manual_seed(0)
            alone.params, said = stage.adjust_all(POSES, seen, alone, scale)
        row[str(factor)] = round(float(said["loss"]), 4)
    return row


def report(rows: Sequence[Row], curves: Sequence[Row]) -> str:
    """Tables in Markdown."""
    return "\n".join(
        [
            "# A focal length that nobody stated\n",
            f"`{COMMAND}`; 72 frames of 128 x 128, the object about four of its radii away; "
            "captures as in `poses.md`, on a 2-core x86_64 CPU. Start and found: focal "
            "length over the true one.\n",
            table(COLUMNS, rows),
            "## What the frames say of it\n",
            "Loss per observation [pixels^2] of all frames adjusted anew at focal lengths that are kept, over the true "
            "one, from the poses found with the true one.\n",
            table(["capture", *map(str, CURVE)], curves),
        ]
    )


if __name__ == "__main__":
    main()
