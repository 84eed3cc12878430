"""The page of a suite: one self-contained HTML file with pictures side by side, plots and sortable tables.

Like the report of a run it loads nothing and runs no script but its own, and its template escapes every value.
"""

import base64
import dataclasses
from importlib import resources
from pathlib import Path
from typing import TypedDict

import jinja2
from markupsafe import Markup

from tumble import __version__
from tumble.bench import tables
from tumble.bench.markdown import facts
from tumble.bench.plot import line_plots
from tumble.bench.rows import ROWS, SuiteResults, SuiteRow
from tumble.bench.tables import METRICS, Table
from tumble.report import script_hash, style_sheet

TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("tumble.bench", "assets"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
"""Template of the page."""
SIDE_BY_SIDE = ("setting", "poses", "method")
"""Labels whose values are shown side by side."""
CAPTION = "albedo.psnr_fg_srgb"
"""Score under a picture."""


class Shot(TypedDict):
    """A picture of the page."""

    image: str
    caption: str
    score: str


def page_of(results: SuiteResults, out: Path) -> str:
    """The page as HTML.

    Args:
        out: Folder of the benchmark, with the pictures of the rows; pictures that are not there are left out.
    """
    script = Markup((resources.files("tumble.bench") / "assets" / "sort.js").read_text("utf-8"))
    return TEMPLATES.get_template("suite.html").render(
        results=results,
        facts=facts(results),
        tables=[_with_commands(table, results) for table in tables.tables_of(results)],
        pictures=_pictures(results, out / ROWS),
        plots=line_plots(results),
        css=style_sheet(),
        script=script,
        script_hash=script_hash(script),
        version=__version__,
    )


def _with_commands(table: Table, results: SuiteResults) -> Table:
    """The table of rows with the command that measures each."""
    rows = [row for row in results["rows"] if "error" not in row]
    if table.headings[-1] != "code":
        return table
    commands = [
        f"tumble bench run {results['name']} --method {row['labels']['method']} --seeds {row['labels']['seed']} "
        f"--only {row['name']}"
        for row in rows
    ]
    # The last column says whether a row is stale, by which the template chooses its colour.
    lines = [(*line[:-1], command, line[-1]) for line, command in zip(table.lines, commands, strict=True)]
    return dataclasses.replace(table, headings=(*table.headings[:-1], "command", "code"), lines=lines)


def _pictures(results: SuiteResults, folder: Path) -> dict[str, list[Shot]]:
    """Pictures of the first seed, by what else distinguishes the rows."""
    rows = tables.usable_rows(results)
    first = next((row["labels"]["seed"] for row in rows), None)
    rows = [row for row in rows if row["labels"]["seed"] == first]
    titles = [name for name in ("object", *tables.varied_labels(rows, ("object",))) if name not in SIDE_BY_SIDE]
    captions = [name for name in tables.varied_labels(rows) if name in SIDE_BY_SIDE] or ["setting"]
    pictures: dict[str, list[Shot]] = {}
    for row in rows:
        path = next(iter(folder.glob(f"*-{row['key'][:8]}-{row['code']['fingerprint'][:8]}.webp")), None)
        if path is not None:
            shots = pictures.setdefault(_words(row, titles), [])
            data = base64.b64encode(path.read_bytes()).decode()
            value = tables.value_of(row, CAPTION)
            score = "" if value is None else METRICS[CAPTION][1].format(value) + " dB"
            shots.append({"image": f"data:image/webp;base64,{data}", "caption": _words(row, captions), "score": score})
    return pictures


def _words(row: SuiteRow, names: list[str]) -> str:
    return ", ".join(str(row["labels"][name]) for name in names)
