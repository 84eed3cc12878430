"""Model files whose nodes and extensions are unusual."""

from pathlib import Path

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh", reason="needs the extra `synth`")

from tests.hostile import models  # noqa: E402
from tumble.io.files import BadFile  # noqa: E402
from tumble.synthetic import pathtracer  # noqa: E402
from tumble.synthetic.glb import require_glb  # noqa: E402


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (-1.0, 0.6, 0.3), (-1.0, -0.6, -0.3)])
def test_faces_of_a_mirrored_node_face_outwards(tmp_path: Path, scale: tuple[float, float, float]) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(subdivisions=2), transform=np.diag([*scale, 1.0]))
    (tmp_path / "x.glb").write_bytes(scene.export(file_type="glb"))
    (part,) = pathtracer.read_model(tmp_path / "x.glb").parts
    corners = part.vertices[part.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * corners.mean(1)).sum(-1) > 0).all()
    assert ((part.normals * part.vertices).sum(-1) > 0).all()


def test_a_mesh_without_normals_has_flat_faces_and_one_with_normals_keeps_them(tmp_path: Path) -> None:
    """All corners of a side of a box agree in one coordinate, and the normal is along that; `uv` is the position."""
    box = trimesh.creation.box((2, 2, 2))
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2])
    for given in (False, True):
        (tmp_path / "x.glb").write_bytes(box.export(file_type="glb", include_normals=given))
        (part,) = pathtracer.read_parts(tmp_path / "x.glb")
        corners, normals = part.vertices[part.faces], part.normals[part.faces]
        np.testing.assert_allclose(part.uv, part.vertices[:, :2] * [1, -1] + [0, 1], atol=1e-6)
        assert len(part.faces) == 12
        if given:
            assert len(part.vertices) == 8
            np.testing.assert_allclose(part.normals, box.vertex_normals, atol=1e-6)
        else:
            same = (corners == corners[:, :1]).all(1)
            np.testing.assert_allclose(normals, np.where(same[:, None], corners, 0), atol=1e-12)


def test_a_mesh_without_normals_counts_with_the_vertices_of_its_flat_faces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """3840 corners of faces are 0.6 MB as vertices of their own, and 0.1 MB as indices of 642 vertices."""
    monkeypatch.setattr("tumble.io.limits.MAX_DECODED_BYTES", 500_000)
    sphere, path = trimesh.creation.icosphere(subdivisions=3), tmp_path / "x.glb"
    path.write_bytes(sphere.export(file_type="glb", include_normals=True))
    require_glb(path)
    path.write_bytes(sphere.export(file_type="glb", include_normals=False))
    with pytest.raises(BadFile, match="vertices and textures"):
        require_glb(path)


def test_a_required_extension_that_is_not_read_is_refused(tmp_path: Path) -> None:
    for name in ("KHR_texture_transform", "KHR_mesh_quantization"):
        required = ["KHR_materials_ior", name]
        (tmp_path / "x.glb").write_bytes(models.changed(lambda d, names=required: d.update(extensionsRequired=names)))
        with pytest.raises(BadFile, match=rf"x\.glb: requires the extension {name}.*EXT_texture_webp"):
            require_glb(tmp_path / "x.glb")
    allowed = ["KHR_materials_ior", "EXT_texture_webp"]
    (tmp_path / "x.glb").write_bytes(models.changed(lambda d: d.update(extensionsRequired=allowed)))
    require_glb(tmp_path / "x.glb")
