"""Captures with exact truth: any GLB under any lat-long light, in one of the three settings, as a capture folder.

A *photograph* is what the camera would store: 8-bit sRGB, saturated where the light is too strong. The *exposure*
multiplies the light so that about one percent of the object's pixels saturate; `truth/light.hdr` includes it.
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
from rich.progress import Progress

from tumble import __version__
from tumble.datasets import MAPS, capture_document, evaluation_frame, training_frame
from tumble.io import BadFile, files, video
from tumble.maths import SE3, SO3, to_srgb8
from tumble.scene import BACKGROUND, OBJECT, Camera, Environment, Light, env_from_obj, opengl_from_opencv
from tumble.synthetic import pathtracer
from tumble.synthetic.options import SynthOptions
from tumble.synthetic.trajectories import (
    ELEVATION,
    LIGHT,
    distance_for,
    shared_views,
    sphere_views,
    trajectory,
)

SATURATED = 0.01
"""Share of the object's pixels that the exposure lets saturate."""
LIGHT_ROWS = 512
"""Larger light maps are averaged down to this height: a finer sun than a third of a degree costs memory, not truth."""
MAP_SAMPLES = 256
"""Samples per pixel of albedo, roughness, normal and depth: they only antialias, no light is involved."""
SETTINGS_FILE = "synth.json"
"""Says how a folder was made; a second call with the same options goes on where the first one stopped."""


@dataclass(frozen=True)
class _Shot:
    """One frame to be rendered."""

    name: str
    T_cam_obj: SE3
    region: str | None
    """None for a training frame."""


@dataclass
class _Studio:
    """What the frames share. Holds Mitsuba's scenes, whose compiled kernels are worth keeping."""

    options: SynthOptions
    model: pathtracer.ObjectModel
    camera: Camera
    out: Path
    shapes: dict[str, Any]
    unlit: tuple[Any, Any]
    scenes: dict[str, Any] = field(default_factory=dict)

    def photograph(
        self, light: str, shot: _Shot, samples: int, seed: int, frame: Light
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linear radiance and coverage of a shot; `frame` says what the light stands still with."""
        R_env_obj = env_from_obj(shot.T_cam_obj, frame)
        scene = self.scenes[light]
        return pathtracer.radiance(scene, shot.T_cam_obj, self.camera, R_env_obj, samples=samples, seed=seed)


def render_capture(model: Path, out: Path, options: SynthOptions) -> Path:
    """Render a capture folder (docs/format.md); returns it. Frames that are there already are kept.

    Raises:
        BadFile: The model or a light cannot be read, or `out` holds something else.
        ModuleNotFoundError: The extra `synth` is not installed.
    """
    pathtracer.mitsuba()
    # Everything is read before anything is written.
    note = _note(model, options)
    studio = _studio(model, out, options)
    sources = _sources(options)
    resuming = _claim(out, note)
    shots = list(_shots(options))
    lights = _expose(studio, sources, shots, resuming)
    with Progress(transient=True) as progress:
        job = progress.add_task(f"rendering {out.name}", total=len(shots))
        for number, shot in enumerate(shots):
            _render(studio, shot, number)
            progress.advance(job)
    pathtracer.write_model(model, studio.model, out / "truth" / "mesh.glb")
    _write_documents(studio, shots, lights)
    if options.video:
        training = [out / "images" / shot.name for shot in shots if shot.region is None]
        video.write_clip(out / "clip.mp4", (files.read_image(path) for path in training))
    return out


def _note(model: Path, options: SynthOptions) -> dict[str, Any]:
    """All that decides the pictures, so that a resumed folder cannot mix two captures."""

    def digest(name: str) -> str:
        if name == "white":
            return name
        if not Path(name).is_file():
            raise BadFile(Path(name), "is missing")
        return hashlib.sha256(Path(name).read_bytes()).hexdigest()[:16]

    chosen = dataclasses.asdict(options) | {"relight": [Path(name).name for name in options.relight]}
    sources = {Path(name).name: digest(name) for name in (str(model), options.env, *options.relight)}
    return {
        "tumble": __version__,
        "model": model.name,
        "sources": sources,
        "options": chosen | {"env": Path(options.env).name},
    }


def _claim(out: Path, note: dict[str, Any]) -> bool:
    """Take `out` for this capture; True when an earlier call has begun the same one."""
    path = out / SETTINGS_FILE
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        files.write_json(path, note)
        return False
    if not path.is_file():
        raise BadFile(out, "is there already and was not made by tumble synth", "choose another folder with -o")
    if {k: v for k, v in files.read_json(path).items() if k in note} != note:
        raise BadFile(
            out, "holds a capture made with other options", f"remove it or choose another -o; see {SETTINGS_FILE}"
        )
    return True


def _studio(model: Path, out: Path, options: SynthOptions) -> _Studio:
    camera = Camera.from_fov(math.radians(options.fov), options.resolution, options.resolution)
    parts = pathtracer.read_model(model, options.up)
    shapes = pathtracer.shape(parts, options.material, options.roughness)
    return _Studio(options, parts, camera, out, shapes, pathtracer.unlit_scenes(parts, options.roughness))


def _shots(options: SynthOptions) -> Iterator[_Shot]:
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
            yield _Shot(f"{number:04}.png", SE3(poses.wxyz[i].float(), poses.xyz[i].float()), region)
            number += 1


# Lights ---------------------------------------------------------------------------------------------------------------


def _light(name: str) -> Environment:
    if name == "white":
        return Environment.from_radiance(torch.ones(16, 32, 3))
    light = Environment.read(Path(name))
    return light if light.log_radiance.shape[0] <= LIGHT_ROWS else light.resampled(LIGHT_ROWS, 2 * LIGHT_ROWS)


def _capture_light(options: SynthOptions) -> Environment:
    """The light in the capture's env frame: a room whose +y is up, seen by a camera that may look down."""
    yaw = SO3.exp(torch.tensor([0.0, math.radians(options.env_rotation), 0.0], dtype=torch.float64))
    # The turntable's camera looks down by its elevation, so in its frame the room is pitched up.
    pitch = ELEVATION if options.setting == "turntable" else 0.0
    R_env_room = SO3.exp(torch.tensor([pitch, 0.0, 0.0], dtype=torch.float64)) @ yaw
    return _light(options.env).rotated(R_env_room.matrix().float())


def _sources(options: SynthOptions) -> dict[str, Environment]:
    """The lights before exposure: the capture's under the empty name, in its env frame; those of relit truth."""
    return {"": _capture_light(options)} | {Path(name).stem: _light(name) for name in options.relight}


def _expose(studio: _Studio, sources: dict[str, Environment], shots: list[_Shot], resuming: bool) -> dict[str, Path]:
    """Choose exposures, write the lights as files, and load them from there as scenes: truth is what is on disk."""
    options, truth = studio.options, studio.out / "truth"
    wanted = {name: truth / "lights" / f"{name}.hdr" if name else truth / "light.hdr" for name in sources}
    training = [shot for shot in shots if shot.region is None]
    views = [shot for shot in shots if shot.region is not None]
    for name, path in wanted.items():
        if not (resuming and path.exists()):
            frame, probes = (LIGHT[options.setting], training) if name == "" else ("object", views or training)
            given = options.exposure if name == "" else None
            factor = _exposure(studio, sources[name], probes, frame) if given is None else given
            Environment.from_radiance(sources[name].radiance * factor).write(path)
        studio.scenes[name] = pathtracer.lit_scene(studio.shapes, Environment.read(path), options.path_depth)
    return wanted


def _exposure(studio: _Studio, light: Environment, probes: list[_Shot], frame: Light) -> float:
    """The factor on the light that lets `SATURATED` of the object's pixels saturate, from up to 16 of the shots."""
    studio.scenes["probe"] = pathtracer.lit_scene(studio.shapes, light, studio.options.path_depth)
    brightest = []
    for number, shot in enumerate(probes[:: max(1, math.ceil(len(probes) / 16))]):
        pixels, coverage = studio.photograph("probe", shot, 64, number, frame)
        brightest.append(pixels[coverage >= 0.99].max(-1))
    level = float(np.quantile(np.concatenate(brightest), 1 - SATURATED)) if any(map(len, brightest)) else 0.0
    if level <= 0:
        raise ValueError("the object is black in every frame: no light reaches it")
    return 1.0 / level


# Frames ---------------------------------------------------------------------------------------------------------------


def _render(studio: _Studio, shot: _Shot, number: int) -> None:
    """One frame and its truth. The photograph is written last: where it exists, the frame is whole."""
    options, out = studio.options, studio.out
    if (out / "images" / shot.name).exists():
        return
    # Every frame draws its own noise, and the same noise in every call.
    seed = 10_000 * options.seed + number
    pixels, coverage = studio.photograph("", shot, options.samples, seed, LIGHT[options.setting])
    if shot.region is not None:
        # One coverage decides about mask and truth: every object pixel of a view has truth.
        coverage = _render_truth(studio, shot, seed)
    mask = np.where(coverage >= 0.5, OBJECT, BACKGROUND).astype(np.uint8)
    files.write_png(out / "masks" / shot.name, mask[..., None])
    _write_photograph(out / "images" / shot.name, pixels)


def _render_truth(studio: _Studio, shot: _Shot, seed: int) -> np.ndarray:
    """Maps and relit pictures of an evaluation view; returns the object's coverage of its pixels."""
    options, truth, exr = studio.options, studio.out / "truth", Path(shot.name).with_suffix(".exr").name
    view = pathtracer.maps(studio.unlit, shot.T_cam_obj, studio.camera, samples=MAP_SAMPLES)
    for name in _maps(options):
        files.write_exr(truth / name / exr, getattr(view, name), half=name != "depth")
    for light in (name for name in studio.scenes if name not in ("", "probe")):
        pixels, _ = studio.photograph(light, shot, options.truth_samples, seed, "object")
        _write_photograph(truth / "relit" / light / shot.name, pixels)
    return view.coverage


def _maps(options: SynthOptions) -> tuple[str, ...]:
    """A Lambertian surface has no roughness to speak of."""
    return tuple(name for name in MAPS if options.material == "original" or name != "roughness")


def _write_photograph(path: Path, radiance: np.ndarray) -> None:
    files.write_png(path, to_srgb8(torch.from_numpy(radiance)).numpy())


# Documents ------------------------------------------------------------------------------------------------------------


def _write_documents(studio: _Studio, shots: list[_Shot], lights: dict[str, Path]) -> None:
    """transforms.json and truth/poses.json, last of all: a folder without them is not a capture yet."""
    options = studio.options
    training = [shot for shot in shots if shot.region is None]
    files.write_json(studio.out / "truth" / "poses.json", {shot.name: _matrix(shot) for shot in training})
    frames = [training_frame(s.name, None if options.pose_free else _matrix(s)) for s in training]
    frames += [
        evaluation_frame(s.name, _matrix(s), s.region, maps=_maps(options), lights=filter(None, lights))
        for s in shots
        if s.region is not None
    ]
    document = capture_document(studio.camera, LIGHT[options.setting], frames, setting=options.setting, with_light=True)
    files.write_json(studio.out / "transforms.json", document)


def _matrix(shot: _Shot) -> list[list[float]]:
    """Camera to object, OpenGL camera axes."""
    T_obj_cam = shot.T_cam_obj.inverse().matrix().double()
    T_obj_cam[:3, :3] = T_obj_cam[:3, :3] @ opengl_from_opencv(T_obj_cam)
    return T_obj_cam.tolist()


def render_captures(
    model: Path, out: Path, options: SynthOptions, roughness_sweep: tuple[float, ...] = ()
) -> list[Path]:
    """One capture in `out`, or one per constant roughness as `out/r0.20`, `out/r0.40`, ...: alike in all else (paper
    section 5.2)."""
    if not roughness_sweep:
        return [render_capture(model, out, options)]
    return [
        render_capture(model, out / f"r{value:.2f}", dataclasses.replace(options, roughness=value))
        for value in roughness_sweep
    ]
