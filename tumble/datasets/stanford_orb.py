"""Reader of captures of Stanford-ORB (Kuang et al. 2023) in their Blender layout: a real object in a room.

    DATASET/blender_LDR/CAPTURE/transforms_train.json     {"camera_angle_x": radians, "frames": [{"file_path":
            (or blender_HDR)                              "train/0000", "transform_matrix": 4x4}, ...]}
                                train/0000.png (.exr)     photos
                                train_mask/0000.png       masks
                                transforms_test.json, test/, test_mask/
                                transforms_novel.json     frames of the same object in other rooms, each with a field of
                                                          view and "scene_name", the capture that has the photo
    DATASET/blender_HDR/CAPTURE/test/0000.exr             radiance of the test views, to which published scores refer
    DATASET/ground_truth/CAPTURE/pseudo_gt_albedo/0000.png, surface_normal/0000.npy, env_map/0000.exr

Poses are camera to world with OpenGL camera axes; normals and light maps are in the frame of the camera, with the same
axes. Images are averaged down to 512 x 512 pixels, the benchmark's resolution. The poses are given, and the light is
fixed to the object. Depth and meshes are not read.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from tumble.datasets import _blender
from tumble.datasets._blender import ObjectFrame
from tumble.datasets._lens import FrameLens
from tumble.datasets._transforms import Matrix, Name
from tumble.datasets.folder import rigid_matrices
from tumble.io import BadFile, files, limits
from tumble.maths import linear_from_srgb, to_srgb8
from tumble.scene import BACKGROUND, OBJECT, Capture, Environment, RelitViews, Truth, truth_without_views

TRAIN = "transforms_train.json"
"""File of the training views."""
SIDE = 512
"""Width of the images after reading [pixels]; smaller ones keep theirs."""
HDR, TRUTH = "blender_HDR", "ground_truth"
"""Folders of the dataset with radiance and with ground truth."""
LAYOUT = f"CAPTURE/{TRAIN} and CAPTURE/train_mask/0000.png of Stanford-ORB"


class _Frame(msgspec.Struct, frozen=True):
    """Entry of "frames"."""

    file_path: Name
    transform_matrix: Matrix
    scene_name: str = ""
    camera_angle_x: float | None = None

    @property
    def name(self) -> str:
        return Path(self.file_path).name


class _Document(msgspec.Struct, frozen=True):
    """Content of a transforms_*.json."""

    frames: Annotated[tuple[_Frame, ...], msgspec.Meta(min_length=1)]
    camera_angle_x: float | None = None


@dataclass(frozen=True)
class _Split:
    """The views of one document of a capture."""

    root: Path
    path: Path
    document: _Document

    @cached_property
    def T_world_cam(self) -> Float[Tensor, "t 4 4"]:
        """Poses, camera to world, OpenGL camera axes."""
        return rigid_matrices(self.path, [(frame.file_path, frame.transform_matrix) for frame in self.document.frames])

    def file(self, frame: _Frame, folder: str, ending: str) -> Path:
        """A file of a view in a folder of the dataset, such as blender_HDR; the view may be of another capture."""
        capture = frame.scene_name or self.root.resolve().name
        return files.path_inside(self.root.resolve().parent.parent, f"{folder}/{capture}/{ending}")

    def image_file(self, frame: _Frame) -> Path:
        """The photo of a view of this capture."""
        path = files.path_inside(self.root, f"{frame.file_path}.png")
        return path if path.exists() else files.path_inside(self.root, f"{frame.file_path}.exr")

    def masks(self, mask_files: list[Path]) -> UInt8[np.ndarray, "t h w"]:
        """Masks of all views, in the order of their files."""
        masks = [np.where(_downsized(files.read_image(path)[..., :1] / 255, path) > 0.5, 255, 0) for path in mask_files]
        return _stacked(masks, mask_files)[..., 0].astype(np.uint8)

    def own_masks(self) -> UInt8[np.ndarray, "t h w"]:
        """Masks of all views, if they are of this capture."""
        paths = [Path(frame.file_path) for frame in self.document.frames]
        return self.masks([files.path_inside(self.root, f"{p.parent}_mask/{p.name}.png") for p in paths])

    def lens(self, frame: _Frame, height: int, width: int) -> FrameLens:
        """Lens of a view whose image has a size after reading."""
        angle = frame.camera_angle_x if self.document.camera_angle_x is None else self.document.camera_angle_x
        return _blender.lens_of(self.path, math.nan if angle is None else angle, height, width)


def recognises(path: Path) -> bool:
    """Whether a path is a capture of Stanford-ORB."""
    return (path / TRAIN).is_file() and (path / "train_mask").is_dir()


def load(path: Path | str) -> Capture:
    """The training views of a capture, with their poses.

    Raises:
        BadFile: A file is missing or broken.
    """
    split = _read(Path(path), TRAIN)
    masks = split.own_masks()
    lens = split.lens(split.document.frames[0], *masks.shape[1:])
    trajectory = _object_frame(split, masks).trajectory(split.T_world_cam)
    names = tuple(f"{frame.name}.png" for frame in split.document.frames)
    if len(set(names)) < len(names):
        raise BadFile(split.path, "has two frames of one name", "every image must be there once")
    return Capture(_photos(split, masks), torch.from_numpy(masks), lens.camera, names, "object", trajectory)


def load_truth(path: Path | str) -> Truth | None:
    """The test views of a capture with their ground truth, and the views of the object in other rooms.

    The latter, and radiance, are only there if the dataset has the folder blender_HDR.

    Raises:
        BadFile: A file is missing or broken.
    """
    root = Path(path)
    train = _read(root, TRAIN)
    train_masks = train.own_masks()
    frame = _object_frame(train, train_masks)
    lens = train.lens(train.document.frames[0], *train_masks.shape[1:])
    truth = replace(
        truth_without_views(lens.camera),
        poses=frame.trajectory(train.T_world_cam),
        setting="dome",
        benchmark="stanford-orb",
        elsewhere=_elsewhere(root, frame),
    )
    if not (root / "transforms_test.json").is_file():
        return truth
    split = _read(root, "transforms_test.json")
    masks, frames = split.own_masks(), split.document.frames
    if masks.shape[1:] != train_masks.shape[1:] or split.lens(frames[0], *masks.shape[1:]) != lens:
        raise BadFile(split.path, "has another camera than the training views")
    return replace(
        truth,
        images=_photos(split, masks),
        masks=torch.from_numpy(masks),
        alpha=torch.from_numpy(masks),
        names=tuple(f"{frame.name}.png" for frame in frames),
        regions=("shared",) * len(frames),
        trajectory=frame.trajectory(split.T_world_cam),
        radiance=_radiance(split, masks),
        albedo=_albedo(split, masks),
        normals=_normals(split, masks),
        light=next(iter(_lights(split)), None),
    )


def _read(root: Path, name: str) -> _Split:
    if not recognises(root):
        raise BadFile(root, "is not a capture of Stanford-ORB", f"expected {LAYOUT}")
    return _Split(root, root / name, files.read_json(root / name, _Document))


def _object_frame(train: _Split, masks: UInt8[np.ndarray, "t h w"]) -> ObjectFrame:
    lens = train.lens(train.document.frames[0], *masks.shape[1:])
    return _blender.object_frame(train.path, masks, lens, train.T_world_cam)


def _elsewhere(root: Path, frame: ObjectFrame) -> RelitViews | None:
    """The views in other rooms; None if there are none, or no radiance of them."""
    if not (root / "transforms_novel.json").is_file():
        return None
    split = _read(root, "transforms_novel.json")
    frames = split.document.frames
    if unnamed := [each.file_path for each in frames if Path(each.scene_name).name != each.scene_name != ""]:
        raise BadFile(split.path, f'{unnamed[0]} has a "scene_name" that is no name', "it is that of a capture")
    photos = [split.file(each, HDR, f"{each.file_path}.exr") for each in frames]
    if not photos[0].is_file():
        return None
    masks = split.masks([photo.parent.parent / "test_mask" / f"{photo.stem}.png" for photo in photos])
    object_ = torch.from_numpy(masks == OBJECT)
    return RelitViews(
        radiance=torch.from_numpy(_stacked([_radiance_of(photo) for photo in photos], photos)) * object_[..., None],
        foreground=object_,
        cameras=tuple(split.lens(each, *masks.shape[1:]).camera for each in frames),
        T_cam_obj=frame.trajectory(split.T_world_cam).T_cam_obj,
        lights=_lights(split, required=True),
    )


# Images ---------------------------------------------------------------------------------------------------------------


def _downsized(pixels: np.ndarray, path: Path) -> Float32[np.ndarray, "h w c"]:
    """Pixels of an image of a width above `SIDE`, averaged down to it; the benchmark averages sRGB albedo."""
    height, width, channels = pixels.shape
    if height != width or (width > SIDE and width % SIDE):
        raise BadFile(path, f"has {width} x {height} pixels", f"expected squares of a multiple of {SIDE} pixels")
    values = np.asarray(pixels, np.float32)
    if width > SIDE:
        values = cv2.resize(values, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return values.reshape(*values.shape[:2], channels)


def _stacked(images: list[np.ndarray], paths: list[Path]) -> np.ndarray:
    """Images of one size as one array."""
    for image, path in zip(images, paths, strict=True):
        if image.shape != images[0].shape:
            raise BadFile(path, f"has another size than {paths[0].name}", "all images must have one size")
    return np.stack(images)


def _radiance_of(path: Path) -> Float32[np.ndarray, "h w 3"]:
    return np.maximum(_downsized(_three_channels(files.read_radiance(path), path), path), 0)


def _three_channels(pixels: np.ndarray, path: Path) -> np.ndarray:
    if pixels.shape[2] < 3:
        raise BadFile(path, f"has {pixels.shape[2]} channel instead of 3")
    return pixels[..., :3]


def _photos(split: _Split, masks: UInt8[np.ndarray, "t h w"]) -> UInt8[Tensor, "t h w 3"]:
    """Photos of all views as sRGB over black; radiance above 1 saturates."""
    paths = [split.image_file(frame) for frame in split.document.frames]
    limits.require_bytes(split.path, 4 * masks.size, f"{len(paths)} frames", limits.MAX_CAPTURE_BYTES)
    images = [_photo(path) for path in paths]
    photos = _stacked(images, paths)
    if photos.shape[:3] != masks.shape:
        raise BadFile(paths[0], "has another size than its mask")
    return torch.from_numpy(np.where((masks == BACKGROUND)[..., None], np.uint8(0), photos))


def _photo(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    if path.suffix == ".exr":
        return to_srgb8(torch.from_numpy(_radiance_of(path))).numpy()
    linear = linear_from_srgb(torch.from_numpy(_three_channels(files.read_image(path), path) / 255).float())
    return to_srgb8(torch.from_numpy(_downsized(linear.numpy(), path))).numpy()


def _radiance(split: _Split, masks: UInt8[np.ndarray, "t h w"]) -> Float[Tensor, "t h w 3"] | None:
    """Radiance of the views of this capture; None if the dataset has none."""
    paths = [split.file(frame, HDR, f"{frame.file_path}.exr") for frame in split.document.frames]
    if not paths[0].is_file():
        return None
    pixels = torch.from_numpy(_stacked([_radiance_of(path) for path in paths], paths))
    return pixels * torch.from_numpy(masks == OBJECT)[..., None]


# Ground truth ---------------------------------------------------------------------------------------------------------


def _truth_files(split: _Split, kind: str, suffix: str) -> list[Path]:
    """The files of one kind of ground truth of all views; empty if the first is missing."""
    frames = split.document.frames
    paths = [split.file(frame, TRUTH, f"{kind}/{frame.name}{suffix}") for frame in frames]
    return paths if paths[0].is_file() else []


def _albedo(split: _Split, masks: UInt8[np.ndarray, "t h w"]) -> Float[Tensor, "t h w 3"] | None:
    """Linear base colour of the scanned object, 0 outside of it."""
    paths = _truth_files(split, "pseudo_gt_albedo", ".png")
    if not paths:
        return None
    images = [_downsized(_three_channels(files.read_image(path), path) / 255, path) for path in paths]
    return linear_from_srgb(torch.from_numpy(_masked(images, paths, masks)))


def _normals(split: _Split, masks: UInt8[np.ndarray, "t h w"]) -> Float[Tensor, "t h w 3"] | None:
    """Unit normals in the object frame, 0 outside the object."""
    paths = _truth_files(split, "surface_normal", ".npy")
    if not paths:
        return None
    n_cam = torch.from_numpy(_masked([_downsized(_read_array(path), path) for path in paths], paths, masks))
    return normalize(torch.einsum("vij,vhwj->vhwi", _R_obj_cam(split).to(n_cam), n_cam), dim=-1)


def _masked(images: list[np.ndarray], paths: list[Path], masks: UInt8[np.ndarray, "t h w"]) -> np.ndarray:
    values = _stacked(images, paths)
    if values.shape[:3] != masks.shape:
        raise BadFile(paths[0], "has another size than the photos")
    return values * (masks == OBJECT)[..., None].astype(np.float32)


def _read_array(path: Path) -> np.ndarray:
    """Numbers `[h w 3]` of a file of numpy; arrays of Python objects, which are pickles, are refused."""
    limits.require_file(path, limits.MAX_DECODED_BYTES)
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError, TypeError) as error:
        raise BadFile(path, f"is not an array of numpy: {str(error)[:100]}") from None
    if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or values.ndim != 3 or values.shape[2] != 3:
        raise BadFile(path, "holds no floating-point numbers of the shape height x width x 3")
    limits.require_image_size(path, values.shape[1], values.shape[0], 12)
    pixels = np.array(values, np.float32)
    if not np.isfinite(pixels).all():
        raise BadFile(path, "holds NaN or infinity")
    return pixels


def _R_obj_cam(split: _Split) -> Float[Tensor, "t 3 3"]:
    """Rotations from the camera of each view, OpenGL axes, to the object frame."""
    R_world_cam = split.T_world_cam[:, :3, :3]
    return R_world_cam.new_tensor(_blender.R_OBJ_WORLD) @ R_world_cam


def _lights(split: _Split, *, required: bool = False) -> tuple[Environment, ...]:
    """Light of each view in the object frame; empty if there are none, unless they are required."""
    paths = _truth_files(split, "env_map", ".exr")
    if not paths and required:
        raise BadFile(split.file(split.document.frames[0], TRUTH, "env_map"), "has no light maps")
    rotations = _R_obj_cam(split)
    chosen = paths if required else paths[:1]
    return tuple(Environment.read(path).rotated(R) for path, R in zip(chosen, rotations, strict=False))
