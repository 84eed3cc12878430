"""Runs many tasks at the same time: each in a process of its own on this machine, or on a Ray cluster.

A task that raises an error has failed. A task whose process was killed, as by the system when memory runs out, or whose
machine was lost, is started again, `RETRIES` times.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

RETRIES = 1
"""How often a task is started again whose process was killed or whose machine was lost."""
CORES_PER_TASK = 2
"""Cores for each task, which computes on several threads: on a cluster, and by default on this machine."""


@runtime_checkable
class NamedTask(Protocol):
    """What is executed: a value that can be sent to another process, with a name for logs and messages."""

    @property
    def name(self) -> str: ...


T = TypeVar("T", bound=NamedTask)
R = TypeVar("R")


@dataclass(frozen=True)
class Outcome(Generic[T, R]):
    """A task with its result or, if it failed, the reason in one line."""

    task: T
    result: R | None = None
    error: str = ""


@dataclass(frozen=True)
class Workers:
    """Where tasks are executed."""

    jobs: int = 0
    """Number of tasks at the same time on this machine; 0: one per `CORES_PER_TASK` cores."""
    address: str = ""
    """Address of a Ray cluster, or "local" for one that is started on this machine; empty: no Ray."""
    gpu: bool | None = False
    """Whether a task on a Ray cluster occupies a GPU, which hides the others from it; None: if the cluster has any."""

    def __post_init__(self) -> None:
        if self.jobs < 0:
            raise ValueError(f"--jobs is out of range: {self.jobs}; give 1 or more, or 0: as many as the cores allow")


def execute(function: Callable[[T], R], tasks: Sequence[T], workers: Workers, logs: Path) -> Iterator[Outcome[T, R]]:
    """Outcomes of `function(task)` for all tasks, in the order in which they finish.

    Args:
        function: A function of a module, which other processes can import.
        logs: Folder for what the processes on this machine print, one file per task. A Ray cluster keeps its own logs.

    Raises:
        ModuleNotFoundError: A cluster is asked for, and Ray is not installed.
        ConnectionError: There is no cluster at the address.
    """
    if workers.address:
        yield from _on_ray(function, tasks, workers)
    else:
        jobs = workers.jobs or max(1, (os.cpu_count() or 1) // CORES_PER_TASK)
        yield from in_processes(function, tasks, jobs, logs)


# Processes on this machine --------------------------------------------------------------------------------------------


def in_processes(function: Callable[[T], R], tasks: Sequence[T], jobs: int, logs: Path) -> Iterator[Outcome[T, R]]:
    """See `execute`; a new process for each task, so that its peak memory is its own, and at most `jobs` at a time."""
    from tumble.io import files  # not above, as in `_outcome`

    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // jobs)))
    with files.describe_write_errors(logs):
        logs.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    waiting = deque((task, 0) for task in tasks)
    running: dict[Any, tuple[Any, T, int]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                task, attempt = waiting.popleft()
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(target=_process, args=(function, task, sender, logs / f"{task.name}.log"))
                process.start()
                sender.close()  # the process has the other end: if it dies, the receiver gets an end of file
                running[receiver] = process, task, attempt
            for receiver in connection.wait(list(running)):
                process, task, attempt = running.pop(receiver)
                outcome = _received(receiver, process, task)
                if outcome is not None:
                    yield outcome
                elif attempt < RETRIES:
                    waiting.appendleft((task, attempt + 1))
                else:
                    reason = f"its process ended {attempt + 1} times with exit code {process.exitcode}"
                    advice = " (killed: is there enough memory?)" if process.exitcode == -signal.SIGKILL else ""
                    yield Outcome(task, error=reason + advice)
    finally:
        for process, _, _ in running.values():
            process.terminate()
        for process, _, _ in running.values():
            process.join()


def _received(receiver: Any, process: Any, task: T) -> Outcome[T, Any] | None:
    """What a process has sent; None if it ended without a word."""
    try:
        succeeded, value = receiver.recv()
    except EOFError:
        return None
    finally:
        process.join()
        receiver.close()
    return _outcome(task, succeeded, value)


def _outcome(task: T, succeeded: bool, value: Any) -> Outcome[T, Any]:
    from tumble.io import one_line  # not above: every process imports this module, and this takes a second

    return Outcome(task, value) if succeeded else Outcome(task, error=one_line(value))


def _process(function: Callable[[T], R], task: T, sender: Any, log: Path) -> None:
    """The work of a process: everything it prints goes to a file; SIGTERM interrupts it as Ctrl-C does."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with log.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    with contextlib.suppress(KeyboardInterrupt):
        sender.send(_attempt(function, task))


def _attempt(function: Callable[[T], R], task: T) -> tuple[bool, Any]:
    """True and the result of a task, or False and its error; the log has the traceback."""
    try:
        return True, function(task)
    except Exception as error:
        traceback.print_exc()
        return False, f"{type(error).__name__}: {error}"


# Ray ------------------------------------------------------------------------------------------------------------------


def _on_ray(function: Callable[[T], R], tasks: Sequence[T], workers: Workers) -> Iterator[Outcome[T, R]]:
    """See `execute`; the cluster decides how many tasks run at the same time, by their cores and GPUs."""
    try:
        import ray
        from ray.exceptions import RayError
    except ModuleNotFoundError:
        raise ModuleNotFoundError("Ray is not installed: pip install 'tumble[cluster]'") from None
    address = None if workers.address == "local" else workers.address
    ray.init(address, log_to_driver=False, configure_logging=False)
    try:
        gpu = ray.cluster_resources().get("GPU", 0) > 0 if workers.gpu is None else workers.gpu
        # A process serves one task, so that its peak memory is its own.
        remote = ray.remote(
            num_cpus=min(CORES_PER_TASK, os.cpu_count() or 1),
            num_gpus=int(gpu),
            max_retries=RETRIES,
            max_calls=1,
        )(_attempt)
        running = {remote.remote(function, task): task for task in tasks}
        while running:
            (finished,), _ = ray.wait(list(running), num_returns=1)
            task = running.pop(finished)
            try:
                succeeded, value = ray.get(finished)
            except RayError as error:
                succeeded, value = False, f"{type(error).__name__}: {error}".partition("\n")[0]
            yield _outcome(task, succeeded, value)
    finally:
        ray.shutdown()
