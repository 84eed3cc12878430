"""Recorded and replayed steps: when a recording is made, and what one that is not valid would do."""

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from tests.simulated_graph import Forbidden, SimulatedRecorder, simulated_graphs
from tumble import backends
from tumble.backends._cuda_graphs import CudaRecorder, looked_at, still_fits
from tumble.backends._pairs import PairLimit
from tumble.engine import graph, optim
from tumble.engine.loop import State, drive
from tumble.maths import Index, entry

# A stage: points that move to one target after the other --------------------------------------------------------------

VERSION = 1


@dataclass(frozen=True)
class Config:
    steps: int = 30
    grow: int = 1000
    """Steps between two changes of the shape."""
    broken: str = ""
    """What `advance` does that it must not do; with "always" the stage says so."""


@dataclass(frozen=True)
class Numbers:
    target: Index
    weight: float | Float[Tensor, ""]
    late: bool


def length(cfg: Config, inputs: Any) -> int:
    return cfg.steps


def init(cfg: Config, inputs: Any, rng: torch.Generator) -> State:
    params = optim.leaves({"x": torch.zeros(2, 3)})
    return State(0, params, optim.adam(params, {"": 0.1}), rng, {"sum": torch.zeros(())})


def prepare(cfg: Config, inputs: Any, state: State) -> Numbers:
    assert state.optimizer is not None
    optim.anneal(state.optimizer, 0.9**state.step)
    if state.step and state.step % cfg.grow == 0:
        n = len(state.params["x"])
        index = torch.arange(n + 1) % n
        state.params = optim.regrow(state.params, state.optimizer, index, index < 0)
    return Numbers(int(torch.randint(4, (), generator=state.rng)), 1 + state.step / 7, state.step >= 20)


def advance(cfg: Config, inputs: Any, state: State, numbers: Numbers) -> dict[str, Tensor | float]:
    assert state.optimizer is not None
    away = state.params["x"] - entry(torch.arange(12.0).view(4, 3), numbers.target)
    if cfg.broken in ("asks", "always"):
        float(away.detach().sum())
    if cfg.broken == "copies":
        away = away + torch.tensor([1.0, 2.0, 3.0])
    if cfg.broken == "freezes":
        away = away + 0.01 * state.step
    if cfg.broken == "replaces" and backends.recording():
        state.memory["sum"] = state.memory["sum"] + 1
    loss = numbers.weight * (away.abs() if numbers.late else away.square()).mean()
    state.memory["sum"] += loss.detach()
    optim.descend(loss, state.optimizer, step=state.step)
    return {"loss": loss.detach()}


def can_be_recorded(cfg: Config) -> bool:
    return cfg.broken != "always"


def step(cfg: Config, inputs: Any, state: State) -> dict[str, Tensor | float]:
    return advance(cfg, inputs, state, prepare(cfg, inputs, state))


def finish(cfg: Config, inputs: Any, state: State) -> dict[str, Tensor]:
    return {"x": state.params["x"].detach(), "sum": state.memory["sum"]}


THIS: Any = sys.modules[__name__]


def stage_with(**parts: Any) -> Any:
    """This stage with other parts of its step, or none."""
    names = ["VERSION", "Config", "length", "init", "step", "finish"] + ["can_be_recorded", "advance"] * bool(parts)
    return SimpleNamespace(**{name: getattr(THIS, name) for name in names}, **parts)


@pytest.fixture
def recorder() -> Iterator[SimulatedRecorder]:
    with simulated_graphs() as simulated:
        yield simulated


# Recordings -----------------------------------------------------------------------------------------------------------


def is_same(cfg: Config) -> bool:
    """Whether replayed steps are those of the same stage without the parts that can be recorded."""
    usual, replayed = (drive(stage, cfg, None, seed=3) for stage in (stage_with(), THIS))
    return all(torch.equal(usual[name], replayed[name]) for name in usual)


def test_a_step_is_recorded_after_some_usual_ones_and_replayed_until_something_changes(
    recorder: SimulatedRecorder,
) -> None:
    """The first step makes the moments, three more are usual; step 20 calculates something else."""
    assert is_same(Config())
    assert (len(recorder.tapes), recorder.replays, recorder.sent) == (2, 16 + 7, 30)
    assert is_same(Config(grow=8))  # changes at steps 8, 16, 20 and 24
    assert len(recorder.tapes) == 2 + 5


def test_a_number_that_is_not_sent_stays_as_it_was_recorded(recorder: SimulatedRecorder) -> None:
    """So the comparison of replayed and usual steps notices it."""
    assert not is_same(Config(broken="freezes"))


@pytest.mark.parametrize("broken", ["asks", "copies"])
def test_what_a_gpu_cannot_capture_is_an_error_in_the_simulation(recorder: SimulatedRecorder, broken: str) -> None:
    with pytest.raises(Forbidden):
        drive(THIS, Config(broken=broken), None, seed=3)


def test_a_recorded_step_must_not_replace_a_tensor_of_the_state(recorder: SimulatedRecorder) -> None:
    with pytest.raises(AssertionError, match="must not replace"):
        drive(THIS, Config(broken="replaces"), None, seed=3)


def test_a_recording_whose_memory_became_too_small_is_made_again(
    recorder: SimulatedRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The host looks after 1, 2, 4 and 8 replays of the first recording, and so on for the next one."""
    longest = torch.zeros(1, dtype=torch.int32)
    limit = PairLimit(capacity=4, longest=longest)
    monkeypatch.setattr(backends.load("cuda"), "pair_limits", lambda device: [limit])

    def fuller(cfg: Config, inputs: Any, state: State) -> Numbers:
        longest.fill_(3 if state.step > 8 else 2)
        return replace(prepare(cfg, inputs, state), late=False)

    drive(stage_with(prepare=fuller), Config(steps=24), None, seed=3)
    assert len(recorder.tapes) == 2
    assert (limit.capacity, recorder.replays) == (8, 20)


def test_lists_fit_until_they_grow_or_are_made_anew() -> None:
    limit = PairLimit(capacity=4, longest=torch.tensor([2], dtype=torch.int32))
    before = looked_at([limit])
    assert still_fits(before, [limit])
    assert limit.longest is not None
    limit.longest.fill_(3)
    assert not still_fits(before, [limit])
    before = looked_at([limit])
    limit.longest = limit.longest.clone()
    assert not still_fits(before, [limit])


def test_a_gradient_that_is_not_finite_in_replayed_steps_stops_them(recorder: SimulatedRecorder) -> None:
    def poisoned(cfg: Config, inputs: Any, state: State) -> Numbers:
        numbers = prepare(cfg, inputs, state)
        return replace(numbers, weight=float("nan") if state.step == 30 else 1.0, late=False)

    with pytest.raises(optim.NotFinite, match="in one of the last 50 steps is not finite at step 49"):
        drive(stage_with(prepare=poisoned), Config(steps=60), None, seed=3)


def test_a_stage_that_cannot_be_recorded_runs_as_usual(recorder: SimulatedRecorder) -> None:
    assert is_same(Config(broken="always"))
    assert recorder.sent == 0


def test_a_stage_in_one_part_and_the_cpu_record_nothing() -> None:
    assert backends.recorder(torch.device("cpu")) is None
    with simulated_graphs() as recorder:
        drive(stage_with(), Config(), None, seed=3)
        assert recorder.sent == 0


def test_steps_that_a_device_refuses_to_record_run_as_usual_after_a_warning(
    recorder: SimulatedRecorder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refused(work: Any) -> Any:
        raise backends.CannotRecord("operation not permitted when stream is capturing")

    monkeypatch.setattr(recorder, "record", refused)
    assert is_same(Config(grow=8))
    assert [x.getMessage() for x in caplog.records] == [
        "steps are not replayed as a CUDA graph, and are slower: operation not permitted when stream is capturing"
    ]


# The calls of CUDA ----------------------------------------------------------------------------------------------------


def test_a_cuda_graph_is_captured_on_the_stream_of_the_session_and_known_to_warp(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No GPU here: the order of the calls, with stand-ins for those of CUDA."""
    warp = pytest.importorskip("warp")
    from tumble.backends._warp import runtime

    calls: list[str] = []

    class Stream:
        def wait_stream(self, other: Any) -> None:
            calls.append("wait")

    @contextlib.contextmanager
    def within(name: str) -> Iterator[None]:
        calls.append(name)
        yield
        calls.append(f"end of {name}")

    outer, graph_of_torch = Stream(), SimpleNamespace(replay=lambda: calls.append("replay"))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: outer)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: Stream())
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: within("stream"))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: graph_of_torch)
    monkeypatch.setattr(torch.cuda, "graph", lambda made, *, stream, capture_error_mode: within("capture"))
    monkeypatch.setattr(runtime, "stream", lambda device: contextlib.nullcontext())
    monkeypatch.setattr(warp, "capture_begin", lambda **options: calls.append(f"warp {options['external']}"))
    monkeypatch.setattr(warp, "capture_end", lambda: calls.append("end of warp") or object())
    recorder = CudaRecorder(torch.device("cuda"), lambda device: [])
    assert isinstance(recorder, backends.Recorder)
    with recorder.session():
        recording = recorder.record(lambda: calls.append(f"work {backends.recording()}") or 7)
        recording.replay()
    assert (recording.result, recording.fits()) == (7, True)
    expected = ["wait", "stream", "capture", "warp True", "work True", "end of warp", "end of capture", "replay"]
    assert calls == [*expected, "end of stream", "wait"]

    def refused() -> None:
        raise RuntimeError("operation not permitted when stream is capturing")

    with pytest.raises(backends.CannotRecord, match="operation not permitted"):
        recorder.record(refused)


@pytest.mark.parametrize("numbers", [Numbers(3, 0.25, True), Numbers(-1, 1e30, False)])
def test_numbers_and_rates_arrive_as_they_were_sent(numbers: Numbers) -> None:
    optimizer = optim.adam(optim.leaves({"x": torch.ones(2), "y": torch.ones(3)}), {"x": 0.1, "y": 1e-5})
    sent = graph.Replayed(THIS, SimulatedRecorder()).sent(numbers, optimizer)
    assert int(sent.target) == numbers.target
    assert float(sent.weight) == torch.tensor(numbers.weight)
    assert sent.late is numbers.late
    assert optimizer.rates is not None
    assert torch.equal(torch.stack(optimizer.rates), torch.tensor([0.1, 1e-5]))
