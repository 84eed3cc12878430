"""What a hostile case is, and the small valid inputs that the cases spoil."""

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

SIDE, FRAMES = 24, 8
"""Side of the pictures [pixels] and number of frames of the valid inputs."""


@dataclass(frozen=True)
class Case:
    """One input that the package must refuse."""

    name: str
    write: Callable[[Path], object]
    """Writes the input into a folder."""
    words: list[str]
    """The command, run inside the folder."""
    says: str
    """Regular expression that the line on stderr must contain: the file, and what is wrong if it is short."""
    code: int = 1
    """Expected exit code: 1, or 2 for options that the command line itself refuses."""
    also: tuple[int, ...] = ()
    """Further admissible exit codes: an input of this kind may also be fine."""
    large: bool = False
    """Whether its input takes a second to make, so that it is no part of the sample."""


RUN = ["run", "in", "-o", "out", "--device", "cpu"]
"""The command that reconstructs the input."""


Content = bytes | Callable[[], bytes]
"""Content of a file, or a function that makes a large one when it is needed."""


def put(folder: Path, contents: Mapping[str, Content]) -> None:
    """Write files by their relative paths."""
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content() if callable(content) else content)


def png(pixels: np.ndarray, kind: str = "PNG", **options: Any) -> bytes:
    """A picture as the bytes of a file."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind, **options)
    return stream.getvalue()


def poses(n: int = FRAMES, distance: float = 4.0) -> np.ndarray:
    """Camera-to-object matrices (OpenGL axes) of a camera that goes around the object, `[n 4 4]`."""
    matrices = np.tile(np.eye(4), (n, 1, 1))
    matrices[:, :3, :3] = Rotation.from_euler("y", np.arange(n)[:, None] * 360 / n, degrees=True).as_matrix()
    matrices[:, :3, 3] = matrices[:, :3, 2] * distance
    return matrices


@cache
def pictures() -> dict[str, bytes]:
    """Image and mask of every frame: a textured disk over black."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    disk = rows**2 + columns**2 < (SIDE / 4) ** 2
    found = {}
    for i in range(FRAMES):
        image = rng.integers(60, 220, (SIDE, SIDE, 3), dtype=np.uint8) * disk[..., None].astype(np.uint8)
        found[f"images/{i:04}.png"] = png(image)
        found[f"masks/{i:04}.png"] = png(np.where(disk, 255, 0).astype(np.uint8))
    return found


def transforms(n: int = FRAMES, *, posed: bool = True) -> dict[str, Any]:
    """A valid transforms.json."""
    frames: list[dict[str, Any]] = [
        {"file_path": f"images/{i:04}.png", "mask_path": f"masks/{i:04}.png", "split": "train"} for i in range(n)
    ]
    if posed:
        frames = [{**frame, "transform_matrix": T.tolist()} for frame, T in zip(frames, poses(n), strict=True)]
    head = {"w": SIDE, "h": SIDE, "fl_x": 40.0, "fl_y": 40.0, "cx": SIDE / 2, "cy": SIDE / 2, "light": "object"}
    return {**head, "frames": frames}


def capture(**changes: bytes) -> dict[str, bytes]:
    """The files of a valid capture in the folder `in`."""
    whole = {"transforms.json": json.dumps(transforms()).encode(), **pictures()}
    return {f"in/{name}": content for name, content in whole.items()}


def cut(content: bytes, fraction: float) -> bytes:
    """The first part of a file."""
    return content[: int(len(content) * fraction)]


def flipped(content: bytes, position: int, mask: int = 0xFF) -> bytes:
    """A file with one byte changed."""
    changed = bytearray(content)
    changed[position % len(content)] ^= mask
    return bytes(changed)
