"""The demo's object: a small enamel coffee pot with lid, spout and handle, as a GLB with printed textures.

A *solid* is a closed surface around an axis: its *profile* gives the radius r at the distance s from the axis's upper
end. A *chart* is a rectangle of the atlas that a stretch of a profile is printed on, as a *strip* (columns run around
the axis) or a *disc* (the axis is its centre). Atlas coordinates are pixels from the top left corner, as in glTF.
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
"""Width of the border that repeats a chart's edge, so that no filter mixes two charts [pixels]."""
COLUMNS = 80
"""Most vertices of a ring."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Chart:
    """A rectangle of the atlas [pixels] and how a surface is laid on it."""

    kind: Literal["strip", "lying", "top", "bottom"]
    """A lying strip is turned a quarter to the left; a disc's middle is a profile's first ("top") or last point."""
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


@dataclass(frozen=True)
class Stretch:
    """A part of a solid's profile, and the chart that it is printed from."""

    profile: Points
    """Control points (r, s) [metres]."""
    rows: int
    """Number of rings."""
    chart: str


@dataclass(frozen=True)
class PotMesh:
    """Triangles with a normal and a place on the atlas per vertex; y up, metres."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    """glTF texture coordinates: the origin is the top left corner."""
    faces: Int[np.ndarray, "f 3"]


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
"""(r, height above the table) of what is turned on the upright axis, from above to below [metres]."""
NOZZLE: Points = [(-0.0960, 0.1080), (-0.0850, 0.0990), (-0.0760, 0.0790), (-0.0660, 0.0540), (-0.0240, 0.0290)]
"""Axis of the spout, (x, y) from its mouth into the body [metres]."""
MOUTH: Points = [
    (0.0052, 0.010),
    (0.0056, 0.001),
    (0.0068, -0.0012),
    (0.0082, 0.0006),
    (0.0080, 0.008),
    (0.0092, 0.035),
]
"""Profile of the spout's upper end, (r, s) from inside over the lip [metres]."""
GRIP: Points = [(0.033, 0.089), (0.056, 0.100), (0.087, 0.096), (0.090, 0.062), (0.074, 0.029), (0.044, 0.023)]
"""Axis of the handle, (x, y) from body to body [metres]."""


def parts() -> dict[str, PotMesh]:
    """The solids of the pot, each closed: body, lid, knob, spout and handle."""
    below_mouth, grip = _lengths(_smooth(NOZZLE, 200))[-1], _lengths(_smooth(GRIP, 200))[-1]
    return {
        "body": _turned({"body_top": 3, "body": 32, "base": 9}, COLUMNS),
        "lid": _turned({"lid": 22, "lid_under": 4}, COLUMNS),
        "knob": _turned({"knob": 20}, 32),
        "spout": _solid(
            NOZZLE,
            [
                Stretch([(0, 0.010), (0.0052, 0.010)], 2, "spout_hole"),
                Stretch([*MOUTH, (0.0128, 0.065), (0.0165, below_mouth)], 30, "spout"),
                Stretch([(0.0165, below_mouth), (0, below_mouth)], 2, "spout_end"),
            ],
            28,
        ),
        "handle": _solid(
            GRIP,
            [
                Stretch([(0, 0), (0.0082, 0)], 2, "handle_start"),
                Stretch([(0.0082, 0), (0.0082, grip)], 36, "handle"),
                Stretch([(0.0082, grip), (0, grip)], 2, "handle_end"),
            ],
            20,
            flatness=0.62,
        ),
    }


def _turned(rows: dict[str, int], columns: int) -> PotMesh:
    """A closed surface around the upright axis from PROFILES, by their names and numbers of rings."""
    tallest = 0.16
    stretches = [Stretch([(r, tallest - y) for r, y in PROFILES[name]], n, name) for name, n in rows.items()]
    return _solid([(0.0, tallest), (0.0, 0.0)], stretches, columns)


def _solid(axis: Points, stretches: list[Stretch], columns: int, *, flatness: float = 1.0) -> PotMesh:
    """A closed surface around an axis in the plane z = 0.

    Args:
        axis: Control points (x, y) from the upper end to the lower one [metres].
        stretches: From the upper end to the lower one; each begins where the one before ends.
        flatness: Thickness in the plane of the axis over that across it.
    """
    spine = _smooth(axis, 200)
    along = _lengths(spine)
    tangents = np.gradient(spine, along, axis=0)
    angle = np.linspace(-1.5 * math.pi, 0.5 * math.pi, columns + 1)
    angle[-1] = angle[0]  # exactly the same points on both sides of the seam
    vertices, uv, faces, count = [], [], [], 0
    for stretch in stretches:
        r, s = _smooth(stretch.profile, stretch.rows).T
        x, y = (_linear_extend(s, along, spine[:, i]) for i in (0, 1))
        tx, ty = (np.interp(s, along, tangents[:, i]) for i in (0, 1))
        length = np.hypot(tx, ty)
        # Columns run to the right as seen from outside with the axis pointing down: z, then z cross tangent.
        across = np.stack([-ty / length, tx / length, 0 * tx], -1)[:, None] * np.sin(angle)[:, None] * flatness
        ahead = np.array([0.0, 0.0, 1.0]) * np.cos(angle)[:, None]
        ring = np.stack([x, y, 0 * x], -1)[:, None] + r[:, None, None] * (across + ahead)
        vertices.append(ring.reshape(-1, 3))
        uv.append(_lay(CHARTS[stretch.chart], _lengths(np.stack([r, s], -1)), columns).reshape(-1, 2) / ATLAS)
        faces.append(_grid_faces(stretch.rows, columns + 1) + count)
        count += stretch.rows * (columns + 1)
    return _welded(np.concatenate(vertices), np.concatenate(uv), np.concatenate(faces))


def _smooth(points: Points, n: int) -> Float[np.ndarray, "n 2"]:
    """A curve near control points (three rounds of Chaikin's corner cutting) in `n` steps, denser where it bends."""
    curve = np.asarray(points, np.float64)
    for _ in range(3 if len(curve) > 2 else 0):
        cut = np.stack([0.75 * curve[:-1] + 0.25 * curve[1:], 0.25 * curve[:-1] + 0.75 * curve[1:]], 1)
        curve = np.concatenate([curve[:1], cut.reshape(-1, 2), curve[-1:]])
    steps = np.diff(curve, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    bend = np.abs(np.diff(heading, prepend=heading[0])) + np.abs(np.diff(heading, append=heading[-1]))
    # A turn of one radian gets as many points as a tenth of the curve.
    weight = np.linalg.norm(steps, axis=1)
    weight = np.concatenate([[0.0], np.cumsum(weight / weight.sum() + 0.05 * bend)])
    at = np.linspace(0, weight[-1], n)
    return np.stack([np.interp(at, weight, curve[:, i]) for i in (0, 1)], -1)


def _lengths(curve: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Distance along a polyline to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def _linear_extend(at: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Linear interpolation that goes straight on before the first point."""
    return np.interp(at, x, y) + np.minimum(at - x[0], 0) * (y[1] - y[0]) / (x[1] - x[0])


def _lay(chart: Chart, length: Float[np.ndarray, " r"], columns: int) -> Float[np.ndarray, "r c 2"]:
    """Atlas coordinates of a grid whose rows lie at distances along a profile."""
    along = length / length[-1]
    turn = np.linspace(0, 1, columns + 1)
    if chart.kind == "strip":
        u, v = np.meshgrid(turn, along)
        return np.stack([chart.left + u * chart.width, chart.top + v * chart.height], -1)
    if chart.kind == "lying":
        u, v = np.meshgrid(1 - turn, along)
        return np.stack([chart.left + v * chart.width, chart.top + u * chart.height], -1)
    angle = 2 * math.pi * (turn - 0.75)
    radius = (along if chart.kind == "top" else 1 - along)[:, None] * (chart.width / 2 - 1)
    # Looking at the pot from above, +z is at the lower edge of the picture; from below, at the upper one.
    down = np.cos(angle) if chart.kind == "top" else -np.cos(angle)
    middle = (chart.left + chart.width / 2, chart.top + chart.height / 2)
    return np.stack([middle[0] + radius * np.sin(angle), middle[1] + radius * down], -1)


def _grid_faces(rows: int, columns: int) -> Int[np.ndarray, "f 3"]:
    """Two triangles per cell of a grid, counter-clockwise when rows go down and columns to the right."""
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    b, c, d = a + columns, a + columns + 1, a + 1
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def _welded(vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> PotMesh:
    """Normals shared by all vertices at one place, and no triangles without area."""
    _, place = np.unique(np.round(vertices * 1e7).astype(np.int64), axis=0, return_inverse=True)
    place = place.reshape(-1)
    a, b, c = place[faces].T
    faces = faces[(a != b) & (b != c) & (c != a)]
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = np.zeros((place.max() + 1, 3))
    for corner in range(3):
        np.add.at(summed, place[faces[:, corner]], normal)
    summed /= np.linalg.norm(summed, axis=1, keepdims=True)
    return PotMesh(vertices, summed[place], uv, faces)


# The file -------------------------------------------------------------------------------------------------------------


def atlas() -> tuple[UInt8[np.ndarray, "512 1024 3"], UInt8[np.ndarray, "512 1024 3"]]:
    """Base colour (sRGB) and, in the green channel, roughness: the two textures of the pot."""
    colour = np.full((ATLAS[1], ATLAS[0], 3), 128, np.uint8)
    packed = np.zeros_like(colour)
    packed[..., 1] = 128
    for name, chart in CHARTS.items():
        lying = chart.kind == "lying"
        across, along = (chart.height, chart.width) if lying else (chart.width, chart.height)
        printed, roughness = (
            np.rot90(_framed(layer), int(lying)) for layer in label.paint(name, across, along).textures()
        )
        rows = slice(chart.top - GUTTER, chart.top + chart.height + GUTTER)
        columns = slice(chart.left - GUTTER, chart.left + chart.width + GUTTER)
        colour[rows, columns] = printed
        packed[rows, columns, 1:2] = roughness
    return colour, packed


def _framed(printed: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "g v c"]:
    """A chart with its gutter: what lies around the corner on the left and right, its own edge above and below."""
    around = np.pad(printed, ((0, 0), (GUTTER, GUTTER), (0, 0)), "wrap")
    return np.pad(around, ((GUTTER, GUTTER), (0, 0), (0, 0)), "edge")


def write_object(path: Path) -> None:
    """The pot as a GLB: metres, y up, spout to -x, handle to +x, label to +z; on one machine always the same bytes."""
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
        # trimesh counts v upwards.
        uv = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], -1)
        visual = TextureVisuals(uv=uv, material=material)
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, visual=visual, process=False)
        scene.add_geometry(solid, node_name=name, geom_name=name)
    data = bytes(export_glb(scene, include_normals=True))
    files.write_whole(path, lambda partial: partial.write_bytes(data))
