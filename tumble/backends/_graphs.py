"""Recording of what a function asks of a device, to repeat it as a whole: the interface, which is not of one device.

A *recording* repeats the same operations on the same memory with the same numbers of Python. What is to change between
two replays is therefore read from tensors that are written in between.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

_recording: ContextVar[bool] = ContextVar("recording", default=False)


def recording() -> bool:
    """Whether a recorder records, so that nothing may ask the device for a value."""
    return _recording.get()


@contextmanager
def as_recording() -> Iterator[None]:
    """Context in which `recording` is true."""
    token = _recording.set(True)
    try:
        yield
    finally:
        _recording.reset(token)


class CannotRecord(RuntimeError):
    """Error for work that cannot be recorded; nothing of it was done."""


@dataclass(frozen=True)
class Recording:
    """Recorded operations of a function."""

    result: Any
    """What the function returned, whose tensors every replay writes."""
    replay: Callable[[], None]
    """Repeats the operations; the host does not wait for them."""
    fits: Callable[[], bool]
    """Asks the device whether memory of the recording that kernels fill by different amounts is still large enough."""


@runtime_checkable
class Recorder(Protocol):
    """Records functions on one device."""

    def session(self) -> AbstractContextManager[None]:
        """Context of everything that is recorded or replayed and of what runs in between."""
        ...

    def pinned(self, values: Tensor) -> Tensor:
        """A copy of values in host memory from which the device copies without a wait."""
        ...

    def record(self, work: Callable[[], Any]) -> Recording:
        """Record a function, whose operations are not executed: `Recording.replay` does that, also the first time.

        The function was called a few times before, so that everything that is kept between calls exists.

        Raises:
            CannotRecord: The function does what cannot be recorded.
        """
        ...
