"""From a capture folder to an asset: the stages in order, kept in a run directory."""

from pathlib import Path

from rich.progress import track

from tumble import decompose, files, predict, refine, relight, run, tree
from tumble.asset import Asset
from tumble.capture import Capture
from tumble.datasets import folder
from tumble.environment import Environment
from tumble.files import BadFile
from tumble.images import photograph
from tumble.recipes import Recipe
from tumble.trajectory import Trajectory

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


def predict_run(out: Path, capture_path: Path) -> Path:
    """Render a finished run's answer for a capture's evaluation views as `out/prediction`; returns that folder.

    Raises:
        BadFile: There is no finished run in `out`, or the capture has no evaluation views.
    """
    asset = finished(out)
    capture, truth = folder.load(capture_path), folder.load_truth(capture_path)
    if truth is None or truth.trajectory is None:
        raise BadFile(capture_path, "has no evaluation views with truth")
    predict.predict(_relighting(out), asset, capture, truth).write(out / PREDICTION)
    return out / PREDICTION


def relight_run(out: Path, env: Path, pictures: Path, *, fast: bool) -> None:
    """Write a run's object under another light as `0000.png`, ..., one per training frame.

    The light's frame is the object's.

    Raises:
        BadFile: There is no finished run in `out`, or the light cannot be read.
    """
    asset, light, cfg = finished(out), Environment.read(env), _relighting(out)
    still = Trajectory(asset.trajectory.T_cam_obj, "object")
    draw = relight.preview if fast else relight.relight
    views = draw(cfg, asset, light, still, asset.camera)
    for number, linear in enumerate(track(views, f"relighting under {env.stem}", len(still), transient=True)):
        files.write_png(pictures / f"{number:04}.png", photograph(linear).numpy())


def finished(out: Path) -> Asset:
    """The asset of a finished run.

    Raises:
        BadFile: There is none.
    """
    if not (out / ASSET).is_file():
        raise BadFile(out, f"has no {ASSET}", "finish the run first: tumble run")
    return tree.load(Asset, out / ASSET)


def _relighting(out: Path) -> relight.Config:
    """The run's own way to relight."""
    return relight.Config(**files.read_json(out / run.RECIPE)["recipe"]["relight"])
