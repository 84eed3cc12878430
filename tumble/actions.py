"""Operations on a finished asset or run: render, relight, make a turntable video, export, evaluate.

Functions that take an `Asset` are for notebooks. Functions that take a run directory are the commands of the command
line: they read the asset from the run and write their output into it.
"""

import itertools
import math
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from tumble import __version__, pipeline
from tumble.engine import run
from tumble.evaluation import (
    SHEET,
    CaptureWithTruth,
    Prediction,
    Report,
    align_views,
    predict_views,
    read_with_truth,
    score,
    score_prediction,
)
from tumble.export import EXPORT_FILE, PresetName, write_asset
from tumble.glb_scores import score_glb
from tumble.io import BadFile, files, load_plugin, outputs, progress, tree, video
from tumble.maths import SE3, to_srgb8
from tumble.preprocess import PROVENANCE, FootageOptions, pick_box, read_provenance
from tumble.recipes import Recipe
from tumble.rendering import Buffers, antialiased_gbuffer, usable_device
from tumble.rendering import relight as relighting
from tumble.scene import Asset, Camera, Capture, Environment, Trajectory

LIGHT_FILE = "relight.json"
"""File in a folder of relit images that records the environment map and the frames, and by which the folder is
recognised."""
SCORES = Path("runs/evaluate")
"""Folder of the scores of prediction folders."""
GLB_SCORES = "glb"
"""Folder of a run for the scores of its exported GLB."""
MAX_RAYS = 1 << 16
"""Maximum number of rays per pixel."""
MAX_EXPOSURE = 32
"""Maximum exposure of relit images [stops]."""
TURNTABLE_FRAMES = 90
"""Frames of a turntable video: three seconds."""
TURNTABLE_SIDE = 384
"""Longer side of a turntable video [pixels]."""
TURNTABLE_ELEVATION = math.radians(20)
"""Elevation of the camera of a turntable video [radians]."""


# Assets ---------------------------------------------------------------------------------------------------------------


def render(asset: Asset, T_cam_obj: SE3 | int = 0, camera: Camera | None = None) -> Buffers:
    """Render the G-buffer of an asset: albedo and roughness (`features`), normals, depth and opacity.

    Args:
        T_cam_obj: Pose of the object, or the index of a training frame whose pose to use.
        camera: Default: the camera of the capture.
    """
    pose = asset.trajectory.T_cam_obj[T_cam_obj] if isinstance(T_cam_obj, int) else T_cam_obj
    return antialiased_gbuffer(asset, pose, camera or asset.camera)


def relight(
    asset: Asset,
    light: Environment | Path | str,
    trajectory: Trajectory | None = None,
    camera: Camera | None = None,
    *,
    cfg: relighting.Config | None = None,
    fast: bool = False,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """Render an asset under another light, view by view: linear radiance over black.

    Args:
        light: Environment map in the env frame of `trajectory`, or the path of an equirectangular .hdr or .exr file.
        trajectory: Poses to render. Default: those of the training frames, with the light fixed to the object.
        camera: Default: the camera of the capture.
        cfg: Numbers of rays.
        fast: Use prefiltered light without shadows instead of ray tracing.
    """
    environment = light if isinstance(light, Environment) else Environment.read(Path(light))
    trajectory = trajectory or Trajectory(asset.trajectory.T_cam_obj, "object")
    draw = relighting.preview if fast else relighting.relight
    place, camera = asset.gamma.device, camera or asset.camera
    environment, trajectory, camera = tree.to(environment, place), tree.to(trajectory, place), tree.to(camera, place)
    return draw(cfg or relighting.Config(), asset, environment, trajectory, camera)


def export_asset(
    asset: Asset,
    folder: Path | str,
    preset: PresetName = "web",
    *,
    names: list[str] | None = None,
    scale_mm: float | None = None,
    capture: Capture | None = None,
    overwrite: bool = False,
) -> Path:
    """Export an asset for other programs (docs/export.md): textured GLB, Gaussian PLYs, environment map, poses.

    Args:
        folder: Folder for the files; also returned.
        preset: web: 20k triangles, 2k textures; game: 8k, 1k; film: 50k, 4k; splat: Gaussians only.
        names: File names of the training frames. Default: their numbers.
        scale_mm: Largest distance between two points of the object, measured with a ruler [mm]; the files are then in
            metres.
        capture: The frames of the asset's trajectory. With them, the base colour of the mesh is solved from the
            photographs; otherwise it is baked from the Gaussians alone, which is blurred.
        overwrite: Write into the folder even if it holds something else than an earlier export.

    Raises:
        BadFile: The folder holds something else.
        ValueError: The capture has another number of frames than the trajectory.
    """
    if capture is not None and len(capture) != len(asset.trajectory):
        fix = "select those in the poses.json of the run: capture.select([...])"
        raise ValueError(f"the capture has {len(capture)} frames, the trajectory {len(asset.trajectory)}: {fix}")
    outputs.claim_folder(Path(folder), EXPORT_FILE, overwrite=overwrite)
    names = names or [f"{number:04}.png" for number in range(len(asset.trajectory))]
    write_asset(asset, names, Path(folder), preset, scale_mm, capture=capture)
    return Path(folder)


def evaluate(
    asset: Asset,
    capture: Path | str,
    *,
    names: tuple[str, ...] | None = None,
    poses_given: bool = True,
    out: Path | str | None = None,
    overwrite: bool = False,
    cfg: relighting.Config | None = None,
) -> Report:
    """Score an asset against the ground truth of a capture (docs/metrics.md).

    Args:
        capture: Path of a capture with ground truth.
        names: File names of the asset's training frames, in order. Default: all of the capture's.
        poses_given: Whether the asset's poses are those of the capture; otherwise the two are aligned first.
        out: Folder for the prediction, `report.json` and `sheet.png`. None saves nothing.
        overwrite: Write into the folder even if it holds something else than an earlier evaluation.
        cfg: Numbers of rays of relit images.

    Raises:
        BadFile: The capture has no ground truth, or the folder holds something else.
    """
    if out is not None:
        outputs.claim_folder(Path(out), SHEET, overwrite=overwrite)
    known = read_with_truth(Path(capture))
    names = names or known.capture.names
    aligned = align_views(asset.trajectory, names, known.capture, known.truth, known_poses=poses_given)
    with tempfile.TemporaryDirectory() as scratch:
        return _scored(asset, known, aligned, names, Path(out or scratch), cfg or relighting.Config())


def _scored(
    asset: Asset,
    known: CaptureWithTruth,
    aligned: tuple[Any, str],
    names: tuple[str, ...],
    out: Path,
    cfg: relighting.Config,
) -> Report:
    """Render a prediction into `out/prediction`, score it, and write the scores into `out`."""
    alignment, words = aligned
    place = asset.gamma.device
    capture, truth = tree.to(known.capture, place), tree.to(known.truth, place)
    prediction: Prediction = predict_views(cfg, asset, capture, truth, tree.to(alignment, place), names=names)
    return score_prediction(prediction, known, out, [words])


# Runs -----------------------------------------------------------------------------------------------------------------


def finished(out: Path, device: str = "cpu") -> Asset:
    """The asset of a finished run, on a device.

    Raises:
        BadFile: There is none.
        ValueError: There is no such device.
    """
    return tree.to(run.asset(out, Asset), usable_device(device))


def run_capture(
    path: Path,
    out: Path,
    recipe: Recipe,
    options: FootageOptions,
    *,
    poses: Literal["given", "estimate"] = "given",
    up: str = "auto",
    white: tuple[int, int, str] | None = None,
    pick: bool = False,
    device: str = "cpu",
) -> Path:
    """Reconstruct a capture or footage in a run directory and write the report; returns the path of the report.

    Args:
        path: A video, a folder of images, or a capture.
        options: How footage is converted to a capture.
        up: See `pipeline.reconstruct`.
        white: See `pipeline.reconstruct`.
        pick: Let the user draw a box around the object in the browser.

    Raises:
        ValueError: There is no such matcher, device, up direction or white pixel.
        BadFile: See `pipeline.capture_of` and `pipeline.reconstruct`.
    """
    from tumble.report import write_report

    place = usable_device(device)
    load_plugin("matching", recipe.matcher)  # fail before the video is converted
    options = pick_box(path, options, out / run.CAPTURE) if pick else options
    capture = pipeline.capture_of(path, out, options)
    pipeline.reconstruct(capture, out, recipe, poses=poses, up=up, white=white, device=place)
    return write_report(out, capture=capture, device=place)


def evaluate_folder(
    prediction: Path,
    capture: Path | None = None,
    out: Path | None = None,
    *,
    overwrite: bool = False,
    device: str = "cpu",
) -> Report:
    """Score a prediction folder, or a run, whose prediction is rendered first.

    Args:
        out: Folder for `report.json` and `sheet.png`, and for a run its `prediction/`. A run directory may be its
            own. Default: `score_folder`.
        overwrite: Write into `out` even if it holds something else than an earlier evaluation.

    Raises:
        ValueError: A prediction folder is given without its capture.
        BadFile: `out` holds something else, or is another run.
    """
    is_run, out = _is_run(prediction), out or score_folder(prediction)
    if not is_run and capture is None:
        raise ValueError(f"{prediction} is not a finished run: give the capture of the prediction as second argument")
    if not (is_run and out.resolve() == prediction.resolve()):
        if _is_run(out) and not overwrite:
            raise BadFile(out, "is a run, whose own scores these would replace", outputs.OTHER_PLACE)
        outputs.claim_folder(out, SHEET, overwrite=overwrite)
    if is_run or capture is None:
        return evaluate_run(prediction, capture, out, device=device)
    return score(prediction, capture, out)


def score_folder(prediction: Path) -> Path:
    """Default folder of scores: a run directory itself; for a prediction folder, which is an input, a new one."""
    return prediction if _is_run(prediction) else SCORES / prediction.resolve().name


def _is_run(path: Path) -> bool:
    """Whether a folder holds a finished run."""
    return (path / run.ASSET).is_file()


def evaluate_run(out: Path, capture: Path | None = None, where: Path | None = None, *, device: str = "cpu") -> Report:
    """Render a finished run's prediction for a capture and score it.

    A run with estimated poses, or with poses of COLMAP, has its own object frame and is aligned first.

    Args:
        capture: Capture with ground truth. Default: the capture of the run.
        where: Folder for `prediction/`, `report.json` and `sheet.png`. Default: the run directory.

    Raises:
        BadFile: There is no finished run in `out`, or the capture has no ground truth.
    """
    asset = finished(out, device)
    outputs.require_writable(where or out)
    known = read_with_truth(capture or run.existing_capture(out))
    names = source_names(out, known.capture)
    return _scored(asset, known, _aligned(out, asset, known), names, where or out, _relighting(out))


def evaluate_glb(
    out: Path, glb: Path, capture: Path | None = None, where: Path | None = None, *, overwrite: bool = False
) -> Report:
    """Score an exported GLB of a run in a capture's evaluation views, path traced by Mitsuba (extra `synth`).

    Args:
        glb: `asset.glb` in a folder of `export_run`.
        capture: Capture with ground truth. Default: the capture of the run.
        where: Folder for `prediction/`, `report.json` and `sheet.png`. Default: `RUN/glb`.
        overwrite: Write into `where` even if it holds something else than an earlier evaluation.

    Raises:
        BadFile: There is no finished run in `out`, the capture has no ground truth, the GLB cannot be read, or `where`
            holds something else.
        ModuleNotFoundError: Mitsuba is not installed.
    """
    asset, known = finished(out), read_with_truth(capture or run.existing_capture(out))
    where = where or out / GLB_SCORES
    outputs.claim_folder(where, SHEET, overwrite=overwrite)
    return score_glb(glb, asset, known, _aligned(out, asset, known), where)


def _aligned(out: Path, asset: Asset, known: CaptureWithTruth) -> tuple[Any, str]:
    """Result of `align_views` for a run's asset: a run with its own object frame is aligned."""
    names = source_names(out, known.capture)
    own_frame = not run.has_given_poses(out) or (out / run.CAPTURE / PROVENANCE).is_file()
    given = known.capture.trajectory is not None and not own_frame
    lens = _focal_ratio(out, asset, known.capture)
    # The capture and its truth are on the CPU, on whatever device the asset is.
    training = tree.to(asset.trajectory, "cpu"), names, known.capture, known.truth
    return align_views(*training, known_poses=given, focal_ratio=lens)


def _focal_ratio(out: Path, asset: Asset, capture: Capture) -> float:
    """Ratio of the capture's focal length to the run's, in the same pixels; 1 if the run's was given by the user."""
    focal, _, cx, _ = asset.camera.fx_fy_cx_cy.tolist()
    whole, made = asset.camera.width, read_provenance(out / run.CAPTURE)
    if made is not None:
        if made.focal_source != "guess" or made.window_top_left_height_width is None:
            return 1.0
        # The principal point is the centre of the video; the run's images are a window of it.
        _, left, _, width = made.window_top_left_height_width
        whole = 2 * (cx + left * asset.camera.width / width)
    return float(capture.camera.fx_fy_cx_cy[0]) / (focal * capture.camera.width / whole)


def source_names(out: Path, capture: Capture) -> tuple[str, ...]:
    """Names in a capture of the frames of a run, in order; frames of a video are identified by their numbers."""
    names, made = tuple(run.frame_names(out)), read_provenance(out / run.CAPTURE)
    if made is None:
        return names
    numbers = {frame.name: frame.source_frame for frame in made.frames}
    known = range(len(capture))
    return tuple(capture.names[i] if (i := numbers.get(name)) in known and i is not None else name for name in names)


def relight_run(
    out: Path,
    env: Path,
    images: Path | None = None,
    *,
    fast: bool,
    exposure: float = 0.0,
    overwrite: bool = False,
    device: str = "cpu",
) -> Path:
    """Render a run's object under another light, one image per training frame; returns the folder of the images.

    The light is fixed to the object. `relight.json` names the frame of each image. Of an interrupted output only the
    missing images are rendered.

    Args:
        images: Folder for `0000.png`, ... Default: `RUN/relit/<name of the map>`, numbered if another map has
            that name.
        exposure: Exposure of the images relative to the environment map [stops].
        overwrite: Write into `images` even if the folder holds something else than relit images.

    Raises:
        BadFile: There is no finished run in `out`, the light cannot be read, or `images` holds something else.
        ValueError: The exposure is out of range.
    """
    gain = _gain(exposure)
    asset, light = finished(out, device), Environment.read(env)
    sha256, n = files.sha256(env), len(asset.trajectory)
    images = images or _relit_folder(out, env.stem, sha256)
    outputs.claim_folder(images, LIGHT_FILE, overwrite=overwrite)
    about = {
        "light": str(env.resolve()),
        "sha256": sha256,
        "asset": files.sha256(out / run.ASSET),
        "fast": fast,
        "exposure": exposure,
        "images": n,
        "frames": run.frame_names(out, n),
        "tumble": __version__,
    }
    missing = _missing_images(images, about)
    if missing:
        files.write_json(images / LIGHT_FILE, about)
        poses = Trajectory(asset.trajectory.T_cam_obj, "object").select(missing)
        views = progress.track(
            relight(asset, light, poses, cfg=_relighting(out), fast=fast), f"relighting under {env.stem}", len(missing)
        )
        for number, linear in zip(missing, views, strict=True):
            files.write_png(images / f"{number:04}.png", to_srgb8(gain * linear).cpu().numpy())
    return images


def _missing_images(images: Path, about: dict[str, Any]) -> list[int]:
    """Numbers of the images to render: those that are missing of the same output, else all; earlier ones are removed.

    If the new ones are fewer, or the command is interrupted, the others would stay under the name of another light.

    Args:
        about: What `LIGHT_FILE` says of the output.
    """
    note, n = images / LIGHT_FILE, about["images"]
    earlier = files.read_json(note, dict[str, Any], f"remove {images}") if note.is_file() else {}
    if earlier | {"light": about["light"]} == about:  # the map may have been moved
        return [number for number in range(n) if not (images / f"{number:04}.png").is_file()]
    # Images with higher numbers may be the user's, who insisted on this folder.
    written = earlier.get("images")
    owned = max(n, written) if isinstance(written, int) else n
    for path in images.glob("[0-9][0-9][0-9][0-9]*.png"):
        if path.stem.isdecimal() and int(path.stem) < owned:
            with files.describe_write_errors(path):
                path.unlink()
    return list(range(n))


def _relit_folder(out: Path, name: str, sha256: str) -> Path:
    """The folder of a run for images under a light: that of the same light, or the next one that does not exist."""
    for number in itertools.count(1):
        folder = out / run.RELIT / (name if number == 1 else f"{name}-{number}")
        note = folder / LIGHT_FILE
        if not folder.exists():
            return folder
        if note.is_file() and files.read_json(note, dict[str, Any], f"remove {folder}").get("sha256") == sha256:
            return folder
    raise AssertionError("unreachable")


def relight_turntable(
    out: Path,
    env: Path,
    clip: Path,
    *,
    fast: bool,
    exposure: float = 0.0,
    overwrite: bool = False,
    device: str = "cpu",
) -> Path:
    """Render a turntable video of a run's object under another light; returns its path.

    The object makes one revolution about its +y axis; light and camera are fixed. In the first frame the light's frame
    is the object's.

    Args:
        clip: File to write; its extension tells the format.
        exposure: Exposure of the frames relative to the environment map [stops].
        overwrite: Replace the file if it exists.

    Raises:
        BadFile: There is no finished run in `out`, the light cannot be read, or `clip` exists or is no video file.
        ValueError: The exposure is out of range.
    """
    gain = _gain(exposure)
    outputs.claim_file(clip, video.CLIP_FORMATS, overwrite=overwrite)
    asset, cfg = finished(out, device), _relighting(out)
    light = tree.to(Environment.read(env), asset.gamma.device)
    # A quarter of the rays is enough: in a video the noise averages out over frames.
    cfg = replace(cfg, brdf_samples=-(-cfg.brdf_samples // 4), light_samples=-(-cfg.light_samples // 4))
    # The run's images are a window of the video; here the object is in the centre. H.264 needs even sides.
    camera = asset.camera.centred()
    R_gl_obj, turning = relighting.turntable(asset, camera, TURNTABLE_FRAMES, TURNTABLE_ELEVATION)
    scale = TURNTABLE_SIDE / max(camera.height, camera.width)
    camera = camera.resized(*(2 * round(side * scale / 2) for side in (camera.height, camera.width)))
    views = relight(asset, light.rotated(R_gl_obj), turning, camera, cfg=cfg, fast=fast)
    frames = progress.track(views, f"turning under {env.stem}", TURNTABLE_FRAMES)
    video.write_clip(clip, (to_srgb8(gain * linear).cpu().numpy() for linear in frames))
    return clip


def _gain(exposure: float) -> float:
    """Factor of an exposure [stops]."""
    if not abs(exposure) <= MAX_EXPOSURE:
        raise ValueError(f"--exposure is out of range: {exposure:g}; give -{MAX_EXPOSURE} to {MAX_EXPOSURE} stops")
    return 2.0**exposure


def export_run(
    out: Path,
    folder: Path | None,
    preset: PresetName,
    scale_mm: float | None,
    *,
    overwrite: bool = False,
    device: str = "cpu",
) -> Path:
    """Export a run's object for other programs; returns the folder, by default `RUN/export/PRESET`.

    Without the run's capture, which may have been moved since, the base colour is baked from the Gaussians alone.

    Raises:
        BadFile: There is no finished run in `out`, or `folder` holds something else than an export.
    """
    if scale_mm is not None and not 0 < scale_mm < 1e6:
        raise ValueError(f"--scale-mm is out of range: {scale_mm:g}; give millimetres above 0")
    folder = folder or out / run.EXPORT / preset
    asset = finished(out, device)
    names = run.frame_names(out, len(asset.trajectory))
    capture = None if preset == "splat" else _frames_of_run(out, asset)
    return export_asset(asset, folder, preset, names=names, scale_mm=scale_mm, capture=capture, overwrite=overwrite)


def _frames_of_run(out: Path, asset: Asset) -> Capture | None:
    """The frames of a run's trajectory, with its masks; None with a warning if the capture is gone or has changed."""
    from tumble.report import capture_of_run

    try:
        return capture_of_run(out, asset, run.existing_capture(out)).frames
    except BadFile as error:
        text = f"{error}; the base colour is baked from the Gaussians, not solved from the photographs"
        warnings.warn(text, stacklevel=3)
        return None


def _relighting(out: Path) -> relighting.Config:
    """The relighting settings of the run's recipe."""
    cfg = run.settings(out, "relight", relighting.Config)
    if not all(0 < n <= MAX_RAYS for n in (cfg.brdf_samples, cfg.light_samples, cfg.preview_directions)):
        raise BadFile(out / run.RECIPE, '"recipe.relight" has an impossible number of rays', f"the limit is {MAX_RAYS}")
    return cfg
