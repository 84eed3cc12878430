"""How far the live view of a report is from `tumble relight`, for the same light, view and tone mapping.

`python -m benchmarks.relight_panel RUN` opens `RUN/report.html` in headless Chromium, shows each light of the page and
one bright spot (dropped as a file) at the start view, and renders the same with rays and with the split sum. The
number is PSNR [dB] of sRGB values over the pixels that both cover; `--pictures DIR` keeps them side by side.
The spot stands at the right, above, before the object: a flipped or turned map would light another side.
"""

import argparse
import base64
import json
import math
import re
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tests import devtools
from tumble.actions import finished
from tumble.engine import run as runs
from tumble.evaluation import metrics
from tumble.io import files
from tumble.maths import SE3, SO3, srgb_from_linear, texel_directions
from tumble.rendering import buffers_of, relight
from tumble.scene import Asset, Camera, Environment, Trajectory, opengl_from_opencv

SPOT = (0.8, 0.5, 0.4)
"""Camera axes: x right, y up, z to the viewer."""
SETTLED = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
DROP = """(() => {
  const files = new DataTransfer();
  files.items.add(new File([Uint8Array.from(atob("DATA"), (c) => c.charCodeAt(0))], "spot.hdr"));
  dispatchEvent(new DragEvent("drop", { dataTransfer: files, cancelable: true }));
})()"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    page = (arguments.run / "report.html").read_text("utf-8")
    lights = {name: read_light(part(page, name)) for name in ("recovered", "studio", "overcast", "sunset")}
    lights["spot"] = spot()
    shown = panel(arguments.run / "report.html", lights["spot"])
    asset = finished(arguments.run)
    cfg = relight.Config(**runs.recipe(arguments.run)["relight"])
    reference, rows = strength(lights["recovered"]), {}
    for name, picture in shown.items():
        trajectory, camera = start_view(page, *picture.shape[:2])
        cover = buffers_of(asset, trajectory.T_cam_obj[0], camera).alpha
        both = (cover > 0.99) & torch.from_numpy(picture[..., 3] == 255)
        theirs = torch.from_numpy(picture[..., :3]).float() / 255
        rows[name], pictures = {}, [theirs]
        for kind, draw in (("rays", relight.relight), ("split_sum", relight.preview)):
            linear = next(draw(cfg, asset, lights[name], trajectory, camera)) * (reference / strength(lights[name]))
            ours = srgb_from_linear(neutral(linear)).clamp(0, 1)
            rows[name][f"psnr_{kind}"] = round(float(metrics.psnr(ours, theirs, both)), 2)
            ratio = (theirs[both].mean() / ours[both].mean()).item()
            rows[name][f"brightness_over_{kind}"] = round(ratio, 3)
            pictures.append(ours)
        print(name, rows[name], flush=True)
        if arguments.pictures:
            side_by_side = (torch.cat(pictures, 1) * 255).round().to(torch.uint8).numpy()
            files.write_png(arguments.pictures / f"{name}.png", side_by_side)
    command = "python -m benchmarks.relight_panel RUN"
    files.write_json(arguments.out, {"command": command, "run": about(arguments.run, asset), "lights": rows})


def about(run: Path, asset: Asset) -> dict[str, object]:
    return {"capture": runs.source(run).name, "gaussians": len(asset.gaussians)}


def part(page: str, name: str) -> bytes:
    found = re.search(rf'<script type="text/plain" id="{name}">([^<]*)</script>', page)
    assert found is not None, f"the page has no {name}"
    return base64.b64decode(found[1])


def read_light(data: bytes) -> Environment:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "x.hdr").write_bytes(data)
        return Environment.read(Path(folder) / "x.hdr")


def spot() -> Environment:
    """Dark but for one spot of about ten degrees."""
    d = texel_directions(64, 128)
    near = d @ torch.nn.functional.normalize(torch.tensor(SPOT), dim=-1)
    return Environment.from_radiance(
        (0.02 + 200 * torch.sigmoid((near - math.cos(0.09)) / 0.002))[..., None].expand(-1, -1, 3)
    )


def strength(light: Environment) -> float:
    """Mean radiance over the sphere, as the page takes it."""
    return float(light.integral() @ torch.tensor([0.2126, 0.7152, 0.0722])) / (4 * math.pi)


def panel(report: Path, dropped: Environment) -> dict[str, np.ndarray]:
    """What the page draws, straight code values with coverage, by light."""
    assert devtools.browser() is not None, f"needs one of {devtools.BROWSERS}"
    with tempfile.TemporaryDirectory() as folder:
        dropped.write(Path(folder) / "spot.hdr")
        data = base64.b64encode((Path(folder) / "spot.hdr").read_bytes()).decode()
        with devtools.opened(report.resolve().as_uri(), Path(folder), 1400, 900) as tab:
            tab.until("document.documentElement.dataset.panel")
            shown = {}
            for name in ("recovered", "studio", "overcast", "sunset", "spot"):
                press = f"document.querySelector('[data-light={name}]').click()"
                tab.value(DROP.replace("DATA", data) if name == "spot" else press)
                tab.until(f'document.documentElement.dataset.light.startsWith("{name}")')
                tab.value(SETTLED)
                url = tab.value('document.getElementById("view").toDataURL("image/png")')
                values = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
                picture = np.asarray(cv2.imdecode(values, cv2.IMREAD_UNCHANGED))
                shown[name] = np.ascontiguousarray(picture[..., [2, 1, 0, 3]])
            return shown


def start_view(page: str, height: int, width: int) -> tuple[Trajectory, Camera]:
    """The page's camera before anybody turns the object: `panel.js`, functions `home` and `come`."""
    found = re.search(r'id="about">(.*?)</script>', page)
    assert found is not None, "a page with a live view"
    start = json.loads(found[1])
    x, y, z, w = start["object_to_camera"]
    low, high = bounds(part(page, "glb"))
    centre, radius = (low + high) / 2, float((high - low).norm()) / 2
    half = math.radians(min(start["fov"], 90)) / 2
    distance = 1.9 * 0.55 * radius / math.sin(half)
    R_gl_obj = SO3(torch.tensor([w, x, y, z])).matrix()
    flip = opengl_from_opencv(centre)
    t_cam = flip @ (torch.tensor([0.0, 0.0, -distance]) - R_gl_obj @ centre)
    T_cam_obj = SE3.from_rotation(SO3.from_matrix(flip @ R_gl_obj), t_cam)
    focal = height / 2 / math.tan(math.radians(start["fov"]) / 2)
    camera = Camera(torch.tensor([focal, focal, width / 2, height / 2]), height, width)
    return Trajectory(SE3(T_cam_obj.wxyz[None], T_cam_obj.xyz[None]), "camera"), camera


def bounds(glb: bytes) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Corners of the box around the positions, as the file states them."""
    document = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    place = document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    return torch.tensor(document["accessors"][place]["min"]), torch.tensor(document["accessors"][place]["max"])


def neutral(linear: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The Khronos PBR neutral tone mapper, as published."""
    start, desaturation = 0.8 - 0.04, 0.15
    least = linear.amin(-1, keepdim=True)
    colour = linear - torch.where(least < 0.08, least - 6.25 * least**2, 0.04)
    peak = colour.amax(-1, keepdim=True)
    pressed = 1 - (1 - start) ** 2 / (peak + 1 - 2 * start)
    share = 1 - 1 / (desaturation * (peak - pressed) + 1)
    mapped = torch.lerp(colour * pressed / peak.clamp(min=1e-9), pressed.expand_as(colour), share)
    return torch.where(peak < start, colour, mapped)


if __name__ == "__main__":
    main()
