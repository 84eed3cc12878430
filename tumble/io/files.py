"""Pictures and tables on disk: PNG, OpenEXR, Radiance HDR and JSON, read with the reason of every refusal.

*Code values* are 8-bit numbers as a file stores them (sRGB for photographs); *radiance* is linear and in float32.
Every writer makes a file that is whole or absent: it fills a *partial* one first, whose name says whose it is. Every
reader raises `BadFile`, which names the file, the rule it broke and the fix, and reads a picture's size before its
pixels: more than `MAX_PIXELS` are refused.
"""

import contextlib
import errno
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import safetensors
from jaxtyping import Float32, UInt8
from PIL import Image

MAX_PIXELS = 1 << 26
"""Largest picture read: 64 megapixels, an 8k x 8k light map; a larger one is a mistake or an attack."""


PARTIAL = ".partial-"
"""Begins the name of what is being written; the number of the process follows."""


class BadFile(ValueError):
    """A file that breaks a rule of its format. The message names the file, the rule and the fix."""

    def __init__(self, path: Path, rule: str, fix: str = "") -> None:
        super().__init__(f"{path}: {rule}" + (f" ({fix})" if fix else ""))


class Unwritten(OSError):
    """A file that could not be written. The message names the file, the reason and the fix."""


def inside(root: Path, name: str) -> Path:
    """The file `name` of folder `root`.

    Raises:
        BadFile: The name leaves the folder (an absolute path, `..`, or a link to outside).
    """
    path = root / name
    if Path(name).is_absolute() or not path.resolve().is_relative_to(root.resolve()):
        raise BadFile(root, f"the path {name!r} leaves the folder", "use paths relative to the folder, without ..")
    return path


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the reasons why a file cannot be written into one sentence with the file and the fix.

    Raises:
        Unwritten: With the number of the system's error, where there is one.
    """
    try:
        yield
    except Unwritten:
        raise
    except (OSError, safetensors.SafetensorError) as error:
        fixes = {
            errno.ENOSPC: "free some space",
            errno.EDQUOT: "free some space",
            errno.EROFS: "choose a folder that can be written",
            errno.EACCES: "choose a folder that you may write to",
            errno.EPERM: "choose a folder that you may write to",
        }
        number = getattr(error, "errno", None)
        advice = f"{fixes[number]}, " if number in fixes else ""
        reason = f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}"
        told = Unwritten(f"{reason} ({advice}what was finished before is kept; the same command goes on from there)")
        told.errno = number
        raise told from error


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Let `write` fill a partial file beside `path`, then put it in place in one step.

    Raises:
        Unwritten: The disk is full, or the folder may not be written; nothing is left behind.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=partial_prefix(), suffix=path.suffix, dir=path.parent)
        os.close(handle)
        partial = Path(name)
        try:
            write(partial)
            partial.chmod(0o644)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


def partial_prefix() -> str:
    """How the names of this process's partial files begin."""
    return f"{PARTIAL}{os.getpid()}-"


def sweep(folder: Path) -> None:
    """Remove the partial files and folders that killed processes left under a folder, and what this one left."""
    if os.name != "posix":
        return  # nobody tells which processes live
    for path in list(folder.rglob(f"{PARTIAL}*")):
        owner = path.name.removeprefix(PARTIAL).partition("-")[0]
        if owner.isdecimal() and int(owner) != os.getpid() and _alive(int(owner)):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def read_json(path: Path) -> Any:
    """A JSON document. NaN and infinity, which JSON does not know, are refused."""

    def refuse(word: str) -> None:
        raise BadFile(path, f"holds {word}, which is not a JSON number")

    _exists(path)
    try:
        return json.loads(path.read_text("utf-8"), parse_constant=refuse)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadFile(path, f"is not valid JSON: {error}") from None


def write_json(path: Path, document: Any) -> None:
    """A JSON document, indented; NaN is written as null, for JSON has no other word."""
    text = json.dumps(_without_nan(document), indent=1, allow_nan=False)
    write_whole(path, lambda partial: partial.write_text(text + "\n", "utf-8"))


def image_size(path: Path) -> tuple[int, int]:
    """Height and width of an 8-bit picture, without decoding it."""
    with _open(path) as picture:
        return picture.height, picture.width


def read_image(path: Path) -> UInt8[np.ndarray, "h w c"]:
    """Code values of an 8-bit PNG or JPEG: 1, 3 or 4 channels as stored (a palette becomes RGB or RGBA)."""
    with _open(path) as picture:
        if picture.mode in ("I", "F") or picture.mode.startswith("I;16"):
            raise BadFile(path, f"has pixels of kind {picture.mode}, not 8 bits", "convert it to 8-bit sRGB")
        mode = {"L": "L", "1": "L", "RGB": "RGB", "RGBA": "RGBA", "LA": "RGBA"}.get(picture.mode)
        if mode is None:
            mode = "RGBA" if "transparency" in picture.info else "RGB"
        try:
            values = np.asarray(picture.convert(mode))
        except (OSError, SyntaxError) as error:
            raise BadFile(path, f"cannot be decoded: {error}") from None
    return values if values.ndim == 3 else values[..., None]


def write_png(path: Path, values: UInt8[np.ndarray, "h w c"]) -> None:
    """Code values as a PNG of 1, 3 or 4 channels."""
    picture = Image.fromarray(values[..., 0] if values.shape[2] == 1 else values)
    write_whole(path, lambda partial: picture.save(partial, "PNG"))


def read_radiance(path: Path) -> Float32[np.ndarray, "h w c"]:
    """Linear float pixels of an OpenEXR (.exr) or Radiance (.hdr) file: 1 or 3 channels, all finite."""
    _exists(path)
    readers = {".exr": _read_exr, ".hdr": _read_hdr}
    if path.suffix.lower() not in readers:
        raise BadFile(path, f"has the ending {path.suffix!r}, not .exr or .hdr")
    values = readers[path.suffix.lower()](path)
    if not np.isfinite(values).all():
        raise BadFile(path, "holds NaN or infinity", "linear pixels must be finite")
    return np.ascontiguousarray(values, np.float32)


def write_exr(path: Path, values: np.ndarray, *, half: bool = False) -> None:
    """Linear pixels `[h w c]` as OpenEXR: channel Y for c = 1, RGB for c = 3; 16-bit floats when `half`."""
    pixels = np.ascontiguousarray(values, np.float16 if half else np.float32)
    channels = {"Y": pixels[..., 0]} if pixels.shape[2] == 1 else {"RGB": pixels}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write(partial: Path) -> None:
        try:
            OpenEXR.File(header, channels).write(str(partial))
        except RuntimeError as error:
            # The library's words end with the system's reason.
            raise OSError(str(error).rpartition('"')[2].strip(" .")) from None

    write_whole(path, write)


def write_hdr(path: Path, values: Float32[np.ndarray, "h w 3"]) -> None:
    """Linear radiance as a Radiance RGBE file; a colour keeps about 8 bits under its shared exponent."""

    def write(partial: Path) -> None:
        # OpenCV does not notice when the last block does not fit on the disk.
        if not cv2.imwrite(str(partial), values[..., ::-1]) or cv2.imread(str(partial), cv2.IMREAD_UNCHANGED) is None:
            raise OSError("is the disk full?")

    write_whole(path, write)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _exists(path: Path) -> None:
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")


def _open(path: Path) -> Image.Image:
    _exists(path)
    try:
        picture = Image.open(path)
    except (OSError, Image.DecompressionBombError) as error:
        raise BadFile(path, f"is not a picture: {error}") from None
    if picture.width * picture.height > MAX_PIXELS:
        raise BadFile(path, f"has {picture.width} x {picture.height} pixels, over the limit of {MAX_PIXELS}")
    return picture


def _read_exr(path: Path) -> np.ndarray:
    try:
        window = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
        width, height = (int(high - low) + 1 for low, high in zip(*window, strict=True))
        if not 0 < width * height <= MAX_PIXELS:
            raise BadFile(path, f"has {width} x {height} pixels, over the limit of {MAX_PIXELS}")
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, OSError, KeyError, ValueError, TypeError) as error:
        if isinstance(error, BadFile):
            raise
        raise BadFile(path, f"is not an OpenEXR file: {error}") from None
    for names in (("R", "G", "B"), ("Y",), ("V",)):
        if set(names) <= set(channels):
            return np.stack([channels[name].pixels.astype(np.float32) for name in names], -1)
    raise BadFile(path, f"has channels {sorted(channels)}, not R, G, B or Y")


def _read_hdr(path: Path) -> np.ndarray:
    height, width = _hdr_size(path)
    if not 0 < width * height <= MAX_PIXELS:
        raise BadFile(path, f"has {width} x {height} pixels, over the limit of {MAX_PIXELS}")
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None or values.dtype != np.float32 or values.ndim != 3:
        raise BadFile(path, "is not a Radiance HDR file")
    return values[..., ::-1]


def _hdr_size(path: Path) -> tuple[int, int]:
    """Height and width from the resolution line that ends a Radiance header."""
    with path.open("rb") as file:
        if not file.readline(64).startswith((b"#?RADIANCE", b"#?RGBE")):
            raise BadFile(path, "is not a Radiance HDR file")
        for _ in range(64):
            words = file.readline(512).split()
            if len(words) == 4 and words[0] == b"-Y" and words[2] == b"+X":
                return int(words[1]), int(words[3])
    raise BadFile(path, "has no resolution line of the form -Y height +X width")


def _without_nan(document: Any) -> Any:
    if isinstance(document, dict):
        return {key: _without_nan(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [_without_nan(value) for value in document]
    return None if isinstance(document, float) and not math.isfinite(document) else document
