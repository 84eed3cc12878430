"""Films in and out: H.264 through PyAV."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import av
import av.error
import numpy as np
from jaxtyping import UInt8

from tumble import files
from tumble.files import BadFile

FPS = 30


def write_clip(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], *, quality: int = 14) -> None:
    """sRGB code values as an H.264 film that every player shows (yuv420p, BT.709); height and width are even.

    Args:
        quality: Constant rate factor: 0 is lossless, 14 leaves no visible trace, 28 is a small preview.
    """

    def write(partial: Path) -> None:
        with av.open(str(partial), "w", format="mp4") as film:
            stream = None
            for values in frames:
                if stream is None:
                    stream = film.add_stream("libx264", rate=FPS, options={"crf": str(quality), "threads": "1"})
                    stream.height, stream.width = values.shape[:2]
                    stream.pix_fmt = "yuv420p"
                film.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(values), "rgb24")))
            if stream is not None:
                film.mux(stream.encode())

    files.write_whole(path, write)


def read_clip(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The frames of a film as sRGB code values, in order of presentation.

    Raises:
        BadFile: Missing, not a film, or cut off.
    """
    if not path.is_file():
        raise BadFile(path, "is missing")
    try:
        with av.open(str(path)) as film:
            for frame in film.decode(video=0):
                yield frame.to_ndarray(format="rgb24")
    except (av.error.FFmpegError, IndexError) as error:
        raise BadFile(path, f"is not a readable film: {error}") from None
