"""Score a prediction folder (docs/prediction.md) against the truth of a capture: report.json and sheet.png.

Keys of the report read `part.metric_where_space`, as in `albedo.psnr_fg_srgb`; `PROTOCOLS` says what each means, and
docs/metrics.md why. The number of a region is the mean of its views' numbers; regions are never mixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble import __version__
from tumble.datasets import which
from tumble.evaluation import lpips, metrics, score_sheet
from tumble.evaluation.prediction import Prediction
from tumble.io import BadFile, files
from tumble.scene import REGIONS, UNKNOWN, Capture, Truth

SMALLEST = 11
"""Least height and width of a capture that can be scored [pixels]."""
TOLERANCE_METRES, TOLERANCE_SHARE = 0.1, 0.1
"""Position error at which a frame is worth nothing: 10 cm, or without metres 10 % of the mean camera distance."""
PARTS = ("capture", "prediction")
"""Folders of a run that go by its name."""
IDENTITY = 1e-3
"""Change of scale, angle [radians] and shift [mean camera distances] under which poses were already aligned."""

_VIEWS = "per view; a region's number is the mean over its views"
PROTOCOLS = {
    "psnr_fg_linear": f"PSNR [dB], peak 1, foreground pixels only, linear values clipped to [0, 1], {_VIEWS}",
    "psnr_full_linear": f"PSNR [dB], peak 1, all pixels over black, linear values clipped to [0, 1], {_VIEWS}",
    "psnr_fg_linear_unscaled": f"as psnr_fg_linear, without the albedo scale, {_VIEWS}",
    "psnr_fg_srgb": f"PSNR [dB], peak 1, foreground pixels only, sRGB, {_VIEWS}",
    "psnr_full_srgb": f"PSNR [dB], peak 1, all pixels over black, sRGB, {_VIEWS}",
    "ssim_full_srgb": f"SSIM, Gaussian window 11 x 11 (sigma 1.5), windows inside the picture, RGB, {_VIEWS}",
    "ssim_crop_srgb": f"as ssim_full_srgb, on the foreground's bounding box and {metrics.CROP_MARGIN} px, {_VIEWS}",
    "lpips_full_srgb": f"LPIPS v0.1, whole picture over black, sRGB, {_VIEWS}",
    "lpips_crop_srgb": f"LPIPS v0.1, foreground's bounding box and {metrics.CROP_MARGIN} px, sRGB, {_VIEWS}",
    "mean_fg_degrees": f"mean angular error [degrees], foreground pixels only, {_VIEWS}",
    "median_fg_degrees": f"median angular error [degrees], foreground pixels only, {_VIEWS}",
    "mean_all_degrees": f"mean angular error [degrees], all pixels, background counted as 0, {_VIEWS}",
    "rmse_fg": f"root mean square error of perceptual roughness, foreground pixels only, {_VIEWS}",
    "iou": f"intersection over union of silhouettes, unknown pixels left out, {_VIEWS}",
    "rmse_clip10": "root mean square error of radiance on a 32 x 64 grid, weighted by solid angle, the prediction "
    "divided by the albedo scale, then both clipped at 10",
    "rmse_clip10_unweighted": "as rmse_clip10, every texel alike",
    "log_correlation": "Pearson correlation of log luminance on a 32 x 64 grid, weighted by solid angle, unclipped",
    "ate": "root mean square error of camera positions after a Sim(3) alignment on all posed training frames "
    "[capture units]",
    "auc_percent": "mean over training frames of max(0, 1 - position error / tolerance), lost frames worth 0 [%]",
    "rpe_translation": "mean translation error of the motion between neighbouring frames, after Sim(3) [capture units]",
    "rpe_rotation_degrees": "mean rotation error of the motion between neighbouring frames [degrees]",
    "rotation_mean_degrees": "mean rotation error after a rotation-only alignment (chordal mean) [degrees]",
    "rotation_median_degrees": "median rotation error after a rotation-only alignment (chordal mean) [degrees]",
    "rotation_below_2_percent": "training frames with a rotation error below 2 degrees, lost frames wrong [%]",
    "rotation_below_5_percent": "training frames with a rotation error below 5 degrees, lost frames wrong [%]",
    "rotation_below_10_percent": "training frames with a rotation error below 10 degrees, lost frames wrong [%]",
    "rotation_longest_run_percent": "most training frames in a row with a rotation error below 10 degrees [% of all]",
}
PREFIXES = {
    "albedo": "predicted albedo times albedo_scale (per channel, median of truth / prediction over all foregrounds); "
    "cut at the predicted silhouette, except for fg",
    "relit": "pictures as the prediction holds them, rendered with albedo times albedo_scale (docs/prediction.md)",
    "image": "views under the capture's own light, albedo and light as estimated",
    "normal": "shading normals, true object frame",
    "silhouette": "predicted silhouette: mask/, else where the predicted albedo is not black",
}


class Report(TypedDict):
    """All scores of one prediction, as `report.json` holds them; docs/metrics.md says what each number means."""

    tumble: str
    prediction: str
    capture: dict[str, Any]
    albedo_scale: list[float] | None
    """Per channel; None where there is no albedo to compare."""
    regions: dict[str, dict[str, float]]
    """Means over the evaluation views of each region, by key."""
    light: dict[str, Any]
    poses: dict[str, Any]
    views: list[dict[str, Any]]
    """The numbers of each view."""
    protocol: dict[str, str]
    """What each number means, by key."""
    notes: list[str]
    """What could not be scored, and how views were aligned."""


@dataclass(frozen=True)
class Subject:
    """A capture with the truth that predictions about it are scored against."""

    path: Path
    capture: Capture
    truth: Truth


def read_subject(path: Path) -> Subject:
    """Read a capture that can be scored, in any layout of `datasets`.

    Raises:
        BadFile: A file breaks a rule, or there is no truth.
    """
    reader = which(path)
    capture, truth = reader.load(path), reader.load_truth(path)
    if truth is None:
        raise BadFile(path, "has no truth to score against", "no evaluation views, no true light, no true poses")
    if min(capture.camera.height, capture.camera.width) < SMALLEST:
        raise BadFile(path, f"has pictures smaller than {SMALLEST} x {SMALLEST}", "SSIM has no window to fit in")
    return Subject(path, capture, truth)


def score(
    prediction: Path,
    capture: Path | Subject,
    out: Path,
    *,
    vgg: Path | None = None,
    notes: Sequence[str] = (),
) -> Report:
    """Score a prediction against the truth of a capture; write report.json and sheet.png, and return the report.

    Args:
        prediction: Folder of docs/prediction.md. What it lacks is noted in the report and not scored.
        capture: Where the capture with its truth is, or what `subject` read there.
        out: Folder for report.json and sheet.png; made when it is not there, and untouched when anything fails.
        vgg: LPIPS weights of VGG-16 (.npz or .safetensors); adds `lpips_*_vgg` to the AlexNet numbers.
        notes: Sentences that belong into the report, on how the prediction was made.

    Raises:
        BadFile: A file of either folder breaks a rule, or the capture has no truth.
    """
    known = read_subject(capture) if isinstance(capture, Path) else capture
    predicted = Prediction.read(prediction, known.capture, known.truth)
    networks = [lpips.read()] + ([lpips.read(vgg)] if vgg else [])
    scores = compare(predicted, known.capture, known.truth, networks)
    scores["notes"] = [*notes, *scores["notes"]]
    report = {"tumble": __version__, "prediction": _called(prediction), "capture": _about(known), **scores}
    picture = score_sheet.draw(report, predicted, known.truth)
    files.write_png(out / "sheet.png", picture)
    files.write_json(out / "report.json", report)
    return cast(Report, report)


@torch.no_grad()
def compare(predicted: Prediction, capture: Capture, truth: Truth, networks: Sequence[lpips.Network]) -> dict[str, Any]:
    """All scores of a prediction: by region, light, poses, by view; with their protocols and notes on what is absent.

    Args:
        networks: For LPIPS, one or more.
    """
    notes = _absences(predicted, truth)
    scale = _scale(predicted, truth, notes)
    rows = [_view_scores(i, predicted, truth, scale, networks) for i in range(len(truth))]
    light: dict[str, Any] = {}
    if predicted.light is not None and truth.light is not None:
        light = metrics.light_scores(predicted.light, truth.light, torch.ones(3) if scale is None else scale)
    scores = {
        "albedo_scale": None if scale is None else scale.tolist(),
        "regions": {region: _mean([rows[i] for i in truth.views(region)]) for region in REGIONS if truth.views(region)},
        "light": {f"light.{key}": value for key, value in light.items()},
        "poses": _pose_scores(predicted, capture, truth, notes),
    }
    keys = {key for part in (*scores["regions"].values(), scores["light"], scores["poses"]) for key in part}
    return {
        **scores,
        "views": [
            {"name": name, "region": region, **row}
            for name, region, row in zip(truth.names, truth.regions, rows, strict=True)
        ],
        "protocol": {key: text for key in sorted(keys) if (text := protocol(key))},
        "notes": notes,
    }


def protocol(key: str) -> str | None:
    """What a number of the report means, by its key; None for counts and settings."""
    part, _, metric = key.rpartition(".")
    part = part.partition(".")[0]
    network = next((name for name in lpips.PLANS if metric.endswith(f"_{name}")), None)
    text = PROTOCOLS.get(metric.removesuffix(f"_{network}"))
    if text is None:
        return None
    sentences = [PREFIXES.get(part, ""), f"{network} features" if network else "", text]
    return "; ".join(sentence for sentence in sentences if sentence)


def _called(path: Path) -> str:
    """A folder's name, or that of the run which it is a part of."""
    path = path.resolve()
    return path.parent.name if path.name in PARTS and path.parent.name else path.name


def _about(known: Subject) -> dict[str, Any]:
    """What was scored: facts of the capture, none of them about the machine."""
    capture, truth = known.capture, known.truth
    return {
        "name": _called(known.path),
        "setting": truth.setting,
        "light": capture.light,
        "units": truth.units,
        "width": capture.camera.width,
        "height": capture.camera.height,
        "frames": len(capture),
        "views": {region: len(truth.views(region)) for region in REGIONS},
    }


def _absences(predicted: Prediction, truth: Truth) -> list[str]:
    """One sentence for each part that cannot be scored."""
    parts = {
        "albedo": (predicted.albedo, truth.albedo),
        "normal": (predicted.normals, truth.normals),
        "roughness": (predicted.roughness, truth.roughness),
        "image": (predicted.images, truth.images if len(truth) else None),
        "light": (predicted.light, truth.light),
        "poses": (predicted.poses, truth.poses),
        **{
            f"relit/{name}": (predicted.relit.get(name), truth.relit.get(name))
            for name in sorted({*predicted.relit, *truth.relit})
        },
    }
    notes = []
    for name, (of_prediction, of_truth) in parts.items():
        if of_prediction is None and of_truth is not None:
            notes.append(f"{name}: not scored, absent from the prediction")
        if of_truth is None and of_prediction is not None:
            notes.append(f"{name}: not scored, the capture has no truth for it")
    return notes


def _scale(predicted: Prediction, truth: Truth, notes: list[str]) -> Float[Tensor, "3"] | None:
    if predicted.albedo is None or truth.albedo is None:
        if predicted.light is not None and truth.light is not None:
            notes.append("light: compared as it is, for without albedo there is no albedo scale")
        return None
    try:
        return metrics.albedo_scale(predicted.albedo, truth.albedo, truth.foreground)
    except ValueError as error:
        notes.append(f"albedo: compared as it is; {error}")
        return torch.ones(3)


def _view_scores(
    i: int,
    predicted: Prediction,
    truth: Truth,
    scale: Float[Tensor, "3"] | None,
    networks: Sequence[lpips.Network],
) -> dict[str, float]:
    """Every score of one view, by key."""
    foreground, counted = truth.foreground[i], truth.masks[i] != UNKNOWN
    scores: dict[str, float] = {}

    def add(part: str, values: dict[str, float]) -> None:
        scores.update({f"{part}.{key}": value for key, value in values.items()})

    def pictures(x: Tensor, y: Tensor) -> dict[str, float]:
        return metrics.image_scores(x[i] / 255, y[i] / 255, foreground, counted, networks)

    if predicted.albedo is not None and truth.albedo is not None and scale is not None:
        assert predicted.silhouettes is not None, "albedo tells where the object is"
        maps = (predicted.albedo[i], truth.albedo[i], predicted.silhouettes[i])
        add("albedo", metrics.albedo_scores(*maps, scale, foreground, counted, networks))
    if predicted.normals is not None and truth.normals is not None:
        add("normal", metrics.normal_scores(predicted.normals[i], truth.normals[i], foreground, counted))
    if predicted.roughness is not None and truth.roughness is not None:
        add("roughness", {"rmse_fg": metrics.rmse(predicted.roughness[i], truth.roughness[i], foreground)})
    if predicted.silhouettes is not None:
        add("silhouette", {"iou": metrics.iou(predicted.silhouettes[i], foreground, counted)})
    if predicted.images is not None:
        add("image", pictures(predicted.images, truth.images))
    lights = sorted({*predicted.relit} & {*truth.relit})
    by_light = [pictures(predicted.relit[light], truth.relit[light]) for light in lights]
    for light, values in zip(lights, by_light, strict=True):
        add(f"relit.{light}", values)
    if by_light:
        add("relit", _mean(by_light))
    return scores


def _pose_scores(predicted: Prediction, capture: Capture, truth: Truth, notes: list[str]) -> dict[str, Any]:
    """Scores of the estimated training poses that have a true one, with the alignment that was found."""
    if predicted.poses is None or truth.poses is None:
        return {}
    places = truth.posed(capture)
    shared = [i for i, name in enumerate(predicted.pose_names) if name in places]
    if len(shared) < 2:
        notes.append("poses: not scored, one pose is always right after alignment")
        return {}
    number = {name: i for i, name in enumerate(places)}
    names = [predicted.pose_names[i] for i in shared]
    frames, lost = [number[name] for name in names], len(places) - len(shared)
    poses, true = predicted.poses.select(shared), truth.poses.select([places[name] for name in names])
    distance = float(torch.linalg.vector_norm(truth.poses.camera_positions, dim=-1).mean())
    tolerance = TOLERANCE_METRES if truth.units == "m" else TOLERANCE_SHARE * distance
    try:
        alignment = metrics.align(poses, true)
        aligned = alignment.to_truth(poses)
        positions: dict[str, Any] = metrics.position_scores(aligned, true, tolerance=tolerance, lost=lost)
        positions["alignment"] = _describe(alignment, distance)
        scale = float(alignment.scale)
    except ValueError as reason:
        notes.append(f"poses: positions not scored; {reason}")
        positions, scale = {"ate": None, "auc_percent": None, "alignment": None}, None
    scores = {
        "posed_frames": len(shared),
        "lost_frames": lost,
        "tolerance": tolerance,
        **positions,
        **metrics.relative_scores(poses, true, frames, scale=scale),
        **metrics.rotation_scores(poses, true, frames, lost=lost),
    }
    return {f"poses.{key}": value for key, value in scores.items()}


def _describe(alignment: metrics.Similarity, distance: float) -> dict[str, Any]:
    angle = float(alignment.R_true_pred.angle())
    off = max(abs(float(alignment.scale) - 1), angle, float(alignment.shift.norm()) / distance)
    return {
        "scale": float(alignment.scale),
        "rotation_degrees": float(np.degrees(angle)),
        "shift": alignment.shift.tolist(),
        "identity": off < IDENTITY,
    }


def _mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean of each number over rows that have the same keys."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
