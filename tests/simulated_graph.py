"""Recordings on the CPU, by the rules of CUDA graphs, of functions whose kernels are those for a GPU.

A recording keeps every operation of torch and every launch of Warp with the very tensors and numbers that it used;
nothing of what it did stays done, and the memory that it made is filled with bytes that are no number. A replay repeats
these operations on the same memory, without the function. So it differs from the function as soon as a number of Python
would have to change, as an operation reads a tensor that was replaced in the meantime, or as something was computed
that is no operation on the device. What a capture forbids is an error: values that the host asks for, and copies of its
own.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map

from tests.simulated_gpu import WAITING, WITH_WARP
from tumble import backends
from tumble.backends import cuda
from tumble.backends._cuda_graphs import looked_at, still_fits
from tumble.backends._graphs import Recording, as_recording

CPU = torch.device("cpu")


class Forbidden(AssertionError):
    """Error for what a GPU could not capture."""


class Tape(TorchDispatchMode):
    """Context whose operations are recorded."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[Callable[[], Any]] = []
        self.operations = Counter[str]()
        self.made: dict[int, Tensor] = {}
        """Memory that was made while recording, by its address."""
        self.before: dict[int, tuple[Tensor, Tensor]] = {}
        """Other memory that was used, by its address, and what it held."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = function.__name__.partition(".")[0], kwargs or {}
        used = self.note((args, kwargs))
        masked = name.startswith("index") and any(x.dtype in (torch.bool, torch.uint8) for x in used[1:])
        if name in WAITING or masked or name == "lift_fresh":
            raise Forbidden(f"{name} while a step is recorded")
        result = function(*args, **kwargs)
        arguments, options = tree_map(without_gradient, (args, kwargs))
        out = [without_gradient(x) for x in tree_flatten(result)[0] if isinstance(x, Tensor)]
        if function._schema.is_mutable:
            self.add(name, lambda: function(*arguments, **options))
        elif not {address(x) for x in out} <= {address(x) for x in used}:
            self.made |= {address(x): memory(x) for x in out}
            if not name.startswith(("empty", "new_empty")):
                self.add(name, lambda: fill(out, function(*arguments, **options)))
        return result

    def note(self, values: Any) -> list[Tensor]:
        """Keep what the memory of the values holds; returns the tensors among them."""
        used = [x for x in tree_flatten(values)[0] if isinstance(x, Tensor)]
        with _disable_current_modes():
            for x in used:
                if address(x) not in self.made and address(x) not in self.before:
                    self.before[address(x)] = memory(x), memory(x).clone()
        return used

    def add(self, name: str, entry: Callable[[], Any]) -> None:
        self.operations[name] += 1
        self.entries.append(entry)

    def undo(self) -> None:
        """Restore what was there before, and spoil what was made."""
        for now, then in self.before.values():
            now.copy_(then)
        for x in self.made.values():
            x.fill_(255)

    @torch.no_grad()
    def replay(self) -> None:
        for entry in self.entries:
            entry()


def without_gradient(x: Any) -> Any:
    return x.detach() if isinstance(x, Tensor) else x


def address(x: Tensor) -> int:
    return x.untyped_storage().data_ptr()


def memory(x: Tensor) -> Tensor:
    """All bytes of a tensor's memory."""
    return torch.empty(0, dtype=torch.uint8).set_(x.untyped_storage())  # type: ignore


def fill(old: list[Tensor], new: Any) -> None:
    for a, b in zip(old, (x for x in tree_flatten(new)[0] if isinstance(x, Tensor)), strict=True):
        a.copy_(b)


class SimulatedRecorder:
    """A `backends.Recorder` of the CPU."""

    def __init__(self) -> None:
        self.tapes: list[Tape] = []
        self.replays = 0
        self.sent = 0

    @contextmanager
    def session(self) -> Iterator[None]:
        yield

    def pinned(self, values: Tensor) -> Tensor:
        self.sent += 1
        return values.clone()

    def record(self, work: Callable[[], Any]) -> Recording:
        import warp

        from tumble.backends._warp import runtime

        limits, tape = looked_at(cuda.pair_limits(CPU)), Tape()
        launch = runtime.launch

        def launched(kernel: Any, threads: Any, *arguments: Any) -> None:
            tape.note(arguments)
            kept = tree_map(without_gradient, arguments)
            tape.add(kernel.key, lambda: launch_on_cpu(kernel, threads, *kept))
            launch(kernel, threads, *arguments)

        def launch_on_cpu(*arguments: Any) -> None:
            with runtime.stream(CPU):
                launch(*arguments)

        def sorted_pairs(*_: Any, **options: Any) -> None:
            raise Forbidden("Warp's sort allocates memory")

        with (
            patch.object(runtime, "launch", launched),
            patch.object(warp.utils, "radix_sort_pairs", sorted_pairs),
            as_recording(),
            tape,
        ):
            result = work()
        tape.undo()
        self.tapes.append(tape)

        def replay() -> None:
            self.replays += 1
            tape.replay()

        return Recording(result, replay, lambda: still_fits(limits, cuda.pair_limits(CPU)))


@contextmanager
def simulated_graphs() -> Iterator[SimulatedRecorder]:
    """Context in which the kernels for a GPU run on the CPU, whose steps can be recorded."""
    if not WITH_WARP:
        pytest.skip("needs NVIDIA Warp: pip install 'tumble[cuda]'")
    recorder = SimulatedRecorder()
    with (
        patch.object(backends, "choose", lambda device, dtype: backends.load("cuda")),
        patch.object(backends, "recorder", lambda device: recorder),
    ):
        yield recorder
