"""Scores of a prediction folder (docs/prediction.md) against a capture's ground truth: report.json and sheet.png.

Keys of the report have the form `part.metric_where_space`, as in `albedo.psnr_fg_srgb`. `PROTOCOLS` defines each
metric, docs/metrics.md gives the reasons. A region's score is the mean over its views; regions are never mixed.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble import __version__
from tumble.datasets import reader_for
from tumble.evaluation import lpips, metrics, score_sheet
from tumble.evaluation.prediction import Prediction
from tumble.evaluation.published import published_scores
from tumble.io import BadFile, files, in_threads, progress
from tumble.scene import REGIONS, UNKNOWN, Capture, Truth

MIN_SIDE = 11
"""Minimum height and width of a capture that can be scored [pixels]: the window of SSIM."""
TOLERANCE_METRES = 0.1
"""Position error up to which recall is integrated for the AUC, for captures in metres [m]."""
TOLERANCE_FRACTION = 0.1
"""The same error for captures in other units [fraction of the mean camera distance]."""
PREDICTION = "prediction"
"""Folder of the rendered prediction in a folder of scores."""
RUN_FOLDERS = ("capture", PREDICTION)
"""Folders of a run; the report gives the run's name for them."""
IDENTITY_TOLERANCE = 1e-3
"""Limit below which an alignment counts as the identity: relative change of scale, rotation [radians] and shift [mean
camera distances]."""

_VIEWS = "per view; a region's score is the mean over its views"
SHEET = "sheet.png"
"""Contact sheet of an evaluation, by which its folder is recognised; written first."""
PROTOCOLS = {
    "psnr_fg_linear": f"PSNR [dB], peak 1, foreground pixels only, linear values clipped to [0, 1], {_VIEWS}",
    "psnr_full_linear": f"PSNR [dB], peak 1, all pixels over black, linear values clipped to [0, 1], {_VIEWS}",
    "psnr_fg_linear_unscaled": f"as psnr_fg_linear, without the albedo scale, {_VIEWS}",
    "psnr_fg_srgb_unscaled": f"as psnr_fg_srgb, without the albedo scale, {_VIEWS}",
    "psnr_fg_srgb": f"PSNR [dB], peak 1, foreground pixels only, sRGB, {_VIEWS}",
    "psnr_full_srgb": f"PSNR [dB], peak 1, all pixels over black, sRGB, {_VIEWS}",
    "ssim_full_srgb": f"SSIM, Gaussian window 11 x 11 (sigma 1.5), windows inside the image, RGB, {_VIEWS}",
    "ssim_crop_srgb": f"as ssim_full_srgb, on the foreground's bounding box plus {metrics.CROP_MARGIN} px, {_VIEWS}",
    "lpips_full_srgb": f"LPIPS v0.1, whole image over black, sRGB, {_VIEWS}",
    "lpips_crop_srgb": f"LPIPS v0.1, foreground's bounding box plus {metrics.CROP_MARGIN} px, sRGB, {_VIEWS}",
    "mean_fg_degrees": f"mean angular error [degrees], foreground pixels only, {_VIEWS}",
    "median_fg_degrees": f"median angular error [degrees], foreground pixels only, {_VIEWS}",
    "mean_all_degrees": f"mean angular error [degrees], all pixels, background counted as 0, {_VIEWS}",
    "rmse_fg": f"root mean square error of perceptual roughness, foreground pixels only, {_VIEWS}",
    "mae_fg": f"mean absolute error of perceptual roughness or of metalness, foreground pixels only, {_VIEWS}",
    "iou": f"intersection over union of silhouettes, without unknown pixels, {_VIEWS}",
    "rmse_clip10": "root mean square error of radiance on a 32 x 64 grid, weighted by solid angle, the prediction "
    "divided by the albedo scale, then both clipped at 10",
    "rmse_clip10_unweighted": "as rmse_clip10, with equal weight for every texel",
    "log_correlation": "Pearson correlation of log luminance on a 32 x 64 grid, weighted by solid angle, unclipped",
    "ate": "root mean square error of camera positions after a Sim(3) alignment on all posed training frames "
    "[capture units]",
    "auc_percent": "mean over training frames of max(0, 1 - position error / tolerance), 0 for lost frames [%]",
    "rpe_translation": "mean translation error of the motion between neighbouring frames, after Sim(3) [capture units]",
    "rpe_rotation_degrees": "mean rotation error of the motion between neighbouring frames [degrees]",
    "rotation_mean_degrees": "mean rotation error after a rotation-only alignment (chordal mean) [degrees]",
    "rotation_median_degrees": "median rotation error after a rotation-only alignment (chordal mean) [degrees]",
    "rotation_below_2_percent": "training frames with a rotation error below 2 degrees; lost frames are wrong [%]",
    "rotation_below_5_percent": "training frames with a rotation error below 5 degrees; lost frames are wrong [%]",
    "rotation_below_10_percent": "training frames with a rotation error below 10 degrees; lost frames are wrong [%]",
    "rotation_longest_run_percent": "maximum number of consecutive training frames with a rotation error below 10 "
    "degrees [% of all]",
}
"""Definition of each metric, by the last part of its key."""
PART_PROTOCOLS = {
    "albedo": "predicted albedo times albedo_scale (per channel, median of truth / prediction over all foregrounds); "
    "masked by the predicted silhouette, except for fg",
    "relit": "images as stored in the prediction, to be rendered with albedo times albedo_scale (docs/prediction.md)",
    "image": "views under the capture's own light, albedo and light as estimated",
    "normal": "shading normals, true object frame",
    "silhouette": "predicted silhouette: mask/ if present, else where the predicted albedo is not black",
}
"""How each part is prepared before its metrics, by the first part of their keys."""


class Report(TypedDict):
    """All scores of one prediction, as written to `report.json`; docs/metrics.md defines each score."""

    tumble: str
    prediction: str
    capture: dict[str, Any]
    albedo_scale: list[float] | None
    """Per channel; None if there is no albedo to compare."""
    regions: dict[str, dict[str, float]]
    """By region and key, the mean over the region's evaluation views."""
    light: dict[str, Any]
    poses: dict[str, Any]
    published: dict[str, float]
    """Scores by the protocol of the benchmark that the capture is of (`evaluation/published.py`); empty for others."""
    views: list[dict[str, Any]]
    """Name, region and scores of each view."""
    protocol: dict[str, str]
    """Definition of each score, by key."""
    notes: list[str]
    """Parts that were not scored, with the reason, and how the views were aligned."""


@dataclass(frozen=True)
class CaptureWithTruth:
    """A capture and the ground truth that its predictions are scored against."""

    path: Path
    capture: Capture
    truth: Truth


def read_with_truth(path: Path) -> CaptureWithTruth:
    """Read a capture that has ground truth, in any layout of `datasets`.

    Raises:
        BadFile: A file breaks a rule of its format, the capture has no ground truth, or its images are too small.
    """
    reader = reader_for(path)
    capture, truth = reader.load(path), reader.load_truth(path)
    if truth is None:
        raise BadFile(path, "has no truth to score against", "it has neither evaluation views nor true light or poses")
    if min(capture.camera.height, capture.camera.width) < MIN_SIDE:
        raise BadFile(path, f"has images smaller than {MIN_SIDE} x {MIN_SIDE} pixels", "SSIM needs one whole window")
    return CaptureWithTruth(path, capture, truth)


def score(
    prediction: Path,
    capture: Path | CaptureWithTruth,
    out: Path,
    *,
    vgg: Path | None = None,
    notes: Sequence[str] = (),
) -> Report:
    """Score a prediction against a capture's ground truth; write report.json and sheet.png, and return the report.

    Args:
        prediction: Folder of docs/prediction.md. The report notes the parts that it lacks; they are not scored.
        capture: Path of the capture with its ground truth, or the result of `read_with_truth`.
        out: Folder for report.json and sheet.png; created if missing, and not touched if anything fails.
        vgg: LPIPS weights of VGG-16 (.npz or .safetensors); adds `lpips_*_vgg` to the AlexNet scores.
        notes: Sentences for the report on how the prediction was made.

    Raises:
        BadFile: A file of either folder breaks a rule of its format, or the capture has no ground truth.
    """
    target = read_with_truth(capture) if isinstance(capture, Path) else capture
    predicted = Prediction.read(prediction, target.capture, target.truth)
    networks = [lpips.read()] + ([lpips.read(vgg)] if vgg else [])
    scores = compare(predicted, target.capture, target.truth, networks)
    scores["notes"] = [*notes, *scores["notes"]]
    report = {
        "tumble": __version__,
        "prediction": _display_name(prediction),
        "capture": _capture_facts(target),
        **scores,
    }
    sheet = score_sheet.draw(report, predicted, target.truth)
    files.write_png(out / SHEET, sheet)
    files.write_json(out / "report.json", report)
    return cast(Report, report)


def score_prediction(predicted: Prediction, target: CaptureWithTruth, out: Path, notes: Sequence[str]) -> Report:
    """Score a prediction in memory; write `prediction/`, report.json and sheet.png.

    The prediction moves to its place at the end: an interrupted evaluation leaves nothing that would block the next.

    Args:
        out: Folder for the files; created if missing.
        notes: See `score`.

    Raises:
        BadFile: See `score`.
    """
    with files.partial_folder(out) as scratch:
        # The report names a run by the folder above.
        partial, place = scratch / out.resolve().name / PREDICTION, out / PREDICTION
        predicted.write(partial)
        report = score(partial, target, out, notes=notes)
        shutil.rmtree(place, ignore_errors=True)
        partial.replace(place)
    return report


@torch.no_grad()
def compare(predicted: Prediction, capture: Capture, truth: Truth, networks: Sequence[lpips.Network]) -> dict[str, Any]:
    """All scores of a prediction: of regions, light, poses and views, with their protocols and notes on missing parts.

    Args:
        networks: Networks of LPIPS; without any, LPIPS is left out.
    """
    notes = _missing_parts(predicted, truth)
    scale = _albedo_scale(predicted, truth, notes)
    of_views = in_threads(lambda i: _view_scores(i, predicted, truth, scale, networks), range(len(truth)))
    rows = list(progress.track(of_views, "scoring views", len(truth)))
    light: dict[str, Any] = {}
    if predicted.light is not None and truth.light is not None:
        light = metrics.light_scores(predicted.light, truth.light, torch.ones(3) if scale is None else scale)
    scores: dict[str, Any] = {
        "albedo_scale": None if scale is None else scale.tolist(),
        "regions": {region: _mean([rows[i] for i in truth.views(region)]) for region in REGIONS if truth.views(region)},
        "light": {f"light.{key}": value for key, value in light.items()},
        "poses": _pose_scores(predicted, capture, truth, notes),
    }
    scores["published"], definitions = published_scores(predicted, truth, networks)
    keys = {key for part in (*scores["regions"].values(), scores["light"], scores["poses"]) for key in part}
    return {
        **scores,
        "views": [
            {"name": name, "region": region, **row}
            for name, region, row in zip(truth.names, truth.regions, rows, strict=True)
        ],
        "protocol": {key: text for key in sorted(keys) if (text := protocol(key))} | definitions,
        "notes": notes,
    }


def protocol(key: str) -> str | None:
    """Definition of a score of the report, by its key; None for counts and settings."""
    part, _, metric = key.rpartition(".")
    part = part.partition(".")[0]
    network = next((name for name in lpips.ARCHITECTURES if metric.endswith(f"_{name}")), None)
    text = PROTOCOLS.get(metric.removesuffix(f"_{network}"))
    if text is None:
        return None
    sentences = [PART_PROTOCOLS.get(part, ""), f"{network} features" if network else "", text]
    return "; ".join(sentence for sentence in sentences if sentence)


def _display_name(path: Path) -> str:
    """Name of a folder, or of the run if the folder belongs to one."""
    path = path.resolve()
    return path.parent.name if path.name in RUN_FOLDERS and path.parent.name else path.name


def _capture_facts(target: CaptureWithTruth) -> dict[str, Any]:
    """Facts of the scored capture for the report, none of which depends on the machine."""
    capture, truth = target.capture, target.truth
    return {
        "name": _display_name(target.path),
        "setting": truth.setting,
        "light": capture.light,
        "units": truth.units,
        "width": capture.camera.width,
        "height": capture.camera.height,
        "frames": len(capture),
        "views": {region: len(truth.views(region)) for region in REGIONS},
    }


def _missing_parts(predicted: Prediction, truth: Truth) -> list[str]:
    """One note for each part that only the prediction or only the truth has."""
    parts = {
        "albedo": (predicted.albedo, truth.albedo),
        "normal": (predicted.normals, truth.normals),
        "roughness": (predicted.roughness, truth.roughness),
        "metalness": (predicted.metalness, truth.metalness),
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
            notes.append(f"{name}: not scored, absent from the capture's truth")
    return notes


def _albedo_scale(predicted: Prediction, truth: Truth, notes: list[str]) -> Float[Tensor, "3"] | None:
    if predicted.albedo is None or truth.albedo is None:
        if predicted.light is not None and truth.light is not None:
            notes.append("light: compared unscaled, because without albedo there is no albedo scale")
        return None
    try:
        return metrics.albedo_scale(predicted.albedo, truth.albedo, truth.foreground)
    except ValueError as error:
        notes.append(f"albedo: compared unscaled; {error}")
        return torch.ones(3)


def _view_scores(
    i: int,
    predicted: Prediction,
    truth: Truth,
    scale: Float[Tensor, "3"] | None,
    networks: Sequence[lpips.Network],
) -> dict[str, float]:
    """Every score of one view, by key."""
    foreground, valid = truth.foreground[i], truth.masks[i] != UNKNOWN
    scores: dict[str, float] = {}

    def add(part: str, values: dict[str, float]) -> None:
        scores.update({f"{part}.{key}": value for key, value in values.items()})

    def image_scores(x: Tensor, y: Tensor) -> dict[str, float]:
        return metrics.image_scores(x[i] / 255, y[i] / 255, foreground, valid, networks)

    if predicted.albedo is not None and truth.albedo is not None and scale is not None:
        assert predicted.silhouettes is not None, "a predicted albedo implies a silhouette"
        maps = (predicted.albedo[i], truth.albedo[i], predicted.silhouettes[i])
        add("albedo", metrics.albedo_scores(*maps, scale, foreground, valid, networks))
    if predicted.normals is not None and truth.normals is not None:
        add("normal", metrics.normal_scores(predicted.normals[i], truth.normals[i], foreground, valid))
    if predicted.roughness is not None and truth.roughness is not None:
        of_roughness = (predicted.roughness[i], truth.roughness[i], foreground)
        add("roughness", {"rmse_fg": metrics.rmse(*of_roughness), "mae_fg": metrics.mae(*of_roughness)})
    if predicted.metalness is not None and truth.metalness is not None:
        add("metalness", {"mae_fg": metrics.mae(predicted.metalness[i], truth.metalness[i], foreground)})
    if predicted.silhouettes is not None:
        add("silhouette", {"iou": metrics.iou(predicted.silhouettes[i], foreground, valid)})
    if predicted.images is not None:
        add("image", image_scores(predicted.images, truth.images))
    lights = sorted({*predicted.relit} & {*truth.relit})
    by_light = [image_scores(predicted.relit[light], truth.relit[light]) for light in lights]
    for light, values in zip(lights, by_light, strict=True):
        add(f"relit.{light}", values)
    if by_light:
        add("relit", _mean(by_light))
    return scores


def _pose_scores(predicted: Prediction, capture: Capture, truth: Truth, notes: list[str]) -> dict[str, Any]:
    """Scores of the estimated training poses for which a true pose exists, with the alignment used."""
    if predicted.poses is None or truth.poses is None:
        return {}
    true_index = truth.pose_indices(capture)
    shared = [i for i, name in enumerate(predicted.pose_names) if name in true_index]
    if len(shared) < 2:
        notes.append("poses: not scored, because a single pose has no error after alignment")
        return {}
    number = {name: i for i, name in enumerate(true_index)}
    names = [predicted.pose_names[i] for i in shared]
    frames, lost = [number[name] for name in names], len(true_index) - len(shared)
    poses, true = predicted.poses.select(shared), truth.poses.select([true_index[name] for name in names])
    distance = float(torch.linalg.vector_norm(truth.poses.camera_positions, dim=-1).mean())
    tolerance = TOLERANCE_METRES if truth.units == "m" else TOLERANCE_FRACTION * distance
    try:
        alignment = metrics.align(poses, true)
        aligned = alignment.to_truth(poses)
        positions: dict[str, Any] = metrics.position_scores(aligned, true, tolerance=tolerance, lost=lost)
        positions["alignment"] = _alignment_summary(alignment, distance)
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


def _alignment_summary(alignment: metrics.Similarity, distance: float) -> dict[str, Any]:
    angle = float(alignment.R_true_pred.angle())
    deviation = max(abs(float(alignment.scale) - 1), angle, float(alignment.shift.norm()) / distance)
    return {
        "scale": float(alignment.scale),
        "rotation_degrees": float(np.degrees(angle)),
        "shift": alignment.shift.tolist(),
        "identity": deviation < IDENTITY_TOLERANCE,
    }


def _mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Mean of each score over rows with the same keys."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
