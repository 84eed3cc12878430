"""Triangle meshes: extraction from a signed distance grid, removal of floaters, simplification, and UV unwrapping.

Object frame, object radius = 1, faces counterclockwise from outside. A *cell* is a cube of the grid; its corners hold
the *values*: signed distances to the surface, positive outside, in any unit (`depth_fusion` computes them).
"""

from dataclasses import dataclass
from itertools import permutations

import numpy as np
import torch
from jaxtyping import Float, Int

from tumble.maths import fibonacci_sphere, local_frame

MIN_COMPONENT_FRACTION = 0.02
"""Size below which a connected component is removed as a floater [fraction of the largest component's triangles]."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, object frame."""

    vertices: Float[np.ndarray, "v 3"]
    """[object radius]"""
    faces: Int[np.ndarray, "f 3"]


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
    label = _components(len(mesh.vertices), mesh.faces)[mesh.faces[:, 0]]
    names, counts = np.unique(label, return_counts=True)
    return _compact(mesh.vertices, mesh.faces[np.isin(label, names[counts >= MIN_COMPONENT_FRACTION * counts.max()])])


def _components(n: int, faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " n"]:
    """Label of the connected component of each vertex, by propagation of minimum labels with pointer jumping."""
    label = np.arange(n)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    while True:
        smallest = label[ends].min(1)
        spread = label.copy()
        np.minimum.at(spread, label[ends].ravel(), smallest.repeat(2))
        spread = spread[spread]
        if (spread == label).all():
            return label
        label = spread


def _compact(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    """The mesh without unused vertices."""
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], index.reshape(-1, 3))


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
    return _unit(total)


def diameter(vertices: Float[np.ndarray, "v 3"]) -> float:
    """Largest distance between two vertices, among those that are extreme in one of 4096 directions."""
    directions = fibonacci_sphere(4096, dtype=torch.float64).numpy()
    extreme = np.unique(np.concatenate([(vertices @ rows.T).argmax(0) for rows in np.split(directions, 16)]))
    corners = torch.from_numpy(np.ascontiguousarray(vertices[extreme], np.float64))
    return float(torch.cdist(corners, corners).max())


# The atlas ------------------------------------------------------------------------------------------------------------


def unwrap(mesh: Mesh, resolution: int, padding: int) -> UnwrappedMesh:
    """The mesh with one set of texture coordinates without overlaps, by xatlas.

    Args:
        resolution: Side of the texture [texels].
        padding: Empty border around every chart [texels].
    """
    import xatlas

    normals = vertex_normals(mesh)
    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), normals.astype(np.float32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations = 1
    packing.resolution, packing.padding, packing.bilinear = resolution, padding, True
    # xatlas rotates charts by swapping u and v, which mirrors them; some viewers handle mirrored charts wrongly.
    charts.fix_winding, packing.rotate_charts = True, False
    atlas.generate(charts, packing)
    origin, faces, uv = atlas[0]
    # The v of xatlas points up (its charts are counterclockwise), that of glTF down.
    faces, uv = faces.astype(np.int64).reshape(-1, 3), np.stack([uv[:, 0], 1 - uv[:, 1]], 1).astype(np.float64)
    vertices, normals = mesh.vertices[origin], normals[origin]
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
    return np.concatenate([_unit(total), np.where(sign < 0, -1.0, 1.0)[:, None]], 1)


def _unit(x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows normalised to length 1; a row of zeros becomes +z."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return np.where(length > 1e-20, x / length.clip(1e-20), np.array([0.0, 0.0, 1.0]))
