"""Captures of a suite: rendered by `tumble synth` where they are needed, and kept under a key of their content."""

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from tumble.bench.code import source_fingerprint
from tumble.bench.executor import in_processes
from tumble.bench.suite import Case
from tumble.engine import loop
from tumble.io import BadFile, files
from tumble.maths import texel_directions
from tumble.report import preset_lights
from tumble.scene import Environment
from tumble.synthetic import SynthOptions, render_capture, room_environment, sunset_environment, write_pot

DATA_VARIABLE = "TUMBLE_BENCH_DATA"
"""Environment variable with the data folder of the suites."""
POT = "pot"
"""The built-in object: the coffee pot of the demo, generated."""
LAMP_RADIUS = math.radians(15)
"""Angular radius of the lamp of `one_lamp` [radians]."""
LAMP_RADIANCE = 100.0
"""Radiance of the lamp relative to the room around it, of which a little light is left so that nothing is black."""
CAPTURES = "captures"
"""Folder of the captures in the folder of a benchmark."""


@dataclass(frozen=True)
class CaptureTask:
    """A capture that is to be rendered."""

    case: Case
    data: Path | None
    """Folder with `meshes/` and `hdri/`; None if only built-in objects and lights are used."""
    out: Path
    """Folder of the benchmark."""

    @property
    def name(self) -> str:
        labels = {k: v for k, v in self.case.labels.items() if k not in ("poses", "method")}
        return "-".join(str(value) for value in labels.values())


def one_lamp() -> Environment:
    """A single round lamp to the upper left, in a room that is nearly dark."""
    d = texel_directions(64, 128)
    towards = torch.nn.functional.normalize(d.new_tensor([-0.6, 0.7, 0.5]), dim=-1)
    inside = torch.sigmoid(((d @ towards) - math.cos(LAMP_RADIUS)) / 0.005)
    return Environment.from_radiance((1 + (LAMP_RADIANCE - 1) * inside)[..., None].expand(-1, -1, 3).contiguous())


LIGHTS: dict[str, Callable[[], Environment]] = {
    "lamp": one_lamp,
    "overcast": preset_lights.overcast,
    "room": room_environment,
    "sunset": sunset_environment,
}
"""Built-in lights besides "white"."""


def data_folder(given: Path | None) -> Path | None:
    """The data folder: the given one, else that of the environment variable, else None."""
    return given or (Path(os.environ[DATA_VARIABLE]) if os.environ.get(DATA_VARIABLE) else None)


def require_inputs(cases: Sequence[Case], data: Path | None) -> None:
    """Check that all objects and lights of some cases are there.

    Raises:
        BadFile: One is missing, or there is no data folder.
    """
    for case in cases:
        if case.options is None:
            _given_folder(data, case.model)
            continue
        for name in (case.model, case.options.env, *case.options.relight):
            _file(data, name)


def make_capture(task: CaptureTask) -> Path:
    """The folder of a capture; one that is not given is rendered if it is missing, in a process of its own.

    Other processes that need the same capture wait. The folder's key covers the files, the options and the sources of
    the room `synthetic`.

    Raises:
        BadFile: The model or a light is missing, or there is no data folder.
        ChildProcessError: The capture could not be rendered.
    """
    if task.case.options is None:
        return _given_folder(task.data, task.case.model)
    folder = task.out / CAPTURES / f"{task.name}-{_key(task, task.case.options)[:10]}"
    with _exclusive(folder.parent / f"{folder.name}.lock"):
        if not (folder / "transforms.json").is_file():
            rendering = _Rendering(task, task.case.options, folder)
            (outcome,) = in_processes(_render, [rendering], 1, task.out / "logs")
            if outcome.error:
                raise ChildProcessError(f"{folder.name} could not be rendered: {outcome.error}")
    return folder


@dataclass(frozen=True)
class _Rendering:
    """A capture to be rendered, and where."""

    task: CaptureTask
    options: SynthOptions
    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name


def _render(rendering: _Rendering) -> None:
    case, options, inputs = rendering.task.case, rendering.options, rendering.task.out / "inputs"
    model = _file(rendering.task.data, case.model)
    if model is None:
        model = inputs / f"{case.model}.glb"
        files.write_atomically(model, write_pot)
    lights = {}
    for name in (options.env, *options.relight):
        path = _file(rendering.task.data, name)
        if path is None and name != "white":
            path = inputs / f"{name}.hdr"
            LIGHTS[name]().write(path)
        lights[name] = str(path or name)
    relight = tuple(lights[name] for name in options.relight)
    render_capture(model, rendering.folder, dataclasses.replace(options, env=lights[options.env], relight=relight))


def _key(task: CaptureTask, options: SynthOptions) -> str:
    """Hash of everything that determines a rendered capture."""
    names = (task.case.model, options.env, *options.relight)
    contents = [files.sha256(path) if (path := _file(task.data, name)) else "" for name in names]
    return loop.fingerprint(names, contents, options, source_fingerprint(("synthetic",)))


def _given_folder(data: Path | None, name: str) -> Path:
    """The folder of a given capture.

    Raises:
        BadFile: It is not in the data folder, or there is no data folder.
    """
    fix = f"give the folder that holds the dataset with --data or in {DATA_VARIABLE}"
    if data is None:
        raise BadFile(Path(name), "is needed, and no data folder is given", fix)
    path = files.path_inside(data, name)
    if not path.is_dir():
        raise BadFile(path, "is missing", fix)
    return path


def _file(data: Path | None, name: str) -> Path | None:
    """The file of a model or light in the data folder; None if it is built in.

    Raises:
        BadFile: There is no such file, or no data folder.
    """
    if name in (POT, "white", *LIGHTS):
        return None
    part = "meshes" if name.endswith(".glb") else "hdri"
    fix = f"give the folder that holds meshes/ and hdri/ with --data or in {DATA_VARIABLE}"
    if data is None:
        raise BadFile(Path(part) / name, "is needed, and no data folder is given", fix)
    path = data / part / name
    if not path.is_file():
        raise BadFile(path, "is missing", fix)
    return path


@contextlib.contextmanager
def _exclusive(path: Path) -> Iterator[None]:
    """Context that one process at a time can enter; the others wait."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if os.name != "posix":
        yield  # other systems lack this kind of lock
        return
    import fcntl

    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
