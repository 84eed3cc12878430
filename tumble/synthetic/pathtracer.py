"""Ground truth by an independent renderer: Mitsuba 3 path traces a GLB under a lat-long light (extra `synth`).

The world of a Mitsuba scene is the object frame: the object never moves, camera and light do. Every radiance is linear
RGB over black, every map is the mean over the part of a pixel that the object covers.
"""

import ctypes
import importlib.util
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tumble.io import BadFile
from tumble.maths import SE3, direction_from_equirect
from tumble.scene import Camera, Environment

OLDEST_LLVM = 17
"""LLVM 15 and 16 abort the process on some processors while they compile Dr.Jit's kernels."""
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
MAX_TRIANGLES = 5_000_000
"""Largest object read: beyond it a render needs more memory than a laptop has."""

Shading = Literal["original", "diffuse"]


# The variant ----------------------------------------------------------------------------------------------------------


def find_llvm() -> tuple[Path, int] | None:
    """The newest libLLVM that Dr.Jit can use safely, with its major version; None when there is none."""
    found = [(path, version) for path in _llvm_candidates() if (version := llvm_version(path)) >= OLDEST_LLVM]
    return max(found, key=lambda item: item[1], default=None)


def _llvm_candidates() -> Iterator[Path]:
    if named := os.environ.get("DRJIT_LIBLLVM_PATH"):
        yield Path(named)
        return
    for pattern in LLVM_FOLDERS:
        for folder in sorted(Path("/").glob(pattern.lstrip("/"))):
            yield from sorted([*folder.glob("libLLVM[-.]*"), *folder.glob("libLLVM.dylib")])


def llvm_version(path: Path) -> int:
    """Major version of a libLLVM by its file name, else by asking the library; 0 when it will not say."""
    if match := re.match(r"libLLVM(?:-|\.so\.)(\d+)", path.name):
        return int(match[1])
    major = ctypes.c_uint(0)
    try:
        ctypes.CDLL(str(path)).LLVMGetVersion(ctypes.byref(major), None, None)
    except (OSError, AttributeError):  # the call came with LLVM 16
        return 0
    return major.value


def mitsuba() -> Any:
    """Mitsuba with a variant set: LLVM when a safe libLLVM is there, else scalar (about seven times slower).

    Raises:
        ModuleNotFoundError: The extra `synth` is not installed; the message says how.
    """
    if importlib.util.find_spec("mitsuba") is None:
        raise ModuleNotFoundError("this needs Mitsuba: pip install 'tumble[synth]'")
    llvm = find_llvm()
    if llvm is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(llvm[0])
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb" if llvm is not None else "scalar_rgb")
        mi.set_log_level(mi.LogLevel.Error)
    return mi


# The object -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """A triangle mesh with one material, object frame."""

    vertices: Float[np.ndarray, "v 3"]
    """[object radius]"""
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "v 2"]
    """glTF texture coordinates: the origin is the top left corner of the texture."""
    albedo: Float[np.ndarray, "h w 3"]
    """Linear base colour."""
    roughness: Float[np.ndarray, "rows columns 1"]
    """Perceptual roughness."""


@dataclass(frozen=True)
class ObjectModel:
    """An object as an artist made it, moved into the unit ball with +y up."""

    parts: tuple[Part, ...]
    T_obj_file: Float[np.ndarray, "4 4"]
    """File to object frame: turn, shift and scale."""


def read_model(path: Path, up: str = "y") -> ObjectModel:
    """The parts of a GLB with base colour and roughness; metalness, normal maps and emission are left out.

    Args:
        up: The file's upward axis, "y" (glTF) or "z" (scans).

    Raises:
        BadFile: Not a readable glTF with triangles.
    """
    import trimesh

    if not path.is_file():
        raise BadFile(path, "is missing")
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers meet in a foreign file
        raise BadFile(path, f"is not a readable GLB: {error}") from None
    meshes = [(*scene.graph[node],) for node in scene.graph.nodes_geometry]
    parts = [_part(scene.geometry[name], T) for T, name in meshes if hasattr(scene.geometry[name], "faces")]
    n_triangles = sum(len(part.faces) for part in parts)
    if not 0 < n_triangles <= MAX_TRIANGLES:
        raise BadFile(path, f"has {n_triangles} triangles", f"1 to {MAX_TRIANGLES} can be rendered")
    turn = np.eye(3) if up == "y" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    corners = np.concatenate([part.vertices for part in parts]) @ turn.T
    center = (corners.min(0) + corners.max(0)) / 2
    radius = np.linalg.norm(corners - center, axis=1).max()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn / radius, -center / radius
    return ObjectModel(tuple(_moved(part, turn, T) for part in parts), T)


def _moved(part: Part, R: np.ndarray, T: np.ndarray) -> Part:
    vertices = part.vertices @ T[:3, :3].T + T[:3, 3]
    return Part(vertices, part.normals @ R.T, part.faces, part.uv, part.albedo, part.roughness)


def _part(mesh: Any, T: Float[np.ndarray, "4 4"]) -> Part:
    vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    normals = mesh.vertex_normals @ np.linalg.inv(T[:3, :3])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    uv = getattr(mesh.visual, "uv", None)
    uv = np.zeros((len(vertices), 2)) if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], 1)
    albedo, roughness = _textures(mesh.visual)
    return Part(vertices, normals, np.asarray(mesh.faces), uv, albedo, roughness)


def _textures(visual: Any) -> tuple[np.ndarray, np.ndarray]:
    """Base colour and roughness textures, each multiplied by its factor (glTF 2.0, section 3.9.2)."""
    material: Any = getattr(visual, "material", None)
    material = material.to_pbr() if hasattr(material, "to_pbr") else material
    factor = np.ones(3) if getattr(material, "baseColorFactor", None) is None else _unit(material.baseColorFactor)
    albedo, roughness = np.ones((1, 1, 3)), np.ones((1, 1, 1))
    if getattr(material, "baseColorTexture", None) is not None:
        albedo = _linear(np.asarray(material.baseColorTexture.convert("RGB")) / 255.0)
    if getattr(material, "metallicRoughnessTexture", None) is not None:
        roughness = np.asarray(material.metallicRoughnessTexture.convert("RGB"))[..., 1:2] / 255.0
    rough = getattr(material, "roughnessFactor", None)
    return albedo * factor, roughness * (1.0 if rough is None else rough)


def _unit(factor: Any) -> np.ndarray:
    """trimesh keeps a colour factor as floats or as 8-bit numbers, by its mood."""
    factor = np.asarray(factor)
    return (factor / 255.0 if factor.dtype.kind in "ui" else factor)[:3].astype(np.float64)


def _linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def write_model(source: Path, model: ObjectModel, path: Path) -> None:
    """The GLB of `source` again, moved into the object frame (truth/mesh.glb)."""
    import trimesh

    scene = trimesh.load_scene(source, process=False)
    scene.apply_transform(model.T_obj_file)
    path.write_bytes(cast(bytes, scene.export(file_type="glb")))


# The scene ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Maps:
    """What a view shows, without light. 0 where the object covers less than half a pixel."""

    albedo: Float[np.ndarray, "h w 3"]
    roughness: Float[np.ndarray, "h w 1"]
    normal: Float[np.ndarray, "h w 3"]
    """Unit shading normals, object frame."""
    depth: Float[np.ndarray, "h w 1"]
    """z-depth [object radius]."""
    coverage: Float[np.ndarray, "h w"]


def shape(model: ObjectModel, shading: Shading, roughness: float | None) -> dict[str, Any]:
    """The model as Mitsuba objects, to be shared by scenes that differ in light.

    Args:
        shading: "original": a dielectric (F0 = 0.04) with the file's base colour and roughness; "diffuse": Lambertian.
        roughness: Replaces the file's roughness everywhere when given.
    """

    def bsdf(part: Part) -> dict[str, Any]:
        if shading == "diffuse":
            return {"type": "diffuse", "reflectance": _bitmap(part.albedo)}
        rough = _bitmap(part.roughness) if roughness is None else roughness
        # Mitsuba's "specular" 0.5 is a refractive index of 1.5, so F0 = 0.04.
        return {"type": "principled", "base_color": _bitmap(part.albedo), "roughness": rough, "specular": 0.5}

    return {f"part_{i}": _mesh(part, bsdf(part)) for i, part in enumerate(model.parts)}


def lit_scene(shapes: dict[str, Any], light: Environment, depth: int) -> Any:
    """A scene under a light, to be rendered with up to `depth` path segments (2 is direct light alone)."""
    mi = mitsuba()
    integrator = {"type": "path", "max_depth": depth, "hide_emitters": True}
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(_envmap(light)), "to_world": mi.ScalarTransform4f()}
    return mi.load_dict({"type": "scene", "integrator": integrator, "light": emitter, **shapes})


def radiance(
    scene: Any, T_cam_obj: SE3, camera: Camera, R_env_obj: Float[Tensor, "3 3"], *, samples: int, seed: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """A photograph: linear radiance over black, and the object's coverage of each pixel."""
    mi = mitsuba()
    params = mi.traverse(scene)
    to_world = np.eye(4)
    to_world[:3, :3] = R_env_obj.double().numpy().T
    params["light.to_world"] = mi.Transform4f(to_world)
    params.update()
    pixels = np.array(mi.render(scene, sensor=_sensor(T_cam_obj, camera), spp=samples, seed=seed))
    return pixels[..., :3], pixels[..., 3]


def unlit_scenes(model: ObjectModel, roughness: float | None) -> tuple[Any, Any]:
    """Two scenes for `maps`. `roughness` replaces the file's when given.

    A diffuse reflectance is the one texture that Mitsuba shows unlit: the second scene carries (roughness, 1, 0) in it.
    """
    mi = mitsuba()

    def scene(aovs: str, texture: Callable[[Part], np.ndarray]) -> Any:
        parts = {
            f"part_{i}": _mesh(part, {"type": "diffuse", "reflectance": _bitmap(texture(part))})
            for i, part in enumerate(model.parts)
        }
        return mi.load_dict({"type": "scene", "integrator": {"type": "aov", "aovs": aovs}, **parts})

    def coded(part: Part) -> np.ndarray:
        values = part.roughness if roughness is None else np.full((1, 1, 1), roughness)
        return np.concatenate([values, np.ones_like(values), np.zeros_like(values)], -1)

    return scene("a:albedo,n:sh_normal,g:geo_normal,x:position", lambda part: part.albedo), scene("r:albedo", coded)


def maps(unlit: tuple[Any, Any], T_cam_obj: SE3, camera: Camera, *, samples: int) -> Maps:
    """Truth of one view of `unlit_scenes`."""
    mi = mitsuba()
    sensor = _sensor(T_cam_obj, camera)
    first, coded = (np.array(mi.render(scene, sensor=sensor, spp=samples, seed=0)) for scene in unlit)
    coverage = coded[..., 1]
    inside = coverage >= 0.5
    share = np.where(inside, coverage, 1.0)[..., None]
    x_obj = torch.from_numpy((first[..., 9:12] / share).astype(np.float64))
    depth = (SE3(T_cam_obj.wxyz.double(), T_cam_obj.xyz.double()) @ x_obj)[..., 2:].numpy()
    to_camera = T_cam_obj.inverse().xyz.double().numpy() - x_obj.numpy()
    # A shading normal belongs to the side that is seen: open meshes show their inside too.
    side = np.sign((first[..., 6:9] * to_camera).sum(-1, keepdims=True))
    normal = side * first[..., 3:6]
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-6)

    def within(values: np.ndarray) -> np.ndarray:
        return np.where(inside[..., None], values, 0).astype(np.float32)

    albedo, roughness = first[..., :3] / share, coded[..., :1] / share
    return Maps(within(albedo), within(roughness), within(normal), within(depth), coverage)


def _bitmap(pixels: np.ndarray) -> dict[str, Any]:
    mi = mitsuba()
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32)), "raw": True}


def _mesh(part: Part, bsdf: dict[str, Any]) -> Any:
    mi = mitsuba()
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "inner": bsdf})
    mesh = mi.Mesh(
        "part",
        len(part.vertices),
        len(part.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=props,
    )
    params = mi.traverse(mesh)
    params["vertex_positions"] = part.vertices.astype(np.float32).ravel()
    params["vertex_normals"] = part.normals.astype(np.float32).ravel()
    params["vertex_texcoords"] = part.uv.astype(np.float32).ravel()
    params["faces"] = part.faces.astype(np.uint32).ravel()
    params.update()
    return mesh


def _envmap(light: Environment) -> Float[np.ndarray, "rows columns 3"]:
    """The light on Mitsuba's own grid, where -z is the left edge and row i lies at the polar angle pi i / (h - 1).

    The grid is finer than the map's, so that Mitsuba's interpolation between its texels repeats ours between our own.
    """
    h, w, _ = light.log_radiance.shape
    finer = max(1, 512 // h)
    rows, columns = 2 * finer * h + 1 if finer > 1 else h + 1, w * finer
    u = (torch.arange(columns, dtype=torch.float64) + 0.5) / columns + 0.5
    v = torch.arange(rows, dtype=torch.float64) / (rows - 1)
    uv = torch.stack([(u % 1).expand(rows, -1), v[:, None].expand(-1, columns)], -1)
    fine = Environment(light.log_radiance.double())
    return fine.lookup(direction_from_equirect(uv)).float().numpy()


def _sensor(T_cam_obj: SE3, camera: Camera) -> Any:
    mi = mitsuba()
    fx, fy, cx, cy = camera.fx_fy_cx_cy.tolist()
    centered = abs(cx - camera.width / 2) + abs(cy - camera.height / 2) + abs(fx - fy) < 1e-3
    assert centered, "captures are synthesized with a centred camera of square pixels"
    # Mitsuba's camera looks along +z like OpenCV's, with x to the left and y up.
    T_obj_cam = T_cam_obj.inverse().matrix().double().numpy() @ np.diag([-1.0, -1.0, 1.0, 1.0])
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "pixel_format": "rgba",
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(camera.fov_x)),
            "near_clip": 1e-2,
            "to_world": mi.ScalarTransform4f(T_obj_cam),
            "film": film,
            "sampler": {"type": "multijitter"},
        }
    )
