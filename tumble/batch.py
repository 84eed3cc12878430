"""Many runs: the rows of a benchmark suite, and the captures of a batch, on this machine or on a Ray cluster."""

import dataclasses
import importlib.util
import resource
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tumble import __version__, actions, bench, pipeline
from tumble.bench import CaptureTask, Case, Outcome, SuiteRow, Workers
from tumble.engine import loop, run
from tumble.evaluation import PREDICTION, read_with_truth
from tumble.io import files, one_line, outputs, progress
from tumble.preprocess import FootageOptions
from tumble.recipes import METHODS, QUALITIES, SMOKE, Recipe
from tumble.rendering import usable_device
from tumble.scene import content_key

MARK = "bench.json"
"""File by which the folder of a benchmark is recognised."""
RUNS = "runs"
"""Folder of the runs in the folder of a benchmark."""
LOGS = "logs"
"""Folder of what the processes have printed."""
BATCH_MARK = "batch.json"
"""File by which the folder of a batch is recognised."""
BATCH_LOGS = ".logs"
"""As `LOGS`, in the folder of a batch: a name that no capture has."""
RECIPES = {"smoke": SMOKE, **QUALITIES}
"""Recipes by the name that a suite gives."""
MAXRSS_UNIT = 1 if sys.platform == "darwin" else 1024
"""Unit in which the operating system counts peak memory [bytes]."""


@dataclass(frozen=True)
class RowTask:
    """A case to be measured."""

    case: Case
    data: Path | None
    out: Path
    device: str
    glb: bool = False
    """Whether the exported GLB is scored as well."""

    @property
    def name(self) -> str:
        return self.case.name


@dataclass(frozen=True)
class RunTask:
    """A capture or footage to be reconstructed."""

    capture: Path
    out: Path
    recipe: Recipe
    options: FootageOptions
    poses: Literal["given", "estimate"]
    device: str

    @property
    def name(self) -> str:
        return self.out.name


# Suites ---------------------------------------------------------------------------------------------------------------


def make_captures(cases: Sequence[Case], out: Path, data: Path | None, workers: Workers) -> Iterable[Outcome]:
    """Render the captures of some cases that are missing; yields each with its folder.

    Raises:
        BadFile: `out` holds something else, or an object or light is missing.
    """
    bench.require_inputs(cases, data)
    _claim(out)
    tasks = [CaptureTask(case, data and data.absolute(), out.absolute()) for case in cases]
    distinct = list({task.name: task for task in tasks}.values())
    return progress.track(bench.execute(bench.make_capture, distinct, workers, out / LOGS), "captures", len(distinct))


def missing_rows(
    cases: Sequence[Case],
    out: Path,
    data: Path | None,
    *,
    device: str = "cpu",
    again: bool = False,
    glb: bool = False,
) -> list[RowTask]:
    """The cases without a row of the current code.

    Args:
        out: Folder of the benchmark.
        data: Folder with the objects and lights of the suite.
        again: Also those whose row says that they failed.
        glb: Also those whose row lacks the scores of the exported GLB; their runs, if still there, are not repeated.

    Raises:
        BadFile: An object or light is missing, or a row is damaged.
        ValueError: There is no such recipe or method.
    """
    bench.require_inputs(cases, data)
    tasks = []
    for case in cases:
        wanted = _empty_row(case)
        path = bench.row_file(out, wanted)
        found = bench.read_row(path) if path.is_file() else None
        # A method in a file of the user may have changed.
        lacks = found is not None and ((again and "error" in found) or (glb and not found.keys() & {"glb", "error"}))
        if found is None or found["recipe"] != wanted["recipe"] or lacks:
            # Machines of a cluster need whole paths.
            tasks.append(RowTask(case, data and data.absolute(), out.absolute(), device, glb))
    progress.LOG.info("%d of %d rows are there already", len(cases) - len(tasks), len(cases))
    return tasks


def run_rows(tasks: Sequence[RowTask], out: Path, workers: Workers) -> Iterable[SuiteRow]:
    """Measure rows and write them; yields each.

    Raises:
        BadFile: `out` holds something else.
        ValueError: This machine is to compute, and has no such device.
    """
    _check_devices({task.device for task in tasks}, workers)
    _claim(out)
    for outcome in progress.track(bench.execute(measure, tasks, workers, out / LOGS), "rows", len(tasks)):
        row, picture = outcome.result or (_empty_row(outcome.task.case), b"")
        if outcome.error:
            row["error"] = outcome.error
        path = bench.row_file(out, row)
        if outcome.error and path.is_file() and "error" not in bench.read_row(path):
            continue  # another command has measured it meanwhile
        if picture:
            files.write_atomically(path.with_suffix(".webp"), lambda partial, data=picture: partial.write_bytes(data))
        files.write_json(path, row)
        yield row


def summary_line(row: SuiteRow) -> str:
    """A row in one line: its name, and its main scores or why there are none."""
    if "error" in row:
        return one_line(f"{row['name']}: {row['error']}")
    scores = row.get("regions", {}).get("shared", {})
    found = [
        f"{part} {scores[key]:.1f} dB" for part in ("albedo", "relit") if (key := f"{part}.psnr_fg_srgb") in scores
    ]
    error = row.get("poses", {}).get("poses.rotation_median_degrees")
    if row["labels"]["poses"] == "estimate" and error is not None:
        found.append(f"poses {error:.2f} degrees")
    return f"{row['name']}: {', '.join(found)}, {row.get('seconds', {}).get('run', 0):.0f} s"


def recipe_of(case: Case) -> Recipe:
    """The recipe of a case.

    Raises:
        ValueError: There is no such recipe or method.
    """
    if case.recipe not in RECIPES:
        raise ValueError(f"there is no recipe {case.recipe!r}; choose among {', '.join(RECIPES)}")
    return method_of(case.method)(dataclasses.replace(RECIPES[case.recipe], seed=case.seed))


def method_of(name: str) -> Callable[[Recipe], Recipe]:
    """A method by its name in `METHODS`, or the function `method` of a Python file, which may be a stage itself.

    A file is executed once per process. Its module is named after its whole path, so that files of the same name in
    different folders are different methods.

    Raises:
        ValueError: There is neither.
    """
    if name in METHODS:
        return METHODS[name]
    path = Path(name)
    module = f"method_{path.stem}_{loop.fingerprint(path.resolve())[:16]}"
    if path.suffix != ".py" or not path.is_file():
        raise ValueError(f"there is no method {name!r}; choose among {', '.join(METHODS)}, or give a Python file")
    if module not in sys.modules:
        spec = importlib.util.spec_from_file_location(module, path)
        assert spec is not None and spec.loader is not None, "a Python file"  # noqa: PT018
        # A stage is found by the name of its module, which has to be listed for that.
        sys.modules[module] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[module])
    if not hasattr(sys.modules[module], "method"):
        raise ValueError(f"{name} has no function `method` that takes a recipe and returns one")
    return sys.modules[module].method


def measure(task: RowTask) -> tuple[SuiteRow, bytes]:
    """Render the capture of a case if it is missing, reconstruct it, and score the result; returns row and picture."""
    case, row, device = task.case, _empty_row(task.case), usable_device(task.device)
    row["machine"] = bench.machine_class(device)
    capture = bench.make_capture(CaptureTask(case, task.data, task.out))
    where = task.out / RUNS / f"{bench.row_file(task.out, row).stem}-{row['recipe'][:8]}"
    pipeline.reconstruct(capture, where, recipe_of(case), poses=case.poses, device=device)
    seconds = sum({r["name"]: r["seconds"] for r in run.log_records(where) if r.get("event") == "done"}.values())
    started = time.perf_counter()
    report = actions.evaluate_run(where, capture, device=task.device)
    known = read_with_truth(capture)
    row["capture"] = content_key(known.capture)
    row["seconds"] = bench.rounded({"run": seconds, "score": time.perf_counter() - started})
    row["peak_memory_MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS_UNIT // 2**20
    row["regions"] = {region: bench.rounded(scores) for region, scores in report["regions"].items()}
    row["light"], row["poses"] = bench.rounded(report["light"]), bench.rounded(report["poses"])
    if report["published"]:
        row["published"] = bench.rounded(report["published"])
    row["albedo_scale"], row["notes"] = report["albedo_scale"], report["notes"]
    if known.truth.light is not None:
        row["directionality"] = round(known.truth.light.directionality(), 3)
    if task.glb:
        glb = actions.export_run(where, None, "web", None, device=task.device) / "asset.glb"
        row["glb"] = bench.rounded(actions.evaluate_glb(where, glb, capture)["regions"]["shared"])
    return row, bench.picture_of(capture, where / PREDICTION, report)


def _empty_row(case: Case) -> SuiteRow:
    recipe = recipe_of(case)
    source = Path(case.method).read_text("utf-8") if case.method.endswith(".py") else ""
    if case.poses == "given":
        recipe = dataclasses.replace(recipe, track=None, matcher="")  # stage 1 does not run
    return bench.row_of(case, bench.current_code(), recipe=loop.fingerprint(recipe, source))


def _check_devices(names: Iterable[str], workers: Workers) -> None:
    """Raise `ValueError` if this machine is to compute and lacks a device; a cluster's machines may have others."""
    for name in names:
        if not workers.address:
            usable_device(name)


def _claim(out: Path) -> None:
    outputs.claim_folder(out, MARK, fix="choose another folder with -o")
    if not (out / MARK).exists():
        files.write_json(out / MARK, bench.current_code())


def report_suite(name: str, out: Path, **selection: Any) -> Path:
    """Write the JSON document, the Markdown tables, the plots and the page of a suite; returns the path of the page.

    Args:
        name: A suite, or the JSON document of an earlier report, from which the others are written again.
        out: Folder of the benchmark.
        selection: See `bench.cases_of`.

    Raises:
        BadFile: There is no such suite, or a row is damaged.
        ValueError: There is no such recipe or method.
    """
    if name.endswith(".json"):
        results = bench.read_results(Path(name))
    else:
        suite = bench.read_suite(name)
        cases, rows = bench.cases_of(suite, **selection), bench.read_rows(out)
        recipes = {case.key: _empty_row(case)["recipe"] for case in cases}
        results = bench.results_of(Path(name).stem, suite, cases, rows, bench.current_code(), recipes=recipes)
    _claim(out)
    texts = {".md": bench.markdown_of(results), ".html": bench.page_of(results, out)}
    texts = {f"{results['name']}{suffix}": text for suffix, text in texts.items()}
    texts |= {plot.file: plot.svg for plot in bench.line_plots(results)}
    files.write_json(out / f"{results['name']}.json", results)
    for file, text in texts.items():
        files.write_atomically(out / file, lambda partial, text=text: partial.write_text(text, "utf-8"))
    return out / f"{results['name']}.html"


# Batches --------------------------------------------------------------------------------------------------------------


def run_batch(
    captures: Sequence[Path],
    out: Path,
    recipe: Recipe,
    options: FootageOptions,
    workers: Workers,
    *,
    poses: Literal["given", "estimate"] = "given",
    device: str = "cpu",
) -> Iterable[Outcome[Any, Path]]:
    """Reconstruct captures or footage, each in `out/<its name>`; yields each with the path of its report.

    Raises:
        BadFile: `out` holds something else than runs.
        ValueError: There are none, two of them have the same name, or there is no such device.
    """
    if not captures:
        raise ValueError("no captures are given: name videos, folders of images, or capture folders")
    _check_devices({device}, workers)
    paths = [path.absolute() for path in captures]
    names = [path.stem if path.is_file() else path.name for path in paths]
    if repeated := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"several captures have the name {min(repeated)}: rename them, or run them one by one")
    outputs.claim_folder(out, BATCH_MARK, overwrite=_holds_runs_only(out), fix="choose another folder with -o")
    files.write_json(out / BATCH_MARK, {"tumble": __version__})
    folders = [out.absolute() / name for name in names]
    tasks = [RunTask(*each, recipe, options, poses, device) for each in zip(paths, folders, strict=True)]
    return progress.track(bench.execute(reconstruct_one, tasks, workers, out / BATCH_LOGS), "captures", len(tasks))


def _holds_runs_only(out: Path) -> bool:
    """Whether a folder is a batch of earlier versions, which had no mark: runs, and their logs in `LOGS`."""
    content = out.iterdir() if out.is_dir() else ()
    return all(path.name == LOGS or any((path / x).exists() for x in (run.RECIPE, run.CAPTURE)) for path in content)


def reconstruct_one(task: RunTask) -> Path:
    """One run of a batch; returns the path of its report."""
    how: dict[str, Any] = {"poses": task.poses, "device": task.device}
    return actions.run_capture(task.capture, task.out, task.recipe, task.options, **how)
