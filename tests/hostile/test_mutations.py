"""Mutations of valid files: every reader returns or refuses them in one line, whatever bytes are changed."""

import io
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.hostile import documents, films, light_maps, models, runs
from tests.hostile.cases import Case, capture, pictures, put
from tests.hostile.test_hostile import assert_refused, server  # noqa: F401 (a fixture)

N_EXAMPLES = 60
"""Number of mutations of each file."""


def saved(kind: str) -> bytes:
    """A picture in another format."""
    stream = io.BytesIO()
    Image.open(io.BytesIO(pictures()["images/0000.png"])).save(stream, kind)
    return stream.getvalue()


def checkpoint() -> bytes:
    """A checkpoint of a stage."""
    about = json.dumps({"key": "k", "step": 3, "seconds": 1.0})
    return safetensors.torch.save(
        {"params/x": torch.zeros(3), "rng": torch.zeros(4, dtype=torch.uint8)}, {"state": about}
    )


def scene() -> dict[str, bytes]:
    """A valid scene of BOP."""
    with TemporaryDirectory() as folder:
        documents.bop_edited(Path(folder), "in/scene_gt.json", ("0", 0, "obj_id"), 1)
        return {str(p.relative_to(folder)): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


PROVENANCE = {"footage": "ab", "options": {"at": 0}, "frames": [{"name": "0000.png", "source_frame": 3}]}
LOG = (
    b'{"name": "refine", "step": 3, "of": 9, "eta": 1.0, "metrics": {"render": 0.5}}\n{"event": "done", "name": "a"}\n'
)
TARGETS: dict[str, tuple[str, str, str, Callable[[], dict[str, bytes]]]] = {
    "transforms.json": ("capture", "in", "in/transforms.json", capture),
    "frame": ("capture", "in", "in/images/0002.png", capture),
    "mask": ("capture", "in", "in/masks/0002.png", capture),
    "truth": ("truth", "in", "in/transforms.json", capture),
    "scene_gt.json": ("bop", "in", "in/scene_gt.json", scene),
    "scene_camera.json": ("bop", "in", "in/scene_camera.json", scene),
    "PNG": ("picture", "x", "x", lambda: {"x": saved("PNG")}),
    "JPEG": ("picture", "x", "x", lambda: {"x": saved("JPEG")}),
    "TIFF": ("picture", "x", "x", lambda: {"x": saved("TIFF")}),
    "WebP": ("picture", "x", "x", lambda: {"x": saved("WEBP")}),
    "film": ("film", "x.mp4", "x.mp4", lambda: {"x.mp4": films.film()}),
    "EXR": ("light map", "x.exr", "x.exr", lambda: {"x.exr": light_maps.exr()}),
    "tiled EXR": ("light map", "x.exr", "x.exr", lambda: {"x.exr": light_maps.tiled(16)}),
    "HDR": ("light map", "x.hdr", "x.hdr", lambda: {"x.hdr": light_maps.hdr()}),
    "GLB": ("model", "x.glb", "x.glb", lambda: {"x.glb": models.box()}),
    "cameras.txt": ("colmap", "in", "in/sparse/0/cameras.txt", models.colmap),
    "images.txt": ("colmap", "in", "in/sparse/0/images.txt", models.colmap),
    "asset": ("asset", "run/asset.safetensors", "run/asset.safetensors", runs.finished),
    "checkpoint": ("checkpoint", "x", "x", lambda: {"x": checkpoint()}),
    "recipe.json": ("recipe", "run", "run/recipe.json", runs.finished),
    "poses.json": ("poses", "run", "run/poses.json", runs.finished),
    "log.jsonl": ("log", "run", "run/log.jsonl", lambda: {"run/log.jsonl": LOG}),
    "ingest.json": ("provenance", "in", "in/ingest.json", lambda: {"in/ingest.json": json.dumps(PROVENANCE).encode()}),
}
"""Per file: the reader, the path that it is given, the mutated file, and all files."""
EDITS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "set", "cut", "insert", "repeat", "digit"]), st.floats(0, 1), st.integers(0, 255)
    ),
    min_size=1,
    max_size=6,
)


def mutated(content: bytes, edits: list[tuple[str, float, int]]) -> bytes:
    """A file after some edits, each at a fraction of its length."""
    data = bytearray(content)
    for kind, fraction, value in edits:
        place = min(int(fraction * len(data)), len(data) - 1)
        if not data:
            break
        if kind == "flip":
            data[place] ^= 1 << value % 8
        elif kind == "set":
            data[place] = value
        elif kind == "cut":
            del data[place : place + value]
        elif kind == "insert":
            data[place:place] = bytes([value]) * (value % 9)
        elif kind == "repeat":
            data[place:place] = data[max(place - value, 0) : place]
        else:  # numbers of documents grow
            digits = [i for i, byte in enumerate(data) if 48 <= byte < 58]
            if digits:
                at = digits[int(fraction * (len(digits) - 1))]
                data[at:at] = b"9" * (value + 1)
    return bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_mutated_file_is_read_or_refused(name: str, server: subprocess.Popen[str], tmp_path: Path) -> None:  # noqa: F811
    reader, path, file, make = TARGETS[name]
    files = make()
    number = 0

    @settings(
        max_examples=N_EXAMPLES,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(EDITS)
    def check(edits: list[tuple[str, float, int]]) -> None:
        nonlocal number
        number += 1
        folder = tmp_path / str(number)
        folder.mkdir()
        contents = {**files, file: mutated(files[file], edits)}
        assert_refused(
            server, Case(name, lambda into: put(into, contents), ["read", reader, path], ".", also=(0,)), folder
        )

    check()


def test_mutations_change_files() -> None:
    content = bytes(range(100))
    assert np.mean([mutated(content, [("flip", i / 9, i)]) != content for i in range(9)]) == 1
