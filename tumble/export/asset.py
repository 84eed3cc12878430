"""Export folder of an asset: a textured GLB, two PLYs of the Gaussians, the light, the poses (docs/export.md).

All files use the object frame, which has +y up as in glTF (if the object has an up direction), and one unit: metres if
the object's size is given, else the object radius.
"""

import contextlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tumble import __version__
from tumble.export import atlas, bake, completion, confidence, gltf, mesh, photo_texture, ply, unseen
from tumble.export.depth_fusion import HALF_SIDE, signed_distances
from tumble.export.mesh import Mesh
from tumble.export.poses import write_poses
from tumble.io import begin, files, progress
from tumble.rendering import lit_frames
from tumble.scene import Asset, Capture


@dataclass(frozen=True)
class Preset:
    """Resolution of an exported mesh and its textures."""

    triangles: int
    """Maximum number of triangles."""
    texture: int
    """Side of the textures [texels]."""
    cells: int
    """Cells per side of the signed distance grid; a multiple of 4."""
    views: int = 48
    """Number of depth maps that are fused; the textures use three quarters as many views."""
    pixels: int = 512
    """Side of the rendered maps [pixels]."""


PresetName = Literal["web", "game", "film", "splat"]
PRESETS: dict[str, Preset | None] = {
    "web": Preset(triangles=20_000, texture=2048, cells=256),
    "game": Preset(triangles=8_000, texture=1024, cells=256),
    "film": Preset(triangles=50_000, texture=4096, cells=384, views=96, pixels=1024),
    "splat": None,
}
"""Settings by name. "web" stays below 10 MB; "splat" has no mesh."""
EXPORT_FILE = "export.json"
"""Unit and settings of an exported folder, by which it is recognised; moved there first."""
CONFIDENCE_FILE = "confidence.png"
"""Confidence of the material as a texture, beside the GLB and over the same UVs."""
MESH_FILES = ("asset.glb", CONFIDENCE_FILE)
"""Files that not every preset writes."""
COARSE_VIEWS = 12
"""Number of views of the coarse texture with which the surface is aligned."""
SIZE_PRESET = Preset(triangles=20_000, texture=256, cells=128, views=32, pixels=256)
"""Settings of the mesh that is extracted only to measure the object's size."""


def write_asset(
    asset: Asset,
    names: list[str],
    out: Path,
    preset: PresetName,
    scale_mm: float | None = None,
    *,
    capture: Capture | None = None,
) -> None:
    """Write a folder: `asset.glb` and `confidence.png` (not for "splat"), both PLYs, `light.*`, `poses*`, `bop/`.

    It takes the place of an earlier export as a whole, when all of it is written.

    Args:
        names: Names of the frames, in the order of the trajectory.
        scale_mm: Largest distance between two points of the object, measured with a ruler [mm].
        capture: Frames of the trajectory, from which the base colour is solved; without it, it is baked from the
            Gaussians alone.

    Raises:
        ValueError: A mesh is needed, but the Gaussians have no surface.
        ModuleNotFoundError: A textured mesh is needed, but xatlas is not installed.
    """
    settings = PRESETS[preset]
    if settings:
        atlas.require_xatlas()
    with ThreadPoolExecutor(1) as beside:
        # The mesh is made by one thread most of the time.
        device = asset.gaussians.means.device
        frames = begin(beside, device, lambda: _lit_frames(asset, capture if settings else None))
        score = begin(beside, device, lambda: _confidence(asset)) if settings else None
        shape = extract_mesh(asset, settings or SIZE_PRESET, capture) if settings or scale_mm else None
        flat, textures = None, None
        if settings and shape:
            with progress.task("texture coordinates"):
                flat = atlas.unwrap(shape, settings.texture)
            flat, textures = textured_mesh(asset, flat, settings, frames())
    surface = flat or shape
    metres = 1.0 if scale_mm is None or surface is None else scale_mm / 1000 / mesh.diameter(surface.vertices)
    facts = {
        "preset": preset,
        "metres_per_object_radius": metres,
        "scale_mm": scale_mm,
        "frame": "x right, y up, z to the viewer; the same for GLB, PLYs and poses",
        "units": "metres" if scale_mm else "object radius (in place of metres)",
        "f0": float(asset.material.f0),
        "tumble": __version__,
    }
    with _replacing(out) as partial:
        files.write_json(partial / EXPORT_FILE, facts)
        if flat and textures and score:
            gltf.write_glb(partial / "asset.glb", flat, textures, f0=float(asset.material.f0), metres=metres)
            texture = bake.nearest_gaussian_texture(score(), asset, flat, resolution=512)
            files.write_png(partial / CONFIDENCE_FILE, texture[..., None])
        ply.write_ply(partial / "asset.ply", ply.splat_columns(asset, metres))
        ply.write_ply(partial / "asset_material.ply", ply.splat_columns(asset, metres) | ply.material_columns(asset))
        _write_light(asset, names, partial)
        write_poses(asset, names, metres, partial)


@contextlib.contextmanager
def _replacing(out: Path) -> Iterator[Path]:
    """A partial folder in `out`, whose files at last replace those of an earlier export; other files stay."""
    # In a folder without the mark such files are not ours.
    own = MESH_FILES if (out / EXPORT_FILE).is_file() else ()
    with files.describe_write_errors(out), files.partial_folder(out) as partial:
        yield partial
        written = [path.relative_to(partial) for path in partial.rglob("*") if path.is_file()]
        # The mark comes first: by it the folder is recognised if the process is killed here.
        for path in sorted(written, key=lambda path: path.name != EXPORT_FILE):
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            (partial / path).replace(out / path)
        for path in map(Path, own):
            if path not in written:
                (out / path).unlink(missing_ok=True)


def extract_mesh(asset: Asset, preset: Preset, capture: Capture | None = None) -> Mesh:
    """The surface of the Gaussians as a triangle mesh, object frame.

    Args:
        capture: Frames of the trajectory. What none of them shows is then spanned by a smooth surface.

    Raises:
        ValueError: The Gaussians have no surface.
    """
    with progress.task("fusing depth maps"):
        values = signed_distances(
            asset.gaussians, asset.gamma, cells=preset.cells, views=preset.views, pixels=preset.pixels
        )
    if values.min() >= 0:
        raise ValueError("the Gaussians have no surface, so there is no mesh to export; use --preset splat")
    with progress.task("extracting the mesh"):
        whole = _surface(values)
        return mesh.simplify(_without_gaps(whole, values, asset, capture) if capture else whole, preset.triangles)


def _surface(values: Float[np.ndarray, "g g g"]) -> Mesh:
    """The smooth surface of signed distances (`depth_fusion.signed_distances`)."""
    return mesh.smooth(mesh.surface(values, -HALF_SIDE, 2 * HALF_SIDE / (len(values) - 1)))


def _without_gaps(whole: Mesh, values: Float[np.ndarray, "g g g"], asset: Asset, capture: Capture) -> Mesh:
    """The mesh with what a hand covers completed, and what is left that no frame shows spanned by a smooth surface.

    Args:
        whole: The surface of the values.
    """
    seen = unseen.seen_regions(whole, asset, capture)
    found = completion.completed(values, whole.vertices[seen], asset, capture)
    if not found.changed.any():
        return unseen.spanned(whole, seen)
    whole = _surface(found.values)
    changed, seen = found.changed_at(whole.vertices), unseen.seen_regions(whole, asset, capture)
    return unseen.spanned(unseen.smoothed(whole, changed & ~seen), changed | seen)


def _lit_frames(asset: Asset, capture: Capture | None) -> list[lit_frames.LitFrame]:
    """The photographs of a capture with their light."""
    if capture is None:
        return []
    found = lit_frames.lit_frames(asset, capture)
    return list(progress.track(found, "light of the photographs", len(lit_frames.frame_numbers(capture))))


def _confidence(asset: Asset) -> Float[Tensor, " n"]:
    """The confidence of each Gaussian's material, 0 to 1."""
    with progress.task("confidence of the material"):
        return confidence.confidence_of(asset, asset.camera).score


def textured_mesh(
    asset: Asset, flat: atlas.UnwrappedMesh, preset: Preset, frames: Sequence[lit_frames.LitFrame] = ()
) -> tuple[atlas.UnwrappedMesh, bake.Textures]:
    """An unwrapped mesh and its textures; with photographs (`frames`), both are fitted to them (`photo_texture`)."""
    if frames:
        with progress.task("aligning the surface"):
            side = photo_texture.solved_side(asset.camera)
            coarse = bake.bake(asset, flat, resolution=side, views=COARSE_VIEWS, pixels=side)
            flat = photo_texture.aligned_surface(flat, coarse.base_color, frames)
    with progress.task("baking textures"):
        finest = max(bake.TEXELS_PER_PIXEL * preset.pixels, photo_texture.solved_side(asset.camera) if frames else 0)
        side = min(preset.texture, finest)
        textures = bake.bake(asset, flat, resolution=side, views=3 * preset.views // 4, pixels=preset.pixels)
    if frames:
        with progress.task("solving the albedo"):
            color = photo_texture.solved_base_color(textures.base_color, flat, frames)
        textures = photo_texture.continued(replace(textures, base_color=color), flat, frames)
    return flat, textures.enlarged(preset.texture)


def write_textured_mesh(asset: Asset, shape: Mesh, preset: Preset, path: Path, capture: Capture | None = None) -> None:
    """Unwrap the mesh for display only, bake its textures, and write the GLB [object radius].

    Args:
        capture: Frames of the trajectory. What they show is then continued over what none of them shows.
    """
    with progress.task("texture coordinates"):
        flat = atlas.unwrap_loosely(shape, preset.texture)
    flat, textures = textured_mesh(asset, flat, preset)
    if capture is not None:
        textures = photo_texture.continued(textures, flat, lit_frames.masked_frames(asset, capture))
    gltf.write_glb(path, flat, textures, f0=float(asset.material.f0), metres=1.0)


def _write_light(asset: Asset, names: list[str], out: Path) -> None:
    """Write `light.exr`, `light.hdr`, and `light.json`, which documents their projection and frame."""
    environment, trajectory = asset.environment, asset.trajectory
    environment.write(out / "light.exr")
    environment.write(out / "light.hdr")
    frames = {
        "camera": "camera frame, OpenGL axes (x right, y up, z to the viewer): the light was fixed to the camera",
        "object": "object frame, that of the GLB: the light was fixed to the object",
    }
    facts = {
        "projection": "equirectangular",
        "radiance": "linear RGB, primaries of sRGB, up to one factor",
        "frame": frames[trajectory.light],
        "up": "+y, the top row",
        "zero_azimuth": "-z, the centre column; +x is at three quarters of the width",
        "u": "atan2(x, -z) / (2 pi) + 1/2, from the left",
        "v": "acos(y) / pi, from the top",
        "first_frame": names[0],
        "R_light_object_of_first_frame": trajectory.R_env_obj[0].tolist(),
    }
    files.write_json(out / "light.json", facts)
