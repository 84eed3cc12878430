"""Models: GLB files for `synth`, and sparse COLMAP models."""

import copy
import io
import json
import struct
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from tests.hostile.cases import RUN, SIDE, Case, cut, flipped, pictures, poses, put
from tests.hostile.pictures import stated

SYNTH = ["synth", "x.glb", "--env", "white", "-o", "out"]
"""The command that reads a GLB."""


@cache
def box() -> bytes:
    """A textured box as GLB."""
    mesh = trimesh.creation.box()
    texture = Image.fromarray(np.full((8, 8, 3), 200, np.uint8))
    mesh.visual = TextureVisuals(np.zeros((len(mesh.vertices), 2)), material=PBRMaterial(baseColorTexture=texture))
    stream = io.BytesIO()
    mesh.export(stream, file_type="glb")
    return stream.getvalue()


def packed(document: dict[str, Any] | bytes, binary: bytes) -> bytes:
    """A GLB from its document and its binary chunk."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def parts() -> tuple[dict[str, Any], bytes]:
    """Document and binary chunk of the box."""
    length = int.from_bytes(box()[12:16], "little")
    return json.loads(box()[20 : 20 + length]), box()[28 + length :]


def changed(change: Callable[[dict[str, Any]], object]) -> bytes:
    """The box with a changed document."""
    document, binary = parts()
    document = copy.deepcopy(document)
    change(document)
    return packed(document, binary)


def with_texture(content: bytes) -> bytes:
    """The box with another texture file."""
    document, binary = parts()
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    view |= {"byteOffset": len(binary), "byteLength": len(content)}
    document["buffers"][0]["byteLength"] = len(binary) + len(content)
    return packed(document, binary + content)


def instances(document: dict[str, Any], n: int) -> None:
    """Refer to the mesh by n nodes."""
    document["nodes"] = [{"mesh": 0, "name": f"n{i}"} for i in range(n)]
    document["scenes"] = [{"nodes": list(range(n))}]


def cycle(document: dict[str, Any]) -> None:
    document["nodes"] = [{"children": [1], "mesh": 0}, {"children": [0]}]
    document["scenes"] = [{"nodes": [0]}]


def doubled(document: dict[str, Any]) -> None:
    """Every node has its successor twice as a child: 2^30 instances."""
    document["nodes"] = [{"children": [i + 1, i + 1]} for i in range(30)] + [{"mesh": 0}]
    document["scenes"] = [{"nodes": [0]}]


def glb() -> dict[str, bytes]:
    """Files that are no model, by name."""
    first: Callable[[dict[str, Any], str], Any] = lambda d, key: d[key][0]  # noqa: E731
    primitive: Callable[[dict[str, Any]], Any] = lambda d: d["meshes"][0]["primitives"][0]  # noqa: E731
    changes: dict[str, Callable[[dict[str, Any]], object]] = {
        "a billion vertices": lambda d: [a.update(count=10**9) for a in d["accessors"]],
        "10^400 vertices": lambda d: first(d, "accessors").update(count=10**400),
        "a count that is negative": lambda d: first(d, "accessors").update(count=-1),
        "a count that is a word": lambda d: first(d, "accessors").update(count="many"),
        "no counts": lambda d: [a.pop("count") for a in d["accessors"]],
        "an accessor without data of a gigabyte": lambda d: first(d, "accessors").update(count=10**8, bufferView=None),
        "a hundred thousand instances": lambda d: instances(d, 100_000),
        "a cycle of nodes": cycle,
        "a node that is its own child": lambda d: d["nodes"][0].update(children=[0]),
        "2^30 instances": doubled,
        "a missing mesh": lambda d: d.update(nodes=[{"mesh": 7}]),
        "a missing node": lambda d: d.update(nodes=[{"children": [9]}]),
        "a missing accessor": lambda d: primitive(d).update(indices=99),
        "indices that are a word": lambda d: primitive(d).update(indices="all"),
        "meshes that are null": lambda d: d.update(meshes=None),
        "nodes that are a dict": lambda d: d.update(nodes={}),
        "no meshes": lambda d: (d.pop("meshes"), d.pop("nodes")),
        "a buffer elsewhere": lambda d: first(d, "buffers").update(uri="/etc/passwd"),
        "a buffer on the net": lambda d: first(d, "buffers").update(uri="http://127.0.0.1:1/x"),
        "a texture elsewhere": lambda d: first(d, "images").update(uri="../../etc/passwd"),
        "a view beyond the file": lambda d: [v.update(byteOffset=10**9) for v in d["bufferViews"]],
        "a view of 10^18 bytes": lambda d: [v.update(byteLength=10**18) for v in d["bufferViews"]],
        "a matrix of 1e300": lambda d: d["nodes"][-1].update(matrix=[1e300] * 16),
        "a matrix of zeros": lambda d: d["nodes"][-1].update(matrix=[0.0] * 16),
        "a matrix of words": lambda d: d["nodes"][-1].update(matrix=["a"] * 16),
        "an unknown component type": lambda d: first(d, "accessors").update(componentType=1),
    }
    textures = {"of 60000 x 60000": stated(60_000, 60_000), "that is text": b"no", "cut": stated(9, 9)[:30]}
    textures |= {"of 8000 x 9000": stated(8000, 9000), "of PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n"}
    points = trimesh.PointCloud(np.eye(3)).export(file_type="ply")
    return {
        **{name: changed(change) for name, change in changes.items()},
        **{f"a texture {name}": with_texture(content) for name, content in textures.items()},
        **{"empty": b"", "text": b"a box", "zeros": bytes(500), "a header": box()[:12], "no binary": packed({}, b"")},
        **{f"cut at {part}": cut(box(), part) for part in (0.05, 0.3, 0.7)},
        **{f"byte {i} flipped": flipped(box(), i) for i in (0, 4, 13, 15, 16, 20, 21)},
        "nested": packed(b'{"nodes":' + b"[" * 100_000, b""),
        "a list": packed(b"[]", b""),
        "a PLY": points if isinstance(points, bytes) else bytes(points),
        "a PLY of 10^9 vertices": b"ply\nformat ascii 1.0\nelement vertex 1000000000\nproperty float x\nend_header\n",
        "a terabyte stated": struct.pack("<4sII", b"glTF", 2, 0xFFFFFFFF) + struct.pack("<I4s", 0xFFFFFFF0, b"JSON"),
    }


# COLMAP ---------------------------------------------------------------------------------------------------------------


def colmap(cameras: str = "", images: str = "", points: str = "") -> dict[str, bytes]:
    """A folder of images with a text model, of which some files may be replaced."""
    lines = ""
    for i, T in enumerate(poses()):
        R = np.diag([1.0, -1, -1]) @ T[:3, :3].T
        t = -R @ T[:3, 3]
        x, y, z, w = Rotation.from_matrix(R).as_quat()
        lines += f"{i + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {i:04}.png\n\n"
    model = {
        "cameras.txt": cameras or f"1 PINHOLE {SIDE} {SIDE} 40 40 12 12\n",
        "images.txt": images or lines,
        "points3D.txt": points or "1 0 0 0 0 0 0 0.5\n",
    }
    files = {f"in/sparse/0/{name}": text.encode() for name, text in model.items()}
    return files | {f"in/{name}": content for name, content in pictures().items()}


def colmap_cases() -> Iterator[Case]:
    """Sparse models."""
    size = f"{SIDE} {SIDE}"
    cameras = {
        "fisheye k of 1e30": f"1 OPENCV_FISHEYE {size} 40 40 12 12 0 0 0 1e30",
        "fisheye k of 5000": f"1 OPENCV_FISHEYE {size} 40 40 12 12 5000 -5000 5000 5000",
        "k of 1e30": f"1 OPENCV {size} 40 40 12 12 1e30 0 0 0",
        "a focal length of 1e30": f"1 PINHOLE {size} 1e30 1e30 12 12",
        "a focal length of 1e-30": f"1 PINHOLE {size} 1e-30 1e-30 12 12",
        "a negative focal length": f"1 PINHOLE {size} 40 -40 12 12",
        "a focal length of inf": f"1 PINHOLE {size} inf inf 12 12",
        "a focal length of nan": f"1 PINHOLE {size} nan 40 12 12",
        "a centre of 1e300": f"1 PINHOLE {size} 40 40 1e300 12",
        "a size of 1e9": "1 PINHOLE 1000000000 1000000000 40 40 12 12",
        "a size of 1e400": "1 PINHOLE 1e400 24 40 40 12 12",
        "another size": "1 PINHOLE 25 24 40 40 12 12",
        "an unknown model": f"1 MOEBIUS {size} 40 40 12 12",
        "too few numbers": f"1 PINHOLE {size} 40",
        "words": f"one PINHOLE {size} 40 40 12 12",
    }
    for name, line in cameras.items():
        yield Case(f"COLMAP: {name}", partial(put, contents=colmap(cameras=line)), RUN, r"in[:/]")
    pose = "1 0 0 0 0 0 4 1 0000.png\n\n"
    images = {
        "no rotation": "1 0 0 0 0 0 0 4 1 0000.png\n\n",
        "a quaternion of 1e200": "1 1e200 1e200 0 0 0 0 4 1 0000.png\n\n",
        "a quaternion of nan": "1 nan 0 0 0 0 0 4 1 0000.png\n\n",
        "positions of 1e300": "".join(f"{i} 1 0 0 0 0 0 1e300 1 000{i}.png\n\n" for i in range(8)),
        "one image": f"1 {pose}",
        "equal poses": "".join(f"{i} 1 0 0 0 0 0 4 1 000{i}.png\n\n" for i in range(8)),
        "an image twice": f"1 {pose}2 {pose}",
        "a missing camera": "1 1 0 0 0 0 0 4 9 0000.png\n\n",
        "a path to elsewhere": "1 1 0 0 0 0 0 4 1 ../../etc/passwd\n\n",
        "a path with a zero": "1 1 0 0 0 0 0 4 1 a\0b.png\n\n",
        "a name of 5000 letters": f"1 1 0 0 0 0 0 4 1 {'a' * 5000}.png\n\n",
        "too few words": "1 1 0 0\n\n",
        "no images": "# none\n",
    }
    for name, lines in images.items():
        yield Case(f"COLMAP: {name}", partial(put, contents=colmap(images=lines)), RUN, r"(in|out/capture)[:/]")
    for name, line in {"words": "1 a b c 0 0 0 0", "infinity": "1 inf 0 0 0 0 0 0", "too few numbers": "1 2"}.items():
        yield Case(f"COLMAP: points of {name}", partial(put, contents=colmap(points=line)), RUN, r"in/.*points3D")
    many: dict[str, Callable[[], bytes]] = {
        "images.txt": lambda: b"\n" * (300 << 20),
        "points3D.txt": lambda: b"1" * (300 << 20),
        "cameras.txt": lambda: b"".join(b"%d SIMPLE_PINHOLE 9 9 9 4 4\n" % i for i in range(500_000)),
    }
    for name, made in many.items():
        files = {**colmap(), f"in/sparse/0/{name}": made}
        yield Case(f"COLMAP: {name} of many lines", partial(put, contents=files), RUN, rf"{name}: ", large=True)
    binary = {
        "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, SIDE, SIDE, 40, 40, 12, 12),
        "images.bin": struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 4, 1) + b"0000.png\0" + struct.pack("<Q", 0),
    }
    for name, content in binary.items():
        for what, damaged in {
            "a count of 2^64": b"\xff" * 8 + content[8:],
            "cut": content[:-5],
            "empty": b"",
            "ones": b"\xff" * 200,
        }.items():
            files = {f"in/sparse/0/{file}": whole for file, whole in binary.items()} | {f"in/sparse/0/{name}": damaged}
            files |= {f"in/{file}": whole for file, whole in pictures().items()}
            yield Case(f"COLMAP: {name} is {what}", partial(put, contents=files), RUN, r"in[:/]")


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for name, content in glb().items():
        yield Case(f"GLB: {name}", partial(put, contents={"x.glb": content}), SYNTH, r"x\.glb: ")
    yield from colmap_cases()
