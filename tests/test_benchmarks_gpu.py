"""The command `make gpu`: what a part measured is kept if it fails or is stopped, and the other parts run."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks import gpu
from tests.lopsided import truth, tumbling


def test_a_part_that_fails_keeps_what_it_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def part(plan: gpu.Plan, row: gpu.Row) -> None:
        row["seconds"] = 3
        raise RuntimeError("out of memory")

    monkeypatch.setitem(gpu.PARTS, "draft", part)
    assert not gpu.run_part(gpu.Plan(tmp_path, (), dry=True), "draft")
    assert json.loads((tmp_path / "draft.json").read_text()) == {"seconds": 3, "failed": "RuntimeError: out of memory"}


def test_a_part_is_stopped_at_its_limit(tmp_path: Path) -> None:
    row = gpu.result_of_process(gpu.Plan(tmp_path, (), dry=True), "standard", 0.1)
    assert row["failed"] == "stopped at its limit of 0 s"
    assert row["wall_seconds"] < gpu.GRACE


def test_the_limits_fit_into_nine_minutes() -> None:
    assert list(gpu.LIMITS) == list(gpu.PARTS)
    assert sum(gpu.LIMITS.values()) + gpu.GRACE <= 9 * 60


def test_an_enlarged_capture_shows_the_same_object_from_the_same_poses() -> None:
    scene = tumbling(6, size=48)
    capture = replace(scene.capture, trajectory=truth(scene))
    large = gpu.enlarged(capture, 8, 96)
    assert large.images.shape == (8, 96, 96, 3)
    assert torch.equal(large.masks[6:, ::2, ::2], capture.masks[:2])
    assert large.trajectory is not None
    assert torch.equal(large.trajectory.T_cam_obj.xyz[6:], truth(scene).T_cam_obj.xyz[:2])
    assert torch.equal(large.camera.fx_fy_cx_cy, 2 * capture.camera.fx_fy_cx_cy)


@pytest.mark.slow
def test_all_parts_run_without_a_gpu(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.gpu", "--dry", "--out", str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, check=False)
    document = json.loads((tmp_path / "gpu.json").read_text())
    assert done.returncode == 0, {name: part.get("failed") for name, part in document.items() if name in gpu.PARTS}
    assert set(gpu.PARTS) < set(document)
    assert (tmp_path / "standard" / "prediction").is_dir()
