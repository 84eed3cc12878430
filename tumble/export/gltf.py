"""GLB writer for a textured mesh: glTF 2.0 binary with one JSON chunk and one binary chunk."""

import json
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from tumble import __version__
from tumble.export.atlas import UnwrappedMesh
from tumble.export.bake import Textures
from tumble.io import files, in_threads
from tumble.scene import DIELECTRIC

FLOAT = 5126
"""Component type of 32-bit floats (glTF 2.0, section 3.6.2)."""
UNSIGNED_SHORT = 5123
"""Component type of 16-bit indices."""
UNSIGNED_INT = 5125
"""Component type of 32-bit indices."""
ARRAY_BUFFER = 34962
"""Target of buffer views with vertex attributes (glTF 2.0, section 5.11)."""
ELEMENT_ARRAY_BUFFER = 34963
"""Target of buffer views with vertex indices."""
PNG_SETTINGS = (cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
"""Compression of textures: runs only. zlib's default strategy takes four times as long for files that are 8 % smaller;
without a level, OpenCV would try one filter only, for files that are 35 % larger."""


@dataclass(frozen=True)
class _Buffer:
    """Binary chunk under construction, with its buffer views and accessors; its methods append to it."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def view(self, values: bytes, **properties: int) -> int:
        """Append bytes, aligned to 4; returns the index of their buffer view."""
        self.data.extend(b"\0" * (-len(self.data) % 4))
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(values), **properties})
        self.data.extend(values)
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, kind: str, component: int, *, target: int, bounds: bool = False) -> int:
        """Append an array, one element per row; returns the index of its accessor."""
        properties = {"componentType": component, "count": len(values), "type": kind}
        if bounds:
            properties |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append({"bufferView": self.view(values.tobytes(), target=target), **properties})
        return len(self.accessors) - 1

    def png(self, encoded: bytes) -> dict[str, Any]:
        """Append a PNG file; returns its entry for `images`."""
        return {"bufferView": self.view(encoded), "mimeType": "image/png"}


def write_glb(path: Path, flat: UnwrappedMesh, textures: Textures, *, f0: float, metres: float) -> None:
    """Write a GLB with one mesh and one metallic-roughness material, a dielectric unless the textures have metalness.

    The tangents are those that the normal map was baked with.

    Args:
        f0: Reflectance at normal incidence; if not 0.04, it is written as an extension (`reflectance_extension`), which
            some viewers ignore.
        metres: Object radius in the file's unit.
    """
    buffer = _Buffer()
    rough = textures.roughness
    metal = np.zeros_like(rough) if textures.metalness is None else textures.metalness
    maps = (textures.base_color, np.stack([np.full_like(rough, 255), rough, metal], -1), textures.normal)
    images = [buffer.png(encoded) for encoded in in_threads(_png, maps)]
    vertices = (flat.vertices * metres).astype(np.float32)
    short_indices = len(vertices) < 65535
    attributes = {
        "POSITION": buffer.accessor(vertices, "VEC3", FLOAT, target=ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.accessor(_unit32(flat.normals), "VEC3", FLOAT, target=ARRAY_BUFFER),
        "TANGENT": buffer.accessor(_tangents32(flat.tangents), "VEC4", FLOAT, target=ARRAY_BUFFER),
        "TEXCOORD_0": buffer.accessor(flat.uv.astype(np.float32), "VEC2", FLOAT, target=ARRAY_BUFFER),
    }
    indices = flat.faces.astype(np.uint16 if short_indices else np.uint32).reshape(-1, 1)
    material: dict[str, Any] = {
        "name": "object",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 0.0 if textures.metalness is None else 1.0,
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
        indices, "SCALAR", UNSIGNED_SHORT if short_indices else UNSIGNED_INT, target=ELEMENT_ARRAY_BUFFER
    )
    if abs(f0 - DIELECTRIC) > 1e-4:
        name, value = reflectance_extension(f0)
        material["extensions"], document["extensionsUsed"] = {name: value}, [name]
    document |= {"bufferViews": buffer.views, "accessors": buffer.accessors, "buffers": [{}]}
    binary = bytes(buffer.data) + b"\0" * (-len(buffer.data) % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    data = header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    files.write_atomically(path, lambda partial: partial.write_bytes(data))


def _png(values: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """An RGB image as a PNG file."""
    return cv2.imencode(".png", cv2.cvtColor(values, cv2.COLOR_RGB2BGR), PNG_SETTINGS)[1].tobytes()


def reflectance_extension(f0: float) -> tuple[str, dict[str, float]]:
    """Name and value of the glTF extension for a reflectance at normal incidence other than 0.04.

    Below 0.04 a factor scales the specular lobe at all angles, as `brdf.fresnel` does; above 0.04 the index of
    refraction is given.
    """
    if f0 < DIELECTRIC:
        return "KHR_materials_specular", {"specularFactor": f0 / DIELECTRIC}
    return "KHR_materials_ior", {"ior": (1 + math.sqrt(f0)) / (1 - math.sqrt(f0))}


def _unit32(x: Float[np.ndarray, "n 3"]) -> np.ndarray:
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def _tangents32(x: Float[np.ndarray, "n 4"]) -> np.ndarray:
    return np.concatenate([_unit32(x[:, :3]), x[:, 3:].astype(np.float32)], 1)
