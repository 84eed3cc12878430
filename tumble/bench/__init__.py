"""Benchmark suites: declarative files that list captures and methods, one row of scores per case, and their report.

A suite (`suites/*.toml`) says which objects are rendered under which lights and settings, and which methods run on the
captures. Each *case* of it leads to one *row*: a JSON file with all scores and with everything that they depend on.
"""

from typing import TYPE_CHECKING

from tumble._lazy import lazy_getattr

if TYPE_CHECKING:
    from tumble.bench.captures import CaptureTask, data_folder, make_capture, require_inputs
    from tumble.bench.code import current_code, machine_class
    from tumble.bench.executor import Outcome, Workers, execute
    from tumble.bench.markdown import markdown_of
    from tumble.bench.page import page_of
    from tumble.bench.pictures import picture_of
    from tumble.bench.plot import line_plots
    from tumble.bench.rows import (
        SuiteRow,
        read_results,
        read_row,
        read_rows,
        results_of,
        rounded,
        row_file,
        row_of,
    )
    from tumble.bench.suite import Case, cases_of, read_suite, suite_names

__all__ = [
    "Case",
    "CaptureTask",
    "Outcome",
    "SuiteRow",
    "Workers",
    "cases_of",
    "current_code",
    "data_folder",
    "execute",
    "line_plots",
    "machine_class",
    "make_capture",
    "markdown_of",
    "page_of",
    "picture_of",
    "read_results",
    "read_row",
    "read_rows",
    "read_suite",
    "require_inputs",
    "results_of",
    "rounded",
    "row_file",
    "row_of",
    "suite_names",
]

__getattr__ = lazy_getattr(
    __name__,
    {
        "captures": (
            "CaptureTask",
            "data_folder",
            "make_capture",
            "require_inputs",
        ),
        "code": (
            "current_code",
            "machine_class",
        ),
        "executor": (
            "Outcome",
            "Workers",
            "execute",
        ),
        "markdown": ("markdown_of",),
        "page": ("page_of",),
        "pictures": ("picture_of",),
        "plot": ("line_plots",),
        "rows": (
            "SuiteRow",
            "read_results",
            "read_row",
            "read_rows",
            "results_of",
            "rounded",
            "row_file",
            "row_of",
        ),
        "suite": (
            "Case",
            "cases_of",
            "read_suite",
            "suite_names",
        ),
    },
)
