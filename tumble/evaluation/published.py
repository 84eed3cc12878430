"""Scores by the protocols of published benchmarks, so that they can be put beside the numbers of their papers.

They differ from the scores of the other files in the pixels that count, in the scales that are fitted, and in the
colour space; docs/metrics.md states each protocol and where these scores deviate from it.
"""

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize, pad

from tumble.evaluation import lpips, metrics
from tumble.evaluation.prediction import Prediction
from tumble.maths import linear_from_srgb, srgb_from_linear, ssim
from tumble.scene import OBJECT, Benchmark, Truth

GAMMA = 1 / 2.2
"""Exponent of TensoIR's albedo before it is compared."""
MIN_ALBEDO = 1e-6
"""Lower limit of the predicted albedo in TensoIR's scale [linear]."""
UP = (0.0, 1.0, 0.0)
"""TensoIR's normal of the background: up, in the object frame."""
MAX_HDR = 4.0
"""Radiance at which Stanford-ORB clips, after its scales."""
ERODED = 5
"""Side of the square with which Stanford-ORB erodes the masks [pixels]."""
SSIM_WINDOW = 3
"""Window of Stanford-ORB's SSIM [pixels]."""
MIN_POWER = 1e-6
"""Sum of squares of a predicted channel below which Stanford-ORB replaces it by a constant."""


def published_scores(
    predicted: Prediction, truth: Truth, networks: Sequence[lpips.Network]
) -> tuple[dict[str, float], dict[str, str]]:
    """Scores by the protocol of the capture's benchmark, by key, and the definition of each; empty if it is of none.

    Args:
        networks: Networks of LPIPS.
    """
    if not truth.benchmark or not len(truth):
        return {}, {}
    scores = SCORES[truth.benchmark](predicted, truth, networks)
    stems = {key: key.partition("_lpips")[0] + "_lpips" * ("_lpips" in key) for key in scores}
    return scores, {key: DEFINITIONS[stem] for key, stem in stems.items()}


def _mean(rows: Sequence[dict[str, float]], prefix: str) -> dict[str, float]:
    return {f"{prefix}_{key}": float(np.mean([row[key] for row in rows])) for key in (rows[0] if rows else ())}


# TensoIR --------------------------------------------------------------------------------------------------------------


def tensoir(predicted: Prediction, truth: Truth, networks: Sequence[lpips.Network]) -> dict[str, float]:
    """Scores of TensoIR (Jin et al. 2023): whole pictures over white, each mean over the test views."""
    assert truth.alpha is not None, "the reader knows it"
    alpha, silhouettes = truth.alpha / 255, predicted.silhouettes
    if silhouettes is None:
        return {}
    scores: dict[str, float] = {}
    if predicted.images is not None:
        rows = _over_white(predicted.images, truth.images, silhouettes, alpha, networks)
        scores |= _mean(rows, "tensoir.image")
    lights = sorted(predicted.relit.keys() & truth.relit.keys())
    rows = [
        row
        for light in lights
        for row in _over_white(predicted.relit[light], truth.relit[light], silhouettes, alpha, networks)
    ]
    scores |= _mean(rows, "tensoir.relit")
    if predicted.albedo is not None and truth.albedo is not None:
        scores["tensoir.albedo_psnr"] = _tensoir_albedo(predicted.albedo, truth.albedo, alpha)
    if predicted.normals is not None and truth.normals is not None:
        scores["tensoir.normal_mae_degrees"] = _tensoir_normals(predicted.normals, truth.normals, silhouettes, alpha)
    return scores


def _over_white(
    predicted: UInt8[Tensor, "v h w 3"],
    truth: UInt8[Tensor, "v h w 3"],
    silhouettes: Bool[Tensor, "v h w"],
    alpha: Float[Tensor, "v h w"],
    networks: Sequence[lpips.Network],
) -> list[dict[str, float]]:
    """PSNR, SSIM and LPIPS of each view over white; the prediction is white outside its silhouette."""
    everywhere = torch.ones_like(silhouettes[0])
    rows = []
    for i in range(len(predicted)):
        x = torch.where(silhouettes[i][..., None], predicted[i] / 255, 1.0)
        y = srgb_from_linear((linear_from_srgb(truth[i] / 255) + 1 - alpha[i][..., None]).clamp(0, 1))
        row = {"psnr": metrics.psnr(x, y, everywhere), "ssim": float(ssim(x, y))}
        rows.append(row | {f"lpips_{network.name}": float(lpips.distance(network, x, y)) for network in networks})
    return rows


def _tensoir_albedo(
    predicted: Float[Tensor, "v h w 3"], truth: Float[Tensor, "v h w 3"], alpha: Float[Tensor, "v h w"]
) -> float:
    """PSNR [dB] of the albedo over white to the power of 1 / 2.2, pooled over all pixels of all views.

    Per channel the prediction is multiplied by the median of truth / prediction over the object's pixels.
    """
    inside = alpha > 0
    white = truth * alpha[..., None] + (1 - alpha[..., None])
    ratio = white[inside] / predicted[inside].clamp_min(MIN_ALBEDO)
    scaled = torch.where(inside[..., None], (predicted * ratio.median(0).values).clamp(0, 1), 1.0)
    error = float((scaled**GAMMA - white.clamp(0, 1) ** GAMMA).square().mean())
    return min(metrics.MAX_PSNR, -10 * math.log10(max(error, 1e-30)))


def _tensoir_normals(
    predicted: Float[Tensor, "v h w 3"],
    truth: Float[Tensor, "v h w 3"],
    silhouettes: Bool[Tensor, "v h w"],
    alpha: Float[Tensor, "v h w"],
) -> float:
    """Mean angle [degrees] over all pixels of all views, with an upward normal outside the object in both."""
    up = truth.new_tensor(UP)
    x = torch.where(silhouettes[..., None], predicted, up)
    y = normalize(truth * alpha[..., None] + up * (1 - alpha[..., None]), dim=-1)
    return float(metrics.normal_angles(x, y).mean())


# Stanford-ORB ---------------------------------------------------------------------------------------------------------


def stanford_orb(predicted: Prediction, truth: Truth, networks: Sequence[lpips.Network]) -> dict[str, float]:
    """Scores of Stanford-ORB (Kuang et al. 2023): scale-invariant, over eroded masks, each mean over the views."""
    scores: dict[str, float] = {}
    masks = [_eroded(mask) for mask in truth.masks == OBJECT]
    if predicted.images is not None and truth.radiance is not None:
        pairs = zip(linear_from_srgb(predicted.images / 255), truth.radiance, masks, strict=True)
        scores |= _mean([_orb_image(x, y, mask, networks) for x, y, mask in pairs], "orb.image")
    if predicted.elsewhere is not None and truth.elsewhere is not None:
        views = truth.elsewhere
        other = [_eroded(mask) for mask in views.foreground]
        pairs = zip(predicted.elsewhere, views.radiance, other, strict=True)
        scores |= _mean([_orb_image(x, y, mask, networks) for x, y, mask in pairs], "orb.relit")
    if predicted.albedo is not None and truth.albedo is not None:
        pairs = zip(predicted.albedo, truth.albedo, masks, strict=True)
        scores |= _mean([_orb_albedo(x, y, mask, networks) for x, y, mask in pairs], "orb.albedo")
    if predicted.normals is not None and truth.normals is not None:
        cosines = (normalize(predicted.normals, dim=-1) * truth.normals).sum(-1)
        rows = [float((1 - cosine)[mask].mean()) for cosine, mask in zip(cosines, masks, strict=True)]
        scores["orb.normal_cosine"] = float(np.mean(rows))
    return scores


def _eroded(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    values = cv2.erode(mask.cpu().numpy().astype(np.uint8), np.ones((ERODED, ERODED), np.uint8))
    return torch.from_numpy(values).to(mask.device) > 0


def _orb_image(
    x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"], networks: Sequence[lpips.Network]
) -> dict[str, float]:
    """Scores of a view in linear radiance, `x` against the truth `y`, after a scale per channel.

    psnr_h: radiance divided by the ratio of the truth's means in linear values and in sRGB, clipped at `MAX_HDR`.
    psnr_l, ssim, lpips: sRGB, clipped at 1.
    """
    inside = mask[..., None]
    x, y = x * inside, y.clamp_min(0) * inside
    shown = y.clamp(0, 1)
    gain = srgb_from_linear(shown).mean() / shown.mean() if shown.mean() > 1e-8 else shown.new_ones(())
    scaled = x * _least_squares_scale(x, y, mask)
    low_x, low_y = (srgb_from_linear(values.clamp(0, 1)) for values in (scaled, y))
    high_x, high_y = ((gain * values).clamp(0, MAX_HDR) for values in (scaled, y))
    scores = {"psnr_h": _orb_psnr(high_x, high_y, mask), "psnr_l": _orb_psnr(low_x, low_y, mask)}
    # The benchmark converts these images to sRGB a second time for LPIPS.
    return scores | _orb_structure(low_x, low_y, networks)


def _orb_albedo(
    x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"], networks: Sequence[lpips.Network]
) -> dict[str, float]:
    """Scores of the linear albedo of a view after a scale per channel, clipped at 1."""
    x, y = x * mask[..., None], y * mask[..., None]
    x, y = (x * _least_squares_scale(x, y, mask)).clamp(0, 1), y.clamp(0, 1)
    return {"psnr": _orb_psnr(x, y, mask)} | _orb_structure(x, y, networks)


def _orb_psnr(x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float:
    """PSNR [dB] over the whole picture, black outside the mask; at least that of a grey prediction."""
    everywhere = torch.ones_like(mask)
    grey = 0.5 * mask[..., None].to(y).expand_as(y)
    return max(metrics.psnr(x, y, everywhere), metrics.psnr(grey, y, everywhere))


def _orb_structure(
    x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], networks: Sequence[lpips.Network]
) -> dict[str, float]:
    """SSIM with a small window, and LPIPS of the images converted to sRGB."""
    margin = (SSIM_WINDOW // 2,) * 4
    wide_x, wide_y = (pad(z.movedim(-1, 0)[None], margin, mode="reflect")[0].movedim(0, -1) for z in (x, y))
    scores = {"ssim": float(ssim(wide_x, wide_y, window=SSIM_WINDOW))}
    x, y = srgb_from_linear(x), srgb_from_linear(y)
    return scores | {f"lpips_{network.name}": float(lpips.distance(network, x, y)) for network in networks}


def _least_squares_scale(
    x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, "3"]:
    """Per channel the factor on `x` with the least squared error; 0 for a channel that is black."""
    power = (x * x)[mask].sum(0)
    return torch.where(power > MIN_POWER, (x * y)[mask].sum(0) / power.clamp_min(MIN_POWER), 0.0)


SCORES: dict[Benchmark, Callable[[Prediction, Truth, Sequence[lpips.Network]], dict[str, float]]] = {
    "tensoir": tensoir,
    "stanford-orb": stanford_orb,
}
"""Protocol of each benchmark."""
_WHITE = "whole picture over white, sRGB; mean over views"
_ORB = (
    "Stanford-ORB: eroded mask, whole picture over black, a least-squares scale per channel and view; mean over views"
)
DEFINITIONS = {
    "tensoir.image_psnr": f"TensoIR: PSNR [dB], {_WHITE}",
    "tensoir.image_ssim": f"TensoIR: SSIM, {_WHITE}",
    "tensoir.image_lpips": f"TensoIR: LPIPS v0.1, {_WHITE}",
    "tensoir.relit_psnr": f"TensoIR: PSNR [dB], {_WHITE} and lights",
    "tensoir.relit_ssim": f"TensoIR: SSIM, {_WHITE} and lights",
    "tensoir.relit_lpips": f"TensoIR: LPIPS v0.1, {_WHITE} and lights",
    "tensoir.albedo_psnr": "TensoIR: PSNR [dB] of linear albedo over white to the power 1/2.2, after the median scale "
    "per channel, pooled over all pixels of all views",
    "tensoir.normal_mae_degrees": "TensoIR: mean angle [degrees], all pixels, upward normals outside the object",
    "orb.image_psnr_h": f"{_ORB}; PSNR-H [dB], radiance clipped at {MAX_HDR:g}",
    "orb.image_psnr_l": f"{_ORB}; PSNR-L [dB], sRGB",
    "orb.image_ssim": f"{_ORB}; SSIM, window of {SSIM_WINDOW}",
    "orb.image_lpips": f"{_ORB}; LPIPS v0.1 of images converted to sRGB twice",
    "orb.relit_psnr_h": f"{_ORB}; views in other places; PSNR-H [dB], radiance clipped at {MAX_HDR:g}",
    "orb.relit_psnr_l": f"{_ORB}; views in other places; PSNR-L [dB], sRGB",
    "orb.relit_ssim": f"{_ORB}; views in other places; SSIM, window of {SSIM_WINDOW}",
    "orb.relit_lpips": f"{_ORB}; views in other places; LPIPS v0.1 of images converted to sRGB twice",
    "orb.albedo_psnr": f"{_ORB}; PSNR [dB], linear albedo",
    "orb.albedo_ssim": f"{_ORB}; SSIM of linear albedo, window of {SSIM_WINDOW}",
    "orb.albedo_lpips": f"{_ORB}; LPIPS v0.1 of albedo converted to sRGB",
    "orb.normal_cosine": "Stanford-ORB: mean of 1 - cosine between normals, eroded mask; mean over views",
}
"""Definition of each score, by key without the name of the network."""
