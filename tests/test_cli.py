"""The command line: help is there, errors are one line with exit code 1, nothing needs a display."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import tumble
from tests.films import scene, written
from tests.test_interrupt import capture, whole  # noqa: F401 (fixtures)
from tumble import __main__, actions, cli, pipeline
from tumble.preprocess.options import FRAMES_AND_SIZE, FootageOptions
from tumble.recipes import DRAFT, PAPER, QUICK_TRACK, Recipe
from tumble.scene.environment import Environment


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Exit code of the command, run inside this process."""
    monkeypatch.setattr(sys, "argv", ["tumble", *words])
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.parametrize(
    "command",
    ["doctor", "synth", "check", "run", "view", "relight", "export", "report", "evaluate", "bench", "batch", "demo"],
)
def test_every_command_explains_itself(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, command, "--help") == 0
    assert f"tumble {command}" in capsys.readouterr().out


def test_ctrl_c_while_the_command_line_is_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted:
        @staticmethod
        def find_spec(name: str, path: object = None, target: object = None) -> None:
            if name == "tumble.cli":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "tumble.cli")
    monkeypatch.setattr(sys, "meta_path", [Interrupted, *sys.meta_path])
    with pytest.raises(SystemExit) as end:
        __main__.main()
    assert end.value.code == 130
    assert capsys.readouterr().err == "tumble: interrupted; repeat the command\n"


@pytest.mark.parametrize("command", ["check", "run"])
def test_the_help_names_frames_and_size_of_every_quality(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, command, "--help") == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    frames, size = ({quality: pair[k] for quality, pair in FRAMES_AND_SIZE.items()} for k in (0, 1))
    for usual in (frames, size):
        assert usual["full"] == usual["paper"]
        assert f"draft {usual['draft']}, standard {usual['standard']}, full and paper {usual['paper']}." in said


def test_the_help_says_that_poses_are_estimated_on_the_cpu(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where it speaks of a GPU: at the device, at the route and at the quality of the paper."""
    assert run(monkeypatch, "run", "--help") == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Poses are estimated on the CPU, with any device" in said
    assert "Both run on the CPU, whatever --device is." in said
    assert "takes days on the CPU unless poses are given" in said


def test_a_film_is_converted_as_the_quality_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder with a capture of another quality is refused, before any work; explicit numbers take precedence."""
    film, out = written(scene().pictures, tmp_path / "x.mp4"), tmp_path / "run"
    pipeline.capture_of(film, out, FootageOptions(box=scene().box(), focal=300.0))
    words = ["run", str(film), "-o", str(out), "--box", *map(str, scene().box()), "--focal", "300"]
    assert run(monkeypatch, *words, "--quality", "standard") == 1
    refused = capsys.readouterr().err
    assert "options.frames is 144 in the folder, 200 was requested" in refused
    assert "options.size is 256 in the folder, 512 was requested" in refused
    assert run(monkeypatch, *words, "--quality", "paper", "--frames", "144") == 1
    refused = capsys.readouterr().err
    assert "options.frames" not in refused
    assert "options.size is 256 in the folder, 800 was requested" in refused


@pytest.mark.parametrize(
    ("words", "track"),
    [
        ((), DRAFT.track),
        (("--route", "progressive"), QUICK_TRACK),
        (("--quality", "paper"), PAPER.track),
        (("--quality", "paper", "--route", "progressive"), PAPER.track),
        (("--quality", "paper", "--route", "graph"), DRAFT.track),
    ],
)
def test_the_route_chooses_stage_1(words: tuple[str, ...], track: object, monkeypatch: pytest.MonkeyPatch) -> None:
    recipes: list[Recipe] = []
    monkeypatch.setattr(actions, "run_capture", lambda *given, **more: recipes.append(given[2]))
    assert run(monkeypatch, "run", "capture", "-o", "run", *words) == 0
    assert [recipe.track for recipe in recipes] == [track]


def test_a_check_selects_as_many_frames_as_the_run_that_it_is_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    film = written(scene().pictures, tmp_path / "x.mp4")
    words = ["check", str(film), "-o", str(tmp_path / "c"), "--box", *map(str, scene().box()), "--focal", "300"]
    run(monkeypatch, *words, "--quality", "full", "--frames", "7")
    assert "7 selected" in capsys.readouterr().out


def test_checks_of_folders_whose_names_have_a_dot_do_not_share_a_preview(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    monkeypatch.setattr("tumble.preprocess.check_footage", lambda _, folder, *__, **___: seen.append(str(folder)) or [])
    monkeypatch.chdir(tmp_path)
    for name in ("can.1", "can.2"):
        (tmp_path / name).mkdir()
        run(monkeypatch, "check", name)
    run(monkeypatch, "check", "clip.mp4")
    assert seen == ["runs/check/can.1", "runs/check/can.2", "runs/check/clip"]


def test_a_batch_converts_films_as_the_quality_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(
        "tumble.batch.run_batch", lambda _captures, _out, _recipe, options, *_, **__: seen.append(options) or []
    )
    assert run(monkeypatch, "batch", "x.mp4", "-o", str(tmp_path / "b"), "--quality", "standard") == 0
    assert [(each.frames, each.size) for each in seen] == [FRAMES_AND_SIZE["standard"]]


def test_numbers_of_processes_and_captures_are_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, message in (
        (["batch", "x.mp4", "-o", "b", "--jobs", "-1"], "--jobs is out of range: -1"),
        (["bench", "make", "smoke", "-o", "b", "--jobs", "-1"], "--jobs is out of range: -1"),
        (["batch", "-o", "b"], "no captures are given"),
        (["synth", "x.glb", "--env", "white", "-o", "b", "--seed", "-1"], "seed is out of range: -1"),
    ):
        monkeypatch.chdir(tmp_path)
        assert run(monkeypatch, *words) == 1, words
        assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_reader_that_stops_early_is_no_error() -> None:
    words = [sys.executable, "-u", "-m", "tumble", "bench", "list", "paper-table1"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""


def test_public_names_are_completed() -> None:
    assert set(tumble.__all__) <= set(dir(tumble))


def test_the_doctor_names_the_renderer_and_every_fix_is_an_instruction(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "doctor") == 0
    out = capsys.readouterr().out
    assert "tumble synth" in out
    assert "torch" in out
    for line in out.splitlines():
        if line.strip().startswith("->"):
            assert any(word in line for word in ("install", "pip", "close", "optional")), line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["synth", "nowhere.glb", "--env", "white", "-o", "OUT"], "nowhere.glb: is missing"),
        (["synth", "nowhere.glb", "--env", "white", "-o", "OUT", "--fov", "500"], "fov is out of range: 500"),
        (["evaluate", "nowhere", "nowhere-either"], "nowhere-either: is missing"),
        (["evaluate", "nowhere"], "nowhere is not a finished run: give the capture"),
        (["evaluate", "nowhere", "--glb", "nowhere.glb"], "nowhere.glb: is missing"),
        (["evaluate", "nowhere", "--glb", __file__], "export.json: is missing (give asset.glb where"),
        (["report", "caf\udce9"], "'caf\\udce9' is not valid UTF-8: rename the file or folder"),
        (["run", "film.mp4", "-o", "OUT", "--matcher", "mixd"], "no 'mixd' in tumble/matching; available: aliked"),
    ],
)
def test_an_error_is_one_line_that_names_the_file_and_ends_with_code_1(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("TUMBLE_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *(str(tmp_path / "out") if word == "OUT" else word for word in words)) == 1
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_what_is_printed_of_names_is_one_line_without_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """Of predictions, captures, lights and videos of somebody else."""
    name = "a [/red] \x1b[2J\n"
    cli._print_finding("!", "video", name, name, width=10)
    scores = {"regions": {"shared": {name: 1.0}}, "light": {}, "poses": {}, "published": {}, "notes": [name]}
    cli._print_scores({"prediction": name, "capture": {"name": name}, **scores})  # type: ignore[arg-type]
    printed = capsys.readouterr().out
    assert printed.count(r"a [/red] \x1b[2J\n") >= 5
    assert "\x1b" not in printed


def test_names_of_scores_are_whole_in_80_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where there is no terminal, with the GLB beside the run; sentences are not broken."""
    monkeypatch.setenv("COLUMNS", "80")
    keys = ("relit.wooden_studio_12_4k.lpips_full_srgb_alex", "relit.wooden_studio_12_4k.lpips_crop_srgb_alex")
    note = "views: " + "rendered in the capture's object frame without alignment, " * 2
    scores = {"regions": {region: dict.fromkeys(keys, 24.37) for region in ("shared", "sphere")}, "notes": [note]}
    report = {"prediction": "p", "capture": {"name": "c"}, "light": {}, "poses": {}, "published": {}, **scores}
    cli._print_scores(report, report)  # type: ignore[arg-type]
    lines = capsys.readouterr().out.splitlines()
    names = "".join(line.split("│")[1].strip() for line in lines if line.startswith("│"))
    assert names == "".join(keys)
    assert lines[-1].strip() == f"note: {note}".strip()


def test_an_unknown_command_ends_with_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "juggle") == 2
    assert "juggle" in capsys.readouterr().err


def test_progress_goes_to_standard_error_and_the_result_to_standard_output(
    whole: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line per task where there is no terminal; the next command does not print it twice."""
    Environment.from_radiance(torch.rand(8, 16, 3)).write(tmp_path / "sun.hdr")
    for out in ("a", "b"):
        words = ["relight", str(whole), "--env", str(tmp_path / "sun.hdr"), "--fast", "-o", str(tmp_path / out)]
        assert run(monkeypatch, *words) == 0
        printed = capsys.readouterr()
        assert printed.err == "tumble: relighting under sun (8 steps)\n"
        assert printed.out.strip() == str(tmp_path / out)


def test_sigterm_ends_a_command_like_ctrl_c_and_only_what_resumes_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def doctor() -> None:
        signal.raise_signal(signal.SIGTERM)

    def demo() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "COMMANDS", (doctor, demo))
    found, resumed = signal.getsignal(signal.SIGTERM), "finished work is kept, repeat the command to resume"
    try:
        for command, advice in (("doctor", "repeat the command"), ("demo", resumed)):
            assert run(monkeypatch, command) == 130
            assert capsys.readouterr().err.endswith(f"tumble: interrupted; {advice}\n")
    finally:
        signal.signal(signal.SIGTERM, found)
    assert cli._resumes(["relight", "run", "--env", "x.hdr"])
    assert not cli._resumes(["relight", "run", "--env", "x.hdr", "--turntable=x.mp4"])


def test_the_help_names_the_option_for_the_version(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--help") == 0
    assert "--version" in capsys.readouterr().out


def test_the_installed_command_answers() -> None:
    answer = subprocess.run([sys.executable, "-m", "tumble", "--version"], check=True, capture_output=True, text=True)
    assert answer.stdout.startswith("tumble ")
