"""Reading and writing videos through PyAV: writes H.264, reads all that FFmpeg decodes (H.264, HEVC, VP9, AV1, ...).

A frame is *upright* when it is rotated by the rotation tag of the video, which phones write instead of rotating pixels.
Frames have timestamps instead of a frame rate because phones record with a variable one.
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
"""Frame rate of written videos, and of frames without a timestamp [1 / s]."""
BT709 = 1
"""Code point of the BT.709 colour matrix, primaries and transfer curve (ITU-T H.273)."""
UNSPECIFIED = 2
"""Code point of an unspecified colour matrix (ITU-T H.273)."""
LIMITED_RANGE = 1
"""FFmpeg's number of the limited code range (16 to 235 for luma)."""
HDR_CURVES = {16: "PQ", 18: "HLG"}
"""Code points of HDR transfer curves (ITU-T H.273), whose code values are not sRGB."""
HD_HEIGHT = 720
"""Frame height [pixels] from which an unspecified colour matrix means BT.709, else BT.601, as in video players."""
CLIP_FORMATS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""FFmpeg's names of the containers that are written, by extension."""
MIN_DECODED_FRACTION = 0.9
"""Minimum fraction of announced frames in a complete video; edit lists hide a few frames of complete videos."""


@dataclass(frozen=True)
class VideoHeader:
    """The header of a video."""

    n_frames: int
    """Announced number of frames; 0 when the container does not hold it."""
    width: int
    """Width of the stored frames, before rotation to upright [pixels]."""
    height: int
    """Height of the stored frames, before rotation to upright [pixels]."""
    codec: str
    """FFmpeg's name of the codec."""
    hdr: str | None
    """"PQ" or "HLG" for HDR videos, whose code values are not sRGB; else None."""
    tags: dict[str, str]
    """Text metadata of the container and the stream, such as the lens."""


def write_clip(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], *, quality: int = 14) -> None:
    """Write sRGB code values as an H.264 video in the most compatible format (yuv420p, BT.709).

    Args:
        path: File to write, with an extension of `CLIP_FORMATS`.
        frames: Frames of even height and width.
        quality: Constant rate factor: 0 is lossless, 14 has no visible artefacts, 28 is a small preview.
    """

    def write(partial: Path) -> None:
        with av.open(str(partial), "w", format=CLIP_FORMATS[path.suffix.lower()]) as container:
            stream = None
            for values in frames:
                if stream is None:
                    stream = container.add_stream("libx264", rate=FPS, options={"crf": str(quality), "threads": "1"})
                    stream.height, stream.width = values.shape[:2]
                    stream.pix_fmt = "yuv420p"
                    codec = stream.codec_context
                    codec.colorspace, codec.color_primaries, codec.color_trc = BT709, BT709, BT709
                    codec.color_range = LIMITED_RANGE
                frame = VideoFrame.from_ndarray(np.ascontiguousarray(values), "rgb24")
                container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)))
            if stream is not None:
                container.mux(stream.encode())

    files.write_atomically(path, write)


def read_clip(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Upright frames of a video as sRGB code values, in order of presentation.

    Raises:
        BadFile: See `timed_frames`.
    """
    for _, values in timed_frames(path):
        yield values


def timed_frames(path: Path) -> Iterator[tuple[float, UInt8[np.ndarray, "h w 3"]]]:
    """Time [s] and upright sRGB code values of every frame, in order of presentation.

    Raises:
        BadFile: The file is missing, is not a video, is truncated, or its frames have more than `files.MAX_PIXELS`.
    """
    announced = probe(path).n_frames
    number = 0
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield frame.time if frame.time is not None else number / FPS, _upright(path, frame)
                number += 1
    except av.error.FFmpegError as error:
        fix = "copy it again from the camera, or cut off the damaged part: ffmpeg -i IN -t SECONDS -c copy OUT"
        raise BadFile(path, f"cannot be decoded after frame {number}: {error}", fix) from None
    if number == 0:
        raise BadFile(path, "is a video without frames")
    if number < MIN_DECODED_FRACTION * announced:
        raise BadFile(path, f"is truncated: it holds {number} of {announced} frames", "copy it again from the camera")


def probe(path: Path) -> VideoHeader:
    """The header of a video, read without decoding frames.

    Raises:
        BadFile: The file is missing, or is not a video.
    """
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise BadFile(path, "has no video stream", "it is an audio file or truncated: copy it again")
            stream = container.streams.video[0]
            codec = stream.codec_context
            hdr = HDR_CURVES.get(int(codec.color_trc))
            tags = {**container.metadata, **stream.metadata}
            return VideoHeader(stream.frames, codec.width, codec.height, codec.name, hdr, tags)
    except av.error.FFmpegError as error:
        raise BadFile(path, f"is not a readable video: {error}", "tumble reads mp4, mov, mkv, webm") from None


def _upright(path: Path, frame: VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB code values of a decoded frame, rotated to upright."""
    if frame.width * frame.height > files.MAX_PIXELS:
        raise BadFile(path, f"has {frame.width} x {frame.height} pixels, over the limit of {files.MAX_PIXELS}")
    assumed = Colorspace.ITU709 if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT else None
    values = frame.reformat(format="rgb24", src_colorspace=assumed).to_ndarray()
    # Both the rotation tag and rot90 count counter-clockwise.
    return np.ascontiguousarray(np.rot90(values, round(frame.rotation / 90)))
