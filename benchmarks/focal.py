"""Effect of a wrong focal length on stage 1, and accuracy of the focal length that stage 1 estimates.

`python -m benchmarks.focal FOLDER [--only WORD...]` runs stage 1 on captures of `pose_captures` (in FOLDER, rendered if
missing) as `benchmarks.poses` does, with the focal length times a factor, which is either fixed ("known") or an initial
estimate ("a guess"). It also measures the loss as a function of the focal length: bundle adjustment of all frames at
fixed focal lengths, starting from the poses estimated with the true one. Writes `benchmarks/focal.json` and the tables
`benchmarks/focal.md`; existing rows are kept.
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
from benchmarks.poses import pose_scores, table
from tumble import matching
from tumble.engine import drive
from tumble.io import files
from tumble.poses import neighbours
from tumble.poses.sfm import stage
from tumble.recipes import DRAFT
from tumble.scene import Capture, Match, Trajectory

COMMAND = "python -m benchmarks.focal FOLDER"
CASES = (Case(TEXTURED[1]), Case(TEXTURED[0]), Case(OTHERS[0]))
"""Captures measured with known and with estimated focal lengths."""
WEAK_CASES = (Case(TEXTURED[0], setting="turntable"), Case("bare_can"), Case("grey_sphere"))
"""Captures whose frames hardly determine the focal length: rotation about a single axis, and objects without texture,
whose poses cannot be found."""
POSES = stage.Config()
"""Configuration of stage 1."""
FACTORS = (0.5, 0.8, 1.25)
"""Initial over true focal length: 0.5 is a phone's main camera assumed for a lens twice as long; the others are usual
errors of an assumed focal length."""
CURVE = (0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4)
"""Focal lengths of the loss curve, over the true one."""
LOSS_SCALES = (1.0, 0.7, *[0.5] * 6)
"""Scale of the robust loss in each round of bundle adjustment at one of these focal lengths [pixels]."""
COLUMNS = ["capture", "taken for", "start", "found", "median [deg]", "AUC_ATE [%]", "health says [deg]", "verdict"]
"""Keys of a row. "health says [deg]" and "verdict" are the rotation error and the rating that stage 1 reports."""
TITLES = {"taken for": "focal length", "health says [deg]": "estimated error [deg]", "verdict": "rating"}
"""Column titles that differ from the key of a row."""
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the captures")
    parser.add_argument("--only", nargs="+", default=[""], help="captures whose names contain one of these")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    stored = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"rows": [], "curves": []}
    rows, curves = stored["rows"], stored["curves"]
    for case in (*CASES, *WEAK_CASES):
        starts = [(factor, True) for factor in FACTORS[1:]]
        if case in CASES:
            starts = [(1.0, False), *((factor, assumed) for factor in FACTORS for assumed in (False, True))]
        measured = {(row["start"], row["taken for"] == "a guess") for row in rows if row["capture"] == case.name}
        starts = [start for start in starts if start not in measured]
        if not starts or not any(word in case.name for word in arguments.only):
            continue
        capture, truth = load(case, arguments.folder)
        matches = matching.match_pairs(matching.views_of(capture), neighbours(len(capture)), DRAFT.matcher)
        rows += [measure(case, capture, truth, matches, *start) for start in starts]
        if case in CASES and case.name not in {row["capture"] for row in curves}:
            curves.append(curve(case, capture, matches))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows, "curves": curves})
        arguments.out.with_suffix(".md").write_text(report(rows, curves))
        print(_score_table([row for row in rows if row["capture"] == case.name]), flush=True)


def measure(
    case: Case, capture: Capture, truth: Trajectory | None, matches: Sequence[Match], factor: float, assumed: bool
) -> Row:
    """A row: stage 1 with the true focal length times `factor`, which it refines if `assumed` and keeps otherwise."""
    zoomed = replace(capture, camera=capture.camera.zoomed(factor), focal_assumed=assumed)
    tracked = drive(stage, POSES, stage.gather(zoomed, matches), seed=0)
    scores = {} if truth is None else pose_scores(tracked.trajectory, truth)
    return {
        "capture": case.name,
        "taken for": "a guess" if assumed else "known",
        "start": factor,
        "found": round(float(tracked.camera.fx_fy_cx_cy[0] / capture.camera.fx_fy_cx_cy[0]), 3),
        "median [deg]": round(scores["rotation_median_degrees"], 2) if scores else "",
        "AUC_ATE [%]": round(scores["auc_percent"], 1) if scores else "",
        "health says [deg]": round(float(torch.rad2deg(torch.tensor(tracked.quality.uncertainty))), 2),
        "verdict": tracked.quality.rating,
    }


@torch.no_grad()
def curve(case: Case, capture: Capture, matches: Sequence[Match]) -> Row:
    """Loss per observation [pixels^2] after bundle adjustment of all frames at each focal length of `CURVE`."""
    inputs = stage.gather(capture, matches)
    state = stage.init(POSES, inputs, torch.Generator().manual_seed(0))
    for state.step in range(stage.length(POSES, inputs)):
        stage.step(POSES, inputs, state)
    row: Row = {"capture": case.name}
    poses = state.params
    for factor in CURVE:
        zoomed = stage.with_focal_length(inputs, torch.tensor(factor).log())
        t = poses.t / torch.tensor([factor, factor, 1.0])
        adjusted = stage.State(0, replace(poses, t=t), None, torch.Generator(), state.memory)
        for scale in LOSS_SCALES:
            adjusted.rng.manual_seed(0)
            adjusted.params, scalars = stage.adjust_all(POSES, zoomed, adjusted, scale)
        row[str(factor)] = round(float(scalars["loss"]), 4)
    return row


def report(rows: Sequence[Row], curves: Sequence[Row]) -> str:
    """The tables in Markdown."""
    return "\n".join(
        [
            "# Stage 1 with an unknown focal length\n",
            f"`{COMMAND}`; 72 frames of 128 x 128, the object at a distance of about four times its radius; "
            "captures and other columns as in [poses.md](poses.md), on a 2-core x86_64 CPU. Focal length: `known`, "
            "stage 1 does not change it, or `assumed`, stage 1 estimates it. Start and found: initial and final focal "
            "length, divided by the true one. Objects without texture (`bare_can`, `grey_sphere`) have no scores.\n",
            _score_table(rows),
            "## Loss over focal length\n",
            "Loss per observation [pixels^2] after bundle adjustment of all frames with a fixed focal length, starting "
            "from the poses that were estimated with the true one. Columns: focal length divided by the true one.\n",
            table(["capture", *map(str, CURVE)], curves),
        ]
    )


def _score_table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table; "a guess" is printed as "assumed"."""
    values = {"a guess": "assumed"}
    titled = [{TITLES.get(key, key): values.get(value, value) for key, value in row.items()} for row in rows]
    return table([TITLES.get(key, key) for key in COLUMNS], titled)


if __name__ == "__main__":
    main()
