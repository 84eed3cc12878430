"""Reader of sparse COLMAP models, binary and text: cameras, posed images, points (colmap.github.io/format.html).

    FOLDER/sparse/0/cameras.bin  images.bin  points3D.bin       or .txt; points3D is optional
    FOLDER/sparse/, FOLDER/colmap/sparse/0/ and FOLDER/ itself  are searched as well

Of several numbered models the one with most images is read. Poses are world to camera, with OpenCV axes. The principal
points of the files put the centre of the first pixel at (0.5, 0.5), OpenCV's functions at (0, 0). Files larger than
`limits.MAX_MODEL_BYTES` are refused, and so is any count that exceeds its file.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Float64

from tumble.datasets import MAX_DISTORTION, plausible_focal
from tumble.io import BadFile, limits
from tumble.maths import SO3

T = TypeVar("T")
CAMERA_MODELS = {
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
"""Name and number of parameters of the camera models, by their number in binary files."""
N_PARAMETERS = dict(CAMERA_MODELS.values())
"""Number of parameters of the camera models, by name."""
MAX_POSITION = 1e9
"""Maximum entry of a translation [unit of the model]."""
QUATERNION_TOLERANCE = 1e-3
"""Maximum deviation of a quaternion's length from 1."""
MAX_IMAGES = 100_000
"""Maximum number of cameras and of images of a model; each takes a kilobyte of memory."""
MAX_POINTS = 10_000_000
"""Maximum number of points of a model; reconstructions of a thousand images have a million."""
MAX_LINE_BYTES = 1 << 24
"""Maximum length of a line, for text files: 16 MiB; the line with the keypoints of an image has one."""


@dataclass(frozen=True)
class Optics:
    """Intrinsics and lens distortion of one camera, in OpenCV's convention."""

    K: Float64[np.ndarray, "3 3"]
    """Camera matrix; the centre of the first pixel is (0, 0) [pixels]."""
    distortion: Float64[np.ndarray, " n"]
    """Distortion coefficients: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6, or k1 to k4 of its fisheye model."""
    fisheye: bool
    """Whether the coefficients are those of OpenCV's fisheye model."""
    height: int
    """[pixels]"""
    width: int
    """[pixels]"""

    def normalised(self, uv: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Undistorted coordinates of pixels on the plane at depth 1 in front of the camera."""
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        return undistort(uv[:, None].astype(np.float64), self.K, self.distortion)[:, 0]


@dataclass(frozen=True)
class PosedImage:
    """One image with its pose."""

    name: str
    """Path of the image, relative to the folder of images."""
    optics: Optics
    R_cam_world: Float64[np.ndarray, "3 3"]
    t_cam_world: Float64[np.ndarray, "3"]
    """Translation [unit of the model]."""


@dataclass(frozen=True)
class SparseModel:
    """A sparse reconstruction."""

    path: Path
    views: tuple[PosedImage, ...]
    """Images sorted by name."""
    points: Float64[np.ndarray, "n 3"]
    """Points in the world frame; empty if the model has no file of points."""
    errors: Float64[np.ndarray, " n"]
    """Mean reprojection error of every point [pixels]."""


def recognises(path: Path) -> bool:
    """Whether a folder contains a sparse model."""
    return path.is_dir() and bool(_model_folders(path))


def read(path: Path) -> SparseModel:
    """Read the sparse model in a COLMAP folder.

    Raises:
        BadFile: There is no model, a file is damaged, or a camera model is unknown.
    """
    folders = _model_folders(path)
    if not folders:
        raise BadFile(
            path, "holds no sparse COLMAP model", "expected sparse/0/ with cameras and images as .bin or .txt"
        )
    models = [_read(folder) for folder in folders]
    return max(models, key=lambda model: len(model.views))


def _model_folders(path: Path) -> list[Path]:
    sparse = [path / "sparse", path / "colmap" / "sparse"]
    numbered = [sorted(p for p in parent.glob("*") if p.name.isdecimal()) for parent in sparse]
    for group in (numbered[0], [sparse[0]], numbered[1], [path]):
        if models := [folder for folder in group if _file(folder, "cameras") and _file(folder, "images")]:
            return models
    return []


def _file(folder: Path, name: str) -> Path | None:
    return next((p for ending in (".bin", ".txt") if (p := folder / f"{name}{ending}").is_file()), None)


def _read(folder: Path) -> SparseModel:
    cameras, images, points = (_file(folder, name) for name in ("cameras", "images", "points3D"))
    assert cameras is not None, "checked by _model_folders"
    assert images is not None, "checked by _model_folders"
    optics = dict(_at_most(MAX_IMAGES, _cameras(cameras), cameras))
    views = sorted(_at_most(MAX_IMAGES, _views(images, optics), images), key=lambda view: view.name)
    if not views:
        raise BadFile(images, "lists no image")
    if len({view.name for view in views}) < len(views):
        raise BadFile(images, "lists two images of the same name")
    listed = _at_most(MAX_POINTS, _points(points), points) if points is not None else ()
    rows = np.fromiter(listed, np.dtype((np.float64, 4)))
    if points is not None and not np.isfinite(rows).all():
        raise BadFile(points, "contains NaN or infinity")
    return SparseModel(folder, tuple(views), rows[:, :3], rows[:, 3])


# The same for both file formats ---------------------------------------------------------------------------------------


def _at_most(count: int, entries: Iterator[T], path: Path) -> Iterator[T]:
    """The entries of a file, which may not be more than `count`."""
    for number, entry in enumerate(entries):
        if number >= count:
            raise BadFile(path, f"lists more than {count} entries", "make a model of fewer images")
        yield entry


def _cameras(path: Path) -> Iterator[tuple[int, Optics]]:
    for number, model, width, height, parameters in _binary_cameras(path) if _binary(path) else _text_cameras(path):
        yield number, _optics(path, model, width, height, np.array(parameters))


def _views(path: Path, optics: dict[int, Optics]) -> Iterator[PosedImage]:
    for name, pose, camera in _binary_images(path) if _binary(path) else _text_images(path):
        values = np.array(pose)
        if camera not in optics:
            raise BadFile(path, f"{name} refers to camera {camera}, which does not exist")
        length = math.hypot(*pose[:4])
        if not abs(length - 1) <= QUATERNION_TOLERANCE:
            raise BadFile(path, f"{name} has no valid rotation: its quaternion has length {length:.4g}")
        if not np.abs(values).max() <= MAX_POSITION:
            raise BadFile(path, f"{name} has the translation {pose[4:]}", "no camera is that far away")
        yield PosedImage(name, optics[camera], SO3(torch.from_numpy(values[:4] / length)).matrix().numpy(), values[4:])


def _points(path: Path) -> Iterator[tuple[float, ...]]:
    return _binary_points(path) if _binary(path) else _text_points(path)


def _optics(path: Path, model: str, width: int, height: int, values: Float64[np.ndarray, " n"]) -> Optics:
    """Optics from the parameters of a COLMAP camera model."""
    two_focals = model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
    fx, fy, cx, cy = values[:4] if two_focals else (values[0], values[0], values[1], values[2])
    plausible = np.isfinite(values).all() and 0 < width <= limits.MAX_SIDE and 0 < height <= limits.MAX_SIDE
    plausible = plausible and plausible_focal(fx, height, width) and plausible_focal(fy, height, width)
    if not plausible or np.abs(values[4 if two_focals else 3 :]).max(initial=0) > MAX_DISTORTION:
        rule = f"has a camera of {width} x {height} pixels with the parameters {values.tolist()}"
        raise BadFile(path, rule, "no lens has them")
    coefficients = np.zeros(4 if "FISHEYE" in model else 8)
    distortion = values[4 if two_focals else 3 :]
    coefficients[: len(distortion)] = distortion
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    return Optics(K, coefficients, "FISHEYE" in model, height, width)


# Binary ---------------------------------------------------------------------------------------------------------------


def _binary(path: Path) -> bool:
    return path.suffix == ".bin"


class _ByteReader:
    """Sequential reader of a file's bytes; a mutable class, because every read advances the position."""

    def __init__(self, path: Path) -> None:
        self.path, self.position, self.data = path, 0, _content(path)

    def take(self, layout: str) -> tuple:
        """The next numbers, little-endian, in a format of `struct`."""
        size = struct.calcsize(f"<{layout}")
        self.skip(size)
        return struct.unpack_from(f"<{layout}", self.data, self.position - size)

    def skip(self, size: int) -> None:
        self.position += size
        if self.position > len(self.data):
            raise BadFile(self.path, f"is damaged: it has {len(self.data)} bytes, and {self.position} are needed")

    def take_string(self) -> str:
        """The next zero-terminated string."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise BadFile(self.path, "is damaged: a name is not terminated")
        text, self.position = self.data[self.position : end], end + 1
        return text.decode("utf-8", errors="replace")


def _content(path: Path) -> bytes:
    limits.require_file(path, limits.MAX_MODEL_BYTES)
    return path.read_bytes()


def _binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    data = _ByteReader(path)
    for _ in range(data.take("Q")[0]):
        number, kind, width, height = data.take("IiQQ")
        if kind not in CAMERA_MODELS:
            raise BadFile(path, f"has the unknown camera model {kind}", _known_models())
        model, count = CAMERA_MODELS[kind]
        yield number, model, width, height, data.take(f"{count}d")


def _binary_images(path: Path) -> Iterator[tuple[str, tuple[float, ...], int]]:
    data = _ByteReader(path)
    for _ in range(data.take("Q")[0]):
        _, *pose, camera = data.take("I7dI")
        name = data.take_string()
        data.skip(24 * data.take("Q")[0])  # per keypoint: two coordinates and the number of a point
        yield name, tuple(pose), camera


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    data = _ByteReader(path)
    for _ in range(data.take("Q")[0]):
        _, x, y, z, _, _, _, error, track_length = data.take("Q3d3BdQ")
        data.skip(8 * track_length)
        yield x, y, z, error


# Text -----------------------------------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[str]:
    """Lines that are no comments, including empty ones, which occur as the keypoints of images."""
    limits.require_file(path, limits.MAX_MODEL_BYTES)
    with path.open("rb") as file:
        while line := file.readline(MAX_LINE_BYTES + 1):
            if len(line) > MAX_LINE_BYTES:
                raise BadFile(path, f"has a line of more than {MAX_LINE_BYTES} bytes", "no image has as many keypoints")
            if not line.startswith(b"#"):
                yield line.decode("utf-8", errors="replace")


def _numbers(path: Path, words: list[str]) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise BadFile(path, f"has {' '.join(words)[:60]!r} where numbers are expected")
    return values


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        model = words[1] if len(words) > 1 else ""
        if model not in N_PARAMETERS:
            raise BadFile(path, f"has the unknown camera model {model!r}", _known_models())
        if len(words) != 4 + N_PARAMETERS[model]:
            raise BadFile(
                path, f"has a {model} camera with {len(words) - 4} parameters instead of {N_PARAMETERS[model]}"
            )
        number, width, height, *parameters = _numbers(path, [words[0], *words[2:]])
        yield int(number), model, int(width), int(height), tuple(parameters)


def _text_images(path: Path) -> Iterator[tuple[str, tuple[float, ...], int]]:
    ended = False
    for number, line in enumerate(_lines(path)):
        words = line.split(maxsplit=9)
        ended = ended or (number % 2 == 0 and not words)
        if ended and (words or number > 2 * MAX_IMAGES):
            raise BadFile(path, "has an empty line where an image is expected", "there must be two lines per image")
        if ended or number % 2 == 1:
            continue
        if len(words) < 10:
            raise BadFile(path, f"has {line[:60]!r} where an image is expected", "there must be two lines per image")
        _, *pose, camera = _numbers(path, words[:9])
        yield words[9].strip(), tuple(pose), int(camera)


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line in _lines(path):
        words = line.split(maxsplit=8)
        if not words:
            continue
        if len(words) < 8:
            raise BadFile(path, f"has {line[:60]!r} where a point is expected")
        _, x, y, z, _, _, _, error = _numbers(path, words[:8])
        yield x, y, z, error


def _known_models() -> str:
    return f"known models: {', '.join(N_PARAMETERS)}"
