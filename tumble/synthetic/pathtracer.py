"""Ground truth from an independent renderer: Mitsuba 3 path traces a GLB under an environment map (extra `synth`).

The world frame of a Mitsuba scene is the object frame: the object stays still, camera and light move. Radiance is
linear RGB over black. A ground-truth map is the mean over the part of each pixel that the object covers.
"""

import ctypes
import importlib.util
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tumble.io import BadFile
from tumble.maths import SE3, direction_from_equirect
from tumble.scene import DIELECTRIC, Camera, Environment
from tumble.synthetic.glb import require_glb

MIN_LLVM = 15
"""Oldest major version of libLLVM that is used: that of Debian 12. The extra `synth` pins the last Mitsuba that works
with it: on the instruction `llvm.minimum` of later versions, LLVM 15 and 16 abort the process."""
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
"""Glob patterns of the folders that are searched for libLLVM."""
MAX_TRIANGLES = 5_000_000
"""Maximum number of triangles of a model; a larger one needs more memory to render than a laptop has."""

Shading = Literal["original", "diffuse", "metal", "gltf"]


# The variant ----------------------------------------------------------------------------------------------------------


def find_llvm() -> tuple[Path, int] | None:
    """Path and major version of the newest libLLVM of at least `MIN_LLVM`; None if there is none."""
    usable = [(path, version) for path in _llvm_candidates() if (version := llvm_version(path)) >= MIN_LLVM]
    return max(usable, key=lambda item: item[1], default=None)


def _llvm_candidates() -> Iterator[Path]:
    """The library named by DRJIT_LIBLLVM_PATH if that is set, else all in `LLVM_FOLDERS`."""
    if configured := os.environ.get("DRJIT_LIBLLVM_PATH"):
        yield Path(configured)
        return
    for pattern in LLVM_FOLDERS:
        for folder in sorted(Path("/").glob(pattern.lstrip("/"))):
            yield from sorted([*folder.glob("libLLVM[-.]*"), *folder.glob("libLLVM.dylib")])


def llvm_version(path: Path) -> int:
    """Major version of a libLLVM, from its file name or else from the library itself; 0 if neither contains it."""
    if match := re.match(r"libLLVM(?:-|\.so\.)(\d+)", path.name):
        return int(match[1])
    major = ctypes.c_uint(0)
    try:
        ctypes.CDLL(str(path)).LLVMGetVersion(ctypes.byref(major), None, None)
    except (OSError, AttributeError):  # LLVMGetVersion exists since LLVM 16
        return 0
    return major.value


def require_extra() -> None:
    """Check that the extra `synth` is installed, without the import of Mitsuba, which writes into the home folder.

    Raises:
        ModuleNotFoundError: It is not; the message contains the command that installs it.
    """
    if any(importlib.util.find_spec(name) is None for name in ("mitsuba", "trimesh")):
        raise ModuleNotFoundError("this needs Mitsuba: pip install 'tumble[synth]'")


def mitsuba() -> Any:
    """The Mitsuba module with a variant set: LLVM if `find_llvm` finds a library, else scalar (about 7 times slower).

    Raises:
        ModuleNotFoundError: The extra `synth` is not installed; the message contains the command that installs it.
    """
    require_extra()
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
    """A triangle mesh with one material, in the object frame."""

    vertices: Float[np.ndarray, "v 3"]
    """Positions [object radius]."""
    normals: Float[np.ndarray, "v 3"]
    """Unit vertex normals."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices."""
    uv: Float[np.ndarray, "v 2"]
    """glTF texture coordinates; the origin is the top left corner of the texture."""
    albedo: Float[np.ndarray, "h w 3"]
    """Base colour texture, linear RGB."""
    roughness: Float[np.ndarray, "rows columns 1"]
    """Perceptual roughness texture."""
    metalness: Float[np.ndarray, "tall wide 1"] = field(default_factory=lambda: np.zeros((1, 1, 1)))
    """Metalness texture: 0 for dielectrics, 1 for metals."""


@dataclass(frozen=True)
class ObjectModel:
    """A model file, transformed into the object frame: inside the unit sphere, +y up."""

    parts: tuple[Part, ...]
    """All triangle meshes of the file."""
    T_obj_file: Float[np.ndarray, "4 4"]
    """Similarity transform from the file's coordinates to the object frame."""

    def named_parts(self) -> dict[str, Part]:
        """The parts by the names of their shapes in Mitsuba scenes."""
        return {f"part_{i}": part for i, part in enumerate(self.parts)}


def read_parts(path: Path) -> tuple[Part, ...]:
    """The meshes of a GLB with base colour, roughness and metalness, in the file's frame; the rest is ignored.

    Raises:
        BadFile: The file is missing, is not readable, or has no triangles or more than `MAX_TRIANGLES`.
    """
    import trimesh

    require_glb(path)
    try:
        with np.errstate(all="ignore"):  # infinite values are refused below
            scene = trimesh.load_scene(path, file_type="glb", process=False)
            meshes = [(*scene.graph[node],) for node in scene.graph.nodes_geometry]
            parts = [_part(scene.geometry[name], T) for T, name in meshes if hasattr(scene.geometry[name], "faces")]
    except Exception as error:  # trimesh's parsers raise exceptions of many types on an invalid file
        raise BadFile(path, f"is not a readable GLB: {type(error).__name__}: {str(error)[:200]}") from None
    n_triangles = sum(len(part.faces) for part in parts)
    if not 0 < n_triangles <= MAX_TRIANGLES:
        raise BadFile(path, f"has {n_triangles} triangles", f"1 to {MAX_TRIANGLES} can be rendered")
    return tuple(parts)


def read_model(path: Path, up: str = "y") -> ObjectModel:
    """Read a GLB with its base colour, roughness and metalness; normal maps and emission are ignored.

    Args:
        path: The GLB file.
        up: Upward axis of the file, "y" (glTF) or "z" (scans).

    Raises:
        BadFile: The file is missing, is not readable, or has no triangles or more than `MAX_TRIANGLES`.
    """
    parts = read_parts(path)
    R_obj_file = np.eye(3) if up == "y" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    vertices = np.concatenate([part.vertices for part in parts]) @ R_obj_file.T
    center = (vertices.min(0) + vertices.max(0)) / 2
    with np.errstate(all="ignore"):
        radius = np.linalg.norm(vertices - center, axis=1).max()
    if not 1e-12 < radius < 1e12 or not all(_consistent(part) for part in parts):
        raise BadFile(path, f"has vertices or faces that are no object: its radius is {radius:.3g}")
    T_obj_file = np.eye(4)
    T_obj_file[:3, :3], T_obj_file[:3, 3] = R_obj_file / radius, -center / radius
    return ObjectModel(tuple(_transformed(part, R_obj_file, T_obj_file) for part in parts), T_obj_file)


def _consistent(part: Part) -> bool:
    """Whether the values of a part are finite and its faces refer to its vertices."""
    finite = all(np.isfinite(x).all() for x in (part.normals, part.uv, part.albedo, part.roughness, part.metalness))
    return bool(finite and part.faces.min(initial=0) >= 0 and part.faces.max(initial=0) < len(part.vertices))


def _transformed(part: Part, R_obj_file: np.ndarray, T_obj_file: np.ndarray) -> Part:
    vertices = part.vertices @ T_obj_file[:3, :3].T + T_obj_file[:3, 3]
    return replace(part, vertices=vertices, normals=part.normals @ R_obj_file.T)


def _part(mesh: Any, T: Float[np.ndarray, "4 4"]) -> Part:
    """A mesh of trimesh with its node's transform `T` applied, in the file's coordinates; flat where the file has no
    normals."""
    vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    uv = getattr(mesh.visual, "uv", None)
    uv = np.zeros((len(vertices), 2)) if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], 1)
    faces = np.asarray(mesh.faces)
    if np.linalg.det(T[:3, :3]) < 0:  # a mirrored node: without this, the outward side of its faces would be inside
        faces = faces[:, ::-1]
    if "vertex_normals" not in mesh._cache:  # there trimesh keeps those of the file; else it would smooth
        return _flat(vertices, faces, uv, _textures(mesh.visual))
    normals = mesh.vertex_normals @ np.linalg.inv(T[:3, :3])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    return Part(vertices, normals, faces, uv, *_textures(mesh.visual))


def _flat(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, textures: tuple[np.ndarray, ...]) -> Part:
    """A part with flat shading: each triangle has three vertices of its own, with the triangle's normal. So glTF 2.0,
    section 3.7.2.1, wants meshes without normals to be drawn."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(np.finfo(np.float64).tiny)
    own = np.arange(faces.size).reshape(-1, 3)
    return Part(corners.reshape(-1, 3), normals.repeat(3, 0), own, uv[faces.ravel()], *textures)


def _textures(visual: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base colour, roughness and metalness textures, each multiplied by its factor (glTF 2.0, section 3.9.2)."""
    material: Any = getattr(visual, "material", None)
    material = material.to_pbr() if hasattr(material, "to_pbr") else material
    factor = np.ones(3) if getattr(material, "baseColorFactor", None) is None else _colour(material.baseColorFactor)
    given = [getattr(material, name, None) for name in ("roughnessFactor", "metallicFactor")]
    factors = [1.0 if x is None else x for x in given] if material else [1.0, 0.0]
    albedo, (roughness, metalness) = np.ones((1, 1, 3)) * factor, (np.full((1, 1, 1), x) for x in factors)
    # By tables of all code values, in the precision of the renderer, because textures have many pixels.
    code_values = np.arange(256) / 255.0
    if getattr(material, "baseColorTexture", None) is not None:
        table = (_linear(code_values)[:, None] * factor).astype(np.float32)
        pixels = np.asarray(material.baseColorTexture.convert("RGB"))
        albedo = np.stack([table[pixels[..., channel], channel] for channel in range(3)], -1)
    if getattr(material, "metallicRoughnessTexture", None) is not None:
        packed = np.asarray(material.metallicRoughnessTexture.convert("RGB"))
        roughness, metalness = (
            (code_values * x).astype(np.float32)[packed[..., i : i + 1]] for i, x in enumerate(factors, start=1)
        )
    return albedo, roughness, metalness


def _colour(factor: Any) -> np.ndarray:
    """RGB in [0, 1] of a colour factor, which trimesh stores either as floats or as 8-bit integers."""
    factor = np.asarray(factor)
    return (factor / 255.0 if factor.dtype.kind in "ui" else factor)[:3].astype(np.float64)


def _linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def write_model(source: Path, model: ObjectModel, path: Path) -> None:
    """Write the GLB `source`, transformed into the object frame of `model`, to `path` (truth/mesh.glb)."""
    import trimesh

    scene = trimesh.load_scene(source, file_type="glb", process=False)
    scene.apply_transform(model.T_obj_file)
    path.write_bytes(cast(bytes, scene.export(file_type="glb")))


# The scene ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Maps:
    """Ground-truth maps of one view, 0 where `coverage` is below 0.5."""

    albedo: Float[np.ndarray, "h w 3"]
    """Linear RGB."""
    roughness: Float[np.ndarray, "h w 1"]
    """Perceptual roughness."""
    metalness: Float[np.ndarray, "h w 1"]
    """Metalness."""
    normal: Float[np.ndarray, "h w 3"]
    """Unit shading normals in the object frame."""
    depth: Float[np.ndarray, "h w 1"]
    """z-depth [object radius]."""
    coverage: Float[np.ndarray, "h w"]
    """Fraction of each pixel that the object covers."""


def mitsuba_shapes(
    model: ObjectModel, shading: Shading, roughness: float | None, f0: float = DIELECTRIC
) -> dict[str, Any]:
    """The model's parts as Mitsuba shapes by name, which scenes with different lights can share.

    Args:
        model: The model.
        shading: "original": a dielectric with the file's base colour and roughness; "diffuse": Lambertian; "metal": a
            metal with them; "gltf": with the file's metalness.
        roughness: Constant roughness that replaces the file's; None keeps the file's.
        f0: Reflectance at normal incidence.
    """

    def bsdf(part: Part) -> dict[str, Any]:
        if shading == "diffuse":
            return {"type": "diffuse", "reflectance": _bitmap(part.albedo)}
        rough = _bitmap(part.roughness) if roughness is None else roughness
        # Mitsuba's "specular" 0.5 means a refractive index of 1.5, hence F0 = 0.04.
        dielectric = {"base_color": _bitmap(part.albedo), "roughness": rough, "specular": f0 / DIELECTRIC / 2}
        metallic = {} if shading == "original" else {"metallic": _bitmap(shaded_metalness(part, shading))}
        return {"type": "principled", **dielectric, **metallic}

    return {name: _mesh(part, bsdf(part)) for name, part in model.named_parts().items()}


def shaded_metalness(part: Part, shading: Shading) -> Float[np.ndarray, "rows columns 1"]:
    """Metalness texture of a part as it is shaded (`mitsuba_shapes`)."""
    return part.metalness if shading == "gltf" else np.full((1, 1, 1), float(shading == "metal"))


def surrounding_shapes(parts: dict[str, Part]) -> dict[str, Any]:
    """Hand and background as Mitsuba shapes by name: dielectrics (F0 = 0.04)."""

    def bsdf(part: Part) -> dict[str, Any]:
        rough = float(part.roughness.mean())
        return {"type": "principled", "base_color": _bitmap(part.albedo), "roughness": rough, "specular": 0.5}

    return {name: _mesh(part, bsdf(part)) for name, part in parts.items()}


def move(scene: Any, parts: dict[str, Part]) -> None:
    """Give shapes of a scene the vertices and normals of `parts` with the same names and faces."""
    params = mitsuba().traverse(scene)
    for name, part in parts.items():
        params[f"{name}.vertex_positions"] = part.vertices.astype(np.float32).ravel()
        params[f"{name}.vertex_normals"] = part.normals.astype(np.float32).ravel()
    params.update()


def lit_scene(shapes: dict[str, Any], light: Environment, path_depth: int) -> Any:
    """A Mitsuba scene of shapes under an environment map, traced with up to `path_depth` segments (2: direct only)."""
    mi = mitsuba()
    integrator = {"type": "path", "max_depth": path_depth, "hide_emitters": True}
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(_envmap(light)), "to_world": mi.ScalarTransform4f()}
    return mi.load_dict({"type": "scene", "integrator": integrator, "light": emitter, **shapes})


def radiance(
    scene: Any, T_cam_obj: SE3, camera: Camera, R_env_obj: Float[Tensor, "3 3"], *, samples: int, seed: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Path trace a view of a `lit_scene`.

    Returns:
        Linear RGB radiance over black, and the fraction of each pixel that the object covers.
    """
    mi = mitsuba()
    params = mi.traverse(scene)
    to_world = np.eye(4)
    to_world[:3, :3] = R_env_obj.double().numpy().T
    params["light.to_world"] = mi.Transform4f(to_world)
    params.update()
    # Mitsuba takes seeds of 32 bits; the number of a frame is added to a multiple of the seed of the options.
    pixels = np.array(mi.render(scene, sensor=_sensor(T_cam_obj, camera), spp=samples, seed=seed % 2**32))
    return pixels[..., :3], pixels[..., 3]


def unlit_scenes(model: ObjectModel, shading: Shading, roughness: float | None) -> tuple[Any, Any]:
    """The two Mitsuba scenes that `maps` renders; a `roughness` that is not None replaces the file's.

    Mitsuba can output only one texture without lighting, the diffuse reflectance. The first scene has the albedo
    there, the second one (roughness, 1, metalness).
    """
    mi = mitsuba()

    def scene(aovs: str, texture: Callable[[Part], np.ndarray]) -> Any:
        parts = {
            name: _mesh(part, {"type": "diffuse", "reflectance": _bitmap(texture(part))})
            for name, part in model.named_parts().items()
        }
        return mi.load_dict({"type": "scene", "integrator": {"type": "aov", "aovs": aovs}, **parts})

    def packed(part: Part) -> np.ndarray:
        rough = part.roughness if roughness is None else np.full((1, 1, 1), roughness)
        metal = shaded_metalness(part, shading)
        if rough.shape != metal.shape:  # one of them is constant
            rough, metal = np.broadcast_arrays(rough, metal)
        return np.concatenate([rough, np.ones_like(rough), metal], -1)

    return scene("a:albedo,n:sh_normal,g:geo_normal,x:position", lambda part: part.albedo), scene("r:albedo", packed)


def maps(unlit: tuple[Any, Any], T_cam_obj: SE3, camera: Camera, *, samples: int) -> Maps:
    """Ground-truth maps of one view, rendered from the scenes of `unlit_scenes`."""
    mi = mitsuba()
    sensor = _sensor(T_cam_obj, camera)
    first, packed = (np.array(mi.render(scene, sensor=sensor, spp=samples, seed=0)) for scene in unlit)
    coverage = packed[..., 1]
    inside = coverage >= 0.5
    divisor = np.where(inside, coverage, 1.0)[..., None]
    x_obj = torch.from_numpy((first[..., 9:12] / divisor).astype(np.float64))
    depth = (SE3(T_cam_obj.wxyz.double(), T_cam_obj.xyz.double()) @ x_obj)[..., 2:].numpy()
    to_camera = T_cam_obj.inverse().xyz.double().numpy() - x_obj.numpy()
    # Shading normals face the camera: the inside of an open mesh can be visible.
    side = np.sign((first[..., 6:9] * to_camera).sum(-1, keepdims=True))
    normal = side * first[..., 3:6]
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-6)

    def masked(values: np.ndarray) -> np.ndarray:
        return np.where(inside[..., None], values, 0).astype(np.float32)

    albedo, roughness, metalness = first[..., :3] / divisor, packed[..., :1] / divisor, packed[..., 2:3] / divisor
    return Maps(masked(albedo), masked(roughness), masked(metalness), masked(normal), masked(depth), coverage)


def layer_scene(layers: tuple[dict[str, Part], dict[str, Part], dict[str, Part]]) -> Any:
    """The Mitsuba scene of three groups of parts by name, for `layer_coverage`."""
    shapes = {
        name: _mesh(part, {"type": "diffuse", "reflectance": _bitmap(np.eye(3)[i][None, None])})
        for i, layer in enumerate(layers)
        for name, part in layer.items()
    }
    return mitsuba().load_dict({"type": "scene", "integrator": {"type": "aov", "aovs": "layer:albedo"}, **shapes})


def layer_coverage(scene: Any, T_cam_obj: SE3, camera: Camera, *, samples: int) -> Float[np.ndarray, "h w 3"]:
    """Fraction of each pixel in which each group of a `layer_scene` is the nearest surface."""
    return np.array(mitsuba().render(scene, sensor=_sensor(T_cam_obj, camera), spp=samples, seed=0))[..., :3]


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
    """The environment map on Mitsuba's grid, whose left edge is -z and whose row i has the polar angle pi i / (h - 1).

    The grid is finer than the map's own, so that Mitsuba's interpolation reproduces ours between our texels.
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
    assert abs(fx - fy) < 1e-3, "Mitsuba's perspective camera has square pixels"
    # Mitsuba's camera looks along +z like OpenCV's, but with x to the left and y up.
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
            "principal_point_offset_x": 0.5 - cx / camera.width,
            "principal_point_offset_y": 0.5 - cy / camera.height,
            "near_clip": 1e-2,
            "to_world": mi.ScalarTransform4f(T_obj_cam),
            "film": film,
            "sampler": {"type": "multijitter"},
        }
    )
