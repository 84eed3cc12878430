"""Whatever ends a run, at whatever moment: the same command goes on, and comes to the bits of a whole run.

A process is really killed (`os.fork`, SIGKILL): either at its n-th change of the file system, which reaches every
moment at which something could be half-written, or after some time.
"""

import dataclasses
import errno
import hashlib
import os
import random
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors
import torch

from tests.engine.test_loop import full_disk
from tests.films import scene, written
from tests.scene.test_visual_hull import silhouettes
from tumble import actions, pipeline, recipes
from tumble.datasets import _capture_folder, folder
from tumble.engine import run
from tumble.io import files, video
from tumble.io.files import BadFile
from tumble.preprocess.options import FootageOptions
from tumble.scene.capture import OBJECT, Capture
from tumble.scene.environment import Environment

RECIPE = dataclasses.replace(recipes.SMOKE, seed=3)
RANDOM = random.Random(0)
FILM_OPTIONS = FootageOptions(box=scene().box(), focal=300.0, frames=16)
CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "tempfile.mkstemp", "tempfile.mkdtemp"}
"""Events of `sys.addaudithook` that come right before the file system changes; and "open" for writing."""


def finished_run(out: Path) -> dict[str, str]:
    """Hashes of all that a run decides: what its clocks write down does not count."""
    clocks = {run.LOG, run.RECIPE}
    found = {p.relative_to(out): p for p in out.rglob("*") if p.is_file() and p.name not in clocks}
    return {str(name): hashlib.sha256(content(path)).hexdigest() for name, path in sorted(found.items())}


def content(path: Path) -> bytes:
    """What a file says; safetensors writes the facts of its header in any order. Films say how many frames they have
    and how large: x264 writes the same frames in other bits, and now and then a sample one level off (`brightness`)."""
    if path.suffix == ".mp4":
        return str([frame.shape for frame in video.read_clip(path)]).encode()
    if path.suffix != ".safetensors":
        return path.read_bytes()
    with safetensors.safe_open(path, framework="np") as file:
        tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
        facts = sorted((file.metadata() or {}).items())
    return str([facts, [(name, x.shape, x.dtype) for name, x in tensors.items()]]).encode() + b"".join(
        x.tobytes() for x in tensors.values()
    )


def brightness(out: Path) -> list[float]:
    """Mean of every frame of a run's films."""
    return [float(frame.mean()) for film in sorted(out.rglob("*.mp4")) for frame in video.read_clip(film)]


def ending(child: Callable[[], object], seconds: float = 120) -> int:
    """The exit code of a forked process that does something; minus the signal that killed it."""
    with warnings.catch_warnings():
        # Of forks beside threads, whose locks the child does not touch.
        warnings.simplefilter("ignore", DeprecationWarning)
        process = os.fork()
    if process == 0:
        try:
            signal.alarm(120)
            sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (the process ends here)
            child()
            os._exit(0)
        finally:
            os._exit(1)
    end = time.monotonic() + seconds
    while (found := os.waitpid(process, os.WNOHANG))[0] == 0:
        if time.monotonic() > end:
            os.kill(process, signal.SIGKILL)
            found = os.waitpid(process, 0)
            break
        time.sleep(0.005)
    return os.waitstatus_to_exitcode(found[1])


def killed_at(n: int, under: Path) -> None:
    """This process dies before its n-th change of the file system under a folder."""
    seen = 0

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal seen
        changes = event in CHANGES or (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & os.O_ACCMODE
        )
        if changes and any(str(argument).startswith(str(under)) for argument in arguments):
            seen += 1
            if seen == n:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grey ellipsoid with a bright half: eight frames with poses."""
    frames, trajectory = silhouettes(8, 32)
    shade = torch.linspace(60, 220, 32).to(torch.uint8)[None, None, :, None]
    images = torch.where(frames.masks[..., None] == OBJECT, shade, 0).to(torch.uint8).repeat(1, 1, 1, 3)
    taken = Capture(images, frames.masks, frames.camera, frames.names, "camera", trajectory)
    path = tmp_path_factory.mktemp("capture") / "c"
    _capture_folder.save_capture(path, taken)
    return path


@pytest.fixture(scope="module")
def whole(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "whole"
    pipeline.reconstruct(capture, out, RECIPE)
    return out


def killed_and_resumed(capture: Path, out: Path, n: int) -> dict[str, str]:
    assert ending(lambda: (killed_at(n, out), pipeline.reconstruct(capture, out, RECIPE))) == -signal.SIGKILL
    pipeline.reconstruct(capture, out, RECIPE)
    return finished_run(out)


def test_a_run_killed_while_it_writes_goes_on_to_the_same_bits(capture: Path, whole: Path, tmp_path: Path) -> None:
    """Right before stage 2's output is put in place, and right before its key is."""
    for n in (26, 33):
        assert killed_and_resumed(capture, tmp_path / str(n), n) == finished_run(whole), f"killed at change {n}"


@pytest.mark.slow
@pytest.mark.parametrize("n", range(1, 84, 4))
def test_a_run_killed_at_any_change_of_its_folder_goes_on_to_the_same_bits(
    capture: Path, whole: Path, tmp_path: Path, n: int
) -> None:
    """A run changes its folder 83 times."""
    assert killed_and_resumed(capture, tmp_path / "run", n) == finished_run(whole)


@pytest.mark.slow
def test_a_run_of_a_film_killed_at_ten_random_moments_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    """Survey, frames, masks, matches, poses and all that follows."""
    film = written(scene().pictures, tmp_path / "x.mp4")

    def everything(out: Path) -> None:
        pipeline.reconstruct(pipeline.capture_of(film, out, FILM_OPTIONS), out, RECIPE)

    # The first one also compiles and loads what the others find ready.
    everything(tmp_path / "warm")
    begun = time.monotonic()
    assert ending(lambda: everything(tmp_path / "whole")) == 0
    seconds = time.monotonic() - begun
    wanted = finished_run(tmp_path / "whole")
    assert wanted == finished_run(tmp_path / "warm")
    for number in range(10):
        out, moment = tmp_path / f"run{number}", RANDOM.uniform(0, seconds)
        # May come to an end before, when it is faster than the first.
        assert ending(lambda out=out: everything(out), moment) in (-signal.SIGKILL, 0)
        everything(out)
        assert finished_run(out) == wanted, f"killed after {moment:.2f} s of {seconds:.2f}"
        assert brightness(out) == pytest.approx(brightness(tmp_path / "whole"), abs=0.2)


# Two processes --------------------------------------------------------------------------------------------------------


def test_two_processes_never_work_in_one_folder_and_a_killed_one_lets_go(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    inside, told = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        process = os.fork()
    if process == 0:
        with run.exclusive_access(out):
            os.write(told, b"x")
            time.sleep(60)
        os._exit(0)
    assert os.read(inside, 1) == b"x"
    with pytest.raises(BadFile, match=rf"run: is in use by another process, {process} \(wait until"):
        pipeline.reconstruct(capture, out, RECIPE)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    assert (out / run.LOCK).exists()
    is_locked = pytest.raises(BadFile, match=f"another process, {os.getpid()}")
    with run.exclusive_access(out), is_locked, run.exclusive_access(out):
        pass
    assert not out.exists() or list(out.iterdir()) == []


def test_a_lock_leaves_nothing_where_nothing_was_made(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match="nothing readable"), run.exclusive_access(tmp_path / "run"):
        raise BadFile(tmp_path, "nothing readable")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(BadFile, match="is a file"), run.exclusive_access(tmp_path / "file"):
        pass


def test_only_what_dead_processes_left_half_written_is_swept(tmp_path: Path) -> None:
    dead = os.fork()
    if dead == 0:
        os._exit(0)
    os.waitpid(dead, 0)
    for owner in (dead, os.getpid(), os.getppid()):
        (tmp_path / "a" / f"{files.PARTIAL_PREFIX}{owner}-xyz").mkdir(parents=True)
        (tmp_path / f"{files.PARTIAL_PREFIX}{owner}-xyz.png").write_text("half of i")
    (tmp_path / "a" / "kept.png").write_text("")
    files.remove_partial_files(tmp_path)
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*"))
    living = f"{files.PARTIAL_PREFIX}{os.getppid()}-xyz"
    assert left == [f"{living}.png", "a", f"a/{living}", "a/kept.png"]


# What is damaged, full or closed --------------------------------------------------------------------------------------


def halve(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)


def flip_a_byte(path: Path) -> None:
    """In the middle of the tensors, where each value is as good as another for the format of the file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [halve, flip_a_byte])
@pytest.mark.parametrize("name", ["2-refine/out.safetensors", "3-decompose/out.safetensors", "asset.safetensors"])
def test_a_damaged_output_is_named_with_the_fix_and_the_fix_works(
    capture: Path, whole: Path, tmp_path: Path, name: str, damage: Callable[[Path], None]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    damage(out / name)
    read = (lambda: actions.finished(out)) if name == run.ASSET else None
    with pytest.raises(BadFile, match=rf"{name}: is damaged: .*\(remove it and run the command that made it again\)"):
        read() if read else pipeline.reconstruct(capture, out, RECIPE)
    (out / name).unlink()
    pipeline.reconstruct(capture, out, RECIPE)
    assert finished_run(out) == finished_run(whole)


def test_half_a_line_of_the_log_spoils_no_other(tmp_path: Path) -> None:
    opened = run.open(tmp_path / "run", Path("clip"), RECIPE)
    assert run.log_records(opened.path) == []
    run.log(opened, {"n": 1})
    with (opened.path / run.LOG).open("a") as file:
        file.write('{"time": "2026-')
    run.log(opened, {"n": 2})
    assert [record["n"] for record in run.log_records(opened.path)] == [1, 2]


def test_a_full_disk_or_a_closed_folder_names_the_file_and_the_fix(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    light = tmp_path / "sun.hdr"
    Environment.from_radiance(torch.rand(8, 16, 3)).write(light)
    before = finished_run(whole)
    with full_disk(500), pytest.raises(OSError, match=r"0000\.png: cannot be written: File too large"):
        actions.relight_run(whole, light, tmp_path / "pictures", fast=True)
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == [actions.LIGHT_FILE]
    with full_disk(3000), pytest.raises(OSError, match=r"asset\.ply: cannot be written"):
        actions.export_run(whole, tmp_path / "export", "splat", None)
    assert not list((tmp_path / "export").iterdir())
    for name, write in (("x.exr", files.write_exr), ("x.hdr", files.write_hdr)):
        with full_disk(100), pytest.raises(OSError, match=rf"{name}: cannot be written: .*(too large|full)"):
            write(tmp_path / name, torch.rand(8, 16, 3).numpy())
    assert finished_run(whole) == before

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OSError, match=r"system \(choose a folder that can be written"), run.exclusive_access(whole):
        pass


# Films ----------------------------------------------------------------------------------------------------------------


def test_a_run_takes_up_the_capture_of_its_own_film_and_options_alone(tmp_path: Path) -> None:
    film, out = written(scene().pictures, tmp_path / "x.mp4"), tmp_path / "run"
    made = pipeline.capture_of(film, out, FILM_OPTIONS)
    before = finished_run(out)
    assert pipeline.capture_of(film, out, FILM_OPTIONS) == made
    film.rename(tmp_path / "moved.mp4")
    assert pipeline.capture_of(tmp_path / "moved.mp4", out, FILM_OPTIONS) == made
    with pytest.raises(BadFile, match=r"other options: options\.frames is 16 in the folder, 12 was requested"):
        pipeline.capture_of(tmp_path / "moved.mp4", out, dataclasses.replace(FILM_OPTIONS, frames=12))
    with pytest.raises(BadFile, match=r"of other footage or made .*: footage is"):
        pipeline.capture_of(written(scene(18).pictures, film), out, FILM_OPTIONS)
    assert finished_run(out) == before


def test_masks_by_another_path_and_files_of_file_managers_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for i in range(6):
        files.write_png(tmp_path / "in" / f"{i}.png", scene().pictures[i])
        files.write_png(tmp_path / "m" / f"{i}.png", scene().object[i][..., None] * np.uint8(255))
    monkeypatch.chdir(tmp_path)
    options = FootageOptions(fov=40.0, masks=Path("m"))
    made = pipeline.capture_of(tmp_path / "in", tmp_path / "run", options)
    for name in (".DS_Store", "._0.png", "Thumbs.db", ".cache/0.png"):
        files.write_atomically(tmp_path / "in" / name, lambda partial: partial.write_bytes(b"0"))
    options = dataclasses.replace(options, masks=tmp_path / "m")
    assert pipeline.capture_of(tmp_path / "in", tmp_path / "run", options) == made
    with pytest.raises(BadFile, match=r"masks is .* in the folder, '' was requested"):
        pipeline.capture_of(tmp_path / "in", tmp_path / "run", dataclasses.replace(options, masks=None))
    files.write_png(tmp_path / "m" / "3.png", scene().object[2][..., None] * np.uint8(255))
    with pytest.raises(BadFile, match="masks is"):
        pipeline.capture_of(tmp_path / "in", tmp_path / "run", options)


def test_a_folder_of_pictures_is_footage_unless_it_is_a_capture(capture: Path, tmp_path: Path) -> None:
    for i in range(6):
        alpha = np.where(scene().object[i], 255, 0).astype(np.uint8)
        files.write_png(tmp_path / "in" / f"{i}.png", np.dstack([scene().pictures[i], alpha]))
    made = pipeline.capture_of(tmp_path / "in", tmp_path / "run", FootageOptions(fov=40.0))
    assert len(folder.load(made)) == 6
    assert pipeline.capture_of(capture, tmp_path / "other", FootageOptions()) == capture
    assert not (tmp_path / "other").exists()


def test_lights_of_the_same_name_get_folders_of_their_own(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    lights = [tmp_path / name / "studio.hdr" for name in ("a", "b")]
    for light in lights:
        Environment.from_radiance(torch.rand(8, 16, 3)).write(light)
    folders = [actions.relight_run(out, light, fast=True) for light in (*lights, lights[0])]
    assert [path.name for path in folders] == ["studio", "studio-2", "studio"]
    dark = files.read_image(folders[0] / "0000.png").mean()
    actions.relight_run(out, lights[0], fast=True, exposure=1.0)
    bright = files.read_image(folders[0] / "0000.png").mean()
    assert bright > 1.2 * dark


def test_relighting_goes_on_with_the_images_that_are_missing(whole: Path, tmp_path: Path) -> None:
    """Of the same object, light, exposure and method; the light map may be moved."""
    out, light = tmp_path / "pictures", tmp_path / "day.hdr"
    Environment.from_radiance(torch.rand(8, 16, 3)).write(light)
    actions.relight_run(whole, light, out, fast=True)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for number in (2, 5):
        (out / f"{number:04}.png").unlink()
    files.write_png(out / "0000.png", np.zeros((2, 2, 1), np.uint8))
    mark = (out / "0000.png").read_bytes()
    actions.relight_run(whole, light.rename(tmp_path / "moved.hdr"), out, fast=True)
    after = {path.name: path.read_bytes() for path in out.iterdir()}
    assert after | {actions.LIGHT_FILE: b""} == before | {"0000.png": mark, actions.LIGHT_FILE: b""}
    actions.relight_run(whole, tmp_path / "moved.hdr", out, fast=True, exposure=0.5)
    assert (out / "0000.png").read_bytes() not in (mark, before["0000.png"])


def test_no_image_of_an_earlier_light_stays_under_the_name_of_another(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the other run has fewer frames, or its command is interrupted. Pictures of the user stay."""
    out, lights = tmp_path / "pictures", [tmp_path / "day.hdr", tmp_path / "night.hdr"]
    for light in lights:
        Environment.from_radiance(torch.rand(8, 16, 3)).write(light)

    def pictures() -> list[str]:
        return sorted(path.name for path in out.glob("*.png"))

    asset, mine = actions.finished(whole), ["0077.png", "front.png"]
    for name in ("0001.png", *mine):
        files.write_png(out / name, np.zeros((2, 2, 1), np.uint8))
    actions.relight_run(whole, lights[0], out, fast=True, overwrite=True)
    numbered = [f"{i:04}.png" for i in range(8)]
    assert pictures() == [*numbered, *mine]
    few, names = dataclasses.replace(asset, trajectory=asset.trajectory.select([0, 1, 2])), run.frame_names(whole)
    assert files.read_json(out / actions.LIGHT_FILE)["frames"] == names
    with monkeypatch.context() as patch:
        patch.setattr(actions, "finished", lambda *_: few)
        patch.setattr(run, "frame_names", lambda *_: names[:3])
        actions.relight_run(whole, lights[1], out, fast=True)
    assert pictures() == [*numbered[:3], *mine]
    assert "night" in files.read_json(out / actions.LIGHT_FILE)["light"]
    actions.relight_run(whole, lights[1], out, fast=True)
    with full_disk(500), pytest.raises(OSError, match=r"0000\.png: cannot be written"):
        actions.relight_run(whole, lights[0], out, fast=True)
    assert pictures() == mine
    assert "day" in files.read_json(out / actions.LIGHT_FILE)["light"]
