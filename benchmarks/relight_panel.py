"""PSNR between the live view of a report and `tumble relight`, for the same light, view and tone mapping.

`python -m benchmarks.relight_panel RUN` opens `RUN/report.html` in headless Chromium and captures the start view under
each light of the page and under a bright spot (dropped as a file). It renders the same with rays and with the split
sum. PSNR [dB] of sRGB values is taken over the pixels that both cover; `--pictures DIR` writes the images side by side.
The spot is to the right, above and in front of the object: a flipped or rotated map would light another side.
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
from tumble.rendering import relight, render_gbuffer
from tumble.scene import Asset, Camera, Environment, Trajectory, opengl_from_opencv

SPOT = (0.8, 0.5, 0.4)
"""Direction of the spot, not normalised; camera axes: x right, y up, z to the viewer."""
SETTLED = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
"""JavaScript that waits until the page has drawn a frame."""
DROP = """(() => {
  const files = new DataTransfer();
  files.items.add(new File([Uint8Array.from(atob("DATA"), (c) => c.charCodeAt(0))], "spot.hdr"));
  dispatchEvent(new DragEvent("drop", { dataTransfer: files, cancelable: true }));
})()"""
"""JavaScript that drops a light map on the page; DATA stands for its bytes in base64."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    arguments = parser.parse_args()
    page = (arguments.run / "report.html").read_text("utf-8")
    lights = {name: read_light(embedded_file(page, name)) for name in ("recovered", "studio", "overcast", "sunset")}
    lights["spot"] = spot()
    page_images = capture_panel(arguments.run / "report.html", lights["spot"])
    asset = finished(arguments.run)
    cfg = relight.Config(**runs.recipe(arguments.run)["relight"])
    reference, rows = mean_luminance(lights["recovered"]), {}
    for name, page_image in page_images.items():
        trajectory, camera = start_view(page, *page_image.shape[:2])
        alpha = render_gbuffer(asset, trajectory.T_cam_obj[0], camera).alpha
        covered = (alpha > 0.99) & torch.from_numpy(page_image[..., 3] == 255)
        panel = torch.from_numpy(page_image[..., :3]).float() / 255
        rows[name], images = {}, [panel]
        for kind, render in (("rays", relight.relight), ("split_sum", relight.preview)):
            gain = reference / mean_luminance(lights[name])
            linear = next(render(cfg, asset, lights[name], trajectory, camera)) * gain
            image = srgb_from_linear(neutral_tone_mapping(linear)).clamp(0, 1)
            rows[name][f"psnr_{kind}"] = round(float(metrics.psnr(image, panel, covered)), 2)
            ratio = (panel[covered].mean() / image[covered].mean()).item()
            rows[name][f"brightness_over_{kind}"] = round(ratio, 3)
            images.append(image)
        print(name, rows[name], flush=True)
        if arguments.pictures:
            side_by_side = (torch.cat(images, 1) * 255).round().to(torch.uint8).numpy()
            files.write_png(arguments.pictures / f"{name}.png", side_by_side)
    command = "python -m benchmarks.relight_panel RUN"
    files.write_json(arguments.out, {"command": command, "run": run_facts(arguments.run, asset), "lights": rows})


def run_facts(run: Path, asset: Asset) -> dict[str, object]:
    """Facts about the run for the JSON file."""
    return {"capture": runs.capture_source(run).name, "gaussians": len(asset.gaussians)}


def embedded_file(page: str, name: str) -> bytes:
    """Content of a file that the page embeds as base64."""
    match = re.search(rf'<script type="text/plain" id="{name}">([^<]*)</script>', page)
    assert match is not None, f"the page has no {name}"
    return base64.b64decode(match[1])


def read_light(data: bytes) -> Environment:
    """The environment map in the bytes of an .hdr file."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "x.hdr").write_bytes(data)
        return Environment.read(Path(folder) / "x.hdr")


def spot() -> Environment:
    """A dark environment map with one bright spot of about ten degrees."""
    d = texel_directions(64, 128)
    cosine = d @ torch.nn.functional.normalize(torch.tensor(SPOT), dim=-1)
    return Environment.from_radiance(
        (0.02 + 200 * torch.sigmoid((cosine - math.cos(0.09)) / 0.002))[..., None].expand(-1, -1, 3)
    )


def mean_luminance(light: Environment) -> float:
    """Mean luminance over the sphere, by which the page normalises all lights."""
    return float(light.integral() @ torch.tensor([0.2126, 0.7152, 0.0722])) / (4 * math.pi)


def capture_panel(report: Path, dropped: Environment) -> dict[str, np.ndarray]:
    """Images of the page's live view [h w 4] by light: 8-bit sRGB with unassociated alpha."""
    assert devtools.browser() is not None, f"needs one of {devtools.BROWSERS}"
    with tempfile.TemporaryDirectory() as folder:
        dropped.write(Path(folder) / "spot.hdr")
        data = base64.b64encode((Path(folder) / "spot.hdr").read_bytes()).decode()
        with devtools.opened(report.resolve().as_uri(), Path(folder), 1400, 900) as tab:
            tab.until("document.documentElement.dataset.panel")
            images = {}
            for name in ("recovered", "studio", "overcast", "sunset", "spot"):
                click = f"document.querySelector('[data-light={name}]').click()"
                tab.value(DROP.replace("DATA", data) if name == "spot" else click)
                tab.until(f'document.documentElement.dataset.light.startsWith("{name}")')
                tab.value(SETTLED)
                url = tab.value('document.getElementById("view").toDataURL("image/png")')
                values = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
                bgra = np.asarray(cv2.imdecode(values, cv2.IMREAD_UNCHANGED))
                images[name] = np.ascontiguousarray(bgra[..., [2, 1, 0, 3]])
            return images


def start_view(page: str, height: int, width: int) -> tuple[Trajectory, Camera]:
    """Pose and camera of the page's start view, as computed by `home` and `come` of `panel.js`."""
    match = re.search(r'id="about">(.*?)</script>', page)
    assert match is not None, "the page has no live view"
    start = json.loads(match[1])
    x, y, z, w = start["object_to_camera"]
    low, high = bounding_box(embedded_file(page, "glb"))
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


def bounding_box(glb: bytes) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Minimum and maximum corner of the mesh, from the header of the GLB."""
    document = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    accessor = document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    return torch.tensor(document["accessors"][accessor]["min"]), torch.tensor(document["accessors"][accessor]["max"])


def neutral_tone_mapping(linear: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The Khronos PBR neutral tone mapper, as published."""
    start, desaturation = 0.8 - 0.04, 0.15
    minimum = linear.amin(-1, keepdim=True)
    colour = linear - torch.where(minimum < 0.08, minimum - 6.25 * minimum**2, 0.04)
    peak = colour.amax(-1, keepdim=True)
    compressed = 1 - (1 - start) ** 2 / (peak + 1 - 2 * start)
    weight = 1 - 1 / (desaturation * (peak - compressed) + 1)
    mapped = torch.lerp(colour * compressed / peak.clamp(min=1e-9), compressed.expand_as(colour), weight)
    return torch.where(peak < start, colour, mapped)


if __name__ == "__main__":
    main()
