"""What other programs open: a textured GLB, two PLYs of the Gaussians, the light, the poses.

The GLB's frame is the object's: +y up, where up means something, as glTF has it. All files of one export share one
length of the object radius in metres: 1 without a scale.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tumble import __version__
from tumble.export import bake, confidence, gltf, mesh, ply
from tumble.export.depth_fusion import REACH, distances
from tumble.export.mesh import Mesh
from tumble.export.poses import write_poses
from tumble.io import files
from tumble.scene import Asset

PADDING = 8
"""Least number of texels between charts."""


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


PresetName = Literal["web", "game", "film", "splat"]
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


def write_asset(asset: Asset, names: list[str], out: Path, preset: PresetName, scale_mm: float | None = None) -> None:
    """Write a folder: `asset.glb` and `confidence.png` (not for "splat"), both PLYs, `light.*`, `poses*`, `bop/`.

    Args:
        names: Of the frames, in the order of the trajectory.
        scale_mm: Largest distance between two points of the object, as a ruler finds it [mm].
    """
    chosen = PRESETS[preset]
    shape = extract_mesh(asset, chosen) if chosen else extract_mesh(asset, COARSE) if scale_mm else None
    metres = 1.0 if scale_mm is None or shape is None else scale_mm / 1000 / mesh.diameter(shape.vertices)
    if chosen and shape:
        write_textured_mesh(asset, shape, chosen, metres, out / "asset.glb")
    ply.write_ply(out / "asset.ply", ply.splats(asset, metres))
    ply.write_ply(out / "asset_material.ply", ply.splats(asset, metres) | ply.material_columns(asset))
    _write_light(asset, out)
    write_poses(asset, names, metres, out)
    about = {
        "preset": preset,
        "metres_per_object_radius": metres,
        "scale_mm": scale_mm,
        "frame": "x right, y up, z to the viewer; the same for GLB, PLYs and poses",
        "units": "metres" if scale_mm else "object radius (written where metres stand)",
        "f0": float(asset.material.f0),
        "tumble": __version__,
    }
    files.write_json(out / "export.json", about)


def extract_mesh(asset: Asset, preset: Preset) -> Mesh:
    """The object's triangles, object frame.

    Raises:
        ValueError: The Gaussians show no surface.
    """
    values = distances(asset.gaussians, asset.gamma, cells=preset.cells, views=preset.views, pixels=preset.pixels)
    if values.min() >= 0:
        raise ValueError("the Gaussians show no surface: nothing to make triangles of; try --preset splat")
    return mesh.simplified(
        mesh.without_floaters(mesh.march(values, -REACH, 2 * REACH / preset.cells)), preset.triangles
    )


def write_textured_mesh(asset: Asset, shape: Mesh, preset: Preset, metres: float, path: Path) -> None:
    """Unwrap, bake and write the GLB, and beside it how sure its material is, over the same coordinates."""
    flat = mesh.unwrapped(shape, preset.texture, PADDING)
    textures = bake.bake(asset, flat, resolution=preset.texture, views=3 * preset.views // 4, pixels=preset.pixels)
    assert asset.material is not None, "an asset with material"
    score = confidence.confidence_of(asset, asset.camera).score
    files.write_png(path.parent / CONFIDENCE, bake.spread(score, asset, flat, resolution=512)[..., None])
    gltf.write_glb(path, flat, textures, f0=float(asset.material.f0), metres=metres)


def _write_light(asset: Asset, out: Path) -> None:
    """`light.exr`, `light.hdr`, and `light.json`, which says how they lie."""
    environment, trajectory = asset.environment, asset.trajectory
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
