"""Limits of what a file may cost to read, in the unit that costs: bytes after decoding.

A file of a few megabytes can state any size, and a compressed one can hold thousands of times its own length. All
readers check the stated sizes against the limits of this file before they decode anything.
"""

from pathlib import Path

from tumble.io.errors import BadFile

MAX_PIXELS = 1 << 26
"""Maximum number of pixels of an image: 64 megapixels."""
MAX_SIDE = 1 << 15
"""Maximum width and height of an image [pixels]; OpenCV's functions end there."""
MAX_DECODED_BYTES = 1 << 29
"""Maximum size of one file after decoding, with all its channels, layers, textures and vertices: 512 MiB. An
environment map of 8k x 4k pixels has 384 MiB."""
MAX_LIGHT_ROWS = 2048
"""Rows of an environment map; larger maps are averaged when they are read. A texel has 0.09 degrees, a sixth of the
sun's diameter, and each operation on a map takes 100 MiB instead of 400."""
MAX_CAPTURE_BYTES = 1 << 32
"""Maximum size of all decoded images and masks of a capture: 4 GiB, or 3400 frames of 640 x 480 pixels."""
MAX_DOCUMENT_BYTES = 1 << 25
"""Maximum size of a JSON document: 32 MiB; ten thousand frames have 6."""
MAX_LOG_BYTES = 1 << 24
"""Size of the part at the end of a run's log that is read: 16 MiB; a run of a day writes 7."""
MAX_MODEL_BYTES = 1 << 30
"""Maximum size of a file of a COLMAP model: 1 GiB; a model of a thousand images has a tenth of it."""


def require_image_size(path: Path, width: int, height: int, bytes_per_pixel: int) -> None:
    """Check the stated size of an image, with all its channels.

    Raises:
        BadFile: The image is empty or exceeds a limit.
    """
    if width < 1 or height < 1 or max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        rule = f"has {width} x {height} pixels, over the limit of {MAX_PIXELS} or of {MAX_SIDE} a side"
        raise BadFile(path, rule, "make the image smaller")
    require_bytes(path, width * height * bytes_per_pixel, f"{width} x {height} pixels of {bytes_per_pixel} bytes")


def require_bytes(path: Path, size: int, what: str, limit: int | None = None) -> None:
    """Check the size of a file after decoding.

    Args:
        size: Stated size [bytes].
        what: What has this size, for the message.
        limit: Maximum size [bytes]. Default: `MAX_DECODED_BYTES`.

    Raises:
        BadFile: The size exceeds the limit.
    """
    limit = MAX_DECODED_BYTES if limit is None else limit
    if size > limit:
        rule = f"holds {what}: {size >> 20} MiB when decoded, over the limit of {limit >> 20} MiB"
        raise BadFile(path, rule, "make it smaller, or leave out channels, layers or textures that are not needed")


def require_file(path: Path, limit: int | None = None) -> None:
    """Check that a path is a file of at most `limit` bytes.

    Raises:
        BadFile: It is missing, something else, or larger.
    """
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")
    if limit is not None and path.stat().st_size > limit:
        raise BadFile(path, f"has {path.stat().st_size} bytes, over the limit of {limit}", "make it smaller")
