"""How well the frames tell the width of the highlight: what each width that stage 3 tries leaves over.

`python -m benchmarks.widths CAPTURE... --runs FOLDER` takes stage 2 from runs of `benchmarks.decomposition`. A row per
capture: the least mean absolute error [thousandths of sRGB] at each roughness, over all strengths, and that of the
highlight as stage 2 left it (`highlight.fit`).
"""

from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks import of_runs
from tumble.datasets import folder
from tumble.inverse_rendering import decompose, refine, specular_fit
from tumble.io import tree
from tumble.recipes import DRAFT


class Found(Exception):
    """Ends stage 3 once its samples are there."""


def errors(capture: Path, run: Path) -> dict[str, float | dict[str, float]]:
    """What is left over at each width, and as stage 2 left it."""

    def compare(samples: specular_fit.Samples, n: int, which: int, strength: float) -> None:
        def left(width: int, strength: float) -> float:
            return round(1000 * float(specular_fit.left_over(samples, samples.specular[width], strength, n, 0.0)[0]), 3)

        widths = {str(r): min(left(i, s) for s in specular_fit.STRENGTHS) for i, r in enumerate(specular_fit.ROUGHNESS)}
        raise Found({"as_stage_2": left(which, strength), "by_roughness": widths})

    refined = tree.load(refine.Refined, run / "2-refine" / "out.safetensors")
    inputs = decompose.Inputs(folder.load(capture), refined)
    assert isinstance(DRAFT.decompose, decompose.Config), "DRAFT is the method, not a baseline"
    with patch.object(specular_fit, "fit", compare):
        try:
            decompose.init(DRAFT.decompose, inputs, torch.Generator().manual_seed(0))
        except Found as found:
            return found.args[0]
    return {}


if __name__ == "__main__":
    of_runs.main(__file__, __doc__ or "", errors)
