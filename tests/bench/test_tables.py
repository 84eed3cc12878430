"""Tables follow from the JSON document alone; means, spreads and tests have values known from elsewhere."""

import itertools
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

from tumble.bench import markdown, page, plot, tables
from tumble.bench.code import Code
from tumble.bench.rows import SuiteResults, SuiteRow, read_results
from tumble.io import files
from tumble.io.files import BadFile

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
COMMITTED = sorted(path for path in BENCHMARKS.glob("*.json") if '"suite":' in path.read_text("utf-8"))
CODE: Code = {"version": "0.1.0", "commit": "abc", "fingerprint": "f" * 16}
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def row(name: str, setting: str, seed: int, albedo: float, **more: Any) -> SuiteRow:
    labels = {"object": name, "light": "sun", "setting": setting, "material": "original"}
    return {
        "name": f"{name}-{setting}-{seed}",
        "key": f"{name}{setting}{seed}",
        "labels": {**labels, "poses": "given", "method": "tumble", "seed": seed},
        "case": {},
        "code": CODE,
        "recipe": "r",
        "machine": "m",
        "regions": {"shared": {"albedo.psnr_fg_srgb": albedo}, "sphere": {"albedo.psnr_fg_srgb": -99.0}},
        **more,  # type: ignore[typeddict-item]
    }


def results(rows: list[SuiteRow], **about: Any) -> SuiteResults:
    compare = {"title": "hand above dome", "ahead": {"setting": "handheld"}, "behind": {"setting": "dome"}}
    suite = {"title": "T", "half": "report", "frozen": "1234", "compare": [compare], "plot": "", **about}
    names = [r["name"] for r in rows]
    return {"format": 1, "name": "t", "suite": suite, "cases": [*names, "absent"], "code": CODE, "rows": rows}


OBJECTS = [f"o{i}" for i in range(10)]


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.name)
def test_a_committed_report_reproduces_its_tables_and_plots(path: Path) -> None:
    report = read_results(path)
    assert path.with_suffix(".md").read_text("utf-8") == markdown.markdown_of(report)
    for drawn in plot.line_plots(report):
        assert (BENCHMARKS / drawn.file).read_text("utf-8") == drawn.svg


def test_a_suite_is_committed() -> None:
    assert COMMITTED


def test_hand_held_ahead_on_ten_of_ten_objects_has_the_smallest_p_of_the_signed_rank_test() -> None:
    """All of the 2^10 signs are equally probable, and only one of them is as extreme."""
    rows = [row(name, "handheld", 0, 30.0 + i) for i, name in enumerate(OBJECTS)]
    rows += [row(name, "dome", 0, 29.0 - i) for i, name in enumerate(OBJECTS)]
    (found,) = tables.comparisons(results(rows))
    assert found.p == pytest.approx(2**-10)
    assert found.differences == {name: 1.0 + 2 * i for i, name in enumerate(OBJECTS)}
    (line,) = tables.comparison_table(results(rows)).lines
    assert line[5:] == ("+10.0 ± 6.1", "10 of 10", "-", "0.000977")


def test_pairs_are_objects_whatever_the_number_of_seeds() -> None:
    """Two seeds are no two independent objects."""
    rows = [row(name, "handheld", seed, 30.0 + seed) for name in ("a", "b") for seed in (0, 1)]
    rows += [row(name, "dome", seed, 31.0 if name == "b" else 28.5) for name in ("a", "b") for seed in (0, 1)]
    (found,) = tables.comparisons(results(rows))
    assert found.differences == {"a": 2.0, "b": -0.5}
    assert found.p == pytest.approx(0.5)  # ranks 1 and 2 of which the larger is positive: 2 of 4 cases
    assert tables.comparison_table(results(rows)).lines[0][6:8] == ("1 of 2", "b")


def test_means_are_over_objects_and_the_spread_is_over_seeds() -> None:
    rows = [row("a", "dome", 0, 20.0), row("a", "dome", 1, 22.0), row("b", "dome", 0, 30.0), row("b", "dome", 1, 34.0)]
    table = tables.mean_table(results(rows))
    assert table.headings[:2] == ("objects", "albedo object [dB]")
    # 25 and 28 are the means of the seeds.
    assert table.lines == [("2", f"26.5 ± {math.sqrt(4.5):.1f}")]
    objects = tables.object_table(results(rows))
    assert objects.lines == [("a", "21.0 ± 1.4"), ("b", "32.0 ± 2.8")]
    assert tables.object_table(results(rows[:1])).lines == []


def test_stale_and_failed_rows_are_shown_and_are_in_no_mean() -> None:
    other: Code = {**CODE, "fingerprint": "0" * 16}
    rows = [row("a", "handheld", 0, 30.0), row("a", "dome", 0, 20.0, code=other)]
    failed = row("b", "dome", 0, 0.0, error="BadFile: too | few")
    del failed["regions"]
    text = markdown.markdown_of(results([*rows, failed]))
    assert tables.mean_table(results(rows)).lines == [("1", "30.0")]
    assert tables.comparisons(results(rows)) == []
    assert "1 failed, 1 stale" in text
    assert "| a | dome | 20.0 | stale |" in text
    assert "| b-dome-0 | BadFile: too / few |" in text
    assert "| absent | not measured |" in text
    assert "frozen at commit 1234" in text


def test_the_page_escapes_what_rows_say_and_names_the_command_of_each(tmp_path: Path) -> None:
    rows = [row(HOSTILE, "dome", 0, 20.0, machine=HOSTILE), row("a", "dome", 0, 21.0)]
    html = page.page_of(results(rows, title=HOSTILE, plot="object"), tmp_path)
    assert html.count("<script>") == 1
    assert "<img src=x" not in html
    assert "tumble bench run t --method tumble --seeds 0 --only a-dome-0" in html
    assert "src=http" not in html
    assert "@import" not in html


def test_plots_have_a_line_for_each_setting_over_the_varied_values() -> None:
    rows = []
    for setting in ("dome", "handheld"):
        for views in (100, 25, 400):
            one = row("a", setting, 0, 20.0 + views / 100)
            rows.append({**one, "labels": {**one["labels"], "views": views}})
    (found,) = plot.line_plots(results(rows, plot="views"))
    assert (found.title, found.file) == ("albedo object [dB] by views", "t-albedo-psnr_fg_srgb.svg")
    drawn = ElementTree.tostring(ElementTree.fromstring(found.svg)).decode()
    places = [drawn.index(f">{views}<") for views in (25, 100, 400)]
    assert places == sorted(places)
    assert (drawn.count(":path"), drawn.count(":circle")) == (2, 6)
    assert all(drawn.count(f">{name}<") == 1 for name in ("dome", "handheld"))
    assert f"]({found.file})" in markdown.markdown_of(results(rows, plot="views"))


def test_a_line_of_a_plot_is_of_objects_that_all_its_values_have() -> None:
    """Each value of "turntable" has another object, so that it has no line."""
    absent = {("dome", "b", 400), ("handheld", "a", 25), ("turntable", "a", 25), ("turntable", "b", 400)}
    rows = []
    for setting, name, views in itertools.product(("dome", "handheld", "turntable"), ("a", "b"), (25, 400)):
        one = row(name, setting, 0, {"a": 20.0, "b": 40.0}[name] + views / 25)
        if (setting, name, views) not in absent:
            rows.append({**one, "labels": {**one["labels"], "views": views}})
    (found,) = plot.line_plots(results(rows, plot="views"))
    drawn = ElementTree.tostring(ElementTree.fromstring(found.svg)).decode()
    assert [drawn.count(f">{name}<") for name in ("dome", "handheld", "turntable")] == [1, 1, 0]
    # The axis ends at the lowest value, of object a alone, and at the highest, of b alone.
    assert (">21<" in drawn, ">56<" in drawn) == (True, True)


@pytest.mark.parametrize(
    "change",
    [
        {"name": "../../x"},
        {"format": 0},
        {"rows": 1},
        {"suite": {}},
        {"rows": [{**row("a", "dome", 0, 1.0), "labels": {"object": "a"}}]},
        {"rows": [{**row("a", "dome", 0, 1.0), "labels": {"object": ["a"]}}]},
        {"rows": [{**row("a", "dome", 0, 1.0), "poses": {"poses.rotation_median_degrees": "<b>"}}]},
    ],
)
def test_a_json_file_that_is_no_report_is_refused(change: dict[str, Any], tmp_path: Path) -> None:
    files.write_json(tmp_path / "r.json", {**results([]), **change})
    with pytest.raises(BadFile, match=r"r\.json.*give the JSON file that tumble bench report has written"):
        read_results(tmp_path / "r.json")
