"""Pictures: as a frame and as a mask of a capture, and as the first of a folder of images."""

import os
import struct
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from tests.hostile.cases import RUN, SIDE, Case, Content, capture, cut, flipped, png, put


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG with its checksum."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def stated(width: int, height: int, depth: int = 8, colour: int = 2, *, before: bytes = b"", pixels: int = 64) -> bytes:
    """A PNG with any header, whose pixels are zeros."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + before + chunk(b"IDAT", zlib.compress(bytes(pixels))) + chunk(b"IEND", b"")


def with_zeros(kind: bytes) -> bytes:
    """A PNG with a compressed chunk of 100 MiB."""
    return stated(SIDE, SIDE, before=chunk(kind, b"a\0\0" + zlib.compress(bytes(100 << 20))))


def contents() -> dict[str, Content]:
    """Files that are no picture of the right size, by name."""
    rng = np.random.default_rng(1)
    whole = rng.integers(0, 255, (SIDE, SIDE, 3), dtype=np.uint8)
    valid, jpeg, tiff, webp, bmp, gif = (png(whole, kind) for kind in ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF"))
    files = {"JPEG": jpeg, "TIFF": tiff, "WebP": webp, "BMP": bmp}
    sizes = (60_000, 60_000), (1 << 31, 1), (1 << 30, 1 << 30), (0, 9), (1 << 20, 60)
    start_of_frame = jpeg.index(b"\xff\xc0") + 5
    return {
        **{"empty": b"", "text": b"not a picture", "zeros": bytes(5000), "a signature": valid[:8], "a GIF": gif},
        **{f"a PNG cut at {part}": cut(valid, part) for part in (0.05, 0.5, 0.9)},
        **{f"a {name} cut": cut(file, 0.6) for name, file in files.items()},
        **{f"a PNG with byte {i} flipped": flipped(valid, i) for i in (1, 12, 17, 24, 25, 26, 60)},
        **{f"{w} x {h} stated": stated(w, h) for w, h in sizes},
        "8000 x 9000 zeros": partial(stated, 8000, 9000, pixels=9000 * 24_001),
        "a JPEG of 65535 x 65535": jpeg[:start_of_frame] + b"\xff\xff\xff\xff" + jpeg[start_of_frame + 4 :],
        "16 bits": png(np.zeros((SIDE, SIDE), np.uint16)),
        "floats": png(np.zeros((SIDE, SIDE), np.float32), "TIFF"),
        "an unknown colour type": stated(SIDE, SIDE, 8, 5),
        "a palette without colours": stated(SIDE, SIDE, 8, 3),
        "100 MiB of text": partial(with_zeros, b"zTXt"),
        "a profile of 100 MiB": partial(with_zeros, b"iCCP"),
        "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n(/etc/passwd) (r) file\n",
        "another size": png(whole[:-3]),
    }  # fmt: skip


def special(folder: Path, name: str, kind: str) -> None:
    """A capture in which a picture is no regular file."""
    put(folder, capture())
    path = folder / "in" / name
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as file:
            file.truncate(1 << 40)


def cases() -> Iterator[Case]:
    """All cases of this family."""
    bare = {name: content for name, content in capture().items() if "transforms" not in name}
    for name, content in contents().items():
        for place in ("images/0000.png", "masks/0003.png"):
            write = partial(put, contents={**capture(), f"in/{place}": content})
            yield Case(f"{place} is {name}", write, RUN, "in/(images|masks)/000.", large=callable(content))
        write = partial(put, contents={**bare, "in/images/0000.png": content})
        yield Case(f"the first image is {name}", write, RUN, "in/(images|masks)/000.", large=callable(content))
    for kind in ("folder", "pipe", "device", "terabyte"):
        for place in ("images/0000.png", "masks/0000.png"):
            yield Case(f"{place} is a {kind}", partial(special, name=place, kind=kind), RUN, r"in[:/]")
