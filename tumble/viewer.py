"""Browser viewer of a finished or running run (extra `view`): cameras, Gaussians and their maps, environment map.

The world frame is the object frame, +y up. Nodes of viser's scene: `/object` (Gaussians, or the points of stage 1),
`/cameras/NAME`, `/path` (the camera centres), `/light` (the environment map on a large sphere, in its orientation at
the selected frame).

The page shows photos of the user's room, so `viewer_access` decides which requests it answers.
"""

import contextlib
import io
import math
import socket
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.datasets import reader_for
from tumble.engine import loop, run
from tumble.inverse_rendering import Refined, decompose
from tumble.io import BadFile, tree
from tumble.maths import SO3, resize_area, srgb_from_linear, texel_directions
from tumble.poses import PoseResult, mask_refinement
from tumble.rendering import relight
from tumble.report import panorama
from tumble.scene import Asset, Camera, Capture, Environment, Gaussians, Material, Trajectory, opacity
from tumble.viewer_access import bind, guarded, new_token

POLL_SECONDS = 2.0
"""Interval at which the run directory is read again [s]."""
MAX_CAMERAS = 48
"""Maximum number of camera frustums drawn."""
THUMBNAIL = 96
"""Longer side of the images in the frustums [pixels]."""
LIGHT_RADIUS = 12.0
"""Radius of the sphere that shows the environment map, beyond the cameras [object radius]."""
LIGHT_ROWS = 48
"""Rows of points on that sphere."""
LIGHT_POINT_SIZE = 0.85
"""Size of those points [object radius]."""
SOURCES = (
    run.ASSET,
    f"{run.DECOMPOSE}/{run.CHECKPOINT}",
    f"{run.REFINE}/{run.OUT}",
    f"{run.REFINE}/{run.CHECKPOINT}",
    f"{run.TRACK}/{run.OUT}",
)
"""Files of a run directory that contain geometry, the most recent stage first."""


@dataclass(frozen=True)
class Snapshot:
    """State of a run directory at one moment; fields are None if the run has not computed them yet."""

    stage: str
    """Stage and step that the geometry is from, for display."""
    gaussians: Gaussians | None = None
    gamma: Float[Tensor, ""] | None = None
    """Sharpness of the Gaussians' opacity [1 / object radius]."""
    points: Float[Tensor, "n 3"] | None = None
    """Surface points of stage 1 in the object frame, while there are no Gaussians."""
    colours: dict[str, Float[Tensor, "n 3"]] = field(default_factory=dict)
    """sRGB colours of the Gaussians or points, by the name of the map."""
    trajectory: Trajectory | None = None
    names: tuple[str, ...] = ()
    """Image names of the trajectory's frames."""
    environment: Environment | None = None


def read_snapshot(out: Path, capture: Capture | None) -> Snapshot:
    """Read the most recent result of a run, or the last checkpoint of a stage that is not finished.

    Raises:
        BadFile: A file of the run is damaged.
    """
    source = next((name for name in SOURCES if (out / name).is_file()), "")
    tracked = mask_refinement.stored_result(out, capture)[0] if capture else run.output(out, run.TRACK, PoseResult)
    trajectory, names = _frames(tracked, capture)
    if source == run.ASSET:
        asset = run.asset(out, Asset)
        shaded = srgb_from_linear(relight.gaussian_colours(asset)).clamp(0, 1)
        colours = {"as captured": shaded} | _maps(asset.gaussians, asset.material)
        parts = asset.gaussians, asset.gamma, None, colours, asset.trajectory, names, asset.environment
        return Snapshot("finished", *parts)
    if source.endswith(run.CHECKPOINT):
        return replace(_read_checkpoint(out / source), trajectory=trajectory, names=names)
    if source.startswith(run.REFINE):
        refined = tree.load(Refined, out / source)
        colours = {"albedo": srgb_from_linear(refined.albedo)} | _normals(refined.gaussians)
        return Snapshot("stage 2 finished", refined.gaussians, refined.gamma, None, colours, trajectory, names)
    if tracked is not None:
        colours = {"as captured": srgb_from_linear(tracked.colours)}
        return Snapshot("stage 1 finished", None, None, tracked.points, colours, trajectory, names)
    return Snapshot("no result yet", trajectory=trajectory, names=names)


def _frames(tracked: PoseResult | None, capture: Capture | None) -> tuple[Trajectory | None, tuple[str, ...]]:
    """Poses and image names of the frames, without those whose pose was not found."""
    names = () if capture is None else capture.names
    if tracked is None:
        return (None if capture is None else capture.trajectory), names
    kept = torch.where(~tracked.quality.lost)[0].tolist()
    return tracked.trajectory.select(kept), tuple(names[i] for i in kept) if names else ()


def _read_checkpoint(path: Path) -> Snapshot:
    """Snapshot of a stage in training; of stage 3, the output that it would have if it ended at this step."""
    step, params = loop.peek(path)
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in params.items():
        part, _, leaf = name.removeprefix("points.").partition(".")
        parts.setdefault(part, {})[leaf] = value
    gaussians, gamma = Gaussians(**parts["gaussians"]), params["gamma"]
    if "material" not in parts:
        colours = {"albedo": srgb_from_linear(torch.sigmoid(params["points.albedo_logits"]))} | _normals(gaussians)
        return Snapshot(f"stage 2, step {step}", gaussians, gamma, None, colours)
    material, environment = Material(**parts["material"]), Environment(**parts["environment"])
    of_object = (params["poses"], params["log_specular_scale"], params["roughness_shift"])
    ended = decompose.absorbed(decompose.Params(gaussians, gamma, material, environment, *of_object))
    colours = _maps(gaussians, ended.material)
    return Snapshot(f"stage 3, step {step}", gaussians, gamma, None, colours, environment=ended.environment)


def _maps(gaussians: Gaussians, material: Material) -> dict[str, Float[Tensor, "n 3"]]:
    """Colours that display albedo and roughness, as means over the corners of each Gaussian, metalness and normals."""
    albedo, rough = srgb_from_linear(material.albedo.mean(1)), material.roughness.mean(1, keepdim=True)
    metalness = {} if material.metalness is None else {"metalness": material.metalness[:, None].expand(-1, 3)}
    return {"albedo": albedo, "roughness": rough.expand(-1, 3)} | metalness | _normals(gaussians)


def _normals(gaussians: Gaussians) -> dict[str, Float[Tensor, "n 3"]]:
    """Colours that display the normals: -1 to 1 as 0 to 1."""
    return {"normals": 0.5 + 0.5 * gaussians.normals}


def progress(out: Path) -> str:
    """The last record of the run's log as one line of text."""
    records = [record for record in run.log_records(out) if "name" in record]
    if not records:
        return "no stage has started"
    last = records[-1]
    if "step" not in last:
        events = {"start": "started", "done": f"finished after {last.get('seconds', 0):.0f} s"}
        return f"{last['name']} {events.get(str(last.get('event')), 'finished')}"
    metrics = ", ".join(f"{key} {value:.3g}" for key, value in last.get("metrics", {}).items() if value is not None)
    return f"{last['name']}: step {last['step']} of {last.get('of')}, {last.get('eta', 0):.0f} s to go; {metrics}"


# The browser ----------------------------------------------------------------------------------------------------------


class ViewerWindow:
    """Web server whose page follows a run; a class, because it holds the state of the page."""

    def __init__(self, out: Path, host: str, port: int) -> None:
        viser = _viser()
        if not out.is_dir() or not ((out / run.RECIPE).is_file() or (out / run.LOCK).exists()):
            raise BadFile(out, "is not a run directory", "give the output folder of a finished or running `tumble run`")
        self.out, self.snapshot = out, Snapshot("no result yet")
        self.timestamps: tuple[dict[str, int], bool] | None = None
        self.capture: Capture | None = None
        self.host, self.token, listening = host, new_token(), bind(host, port)
        port = listening.getsockname()[1]
        # viser prints addresses without the token.
        with guarded(listening, host, self.token), contextlib.redirect_stdout(io.StringIO()):
            self.server = viser.ViserServer(host=host, port=port, label=f"tumble {out.name}", verbose=False)
        # Any page of viser can ask for a public address of the server on the internet; viser calls this function then.
        self.server.request_share_url = lambda verbose=True: None
        self.server.gui.configure_theme(show_share_button=False)
        self.server.scene.set_up_direction("+y")
        self.server.scene.configure_fog(1.0, 2.0, enabled=False)
        self.server.initial_camera.position = (0.9, 0.9, 2.4)
        gui = self.server.gui
        # Plain text: names in the log of a run from elsewhere could be markup.
        self.status = gui.add_text("Status", "", multiline=True, disabled=True)
        self.map = gui.add_dropdown("Colour", ("as captured",))
        self.frame = gui.add_slider("Frame", 0, 1, 1, 0)
        self.image = gui.add_image(np.zeros((8, 8, 3), np.uint8), label="Image")
        self.panorama = gui.add_image(np.zeros((8, 16, 3), np.uint8), label="Light")
        self.light_visible = gui.add_checkbox("Light around the object", True)
        self.map.on_update(lambda _: self._show_object())
        self.frame.on_update(lambda _: self._show_frame())
        self.light_visible.on_update(lambda _: self._show_frame())
        self.refresh()

    @property
    def address(self) -> str:
        """URL of the page, with the token that admits to it."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}/{self.token}/"

    def refresh(self) -> None:
        """Update the page if files of the run have changed."""
        if self.capture is None and (self.out / run.RECIPE).is_file():
            self.capture = _load_capture(self.out)
        timestamps = _timestamps(self.out)
        if (timestamps, self.capture is None) != self.timestamps and self._read(timestamps):
            self.timestamps = timestamps, self.capture is None
            self._show_cameras()
            self.map.options = tuple(self.snapshot.colours) or ("as captured",)
            self._show_object()
            self._show_light()
            self._show_frame()
        self.status.value = f"{self.snapshot.stage}\n{progress(self.out)}"

    def _read(self, timestamps: dict[str, int]) -> bool:
        """Read the run's result; false if the run replaced or removed files meanwhile, so that it must be read again.

        Raises:
            BadFile: A file of the run is damaged.
        """
        try:
            if self.capture is not None:
                tracked, _ = mask_refinement.stored_result(self.out, self.capture)
                self.capture = replace(self.capture, camera=tracked.camera) if tracked else self.capture
            self.snapshot = read_snapshot(self.out, self.capture)
        except (BadFile, OSError):
            if _timestamps(self.out) == timestamps:
                raise
            return False
        return True

    def _show_object(self) -> None:
        """Draw the Gaussians or points in the colours of the selected map."""
        snapshot = self.snapshot
        if not snapshot.colours:
            return
        selected = snapshot.colours.get(self.map.value, next(iter(snapshot.colours.values())))
        colours = selected.clamp(0, 1).detach().numpy()
        if snapshot.gaussians is None:
            assert snapshot.points is not None, "a snapshot with colours has Gaussians or points"
            self.server.scene.add_point_cloud("/object", snapshot.points.numpy(), colours, point_size=0.02)
            return
        gaussians, gamma = snapshot.gaussians, snapshot.gamma
        assert gamma is not None, "a snapshot with Gaussians has gamma"
        axes = gaussians.R_obj_local * gaussians.scales[:, None]
        centres, covariances, alpha = gaussians.means, axes @ axes.mT, opacity(gaussians.sdf, gamma)[:, None]
        parts = (x.detach().numpy() for x in (centres, covariances))
        self.server.scene.add_gaussian_splats("/object", *parts, colours, alpha.detach().numpy())

    def _show_cameras(self) -> None:
        """Draw the camera path, and frustums with their images at up to `MAX_CAMERAS` frames."""
        trajectory, capture = self.snapshot.trajectory, self.capture
        if trajectory is None or capture is None:
            return
        names = self.snapshot.names
        self.frame.max = len(names) - 1
        # An earlier snapshot may have had other frames, and another object frame.
        self.server.scene.remove_by_name("/cameras")
        T_obj_cam, border = trajectory.T_cam_obj.inverse(), _border(capture.camera)
        left, right, top, bottom = border
        height, width = capture.camera.height + top + bottom, capture.camera.width + left + right
        fov = 2 * math.atan(0.5 * height / float(capture.camera.fx_fy_cx_cy[1]))
        for i in np.linspace(0, len(names) - 1, min(MAX_CAMERAS, len(names))).round().astype(int):
            self.server.scene.add_camera_frustum(
                f"/cameras/{names[i]}",
                fov,
                width / height,
                scale=0.2,
                thickness=0.008,
                color=(60, 110, 200),
                image=_thumbnail(capture, names[i], border=border),
                wxyz=T_obj_cam.wxyz[i].numpy(),
                position=T_obj_cam.xyz[i].numpy(),
            )
        self.server.scene.add_spline_catmull_rom("/path", T_obj_cam.xyz.numpy(), thickness=0.01, color=(60, 110, 200))

    def _show_light(self) -> None:
        """Draw the environment map as a panorama and as points on a sphere around the object."""
        if self.snapshot.environment is None:
            return
        colours = panorama(self.snapshot.environment, LIGHT_ROWS)
        self.panorama.image = panorama(self.snapshot.environment, 96)
        positions = LIGHT_RADIUS * texel_directions(LIGHT_ROWS, 2 * LIGHT_ROWS).reshape(-1, 3).numpy()
        self.server.scene.add_point_cloud("/light", positions, colours.reshape(-1, 3), point_size=LIGHT_POINT_SIZE)

    def _show_frame(self) -> None:
        """Show the selected frame's input image, and rotate the light to its orientation in that frame."""
        names = self.snapshot.names
        if self.capture is not None and names:
            self.image.image = _thumbnail(self.capture, names[min(self.frame.value, len(names) - 1)], 320)
        light = self.server.scene.get_handle_by_name("/light")
        if light is not None and self.snapshot.trajectory is not None:
            R_env_obj = self.snapshot.trajectory.R_env_obj[min(self.frame.value, len(self.snapshot.trajectory) - 1)]
            light.wxyz = SO3.from_matrix(R_env_obj.T).wxyz.numpy()
            light.visible = self.light_visible.value


def _timestamps(out: Path) -> dict[str, int]:
    """Times of the last change of those files of `SOURCES` that a run has [ns]."""
    found = {}
    for name in SOURCES:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            found[name] = (out / name).stat().st_mtime_ns
    return found


def serve(out: Path, host: str, port: int) -> None:
    """Serve the viewer page of a run until Ctrl-C.

    Raises:
        ModuleNotFoundError: viser is not installed; the message contains the command that installs it.
        BadFile: `out` is not a run directory, or one of its files is damaged.
        ValueError, OSError: The server cannot listen on this host and port.
    """
    window = ViewerWindow(out, host, port)
    port = window.server.get_port()
    print(f"{window.address}   (Ctrl-C stops it; from another machine: ssh -L {port}:localhost:{port} THIS_MACHINE)")
    try:
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(POLL_SECONDS)
                window.refresh()
    finally:
        window.server.stop()


def _viser() -> Any:
    try:
        import viser
    except ModuleNotFoundError:
        raise ModuleNotFoundError("tumble view needs viser: pip install 'tumble[view]'") from None
    return viser


def _load_capture(out: Path) -> Capture | None:
    """The capture of a run; None if it is no longer at the path stored in the run."""
    path = run.capture_source(out)
    return reader_for(path).load(path) if path.exists() else None


def _border(camera: Camera) -> tuple[int, int, int, int]:
    """Pixels to add on the left, right, top and bottom, so that the principal point becomes the centre of the image.

    Images of a film are a window of it; frustums are symmetric.
    """
    cx, cy = camera.fx_fy_cx_cy[2:].tolist()
    x, y = round(camera.width - 2 * cx), round(camera.height - 2 * cy)
    return max(0, x), max(0, -x), max(0, y), max(0, -y)


def _thumbnail(
    capture: Capture, name: str, side: int = THUMBNAIL, border: tuple[int, int, int, int] = (0, 0, 0, 0)
) -> UInt8[np.ndarray, "h w 3"]:
    """An input image with a black border, reduced so that its longer side is at most `side` [pixels]."""
    left, right, top, bottom = border
    image = torch.nn.functional.pad(capture.images[capture.names.index(name)], (0, 0, left, right, top, bottom))
    scale = min(1.0, side / max(image.shape[:2]))
    size = (max(1, round(scale * length)) for length in image.shape[:2])
    return resize_area(image.float(), *size).round().to(torch.uint8).numpy()
