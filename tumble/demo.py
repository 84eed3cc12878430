"""The bundled clip: a pot of our own making, turned in front of a still camera, with its truth.

`tumble/data/demo/` is a pose-free capture folder whose training photographs are the frames of `clip.mp4`; everything in
it was made by `build`, from code alone.
"""

import base64
import html
import shutil
import tempfile
from importlib import resources
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from tumble import files, video
from tumble.capture import Capture, Truth
from tumble.datasets import folder
from tumble.environment import Environment
from tumble.images import photograph

CLIP = "clip.mp4"


def bundled() -> Path:
    """The folder of the bundled clip."""
    return Path(str(resources.files("tumble"))) / "data" / "demo"


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


def run(out: Path) -> Path:
    """Unpack the clip, and show it and its truth on one page; returns the page."""
    capture_folder = unpack(out / "capture")
    capture, truth = folder.load(capture_folder), folder.load_truth(capture_folder)
    assert truth is not None, "the bundled clip has truth"
    page = out / "report.html"
    files.write_whole(page, lambda partial: partial.write_text(_page(capture, truth), "utf-8"))
    return page


def build(out: Path = Path("tumble/data/demo")) -> None:
    """Make the bundled clip anew: object, light, film, masks and truth (extra `synth`; minutes).

    $ python -c "from tumble.demo import build; build()"
    """
    from tumble import demo_assets
    from tumble.synthesize import NOTE, Options, synthesize

    with tempfile.TemporaryDirectory() as folder_name:
        work = Path(folder_name)
        demo_assets.write_object(work / "pot.glb")
        demo_assets.environment().write(work / "room.hdr")
        demo_assets.other_environment().write(work / "sunset.hdr")
        options = Options(
            env=str(work / "room.hdr"),
            relight=(str(work / "sunset.hdr"),),
            views=96,
            resolution=192,
            eval_shared=8,
            eval_sphere=2,
            pose_free=True,
            video=True,
        )
        made = synthesize(work / "pot.glb", work / "capture", options)
        (made / NOTE).unlink()
        for frame in folder.load(made).names:
            (made / "images" / frame).unlink()
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(made, out)


# The page -------------------------------------------------------------------------------------------------------------


def _page(capture: Capture, truth: Truth) -> str:
    views = truth.views("shared")[:4] + truth.views("sphere")[:2]
    assert truth.albedo is not None
    assert truth.roughness is not None
    assert truth.normals is not None
    object_pixels = truth.foreground[views][..., None]
    normals = ((truth.normals[views] * 0.5 + 0.5) * 255).to(torch.uint8) * object_pixels
    roughness = (truth.roughness[views][..., None] * 255).to(torch.uint8).expand(-1, -1, -1, 3)
    rows = {
        "photograph": truth.images[views],
        "albedo": photograph(truth.albedo[views]),
        "roughness": roughness,
        "normal": normals,
    } | {f"under {name}": pictures[views] for name, pictures in truth.relit.items()}
    lights = {"of the film": truth.light} | truth.lights
    sections = [
        ("The film", f"{len(capture)} frames; the camera and the light stand still, the object turns.", _film(capture)),
        ("Its truth", "Views that no reconstruction is shown.", _table(rows)),
        ("The light", "Equirectangular, tone-mapped.", _lights({k: v for k, v in lights.items() if v is not None})),
    ]
    body = "".join(
        f"<section><h2>{title}</h2><p>{html.escape(text)}</p>{inner}</section>" for title, text, inner in sections
    )
    return _HEAD + f"<main><h1>tumble <small>the bundled clip</small></h1>{body}</main></html>"


_HEAD = """<!doctype html><html lang="en"><meta charset="utf-8"><title>tumble: the bundled clip</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root { color-scheme: dark; } body { margin: 0; background: #15171a; color: #e8e6e1;
  font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 76rem; margin: auto; padding: 2rem 1.5rem 4rem; } h1 { font-weight: 650; letter-spacing: -.02em; }
h1 small { font-weight: 400; color: #9aa0a6; margin-left: .5rem; } h2 { margin: 2.5rem 0 0; font-weight: 600; }
p { margin: .2rem 0 1rem; color: #9aa0a6; } img { display: block; width: 100%; height: auto; image-rendering: auto; }
.film { display: grid; grid-template-columns: repeat(8, 1fr); gap: 2px;
  background: #000; border-radius: 10px; overflow: hidden; }
table { border-collapse: collapse; width: 100%; background: #000; border-radius: 10px; overflow: hidden; }
th { text-align: right; font-weight: 500; padding: 0 .8rem; color: #b9bec4; width: 7rem; } td { padding: 1px; }
.lights { display: grid; grid-template-columns: repeat(auto-fit, minmax(20rem, 1fr)); gap: 1rem; }
figure { margin: 0; } figcaption { color: #b9bec4; padding: .3rem 0; } .lights img { border-radius: 10px; }
</style>
"""


def _film(capture: Capture) -> str:
    step = max(1, len(capture) // 24)
    return f'<div class="film">{"".join(map(_picture, capture.images[::step][:24]))}</div>'


def _table(rows: dict[str, torch.Tensor]) -> str:
    cells = {name: "".join(f"<td>{_picture(picture)}</td>" for picture in pictures) for name, pictures in rows.items()}
    return f"<table>{''.join(f'<tr><th>{html.escape(name)}</th>{row}</tr>' for name, row in cells.items())}</table>"


def _lights(lights: dict[str, Environment]) -> str:
    figures = []
    for name, light in lights.items():
        # Half of the radiance range of a room lies above what a screen shows: a soft shoulder keeps the lamp's shape.
        radiance = light.radiance / light.radiance.mean()
        shown = _picture(photograph(radiance / (1 + radiance)))
        figures.append(f"<figure>{shown}<figcaption>{html.escape(name)}</figcaption></figure>")
    return f'<div class="lights">{"".join(figures)}</div>'


def _picture(values: torch.Tensor | UInt8[np.ndarray, "h w 3"]) -> str:
    """An image element that carries its picture with it."""
    stream = BytesIO()
    Image.fromarray(np.asarray(values)).save(stream, "PNG")
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}">'
