"""Films in and out through PyAV: H.264 written, whatever FFmpeg decodes read (H.264, HEVC, VP9, AV1, ...).

A frame is *upright*: turned as the film's rotation mark says, which phones write instead of turning pixels. Frames have
times, not a rate: phones film with a variable one.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import av.error
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Colorspace
from jaxtyping import UInt8

from tumble.io import files
from tumble.io.files import BadFile

FPS = 30
BT709, UNSPECIFIED = 1, 2
"""Code points of ITU-T H.273 for colour matrices."""
LIMITED_RANGE = 1
HDR_CURVES = {16: "PQ", 18: "HLG"}
"""Transfer curves of H.273 that are no photograph's: their code values are not sRGB."""
HD_HEIGHT = 720
"""A film that does not name its colour matrix means BT.709 from this height on, BT.601 below, as players take it."""
KEPT_SHARE = 0.9
"""A film that ends before this share of the frames it announces was cut off; edit lists hide a few honestly."""


@dataclass(frozen=True)
class Video:
    """What a film's header says."""

    n_frames: int
    """As announced; 0 when the container does not say."""
    width: int
    """Of the stored frames, before they are turned upright [pixels]."""
    height: int
    """[pixels]"""
    codec: str
    hdr: str | None
    """"PQ" or "HLG" when the code values are not sRGB."""
    tags: dict[str, str]
    """Free text of the container and the stream, e.g. the lens."""


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
                    codec = stream.codec_context
                    codec.colorspace, codec.color_primaries, codec.color_trc = BT709, BT709, BT709
                    codec.color_range = LIMITED_RANGE
                frame = VideoFrame.from_ndarray(np.ascontiguousarray(values), "rgb24")
                film.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)))
            if stream is not None:
                film.mux(stream.encode())

    files.write_whole(path, write)


def read_clip(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The upright frames of a film as sRGB code values, in order of presentation.

    Raises:
        BadFile: Missing, not a film, or cut off.
    """
    for _, values in timed_frames(path):
        yield values


def timed_frames(path: Path) -> Iterator[tuple[float, UInt8[np.ndarray, "h w 3"]]]:
    """Time [s] and upright sRGB code values of every frame, in order of presentation.

    Raises:
        BadFile: Missing, not a film, cut off, or its frames are larger than `files.MAX_PIXELS`.
    """
    announced = probe(path).n_frames
    number = 0
    try:
        with av.open(str(path)) as film:
            for frame in film.decode(video=0):
                yield frame.time if frame.time is not None else number / FPS, _upright(path, frame)
                number += 1
    except av.error.FFmpegError as error:
        fix = "copy it again from the camera, or keep the good part: ffmpeg -i IN -t SECONDS -c copy OUT"
        raise BadFile(path, f"cannot be decoded after frame {number}: {error}", fix) from None
    if number == 0:
        raise BadFile(path, "is a film without frames")
    if number < KEPT_SHARE * announced:
        raise BadFile(path, f"is cut off: it holds {number} of {announced} frames", "copy it again from the camera")


def probe(path: Path) -> Video:
    """What the header of a film says, without decoding it.

    Raises:
        BadFile: Missing, or not a film.
    """
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")
    try:
        with av.open(str(path)) as film:
            if not film.streams.video:
                raise BadFile(path, "has no pictures", "it is a sound file, or it was cut off: copy it again")
            stream = film.streams.video[0]
            codec = stream.codec_context
            hdr = HDR_CURVES.get(int(codec.color_trc))
            tags = {**film.metadata, **stream.metadata}
            return Video(stream.frames, codec.width, codec.height, codec.name, hdr, tags)
    except av.error.FFmpegError as error:
        raise BadFile(path, f"is not a readable film: {error}", "tumble reads mp4, mov, mkv, webm") from None


def _upright(path: Path, frame: VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
    if frame.width * frame.height > files.MAX_PIXELS:
        raise BadFile(path, f"has {frame.width} x {frame.height} pixels, over the limit of {files.MAX_PIXELS}")
    guessed = Colorspace.ITU709 if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT else None
    values = frame.reformat(format="rgb24", src_colorspace=guessed).to_ndarray()
    # The mark says by how much to turn counter-clockwise; so does rot90.
    return np.ascontiguousarray(np.rot90(values, round(frame.rotation / 90)))
