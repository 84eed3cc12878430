"""Threads for work that libraries do without holding Python's lock: numpy, OpenCV and torch on large arrays."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

S = TypeVar("S")
T = TypeVar("T")


def in_threads(function: Callable[[S], T], items: Iterable[S], threads: int | None = None) -> Iterator[T]:
    """Yield the results for all items, in order; when one fails, those that have not begun are dropped.

    Args:
        function: Called once for every item.
        items: Arguments of these calls.
        threads: Number of threads; that of torch by default.
    """
    threads = torch.get_num_threads() if threads is None else threads
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        try:
            yield from pool.map(function, items)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def begin(pool: ThreadPoolExecutor, device: torch.device, task: Callable[[], T]) -> Callable[[], T]:
    """A function that returns the result of a task which a thread does meanwhile.

    A task on a device other than the CPU, whose work is one queue anyway, is done at once by the calling thread.
    """
    if device.type == "cpu":
        return pool.submit(task).result
    result = task()
    return lambda: result
