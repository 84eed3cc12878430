"""A run directory: the recipe, the log, and one folder per stage with what it made.

    runs/mug/  recipe.json  log.jsonl  1-track/  2-refine/  3-decompose/       while a process works in it: .lock
    2-refine/  out.safetensors  stage.json                      while it trains: state.safetensors

A *key* is a hash of all that decides a result: the stage and its version, its settings, the seed, and the keys of what
it reads. A stage whose result is there under its key is not run again. Truth never enters a key.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import torch
from torch import Tensor

from tumble import __version__
from tumble.engine import loop
from tumble.engine.loop import Progress
from tumble.io import BadFile, files, tree

T = TypeVar("T")

FORMAT = 2
"""Of run directories; raised when an older one can no longer be read."""
RECIPE, LOG, LOCK = "recipe.json", "log.jsonl", ".lock"
CAPTURE = "capture"
"""The capture that a film became."""
TRACK, REFINE, DECOMPOSE = "1-track", "2-refine", "3-decompose"
"""Folders of the stages."""
OUT, DONE, CHECKPOINT = "out.safetensors", "stage.json", "state.safetensors"
"""In the folder of a stage: its output, what made it, and its state while it trains."""
ASSET, POSES, LIGHT = "asset.safetensors", "poses.json", "light.exr"
"""The outcome: asset, camera-to-object pose by name of the frame, recovered light."""
REPORT, SCORES, PREDICTION, RELIT, EXPORT = "report.html", "report.json", "prediction", "relit", "export"
"""What is made of a finished run."""
NEUTRAL = tuple(f"{__name__.partition('.')[0]}.{room}" for room in ("engine", "io"))
"""Rooms whose constants decide no result."""
CHECKPOINTS = 20
"""A stage saves at most about this often: one on a GPU makes hundreds of steps in the time a save takes."""


@dataclass(frozen=True)
class Run:
    """An open run directory, or a run that keeps nothing."""

    path: Path | None
    """None: stages are not kept, and cannot be taken up again."""
    recipe: Any
    """A frozen dataclass of the stages' settings, with a `seed`."""
    report: Callable[[Progress], None] | None = None
    """Called as the stages go on."""


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Work in a run directory in which no other process works; what a killed one left half-written is cleared away.

    The lock is the system's, on a file in the directory: it ends with this process, however that ends.

    Raises:
        BadFile: Another process works in it, or it holds something else.
        OSError: The folder cannot be written.
    """
    _refuse_other(path)
    if os.name != "posix":
        yield  # other systems lack this kind of lock
        return
    made = not path.exists()
    handle = _locked(path)
    try:
        files.sweep(path)
        yield
    finally:
        (path / LOCK).unlink(missing_ok=True)
        os.close(handle)
        if made and not any(path.iterdir()):
            path.rmdir()


def _locked(path: Path) -> int:
    """The handle of a run directory's lock, which is this process's alone."""
    import fcntl

    while True:
        with files.writing(path / LOCK):
            path.mkdir(parents=True, exist_ok=True)
            handle = os.open(path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(handle, 32).decode(errors="replace")
            os.close(handle)
            fix = "wait until it ends, or choose another folder with -o"
            raise BadFile(path, f"is being worked in by another process, {owner}", fix) from None
        except OSError:
            return handle  # a file system without locks
        # The process before this one removes the file before it lets go of the lock.
        if (path / LOCK).exists() and os.path.samestat(os.stat(path / LOCK), os.fstat(handle)):
            # For people only; a full disk is told of when there is something to keep.
            with contextlib.suppress(OSError):
                os.truncate(handle, 0)
                os.write(handle, str(os.getpid()).encode())
            return handle
        os.close(handle)


def open(
    path: Path,
    capture_path: Path,
    recipe: Any,
    *,
    content: str = "",
    report: Callable[[Progress], None] | None = None,
) -> Run:
    """Take a folder for a run, or go on with the run that is in it. One that has made nothing yet is another's to take.

    Args:
        path: The run directory; may exist if it is empty or holds this very run.
        capture_path: Where the capture comes from.
        recipe: A frozen dataclass of frozen dataclasses with a `seed`.
        content: Hash of the capture. Where both runs have one it decides which captures are the same, so that a capture
            may move; else the path does.
        report: Called as the stages go on.

    Raises:
        BadFile: The folder holds something else, a run of an older format, or one with another recipe or capture; says
            what differs.
        OSError: The folder cannot be written.
    """
    wanted = {
        "tumble": __version__,
        "format": FORMAT,
        "capture": {"path": str(Path(capture_path).resolve()), "content": content},
        "recipe": _plain(recipe),
    }
    file = path / RECIPE
    _refuse_other(path)
    if not file.is_file():
        files.write_json(file, wanted)
        return Run(path, recipe, report)
    made = any(path.glob("[0-9]-*/*.safetensors"))
    found = _document(path, of_any_format=not made)
    compared = ["recipe", "capture.content" if content and _at(found, "capture.content") else "capture.path"]
    different = [line for name in compared for line in differences(_at(found, name), _at(wanted, name), name)]
    if different and made:
        rule = f"holds another run: {'; '.join(different)}"
        raise BadFile(path, rule, "choose another folder with -o, or remove this one")
    if different or not made:
        files.write_json(file, wanted)
    return Run(path, recipe, report)


def source(path: Path) -> Path:
    """Where the capture of a run comes from.

    Raises:
        BadFile: There is no run, or one of an older format.
    """
    return Path(_document(path)["capture"]["path"])


def recipe(path: Path) -> dict[str, Any]:
    """The settings of a run, as JSON has them.

    Raises:
        BadFile: There is no run, or one of an older format.
    """
    return _document(path)["recipe"]


def _document(path: Path, *, of_any_format: bool = False) -> dict[str, Any]:
    """What `recipe.json` of a run directory says."""
    found = files.read_json(path / RECIPE)
    if not isinstance(found, dict) or not {"capture", "recipe"} <= found.keys():
        raise BadFile(path / RECIPE, "is no recipe of a run", "choose another folder with -o")
    if found.get("format") != FORMAT and not of_any_format:
        rule = f"is a run of format {found.get('format', 1)}, made by another version; this one reads {FORMAT}"
        raise BadFile(path, rule, "run the capture again, into another folder with -o")
    return found


def output(path: Path, folder: str, cls: type[T]) -> T | None:
    """What a finished stage of a run put out, as a tree of class `cls`; None where it is not there."""
    file = path / folder / OUT
    return tree.load(cls, file) if file.is_file() else None


def asset(path: Path, cls: type[T]) -> T:
    """The asset of a finished run, as a tree of class `cls`.

    Raises:
        BadFile: The run is not finished, or of an older format.
    """
    if not (path / ASSET).is_file():
        raise BadFile(path, f"has no {ASSET}", "finish the run first: tumble run")
    _document(path)
    return tree.load(cls, path / ASSET)


def _refuse_other(path: Path) -> None:
    if not path.exists():
        return
    if not path.is_dir():
        raise BadFile(path, "is a file", "a run is a folder: choose another with -o")
    others = [p for p in path.iterdir() if p.name not in (CAPTURE, LOCK) and not p.name.startswith(files.PARTIAL)]
    if others and not (path / RECIPE).is_file():
        raise BadFile(path, "is there already and is no run", "choose another folder with -o")


def stage(
    run: Run, folder: str, stage: loop.Stage, cfg: Any, inputs: Any, input_keys: Sequence[str]
) -> tuple[Any, str]:
    """The output of a stage, from its folder if it is there under its key, else made, stored and read back; its key.

    An interrupted stage goes on from its checkpoint. What comes back was always read from disk, so that a run goes on
    with the same bits whether it was stopped or not.

    Args:
        run: Where the results are kept.
        folder: Of the stage, as `2-refine`: the number orders, the name decides the seed with that of the recipe.
        stage: The module. The return annotation of its `finish` is the class of the tree it puts out.
        cfg: Its settings.
        inputs: What it reads.
        input_keys: Keys of what it reads: a hash of the capture, keys of earlier stages.

    Raises:
        NotFinite, BadFile, OSError, KeyboardInterrupt: As `loop.drive`; finished stages are kept.
    """
    name = folder.partition("-")[2]
    seed = stage_seed(run.recipe.seed, name)
    own_key = key(name, stage, cfg, [*input_keys, f"seed {seed}"])
    if run.path is None:
        return loop.drive(stage, cfg, inputs, seed=seed, report=run.report, name=name), own_key
    place = run.path / folder
    if not _is_done(place, own_key):
        log(run, {"name": name, "event": "start", "key": own_key})
        spent, since = 0.0, time.perf_counter()

        def report(progress: Progress) -> None:
            nonlocal spent, since
            log(run, dataclasses.asdict(progress))
            spent, since = progress.seconds, time.perf_counter()
            if run.report is not None:
                run.report(progress)

        made = loop.drive(
            stage,
            cfg,
            inputs,
            seed=seed,
            checkpoint=place / CHECKPOINT,
            every=max(500, stage.length(cfg, inputs) // CHECKPOINTS),
            report=report,
            name=name,
            key=own_key,
        )
        about = {"stage": name, "version": stage.VERSION, "seed": seed, "inputs": list(input_keys)}
        _store(made, place, {"key": own_key, **about, "config": _plain(cfg)})
        log(run, {"name": name, "event": "done", "seconds": round(spent + time.perf_counter() - since, 3)})
    if (place / CHECKPOINT).exists():
        (place / CHECKPOINT).unlink()  # of a process that was killed right after the last write
    return tree.load(_output_class(stage), place / OUT, _device(inputs)), own_key


def key(name: str, stage: loop.Stage, cfg: Any, input_keys: Sequence[str]) -> str:
    """What decides a stage's result, as a hash."""
    return loop.fingerprint(name, stage.VERSION, cfg, constants(stage), list(input_keys))


def constants(stage: Any) -> dict[str, Any]:
    """The numbers in capitals of a stage's module and of all modules of its package that it leads to.

    They are settings that nobody sets: a result that was made with others is another result. Those of the engine and
    of what it imports are about time and files, and decide nothing.
    """
    first = stage if isinstance(stage, ModuleType) else sys.modules[stage.__module__]
    package = first.__name__.partition(".")[0] + "."
    found: dict[str, Any] = {}
    seen: set[str] = set()
    todo = [first]
    while todo:
        module = todo.pop()
        name = module.__name__
        if name in seen or not name.startswith(package) or name.startswith(NEUTRAL):
            continue
        seen.add(name)
        # Of a package, what it offers: which other modules of it are loaded is chance.
        names = getattr(module, "__all__", ()) if hasattr(module, "__path__") else vars(module)
        for name in names:
            value = vars(module)[name]
            if name.isupper() and _is_number(value):
                found[f"{module.__name__}.{name}"] = value
            origin = (
                value if isinstance(value, ModuleType) else sys.modules.get(getattr(value, "__module__", None) or "")
            )
            todo += [origin] if origin is not None else []
    return dict(sorted(found.items()))


def _is_number(value: object) -> bool:
    """Whether a value is a number or a tuple of such."""
    return isinstance(value, int | float) or (isinstance(value, tuple) and all(_is_number(part) for part in value))


def stage_seed(seed: int, name: str) -> int:
    """The seed of one stage of a run: stages draw independently, and adding one changes no other's."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:7], "big")


def log(run: Run, record: dict[str, Any]) -> None:
    """Append a JSON document to the run's log, if it keeps one, with the time.

    Raises:
        OSError: The log cannot be written.
    """
    if run.path is None:
        return
    line = json.dumps({"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **record})
    with files.writing(run.path / LOG), (run.path / LOG).open("ab+") as file:
        # A killed process may have left half a line.
        whole = not file.tell() or not file.seek(-1, os.SEEK_END) or file.read() == b"\n"
        file.write(b"" if whole else b"\n")
        file.write(f"{line}\n".encode())


def records(path: Path) -> list[dict[str, Any]]:
    """What the log of a run directory holds; a line that a killed process left half-written does not count."""
    lines = (path / LOG).read_text("utf-8", errors="replace").splitlines() if (path / LOG).is_file() else []
    found = []
    for line in lines:
        with contextlib.suppress(json.JSONDecodeError):
            found.append(json.loads(line))
    return [record for record in found if isinstance(record, dict)]


# One stage's folder ---------------------------------------------------------------------------------------------------


def _is_done(folder: Path, own_key: str) -> bool:
    if not ((folder / OUT).is_file() and (folder / DONE).is_file()):
        return False
    about = files.read_json(folder / DONE)
    return isinstance(about, dict) and about.get("key") == own_key


def _store(output: Any, folder: Path, about: dict[str, Any]) -> None:
    """Write the output, then its key, then drop the checkpoint: a key never stands beside another's output."""
    with files.writing(folder / OUT):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / DONE).unlink(missing_ok=True)
        tree.save(output, folder / OUT)
        files.write_json(folder / DONE, about)
        (folder / CHECKPOINT).unlink(missing_ok=True)


def _output_class(stage: loop.Stage) -> type:
    returned = getattr(stage.finish, "__annotations__", {}).get("return")
    if not dataclasses.is_dataclass(returned) or not isinstance(returned, type):
        raise TypeError(f"finish needs a dataclass as its return annotation, not {returned!r}")
    return returned


def _device(inputs: Any) -> torch.device:
    return next((x.device for x in _tensors(inputs)), torch.device("cpu"))


def _tensors(inputs: Any) -> Iterator[Tensor]:
    for part in inputs if isinstance(inputs, tuple | list) else [inputs]:
        yield from _tensors(part) if isinstance(part, tuple | list) else tree.named_tensors(part).values()


# Recipes --------------------------------------------------------------------------------------------------------------


def _plain(recipe: Any) -> Any:
    """A recipe as it comes back from JSON."""
    # Infinity is null in a JSON file.
    return json.loads(json.dumps(dataclasses.asdict(recipe), default=str), parse_constant=lambda word: None)


def _at(document: Any, name: str) -> Any:
    for part in name.split("."):
        document = document.get(part) if isinstance(document, dict) else None
    return document


def differences(there: Any, here: Any, name: str) -> list[str]:
    """One line for each value that differs between two documents, by its dotted name."""
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return [] if there == here else [f"{name} is {there!r} there and {here!r} here"]
    return [line for k in {**there, **here} for line in differences(there.get(k), here.get(k), f"{name}.{k}")]
