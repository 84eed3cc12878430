"""Unusual options of synthetic captures: large seeds, lights and names that clash, and what is refused."""

from pathlib import Path

import pytest

mi = pytest.importorskip("mitsuba", reason="needs the extra `synth`")
trimesh = pytest.importorskip("trimesh", reason="needs the extra `synth`")

from tumble.synthetic import synthesize  # noqa: E402
from tumble.synthetic.options import SynthOptions  # noqa: E402

# Dr.Jit emits deprecation warnings about its own code when it is imported.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

TINY = {"views": 2, "resolution": 16, "samples": 4, "truth_samples": 4, "eval_shared": 0, "eval_sphere": 0}


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("box") / "box.glb"
    trimesh.creation.box().export(path)
    return path


def test_a_capture_is_rendered_with_the_largest_seed(box: Path, tmp_path: Path) -> None:
    out = synthesize.render_capture(box, tmp_path / "out", SynthOptions(env="white", film=True, seed=2**32 - 1, **TINY))
    assert (out / "transforms.json").is_file()
