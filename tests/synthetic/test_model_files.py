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


def test_a_required_extension_that_is_not_read_is_refused(tmp_path: Path) -> None:
    for name in ("KHR_texture_transform", "KHR_mesh_quantization"):
        required = ["KHR_materials_ior", name]
        (tmp_path / "x.glb").write_bytes(models.changed(lambda d, names=required: d.update(extensionsRequired=names)))
        with pytest.raises(BadFile, match=rf"x\.glb: requires the extension {name}.*EXT_texture_webp"):
            require_glb(tmp_path / "x.glb")
    allowed = ["KHR_materials_ior", "EXT_texture_webp"]
    (tmp_path / "x.glb").write_bytes(models.changed(lambda d: d.update(extensionsRequired=allowed)))
    require_glb(tmp_path / "x.glb")
