"""Unusual options of synthetic captures: large seeds, lights and names that clash, and what is refused."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="needs the extra `synth`")
trimesh = pytest.importorskip("trimesh", reason="needs the extra `synth`")

from tumble.io import files  # noqa: E402
from tumble.io.files import BadFile  # noqa: E402
from tumble.synthetic import backgrounds, film, synthesize, trajectories  # noqa: E402
from tumble.synthetic.options import MAX_FOV, SynthOptions  # noqa: E402

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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"material": "diffuse", "roughness": 0.3}, "a diffuse material has no roughness"),
        ({"background": "torso", "fov": 60.0}, "at most 55 degrees"),
        ({"background": "desk", "fov": 80.0}, "at most 52 degrees"),
        ({"exposure": math.inf}, "exposure is out of range"),
        ({"exposure": math.nan}, "exposure is out of range"),
        ({"env_rotation": math.nan}, "env_rotation is out of range"),
        ({"relight": ("a\\b.hdr",)}, "which no folder can have"),
        ({"relight": ("maps/...hdr",)}, "which no folder can have"),
    ],
)
def test_options_without_meaning_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SynthOptions(env="white", **change)


def test_an_unknown_skin_is_refused() -> None:
    options = SynthOptions(env="white")
    object.__setattr__(options, "skin", "pale")  # because tests check the types of arguments
    with pytest.raises(ValueError, match="skin is out of range: pale"):
        options.__post_init__()


@pytest.mark.parametrize("values", [(0.5, 0.0), (0.201, 0.204)])
def test_a_roughness_sweep_is_checked_before_anything_is_rendered(
    box: Path, tmp_path: Path, values: tuple[float, ...]
) -> None:
    with pytest.raises(ValueError, match="roughness"):
        synthesize.render_captures(box, tmp_path / "out", SynthOptions(env="white", **TINY), values)
    assert not (tmp_path / "out").exists()


def test_the_folders_of_a_roughness_sweep_are_checked_before_anything_is_rendered(box: Path, tmp_path: Path) -> None:
    files.write_json(tmp_path / "r0.40" / "diary.json", {})
    with pytest.raises(BadFile, match=r"r0\.40: holds other files"):
        synthesize.render_captures(box, tmp_path, SynthOptions(env="white", **TINY), (0.3, 0.4))
    assert [path.name for path in tmp_path.iterdir()] == ["r0.40"]


def test_a_black_light_is_refused(box: Path, tmp_path: Path) -> None:
    files.write_hdr(tmp_path / "night.hdr", np.zeros((8, 16, 3), np.float32))
    for lights in ({"env": str(tmp_path / "night.hdr")}, {"env": "white", "relight": (str(tmp_path / "night.hdr"),)}):
        with pytest.raises(BadFile, match=r"night\.hdr: is black"):
            synthesize.render_capture(box, tmp_path / "out", SynthOptions(**lights, **TINY))
        assert not (tmp_path / "out").exists()


def test_files_that_a_killed_call_left_are_removed(box: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """But not those of a process that is still running, such as the first one of all."""
    options = SynthOptions(env="white", **TINY)
    files.write_json(tmp_path / synthesize.SETTINGS_FILE, synthesize._manifest(box, options))
    dead, alive = tmp_path / "truth" / f".partial-{2**22 + 1}-x.hdr", tmp_path / ".partial-1-x.json"
    for path in (dead, alive):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"half")
    monkeypatch.setattr(synthesize, "_expose_lights", lambda *_: {})
    monkeypatch.setattr(synthesize, "_render_frame", lambda *_: None)
    synthesize.render_capture(box, tmp_path, options)
    assert (dead.exists(), alive.exists()) == (False, True)


@pytest.mark.parametrize("kind", ["wall", "torso", "desk", "clutter"])
def test_a_background_fills_the_film_of_every_field_of_view_that_is_allowed(kind: str) -> None:
    for fov in (1.0, 30.0, MAX_FOV[kind]):
        tangent = math.tan(math.radians(fov) / 2)
        parts = backgrounds.background_parts(kind, trajectories.distance_for(math.radians(fov)), 0)
        corners = parts["desk" if "desk" in parts else "wall"].vertices
        sides = corners[1:] - corners[0]
        lengths = np.linalg.norm(sides, axis=1)
        across, down = sides[lengths < 1.1 * lengths.min()]
        for x, y in itertools.product((-1, 1), repeat=2):
            ray = np.array([x * film.WIDER[0] * tangent, y * film.WIDER[1] * tangent, 1.0])
            a, b, depth = np.linalg.solve(np.stack([across, down, -ray], 1), -corners[0])
            assert depth > 0
            assert min(a, b) >= 0
            assert max(a, b) <= 1
