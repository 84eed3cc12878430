"""Environment maps: OpenEXR and Radiance HDR."""

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import OpenEXR

from tests.hostile.cases import Case, Content, cut, flipped, put
from tests.hostile.models import box


def exr(
    height: int = 8, width: int = 16, channels: tuple[str, ...] = ("R", "G", "B"), value: float = 0.5, **header: Any
) -> bytes:
    """An OpenEXR file with one value everywhere."""
    head = {"compression": OpenEXR.RLE_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    planes = {name: np.full((height, width), value, np.float32) for name in channels}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.exr"
        OpenEXR.File(head, planes).write(str(path))
        return path.read_bytes()


def tiled(side: int) -> bytes:
    """An OpenEXR file whose stated tiles have any size."""
    description = OpenEXR.TileDescription()
    description.xSize = description.ySize = 16
    content = exr(type=OpenEXR.tiledimage, tiles=description)
    place = content.index(b"tiledesc\0") + 9 + 4
    return content[:place] + side.to_bytes(4, "little") * 2 + content[place + 8 :]


def windowed(*window: int, channels: tuple[str, ...] = ("R", "G", "B")) -> bytes:
    """An OpenEXR file with any stated data window: x and y of the first and of the last pixel."""
    content = exr(channels=channels)
    place = content.index(b"dataWindow\0box2i\0") + 17 + 4
    values = b"".join(value.to_bytes(4, "little", signed=True) for value in window)
    return content[:place] + values + content[place + 16 :]


def hdr(size: bytes = b"-Y 8 +X 16", pixels: bytes = bytes([100, 100, 100, 128]) * 128) -> bytes:
    """A Radiance file without compression."""
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size + b"\n" + pixels


def contents() -> dict[str, Content]:
    """Files that are no environment map, by name with the right ending."""
    valid = exr()
    header = valid.index(b"screenWindowWidth")
    found: dict[str, Content] = {
        **{"empty.exr": b"", "text.exr": b"v/1", "zeros.exr": bytes(3000), "magic.exr": valid[:8]},
        **{f"cut at {part}.exr": cut(valid, part) for part in (0.1, 0.3, 0.6, 0.95)},
        **{f"byte {i} flipped.exr": flipped(valid, i) for i in (0, 4, 5, 16, 20, 24, header // 3, header // 2)},
        "19 channels.exr": partial(exr, 2048, 4096, ("R", "G", "B", *(f"c{i}" for i in range(16)))),
        "1003 channels.exr": windowed(0, 0, 1023, 511, channels=("R", "G", "B", *(f"c{i}" for i in range(1000)))),
        "8k x 8k.exr": partial(exr, 8192, 8191),
        "not 2 to 1.exr": exr(8, 17),
        "one channel.exr": exr(channels=("Y",)),
        "other channels.exr": exr(channels=("A", "Z")),
        "infinite.exr": exr(value=math.inf),
        "not a number.exr": exr(value=math.nan),
        "negative.exr": exr(value=-1.0),
        "tiles of 2^30.exr": tiled(1 << 30),
        "tiles of 60000.exr": tiled(60_000),
        "tiles of 0.exr": tiled(0),
        "a window of 2^31.exr": windowed(-(1 << 30), 0, (1 << 30) - 1, 0),
        "a window of 10^10 pixels.exr": windowed(0, 0, 99_999, 99_999),
        "an inverted window.exr": windowed(15, 7, 0, 0),
        **{"empty.hdr": b"", "text.hdr": b"#?RADIANCE", "zeros.hdr": bytes(3000), "no size.hdr": hdr(b"")},
        "4000000 wide.hdr": hdr(b"-Y 16 +X 4000000"),
        "4000000 wide and whole.hdr": partial(hdr, b"-Y 1 +X 4000000", bytes(16_000_000)),
        "100000 x 200000.hdr": hdr(b"-Y 100000 +X 200000"),
        "8k x 8k.hdr": hdr(b"-Y 8192 +X 8190"),
        "no pixels.hdr": hdr(b"-Y 0 +X 0"),
        "a negative size.hdr": hdr(b"-Y -8 +X -16"),
        "a size of words.hdr": hdr(b"-Y eight +X sixteen"),
        "a size of 5000 digits.hdr": hdr(b"-Y " + b"9" * 5000 + b" +X 16"),
        "a size of 400 digits.hdr": hdr(b"-Y " + b"9" * 400 + b" +X 16"),
        "turned.hdr": hdr(b"+X 16 -Y 8"),
        "not 2 to 1.hdr": hdr(b"-Y 16 +X 8"),
        "cut.hdr": cut(hdr(), 0.5),
        "cut and large.hdr": hdr(b"-Y 4000 +X 8000"),
        "a damaged run.hdr": hdr(pixels=b"\x02\x02\x00\x10" + bytes([255]) * 400),
        "a long header.hdr": b"#?RADIANCE\n" + b"A=1\n" * 100_000,
    }
    return found | {"an EXR.hdr": valid, "an HDR.exr": hdr(), "a picture.png": b"\x89PNG"}


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for name, content in contents().items():
        file = f"light{Path(name).suffix}"
        write = partial(put, contents={"box.glb": box(), file: content})
        words = ["synth", "box.glb", "--env", file, "-o", "out"]
        yield Case(name, write, words, rf"{file}: ", large=callable(content))
