"""A run in the browser: what the page is told to show is what the run holds, before its end and after."""

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


def test_a_finished_run_shows_the_maps_of_its_asset(whole: Path, capture: Path) -> None:  # noqa: F811
    asset = tree.load(Asset, whole / "asset.safetensors")
    seen = viewer.look(whole, folder.load(capture))
    assert seen.stage == "finished"
    assert list(seen.colours) == ["as photographed", "albedo", "roughness", "normals"]
    assert asset.material is not None
    torch.testing.assert_close(linear_from_srgb(seen.colours["albedo"]), asset.material.albedo.mean(1))
    torch.testing.assert_close(2 * seen.colours["normals"] - 1, asset.gaussians.normals)
    assert seen.trajectory is not None
    assert len(seen.trajectory) == 8


@pytest.mark.parametrize(
    ("stage", "stop", "found"), [(refine, 25, "stage 2, step 26"), (decompose, 6, "stage 3, step 7")]
)
def test_a_run_that_is_still_going_on_shows_its_last_checkpoint(
    capture: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stage,
    stop: int,
    found: str,
) -> None:
    step, last = stage.step, []

    def interrupted(cfg, inputs, state):
        result = step(cfg, inputs, state)
        if state.step == stop:
            import signal

            if stage is decompose:
                with torch.no_grad():
                    state.params.log_tint.add_(torch.tensor([0.4, 0.1, -0.2]))
            last[:] = cfg, inputs, state
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(stage, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pipeline.reconstruct(capture, tmp_path / "run", RECIPE)
    seen = viewer.look(tmp_path / "run", folder.load(capture))
    assert seen.stage == found
    assert seen.gaussians is not None
    assert all(values.shape == (len(seen.gaussians), 3) for values in seen.colours.values())
    assert ("roughness" in seen.colours) == (stage is decompose)
    assert (seen.environment is not None) == (stage is decompose)
    if stage is decompose:
        # What the stage would put out if it ended now: the tint of the highlight is shared out.
        ended = decompose.finish(*last)
        assert ended.material is not None
        torch.testing.assert_close(linear_from_srgb(seen.colours["albedo"]), ended.material.albedo.mean(1))


def test_the_log_becomes_a_line(tmp_path: Path) -> None:
    opened = run.open(tmp_path / "run", Path("clip"), RECIPE)
    assert viewer.progress(opened.path) == "no stage has begun"
    run.log(opened, {"name": "refine", "event": "start"})
    assert viewer.progress(opened.path) == "refine begins"
    run.log(opened, {"name": "refine", "step": 5, "of": 30, "eta": 12.0, "metrics": {"loss": 0.25}})
    assert viewer.progress(opened.path) == "refine: step 5 of 30, 12 s to go; loss 0.25"
    run.log(opened, {"name": "refine", "event": "done", "seconds": 31.2})
    assert viewer.progress(opened.path) == "refine finished after 31 s"


def test_without_viser_the_way_to_get_it_is_said(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
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
    assert "finished" in window.state.content
    assert window.map.options == ("as photographed", "albedo", "roughness", "normals")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_choices_change_what_is_shown(window: viewer.ViewerWindow, whole: Path) -> None:  # noqa: F811
    node = window.server.scene.get_handle_by_name
    window.map.value = "normals"
    window._object()
    normals = tree.load(Asset, whole / "asset.safetensors").gaussians.normals.numpy()
    np.testing.assert_allclose(node("/object").rgbs / 255, 0.5 + 0.5 * normals, atol=1 / 255)
    turns = []
    for frame in (0, 5):
        window.frame.value = frame
        window._choose()
        turns.append(np.array(node("/light").wxyz))
    assert window.look.trajectory is not None
    # A light that stands still with the camera turns about the object.
    assert np.abs(turns[0] - turns[1]).max() > 0.05
    window.sky.value = False
    window._choose()
    assert not node("/light").visible


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    with pytest.raises(BadFile, match="is no run"):
        viewer.ViewerWindow(tmp_path, "127.0.0.1", free_port())
