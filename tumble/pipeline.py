"""From a capture folder to an asset: the stages in order, kept in a run directory."""

import hashlib
import itertools
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from rich.progress import track

from tumble import matching
from tumble.datasets import which
from tumble.engine import run
from tumble.evaluation import evaluate, render_prediction
from tumble.export import asset as export
from tumble.inverse_rendering import decompose, mean_colour_baseline, refine
from tumble.io import files, tree, video
from tumble.io.files import BadFile
from tumble.maths.images import photograph
from tumble.poses.frame_pairs import neighbours
from tumble.poses.progressive import stage as progressive
from tumble.poses.result import Health
from tumble.poses.sfm import stage as graph
from tumble.poses.sfm.finalize import Tracked
from tumble.preprocess import colmap_to_capture, footage, video_to_capture
from tumble.preprocess.survey import Options
from tumble.recipes import Recipe, known_poses
from tumble.rendering import relight
from tumble.scene.asset import Asset
from tumble.scene.capture import Capture
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Trajectory

ASSET, POSES = "asset.safetensors", "poses.json"
PREDICTION = "prediction"
RELIT, LIGHT_NOTE = "relit", "light.json"
LEAST_TRACKED = 8
"""A capture of which fewer frames have a pose shows too little of the object."""
FILM_FRAMES, FILM_SIDE, FILM_ELEVATION = 90, 384, math.radians(20)
"""Of a turntable film: three seconds, its longer side [pixels], and how far the camera looks down [radians]."""


def ingested(path: Path, out: Path, options: Options) -> Path:
    """The capture folder to reconstruct: `path` itself, or what became of footage, in the run directory.

    Raises:
        BadFile: The footage cannot become a capture, or `out` holds that of other footage or of other options.
    """
    with_model = colmap_to_capture.recognises(path)
    if not with_model and not footage.is_footage(path):
        return path
    made = out / run.CAPTURE
    with run.alone(out):
        if not made.exists():
            return (colmap_to_capture.capture_from_model if with_model else video_to_capture.capture_from_video)(
                path, made, options
            )
    note = made / video_to_capture.PROVENANCE
    found, wanted = files.read_json(note) if note.exists() else {}, video_to_capture.origin(path, options)
    different = [line for name in wanted for line in run.differences(found.get(name), wanted[name], name)]
    if different:
        rule = f"holds the capture of another film, or one made in another way: {'; '.join(different)}"
        raise BadFile(out, rule, "choose another folder with -o, or remove this one")
    return made


def reconstruct(
    capture_path: Path,
    out: Path,
    recipe: Recipe,
    *,
    poses: Literal["given", "estimate"] = "given",
    device: torch.device | str = "cpu",
) -> Asset:
    """Run all stages on a capture; finished ones are taken from `out`. Truth is never read.

    Writes `asset.safetensors`, `light.exr` and `poses.json` beside the stages' own folders. Frames whose pose is lost
    are left out of all that follows stage 1.

    Args:
        poses: given: those of the capture, which stay as they are, where it has any; estimate: never those.
        device: Of stages 2 and 3. The asset that is returned is on the CPU.

    Raises:
        BadFile: The capture breaks a rule or cannot be tracked, or `out` holds another run.
        NotFinite: Training met a NaN; names the tensor, the step and the state that is kept.
    """
    capture = which(capture_path).load(capture_path)
    if poses == "estimate":
        capture = replace(capture, trajectory=None)
    with run.alone(out):
        return _reconstruct(capture, capture_path, out, recipe, device)


def _reconstruct(capture: Capture, capture_path: Path, out: Path, recipe: Recipe, device: torch.device | str) -> Asset:
    content = run.capture_key(capture)
    opened = run.open(out, capture_path, recipe, content=content)
    trajectory, keys = capture.trajectory, [content]
    if trajectory is None:
        tracked, key = _track(opened, capture, capture_path, content)
        kept = torch.where(~tracked.health.lost)[0].tolist()
        trajectory, keys = tracked.trajectory.select(kept), [key]
        capture = replace(capture.select(kept), camera=tracked.camera)
    else:
        recipe = known_poses(recipe)
    capture, trajectory = tree.to(capture, device), tree.to(trajectory, device)
    refined = run.stage(opened, 2, "refine", refine, recipe.refine, refine.Inputs(capture, trajectory), keys)
    keys = [run.key("refine", refine.VERSION, recipe.refine, keys)]
    last = mean_colour_baseline if isinstance(recipe.decompose, mean_colour_baseline.Config) else decompose
    asset = run.stage(opened, 3, "decompose", last, recipe.decompose, decompose.Inputs(capture, refined), keys)
    asset = tree.to(asset, "cpu")
    _keep(asset, capture, out)
    return asset


def _track(opened: run.Run, capture: Capture, capture_path: Path, content: str) -> tuple[Tracked, str]:
    """Stage 1: match, then find all poses; also the key of the result."""
    if len(capture) < LEAST_TRACKED:
        rule = f"has {len(capture)} frames: too few to find how the object moved"
        raise BadFile(capture_path, rule, f"film more of it: at least {LEAST_TRACKED} frames, better 40 to 100")
    recipe = opened.recipe
    route = graph if isinstance(recipe.track, graph.Config) else progressive
    near = neighbours(len(capture))
    matches = matching.match_pairs(
        matching.views_of(capture), near, recipe.matcher, cache=opened.path / "1-track" / "matches"
    )
    try:
        inputs = route.gather(capture, matches)
    except ValueError as error:
        raise BadFile(capture_path, str(error), "give masks that show the object") from None
    keys = [content, matching.settings(recipe.matcher)]
    tracked = run.stage(opened, 1, "track", route, recipe.track, inputs, keys)
    health = tracked.health
    lost = int(health.lost.sum())
    about = {"lost": lost, "verdict": health.verdict, "axis": health.observability.sentence}
    run.log(opened, {"name": "track", "event": "health", **about, "degrees": math.degrees(health.uncertainty)})
    focal, guess = (float(camera.fx_fy_cx_cy[0]) for camera in (tracked.camera, capture.camera))
    if focal != guess:
        said = f"focal length {focal:.0f} pixels (estimated; the guess was {guess:.0f})"
        run.log(opened, {"name": "track", "event": "focal", "pixels": focal, "guess": guess, "said": said})
    if len(capture) - lost < LEAST_TRACKED:
        rule = f"could not be tracked: {lost} of {len(capture)} frames contradict the others"
        raise BadFile(capture_path, rule, "film an object with more texture or shape, in smaller turns")
    if health.verdict == "bad":
        warnings.warn(health.sentence, stacklevel=2)
    return tracked, run.key("track", route.VERSION, recipe.track, keys)


def _keep(asset: Asset, capture: Capture, out: Path) -> None:
    tree.save(asset, out / ASSET)
    assert asset.environment is not None, "stage 3 finds the light"
    asset.environment.write(out / "light.exr")
    poses = dict(zip(capture.names, asset.trajectory.camera_to_object().tolist(), strict=True))
    files.write_json(out / POSES, poses)


def health(out: Path) -> Health | None:
    """How far the poses of a run can be trusted; None where they were given."""
    tracked = out / "1-track" / run.OUT
    return tree.load(Tracked, tracked).health if tracked.is_file() else None


def predict_run(out: Path, capture_path: Path) -> Path:
    """Render a finished run's answer for a capture's evaluation views as `out/prediction`; returns that folder.

    Raises:
        BadFile: There is no finished run in `out`, or the capture has no truth.
    """
    finished(out)
    _predict(out, evaluate.subject(capture_path))
    return out / PREDICTION


def evaluate_run(out: Path, capture_path: Path, where: Path) -> dict[str, Any]:
    """Render a finished run's answer for a capture and score it; returns the report, which is written to `where`.

    Raises:
        BadFile: As `predict_run`.
    """
    finished(out)
    known = evaluate.subject(capture_path)
    return evaluate.run(out / PREDICTION, known, where, notes=[_predict(out, known)])


def _predict(out: Path, known: evaluate.Subject) -> str:
    """Write the prediction; returns how its views were aligned, in words.

    A run that found its poses, or had them from COLMAP, has an object frame of its own.
    """
    asset, names = finished(out), source_names(out, known.capture)
    own_frame = any(out.glob("1-*")) or (out / run.CAPTURE / video_to_capture.PROVENANCE).is_file()
    given = known.capture.trajectory is not None and not own_frame
    lens = _lens(out, asset, known.capture)
    alignment, words = render_prediction.aligned(
        asset.trajectory, names, known.capture, known.truth, given=given, lens=lens
    )
    cfg = _relighting(out)
    prediction = render_prediction.predict(cfg, asset, known.capture, known.truth, alignment, names=names)
    prediction.write(out / PREDICTION)
    return words


def _lens(out: Path, asset: Asset, capture: Capture) -> float:
    """The capture's focal length over the run's, in the same pixels; 1 of a film whose focal length is no guess."""
    focal, _, cx, _ = asset.camera.fx_fy_cx_cy.tolist()
    whole, note = asset.camera.width, out / run.CAPTURE / video_to_capture.PROVENANCE
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
    names, note = tuple(files.read_json(out / POSES)), out / run.CAPTURE / video_to_capture.PROVENANCE
    if not note.is_file():
        return names
    numbers = {said["name"]: said.get("source_frame", len(capture)) for said in files.read_json(note)["frames"]}
    return tuple(capture.names[i] if (i := numbers.get(name, len(capture))) < len(capture) else name for name in names)


def relight_run(out: Path, env: Path, pictures: Path | None = None, *, fast: bool, exposure: float = 0.0) -> Path:
    """Write a run's object under another light as `0000.png`, ..., one per training frame; returns their folder.

    The light's frame is the object's.

    Args:
        pictures: Left out: RELIT/<name of the light>, or with a number where another light has that name.
        exposure: How much brighter the pictures are than the light makes them [stops].

    Raises:
        BadFile: There is no finished run in `out`, or the light cannot be read.
    """
    asset, light, cfg = finished(out), Environment.read(env), _relighting(out)
    still = Trajectory(asset.trajectory.T_cam_obj, "object")
    draw = relight.preview if fast else relight.relight
    views = draw(cfg, asset, light, still, asset.camera)
    pictures = pictures or _relit_folder(out, env)
    for number, linear in enumerate(track(views, f"relighting under {env.stem}", len(still), transient=True)):
        files.write_png(pictures / f"{number:04}.png", photograph(2**exposure * linear).numpy())
    return pictures


def _relit_folder(out: Path, env: Path) -> Path:
    content = hashlib.sha256(env.read_bytes()).hexdigest()
    for number in itertools.count(1):
        folder = out / RELIT / (env.stem if number == 1 else f"{env.stem}-{number}")
        note = folder / LIGHT_NOTE
        if not note.is_file() or files.read_json(note).get("sha256") == content:
            files.write_json(note, {"light": str(env.resolve()), "sha256": content})
            return folder
    raise AssertionError("numbers do not end")


def film_run(out: Path, env: Path, film: Path, *, fast: bool, exposure: float = 0.0) -> None:
    """Write a film of a run's object that turns once about its +y axis under another light.

    Light and camera stand still; at the first frame the light's frame is the object's.

    Args:
        exposure: How much brighter the frames are than the light makes them [stops].

    Raises:
        BadFile: There is no finished run in `out`, or the light cannot be read.
    """
    asset, light, cfg = finished(out), Environment.read(env), _relighting(out)
    # A film hides the noise of a quarter of the rays.
    cfg = replace(cfg, brdf_samples=-(-cfg.brdf_samples // 4), light_samples=-(-cfg.light_samples // 4))
    R_gl_obj, turning = relight.turntable(asset.trajectory, FILM_FRAMES, FILM_ELEVATION)
    # A run's pictures are a window of its film's; here the object turns in their middle. H.264 wants even sides.
    camera = asset.camera.centred()
    scale = FILM_SIDE / max(camera.height, camera.width)
    camera = camera.resized(*(2 * round(side * scale / 2) for side in (camera.height, camera.width)))
    draw = relight.preview if fast else relight.relight
    views = draw(cfg, asset, light.rotated(R_gl_obj), turning, camera)
    frames = track(views, f"turning under {env.stem}", FILM_FRAMES, transient=True)
    video.write_clip(film, (photograph(2**exposure * linear).cpu().numpy() for linear in frames))


def export_run(out: Path, folder: Path, preset: export.Name, scale_mm: float | None) -> None:
    """Write a run's object for other programs: `export.export`.

    Raises:
        BadFile: There is no finished run in `out`.
    """
    asset = finished(out)
    export.export(asset, list(files.read_json(out / POSES)), folder, preset, scale_mm)


def finished(out: Path) -> Asset:
    """The asset of a finished run.

    Raises:
        BadFile: There is none.
    """
    if not (out / ASSET).is_file():
        raise BadFile(out, f"has no {ASSET}", "finish the run first: tumble run")
    return tree.load(Asset, out / ASSET)


def _relighting(out: Path) -> relight.Config:
    """The run's own way to relight."""
    return relight.Config(**files.read_json(out / run.RECIPE)["recipe"]["relight"])
