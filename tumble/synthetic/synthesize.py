"""Synthetic captures with ground truth, written as capture folders (docs/format.md).

Input images are what a camera would store: 8-bit sRGB, saturated where the radiance is above 1. The *exposure* is a
factor on the light, by default such that about one percent of the object's pixels saturate; `truth/light.hdr`
includes it.
"""

import dataclasses
import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tumble import __version__
from tumble.datasets import MAPS, capture_document, evaluation_frame, training_frame
from tumble.io import BadFile, files, outputs, progress, video
from tumble.maths import SE3, SO3, to_srgb8
from tumble.scene import BACKGROUND, OBJECT, Camera, Environment, Light, env_from_obj, opengl_from_opencv
from tumble.synthetic import pathtracer
from tumble.synthetic.options import SynthOptions
from tumble.synthetic.trajectories import (
    ELEVATION,
    LIGHT_FRAME,
    distance_for,
    shared_views,
    sphere_views,
    trajectory,
)

SATURATED = 0.01
"""Fraction of the object's pixels that saturate under the automatic exposure."""
LIGHT_ROWS = 512
"""Maximum height of an environment map; larger ones are averaged down to it, a resolution of a third of a degree."""
MAP_SAMPLES = 256
"""Samples per pixel of albedo, roughness, normal and depth; they only antialias, because no light is involved."""
SETTINGS_FILE = "synth.json"
"""File in a capture folder with the model, lights and options that it was rendered from; a second call with the same
options resumes an interrupted one."""


@dataclass(frozen=True)
class _Frame:
    """One frame to be rendered."""

    name: str
    """File name of its image."""
    T_cam_obj: SE3
    region: str | None
    """Region of an evaluation view; None for a training frame."""


@dataclass
class _RenderContext:
    """What all frames share, Mitsuba's scenes included: their compiled kernels are reused from frame to frame."""

    options: SynthOptions
    model: pathtracer.ObjectModel
    camera: Camera
    out: Path
    """The capture folder."""
    shapes: dict[str, Any]
    """Mitsuba shapes of the model."""
    unlit: tuple[Any, Any]
    """Mitsuba scenes of the ground-truth maps."""
    scenes: dict[str, Any] = field(default_factory=dict)
    """Mitsuba scenes by the name of their light; "" is the capture's own."""

    def render(
        self, light: str, frame: _Frame, samples: int, seed: int, light_frame: Light
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linear radiance and coverage of a frame under a light that is at rest in `light_frame`."""
        R_env_obj = env_from_obj(frame.T_cam_obj, light_frame)
        scene = self.scenes[light]
        return pathtracer.radiance(scene, frame.T_cam_obj, self.camera, R_env_obj, samples=samples, seed=seed)


def render_capture(model: Path, out: Path, options: SynthOptions) -> Path:
    """Render a capture folder (docs/format.md) and return its path; frames that exist already are not rendered again.

    Raises:
        BadFile: The model or a light cannot be read, or `out` holds something else.
        ModuleNotFoundError: The extra `synth` is not installed.
    """
    outputs.claim_folder(out, SETTINGS_FILE, fix="choose another folder with -o")
    pathtracer.mitsuba()
    # All inputs are read before anything is written.
    manifest = _manifest(model, options)
    context = _context(model, out, options)
    unexposed = _unexposed_lights(options)
    resuming = _prepare_folder(out, manifest)
    frames = list(_frames(options))
    lights = _expose_lights(context, unexposed, frames, resuming)
    for number, frame in enumerate(progress.track(frames, f"rendering {out.name}", len(frames))):
        _render_frame(context, frame, number)
    pathtracer.write_model(model, context.model, out / "truth" / "mesh.glb")
    _write_documents(context, frames, lights)
    if options.video:
        training = [out / "images" / frame.name for frame in frames if frame.region is None]
        video.write_clip(out / "clip.mp4", (files.read_image(path) for path in training))
    return out


def _manifest(model: Path, options: SynthOptions) -> dict[str, Any]:
    """All inputs that determine the images, for `SETTINGS_FILE`: a resumed folder must not mix two captures."""

    def digest(name: str) -> str:
        if name == "white":
            return name
        if not Path(name).is_file():
            raise BadFile(Path(name), "is missing")
        return hashlib.sha256(Path(name).read_bytes()).hexdigest()[:16]

    option_values = dataclasses.asdict(options) | {"relight": [Path(name).name for name in options.relight]}
    sources = {Path(name).name: digest(name) for name in (str(model), options.env, *options.relight)}
    return {
        "tumble": __version__,
        "model": model.name,
        "sources": sources,
        "options": option_values | {"env": Path(options.env).name},
    }


def _prepare_folder(out: Path, manifest: dict[str, Any]) -> bool:
    """Create `out` with its manifest; True if an earlier call has begun the same capture there.

    Raises:
        BadFile: `out` holds something else.
    """
    path = out / SETTINGS_FILE
    if not path.is_file():
        files.write_json(path, manifest)
        return False
    if {k: v for k, v in files.read_json(path).items() if k in manifest} != manifest:
        raise BadFile(
            out, "holds a capture made with other options", f"remove it or choose another -o; see {SETTINGS_FILE}"
        )
    return True


def _context(model: Path, out: Path, options: SynthOptions) -> _RenderContext:
    camera = Camera.from_fov(math.radians(options.fov), options.resolution, options.resolution)
    parts = pathtracer.read_model(model, options.up)
    shapes = pathtracer.mitsuba_shapes(parts, options.material, options.roughness)
    return _RenderContext(options, parts, camera, out, shapes, pathtracer.unlit_scenes(parts, options.roughness))


def _frames(options: SynthOptions) -> Iterator[_Frame]:
    """All frames in the order of their numbers: training frames, then the evaluation views of each region."""
    distance = distance_for(math.radians(options.fov))
    training = trajectory(options.setting, options.views, distance, seed=options.seed)
    groups = (
        (None, training, options.views),
        ("shared", shared_views(options.eval_shared, distance), options.eval_shared),
        ("sphere", sphere_views(options.eval_sphere, distance), options.eval_sphere),
    )
    number = 0
    for region, poses, n in groups:
        for i in range(n):
            yield _Frame(f"{number:04}.png", SE3(poses.wxyz[i].float(), poses.xyz[i].float()), region)
            number += 1


# Lights ---------------------------------------------------------------------------------------------------------------


def _read_light(name: str) -> Environment:
    """The environment map in a file, at most `LIGHT_ROWS` high; for "white" a uniform one of radiance 1."""
    if name == "white":
        return Environment.from_radiance(torch.ones(16, 32, 3))
    light = Environment.read(Path(name))
    return light if light.log_radiance.shape[0] <= LIGHT_ROWS else light.resampled(LIGHT_ROWS, 2 * LIGHT_ROWS)


def _capture_light(options: SynthOptions) -> Environment:
    """The capture's environment map in its env frame; +y of the file is up for the object."""
    yaw = SO3.exp(torch.tensor([0.0, math.radians(options.env_rotation), 0.0], dtype=torch.float64))
    # The turntable's camera looks down by its elevation, so in its frame the room is pitched up.
    pitch = ELEVATION if options.setting == "turntable" else 0.0
    R_env_room = SO3.exp(torch.tensor([pitch, 0.0, 0.0], dtype=torch.float64)) @ yaw
    return _read_light(options.env).rotated(R_env_room.matrix().float())


def _unexposed_lights(options: SynthOptions) -> dict[str, Environment]:
    """The lights before exposure by name: "" is the capture's, in its env frame; the others are for relighting."""
    return {"": _capture_light(options)} | {Path(name).stem: _read_light(name) for name in options.relight}


def _expose_lights(
    context: _RenderContext, unexposed: dict[str, Environment], frames: list[_Frame], resuming: bool
) -> dict[str, Path]:
    """Write each light times its exposure, and make the Mitsuba scenes from the written files: the stored light is then
    exactly the one that is rendered.

    Returns:
        The written files by the light's name.
    """
    options, truth = context.options, context.out / "truth"
    paths = {name: truth / "lights" / f"{name}.hdr" if name else truth / "light.hdr" for name in unexposed}
    training = [frame for frame in frames if frame.region is None]
    evaluation = [frame for frame in frames if frame.region is not None]
    for name, path in paths.items():
        if not (resuming and path.exists()):
            light_frame, measured = (
                (LIGHT_FRAME[options.setting], training) if name == "" else ("object", evaluation or training)
            )
            given = options.exposure if name == "" else None
            factor = _exposure(context, unexposed[name], measured, light_frame) if given is None else given
            Environment.from_radiance(unexposed[name].radiance * factor).write(path)
        context.scenes[name] = pathtracer.lit_scene(context.shapes, Environment.read(path), options.path_depth)
    return paths


def _exposure(context: _RenderContext, light: Environment, frames: list[_Frame], light_frame: Light) -> float:
    """The factor on the light at which a fraction `SATURATED` of the object's pixels saturate, over up to 16 frames.

    Raises:
        ValueError: The object is black in all of them.
    """
    context.scenes["probe"] = pathtracer.lit_scene(context.shapes, light, context.options.path_depth)
    brightest = []
    for number, frame in enumerate(frames[:: max(1, math.ceil(len(frames) / 16))]):
        pixels, coverage = context.render("probe", frame, 64, number, light_frame)
        brightest.append(pixels[coverage >= 0.99].max(-1))
    level = float(np.quantile(np.concatenate(brightest), 1 - SATURATED)) if any(map(len, brightest)) else 0.0
    if level <= 0:
        raise ValueError("the object is black in every frame, because no light reaches it: choose another light")
    return 1.0 / level


# Frames ---------------------------------------------------------------------------------------------------------------


def _render_frame(context: _RenderContext, frame: _Frame, number: int) -> None:
    """Render and write a frame and its ground truth. The image is written last, so that if it exists all files do."""
    options, out = context.options, context.out
    if (out / "images" / frame.name).exists():
        return
    # Noise differs between frames and is the same in every call.
    seed = 10_000 * options.seed + number
    pixels, coverage = context.render("", frame, options.samples, seed, LIGHT_FRAME[options.setting])
    if frame.region is not None:
        # Mask and maps use the same coverage, so that every object pixel of a view has ground truth.
        coverage = _render_truth(context, frame, seed)
    mask = np.where(coverage >= 0.5, OBJECT, BACKGROUND).astype(np.uint8)
    files.write_png(out / "masks" / frame.name, mask[..., None])
    _write_srgb(out / "images" / frame.name, pixels)


def _render_truth(context: _RenderContext, frame: _Frame, seed: int) -> np.ndarray:
    """Write maps and relit images of an evaluation view; returns the fraction of each pixel that the object covers."""
    options, truth, exr = context.options, context.out / "truth", Path(frame.name).with_suffix(".exr").name
    maps = pathtracer.maps(context.unlit, frame.T_cam_obj, context.camera, samples=MAP_SAMPLES)
    for name in _map_names(options):
        files.write_exr(truth / name / exr, getattr(maps, name), half=name != "depth")
    for light in (name for name in context.scenes if name not in ("", "probe")):
        pixels, _ = context.render(light, frame, options.truth_samples, seed, "object")
        _write_srgb(truth / "relit" / light / frame.name, pixels)
    return maps.coverage


def _map_names(options: SynthOptions) -> tuple[str, ...]:
    """The ground-truth maps of the capture; a Lambertian surface has no roughness."""
    return tuple(name for name in MAPS if options.material == "original" or name != "roughness")


def _write_srgb(path: Path, radiance: np.ndarray) -> None:
    files.write_png(path, to_srgb8(torch.from_numpy(radiance)).numpy())


# Documents ------------------------------------------------------------------------------------------------------------


def _write_documents(context: _RenderContext, frames: list[_Frame], lights: dict[str, Path]) -> None:
    """Write truth/poses.json and transforms.json. They come last: a folder without them is not a valid capture."""
    options = context.options
    training = [frame for frame in frames if frame.region is None]
    files.write_json(context.out / "truth" / "poses.json", {frame.name: _matrix(frame) for frame in training})
    entries = [training_frame(f.name, None if options.pose_free else _matrix(f)) for f in training]
    entries += [
        evaluation_frame(f.name, _matrix(f), f.region, maps=_map_names(options), lights=filter(None, lights))
        for f in frames
        if f.region is not None
    ]
    light_frame = LIGHT_FRAME[options.setting]
    document = capture_document(context.camera, light_frame, entries, setting=options.setting, with_light=True)
    files.write_json(context.out / "transforms.json", document)


def _matrix(frame: _Frame) -> list[list[float]]:
    """`T_obj_cam` as a 4 x 4 matrix, OpenGL camera axes."""
    T_obj_cam = frame.T_cam_obj.inverse().matrix().double()
    T_obj_cam[:3, :3] = T_obj_cam[:3, :3] @ opengl_from_opencv(T_obj_cam)
    return T_obj_cam.tolist()


def render_captures(
    model: Path, out: Path, options: SynthOptions, roughness_sweep: tuple[float, ...] = ()
) -> list[Path]:
    """Render one capture into `out`, or for a roughness sweep (paper section 5.2) one per value into `out/r0.20`, ...

    Returns:
        The capture folders.
    """
    if not roughness_sweep:
        return [render_capture(model, out, options)]
    return [
        render_capture(model, out / f"r{value:.2f}", dataclasses.replace(options, roughness=value))
        for value in roughness_sweep
    ]
