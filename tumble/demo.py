"""The bundled clip: a pot of our own making, turned in front of a still camera, with its truth; and its reconstruction.

`tumble/data/demo/` is a pose-free capture folder whose training photographs are the frames of `clip.mp4`; everything in
it was made by `build`, from code alone.
"""

import shutil
import tempfile
from importlib import resources
from pathlib import Path

from tumble import actions, pipeline
from tumble.datasets import folder as capture_folder
from tumble.engine import run
from tumble.evaluation import Report
from tumble.io import files, video
from tumble.recipes import DRAFT, Recipe
from tumble.report import write_report
from tumble.synthetic import environment, other_environment, write_object

CLIP = "clip.mp4"


def bundled() -> Path:
    """The folder of the bundled clip."""
    return Path(str(resources.files("tumble"))) / "data" / "demo"


def demo_clip(out: Path | str) -> Path:
    """Write the bundled clip as a capture folder without poses, with its truth; returns `out`."""
    return unpack(Path(out))


def unpack(out: Path) -> Path:
    """The bundled clip as a capture folder: its films' frames become pictures. Returns the folder."""
    if (out / "transforms.json").exists():
        return out
    shutil.copytree(bundled(), out, dirs_exist_ok=True, ignore=shutil.ignore_patterns("transforms.json"))
    document = files.read_json(bundled() / "transforms.json")
    names = [frame["file_path"] for frame in document["frames"] if frame["split"] == "train"]
    for name, values in zip(names, video.read_clip(out / CLIP), strict=True):
        files.write_png(files.inside(out, name), values)
    files.write_json(out / "transforms.json", document)
    return out


def reconstruct_clip(out: Path, recipe: Recipe = DRAFT) -> tuple[Report, Path]:
    """Reconstruct the bundled clip from its frames and masks alone, score it, and write its report.

    Returns:
        The scores (docs/metrics.md), and the page.

    Raises:
        BadFile: `out` holds something else.
    """
    with run.alone(out):
        folder = unpack(out / run.CAPTURE)
    pipeline.reconstruct(folder, out, recipe)
    return actions.evaluate_run(out, folder), write_report(out)


def build(out: Path = Path("tumble/data/demo")) -> None:
    """Make the bundled clip anew: object, light, film, masks and truth (extra `synth`; minutes).

    $ python -c "from tumble.demo import build; build()"
    """
    from tumble.synthetic import SETTINGS_FILE, SynthOptions, render_capture

    with tempfile.TemporaryDirectory() as folder_name:
        work = Path(folder_name)
        write_object(work / "pot.glb")
        environment().write(work / "room.hdr")
        other_environment().write(work / "sunset.hdr")
        options = SynthOptions(
            env=str(work / "room.hdr"),
            relight=(str(work / "sunset.hdr"),),
            views=96,
            resolution=192,
            eval_shared=8,
            eval_sphere=2,
            pose_free=True,
            video=True,
        )
        made = render_capture(work / "pot.glb", work / "capture", options)
        (made / SETTINGS_FILE).unlink()
        for frame in capture_folder.load(made).names:
            (made / "images" / frame).unlink()
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(made, out)
