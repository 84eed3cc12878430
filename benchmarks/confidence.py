"""Rank correlation between the report's confidence and the true albedo error.

`python -m benchmarks.confidence RUN CAPTURE ...` takes pairs of a run, with the capture's own poses, and its capture;
it prints the rows and writes `benchmarks/confidence.json`. For each pixel of the evaluation views that both prediction
and ground truth cover, it compares the albedo error (mean over the channels of the absolute sRGB difference, after the
evaluation's scale per channel) with the three counts of `tumble.export.confidence`, rendered from the Gaussians. A
useful confidence has a negative Spearman's rho.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import spearmanr
from torch import Tensor

from tumble.actions import finished
from tumble.datasets import reader_for
from tumble.engine import run as runs
from tumble.evaluation import metrics
from tumble.export import confidence_of
from tumble.io import files
from tumble.maths import srgb_from_linear
from tumble.rendering import rasterize, render_gbuffer
from tumble.report import small_camera
from tumble.scene import OBJECT, Asset, Truth

COUNTS = {"views": "views", "lights": "lights", "halves": "half_vectors"}
"""Fields of `Confidence` that are compared with the error, by their key in a row."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", type=Path, nargs="+", help="RUN CAPTURE, RUN CAPTURE, ...")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows, pixels = [], []
    for run, capture in zip(arguments.pairs[::2], arguments.pairs[1::2], strict=True):
        truth = reader_for(capture).load_truth(capture)
        assert truth is not None, f"{capture} has no ground truth"
        assert runs.capture_source(run).name == capture.name, f"{run} is a run of another capture than {capture}"
        pixels.append(errors_and_counts(finished(run), truth))
        rows.append({"capture": capture.name, **correlations(pixels[-1])})
        print(rows[-1], flush=True)
    if len(pixels) > 1:
        rows.append({"capture": "all of them together", **correlations(torch.cat(pixels))})
        print(rows[-1])
    files.write_json(arguments.out, {"command": "python -m benchmarks.confidence RUN CAPTURE ...", "rows": rows})


@torch.no_grad()
def errors_and_counts(asset: Asset, truth: Truth) -> Float[Tensor, "m 4"]:
    """Albedo error and counts of each pixel that both prediction and ground truth cover."""
    assert truth.albedo is not None, "the capture needs true albedo"
    assert truth.trajectory is not None, "the capture needs evaluation views"
    confidence, n = confidence_of(asset, small_camera(asset.camera)), len(asset.gaussians)
    counts = torch.stack([getattr(confidence, name) for name in COUNTS.values()], -1)[:, None].expand(n, 4, len(COUNTS))
    albedo, rendered, opaque = [], [], []
    for i in range(len(truth)):
        T_cam_obj = truth.trajectory.T_cam_obj[i]
        view = render_gbuffer(asset, T_cam_obj, asset.camera)
        albedo.append(view.features["albedo"])
        opaque.append(view.alpha > 0.99)
        rendered.append(rasterize(asset.gaussians, asset.gamma, T_cam_obj, asset.camera, {"counts": counts}))
    estimate, covered = torch.stack(albedo), torch.stack(opaque) & (truth.masks == OBJECT)
    scaled = (estimate * metrics.albedo_scale(estimate, truth.albedo, covered)).clamp(0, 1)
    error = (srgb_from_linear(scaled) - srgb_from_linear(truth.albedo)).abs().mean(-1, keepdim=True)
    values = torch.stack([buffers.features["counts"] for buffers in rendered])
    return torch.cat([error, values], -1)[covered]


def correlations(pixels: Float[Tensor, "m 4"]) -> dict[str, object]:
    """A row: for each count Spearman's rho, and the mean errors in its lowest and highest quartiles."""
    error = pixels[:, 0]
    row: dict[str, object] = {"pixels": len(pixels), "error_srgb": round(float(error.mean()), 4)}
    for name, values in zip(COUNTS, pixels[:, 1:].T, strict=True):
        low, high = (np.quantile(values.numpy(), q) for q in (0.25, 0.75))
        row[name] = {
            "rho": round(float(np.asarray(spearmanr(values.numpy(), error.numpy()))[0]), 3),
            "error_of_lowest_quarter": round(float(error[values <= low].mean()), 4),
            "error_of_highest_quarter": round(float(error[values >= high].mean()), 4),
        }
    return row


if __name__ == "__main__":
    main()
