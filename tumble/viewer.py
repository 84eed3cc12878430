"""A run in the browser (extra `view`), while it goes on and after: cameras, Gaussians and their maps, the light.

The world is the object's frame, +y up. Nodes: `/object` (Gaussians, or the points of stage 1), `/cameras/NAME`,
`/path`, `/light` (a sphere of the light's colours, turned as the light stood in the chosen frame).
"""

import contextlib
import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.datasets import which
from tumble.engine import loop, run
from tumble.inverse_rendering import Refined, decompose
from tumble.io import BadFile, tree
from tumble.maths import SO3, resize_area, srgb_from_linear, texel_directions
from tumble.poses import PoseResult
from tumble.rendering import relight
from tumble.report import panorama
from tumble.scene import Asset, Capture, Environment, Gaussians, Material, Trajectory, opacity

SECONDS = 2.0
"""Between two looks at the run."""
CAMERAS, THUMBNAIL = 48, 96
"""Cameras drawn at most, and the longer side of their photographs [pixels]."""
SKY, SKY_ROWS, SKY_TEXEL = 12.0, 48, 0.85
"""Radius of the sphere of light, beyond the cameras [object radius], its rows of points, and their size."""
SOURCES = (
    run.ASSET,
    f"{run.DECOMPOSE}/{run.CHECKPOINT}",
    f"{run.REFINE}/{run.OUT}",
    f"{run.REFINE}/{run.CHECKPOINT}",
    f"{run.TRACK}/{run.OUT}",
)
"""Where geometry is, the latest first."""


@dataclass(frozen=True)
class Look:
    """What a run directory shows at one moment; None where it does not know yet."""

    stage: str
    """Where the geometry is from, in words."""
    gaussians: Gaussians | None = None
    gamma: Float[Tensor, ""] | None = None
    points: Float[Tensor, "n 3"] | None = None
    """Of stage 1, before there are Gaussians; object frame."""
    colours: dict[str, Float[Tensor, "n 3"]] = field(default_factory=dict)
    """sRGB by the name of a map."""
    trajectory: Trajectory | None = None
    names: tuple[str, ...] = ()
    """Of the trajectory's frames."""
    environment: Environment | None = None


def look(out: Path, capture: Capture | None) -> Look:
    """What is there: of an unfinished run the last checkpoint.

    Raises:
        BadFile: A file of the run is damaged.
    """
    source = next((name for name in SOURCES if (out / name).is_file()), "")
    tracked = run.output(out, run.TRACK, PoseResult)
    trajectory, names = _frames(tracked, capture)
    if source == run.ASSET:
        asset = run.asset(out, Asset)
        lit = srgb_from_linear(relight.gaussian_colours(asset)).clamp(0, 1)
        colours = {"as photographed": lit} | _maps(asset.gaussians, asset.material)
        shown = asset.gaussians, asset.gamma, None, colours, asset.trajectory, names, asset.environment
        return Look("finished", *shown)
    if source.endswith(run.CHECKPOINT):
        return replace(_checkpoint(out / source), trajectory=trajectory, names=names)
    if source.startswith(run.REFINE):
        refined = tree.load(Refined, out / source)
        colours = {"albedo": srgb_from_linear(refined.albedo)} | _normals(refined.gaussians)
        return Look("stage 2 finished", refined.gaussians, refined.gamma, None, colours, trajectory, names)
    if tracked is not None:
        colours = {"as photographed": srgb_from_linear(tracked.colours)}
        return Look("stage 1 finished", None, None, tracked.points, colours, trajectory, names)
    return Look("nothing yet", trajectory=trajectory, names=names)


def _frames(tracked: PoseResult | None, capture: Capture | None) -> tuple[Trajectory | None, tuple[str, ...]]:
    """Poses and names of the frames that are used; those whose pose is lost are left out."""
    names = () if capture is None else capture.names
    if tracked is None:
        return (None if capture is None else capture.trajectory), names
    kept = torch.where(~tracked.quality.lost)[0].tolist()
    return tracked.trajectory.select(kept), tuple(names[i] for i in kept) if names else ()


def _checkpoint(path: Path) -> Look:
    """A stage in training; of stage 3 what it would put out if it ended now."""
    step, params = loop.peek(path)
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in params.items():
        part, _, leaf = name.removeprefix("points.").partition(".")
        parts.setdefault(part, {})[leaf] = value
    gaussians, gamma = Gaussians(**parts["gaussians"]), params["gamma"]
    if "material" not in parts:
        colours = {"albedo": srgb_from_linear(torch.sigmoid(params["points.albedo_logits"]))} | _normals(gaussians)
        return Look(f"stage 2, step {step}", gaussians, gamma, None, colours)
    material, environment = Material(**parts["material"]), Environment(**parts["environment"])
    trained = decompose.Params(gaussians, gamma, material, environment, params["poses"], params["log_tint"])
    ended = decompose.shared_out(trained)
    colours = _maps(gaussians, ended.material)
    return Look(f"stage 3, step {step}", gaussians, gamma, None, colours, environment=ended.environment)


def _maps(gaussians: Gaussians, material: Material) -> dict[str, Float[Tensor, "n 3"]]:
    albedo, rough = srgb_from_linear(material.albedo.mean(1)), material.roughness.mean(1, keepdim=True)
    return {"albedo": albedo, "roughness": rough.expand(-1, 3)} | _normals(gaussians)


def _normals(gaussians: Gaussians) -> dict[str, Float[Tensor, "n 3"]]:
    return {"normals": 0.5 + 0.5 * gaussians.normals}


def progress(out: Path) -> str:
    """What the log says last, as a line."""
    records = [record for record in run.records(out) if "name" in record]
    if not records:
        return "no stage has begun"
    last = records[-1]
    if "step" not in last:
        words = {"start": "begins", "done": f"finished after {last.get('seconds', 0):.0f} s"}
        return f"{last['name']} {words.get(last.get('event', ''), 'finished')}"
    metrics = ", ".join(f"{key} {value:.3g}" for key, value in last["metrics"].items() if value is not None)
    return f"{last['name']}: step {last['step']} of {last['of']}, {last['eta']:.0f} s to go; {metrics}"


# The browser ----------------------------------------------------------------------------------------------------------


class ViewerWindow:
    """A server whose page follows a run; a class, because it remembers what the page shows."""

    def __init__(self, out: Path, host: str, port: int) -> None:
        viser = _viser()
        if not out.is_dir() or not ((out / run.RECIPE).is_file() or (out / run.LOCK).exists()):
            raise BadFile(out, "is no run", "give the folder of a `tumble run`, which may still be going on")
        self.out, self.stamp, self.look = out, (), Look("nothing yet")
        self.capture: Capture | None = None
        self.server = viser.ViserServer(host=host, port=port, label=f"tumble {out.name}", verbose=False)
        self.server.scene.set_up_direction("+y")
        self.server.scene.configure_fog(1.0, 2.0, enabled=False)
        self.server.initial_camera.position = (0.9, 0.9, 2.4)
        gui = self.server.gui
        self.state = gui.add_markdown("")
        self.map = gui.add_dropdown("Colour", ("as photographed",))
        self.frame = gui.add_slider("Frame", 0, 1, 1, 0)
        self.photograph = gui.add_image(np.zeros((8, 8, 3), np.uint8), label="Photograph")
        self.panorama = gui.add_image(np.zeros((8, 16, 3), np.uint8), label="Light")
        self.sky = gui.add_checkbox("Light around the object", True)
        self.map.on_update(lambda _: self._object())
        self.frame.on_update(lambda _: self._choose())
        self.sky.on_update(lambda _: self._choose())
        self.refresh()

    @property
    def address(self) -> str:
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def refresh(self) -> None:
        """Show what is there now."""
        stamp = tuple((self.out / name).stat().st_mtime_ns for name in SOURCES if (self.out / name).is_file())
        if self.capture is None and (self.out / run.RECIPE).is_file():
            self.capture = _capture(self.out)
        if (stamp, self.capture is None) != self.stamp:
            self.stamp = stamp, self.capture is None
            tracked = run.output(self.out, run.TRACK, PoseResult)
            if self.capture is not None and tracked is not None:
                self.capture = replace(self.capture, camera=tracked.camera)
            self.look = look(self.out, self.capture)
            self._cameras()
            self.map.options = tuple(self.look.colours) or ("as photographed",)
            self._object()
            self._light()
            self._choose()
        self.state.content = f"**{self.look.stage}**\n\n{progress(self.out)}"

    def _object(self) -> None:
        found = self.look
        if not found.colours:
            return
        chosen = found.colours.get(self.map.value, next(iter(found.colours.values())))
        colours = chosen.clamp(0, 1).detach().numpy()
        if found.gaussians is None:
            assert found.points is not None, "colours of something"
            self.server.scene.add_point_cloud("/object", found.points.numpy(), colours, point_size=0.02)
            return
        gaussians, gamma = found.gaussians, found.gamma
        assert gamma is not None, "Gaussians come with their sharpness"
        axes = gaussians.R_obj_local * gaussians.scales[:, None]
        centres, covariances, alpha = gaussians.means, axes @ axes.mT, opacity(gaussians.sdf, gamma)[:, None]
        parts = (x.detach().numpy() for x in (centres, covariances))
        self.server.scene.add_gaussian_splats("/object", *parts, colours, alpha.detach().numpy())

    def _cameras(self) -> None:
        trajectory, capture = self.look.trajectory, self.capture
        if trajectory is None or capture is None:
            return
        names = self.look.names
        self.frame.max = len(names) - 1
        T_obj_cam, camera = trajectory.T_cam_obj.inverse(), capture.camera
        fov = 2 * math.atan(0.5 * camera.height / float(camera.fx_fy_cx_cy[1]))
        for i in np.linspace(0, len(names) - 1, min(CAMERAS, len(names))).round().astype(int):
            self.server.scene.add_camera_frustum(
                f"/cameras/{names[i]}",
                fov,
                camera.width / camera.height,
                scale=0.2,
                thickness=0.008,
                color=(60, 110, 200),
                image=_small(capture, names[i]),
                wxyz=T_obj_cam.wxyz[i].numpy(),
                position=T_obj_cam.xyz[i].numpy(),
            )
        self.server.scene.add_spline_catmull_rom("/path", T_obj_cam.xyz.numpy(), thickness=0.01, color=(60, 110, 200))

    def _light(self) -> None:
        if self.look.environment is None:
            return
        picture = panorama(self.look.environment, SKY_ROWS)
        self.panorama.image = panorama(self.look.environment, 96)
        around = SKY * texel_directions(SKY_ROWS, 2 * SKY_ROWS).reshape(-1, 3).numpy()
        self.server.scene.add_point_cloud("/light", around, picture.reshape(-1, 3), point_size=SKY_TEXEL)

    def _choose(self) -> None:
        """Show the frame's photograph, and turn the light as it stood about the object then."""
        names = self.look.names
        if self.capture is not None and names:
            self.photograph.image = _small(self.capture, names[min(self.frame.value, len(names) - 1)], 320)
        light = self.server.scene.get_handle_by_name("/light")
        if light is not None and self.look.trajectory is not None:
            R_env_obj = self.look.trajectory.R_env_obj[min(self.frame.value, len(self.look.trajectory) - 1)]
            light.wxyz = SO3.from_matrix(R_env_obj.T).wxyz.numpy()
            light.visible = self.sky.value


def serve(out: Path, host: str, port: int) -> None:
    """Serve a run until Ctrl-C.

    Raises:
        ModuleNotFoundError: viser is not installed; says how to.
        BadFile: `out` is no run, or a file of it is damaged.
    """
    window = ViewerWindow(out, host, port)
    print(f"{window.address}   (Ctrl-C ends it; from another machine: ssh -L {port}:localhost:{port} THIS_MACHINE)")
    try:
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(SECONDS)
                window.refresh()
    finally:
        window.server.stop()


def _viser() -> Any:
    try:
        import viser
    except ModuleNotFoundError:
        raise ModuleNotFoundError("tumble view needs viser: pip install 'tumble[view]'") from None
    return viser


def _capture(out: Path) -> Capture | None:
    """The run's photographs, if they are still where the run found them."""
    path = run.source(out)
    return which(path).load(path) if path.exists() else None


def _small(capture: Capture, name: str, side: int = THUMBNAIL) -> UInt8[np.ndarray, "h w 3"]:
    picture = capture.images[capture.names.index(name)]
    scale = min(1.0, side / max(picture.shape[:2]))
    size = (max(1, round(scale * length)) for length in picture.shape[:2])
    return resize_area(picture.float(), *size).round().to(torch.uint8).numpy()
