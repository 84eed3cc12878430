"""Suites of captures that the user has: nothing is rendered, and rows hold the scores of the benchmark's protocol."""

import math
from pathlib import Path
from typing import Any

import pytest

from tests import spheres
from tumble import batch
from tumble.bench import captures, rows, suite, tables
from tumble.io.files import BadFile

SUITE = """
title = "t"
recipe = "smoke"
seeds = [0]
[[object]]
folder = "{}"
[[rows]]
method = ["tumble", "average"]
"""
WANTED = {
    "tensoir": {"tensoir.albedo_psnr", "tensoir.relit_psnr", "tensoir.image_lpips_alex", "tensoir.normal_mae_degrees"},
    "stanford_orb": {"orb.relit_psnr_h", "orb.image_psnr_l", "orb.albedo_psnr", "orb.normal_cosine"},
}


def cases_of(folder: str, tmp_path: Path, **selection: Any) -> list[suite.Case]:
    (tmp_path / "own.toml").write_text(SUITE.format(folder))
    return suite.cases_of(suite.read_suite(str(tmp_path / "own.toml")), **selection)


@pytest.mark.parametrize("name", [pytest.param("tensoir", marks=pytest.mark.slow), "stanford_orb"])
def test_a_row_of_a_given_capture_has_the_published_scores(name: str, tmp_path: Path) -> None:
    data = tmp_path / "data"
    path = spheres.WRITERS[name](data)
    (case,) = cases_of(str(path.relative_to(data)), tmp_path, methods=["average"])
    assert case.name == f"{path.name}-given-{path.parent.name}-given-given-average-seed0"
    task = captures.CaptureTask(case, data, tmp_path / "out")
    assert captures.make_capture(task) == path
    row, picture = batch.measure(batch.RowTask(case, data, tmp_path / "out", "cpu"))
    assert picture
    assert WANTED[name] <= row.get("published", {}).keys()
    assert all(math.isfinite(value or 0) for value in row.get("published", {}).values())
    # The colours of the sphere, in one of many units, and its silhouette are found even in seconds.
    assert tables.value_of(row, min(WANTED[name])) == row["published"][min(WANTED[name])]  # type: ignore
    assert row["regions"]["shared"]["silhouette.iou"] > 0.85  # type: ignore
    assert rows.row_file(tmp_path, row).name.startswith(case.name)


def test_a_folder_outside_of_the_data_or_missing_is_refused_with_the_fix(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"no data folder is given.*--data"):
        captures.require_inputs(cases_of("a/b", tmp_path), None)
    with pytest.raises(BadFile, match=r"a/b: is missing.*--data"):
        captures.require_inputs(cases_of("a/b", tmp_path), tmp_path)
    with pytest.raises(BadFile, match="leaves the folder"):
        captures.require_inputs(cases_of("../b", tmp_path), tmp_path)
