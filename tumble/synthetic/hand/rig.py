"""A rigged right hand: joints, skin weights, and its mesh posed by the flexion of its joints.

The *bind pose* is the flat hand as the file stores it [metres]. In the bind frame of a joint, -z points along the bone
to the fingertip and +y to the back of the hand, so that a finger curls by a rotation about -x (WebXR Hand Input).
"""

import dataclasses
import json
import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

RIG = Path(__file__).parent / "right.glb"
"""WebXR generic hand (MIT, tumble/data/LICENSES.md): 1360 vertices, 25 joints, metric."""
DIGITS = ("thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger")
"""Prefixes of the names of the joints of each digit."""
BONES = ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
"""Suffixes of the names of the joints along a digit; the thumb has no intermediate one."""
FLEXED = 3
"""Joints that flex per digit, from the palm to the tip: all three of the thumb, the three phalanges of a finger."""
WRIST_END = 0.006
"""Distance behind the wrist at which the hand's mesh ends, inside of the forearm [metres]; the file's ends later."""


@dataclass(frozen=True)
class Rig:
    """A hand in its bind pose."""

    vertices: Float[Tensor, "v 3"]
    """Positions [metres]."""
    faces: Int[Tensor, "f 3"]
    """Vertex indices, counter-clockwise from outside."""
    uv: Float[Tensor, "v 2"]
    """glTF texture coordinates."""
    weights: Float[Tensor, "v joints"]
    """Skin weights; each row sums to 1."""
    bind: Float[Tensor, "joints 4 4"]
    """Joint to hand frame in the bind pose."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the wrist. A parent comes before its children."""
    chains: Int[Tensor, "5 3"]
    """Joints of each digit that flex, from the palm to the tip, in the order of `DIGITS`."""


@cache
def read_rig() -> Rig:
    """The bundled hand."""
    document, binary = _chunks(RIG.read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    attributes = {name: _accessor(document, binary, i) for name, i in primitive["attributes"].items()}
    skin = document["skins"][0]
    faces = _accessor(document, binary, primitive["indices"]).reshape(-1, 3).astype(np.int64)
    names = [document["nodes"][i]["name"] for i in skin["joints"]]
    # glTF stores matrices column by column.
    inverse_bind = _accessor(document, binary, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    bind = np.linalg.inv(inverse_bind.astype(np.float64))
    behind_wrist = (attributes["POSITION"] - bind[0, :3, 3]) @ bind[0, :3, 2]
    weights = np.zeros((len(attributes["POSITION"]), len(names)))
    for joint, weight in zip(attributes["JOINTS_0"].T, attributes["WEIGHTS_0"].T, strict=True):
        np.add.at(weights, (np.arange(len(weights)), joint), weight)
    parents, chains = [-1] * len(names), []
    for digit in DIGITS:
        chain = [names.index(f"{digit}-{bone}") for bone in BONES if f"{digit}-{bone}" in names]
        for parent, joint in zip([names.index("wrist"), *chain], chain, strict=False):
            parents[joint] = parent
        chains.append(chain[-1 - FLEXED : -1])
    return Rig(
        torch.from_numpy(attributes["POSITION"].astype(np.float64)),
        torch.from_numpy(faces[behind_wrist[faces].mean(1) < WRIST_END]),
        torch.from_numpy(attributes["TEXCOORD_0"].astype(np.float64)),
        torch.from_numpy(weights / weights.sum(1, keepdims=True)),
        torch.from_numpy(bind),
        tuple(parents),
        torch.tensor(chains),
    )


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk of a GLB file (glTF 2.0, section 4)."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def _accessor(document: dict[str, Any], binary: bytes, number: int) -> np.ndarray:
    """Values of an accessor, one row per element."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    dtype = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    return np.frombuffer(binary, dtype, accessor["count"] * width, start).reshape(-1, width)


def joint_transforms(
    rig: Rig, flexion: Float[Tensor, "*b 5 3"], opposition: Float[Tensor, "*b"]
) -> Float[Tensor, "*b joints 4 4"]:
    """Joint to hand frame of posed hands; the wrist stays in its bind pose.

    Args:
        rig: The hand.
        flexion: Rotation of each joint of `Rig.chains` about its -x axis [radians]; 0 is the bind pose.
        opposition: Rotation of the thumb about the wrist's -z axis, from beside the palm to in front of it [radians].
    """
    batch = flexion.shape[:-2]
    local = torch.eye(4, dtype=rig.bind.dtype).expand(*batch, len(rig.parents), 4, 4).clone()
    local[..., rig.chains.flatten(), :, :] = _rotation(-flexion.flatten(-2), axis=0)
    thumb = int(rig.chains[0, 0])
    R_thumb_wrist = torch.zeros_like(rig.bind[0])
    R_thumb_wrist[:3, :3] = rig.bind[thumb, :3, :3].T @ rig.bind[0, :3, :3]
    R_thumb_wrist[3, 3] = 1.0
    swing = R_thumb_wrist @ _rotation(opposition, axis=2) @ R_thumb_wrist.T
    local[..., thumb, :, :] = swing @ local[..., thumb, :, :]
    posed: list[Tensor] = []
    for joint, parent in enumerate(rig.parents):
        rest = rig.bind[joint] if parent < 0 else posed[parent] @ torch.linalg.inv(rig.bind[parent]) @ rig.bind[joint]
        posed.append(rest @ local[..., joint, :, :])
    return torch.stack(posed, -3)


def _rotation(angle: Float[Tensor, "*b"], *, axis: int) -> Float[Tensor, "*b 4 4"]:
    """Rotation about a coordinate axis as a homogeneous matrix."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = torch.eye(4, dtype=angle.dtype).expand(*angle.shape, 4, 4).clone()
    matrix[..., i, i] = matrix[..., j, j] = angle.cos()
    matrix[..., j, i], matrix[..., i, j] = angle.sin(), -angle.sin()
    return matrix


def skinned(rig: Rig, joints: Float[Tensor, "*b joints 4 4"]) -> Float[Tensor, "*b v 3"]:
    """Vertices of posed hands by linear blend skinning, in the hand frame [unit of the rig]."""
    skin = (joints @ torch.linalg.inv(rig.bind))[..., :3, :].flatten(-2)
    blended = (rig.weights @ skin).unflatten(-1, (3, 4))
    return (blended[..., :3] @ rig.vertices[:, :, None])[..., 0] + blended[..., 3]


def scaled(rig: Rig, factor: float) -> Rig:
    """The rig in another unit of length, `factor` per metre."""
    bind = rig.bind.clone()
    bind[:, :3, 3] *= factor
    return dataclasses.replace(rig, vertices=rig.vertices * factor, bind=bind)
