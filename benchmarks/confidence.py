"""Whether the report's confidence tells where the albedo is wrong: rank correlation with its true error.

`python -m benchmarks.confidence RUN CAPTURE ...` (pairs; runs with the capture's own poses) prints and writes
`benchmarks/confidence.json`. Per pixel of the evaluation views that prediction and truth both cover: the error of the
albedo (mean over the channels of the absolute difference in sRGB, after the one scale per channel of the evaluation),
and the three counts of `tumble.confidence`, rendered from the Gaussians. Spearman's rho; negative is what is hoped for.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import spearmanr
from torch import Tensor

from tumble.actions import finished
from tumble.datasets import which
from tumble.engine import run as runs
from tumble.evaluation import metrics
from tumble.export import confidence_of
from tumble.io import files
from tumble.maths import srgb_from_linear
from tumble.rendering import buffers_of, rasterize
from tumble.report import small_camera
from tumble.scene import OBJECT, Asset, Truth

COUNTS = ("views", "lights", "halves")
"""Fields of `Confidence`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", type=Path, nargs="+", help="RUN CAPTURE, RUN CAPTURE, ...")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    rows, pixels = [], []
    for run, capture in zip(arguments.pairs[::2], arguments.pairs[1::2], strict=True):
        truth = which(capture).load_truth(capture)
        assert truth is not None, f"{capture} has no truth"
        assert runs.source(run).name == capture.name, "another capture's run"
        pixels.append(counted(finished(run), truth))
        rows.append({"capture": capture.name, **correlations(pixels[-1])})
        print(rows[-1], flush=True)
    if len(pixels) > 1:
        rows.append({"capture": "all of them together", **correlations(torch.cat(pixels))})
        print(rows[-1])
    files.write_json(arguments.out, {"command": "python -m benchmarks.confidence RUN CAPTURE ...", "rows": rows})


@torch.no_grad()
def counted(asset: Asset, truth: Truth) -> Float[Tensor, "m 4"]:
    """Per pixel that both cover: the error of the albedo, and the counts."""
    assert truth.albedo is not None, "a capture with true albedo"
    assert truth.trajectory is not None, "a capture with evaluation views"
    seen, n = confidence_of(asset, small_camera(asset.camera)), len(asset.gaussians)
    counts = torch.stack([getattr(seen, name) for name in COUNTS], -1)[:, None].expand(n, 4, len(COUNTS))
    albedo, rendered, solid = [], [], []
    for i in range(len(truth)):
        T_cam_obj = truth.trajectory.T_cam_obj[i]
        view = buffers_of(asset, T_cam_obj, asset.camera)
        albedo.append(view.features["albedo"])
        solid.append(view.alpha > 0.99)
        rendered.append(rasterize(asset.gaussians, asset.gamma, T_cam_obj, asset.camera, {"counts": counts}))
    found, both = torch.stack(albedo), torch.stack(solid) & (truth.masks == OBJECT)
    scaled = (found * metrics.albedo_scale(found, truth.albedo, both)).clamp(0, 1)
    error = (srgb_from_linear(scaled) - srgb_from_linear(truth.albedo)).abs().mean(-1, keepdim=True)
    values = torch.stack([buffers.features["counts"] for buffers in rendered])
    return torch.cat([error, values], -1)[both]


def correlations(pixels: Float[Tensor, "m 4"]) -> dict[str, object]:
    """One row: Spearman's rho per count, and the mean errors of its lowest and of its highest quarter."""
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
