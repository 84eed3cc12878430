"""Tasks in processes and on a Ray cluster: results, errors, and workers that are killed."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from tumble.bench import executor
from tumble.bench.executor import Workers


@dataclass(frozen=True)
class Task:
    name: str
    folder: Path


def work(task: Task) -> str:
    """Note the attempt; then the task's name says what happens."""
    attempts = task.folder / f"{task.name}.attempts"
    with attempts.open("a") as file:
        file.write(f"{os.getpid()}\n")
    n = len(attempts.read_text().splitlines())
    if task.name == "wrong":
        raise ValueError("two\nlines")
    if task.name == "doomed" or (task.name == "killed" and n == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    print(f"attempt {n}")
    return task.name.upper()


def attempts(task: Task) -> int:
    return len((task.folder / f"{task.name}.attempts").read_text().splitlines())


def test_processes_return_results_and_errors_and_are_replaced_when_killed(tmp_path: Path) -> None:
    tasks = {name: Task(name, tmp_path) for name in ("good", "wrong", "killed", "doomed")}
    outcomes = list(executor.execute(work, list(tasks.values()), Workers(jobs=2), tmp_path / "logs"))
    by_name = {outcome.task.name: outcome for outcome in outcomes}
    assert by_name["good"].result == "GOOD"
    assert by_name["killed"].result == "KILLED"
    assert by_name["wrong"].error == r"ValueError: two\nlines"
    assert "ended 2 times with exit code -9" in by_name["doomed"].error
    assert {name: attempts(task) for name, task in tasks.items()} == {"good": 1, "wrong": 1, "killed": 2, "doomed": 2}
    assert (tmp_path / "logs" / "killed.log").read_text() == "attempt 2\n"
    assert "Traceback" in (tmp_path / "logs" / "wrong.log").read_text()


def sleep(task: Task) -> None:
    """Nothing for the task "short", else a minute of work that notes its interruption."""
    if task.name == "short":
        return
    try:
        (task.folder / "started").touch()
        time.sleep(60)
    except KeyboardInterrupt:
        (task.folder / "interrupted").touch()
        raise


def test_processes_are_interrupted_with_their_caller(tmp_path: Path) -> None:
    """As by Ctrl-C, upon which a stage saves its checkpoint."""
    tasks = [Task("short", tmp_path), Task("long", tmp_path)]
    outcomes = executor.in_processes(sleep, tasks, 2, tmp_path / "logs")
    assert next(outcomes).task.name == "short"
    end = time.monotonic() + 60
    while not (tmp_path / "started").exists():
        assert time.monotonic() < end
        time.sleep(0.01)
    outcomes.close()  # type: ignore[attr-defined]
    assert (tmp_path / "interrupted").exists()
