"""Reading and writing images and documents: PNG, JPEG, OpenEXR, Radiance HDR and JSON.

*Code values* are 8-bit numbers as a file stores them (sRGB for photos); *radiance* is linear float32. Writers are
atomic: they fill a *partial* file, whose name holds the number of the writing process, and rename it when it is
complete. Readers raise `BadFile` with the file, the rule it breaks and the fix. They check the size of an image before
decoding its pixels and reject more than `MAX_PIXELS`.
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
"""Largest image that is read [pixels]: 64 megapixels, an 8k x 8k environment map. Larger ones are errors or attacks."""
PARTIAL_PREFIX = ".partial-"
"""Start of the name of an incomplete file or folder; the number of the writing process follows."""


class BadFile(ValueError):
    """Error for a file that breaks a rule of its format; the message holds the file, the rule and the fix."""

    def __init__(self, path: Path, rule: str, fix: str = "") -> None:
        super().__init__(f"{path}: {rule}" + (f" ({fix})" if fix else ""))


class WriteError(OSError):
    """Error for a file that could not be written; the message holds the file, the reason and the fix."""


def path_inside(root: Path, name: str) -> Path:
    """Path of the file `name` in the folder `root`.

    Raises:
        BadFile: The name points outside the folder (an absolute path, `..`, or a link).
    """
    path = root / name
    if not Path(name).is_absolute() and path.resolve().is_relative_to(root.resolve()):
        return path
    parts = Path(name).parts
    links = [root.joinpath(*parts[:n]) for n in range(1, len(parts) + 1) if root.joinpath(*parts[:n]).is_symlink()]
    if Path(name).is_absolute() or ".." in parts or not links:
        raise BadFile(root, f"the path {name!r} leaves the folder", "use paths relative to the folder, without ..")
    reason = (
        "links out of a folder are not followed, because in one from elsewhere they could lead to any file of yours"
    )
    raise BadFile(links[0], f"is a link to {links[0].resolve()}, outside of {root}", f"copy the files there; {reason}")


@contextlib.contextmanager
def describe_write_errors(path: Path) -> Iterator[None]:
    """Context in which errors of writing `path` become a `WriteError`, whose message holds the file and the fix.

    Raises:
        WriteError: Its `errno` is that of the system's error, or None.
    """
    try:
        yield
    except WriteError:
        raise
    except (OSError, safetensors.SafetensorError) as error:
        fixes = {
            errno.ENOSPC: "free some space",
            errno.EDQUOT: "free some space",
            errno.EROFS: "choose a folder that can be written",
            errno.ENOTDIR: "a part of this path is a file: choose another folder",
            errno.EEXIST: "a part of this path is a file: choose another folder",
            errno.EACCES: "choose a folder that you may write to",
            errno.EPERM: "choose a folder that you may write to",
        }
        number = getattr(error, "errno", None)
        advice = f"{fixes[number]}, " if number in fixes else ""
        reason = f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}"
        fix = f"{advice}then run the same command again: it continues from the last saved state"
        write_error = WriteError(f"{reason} ({fix})")
        write_error.errno = number
        raise write_error from error


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file atomically: `write` fills a partial file in the same folder, which is then renamed to `path`.

    Raises:
        WriteError: The disk is full or the folder is not writable; the partial file is removed.
    """
    with describe_write_errors(path):
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
    """Start of the names of this process's partial files."""
    return f"{PARTIAL_PREFIX}{os.getpid()}-"


def remove_partial_files(folder: Path) -> None:
    """Remove the partial files and folders below a folder, except those of other processes that are still running."""
    if os.name != "posix":
        return  # elsewhere there is no portable way to check whether a process is running
    for path in list(folder.rglob(f"{PARTIAL_PREFIX}*")):
        owner = path.name.removeprefix(PARTIAL_PREFIX).partition("-")[0]
        if owner.isdecimal() and int(owner) != os.getpid() and _is_running(int(owner)):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def read_json(path: Path) -> Any:
    """The parsed JSON document.

    Raises:
        BadFile: The file is missing, is not valid JSON, or holds NaN or infinity, which JSON does not define.
    """

    def reject(word: str) -> None:
        raise BadFile(path, f"holds {word}, which is not a JSON number")

    _require_file(path)
    try:
        return json.loads(path.read_text("utf-8"), parse_constant=reject)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadFile(path, f"is not valid JSON: {error}") from None


def write_json(path: Path, document: Any) -> None:
    """Write an indented JSON document; NaN and infinities, which JSON does not define, become null."""
    text = json.dumps(_without_nan(document), indent=1, allow_nan=False)
    write_atomically(path, lambda partial: partial.write_text(text + "\n", "utf-8"))


def image_size(path: Path) -> tuple[int, int]:
    """Height and width of an 8-bit image [pixels], read without decoding it."""
    with _open(path) as image:
        return image.height, image.width


def read_image(path: Path) -> UInt8[np.ndarray, "h w c"]:
    """Code values of an 8-bit PNG or JPEG: 1, 3 or 4 channels as stored (a palette becomes RGB or RGBA).

    Raises:
        BadFile: The file is missing, is not an 8-bit image, is damaged, or has more than `MAX_PIXELS` pixels.
    """
    with _open(path) as image:
        if image.mode in ("I", "F") or image.mode.startswith("I;16"):
            raise BadFile(path, f"has pixels of type {image.mode}, not 8-bit ones", "convert it to 8-bit sRGB")
        mode = {"L": "L", "1": "L", "RGB": "RGB", "RGBA": "RGBA", "LA": "RGBA"}.get(image.mode)
        if mode is None:
            mode = "RGBA" if "transparency" in image.info else "RGB"
        try:
            values = np.asarray(image.convert(mode))
        except (OSError, SyntaxError) as error:
            raise BadFile(path, f"cannot be decoded: {error}") from None
    return values if values.ndim == 3 else values[..., None]


def write_png(path: Path, values: UInt8[np.ndarray, "h w c"]) -> None:
    """Write code values as a PNG with 1, 3 or 4 channels."""
    image = Image.fromarray(values[..., 0] if values.shape[2] == 1 else values)
    write_atomically(path, lambda partial: image.save(partial, "PNG"))


def read_radiance(path: Path) -> Float32[np.ndarray, "h w c"]:
    """Linear float pixels of an OpenEXR (.exr) or Radiance (.hdr) file with 1 or 3 channels.

    Raises:
        BadFile: The file is missing, of another format, damaged, too large, or holds NaN or infinity.
    """
    _require_file(path)
    readers = {".exr": _read_exr, ".hdr": _read_hdr}
    if path.suffix.lower() not in readers:
        raise BadFile(path, f"has the ending {path.suffix!r}, not .exr or .hdr")
    values = readers[path.suffix.lower()](path)
    if not np.isfinite(values).all():
        raise BadFile(path, "holds NaN or infinity", "linear pixels must be finite")
    return np.ascontiguousarray(values, np.float32)


def write_exr(path: Path, values: np.ndarray, *, half: bool = False) -> None:
    """Write linear pixels `[h w c]` as OpenEXR: channel Y for c = 1, RGB for c = 3; 16-bit floats when `half`."""
    pixels = np.ascontiguousarray(values, np.float16 if half else np.float32)
    channels = {"Y": pixels[..., 0]} if pixels.shape[2] == 1 else {"RGB": pixels}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write(partial: Path) -> None:
        try:
            OpenEXR.File(header, channels).write(str(partial))
        except RuntimeError as error:
            # The message of the library ends with that of the system.
            raise OSError(str(error).rpartition('"')[2].strip(" .")) from None

    write_atomically(path, write)


def write_hdr(path: Path, values: Float32[np.ndarray, "h w 3"]) -> None:
    """Write linear radiance as a Radiance RGBE file, whose shared exponent keeps about 8 bits of each colour."""

    def write(partial: Path) -> None:
        # OpenCV does not report an error when the last block does not fit on the disk.
        if not cv2.imwrite(str(partial), values[..., ::-1]) or cv2.imread(str(partial), cv2.IMREAD_UNCHANGED) is None:
            raise OSError("is the disk full?")

    write_atomically(path, write)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")


def _open(path: Path) -> Image.Image:
    _require_file(path)
    try:
        image = Image.open(path)
    except (OSError, Image.DecompressionBombError) as error:
        raise BadFile(path, f"is not an image: {error}") from None
    if image.width * image.height > MAX_PIXELS:
        raise BadFile(path, f"has {image.width} x {image.height} pixels, over the limit of {MAX_PIXELS}")
    return image


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
    """Height and width from the resolution line at the end of a Radiance header."""
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
