"""The training loop with this module as a stage: interrupted and resumed runs have the bits of uninterrupted ones."""

import io
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor

from tumble.engine import loop, optim
from tumble.engine.loop import Progress, Stage, State, drive, fingerprint
from tumble.engine.optim import NotFinite
from tumble.io import files, progress, tree
from tumble.io.files import BadFile

# A stage: points that move to a target with densification and pruning, and a light on a growing grid ------------------

VERSION = 1
NOISE = 0.1
"""A module constant that affects the result."""


@dataclass(frozen=True)
class Config:
    steps: int = 30
    rate: float = 0.05
    regrow: int = 4
    finer: int = 11


@dataclass(frozen=True)
class Inputs:
    target: Tensor = field(default_factory=lambda: torch.tensor([0.3, -0.2]))
    at: dict[int, Callable[[State], Any]] = field(default_factory=dict)
    """Functions called at given steps, which simulate interrupts and errors; not part of the settings."""


@dataclass(frozen=True)
class Params:
    points: Tensor
    weight: Tensor
    light: Tensor
    frozen: Tensor


@dataclass(frozen=True)
class Output:
    params: Params
    rest: dict[str, Tensor]
    """Moments, memory and generator, which must be equal in equal runs."""


def length(cfg: Config, inputs: Inputs) -> int:
    return cfg.steps


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    points = torch.randn(6, 2, generator=rng)
    params = optim.leaves(Params(points, torch.ones(()), torch.zeros(2, 3), torch.ones(2)))
    optimizer = optim.adam(params, {"": cfg.rate, "frozen": 0.0})
    return State(0, params, optimizer, rng, {"distance": torch.zeros(6), "minimum": torch.tensor(float("inf"))})


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    params, optimizer = state.params, state.optimizer
    assert optimizer is not None
    noise = NOISE * torch.randn(params.points.shape, generator=state.rng)
    away = ((params.points + noise - inputs.target) ** 2).sum(-1)
    loss = params.weight * away.mean() + ((params.light - 1) ** 2).mean() + params.weight**2
    inputs.at.get(state.step, lambda state: None)(state)
    optim.anneal(optimizer, {"points": 1 - state.step / cfg.steps})
    optim.descend(loss, optimizer, step=state.step)
    state.memory["distance"] += away.detach()
    state.memory["minimum"] = torch.minimum(state.memory["minimum"], loss.detach())
    if (state.step + 1) % cfg.regrow == 0:
        densify(state)
    if state.step + 1 == cfg.finer:
        state.params = optim.resample(state.params, optimizer, "light", lambda x: x.repeat_interleave(2, 0))
    return {"loss": loss, "points": len(params.points)}


def densify(state: State) -> None:
    """Prune and split randomly chosen points."""
    assert state.optimizer is not None
    n = len(state.params.points)
    index = torch.multinomial(state.memory["distance"] + 1, n + 1, replacement=True, generator=state.rng)
    fresh = torch.rand(n + 1, generator=state.rng) < 0.5
    grown = optim.regrow({"points": state.params.points}, state.optimizer, index, fresh)
    state.params = replace(state.params, **grown)
    with torch.no_grad():
        state.params.points[fresh] += 0.01 * torch.randn(int(fresh.sum()), 2, generator=state.rng)
    state.memory["distance"] = torch.zeros(n + 1)


def finish(cfg: Config, inputs: Inputs, state: State) -> Output:
    moments = optim.pack(state.optimizer) if state.optimizer else {}
    rest = moments | state.memory | {"rng": state.rng.get_state()}
    return Output(tree.detach(state.params), {name: x.clone() for name, x in rest.items()})


THIS = sys.modules[__name__]


class Previewed:
    """The same stage with a preview that uses random numbers."""

    VERSION, Config = VERSION, Config
    length, init, step, finish = staticmethod(length), staticmethod(init), staticmethod(step), staticmethod(finish)

    @staticmethod
    def preview(cfg: Config, inputs: Inputs, state: State) -> Tensor:
        return (255 * torch.rand(4, 5, 3, generator=state.rng)).to(torch.uint8)


def bits(output: Output) -> dict[str, bytes]:
    return {name: x.numpy().tobytes() for name, x in tree.named_tensors(output).items()}


def uninterrupted(**settings: Any) -> dict[str, bytes]:
    return bits(drive(THIS, Config(**settings), Inputs(), seed=3))


def press_ctrl_c(state: State) -> None:
    signal.raise_signal(signal.SIGINT)


def crash(state: State) -> None:
    raise RuntimeError("power cut")


def poison(state: State) -> None:
    with torch.no_grad():
        state.params.points[0, 0] = float("nan")


# Interrupting and resuming --------------------------------------------------------------------------------------------


def test_a_module_can_be_driven_as_a_stage() -> None:
    assert isinstance(THIS, Stage)
    assert not isinstance(loop, Stage)
    output = drive(THIS, Config(steps=400), Inputs(), seed=0)
    assert output.params.light.shape == (4, 3)
    # Adam's steps vanish with the learning rate; the remaining error is the noise of the last steps.
    assert (output.params.light - 1).abs().max() < 0.05
    assert torch.equal(output.params.frozen, torch.ones(2))


def test_the_seed_decides_the_result() -> None:
    assert uninterrupted() == uninterrupted()
    assert uninterrupted() != bits(drive(THIS, Config(), Inputs(), seed=4))


@pytest.mark.parametrize("stops", [[0], [3], [10], [11], [29], [2, 5, 12, 20]])
def test_a_run_resumed_after_ctrl_c_equals_an_uninterrupted_one_bit_for_bit(tmp_path: Path, stops: list[int]) -> None:
    """Some interrupts are before, at and after the steps in which leaves change their shapes."""
    path = tmp_path / "1-toy" / "state.safetensors"
    for stop in stops:
        with pytest.raises(KeyboardInterrupt, match=rf"toy stopped at step {stop + 1} of 30; run .* from {path}"):
            drive(THIS, Config(), Inputs(at={stop: press_ctrl_c}), seed=3, checkpoint=path, name="toy")
    resumed = drive(THIS, Config(), Inputs(at={stops[-1]: crash}), seed=3, checkpoint=path)
    assert bits(resumed) == uninterrupted()
    assert [p.name for p in path.parent.iterdir()] == ["state.safetensors"]


def test_a_signal_between_two_steps_is_not_lost_and_has_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One right after the loop has asked for signals, and one while the last state is saved."""
    path, answers, save = tmp_path / "state", iter([False, True, True]), loop._save
    with monkeypatch.context() as patch:
        patch.setattr(loop, "_interrupts", lambda: nullcontext(lambda: next(answers)))
        with pytest.raises(KeyboardInterrupt, match="stopped at step 2 of 30; run the same command again to continue"):
            drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)
    assert loop.peek(path)[0] == 2

    def save_and_press(state: State, *others: Any) -> None:
        save(state, *others)
        press_ctrl_c(state)

    monkeypatch.setattr(loop, "_save", save_and_press)
    with pytest.raises(KeyboardInterrupt, match="stopped at step 30 of 30"):
        drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)
    assert bits(drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)) == uninterrupted()


@pytest.mark.parametrize("stop", [7, 8, 9, 22])
def test_a_crashed_run_resumes_from_its_last_checkpoint_bit_for_bit(tmp_path: Path, stop: int) -> None:
    path = tmp_path / "state"
    with pytest.raises(RuntimeError, match="power cut"):
        drive(THIS, Config(), Inputs(at={stop: crash}), seed=3, checkpoint=path, every=8)
    repeated: list[int] = []
    at = {n: lambda state, n=n: repeated.append(n) for n in range(30)}
    resumed = drive(THIS, Config(), Inputs(at=at), seed=3, checkpoint=path, every=8)
    assert repeated[0] == stop // 8 * 8
    assert bits(resumed) == uninterrupted()


def test_training_is_not_repeated_after_its_last_step(tmp_path: Path) -> None:
    drive(THIS, Config(), Inputs(), seed=3, checkpoint=tmp_path / "state")
    again = drive(THIS, Config(), Inputs(at=dict.fromkeys(range(30), crash)), seed=3, checkpoint=tmp_path / "state")
    assert bits(again) == uninterrupted()


@pytest.mark.parametrize("other", [{"cfg": Config(rate=0.06)}, {"seed": 4}, {"key": "other inputs"}])
def test_a_checkpoint_of_other_settings_is_ignored(tmp_path: Path, other: dict[str, Any]) -> None:
    usual: dict[str, Any] = {"cfg": Config(), "seed": 3, "key": "inputs"}
    with pytest.raises(KeyboardInterrupt):
        drive(THIS, inputs=Inputs(at={9: press_ctrl_c}), checkpoint=tmp_path / "state", **usual)
    changed = usual | other
    fresh = drive(THIS, inputs=Inputs(), **changed)
    assert bits(drive(THIS, inputs=Inputs(), checkpoint=tmp_path / "state", **changed)) == bits(fresh)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_stops_immediately_and_the_handler_is_restored(
    tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = signal.signal(signal.SIGTERM, signal.default_int_handler)
    before = signal.getsignal(number)

    def twice(state: State) -> None:
        signal.raise_signal(number)
        signal.raise_signal(number)

    path = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        drive(THIS, Config(), Inputs(at={10: twice}), seed=3, checkpoint=path, every=8)
    assert signal.getsignal(number) is before
    signal.signal(signal.SIGTERM, found)
    assert bits(drive(THIS, Config(), Inputs(), seed=3, checkpoint=path, every=8)) == uninterrupted()


def test_sigterm_saves_a_checkpoint_and_ends_the_stage_like_ctrl_c(tmp_path: Path) -> None:
    found, path = signal.signal(signal.SIGTERM, signal.SIG_DFL), tmp_path / "state"
    terminate = lambda state: signal.raise_signal(signal.SIGTERM)  # noqa: E731
    with pytest.raises(KeyboardInterrupt, match=r"stopped at step 11 of 30; .*continue from .*state"):
        drive(THIS, Config(), Inputs(at={10: terminate}), seed=3, checkpoint=path, every=100)
    assert loop.peek(path)[0] == 11
    assert signal.signal(signal.SIGTERM, found) == signal.SIG_DFL
    assert bits(drive(THIS, Config(), Inputs(), seed=3, checkpoint=path, every=100)) == uninterrupted()


def test_the_log_has_a_line_for_the_start_of_a_stage_and_one_for_its_steps(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "tumble")
    drive(THIS, Config(), Inputs(), seed=3, name="refine")
    assert caplog.messages == ["refine: start", "refine (30 steps)"]


def test_without_a_checkpoint_the_message_of_ctrl_c_is_that_nothing_was_saved() -> None:
    with pytest.raises(KeyboardInterrupt, match="nothing was saved"):
        drive(THIS, Config(), Inputs(at={2: press_ctrl_c}), seed=3)


def test_a_stage_can_be_driven_from_another_thread() -> None:
    """Python can handle signals in the main thread only."""
    results: list[dict[str, bytes]] = []
    thread = threading.Thread(target=lambda: results.append(uninterrupted()))
    thread.start()
    thread.join()
    assert results == [uninterrupted()]


def test_states_without_gradients_or_optimizer_are_restored(tmp_path: Path) -> None:
    """A state may hold booleans, empty tensors and tensors with shared storage."""

    class Plain(Previewed):
        @staticmethod
        def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
            shared = torch.arange(6)
            memory = {"flags": torch.tensor([True, False]), "none": torch.zeros(0, 3), "tail": shared[3:].flip(0)}
            return State(0, {"all": shared, "transposed": shared.reshape(2, 3).T}, None, rng, memory)

        @staticmethod
        def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
            inputs.at.get(state.step, lambda state: None)(state)
            state.params["all"] += torch.randint(9, (6,), generator=state.rng)
            state.memory["flags"] = ~state.memory["flags"]
            return {}

        @staticmethod
        def finish(cfg: Config, inputs: Inputs, state: State) -> Output:
            return Output(state.params, state.memory)

    def result(**kwargs: Any) -> dict[str, Tensor]:
        return tree.named_tensors(drive(Plain, Config(), seed=1, **kwargs))

    with pytest.raises(KeyboardInterrupt):
        result(inputs=Inputs(at={6: press_ctrl_c}), checkpoint=tmp_path / "state")
    again, expected = result(inputs=Inputs(), checkpoint=tmp_path / "state"), result(inputs=Inputs())
    assert again["rest.flags"].dtype == torch.bool
    assert again["rest.none"].shape == (0, 3)
    assert torch.equal(again["params.all"], expected["params.all"])
    assert torch.equal(again["rest.tail"], torch.tensor([5, 4, 3]))


# Errors ---------------------------------------------------------------------------------------------------------------


def test_a_nan_raises_with_its_name_its_step_and_the_last_valid_state(tmp_path: Path) -> None:
    path = tmp_path / "state"
    with pytest.raises(NotFinite, match=r"not finite at step 10; the last valid state is in .*state") as caught:
        drive(THIS, Config(), Inputs(at={9: poison}), seed=3, checkpoint=path, every=8)
    assert (caught.value.state_file, caught.value.step) == (path, 10)
    # The state of step 8 is still stored and valid.
    assert bits(drive(THIS, Config(), Inputs(), seed=3, checkpoint=path, every=8)) == uninterrupted()


def test_a_nan_outside_of_the_loss_is_neither_saved_nor_returned(tmp_path: Path) -> None:
    def hide(state: State) -> None:
        with torch.no_grad():
            state.params.frozen[1] = float("inf")

    path = tmp_path / "state"
    for n, checkpoint in ((9, path), (9, None), (29, None)):
        with pytest.raises(NotFinite, match="frozen is not finite") as caught:
            drive(THIS, Config(), Inputs(at={n: hide}), seed=3, checkpoint=checkpoint, every=8)
        assert caught.value.state_file == checkpoint
    assert bits(drive(THIS, Config(), Inputs(), seed=3, checkpoint=path, every=8)) == uninterrupted()


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """Context in which writing beyond `room` bytes of a file fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_an_error_and_the_previous_checkpoint_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        drive(THIS, Config(), Inputs(at={4: press_ctrl_c}), seed=3, checkpoint=path)
    with full_disk(3000), pytest.raises(OSError, match=r"state: cannot be written: .*then run the same command again"):
        drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)
    assert [p.name for p in tmp_path.iterdir()] == ["state"]
    assert bits(drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)) == uninterrupted()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_write_permission_is_an_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match=r"state: cannot .* \(choose a folder that you may write to"):
        drive(THIS, Config(), Inputs(), seed=3, checkpoint=tmp_path / "state")
    tmp_path.chmod(0o700)


@pytest.mark.parametrize("damage", ["flipped byte", "not tensors", "other tensors"])
def test_a_damaged_checkpoint_restarts_the_stage_with_a_warning(tmp_path: Path, damage: str) -> None:
    """A checkpoint of step 20 with one flipped bit is not the last valid state; the result is that of a whole run."""
    whole = drive(THIS, Config(), Inputs(), seed=3)
    path = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        drive(THIS, Config(), Inputs(at={20: press_ctrl_c}), seed=3, checkpoint=path)
    if damage == "flipped byte":
        content = bytearray(path.read_bytes())
        content[-3] ^= 1
        path.write_bytes(content)
        reason = "is damaged: its content does not match its checksum"
    elif damage == "not tensors":
        path.write_bytes(b"junk" * 20)
        reason = "is damaged: "
    else:
        tree.save(Params(*torch.zeros(4, 1)), path)
        reason = "is not a checkpoint"
    said = rf"state: {reason}.* \(the stage starts again from its first step\)"
    with pytest.warns(UserWarning, match=said):
        again = drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)
    assert bits(again) == bits(whole)
    path.write_bytes(b"junk" * 20)
    with pytest.raises(BadFile, match="state: is damaged"):
        loop.peek(path)


def test_a_checkpoint_of_another_structure_is_rejected(tmp_path: Path) -> None:
    """The stage was edited without incrementing VERSION."""

    class Edited(Previewed):
        @staticmethod
        def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
            params = optim.leaves({"points": torch.zeros(6, 2), "more": torch.zeros(1)})
            return State(0, params, optim.adam(params, {"": 0.1}), rng)

    path = tmp_path / "state"
    drive(THIS, Config(), Inputs(), seed=3, checkpoint=path)
    with pytest.raises(BadFile, match="does not match this stage"):
        drive(Edited, Config(), Inputs(), seed=3, checkpoint=path)


# Progress -------------------------------------------------------------------------------------------------------------


def test_reports_are_rate_limited_and_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records: list[Progress] = []
    drive(THIS, Config(), Inputs(), seed=3, report=records.append, name="toy")
    # Thirty steps take milliseconds, so that only the first and the last one are reported.
    assert (records[0].step, records[-1].step) == (1, 30)
    assert len(records) < 5
    assert records[-1].of == 30
    assert records[-1].name == "toy"
    assert records[-1].eta == 0
    assert set(records[-1].metrics) == {"loss", "points"}
    monkeypatch.setattr(loop, "REPORT_SECONDS", 0.0)
    records.clear()
    path = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        drive(THIS, Config(), Inputs(at={9: press_ctrl_c}), seed=3, report=records.append, checkpoint=path)
    drive(THIS, Config(), Inputs(), seed=3, report=records.append, checkpoint=path)
    assert [record.step for record in records] == list(range(1, 31))
    seconds = [record.seconds for record in records]
    assert seconds == sorted(seconds), "the time of a resumed run includes that before the interrupt"


def test_a_terminal_shows_the_stage_its_metric_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120))
    monkeypatch.setattr(progress, "BAR_SECONDS", 0.0)
    drive(THIS, Config(), Inputs(), seed=3, name="toy")
    text = screen.getvalue()
    assert all(word in text for word in ("toy", "30/30", "loss", "0:00:0"))


def test_nothing_is_printed_without_a_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    drive(THIS, Config(), Inputs(), seed=3, name="toy")
    assert capfd.readouterr() == ("", "")


def test_a_preview_is_written_beside_the_checkpoint_and_does_not_affect_the_result(tmp_path: Path) -> None:
    output = drive(Previewed, Config(), Inputs(), seed=3, checkpoint=tmp_path / "state", every=3)
    assert files.read_image(tmp_path / "preview.png").shape == (4, 5, 3)
    assert bits(output) == uninterrupted()


def test_fingerprints_differ_between_settings_and_between_classes() -> None:
    @dataclass(frozen=True)
    class Other:
        steps: int = 30
        rate: float = 0.05
        regrow: int = 4
        finer: int = 11

    assert fingerprint("a", Config()) == fingerprint("a", Config())
    hashes = [fingerprint("a", x) for x in (Config(), Config(rate=0.06), Other(), {"x": Config()}, float("inf"), None)]
    assert len(set(hashes)) == len(hashes)
    assert all(len(x) == 64 for x in hashes)
    with pytest.raises(TypeError, match="not a Tensor"):
        fingerprint(torch.zeros(2))
