"""Steps that are recorded on a GPU and replayed as a whole, as a CUDA graph.

The host then asks the device once for a whole step, instead of for every operation of it. A stage that offers this
splits its step in two. `prepare` is what runs on the host: whatever changes shapes, replaces tensors or asks the device
for a value, and the *numbers* of this step, such as the index of its frame. `advance` is the rest; with the numbers as
tensors it asks the device for nothing and replaces no tensor of the state, so that it can be recorded.

Numbers and learning rates lie in one buffer on the device, which the host writes before each replay. A recording is
valid as long as the state consists of the same tensors; afterwards some steps run as usual, and a new one is made. If a
step cannot be recorded, a warning says so, and all steps run as usual.
"""

import logging
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from tumble import backends
from tumble.engine import optim
from tumble.io import tree

logger = logging.getLogger(__name__)

WARMUP = 3
"""Steps before a recording, in which kernels are compiled and everything is made that is kept between steps."""

Step = Callable[[Any, Any, Any], Mapping[str, Tensor | float]]
"""A function like `Stage.step`, of settings, inputs and state."""


@runtime_checkable
class SplitStage(Protocol):
    """A stage (`loop.Stage`) whose step is `prepare` and then `advance`."""

    def can_be_recorded(self, cfg: Any) -> bool:
        """Whether `advance` can be recorded with these settings; if not, all steps are usual ones."""
        ...

    def prepare(self, cfg: Any, inputs: Any, state: Any) -> Any:
        """What must precede the step, and its numbers.

        Returns:
            A frozen dataclass. Its fields of the types int and float are numbers; in a recorded step they are tensors
            without axes on the device, an int64 or a float32. Each of its other fields holds while a recording does.
        """
        ...

    def advance(self, cfg: Any, inputs: Any, state: Any, numbers: Any) -> Mapping[str, Tensor | float]:
        """The rest of the step with these numbers; returns what `step` returns."""
        ...


@contextmanager
def steps(stage: Any, cfg: Any, inputs: Any, state: Any) -> Iterator[Step]:
    """The step of a stage: recorded and replayed if it is a `SplitStage` that allows it and the device can do so."""
    usual: Step = stage.step
    splits = isinstance(stage, SplitStage) and stage.can_be_recorded(cfg)
    recorder = backends.recorder(next(iter(tree.named_tensors(state.params).values())).device) if splits else None
    if recorder is None:
        yield usual
        return
    with recorder.session():
        try:
            yield Replayed(stage, recorder).step
        finally:
            state.optimizer.rates = None


@dataclass(frozen=True)
class Validity:
    """What a recording depends on."""

    tensors: list[Tensor]
    """Tensors of the state."""
    rest: list[Hashable]
    """Their names, and whatever else decides what a step does."""

    def equals(self, other: "Validity") -> bool:
        """Whether all tensors are the same objects, and the rest is equal."""
        same = len(self.tensors) == len(other.tensors) and self.rest == other.rest
        return same and all(a is b for a, b in zip(self.tensors, other.tensors, strict=True))


@dataclass
class Replayed:
    """Steps of a stage, recorded and replayed; mutable, because a recording outlives the step in which it is made."""

    stage: SplitStage
    recorder: backends.Recorder
    validity: Validity = field(default_factory=lambda: Validity([], []))
    """Of the recording, or of the next one."""
    usual: int = 0
    """Steps without a recording since the last change."""
    refused: bool = False
    """Whether a recording failed, so that none is tried again."""
    recording: backends.Recording | None = None
    replays: int = 0
    """Replays of the recording."""
    buffer: UInt8[Tensor, " bytes"] | None = None
    """Numbers of the step on the device."""

    def step(self, cfg: Any, inputs: Any, state: Any) -> Mapping[str, Tensor | float]:
        """A step as by `Stage.step`."""
        numbers = self.stage.prepare(cfg, inputs, state)
        advance = partial(self.stage.advance, cfg, inputs, state, self.sent(numbers, state.optimizer))
        now = validity(numbers, state)
        if not now.equals(self.validity):
            self.validity, self.usual, self.recording = now, 0, None
        if self.recording is None and (self.usual < WARMUP or self.refused):
            self.usual += 1
            scalars = advance()
        else:
            scalars = self.replayed(advance)
            assert validity(numbers, state).equals(now), "advance must not replace a tensor of the state"
        if (state.step + 1) % optim.CHECK_EVERY == 0:
            optim.check_steps(state.optimizer, state.step)
        return scalars

    def replayed(self, advance: Callable[[], Mapping[str, Tensor | float]]) -> Mapping[str, Tensor | float]:
        """Replay the recording of `advance`, which is made if there is none."""
        if self.recording is None:
            try:
                self.recording, self.replays = self.recorder.record(advance), 0
            except backends.CannotRecord as error:
                logger.warning("steps are not replayed as a CUDA graph, and are slower: %s", error)
                self.refused = True
                return advance()
        scalars: Mapping[str, Tensor | float] = self.recording.result
        self.recording.replay()
        self.replays += 1
        # Most changes soon after a recording, as what a view needs does in the steps after a densification.
        if self.replays & (self.replays - 1) == 0 or self.replays % optim.CHECK_EVERY == 0:
            self.recording = self.recording if self.recording.fits() else None
        return scalars

    def sent(self, numbers: Any, optimizer: optim.Adam) -> Any:
        """The numbers as tensors on the device, and the optimizer's learning rates with them, in one copy."""
        kinds = {f.name: type(getattr(numbers, f.name)) for f in fields(numbers)}
        whole, real = ([name for name, kind in kinds.items() if kind is wanted] for wanted in (int, float))
        rates = [group["lr"] for group in optimizer.param_groups]
        of_whole = torch.tensor([getattr(numbers, name) for name in whole], dtype=torch.int64)
        of_real = torch.tensor([*(getattr(numbers, name) for name in real), *rates], dtype=torch.float32)
        values = torch.cat([of_whole.view(torch.uint8), of_real.view(torch.uint8)])
        if self.buffer is None:
            self.buffer = torch.empty_like(values, device=optimizer.param_groups[0]["params"][0].device)
        self.buffer.copy_(self.recorder.pinned(values), non_blocking=True)
        integers, floats = (x.unbind() for x in parted(self.buffer, len(whole)))
        optimizer.rates = list(floats[len(real) :])
        return replace(numbers, **dict(zip([*whole, *real], [*integers, *floats[: len(real)]], strict=True)))


def parted(buffer: UInt8[Tensor, " bytes"], n: int) -> tuple[Int64[Tensor, " {n}"], Float[Tensor, " m"]]:
    """The parts of a buffer that begins with n numbers of int64 and goes on with some of float32."""
    return buffer[: 8 * n].view(torch.int64), buffer[8 * n :].view(torch.float32)


def validity(numbers: Any, state: Any) -> Validity:
    """What a recording of a step with these numbers depends on."""
    named = {f"params.{name}": x for name, x in tree.named_tensors(state.params).items()}
    named |= {f"memory.{name}": x for name, x in state.memory.items()}
    moments = [x for kept in state.optimizer.state.values() for x in kept.values()]
    others = [getattr(numbers, f.name) for f in fields(numbers)]
    return Validity([*named.values(), *moments], [*named, *(x for x in others if type(x) not in (int, float))])
