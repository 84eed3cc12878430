"""Check of a GLB before it is decoded: its structure, and the size of what it states to hold.

A GLB of a kilobyte can state a billion vertices, refer to one mesh a thousand times, or hold a picture of a gigapixel.
"""

import io
import struct
from collections import Counter
from pathlib import Path
from typing import Annotated

import msgspec
from PIL import Image

from tumble.io import BadFile, files, limits

JSON_CHUNK = 0x4E4F534A
"""Type of the chunk that holds the JSON document."""
ACCESSOR_BYTES = 16
"""Memory of an element of an accessor [bytes]."""
VERTEX_BYTES = 160
"""Memory of a vertex of one instance of a mesh, with position, normal, texture coordinates and copies [bytes]."""
NODE_BYTES = 1 << 15
"""Memory of a node, which limits their number to 16000 [bytes]."""
INDEX_BYTES = 24
"""Memory of an index of one instance of a mesh with normals [bytes]; without them it becomes a vertex of its own."""
EXTENSIONS = ("EXT_texture_webp", "KHR_lights_punctual", "KHR_xmp_json_ld")
"""Extensions that a file may require: they are read, or change nothing that is read."""
MATERIAL_EXTENSIONS = "KHR_materials_"
"""Beginning of the names of extensions of materials, which may be required, too."""

Index = Annotated[int, msgspec.Meta(ge=0)]


class _Accessor(msgspec.Struct, frozen=True):
    count: Index


class _Primitive(msgspec.Struct, frozen=True):
    attributes: dict[str, Index]
    indices: Index | None = None


class _GltfMesh(msgspec.Struct, frozen=True):
    primitives: list[_Primitive]


class _Node(msgspec.Struct, frozen=True):
    children: list[Index] = []
    mesh: Index | None = None


class _Buffer(msgspec.Struct, frozen=True):
    uri: str | None = None


class _View(msgspec.Struct, frozen=True):
    byteLength: Index
    byteOffset: Index = 0


class _Image(msgspec.Struct, frozen=True):
    uri: str | None = None
    bufferView: Index | None = None


class _Gltf(msgspec.Struct, frozen=True):
    """The entries of a glTF document that determine its size."""

    accessors: list[_Accessor] = []
    meshes: list[_GltfMesh] = []
    nodes: list[_Node] = []
    buffers: list[_Buffer] = []
    bufferViews: list[_View] = []
    images: list[_Image] = []
    extensionsRequired: list[str] = []


def require_glb(path: Path) -> None:
    """Check that a file is a GLB that holds all its data, and that these are within the limits after decoding.

    Raises:
        BadFile: The file breaks a rule of glTF 2.0 or exceeds a limit.
    """
    limits.require_file(path, limits.MAX_DECODED_BYTES)
    content = path.read_bytes()
    fix = "save it as binary glTF (.glb), for instance with Blender"
    if len(content) < 20:
        raise BadFile(path, "is not a readable GLB", fix)
    magic, version, _, length, kind = struct.unpack_from("<4s4I", content)
    if (magic, version, kind) != (b"glTF", 2, JSON_CHUNK) or length > len(content) - 20:
        raise BadFile(path, "is not a readable GLB", fix)
    document = files.parse_json(path, content[20 : 20 + length], _Gltf)
    if any(part.uri is not None for part in (*document.buffers, *document.images)):
        raise BadFile(path, "refers to other files", "save it with all data inside")
    required = [name for name in document.extensionsRequired if not name.startswith(MATERIAL_EXTENSIONS)]
    if unknown := [name for name in required if name not in EXTENSIONS]:
        known = f"only {', '.join(EXTENSIONS)} and {MATERIAL_EXTENSIONS}* may be required"
        raise BadFile(path, f"requires the extension {unknown[0]}", f"save it without; {known}")
    try:
        _require_tree(path, document)
        geometry = _geometry_bytes(document)
        textures = sum(_image_bytes(path, document, image, content[28 + length :]) for image in document.images)
    except IndexError:
        raise BadFile(path, "refers to an entry that it does not have") from None
    limits.require_bytes(path, geometry + textures, "vertices and textures")


def _require_tree(path: Path, document: _Gltf) -> None:
    """Every node has at most one parent, and none is its own ancestor."""
    parents = Counter(child for node in document.nodes for child in node.children)
    if parents and max(parents.values()) > 1:
        raise BadFile(path, "has a node with two parents", "nodes must form trees")
    reached = [number for number in range(len(document.nodes)) if number not in parents]
    for number in reached:
        reached += document.nodes[number].children
    if len(reached) < len(document.nodes):
        raise BadFile(path, "has a node that is its own ancestor", "nodes must form trees")


def _geometry_bytes(document: _Gltf) -> int:
    """Memory of all nodes and accessors, and of all instances of all meshes [bytes]."""
    total = NODE_BYTES * len(document.nodes) + sum(ACCESSOR_BYTES * accessor.count for accessor in document.accessors)
    for node in document.nodes:
        for primitive in document.meshes[node.mesh].primitives if node.mesh is not None else []:
            total += VERTEX_BYTES * max((document.accessors[i].count for i in primitive.attributes.values()), default=0)
            size = INDEX_BYTES if "NORMAL" in primitive.attributes else VERTEX_BYTES
            total += 0 if primitive.indices is None else size * document.accessors[primitive.indices].count
    return total


def _image_bytes(path: Path, document: _Gltf, image: _Image, binary: bytes) -> int:
    """Memory of a decoded texture [bytes]; its own size is within the limits."""
    if image.bufferView is None:
        return 0
    view = document.bufferViews[image.bufferView]
    with files.image_errors(path, "has a texture that is not an image"):
        stream = io.BytesIO(binary[view.byteOffset : view.byteOffset + view.byteLength])
        with Image.open(stream, formats=files.IMAGE_FORMATS) as texture:
            width, height = texture.size
    limits.require_image_size(path, width, height, 4)
    return 4 * width * height
