"""Report of a run: one self-contained HTML file with results, quality measures and a live relighting view.

All images, the mesh, the lights and the scripts are embedded; a content security policy in the page forbids loading
anything else, and any script but these. Names, log and settings of a run may come from somebody else: the templates in
`assets/` escape every value that is not `Markup`. The report never uses the ground truth of a capture.
"""

import base64
import hashlib
import json
import math
import tempfile
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import torch
from markupsafe import Markup
from torch.nn.functional import normalize

from tumble import __version__
from tumble.datasets import reader_for
from tumble.engine import run
from tumble.export import Preset, confidence_of, extract_mesh, write_textured_mesh
from tumble.io import BadFile, begin, files, outputs, progress, tree
from tumble.maths import fibonacci_sphere
from tumble.poses import PoseQuality, PoseResult, background_removal
from tumble.preprocess import read_provenance
from tumble.report import coverage, figures, health_card, preset_lights, svg, training_views, worst_frames
from tumble.report.training_views import RenderedFrame
from tumble.report.worst_frames import AllFrames
from tumble.scene import Asset, Capture, Environment, content_key, opengl_from_opencv

N_COMPARISONS = 6
"""Number of photos shown beside their renders."""
N_VIEWS = 4
"""Number of views of the material and confidence maps."""
MESH = Preset(triangles=12_000, texture=1024, cells=192, views=48, pixels=512)
"""Settings of the mesh in the page, about two megabytes."""
SECTIONS: dict[str, str] = {
    "relight": "Relight",
    "frames": "Photos and renders",
    "maps": "Material",
    "light": "Light and motion",
    "coverage": "Coverage",
    "health": "Health",
    "worst": "Worst frames",
    "confidence": "Confidence",
    "timings": "Timings",
    "configuration": "Configuration",
}
"""Title of each section, by the id of its element."""

TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("tumble.report", "assets"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
"""Templates of the page."""


@dataclass(frozen=True)
class RunSummary:
    """Name, log and settings of a run."""

    name: str
    """Name of the object or the run."""
    records: Sequence[dict[str, Any]]
    """Records of the run's log."""
    recipe: dict[str, Any]
    """Settings by stage."""
    assumed_focal: float | None = None
    """The capture's focal length if it was assumed, else None [pixels]."""
    exposure_corrected: bool = False
    """Whether the capture was made from footage, whose exposure is measured on the background and corrected."""


def write_report(out: Path, *, capture: Path | None = None, device: torch.device | str = "cpu") -> Path:
    """Write `report.html` into a finished run's folder; returns its path.

    Args:
        capture: Path of the run's capture, if it was moved since the run.
        device: Where the views are rendered.

    Raises:
        BadFile: The run is not finished, its capture is missing, or `capture` is not the capture of the run.
        OSError: The folder cannot be written.
    """
    asset, path = run.asset(out, Asset), capture or run.existing_capture(out)
    outputs.require_writable(out)
    used = capture_of_run(out, asset, path)
    made = read_provenance(path) if path.is_dir() else None
    hand_coloured = {frame.name: frame.hand_coloured for frame in made.frames} if made else {}
    name = (out if path.name == run.CAPTURE else path).resolve().name
    assumed_focal = float(used.whole.camera.fx_fy_cx_cy[0]) if used.whole.focal_assumed else None
    corrected = made is not None and made.window_top_left_height_width is not None
    summary = RunSummary(name, run.log_records(out), run.recipe(out), assumed_focal, corrected)
    with tempfile.TemporaryDirectory() as folder:
        asset = tree.to(asset, device)
        quality = used.tracked.quality if used.tracked else None
        all_frames = AllFrames(used.whole, used.masked, hand_coloured)
        with ThreadPoolExecutor(1) as beside:
            # The mesh is made by one thread most of the time.
            model = begin(beside, asset.gaussians.means.device, lambda: write_model(asset, Path(folder), used.frames))
            build(asset, used.frames, model, summary, quality, out / run.REPORT, all_frames=all_frames)
    return out / run.REPORT


@dataclass(frozen=True)
class RunCapture:
    """The capture of a run."""

    whole: Capture
    """As it was read."""
    tracked: PoseResult | None
    """The poses that stage 1 found; None if they came with the capture."""
    masked: Capture
    """With the masks that stages 2 and 3 have seen."""
    frames: Capture
    """Its frames that have a pose, in the order of the asset's trajectory."""


def capture_of_run(out: Path, asset: Asset, path: Path) -> RunCapture:
    """Read the capture of a finished run from its path.

    Raises:
        BadFile: It cannot be read, or is not the capture of the run, or has changed since.
    """
    whole, known = reader_for(path).load(path), run.frames_key(out)
    if known and content_key(replace(whole, trajectory=None)) != known:
        rule = "is not the capture of this run, or its images, masks or camera have changed since"
        raise BadFile(path, rule, "run the capture again, or give `tumble report` the right one with --capture")
    tracked, masked = background_removal.stored_result(out, whole)
    frames = frames_of_run(masked, asset, run.frame_names(out, len(asset.trajectory)), path)
    return RunCapture(whole, tracked, masked, frames)


def frames_of_run(capture: Capture, asset: Asset, names: Sequence[str], path: Path) -> Capture:
    """The frames of a capture that a run used, in the run's order.

    Raises:
        BadFile: Frames of the run are missing, or their size differs.
    """
    index_of = {name: i for i, name in enumerate(capture.names)}
    size = (asset.camera.height, asset.camera.width)
    if not set(names) <= index_of.keys() or tuple(capture.images.shape[1:3]) != size:
        raise BadFile(path, "is not the capture of this run", "give the right one with --capture")
    index = [index_of[name] for name in names]
    return Capture(capture.images[index], capture.masks[index], asset.camera, tuple(names), capture.light)


def write_model(asset: Asset, folder: Path, capture: Capture) -> Path | None:
    """Write a small GLB of the asset to a folder; None if the Gaussians have no surface or xatlas is not installed.

    Args:
        capture: The frames of the asset's trajectory.
    """
    try:
        shape = extract_mesh(asset, MESH, capture)
    except ValueError:
        return None
    try:
        write_textured_mesh(asset, shape, MESH, folder / "asset.glb", capture)
    except ModuleNotFoundError as error:
        warnings.warn(f"{error}; the report has no live view without a mesh", stacklevel=2)
        return None
    return folder / "asset.glb"


@torch.no_grad()
def build(
    asset: Asset,
    capture: Capture,
    model: Callable[[], Path | None],
    summary: RunSummary,
    quality: PoseQuality | None,
    out: Path,
    *,
    all_frames: AllFrames | None = None,
) -> list[health_card.Row]:
    """Write the page; returns the rows of its health card.

    Args:
        asset: Asset with material and light.
        capture: The asset's training frames, in the order of its trajectory.
        model: Returns a GLB for the live view when it is needed; without one the live view is left out.
        quality: Quality of the poses, if they were estimated.
        all_frames: The frames of `capture` and those without a pose; None if all have one.
    """
    scene = training_views.prepare(asset)
    frames = list(progress.track(training_views.frames(scene, capture), "report: training views", len(capture)))
    selected = figures.select_diverse(asset, frames, N_COMPARISONS)
    views = selected[:N_VIEWS]
    confidence = confidence_of(asset, figures.small_camera(asset.camera))
    deviation = _colour_deviation(summary.records)
    rows = health_card.card(frames, quality, confidence, deviation, corrected=summary.exposure_corrected)
    rating, word, sentence = health_card.overall(rows)
    covered = coverage.coverage_of(asset, capture)
    told = coverage.advice(covered, light_turns=asset.trajectory.light == "camera")
    n_lost = len(all_frames.before) - len(capture) if all_frames else 0
    said = _what_to_record(told.sentence, quality, n_lost)
    progress.LOG.info(said)
    hero = figures.hero_image(scene, views[0])
    comparisons = [figures.comparison(frame) for frame in sorted(selected, key=lambda frame: frame.number)]
    maps, of_confidence = figures.material_maps(asset, views), figures.confidence_maps(asset, views, confidence)
    glb = model()
    lights = {} if glb is None else _live_view_lights(asset, views[0])
    page = TEMPLATES.get_template("page.html").render(
        summary=summary,
        rating=rating,
        rating_word=word,
        rating_sentence=sentence,
        hero=figures.webp(hero),
        facts=_facts(asset, capture, summary),
        sections={key: title for key, title in SECTIONS.items() if glb is not None or key != "relight"},
        comparisons=comparisons,
        maps=maps,
        panorama=figures.webp(figures.panorama(_environment(asset), 256)),
        light_caption=LIGHT_CAPTIONS[asset.trajectory.light],
        path=svg.globes(asset.trajectory.camera_positions.cpu().numpy()),
        path_caption=_path_caption(asset),
        advice=said,
        region="" if told.region is None else figures.webp(figures.region_image(asset, covered, told.region)),
        sides=coverage.by_side(covered),
        n_frames=len(frames),
        rows=[(row, health_card.RATING_LABELS[row.rating], svg.bars(row.bars, row.marks)) for row in rows],
        worst=figures.worst_frames(worst_frames.worst_frames(all_frames or AllFrames(capture, capture), frames)),
        confidence=of_confidence,
        timings=_timings(summary.records),
        configuration=_configuration(summary.recipe),
        version=__version__,
        css=style_sheet(),
        buttons=[(key, name, figures.webp(figures.panorama(light, 64))) for key, (name, light) in lights.items()],
        live_view=None if glb is None else _live_view(asset, views[0], glb.read_bytes(), lights),
    )
    files.write_atomically(out, lambda partial: partial.write_text(page, "utf-8"))
    return rows


# The page -------------------------------------------------------------------------------------------------------------


def style_sheet() -> Markup:
    """Style sheet of the page, for other pages that look like it."""
    return _own("page.css")


def _own(name: str) -> Markup:
    """A file of the package that is inserted as it is."""
    return Markup((resources.files("tumble.report") / "assets" / name).read_text("utf-8"))


def _what_to_record(sentence: str, quality: PoseQuality | None, n_lost: int) -> str:
    """The advice on what to record again, with how far it can be trusted."""
    if quality is not None and quality.rating == "bad":
        sentence = f"The poses are not reliable, so this may be wrong: {sentence[0].lower()}{sentence[1:]}"
    uncounted = "A frame without a pose is" if n_lost == 1 else f"{n_lost} frames without a pose are"
    return f"{sentence} {uncounted} not counted." if n_lost else sentence


def _colour_deviation(records: Sequence[dict[str, Any]]) -> Sequence[float]:
    """Standard deviation of the albedo's scale per channel, as the run logged it last; empty if it did not."""
    estimates = [r["deviation"] for r in records if r.get("event") == "colour" and "deviation" in r]
    return estimates[-1] if estimates else ()


def _facts(asset: Asset, capture: Capture, summary: RunSummary) -> dict[str, str]:
    """Short facts at the top of the page, by title."""
    seconds = sum(_seconds(summary.records).values())
    camera = asset.camera
    focal = float(camera.fx_fy_cx_cy[0])
    source = "" if summary.assumed_focal is None else ", assumed"
    source = (
        f" (estimated; {summary.assumed_focal:.0f} was assumed at the start)"
        if summary.assumed_focal not in (None, focal)
        else source
    )
    return {
        "Frames": f"{len(capture)}",
        "Size": f"{camera.width} x {camera.height}",
        "Focal length": f"{focal:.0f} pixels{source}",
        "Light is fixed to": {"camera": "the camera", "object": "the object"}[asset.trajectory.light],
        "Gaussians": f"{len(asset.gaussians):,}".replace(",", " "),
        "Time": _duration(seconds) if seconds else "-",
    }


# Light and motion -----------------------------------------------------------------------------------------------------

LIGHT_CAPTIONS = {
    "camera": "The recovered light as a panorama, tone-mapped. The centre shows what is behind the object as seen from "
    "the camera, the left and right edges what is behind the camera, the top what is above. Directions from which no "
    "light reached the object are not reliable.",
    "object": "The recovered light as a panorama, tone-mapped, in the object's axes: the centre is -z, the right "
    "quarter is +x, the top is +y. Directions from which no light reached the object are not reliable.",
}
"""Caption of the panorama, by the frame to which the light is fixed."""


def _environment(asset: Asset) -> Environment:
    return asset.environment


def _path_caption(asset: Asset) -> str:
    d = normalize(asset.trajectory.camera_positions, dim=-1)
    covered = len((d @ fibonacci_sphere(64).to(d).T).argmax(-1).unique())
    return (
        "Directions from which the camera saw the object, in the object's axes, on a globe drawn from two opposite "
        f"sides. Blue is the first frame, orange the last. The {len(d)} frames cover {covered} of 64 equal parts of it."
    )


# Tables ---------------------------------------------------------------------------------------------------------------


def _seconds(records: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Duration of every finished stage, in order [s]."""
    return {r["name"]: r["seconds"] for r in records if r.get("event") == "done" and {"name", "seconds"} <= r.keys()}


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _timings(records: Sequence[dict[str, Any]]) -> list[tuple[str, str, str, Markup]]:
    """Name, number of steps, duration and loss curve of every finished stage, and their sum; empty without any."""
    done = _seconds(records)
    steps_of: dict[str, list[dict[str, Any]]] = {name: [] for name in done}
    for record in records:
        if record.get("metrics") and record.get("name") in done:
            steps_of[record["name"]].append(record)
    lines = []
    for name, seconds in done.items():
        steps = steps_of[name]
        values = [record["metrics"]["render"] for record in steps if record["metrics"].get("render") is not None]
        lines.append((name, str(steps[-1].get("of", "-")) if steps else "-", _duration(seconds), svg.curve(values)))
    return [*lines, ("all", "", _duration(sum(done.values())), Markup(""))] if lines else []


def _configuration(recipe: dict[str, Any]) -> dict[str, list[tuple[str, str]]]:
    """Names and values of the settings, by stage."""
    single = {key: value for key, value in recipe.items() if not isinstance(value, dict)}
    tables = {key: value for key, value in recipe.items() if isinstance(value, dict)}
    return {name: _flat(settings) for name, settings in {**tables, **({"run": single} if single else {})}.items()}


def _flat(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    lines = []
    for key, value in settings.items():
        nested = isinstance(value, dict)
        lines += _flat(value, f"{prefix}{key}.") if nested else [(prefix + key, json.dumps(value))]
    return lines


# The live view --------------------------------------------------------------------------------------------------------


def _live_view_lights(asset: Asset, frame: RenderedFrame) -> dict[str, tuple[str, Environment]]:
    """Name and light of each button of the live view, by key, in a frame's camera axes (OpenGL: x right, y up)."""
    recovered = _environment(asset)
    if asset.trajectory.light == "object":
        R_cam_obj = asset.trajectory.T_cam_obj[frame.number].rotation.matrix()
        recovered = recovered.rotated(opengl_from_opencv(R_cam_obj) @ R_cam_obj)
    return {
        "recovered": ("Recovered", recovered),
        "studio": ("Studio", preset_lights.studio()),
        "overcast": ("Overcast", preset_lights.overcast()),
        "sunset": ("Sunset", preset_lights.sunset()),
    }


def _rgbe(light: Environment) -> bytes:
    pixels = light.radiance.detach().cpu().numpy().astype(np.float32)
    return cv2.imencode(".hdr", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()


def _live_view(
    asset: Asset, frame: RenderedFrame, glb: bytes, lights: dict[str, tuple[str, Environment]]
) -> dict[str, Any]:
    """Settings, data by the id of its element, and scripts of the live view."""
    pose = asset.trajectory.T_cam_obj[frame.number].rotation
    # From OpenCV to OpenGL axes: rotation by pi about x, (w, x, y, z) -> (-x, w, -z, y); three.js orders x, y, z, w.
    w, x, y, z = pose.wxyz.tolist()
    camera = asset.camera
    fov = math.degrees(2 * math.atan(0.5 * camera.height / float(camera.fx_fy_cx_cy[1])))
    parts = {"glb": glb} | {key: _rgbe(light) for key, (_, light) in lights.items()}
    return {
        "about": {"fov": fov, "object_to_camera": [w, -z, y, -x]},
        "parts": {key: base64.b64encode(data).decode() for key, data in parts.items()},
        "scripts": {script_hash(script): script for script in (_own("three.js"), _own("panel.js"))},
    }


def script_hash(script: str) -> str:
    """Hash of a script as a content security policy writes it."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}"
