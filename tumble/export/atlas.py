"""The texture atlas: the mesh is cut into charts, these are flattened, and packed into the unit square.

A *chart* is a connected part of the surface that is flattened in one piece. xatlas cuts and flattens the mesh. The
charts are packed here, because xatlas mirrors charts when it rotates them, and leaves up to half of the texture empty:
they are placed one by one on a grid of *cells*, the largest first, each where it fits best beside those placed before,
at the largest common scale at which all fit. Long charts are cut in two where this helps.
"""

import importlib.util
import math
from dataclasses import dataclass
from functools import partial
from itertools import takewhile

import cv2
import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from numpy import fft

from tumble.export.mesh import Mesh, components, unit_rows, vertex_normals
from tumble.io import in_threads
from tumble.maths import local_frame

CELL = 4
"""Side of a cell of the grid on which charts are packed [texels]; larger if the grid would exceed `MAX_CELLS`."""
MIN_CELLS, MAX_CELLS = 128, 512
"""Limits of the side of the grid [cells]."""
GAP = 2
"""Free cells around every chart, so that filters and the first mipmaps do not mix charts."""
ROTATIONS = 8
"""Number of rotations that are tried for each chart; they are never mirrored, which some viewers handle wrongly."""
LARGE_CHARTS = 64
"""Number of charts that are rotated; more of them are crumbs, which fit anywhere."""
MAX_CHARTS = 128
"""Number of charts above which xatlas packs them, because packing them here would take minutes: the surface is so rough
that no texture of it can be painted."""
PROXIMITY = 1 / 32
"""Distance over which the benefit of being close to other charts and to the border decreases by a factor e [side of the
texture]."""
ATTEMPTS = (
    *((longest, (0.75, 0.76, 0.77)) for longest in (math.inf, 0.6, 0.35, 0.28)),
    *((0.35, (filled,)) for filled in (0.73, 0.7, 0.66, 0.6, 0.5, 0.35, 0.2, 0.05)),
)
"""Maximum length of a chart [side of the texture at 75 %], and fractions of the texture that the charts cover, in the
order in which they are tried: the last fraction at which the charts fit is used."""
SUBCELL_BITS = 4
"""Fractional bits of the vertex positions when charts are drawn into the grid."""
MAX_COST = 8.0
"""Cost at which xatlas stops to add faces to a chart; four times its default, for fewer and larger charts."""
MAX_PART = 12_500
"""Number of triangles above which a mesh is cut in two before its charts are found, which takes time that grows with
the square of the number of triangles."""
ITERATIONS = 1
"""Number of times that xatlas grows the charts, from better seeds each time; most of its time."""


@dataclass(frozen=True)
class UnwrappedMesh:
    """A triangle mesh with texture coordinates; vertices on a seam of the atlas are duplicated."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    """Unit length, equal on both sides of a seam."""
    tangents: Float[np.ndarray, "v 4"]
    """Unit direction of increasing u, and the sign w in bitangent = w cross(normal, tangent), towards smaller v."""
    uv: Float[np.ndarray, "v 2"]
    """glTF texture coordinates: the origin is the top left corner of the texture."""
    faces: Int[np.ndarray, "f 3"]


def require_xatlas() -> None:
    """Check that meshes can be unwrapped, before the work that would be lost.

    Raises:
        ModuleNotFoundError: xatlas is not installed; the message says how to go on.
    """
    if importlib.util.find_spec("xatlas") is None:
        raise ModuleNotFoundError("xatlas, which unwraps meshes, is missing: pip install xatlas, or use --preset splat")


def unwrap(mesh: Mesh, resolution: int) -> UnwrappedMesh:
    """The mesh with one set of texture coordinates without overlaps, of few charts that fill the texture.

    Args:
        resolution: Side of the texture [texels].

    Raises:
        ValueError: The surface is in too many pieces for a texture.
    """
    charts = _charts(mesh, resolution)
    if charts.count > MAX_CHARTS:
        return _unwrapped(mesh, charts.origin, charts.uv, charts.faces)
    uv, faces, source = pack(charts.uv * charts.size, charts.faces, resolution)
    return _unwrapped(mesh, charts.origin[source], uv, faces)


def unwrap_loosely(mesh: Mesh, resolution: int) -> UnwrappedMesh:
    """As `unwrap`, in two thirds of the time: xatlas places the charts, so that up to half of the texture is empty."""
    charts = _charts(mesh, resolution)
    return _unwrapped(mesh, charts.origin, charts.uv, charts.faces)


@dataclass(frozen=True)
class _Charts:
    """The charts of a mesh as xatlas cuts, flattens and places them."""

    count: int
    origin: Int[np.ndarray, " w"]
    """Vertex of the mesh that each vertex is."""
    uv: Float[np.ndarray, "w 2"]
    """glTF texture coordinates."""
    faces: Int[np.ndarray, "f 3"]
    size: tuple[int, int]
    """Width and height of the texture for which they are placed [texels]."""


def _charts(mesh: Mesh, resolution: int) -> _Charts:
    require_xatlas()
    import xatlas

    atlas, normals, parts = xatlas.Atlas(), vertex_normals(mesh), []
    for part in _halved(mesh.vertices[mesh.faces].mean(1), np.arange(len(mesh.faces))):
        used, local = np.unique(mesh.faces[part], return_inverse=True)
        parts.append((part, used))
        triangles = local.reshape(-1, 3).astype(np.uint32)
        atlas.add_mesh(mesh.vertices[used].astype(np.float32), triangles, normals[used].astype(np.float32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost, charts.max_iterations, charts.fix_winding = MAX_COST, ITERATIONS, True
    packing.resolution, packing.padding, packing.bilinear = resolution, GAP * CELL, True
    packing.rotate_charts = False
    atlas.generate(charts, packing)
    origin, uv, faces, first = [], [], np.empty_like(mesh.faces), 0
    for i, (part, used) in enumerate(parts):
        of_vertex, triangles, coordinates = atlas[i]
        origin.append(used[of_vertex])
        uv.append(coordinates.astype(np.float64))
        faces[part] = triangles.astype(np.int64).reshape(-1, 3) + first
        first += len(of_vertex)
    # The v of xatlas points up (its charts are counterclockwise), that of glTF down.
    uv = np.concatenate(uv) * [1, -1] + [0, 1]
    return _Charts(atlas.chart_count, np.concatenate(origin), uv, faces, (atlas.width, atlas.height))


def _halved(centres: Float[np.ndarray, "f 3"], part: Int[np.ndarray, " p"]) -> list[Int[np.ndarray, " _"]]:
    """The triangles, given by their centres, halved along their longest axis until parts have at most `MAX_PART`."""
    if len(part) <= MAX_PART:
        return [part]
    relative = centres[part] - centres[part].mean(0)
    along = relative @ np.linalg.svd(relative, full_matrices=False)[2][0]
    upper = along > np.median(along)
    return [piece for side in (~upper, upper) for piece in _halved(centres, part[side])]


def _unwrapped(
    mesh: Mesh, origin: Int[np.ndarray, " w"], uv: Float[np.ndarray, "w 2"], faces: Int[np.ndarray, "f 3"]
) -> UnwrappedMesh:
    vertices, normals = mesh.vertices[origin], vertex_normals(mesh)[origin]
    return UnwrappedMesh(vertices, normals, _tangents(vertices, normals, uv, faces), uv, faces)


def _tangents(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    uv: Float[np.ndarray, "v 2"],
    faces: Int[np.ndarray, "f 3"],
) -> Float[np.ndarray, "v 4"]:
    """Tangents of vertices: directions of increasing u, averaged over the adjacent faces, orthogonal to the normals."""
    corners, corners_uv = vertices[faces], uv[faces]
    (x1, x2), (p1, p2) = (
        (values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]) for values in (corners, corners_uv)
    )
    # Twice the signed area in the texture: negative for charts that are not mirrored, because v points down.
    area = (p1[:, 0] * p2[:, 1] - p1[:, 1] * p2[:, 0])[:, None]
    along = (x1 * p2[:, 1:] - x2 * p1[:, 1:]) * np.sign(area)
    total, sign = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(total, faces[:, corner], along)
        np.add.at(sign, faces[:, corner], -area[:, 0])
    total -= normals * (total * normals).sum(1, keepdims=True)
    fallback = local_frame(torch.from_numpy(np.ascontiguousarray(normals, np.float64)))[..., 0].numpy()
    total = np.where(np.linalg.norm(total, axis=1, keepdims=True) > 1e-12, total, fallback)
    return np.concatenate([unit_rows(total), np.where(sign < 0, -1.0, 1.0)[:, None]], 1)


# Packing --------------------------------------------------------------------------------------------------------------


def pack(
    uv: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "f 3"], resolution: int
) -> tuple[Float[np.ndarray, "w 2"], Int[np.ndarray, "f 3"], Int[np.ndarray, " w"]]:
    """Texture coordinates in the unit square with the charts rotated, moved, and scaled by a common factor.

    Args:
        uv: Coordinates of the charts in any unit; they may overlap.
        faces: Triangles; a chart is a connected component.
        resolution: Side of the texture [texels].

    Returns:
        Coordinates, triangles in the same order, and the index in `uv` of each vertex; those on a cut are duplicated.

    Raises:
        ValueError: There are too many charts.
    """
    label = components(len(uv), faces)[faces[:, 0]]
    corners = uv[faces]
    (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = np.abs(a * d - b * c).sum() / 2
    n = min(max(resolution // CELL, MIN_CELLS), MAX_CELLS)
    charts: list[Int[np.ndarray, " _"]] = []
    for longest, fractions in ATTEMPTS:
        whole = [np.nonzero(label == name)[0] for name in np.unique(label)]
        charts = [part for chart in whole for part in _cut(corners, chart, longest * math.sqrt(area / 0.75))]
        charts.sort(key=lambda chart: -float(np.ptp(corners[chart].reshape(-1, 2), axis=0).prod()))
        attempts = (_place([corners[chart] * (n * math.sqrt(x / area)) for chart in charts], n) for x in fractions)
        placed = list(takewhile(len, attempts))
        if placed:
            packed, name = np.zeros_like(corners), np.zeros_like(faces)
            for number, (chart, position) in enumerate(zip(charts, placed[-1], strict=True)):
                packed[chart], name[chart] = position / n, number
            _, first, index = np.unique(name * len(uv) + faces, return_index=True, return_inverse=True)
            return packed.reshape(-1, 2)[first], index.reshape(-1, 3), faces.ravel()[first]
    raise ValueError(f"the surface has {len(charts)} pieces, too many for a texture; use --preset splat")


def _cut(
    corners: Float[np.ndarray, "f 3 2"], chart: Int[np.ndarray, " c"], longest: float
) -> list[Int[np.ndarray, " _"]]:
    """The triangles of a chart, cut in half across its longer axis until no part is longer than `longest`."""
    centres = corners[chart].mean(1) - corners[chart].mean((0, 1))
    along = centres @ np.linalg.svd(centres, full_matrices=False)[2][0]
    if np.ptp(along) <= longest:
        return [chart]
    half = along < (along.min() + along.max()) / 2
    return [part for side in (half, ~half) for part in _cut(corners, chart[side], longest)]


def _place(charts: list[Float[np.ndarray, "_ 3 2"]], n: int) -> list[Float[np.ndarray, "_ 3 2"]]:
    """Charts, given by the corners of their triangles [cells], moved to free places on a grid of n x n cells.

    Empty if not all of them fit.
    """
    occupied = np.zeros((n, n), np.uint8)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * GAP + 1, 2 * GAP + 1))
    placed = []
    for index, chart in enumerate(charts):
        to_border = np.pad(1 - occupied, 1)
        distance = cv2.distanceTransform(to_border, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
        spectra = fft.rfft2(np.stack([occupied.astype(np.float32), np.exp(-distance / (PROXIMITY * n))]))
        turns = [turn / ROTATIONS for turn in range(ROTATIONS if index < LARGE_CHARTS else 1)]
        options = in_threads(partial(_placed, chart, spectra, n), turns)
        value, row, column, shape = max(options, key=lambda option: option[0])
        if value == -math.inf:
            return []
        height, width = shape.cells.shape
        region = np.zeros_like(occupied)
        region[row : row + height, column : column + width] = shape.cells
        occupied = np.maximum(occupied, cv2.dilate(region, around))
        placed.append(shape.corners + np.array([column, row]))
    return placed


@dataclass(frozen=True)
class _Shape:
    """A rotated chart on the grid, with its bounding box at the origin."""

    corners: Float[np.ndarray, "f 3 2"]
    """[cells]"""
    cells: np.ndarray
    """1 in all cells that the chart touches, u8[h w]."""


def _placed(
    chart: Float[np.ndarray, "f 3 2"], spectra: Complex[np.ndarray, "2 n _"], n: int, turn: float
) -> tuple[float, int, int, _Shape]:
    """The best position of the chart rotated by a part of a turn (see `_best_position`), and its shape."""
    shape = _rasterized(chart, 2 * math.pi * turn)
    if max(shape.cells.shape) > n:
        return -math.inf, 0, 0, shape
    value, row, column = _best_position(spectra, shape.cells, n)
    return value, row, column, shape


def _rasterized(chart: Float[np.ndarray, "f 3 2"], angle: float) -> _Shape:
    """The chart rotated by an angle [radians] and drawn into cells."""
    c, s = math.cos(angle), math.sin(angle)
    corners = chart @ np.array([[c, s], [-s, c]])
    # Half a cell of margin: the centre of the first cell is at 0.5, and drawing rounds to the nearest cell.
    corners = corners - corners.reshape(-1, 2).min(0) + 0.5
    width, height = np.ceil(corners.reshape(-1, 2).max(0) + 0.5).astype(int)
    cells = np.zeros((height, width), np.uint8)
    triangles = np.rint((corners - 0.5) * (1 << SUBCELL_BITS)).astype(np.int32)
    cv2.fillPoly(cells, triangles, 1, cv2.LINE_8, SUBCELL_BITS)
    return _Shape(corners, cells)


def _best_position(spectra: Complex[np.ndarray, "2 n _"], cells: np.ndarray, n: int) -> tuple[float, int, int]:
    """Value, row and column of the best position of a shape that touches no occupied cell; -inf if there is none.

    The value is the mean proximity of the shape's outline to occupied cells and the border.

    Args:
        spectra: Fourier transforms of the occupied cells and of the proximity to them.
        cells: 1 in the cells of the shape, u8[h w].
        n: Side of the grid [cells].
    """
    height, width = cells.shape
    inner = cv2.erode(cells, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    outline = cells - inner
    # One axis after the other: most rows of the kernels are zero, and not all rows of the sums are used.
    kernels = fft.fft(fft.rfft(np.stack([cells, outline]).astype(np.float32), n), n, axis=1)
    product = np.multiply(spectra, np.conjugate(kernels, out=kernels), out=kernels)
    rows = fft.ifft(product, axis=1)[:, : n - height + 1]
    overlap, value = fft.irfft(rows, n)[..., : n - width + 1]
    value = np.where(overlap > 0.5, -np.inf, value / outline.sum())
    row, column = divmod(int(value.argmax()), value.shape[1])
    return float(value[row, column]), row, column
