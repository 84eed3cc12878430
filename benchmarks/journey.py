"""End-to-end benchmark: a video and a box as input, the asset as output, scored against the ground truth of the video.

`python -m benchmarks.journey FOLDER` renders captures without poses, 120 frames of 256 x 256 (kept in FOLDER), of three
objects on which constants were chosen, or, with `--only`, of those of the suite paper-table1. It runs `tumble check`
and `tumble run` on each `clip.mp4` with a box around the object in its first frame, exports a GLB, scores both with
`tumble evaluate`, and writes `benchmarks/journey.json` and the table `benchmarks/journey.md`. Existing rows are kept.
Time and memory are those of the processes. `--smoke` uses tiny captures, to test this program.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kernels import machine
from benchmarks.pose_captures import DATA
from tumble import bench
from tumble.actions import GLB_SCORES
from tumble.datasets import folder
from tumble.engine import run as runs
from tumble.io import files
from tumble.poses import mask_refinement
from tumble.preprocess import FootageOptions
from tumble.scene import OBJECT
from tumble.synthetic import SynthOptions, render_capture

TUNE = dict.fromkeys(("ycb_006_mustard_bottle", "ycb_003_cracker_box", "chess_Knight"), "immenstadter_horn_1k.hdr")
"""Objects on which constants of the method were chosen, with the light map of their videos."""
SUITE = bench.read_suite("paper-table1")
REPORT = {Path(entry["model"]).stem: str(entry["env"]) for entry in SUITE.object}
"""Objects on which no constant was chosen, under other light maps; the suite says which of them design looked at."""
OBJECTS = TUNE | REPORT
RELIGHT = dict.fromkeys(TUNE, ("forest_slope_1k.hdr", "studio_small_03_1k.hdr")) | dict.fromkeys(
    REPORT, tuple(SUITE.capture["relight"])
)
"""Light maps of the relit ground truth."""
FOV = 30.0
"""Field of view of the videos, given to `tumble run` [degrees]."""
BOX_MARGIN = 4
"""Margin between the object and the box around it [pixels]."""
COMMAND = "python -m benchmarks.journey FOLDER"
COLUMNS = {
    "albedo.psnr_fg_srgb": "albedo fg [dB]",
    "albedo.psnr_full_srgb": "albedo full [dB]",
    "albedo.psnr_fg_srgb_unscaled": "albedo fg, unscaled [dB]",
    "relit.psnr_fg_srgb": "relit fg [dB]",
    "relit.psnr_full_srgb": "relit full [dB]",
    "normal.mean_fg_degrees": "normal [deg]",
    "roughness.mae_fg": "roughness MAE",
    "silhouette.iou": "IoU",
}
"""Titles of the score columns, by the score."""
GLB_COLUMNS = {
    "albedo.psnr_fg_srgb": "GLB: albedo fg [dB]",
    "relit.psnr_fg_srgb": "GLB: relit fg [dB]",
    "normal.mean_fg_degrees": "GLB: normal [deg]",
}
"""Titles of the columns of the exported GLB, by the score."""
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of captures and runs")
    parser.add_argument("--only", nargs="+", default=list(TUNE), choices=list(OBJECTS), metavar="OBJECT")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for model in arguments.only:
        if model in [row["object"] for row in rows]:
            continue
        capture = rendered(model, arguments.folder / "captures", arguments.smoke)
        rows.append(measure(model, capture, arguments.folder / "runs" / model, arguments.quality))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
        arguments.out.with_suffix(".md").write_text(report(rows))
        print(json.dumps(rows[-1], indent=1), flush=True)


def rendered(model: str, root: Path, smoke: bool) -> Path:
    """A capture without poses and its video, rendered if it does not exist."""
    options = SynthOptions(
        env=hdri(OBJECTS[model]),
        relight=tuple(map(hdri, RELIGHT[model])),
        views=48 if smoke else 120,
        resolution=128 if smoke else 256,
        samples=16 if smoke else 256,
        truth_samples=16 if smoke else 400,
        eval_shared=2 if smoke else 8,
        eval_sphere=1 if smoke else 4,
        fov=FOV,
        pose_free=True,
        video=True,
    )
    return render_capture(DATA / "meshes" / f"{model}.glb", root / model, options)


def hdri(name: str) -> str:
    """Path of the file of a light map."""
    return str(DATA / "hdri" / name)


def measure(model: str, capture: Path, run: Path, quality: str) -> Row:
    """A row: results, time and memory of the four commands."""
    shutil.rmtree(run, ignore_errors=True)
    clip = [str(capture / "clip.mp4"), "--fov", f"{FOV:g}", "--box", *map(str, box(capture))]
    size = folder.load(capture).images.shape
    code = bench.current_code()["commit"]
    row: Row = {
        "object": model,
        "code": code,
        "light": OBJECTS[model].removesuffix("_1k.hdr"),
        "frames": size[0],
        "side": size[1],
        "quality": quality,
    }
    check = tumble("check", *clip, "-o", str(run) + "-check")
    row |= {"check": "GO" if check["exit"] == 0 else "NO-GO", "check_seconds": check["seconds"]}
    reconstruction = tumble("run", *clip, "-o", str(run), "--quality", quality)
    row |= {
        "run_exit": reconstruction["exit"],
        "run_seconds": reconstruction["seconds"],
        "run_memory_MiB": reconstruction["memory_MiB"],
    }
    if (run / runs.CAPTURE).exists():  # not if the clip was refused
        tracked, _ = mask_refinement.stored_result(run, folder.load(run / runs.CAPTURE))
        if tracked is not None:
            row |= {"verdict": tracked.quality.rating, "verdict_sentence": tracked.quality.sentence}
    if reconstruction["exit"] != 0:
        row["said"] = reconstruction["said"].replace(str(run), "RUN")
    else:
        export = tumble("export", str(run), "--preset", "web")
        evaluation = tumble("evaluate", str(run), str(capture), "--glb", str(run / "export" / "web" / "asset.glb"))
        row |= {
            "export_seconds": export["seconds"],
            "score_exit": evaluation["exit"],
            "score_seconds": evaluation["seconds"],
        }
        row |= {"kept": len(files.read_json(run / runs.POSES)), "poses": {}}
        if evaluation["exit"] == 0:
            scores = files.read_json(run / "report.json")
            row |= {**scores["regions"], "poses": scores["poses"]}
            row["glb"] = files.read_json(run / GLB_SCORES / "report.json")["regions"]["shared"]
    return row


def box(capture: Path) -> list[int]:
    """A box around the object in the first frame, as a user would draw it: left, top, width, height [pixels]."""
    mask = folder.load(capture).masks[FootageOptions().at].numpy() == OBJECT
    rows, columns = np.nonzero(mask)
    low = max(int(columns.min()) - BOX_MARGIN, 0), max(int(rows.min()) - BOX_MARGIN, 0)
    high = (
        min(int(columns.max()) + 1 + BOX_MARGIN, mask.shape[1]),
        min(int(rows.max()) + 1 + BOX_MARGIN, mask.shape[0]),
    )
    return [*low, high[0] - low[0], high[1] - low[1]]


def tumble(*words: str) -> dict[str, Any]:
    """Run a command in a process of its own; exit code, seconds, peak memory, and its last line on stderr."""
    started = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "tumble", *words], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None, "stderr is a pipe"
    lines = [line.strip() for line in process.stderr if line.strip()]
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds, memory = round(time.perf_counter() - started, 1), usage.ru_maxrss // 1024
    return {"exit": process.returncode, "seconds": seconds, "memory_MiB": memory, "said": (lines or [""])[-1]}


def report(rows: list[Row]) -> str:
    """The rows as a table in Markdown: scores of the shared views, and of the poses of all frames."""
    titles = [
        "object",
        "light",
        "check",
        *COLUMNS.values(),
        *GLB_COLUMNS.values(),
        "rotation, median [deg]",
        "position [% of distance]",
        "frames",
        "pose rating",
    ]
    titles += ["run [min]", "score [min]", "memory [GiB]", "code"]
    first = rows[0]
    lines = [
        f"# From a video to an asset: {first['frames']} frames of {first['side']} x {first['side']} pixels",
        "",
        f"`{COMMAND}`: the input is `clip.mp4` and a box around the object in its first frame; the videos are "
        "rendered from the meshes and light maps in `$TUMBLE_BENCH_DATA` unless FOLDER has them. The focal length is "
        "given (`--fov`). One thread per run, on a 2-core x86_64 CPU shared with other work. Scores over the "
        "evaluation views of region shared, PSNR of sRGB values ([metrics](../docs/metrics.md)). Position: root mean "
        "square error divided by the mean camera distance. Frames: number of frames with a pose. Unscaled: without "
        "the factor per channel between albedo and truth. GLB: the file of `tumble export --preset web`, path traced "
        "by Mitsuba; its normals are those of the mesh.",
    ]
    for title, objects in (("Objects on which constants were chosen", TUNE), ("Other objects", REPORT)):
        if of_these := [row for row in rows if row["object"] in objects]:
            lines += ["", f"## {title}", "", *table(titles, of_these)]
    errors = [f"- {row['object']}: {row['said']}" for row in rows if "said" in row]
    return "\n".join([*lines, *([""] if errors else []), *errors, ""])


def table(titles: list[str], rows: list[Row]) -> list[str]:
    """Lines of a table, and a last one with the means of the scores."""
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    lines += [f"| {' | '.join(cells(row))} |" for row in rows]
    complete = [row for row in rows if "shared" in row]
    if complete:
        means = [mean(row["shared"].get(key) for row in complete) for key in COLUMNS]
        means += [mean(row.get("glb", {}).get(key) for row in complete) for key in GLB_COLUMNS]
        lines.append(f"| mean of {len(complete)} | | | {' | '.join(means)} |" + " |" * (len(titles) - 3 - len(means)))
    return lines


def mean(values: Iterable[float | None]) -> str:
    """The mean of the values that are known, as text."""
    known = [value for value in values if value is not None]
    return f"{statistics.fmean(known):.3g}" if known else "-"


def cells(row: Row) -> list[str]:
    """The cells of a line of the table; a dash for a missing value."""

    def text(value: Any, digits: str = ".1f", factor: float = 1.0) -> str:
        return "-" if value is None else f"{factor * value:{digits}}"

    shared, poses = row.get("shared", {}), row.get("poses", {})
    digits = {"silhouette.iou": ".3f", "roughness.mae_fg": ".3f"}
    scores = [text(shared.get(key), digits.get(key, ".1f")) for key in COLUMNS]
    scores += [text(row.get("glb", {}).get(key)) for key in GLB_COLUMNS]
    # The tolerance of the AUC is a tenth of the camera's distance.
    position = poses["poses.ate"] / poses["poses.tolerance"] if poses.get("poses.ate") is not None else None
    pose_errors = [text(poses.get("poses.rotation_median_degrees"), ".2f"), text(position, ".2f", 10)]
    minutes = [text(row.get(key), ".1f", 1 / 60) for key in ("run_seconds", "score_seconds")]
    result = [str(row.get("kept", "-")), row.get("verdict", f"exit {row['run_exit']}")]
    return [
        row["object"],
        row["light"],
        row["check"],
        *scores,
        *pose_errors,
        *result,
        *minutes,
        text(row["run_memory_MiB"], ".1f", 1 / 1024),
        row.get("code", "-"),
    ]


if __name__ == "__main__":
    main()
