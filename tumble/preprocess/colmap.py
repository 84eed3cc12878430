"""Sparse models of COLMAP, binary and text: cameras, posed pictures, points (colmap.github.io/format.html).

    FOLDER/sparse/0/cameras.bin  images.bin  points3D.bin       or .txt, and points3D may be missing
    FOLDER/sparse/, FOLDER/colmap/sparse/0/ and FOLDER/ itself  are looked at, too

Of several numbered models the one with most pictures is taken. Poses are world to camera, with OpenCV axes; the files'
principal points put the centre of the first pixel at (0.5, 0.5), OpenCV's functions at (0, 0). Files of more than
`MAX_BYTES` are refused, and so is every count that its file cannot hold.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float64

from tumble.io import BadFile
from tumble.maths import SO3

MAX_BYTES = 1 << 30
"""Largest file of a model that is read; a thousand pictures make a tenth of it."""
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
}
"""Camera models by their number in binary files: name and count of parameters."""
PARAMETERS = dict(MODELS.values())
UNIT = 1e-3
"""Largest deviation of a quaternion's length from 1."""


@dataclass(frozen=True)
class Optics:
    """One camera: a matrix and how its lens bends lines, as OpenCV wants both."""

    K: Float64[np.ndarray, "3 3"]
    """With the centre of the first pixel at (0, 0) [pixels]."""
    distortion: Float64[np.ndarray, " n"]
    fisheye: bool
    """Whether the coefficients are those of OpenCV's fisheye model."""
    height: int
    """[pixels]"""
    width: int
    """[pixels]"""

    def normalised(self, uv: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Where pixels lie on the plane at depth 1 before the camera."""
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        return undistort(uv[:, None].astype(np.float64), self.K, self.distortion)[:, 0]


@dataclass(frozen=True)
class PosedPicture:
    """One picture with its pose."""

    name: str
    """Path of the picture in the folder of pictures."""
    optics: Optics
    R_cam_world: Float64[np.ndarray, "3 3"]
    t_cam_world: Float64[np.ndarray, "3"]
    """[the model's unit]"""


@dataclass(frozen=True)
class SparseModel:
    """A sparse reconstruction."""

    path: Path
    views: tuple[PosedPicture, ...]
    """In the order of their names."""
    points: Float64[np.ndarray, "n 3"]
    """World frame; none where the model has no file of points."""
    errors: Float64[np.ndarray, " n"]
    """Mean reprojection error of every point [pixels]."""


def recognises(path: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return path.is_dir() and bool(_places(path))


def read(path: Path) -> SparseModel:
    """The sparse model in a folder of COLMAP.

    Raises:
        BadFile: There is none, a file is damaged, or a camera model is not known.
    """
    places = _places(path)
    if not places:
        raise BadFile(path, "holds no sparse model of COLMAP", "sparse/0/ with cameras, images as .bin or .txt")
    models = [_read(place) for place in places]
    return max(models, key=lambda model: len(model.views))


def _places(path: Path) -> list[Path]:
    sparse = [path / "sparse", path / "colmap" / "sparse"]
    numbered = [sorted(p for p in folder.glob("*") if p.name.isdecimal()) for folder in sparse]
    for group in (numbered[0], [sparse[0]], numbered[1], [path]):
        if found := [place for place in group if _file(place, "cameras") and _file(place, "images")]:
            return found
    return []


def _file(place: Path, name: str) -> Path | None:
    return next((p for ending in (".bin", ".txt") if (p := place / f"{name}{ending}").is_file()), None)


def _read(place: Path) -> SparseModel:
    cameras, images, points = (_file(place, name) for name in ("cameras", "images", "points3D"))
    assert cameras is not None, "a place has both"
    assert images is not None, "a place has both"
    optics = dict(_cameras(cameras))
    views = sorted(_views(images, optics), key=lambda view: view.name)
    if not views:
        raise BadFile(images, "holds no picture")
    if len({view.name for view in views}) < len(views):
        raise BadFile(images, "has two pictures of one name")
    rows = np.array(list(_points(points)) if points is not None else [], np.float64).reshape(-1, 4)
    if points is not None and not np.isfinite(rows).all():
        raise BadFile(points, "holds NaN or infinity")
    return SparseModel(place, tuple(views), rows[:, :3], rows[:, 3])


# Both layouts give these three ----------------------------------------------------------------------------------------


def _cameras(path: Path) -> Iterator[tuple[int, Optics]]:
    for number, model, width, height, parameters in _binary_cameras(path) if _binary(path) else _text_cameras(path):
        yield number, _optics(path, model, width, height, np.array(parameters))


def _views(path: Path, optics: dict[int, Optics]) -> Iterator[PosedPicture]:
    for name, pose, camera in _binary_images(path) if _binary(path) else _text_images(path):
        values = np.array(pose)
        if camera not in optics:
            raise BadFile(path, f"{name} was taken by camera {camera}, there is none of that number")
        length = math.sqrt(float((values[:4] ** 2).sum()))
        if not np.isfinite(values).all() or abs(length - 1) > UNIT:
            raise BadFile(path, f"{name} has no rotation: its quaternion has length {length:.4g}")
        yield PosedPicture(
            name, optics[camera], SO3(torch.from_numpy(values[:4] / length)).matrix().numpy(), values[4:]
        )


def _points(path: Path) -> Iterator[tuple[float, ...]]:
    return _binary_points(path) if _binary(path) else _text_points(path)


def _optics(path: Path, model: str, width: int, height: int, values: Float64[np.ndarray, " n"]) -> Optics:
    """The parameters by OpenCV's names: k1 k2 p1 p2 k3 k4 k5 k6, or k1 to k4 of a fisheye lens."""
    two_focals = model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
    fx, fy, cx, cy = values[:4] if two_focals else (values[0], values[0], values[1], values[2])
    if not np.isfinite(values).all() or min(fx, fy) <= 0 or not (0 < width < 1 << 16 and 0 < height < 1 << 16):
        raise BadFile(path, f"has a camera of {width} x {height} pixels with the parameters {values.tolist()}")
    coefficients = np.zeros(4 if "FISHEYE" in model else 8)
    rest = values[4 if two_focals else 3 :]
    coefficients[: len(rest)] = rest
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    return Optics(K, coefficients, "FISHEYE" in model, height, width)


# Binary ---------------------------------------------------------------------------------------------------------------


def _binary(path: Path) -> bool:
    return path.suffix == ".bin"


class _Bytes:
    """A file's bytes and how far they are read; a class, because every read moves on."""

    def __init__(self, path: Path) -> None:
        self.path, self.at, self.data = path, 0, _content(path)

    def take(self, layout: str) -> tuple:
        """The next numbers, little-endian, by struct's letters."""
        size = struct.calcsize(f"<{layout}")
        self.skip(size)
        return struct.unpack_from(f"<{layout}", self.data, self.at - size)

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise BadFile(self.path, f"is damaged: it ends at byte {len(self.data)}, {self.at} are needed")

    def word(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise BadFile(self.path, "is damaged: a name does not end")
        text, self.at = self.data[self.at : end], end + 1
        return text.decode("utf-8", errors="replace")


def _content(path: Path) -> bytes:
    if path.stat().st_size > MAX_BYTES:
        raise BadFile(path, f"has {path.stat().st_size} bytes, over the limit of {MAX_BYTES}")
    return path.read_bytes()


def _binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        number, kind, width, height = data.take("IiQQ")
        if kind not in MODELS:
            raise BadFile(path, f"has the camera model {kind}", _known())
        model, count = MODELS[kind]
        yield number, model, width, height, data.take(f"{count}d")


def _binary_images(path: Path) -> Iterator[tuple[str, tuple[float, ...], int]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        _, *pose, camera = data.take("I7dI")
        name = data.word()
        data.skip(24 * data.take("Q")[0])  # keypoints: two coordinates and the number of a point
        yield name, tuple(pose), camera


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        _, x, y, z, _, _, _, error, seen = data.take("Q3d3BdQ")
        data.skip(8 * seen)
        yield x, y, z, error


# Text -----------------------------------------------------------------------------------------------------------------


def _lines(path: Path) -> list[str]:
    """Without comments; empty ones stay, for a picture without keypoints has one."""
    lines = _content(path).decode("utf-8", errors="replace").splitlines()
    return [line for line in lines if not line.startswith("#")]


def _numbers(path: Path, words: list[str]) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise BadFile(path, f"has {' '.join(words)[:60]!r} in the place of numbers")
    return values


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        model = words[1] if len(words) > 1 else ""
        if model not in PARAMETERS:
            raise BadFile(path, f"has the camera model {model!r}", _known())
        if len(words) != 4 + PARAMETERS[model]:
            raise BadFile(path, f"has a {model} with {len(words) - 4} parameters, it has {PARAMETERS[model]}")
        number, width, height, *parameters = _numbers(path, [words[0], *words[2:]])
        yield int(number), model, int(width), int(height), tuple(parameters)


def _text_images(path: Path) -> Iterator[tuple[str, tuple[float, ...], int]]:
    lines = _lines(path)
    while lines and not lines[-1].strip():
        lines.pop()
    for line in lines[::2]:
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise BadFile(path, f"has {line[:60]!r} in the place of a picture", "two lines per picture")
        _, *pose, camera = _numbers(path, words[:9])
        yield words[9].strip(), tuple(pose), int(camera)


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line in _lines(path):
        words = line.split(maxsplit=8)
        if not words:
            continue
        if len(words) < 8:
            raise BadFile(path, f"has {line[:60]!r} in the place of a point")
        _, x, y, z, _, _, _, error = _numbers(path, words[:8])
        yield x, y, z, error


def _known() -> str:
    return f"known: {', '.join(PARAMETERS)}"
