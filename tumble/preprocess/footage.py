"""Footage: a video or a folder of images, read as a sequence of upright frames with masks and one lens.

The images of a folder are sorted by the numbers in their names, so that `frame10` follows `frame9`. If the folder has a
subfolder `images/`, the images are taken from there, and the masks from `masks/` beside it. Masks of a video are a
folder of images, one per frame in order. A mask of an image has the stem of its name (`0001.png`) or, as in COLMAP, its
whole name (`0001.jpg.png`). Without other masks the alpha channel of an image is its mask, unless all images of the
folder are opaque, as image editors save them.
"""

import math
import re
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from tumble.datasets import MAX_DISTORTION, plausible_focal
from tumble.io import BadFile, files, video
from tumble.scene import BACKGROUND, OBJECT, Camera, decode_mask, mask_from_alpha, undistortion

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""File endings of the images that are read from folders."""
FULL_FRAME_DIAGONAL = math.hypot(36, 24)
"""Diagonal of 35 mm film, to which equivalent focal lengths refer [mm]."""
DEFAULT_EQUIVALENT_FOCAL = 28.0
"""Assumed 35 mm equivalent focal length of a phone's main camera in video mode [mm]; photos have 24 to 26, videos are
cropped."""
EQUIVALENT_FOCAL_TAG = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
"""The only metadata tag of videos that states the focal length; most cameras write none."""
EXIF_ORIENTATION = 0x0112
"""EXIF tag of the orientation."""
EXIF_IFD = 0x8769
"""EXIF tag of the directory that holds the camera's settings."""
EXIF_EQUIVALENT_FOCAL = 0xA405
"""EXIF tag of the focal length in 35 mm equivalent [mm]."""
ORIENTATIONS = ((0, False), (0, False), (0, True), (2, False), (2, True), (3, True), (3, False), (1, True), (1, False))
"""Per EXIF orientation 0 (not stated) to 8: number of quarter turns counter-clockwise, and whether to mirror left to
right after them."""
OPAQUE = 255
"""Alpha of an opaque pixel."""
MAX_TINT = 16
"""Largest difference between the channels of a grey pixel in a lossy image [code values]."""
PROVENANCE = "ingest.json"
"""File name, in a capture, of the record of how it was made."""
WRONG_PROVENANCE = "remove the folder that holds it, and convert the footage again"
"""Fix for a damaged record of how a capture was made."""


@dataclass(frozen=True)
class Footage:
    """An opened video or folder of images; no frame is read yet."""

    path: Path
    images: tuple[Path, ...]
    """Images of a folder, in order; empty for a video."""
    masks: tuple[Path, ...]
    """Mask files, one per frame, or empty."""
    equivalent_focal: float | None
    """35 mm equivalent focal length from the metadata [mm]."""
    hdr: str | None
    """"PQ" or "HLG" if the video is HDR, whose code values are converted to sRGB."""


@dataclass(frozen=True)
class FootageFrame:
    """One upright frame."""

    number: int
    """Number of the frame in the footage, counted from 0."""
    time: float
    """Time in the video [s]; the frames of an image folder are 1/30 s apart."""
    image: UInt8[np.ndarray, "h w 3"]
    """sRGB code values."""
    mask: UInt8[np.ndarray, "h w"] | None
    """OBJECT, UNKNOWN or BACKGROUND; None if there is no mask."""


@dataclass(frozen=True)
class Lens:
    """The pinhole camera to which the footage is undistorted."""

    camera: Camera
    source: Literal["given", "metadata", "guess"]
    """Where the focal length is from; "guess" is the default for phones."""
    undistort: Callable[[np.ndarray, int], np.ndarray] | None
    """Resamples an image to the pinhole camera, given an OpenCV interpolation flag; None if there is no distortion."""


def open_footage(path: Path, masks: Path | None = None) -> Footage:
    """Open the footage at a path, with masks from a folder.

    Raises:
        BadFile: The footage cannot be read, or the number of masks differs from the number of images.
    """
    if not path.is_dir():
        header = video.probe(path)
        mask_files = () if masks is None else _list_images(masks)
        return Footage(path, (), mask_files, _positive_number(header.tags.get(EQUIVALENT_FOCAL_TAG)), header.hdr)
    with_images = (path / "images").is_dir()
    images = _list_images(path / "images" if with_images else path)
    masks = path / "masks" if masks is None and with_images and (path / "masks").is_dir() else masks
    mask_files = () if masks is None else tuple(find_mask(image, masks) for image in images)
    equivalent_focal = _exif(images[0]).get_ifd(EXIF_IFD).get(EXIF_EQUIVALENT_FOCAL)
    return Footage(path, images, mask_files, _positive_number(equivalent_focal), None)


def read_frames(
    footage: Footage, *, part: tuple[int, int] | None = None, invert_masks: bool = False
) -> Iterator[FootageFrame]:
    """Read the frames, one at a time.

    Args:
        part: Numbers of the first and the last frame; None for all.

    Raises:
        BadFile: A frame cannot be read or differs in size from the first; a mask is missing or has another size; the
            footage ends before the part begins.
    """
    first, last = part or (0, sys.maxsize)
    source = _video_frames(footage) if not footage.images else _image_frames(footage, invert_masks)
    shape, number = None, -1
    for number, (time, image, mask) in enumerate(source):
        if number > last:
            return
        if number < first:
            continue
        shape = shape or image.shape
        if image.shape != shape:
            name = footage.images[number] if footage.images else footage.path
            rule = f"frame {number} has {image.shape[1]} x {image.shape[0]} pixels, the first {shape[1]} x {shape[0]}"
            raise BadFile(name, rule, "all frames must be from one camera in one mode")
        if footage.masks:
            if number >= len(footage.masks):
                rule = f"holds {len(footage.masks)} masks, but the video has more frames"
                raise BadFile(footage.masks[0].parent, rule, "give one mask per frame of the video, in order")
            mask = read_mask(footage.masks[number], image, invert_masks)
        yield FootageFrame(number, time, image, mask)
    if 0 <= number < first:
        raise BadFile(footage.path, f"has {number + 1} frames", f"--part begins with frame {first}, counted from 0")
    if footage.masks and not footage.images and number + 1 < len(footage.masks):
        rule = f"holds {len(footage.masks)} masks, but the video has {number + 1} frames"
        raise BadFile(footage.masks[0].parent, rule, "give one mask per frame of the video, in order")


def resolve_lens(
    footage: Footage,
    height: int,
    width: int,
    *,
    focal: float | None,
    fov: float | None,
    fisheye: tuple[float, ...] | None,
    distortion: tuple[float, ...] | None,
) -> Lens:
    """The camera of the footage: from the options, else from its metadata, else a phone's (28 mm equivalent).

    Focal lengths from metadata and the default refer to the full image, so they are wrong for footage that was cropped.

    Args:
        height: Height of the upright frames [pixels].
        width: Width of the upright frames [pixels].
        focal: Focal length [pixels].
        fov: Horizontal field of view [degrees]; used if `focal` is None.
        fisheye: OpenCV's fisheye coefficients k1 k2 k3 k4; zeros are the ideal equidistant lens.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3].

    Raises:
        ValueError: The arguments contradict each other or are out of range.
    """
    if fisheye is not None and distortion is not None:
        raise ValueError("--fisheye and --distortion are different lens models: give only one of them")
    if fov is not None and not 1 <= fov <= (179 if fisheye is None else 240):
        raise ValueError(f"--fov is out of range: {fov:g} degrees")
    if focal is not None and not plausible_focal(focal, height, width):
        raise ValueError(f"--focal is out of range: {focal:g} pixels for a video of {width} x {height}")
    if not all(abs(value) <= MAX_DISTORTION for value in (*(fisheye or ()), *(distortion or ()))):
        raise ValueError(f"--fisheye and --distortion take coefficients up to {MAX_DISTORTION:g}")
    if distortion is not None and len(distortion) not in (4, 5):
        raise ValueError(f"--distortion takes 4 or 5 coefficients, these are {len(distortion)}")
    source: Literal["given", "metadata", "guess"] = "given"
    if focal is None and fov is not None:
        half = math.radians(fov) / 2
        focal = 0.5 * width / (math.tan(half) if fisheye is None else half)
    if focal is None:
        source = "guess" if footage.equivalent_focal is None else "metadata"
        focal = (footage.equivalent_focal or DEFAULT_EQUIVALENT_FOCAL) / FULL_FRAME_DIAGONAL * math.hypot(width, height)
    camera = Camera(torch.tensor([focal, focal, width / 2, height / 2]), height, width)
    coefficients = fisheye if fisheye is not None else distortion
    if coefficients is None:
        return Lens(camera, source, None)
    values = np.array(coefficients, np.float64)
    return Lens(camera, source, undistortion(camera.opencv_matrix, values, camera, fisheye=fisheye is not None))


def _exif(path: Path) -> Image.Exif:
    """EXIF tags of an image; none if they are damaged."""
    with files.open_image(path) as image:
        try:
            return image.getexif()
        except (OSError, ValueError, SyntaxError, LookupError, TypeError, struct.error):
            return Image.Exif()


def _positive_number(text: object) -> float | None:
    try:
        value = float(str(text))
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


def _list_images(path: Path) -> tuple[Path, ...]:
    if not path.is_dir():
        raise BadFile(path, "is missing" if not path.exists() else "is not a folder")
    shown = (p for p in path.iterdir() if not p.name.startswith("."))  # macOS writes ._0001.png beside 0001.png
    images = sorted((p for p in shown if p.suffix.lower() in IMAGE_SUFFIXES), key=_natural_key)
    if not images:
        raise BadFile(path, "holds no images", f"known file endings: {', '.join(IMAGE_SUFFIXES)}")
    for a, b in pairwise(images):
        if a.stem == b.stem:
            raise BadFile(path, f"holds both {a.name} and {b.name}", "keep one of them")
    return tuple(images)


def _natural_key(path: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


def find_mask(image: Path, masks: Path) -> Path:
    """Path of the mask of an image, named by its stem or its whole name.

    Raises:
        BadFile: There is no such mask.
    """
    names = [image.stem + ending for ending in IMAGE_SUFFIXES] + [image.name + ".png"]
    for name in names:
        if (masks / name).is_file():
            return masks / name
    raise BadFile(masks, f"has no mask for {image.name}", f"name the mask {names[0]} or {names[-1]}")


def _video_frames(footage: Footage) -> Iterator[tuple[float, np.ndarray, None]]:
    for time, image in video.timed_frames(footage.path):
        yield time, image, None


def _image_frames(footage: Footage, invert: bool) -> Iterator[tuple[float, np.ndarray, np.ndarray | None]]:
    opaque = bool(footage.masks) or all(map(_is_opaque, footage.images))
    for number, path in enumerate(footage.images):
        values = _upright(path, files.read_image(path))
        mask = None
        if values.shape[2] == 4 and not opaque:
            alpha = np.ascontiguousarray(values[..., 3])
            mask = mask_from_alpha(255 - alpha if invert else alpha)
        image = np.repeat(values, 3, 2) if values.shape[2] == 1 else np.ascontiguousarray(values[..., :3])
        yield number / video.FPS, image, mask


def _is_opaque(path: Path) -> bool:
    """Whether an image has no pixel that its alpha channel makes transparent; images without one are not decoded."""
    with files.open_image(path) as image:
        if not image.has_transparency_data:
            return True
    values = files.read_image(path)
    return values.shape[2] < 4 or bool((values[..., 3] == OPAQUE).all())


def _upright(path: Path, values: np.ndarray) -> np.ndarray:
    orientation = _exif(path).get(EXIF_ORIENTATION, 1)
    quarter_turns, mirror = ORIENTATIONS[orientation] if orientation in range(len(ORIENTATIONS)) else ORIENTATIONS[1]
    rotated = np.rot90(values, quarter_turns)
    return np.ascontiguousarray(rotated[:, ::-1] if mirror else rotated)


def read_mask(path: Path, image: UInt8[np.ndarray, "h w c"], invert: bool) -> UInt8[np.ndarray, "h w"]:
    """Read a mask with the size of an image, as OBJECT, UNKNOWN and BACKGROUND.

    It is the alpha channel unless that is opaque, as image editors add it; else the brightness, or what is not black in
    an image of labels, in which every object has a colour.

    Raises:
        BadFile: The mask cannot be read or has another size.
    """
    values = files.read_image(path)
    mask = values[..., :3].max(-1)
    if values.shape[2] == 4 and values[..., 3].min() < OPAQUE:
        mask = np.ascontiguousarray(values[..., 3])
    elif (mask - values[..., :3].min(-1)).max() > MAX_TINT:
        mask = np.where(mask > 0, np.uint8(OBJECT), np.uint8(BACKGROUND))
    if mask.shape != image.shape[:2]:
        rule = f"has {mask.shape[1]} x {mask.shape[0]} pixels, its frame {image.shape[1]} x {image.shape[0]}"
        raise BadFile(path, rule, "masks must be as large as the upright frames")
    return decode_mask(mask, invert=invert)


class SourceFrame(msgspec.Struct, frozen=True):
    """One frame of the capture."""

    name: str
    source_frame: int | None = None
    """Number of the frame in the video; None for images with a COLMAP model."""
    hand_coloured: float = 0.0
    """Fraction of the mask with the colours of the hands."""


class Provenance(msgspec.Struct, frozen=True):
    """The entries of `ingest.json` that are read again."""

    footage: str = ""
    """SHA-256 of the footage."""
    masks: str = ""
    """SHA-256 of the masks that were given in a folder of their own."""
    options: dict[str, Any] = {}
    """The `FootageOptions`, by name."""
    frames: tuple[SourceFrame, ...] = ()
    focal_source: str = ""
    window_top_left_height_width: tuple[float, float, float, float] | None = None
    """Crop window [pixels of the footage]; None for images with a COLMAP model."""


def read_provenance(capture: Path) -> Provenance | None:
    """The record in a capture folder; None if there is none.

    Raises:
        BadFile: The record is damaged.
    """
    path = capture / PROVENANCE
    return files.read_json(path, Provenance, WRONG_PROVENANCE) if path.is_file() else None
