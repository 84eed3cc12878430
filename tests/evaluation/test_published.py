"""Scores by the protocols of TensoIR and Stanford-ORB, against sums written out in numpy.

The captures are those of `tests.spheres`, and predictions are their truth with known errors.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tests import spheres
from tumble import datasets
from tumble.evaluation import evaluate, lpips, published
from tumble.evaluation.prediction import Prediction
from tumble.io.files import BadFile
from tumble.maths.images import linear_from_srgb, srgb_from_linear
from tumble.scene.capture import OBJECT, Truth

SCALE = torch.tensor([0.5, 0.8, 0.7])
"""Factor per channel that the scores ignore."""


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: write(tmp_path_factory.mktemp(name)) for name, write in spheres.WRITERS.items()}


def truth_of(path: Path) -> Truth:
    truth = datasets.reader_for(path).load_truth(path)
    assert isinstance(truth, Truth)
    return truth


def perfect(truth: Truth) -> Prediction:
    assert truth.albedo is not None
    return Prediction(
        albedo=truth.albedo * SCALE,
        normals=truth.normals,
        masks=truth.foreground,
        images=truth.images,
        relit=truth.relit,
        elsewhere=None if truth.elsewhere is None else truth.elsewhere.radiance * SCALE,
    )


def noise(like: torch.Tensor) -> torch.Tensor:
    return torch.rand(like.shape, generator=torch.Generator().manual_seed(0))


def psnr(squares: np.ndarray) -> float:
    return -10 * math.log10(float(squares.mean()))


@pytest.mark.parametrize(("name", "limit"), [("tensoir", 99.0), ("stanford_orb", 45.0)])
def test_the_truth_has_the_best_scores(name: str, limit: float, paths: Any, tmp_path: Path) -> None:
    """Written and read as a prediction folder; the photos of Stanford-ORB have eight bits, its truth has more."""
    known = evaluate.read_with_truth(paths[name])
    perfect(known.truth).write(tmp_path / "prediction")
    report = evaluate.score(tmp_path / "prediction", known, tmp_path / "out")
    scores = report["published"]
    assert set(scores) <= set(report["protocol"])
    for key, value in scores.items():
        if "psnr" in key:
            assert value > limit, key
        elif "ssim" in key:
            assert value > 0.999, key
        else:
            assert value == pytest.approx(0, abs=0.05), key
    parts = {"tensoir": ("image_ssim", "relit_lpips_alex", "albedo_psnr", "normal_mae_degrees")}
    parts["stanford_orb"] = ("image_psnr_h", "relit_psnr_l", "relit_lpips_alex", "albedo_ssim", "normal_cosine")
    stem = name.removeprefix("stanford_")
    assert {f"{stem}.{part}" for part in parts[name]} <= set(scores)


def test_albedo_of_tensoir_is_compared_over_white_after_a_median_scale_per_channel(paths: Any) -> None:
    truth = truth_of(paths["tensoir"])
    assert truth.albedo is not None
    predicted = replace(perfect(truth), albedo=(0.5 * truth.albedo + 0.2 * noise(truth.albedo)))
    found = published.tensoir(predicted, truth, [])["tensoir.albedo_psnr"]
    inside = (truth.masks == OBJECT).numpy()
    x, y = predicted.albedo.numpy(), truth.albedo.numpy()  # type: ignore
    scale = np.median(y[inside] / x[inside], axis=0)
    x = np.where(inside[..., None], np.clip(x * scale, 0, 1), 1)
    y = np.where(inside[..., None], y, 1)
    assert found == pytest.approx(psnr((x ** (1 / 2.2) - y ** (1 / 2.2)) ** 2), abs=0.02)


def test_normals_of_tensoir_are_averaged_over_the_whole_picture(paths: Any) -> None:
    truth = truth_of(paths["tensoir"])
    assert truth.normals is not None
    turn = torch.tensor([[1.0, 0, 0], [0, math.cos(0.1), -math.sin(0.1)], [0, math.sin(0.1), math.cos(0.1)]])
    n = torch.tensor([1.0, 0.0, 0.0]).expand_as(truth.normals)
    truth = replace(truth, normals=torch.tensor([0.0, 1.0, 0.0]).expand_as(n).contiguous())
    predicted = replace(perfect(truth), normals=truth.normals @ turn.T)  # type: ignore
    fraction = float((truth.masks == OBJECT).float().mean())
    found = published.tensoir(predicted, truth, [])["tensoir.normal_mae_degrees"]
    assert found == pytest.approx(fraction * math.degrees(0.1), rel=1e-3)


def test_pictures_of_tensoir_are_over_white(paths: Any) -> None:
    """A prediction without the object is white, one without a silhouette is black there."""
    truth = truth_of(paths["tensoir"])
    inside = (truth.masks == OBJECT).numpy()
    nothing = replace(perfect(truth), masks=torch.zeros_like(truth.foreground))
    found = published.tensoir(nothing, truth, [])["tensoir.image_psnr"]
    y = np.where(inside[..., None], truth.images.numpy() / 255, 1.0)
    assert found == pytest.approx(np.mean([psnr((1 - view) ** 2) for view in y]), abs=1e-3)


def orb_numbers(x: np.ndarray, y: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """PSNR-H and PSNR-L of one view, written out."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    x, y = x * inside[..., None], y * inside[..., None]
    scale = np.array([(x[..., c] * y[..., c]).sum() / (x[..., c] ** 2).sum() for c in range(3)])
    shown = np.clip(y, 0, 1)
    gain = srgb_from_linear(torch.from_numpy(shown)).numpy().mean() / shown.mean()
    high = psnr((np.clip(gain * scale * x, 0, 4) - np.clip(gain * y, 0, 4)) ** 2)
    low = [srgb_from_linear(torch.from_numpy(np.clip(z, 0, 1))).numpy() for z in (scale * x, y)]
    return high, psnr((low[0] - low[1]) ** 2)


def test_radiance_of_stanford_orb_is_compared_after_a_scale_per_channel(paths: Any) -> None:
    truth = truth_of(paths["stanford_orb"])
    views = truth.elsewhere
    assert views is not None
    bright = replace(views, radiance=3 * views.radiance)  # some pixels saturate
    truth = replace(truth, elsewhere=bright)
    predicted = views.radiance * SCALE * (0.8 + 0.4 * noise(views.radiance))
    found = published.stanford_orb(Prediction(elsewhere=predicted), truth, [])
    rows = [
        orb_numbers(x.double().numpy(), y.double().numpy(), mask.numpy())
        for x, y, mask in zip(predicted, bright.radiance, views.foreground, strict=True)
    ]
    high, low = np.mean(rows, axis=0)
    assert found["orb.relit_psnr_h"] == pytest.approx(high, abs=1e-3)
    assert found["orb.relit_psnr_l"] == pytest.approx(low, abs=1e-3)
    assert high < low < 40
    again = published.stanford_orb(Prediction(elsewhere=7 * predicted), truth, [])
    assert again["orb.relit_psnr_h"] == pytest.approx(high, abs=1e-3)


def test_a_black_prediction_scores_like_a_grey_one(paths: Any) -> None:
    truth = truth_of(paths["stanford_orb"])
    assert truth.albedo is not None
    found = published.stanford_orb(Prediction(albedo=torch.zeros_like(truth.albedo)), truth, [])["orb.albedo_psnr"]
    rows = []
    for y, mask in zip(truth.albedo.numpy(), (truth.masks == OBJECT).numpy(), strict=True):
        inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))[..., None] > 0
        rows.append(max(psnr((inside * (0.5 - y)) ** 2), psnr((inside * y) ** 2)))
    assert found == pytest.approx(np.mean(rows), abs=1e-3)


def test_lpips_of_stanford_orb_converts_to_srgb_twice(paths: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the benchmark does, whose published numbers contain this."""
    truth = truth_of(paths["stanford_orb"])
    assert truth.radiance is not None
    shown: list[torch.Tensor] = []
    monkeypatch.setattr(published.lpips, "distance", lambda _, x, y: shown.append(y) or torch.zeros(()))
    network = lpips.read()
    published.stanford_orb(Prediction(images=truth.images), truth, [network])
    once = linear_from_srgb(shown[0])
    at = (slice(20, 28), slice(20, 28))
    torch.testing.assert_close(linear_from_srgb(once)[at], truth.radiance[0].clamp(0, 1)[at], atol=1e-4, rtol=0)


def test_captures_of_no_benchmark_have_no_such_scores(paths: Any) -> None:
    truth = replace(truth_of(paths["tensoir"]), benchmark="")
    assert published.published_scores(perfect(truth), truth, []) == ({}, {})


BROKEN: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    r"elsewhere/0001\.exr: holds a negative radiance": lambda x: x - 5 * (torch.arange(3) == 1)[:, None, None, None],
    r"elsewhere/0002\.exr: is missing": lambda x: x[:2],
    r"elsewhere/0000\.exr: is 40 x 48 pixels": lambda x: x[:, :, :40],
}


@pytest.mark.parametrize("message", BROKEN)
def test_broken_views_elsewhere_are_refused(message: str, paths: Any, tmp_path: Path) -> None:
    known = evaluate.read_with_truth(paths["stanford_orb"])
    assert known.truth.elsewhere is not None
    Prediction(elsewhere=BROKEN[message](known.truth.elsewhere.radiance)).write(tmp_path)
    with pytest.raises(BadFile, match=message):
        Prediction.read(tmp_path, known.capture, known.truth)
