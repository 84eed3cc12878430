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


def test_a_capture_is_not_resumed_if_one_of_two_lights_of_the_same_name_has_changed(box: Path, tmp_path: Path) -> None:
    env, relight = tmp_path / "a" / "room.hdr", tmp_path / "b" / "room.hdr"
    for i, path in enumerate((env, relight)):
        path.parent.mkdir()
        path.write_bytes(bytes([i]))
    options = SynthOptions(env=str(env), relight=(str(relight),), **TINY)
    before = synthesize._manifest(box, options)
    assert list(before["sources"]) == ["box.glb", "room.hdr", "relight/room.hdr"]
    env.write_bytes(b"2")
    after = synthesize._manifest(box, options)
    assert after != before
    env.write_bytes(relight.read_bytes())
    assert list(synthesize._manifest(box, options)["sources"]) == ["box.glb", "room.hdr"]
