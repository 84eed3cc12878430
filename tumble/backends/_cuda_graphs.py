"""Recordings as CUDA graphs.

torch captures everything that is launched on its current stream, in memory of its own (a private pool). Warp's kernels
go to the same stream. Warp is told about the capture: it then keeps the modules of its kernels loaded for as long as
the graph exists, and frees nothing meanwhile. Captures are impossible on the default stream, and an operation of the
backward pass waits for the stream of its parameter's first use; therefore all steps run on one stream of their own, not
only the captured ones.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tumble.backends._graphs import CannotRecord, Recording, as_recording
from tumble.backends._pairs import PairLimit


@dataclass(frozen=True)
class CudaRecorder:
    """Records CUDA graphs; see `Recorder`."""

    device: torch.device
    lists: Callable[[torch.device], Sequence[PairLimit]]
    """Lists of tiles of all views on a device (`cuda.pair_limits`)."""

    @contextmanager
    def session(self) -> Iterator[None]:
        """See `Recorder.session`."""
        outer, own = torch.cuda.current_stream(self.device), torch.cuda.Stream(self.device)
        own.wait_stream(outer)
        try:
            with torch.cuda.stream(own):
                yield
        finally:
            outer.wait_stream(own)

    def pinned(self, values: Tensor) -> Tensor:
        """See `Recorder.pinned`; torch does not reuse the memory before the copy is made."""
        return values.pin_memory()

    def record(self, work: Callable[[], Any]) -> Recording:
        """See `Recorder.record`."""
        from tumble.backends._warp import runtime

        limits = looked_at(self.lists(self.device))
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.current_stream(self.device)
        # Only this thread must do nothing that a capture forbids, not those that torch or the user runs beside it.
        capture = torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local")
        try:
            with as_recording(), capture, runtime.told_of_capture(self.device) as of_warp:
                result = work()
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            raise CannotRecord(str(error)) from error

        def replay() -> None:
            assert of_warp, "the capture has ended"  # Warp's part of the graph lives as long as this function
            graph.replay()

        return Recording(result, replay, lambda: still_fits(limits, self.lists(self.device)))


def looked_at(limits: Sequence[PairLimit]) -> list[PairLimit]:
    """Copies of the limits after a look at the device."""
    for limit in limits:
        limit.look()
    return [replace(limit) for limit in limits]


def still_fits(before: Sequence[PairLimit], limits: Sequence[PairLimit]) -> bool:
    """Whether a look at the device leaves the lists as they were."""
    now = looked_at(limits)
    return all(a.capacity == b.capacity and a.longest is b.longest for a, b in zip(before, now, strict=False))
