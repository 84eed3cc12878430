"""What other programs open: a textured GLB, two PLYs of the Gaussians, the light, the poses.

The GLB's frame is the object's: +y up, where up means something, as glTF has it. All files of one export share one
length of the object radius in metres: 1 without a scale. The writer is our own: a GLB is a JSON document and a buffer.
"""

import io
import json
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from tumble import __version__
from tumble.export import bake, confidence, mesh
from tumble.export.bake import Textures
from tumble.export.mesh import Mesh, Unwrapped
from tumble.io import files
from tumble.maths.directions import fibonacci_sphere
from tumble.maths.images import srgb_from_linear
from tumble.rendering import shade
from tumble.rendering.prefilter import prefilter
from tumble.rendering.shade import Surface
from tumble.rendering.trace import open_sky
from tumble.scene.asset import Asset
from tumble.scene.gaussians import opacity
from tumble.scene.material import DIELECTRIC
from tumble.scene.trajectory import Trajectory

PADDING = 8
"""Least number of texels between charts."""
SH_DC, SH_REST = 0.28209479177387814, 45
"""Harmonic of degree 0, and how many further coefficients the common layout has."""
FLOAT, SHORT, INT = 5126, 5123, 5125
ARRAY, ELEMENTS = 34962, 34963
"""Numbers of glTF 2.0, sections 3.6.2 and 5.11."""


@dataclass(frozen=True)
class Preset:
    """How fine a mesh is made."""

    triangles: int
    texture: int
    """Side of the textures [texels]."""
    cells: int
    """Of the grid, per side."""
    views: int = 64
    """Depth maps that are fused; three quarters of them for the textures."""
    pixels: int = 768
    """Side of the rendered maps."""


Name = Literal["web", "game", "film", "splat"]
PRESETS: dict[str, Preset | None] = {
    "web": Preset(triangles=20_000, texture=2048, cells=256),
    "game": Preset(triangles=8_000, texture=1024, cells=256),
    "film": Preset(triangles=50_000, texture=4096, cells=384, views=96, pixels=1024),
    "splat": None,
}
"""web: up to 10 MB; splat: no mesh at all."""
CONFIDENCE = "confidence.png"
COARSE = Preset(triangles=20_000, texture=256, cells=128, views=32, pixels=256)
"""Enough to measure a size."""


def export(asset: Asset, names: list[str], out: Path, preset: Name, scale_mm: float | None = None) -> None:
    """Write a folder: `asset.glb` and `confidence.png` (not for "splat"), both PLYs, `light.*`, `poses*`, `bop/`.

    Args:
        names: Of the frames, in the order of the trajectory.
        scale_mm: Largest distance between two points of the object, as a ruler finds it [mm].
    """
    chosen = PRESETS[preset]
    shape = surface(asset, chosen) if chosen else surface(asset, COARSE) if scale_mm else None
    metres = 1.0 if scale_mm is None or shape is None else scale_mm / 1000 / mesh.diameter(shape.vertices)
    if chosen and shape:
        glb(asset, shape, chosen, metres, out / "asset.glb")
    write_ply(out / "asset.ply", splats(asset, metres))
    write_ply(out / "asset_material.ply", splats(asset, metres) | material_columns(asset))
    light(asset, out)
    poses(asset.trajectory, asset, names, metres, out)
    about = {
        "preset": preset,
        "metres_per_object_radius": metres,
        "scale_mm": scale_mm,
        "frame": "x right, y up, z to the viewer; the same for GLB, PLYs and poses",
        "units": "metres" if scale_mm else "object radius (written where metres stand)",
        "f0": None if asset.material is None else float(asset.material.f0),
        "tumble": __version__,
    }
    files.write_json(out / "export.json", about)


def surface(asset: Asset, preset: Preset) -> Mesh:
    """The object's triangles, object frame.

    Raises:
        ValueError: The Gaussians show no surface.
    """
    values = mesh.distances(asset.gaussians, asset.gamma, cells=preset.cells, views=preset.views, pixels=preset.pixels)
    if values.min() >= 0:
        raise ValueError("the Gaussians show no surface: nothing to make triangles of; try --preset splat")
    return mesh.simplified(
        mesh.without_floaters(mesh.march(values, -mesh.REACH, 2 * mesh.REACH / preset.cells)), preset.triangles
    )


def glb(asset: Asset, shape: Mesh, preset: Preset, metres: float, path: Path) -> None:
    """Unwrap, bake and write the GLB, and beside it how sure its material is, over the same coordinates."""
    flat = mesh.unwrapped(shape, preset.texture, PADDING)
    textures = bake.bake(asset, flat, resolution=preset.texture, views=3 * preset.views // 4, pixels=preset.pixels)
    assert asset.material is not None, "an asset with material"
    if asset.environment is not None:
        score = confidence.confidence(asset, asset.camera).score
        files.write_png(path.parent / CONFIDENCE, bake.spread(score, asset, flat, resolution=512)[..., None])
    write_glb(path, flat, textures, f0=float(asset.material.f0), metres=metres)


# GLB ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Buffer:
    """The binary chunk as it grows, and the views and accessors into it."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def view(self, values: bytes, **more: int) -> int:
        self.data.extend(b"\0" * (-len(self.data) % 4))
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(values), **more})
        self.data.extend(values)
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, kind: str, component: int, *, target: int, bounds: bool = False) -> int:
        about = {"componentType": component, "count": len(values), "type": kind}
        if bounds:
            about |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append({"bufferView": self.view(values.tobytes(), target=target), **about})
        return len(self.accessors) - 1

    def png(self, values: UInt8[np.ndarray, "h w *c"]) -> dict[str, Any]:
        file = io.BytesIO()
        Image.fromarray(values).save(file, "PNG", optimize=False, compress_level=9)
        return {"bufferView": self.view(file.getvalue()), "mimeType": "image/png"}


def write_glb(path: Path, flat: Unwrapped, textures: Textures, *, f0: float, metres: float) -> None:
    """A glTF 2.0 binary with one mesh and one dielectric metallic-roughness material.

    Reflectance at normal incidence goes into KHR_materials_ior, below 0.04 into KHR_materials_specular; viewers without
    them show 0.04.
    Tangents are those that the normal map was baked with.
    """
    buffer = _Buffer()
    rough = textures.roughness
    red, blue = np.full_like(rough, 255), np.zeros_like(rough)
    images = [buffer.png(x) for x in (textures.base_color, np.stack([red, rough, blue], -1), textures.normal)]
    vertices = (flat.vertices * metres).astype(np.float32)
    few = len(vertices) < 65535
    attributes = {
        "POSITION": buffer.accessor(vertices, "VEC3", FLOAT, target=ARRAY, bounds=True),
        "NORMAL": buffer.accessor(_unit32(flat.normals), "VEC3", FLOAT, target=ARRAY),
        "TANGENT": buffer.accessor(_tangents32(flat.tangents), "VEC4", FLOAT, target=ARRAY),
        "TEXCOORD_0": buffer.accessor(flat.uv.astype(np.float32), "VEC2", FLOAT, target=ARRAY),
    }
    indices = flat.faces.astype(np.uint16 if few else np.uint32).reshape(-1, 1)
    material: dict[str, Any] = {
        "name": "object",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 0.0,
        },
        "normalTexture": {"index": 2},
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"tumble {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "object"}],
        "meshes": [{"primitives": [{"attributes": attributes, "material": 0}]}],
        "materials": [material],
        "textures": [{"source": i, "sampler": 0} for i in range(3)],
        # Linear filters with mipmaps; clamped to the edge.
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": images,
    }
    document["meshes"][0]["primitives"][0]["indices"] = buffer.accessor(
        indices, "SCALAR", SHORT if few else INT, target=ELEMENTS
    )
    if abs(f0 - DIELECTRIC) > 1e-4:
        name, value = specular(f0)
        material["extensions"], document["extensionsUsed"] = {name: value}, [name]
    document |= {"bufferViews": buffer.views, "accessors": buffer.accessors, "buffers": [{}]}
    binary = bytes(buffer.data) + b"\0" * (-len(buffer.data) % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    whole = (
        header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    files.write_whole(path, lambda partial: partial.write_bytes(whole))


def specular(f0: float) -> tuple[str, dict[str, float]]:
    """What glTF says for a reflectance at normal incidence: below glass a dimmed highlight (as `brdf.fresnel` has it,
    grazing angles too), above it an index."""
    if f0 < DIELECTRIC:
        return "KHR_materials_specular", {"specularFactor": f0 / DIELECTRIC}
    return "KHR_materials_ior", {"ior": (1 + math.sqrt(f0)) / (1 - math.sqrt(f0))}


def _unit32(x: Float[np.ndarray, "n 3"]) -> np.ndarray:
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def _tangents32(x: Float[np.ndarray, "n 4"]) -> np.ndarray:
    return np.concatenate([_unit32(x[:, :3]), x[:, 3:].astype(np.float32)], 1)


# PLY ------------------------------------------------------------------------------------------------------------------


def write_ply(path: Path, columns: dict[str, Float[np.ndarray, " n"]]) -> None:
    """One row of 32-bit floats per Gaussian, binary, little endian."""
    table = np.stack([np.asarray(values, "<f4") for values in columns.values()], 1)
    names = "".join(f"property float {name}\n" for name in columns)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{names}end_header\n"
    files.write_whole(path, lambda partial: partial.write_bytes(head.encode() + table.tobytes()))


@torch.no_grad()
def splats(asset: Asset, metres: float) -> dict[str, Float[np.ndarray, " n"]]:
    """The common layout of 3D Gaussian splatting: what splat viewers, which know no light, show.

    Colour is that of the first frame, sRGB, the same from all sides; the layout's harmonics beyond are zero.
    """
    gaussians = asset.gaussians
    alpha = opacity(gaussians.sdf, asset.gamma).clamp(1e-4, 1 - 1e-4)
    colour = (srgb_from_linear(_lit(asset)).clamp(0, 1) - 0.5) / SH_DC
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    groups = {
        ("x", "y", "z"): gaussians.means * metres,
        ("nx", "ny", "nz"): gaussians.normals,
        ("f_dc_0", "f_dc_1", "f_dc_2"): colour,
        tuple(f"f_rest_{i}" for i in range(SH_REST)): colour.new_zeros(len(colour), SH_REST),
        ("opacity",): torch.logit(alpha)[:, None],
        ("scale_0", "scale_1", "scale_2"): gaussians.log_scales + math.log(metres),
        ("rot_0", "rot_1", "rot_2", "rot_3"): quats,
    }
    return {name: values[:, i].cpu().numpy() for key, values in groups.items() for i, name in enumerate(key)}


@torch.no_grad()
def material_columns(asset: Asset) -> dict[str, Float[np.ndarray, " n"]]:
    """Linear albedo, perceptual roughness and reflectance at normal incidence, mean over the corners."""
    material = asset.material
    assert material is not None, "an asset with material"
    albedo = material.albedo.mean(1)
    columns = {f"albedo_{i}": albedo[:, i] for i in range(3)}
    columns |= {"roughness": material.roughness.mean(1), "f0": material.f0.expand(len(albedo))}
    return {name: values.cpu().numpy() for name, values in columns.items()}


def _lit(asset: Asset) -> Float[Tensor, "n 3"]:
    """Linear radiance of every Gaussian under the light of the first frame, nothing in the way, seen head-on."""
    material, environment, gaussians = asset.material, asset.environment, asset.gaussians
    if material is None or environment is None:
        return (gaussians.sh[:, 0] * SH_DC).clamp(min=0)
    normals, n = gaussians.normals, len(gaussians)
    points = Surface(torch.arange(n, device=normals.device), gaussians.means, normals, normals)
    sky = open_sky(fibonacci_sphere(512).to(normals), n)
    R_env_obj = asset.trajectory.R_env_obj[0]
    roughness = material.roughness.mean(1, keepdim=True)
    return shade.shade_split(
        points, material.albedo.mean(1), roughness, prefilter(environment), R_env_obj, sky, f0=float(material.f0)
    )


# Light and poses ------------------------------------------------------------------------------------------------------


def light(asset: Asset, out: Path) -> None:
    """`light.exr`, `light.hdr`, and `light.json`, which says how they lie."""
    environment, trajectory = asset.environment, asset.trajectory
    if environment is None:
        return
    environment.write(out / "light.exr")
    environment.write(out / "light.hdr")
    frames = {
        "camera": "the camera's, OpenGL axes (x right, y up, z to the viewer): the light stood still with the camera",
        "object": "the object's, that of the GLB: the light stood still with the object",
    }
    about = {
        "projection": "equirectangular",
        "radiance": "linear RGB, primaries of sRGB, up to one factor",
        "frame": frames[trajectory.light],
        "up": "+y, the top row",
        "zero_azimuth": "-z, the centre column; +x is at three quarters of the width",
        "u": "atan2(x, -z) / (2 pi) + 1/2, from the left",
        "v": "acos(y) / pi, from the top",
        "R_light_object_of_first_frame": trajectory.R_env_obj[0].tolist(),
    }
    files.write_json(out / "light.json", about)


def poses(trajectory: Trajectory, asset: Asset, names: list[str], metres: float, out: Path) -> None:
    """The track in three forms: `poses.json`, `poses_tum.txt`, and `bop/scene_gt.json` with `bop/scene_camera.json`.

    JSON: camera to object, OpenGL camera axes, as in a capture. TUM: the camera in the object frame, OpenCV axes, the
    frame's number as time. BOP: object to camera, OpenCV axes, millimetres.
    """
    matrices = trajectory.camera_to_object().double()
    matrices[:, :3, 3] *= metres
    files.write_json(out / "poses.json", dict(zip(names, matrices.tolist(), strict=True)))
    numbers = _numbers(names)
    T_obj_cam = trajectory.T_cam_obj.inverse()
    lines = ["# timestamp tx ty tz qx qy qz qw: camera in the object frame; the timestamp is the frame's number"]
    for number, xyz, wxyz in zip(numbers, T_obj_cam.xyz.double() * metres, T_obj_cam.wxyz.double(), strict=True):
        w, x, y, z = wxyz.tolist()
        lines.append(" ".join([str(number), *(f"{value:.9g}" for value in [*xyz.tolist(), x, y, z, w])]))
    text = "\n".join(lines) + "\n"
    files.write_whole(out / "poses_tum.txt", lambda partial: partial.write_text(text, "utf-8"))
    R_cam_obj = trajectory.T_cam_obj.rotation.matrix().double()
    t_mm = trajectory.T_cam_obj.xyz.double() * metres * 1000
    truth = {
        str(number): [{"cam_R_m2c": R.flatten().tolist(), "cam_t_m2c": t.tolist(), "obj_id": 1}]
        for number, R, t in zip(numbers, R_cam_obj, t_mm, strict=True)
    }
    files.write_json(out / "bop" / "scene_gt.json", truth)
    K = asset.camera.matrix
    K[:2, 2] -= 0.5  # BOP's pixel centres are whole numbers
    files.write_json(
        out / "bop" / "scene_camera.json",
        {str(number): {"cam_K": K.flatten().tolist(), "depth_scale": 1.0} for number in numbers},
    )


def _numbers(names: list[str]) -> list[int]:
    """Numbers of the frames: those that the names are, else 0, 1, ..."""
    stems = [Path(name).stem for name in names]
    if all(stem.isdecimal() for stem in stems) and len({int(stem) for stem in stems}) == len(stems):
        return [int(stem) for stem in stems]
    return list(range(len(names)))
