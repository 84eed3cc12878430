"""The command `python -m benchmarks.real`: a time limit that stops it also stops `tumble run`, which ends in order."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
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


@pytest.mark.parametrize(("beside", "found"), [(40, True), (0, False)])
def test_a_pose_counts_as_true_only_if_its_mirror_image_in_depth_does_not_agree(beside: int, found: bool) -> None:
    """A cube that shows a face, of which a long lens tells two poses, and points of the face beside it, or none."""
    from scipy.spatial.transform import Rotation

    from benchmarks.real import best_pose, mirror_image

    rng = np.random.default_rng(3)
    K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    face = np.column_stack([rng.uniform(-0.5, 0.5, (120, 2)), np.full(120, -0.5)])
    side = np.column_stack([np.full(beside, 0.5), rng.uniform(-0.5, 0.5, (beside, 2))])
    world = np.concatenate([face, side])
    R, t = Rotation.from_rotvec([0, 0.35, 0]).as_matrix(), np.array([0.1, 0, 12.0])
    x = (world @ R.T + t) @ K.T
    image = x[:, :2] / x[:, 2:] + rng.normal(0, 0.7, (len(world), 2))
    image[::9] = rng.uniform(0, 400, image[::9].shape)  # wrong matches
    assert np.degrees(Rotation.from_matrix(mirror_image(R, t, face)[0].T @ R).magnitude()) > 30
    pose = best_pose(world, image, K)
    assert (pose is not None) == found
    if pose is not None:
        assert np.degrees(Rotation.from_matrix(pose[0].T @ R).magnitude()) < 2
