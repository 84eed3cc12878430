"""What is done with a finished asset, and with the run that holds one: render, relight, film, export, score.

Functions of an `Asset` are for notebooks; those whose names end in `_run` find all they need in a run directory, and
write into it.
"""

import hashlib
import itertools
import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float
from rich.progress import track
from torch import Tensor

from tumble import pipeline
from tumble.engine import run
from tumble.evaluation import Report, Subject, align_views, predict_views, read_subject, score
from tumble.export import PresetName, write_asset
from tumble.io import files, named, video
from tumble.maths import SE3, to_srgb8
from tumble.preprocess import PROVENANCE, FootageOptions, pick_box
from tumble.recipes import Recipe
from tumble.rendering import Buffers, antialiased, usable_device
from tumble.rendering import relight as relighting
from tumble.report import write_report
from tumble.scene import Asset, Camera, Capture, Environment, Trajectory

LIGHT_NOTE = "light.json"
"""In a folder of relit pictures: which light they show."""
FILM_FRAMES, FILM_SIDE, FILM_ELEVATION = 90, 384, math.radians(20)
"""Of a turntable film: three seconds, its longer side [pixels], and how far the camera looks down [radians]."""


# Assets ---------------------------------------------------------------------------------------------------------------


def render(asset: Asset, T_cam_obj: SE3 | int = 0, camera: Camera | None = None) -> Buffers:
    """Draw an asset's maps: albedo and roughness (`features`), normals, depth and coverage.

    Args:
        T_cam_obj: The object's pose, or the number of a training frame whose pose it is.
        camera: The capture's when None.
    """
    pose = asset.trajectory.T_cam_obj[T_cam_obj] if isinstance(T_cam_obj, int) else T_cam_obj
    return antialiased(asset, pose, camera or asset.camera)


def relight(
    asset: Asset,
    light: Environment | Path | str,
    trajectory: Trajectory | None = None,
    camera: Camera | None = None,
    *,
    cfg: relighting.Config | None = None,
    fast: bool = False,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """Draw an asset under another light, view by view: linear radiance over black.

    Args:
        light: In the frame in which it stands still, or the path of a lat-long .hdr or .exr.
        trajectory: Poses, and what the light stands still with; when None those of the training frames, with the light
            standing still with the object.
        camera: The capture's when None.
        cfg: How many rays.
        fast: Prefiltered light without shadows, instead of rays.
    """
    environment = light if isinstance(light, Environment) else Environment.read(Path(light))
    trajectory = trajectory or Trajectory(asset.trajectory.T_cam_obj, "object")
    draw = relighting.preview if fast else relighting.relight
    return draw(cfg or relighting.Config(), asset, environment, trajectory, camera or asset.camera)


def export_asset(
    asset: Asset,
    folder: Path | str,
    preset: PresetName = "web",
    *,
    names: list[str] | None = None,
    scale_mm: float | None = None,
) -> Path:
    """Write an asset for other programs (docs/export.md): textured GLB, Gaussian PLYs, light, poses.

    Args:
        preset: web: 20k triangles, 2k textures; game: 8k, 1k; film: 50k, 4k; splat: the Gaussians alone.
        names: Of the training frames; their numbers when None.
        scale_mm: The largest distance between two points of the object, as a ruler finds it [mm]: files in metres.
    """
    names = names or [f"{number:04}.png" for number in range(len(asset.trajectory))]
    write_asset(asset, names, Path(folder), preset, scale_mm)
    return Path(folder)


def evaluate(
    asset: Asset,
    capture: Path | str,
    *,
    names: tuple[str, ...] | None = None,
    poses_given: bool = True,
    out: Path | str | None = None,
    cfg: relighting.Config | None = None,
) -> Report:
    """Score an asset against a capture's truth (docs/metrics.md).

    Args:
        capture: A capture with truth.
        names: Training frames of the asset's trajectory, in order; all of the capture's when None.
        poses_given: Whether the asset's poses are those of the capture; else both are aligned first.
        out: Folder for the prediction, `report.json` and `sheet.png`. None keeps nothing.
        cfg: How many rays relit pictures take.
    """
    known = read_subject(Path(capture))
    names = names or known.capture.names
    aligned = align_views(asset.trajectory, names, known.capture, known.truth, given=poses_given)
    with tempfile.TemporaryDirectory() as scratch:
        where = Path(out or scratch)
        return _scored(asset, known, aligned, names, where, where, cfg or relighting.Config())


def _scored(
    asset: Asset,
    known: Subject,
    aligned: tuple[Any, str],
    names: tuple[str, ...],
    folder: Path,
    where: Path,
    cfg: relighting.Config,
) -> Report:
    """Render a prediction into `folder/prediction`, and score it into `where`."""
    alignment, words = aligned
    answer = predict_views(cfg, asset, known.capture, known.truth, alignment, names=names)
    answer.write(folder / run.PREDICTION)
    return score(folder / run.PREDICTION, known, where, notes=[words])


# Runs -----------------------------------------------------------------------------------------------------------------


def finished(out: Path) -> Asset:
    """The asset of a finished run.

    Raises:
        BadFile: There is none.
    """
    return run.asset(out, Asset)


def run_capture(
    path: Path,
    out: Path,
    recipe: Recipe,
    options: FootageOptions,
    *,
    poses: Literal["given", "estimate"] = "given",
    pick: bool = False,
    device: str = "cpu",
) -> Path:
    """Reconstruct a capture, or footage that becomes one, in a run directory, and write its report; returns the page.

    Args:
        path: A film, pictures, or a capture.
        options: How footage becomes a capture.
        pick: Ask a person in the browser where the object is.

    Raises:
        ValueError: There is no such matcher or device.
        BadFile: As `pipeline.ingested` and `pipeline.reconstruct`.
    """
    place = usable_device(device)
    named("matching", recipe.matcher)  # before a film is cut up for it
    options = pick_box(path, options, out / run.CAPTURE) if pick else options
    capture = pipeline.ingested(path, out, options)
    pipeline.reconstruct(capture, out, recipe, poses=poses, device=place)
    return write_report(out, capture=capture)


def evaluate_folder(prediction: Path, capture: Path | None = None, out: Path | None = None) -> Report:
    """Score a prediction folder, or a run, which is rendered first.

    Raises:
        ValueError: A prediction folder does not say which capture it answers.
    """
    if (prediction / run.ASSET).is_file():
        return evaluate_run(prediction, capture, out)
    if capture is None:
        raise ValueError(f"{prediction} is no finished run: name the capture that it answers, after it")
    return score(prediction, capture, out or prediction)


def evaluate_run(out: Path, capture: Path | None = None, where: Path | None = None) -> Report:
    """Render a finished run's answer for a capture and score it.

    A run that found its poses, or had them from COLMAP, has an object frame of its own: it is aligned first.

    Args:
        capture: With truth; where the run found its own when None.
        where: Folder for `report.json` and `sheet.png`; the run directory when None.

    Raises:
        BadFile: There is no finished run in `out`, or the capture has no truth.
    """
    asset = finished(out)
    known = read_subject(capture or run.source(out))
    names = source_names(out, known.capture)
    own_frame = (out / run.TRACK).is_dir() or (out / run.CAPTURE / PROVENANCE).is_file()
    given = known.capture.trajectory is not None and not own_frame
    lens = _lens(out, asset, known.capture)
    training = asset.trajectory, names, known.capture, known.truth
    aligned = align_views(*training, given=given, lens=lens)
    return _scored(asset, known, aligned, names, out, where or out, _relighting(out))


def _lens(out: Path, asset: Asset, capture: Capture) -> float:
    """The capture's focal length over the run's, in the same pixels; 1 of a film whose focal length is no guess."""
    focal, _, cx, _ = asset.camera.fx_fy_cx_cy.tolist()
    whole, note = asset.camera.width, out / run.CAPTURE / PROVENANCE
    if note.is_file():
        said = files.read_json(note)
        if said.get("focal_source") != "guess":
            return 1.0
        # The lens of a film looks through its middle, of which the run's pictures are a window.
        _, left, _, width = said["window_top_left_height_width"]
        whole = 2 * (cx + left * asset.camera.width / width)
    return float(capture.camera.fx_fy_cx_cy[0]) / (focal * capture.camera.width / whole)


def source_names(out: Path, capture: Capture) -> tuple[str, ...]:
    """Names in a capture of the frames of a run, in order: those of a film are found by their numbers."""
    names, note = tuple(files.read_json(out / run.POSES)), out / run.CAPTURE / PROVENANCE
    if not note.is_file():
        return names
    numbers = {said["name"]: said.get("source_frame", len(capture)) for said in files.read_json(note)["frames"]}
    return tuple(capture.names[i] if (i := numbers.get(name, len(capture))) < len(capture) else name for name in names)


def relight_run(out: Path, env: Path, pictures: Path | None = None, *, fast: bool, exposure: float = 0.0) -> Path:
    """Write a run's object under another light as `0000.png`, ..., one per training frame; returns their folder.

    The light's frame is the object's.

    Args:
        pictures: None: `RUN/relit/<name of the light>`, or with a number where another light has that name.
        exposure: How much brighter the pictures are than the light makes them [stops].

    Raises:
        BadFile: There is no finished run in `out`, or the light cannot be read.
    """
    asset = finished(out)
    views = relight(asset, env, cfg=_relighting(out), fast=fast)
    pictures = pictures or _relit_folder(out, env)
    n = len(asset.trajectory)
    for number, linear in enumerate(track(views, f"relighting under {env.stem}", n, transient=True)):
        files.write_png(pictures / f"{number:04}.png", to_srgb8(2**exposure * linear).numpy())
    return pictures


def _relit_folder(out: Path, env: Path) -> Path:
    content = hashlib.sha256(env.read_bytes()).hexdigest()
    for number in itertools.count(1):
        folder = out / run.RELIT / (env.stem if number == 1 else f"{env.stem}-{number}")
        note = folder / LIGHT_NOTE
        if not note.is_file() or files.read_json(note).get("sha256") == content:
            files.write_json(note, {"light": str(env.resolve()), "sha256": content})
            return folder
    raise AssertionError("numbers do not end")


def relight_turntable(out: Path, env: Path, film: Path, *, fast: bool, exposure: float = 0.0) -> Path:
    """Write a film of a run's object that turns once about its +y axis under another light; returns its path.

    Light and camera stand still; at the first frame the light's frame is the object's.

    Args:
        exposure: How much brighter the frames are than the light makes them [stops].

    Raises:
        BadFile: There is no finished run in `out`, or the light cannot be read.
    """
    asset, light, cfg = finished(out), Environment.read(env), _relighting(out)
    # A film hides the noise of a quarter of the rays.
    cfg = replace(cfg, brdf_samples=-(-cfg.brdf_samples // 4), light_samples=-(-cfg.light_samples // 4))
    R_gl_obj, turning = relighting.turntable(asset.trajectory, FILM_FRAMES, FILM_ELEVATION)
    # A run's pictures are a window of its film's; here the object turns in their middle. H.264 wants even sides.
    camera = asset.camera.centred()
    scale = FILM_SIDE / max(camera.height, camera.width)
    camera = camera.resized(*(2 * round(side * scale / 2) for side in (camera.height, camera.width)))
    views = relight(asset, light.rotated(R_gl_obj), turning, camera, cfg=cfg, fast=fast)
    frames = track(views, f"turning under {env.stem}", FILM_FRAMES, transient=True)
    video.write_clip(film, (to_srgb8(2**exposure * linear).cpu().numpy() for linear in frames))
    return film


def export_run(out: Path, folder: Path | None, preset: PresetName, scale_mm: float | None) -> Path:
    """Write a run's object for other programs; returns the folder, `RUN/export/PRESET` when None.

    Raises:
        BadFile: There is no finished run in `out`.
    """
    if scale_mm is not None and not 0 < scale_mm < 1e6:
        raise ValueError(f"--scale-mm is out of range: {scale_mm:g}; give millimetres above 0")
    folder = folder or out / run.EXPORT / preset
    return export_asset(finished(out), folder, preset, names=list(files.read_json(out / run.POSES)), scale_mm=scale_mm)


def _relighting(out: Path) -> relighting.Config:
    """The run's own way to relight."""
    return relighting.Config(**run.recipe(out)["relight"])
