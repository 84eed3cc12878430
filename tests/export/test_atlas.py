"""The texture atlas: few charts, no overlaps, a gap around every chart, and little of the texture left empty."""

import cv2
import numpy as np
import pytest

from tests.export.test_bake import painted
from tests.export.test_mesh import grid, marched, to_torus
from tests.surfaces import torus
from tumble.export import asset as export
from tumble.export import atlas, mesh
from tumble.export.asset import Preset


def chart_sizes(n: int, faces: np.ndarray) -> np.ndarray:
    """Number of triangles of each chart of `n` vertices."""
    return np.unique(mesh.components(n, faces)[faces[:, 0]], return_counts=True)[1]


def test_an_atlas_has_no_overlaps_and_tangents_follow_u() -> None:
    flat = atlas.unwrap(mesh.simplify(mesh.smooth(marched(to_torus(grid()))), 2000), 256)
    assert flat.uv.min() >= 0
    assert flat.uv.max() <= 1
    corners = flat.uv[flat.faces]
    (u1, v1), (u2, v2) = ((corners[:, i] - corners[:, 0]).T for i in (1, 2))
    # Counterclockwise from outside is counterclockwise in the texture, whose v points down: no chart is mirrored.
    assert (u1 * v2 - u2 * v1 < 1e-12).all()
    assert (flat.tangents[:, 3] == 1).all()
    # Random points: each lies in at most one triangle.
    for x, y in np.random.default_rng(0).random((300, 2)):
        a, b, c = ((x, y) - corners[:, i] for i in range(3))
        turns = [p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))]
        assert (np.max(turns, 0) < -1e-9).sum() <= 1
    # Along an edge the position moves along the tangent when u grows.
    corner, other = flat.faces[:, 0], flat.faces[:, 1]
    step = flat.vertices[other] - flat.vertices[corner]
    du, dv = (flat.uv[other] - flat.uv[corner]).T
    clear = np.abs(du) > 4 * np.abs(dv)
    assert ((step * flat.tangents[corner, :3]).sum(1) * du)[clear].min() > 0


def test_an_exported_surface_has_few_charts_and_hardly_any_crumbs() -> None:
    """A torus of Gaussians; a torus without noise needs about ten charts."""
    small = Preset(triangles=3000, texture=256, cells=64, views=12, pixels=128)
    flat = atlas.unwrap(export.extract_mesh(painted(torus(3000)), small), 256)
    sizes = chart_sizes(len(flat.vertices), flat.faces)
    assert len(sizes) < 40
    assert (sizes <= 5).sum() < 8


def test_packed_charts_keep_their_distance_and_shape_and_fill_the_texture() -> None:
    """Forty rectangles with sides of 2 to 30, none of which is long enough to be cut."""
    rng = np.random.default_rng(0)
    sides = np.sort(rng.uniform(2, 30, (40, 2)) * [1, 0.5], axis=1)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    uv = (corners * sides[:, None]).reshape(-1, 2)
    faces = (4 * np.arange(40)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    packed, same, source = atlas.pack(uv, faces, 512)
    assert packed.min() >= 0
    assert packed.max() <= 1
    assert (source[same] == faces).all()
    quads = packed[np.argsort(source)].reshape(40, 4, 2)
    along, up = quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0]
    scale = np.linalg.norm(along, axis=1) / sides[:, 0]
    assert np.ptp(scale) < 1e-9 * scale[0]
    np.testing.assert_allclose(along[:, 0] * up[:, 1] - along[:, 1] * up[:, 0], scale**2 * sides.prod(1), rtol=1e-9)
    # The gaps of 8 texels alone take more than a tenth of this small texture.
    assert (scale**2 * sides.prod(1)).sum() > 0.65
    # Points on the outlines of different charts.
    t = np.linspace(0, 1, 50)[:, None]
    outlines = [np.concatenate([a + t * (b - a) for a, b in zip(q, np.roll(q, 1, 0), strict=True)]) for q in quads]
    for i in range(40):
        for j in range(i):
            gap = np.linalg.norm(outlines[i][:, None] - outlines[j], axis=-1).min()
            assert gap >= 8 / 512, (i, j)


def test_long_charts_are_cut_where_the_texture_is_filled_better() -> None:
    """Two strips, each longer than the diagonal of a square of their area: uncut they would fill a tenth of it."""
    x, y, strip = (i.ravel() for i in np.meshgrid(np.arange(101.0), [0.0, 4.0], [0.0, 10.0], indexing="ij"))
    uv = np.stack([x, y + strip], 1)
    i = 4 * np.arange(100)[:, None, None] + np.array([0, 1])[:, None]
    faces = np.concatenate([i + np.array([0, 4, 6]), i + np.array([0, 6, 2])], 1).reshape(-1, 3).astype(np.int64)
    packed, same, source = atlas.pack(uv, faces, 512)
    assert (source[same] == faces).all()
    assert len(chart_sizes(len(packed), same)) > 2
    a, b, c = np.moveaxis(packed[same], 1, 0)
    (p, q), (r, s) = (b - a).T, (c - a).T
    assert np.abs(p * s - q * r).sum() / 2 > 0.6


def test_a_surface_of_crumbs_is_packed_by_xatlas(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise of a cell: hundreds of charts, which would take minutes."""

    def never(*_: object) -> None:
        raise AssertionError("packed here")

    monkeypatch.setattr(atlas, "pack", never)
    noise = np.random.default_rng(0).normal(scale=0.05, size=grid().shape[:3])
    flat = atlas.unwrap(mesh.simplify(marched(to_torus(grid()) + noise), 3000), 256)
    assert len(chart_sizes(len(flat.vertices), flat.faces)) > atlas.MAX_CHARTS
    assert flat.uv.min() >= 0
    assert flat.uv.max() <= 1


def test_pieces_without_number_are_an_error_with_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlas, "_place", lambda charts, n: [])
    with pytest.raises(ValueError, match="has 1 pieces, too many for a texture; use --preset splat"):
        atlas.pack(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]]), 256)


def test_a_large_mesh_is_cut_in_parts_without_an_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its triangles keep their order and corners, and each texel belongs to one of them."""
    monkeypatch.setattr(atlas, "MAX_PART", 700)
    shape = mesh.simplify(mesh.smooth(marched(to_torus(grid()))), 2000)
    for unwrap in (atlas.unwrap, atlas.unwrap_loosely):
        flat = unwrap(shape, 256)
        assert np.allclose(flat.vertices[flat.faces], shape.vertices[shape.faces])
        corners = flat.uv[flat.faces] * 256
        (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
        drawn = np.zeros((256, 256), np.uint8)
        cv2.fillPoly(drawn, list(np.rint(corners).astype(np.int32)), 1)
        # Overlapping charts would cover less than the sum of their areas; drawing adds half a texel at borders.
        assert np.abs(a * d - b * c).sum() / 2 < drawn.sum()
