"""Sparse COLMAP models, binary and text, are read as written by the tests; damaged ones are refused."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tumble.io import limits
from tumble.io.files import BadFile
from tumble.preprocess import colmap

CAMERAS: dict[int, tuple[int, str, int, int, list[float]]] = {
    7: (4, "OPENCV", 128, 96, [150.0, 155.0, 60.5, 50.25, 0.08, -0.03, 0.002, -0.001]),
    2: (2, "SIMPLE_RADIAL", 160, 120, [140.0, 80.0, 60.0, 0.05]),
}
"""By number: model number, model name, width, height, parameters."""
IMAGES: dict[str, tuple[int, list[float], int, int]] = {
    "b/zwei drei.jpg": (11, [*Rotation.from_rotvec([0.3, -1.2, 0.5]).as_quat(scalar_first=True), 0.1, -0.2, 3.0], 7, 3),
    "a.png": (4, [*Rotation.from_rotvec([0.0, 0.4, 2.0]).as_quat(scalar_first=True), -0.3, 0.0, 2.5], 2, 0),
}
"""By name: number, pose (quaternion wxyz and translation, world to camera), camera, number of keypoints."""
POINTS = [(3, (0.1, -0.5, 2.0), (255, 0, 9), 0.75, 2), (9, (1.0, 0.25, -1.0), (1, 2, 3), 1.25, 0)]
"""Number, position, colour, error, length of the track."""


def write_binary(folder: Path, cameras=CAMERAS, images=IMAGES, points=POINTS) -> Path:
    """Write the binary files by COLMAP's documentation of the format."""
    folder.mkdir(parents=True, exist_ok=True)
    content = struct.pack("<Q", len(cameras))
    for number, (kind, _, width, height, parameters) in cameras.items():
        content += struct.pack(f"<IiQQ{len(parameters)}d", number, kind, width, height, *parameters)
    (folder / "cameras.bin").write_bytes(content)
    content = struct.pack("<Q", len(images))
    for name, (number, pose, camera, keypoints) in images.items():
        content += struct.pack("<I7dI", number, *pose, camera) + name.encode() + b"\0"
        content += struct.pack("<Q", keypoints) + struct.pack("<ddq", 1.5, 2.5, -1) * keypoints
    (folder / "images.bin").write_bytes(content)
    content = struct.pack("<Q", len(points))
    for number, position, colour, error, track_length in points:
        content += (
            struct.pack("<Q3d3BdQ", number, *position, *colour, error, track_length)
            + struct.pack("<II", 4, 0) * track_length
        )
    (folder / "points3D.bin").write_bytes(content)
    return folder


def write_text(folder: Path, cameras=CAMERAS, images=IMAGES, points=POINTS) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list with one line of data per camera:"]
    lines += [f"{n} {name} {w} {h} {' '.join(map(repr, p))}" for n, (_, name, w, h, p) in cameras.items()]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:", "#   IMAGE_ID, QW, ..."]
    for name, (number, pose, camera, keypoints) in images.items():
        lines += [f"{number} {' '.join(repr(float(x)) for x in pose)} {camera} {name}", "1.5 2.5 -1 " * keypoints]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list"]
    for number, position, colour, error, track_length in points:
        lines.append(
            f"{number} {' '.join(repr(float(x)) for x in position)} {' '.join(map(str, colour))} {error} "
            + "4 0 " * track_length
        )
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("subfolder", ["sparse/0", "sparse", "colmap/sparse/0", "."])
@pytest.mark.parametrize("write", [write_binary, write_text])
def test_a_model_is_read_as_written(write: Callable[..., Path], subfolder: str, tmp_path: Path) -> None:
    write(tmp_path / subfolder)
    assert colmap.recognises(tmp_path)
    model = colmap.read(tmp_path)
    assert [view.name for view in model.views] == ["a.png", "b/zwei drei.jpg"]
    for view in model.views:
        _, pose, camera, _ = IMAGES[view.name]
        expected = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
        np.testing.assert_allclose(view.R_cam_world, expected, atol=1e-12)
        assert view.t_cam_world.tolist() == pose[4:]
        assert (view.optics.width, view.optics.height) == CAMERAS[camera][2:4]
    small, large = (view.optics for view in model.views)
    assert small.K.tolist() == [[140, 0, 79.5], [0, 140, 59.5], [0, 0, 1]]
    assert large.K.tolist() == [[150, 0, 60], [0, 155, 49.75], [0, 0, 1]]
    assert large.distortion.tolist() == [0.08, -0.03, 0.002, -0.001, 0, 0, 0, 0]
    assert model.points.tolist() == [[0.1, -0.5, 2.0], [1.0, 0.25, -1.0]]
    assert model.errors.tolist() == [0.75, 1.25]


def test_the_largest_of_several_models_is_read_and_points_are_optional(tmp_path: Path) -> None:
    one = {"a.png": IMAGES["a.png"]}
    (write_binary(tmp_path / "sparse" / "0", images=one) / "points3D.bin").unlink()
    (write_text(tmp_path / "sparse" / "1") / "points3D.txt").unlink()
    model = colmap.read(tmp_path)
    assert model.path.name == "1"
    assert model.points.shape == (0, 3)
    assert not colmap.recognises(tmp_path / "nowhere")


# Lenses ---------------------------------------------------------------------------------------------------------------

PARAMETERS: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [90.0, 60.0, 45.0],
    "PINHOLE": [90.0, 95.0, 60.0, 45.0],
    "SIMPLE_RADIAL": [90.0, 60.0, 45.0, 0.06],
    "RADIAL": [90.0, 60.0, 45.0, 0.06, -0.02],
    "OPENCV": [90.0, 95.0, 60.0, 45.0, 0.06, -0.02, 0.004, -0.003],
    "FULL_OPENCV": [90.0, 95.0, 60.0, 45.0, 0.06, -0.02, 0.004, -0.003, 0.01, 0.02, -0.01, 0.005],
    "OPENCV_FISHEYE": [90.0, 95.0, 60.0, 45.0, 0.05, -0.01, 0.004, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [90.0, 60.0, 45.0, 0.05],
    "RADIAL_FISHEYE": [90.0, 60.0, 45.0, 0.05, -0.01],
}


def imaged(model: str, p: list[float], xy: np.ndarray) -> np.ndarray:
    """Pixel positions of points on the plane at depth 1, by COLMAP's documentation of its camera models."""
    two_focals = model in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
    (fx, fy, cx, cy), k = (p[:4], p[4:]) if two_focals else ([p[0], p[0], p[1], p[2]], p[3:])
    x, y = xy.T
    if "FISHEYE" in model:
        radius = np.hypot(x, y)
        theta = np.arctan(radius)
        k = [*k, 0, 0, 0, 0][:4]
        bent = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
        u, v = x * bent / radius, y * bent / radius
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = [*k, *[0] * 8][:8]
        r2 = x * x + y * y
        scale = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        u = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return np.stack([fx * u + cx, fy * v + cy], -1)


@pytest.mark.parametrize("model", PARAMETERS)
def test_undistortion_inverts_the_documented_formulas(model: str, tmp_path: Path) -> None:
    number = next(n for n, (name, _) in colmap.CAMERA_MODELS.items() if name == model)
    cameras: Any = {2: (number, model, 120, 90, PARAMETERS[model])}
    for write in (write_binary, write_text):
        write(tmp_path / write.__name__, cameras=cameras, images={"a.png": IMAGES["a.png"]})
        optics = colmap.read(tmp_path / write.__name__).views[0].optics
        xy = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
        # COLMAP measures pixel positions from the corner of the first pixel, OpenCV from its centre.
        undistorted = optics.normalised(imaged(model, PARAMETERS[model], xy) - 0.5)
        # OpenCV inverts the distortion by a few iterations; 1e-3 is a tenth of a pixel.
        np.testing.assert_allclose(undistorted, xy, atol=1e-3)


# Damage ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_truncated_binary_file_is_refused(name: str, tmp_path: Path) -> None:
    file = write_binary(tmp_path / "sparse" / "0") / name
    content = file.read_bytes()
    for end in range(0, len(content), 3):
        file.write_bytes(content[:end])
        with pytest.raises(BadFile, match=rf"{name}: is damaged"):
            colmap.read(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_counts_that_exceed_the_file_are_refused(name: str, tmp_path: Path) -> None:
    file = write_binary(tmp_path / "sparse" / "0") / name
    file.write_bytes(b"\xff" * 8 + file.read_bytes()[8:])
    with pytest.raises(BadFile, match=rf"{name}: is damaged: it has|{name}: has the unknown camera model"):
        colmap.read(tmp_path)
    keypoints = write_binary(tmp_path / "sparse" / "0") / "images.bin"
    keypoints.write_bytes(keypoints.read_bytes()[:-8] + b"\xff" * 7 + b"\x7f")
    with pytest.raises(BadFile, match=r"images\.bin: is damaged"):
        colmap.read(tmp_path)


def camera(number: int, **change: Any) -> dict[int, tuple]:
    kind, name, width, height, parameters = CAMERAS[number]
    values = {"kind": kind, "name": name, "width": width, "height": height, "parameters": parameters} | change
    return {**CAMERAS, number: tuple(values.values())}


def image(pose: list[float], number: int = 2) -> dict[str, tuple]:
    return {**IMAGES, "a.png": (4, pose, number, 0)}


BROKEN: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown lens": (
        {"cameras": camera(2, kind=7, name="FOV")},
        r"cameras\.\w+: has the unknown camera model .*known models: SIMPLE_P",
    ),
    "no focal length": ({"cameras": camera(2, parameters=[0.0, 80.0, 60.0, 0.0])}, "with the parameters"),
    "a camera that is too large": ({"cameras": camera(2, width=1 << 40)}, r"1099511627776 x 120 pixels"),
    "a missing camera": ({"images": image(IMAGES["a.png"][1], number=5)}, r"a\.png refers to camera 5"),
    "no rotation": ({"images": image([0.5, 0, 0, 0, 0, 0, 1])}, r"a\.png has no valid rotation"),
    "not a number": (
        {"images": image([1, 0, 0, 0, 0, float("nan"), 1])},
        r"a\.png has the translation|where numbers are expected",
    ),
    "no images": ({"images": {}}, "lists no image"),
}


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize("name", BROKEN)
def test_models_that_break_a_rule_are_refused(name: str, write: Callable[..., Path], tmp_path: Path) -> None:
    change, message = BROKEN[name]
    write(tmp_path / "sparse" / "0", **change)
    with pytest.raises(BadFile, match=message):
        colmap.read(tmp_path)


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("cameras.txt", "1 PINHOLE 64 64 50 50 32", "PINHOLE camera with 3 parameters instead of 4"),
        ("cameras.txt", "one PINHOLE 64 64 50 50 32 32", "where numbers are expected"),
        ("images.txt", "5 1 0 0 0 0 0", "where an image is expected"),
        ("points3D.txt", "1 2 3", "where a point is expected"),
    ],
)
def test_a_text_file_with_a_broken_line_is_refused(name: str, line: str, message: str, tmp_path: Path) -> None:
    file = write_text(tmp_path / "sparse" / "0") / name
    file.write_text(file.read_text() + line + "\n")
    with pytest.raises(BadFile, match=rf"{name}: has .*{message}"):
        colmap.read(tmp_path)


def test_a_file_over_the_size_limit_is_refused(tmp_path: Path) -> None:
    file = write_binary(tmp_path / "sparse" / "0") / "points3D.bin"
    with file.open("r+b") as handle:
        handle.truncate(limits.MAX_MODEL_BYTES + 1)
    with pytest.raises(BadFile, match=r"points3D\.bin: has 1073741825 bytes, over the limit"):
        colmap.read(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("write", [write_text, write_binary])
def test_a_model_of_too_many_entries_is_refused(
    name: str, write: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gigabyte of shortest entries took ten."""
    write(tmp_path / "sparse" / "0")
    monkeypatch.setattr(colmap, "MAX_POINTS" if name == "points3D" else "MAX_IMAGES", 0)
    file = "cameras" if name == "images" else name  # cameras are read first
    with pytest.raises(BadFile, match=rf"{file}\..*: lists more than 0 entries \(make a model of fewer images\)"):
        colmap.read(tmp_path)


def test_text_is_read_line_by_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = write_text(tmp_path / "sparse" / "0") / "images.txt"
    whole = images.read_text()
    images.write_text(whole + "\n" * 9)
    assert len(colmap.read(tmp_path).views) > 1
    images.write_text(whole + "\n\n" + whole)
    with pytest.raises(BadFile, match=r"images\.txt: has an empty line where an image is expected"):
        colmap.read(tmp_path)
    images.write_text(whole + "\n" * 20)
    monkeypatch.setattr(colmap, "MAX_IMAGES", 5)
    with pytest.raises(BadFile, match=r"images\.txt: has an empty line where an image is expected"):
        colmap.read(tmp_path)
    monkeypatch.setattr(colmap, "MAX_LINE_BYTES", 5)
    with pytest.raises(BadFile, match=r"cameras\.txt: has a line of more than 5 bytes"):
        colmap.read(tmp_path)
