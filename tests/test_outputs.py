"""Outputs of all commands: nothing is overwritten silently, and every refusal is one line that names the fix."""

import contextlib
import errno
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.films import scene, written
from tests.test_cli import run
from tests.test_interrupt import RECIPE, capture, whole  # noqa: F401 (fixtures)
from tumble import actions, cli, pipeline
from tumble.io import files, video
from tumble.io.files import BadFile
from tumble.preprocess.options import FootageOptions
from tumble.report import write_report
from tumble.scene.environment import Environment


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("light") / "sun.hdr"
    Environment.from_radiance(torch.rand(8, 16, 3)).write(path)
    return path


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(scene().pictures, tmp_path_factory.mktemp("film") / "x.mp4")


@pytest.fixture
def command(
    whole: Path,  # noqa: F811
    light: Path,
    film: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., str]:
    """A function that runs a command and returns its error message, which has one line; "" if there is none."""
    monkeypatch.delenv("TUMBLE_DEBUG", raising=False)
    monkeypatch.setattr(cli, "_progress_lines", contextlib.nullcontext)
    monkeypatch.setattr(actions, "TURNTABLE_FRAMES", 2)
    monkeypatch.setattr(actions, "TURNTABLE_SIDE", 32)
    words = {
        "export": ["export", str(whole), "--preset", "splat"],
        "relight": ["relight", str(whole), "--env", str(light), "--fast"],
        "evaluate": ["evaluate", str(whole)],
        "report": ["report", str(whole)],
        "check": ["check", str(film), "--box", *map(str, scene().box())],
        "run": ["run", str(film), "--box", *map(str, scene().box())],
        "synth": ["synth", str(film), "--env", "white"],
        "demo": ["demo"],
    }

    def called(name: str, *more: object) -> str:
        capsys.readouterr()
        code = run(monkeypatch, *words[name], *map(str, more))
        error = capsys.readouterr().err
        assert code in (0, 1)
        # A check may find the clip unsuitable.
        assert name == "check" or (code == 1) == bool(error), error
        assert len(error.splitlines()) <= 1, error
        return error

    return called


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["export", "relight", "evaluate", "check", "run", "synth", "demo"])
def test_a_folder_of_something_else_is_not_touched(command: Callable[..., str], name: str, tmp_path: Path) -> None:
    for taken in ("0000.png", "poses.json", "report.json", "asset.ply"):
        (tmp_path / taken).write_text("of somebody else")
    before = content(tmp_path)
    assert str(tmp_path) in command(name, "-o", tmp_path)
    assert content(tmp_path) == before


@pytest.mark.parametrize("name", ["export", "relight", "evaluate", "check"])
def test_a_run_directory_is_something_else(
    command: Callable[..., str],
    name: str,
    whole: Path,  # noqa: F811
) -> None:
    before = content(whole)
    out = whole / "2-refine" if name == "evaluate" else whole
    error = command(name, "-o", out)
    assert "holds other files" in error
    assert "--overwrite" in error
    assert content(whole) == before


@pytest.mark.parametrize("name", ["export", "relight"])
def test_own_output_is_written_again_and_overwrite_insists(
    command: Callable[..., str], name: str, tmp_path: Path
) -> None:
    assert command(name, "-o", tmp_path / "new") == ""
    assert command(name, "-o", tmp_path / "new") == ""
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("kept")
    assert "holds other files" in command(name, "-o", tmp_path / "other")
    assert command(name, "-o", tmp_path / "other", "--overwrite") == ""
    assert (tmp_path / "other" / "mine.txt").read_text() == "kept"
    assert content(tmp_path / "new").keys() < content(tmp_path / "other").keys()


@pytest.mark.parametrize("name", ["export", "relight", "evaluate", "check", "run", "synth", "demo"])
def test_an_output_that_is_a_file_is_said_to_be_one(command: Callable[..., str], name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        error = command(name, "-o", out)
        assert "is a file" in error
        assert "choose another" in error or "choose a new" in error
    assert content(tmp_path) == {"file": b"kept"}


def test_the_extension_of_a_turntable_video_is_its_format(command: Callable[..., str], tmp_path: Path) -> None:
    for name, magic in (("x.mp4", b"ftypisom"), ("x.mov", b"ftypqt"), ("x.MKV", b"matroska")):
        assert command("relight", "--turntable", tmp_path / name) == ""
        assert magic in (tmp_path / name).read_bytes()[:64]
        assert len(list(video.read_clip(tmp_path / name))) == 2
    for name in ("x.gif", "x", "x.webm"):
        error = command("relight", "--turntable", tmp_path / name)
        assert f"has the extension '{Path(name).suffix}' (these can be written: .mp4, .mov, .mkv)" in error
        assert not (tmp_path / name).exists()
    error = command("relight", "--turntable", tmp_path / "y.mp4", "-o", tmp_path / "y")
    assert "leave one of them out" in error
    assert not list(tmp_path.glob("y*"))
    (tmp_path / "x.mp4").write_text("of somebody else")
    assert "exists already (" in command("relight", "--turntable", tmp_path / "x.mp4")
    assert (tmp_path / "x.mp4").read_text() == "of somebody else"
    assert command("relight", "--turntable", tmp_path / "x.mp4", "--overwrite") == ""
    assert len(list(video.read_clip(tmp_path / "x.mp4"))) == 2


def test_the_functions_for_notebooks_follow_the_same_rule(
    whole: Path,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    asset = actions.finished(whole)
    (tmp_path / "poses.json").write_text("of somebody else")
    with pytest.raises(BadFile, match="holds other files"):
        actions.export_asset(asset, tmp_path, "splat")
    with pytest.raises(BadFile, match="holds other files"):
        actions.evaluate(asset, capture, out=tmp_path)
    assert content(tmp_path) == {"poses.json": b"of somebody else"}
    actions.export_asset(asset, tmp_path, "splat", overwrite=True)
    with pytest.raises(ValueError, match=r"the capture has 1 frames, the trajectory 8: select those"):
        actions.export_asset(asset, tmp_path / "few", capture=pipeline.read_capture(capture).select([0]))


def test_a_capture_that_has_changed_is_not_taken_for_that_of_the_run(
    whole: Path,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    run_folder, moved = tmp_path / "run", tmp_path / "moved.v2"
    shutil.copytree(whole, run_folder)
    shutil.copytree(capture, moved)
    assert "<h1>moved.v2</h1>" in write_report(run_folder, capture=moved).read_text()
    photo = next(moved.glob("images/*.png"))
    files.write_png(photo, 255 - files.read_image(photo))
    with pytest.raises(BadFile, match="images, masks or camera have changed since"):
        write_report(run_folder, capture=moved)
    recipe = run_folder / "recipe.json"
    recipe.write_text(recipe.read_text().replace(str(capture.resolve()), str(moved)))
    with pytest.warns(UserWarning, match="have changed since.*baked from the Gaussians"):
        actions.export_run(run_folder, tmp_path / "out", "game", None)


def test_a_run_whose_capture_was_moved_says_how_to_go_on(
    whole: Path,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    out, moved, gone = tmp_path / "run", tmp_path / "moved", tmp_path / "gone"
    shutil.copytree(whole, out)
    shutil.copytree(capture, moved)
    recipe = out / "recipe.json"
    recipe.write_text(recipe.read_text().replace(str(capture.resolve()), str(gone)))
    advice = rf"{gone}: is the run's capture but does not exist \(.*repeat `tumble run NEW_CAPTURE -o {out}`.*--capture"
    for command in (actions.evaluate_run, write_report):
        with pytest.raises(BadFile, match=advice):
            command(out)
    with pytest.raises(BadFile, match=rf"{gone}: is missing"):
        write_report(out, capture=gone)
    with pytest.warns(UserWarning, match=rf"{advice}.*baked from the Gaussians"):
        assert actions._frames_of_run(out, actions.finished(out)) is None
    pipeline.reconstruct(moved, out, RECIPE)
    assert actions._frames_of_run(out, actions.finished(out)) is not None


def test_an_interrupted_evaluation_does_not_block_the_next(
    whole: Path,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("tumble.evaluation.evaluate.compare", interrupted)
        with pytest.raises(KeyboardInterrupt):
            actions.evaluate_run(whole, capture, tmp_path / "scores")
    report = actions.evaluate_folder(whole, capture, tmp_path / "scores")
    assert report["prediction"] == "scores"
    assert {path.name for path in (tmp_path / "scores").iterdir()} == {"prediction", "report.json", "sheet.png"}


def test_a_folder_that_cannot_be_written_is_noticed_before_any_work(
    command: Callable[..., str],
    whole: Path,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    for work in ("actions.write_asset", "actions.relight", "actions._scored", "report.page.capture_of_run"):
        monkeypatch.setattr(f"tumble.{work}", lambda *_, **__: pytest.fail("there was work"))
    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    message = "cannot be written: Read-only file system (choose a folder that can be written"
    for name in ("export", "relight", "evaluate", "report"):
        assert message in command(name)
    for words in (("export", "-o", tmp_path / "new" / "x"), ("relight", "--turntable", tmp_path / "x.mp4")):
        assert message in command(*words)
    monkeypatch.setattr(tempfile, "TemporaryDirectory", refuse)
    with pytest.raises(OSError, match="scores: cannot be written"), files.partial_folder(tmp_path / "scores"):
        pass


def test_the_output_may_not_lie_in_the_footage(tmp_path: Path, command: Callable[..., str]) -> None:
    """A run hashes its footage, so that it would find other footage when it is resumed."""
    source = tmp_path / "images"
    for i in range(6):
        alpha = np.where(scene().object[i], 255, 0).astype(np.uint8)
        files.write_png(source / f"{i}.png", np.dstack([scene().pictures[i], alpha]))
    before, options = content(tmp_path), FootageOptions(fov=40.0)
    for out in (source / "run", source, source / ".." / "images" / "a" / "b"):
        with pytest.raises(BadFile, match=r"lies in the input folder .*images \(choose a folder outside"):
            pipeline.capture_of(source, out, options)
        with pytest.raises(BadFile, match="lies in the input folder"):
            pipeline.video_to_capture(source, out, options)
        with pytest.raises(BadFile, match="lies in the input folder"):
            actions.run_capture(source, out, RECIPE, options)
    assert content(tmp_path) == before
    made = pipeline.capture_of(source, tmp_path / "images-run", options)
    assert pipeline.capture_of(source, tmp_path / "images-run", options) == made
    shutil.rmtree(tmp_path / "images-run")


@pytest.mark.parametrize("name", ["prediction", "relit", "export/splat", ".lock", "log.jsonl", "2-refine", "asset"])
def test_nothing_is_written_through_the_links_of_a_run_from_elsewhere(
    command: Callable[..., str],
    name: str,
    whole: Path,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    """Through them pictures of the user were removed, a file was replaced by a number, and another one extended."""
    mine, foreign = tmp_path / "mine", tmp_path / "foreign"
    (mine / "image").mkdir(parents=True)
    (mine / "image" / "photo.jpg").write_text("kept")
    (mine / "notes").write_text("kept")
    shutil.copytree(whole, foreign)
    place = foreign / name
    place.parent.mkdir(exist_ok=True)
    shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
    place.symlink_to(mine / "notes" if name in (".lock", "log.jsonl") else mine)
    before = content(mine)
    for call in (
        lambda: pipeline.reconstruct(capture, foreign, RECIPE),
        lambda: actions.evaluate_run(foreign, capture),
        lambda: actions.export_run(foreign, None, "splat", None),
        lambda: write_report(foreign),
    ):
        with pytest.raises(BadFile, match=rf"{name}: is a link to .*mine.*, outside of .*foreign \(remove it; "):
            call()
    for words in ("export", "relight"):
        out = tmp_path / words
        assert command(words, "-o", out) == ""
        (out / "more").symlink_to(mine)
        assert f"{out / 'more'}: is a link to {mine}" in command(words, "-o", out)
    assert content(mine) == before
