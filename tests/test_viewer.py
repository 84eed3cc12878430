"""The viewer: the page shows the contents of the run directory, during a run and after it."""

import dataclasses
import os
import shutil
import socket
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.test_interrupt import RECIPE, capture, whole  # noqa: F401 (fixtures)
from tumble import pipeline, recipes, viewer, viewer_access
from tumble.datasets import folder
from tumble.engine import run
from tumble.inverse_rendering import decompose, refine
from tumble.io import tree
from tumble.io.files import BadFile
from tumble.maths.images import linear_from_srgb
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera


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
    with pytest.raises(KeyboardInterrupt):  # without the trial of stage 3, which makes steps, too
        pipeline.reconstruct(capture, tmp_path / "run", recipes.no_specular_fit(RECIPE))
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
    assert "finished" in window.status.value
    assert window.map.options == ("as captured", "albedo", "roughness", "normals")
    # Another snapshot with fewer frames.
    fewer = asset.trajectory.select(torch.arange(4))
    window.snapshot = dataclasses.replace(window.snapshot, trajectory=fewer, names=window.snapshot.names[:4])
    window._show_cameras()
    assert node("/cameras/3.png") is not None
    assert node("/cameras/7.png") is None


def test_the_border_makes_a_cropped_image_symmetric() -> None:
    camera = Camera(torch.tensor([50.0, 50.0, 10.0, 33.0]), 40, 60)
    left, right, top, bottom = viewer._border(camera)
    assert (left, right, top, bottom) == (40, 0, 0, 26)
    assert left + 10 == (60 + left + right) / 2
    assert top + 33 == (40 + top + bottom) / 2


# Access ---------------------------------------------------------------------------------------------------------------


def received(window: viewer.ViewerWindow, *, token: str, seconds: float = 3, **headers: str) -> int:
    """Bytes that a websocket client with these headers receives; raises the library's error if it is refused."""
    import viser
    import websockets.sync.client as library
    import websockets.typing

    port = window.server.get_port()
    with library.connect(
        f"ws://{headers.pop('host', '127.0.0.1')}:{port}/{token}",
        sock=socket.create_connection(("127.0.0.1", port)),
        origin=websockets.typing.Origin(headers["origin"]) if "origin" in headers else None,
        subprotocols=[websockets.typing.Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
    ) as client:
        n, end = 0, time.monotonic() + seconds
        while n < 1000 and time.monotonic() < end:
            n += len(client.recv(timeout=seconds))
        return n


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_only_the_page_with_the_token_receives_the_run(window: viewer.ViewerWindow) -> None:
    from websockets.exceptions import InvalidStatus

    port, token = window.server.get_port(), window.token
    assert received(window, token=token) > 1000
    assert received(window, token=token, origin=f"http://127.0.0.1:{port}") > 1000
    assert received(window, token=token, host="localhost", origin=f"http://localhost:{port}") > 1000
    for case in (
        {"token": ""},
        {"token": token[:-1]},
        {"token": f"x/{token}"},
        {"token": token, "origin": "https://example.com"},
        {"token": token, "origin": "null"},
        {"token": token, "origin": f"http://127.0.0.1:{port + 1}"},
        {"token": token, "host": "example.com"},
        {"token": token, "host": "example.com", "origin": f"http://example.com:{port}"},
        {"token": token, "host": "127.0.0.1.example.com"},
    ):
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            received(window, **case)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_page_itself_needs_the_token_and_tells_it_nobody(window: viewer.ViewerWindow) -> None:
    with urllib.request.urlopen(window.address) as page:
        assert page.headers["Referrer-Policy"] == "no-referrer"
    for wrong in (f"http://127.0.0.1:{window.server.get_port()}/", window.address.replace(window.token, "x")):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(wrong)
    assert window.server._websock_server._host == "127.0.0.1"


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_no_client_can_make_the_page_public(window: viewer.ViewerWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the token a client may send any message; the one that asks viser for a public address has no effect."""
    import msgspec
    import viser
    import viser._viser
    import websockets.sync.client as library

    opened = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *arguments: opened.append(arguments))
    asked = []
    share = window.server.request_share_url
    monkeypatch.setattr(window.server, "request_share_url", lambda: asked.append(1) or share())
    address = f"ws://127.0.0.1:{window.server.get_port()}/{window.token}"
    with library.connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as client:
        client.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        end = time.monotonic() + 5
        while not asked and time.monotonic() < end:
            time.sleep(0.01)
    assert asked
    assert not opened


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_log_is_shown_as_plain_text(window: viewer.ViewerWindow) -> None:
    """A name in the log of a run from elsewhere may be markup, which viser's other text fields would draw."""
    import viser

    assert isinstance(window.status, viser.GuiTextHandle)


@pytest.mark.parametrize(
    ("host", "port", "message"),
    [
        ("127.0.0.1", 99999, "--port is out of range: 99999"),
        ("127.0.0.1", -1, "--port is out of range: -1"),
        ("no-such-host.invalid", 8080, "--host no-such-host.invalid is unknown"),
        ("203.0.113.1", 8080, "cannot listen on port 8080 of 203.0.113.1"),
    ],
)
def test_an_address_that_cannot_be_served_is_an_error_of_one_line(
    whole: Path,  # noqa: F811
    host: str,
    port: int,
    message: str,
) -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    with pytest.raises((ValueError, OSError), match=message) as caught:
        viewer.serve(whole, host, port)
    assert "\n" not in str(caught.value)


def test_a_busy_port_is_passed_over() -> None:
    with viewer_access.bind("127.0.0.1", free_port()) as first:
        number = first.getsockname()[1]
        with viewer_access.bind("127.0.0.1", number) as second:
            assert number < second.getsockname()[1] < number + viewer_access.N_PORTS


def test_a_server_that_starts_without_the_check_is_an_error() -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    listening = viewer_access.bind("127.0.0.1", 0)
    with (
        pytest.raises(ModuleNotFoundError, match="pip install 'viser"),
        viewer_access.guarded(listening, "127.0.0.1", "x"),
    ):
        pass
    assert listening.fileno() == -1


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


def test_a_file_that_the_run_removes_while_it_is_read_does_not_end_the_viewer(
    whole: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stage that ends removes its checkpoint, at any moment; a damaged file stays an error."""
    pytest.importorskip("viser", reason="needs the extra `view`")
    out = Path(shutil.copytree(whole, tmp_path / "run"))
    window, original = viewer.ViewerWindow(out, "127.0.0.1", free_port()), run.asset

    def removed(path: Path, cls: type[Asset]) -> Asset:
        (path / run.ASSET).unlink()
        return original(path, cls)

    try:
        os.utime(out / run.ASSET)
        with monkeypatch.context() as patch:
            patch.setattr(run, "asset", removed)
            window.refresh()
        assert window.snapshot.stage == "finished"
        window.refresh()
        assert window.snapshot.stage == "stage 2 finished"
        (out / run.ASSET).write_bytes(b"damaged")
        with pytest.raises(BadFile, match=run.ASSET):
            window.refresh()
    finally:
        window.server.stop()


def test_a_folder_that_is_not_a_run_raises(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    with pytest.raises(BadFile, match="is not a run directory"):
        viewer.ViewerWindow(tmp_path, "127.0.0.1", free_port())
