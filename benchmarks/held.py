"""Masks, poses and assets of synthetic films in which a hand holds the object, against the truth.

`python -m benchmarks.held CAPTURE... [--until masks|poses|asset] [--draw FOLDER] [--runs FOLDER]` takes captures of
`tumble synth --film`, with `--hand` and without it (the twin), reads their film as `tumble run` does, with the box and
the focal length of `film.json`, and writes `benchmarks/held.json` and the table `benchmarks/held.md`. Truth is used for
the scores only. Masks are scored where the truth is certain: a pixel is object or hand if nine tenths of it are.
With `--until asset` poses are those of `tumble run`, and its asset is scored by `tumble evaluate`.
"""

import argparse
import json
import math
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import torch

import tumble
from benchmarks.kernels import machine
from benchmarks.poses import line, pose_scores
from tumble.bench import current_code
from tumble.engine import run as runs
from tumble.io import files
from tumble.poses import PoseResult, mask_refinement
from tumble.preprocess import FootageOptions, Survey, survey_footage
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Trajectory

COMMAND = "python -m benchmarks.held CAPTURE..."
CERTAIN = 0.9
"""Fraction of a pixel that is object, or hand, above which the truth counts as certain."""
DRAWN = 20
"""Frames per contact sheet."""
Row = dict[str, Any]
SCORES = {
    "iou_median": "mask IoU, median",
    "iou_worst_tenth": "worst tenth",
    "hand_percent": "hand in the mask [%]",
    "unknown_percent": "object unknown [%]",
    "survey_seconds": "masks [s]",
    "posed_percent": "posed [%]",
    "rotation_median_degrees": "rotation, median [deg]",
    "rotation_below_10_percent": "< 10 deg [%]",
    "claimed_degrees": "estimated [deg]",
    "verdict": "rating",
    "pose_seconds": "poses [s]",
    "albedo.psnr_fg_srgb": "albedo fg [dB]",
    "normal.mean_fg_degrees": "normal [deg]",
    "silhouette.iou": "shape, IoU",
    "code": "code",
}
"""Column titles by the key of a row."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--until", choices=["masks", "poses", "asset"], default="poses")
    parser.add_argument("--draw", type=Path, help="folder of the contact sheets of the masks")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the runs of --until asset")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.out.read_text())["rows"] if arguments.out.exists() else []
    for path in arguments.captures:
        row = measure(path, arguments.until, arguments.draw, arguments.runs / path.name)
        rows = [each for each in rows if each["name"] != row["name"]] + [row]
        print(line(["name", *SCORES], row), flush=True)
        files.write_json(arguments.out, {"command": COMMAND, "machine": machine(), "rows": rows})
        arguments.out.with_suffix(".md").write_text(report(rows))


def report(rows: list[Row]) -> str:
    """The table in Markdown."""
    titles = {"name": "film", **SCORES}
    lines = [line([*titles], titles), "|" + " --- |" * len(titles), *(line([*titles], row) for row in rows)]
    text = (
        "# Objects in a hand\n\n"
        f"`{COMMAND}`; films of 120 frames of 512 x 384 pixels with motion blur, noise, compression and drifting "
        "exposure, rendered by `tumble synth MESH --env adams_place_bridge_1k.hdr --hand --film --views 120 "
        "--resolution 256 --samples 16` with `--skin light "
        "--background clutter --seed 0` (box), `dark torso 1` "
        "(bottle), `medium wall 2` (can) and `light desk 3` (knight). The object turns 5 to 12 degrees from frame to "
        "frame. Known to the program: the box of `film.json` on the first frame, and the focal length. Overlap "
        '(IoU) leaves out unknown pixels; "hand in the mask" is the fraction of the mask\'s pixels, '
        '"object unknown" that of the true object\'s. Rotation errors are of the frames with a pose; rows without them '
        "were run with `--until masks`, rows with scores of the asset with `--until asset`. Rows of a twin are of the "
        "same object, motion, light and background without the hand. Time on one thread of a 2-core x86_64 CPU shared "
        "with other work.\n"
    )
    return text + "\n" + "\n".join(lines) + "\n"


def measure(path: Path, until: str, draw: Path | None, run: Path) -> Row:
    """A row of figures for a capture with a film."""
    film = json.loads((path / "film.json").read_text())
    options = FootageOptions(box=tuple(film["box"]), at=film["frame"], focal=film["focal"])
    started = time.perf_counter()
    survey = survey_footage(path / "film.mp4", options)
    row: Row = {"name": path.name, **mask_scores(survey, path), "survey_seconds": round(time.perf_counter() - started)}
    row["code"] = current_code()["commit"]
    if draw:
        draw.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(draw / f"{path.name}.png"), contact_sheet(survey, path)[..., ::-1])
    if until == "masks":
        return row
    return row | (poses(path, options) if until == "poses" else asset(path, options, run))


def poses(path: Path, options: FootageOptions) -> Row:
    """Scores of the poses of the capture made from the film."""
    with TemporaryDirectory() as folder:
        made = tumble.video_to_capture(path / "film.mp4", Path(folder) / "capture", options)
        capture = tumble.read_capture(made)
        started = time.perf_counter()
        result = tumble.estimate_poses(capture)
        seconds = round(time.perf_counter() - started)
        return {**scores_of_poses(path, made, result), "pose_seconds": seconds}


def asset(path: Path, options: FootageOptions, run: Path) -> Row:
    """Scores of the poses and of the asset of `tumble run`."""
    assert options.box is not None, "film.json has it"
    given = ["--box", *options.box, "--at", options.at, "--focal", options.focal]
    for words in (["run", path / "film.mp4", *given, "-o", run], ["evaluate", run, path]):
        subprocess.run([sys.executable, "-m", "tumble", *map(str, words)], check=True)
    made = run / runs.CAPTURE
    result, _ = mask_refinement.stored_result(run, tumble.read_capture(made))
    assert result is not None, "the run has estimated poses"
    scores = files.read_json(run / "report.json")["regions"]["shared"]
    return {
        **scores_of_poses(path, made, result),
        **{name: round(scores[name], 3) for name in SCORES if name in scores},
    }


def scores_of_poses(path: Path, capture: Path, result: PoseResult) -> Row:
    """Scores of poses of a capture that was made from the film."""
    numbers = [each["source_frame"] for each in files.read_json(capture / "ingest.json")["frames"]]
    truth = true_trajectory(path, numbers)
    kept = (~result.quality.lost).nonzero()[:, 0]
    scores = pose_scores(result.trajectory.select(kept), truth.select(kept)) if len(kept) > 2 else {}
    return {
        "frames": len(numbers),
        "posed_percent": round(100 * len(kept) / len(numbers)),
        **{name: round(value, 2) for name, value in scores.items()},
        "claimed_degrees": round(math.degrees(result.quality.uncertainty), 2),
        "verdict": result.quality.rating,
        "sentence": result.quality.sentence,
    }


def true_trajectory(path: Path, numbers: list[int]) -> Trajectory:
    """True poses of some frames of the film."""
    trajectory = tumble.read_capture(path).trajectory
    assert trajectory is not None, "the capture has poses"
    return trajectory.select(torch.tensor(numbers))


def mask_scores(survey: Survey, path: Path) -> dict[str, float]:
    """Scores of the masks over all frames; the band of unknown pixels along the silhouette counts as neither."""
    overlaps, hands, unknown = [], 0, []
    pixels = 0
    for k, i in enumerate(survey.numbers):
        labels = survey.masks.with_doubt(k)
        there, hand = (true_mask(path, kind, int(i), labels.shape) for kind in ("object", "hand"))
        inside, decided = labels == OBJECT, (labels == OBJECT) | (labels == BACKGROUND)
        certain = decided & ((there > CERTAIN) | (there < 1 - CERTAIN))
        union = certain & (inside | (there > CERTAIN))
        overlaps.append((certain & inside & (there > CERTAIN)).sum() / max(union.sum(), 1))
        hands += int((inside & (hand > CERTAIN)).sum())
        pixels += int(inside.sum())
        unknown.append((~decided & (there > CERTAIN)).sum() / max((there > CERTAIN).sum(), 1))
    return {
        "iou_median": round(float(np.median(overlaps)), 3),
        "iou_worst_tenth": round(float(np.quantile(overlaps, 0.1)), 3),
        "hand_percent": round(100 * hands / max(pixels, 1), 2),
        "unknown_percent": round(100 * float(np.mean(unknown)), 1),
    }


def true_mask(path: Path, kind: str, number: int, shape: tuple[int, ...]) -> np.ndarray:
    """Fraction of every pixel that shows the object or the hand."""
    mask = files.read_image(path / "truth" / f"film_{kind}_mask" / f"{number:04d}.png")[..., 0]
    return cv2.resize(mask.astype(np.float32) / 255, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def contact_sheet(survey: Survey, path: Path) -> np.ndarray:
    """Frames with the object green, unknown pixels red, and the true outline of the object white."""
    tiles = []
    for i in np.linspace(0, len(survey.images) - 1, DRAWN).round().astype(int):
        image, labels = survey.images[i].copy(), survey.masks.with_doubt(i)
        for value, colour in ((OBJECT, (0, 255, 0)), (UNKNOWN, (255, 0, 0))):
            where = labels == value
            image[where] = (0.6 * image[where] + 0.4 * np.array(colour)).astype(np.uint8)
        truth = (true_mask(path, "object", int(survey.numbers[i]), labels.shape) > 0.5).astype(np.uint8)
        outline, _ = cv2.findContours(truth, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        tiles.append(cv2.drawContours(image, outline, -1, (255, 255, 255), 1))
        cv2.putText(tiles[-1], f"{survey.numbers[i]}", (4, 14), 0, 0.5, (255, 255, 0), 1)
    return np.concatenate([np.concatenate(tiles[k : k + 5], 1) for k in range(0, DRAWN, 5)])


if __name__ == "__main__":
    main()
