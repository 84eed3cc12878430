"""The demo's object: a small enamel coffee pot with lid, spout and handle, as a textured GLB.

A *solid* is a closed surface swept along an axis; its *profile* is the radius r at distance s from the upper end of the
axis. A profile consists of *segments*, each mapped to a *chart*, a rectangle of the texture atlas: either as a *strip*
(columns run around the axis) or as a *disc* (its centre is on the axis). Atlas coordinates are pixels from the top left
corner, as in glTF.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from tumble.io import files
from tumble.synthetic.demo_object import label

ATLAS = (1024, 512)
"""Width and height of both textures [pixels]."""
GUTTER = 4
"""Width of the border around a chart, a copy of its edge, so that texture filters do not mix two charts [pixels]."""
COLUMNS = 80
"""Vertices per ring of body and lid."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Chart:
    """A rectangle of the atlas [pixels] and the layout of a surface on it."""

    kind: Literal["strip", "lying", "top", "bottom"]
    """strip: columns run around the axis; lying: a strip rotated by 90 degrees to the left; top, bottom: a disc whose
    centre is the first or the last point of the profile."""
    left: int
    top: int
    width: int
    height: int


CHARTS = {
    "body": Chart("strip", 4, 4, 1016, 292),
    "lid": Chart("top", 4, 304, 204, 204),
    "base": Chart("bottom", 216, 304, 204, 204),
    "spout": Chart("strip", 428, 304, 150, 204),
    "handle": Chart("lying", 586, 304, 430, 66),
    "knob": Chart("strip", 586, 378, 170, 130),
    "lid_under": Chart("bottom", 764, 378, 130, 130),
    "body_top": Chart("top", 902, 378, 60, 60),
    "spout_hole": Chart("top", 970, 378, 46, 46),
    "spout_end": Chart("bottom", 970, 432, 46, 46),
    "handle_start": Chart("top", 902, 446, 26, 26),
    "handle_end": Chart("bottom", 936, 446, 26, 26),
}
"""Layout of the atlas, by the name of the chart."""


@dataclass(frozen=True)
class Segment:
    """A part of a solid's profile and its chart."""

    profile: Points
    """Control points (r, s) [metres]."""
    rows: int
    """Number of rings."""
    chart: str
    """Key of `CHARTS`."""


@dataclass(frozen=True)
class PotMesh:
    """A triangle mesh with texture coordinates; y up."""

    vertices: Float[np.ndarray, "v 3"]
    """Positions [metres]."""
    normals: Float[np.ndarray, "v 3"]
    """Unit vertex normals."""
    uv: Float[np.ndarray, "v 2"]
    """glTF texture coordinates; the origin is the top left corner of the atlas."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices, counter-clockwise from outside."""


PROFILES: dict[str, Points] = {
    "body_top": [(0, 0.1042), (0.0300, 0.1042)],
    "body": [
        *[(0.0300, 0.1042), (0.0350, 0.1046), (0.0375, 0.1050), (0.0395, 0.1030), (0.0390, 0.1000), (0.0372, 0.0985)],
        *[(0.0385, 0.0920), (0.0440, 0.0680), (0.0485, 0.0360), (0.0500, 0.0120), (0.0500, 0.0030), (0.0480, 0.0)],
        (0.0440, 0.0),
    ],
    "base": [(0.0440, 0.0), (0.0420, 0.0), (0.0400, 0.0026), (0.0360, 0.0028), (0, 0.0028)],
    "lid": [
        *[(0, 0.1240), (0.0140, 0.1236), (0.0240, 0.1212), (0.0285, 0.1180), (0.0290, 0.1150), (0.0320, 0.1142)],
        *[(0.0390, 0.1125), (0.0422, 0.1095), (0.0422, 0.1060), (0.0405, 0.1050), (0.0385, 0.1056)],
    ],
    "lid_under": [(0.0385, 0.1056), (0.0360, 0.1056), (0, 0.1056)],
    "knob": [
        *[(0, 0.1480), (0.0070, 0.1478), (0.0118, 0.1440), (0.0125, 0.1380), (0.0095, 0.1325), (0.0052, 0.1295)],
        *[(0.0050, 0.1265), (0.0085, 0.1235), (0.0090, 0.1215), (0, 0.1215)],
    ],
}
"""Control points (r, y) of the surfaces of revolution about the upright axis, from top to bottom [metres]."""
SPOUT_AXIS: Points = [(-0.0960, 0.1080), (-0.0850, 0.0990), (-0.0760, 0.0790), (-0.0660, 0.0540), (-0.0240, 0.0290)]
"""Control points (x, y) of the spout's axis, from its mouth into the body [metres]."""
SPOUT_MOUTH: Points = [
    (0.0052, 0.010),
    (0.0056, 0.001),
    (0.0068, -0.0012),
    (0.0082, 0.0006),
    (0.0080, 0.008),
    (0.0092, 0.035),
]
"""Control points (r, s) of the spout's upper end, from the inside over the lip [metres]."""
HANDLE_AXIS: Points = [(0.033, 0.089), (0.056, 0.100), (0.087, 0.096), (0.090, 0.062), (0.074, 0.029), (0.044, 0.023)]
"""Control points (x, y) of the handle's axis, which starts and ends inside the body [metres]."""


def parts() -> dict[str, PotMesh]:
    """The solids of the pot by name, each a closed mesh: body, lid, knob, spout and handle."""
    spout_length = _arc_lengths(_smooth_curve(SPOUT_AXIS, 200))[-1]
    handle_length = _arc_lengths(_smooth_curve(HANDLE_AXIS, 200))[-1]
    return {
        "body": _revolved({"body_top": 3, "body": 32, "base": 9}, COLUMNS),
        "lid": _revolved({"lid": 22, "lid_under": 4}, COLUMNS),
        "knob": _revolved({"knob": 20}, 32),
        "spout": _swept(
            SPOUT_AXIS,
            [
                Segment([(0, 0.010), (0.0052, 0.010)], 2, "spout_hole"),
                Segment([*SPOUT_MOUTH, (0.0128, 0.065), (0.0165, spout_length)], 30, "spout"),
                Segment([(0.0165, spout_length), (0, spout_length)], 2, "spout_end"),
            ],
            28,
        ),
        "handle": _swept(
            HANDLE_AXIS,
            [
                Segment([(0, 0), (0.0082, 0)], 2, "handle_start"),
                Segment([(0.0082, 0), (0.0082, handle_length)], 36, "handle"),
                Segment([(0.0082, handle_length), (0, handle_length)], 2, "handle_end"),
            ],
            20,
            flatness=0.62,
        ),
    }


def _revolved(rows: dict[str, int], columns: int) -> PotMesh:
    """A closed surface of revolution about the upright axis, from the names and numbers of rings of its `PROFILES`."""
    top = 0.16
    segments = [Segment([(r, top - y) for r, y in PROFILES[name]], n, name) for name, n in rows.items()]
    return _swept([(0.0, top), (0.0, 0.0)], segments, columns)


def _swept(axis: Points, segments: list[Segment], columns: int, *, flatness: float = 1.0) -> PotMesh:
    """A closed surface around an axis in the plane z = 0.

    Args:
        axis: Control points (x, y) from the upper end to the lower one [metres].
        segments: Segments of the profile from the upper end to the lower one; each starts at the end of the previous.
        columns: Vertices per ring.
        flatness: Ratio of the thickness in the plane of the axis to that across it.
    """
    spine = _smooth_curve(axis, 200)
    along = _arc_lengths(spine)
    tangents = np.gradient(spine, along, axis=0)
    angle = np.linspace(-1.5 * math.pi, 0.5 * math.pi, columns + 1)
    angle[-1] = angle[0]  # exactly the same points on both sides of the seam
    vertices, uv, faces, count = [], [], [], 0
    for segment in segments:
        r, s = _smooth_curve(segment.profile, segment.rows).T
        x, y = (_interpolate(s, along, spine[:, i]) for i in (0, 1))
        tx, ty = (np.interp(s, along, tangents[:, i]) for i in (0, 1))
        length = np.hypot(tx, ty)
        # From outside, with the axis pointing down, columns run to the right: z, then z cross tangent.
        across = np.stack([-ty / length, tx / length, 0 * tx], -1)[:, None] * np.sin(angle)[:, None] * flatness
        ahead = np.array([0.0, 0.0, 1.0]) * np.cos(angle)[:, None]
        ring = np.stack([x, y, 0 * x], -1)[:, None] + r[:, None, None] * (across + ahead)
        vertices.append(ring.reshape(-1, 3))
        atlas_uv = _atlas_coordinates(CHARTS[segment.chart], _arc_lengths(np.stack([r, s], -1)), columns)
        uv.append(atlas_uv.reshape(-1, 2) / ATLAS)
        faces.append(_grid_faces(segment.rows, columns + 1) + count)
        count += segment.rows * (columns + 1)
    return _with_normals(np.concatenate(vertices), np.concatenate(uv), np.concatenate(faces))


def _smooth_curve(points: Points, n: int) -> Float[np.ndarray, "n 2"]:
    """`n` points of a smooth curve near control points (three rounds of Chaikin's corner cutting), denser at bends."""
    curve = np.asarray(points, np.float64)
    for _ in range(3 if len(curve) > 2 else 0):
        inner = np.stack([0.75 * curve[:-1] + 0.25 * curve[1:], 0.25 * curve[:-1] + 0.75 * curve[1:]], 1)
        curve = np.concatenate([curve[:1], inner.reshape(-1, 2), curve[-1:]])
    steps = np.diff(curve, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    bend = np.abs(np.diff(heading, prepend=heading[0])) + np.abs(np.diff(heading, append=heading[-1]))
    # A bend of one radian has as many points as a tenth of the curve's length.
    weight = np.linalg.norm(steps, axis=1)
    weight = np.concatenate([[0.0], np.cumsum(weight / weight.sum() + 0.05 * bend)])
    at = np.linspace(0, weight[-1], n)
    return np.stack([np.interp(at, weight, curve[:, i]) for i in (0, 1)], -1)


def _arc_lengths(curve: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Length of a polyline from its start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def _interpolate(at: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Linear interpolation of (x, y) at positions `at`, with linear extrapolation before the first point."""
    return np.interp(at, x, y) + np.minimum(at - x[0], 0) * (y[1] - y[0]) / (x[1] - x[0])


def _atlas_coordinates(chart: Chart, length: Float[np.ndarray, " r"], columns: int) -> Float[np.ndarray, "r c 2"]:
    """Atlas coordinates of a grid of rings, whose rows have the given arc lengths along the profile."""
    along = length / length[-1]
    revolution = np.linspace(0, 1, columns + 1)
    if chart.kind == "strip":
        u, v = np.meshgrid(revolution, along)
        return np.stack([chart.left + u * chart.width, chart.top + v * chart.height], -1)
    if chart.kind == "lying":
        u, v = np.meshgrid(1 - revolution, along)
        return np.stack([chart.left + v * chart.width, chart.top + u * chart.height], -1)
    angle = 2 * math.pi * (revolution - 0.75)
    radius = (along if chart.kind == "top" else 1 - along)[:, None] * (chart.width / 2 - 1)
    # Seen from above the pot, +z is at the lower edge of the chart; seen from below, at the upper edge.
    down = np.cos(angle) if chart.kind == "top" else -np.cos(angle)
    centre = (chart.left + chart.width / 2, chart.top + chart.height / 2)
    return np.stack([centre[0] + radius * np.sin(angle), centre[1] + radius * down], -1)


def _grid_faces(rows: int, columns: int) -> Int[np.ndarray, "f 3"]:
    """Two triangles per cell of a grid, counter-clockwise if rows go down and columns to the right."""
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    b, c, d = a + columns, a + columns + 1, a + 1
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def _with_normals(vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> PotMesh:
    """A mesh with smooth normals, equal for all vertices at one position, and without degenerate triangles."""
    _, position = np.unique(np.round(vertices * 1e7).astype(np.int64), axis=0, return_inverse=True)
    position = position.reshape(-1)
    a, b, c = position[faces].T
    faces = faces[(a != b) & (b != c) & (c != a)]
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((position.max() + 1, 3))
    for corner in range(3):
        np.add.at(normals, position[faces[:, corner]], face_normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PotMesh(vertices, normals[position], uv, faces)


# The file -------------------------------------------------------------------------------------------------------------


def atlas() -> tuple[UInt8[np.ndarray, "512 1024 3"], UInt8[np.ndarray, "512 1024 3"]]:
    """The pot's two textures: base colour (sRGB), and roughness in the green channel (glTF's layout)."""
    colour = np.full((ATLAS[1], ATLAS[0], 3), 128, np.uint8)
    packed = np.zeros_like(colour)
    packed[..., 1] = 128
    for name, chart in CHARTS.items():
        lying = chart.kind == "lying"
        across, along = (chart.height, chart.width) if lying else (chart.width, chart.height)
        chart_colour, chart_roughness = (
            np.rot90(_with_gutter(layer), int(lying)) for layer in label.paint(name, across, along).textures()
        )
        rows = slice(chart.top - GUTTER, chart.top + chart.height + GUTTER)
        columns = slice(chart.left - GUTTER, chart.left + chart.width + GUTTER)
        colour[rows, columns] = chart_colour
        packed[rows, columns, 1:2] = chart_roughness
    return colour, packed


def _with_gutter(texture: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "g v c"]:
    """A chart's texture with its gutter: the opposite side on the left and right, its own edge above and below."""
    wrapped = np.pad(texture, ((0, 0), (GUTTER, GUTTER), (0, 0)), "wrap")
    return np.pad(wrapped, ((GUTTER, GUTTER), (0, 0), (0, 0)), "edge")


def write_pot(path: Path) -> None:
    """Write the pot as a GLB in metres, y up, spout at -x, handle at +x, label at +z; deterministic on one machine."""
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    colour, packed = (Image.fromarray(texture) for texture in atlas())
    material = PBRMaterial(
        name="enamel",
        baseColorTexture=colour,
        metallicRoughnessTexture=packed,
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    scene = trimesh.Scene()
    for name, mesh in parts().items():
        # trimesh's v axis points up.
        uv = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], -1)
        visual = TextureVisuals(uv=uv, material=material)
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, visual=visual, process=False)
        scene.add_geometry(solid, node_name=name, geom_name=name)
    data = bytes(export_glb(scene, include_normals=True))
    files.write_atomically(path, lambda partial: partial.write_bytes(data))
