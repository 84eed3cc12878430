"""Reading and writing images and documents: PNG, JPEG, OpenEXR, Radiance HDR and JSON.

*Code values* are 8-bit numbers as a file stores them (sRGB for photos); *radiance* is linear float32. Writers are
atomic: they fill a *partial* file, whose name holds the number of the writing process, and rename it when it is
complete. Readers raise `BadFile` with the file, the rule it breaks and the fix. They check the stated size of a file
against `limits` before decoding it. Documents are parsed and validated at once, by msgspec.
"""

import contextlib
import errno
import hashlib
import io
import json
import math
import os
import shutil
import struct
import sys
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import msgspec
import numpy as np
import OpenEXR
import safetensors
from jaxtyping import Float32, UInt8
from PIL import Image

from tumble.io import limits
from tumble.io.errors import BadFile, WriteError

T = TypeVar("T")
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP")
"""Formats of 8-bit images that are read; others that Pillow knows are rare, and some of them run programs."""
EXR_CHANNELS = (("R", "G", "B"), ("Y",), ("V",))
"""Channels of an OpenEXR file that are read: the first of these sets that it has."""
PARTIAL_PREFIX = ".partial-"
"""Start of the name of an incomplete file or folder; the number of the writing process follows."""


def path_inside(root: Path, name: str) -> Path:
    """Path of the file `name` in the folder `root`.

    Raises:
        BadFile: The name points outside the folder (an absolute path, `..`, or a link), or no file can have it.
    """
    path = root / name
    try:
        inside = not Path(name).is_absolute() and path.resolve().is_relative_to(root.resolve())
        path.exists()
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a zero byte, a name that is too long
        raise BadFile(root, f"the path {name[:80]!r} cannot be opened: {_first_line(error)}") from None
    if inside:
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
        fix = f"{advice}then run the same command again; a run continues from the last saved state"
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


def sha256(path: Path) -> str:
    """SHA-256 of the content of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def partial_folder(parent: Path) -> Iterator[Path]:
    """A temporary folder in a folder, which is created if it is missing.

    Raises:
        WriteError: It cannot be made.
    """
    with describe_write_errors(parent):
        parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(prefix=partial_prefix(), dir=parent)
    with folder as name:
        yield Path(name)


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


def read_json(path: Path, kind: type[T] | Any = Any, fix: str = "") -> T:
    """The JSON document in a file, as `kind`: a record of msgspec, a dict or list of them, or any type that it knows.

    Keys that a record does not have are ignored.

    Args:
        fix: What the user should do about a damaged document that a command wrote, for the error message.

    Raises:
        BadFile: The file is missing, too large, no valid JSON, or does not match `kind`; the message names the key.
    """
    limits.require_file(path, limits.MAX_DOCUMENT_BYTES)
    return parse_json(path, path.read_bytes(), kind, fix)


def parse_json(path: Path, content: bytes | str, kind: type[T] | Any = Any, fix: str = "") -> T:
    """A JSON document that was read from `path`, as `kind`; see `read_json`.

    Raises:
        BadFile: The document is no valid JSON, or does not match `kind`; the message names the key.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        raise BadFile(path, violated_rule(error), fix) from None
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        reason = str(error).removeprefix("JSON is malformed: ")
        fix = fix or "JSON has no NaN, no Infinity, no comments"
        raise BadFile(path, f"is not valid JSON: {reason}", fix) from None


def violated_rule(error: msgspec.ValidationError) -> str:
    """The rule that a document violates, with the key, from an error of msgspec."""
    rule, _, place = str(error).replace("`", "").partition(" - at ")
    key = place.removesuffix(" in $").removeprefix("$").removeprefix(".")
    return (f'"{key}": ' if key else "") + rule[:1].lower() + rule[1:]


def write_json(path: Path, document: Any) -> None:
    """Write an indented JSON document; NaN and infinities, which JSON does not define, become null.

    Raises:
        BadFile: The document names a file whose name is not valid UTF-8, as JSON is.
        WriteError: See `write_atomically`.
    """
    text = json.dumps(_without_nan(document), indent=1, allow_nan=False, ensure_ascii=False)
    try:
        content = text.encode()
    except UnicodeEncodeError as error:  # Python represents other bytes of file names by halves of characters
        name = text[max(0, error.start - 20) : error.end + 20]
        raise BadFile(path, f"would name a file whose name is not valid UTF-8: ...{name}...", "rename it") from None
    write_atomically(path, lambda partial: partial.write_bytes(content + b"\n"))


def image_size(path: Path) -> tuple[int, int]:
    """Height and width of an 8-bit image [pixels], read without decoding it."""
    with open_image(path) as image:
        return image.height, image.width


def read_image(path: Path) -> UInt8[np.ndarray, "h w c"]:
    """Code values of an 8-bit PNG or JPEG: 1, 3 or 4 channels as stored (a palette becomes RGB or RGBA).

    Raises:
        BadFile: The file is missing, is not an 8-bit image, is damaged, or exceeds a limit of `limits`.
    """
    with open_image(path) as image:
        if image.mode in ("I", "F") or image.mode.startswith("I;16"):
            raise BadFile(path, f"has pixels of type {image.mode}, not 8-bit ones", "convert it to 8-bit sRGB")
        mode = {"L": "L", "1": "L", "RGB": "RGB", "RGBA": "RGBA", "LA": "RGBA"}.get(image.mode)
        if mode is None:
            mode = "RGBA" if "transparency" in image.info else "RGB"
        with image_errors(path, "cannot be decoded"):
            values = np.asarray(image.convert(mode))
    return values if values.ndim == 3 else values[..., None]


def open_image(path: Path) -> Image.Image:
    """Open an image without decoding its pixels; its size is within the limits.

    Raises:
        BadFile: The file is missing, is not an image, or exceeds a limit of `limits`.
    """
    limits.require_file(path)
    with image_errors(path, "is not an image"):
        image = Image.open(path, formats=IMAGE_FORMATS)
    limits.require_image_size(path, image.width, image.height, 4)
    return image


@contextlib.contextmanager
def image_errors(path: Path, rule: str) -> Iterator[None]:
    """Context in which the exceptions of Pillow's parsers, which are of many types, become a `BadFile`."""
    try:
        with warnings.catch_warnings():
            # Pillow warns of large images, which the limits refuse, and of damaged metadata.
            warnings.simplefilter("ignore")
            yield
    except BadFile:
        raise
    except (OSError, ValueError, SyntaxError, LookupError, TypeError, OverflowError, struct.error, zlib.error) as error:
        raise BadFile(path, f"{rule}: {_first_line(error)}") from None
    except Image.DecompressionBombError as error:
        raise BadFile(path, f"is over the limit of {limits.MAX_PIXELS} pixels: {error}") from None


def write_png(path: Path, values: UInt8[np.ndarray, "h w c"]) -> None:
    """Write code values as a PNG with 1, 3 or 4 channels."""
    image = Image.fromarray(values[..., 0] if values.shape[2] == 1 else values)
    write_atomically(path, lambda partial: image.save(partial, "PNG"))


def read_radiance(path: Path) -> Float32[np.ndarray, "h w c"]:
    """Linear float pixels of an OpenEXR (.exr) or Radiance (.hdr) file with 1 or 3 channels.

    Raises:
        BadFile: The file is missing, of another format, damaged, too large, or holds NaN or infinity.
    """
    limits.require_file(path)
    readers = {".exr": _read_exr, ".hdr": _read_hdr}
    if path.suffix.lower() not in readers:
        raise BadFile(path, f"has the ending {path.suffix!r}, not .exr or .hdr")
    with _hidden_library_messages():
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


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0][:200]


@contextlib.contextmanager
def _hidden_library_messages() -> Iterator[None]:
    """Context in which nothing is printed, where OpenEXR and OpenCV report what becomes a `BadFile`."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _read_exr(path: Path) -> np.ndarray:
    try:
        _require_exr_size(path, OpenEXR.File(str(path), header_only=True))
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except BadFile:
        raise
    except (RuntimeError, OSError, LookupError, ValueError, TypeError, AttributeError) as error:
        raise BadFile(path, f"is not an OpenEXR file: {_first_line(error)}") from None
    names = next((names for names in EXR_CHANNELS if set(names) <= set(channels)), None)
    if names is None:
        raise BadFile(path, f"has the channels {', '.join(sorted(channels))[:80]}, not R, G, B or Y")
    planes = [channels[name].pixels for name in names]
    del channels  # the others are not needed
    if any(plane.ndim != 2 or plane.shape != planes[0].shape for plane in planes):
        raise BadFile(path, f"has channels {', '.join(names)} of different sizes")
    values = np.empty((*planes[0].shape, len(names)), np.float32)
    for i in range(len(names)):
        values[..., i] = planes.pop(0)
    return values


def _require_exr_size(path: Path, file: OpenEXR.File) -> None:
    """Check the stated sizes of all parts of an OpenEXR file with all their channels, and of their tiles."""
    total = 0
    for part in file.parts:
        if part.type() not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise BadFile(path, "is a deep image", "save it as a flat image")
        low, high = part.header["dataWindow"]
        width, height = (int(last) - int(first) + 1 for first, last in zip(low, high, strict=True))
        pixel = 4 * len(part.header["channels"])
        limits.require_image_size(path, width, height, pixel)
        if "tiles" in part.header:
            limits.require_image_size(path, part.header["tiles"].xSize, part.header["tiles"].ySize, pixel)
        total += width * height * pixel
    limits.require_bytes(path, total, f"{len(file.parts)} parts")


def _read_hdr(path: Path) -> np.ndarray:
    height, width = _hdr_size(path)
    limits.require_image_size(path, width, height, 12)
    try:
        values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise BadFile(path, f"is not a Radiance HDR file: {_first_line(error)}") from None
    if values is None or values.dtype != np.float32 or values.ndim != 3:
        raise BadFile(path, "is not a Radiance HDR file")
    return cv2.cvtColor(values, cv2.COLOR_BGR2RGB, dst=values)


def _hdr_size(path: Path) -> tuple[int, int]:
    """Height and width from the resolution line at the end of a Radiance header."""
    with path.open("rb") as file:
        if not file.readline(64).startswith((b"#?RADIANCE", b"#?RGBE")):
            raise BadFile(path, "is not a Radiance HDR file")
        for _ in range(64):
            words = file.readline(512).split()
            digits = [word for word in words[1::2] if word.isdigit() and len(word) < 10]
            if len(words) == 4 and words[0] == b"-Y" and words[2] == b"+X" and len(digits) == 2:
                return int(words[1]), int(words[3])
    raise BadFile(path, "has no resolution line of the form -Y height +X width")


def _without_nan(document: Any) -> Any:
    if isinstance(document, dict):
        return {key: _without_nan(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [_without_nan(value) for value in document]
    return None if isinstance(document, float) and not math.isfinite(document) else document
