"""Progress on standard error: a line on a terminal, a line per task and every half minute elsewhere, else nothing."""

import io
import logging
import threading
import time

import pytest
from rich.console import Console

from tumble.io import progress


def test_a_task_is_one_line_of_the_log_and_another_every_while(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.05)
    caplog.set_level(logging.INFO, "tumble")
    assert list(progress.track("abc", "letters", 3)) == ["a", "b", "c"]
    with progress.task("texture coordinates"):
        pass
    assert caplog.messages == ["letters (3 steps)", "texture coordinates"]
    with progress.task("slow", 9) as update:
        update(4, str)
        time.sleep(0.12)
    with progress.task("unknown"):
        time.sleep(0.07)
    assert caplog.messages[2:] == ["slow (9 steps)", *["slow: step 4 of 9, 0 s"] * 2, "unknown", "unknown: 0 s"]


def test_names_of_files_are_shown_as_they_are(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They may hold what terminals and `rich` execute, or line breaks."""
    caplog.set_level(logging.INFO, "tumble")
    terminal = Console(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.05)
    with progress.task("converting \x1b[2J[/red]\n.mp4"):
        pass
    assert caplog.messages == [r"converting \x1b[2J[/red]\n.mp4"]
    monkeypatch.setattr(progress, "Console", lambda **_: terminal)
    with progress.task("converting [/red].mp4", 2) as update:
        update(1, lambda: "[/b]")
    assert "[/red].mp4" in terminal.file.getvalue()


def test_without_a_reader_of_the_log_a_task_starts_no_thread_and_describes_nothing(
    capfd: pytest.CaptureFixture[str],
) -> None:
    before = threading.active_count()
    with progress.task("quiet", 2) as update:
        update(1, lambda: pytest.fail("reading a metric waits for the device"))
        assert threading.active_count() == before
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("total", [None, 3])
def test_on_a_terminal_a_task_is_a_live_line_that_disappears(
    total: int | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda stderr: Console(file=screen, force_terminal=True, width=100))
    monkeypatch.setattr(progress, "BAR_SECONDS", 0.0)
    caplog.set_level(logging.INFO, "tumble")
    with progress.task("turning", total) as update:
        update(1, lambda: "loss 0.25")
        assert "turning" in screen.getvalue()
        assert "loss 0.25" in screen.getvalue()
        assert ("1/3" in screen.getvalue()) == (total is not None)
    assert screen.getvalue().endswith("\x1b[2K"), "the line is erased at the end"
    assert not caplog.messages
