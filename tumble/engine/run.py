"""Run directories: the recipe, the log, and one folder per stage with its output.

    runs/mug/  recipe.json  log.jsonl  1-track/  2-refine/  3-decompose/       while a process uses it: .lock
    2-refine/  out.safetensors  stage.json                                     during training: state.safetensors

The *key* of a result is a hash of everything that determines it: the stage and its version, its settings, the seed, and
the keys of its inputs. A stage whose output is stored under its key is not run again. Ground truth never enters a key.
Outputs, checkpoints and the asset hold a checksum: a damaged output is an error, a damaged checkpoint restarts a stage.
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
from typing import Annotated, Any, NotRequired, TypedDict, TypeVar

import msgspec
import torch
from torch import Tensor

from tumble import __version__
from tumble.engine import loop
from tumble.engine.loop import Progress
from tumble.io import BadFile, files, limits, outputs, tree

T = TypeVar("T")

FORMAT = 3
"""Version of the layout of run directories; incremented when older ones can no longer be read. Runs of format 2 have no
checksums, and with estimated poses their objects are upside down."""
RECIPE = "recipe.json"
"""Settings of the run and the path of its capture."""
LOG = "log.jsonl"
"""Log of the run, one JSON document per line."""
LOCK = ".lock"
"""File that is locked while a process uses the run directory."""
CAPTURE = "capture"
"""Folder of the capture that was made from a video."""
TRACK = "1-track"
"""Folder of stage 1."""
REFINE = "2-refine"
"""Folder of stage 2."""
DECOMPOSE = "3-decompose"
"""Folder of stage 3."""
OUT = "out.safetensors"
"""Output of a stage, in its folder."""
DONE = "stage.json"
"""Key, settings and inputs of the output of a stage, in its folder."""
CHECKPOINT = "state.safetensors"
"""Checkpoint of a stage during training, in its folder."""
ASSET = "asset.safetensors"
"""The recovered asset."""
POSES = "poses.json"
"""The recovered camera-to-object poses by frame name."""
LIGHT = "light.exr"
"""The recovered environment map."""
REPORT = "report.html"
"""Report of a finished run."""
SCORES = "report.json"
"""Numbers of the report."""
RELIT = "relit"
"""Folder of relit renderings."""
EXPORT = "export"
"""Folder of exported files."""
IGNORED_PACKAGES = tuple(f"{__name__.partition('.')[0]}.{name}" for name in ("engine", "io"))
"""Subpackages whose constants affect no result, only timing and files."""
MAX_CHECKPOINTS = 20
"""Approximate maximum number of checkpoints per stage; on a GPU one save takes as long as hundreds of steps."""


WRONG_FOLDER = "choose another folder with -o"
"""Fix that errors suggest for a folder that holds something else."""
WRONG_RECIPE = "give the folder of a run; if this one is damaged, run the capture again, into another folder"
"""Fix for a recipe that is missing or damaged."""
WRONG_POSES = "repeat the tumble run that made this folder, which writes it again"
"""Fix for a damaged list of poses."""
WRONG_NOTE = "remove it, and repeat the tumble run that made it: the stage runs again"
"""Fix for a damaged key of a stage."""


class _CaptureRecord(TypedDict):
    """ "capture" of `recipe.json`."""

    path: str
    content: NotRequired[str]
    frames: NotRequired[str]


class _RunRecord(TypedDict):
    """The content of `recipe.json`."""

    capture: _CaptureRecord
    recipe: dict[str, Any]
    format: NotRequired[int]


class _LogRecord(TypedDict, total=False):
    """Entries of a line of the log that other rooms read."""

    name: str
    event: str
    seconds: float
    step: int
    of: int
    eta: float
    metrics: dict[str, float | None]
    factor: list[float]
    deviation: list[float]


@dataclass(frozen=True)
class Run:
    """An open run directory, or a run in memory."""

    path: Path | None
    """The run directory; None stores nothing, and the run cannot be resumed."""
    recipe: Any
    """A frozen dataclass with the settings of the stages and a `seed`."""
    report: Callable[[Progress], None] | None = None
    """Called with the progress of the stages."""


@contextlib.contextmanager
def exclusive_access(path: Path) -> Iterator[None]:
    """Context with exclusive access to a run directory; partial files of killed processes are removed first.

    The lock is a system lock on a file in the directory, so that it is released whenever the process ends.

    Raises:
        BadFile: Another process uses the directory, or it holds something other than a run.
        OSError: The folder cannot be written.
    """
    _require_run_folder(path)
    if os.name != "posix":
        yield  # other systems lack this kind of lock
        return
    is_new = not path.exists()
    handle = _acquire_lock(path)
    try:
        files.remove_partial_files(path)
        yield
    finally:
        (path / LOCK).unlink(missing_ok=True)
        os.close(handle)
        if is_new and not any(path.iterdir()):
            path.rmdir()


def _acquire_lock(path: Path) -> int:
    """Lock a run directory for this process; returns the handle of the lock file."""
    import fcntl

    while True:
        with files.describe_write_errors(path / LOCK):
            path.mkdir(parents=True, exist_ok=True)
            handle = os.open(path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(handle, 32).decode(errors="replace")
            os.close(handle)
            fix = "wait until it ends, or choose another folder with -o"
            raise BadFile(path, f"is in use by another process, {owner}", fix) from None
        except OSError:
            return handle  # a file system without locks
        # The previous owner removes the file before it releases the lock, so the lock may be on a removed file.
        if (path / LOCK).exists() and os.path.samestat(os.stat(path / LOCK), os.fstat(handle)):
            # The number only serves the error message above, so a full disk is not an error yet.
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
    frames: str = "",
    report: Callable[[Progress], None] | None = None,
) -> Run:
    """Create a run directory, or open it to continue the run in it. A run without any results yet is overwritten.

    Args:
        path: The run directory; it may exist if it is empty or holds the same run.
        capture_path: Path of the capture or video.
        recipe: A frozen dataclass of frozen dataclasses with a `seed`.
        content: Hash of the capture. If both runs have one, captures are compared by it instead of by path, so that a
            capture may be moved.
        frames: Hash of the capture without its poses, by which it is recognised later (`frames_key`).
        report: Called with the progress of the stages.

    Raises:
        BadFile: The folder holds something else, a run of an older format, or a run with another recipe or capture; the
            message lists the differences.
        OSError: The folder cannot be written.
    """
    requested = {
        "tumble": __version__,
        "format": FORMAT,
        "capture": {"path": str(Path(capture_path).resolve()), "content": content, "frames": frames},
        "recipe": _plain(recipe),
    }
    file = path / RECIPE
    _require_run_folder(path)
    if not file.is_file():
        files.write_json(file, requested)
        return Run(path, recipe, report)
    has_results = any(path.glob("[0-9]-*/*.safetensors"))
    stored = _document(path, of_any_format=not has_results)
    names = ["recipe", "capture.content" if content and _lookup(stored, "capture.content") else "capture.path"]
    different = [line for name in names for line in differences(_lookup(stored, name), _lookup(requested, name), name)]
    if different and has_results:
        rule = f"holds another run: {'; '.join(different)}"
        raise BadFile(path, rule, "choose another folder with -o, or remove this one")
    moved = content and _lookup(stored, "capture") != requested["capture"]
    if different or moved or not has_results:
        files.write_json(file, requested)
    return Run(path, recipe, report)


def capture_source(path: Path) -> Path:
    """Path of the capture or video of a run.

    Raises:
        BadFile: The folder holds no run, or a run of an older format.
    """
    stored, own = Path(_document(path)["capture"]["path"]), path / CAPTURE
    # One that was made from footage lies in the run, and moves with it.
    return own if stored.name == CAPTURE and own.is_dir() else stored


def existing_capture(path: Path) -> Path:
    """Path of the capture or video of a run, for those who are going to read it.

    Raises:
        BadFile: It is not there any more, or the folder holds no run, or a run of an older format.
    """
    source = capture_source(path)
    if not source.exists():
        fix = (
            f"if it was moved, repeat `tumble run NEW_CAPTURE -o {path}` with its options: that only notes the new "
            "place; `tumble report` also takes it with --capture"
        )
        raise BadFile(source, "is the run's capture but does not exist", fix)
    return source


def frames_key(path: Path) -> str:
    """Hash of the capture of a run without its poses; empty for runs of earlier versions.

    Raises:
        BadFile: The folder holds no run, or a run of an older format.
    """
    return _document(path)["capture"].get("frames", "")


def has_given_poses(path: Path) -> bool:
    """Whether a run used poses as they were given, so that its asset has their object frame.

    Raises:
        BadFile: The folder holds no run, or a run of an older format.
    """
    capture = _document(path)["capture"]
    return capture.get("content") != capture.get("frames", "") and not (path / TRACK).is_dir()


def recipe(path: Path) -> dict[str, Any]:
    """Settings of a run as a JSON document.

    Raises:
        BadFile: The folder holds no run, or a run of an older format.
    """
    return _document(path)["recipe"]


def settings(path: Path, part: str, cls: type[T]) -> T:
    """One part of the settings of a run, such as "relight", as its dataclass.

    Raises:
        BadFile: As for `recipe`, or the part does not match the dataclass.
    """
    try:
        return msgspec.convert(recipe(path).get(part), cls)
    except msgspec.ValidationError as error:
        raise BadFile(path / RECIPE, f'"recipe.{part}": {files.violated_rule(error)}', WRONG_RECIPE) from None


def frame_names(path: Path, count: int | None = None) -> list[str]:
    """File names of the frames of a finished run, in order.

    Args:
        count: Number of poses in the run's asset, if it is known.

    Raises:
        BadFile: `poses.json` is damaged, or holds another number of frames.
    """
    kind = dict[str, list[Annotated[list[float], msgspec.Meta(max_length=4)]]]
    names = list(files.read_json(path / POSES, kind, WRONG_POSES))
    if count is not None and len(names) != count:
        raise BadFile(path / POSES, f"holds {len(names)} frames, the asset {count}", WRONG_POSES)
    return names


def _document(path: Path, *, of_any_format: bool = False) -> _RunRecord:
    """The content of `recipe.json`."""
    try:
        document = files.read_json(path / RECIPE, _RunRecord)
    except BadFile as error:
        raise BadFile(path / RECIPE, f"is not the recipe of a run: {error.rule}", WRONG_RECIPE) from None
    if document.get("format") != FORMAT and not of_any_format:
        rule = f"is a run of format {document.get('format', 1)}, made by another version; this version reads {FORMAT}"
        raise BadFile(path, rule, "run the capture again, into another folder with -o")
    return document


def output(path: Path, folder: str, cls: type[T]) -> T | None:
    """The output of a finished stage as a tree of class `cls`; None if the stage is not finished."""
    file = path / folder / OUT
    return tree.load(cls, file) if file.is_file() else None


def asset(path: Path, cls: type[T]) -> T:
    """The asset of a finished run as a tree of class `cls`.

    Raises:
        BadFile: The run is not finished, is of an older format, or holds a link out of it.
    """
    if not (path / ASSET).is_file():
        raise BadFile(path, f"has no {ASSET}", "finish the run first: tumble run")
    outputs.require_no_links(path)  # who reads the asset goes on to write into the run
    _document(path)
    return tree.load(cls, path / ASSET)


def _require_run_folder(path: Path) -> None:
    """Raise `BadFile` if the path is a file, or a folder that holds something other than a run, or a link out of it."""
    if not path.exists():
        return
    if not path.is_dir():
        raise BadFile(path, "is a file", "a run is a folder: choose another with -o")
    names = [p.name for p in path.iterdir()]
    others = [name for name in names if name not in (CAPTURE, LOCK) and not name.startswith(files.PARTIAL_PREFIX)]
    if others and not (path / RECIPE).is_file():
        raise BadFile(path, "exists and is not a run directory", WRONG_FOLDER)
    outputs.require_no_links(path)


def stage(
    run: Run, folder: str, stage: loop.Stage, cfg: Any, inputs: Any, input_keys: Sequence[str]
) -> tuple[Any, str]:
    """The output of a stage and its key; the stage is only run if no output is stored under its key.

    An interrupted stage is resumed from its checkpoint. The output is always read back from disk, so that interrupted
    and uninterrupted runs continue with the same bits.

    Args:
        run: The run that stores the output.
        folder: Folder of the stage, such as `2-refine`. Its name after the number and the recipe's seed determine the
            seed of the stage.
        stage: The stage module. The return annotation of its `finish` is the class of its output.
        cfg: Settings of the stage.
        inputs: Inputs of the stage, whose kind of device is a part of the key.
        input_keys: Keys of the inputs: the hash of the capture, keys of earlier stages.

    Raises:
        NotFinite, BadFile, OSError, KeyboardInterrupt: See `loop.drive`; finished stages are kept.
    """
    name = folder.partition("-")[2]
    seed = stage_seed(run.recipe.seed, name)
    kind = _device(inputs).type
    own_key = key(name, stage, cfg, [*input_keys, f"seed {seed}", *([] if kind == "cpu" else [kind])])
    if run.path is None:
        return loop.drive(stage, cfg, inputs, seed=seed, report=run.report, name=name), own_key
    stage_path = run.path / folder
    if not _is_done(stage_path, own_key):
        log(run, {"name": name, "event": "start", "key": own_key})
        seconds, since = 0.0, time.perf_counter()

        def report(progress: Progress) -> None:
            nonlocal seconds, since
            log(run, dataclasses.asdict(progress))
            seconds, since = progress.seconds, time.perf_counter()
            if run.report is not None:
                run.report(progress)

        result = loop.drive(
            stage,
            cfg,
            inputs,
            seed=seed,
            checkpoint=stage_path / CHECKPOINT,
            every=max(500, stage.length(cfg, inputs) // MAX_CHECKPOINTS),
            report=report,
            name=name,
            key=own_key,
        )
        about = {"stage": name, "version": stage.VERSION, "seed": seed, "inputs": list(input_keys)}
        _store(result, stage_path, {"key": own_key, **about, "config": _plain(cfg)})
        log(run, {"name": name, "event": "done", "seconds": round(seconds + time.perf_counter() - since, 3)})
    if (stage_path / CHECKPOINT).exists():
        (stage_path / CHECKPOINT).unlink()  # left by a process that was killed directly after `_store`
    return tree.load(_output_class(stage), stage_path / OUT, _device(inputs)), own_key


def key(name: str, stage: loop.Stage, cfg: Any, input_keys: Sequence[str]) -> str:
    """Hash of everything that determines the output of a stage."""
    return loop.fingerprint(name, stage.VERSION, cfg, constants(stage), list(input_keys))


def constants(stage: Any) -> dict[str, Any]:
    """Numeric constants, by dotted name, of the stage's module and of all modules of the package that it imports.

    They are part of the key because a change of any of them changes the result. Modules of `IGNORED_PACKAGES` do not
    count.
    """
    first = stage if isinstance(stage, ModuleType) else sys.modules[stage.__module__]
    package = first.__name__.partition(".")[0] + "."
    numbers: dict[str, Any] = {}
    visited: set[str] = set()
    queue = [first]
    while queue:
        module = queue.pop()
        name = module.__name__
        if name in visited or not name.startswith(package) or name.startswith(IGNORED_PACKAGES):
            continue
        visited.add(name)
        # Packages count with `__all__` only, because which of their submodules are loaded depends on other imports.
        names = getattr(module, "__all__", ()) if hasattr(module, "__path__") else vars(module)
        for name in names:
            value = vars(module)[name]
            if name.isupper() and _is_number(value):
                numbers[f"{module.__name__}.{name}"] = value
            origin = (
                value if isinstance(value, ModuleType) else sys.modules.get(getattr(value, "__module__", None) or "")
            )
            queue += [origin] if origin is not None else []
    return dict(sorted(numbers.items()))


def _is_number(value: object) -> bool:
    """Whether a value is a number or a (nested) tuple of numbers."""
    return isinstance(value, int | float) or (isinstance(value, tuple) and all(_is_number(part) for part in value))


def stage_seed(seed: int, name: str) -> int:
    """Seed of one stage, derived from the seed of the run and the stage's name only, so that stages are independent."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:7], "big")


def log(run: Run, record: dict[str, Any]) -> None:
    """Append a JSON document with the current time to the log; runs in memory have no log.

    Raises:
        OSError: The log cannot be written.
    """
    if run.path is None:
        return
    line = json.dumps({"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **record})
    with files.describe_write_errors(run.path / LOG), (run.path / LOG).open("ab+") as file:
        # A killed process may have left an incomplete last line.
        complete = not file.tell() or not file.seek(-1, os.SEEK_END) or file.read() == b"\n"
        file.write(b"" if complete else b"\n")
        file.write(f"{line}\n".encode())


def log_records(path: Path) -> list[dict[str, Any]]:
    """The records in the log of a run directory; of a log over the limit of `io.limits`, those at its end.

    Lines that a killed process left incomplete are left out, and so are records whose values are of the wrong type or
    no valid text. A record with "step" is a `Progress`; one of the event "done" has "name" and "seconds".
    """
    records = []
    for line in _last_lines(path / LOG, limits.MAX_LOG_BYTES):
        with contextlib.suppress(ValueError, RecursionError):
            record = json.loads(line)
            json.dumps(record, ensure_ascii=False).encode()  # JSON can hold halves of characters, which no file can
            msgspec.convert(record, _LogRecord)
            needed = {"name", "of", "eta", "metrics"} if "step" in record else {"name", "seconds"}
            if needed <= record.keys() or not ("step" in record or record.get("event") == "done"):
                records.append(record)
    return records


def _last_lines(path: Path, size: int) -> list[str]:
    """The whole lines among the last bytes of a text file; none if it is missing or no file."""
    if not path.is_file():
        return []
    with path.open("rb") as file:
        start = max(0, file.seek(0, os.SEEK_END) - size)
        file.seek(start)
        lines = file.read(size).decode(errors="replace").splitlines()
    return lines[1:] if start else lines


# Folder of a stage ----------------------------------------------------------------------------------------------------


def _is_done(folder: Path, own_key: str) -> bool:
    """Whether the folder of a stage holds an output with this key."""
    if not ((folder / OUT).is_file() and (folder / DONE).is_file()):
        return False
    return files.read_json(folder / DONE, dict[str, Any], WRONG_NOTE).get("key") == own_key


def _store(output: Any, folder: Path, about: dict[str, Any]) -> None:
    """Write the output of a stage, then its key, then remove the checkpoint, so that key and output always match."""
    with files.describe_write_errors(folder / OUT):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / DONE).unlink(missing_ok=True)
        tree.save(output, folder / OUT)
        files.write_json(folder / DONE, about)
        (folder / CHECKPOINT).unlink(missing_ok=True)


def _output_class(stage: loop.Stage) -> type:
    returned = getattr(stage.finish, "__annotations__", {}).get("return")
    if not dataclasses.is_dataclass(returned) or not isinstance(returned, type):
        raise TypeError(f"the return annotation of `finish` must be a dataclass, not {returned!r}")
    return returned


def _device(inputs: Any) -> torch.device:
    """Device of the first tensor in the inputs; the CPU if there is none."""
    return next((x.device for x in _tensors(inputs)), torch.device("cpu"))


def _tensors(inputs: Any) -> Iterator[Tensor]:
    """All tensors in a tree or in nested tuples and lists of trees."""
    for part in inputs if isinstance(inputs, tuple | list) else [inputs]:
        yield from _tensors(part) if isinstance(part, tuple | list) else tree.named_tensors(part).values()


# Recipes --------------------------------------------------------------------------------------------------------------


def _plain(recipe: Any) -> Any:
    """A recipe as it is read back from JSON, where infinity is null."""
    return json.loads(json.dumps(dataclasses.asdict(recipe), default=str), parse_constant=lambda word: None)


def _lookup(document: Any, name: str) -> Any:
    """The value with a dotted name in a JSON document; None if there is none."""
    for part in name.split("."):
        document = document.get(part) if isinstance(document, dict) else None
    return document


def differences(stored: Any, requested: Any, name: str) -> list[str]:
    """One line of text, with the dotted name, for each value that differs between two JSON documents."""
    if not (isinstance(stored, dict) and isinstance(requested, dict)):
        return [] if stored == requested else [f"{name} is {stored!r} in the folder, {requested!r} was requested"]
    keys = {**stored, **requested}
    return [line for k in keys for line in differences(stored.get(k), requested.get(k), f"{name}.{k}")]
