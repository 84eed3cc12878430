"""A small scene with ground truth from Mitsuba: a figure of body, brim and head under a lamp and a dim sky.

The brim casts shadows on the body, and the parts light each other where they meet. Every part has its own texture, so
that no side looks like another; the body is glossy, the rest matte. The lamp is narrow, so that shading tells how the
object is turned, and the light on the other side has another colour.

$ python -m tests.learning.scene     # renders tests/learning/capture again (extra `synth`; about a minute)
"""

import math
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tumble.maths import texel_directions
from tumble.scene import Environment
from tumble.synthetic import SETTINGS_FILE, SynthOptions, render_capture
from tumble.synthetic.surfaces import pattern, smooth_normals

CAPTURE = Path(__file__).parent / "capture"
"""The committed capture: 32 hand-held frames of 64 x 64 pixels with poses, and 8 evaluation views."""
TRIANGLE_ROWS = 97
"""Rows of vertices per part."""
TEXTURE_ROWS = 128
"""Rows and columns of the texture of each part [pixels]."""

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """A superellipsoid |x/a|^p + |y/b|^p + |z/c|^p = 1 whose texture wanders between two colours."""

    centre: tuple[float, float, float]
    """In an arbitrary unit, as are the half axes a, b, c."""
    axes: tuple[float, float, float]
    power: float
    roughness: float
    """Perceptual roughness."""
    colours: tuple[Colour, Colour]
    """Linear RGB."""


PARTS = {
    "body": Part((0.0, -0.4, 0.0), (0.62, 0.56, 0.62), 2.5, 0.25, ((0.70, 0.55, 0.30), (0.15, 0.30, 0.45))),
    "brim": Part((0.08, 0.18, 0.0), (0.78, 0.07, 0.60), 3.0, 0.7, ((0.60, 0.12, 0.08), (0.65, 0.60, 0.50))),
    "head": Part((0.0, 0.55, 0.1), (0.44, 0.44, 0.44), 2.0, 0.7, ((0.10, 0.40, 0.12), (0.75, 0.65, 0.15))),
}


def light(lamp: Colour = (0.55, 0.55, 0.63), sky: Colour = (-0.9, 0.3, 0.2), rows: int = 64) -> Environment:
    """A warm lamp of about ten degrees, a wide bluish glow, and little light from elsewhere.

    Args:
        lamp: Direction of the lamp, env frame; that of the capture is to the right, above and behind the camera.
        sky: Direction of the glow, env frame.
        rows: Rows of the environment map.
    """
    d_env = texel_directions(rows, 2 * rows)

    def lobe(direction: Colour, width: float) -> torch.Tensor:
        axis = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
        return ((d_env @ axis - 1) / (1 - math.cos(math.radians(width)))).exp()[..., None]

    warm = 40 * lobe(lamp, 10) * torch.tensor([1.0, 0.85, 0.6])
    return Environment.from_radiance(0.1 + warm + 0.6 * lobe(sky, 35) * torch.tensor([0.4, 0.7, 1.0]))


@dataclass(frozen=True)
class Surface:
    """The surface of a part as triangles, in its arbitrary unit."""

    vertices: np.ndarray
    """[v 3]."""
    normals: np.ndarray
    """Unit vertex normals [v 3]."""
    faces: np.ndarray
    """Vertex indices [f 3]."""
    uv: np.ndarray
    """Texture coordinates whose origin is the bottom left corner of the texture [v 2]."""
    albedo: np.ndarray
    """Texture, linear RGB [h w 3]."""


def surface(name: str) -> Surface:
    """The surface of a part of `PARTS`."""
    part, rows = PARTS[name], TRIANGLE_ROWS
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, 2 * rows), indexing="ij")
    d = np.stack([np.sin(v) * np.sin(u), np.cos(v), np.sin(v) * np.cos(u)], -1)
    radius = (np.abs(d) ** part.power).sum(-1, keepdims=True) ** (-1 / part.power)
    vertices = (d * radius * np.array(part.axes)).reshape(-1, 3)
    a = (2 * rows * np.arange(rows - 1)[:, None] + np.arange(2 * rows - 1)).ravel()
    faces = np.concatenate(
        [np.stack([a, a + 2 * rows, a + 2 * rows + 1], 1), np.stack([a, a + 2 * rows + 1, a + 1], 1)]
    )
    same = np.unique(vertices.round(6), axis=0, return_inverse=True)[1].ravel()
    uv = np.stack([u.ravel() / (2 * np.pi), 1 - v.ravel() / np.pi], 1)
    albedo = pattern(np.array(part.colours), (5.0, 3.0), 10 * list(PARTS).index(name), rows=TEXTURE_ROWS)
    return Surface(vertices + np.array(part.centre), smooth_normals(vertices, faces, same), faces, uv, albedo)


def write_figure(path: Path) -> None:
    """The object as a GLB (extra `synth`)."""
    import trimesh
    from PIL import Image

    scene = trimesh.Scene()
    for name, part in PARTS.items():
        shape = surface(name)
        srgb = np.where(shape.albedo < 0.0031308, 12.92 * shape.albedo, 1.055 * shape.albedo ** (1 / 2.4) - 0.055)
        texture = Image.fromarray((255 * srgb).round().astype(np.uint8))
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=texture, roughnessFactor=part.roughness, metallicFactor=0.0
        )
        mesh = trimesh.Trimesh(shape.vertices, shape.faces, vertex_normals=shape.normals, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(uv=shape.uv, material=material)
        scene.add_geometry(mesh, geom_name=name)
    path.write_bytes(scene.export(file_type="glb"))


def render(out: Path, **changes: Any) -> Path:
    """Render the scene as a capture folder; `changes` are options of `tumble synth` (extra `synth`)."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        write_figure(work / "figure.glb")
        light().write(work / "light.hdr")
        light((-0.7, 0.6, -0.4), (0.5, -0.5, 0.7)).write(work / "other.hdr")
        options: dict[str, Any] = {
            "env": str(work / "light.hdr"),
            "relight": (str(work / "other.hdr"),),
            "views": 32,
            "stride": 2,
            "resolution": 64,
            "samples": 1024,
            "eval_shared": 4,
            "eval_sphere": 4,
        }
        return render_capture(work / "figure.glb", out, SynthOptions(**options | changes))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        made = render(Path(name) / "capture")
        for part in (SETTINGS_FILE, "truth/mesh.glb"):
            (made / part).unlink()
        shutil.rmtree(CAPTURE, ignore_errors=True)
        shutil.copytree(made, CAPTURE)
