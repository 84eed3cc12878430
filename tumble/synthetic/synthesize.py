"""Synthetic captures with ground truth, written as capture folders (docs/format.md).

Input images are what a camera would store: 8-bit sRGB, saturated where the radiance is above 1. The *exposure* is a
factor on the light, by default such that about one percent of the object's pixels saturate; `truth/light.hdr`
includes it.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tumble import __version__
from tumble.datasets import MAPS, capture_document, evaluation_frame, training_frame
from tumble.io import BadFile, files, outputs, progress, video
from tumble.maths import SE3, SO3, to_srgb8
from tumble.scene import (
    BACKGROUND,
    MIN_RADIANCE,
    OBJECT,
    UNKNOWN,
    Camera,
    Environment,
    Light,
    env_from_obj,
    opengl_from_opencv,
)
from tumble.synthetic import film, pathtracer
from tumble.synthetic.options import SynthOptions
from tumble.synthetic.surroundings import Surroundings, surroundings
from tumble.synthetic.trajectories import (
    ELEVATION,
    LIGHT_FRAME,
    distance_for,
    light_turns,
    shared_views,
    sphere_views,
    trajectory,
)

SATURATED = 0.01
"""Fraction of the object's pixels that saturate under the automatic exposure."""
LAYER_SAMPLES = 64
"""Samples per pixel of the masks of object and hand."""
SURROUNDED = "/surrounded"
"""Name of the Mitsuba scene of the capture's light with hand and background. No light has a slash in its name."""
PROBE = "/probe"
"""Name of the Mitsuba scene of a light whose exposure is being measured."""
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
    time: float = 0.0
    """Time of a training frame [frames]."""
    light_turn: Tensor | None = None
    """Rotation of the light in a training frame, `[3 3]`; None if it does not turn by itself."""


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
    poses: SE3
    """Poses of the training frames."""
    surroundings: Surroundings | None
    """Hand and background of the training frames."""
    layers: Any
    """Mitsuba scene of object, hand and background; None without surroundings."""
    scenes: dict[str, Any] = field(default_factory=dict)
    """Mitsuba scenes by the name of their light; "" is the capture's own, `SURROUNDED` that with the surroundings."""

    def render(
        self, light: str, frame: _Frame, samples: int, seed: int, light_frame: Light, camera: Camera | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Linear radiance and coverage of a frame under a light that is at rest in `light_frame`; the coverage includes
        the surroundings."""
        R_env_obj = env_from_obj(frame.T_cam_obj, light_frame)
        R_env_obj = R_env_obj if frame.light_turn is None else frame.light_turn @ R_env_obj
        scene = self.scenes[light]
        camera = self.camera if camera is None else camera
        return pathtracer.radiance(scene, frame.T_cam_obj, camera, R_env_obj, samples=samples, seed=seed)


def render_capture(model: Path, out: Path, options: SynthOptions) -> Path:
    """Render a capture folder (docs/format.md) and return its path; frames that exist already are not rendered again.

    Raises:
        BadFile: The model or a light cannot be read, or `out` holds something else.
        ModuleNotFoundError: The extra `synth` is not installed.
    """
    outputs.claim_folder(out, SETTINGS_FILE, fix="choose another folder with -o")
    pathtracer.require_extra()
    # All inputs are read before anything is written.
    manifest = _manifest(model, options)
    parts = pathtracer.read_model(model, options.up)
    unexposed = _unexposed_lights(options)
    pathtracer.mitsuba()
    context = _context(parts, out, options)
    resuming = _prepare_folder(out, manifest)
    files.remove_partial_files(out)
    frames = list(_frames(options, context.poses))
    lights = _expose_lights(context, unexposed, frames, resuming)
    for number, frame in enumerate(progress.track(frames, f"rendering {out.name}", len(frames))):
        _render_frame(context, frame, number)
    pathtracer.write_model(model, context.model, out / "truth" / "mesh.glb")
    training = [frame.name for frame in frames if frame.region is None]
    if options.video:
        video.write_clip(out / "clip.mp4", (files.read_image(out / "images" / name) for name in training))
    if options.film:
        mask = files.read_image(out / "truth" / "film_object_mask" / training[0])[..., 0]
        film.write_film(out, training, mask, film.film_camera(context.camera), options.seed)
    _write_documents(context, frames, lights)
    return out


def _manifest(model: Path, options: SynthOptions) -> dict[str, Any]:
    """All inputs that determine the images, for `SETTINGS_FILE`: a resumed folder must not mix two captures."""

    def digest(name: str) -> str:
        if name == "white":
            return name
        if not Path(name).is_file():
            raise BadFile(Path(name), "is missing")
        return files.sha256(Path(name))[:16]

    option_values = dataclasses.asdict(options) | {"relight": [Path(name).name for name in options.relight]}
    sources: dict[str, str] = {}
    for role, name in (("model", str(model)), ("env", options.env), *(("relight", name) for name in options.relight)):
        key, value = Path(name).name, digest(name)
        # Two files of one name are told apart by what they are for.
        sources[key if sources.get(key, value) == value else f"{role}/{key}"] = value
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
    if {k: v for k, v in files.read_json(path, dict[str, Any]).items() if k in manifest} != manifest:
        raise BadFile(
            out, "holds a capture made with other options", f"remove it or choose another -o; see {SETTINGS_FILE}"
        )
    return True


def _context(parts: pathtracer.ObjectModel, out: Path, options: SynthOptions) -> _RenderContext:
    camera = Camera.from_fov(math.radians(options.fov), options.resolution, options.resolution)
    shapes = pathtracer.mitsuba_shapes(parts, options.material, options.roughness)
    unlit = pathtracer.unlit_scenes(parts, options.material, options.roughness)
    distance = distance_for(math.radians(options.fov))
    poses = trajectory(options.setting, options.views, distance, seed=options.seed, stride=options.stride)
    around = surroundings(parts, poses, options, distance)
    layers = None if around is None else pathtracer.layer_scene((parts.named_parts(), *around.at(0.0, poses[0])))
    return _RenderContext(options, parts, camera, out, shapes, unlit, poses, around, layers)


def _frames(options: SynthOptions, poses: SE3) -> Iterator[_Frame]:
    """All frames in the order of their numbers: training frames, then the evaluation views of each region."""
    distance = distance_for(math.radians(options.fov))
    groups = (
        (None, poses, options.views),
        ("shared", shared_views(options.eval_shared, distance), options.eval_shared),
        ("sphere", sphere_views(options.eval_sphere, distance), options.eval_sphere),
    )
    turned = options.setting == "turned"
    turns = light_turns(options.views, options.turns or options.views, seed=options.seed).float() if turned else None
    number = 0
    for region, poses, n in groups:
        for i in range(n):
            turn = turns[i] if turns is not None and region is None else None
            yield _Frame(f"{number:04}.png", SE3(poses.wxyz[i].float(), poses.xyz[i].float()), region, number, turn)
            number += 1


# Lights ---------------------------------------------------------------------------------------------------------------


def _read_light(name: str) -> Environment:
    """The environment map in a file, at most `LIGHT_ROWS` high; for "white" a uniform one of radiance 1.

    Raises:
        BadFile: The file is no environment map, or black everywhere.
    """
    if name == "white":
        return Environment.from_radiance(torch.ones(16, 32, 3))
    light = Environment.read(Path(name))
    if light.radiance.max() < 1.01 * MIN_RADIANCE:  # the exposure would make a white light of the lower limit
        raise BadFile(Path(name), f"is black: no radiance is above {MIN_RADIANCE:g}", "choose or scale up another map")
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
    if context.surroundings is not None:
        hand, background = context.surroundings.at(0.0, context.poses[0])
        shapes = context.shapes | pathtracer.surrounding_shapes(hand | background)
        light = Environment.read(paths[""])
        context.scenes[SURROUNDED] = pathtracer.lit_scene(shapes, light, options.path_depth)
    return paths


def _exposure(context: _RenderContext, light: Environment, frames: list[_Frame], light_frame: Light) -> float:
    """The factor on the light at which a fraction `SATURATED` of the object's pixels saturate, over up to 16 frames.

    Raises:
        ValueError: The object is black in all of them.
    """
    context.scenes[PROBE] = pathtracer.lit_scene(context.shapes, light, context.options.path_depth)
    brightest = []
    for number, frame in enumerate(frames[:: max(1, math.ceil(len(frames) / 16))]):
        pixels, coverage = context.render(PROBE, frame, 64, number, light_frame)
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
    if frame.region is not None:
        pixels, _ = context.render("", frame, options.samples, seed, LIGHT_FRAME[options.setting])
        # Mask and maps use the same coverage, so that every object pixel of a view has ground truth.
        mask = _two_valued(_render_truth(context, frame, seed))
    else:
        pixels, mask = _render_training(context, frame, seed)
    if frame.region is None and options.film:
        _render_film(context, frame, seed)
    files.write_png(out / "masks" / frame.name, mask[..., None])
    _write_srgb(out / "images" / frame.name, pixels)


def _two_valued(coverage: np.ndarray) -> np.ndarray:
    return np.where(coverage >= 0.5, OBJECT, BACKGROUND).astype(np.uint8)


def _render_training(context: _RenderContext, frame: _Frame, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and mask of a training frame; what a hand may hide is unknown in the mask."""
    options, light_frame = context.options, LIGHT_FRAME[context.options.setting]
    if context.surroundings is None:
        pixels, coverage = context.render("", frame, options.samples, seed, light_frame)
        return pixels, _two_valued(coverage)
    _place_surroundings(context, frame)
    pixels, _ = context.render(SURROUNDED, frame, options.samples, seed, light_frame)
    visible = pathtracer.layer_coverage(context.layers, frame.T_cam_obj, context.camera, samples=LAYER_SAMPLES)
    _write_layers(context.out / "truth", "", frame, visible)
    elsewhere = np.where(visible[..., :2].sum(-1) >= 0.5, UNKNOWN, BACKGROUND)
    return pixels, np.where(visible[..., 0] >= 0.5, OBJECT, elsewhere).astype(np.uint8)


def _render_film(context: _RenderContext, frame: _Frame, seed: int) -> None:
    """Write a frame of the film, averaged while the shutter is open, and its masks of object and hand."""
    options, camera = context.options, film.film_camera(context.camera)
    samples = math.ceil(options.samples / film.SUBFRAMES)
    total, visible = np.zeros(()), np.zeros(())
    for i, time in enumerate(film.shutter_times(frame.time)):
        pose = film.pose_at(context.poses, time)
        moment = _Frame(frame.name, SE3(pose.wxyz.float(), pose.xyz.float()), None, time)
        light = "" if context.surroundings is None else SURROUNDED
        _place_surroundings(context, moment)
        seed_of_moment = film.SUBFRAMES * seed + i
        pixels, coverage = context.render(light, moment, samples, seed_of_moment, LIGHT_FRAME[options.setting], camera)
        total = total + pixels / film.SUBFRAMES
        layers = np.stack([coverage, 0 * coverage], -1)
        if context.layers is not None:
            layers = pathtracer.layer_coverage(context.layers, moment.T_cam_obj, camera, samples=LAYER_SAMPLES // 4)
        visible = visible + layers / film.SUBFRAMES
    _write_layers(context.out / "truth", "film_", frame, visible)
    _write_srgb(context.out / film.FRAMES_FOLDER / frame.name, total)


def _place_surroundings(context: _RenderContext, frame: _Frame) -> None:
    """Move hand and background to where they are on a training frame."""
    if context.surroundings is not None:
        hand, background = context.surroundings.at(frame.time, frame.T_cam_obj)
        for scene in (context.scenes[SURROUNDED], context.layers):
            pathtracer.move(scene, hand | background)


def _write_layers(truth: Path, prefix: str, frame: _Frame, visible: np.ndarray) -> None:
    """Write the masks of visible object and hand; `visible` is the fraction of each pixel that each covers."""
    for i, name in enumerate(("object_mask", "hand_mask")):
        mask = np.where(visible[..., i : i + 1] > 0.5, 255, 0).astype(np.uint8)
        files.write_png(truth / f"{prefix}{name}" / frame.name, mask)


def _render_truth(context: _RenderContext, frame: _Frame, seed: int) -> np.ndarray:
    """Write maps and relit images of an evaluation view; returns the fraction of each pixel that the object covers."""
    options, truth, exr = context.options, context.out / "truth", Path(frame.name).with_suffix(".exr").name
    maps = pathtracer.maps(context.unlit, frame.T_cam_obj, context.camera, samples=MAP_SAMPLES)
    for name in _map_names(options):
        files.write_exr(truth / name / exr, getattr(maps, name), half=name != "depth")
    for light in (name for name in context.scenes if name not in ("", PROBE, SURROUNDED)):
        pixels, _ = context.render(light, frame, options.truth_samples, seed, "object")
        _write_srgb(truth / "relit" / light / frame.name, pixels)
    return maps.coverage


def _map_names(options: SynthOptions) -> tuple[str, ...]:
    """The ground-truth maps of the capture: a Lambertian surface has no roughness, and no dielectric metalness."""
    left_out = {"diffuse": ("roughness", "metalness"), "original": ("metalness",)}.get(options.material, ())
    return tuple(name for name in MAPS if name not in left_out)


def _write_srgb(path: Path, radiance: np.ndarray) -> None:
    files.write_png(path, to_srgb8(torch.from_numpy(radiance)).numpy())


# Documents ------------------------------------------------------------------------------------------------------------


def _write_documents(context: _RenderContext, frames: list[_Frame], lights: dict[str, Path]) -> None:
    """Write truth/poses.json and transforms.json. They come last: a folder without them is not a valid capture."""
    options = context.options
    training = [frame for frame in frames if frame.region is None]
    files.write_json(context.out / "truth" / "poses.json", {frame.name: _matrix(frame) for frame in training})
    entries = [
        training_frame(
            f.name,
            None if options.pose_free else _matrix(f),
            None if f.light_turn is None else f.light_turn.tolist(),
        )
        for f in training
    ]
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

    Raises:
        BadFile: A folder of the sweep holds something else; nothing is rendered then.
        ValueError: A roughness is out of range, or two would have the same folder; nothing is rendered then.
    """
    if not roughness_sweep:
        return [render_capture(model, out, options)]
    captures = {out / f"r{value:.2f}": dataclasses.replace(options, roughness=value) for value in roughness_sweep}
    if len(captures) < len(roughness_sweep):
        raise ValueError(f"the roughnesses {roughness_sweep} must differ in their first two decimals")
    for folder in captures:
        outputs.claim_folder(folder, SETTINGS_FILE, fix="choose another folder with -o")
    return [render_capture(model, folder, each) for folder, each in captures.items()]
