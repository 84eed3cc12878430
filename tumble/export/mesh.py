"""Triangles from Gaussians: depth maps from all around, fused into a signed distance, marched, thinned and unwrapped.

Object frame, object radius = 1, faces counterclockwise from outside. A *cell* is a cube of the grid, whose corners hold
the *values*: signed distances to the surface, positive outside, in units of a cell and clamped to `BAND`.
"""

from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, Int32
from torch import Tensor
from torch.nn.functional import max_pool3d, normalize

from tumble.maths.directions import fibonacci_sphere, local_frame
from tumble.maths.se3 import SE3, SO3
from tumble.rendering.buffers import Buffers
from tumble.rendering.rasterize import rasterize
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians

BAND = 4
"""How far from the surface values are known [cells]: more than half the diagonal of a block of 4 x 4 x 4."""
THROUGH = 0.15
"""Share of the views that must see through a point for no view to count it as inside: keeps thin walls thin."""
DISTANCE = 6.0
"""From the cameras to the centre [object radius]."""
REACH = 1.08
"""Half the side of the grid, and what the cameras see [object radius]."""
CHUNK = 1 << 18
"""Points fused at once: bounds memory, changes nothing else."""
SMALL = 0.02
"""Share of the largest component's triangles below which another one is dropped as a floater."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, object frame."""

    vertices: Float[np.ndarray, "v 3"]
    """[object radius]"""
    faces: Int[np.ndarray, "f 3"]


@dataclass(frozen=True)
class Unwrapped:
    """A mesh with texture coordinates; vertices on a seam are there more than once."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    """Unit; the same on both sides of a seam."""
    tangents: Float[np.ndarray, "v 4"]
    """Unit direction of growing u, and the sign w with bitangent = w cross(normal, tangent) towards smaller v."""
    uv: Float[np.ndarray, "v 2"]
    """glTF texture coordinates: the origin is the top left corner of the texture."""
    faces: Int[np.ndarray, "f 3"]


# Depth maps -----------------------------------------------------------------------------------------------------------


def around(n: int, pixels: int) -> tuple[SE3, Camera]:
    """Poses of `n` cameras spread evenly around the object, and what they have in common."""
    backward = fibonacci_sphere(n, dtype=torch.float64)
    R_obj_cam = local_frame(-backward)
    T_cam_obj = SE3.from_rotation(SO3.from_matrix(R_obj_cam), DISTANCE * backward).inverse()
    focal = 0.5 * pixels * (DISTANCE**2 / REACH**2 - 1) ** 0.5
    centre = pixels / 2
    camera = Camera(torch.tensor([focal, focal, centre, centre]), pixels, pixels)
    return SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), camera


@torch.no_grad()
def distances(
    gaussians: Gaussians, gamma: Float[Tensor, ""], *, cells: int, views: int, pixels: int
) -> Float[np.ndarray, "g g g"]:
    """Values at the corners of a grid of `cells`^3 that spans [-REACH, REACH]^3, from depth maps of `views` cameras.

    What some views see through is outside, what none sees is inside; near the surface it is the weighted mean of
    distances to the planes that the views' depths and normals span (Curless and Levoy 1996, with planes for points).

    Args:
        gamma: Sharpness of the opacity [1 / object radius].
        cells: A multiple of 4.
        pixels: Side of the depth maps.
    """
    poses, camera = around(views, pixels)
    means = gaussians.means
    camera = Camera(camera.fx_fy_cx_cy.to(means), pixels, pixels)
    poses = SE3(poses.wxyz.to(means), poses.xyz.to(means))
    cell, backs = 2 * REACH / cells, _turned_over(gaussians)
    sights, near = [], torch.zeros((cells + 1,) * 3, dtype=torch.bool, device=means.device)
    for i in range(views):
        view = rasterize(gaussians, gamma, poses[i], camera, {})
        known, x_obj = _surface(view, poses[i], camera, 2 * cell)
        back = rasterize(backs, gamma, poses[i], camera, {}).alpha
        sights.append(_sight(view, known, back, x_obj))
        at = ((x_obj[known] + REACH) / cell).round().long().clamp(0, cells)
        near[at[:, 0], at[:, 1], at[:, 2]] = True
    corners = torch.where(_grown(near, BAND))
    coarse = torch.cartesian_prod(*[torch.arange(2, cells + 1, 4, device=means.device)] * 3)

    def fused(index: Int[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        return torch.cat([_fused(rows * cell - REACH, sights, poses, camera, cell) for rows in index.split(CHUNK)])

    blocks = fused(coarse).sign().reshape((cells // 4,) * 3) * BAND
    values = torch.full((cells + 1,) * 3, float(BAND), device=means.device)
    values[:cells, :cells, :cells] = blocks.repeat_interleave(4, 0).repeat_interleave(4, 1).repeat_interleave(4, 2)
    values[corners] = fused(torch.stack(corners, -1))
    # Nothing reaches the grid's own faces, so that the surface is closed.
    values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]] = BAND, BAND, BAND
    return values.cpu().numpy()


def _surface(
    view: Buffers, T_cam_obj: SE3, camera: Camera, spread: float
) -> tuple[Bool[Tensor, "h w"], Float[Tensor, "h w 3"]]:
    """Which pixels show one surface, no mixture of a near and a far one, and where it lies, object frame."""
    known = (view.alpha > 0.5) & (view.depth_var < spread**2) & (view.normal.norm(dim=-1) > 0.1)
    x_cam = camera.unproject(camera.pixel_centers().to(view.depth), view.depth)
    return known, T_cam_obj.inverse() @ x_cam


def _turned_over(gaussians: Gaussians) -> Gaussians:
    """The same with the other side outwards: what a view sees of them it sees from within the object."""
    half_turn = SO3(gaussians.quats.new_tensor([0.0, 1.0, 0.0, 0.0]))
    return replace(gaussians, quats=(SO3(normalize(gaussians.quats, dim=-1)) @ half_turn).wxyz)


@dataclass(frozen=True)
class _Sight:
    """What one view tells; most of its pixels tell little, and there are many views of many pixels."""

    state: Int8[Tensor, " p"]
    """1: a surface; 0: nothing; -1: sky."""
    place: Int32[Tensor, " p"]
    """Of a pixel's plane, where it has one."""
    planes: Float[Tensor, "k 5"]
    """Normal, offset and depth."""


def _sight(
    view: Buffers, known: Bool[Tensor, "h w"], back: Float[Tensor, "h w"], x_obj: Float[Tensor, "h w 3"]
) -> _Sight:
    """A view of the far side's back looks in where no frame ever showed the object: that is no sky."""
    normal = normalize(view.normal[known], dim=-1)
    offset = (normal * x_obj[known]).sum(-1)
    state = known.to(torch.int8) - ((view.alpha < 0.5) & (back < 0.5)).to(torch.int8)
    place = (known.flatten().cumsum(0, dtype=torch.int32) - 1).clamp(min=0)
    planes = torch.cat([normal, torch.stack([offset, view.depth[known]], -1)], -1)
    # A view of nothing but sky.
    planes = planes if len(planes) else planes.new_zeros(1, 5)
    return _Sight(state.flatten(), place, planes)


def _fused(
    x_obj: Float[Tensor, "n 3"], sights: list[_Sight], poses: SE3, camera: Camera, cell: float
) -> Float[Tensor, " n"]:
    """Signed distances [cells] of points, from all views' planes."""
    total, weights, outer, outer_weights, through = x_obj.new_zeros(5, len(x_obj))
    for i, sight in enumerate(sights):
        x_cam = poses[i] @ x_obj
        column, row = camera.project(x_cam).floor().long().unbind(-1)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        pixel = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        state, (normal, rest) = sight.state[pixel], sight.planes[sight.place[pixel].long()].split([3, 2], -1)
        offset, depth = rest.unbind(-1)
        distance = ((normal * x_obj).sum(-1) - offset) / cell
        behind = (x_cam[:, 2] - depth) / cell
        through += ~inside | (state < 0) | ((state > 0) & (behind < -3 * BAND) & (distance > BAND))
        cosine = (normal * (poses[i].inverse().xyz - x_obj)).sum(-1) / DISTANCE
        # Two cells behind the surface a view knows no more: it may be another one's air. With a wider fade a plate of
        # three cells comes out four thick (test_a_thin_plate_keeps_both_sides).
        fade = (1 + (distance + 0.5).clamp(max=0) / 1.5).clamp(min=0)
        near = inside & (state > 0) & (distance.abs() < BAND) & (behind.abs() < 3 * BAND)
        weight = near * fade * cosine.clamp(min=0).square()
        total, weights = total + weight * distance, weights + weight
        outer, outer_weights = outer + weight * distance.clamp(min=0), outer_weights + weight * (distance > 0)
    air = through > THROUGH * len(sights)
    total, weights = torch.where(air, outer, total), torch.where(air, outer_weights, weights)
    unseen = torch.where(through >= 2, float(BAND), -float(BAND))
    return torch.where(weights > 0.1, total / weights.clamp(min=0.1), unseen)


def _grown(marked: Bool[Tensor, "a b c"], reach: int) -> Bool[Tensor, "a b c"]:
    """All within `reach` of what is marked, along each axis."""
    x = marked[None, None].float()
    for axis in range(3):
        kernel, padding = [1, 1, 1], [0, 0, 0]
        kernel[axis], padding[axis] = 2 * reach + 1, reach
        x = max_pool3d(x, kernel, 1, padding)
    return x[0, 0] > 0


# Marching -------------------------------------------------------------------------------------------------------------


def march(values: Float[np.ndarray, "a b c"], origin: float, cell: float) -> Mesh:
    """The surface where the values change sign, by marching tetrahedra: closed and manifold off the grid's faces.

    Args:
        values: Positive outside.
        origin: All three coordinates of the first corner [object radius].
        cell: Width of a cell [object radius].
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
    share = (value_a / (value_a - value_b))[:, None]
    at_a, at_b = (np.stack(np.unravel_index(i, values.shape), -1) for i in (a, b))
    return Mesh(origin + cell * (at_a + share * (at_b - at_a)), faces.reshape(-1, 3))


def _tetrahedra() -> Int[np.ndarray, "6 4 3"]:
    """Corners of the six tetrahedra of a cell, one per way from (0, 0, 0) to (1, 1, 1) (Kuhn), right-handed."""
    found = []
    for order in permutations(range(3)):
        path = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], 0)])
        found.append(path if np.linalg.det(path[1:]) > 0 else path[[0, 2, 1, 3]])
    return np.stack(found)


def _triangles(code: int) -> list[list[list[int]]]:
    """Triangles in a tetrahedron by which corners are inside; each point lies on an edge between two corners."""
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


def without_floaters(mesh: Mesh) -> Mesh:
    """The largest component, and every other with at least `SMALL` of its triangles."""
    label = _components(len(mesh.vertices), mesh.faces)[mesh.faces[:, 0]]
    names, counts = np.unique(label, return_counts=True)
    return _compact(mesh.vertices, mesh.faces[np.isin(label, names[counts >= SMALL * counts.max()])])


def _components(n: int, faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " n"]:
    """A number for each vertex, the same for all that hang together: the smallest one spreads, in leaps."""
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
    """Without the vertices that no face has."""
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], index.reshape(-1, 3))


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """About the same surface of at most `triangles`, by quadric edge collapse (Garland and Heckbert 1997)."""
    import fast_simplification

    vertices, faces = mesh.vertices, mesh.faces
    for aggressiveness in (3.0, 5.0, 7.0, 9.0):
        if len(faces) <= triangles:
            break
        # It stops early where the errors allowed by its schedule are used up.
        vertices, faces = fast_simplification.simplify(
            vertices.astype(np.float64), faces.astype(np.int32), target_count=triangles, agg=aggressiveness
        )[:2]
    # Triangles without area stay: without them the surface has cracks.
    return _compact(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))


def vertex_normals(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Unit normals, faces weighted by their area."""
    corners = mesh.vertices[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], face)
    return _unit(total)


def diameter(vertices: Float[np.ndarray, "v 3"]) -> float:
    """The largest distance between two vertices: among the extreme ones in 4096 directions."""
    directions = fibonacci_sphere(4096, dtype=torch.float64).numpy()
    extreme = np.unique(np.concatenate([(vertices @ rows.T).argmax(0) for rows in np.split(directions, 16)]))
    corners = torch.from_numpy(np.ascontiguousarray(vertices[extreme], np.float64))
    return float(torch.cdist(corners, corners).max())


# The atlas ------------------------------------------------------------------------------------------------------------


def unwrapped(mesh: Mesh, resolution: int, padding: int) -> Unwrapped:
    """One set of texture coordinates without overlaps, by xatlas.

    Args:
        resolution: Side of the texture [texels].
        padding: Texels left free around every chart.
    """
    import xatlas

    normals = vertex_normals(mesh)
    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), normals.astype(np.float32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations = 1
    packing.resolution, packing.padding, packing.bilinear = resolution, padding, True
    # xatlas turns charts by swapping u and v: a mirrored one is one more thing that a viewer can get wrong.
    charts.fix_winding, packing.rotate_charts = True, False
    atlas.generate(charts, packing)
    origin, faces, uv = atlas[0]
    # Its v runs upwards, for its charts are counterclockwise.
    faces, uv = faces.astype(np.int64).reshape(-1, 3), np.stack([uv[:, 0], 1 - uv[:, 1]], 1).astype(np.float64)
    vertices, normals = mesh.vertices[origin], normals[origin]
    return Unwrapped(vertices, normals, _tangents(vertices, normals, uv, faces), uv, faces)


def _tangents(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    uv: Float[np.ndarray, "v 2"],
    faces: Int[np.ndarray, "f 3"],
) -> Float[np.ndarray, "v 4"]:
    """Directions of growing u, mean over the faces of a vertex, at right angles to its normal."""
    corners, places = vertices[faces], uv[faces]
    (x1, x2), (p1, p2) = ((values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]) for values in (corners, places))
    # Twice the area on the texture, negative where u, v turn like x, y on paper seen from outside: v runs down.
    area = (p1[:, 0] * p2[:, 1] - p1[:, 1] * p2[:, 0])[:, None]
    along = (x1 * p2[:, 1:] - x2 * p1[:, 1:]) * np.sign(area)
    total, sign = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(total, faces[:, corner], along)
        np.add.at(sign, faces[:, corner], -area[:, 0])
    total -= normals * (total * normals).sum(1, keepdims=True)
    spare = local_frame(torch.from_numpy(np.ascontiguousarray(normals, np.float64)))[..., 0].numpy()
    total = np.where(np.linalg.norm(total, axis=1, keepdims=True) > 1e-12, total, spare)
    return np.concatenate([_unit(total), np.where(sign < 0, -1.0, 1.0)[:, None]], 1)


def _unit(x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows of length 1; +z for a row of zeros."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return np.where(length > 1e-20, x / length.clip(1e-20), np.array([0.0, 0.0, 1.0]))
