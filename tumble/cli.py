"""The command line: plain functions, one per command; `tumble --help` is made from what is written here."""

import os
import sys

# Torch's own threads otherwise spin while they wait, on the cores that the kernels need. Read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

Folder = Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
OptionalFolder = Annotated[Path | None, arg(aliases=["-o"], metavar="DIR")]


def doctor() -> None:
    """Say what this machine offers, and the exact fix for what is missing."""
    from rich.console import Console

    from tumble.doctor import findings

    console = Console(highlight=False)
    for finding in findings():
        mark = "[yellow]![/]" if finding.fix else "[green]+[/]"
        console.print(f" {mark} [bold]{finding.subject:13}[/] {finding.state}", soft_wrap=True)
        if finding.fix:
            console.print(f"   {'':13} -> {finding.fix}", markup=False, soft_wrap=True)


def main() -> None:
    """Entry point of the `tumble` command; an error ends with one line and exit code 1, Ctrl-C with 130."""
    from tumble import __version__

    commands = {
        "doctor": doctor,
        "synth": _synth(),
        "run": run,
        "relight": relight,
        "evaluate": evaluate,
        "demo": demo,
    }
    if sys.argv[1:] in (["--version"], ["version"]):
        print(f"tumble {__version__}")
        return
    try:
        about = "From one video of an object turned in the hand to its motion, shape, material and light."
        tyro.extras.subcommand_cli_from_dict(commands, prog="tumble", description=about)
    except KeyboardInterrupt:
        print(
            "tumble: interrupted; what is finished is kept, the same command goes on from there",
            file=sys.stderr,
        )
        raise SystemExit(130) from None
    except (ValueError, OSError, ModuleNotFoundError) as error:
        if os.environ.get("TUMBLE_DEBUG"):
            raise
        print(f"tumble: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def _synth():
    from tumble.synthesize import Options, sweep, synthesize

    def synth(
        model: Positional[Path],
        /,
        options: Annotated[Options, arg(name="")],
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
        made = sweep(model, out, options, roughness_sweep) if roughness_sweep else [synthesize(model, out, options)]
        for folder in made:
            print(folder)

    return synth


def run(
    capture: Positional[Path], /, out: Folder, quality: Literal["draft", "standard", "paper"] = "draft", seed: int = 0
) -> None:
    """Reconstruct a capture with known poses: geometry, albedo, roughness and light.

    Args:
        capture: The capture folder (docs/format.md). Its truth is never read.
        out: The run directory; the same command goes on where an interrupted one stopped.
        quality: draft: two CPU cores, minutes; standard: one GPU, minutes; paper: the published numbers, hours.
        seed: Of every random draw.
    """
    from dataclasses import replace

    from tumble.recipes import QUALITIES
    from tumble.reconstruct import ASSET, reconstruct

    reconstruct(capture, out, replace(QUALITIES[quality], seed=seed))
    print(out / ASSET)


def relight(run: Positional[Path], /, env: Path, out: OptionalFolder = None, fast: bool = False) -> None:
    """Show a reconstructed object under another light, from where the camera saw it.

    Args:
        run: The run directory.
        env: The light, a lat-long .hdr or .exr (+y up in the object's frame).
        out: Where the pictures go; RUN/relit/<name of the light> when left out.
        fast: Prefiltered light without shadows, instead of rays.
    """
    from tumble.reconstruct import relight_run

    where = out or run / "relit" / env.stem
    relight_run(run, env, where, fast=fast)
    print(where)


def evaluate(prediction: Positional[Path], capture: Positional[Path], /, out: OptionalFolder = None) -> None:
    """Score a prediction folder, or a run, against a capture with truth: report.json and a picture sheet.

    Args:
        prediction: The prediction folder (docs/prediction.md), or a run directory: its prediction is rendered first.
        capture: The capture folder (docs/format.md).
        out: Where report.json and sheet.png go; the prediction folder when left out.
    """
    from rich.console import Console
    from rich.table import Table

    from tumble import evaluate as evaluation
    from tumble.reconstruct import ASSET, predict_run

    where = out or prediction
    folder = predict_run(prediction, capture) if (prediction / ASSET).is_file() else prediction
    report = evaluation.run(folder, capture, where)
    table = Table(title=f"{report['prediction']} on {report['capture']['name']}", title_justify="left")
    regions = report["regions"]
    for heading in ("metric", *regions):
        table.add_column(heading, justify="left" if heading == "metric" else "right")
    for key in dict.fromkeys(key for scores in regions.values() for key in scores):
        table.add_row(key, *(_shown(scores.get(key)) for scores in regions.values()))
    for key, value in {**report["light"], **report["poses"]}.items():
        if value is None or isinstance(value, int | float):
            table.add_row(key, _shown(value))
    console = Console()
    console.print(table)
    for note in report["notes"]:
        console.print(f"note: {note}", markup=False, highlight=False)
    print(where / "report.json")


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def demo(out: Folder = Path("runs/demo")) -> None:
    """Show the bundled clip: its contact sheet and its truth.

    Args:
        out: Where the pictures and report.html go.
    """
    from tumble.demo import run

    print(run(out))
