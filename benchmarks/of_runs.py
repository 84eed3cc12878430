"""Command line of the benchmarks that evaluate runs of `benchmarks.decomposition`, one row of figures per capture."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.kernels import machine
from tumble.io import files


def main(file: str, about: str, row: Callable[[Path, Path], dict[str, Any]]) -> None:
    """Print `row(capture, run)` of each capture and write the rows to a JSON file beside the benchmark's `file`."""
    script = Path(file)
    parser = argparse.ArgumentParser(description=about.split("\n")[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=script.with_suffix(".json"))
    arguments = parser.parse_args()
    rows = []
    for capture in arguments.captures:
        rows.append({"capture": capture.name, **row(capture, arguments.runs / f"{capture.name}-draft-0")})
        print(rows[-1], flush=True)
        command = f"python -m benchmarks.{script.stem} CAPTURE... --runs FOLDER"
        files.write_json(arguments.out, {"command": command, "machine": machine(), "rows": rows})
