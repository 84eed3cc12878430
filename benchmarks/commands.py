"""Time of whole commands as a user waits for them, with stages 1 to 3, and against another checkout.

`python -m benchmarks.commands CAPTURE [--large CAPTURE] [--against CHECKOUT]` runs each command as a process of its
own, `--repeats` times, in this checkout and the other one in turn, and writes `benchmarks/commands.json` and the table
`benchmarks/commands.md`. Captures need known poses and ground truth. A checkout's commands work on its own run. With
`--only`, rows that are not measured keep their figures.

Stages 2 and 3: as the log of `tumble run` gives them. Stage 1: as the log of `tumble run --poses estimate` gives it;
and from the start of the process to that of stage 2, at which the process is stopped.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.kernels import machine
from tumble.io import files

HERE = Path(__file__).parents[1]
COMMAND = "python -m benchmarks.commands CAPTURE [--large CAPTURE] [--against CHECKOUT]"
ROWS = {
    "run": "`tumble run`, known poses, with report",
    "refine": "stage 2 of it",
    "decompose": "stage 3 of it",
    "export web": "`tumble export --preset web`",
    "export film": "`tumble export --preset film`",
    "evaluate": "`tumble evaluate`",
    "track": "stage 1",
    "poses": "`tumble run --poses estimate` up to stage 2",
    "demo": "`tumble demo`",
    "large": "`tumble run` of the large capture",
}
"""What each row times."""
PARTS = {"refine": "run", "decompose": "run", "track": "poses"}
"""Rows that are read from the log of another row's command."""
POLL = 0.05
"""Time between two looks at a log [s]."""
Times = dict[str, dict[str, float]]
"""Wall-clock and processor time by row [s]."""


class Failed(Exception):
    """A command failed; the message holds the end of its output."""


@dataclass(frozen=True)
class Checkout:
    """A version of the code, and its folder for runs."""

    code: Path
    work: Path

    def command(self, *words: object, until: Callable[[], bool] | None = None) -> dict[str, float]:
        """Time of a command [s]; it is stopped as soon as a condition holds.

        Raises:
            Failed: The command failed.
        """
        self.work.mkdir(parents=True, exist_ok=True)
        # Compiled modules are kept, as those of an installed package are.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        environment |= {"PYTHONPATH": str(self.code), "PYTHONPYCACHEPREFIX": str(self.work.parent / "compiled")}
        log = self.work / "output.txt"
        with log.open("wb") as output:
            start = time.perf_counter()
            arguments = [sys.executable, "-m", "tumble", *map(str, words)]
            process = subprocess.Popen(arguments, cwd=self.work, env=environment, stdout=output, stderr=output)
            stopped = until is not None and _stop_when(process, until)
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            seconds = time.perf_counter() - start
        if process.returncode and not stopped:
            last = log.read_text(errors="replace").strip().splitlines()[-1:]
            raise Failed(f"tumble {words[0]}: exit code {process.returncode}: {' '.join(last)[:300]}")
        return {"wall": round(seconds, 2), "cpu": round(used.ru_utime + used.ru_stime, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, help="capture with known poses and ground truth")
    parser.add_argument("--large", type=Path, help="capture of larger images")
    parser.add_argument("--tracked", type=Path, help="capture for stage 1; default: the first one")
    parser.add_argument("--against", type=Path, help="root of another checkout")
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--work", type=Path, help="folder for runs, which is kept; default: a temporary one")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    work = (arguments.work or Path(tempfile.mkdtemp(prefix="tumble-commands-"))).resolve()
    checkouts = {"this": Checkout(HERE, work / "this")}
    if arguments.against is not None:
        checkouts["against"] = Checkout(arguments.against.resolve(), work / "against")
    try:
        measure(checkouts, _timers(arguments), arguments.only, arguments.repeats, arguments.out)
    finally:
        if arguments.work is None:
            shutil.rmtree(work, ignore_errors=True)


def _timers(arguments: argparse.Namespace) -> dict[str, Callable[[Checkout], Times]]:
    """Functions that time the commands, by the row of the command."""
    capture = arguments.capture.resolve()
    timers: dict[str, Callable[[Checkout], Times]] = {
        "run": partial(time_run, row="run", capture=capture),
        "export web": partial(time_export, preset="web"),
        "export film": partial(time_export, preset="film"),
        "evaluate": lambda checkout: {"evaluate": checkout.command("evaluate", checkout.work / "run")},
        "poses": partial(time_poses, capture=(arguments.tracked or capture).resolve()),
        "demo": time_demo,
    }
    if arguments.large is not None:
        timers["large"] = partial(time_run, row="large", capture=arguments.large.resolve())
    return timers


def measure(
    checkouts: dict[str, Checkout],
    timers: dict[str, Callable[[Checkout], Times]],
    only: Sequence[str],
    repeats: int,
    out: Path,
) -> None:
    """Time the commands alternately in all checkouts, and write all figures after each."""
    wanted = {PARTS.get(row, row): repeats for row in only}
    ready = all((checkout.work / "run").is_dir() for checkout in checkouts.values())
    if not ready and wanted.keys() & {"export web", "export film", "evaluate"}:
        wanted.setdefault("run", 1)
    kept = json.loads(out.read_text("utf-8"))["rows"] if out.is_file() else {}
    kept = {row: times for row, times in kept.items() if PARTS.get(row, row) not in wanted}
    result: dict[str, Any] = {"command": COMMAND, "machine": machine(), "rows": kept, "failed": []}
    for checkout in checkouts.values():
        with contextlib.suppress(Failed):
            checkout.command("doctor")  # compiles modules and kernels
    for command, timer in timers.items():
        for _ in range(wanted.get(command, 0)):
            for name, checkout in checkouts.items():
                try:
                    times = timer(checkout)
                except Failed as error:
                    result["failed"].append(f"{command}, {name}: {error}")
                    print(result["failed"][-1], file=sys.stderr, flush=True)
                    continue
                for row, seconds in times.items():
                    result["rows"].setdefault(row, {}).setdefault(name, []).append(seconds)
                    print(f"{row}, {name}: {seconds}", flush=True)
            files.write_json(out, result)
            text = report(result)
            files.write_atomically(out.with_suffix(".md"), lambda partial, text=text: partial.write_text(text))
    print(report(result))


# Commands -------------------------------------------------------------------------------------------------------------


def time_run(checkout: Checkout, *, row: str, capture: Path) -> Times:
    """A run with known poses, its stages 2 and 3 if it is not the large one; replaces the run before it."""
    folder = checkout.work / row
    shutil.rmtree(folder, ignore_errors=True)
    times = {row: checkout.command("run", capture, "-o", folder)}
    return times | (stages(folder) if row == "run" else {})


def time_poses(checkout: Checkout, *, capture: Path) -> Times:
    """A run with estimated poses up to the start of stage 2, and its stage 1."""
    folder = checkout.work / "poses"
    shutil.rmtree(folder, ignore_errors=True)
    words = ("run", capture, "-o", folder, "--poses", "estimate")
    times = {"poses": checkout.command(*words, until=lambda: any(r.get("name") == "refine" for r in records(folder)))}
    return times | stages(folder)


def time_export(checkout: Checkout, *, preset: str) -> Times:
    folder = checkout.work / f"export-{preset}"
    shutil.rmtree(folder, ignore_errors=True)
    return {f"export {preset}": checkout.command("export", checkout.work / "run", "--preset", preset, "-o", folder)}


def time_demo(checkout: Checkout) -> Times:
    shutil.rmtree(checkout.work / "demo", ignore_errors=True)
    return {"demo": checkout.command("demo", "-o", checkout.work / "demo")}


def _stop_when(process: "subprocess.Popen[bytes]", condition: Callable[[], bool]) -> bool:
    """Whether the condition came true while the process ran, which is then stopped; its end is not waited for."""
    while os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if condition():
            process.send_signal(signal.SIGTERM)
            return True
        time.sleep(POLL)
    return False


# Logs -----------------------------------------------------------------------------------------------------------------


def records(folder: Path) -> list[dict[str, Any]]:
    """The complete records in the log of a run."""
    log = folder / "log.jsonl"
    lines = log.read_text(errors="replace").split("\n")[:-1] if log.is_file() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def stages(folder: Path) -> Times:
    """Time of every finished stage, all rounds of stage 1 together."""
    times: Times = {}
    for record in records(folder):
        if record.get("event") == "done" and "seconds" in record:
            before = times.get(record["name"], {"wall": 0.0})["wall"]
            times[record["name"]] = {"wall": round(before + record["seconds"], 2)}
    return {name: seconds for name, seconds in times.items() if name in PARTS}


def report(result: dict[str, Any]) -> str:
    """The figures in Markdown."""
    lines = [
        f"# Time of whole commands\n\n`{result['command']}`: each command as a process of its own, recipe DRAFT; "
        f"{result['machine']['class']}. Seconds by the wall clock (and of processor time), medians of several runs in "
        "this checkout and in another one in turn.\n",
        "| what | runs | this [s] | other [s] | ratio |",
        "|---|---|---|---|---|",
    ]
    for row, title in ROWS.items():
        times = result["rows"].get(row)
        if times is None:
            continue
        walls = {name: statistics.median(x["wall"] for x in found) for name, found in times.items()}
        ratio = f"{walls['against'] / walls['this']:.2f}" if walls.keys() == {"this", "against"} else ""
        runs = max(map(len, times.values()))
        lines += [f"| {title} | {runs} | {_median(times, 'this')} | {_median(times, 'against')} | {ratio} |"]
    return "\n".join([*lines, "", *(f"Failed: {text}" for text in result["failed"]), ""])


def _median(times: dict[str, list[dict[str, float]]], name: str) -> str:
    found = times.get(name, [])
    if not found:
        return ""
    wall, cpu = (statistics.median(x.get(kind, 0.0) for x in found) for kind in ("wall", "cpu"))
    return f"{wall:.1f} ({cpu:.1f})" if cpu else f"{wall:.1f}"


if __name__ == "__main__":
    main()
