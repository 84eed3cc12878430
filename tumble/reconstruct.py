"""From a capture folder to an asset: the stages in order, kept in a run directory."""

from pathlib import Path
from typing import Any

from tumble import decompose, evaluate, files, predict, refine, run, tree
from tumble.asset import Asset
from tumble.capture import Capture
from tumble.datasets import folder
from tumble.files import BadFile
from tumble.recipes import Recipe

ASSET = "asset.safetensors"
PREDICTION = "prediction"


def reconstruct(capture_path: Path, out: Path, recipe: Recipe) -> Asset:
    """Run all stages on a capture with known poses; finished ones are taken from `out`. Truth is never read.

    Writes `asset.safetensors`, `light.exr` and `poses.json` beside the stages' own folders.

    Raises:
        BadFile: The capture breaks a rule or has no poses, or `out` holds another run.
        NotFinite: Training met a NaN; names the tensor, the step and the state that is kept.
    """
    capture = folder.load(capture_path)
    if capture.trajectory is None:
        raise BadFile(capture_path, "has no poses", "stage 1, which estimates them, is not built yet")
    content = run.capture_key(capture)
    opened = run.open(out, capture_path, recipe, content=content)
    refined = run.stage(
        opened, 2, "refine", refine, recipe.refine, refine.Inputs(capture, capture.trajectory), [content]
    )
    key = run.key("refine", refine.VERSION, recipe.refine, [content])
    asset = run.stage(opened, 3, "decompose", decompose, recipe.decompose, decompose.Inputs(capture, refined), [key])
    _keep(asset, capture, out)
    return asset


def _keep(asset: Asset, capture: Capture, out: Path) -> None:
    tree.save(asset, out / ASSET)
    assert asset.environment is not None, "stage 3 finds the light"
    asset.environment.write(out / "light.exr")
    poses = dict(zip(capture.names, asset.trajectory.camera_to_object().tolist(), strict=True))
    files.write_json(out / "poses.json", poses)


def score(out: Path, capture_path: Path, recipe: Recipe) -> dict[str, Any]:
    """Render a run's prediction of a capture's evaluation views, and score it; returns the report.

    Raises:
        BadFile: There is no finished run in `out`, or the capture has no evaluation views.
    """
    if not (out / ASSET).is_file():
        raise BadFile(out, f"has no {ASSET}", "finish the run first: tumble run")
    capture, truth = folder.load(capture_path), folder.load_truth(capture_path)
    if truth is None or truth.trajectory is None:
        raise BadFile(capture_path, "has no evaluation views with truth")
    prediction = predict.predict(recipe.relight, tree.load(Asset, out / ASSET), capture, truth)
    prediction.write(out / PREDICTION)
    return evaluate.run(out / PREDICTION, capture_path, out)
