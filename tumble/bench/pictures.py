"""The picture of a row: one evaluation view, above the truth and below the prediction."""

from pathlib import Path

import numpy as np
import torch

from tumble.evaluation import Prediction, Report, read_with_truth
from tumble.maths import to_srgb8
from tumble.report import panorama, webp_file
from tumble.scene import Environment

LIGHT_RATIO = 2
"""Width of a light map over its height."""


def picture_of(capture: Path, prediction: Path, report: Report) -> bytes:
    """WebP image of truth (above) and prediction (below): albedo, relit image and light; black where there is none.

    The albedo and the light have the scale of the evaluation.
    """
    known = read_with_truth(capture)
    predicted, truth = Prediction.read(prediction, known.capture, known.truth), known.truth
    side = known.capture.camera.height
    nothing = np.zeros((side, known.capture.camera.width, 3), np.uint8)
    scale = torch.tensor(report["albedo_scale"] or [1.0, 1.0, 1.0])
    masks = predicted.silhouettes
    views = truth.views("shared") or list(range(len(truth)))
    i = views[0] if views else 0
    strips = []
    for of, factor in ((truth, torch.ones(3)), (predicted, scale)):
        albedo, relit = nothing, nothing
        if of.albedo is not None:
            mask = masks[i] if of is predicted and masks is not None else truth.foreground[i]
            albedo = to_srgb8(of.albedo[i] * factor * mask[..., None]).numpy()
        if lights := sorted(truth.relit.keys() & predicted.relit.keys()):
            relit = of.relit[lights[0]][i].numpy()
        light = np.zeros((side, LIGHT_RATIO * side, 3), np.uint8)
        if of.light is not None:
            light = panorama(Environment.from_radiance(of.light.radiance / factor), side)
        strips.append(np.concatenate([albedo, relit, light], 1))
    return webp_file(np.concatenate(strips, 0))
