"""The viewer: the page shows the contents of the run directory, during a run and after it."""

import socket
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.test_interrupt import RECIPE, capture, whole  # noqa: F401 (fixtures)
from tumble import pipeline, viewer
from tumble.datasets import folder
from tumble.engine import run
from tumble.inverse_rendering import decompose, refine
from tumble.io import tree
from tumble.io.files import BadFile
from tumble.maths.images import linear_from_srgb
from tumble.scene.asset import Asset


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_snapshot_of_a_finished_run_has_the_maps_of_its_asset(whole: Path, capture: Path) -> None:  # noqa: F811
    asset = tree.load(Asset, whole / "asset.safetensors")
    snapshot = viewer.read_snapshot(whole, folder.load(capture))
    assert snapshot.stage == "finished"
    assert list(snapshot.colours) == ["as captured", "albedo", "roughness", "normals"]
    assert asset.material is not None
    torch.testing.assert_close(linear_from_srgb(snapshot.colours["albedo"]), asset.material.albedo.mean(1))
    torch.testing.assert_close(2 * snapshot.colours["normals"] - 1, asset.gaussians.normals)
    assert snapshot.trajectory is not None
    assert len(snapshot.trajectory) == 8


@pytest.mark.parametrize(
    ("stage", "stop", "label"), [(refine, 25, "stage 2, step 26"), (decompose, 6, "stage 3, step 7")]
)
def test_the_snapshot_of_an_unfinished_run_is_its_last_checkpoint(
    capture: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stage,
    stop: int,
    label: str,
) -> None:
    step, last = stage.step, []

    def interrupted(cfg, inputs, state):
        result = step(cfg, inputs, state)
        if state.step == stop:
            import signal

            if stage is decompose:
                with torch.no_grad():
                    state.params.log_specular_scale.add_(torch.tensor([0.4, 0.1, -0.2]))
            last[:] = cfg, inputs, state
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(stage, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pipeline.reconstruct(capture, tmp_path / "run", RECIPE)
    snapshot = viewer.read_snapshot(tmp_path / "run", folder.load(capture))
    assert snapshot.stage == label
    assert snapshot.gaussians is not None
    assert all(values.shape == (len(snapshot.gaussians), 3) for values in snapshot.colours.values())
    assert ("roughness" in snapshot.colours) == (stage is decompose)
    assert (snapshot.environment is not None) == (stage is decompose)
    if stage is decompose:
        # The snapshot equals the stage's output at this step, in which albedo and light absorb the specular scale.
        ended = decompose.finish(*last)
        assert ended.material is not None
        torch.testing.assert_close(linear_from_srgb(snapshot.colours["albedo"]), ended.material.albedo.mean(1))


def test_progress_is_the_last_record_of_the_log(tmp_path: Path) -> None:
    opened = run.open(tmp_path / "run", Path("clip"), RECIPE)
    assert viewer.progress(opened.path) == "no stage has started"
    run.log(opened, {"name": "refine", "event": "start"})
    assert viewer.progress(opened.path) == "refine started"
    run.log(opened, {"name": "refine", "step": 5, "of": 30, "eta": 12.0, "metrics": {"loss": 0.25}})
    assert viewer.progress(opened.path) == "refine: step 5 of 30, 12 s to go; loss 0.25"
    run.log(opened, {"name": "refine", "event": "done", "seconds": 31.2})
    assert viewer.progress(opened.path) == "refine finished after 31 s"


def test_the_error_without_viser_has_the_install_command(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs viser: pip install 'tumble\[view\]'"):
        viewer.serve(whole, "127.0.0.1", 0)


# With viser -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def window(whole: Path) -> Iterator[viewer.ViewerWindow]:  # noqa: F811
    pytest.importorskip("viser", reason="needs the extra `view`")
    opened = viewer.ViewerWindow(whole, "127.0.0.1", free_port())
    yield opened
    opened.server.stop()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_page_is_served_and_its_scene_holds_the_run(window: viewer.ViewerWindow, whole: Path) -> None:  # noqa: F811
    with urllib.request.urlopen(window.address) as page:
        assert b"<html" in page.read()
    asset, node = tree.load(Asset, whole / "asset.safetensors"), window.server.scene.get_handle_by_name
    np.testing.assert_allclose(node("/object").centers, asset.gaussians.means.numpy())
    for name in ("/path", "/light", *(f"/cameras/{i}.png" for i in range(8))):
        assert node(name) is not None, name
    camera = asset.trajectory.T_cam_obj[3].inverse()
    np.testing.assert_allclose(node("/cameras/3.png").position, camera.xyz.numpy(), atol=1e-6)
    assert "finished" in window.status.content
    assert window.map.options == ("as captured", "albedo", "roughness", "normals")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_controls_change_the_scene(window: viewer.ViewerWindow, whole: Path) -> None:  # noqa: F811
    node = window.server.scene.get_handle_by_name
    window.map.value = "normals"
    window._show_object()
    normals = tree.load(Asset, whole / "asset.safetensors").gaussians.normals.numpy()
    np.testing.assert_allclose(node("/object").rgbs / 255, 0.5 + 0.5 * normals, atol=1 / 255)
    orientations = []
    for frame in (0, 5):
        window.frame.value = frame
        window._show_frame()
        orientations.append(np.array(node("/light").wxyz))
    assert window.snapshot.trajectory is not None
    # A light that is fixed to the camera rotates in the object frame.
    assert np.abs(orientations[0] - orientations[1]).max() > 0.05
    window.light_visible.value = False
    window._show_frame()
    assert not node("/light").visible


def test_a_folder_that_is_not_a_run_raises(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    with pytest.raises(BadFile, match="is not a run directory"):
        viewer.ViewerWindow(tmp_path, "127.0.0.1", free_port())
