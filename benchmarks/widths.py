"""How well the images determine the roughness: the error of each roughness that stage 3 tries at its start.

`python -m benchmarks.widths CAPTURE... --runs FOLDER` takes stage 2 from runs of `benchmarks.decomposition`. A row per
capture has the minimum mean absolute error [thousandths of sRGB] at each roughness, over all specular scales, and the
error with the specular lobe of stage 2 (`specular_fit.fit`).
"""

from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks import of_runs
from tumble.datasets import folder
from tumble.inverse_rendering import decompose, refine, specular_fit
from tumble.io import tree
from tumble.recipes import DRAFT


class Result(Exception):
    """Carries the row and ends stage 3 as soon as its samples are known."""


def errors(capture: Path, run: Path) -> dict[str, float | dict[str, float]]:
    """The row of one capture and its run."""

    def compare(samples: specular_fit.Samples, n: int, roughness_index: int, specular_scale: float) -> None:
        def error(index: int, scale: float) -> float:
            return round(1000 * float(specular_fit.fit_error(samples, samples.specular[index], scale, n, 0.0)[0]), 3)

        by_roughness = {
            str(r): min(error(i, s) for s in specular_fit.SPECULAR_SCALES)
            for i, r in enumerate(specular_fit.ROUGHNESSES)
        }
        raise Result({"as_stage_2": error(roughness_index, specular_scale), "by_roughness": by_roughness})

    refined = tree.load(refine.Refined, run / "2-refine" / "out.safetensors")
    inputs = decompose.Inputs(folder.load(capture), refined)
    assert isinstance(DRAFT.decompose, decompose.Config), "DRAFT is the method, not a baseline"
    with patch.object(specular_fit, "fit", compare):
        try:
            decompose.init(DRAFT.decompose, inputs, torch.Generator().manual_seed(0))
        except Result as result:
            return result.args[0]
    return {}


if __name__ == "__main__":
    of_runs.main(__file__, __doc__ or "", errors)
