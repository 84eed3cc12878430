"""The picture that goes with an evaluation's report: truth, prediction and error side by side, for a few views."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.evaluation import contact_sheet, metrics
from tumble.evaluation.contact_sheet import Group, Sheet, Tile
from tumble.evaluation.prediction import Prediction
from tumble.maths import crop, crop_box, srgb_from_linear
from tumble.scene import REGIONS, Environment, Truth

VIEWS = 4
"""Rows of the sheet; both regions have their share."""
TOPS = {"albedo": 0.25, "normal": 30.0, "roughness": 0.5, "relit": 0.25}
"""Error at the bright end of the colours [sRGB, degrees, roughness, sRGB]."""
HEADLINES = {
    "albedo.psnr_fg_srgb": ("albedo PSNR fg, sRGB", "{:.2f} dB"),
    "albedo.lpips_full_srgb_alex": ("albedo LPIPS, full", "{:.4f}"),
    "relit.psnr_fg_srgb": ("relit PSNR fg", "{:.2f} dB"),
    "relit.psnr_full_srgb": ("relit PSNR full", "{:.2f} dB"),
    "image.psnr_fg_srgb": ("image PSNR fg", "{:.2f} dB"),
    "normal.mean_fg_degrees": ("normal mean fg", "{:.2f}°"),
    "roughness.rmse_fg": ("roughness RMSE", "{:.4f}"),
    "silhouette.iou": ("silhouette IoU", "{:.4f}"),
}
"""Numbers of the table: their headings, and how they are written."""
CAPTIONS = {
    "albedo": "albedo.psnr_fg_srgb",
    "normal": "normal.mean_fg_degrees",
    "roughness": "roughness.rmse_fg",
}
"""The number under each error picture."""
SCALES = {"albedo": "0.25", "normal": "30°", "roughness": "0.5", "relit": "0.25"}
"""How the ends of the colours are written."""
LIGHT_SIZE = (144, 288)


def draw(report: dict[str, Any], predicted: Prediction, truth: Truth) -> UInt8[np.ndarray, "h w 3"]:
    """The sheet of an evaluation.

    Args:
        report: What `evaluate.run` writes.
        predicted: What was scored.
        truth: What it was scored against.
    """
    light = next(iter(sorted({*predicted.relit} & {*truth.relit})), next(iter(sorted(truth.relit)), None))
    parts = [part for part, known in _known(truth, light).items() if known]
    groups = [Group(_heading(part, light), ("truth", "prediction", "error"), SCALES[part]) for part in parts]
    rows = []
    for i in _chosen(truth):
        tiles = [tile for part in parts for tile in _tiles(part, i, report, predicted, truth, light)]
        rows.append((f"{truth.names[i]}\n{truth.regions[i]}", tiles))
    return contact_sheet.draw(
        Sheet(
            title=_title(report),
            subtitle=_subtitle(report),
            table=_table(report),
            groups=groups,
            rows=rows,
            strips=_lights(report, predicted, truth),
            remarks=_poses(report),
            notes=report["notes"],
        )
    )


def _title(report: dict[str, Any]) -> str:
    names = dict.fromkeys([report["prediction"], report["capture"]["name"]])
    return f"Scores of {' on '.join(names)}"


def _known(truth: Truth, light: str | None) -> dict[str, bool]:
    maps = {"albedo": truth.albedo, "normal": truth.normals, "roughness": truth.roughness}
    return {**{part: value is not None for part, value in maps.items()}, "relit": light is not None}


def _heading(part: str, light: str | None) -> str:
    return {"albedo": "albedo, scaled (sRGB)", "normal": "normal, object frame", "relit": f"relit, {light}"}.get(
        part, part
    )


def _chosen(truth: Truth) -> list[int]:
    """Views spread evenly over each region."""
    regions = [truth.views(region) for region in REGIONS if truth.views(region)]
    if not regions:
        return []
    share = VIEWS // len(regions)
    return [views[k * len(views) // min(share, len(views))] for views in regions for k in range(min(share, len(views)))]


def _tiles(
    part: str, i: int, report: dict[str, Any], predicted: Prediction, truth: Truth, light: str | None
) -> tuple[Tile, Tile, Tile]:
    """Truth, prediction and error of one part of one view, cropped to the object."""
    true, guess, error = _pictures(part, i, report, predicted, truth, light)
    key = CAPTIONS.get(part, f"relit.{light}.psnr_fg_srgb")
    pattern = HEADLINES.get(key, HEADLINES["relit.psnr_fg_srgb"])[1]
    number = report["views"][i].get(key)
    box = crop_box(truth.foreground[i], 4)

    def tile(pixels: Tensor | None) -> Tile:
        return Tile(None if pixels is None else _code_values(_square(crop(pixels, box))))

    if error is None:
        return tile(true), tile(guess), Tile(None)
    mask = _square(crop(truth.foreground[i], box)).numpy()
    heat = contact_sheet.heat(_square(crop(error, box)).numpy(), mask, TOPS[part])
    return tile(true), tile(guess), Tile(heat, "" if number is None else pattern.format(number))


def _square(x: Tensor) -> Tensor:
    """The picture in the middle of the smallest square that holds it, zeros (or False) around it."""
    h, w = x.shape[:2]
    side = max(h, w)
    square = x.new_zeros(side, side, *x.shape[2:])
    top, left = (side - h) // 2, (side - w) // 2
    square[top : top + h, left : left + w] = x
    return square


def _pictures(
    part: str, i: int, report: dict[str, Any], predicted: Prediction, truth: Truth, light: str | None
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Truth and prediction as sRGB pictures in [0, 1], and the error in the part's own measure; None when absent."""
    if part == "normal":
        return _pair(truth.normals, predicted.normals, i, _normal_picture, metrics.normal_angles)
    if part == "roughness":
        return _pair(truth.roughness, predicted.roughness, i, _grey, lambda x, y: (x - y).abs())
    if part == "relit":
        assert light is not None
        return _pair(truth.relit[light], predicted.relit.get(light), i, lambda x: x / 255, _mean_error_of_codes)
    scale = torch.tensor(report["albedo_scale"] or [1.0, 1.0, 1.0])
    albedo, silhouettes = predicted.albedo, predicted.silhouettes
    scaled = None if albedo is None or silhouettes is None else albedo * scale * silhouettes[..., None]
    return _pair(truth.albedo, scaled, i, _srgb, lambda x, y: (_srgb(x) - _srgb(y)).abs().mean(-1))


def _pair(
    truth: Tensor | None,
    predicted: Tensor | None,
    i: int,
    picture: Callable[[Tensor], Tensor],
    error: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    assert truth is not None
    if predicted is None:
        return picture(truth[i]), None, None
    return picture(truth[i]), picture(predicted[i]), error(predicted[i], truth[i])


def _srgb(linear: Tensor) -> Tensor:
    return srgb_from_linear(linear.clamp(0, 1))


def _grey(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    return values[..., None].expand(-1, -1, 3)


def _normal_picture(normals: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    length = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    return torch.where(length > metrics.NO_NORMAL, 0.5 + 0.5 * normals / length.clamp_min(1e-6), 0.0)


def _mean_error_of_codes(x: Tensor, y: Tensor) -> Tensor:
    return (x / 255 - y / 255).abs().mean(-1)


def _code_values(srgb: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (srgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


# Words ----------------------------------------------------------------------------------------------------------------


def _subtitle(report: dict[str, Any]) -> str:
    about = report["capture"]
    views = ", ".join(f"{count} {region}" for region, count in about["views"].items())
    words = [about["setting"] or "", f"light stands still with the {about['light']}", f"{about['frames']} frames"]
    words += [f"evaluation views: {views}", f"{about['width']} x {about['height']} pixels"]
    if report["albedo_scale"]:
        words.append("albedo scale " + " ".join(f"{s:.3f}" for s in report["albedo_scale"]))
    return "   |   ".join(word for word in words if word)


def _table(report: dict[str, Any]) -> list[list[str]]:
    regions = report["regions"]
    keys = [key for key in HEADLINES if any(key in scores for scores in regions.values())]
    if not keys:
        return []
    table = [["", *(HEADLINES[key][0] for key in keys)]]
    for region, scores in regions.items():
        table.append([region, *(HEADLINES[key][1].format(scores[key]) if key in scores else "-" for key in keys)])
    return table


def _lights(report: dict[str, Any], predicted: Prediction, truth: Truth) -> Sequence[Tile]:
    if truth.light is None:
        return ()
    exposure = 0.3 / max(float(truth.light.radiance.mean()), 1e-6)
    tiles = [Tile(_light_picture(truth.light, torch.ones(3), exposure), "true light, capture's env frame")]
    if predicted.light is None:
        return [*tiles, Tile(None, "predicted light")]
    scale = torch.tensor(report["albedo_scale"] or [1.0, 1.0, 1.0])
    scores = report["light"]
    words = f"predicted light / albedo scale   RMSE {scores['light.rmse_clip10']:.3f} (clipped at 10)"
    if scores["light.log_correlation"] is not None:
        words += f"   log corr. {scores['light.log_correlation']:.3f}"
    return [*tiles, Tile(_light_picture(predicted.light, scale, exposure), words)]


def _light_picture(light: Environment, scale: Float[Tensor, "3"], exposure: float) -> UInt8[np.ndarray, "h w 3"]:
    return _code_values(_srgb(exposure * light.resampled(*LIGHT_SIZE).radiance / scale))


def _poses(report: dict[str, Any]) -> list[str]:
    scores = report["poses"]
    if not scores:
        return []

    def word(key: str, pattern: str) -> str:
        value = scores[f"poses.{key}"]
        return "not defined" if value is None else pattern.format(value)

    unit = " m" if report["capture"]["units"] == "m" else ""
    percents = ", ".join(word(f"rotation_below_{d}_percent", "{:.0f} %") for d in (2, 5, 10))
    return [
        f"poses of {scores['poses.posed_frames']} training frames, {scores['poses.lost_frames']} lost",
        f"rotation error: median {word('rotation_median_degrees', '{:.2f}°')}, "
        f"mean {word('rotation_mean_degrees', '{:.2f}°')};  below 2°, 5°, 10°: {percents}",
        f"position error: ATE {word('ate', '{:.4f}')}{unit},  "
        f"AUC {word('auc_percent', '{:.1f} %')} (to {scores['poses.tolerance']:.3g}{unit})",
        f"between neighbours: RPE {word('rpe_translation', '{:.4f}')}{unit}, {word('rpe_rotation_degrees', '{:.2f}°')}",
    ]
