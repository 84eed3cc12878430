"""Tasks in processes and on a Ray cluster: results, errors, and workers that are killed."""

import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

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


def on_a_machine(task: Task) -> str:
    """Note on which machine of the cluster the task is, and wait until it may go on."""
    import ray

    node = ray.get_runtime_context().get_node_id()
    with (task.folder / f"{task.name}.attempts").open("a") as file:
        file.write(f"{node}\n")
    while not (task.folder / "go").exists():
        time.sleep(0.05)
    return node


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_ray_cluster_goes_on_when_one_of_its_two_workers_is_killed(tmp_path: Path) -> None:
    """Two machines with one task each; one is lost, and its task and all others run on the other one."""
    pytest.importorskip("ray", reason="needs the extra `cluster`")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        machines = {node.node_id: node for node in (cluster.add_node(num_cpus=2) for _ in range(2))}
        cluster.wait_for_nodes()
        tasks = [Task(f"t{i}", tmp_path) for i in range(4)]
        noted: list[Path] = []

        def lose_one() -> None:
            while len(noted) < 2:
                noted[:] = tmp_path.glob("*.attempts")
                time.sleep(0.05)
            lost.append(noted[0].read_text().split()[0])
            cluster.remove_node(machines[lost[0]], allow_graceful=False)
            (tmp_path / "go").touch()

        lost: list[str] = []
        thread = threading.Thread(target=lose_one)
        thread.start()
        outcomes = list(executor.execute(on_a_machine, tasks, Workers(address=cluster.address), tmp_path))
        thread.join()
    finally:
        cluster.shutdown()
    (left,) = machines.keys() - set(lost)
    assert [outcome.error for outcome in outcomes] == [""] * 4
    assert {outcome.task.name for outcome in outcomes} == {"t0", "t1", "t2", "t3"}
    assert {outcome.result for outcome in outcomes} == {left}
    assert attempts(Task(noted[0].stem, tmp_path)) == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_ray_on_this_machine_returns_results_errors_and_replaces_killed_processes(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs the extra `cluster`")
    tasks = [Task(name, tmp_path) for name in ("good", "wrong", "killed", "doomed")]
    outcomes = list(executor.execute(work, tasks, Workers(address="local"), tmp_path))
    by_name = {outcome.task.name: outcome for outcome in outcomes}
    assert (by_name["good"].result, by_name["killed"].result) == ("GOOD", "KILLED")
    assert by_name["wrong"].error == r"ValueError: two\nlines"
    assert "WorkerCrashedError" in by_name["doomed"].error
    assert {task.name: attempts(task) for task in tasks} == {"good": 1, "wrong": 1, "killed": 2, "doomed": 2}


@pytest.mark.parametrize(("gpu", "has", "occupied"), [(None, 2.0, 1), (None, 0.0, 0), (False, 2.0, 0), (True, 0.0, 1)])
def test_a_task_occupies_a_gpu_if_it_must_or_may(
    gpu: bool | None, has: float, occupied: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict] = []
    ray = SimpleNamespace(
        init=lambda *_, **__: None,
        cluster_resources=lambda: {"CPU": 8.0, **({"GPU": has} if has else {})},
        remote=lambda **options: asked.append(options) or (lambda function: function),
        shutdown=lambda: None,
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", SimpleNamespace(RayError=RuntimeError))
    assert list(executor.execute(work, [], Workers(address="local", gpu=gpu), tmp_path)) == []
    assert [options["num_gpus"] for options in asked] == [occupied]


def test_a_cluster_without_ray_is_refused_with_the_fix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'tumble\[cluster\]'"):
        list(executor.execute(work, [], Workers(address="local"), tmp_path))
