"""Progress of tasks that take long, on standard error.

On a terminal a task is one live line with a bar. Elsewhere it is a line in the log `tumble` of Python's `logging` when
it starts, and another every `LOG_SECONDS`. The command line prints this log; in Python nobody sees it unless asked for:
`logging.basicConfig(level="INFO")`. Tasks do not contain each other; those of threads beside the main one have
no bar.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tumble.io.errors import one_line

T = TypeVar("T")

LOG = logging.getLogger("tumble")
"""The log of all tasks."""
LOG_SECONDS = 30.0
"""Time between two lines of the log about one task [s]."""
BAR_SECONDS = 0.5
"""Minimum time between two updates of a bar [s]; a text about the step may have to wait for the device."""


Update = Callable[[int, Callable[[], str]], None]
"""Function that takes the number of finished steps, and a function for a text about the latest one."""


@contextlib.contextmanager
def task(name: str, total: int | None = None) -> Iterator[Update]:
    """Context of a task; yields the function that reports finished steps, which costs nothing between two updates.

    Args:
        name: What is done, for display.
        total: Number of steps, if it is known.
    """
    console, name = Console(stderr=True), one_line(name)
    if console.is_terminal and threading.current_thread() is not threading.main_thread():
        yield lambda step, describe: None
        return
    with _bar(name, total, console) if console.is_terminal else _log_lines(name, total) as update:
        yield update


def track(items: Iterable[T], name: str, total: int) -> Iterator[T]:
    """The items, in a task whose steps they are."""
    with task(name, total) as update:
        for number, item in enumerate(items, 1):
            yield item
            update(number, str)


@contextlib.contextmanager
def _bar(name: str, total: int | None, console: Console) -> Iterator[Update]:
    steps = () if total is None else (MofNCompleteColumn(), TimeRemainingColumn())
    name_column, text_column = (
        TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[text]}")
    )
    columns = (name_column, BarColumn(), *steps, text_column)
    columns = columns if total is not None else (*columns, TimeElapsedColumn())
    # A thread that draws would compete with training; it is only used where no step causes a drawing.
    bar = Progress(*columns, console=console, auto_refresh=total is None, transient=True)
    shown, drawn = bar.add_task(name, total=total, text=""), -float("inf")

    def update(step: int, describe: Callable[[], str]) -> None:
        nonlocal drawn
        if time.perf_counter() - drawn >= BAR_SECONDS:
            drawn = time.perf_counter()
            bar.update(shown, completed=step, text=describe(), refresh=True)

    with bar:
        yield update


@contextlib.contextmanager
def _log_lines(name: str, total: int | None) -> Iterator[Update]:
    done, ended, start = 0, threading.Event(), time.perf_counter()

    def update(step: int, describe: Callable[[], str]) -> None:
        nonlocal done
        done = step

    def repeat() -> None:
        while not ended.wait(LOG_SECONDS):
            steps = "" if total is None else f"step {done} of {total}, "
            LOG.info("%s: %s%.0f s", name, steps, time.perf_counter() - start)

    LOG.info("%s", name if total is None else f"{name} ({total} steps)")
    if not LOG.isEnabledFor(logging.INFO):
        yield update
        return
    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield update
    finally:
        ended.set()
        thread.join()
