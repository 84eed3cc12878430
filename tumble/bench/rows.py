"""Rows: one JSON file per case and version of the code, with all scores or the reason why there are none.

Every row is a file of its own, so that processes never write the same file and an interrupted run goes on where it was.
The picture of a row lies beside it, with the same name.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from tumble.bench.code import Code
from tumble.bench.suite import Case, Suite
from tumble.io import BadFile, files

ROWS = "rows"
"""Folder of the rows in the folder of a benchmark."""
DIGITS = 4
"""Decimals of the scores in a row."""
WRONG_ROW = "remove it; tumble bench run measures it again"
"""Fix for a damaged row."""
LABELS = ("object", "light", "setting", "material", "poses", "method", "seed")
"""Labels of every row."""
FORMAT = 1
"""Version of the layout of a report's JSON document."""


class SuiteRow(TypedDict):
    """The content of a row's file."""

    name: str
    key: str
    """Key of the case."""
    labels: dict[str, str | float | int | None]
    """What distinguishes the case from others, by heading."""
    case: dict[str, Any]
    """The whole case, with all options of its capture."""
    code: Code
    recipe: str
    """Hash of the settings of all stages that run, and of the Python file of the method if it is in one."""
    machine: str
    """Class of the machine."""
    error: NotRequired[str]
    """Why there are no scores."""
    capture: NotRequired[str]
    """Hash of the frames, masks, camera and poses that were reconstructed."""
    directionality: NotRequired[float]
    """Length of the mean direction of the capture's light, weighted by luminance: 0 uniform, 1 one small lamp."""
    seconds: NotRequired[dict[str, float | None]]
    """Duration of the run (the sum of its stages) and of its evaluation [s]."""
    peak_memory_MiB: NotRequired[int]
    """Maximum memory of the process of the run and its evaluation [MiB]."""
    regions: NotRequired[dict[str, dict[str, float | None]]]
    """Scores by region of evaluation views and key (docs/metrics.md)."""
    glb: NotRequired[dict[str, float | None]]
    """Scores of the exported GLB in the shared views, by key; only in suites that ask for it."""
    light: NotRequired[dict[str, float | None]]
    poses: NotRequired[dict[str, float | None]]
    published: NotRequired[dict[str, float | None]]
    """Scores by the protocol of the benchmark that the capture is of (docs/metrics.md)."""
    albedo_scale: NotRequired[list[float] | None]
    notes: NotRequired[list[str]]


class ComparedSets(TypedDict):
    """A comparison of a suite; see `suite.Comparison`."""

    title: str
    ahead: dict[str, str | float | int | None]
    behind: dict[str, str | float | int | None]


class SuiteFacts(TypedDict):
    """What a report says about its suite; see `suite.Suite`."""

    title: str
    half: str
    frozen: str
    plot: str
    compare: list[ComparedSets]


class SuiteResults(TypedDict):
    """All rows of a suite, from which its tables follow: the JSON file of a report."""

    format: int
    name: str
    suite: SuiteFacts
    cases: list[str]
    """Names of all cases of the suite."""
    code: Code
    """The code that was current when the report was written; rows of other code are stale."""
    rows: list[SuiteRow]
    recipes: NotRequired[dict[str, str]]
    """The recipe of each case when the report was written, by key: rows of another one are stale too, because the
    Python file of a method is no part of `code`. Early reports lack them."""


def row_of(case: Case, code: Code, *, recipe: str) -> SuiteRow:
    """A row without scores, with the fingerprint of the code that decides them: without stage 1 if poses are given."""
    whole = code["fingerprint"]
    own = code.get("fingerprint_given", whole) if case.poses == "given" else whole
    plain: dict[str, Any] = dataclasses.asdict(dataclasses.replace(case, varied=()))
    return {
        "name": case.name,
        "key": case.key,
        "labels": case.labels,
        "case": plain,
        "code": {"version": code["version"], "commit": code["commit"], "fingerprint": own},
        "recipe": recipe,
        "machine": "",
    }


def row_file(out: Path, row: SuiteRow) -> Path:
    """The file of a row in the folder of a benchmark."""
    return out / ROWS / f"{row['name']}-{row['key'][:8]}-{row['code']['fingerprint'][:8]}.json"


def read_row(path: Path) -> SuiteRow:
    """A row.

    Raises:
        BadFile: The file holds no row.
    """
    return files.read_json(path, SuiteRow, WRONG_ROW)


def read_rows(out: Path) -> list[SuiteRow]:
    """All rows in the folder of a benchmark; the oldest first."""
    paths = sorted((out / ROWS).glob("*.json"), key=lambda path: (path.stat().st_mtime_ns, path.name))
    return [read_row(path) for path in paths]


def results_of(
    name: str,
    suite: Suite,
    cases: Sequence[Case],
    rows: Sequence[SuiteRow],
    code: Code,
    *,
    recipes: Mapping[str, str],
) -> SuiteResults:
    """The rows of the given cases: of each the current one, or else the latest one of other code.

    Args:
        recipes: The recipe of each case now, by key.
    """
    latest: dict[str, SuiteRow] = {}
    for row in rows:
        before = latest.get(row["key"])
        if before is None or not _is_current(before, code, recipes) or _is_current(row, code, recipes):
            latest[row["key"]] = row
    about: Any = dataclasses.asdict(suite)
    return {
        "format": FORMAT,
        "name": name,
        "suite": {key: about[key] for key in SuiteFacts.__annotations__},  # type: ignore
        "cases": [case.name for case in cases],
        "code": code,
        # The labels depend on what else is in the suite; a row may have been measured for another one.
        "rows": [latest[c.key] | {"name": c.name, "labels": c.labels} for c in cases if c.key in latest],  # type: ignore
        "recipes": dict(recipes),
    }


def read_results(path: Path) -> SuiteResults:
    """The JSON document of a report.

    Raises:
        BadFile: The file holds something else.
    """
    fix = "give the JSON file that tumble bench report has written"
    results = files.read_json(path, SuiteResults, fix)
    if not re.fullmatch(r"[\w-]+", results["name"]):
        raise BadFile(path, f"is of a suite with the name {results['name']!r}, which is no word", fix)
    if results["format"] != FORMAT:
        raise BadFile(path, f"has format {results['format']}; this version reads {FORMAT}", fix)
    for row in results["rows"]:
        if missing := [name for name in LABELS if name not in row["labels"]]:
            raise BadFile(path, f"has a row without the label {missing[0]!r}", fix)
    return results


def _is_current(row: SuiteRow, code: Code, recipes: Mapping[str, str]) -> bool:
    same_recipe = recipes.get(row["key"], row["recipe"]) == row["recipe"]
    return same_recipe and row["code"]["fingerprint"] in (code["fingerprint"], code.get("fingerprint_given"))


def is_stale(row: SuiteRow, results: SuiteResults) -> bool:
    """Whether a row was measured with other code than the report's, or with another recipe than its case has."""
    return not _is_current(row, results["code"], results.get("recipes", {}))


def rounded(scores: Mapping[str, Any]) -> dict[str, float | None]:
    """Scores with few decimals; what is no number is left out."""
    kept = {key: value for key, value in scores.items() if value is None or isinstance(value, int | float)}
    return {key: round(value, DIGITS) if isinstance(value, float) else value for key, value in kept.items()}
