"""The command `python -m benchmarks.real`: a time limit that stops it also stops `tumble run`, which ends in order."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("trimesh", reason="needs the extra `synth`")
pytest.importorskip("scipy", reason="needs the extra `synth`")

RUN = """#!{python}
import os, signal, sys, time
from pathlib import Path

def stop(*_):
    time.sleep(1)
    print("interrupted", flush=True)  # is an error if nobody reads
    Path("stopped").touch()
    sys.exit(130)

signal.signal(signal.SIGTERM, stop)
Path("writing").write_text(str(os.getpid()))
Path("writing").rename("started")
time.sleep(100)
"""
"""Stands for `tumble run`: it takes a while to stop."""


def test_a_stopped_benchmark_waits_until_its_run_has_stopped(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.write_text(RUN.format(python=sys.executable))
    run.chmod(0o700)
    program = f"import sys; from benchmarks import real; sys.executable = {str(run)!r}; real.main()"
    command = [sys.executable, "-c", program, "cube=clip.mp4", "-o", "out"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    benchmark = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
    try:
        while not (tmp_path / "started").exists():
            assert benchmark.poll() is None
            time.sleep(0.1)
        benchmark.terminate()
        benchmark.wait(60)
        assert (tmp_path / "stopped").exists()
    finally:
        benchmark.kill()
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            os.kill(int((tmp_path / "started").read_text()), signal.SIGKILL)
