"""Contact sheet of an evaluation: truth, prediction and error side by side for a few views (sheet.png)."""

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

N_VIEWS = 4
"""Maximum number of rows, divided evenly between the regions."""
MAX_ERRORS = {"albedo": 0.25, "normal": 30.0, "roughness": 0.5, "relit": 0.25}
"""Error at the bright end of the error maps' colours [sRGB, degrees, roughness, sRGB]."""
TABLE_COLUMNS = {
    "albedo.psnr_fg_srgb": ("albedo PSNR fg, sRGB", "{:.2f} dB"),
    "albedo.psnr_fg_srgb_unscaled": ("the same unscaled", "{:.2f} dB"),
    "albedo.lpips_full_srgb_alex": ("albedo LPIPS, full", "{:.4f}"),
    "relit.psnr_fg_srgb": ("relit PSNR fg", "{:.2f} dB"),
    "relit.psnr_full_srgb": ("relit PSNR full", "{:.2f} dB"),
    "image.psnr_fg_srgb": ("image PSNR fg", "{:.2f} dB"),
    "normal.mean_fg_degrees": ("normal mean fg", "{:.2f}°"),
    "roughness.rmse_fg": ("roughness RMSE", "{:.4f}"),
    "silhouette.iou": ("silhouette IoU", "{:.4f}"),
}
"""Heading and number format of each metric in the table."""
CAPTION_METRICS = {
    "albedo": "albedo.psnr_fg_srgb",
    "normal": "normal.mean_fg_degrees",
    "roughness": "roughness.rmse_fg",
}
"""Metric under each error map."""
MAX_ERROR_LABELS = {"albedo": "0.25", "normal": "30°", "roughness": "0.5", "relit": "0.25"}
"""`MAX_ERRORS` as text."""
LIGHT_SIZE = (144, 288)
"""Rows and columns of the light maps [pixels]."""


def draw(report: dict[str, Any], predicted: Prediction, truth: Truth) -> UInt8[np.ndarray, "h w 3"]:
    """The contact sheet of an evaluation, as an sRGB image.

    Args:
        report: The report of `evaluate.score`.
        predicted: The scored prediction.
        truth: The ground truth that it was scored against.
    """
    light = next(iter(sorted({*predicted.relit} & {*truth.relit})), next(iter(sorted(truth.relit)), None))
    parts = [part for part, available in _available_parts(truth, light).items() if available]
    groups = [Group(_heading(part, light), ("truth", "prediction", "error"), MAX_ERROR_LABELS[part]) for part in parts]
    rows = []
    for i in _selected_views(truth):
        tiles = [tile for part in parts for tile in _tiles(part, i, report, predicted, truth, light)]
        rows.append((f"{truth.names[i]}\n{truth.regions[i]}", tiles))
    return contact_sheet.draw(
        Sheet(
            title=_title(report),
            subtitle=_subtitle(report),
            table=_table(report),
            groups=groups,
            rows=rows,
            strips=_light_tiles(report, predicted, truth),
            remarks=_pose_lines(report),
            notes=report["notes"],
        )
    )


def _title(report: dict[str, Any]) -> str:
    names = dict.fromkeys([report["prediction"], report["capture"]["name"]])
    return f"Scores of {' on '.join(names)}"


def _available_parts(truth: Truth, light: str | None) -> dict[str, bool]:
    """Whether the truth has each part of the sheet."""
    maps = {"albedo": truth.albedo, "normal": truth.normals, "roughness": truth.roughness}
    return {**{part: value is not None for part, value in maps.items()}, "relit": light is not None}


def _heading(part: str, light: str | None) -> str:
    return {"albedo": "albedo, scaled (sRGB)", "normal": "normal, object frame", "relit": f"relit, {light}"}.get(
        part, part
    )


def _selected_views(truth: Truth) -> list[int]:
    """Indices of the views to show, evenly spaced within each region."""
    regions = [truth.views(region) for region in REGIONS if truth.views(region)]
    if not regions:
        return []
    count = N_VIEWS // len(regions)
    return [views[k * len(views) // min(count, len(views))] for views in regions for k in range(min(count, len(views)))]


def _tiles(
    part: str, i: int, report: dict[str, Any], predicted: Prediction, truth: Truth, light: str | None
) -> tuple[Tile, Tile, Tile]:
    """Truth, prediction and error of one part of one view, cropped to the object."""
    true, estimate, error = _part_images(part, i, report, predicted, truth, light)
    key = CAPTION_METRICS.get(part, f"relit.{light}.psnr_fg_srgb")
    number_format = TABLE_COLUMNS.get(key, TABLE_COLUMNS["relit.psnr_fg_srgb"])[1]
    number = report["views"][i].get(key)
    box = crop_box(truth.foreground[i], 4)

    def tile(pixels: Tensor | None) -> Tile:
        return Tile(None if pixels is None else _code_values(_square(crop(pixels, box))))

    if error is None:
        return tile(true), tile(estimate), Tile(None)
    mask = _square(crop(truth.foreground[i], box)).numpy()
    error_map = contact_sheet.heat_map(_square(crop(error, box)).numpy(), mask, MAX_ERRORS[part])
    return tile(true), tile(estimate), Tile(error_map, "" if number is None else number_format.format(number))


def _square(x: Tensor) -> Tensor:
    """The image centred in the smallest square that contains it, padded with zeros or False."""
    h, w = x.shape[:2]
    side = max(h, w)
    square = x.new_zeros(side, side, *x.shape[2:])
    top, left = (side - h) // 2, (side - w) // 2
    square[top : top + h, left : left + w] = x
    return square


def _part_images(
    part: str, i: int, report: dict[str, Any], predicted: Prediction, truth: Truth, light: str | None
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Truth and prediction as sRGB images in [0, 1], and the error map in the unit of `MAX_ERRORS`; None if absent."""
    if part == "normal":
        return _compared(truth.normals, predicted.normals, i, _normal_image, metrics.normal_angles)
    if part == "roughness":
        return _compared(truth.roughness, predicted.roughness, i, _grey, lambda x, y: (x - y).abs())
    if part == "relit":
        assert light is not None
        return _compared(truth.relit[light], predicted.relit.get(light), i, lambda x: x / 255, _code_value_error)
    scale = torch.tensor(report["albedo_scale"] or [1.0, 1.0, 1.0])
    albedo, silhouettes = predicted.albedo, predicted.silhouettes
    masked = None if albedo is None or silhouettes is None else albedo * scale * silhouettes[..., None]
    return _compared(truth.albedo, masked, i, _srgb, lambda x, y: (_srgb(x) - _srgb(y)).abs().mean(-1))


def _compared(
    truth: Tensor | None,
    predicted: Tensor | None,
    i: int,
    to_image: Callable[[Tensor], Tensor],
    error: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    assert truth is not None
    if predicted is None:
        return to_image(truth[i]), None, None
    return to_image(truth[i]), to_image(predicted[i]), error(predicted[i], truth[i])


def _srgb(linear: Tensor) -> Tensor:
    return srgb_from_linear(linear.clamp(0, 1))


def _grey(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    return values[..., None].expand(-1, -1, 3)


def _normal_image(normals: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    length = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    return torch.where(length > metrics.MIN_NORMAL_LENGTH, 0.5 + 0.5 * normals / length.clamp_min(1e-6), 0.0)


def _code_value_error(x: Tensor, y: Tensor) -> Tensor:
    return (x / 255 - y / 255).abs().mean(-1)


def _code_values(srgb: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (srgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


# Text -----------------------------------------------------------------------------------------------------------------


def _subtitle(report: dict[str, Any]) -> str:
    facts = report["capture"]
    views = ", ".join(f"{count} {region}" for region, count in facts["views"].items())
    items = [facts["setting"] or "", f"light fixed to the {facts['light']}", f"{facts['frames']} frames"]
    items += [f"evaluation views: {views}", f"{facts['width']} x {facts['height']} pixels"]
    if report["albedo_scale"]:
        items.append("albedo scale " + " ".join(f"{s:.3f}" for s in report["albedo_scale"]))
    return "   |   ".join(item for item in items if item)


def _table(report: dict[str, Any]) -> list[list[str]]:
    regions = report["regions"]
    keys = [key for key in TABLE_COLUMNS if any(key in scores for scores in regions.values())]
    if not keys:
        return []
    table = [["", *(TABLE_COLUMNS[key][0] for key in keys)]]
    for region, scores in regions.items():
        table.append([region, *(TABLE_COLUMNS[key][1].format(scores[key]) if key in scores else "-" for key in keys)])
    return table


def _light_tiles(report: dict[str, Any], predicted: Prediction, truth: Truth) -> Sequence[Tile]:
    if truth.light is None:
        return ()
    exposure = 0.3 / max(float(truth.light.radiance.mean()), 1e-6)
    tiles = [Tile(_light_image(truth.light, torch.ones(3), exposure), "true light, env frame of the capture")]
    if predicted.light is None:
        return [*tiles, Tile(None, "predicted light")]
    scale = torch.tensor(report["albedo_scale"] or [1.0, 1.0, 1.0])
    scores = report["light"]
    caption = f"predicted light / albedo scale   RMSE {scores['light.rmse_clip10']:.3f} (clipped at 10)"
    if scores["light.log_correlation"] is not None:
        caption += f"   log corr. {scores['light.log_correlation']:.3f}"
    return [*tiles, Tile(_light_image(predicted.light, scale, exposure), caption)]


def _light_image(light: Environment, scale: Float[Tensor, "3"], exposure: float) -> UInt8[np.ndarray, "h w 3"]:
    return _code_values(_srgb(exposure * light.resampled(*LIGHT_SIZE).radiance / scale))


def _pose_lines(report: dict[str, Any]) -> list[str]:
    scores = report["poses"]
    if not scores:
        return []

    def formatted(key: str, number_format: str) -> str:
        value = scores[f"poses.{key}"]
        return "not defined" if value is None else number_format.format(value)

    unit = " m" if report["capture"]["units"] == "m" else ""
    percents = ", ".join(formatted(f"rotation_below_{d}_percent", "{:.0f} %") for d in (2, 5, 10))
    return [
        f"poses of {scores['poses.posed_frames']} training frames, {scores['poses.lost_frames']} lost",
        f"rotation error: median {formatted('rotation_median_degrees', '{:.2f}°')}, "
        f"mean {formatted('rotation_mean_degrees', '{:.2f}°')};  below 2°, 5°, 10°: {percents}",
        f"position error: ATE {formatted('ate', '{:.4f}')}{unit},  "
        f"AUC {formatted('auc_percent', '{:.1f} %')} (to {scores['poses.tolerance']:.3g}{unit})",
        f"between neighbouring frames: RPE {formatted('rpe_translation', '{:.4f}')}{unit}, "
        f"{formatted('rpe_rotation_degrees', '{:.2f}°')}",
    ]
