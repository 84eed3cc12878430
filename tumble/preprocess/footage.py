"""What a camera left behind: a film, or a folder of pictures, as one sequence of upright frames with masks and lens.

A folder of pictures is sorted by the numbers in its names, so that `frame10` follows `frame9`; with a subfolder
`images/`, that is meant, and `masks/` beside it. Masks of a film are a folder of pictures, one per frame in order.
Masks of pictures have the picture's stem (`0001.png`) or, as COLMAP names them, its whole name (`0001.jpg.png`). A
picture's alpha channel is its mask when no other is given.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from tumble.io import BadFile, files, video
from tumble.scene import Camera, decoded_mask, mask_from_alpha, undistortion

PICTURES = (".png", ".jpg", ".jpeg")
"""Endings of pictures read from folders."""
FILM_DIAGONAL = math.hypot(36, 24)
"""Of the 35 mm film that equivalent focal lengths are stated for [mm]."""
GUESSED_FOCAL = 28.0
"""Equivalent focal length of a phone's main camera while it films [mm]: 24 to 26 on photographs, then cropped."""
EQUIVALENT_FOCAL_TAG = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
"""The one tag of films that names the lens; most cameras write none."""
EXIF_ORIENTATION, EXIF_IFD, EXIF_EQUIVALENT_FOCAL = 0x0112, 0x8769, 0xA405
TURNS = ((0, False), (0, False), (0, True), (2, False), (2, True), (3, True), (3, False), (1, True), (1, False))
"""EXIF orientations 0 (none said) to 8 as quarter turns counter-clockwise, then a mirror left to right."""


@dataclass(frozen=True)
class Footage:
    """A film or a folder of pictures, opened but not read."""

    path: Path
    pictures: tuple[Path, ...]
    """Of a folder, in order; empty for a film."""
    masks: tuple[Path, ...]
    """One per frame, or empty."""
    equivalent_focal: float | None
    """From the metadata [mm on 35 mm film]."""
    hdr: str | None
    """"PQ" or "HLG" when the film's code values are not sRGB."""


@dataclass(frozen=True)
class FootageFrame:
    """One upright frame."""

    number: int
    """Counted from 0 in the footage."""
    time: float
    """[s]; of pictures, their number at 30 per second."""
    picture: UInt8[np.ndarray, "h w 3"]
    """sRGB code values."""
    mask: UInt8[np.ndarray, "h w"] | None
    """OBJECT, UNKNOWN or BACKGROUND, where one is given."""


@dataclass(frozen=True)
class Lens:
    """The pinhole camera that the footage is turned into, and how."""

    camera: Camera
    source: Literal["given", "metadata", "guess"]
    """Where the focal length is from."""
    undistort: Callable[[np.ndarray, int], np.ndarray] | None
    """Maps a picture, by an OpenCV interpolation, to what the pinhole camera sees; None when it is one already."""


def open_footage(path: Path, masks: Path | None = None) -> Footage:
    """The footage at a path, with masks from a folder.

    Raises:
        BadFile: Nothing readable there, or not one mask per frame.
    """
    if not path.is_dir():
        film = video.probe(path)
        mask_files = () if masks is None else _pictures_in(masks)
        return Footage(path, (), mask_files, _positive(film.tags.get(EQUIVALENT_FOCAL_TAG)), film.hdr)
    with_images = (path / "images").is_dir()
    pictures = _pictures_in(path / "images" if with_images else path)
    masks = path / "masks" if masks is None and with_images and (path / "masks").is_dir() else masks
    mask_files = () if masks is None else tuple(mask_of(picture, masks) for picture in pictures)
    with Image.open(pictures[0]) as first:
        stated = first.getexif().get_ifd(EXIF_IFD).get(EXIF_EQUIVALENT_FOCAL)
    return Footage(path, pictures, mask_files, _positive(stated), None)


def frames(footage: Footage, *, invert_masks: bool = False) -> Iterator[FootageFrame]:
    """All frames, one at a time.

    Raises:
        BadFile: A frame cannot be read or differs in size from the first, a mask is missing or of another size.
    """
    source = _films_frames(footage) if not footage.pictures else _folders_frames(footage, invert_masks)
    shape, number = None, -1
    for number, (time, picture, mask) in enumerate(source):
        shape = shape or picture.shape
        if picture.shape != shape:
            name = footage.pictures[number] if footage.pictures else footage.path
            found = f"frame {number} is {picture.shape[1]} x {picture.shape[0]}, the first {shape[1]} x {shape[0]}"
            raise BadFile(name, found, "all frames come from one camera in one mode")
        if footage.masks:
            if number >= len(footage.masks):
                rule = f"holds {len(footage.masks)} masks, the film has more frames"
                raise BadFile(footage.masks[0].parent, rule, "give one mask per frame of the film, in order")
            mask = read_mask(footage.masks[number], picture, invert_masks)
        yield FootageFrame(number, time, picture, mask)
    if footage.masks and not footage.pictures and number + 1 < len(footage.masks):
        rule = f"holds {len(footage.masks)} masks, the film has {number + 1} frames"
        raise BadFile(footage.masks[0].parent, rule, "give one mask per frame of the film, in order")


def lens(
    footage: Footage,
    height: int,
    width: int,
    *,
    focal: float | None,
    fov: float | None,
    fisheye: tuple[float, ...] | None,
    distortion: tuple[float, ...] | None,
) -> Lens:
    """The camera of the footage: as given, else from its metadata, else a phone's (28 mm on 35 mm film).

    Metadata and guess are for the whole picture, so they are off when the film was cropped after it was taken.

    Args:
        height: Of the upright frames [pixels].
        width: [pixels]
        focal: [pixels]
        fov: Horizontal field of view [degrees], used when `focal` is None.
        fisheye: OpenCV's fisheye coefficients k1 k2 k3 k4; zeros are the ideal equidistant lens.
        distortion: OpenCV's k1 k2 p1 p2 [k3].

    Raises:
        ValueError: Contradicting or impossible arguments.
    """
    if fisheye is not None and distortion is not None:
        raise ValueError("--fisheye and --distortion are two lens models: give one")
    if fov is not None and not 1 <= fov <= (179 if fisheye is None else 240):
        raise ValueError(f"--fov is out of range: {fov:g} degrees")
    if focal is not None and not focal > 0:
        raise ValueError(f"--focal must be positive: {focal:g} pixels")
    source: Literal["given", "metadata", "guess"] = "given"
    if focal is None and fov is not None:
        half = math.radians(fov) / 2
        focal = 0.5 * width / (math.tan(half) if fisheye is None else half)
    if focal is None:
        source = "guess" if footage.equivalent_focal is None else "metadata"
        focal = (footage.equivalent_focal or GUESSED_FOCAL) / FILM_DIAGONAL * math.hypot(width, height)
    camera = Camera(torch.tensor([focal, focal, width / 2, height / 2]), height, width)
    coefficients = fisheye if fisheye is not None else distortion
    if coefficients is None:
        return Lens(camera, source, None)
    bent = np.array(coefficients, np.float64)
    return Lens(camera, source, undistortion(camera.opencv_matrix, bent, camera, fisheye=fisheye is not None))


def _positive(stated: object) -> float | None:
    try:
        value = float(str(stated))
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


def _pictures_in(path: Path) -> tuple[Path, ...]:
    if not path.is_dir():
        raise BadFile(path, "is missing" if not path.exists() else "is not a folder")
    found = sorted((p for p in path.iterdir() if p.suffix.lower() in PICTURES), key=_by_numbers)
    if not found:
        raise BadFile(path, "holds no pictures", f"known endings: {', '.join(PICTURES)}")
    for one, other in pairwise(found):
        if one.stem == other.stem:
            raise BadFile(path, f"holds both {one.name} and {other.name}", "keep one of them")
    return tuple(found)


def _by_numbers(path: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


def mask_of(picture: Path, masks: Path) -> Path:
    """The mask of a picture, by its stem or its whole name.

    Raises:
        BadFile: There is none.
    """
    names = [picture.stem + ending for ending in PICTURES] + [picture.name + ".png"]
    for name in names:
        if (masks / name).is_file():
            return masks / name
    raise BadFile(masks, f"has no mask for {picture.name}", f"name it {names[0]} or {names[-1]}")


def _films_frames(footage: Footage) -> Iterator[tuple[float, np.ndarray, None]]:
    for time, picture in video.timed_frames(footage.path):
        yield time, picture, None


def _folders_frames(footage: Footage, invert: bool) -> Iterator[tuple[float, np.ndarray, np.ndarray | None]]:
    for number, path in enumerate(footage.pictures):
        values = _upright(path, files.read_image(path))
        mask = None
        if values.shape[2] == 4:
            alpha = np.ascontiguousarray(values[..., 3])
            mask = mask_from_alpha(255 - alpha if invert else alpha)
        picture = np.repeat(values, 3, 2) if values.shape[2] == 1 else np.ascontiguousarray(values[..., :3])
        yield number / video.FPS, picture, mask


def _upright(path: Path, values: np.ndarray) -> np.ndarray:
    with Image.open(path) as picture:
        said = picture.getexif().get(EXIF_ORIENTATION, 1)
    turns, mirror = TURNS[said] if said in range(len(TURNS)) else TURNS[1]
    turned = np.rot90(values, turns)
    return np.ascontiguousarray(turned[:, ::-1] if mirror else turned)


def read_mask(path: Path, picture: UInt8[np.ndarray, "h w c"], invert: bool) -> UInt8[np.ndarray, "h w"]:
    """A mask of a picture's size as OBJECT, UNKNOWN and BACKGROUND.

    Raises:
        BadFile: It cannot be read or is of another size.
    """
    mask = np.ascontiguousarray(files.read_image(path)[..., -1])
    if mask.shape != picture.shape[:2]:
        found = f"is {mask.shape[1]} x {mask.shape[0]} pixels"
        raise BadFile(path, f"{found}, its frame is {picture.shape[1]} x {picture.shape[0]}", "masks are upright, too")
    return decoded_mask(mask, invert=invert)
