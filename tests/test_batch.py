"""A suite from the objects to the page, with one row that fails; and a batch of captures."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mitsuba", reason="needs the extra `synth`")

from tests.test_cli import run
from tumble import batch
from tumble.bench import captures, code, rows
from tumble.bench.suite import Case, cases_of, read_suite
from tumble.engine import loop
from tumble.io import files
from tumble.io.files import BadFile
from tumble.preprocess import FootageOptions
from tumble.recipes import SMOKE

SUITE = """
title = "Two rows of a pot"
recipe = "smoke"
seeds = [0]
glb = true
[capture]
views = 6
resolution = 32
samples = 2
truth_samples = 2
relight = ["sunset"]
eval_shared = 1
eval_sphere = 1
[[object]]
model = "pot"
env = "room"
[[rows]]
poses = ["given", "estimate"]
"""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Six frames are enough for given poses, and too few to estimate them."""
    path = tmp_path_factory.mktemp("suite") / "pot.toml"
    path.write_text(SUITE)
    return str(path)


@pytest.fixture(scope="module")
def measured(suite: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a benchmark with both rows; each process waits for, or renders, the one capture."""
    out = tmp_path_factory.mktemp("bench") / "b"
    tasks = batch.missing_rows(cases_of(read_suite(suite)), out, None, glb=True)
    list(batch.run_rows(tasks, out, batch.Workers(jobs=2)))
    return out


def test_a_row_has_all_scores_and_what_they_depend_on(measured: Path) -> None:
    row = next(row for row in rows.read_rows(measured) if "error" not in row)
    assert row["labels"] | {"object": "pot", "light": "room", "poses": "given", "seed": 0} == row["labels"]
    now = code.current_code()
    assert row["code"] == {name: now[name] for name in ("version", "commit")} | {
        "fingerprint": now["fingerprint_given"]
    }
    assert len(row["recipe"]) == len(row["capture"]) == 64
    assert "CPU" in row["machine"]
    assert row["seconds"]["run"] > 0 < row["seconds"]["score"]
    assert 100 < row["peak_memory_MiB"] < 8000
    assert 0 < row["directionality"] < 1
    wanted = {"albedo.psnr_fg_srgb", "albedo.psnr_full_srgb", "albedo.ssim_full_srgb", "albedo.lpips_full_srgb_alex"}
    wanted |= {"albedo.psnr_fg_linear_unscaled", "relit.lpips_full_srgb_alex", "normal.mean_fg_degrees"}
    assert row["regions"].keys() == {"shared", "sphere"}
    assert all(wanted | {"roughness.rmse_fg"} <= scores.keys() for scores in row["regions"].values())
    assert {"light.rmse_clip10", "light.log_correlation"} <= row["light"].keys()
    assert {"albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "normal.mean_fg_degrees"} <= row["glb"].keys()
    # Gaussians and GLB show the same object: their scores differ, but little.
    difference = row["glb"]["albedo.psnr_fg_srgb"] - row["regions"]["shared"]["albedo.psnr_fg_srgb"]
    assert 0 < abs(difference) < 3
    assert len(list((measured / captures.CAPTURES).glob("*/transforms.json"))) == 1


def test_a_row_without_the_scores_of_the_glb_is_completed_only_for_suites_that_have_them(
    measured: Path, suite: str, tmp_path: Path
) -> None:
    cases = cases_of(read_suite(suite))
    for row in rows.read_rows(measured):
        row.pop("glb", None)
        files.write_json(rows.row_file(tmp_path, row), row)
    assert batch.missing_rows(cases, tmp_path, None) == []
    missing = batch.missing_rows(cases, tmp_path, None, glb=True)
    assert [(task.case.poses, task.glb) for task in missing] == [("given", True)]


def test_a_failed_row_says_why_and_is_measured_again_only_on_demand(measured: Path, suite: str) -> None:
    failed = [row for row in rows.read_rows(measured) if "error" in row]
    assert [row["labels"]["poses"] for row in failed] == ["estimate"]
    assert "has 6 frames, too few to estimate the motion" in failed[0]["error"]
    cases = cases_of(read_suite(suite))
    assert batch.missing_rows(cases, measured, None) == []
    assert [task.name for task in batch.missing_rows(cases, measured, None, again=True)] == [failed[0]["name"]]


def test_a_method_in_a_file_is_measured_again_when_the_file_changes(suite: str, tmp_path: Path) -> None:
    own, folder = tmp_path / "own.py", tmp_path / "out"
    own.write_text("from dataclasses import replace\ndef method(recipe):\n    return replace(recipe, matcher='sift')\n")
    (case,) = cases_of(read_suite(suite), methods=[str(own)], only=["estimate"])
    assert case.name == "pot-room-handheld-original-estimate-own-seed0"
    recipe = batch.recipe_of(case)
    assert (recipe.matcher, recipe.decompose) == ("sift", SMOKE.decompose)
    row = rows.row_of(case, code.current_code(), recipe=loop.fingerprint(recipe, own.read_text()))
    files.write_json(rows.row_file(folder, row), row)
    assert batch.missing_rows([case], folder, None) == []
    own.write_text(own.read_text() + "# a change\n")
    assert [task.case for task in batch.missing_rows([case], folder, None)] == [case]


def test_a_row_of_an_earlier_version_of_a_method_file_is_stale_and_in_no_mean(suite: str, tmp_path: Path) -> None:
    own, folder = tmp_path / "changed.py", tmp_path / "out"
    own.write_text("def method(recipe):\n    return recipe\n")
    chosen = {"methods": [str(own)], "seeds": [0, 1], "only": ["estimate"]}
    cases = cases_of(read_suite(suite), **chosen)

    def measure(case: Case, score: float) -> rows.SuiteRow:
        recipe = loop.fingerprint(batch.recipe_of(case), own.read_text())
        row = rows.row_of(case, code.current_code(), recipe=recipe)
        return row | {"regions": {"shared": {"albedo.psnr_fg_srgb": score}}}

    first, second = measure(cases[0], 20.0), measure(cases[1], 20.0)
    own.write_text(own.read_text() + "# a change\n")
    again = measure(cases[1], 30.0)
    files.write_json(folder / batch.MARK, {})
    for row in (first, again):
        files.write_json(rows.row_file(folder, row), row)
    batch.report_suite(suite, folder, **chosen)
    text, report = (folder / "pot.md").read_text("utf-8"), rows.read_results(folder / "pot.json")
    assert "2 of 2 rows: 0 failed, 1 stale" in text
    assert "| 1 | 30.0 |" in text.partition("## Means")[2]
    assert [task.case for task in batch.missing_rows(cases, folder, None)] == [cases[0]]
    # Of a case that has both the row of today is taken, also if the other one is written later.
    about = "pot", read_suite(suite), cases, [again, second], code.current_code()
    assert rows.results_of(*about, recipes=report["recipes"])["rows"][0]["regions"] == again["regions"]


def test_a_row_in_one_line_has_the_error_of_poses_only_if_they_were_estimated(measured: Path) -> None:
    row = next(row for row in rows.read_rows(measured) if "error" not in row)
    assert "poses 0.00" not in batch.summary_line(row)
    row["labels"] |= {"poses": "estimate"}
    assert ", poses 0.00 degrees, " in batch.summary_line(row)


def test_other_settings_of_stage_1_measure_only_rows_with_estimated_poses_again(
    measured: Path, suite: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(batch.RECIPES, "smoke", replace(SMOKE, matcher="sift", track=SMOKE.refine))
    missing = batch.missing_rows(cases_of(read_suite(suite)), measured, None)
    assert [task.case.poses for task in missing] == ["estimate"]


def test_method_files_of_the_same_name_are_different_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where one path names both, after a change of the folder; and one file has one module under all its paths."""
    text = "from dataclasses import replace\ndef method(recipe):\n    return replace(recipe, matcher={!r})\n"
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "same.py").write_text(text.format(name))
    for name in ("first", "second"):
        monkeypatch.chdir(tmp_path / name)
        method = batch.method_of("same.py")
        assert method(SMOKE).matcher == name
        assert batch.method_of(str(tmp_path / name / "same.py")) is method


def test_an_unknown_method_is_refused_with_the_known_ones(suite: str, tmp_path: Path) -> None:
    (tmp_path / "empty.py").touch()
    for name, message in (("magic", "choose among tumble, average"), (str(tmp_path / "empty.py"), "has no function")):
        with pytest.raises(ValueError, match=message):
            batch.missing_rows(cases_of(read_suite(suite), methods=[name]), tmp_path / "out", None)


def test_rows_of_other_code_are_stale_in_the_report(
    measured: Path, suite: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "bench", "report", suite, "-o", str(measured)) == 0
    page = Path(capsys.readouterr().out.strip()).read_text("utf-8")
    assert page.count("data:image/webp") == 1
    assert "<title>Two rows of a pot - tumble</title>" in page
    document, markdown = measured / "pot.json", measured / "pot.md"
    assert "1 failed, 0 stale" in markdown.read_text("utf-8")
    assert "| GLB: albedo object [dB] |" in markdown.read_text("utf-8")
    before, now = markdown.read_text("utf-8"), code.current_code()
    other = {**now, "fingerprint": "0" * 16}
    monkeypatch.setattr(code, "current_code", lambda: other)
    batch.report_suite(suite, measured)
    # Other code of stage 1 leaves the row with given poses as it is.
    assert "1 failed, 1 stale" in markdown.read_text("utf-8")
    other["fingerprint_given"] = "1" * 16
    batch.report_suite(suite, measured)
    assert "1 failed, 2 stale" in markdown.read_text("utf-8")
    assert "## Means" not in markdown.read_text("utf-8")
    stale = json.loads(document.read_text("utf-8"))
    assert len(stale["rows"]) == 2
    document.write_text(json.dumps({**stale, "code": now}))
    batch.report_suite(str(document), measured)
    assert markdown.read_text("utf-8") == before


def test_a_report_can_be_of_a_selection_of_rows(
    measured: Path, suite: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "bench", "report", suite, "-o", str(measured), "--only", "given", "--seeds", "0", "1") == 0
    text = (measured / "pot.md").read_text("utf-8")
    assert "1 of 2 rows: 0 failed" in text
    assert "| pot-room-handheld-original-given-tumble-seed1 | not measured |" in text


def test_a_missing_data_folder_is_named_with_the_fix_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(captures.DATA_VARIABLE, raising=False)
    out = tmp_path / "out"
    for folder, message in (((), "no data folder is given"), (("--data", str(tmp_path)), "is missing")):
        assert run(monkeypatch, "bench", "run", "tune", "-o", str(out), *folder) == 1
        error = capsys.readouterr().err
        assert message in error
        assert "--data or in TUMBLE_BENCH_DATA" in error
    assert not out.exists()


@pytest.mark.slow
def test_a_batch_reconstructs_each_capture_and_reports_the_one_that_fails(measured: Path, tmp_path: Path) -> None:
    (good,) = (measured / captures.CAPTURES).glob("*/")
    (tmp_path / "nothing").mkdir()
    how = SMOKE, FootageOptions(), batch.Workers(jobs=2)
    outcomes = list(batch.run_batch([good, tmp_path / "nothing"], tmp_path / "runs", *how))
    found = {outcome.task.name: outcome for outcome in outcomes}
    assert found[good.name].result == tmp_path / "runs" / good.name / "report.html"
    assert "nothing" in found["nothing"].error


def test_captures_of_a_batch_need_different_names(tmp_path: Path) -> None:
    (tmp_path / "mug.mp4").touch()
    (tmp_path / "mug").mkdir()
    (tmp_path / "mug.v2").mkdir()
    captures = [tmp_path / "mug.mp4", tmp_path / "mug.v2", tmp_path / "mug"]
    with pytest.raises(ValueError, match="several captures have the name mug:"):
        batch.run_batch(captures, tmp_path, SMOKE, FootageOptions(), batch.Workers())
    assert batch.run_batch(captures[:2], tmp_path / "out", SMOKE, FootageOptions(), batch.Workers()), "not started yet"


def test_a_batch_goes_into_a_folder_of_its_own(tmp_path: Path) -> None:
    """Which may be one of an earlier version, without a mark; logs clash with no capture, not even with "logs"."""
    own, other = tmp_path / "own", tmp_path / "other"
    (own / "mug" / "capture").mkdir(parents=True)
    for folder in (own, other):
        (folder / "logs").mkdir(parents=True)
    (other / "logs.txt").write_text("mine")
    how = SMOKE, FootageOptions(), batch.Workers(jobs=1)
    with pytest.raises(BadFile, match=r"other: holds other files.*choose another folder"):
        batch.run_batch([tmp_path / "logs"], other, *how)
    assert sorted(path.name for path in other.iterdir()) == ["logs", "logs.txt"]
    for _ in range(2):
        (outcome,) = batch.run_batch([tmp_path / "logs"], own, *how)
        assert "logs" in outcome.error
    assert sorted(path.name for path in own.iterdir()) == [".logs", "batch.json", "logs", "mug"]
    assert (own / ".logs" / "logs.log").is_file()


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(BadFile, match="holds other files"):
        list(batch.run_rows([], tmp_path, batch.Workers()))
