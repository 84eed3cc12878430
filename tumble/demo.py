"""The bundled demo clip and its reconstruction.

The clip is a rendered video of a coffee pot that rotates in front of a still camera. `tumble/data/demo/` is a capture
folder without poses, with ground truth; its training images are stored as the frames of `clip.mp4`. `build` generates
all of it from code.
"""

import shutil
import tempfile
from importlib import resources
from pathlib import Path

from tumble import actions, pipeline
from tumble.datasets import folder as capture_folder
from tumble.engine import run
from tumble.evaluation import Report
from tumble.io import BadFile, files, video
from tumble.recipes import DRAFT, Recipe
from tumble.rendering import usable_device
from tumble.report import write_report
from tumble.synthetic import room_environment, sunset_environment, write_pot

CLIP = "clip.mp4"
"""Name of the video in the bundled folder."""


def bundled_folder() -> Path:
    """Path of the bundled clip's folder inside the installed package."""
    return Path(str(resources.files("tumble"))) / "data" / "demo"


def demo_clip(out: Path | str) -> Path:
    """Write the bundled clip to `out` as a capture folder without poses, with ground truth; returns the folder."""
    return unpack(Path(out))


def unpack(out: Path) -> Path:
    """Copy the bundled clip to `out` as a capture folder, with the video's frames as its images; returns the folder.

    A folder that holds the clip already is returned unchanged.

    Raises:
        BadFile: `out` holds another capture.
    """
    document = files.read_json(bundled_folder() / "transforms.json")
    if (out / "transforms.json").exists():
        if files.read_json(out / "transforms.json") != document:
            raise BadFile(out, "holds a capture other than the bundled clip", run.WRONG_FOLDER)
        return out
    # The package may be installed read-only: modes of its files and folders are not copied.
    bundled = bundled_folder()
    for path in bundled.rglob("*"):
        place = out / path.relative_to(bundled)
        if path.is_file() and path.name != "transforms.json":
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)
    names = [frame["file_path"] for frame in document["frames"] if frame["split"] == "train"]
    for name, values in zip(names, video.read_clip(out / CLIP), strict=True):
        files.write_png(files.path_inside(out, name), values)
    files.write_json(out / "transforms.json", document)
    return out


def reconstruct_clip(out: Path, recipe: Recipe = DRAFT, *, device: str = "cpu") -> tuple[Report, Path]:
    """Reconstruct the bundled clip from its frames and masks, evaluate the result, and write the report page.

    Returns:
        The scores (docs/metrics.md), and the path of the page.

    Raises:
        BadFile: `out` holds something else.
        ValueError: There is no such device.
    """
    place = usable_device(device)
    with run.exclusive_access(out):
        folder = unpack(out / run.CAPTURE)
    pipeline.reconstruct(folder, out, recipe, device=place)
    return actions.evaluate_run(out, folder, device=device), write_report(out, device=place)


def build(out: Path = Path("tumble/data/demo")) -> None:
    """Generate the bundled clip again: object, light, video, masks and ground truth (extra `synth`; takes minutes).

    $ python -c "from tumble.demo import build; build()"
    """
    from tumble.synthetic import SETTINGS_FILE, SynthOptions, render_capture

    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        write_pot(work / "pot.glb")
        room_environment().write(work / "room.hdr")
        sunset_environment().write(work / "sunset.hdr")
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
        capture = render_capture(work / "pot.glb", work / "capture", options)
        (capture / SETTINGS_FILE).unlink()
        for frame in capture_folder.load(capture).names:
            (capture / "images" / frame).unlink()
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(capture, out)
