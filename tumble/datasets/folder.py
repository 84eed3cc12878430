"""Reader of the capture folder: `transforms.json` as in instant-ngp and nerfstudio, with masks and ground truth.

The format is specified in docs/format.md. Any violation raises `BadFile`, which names the file, the rule and the fix.
Frames with different lenses are resampled to one pinhole camera (`_lens`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.datasets import _transforms
from tumble.datasets._lens import FrameLens, common_lens, resample
from tumble.datasets._plausibility import MAX_DISTORTION, plausible_centre, plausible_focal
from tumble.datasets._transforms import TRANSFORMS, FrameRecord, Matrix, TransformsRecord
from tumble.io import BadFile, files, limits
from tumble.maths import linear_from_srgb, to_srgb8
from tumble.scene import (
    BACKGROUND,
    OBJECT,
    UNKNOWN,
    Camera,
    Capture,
    Environment,
    Trajectory,
    Truth,
    decode_mask,
    mask_from_alpha,
    truth_without_views,
)

LAYOUT = f"CAPTURE/{TRANSFORMS} (docs/format.md)"
RIGID_TOLERANCE = 1e-3
"""Maximum deviation of the entries of R^T R from the identity: rounding of printed digits, but no scale or shear."""
MAX_BLACK = 16
"""Maximum code value of a black background: what lossy compression leaves."""


@dataclass(frozen=True)
class _Folder:
    """A capture folder with its validated document."""

    root: Path
    document: TransformsRecord

    @property
    def path(self) -> Path:
        return self.root / TRANSFORMS


@dataclass(frozen=True)
class _Lenses:
    """The lens of every frame, and the pinhole lens to which all are resampled."""

    frames: tuple[FrameLens, ...]
    common: FrameLens


def recognises(path: Path) -> bool:
    """Whether a path is a capture folder."""
    return (path / TRANSFORMS).is_file()


def load(path: Path | str) -> Capture:
    """The training frames of a capture folder; nothing under `truth/` is read.

    Raises:
        BadFile: The folder breaks a rule of docs/format.md.
    """
    folder = _open(path)
    frames = folder.document.split("train")
    if not frames:
        rule = "has no training frame"
        raise BadFile(folder.path, rule, 'at least one frame must have "split": "train", or no "split"')
    lenses = _lenses(folder, frames)
    images, masks = _read_images(folder, frames, lenses)
    if all(frame.mask_path for frame in frames) and not (masks == BACKGROUND).any():
        rule = "has only masks that are white everywhere"
        raise BadFile(folder.path, rule, "the background must be black; without masks, leave out mask_path")
    names = tuple(frame.name for frame in frames)
    focal_assumed = folder.document.focal_source == "guess"
    light, poses = folder.document.light, _poses(folder, frames)
    full_images = _read_full_images(folder, frames, lenses) if all(frame.full_image_path for frame in frames) else None
    return Capture(images, masks, lenses.common.camera, names, light, poses, focal_assumed, full_images)


def load_truth(path: Path | str) -> Truth | None:
    """The evaluation views of a capture folder, with all available ground truth; None if there is none.

    Raises:
        BadFile: The folder breaks a rule of docs/format.md.
    """
    folder = _open(path)
    frames = folder.document.split("eval")
    lenses = _lenses(folder, frames or folder.document.frames)
    truth = _evaluation_views(folder, frames, lenses) if frames else truth_without_views(lenses.common.camera)
    light, lights, poses = _light(folder), _lights(folder, frames), _true_poses(folder)
    if not frames and light is None and poses is None:
        return None
    labels = {"units": folder.document.units, "setting": folder.document.setting}
    return Truth(**{**vars(truth), "light": light, "lights": lights, "poses": poses, **labels})


def _open(path: Path | str) -> _Folder:
    return _Folder(Path(path), _transforms.read(Path(path)))


# Lenses ---------------------------------------------------------------------------------------------------------------


def _lenses(folder: _Folder, frames: Sequence[FrameRecord]) -> _Lenses:
    """The lenses of frames. Without intrinsics of their own, all have the image size of the first."""
    own = any(_intrinsics(frame, None) for frame in frames)
    found = [_lens(folder, frame) for frame in (frames if own else frames[:1])]
    found = found if own else found * len(frames)
    return _Lenses(tuple(found), common_lens(folder.path, found))


def _intrinsics(frame: FrameRecord, document: TransformsRecord | None) -> dict[str, Any]:
    """The intrinsics that are stated in a frame or else in the document, by name.

    The focal length has several names: a frame that states it under one of them does not take it from the document.
    """
    own, general = ({} if record is None else _transforms.stated_intrinsics(record) for record in (frame, document))
    if own.keys() & {"fl_x", "camera_angle_x"}:
        general = {name: value for name, value in general.items() if name not in ("fl_x", "fl_y", "camera_angle_x")}
    return general | own


def _lens(folder: _Folder, frame: FrameRecord) -> FrameLens:
    stated = _intrinsics(frame, folder.document)
    image = _image_path(folder, frame)
    height, width = files.image_size(image)
    for name, value in (("w", width), ("h", height)):
        if stated.get(name, value) != value:
            raise BadFile(image, f"has {width} x {height} pixels, but {TRANSFORMS} has {name} = {stated[name]:g}")
    focal = stated.get("fl_x")
    if focal is None and "camera_angle_x" in stated:
        focal = 0.5 * width / math.tan(0.5 * stated["camera_angle_x"])
    if focal is None:
        raise BadFile(folder.path, 'must have a positive "fl_x" [pixels] or "camera_angle_x" [radians]')
    focals = focal, stated.get("fl_y", focal)
    if not all(plausible_focal(value, height, width) for value in focals):
        rule = f"has focal lengths of {focals[0]:.3g} and {focals[1]:.3g} pixels for images of {width} x {height}"
        raise BadFile(folder.path, rule, '"fl_x" and "fl_y" are in pixels')
    fisheye = stated.get("camera_model") == "OPENCV_FISHEYE"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = tuple(stated.get(name, 0.0) for name in names)
    if max(map(abs, distortion)) > MAX_DISTORTION:
        raise BadFile(folder.path, f"has the distortion coefficients {distortion}", f"the limit is {MAX_DISTORTION:g}")
    centre = stated.get("cx", width / 2), stated.get("cy", height / 2)
    if not plausible_centre(*centre, height, width):
        rule = f"has its principal point at ({centre[0]:.3g}, {centre[1]:.3g}) for images of {width} x {height}"
        raise BadFile(folder.path, rule, '"cx" and "cy" are in pixels')
    return FrameLens((*focals, *centre), height, width, distortion if fisheye or any(distortion) else (), fisheye)


# Images ---------------------------------------------------------------------------------------------------------------


def _image_path(folder: _Folder, frame: FrameRecord) -> Path:
    path = files.path_inside(folder.root, frame.file_path)
    # NeRF's synthetic scenes omit the file ending.
    return path if path.suffix or path.exists() or not path.name else path.with_suffix(".png")


def _read_images(
    folder: _Folder, frames: Sequence[FrameRecord], lenses: _Lenses
) -> tuple[UInt8[Tensor, "t h w 3"], UInt8[Tensor, "t h w"]]:
    shape = len(frames), lenses.common.height, lenses.common.width
    limits.require_bytes(folder.path, 4 * math.prod(shape), f"{len(frames)} frames", limits.MAX_CAPTURE_BYTES)
    images, masks = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint8)
    for i, (frame, lens) in enumerate(zip(frames, lenses.frames, strict=True)):
        images[i], masks[i] = _read_image_and_mask(folder, frame, lens, lenses.common)
    return torch.from_numpy(images), torch.from_numpy(masks)


def _read_image_and_mask(
    folder: _Folder, frame: FrameRecord, lens: FrameLens, common: FrameLens
) -> tuple[np.ndarray, np.ndarray]:
    path = _image_path(folder, frame)
    pixels = _require_size(files.read_image(path), path, lens)
    image = np.repeat(pixels, 3, 2) if pixels.shape[2] == 1 else pixels[..., :3]
    mask = np.full(pixels.shape[:2], OBJECT, np.uint8)
    if pixels.shape[2] == 4:
        image, mask = composite_over_black(pixels), mask_from_alpha(pixels[..., 3])
    if frame.mask_path:
        mask_path = files.path_inside(folder.root, frame.mask_path)
        mask = decode_nonempty_mask(_require_size(files.read_image(mask_path), mask_path, lens)[..., 0], mask_path)
        image = blacken_background(image, mask)
    # The object of a mask ends before the border of the image; without a mask, nothing is known beyond.
    masked = bool(frame.mask_path) or pixels.shape[2] == 4
    image, mask = resample(image, mask, lens, common, beyond=BACKGROUND if masked else UNKNOWN)
    if not (mask == OBJECT).any():
        raise BadFile(
            folder.root / (frame.mask_path or frame.file_path),
            "is an empty mask",
            "every frame must show the object: remove the frame, or correct its mask",
        )
    return image, mask


def _read_full_images(folder: _Folder, frames: Sequence[FrameRecord], lenses: _Lenses) -> UInt8[Tensor, "t h w 3"]:
    """The photos with their background."""
    shape = len(frames), lenses.common.height, lenses.common.width, 3
    limits.require_bytes(folder.path, 2 * math.prod(shape), f"{len(frames)} frames", limits.MAX_CAPTURE_BYTES)
    images = np.empty(shape, np.uint8)
    for i, (frame, lens) in enumerate(zip(frames, lenses.frames, strict=True)):
        path = files.path_inside(folder.root, frame.full_image_path)
        pixels = _require_size(files.read_image(path), path, lens)
        if pixels.shape[2] != 3:
            raise BadFile(path, f"has {pixels.shape[2]} channels instead of 3 (full_image_path)")
        images[i], _ = resample(pixels, np.full(pixels.shape[:2], OBJECT, np.uint8), lens, lenses.common)
    return torch.from_numpy(images)


def _require_size(pixels: np.ndarray, path: Path, lens: FrameLens | Camera) -> np.ndarray:
    if pixels.shape[:2] != (lens.height, lens.width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise BadFile(path, f"has {size} pixels, but the capture has {lens.width} x {lens.height}")
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


def _poses(folder: _Folder, frames: Sequence[FrameRecord]) -> Trajectory | None:
    matrices = {frame.name: frame.transform_matrix for frame in frames}
    without = [name for name, matrix in matrices.items() if matrix is None]
    if len(without) == len(frames):
        if any(frame.light_turn for frame in frames):
            raise BadFile(folder.path, 'has "light_turn" without poses', "give the poses, too")
        return None
    if without:
        rule = f"the frame {without[0]} has no pose, but others have"
        raise BadFile(folder.path, rule, "give all frames a pose, or none")
    T_obj_cam, turns = rigid_matrices(folder.path, matrices.items()), _light_turns(folder, frames)
    return replace(Trajectory.from_camera_to_object(T_obj_cam, folder.document.light), light_turns=turns)


def _light_turns(folder: _Folder, frames: Sequence[FrameRecord]) -> Float[Tensor, "t 3 3"] | None:
    """Rotations of the light of frames with poses; None if the light does not turn."""
    turns = [frame.light_turn for frame in frames]
    if not any(turns):
        return None
    if without := [frame.name for frame in frames if frame.light_turn is None]:
        rule = f'the frame {without[0]} has no "light_turn", but others have'
        raise BadFile(folder.path, rule, "give it for all training frames, or for none")
    homogeneous = [(*((*row, 0.0) for row in turn or ()), (0.0, 0.0, 0.0, 1.0)) for turn in turns]
    names = [frame.name for frame in frames]
    return rigid_matrices(folder.path, zip(names, homogeneous, strict=True), "light_turn")[:, :3, :3].contiguous()


def rigid_matrices(
    path: Path, named_matrices: Iterable[tuple[str, Any]], key: str = "transform_matrix"
) -> Float[Tensor, "t 4 4"]:
    """Homogeneous matrices of rigid motions, from a file's rows of numbers by frame name.

    Raises:
        BadFile: One of them is no rotation and translation.
    """
    matrices = []
    for name, values in named_matrices:
        with np.errstate(over="ignore"):
            matrix = np.array(values, np.float64).astype(np.float32).astype(np.float64)
        R = matrix[:3, :3]
        finite = np.isfinite(matrix).all()
        deviation = max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(matrix[3] - [0, 0, 0, 1]).max()) if finite else np.inf
        if deviation > RIGID_TOLERANCE or np.linalg.det(R) < 0:
            rule = f'frame {name}: "{key}" is not a rotation and a translation'
            raise BadFile(path, rule, f"the deviation is {deviation:.2g}")
        matrices.append(np.array(values, np.float64))
    return torch.from_numpy(np.stack(matrices)).float()


def read_poses(path: Path, names: Iterable[str]) -> Float[Tensor, "t 4 4"]:
    """Poses of the given frames from a JSON file `{"0000.png": 4x4}`: camera to object, OpenGL camera axes.

    Raises:
        BadFile: A frame is missing, or its matrix is not rigid.
    """
    document, names = files.read_json(path, dict[str, Matrix]), list(names)
    if missing := [name for name in names if name not in document]:
        raise BadFile(path, f"has no pose for {', '.join(missing[:3])}")
    return rigid_matrices(path, ((name, document[name]) for name in names))


def _true_poses(folder: _Folder) -> Trajectory | None:
    frames = folder.document.split("train")
    path = folder.root / "truth" / "poses.json"
    if not frames or not path.exists():
        return _poses(folder, frames)
    names = [frame.name for frame in frames]
    return Trajectory.from_camera_to_object(read_poses(path, names), folder.document.light)


# Truth ----------------------------------------------------------------------------------------------------------------


def _evaluation_views(folder: _Folder, frames: Sequence[FrameRecord], lenses: _Lenses) -> Truth:
    camera = lenses.common.camera
    if any(lens != lenses.common for lens in lenses.frames):
        rule = "has evaluation views with lens distortion or with different lenses"
        raise BadFile(folder.path, rule, "ground truth must have one pinhole camera")
    images, masks = _read_images(folder, frames, lenses)
    trajectory = _poses(folder, frames)
    if trajectory is None:
        rule = 'has evaluation frames without "transform_matrix"'
        raise BadFile(folder.path, rule, "every evaluation view must have a pose")

    def linear(key: str, channels: Literal[1, 3]) -> Tensor | None:
        if not any(getattr(frame, key) for frame in frames):
            return None
        maps = torch.stack([_linear_map(folder, frame, key, channels, camera) for frame in frames])
        return maps[..., 0] if channels == 1 else maps

    normals = linear("normal_path", 3)
    return Truth(
        images=images,
        masks=masks,
        names=tuple(frame.name for frame in frames),
        regions=tuple(frame.region for frame in frames),
        trajectory=trajectory,
        albedo=linear("albedo_path", 3),
        roughness=linear("roughness_path", 1),
        metalness=linear("metalness_path", 1),
        # Half precision changes lengths by 1e-3, which an arccos turns into an angle of 0.4 degrees.
        normals=None if normals is None else torch.nn.functional.normalize(normals, dim=-1),
        depth=linear("depth_path", 1),
        relit={light: _relit(folder, frames, light, camera) for light in _light_names(folder, frames)},
    )


def _truth_path(folder: _Folder, frame: FrameRecord, key: str, name: str) -> Path:
    if not name:
        rule = f'the frame {frame.name} has no "{key}", but others have'
        raise BadFile(folder.path, rule, "give it for all views, or for none")
    return files.path_inside(folder.root, name)


def _linear_map(folder: _Folder, frame: FrameRecord, key: str, channels: int, camera: Camera) -> Tensor:
    path = _truth_path(folder, frame, key, getattr(frame, key))
    pixels = _require_size(files.read_radiance(path), path, camera)
    if pixels.shape[2] != channels:
        raise BadFile(path, f"has {pixels.shape[2]} channels instead of {channels} ({key})")
    return torch.from_numpy(pixels)


def _light_names(folder: _Folder, frames: Sequence[FrameRecord]) -> list[str]:
    names = sorted({name for frame in frames for name in frame.relit})
    for name in names:  # predictions have folders with these names
        if Path(name).name != name or name in ("", "..") or {"\\", "\0"} & set(name):
            raise BadFile(folder.path, f'"relit" has a light {name!r}, which is no valid folder name')
    return names


def _relit(folder: _Folder, frames: Sequence[FrameRecord], light: str, camera: Camera) -> Tensor:
    paths = [_truth_path(folder, frame, f"relit/{light}", frame.relit.get(light, "")) for frame in frames]
    images = []
    for path in paths:
        pixels = _require_size(files.read_image(path), path, camera)
        if pixels.shape[2] < 3:
            raise BadFile(path, f"has {pixels.shape[2]} channel instead of 3 (relit)")
        images.append(pixels[..., :3])
    return torch.from_numpy(np.stack(images))


def _light(folder: _Folder) -> Environment | None:
    name = folder.document.light_path
    return Environment.read(files.path_inside(folder.root, name)) if name else None


def _lights(folder: _Folder, frames: Sequence[FrameRecord]) -> dict[str, Environment]:
    paths = {name: f"truth/lights/{name}.hdr" for name in _light_names(folder, frames)}
    return {name: Environment.read(files.path_inside(folder.root, path)) for name, path in paths.items()}
