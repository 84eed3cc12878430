"""The only training loop: it drives a stage step by step, shows where it is, and can be stopped and taken up again.

A *stage* is a module that says how a state begins, what one step does and what comes out; it knows nothing of disks
and progress bars. A *checkpoint* is the whole state between two steps as one safetensors file: leaves, moments,
memory and generator by name, the rest as JSON in its header. A run taken up from its checkpoint equals one that was
never stopped, bit for bit on the CPU, as long as all randomness comes from `State.rng`. A *fingerprint* is a hash that
tells whether a file on disk was made with these settings.
"""

import contextlib
import dataclasses
import hashlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import safetensors
import safetensors.torch
import torch
from jaxtyping import UInt8
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from torch import Tensor

from tumble import __version__
from tumble.engine import optim
from tumble.engine.optim import NotFinite
from tumble.io import BadFile, files, tree

BAR_SECONDS = 0.5
"""Least time between two movements of the bar: reading a metric waits for the device."""
REPORT_SECONDS = 5.0
"""Least time between two reports [s]."""
PREVIEW = "preview.png"
"""The stage's latest picture, beside its checkpoint."""


@dataclass
class State:
    """All that changes while a stage trains; mutable, because training is change, and the one object that it changes.

    `Stage.step` works on it in place. What is not in here does not survive a stop.
    """

    step: int
    """Steps done. Only `drive` counts."""
    params: Any
    """A tree of leaf tensors. Shapes may change while training, names may not."""
    optimizer: torch.optim.Adam | None
    """Over leaves of `params`, the same from `init` on: one that joins late has rate 0 until then (`optim.anneal`)."""
    rng: torch.Generator
    """The source of all randomness, on the CPU whatever the device: draw there, then move."""
    memory: dict[str, Tensor] = field(default_factory=dict)
    """What else a stage remembers: accumulators, caches."""


@dataclass(frozen=True)
class Progress:
    """How far a stage has come."""

    name: str
    """Of the stage."""
    step: int
    """Steps done."""
    of: int
    """Steps in all."""
    seconds: float
    """Of training, over all processes that worked on it."""
    eta: float
    """Seconds to go."""
    metrics: dict[str, float]
    """What the latest step returned."""


@runtime_checkable
class Stage(Protocol):
    """What a module offers to be driven. It may also have `preview(cfg, inputs, state)`, a picture `u8[h w 3]`."""

    @property
    def VERSION(self) -> int:
        """Raised when the same settings give another result, so that stored results are not taken for new ones."""
        ...

    @property
    def Config(self) -> type:
        """A frozen dataclass of numbers, words and further such dataclasses."""
        ...

    def length(self, cfg: Any, inputs: Any) -> int:
        """Number of steps."""
        ...

    def init(self, cfg: Any, inputs: Any, rng: torch.Generator) -> State:
        """The state at step 0. Also called before a checkpoint is restored, to learn its structure."""
        ...

    def step(self, cfg: Any, inputs: Any, state: State) -> Mapping[str, Tensor | float]:
        """Everything of one step but counting it; returns scalars to show."""
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
    """Run a stage from its start or its checkpoint to its end.

    On a terminal a bar shows the remaining time and the latest scalars. Ctrl-C lets the current step end, saves, and
    says how to go on; a second one stops at once.

    Args:
        stage: The module to drive.
        cfg: Its settings.
        inputs: What its functions take as `inputs`.
        seed: Of `State.rng`.
        checkpoint: File to take up from and to save to; a preview goes beside it. None keeps nothing.
        every: Steps between two checkpoints; one is also saved at the end, before `finish`.
        report: Called after the first and the last step, and in between every few seconds at most.
        name: Of the stage, for people.
        key: What the inputs are. A checkpoint of another key, version, configuration or seed is started over.

    Raises:
        NotFinite: A NaN, with the tensor, the step and the last good checkpoint, which stays as it is.
        BadFile: The checkpoint is not one, or does not fit the stage.
        OSError: The checkpoint cannot be written; the one before it is still whole.
        KeyboardInterrupt: After Ctrl-C, with what was saved.
    """
    begun = time.perf_counter()
    key = fingerprint(key, stage.VERSION, cfg, seed)
    total = stage.length(cfg, inputs)
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(seed))
    spent = _restore(state, checkpoint, key) if checkpoint else 0.0

    def save() -> None:
        _check(state, checkpoint)
        if checkpoint:
            _save(state, checkpoint, key, spent + time.perf_counter() - begun)
            _show(stage, cfg, inputs, state, checkpoint.with_name(PREVIEW))

    with _told(name, total, state.step, begun - spent, report) as tell, _interrupts() as interrupted:
        while state.step < total:
            scalars = _step(stage, cfg, inputs, state, checkpoint)
            state.step += 1
            tell(state.step, scalars)
            if state.step % every == 0 or state.step == total or interrupted():
                save()
            if interrupted():
                raise KeyboardInterrupt(_farewell(name, state.step, total, checkpoint))
    return stage.finish(cfg, inputs, state)


def peek(path: Path) -> tuple[int, dict[str, Tensor]]:
    """The step of a checkpoint and its parameters by name, to look at.

    Raises:
        BadFile: It is not one.
    """
    about, tensors = _read(path)
    return about["step"], {
        name.removeprefix("params/"): value for name, value in tensors.items() if name.startswith("params/")
    }


def fingerprint(*parts: Any) -> str:
    """sha256 of plain facts and dataclasses of them, as canonical JSON; a dataclass counts with its name."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return {"": type(value).__name__} | {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        if isinstance(value, Path):
            return str(value)
        raise TypeError(f"settings are numbers, words and dataclasses of them, not a {type(value).__name__}")

    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _step(stage: Stage, cfg: Any, inputs: Any, state: State, checkpoint: Path | None) -> Mapping[str, Tensor | float]:
    try:
        return stage.step(cfg, inputs, state)
    except NotFinite as error:
        raise _with_file(error, checkpoint) from error


def _with_file(error: NotFinite, checkpoint: Path | None) -> NotFinite:
    kept = checkpoint if checkpoint and checkpoint.exists() else None
    return NotFinite(error.name, error.step, part=error.part, state_file=kept)


def _farewell(name: str, step: int, total: int, checkpoint: Path | None) -> str:
    kept = f"the same command goes on from {checkpoint}" if checkpoint else "nothing was saved: there is no checkpoint"
    return f"{name or 'training'} stopped at step {step} of {total}; {kept}"


def _show(stage: Stage, cfg: Any, inputs: Any, state: State, path: Path) -> None:
    """Write the stage's preview, if it has one. What it draws at random does not count."""
    preview: Callable[..., UInt8[Tensor, "h w 3"]] | None = getattr(stage, "preview", None)
    if preview is None:
        return
    before = state.rng.get_state()
    with torch.no_grad():
        picture = preview(cfg, inputs, state)
    state.rng.set_state(before)
    files.write_png(path, picture.cpu().numpy())


# The checkpoint -------------------------------------------------------------------------------------------------------


def _named(state: State) -> dict[str, dict[str, Tensor]]:
    """The tensors of a state by part and name."""
    moments = optim.pack(state.optimizer) if state.optimizer else {}
    return {"params": tree.named_tensors(state.params), "optimizer": moments, "memory": state.memory}


def _check(state: State, checkpoint: Path | None) -> None:
    """No state with a NaN is kept or handed on; memory may hold infinities, as a minimum does at first."""
    parts = _named(state)
    if name := optim.first_not_finite((parts["params"] | parts["optimizer"]).items()):
        raise _with_file(NotFinite(name, state.step), checkpoint)


def _save(state: State, path: Path, key: str, seconds: float) -> None:
    """Write a state between two steps, whole or not at all."""
    tensors = {f"{part}/{name}": x for part, named in _named(state).items() for name, x in named.items()}
    tensors["rng"] = state.rng.get_state()
    owned = {name: x.detach().to("cpu", copy=True).contiguous() for name, x in tensors.items()}
    about = {"key": key, "step": state.step, "seconds": seconds}
    data = safetensors.torch.save(owned, {"type": "State", "tumble": __version__, "state": json.dumps(about)})
    files.write_whole(path, lambda partial: partial.write_bytes(data))


def _restore(state: State, path: Path, key: str) -> float:
    """Put a checkpoint of this key into a fresh state; seconds of training that it holds, 0 when there is none."""
    if not path.exists():
        return 0.0
    about, tensors = _read(path)
    if about["key"] != key:
        return 0.0
    parts: dict[str, dict[str, Tensor]] = {"params": {}, "optimizer": {}, "memory": {}}
    for name, value in tensors.items():
        part, _, rest = name.partition("/")
        if part in parts:
            parts[part][rest] = value
    order = list(tree.named_tensors(state.params))
    devices = {name: x.device for name, x in state.memory.items()}
    home = next((x.device for x in tree.named_tensors(state.params).values()), torch.device("cpu"))
    try:
        params = {name: parts["params"].pop(name) for name in order} | parts["params"]
        state.params = optim.overwrite(state.params, state.optimizer, params)
        if state.optimizer:
            optim.unpack(state.optimizer, parts["optimizer"])
    except (KeyError, ValueError) as error:
        raise BadFile(path, f"does not fit this stage: {error}", "remove it to start the stage over") from None
    state.memory = {name: x.to(devices.get(name, home), copy=True) for name, x in parts["memory"].items()}
    state.rng.set_state(tensors["rng"])
    state.step = about["step"]
    return about["seconds"]


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})["state"])
            return about, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (safetensors.SafetensorError, OSError, KeyError, json.JSONDecodeError) as error:
        raise BadFile(path, f"is not a checkpoint: {error}", "remove it to start the stage over") from None


# People ---------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _interrupts() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C was pressed. The second one interrupts at once; other threads never see any."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield lambda: False
        return
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _told(
    name: str, total: int, first: int, begun: float, report: Callable[[Progress], None] | None
) -> Iterator[Callable[[int, Mapping[str, Tensor | float]], None]]:
    """A function that tells people and `report` of a step, seldom enough to cost nothing."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[metrics]}"),
    )
    # The bar is drawn here and not by a thread of its own: threads are for training.
    bar = ProgressBar(*columns, console=console, auto_refresh=False, transient=True, disable=not console.is_terminal)
    task = bar.add_task(name or "training", total=total, completed=first, metrics="")
    start = time.perf_counter()
    drawn = reported = -float("inf")

    def tell(step: int, scalars: Mapping[str, Tensor | float]) -> None:
        nonlocal drawn, reported
        now = time.perf_counter()
        draws = not bar.disable and now - drawn >= BAR_SECONDS
        reports = report is not None and (now - reported >= REPORT_SECONDS or step == total)
        if not (draws or reports):
            return
        metrics = {key: float(torch.as_tensor(value).detach()) for key, value in scalars.items()}
        if draws:
            drawn = now
            words = "  ".join(f"{key} {value:.4g}" for key, value in metrics.items())
            bar.update(task, completed=step, metrics=words, refresh=True)
        if report is not None and reports:
            reported = now
            eta = (now - start) / (step - first) * (total - step)
            report(Progress(name, step, total, round(now - begun, 3), round(eta, 1), metrics))

    with bar:
        yield tell
