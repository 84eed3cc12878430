"""The journey of a user with a film: one clip and one box in, an asset out, scored against the truth of the clip.

`python -m benchmarks.journey FOLDER` makes pose-free captures of three objects, 120 frames of 256 x 256 (kept in
FOLDER), runs `tumble check` and `tumble run` on their `clip.mp4` alone with a box around the object on its first frame,
scores the run with `tumble evaluate`, and writes `benchmarks/journey.json` and the table `benchmarks/journey.md`. Rows
that are there are kept. Time and memory are those of the processes. `--smoke` makes tiny captures, to try this file.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kernels import machine
from benchmarks.pose_captures import DATA
from tumble.datasets import folder
from tumble.engine import run as runs
from tumble.io import files
from tumble.poses import PoseResult
from tumble.preprocess import FootageOptions
from tumble.scene import OBJECT
from tumble.synthetic import SynthOptions, render_capture

OBJECTS = ("ycb_006_mustard_bottle", "ycb_003_cracker_box", "chess_Knight")
LIGHT, OTHERS = "immenstadter_horn", ("forest_slope", "studio_small_03")
FOV = 30.0
"""Of the films [degrees]; a user would know it, or live with a guess."""
ROOM = 4
"""Between the object and the box that is drawn around it [pixels]."""
COMMAND = "python -m benchmarks.journey FOLDER"
COLUMNS = {
    "albedo.psnr_fg_srgb": "albedo fg [dB]",
    "albedo.psnr_full_srgb": "albedo full [dB]",
    "relit.psnr_fg_srgb": "relit fg [dB]",
    "relit.psnr_full_srgb": "relit full [dB]",
    "normal.mean_fg_degrees": "normal [deg]",
    "silhouette.iou": "IoU",
}
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of captures and runs")
    parser.add_argument("--only", nargs="+", default=OBJECTS, choices=OBJECTS)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for model in arguments.only:
        if model in [row["object"] for row in rows]:
            continue
        capture = filmed(model, arguments.folder / "captures", arguments.smoke)
        rows.append(measure(model, capture, arguments.folder / "runs" / model, arguments.quality))
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
        arguments.out.with_suffix(".md").write_text(report(rows))
        print(json.dumps(rows[-1], indent=1), flush=True)


def filmed(model: str, root: Path, smoke: bool) -> Path:
    """A pose-free capture with its clip; rendered where it is not there yet."""
    options = SynthOptions(
        env=hdri(LIGHT),
        relight=tuple(map(hdri, OTHERS)),
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
    return str(DATA / "hdri" / f"{name}_1k.hdr")


def measure(model: str, capture: Path, run: Path, quality: str) -> Row:
    """The three commands, what they took, and what they said."""
    shutil.rmtree(run, ignore_errors=True)
    clip = [str(capture / "clip.mp4"), "--fov", f"{FOV:g}", "--box", *map(str, box(capture))]
    size = folder.load(capture).images.shape
    row: Row = {"object": model, "light": LIGHT, "frames": size[0], "side": size[1], "quality": quality}
    checked = tumble("check", *clip, "-o", str(run) + "-check")
    row |= {"check": "GO" if checked["exit"] == 0 else "NO-GO", "check_seconds": checked["seconds"]}
    made = tumble("run", *clip, "-o", str(run), "--quality", quality)
    row |= {"run_exit": made["exit"], "run_seconds": made["seconds"], "run_memory_MiB": made["memory_MiB"]}
    tracked = runs.output(run, runs.TRACK, PoseResult)
    if tracked is not None:
        row |= {"verdict": tracked.quality.verdict, "verdict_sentence": tracked.quality.sentence}
    if made["exit"] != 0:
        row["said"] = made["said"].replace(str(run), "RUN")
    else:
        scored = tumble("evaluate", str(run), str(capture))
        row |= {"score_exit": scored["exit"], "score_seconds": scored["seconds"]}
        found = files.read_json(run / "report.json") if scored["exit"] == 0 else {"regions": {}, "poses": {}}
        row |= {"kept": len(files.read_json(run / runs.POSES)), **found["regions"], "poses": found["poses"]}
    return row


def box(capture: Path) -> list[int]:
    """What a person would draw on the first frame: left, top, width, height."""
    shown = folder.load(capture).masks[FootageOptions().at].numpy() == OBJECT
    rows, columns = np.nonzero(shown)
    low = max(int(columns.min()) - ROOM, 0), max(int(rows.min()) - ROOM, 0)
    high = min(int(columns.max()) + 1 + ROOM, shown.shape[1]), min(int(rows.max()) + 1 + ROOM, shown.shape[0])
    return [*low, high[0] - low[0], high[1] - low[1]]


def tumble(*words: str) -> dict[str, Any]:
    """A command in a process of its own: exit code, seconds, the most memory it held, and its last complaint."""
    begun = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "tumble", *words], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None, "a pipe"
    lines = [line.strip() for line in process.stderr if line.startswith("tumble: ")]
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds, memory = round(time.perf_counter() - begun, 1), used.ru_maxrss // 1024
    return {"exit": process.returncode, "seconds": seconds, "memory_MiB": memory, "said": (lines or [""])[-1]}


def report(rows: list[Row]) -> str:
    """The rows as a table in Markdown: shared views, and the poses of all frames."""
    heads = [
        "object",
        "check",
        *COLUMNS.values(),
        "rotation, median [deg]",
        "position [% of distance]",
        "frames",
        "poses",
    ]
    heads += ["run [min]", "score [min]", "memory [GiB]"]
    first = rows[0]
    lines = [
        f"# From a clip to an asset: {first['frames']} frames of {first['side']} x {first['side']} pixels",
        "",
        f"`{COMMAND}`: from `clip.mp4` and one box; films are made from the meshes and light maps in "
        "`../shared/data` where FOLDER lacks them. The focal length is given (`--fov`). One thread per run, on a "
        "2-core x86_64 CPU that did other work. Views of region shared, PSNR of sRGB values.",
        "",
        f"| {' | '.join(heads)} |",
        "|" + "---|" * len(heads),
    ]
    lines += [f"| {' | '.join(cells(row))} |" for row in rows]
    done = [row for row in rows if "shared" in row]
    if done:
        means = [f"{statistics.fmean(row['shared'][key] for row in done):.3g}" for key in COLUMNS]
        lines.append(f"| mean of {len(done)} | | {' | '.join(means)} |" + " |" * (len(heads) - 2 - len(means)))
    failed = [f"- {row['object']}: {row['said']}" for row in rows if "said" in row]
    return "\n".join([*lines, *([""] if failed else []), *failed, ""])


def cells(row: Row) -> list[str]:
    """One line of the table; a dash for what is not known."""

    def shown(value: Any, digits: str = ".1f", share: float = 1.0) -> str:
        return "-" if value is None else f"{share * value:{digits}}"

    shared, poses = row.get("shared", {}), row.get("poses", {})
    digits = {"silhouette.iou": ".3f"}
    scores = [shown(shared.get(key), digits.get(key, ".1f")) for key in COLUMNS]
    # The tolerance of AUC is a tenth of the camera's distance.
    off = poses["poses.ate"] / poses["poses.tolerance"] if poses.get("poses.ate") is not None else None
    found = [shown(poses.get("poses.rotation_median_degrees"), ".2f"), shown(off, ".2f", 10)]
    minutes = [shown(row.get(key), ".1f", 1 / 60) for key in ("run_seconds", "score_seconds")]
    about = [str(row.get("kept", "-")), row.get("verdict", f"exit {row['run_exit']}")]
    return [
        row["object"],
        row["check"],
        *scores,
        *found,
        *about,
        *minutes,
        shown(row["run_memory_MiB"], ".1f", 1 / 1024),
    ]


if __name__ == "__main__":
    main()
