"""Triangle meshes: extraction from a signed distance grid, removal of floaters, smoothing and simplification.

Object frame, object radius = 1, faces counterclockwise from outside. A *cell* is a cube of the grid; its corners hold
the *values*: signed distances to the surface, positive outside, in any unit (`depth_fusion` computes them).
"""

from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int

from tumble.maths import fibonacci_sphere

if TYPE_CHECKING:
    from scipy import sparse

MIN_COMPONENT_FRACTION = 0.02
"""Size below which a connected component is removed as a floater [fraction of the largest component's triangles]."""
SMOOTHING_STEPS = 10
"""Pairs of steps of Taubin smoothing, which remove the noise of the grid and the slivers of marching, at which charts
of the atlas would break. They move vertices by about a fifth of a cell."""
MAX_TUNNELS = 20
"""Number of tunnels above which they may be noise: a mug has one, scissors have two, a shoe with laces and loops ten;
films of objects in a hand have 35 to 658. Smoothing closes tunnels, but takes thin parts away, too."""
SMOOTHED = (1.0, 1.5, 2.0)
"""Standard deviations of the filters that are tried in turn [cells]."""
SHRINKING, GROWING = 0.5, -0.53
"""Fractions by which the two steps of a pair move a vertex towards the mean of its neighbours (Taubin 1995); together
they keep the volume."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, object frame."""

    vertices: Float[np.ndarray, "v 3"]
    """[object radius]"""
    faces: Int[np.ndarray, "f 3"]


# Marching -------------------------------------------------------------------------------------------------------------


def marching_tetrahedra(values: Float[np.ndarray, "a b c"], origin: float, cell: float) -> Mesh:
    """The zero level set of the values, by marching tetrahedra: closed and manifold except at the grid's boundary.

    Args:
        values: Signed distances in any unit, positive outside.
        origin: Coordinate of the grid's first corner, the same on all three axes [object radius].
        cell: Side of a cell [object radius].
    """
    inside = values < 0
    shape, strides = np.array(values.shape), np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    count = sum(inside[x : shape[0] - 1 + x, y : shape[1] - 1 + y, z : shape[2] - 1 + z].astype(np.int8)
                for x in (0, 1) for y in (0, 1) for z in (0, 1))  # fmt: skip
    first = np.argwhere((count > 0) & (count < 8)) @ strides
    flat = inside.ravel()
    edges = []
    for tetrahedron in _tetrahedra() @ strides:
        corners = first[:, None] + tetrahedron
        codes = flat[corners] @ np.array([1, 2, 4, 8])
        for code in range(1, 15):
            for triangle in _triangles(code):
                edges.append(corners[codes == code][:, triangle])
    ends = np.sort(np.concatenate(edges).reshape(-1, 2), axis=1)
    unique, faces = np.unique(ends[:, 0] * values.size + ends[:, 1], return_inverse=True)
    a, b = unique // values.size, unique % values.size
    value_a, value_b = values.ravel()[a].astype(np.float64), values.ravel()[b].astype(np.float64)
    fraction = (value_a / (value_a - value_b))[:, None]
    at_a, at_b = (np.stack(np.unravel_index(i, values.shape), -1) for i in (a, b))
    return Mesh(origin + cell * (at_a + fraction * (at_b - at_a)), faces.reshape(-1, 3))


def surface(values: Float[np.ndarray, "a b c"], origin: float, cell: float) -> Mesh:
    """The zero level set without floaters, and without the tunnels that noise of the values makes.

    Of an object that a hand hides in part, depth maps contradict each other within the surface, which then has tunnels
    by the hundred and cannot be painted on. Values are smoothed only if there are many, and only for as long as that
    removes most of them, since real holes stay.

    Args:
        values: See `marching_tetrahedra`, as origin and cell.
    """
    from scipy import ndimage

    whole = remove_floaters(marching_tetrahedra(values, origin, cell))
    tunnels = n_tunnels(whole)
    for sigma in SMOOTHED:
        if tunnels <= MAX_TUNNELS:
            break
        smoothed = ndimage.gaussian_filter(values, sigma)
        if smoothed.min() >= 0:
            break
        smoother = remove_floaters(marching_tetrahedra(smoothed, origin, cell))
        left = n_tunnels(smoother)
        if left > tunnels / 2:
            break
        whole, tunnels = smoother, left
    return whole


def n_tunnels(mesh: Mesh) -> int:
    """Number of tunnels of a closed surface, the sum over its components (their genus, by Euler's formula)."""
    euler = len(mesh.vertices) - len(mesh.faces) // 2
    return len(np.unique(components(len(mesh.vertices), mesh.faces))) - euler // 2


def _tetrahedra() -> Int[np.ndarray, "6 4 3"]:
    """Corners of the six tetrahedra of a cell, one per edge path from (0, 0, 0) to (1, 1, 1) (Kuhn), right-handed."""
    tetrahedra = []
    for order in permutations(range(3)):
        path = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], 0)])
        tetrahedra.append(path if np.linalg.det(path[1:]) > 0 else path[[0, 2, 1, 3]])
    return np.stack(tetrahedra)


def _triangles(code: int) -> list[list[list[int]]]:
    """Triangles in a tetrahedron whose inside corners are the bits of `code`; a vertex is an edge (pair of corners)."""
    inside = [i for i in range(4) if code >> i & 1]
    a, b, c, d = next(p for p in permutations(range(4)) if set(p[: len(inside)]) == set(inside) and _is_even(p))
    if len(inside) == 1:
        return [[[a, b], [a, c], [a, d]]]
    if len(inside) == 2:
        return [[[a, c], [a, d], [b, d]], [[a, c], [b, d], [b, c]]]
    return [[[d, a], [d, b], [d, c]]]


def _is_even(order: tuple[int, ...]) -> bool:
    return bool(np.linalg.det(np.eye(len(order))[list(order)]) > 0)


# Triangles ------------------------------------------------------------------------------------------------------------


def remove_floaters(mesh: Mesh) -> Mesh:
    """The mesh without connected components that are smaller than `MIN_COMPONENT_FRACTION` of the largest."""
    label = components(len(mesh.vertices), mesh.faces)[mesh.faces[:, 0]]
    names, counts = np.unique(label, return_counts=True)
    return _compact(mesh.vertices, mesh.faces[np.isin(label, names[counts >= MIN_COMPONENT_FRACTION * counts.max()])])


def components(n: int, faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " n"]:
    """Label of the connected component of each vertex."""
    from scipy import sparse

    start, end = faces[:, :2].ravel(), faces[:, 1:].ravel()
    graph = sparse.coo_matrix((np.ones(len(start), bool), (start, end)), (n, n))
    return sparse.csgraph.connected_components(graph, directed=False)[1]


def _compact(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    """The mesh without unused vertices."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return Mesh(vertices[used], (np.cumsum(used) - 1)[faces])


def smooth(mesh: Mesh) -> Mesh:
    """The mesh without noise at the scale of its edges, of the same topology and volume (Taubin 1995).

    Each edge must belong to two triangles that are oriented alike, as in meshes of `marching_tetrahedra`.
    """
    mean, x = neighbour_means(mesh), mesh.vertices
    for fraction in (SHRINKING, GROWING) * SMOOTHING_STEPS:
        x = x + fraction * (mean @ x - x)
    return Mesh(x, mesh.faces)


def neighbour_means(mesh: Mesh) -> "sparse.csr_matrix":
    """Matrix that takes values of the vertices to the means over their neighbours.

    Each edge must belong to two triangles that are oriented alike.
    """
    from scipy import sparse

    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    n = len(mesh.vertices)
    weight = 1 / np.bincount(start, minlength=n).clip(1)
    return sparse.csr_matrix((weight[start], (start, end)), (n, n))


def simplify(mesh: Mesh, triangles: int) -> Mesh:
    """The mesh reduced to at most `triangles`, if possible, by quadric edge collapse (Garland and Heckbert 1997)."""
    import fast_simplification

    vertices, faces = mesh.vertices, mesh.faces
    for aggressiveness in (3.0, 5.0, 7.0, 9.0):
        if len(faces) <= triangles:
            break
        # A run may stop early, at the error limit of its schedule; the next one is more aggressive.
        vertices, faces = fast_simplification.simplify(
            vertices.astype(np.float64), faces.astype(np.int32), target_count=triangles, agg=aggressiveness
        )[:2]
    # Triangles without area are kept, because removing them would open cracks.
    return _compact(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))


def vertex_normals(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Unit normals of vertices: area-weighted means over the adjacent faces."""
    corners = mesh.vertices[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], face)
    return unit_rows(total)


def diameter(vertices: Float[np.ndarray, "v 3"]) -> float:
    """Largest distance between two vertices, among those that are extreme in one of 4096 directions."""
    corners = torch.from_numpy(np.ascontiguousarray(extreme_points(vertices, 4096), np.float64))
    return float(torch.cdist(corners, corners).max())


def extreme_points(vertices: Float[np.ndarray, "v 3"], directions: int) -> Float[np.ndarray, "e 3"]:
    """Vertices that are the farthest in one of a number of directions, a multiple of 16."""
    towards = fibonacci_sphere(directions, dtype=torch.float64).numpy()
    return vertices[np.unique(np.concatenate([(vertices @ rows.T).argmax(0) for rows in np.split(towards, 16)]))]


def unit_rows(x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows normalised to length 1; a row of zeros becomes +z."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return np.where(length > 1e-20, x / length.clip(1e-20), np.array([0.0, 0.0, 1.0]))
