"""Reader of the capture folder: `transforms.json` as in instant-ngp and nerfstudio, with masks and ground truth.

The format is specified in docs/format.md. Any violation raises `BadFile`, which names the file, the rule and the fix.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.io import BadFile, files
from tumble.maths import linear_from_srgb, to_srgb8
from tumble.scene import (
    BACKGROUND,
    LIGHTS,
    OBJECT,
    REGIONS,
    UNITS,
    Camera,
    Capture,
    Environment,
    Light,
    Trajectory,
    Truth,
    decode_mask,
    mask_from_alpha,
    truth_without_views,
    undistortion,
)

TRANSFORMS = "transforms.json"
"""File of the camera and the frames."""
LAYOUT = f"CAPTURE/{TRANSFORMS} (docs/format.md)"
RIGID_TOLERANCE = 1e-3
"""Maximum deviation of the entries of R^T R from the identity: rounding of printed digits, but no scale or shear."""
MAX_BLACK = 16
"""Maximum code value of a black background: what lossy compression leaves."""


@dataclass(frozen=True)
class _Document:
    """A validated transforms.json."""

    root: Path
    fields: dict[str, Any]
    frames: list[dict[str, Any]]
    light: Light

    @property
    def path(self) -> Path:
        return self.root / TRANSFORMS

    def split(self, name: str) -> list[dict[str, Any]]:
        return [frame for frame in self.frames if frame.get("split", "train") == name]


def recognises(path: Path) -> bool:
    """Whether a path is a capture folder."""
    return (path / TRANSFORMS).is_file()


def load(path: Path | str) -> Capture:
    """The training frames of a capture folder; nothing under `truth/` is read.

    Raises:
        BadFile: The folder breaks a rule of docs/format.md.
    """
    document = _read(Path(path))
    frames = document.split("train")
    if not frames:
        raise BadFile(
            document.path, "has no training frame", 'at least one frame must have "split": "train", or no "split"'
        )
    lens = _lens(document, frames[0])
    images, masks = _read_images(document, frames, lens)
    names = tuple(_name(frame) for frame in frames)
    focal_assumed = document.fields.get("focal_source") == "guess"
    return Capture(images, masks, lens.camera, names, document.light, _poses(document, frames), focal_assumed)


def load_truth(path: Path | str) -> Truth | None:
    """The evaluation views of a capture folder, with all available ground truth; None if there is none.

    Raises:
        BadFile: The folder breaks a rule of docs/format.md.
    """
    document = _read(Path(path))
    frames = document.split("eval")
    lens = _lens(document, (frames or document.frames)[0])
    truth = _evaluation_views(document, frames, lens) if frames else truth_without_views(lens.camera)
    light, lights, poses = _light(document), _lights(document, frames), _true_poses(document)
    if not frames and light is None and poses is None:
        return None
    labels = {"units": _units(document), "setting": document.fields.get("setting")}
    return Truth(**{**vars(truth), "light": light, "lights": lights, "poses": poses, **labels})


# The document ---------------------------------------------------------------------------------------------------------


def _read(root: Path) -> _Document:
    if not root.is_dir():
        raise BadFile(root, "is not a folder", f"a capture is a folder that contains {TRANSFORMS}")
    path = root / TRANSFORMS
    fields = files.read_json(path)
    if not isinstance(fields, dict) or not isinstance(fields.get("frames"), list) or not fields["frames"]:
        raise BadFile(path, 'must have a list "frames" with at least one frame')
    light = fields.get("light", "object")
    if light not in LIGHTS:
        raise BadFile(path, f'"light" is {light!r}', f"it must be one of {', '.join(LIGHTS)}")
    names: set[str] = set()
    for number, frame in enumerate(fields["frames"]):
        _check_frame(path, number, frame, names)
    return _Document(root, fields, fields["frames"], cast(Light, light))


def _check_frame(path: Path, number: int, frame: Any, names: set[str]) -> None:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise BadFile(path, f'frame {number} has no "file_path"')
    name = frame["file_path"]
    if name in names or Path(name).name in names:
        raise BadFile(path, f"the frame {name} is there twice", "frames must have images with different names")
    names |= {name, Path(name).name}
    if frame.get("split", "train") not in ("train", "eval"):
        raise BadFile(path, f'frame {name}: "split" is {frame["split"]!r}', "it must be train or eval")
    if frame.get("split") == "eval" and frame.get("region", "sphere") not in REGIONS:
        raise BadFile(path, f'frame {name}: "region" is {frame["region"]!r}', f"it must be one of {', '.join(REGIONS)}")


def _number(document: _Document, frame: dict[str, Any], name: str) -> float | None:
    """A number of the document or, as in nerfstudio, of its first frame; None if it is missing."""
    value = document.fields.get(name, frame.get(name))
    if value is None:
        return None
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise BadFile(document.path, f'"{name}" is {value!r}, not a number')
    return float(value)


def _units(document: _Document) -> str:
    units = document.fields.get("units", "arbitrary")
    if units not in UNITS:
        raise BadFile(document.path, f'"units" is {units!r}', f"it must be one of {', '.join(UNITS)}")
    return units


def _name(frame: dict[str, Any]) -> str:
    return Path(frame["file_path"]).name


# The camera -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Lens:
    """A pinhole camera, and the undistortion of images to it."""

    camera: Camera
    undistort: Callable[[np.ndarray, int], np.ndarray] | None
    """Resamples an image to the pinhole camera, given an OpenCV interpolation flag; None if there is no distortion."""


def _lens(document: _Document, frame: dict[str, Any]) -> _Lens:
    _same_intrinsics(document)
    image = _image_path(document, frame)
    height, width = files.image_size(image)
    for name, value in (("w", width), ("h", height)):
        if (stated := _number(document, frame, name)) is not None and stated != value:
            raise BadFile(image, f"has {width} x {height} pixels, but {TRANSFORMS} has {name} = {stated:g}")
    focal = _number(document, frame, "fl_x")
    angle = _number(document, frame, "camera_angle_x")
    if focal is None and angle is not None:
        focal = 0.5 * width / math.tan(0.5 * angle)
    if focal is None or focal <= 0:
        raise BadFile(document.path, 'must have a positive "fl_x" [pixels] or "camera_angle_x" [radians]')
    fy = _number(document, frame, "fl_y") or focal
    cx, cy = _number(document, frame, "cx"), _number(document, frame, "cy")
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    camera = Camera(torch.tensor([focal, fy, *center]), height, width)
    return _Lens(camera, _undistortion(document, frame, camera))


def _same_intrinsics(document: _Document) -> None:
    for name in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "w", "h"):
        if len({frame[name] for frame in document.frames if name in frame}) > 1:
            raise BadFile(
                document.path, f'frames differ in "{name}"', "all frames of a capture must be from one camera"
            )


def _undistortion(
    document: _Document, frame: dict[str, Any], camera: Camera
) -> Callable[[np.ndarray, int], np.ndarray] | None:
    model = document.fields.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE"
    if model not in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE"):
        raise BadFile(document.path, f'"camera_model" is {model!r}', "known models: OPENCV, OPENCV_FISHEYE, PINHOLE")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    coefficients = np.array([_number(document, frame, name) or 0.0 for name in names])
    if not coefficients.any() and not fisheye:
        return None
    return undistortion(camera.opencv_matrix, coefficients, camera, fisheye=fisheye)


# Images ---------------------------------------------------------------------------------------------------------------


def _image_path(document: _Document, frame: dict[str, Any]) -> Path:
    path = files.path_inside(document.root, frame["file_path"])
    # NeRF's synthetic scenes omit the file ending.
    return path if path.suffix or path.exists() else path.with_suffix(".png")


def _read_images(
    document: _Document, frames: list[dict[str, Any]], lens: _Lens
) -> tuple[UInt8[Tensor, "t h w 3"], UInt8[Tensor, "t h w"]]:
    pairs = [_read_image_and_mask(document, frame, lens) for frame in frames]
    images, masks = (torch.from_numpy(np.stack(arrays)) for arrays in zip(*pairs, strict=True))
    return images, masks


def _read_image_and_mask(document: _Document, frame: dict[str, Any], lens: _Lens) -> tuple[np.ndarray, np.ndarray]:
    path = _image_path(document, frame)
    pixels = _require_size(files.read_image(path), path, lens.camera)
    image = np.repeat(pixels, 3, 2) if pixels.shape[2] == 1 else pixels[..., :3]
    mask = np.full(pixels.shape[:2], OBJECT, np.uint8)
    if pixels.shape[2] == 4:
        image, mask = composite_over_black(pixels), mask_from_alpha(pixels[..., 3])
    if "mask_path" in frame:
        mask_path = files.path_inside(document.root, frame["mask_path"])
        mask = decode_nonempty_mask(
            _require_size(files.read_image(mask_path), mask_path, lens.camera)[..., 0], mask_path
        )
        image = blacken_background(image, mask)
    if lens.undistort is not None:
        image, mask = lens.undistort(image, cv2.INTER_LINEAR), lens.undistort(mask, cv2.INTER_NEAREST)
    if not (mask == OBJECT).any():
        file = frame.get("mask_path", frame["file_path"])
        raise BadFile(
            document.root / file,
            "is an empty mask",
            "every frame must show the object: remove the frame, or correct its mask",
        )
    return np.ascontiguousarray(image), np.ascontiguousarray(mask)


def _require_size(pixels: np.ndarray, path: Path, camera: Camera) -> np.ndarray:
    if pixels.shape[:2] != (camera.height, camera.width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise BadFile(path, f"has {size} pixels, but the capture has {camera.width} x {camera.height}")
    return pixels


def composite_over_black(rgba: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """Unpremultiplied sRGB colour with alpha, composited over black in linear light, as sRGB code values."""
    linear = linear_from_srgb(torch.from_numpy(rgba[..., :3] / 255.0)) * torch.from_numpy(rgba[..., 3:] / 255.0)
    return to_srgb8(linear).numpy()


def blacken_background(image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The image with a black background; an image whose background is black already is returned unchanged.

    Faint pixels next to the silhouette of an object over black belong to the object, which covers them partly.
    """
    background = mask == BACKGROUND
    interior = cv2.erode(background.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    return image if image[interior].max(initial=0) <= MAX_BLACK else np.where(background[..., None], np.uint8(0), image)


def decode_nonempty_mask(mask: UInt8[np.ndarray, "h w"], path: Path) -> UInt8[np.ndarray, "h w"]:
    """Code values of a mask file as OBJECT, UNKNOWN and BACKGROUND.

    Raises:
        BadFile: The mask is black everywhere.
    """
    if mask.max(initial=0) == 0:
        raise BadFile(
            path, "is an empty mask", "every frame must show the object: remove the frame, or correct its mask"
        )
    return decode_mask(mask)


# Poses ----------------------------------------------------------------------------------------------------------------


def _poses(document: _Document, frames: list[dict[str, Any]]) -> Trajectory | None:
    with_pose = [frame for frame in frames if "transform_matrix" in frame]
    if not with_pose:
        return None
    if len(with_pose) < len(frames):
        without = next(frame for frame in frames if "transform_matrix" not in frame)
        raise BadFile(
            document.path, f"the frame {_name(without)} has no pose, but others have", "give all frames a pose, or none"
        )
    named_matrices = ((_name(frame), frame["transform_matrix"]) for frame in frames)
    return Trajectory.from_camera_to_object(_rigid_matrices(document.path, named_matrices), document.light)


def _rigid_matrices(path: Path, named_matrices: Iterable[tuple[str, Any]]) -> Float[Tensor, "t 4 4"]:
    matrices = []
    for name, values in named_matrices:
        try:
            matrix = np.array(values, np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise BadFile(path, f'frame {name}: "transform_matrix" is not 4 x 4 finite numbers')
        R = matrix[:3, :3]
        deviation = max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(matrix[3] - [0, 0, 0, 1]).max())
        if deviation > RIGID_TOLERANCE or np.linalg.det(R) < 0:
            raise BadFile(
                path,
                f'frame {name}: "transform_matrix" is not a rotation and a translation',
                f"the deviation is {deviation:.2g}",
            )
        matrices.append(matrix)
    return torch.from_numpy(np.stack(matrices)).float()


def read_poses(path: Path, names: Iterable[str]) -> Float[Tensor, "t 4 4"]:
    """Poses of the given frames from a JSON file `{"0000.png": 4x4}`: camera to object, OpenGL camera axes.

    Raises:
        BadFile: A frame is missing, or its matrix is not rigid.
    """
    document = files.read_json(path)
    names = list(names)
    if not isinstance(document, dict) or (missing := [name for name in names if name not in document]):
        raise BadFile(path, f"has no pose for {', '.join(missing[:3]) if isinstance(document, dict) else names[0]}")
    return _rigid_matrices(path, ((name, document[name]) for name in names))


def _true_poses(document: _Document) -> Trajectory | None:
    frames = document.split("train")
    path = document.root / "truth" / "poses.json"
    if not frames or not path.exists():
        return _poses(document, frames)
    return Trajectory.from_camera_to_object(read_poses(path, map(_name, frames)), document.light)


# Truth ----------------------------------------------------------------------------------------------------------------


def _evaluation_views(document: _Document, frames: list[dict[str, Any]], lens: _Lens) -> Truth:
    if lens.undistort is not None:
        raise BadFile(
            document.path, "has evaluation views and lens distortion", "ground truth must have a pinhole camera"
        )
    images, masks = _read_images(document, frames, lens)
    trajectory = _poses(document, frames)
    if trajectory is None:
        raise BadFile(
            document.path, 'has evaluation frames without "transform_matrix"', "every evaluation view must have a pose"
        )

    def linear(key: str, channels: Literal[1, 3]) -> Tensor | None:
        if not any(key in frame for frame in frames):
            return None
        maps = torch.stack([_linear_map(document, frame, key, channels, lens.camera) for frame in frames])
        return maps[..., 0] if channels == 1 else maps

    normals = linear("normal_path", 3)
    return Truth(
        images=images,
        masks=masks,
        names=tuple(_name(frame) for frame in frames),
        regions=tuple(frame.get("region", "sphere") for frame in frames),
        trajectory=trajectory,
        albedo=linear("albedo_path", 3),
        roughness=linear("roughness_path", 1),
        # Half precision changes lengths by 1e-3, which an arccos turns into an angle of 0.4 degrees.
        normals=None if normals is None else torch.nn.functional.normalize(normals, dim=-1),
        depth=linear("depth_path", 1),
        relit={light: _relit(document, frames, light, lens.camera) for light in _light_names(document, frames)},
    )


def _truth_path(document: _Document, frame: dict[str, Any], key: str, name: object) -> Path:
    if not isinstance(name, str):
        raise BadFile(
            document.path,
            f'the frame {_name(frame)} has no "{key}", but others have',
            "give it for all views, or for none",
        )
    return files.path_inside(document.root, name)


def _linear_map(document: _Document, frame: dict[str, Any], key: str, channels: int, camera: Camera) -> Tensor:
    path = _truth_path(document, frame, key, frame.get(key))
    pixels = _require_size(files.read_radiance(path), path, camera)
    if pixels.shape[2] != channels:
        raise BadFile(path, f"has {pixels.shape[2]} channels instead of {channels} ({key})")
    return torch.from_numpy(pixels)


def _light_names(document: _Document, frames: list[dict[str, Any]]) -> list[str]:
    names = sorted({name for frame in frames for name in frame.get("relit", {})})
    for name in names:  # predictions have folders with these names
        if Path(name).name != name or name in ("", "..") or {"\\", "\0"} & set(name):
            raise BadFile(document.path, f'"relit" has a light {name!r}, which is no valid folder name')
    return names


def _relit(document: _Document, frames: list[dict[str, Any]], light: str, camera: Camera) -> Tensor:
    paths = [_truth_path(document, f, f"relit/{light}", f.get("relit", {}).get(light)) for f in frames]
    return torch.from_numpy(np.stack([_require_size(files.read_image(path), path, camera)[..., :3] for path in paths]))


def _light(document: _Document) -> Environment | None:
    if "light_path" not in document.fields:
        return None
    return Environment.read(files.path_inside(document.root, document.fields["light_path"]))


def _lights(document: _Document, frames: list[dict[str, Any]]) -> dict[str, Environment]:
    paths = {name: f"truth/lights/{name}.hdr" for name in _light_names(document, frames)}
    return {name: Environment.read(files.path_inside(document.root, path)) for name, path in paths.items()}
