"""Meshes from distance grids and from Gaussians, against shapes with a known surface."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from tests.surfaces import GAMMA, MAJOR, MINOR, flat, sphere, torus
from tumble import backends
from tumble.export import depth_fusion, mesh
from tumble.export.mesh import Mesh
from tumble.maths.directions import fibonacci_sphere
from tumble.scene.gaussians import Gaussians

CELLS = 48
CELL = 2 * depth_fusion.HALF_SIDE / CELLS


def grid(n: int = CELLS) -> np.ndarray:
    axis = np.linspace(-depth_fusion.HALF_SIDE, depth_fusion.HALF_SIDE, n + 1)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)


def to_torus(x: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(x[..., 0], x[..., 1]) - MAJOR, x[..., 2]) - MINOR


def marched(distance: np.ndarray) -> Mesh:
    return mesh.marching_tetrahedra(distance, -depth_fusion.HALF_SIDE, CELL)


def directed_edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def assert_closed(shape: Mesh) -> None:
    """Each edge occurs once in each direction: no holes, manifold, consistent orientation."""
    edges = directed_edges(shape.faces)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(e) for e in edges} == {tuple(e[::-1]) for e in edges}


def euler_characteristic(shape: Mesh) -> int:
    return len(shape.vertices) - len(directed_edges(shape.faces)) // 2 + len(shape.faces)


def volume(shape: Mesh) -> float:
    """Volume by the divergence theorem; positive if faces are counterclockwise from outside."""
    a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def area(shape: Mesh) -> float:
    a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize(
    ("distance", "genus", "true_volume"),
    [
        (np.linalg.norm(grid() - [0.1, -0.05, 0.02], axis=-1) - 0.7, 0, 4 / 3 * math.pi * 0.7**3),
        (to_torus(grid()), 1, 2 * math.pi**2 * MAJOR * MINOR**2),
    ],
    ids=["sphere", "torus"],
)
def test_marching_tetrahedra_give_a_closed_surface_in_the_right_place(
    distance: np.ndarray, genus: int, true_volume: float
) -> None:
    shape = marched(distance)
    assert_closed(shape)
    assert euler_characteristic(shape) == 2 - 2 * genus
    # A chord cuts off about cell^2 / (8 radius): 1 % of the volume at this resolution.
    assert volume(shape) == pytest.approx(true_volume, rel=0.012)


def test_marching_tetrahedra_agree_with_marching_cubes() -> None:
    """Compared on an irregular shape: areas within 0.5 %, because both interpolate linearly along edges."""
    measure = pytest.importorskip("skimage.measure")
    x = grid()
    distance = np.linalg.norm(x * [1.0, 1.4, 2.0] - [0.2, 0, 0.1], axis=-1) - 0.6 + 0.05 * np.sin(5 * x[..., 0])
    vertices, faces, _, _ = measure.marching_cubes(distance, 0.0, spacing=(CELL,) * 3)
    shape = marched(distance)
    other = Mesh(vertices.astype(np.float64) - depth_fusion.HALF_SIDE, faces)
    assert area(shape) == pytest.approx(area(other), rel=5e-3)
    assert volume(shape) == pytest.approx(abs(volume(other)), rel=5e-3)


def test_random_values_give_a_closed_surface() -> None:
    """No sign pattern of a cell leaves a hole: values are pure noise, positive on the grid's faces."""
    values = np.random.default_rng(0).normal(size=(12, 12, 12))
    for axis in range(3):
        np.moveaxis(values, axis, 0)[[0, -1]] = 1.0
    assert_closed(mesh.marching_tetrahedra(values, 0.0, 1.0))


def test_tunnels_of_noise_are_closed_and_real_holes_stay() -> None:
    x = grid()
    to_sphere = np.linalg.norm(x, axis=-1) - 0.7
    noisy = to_sphere + 1.2 * CELL * np.random.default_rng(0).standard_normal(to_sphere.shape)
    assert mesh.n_tunnels(mesh.remove_floaters(marched(noisy))) > 50
    cleaned = mesh.surface(noisy, -depth_fusion.HALF_SIDE, CELL)
    assert mesh.n_tunnels(cleaned) <= mesh.MAX_TUNNELS
    assert_closed(cleaned)
    assert np.abs(np.linalg.norm(cleaned.vertices, axis=1) - 0.7).max() < 2 * CELL
    # A plate with nine holes of two cells' radius.
    middles = [(a, b) for a in (-0.5, 0.0, 0.5) for b in (-0.5, 0.0, 0.5)]
    holes = np.stack([2.5 * CELL - np.hypot(x[..., 0] - a, x[..., 1] - b) for a, b in middles]).max(0)
    plate = np.maximum(np.maximum(np.abs(x[..., :2]).max(-1) - 0.8, np.abs(x[..., 2]) - 0.13), holes)
    kept = mesh.surface(plate, -depth_fusion.HALF_SIDE, CELL)
    assert mesh.n_tunnels(kept) == 9
    assert np.array_equal(kept.vertices, marched(plate).vertices)


def test_thin_loops_stay() -> None:
    """A ball with six loops of wire, as those of a shoe's laces: smoothing would cut them."""
    x = grid()
    solid = np.linalg.norm(x, axis=-1) - 0.5
    for axis in range(3):
        for side in (-1, 1):
            at = np.roll(x, -axis, axis=-1) - np.array([0.5 * side, 0.0, 0.0])
            ring = np.hypot(np.hypot(at[..., 0], at[..., 1]) - 0.3, at[..., 2])
            solid = np.minimum(solid, ring - 1.1 * CELL)
    assert mesh.n_tunnels(marched(solid)) == 6
    assert mesh.n_tunnels(marched(ndimage.gaussian_filter(solid, mesh.SMOOTHED[0]))) < 6
    kept = mesh.surface(solid, -depth_fusion.HALF_SIDE, CELL)
    assert np.array_equal(kept.vertices, marched(solid).vertices)


def fused(gaussians: Gaussians) -> Mesh:
    values = depth_fusion.signed_distances(gaussians, GAMMA, cells=CELLS, views=32, pixels=128)
    return mesh.remove_floaters(mesh.marching_tetrahedra(values, -depth_fusion.HALF_SIDE, CELL))


def test_gaussians_on_a_torus_become_its_surface() -> None:
    """The hole of radius 0.35 stays open; the surface is within a Gaussian's thickness, 0.006, of the centres."""
    shape = fused(torus(3000))
    assert_closed(shape)
    assert euler_characteristic(shape) == 0
    error = np.abs(to_torus(shape.vertices))
    assert error.mean() < 0.006
    assert error.max() < 0.3 * CELL
    assert volume(shape) == pytest.approx(2 * math.pi**2 * MAJOR * MINOR**2, rel=0.03)


def test_a_side_without_gaussians_is_closed() -> None:
    """On a turntable the underside has no Gaussians, so views from below show backs of the upper side."""
    whole = sphere(3000, radius=0.8)
    kept = whole.means[:, 1] > -0.5
    shape = fused(Gaussians(**{name: values[kept] for name, values in vars(whole).items()}))
    assert_closed(shape)
    assert euler_characteristic(shape) == 2
    # At least a plane closes the hole, because level views see free space below it; at most the rest of the sphere.
    height = 0.3
    cap = math.pi * height**2 * (3 * 0.8 - height) / 3
    sphere_volume = 4 / 3 * math.pi * 0.8**3
    assert 0.97 * (sphere_volume - cap) < volume(shape) < 1.02 * sphere_volume
    # The side with Gaussians is where it was.
    radii = np.linalg.norm(shape.vertices[shape.vertices[:, 1] > -0.4], axis=1)
    np.testing.assert_allclose(radii, 0.8, atol=CELL)


def test_small_holes_do_not_let_the_outside_in() -> None:
    """Four holes of half angle 0.3, through which few views look in or through; all of them made an inner surface."""
    whole = sphere(3000, radius=0.8)
    kept = (whole.means[:, :2].abs() < 0.8 * math.cos(0.3)).all(-1)
    pierced = Gaussians(**{name: values[kept] for name, values in vars(whole).items()})
    values = depth_fusion.signed_distances(pierced, GAMMA, cells=CELLS, views=100, pixels=128)
    shape = mesh.remove_floaters(mesh.marching_tetrahedra(values, -depth_fusion.HALF_SIDE, CELL))
    assert volume(shape) == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=0.02)
    assert area(shape) < 1.1 * 4 * math.pi * 0.8**2


def test_a_thin_plate_keeps_both_sides() -> None:
    """A disc of radius 0.7, three cells thick, thinner than the band in which distances are averaged."""
    half = 1.5 * CELL
    i = torch.arange(4000) + 0.5
    r, phi = 0.7 * (i / 4000).sqrt(), 2.399963 * i
    disc = torch.stack([r * phi.cos(), r * phi.sin(), torch.full_like(r, half)], -1)
    turn = torch.arange(2000) * 2.399963
    rim = torch.stack([0.7 * turn.cos(), 0.7 * turn.sin(), half * (2 * torch.arange(2000) / 2000 - 1)], -1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(disc)
    points = torch.cat([disc, disc * torch.tensor([1.0, 1.0, -1.0]), rim])
    normals = torch.cat([up, -up, torch.stack([turn.cos(), turn.sin(), 0 * turn], -1)])
    shape = fused(flat(points, normals, 2 * math.pi * 0.49))
    assert_closed(shape)
    middle = np.linalg.norm(shape.vertices[:, :2], axis=1) < 0.5
    assert np.abs(np.abs(shape.vertices[middle, 2]) - half).max() < 0.05 * CELL
    assert volume(shape) == pytest.approx(math.pi * 0.49 * 2 * half, rel=0.1)


def test_floaters_are_dropped_and_large_parts_kept() -> None:
    x = grid()
    parts = [
        np.linalg.norm(x - centre, axis=-1) - radius
        for centre, radius in (([-0.4, 0, 0], 0.4), ([0.5, 0, 0], 0.3), ([0.5, 0.8, 0.5], 0.04))
    ]
    shape = mesh.remove_floaters(marched(np.minimum.reduce(parts)))
    assert euler_characteristic(shape) == 4, "two spheres"
    assert shape.vertices[:, 1].max() < 0.5


def test_simplification_keeps_the_surface_closed_and_in_place() -> None:
    shape = mesh.simplify(marched(to_torus(grid())), 1500)
    assert 1000 < len(shape.faces) <= 1500
    assert_closed(shape)
    assert np.abs(to_torus(shape.vertices)).max() < 0.3 * CELL


def test_normals_point_outwards() -> None:
    shape = marched(np.linalg.norm(grid(), axis=-1) - 0.8)
    assert (mesh.vertex_normals(shape) * shape.vertices).sum(1).min() > 0.98 * 0.8


def test_the_diameter_is_the_largest_distance() -> None:
    points = np.random.default_rng(1).normal(size=(500, 3)) * [1.0, 0.3, 0.6]
    assert mesh.diameter(points) == pytest.approx(np.linalg.norm(points[:, None] - points, axis=-1).max(), rel=1e-9)


def test_the_surrounding_cameras_see_the_whole_unit_sphere() -> None:
    poses, camera = depth_fusion.surrounding_cameras(20, 64)
    for i in range(20):
        x_cam = poses[i] @ fibonacci_sphere(500)
        assert x_cam[:, 2].min() > 1
        uv = camera.project(x_cam)
        assert uv.min() > 0
        assert uv.max() < 64
        assert uv.max() > 58, "the sphere should fill the image"


def test_smoothing_removes_noise_and_slivers_and_keeps_the_volume() -> None:
    """Noise of an eighth of a cell on a torus."""
    noise = np.random.default_rng(0).normal(scale=CELL / 8, size=(CELLS + 1,) * 3)
    rough = marched(to_torus(grid()) + noise)
    smooth = mesh.smooth(rough)
    assert (smooth.faces == rough.faces).all()
    assert volume(smooth) == pytest.approx(2 * math.pi**2 * MAJOR * MINOR**2, rel=0.01)
    before, after = (np.abs(to_torus(shape.vertices)).mean() for shape in (rough, smooth))
    assert after < 0.8 * before

    def thinnest(shape: Mesh) -> float:
        """First percentile of 4 sqrt(3) area / sum of squared edges: 1 for equilateral triangles, 0 for slivers."""
        a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
        squared_edges = sum(((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a)))
        return float(np.percentile(2 * 3**0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1) / squared_edges, 1))

    assert thinnest(rough) < 0.05
    assert thinnest(smooth) > 0.15


def test_a_sphere_of_gaussians_keeps_its_radius() -> None:
    """Mean error below the thickness of the Gaussians, with a small spread."""
    error = np.linalg.norm(fused(sphere(2000, radius=0.8)).vertices, axis=1) - 0.8
    assert abs(error.mean()) < 0.006
    assert error.std() < 0.02 * CELL


def test_the_kernel_fuses_depth_maps_like_its_definition() -> None:
    """Pixels on whose border a point lies may differ: one point in ten thousand."""
    kernel = backends.fuse_kernel(backends.load("cpu"))
    assert kernel is not None, "the kernels are not compiled"
    generator = torch.Generator().manual_seed(0)
    poses, camera = depth_fusion.surrounding_cameras(6, 64)
    index = torch.randint(-2, 2000, (6, 64, 64), generator=generator, dtype=torch.int32)
    index[:, :8] = depth_fusion.FREE
    planes = torch.randn(2000, 5, generator=generator)
    planes[:, :3] /= planes[:, :3].norm(dim=-1, keepdim=True)
    planes[:, 3:] = torch.tensor([0.0, 6.0]) + 0.2 * planes[:, 3:]
    points = 1.6 * torch.rand(5003, 3, generator=generator) - 0.8
    arguments = points, backends.DepthMaps(index, planes), depth_fusion.posed_cameras(poses, camera)
    given = {"cell": 0.05, "reach": 4.0, "distance": 6.0}
    ours, theirs = (fuse(*arguments, **given) for fuse in (kernel, depth_fusion.sums_by_operations))
    assert (theirs.abs() > 0.1).float().mean(1).min() > 0.1, "all sums occur"
    different = ((ours - theirs).abs() > 1e-4).any(0)
    assert different.float().mean() < 1e-3
