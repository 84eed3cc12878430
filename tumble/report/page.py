"""The report of a run: one HTML file that is complete in itself and loads nothing.

Every picture, the object, the lights and the scripts are embedded; a content security policy in the page forbids the
rest. It shows what was found and how far to trust it, and never reads the truth of a capture.
"""

import base64
import html
import json
import math
import re
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch.nn.functional import normalize

from tumble import __version__
from tumble.datasets import which
from tumble.engine import run
from tumble.export import Preset, confidence_of, extract_mesh, write_textured_mesh
from tumble.io import BadFile, files
from tumble.maths import fibonacci_sphere
from tumble.poses import PoseQuality, PoseResult
from tumble.report import figures, health_card, preset_lights, svg, training_views
from tumble.report.training_views import RenderedFrame
from tumble.scene import Asset, Capture, Environment, opengl_from_opencv

PAIRS, VIEWS = 6, 4
"""Frames shown beside their renders, and views of the maps."""
MESH = Preset(triangles=12_000, texture=1024, cells=192, views=48, pixels=512)
"""Of the object in the page: about two megabytes."""
SECTIONS: dict[str, str] = {
    "relight": "Relight",
    "frames": "Input against render",
    "maps": "Material",
    "light": "Light and motion",
    "health": "Health",
    "confidence": "Confidence",
    "timings": "Timings",
    "configuration": "Configuration",
}


@dataclass(frozen=True)
class Story:
    """What is known of how a run went."""

    name: str
    """Of the object, or of the run."""
    records: Sequence[dict[str, Any]]
    """Lines of the run's log."""
    recipe: dict[str, Any]
    """Settings by stage."""
    guess: float | None = None
    """The capture's focal length where it is a guess [pixels]."""


def write_report(out: Path, *, capture: Path | None = None) -> Path:
    """Write `report.html` into a finished run's folder; returns its path.

    Args:
        capture: Where the capture is now, if not where the run found it.

    Raises:
        BadFile: The run is not finished, or its capture is gone, or `capture` is not that of the run.
    """
    asset, path = run.asset(out, Asset), capture or run.source(out)
    if not path.exists():
        raise BadFile(path, "is the run's capture and is gone", "say where it is: --capture")
    whole = which(path).load(path)
    taken = of_run(whole, asset, list(files.read_json(out / run.POSES)), path)
    tracked = run.output(out, run.TRACK, PoseResult)
    name = out.resolve().name if path.name == run.CAPTURE else path.stem
    guess = float(whole.camera.fx_fy_cx_cy[0]) if whole.focal_guessed else None
    story = Story(name, run.records(out), run.recipe(out), guess)
    with tempfile.TemporaryDirectory() as folder:
        glb = model(asset, Path(folder))
        build(asset, taken, glb, story, tracked.quality if tracked else None, out / run.REPORT)
    return out / run.REPORT


def of_run(capture: Capture, asset: Asset, names: Sequence[str], path: Path) -> Capture:
    """The frames of a capture that a run used, in the run's order.

    Raises:
        BadFile: They are not all there.
    """
    places = {name: place for place, name in enumerate(capture.names)}
    size = (asset.camera.height, asset.camera.width)
    if not set(names) <= places.keys() or tuple(capture.images.shape[1:3]) != size:
        raise BadFile(path, "is not the capture of this run", "say which it is: --capture")
    index = [places[name] for name in names]
    return Capture(capture.images[index], capture.masks[index], asset.camera, tuple(names), capture.light)


def model(asset: Asset, folder: Path) -> Path | None:
    """A small GLB of the asset in a folder; None where the Gaussians show no surface, or xatlas is not installed."""
    try:
        shape = extract_mesh(asset, MESH)
    except ValueError:
        return None
    try:
        write_textured_mesh(asset, shape, MESH, 1.0, folder / "asset.glb")
    except ModuleNotFoundError as error:
        warnings.warn(f"{error}; the report shows no mesh", stacklevel=2)
        return None
    return folder / "asset.glb"


@torch.no_grad()
def build(
    asset: Asset, capture: Capture, glb: Path | None, story: Story, quality: PoseQuality | None, out: Path
) -> list[health_card.Row]:
    """Write the page; returns the health card that it shows.

    Args:
        asset: With material and light, on the CPU.
        capture: Its training frames, in the order of the asset's trajectory.
        glb: The object for the live view, which is left out without one.
        quality: Of the poses, where they were estimated.
    """
    scene = training_views.scene(asset)
    frames = list(training_views.frames(scene, capture))
    chosen = figures.spread(asset, frames, PAIRS)
    views = chosen[:VIEWS]
    seen = confidence_of(asset, figures.small_camera(asset.camera))
    rows = health_card.card(frames, quality, seen)
    verdict, word, sentence = health_card.overall(rows)
    hero = figures.hero(scene, views[0])
    parts = {
        "name": html.escape(story.name),
        "verdict": verdict,
        "verdict_word": word,
        "verdict_sentence": html.escape(sentence),
        "hero": figures.webp(hero),
        "facts": _facts(asset, capture, story),
        "links": "".join(
            f'<a href="#{key}">{words}</a>' for key, words in SECTIONS.items() if glb is not None or key != "relight"
        ),
        "pairs": "".join(figures.pair(frame) for frame in sorted(chosen, key=lambda frame: frame.number)),
        "maps": figures.maps(asset, views),
        "panorama": figures.webp(figures.panorama(_environment(asset), 256)),
        "light_caption": LIGHT_CAPTIONS[asset.trajectory.light],
        "path": svg.globes(asset.trajectory.camera_positions.cpu().numpy()),
        "path_caption": _path_caption(asset),
        "health_lead": f"Measured on all {len(frames)} training frames, without any truth: the finished asset is "
        "rendered again at every pose and compared with the photograph.",
        "health": "".join(_row(row) for row in rows),
        "confidence": figures.confidence(asset, views, seen),
        "timings": _timings(story.records),
        "configuration": _configuration(story.recipe),
        "version": __version__,
        "css": _read("page.css"),
        "relight": "" if glb is None else _fill(_read("panel.html"), {"lights": _buttons(asset, views[0])}),
        "scripts": "" if glb is None else _scripts(asset, views[0], glb.read_bytes()),
    }
    page = _fill(_read("page.html"), parts)
    files.write_whole(out, lambda partial: partial.write_text(page, "utf-8"))
    return rows


# The page -------------------------------------------------------------------------------------------------------------


def _read(name: str) -> str:
    return (resources.files("tumble.report") / "assets" / name).read_text("utf-8")


def _fill(template: str, parts: dict[str, str]) -> str:
    """The template with every `{{name}}` replaced at once: what is put in is not looked at again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template)


def _facts(asset: Asset, capture: Capture, story: Story) -> str:
    seconds = sum(_seconds(story.records).values())
    camera = asset.camera
    focal = float(camera.fx_fy_cx_cy[0])
    said = "" if story.guess is None else ", a guess"
    said = f" (estimated; the guess was {story.guess:.0f})" if story.guess not in (None, focal) else said
    facts = {
        "Frames": f"{len(capture)}",
        "Size": f"{camera.width} x {camera.height}",
        "Focal length": f"{focal:.0f} pixels{said}",
        "Light stands still with": {"camera": "the camera", "object": "the object"}[asset.trajectory.light],
        "Gaussians": f"{len(asset.gaussians):,}".replace(",", " "),
        "Time": _duration(seconds) if seconds else "-",
    }
    return "".join(f"<div><dt>{key}</dt><dd>{value}</dd></div>" for key, value in facts.items())


# Light and motion -----------------------------------------------------------------------------------------------------

LIGHT_CAPTIONS = {
    "camera": "The recovered light, tone-mapped. Its centre lies behind the object as the camera sees it, its left and "
    "right edges behind the camera, its top above. What never shone on the object is a guess.",
    "object": "The recovered light, tone-mapped, in the object's axes: its centre is -z, its right quarter +x, its top "
    "+y. What never shone on the object is a guess.",
}


def _environment(asset: Asset) -> Environment:
    return asset.environment


def _path_caption(asset: Asset) -> str:
    d = normalize(asset.trajectory.camera_positions, dim=-1)
    touched = len((d @ fibonacci_sphere(64).to(d).T).argmax(-1).unique())
    return (
        "Where the camera stood about the object, in the object's own axes, from two opposite sides; blue is the first "
        f"frame, orange the last. The {len(d)} frames touch {touched} of 64 equal parts of the sphere."
    )


# Tables ---------------------------------------------------------------------------------------------------------------


def _row(row: health_card.Row) -> str:
    return (
        f'<div class="row {row.verdict}"><span class="mark {row.verdict}">{health_card.WORDS[row.verdict]}</span>'
        f"<div><small>{row.name}</small><b>{row.value}</b></div><p>{html.escape(row.sentence)}</p>"
        f'<div class="bars">{svg.bars(row.bars, row.marks)}</div></div>'
    )


def _seconds(records: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Seconds of every finished stage, in order."""
    return {record["name"]: record["seconds"] for record in records if record.get("event") == "done"}


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _timings(records: Sequence[dict[str, Any]]) -> str:
    done = _seconds(records)
    if not done:
        return '<p class="lead">No finished stage is in the log.</p>'
    lines = ""
    for name, seconds in done.items():
        steps = [record for record in records if record.get("name") == name and record.get("metrics")]
        values = [record["metrics"]["render"] for record in steps if record["metrics"].get("render") is not None]
        count = steps[-1]["of"] if steps else "-"
        lines += (
            f'<tr><td>{html.escape(name)}</td><td class="n">{count}</td><td class="n">{_duration(seconds)}</td>'
            f'<td class="curve">{svg.curve(values)}</td></tr>'
        )
    total = f'<tr><th>all</th><td></td><td class="n"><b>{_duration(sum(done.values()))}</b></td><td></td></tr>'
    head = '<tr><th>stage</th><th class="n">steps</th><th class="n">time</th><th>photometric loss</th></tr>'
    return f'<div class="wide"><table>{head}{lines}{total}</table></div>'


def _configuration(recipe: dict[str, Any]) -> str:
    single = {key: value for key, value in recipe.items() if not isinstance(value, dict)}
    tables = {key: value for key, value in recipe.items() if isinstance(value, dict)}
    return "".join(
        f"<details><summary>{html.escape(name)}</summary><table>"
        + "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in _flat(settings))
        + "</table></details>"
        for name, settings in {**tables, **({"run": single} if single else {})}.items()
    )


def _flat(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    lines = []
    for key, value in settings.items():
        nested = isinstance(value, dict)
        lines += _flat(value, f"{prefix}{key}.") if nested else [(prefix + key, json.dumps(value))]
    return lines


# The live view --------------------------------------------------------------------------------------------------------


def _shown_lights(asset: Asset, frame: RenderedFrame) -> dict[str, tuple[str, Environment]]:
    """The lights of the live view by key, with their names; axes are the camera's of a frame, x right, y up."""
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


def _buttons(asset: Asset, frame: RenderedFrame) -> str:
    return "".join(
        f'<button type="button" data-light="{key}" aria-pressed="false">'
        f'<img src="{figures.webp(figures.panorama(light, 64))}" alt="">'
        f"{name}</button>"
        for key, (name, light) in _shown_lights(asset, frame).items()
    )


def _rgbe(light: Environment) -> bytes:
    pixels = light.radiance.detach().cpu().numpy().astype(np.float32)
    return cv2.imencode(".hdr", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()


def _scripts(asset: Asset, frame: RenderedFrame, glb: bytes) -> str:
    pose = asset.trajectory.T_cam_obj[frame.number].rotation
    # From OpenCV to OpenGL axes is half a turn about x: (w, x, y, z) -> (-x, w, -z, y), here written x, y, z, w.
    w, x, y, z = pose.wxyz.tolist()
    camera = asset.camera
    fov = math.degrees(2 * math.atan(0.5 * camera.height / float(camera.fx_fy_cx_cy[1])))
    about = {"fov": fov, "object_to_camera": [w, -z, y, -x]}
    parts = {"glb": glb} | {key: _rgbe(light) for key, (_, light) in _shown_lights(asset, frame).items()}
    embedded = "".join(
        f'<script type="text/plain" id="{key}">{base64.b64encode(data).decode()}</script>\n'
        for key, data in parts.items()
    )
    return (
        f'<script type="application/json" id="about">{json.dumps(about)}</script>\n{embedded}'
        f"<script>{_read('three.js')}</script>\n<script>{_read('panel.js')}</script>"
    )
