"""The training loop of all stages, with progress, checkpoints and resuming.

A *stage* is a module that defines the initial state, one training step, and the output; files and progress bars are
left to this module. A *checkpoint* is the complete state between two steps as one safetensors file: leaves, moments,
memory and random generator by name, the rest as JSON in its header. A run resumed from a checkpoint equals an
uninterrupted run, bit for bit on the CPU, if all randomness comes from `State.rng`. A *fingerprint* is a hash of
settings, by which a file on disk is recognised as made with these settings.
"""

import contextlib
import dataclasses
import hashlib
import json
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import msgspec
import torch
from jaxtyping import UInt8
from torch import Tensor

from tumble import __version__
from tumble.engine import graph, optim
from tumble.engine.optim import NotFinite
from tumble.io import BadFile, files, progress, read_tensors, tree, write_tensors

REPORT_SECONDS = 5.0
"""Minimum time between two reports [s]."""
CACHE = "cache."
"""Prefix of the names of tensors in `State.memory` that checkpoints do not contain."""
PREVIEW = "preview.png"
"""Name of the preview image in the folder of the checkpoint."""
RESTART = "the stage starts again from its first step"
"""What happens with a damaged checkpoint, for the message."""


@dataclass
class State:
    """The complete training state of a stage, the only mutable object of training.

    `Stage.step` changes it in place. Anything outside of it is lost when training is interrupted.
    """

    step: int
    """Number of steps made; only `drive` increments it, and `init` if it makes some."""
    params: Any
    """A tree of leaf tensors. Shapes may change during training, names may not."""
    optimizer: optim.Adam | None
    """Optimizer of leaves of `params`. The set of leaves is fixed in `init`; leaves that are trained only later have
    learning rate 0 until then (`optim.anneal`)."""
    rng: torch.Generator
    """Random generator of the stage, always on the CPU; samples are moved to the device after drawing."""
    memory: dict[str, Tensor] = field(default_factory=dict)
    """Further tensors of the state, such as accumulators. Those whose names begin with `CACHE` are left out of
    checkpoints: the stage computes them again, from the others, if they are missing."""


@dataclass(frozen=True)
class Progress:
    """Progress of a stage."""

    name: str
    """Name of the stage."""
    step: int
    """Number of steps made."""
    of: int
    """Total number of steps."""
    seconds: float
    """Training time so far, including earlier interrupted processes [s]."""
    eta: float
    """Estimated remaining time [s]."""
    metrics: dict[str, float]
    """Scalars returned by the latest step."""


@runtime_checkable
class Stage(Protocol):
    """Interface of a stage module.

    It may also define `preview(cfg, inputs, state)`, an image `u8[h w 3]`; the two parts of its step
    (`graph.SplitStage`); and, if `init` takes long, `blank(cfg, inputs, rng, names)`: a state whose `params` have
    tensors of these names, into which a checkpoint is restored instead of into that of `init`.
    """

    @property
    def VERSION(self) -> int:
        """Version of the results; incremented when the same settings give another result, as older ones are invalid."""
        ...

    @property
    def Config(self) -> type:
        """A frozen dataclass of numbers, strings and further such dataclasses."""
        ...

    def length(self, cfg: Any, inputs: Any) -> int:
        """Number of steps."""
        ...

    def init(self, cfg: Any, inputs: Any, rng: torch.Generator) -> State:
        """The first state, which may have made some steps. Without a `blank`, also called before a checkpoint is
        restored, to provide its structure."""
        ...

    def step(self, cfg: Any, inputs: Any, state: State) -> Mapping[str, Tensor | float]:
        """Make one step, except incrementing `state.step`; returns scalars for the progress display."""
        ...

    def finish(self, cfg: Any, inputs: Any, state: State) -> Any:
        """The stage's output, a tree."""
        ...


def drive(
    stage: Stage,
    cfg: Any,
    inputs: Any,
    *,
    seed: int,
    checkpoint: Path | None = None,
    every: int = 500,
    report: Callable[[Progress], None] | None = None,
    name: str = "",
    key: str = "",
) -> Any:
    """Train a stage from its start or its checkpoint to the end, and return its output.

    Steps are recorded and replayed as a whole if stage and device can do so (`engine.graph`).

    On a terminal a progress bar shows the remaining time and the latest scalars (`io.progress`). Ctrl-C or SIGTERM
    stops after the current step and saves a checkpoint; a second one stops immediately.

    Args:
        stage: The stage module.
        cfg: Settings of the stage.
        inputs: Argument `inputs` of the stage's functions.
        seed: Seed of `State.rng`.
        checkpoint: File to resume from and to save to, in whose folder a preview is also written; None saves nothing.
        every: Number of steps between two checkpoints; one is also saved after the last step, before `finish`.
        report: Called after the first step of this process and the last one, and between them at most every
            `REPORT_SECONDS`.
        name: Name of the stage for messages.
        key: Hash of the inputs. A checkpoint with another key, version, configuration or seed is ignored.

    Raises:
        NotFinite: A tensor became NaN or infinite; the last valid checkpoint is kept.
        BadFile: The checkpoint does not match the stage.
        OSError: The checkpoint cannot be written; the previous one is kept.
        KeyboardInterrupt: Training was stopped by Ctrl-C or SIGTERM; the message holds the checkpoint.
    """
    started = time.perf_counter()
    key = fingerprint(key, stage.VERSION, cfg, seed)
    total = stage.length(cfg, inputs)
    # A task of its own, which shows that it goes on without a number of steps: stage 3 tries out several starts here.
    with progress.task(f"{name or 'training'}: start"):
        state, seconds = _start(stage, cfg, inputs, torch.Generator().manual_seed(seed), checkpoint, key)
    with progress.task(name or "training", total) as update:

        def save() -> None:
            _check(state, checkpoint)
            if checkpoint:
                _save(state, checkpoint, key, seconds + time.perf_counter() - started)
                _write_preview(stage, cfg, inputs, state, checkpoint.with_name(PREVIEW))

        show = _step_reports(name, total, state.step, started - seconds, update, report)
        with _interrupts() as interrupted, graph.steps(stage, cfg, inputs, state) as step:
            if state.step >= total:
                _check(state, checkpoint)
            while state.step < total:
                scalars = _step(step, cfg, inputs, state, checkpoint)
                state.step += 1
                show(state.step, scalars)
                stops = interrupted()  # asked once, so that a signal after it has its state saved by the next step
                if state.step % every == 0 or state.step == total or stops:
                    save()
                if stops:
                    break
            if interrupted():
                raise KeyboardInterrupt(_stop_message(name, state.step, total, checkpoint))
        return stage.finish(cfg, inputs, state)


def peek(path: Path) -> tuple[int, dict[str, Tensor]]:
    """Step number and parameters by name of a checkpoint, for inspection.

    Raises:
        BadFile: The file is not a checkpoint.
    """
    about, tensors = _read(path)
    return about.step, {
        name.removeprefix("params/"): value for name, value in tensors.items() if name.startswith("params/")
    }


def fingerprint(*parts: Any) -> str:
    """SHA-256 of plain values and dataclasses of them as canonical JSON, which includes the class names."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return {"": type(value).__name__} | {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        if isinstance(value, Path):
            return str(value)
        raise TypeError(f"settings must be numbers, strings or dataclasses of these, not a {type(value).__name__}")

    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _step(
    step: graph.Step, cfg: Any, inputs: Any, state: State, checkpoint: Path | None
) -> Mapping[str, Tensor | float]:
    try:
        return step(cfg, inputs, state)
    except NotFinite as error:
        raise _with_checkpoint(error, checkpoint) from error


def _with_checkpoint(error: NotFinite, checkpoint: Path | None) -> NotFinite:
    """The error with the path of the checkpoint in its message, if there is one."""
    existing = checkpoint if checkpoint and checkpoint.exists() else None
    return NotFinite(error.name, error.step, part=error.part, state_file=existing)


def _stop_message(name: str, step: int, total: int, checkpoint: Path | None) -> str:
    saved = f"run the same command again to continue from {checkpoint}" if checkpoint else "nothing was saved"
    return f"{name or 'training'} stopped at step {step} of {total}; {saved}"


def _write_preview(stage: Stage, cfg: Any, inputs: Any, state: State, path: Path) -> None:
    """Write the preview image of a stage that defines one; `state.rng` is restored afterwards."""
    preview: Callable[..., UInt8[Tensor, "h w 3"]] | None = getattr(stage, "preview", None)
    if preview is None:
        return
    before = state.rng.get_state()
    with torch.no_grad():
        image = preview(cfg, inputs, state)
    state.rng.set_state(before)
    files.write_png(path, image.cpu().numpy())


# Checkpoints ----------------------------------------------------------------------------------------------------------


class _SavedState(msgspec.Struct, frozen=True):
    """The part of a checkpoint that is no tensor."""

    key: str
    step: Annotated[int, msgspec.Meta(ge=0)]
    seconds: float


def _parts(state: State) -> dict[str, dict[str, Tensor]]:
    """The tensors of a state, by part and by name."""
    moments = optim.pack(state.optimizer) if state.optimizer else {}
    memory = {name: x for name, x in state.memory.items() if not name.startswith(CACHE)}
    return {"params": tree.named_tensors(state.params), "optimizer": moments, "memory": memory}


def _check(state: State, checkpoint: Path | None) -> None:
    """Raise `NotFinite` if parameters or moments are not finite; `memory` may hold infinities."""
    parts = _parts(state)
    if state.optimizer:
        optim.check_steps(state.optimizer, state.step)
    if name := optim.first_not_finite((parts["params"] | parts["optimizer"]).items()):
        raise _with_checkpoint(NotFinite(name, state.step), checkpoint)


def _save(state: State, path: Path, key: str, seconds: float) -> None:
    """Write a checkpoint atomically."""
    tensors = {f"{part}/{name}": x for part, named in _parts(state).items() for name, x in named.items()}
    tensors["rng"] = state.rng.get_state()
    about = {"key": key, "step": state.step, "seconds": seconds}  # a `_SavedState`
    write_tensors(path, tensors, {"type": "State", "tumble": __version__, "state": json.dumps(about)})


def _start(
    stage: Stage, cfg: Any, inputs: Any, rng: torch.Generator, path: Path | None, key: str
) -> tuple[State, float]:
    """The state of a checkpoint with this key and its training time [s], or the first state and 0 without one.

    A damaged checkpoint gives a warning, and the stage starts again: every later state would contain the damage.
    """
    try:
        saved = _read(path) if path and path.exists() else None
    except BadFile as error:
        warnings.warn(str(error), stacklevel=4)
        saved = None
    if path is None or saved is None or saved[0].key != key:
        return stage.init(cfg, inputs, rng), 0.0
    about, tensors = saved
    names = [name.removeprefix("params/") for name in tensors if name.startswith("params/")]
    blank = getattr(stage, "blank", None)
    state = blank(cfg, inputs, rng, names) if blank else stage.init(cfg, inputs, rng)
    _restore(state, path, tensors)
    state.step = about.step
    return state, about.seconds


def _restore(state: State, path: Path, tensors: dict[str, Tensor]) -> None:
    """Restore the tensors of a checkpoint into a state with its structure."""
    parts: dict[str, dict[str, Tensor]] = {"params": {}, "optimizer": {}, "memory": {}}
    for name, value in tensors.items():
        part, _, rest = name.partition("/")
        if part in parts:
            parts[part][rest] = value
    order = list(tree.named_tensors(state.params))
    devices = {name: x.device for name, x in state.memory.items()}
    default = next((x.device for x in tree.named_tensors(state.params).values()), torch.device("cpu"))
    try:
        params = {name: parts["params"].pop(name) for name in order} | parts["params"]
        state.params = optim.overwrite(state.params, state.optimizer, params)
        if state.optimizer:
            optim.unpack(state.optimizer, parts["optimizer"])
        state.rng.set_state(tensors["rng"])
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise BadFile(path, f"does not match this stage: {error}", "remove it to restart the stage") from None
    state.memory = {name: x.to(devices.get(name, default), copy=True) for name, x in parts["memory"].items()}


def _read(path: Path) -> tuple[_SavedState, dict[str, Tensor]]:
    try:
        tensors, header = read_tensors(path, RESTART)
    except OSError as error:
        raise BadFile(path, f"is not a checkpoint: {error}", RESTART) from None
    try:
        return files.parse_json(path, header.get("state", ""), _SavedState), tensors
    except BadFile as error:
        raise BadFile(path, f"is not a checkpoint: {error.rule}", RESTART) from None


# Interrupts and progress ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _interrupts() -> Iterator[Callable[[], bool]]:
    """A function that returns whether Ctrl-C was pressed or SIGTERM received; a second one has its usual effect.

    In other threads than the main one, where Python cannot handle signals, the function always returns False. Signals
    that the process ignores, as in a background job of a shell, stay ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}
    received: list[int] = []

    def handle(number: int, frame: Any) -> None:
        received.append(number)
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, handle)
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _step_reports(
    name: str,
    total: int,
    first: int,
    started: float,
    update: progress.Update,
    report: Callable[[Progress], None] | None,
) -> Callable[[int, Mapping[str, Tensor | float]], None]:
    """A function that passes a step to the progress display and to `report`, at limited rates."""
    start = time.perf_counter()
    reported = -float("inf")

    def show(step: int, scalars: Mapping[str, Tensor | float]) -> None:
        nonlocal reported

        def metrics() -> dict[str, float]:
            return {key: float(torch.as_tensor(value).detach()) for key, value in scalars.items()}

        update(step, lambda: "  ".join(f"{key} {value:.4g}" for key, value in metrics().items()))
        now = time.perf_counter()
        if report is not None and (now - reported >= REPORT_SECONDS or step == total):
            reported = now
            eta = (now - start) / (step - first) * (total - step)
            report(Progress(name, step, total, round(now - started, 3), round(eta, 1), metrics()))

    return show
