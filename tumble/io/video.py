"""Reading and writing videos through PyAV: writes H.264, reads all that FFmpeg decodes (H.264, HEVC, VP9, AV1, ...).

A frame is *upright* when it is rotated by the rotation tag of the video, which phones write instead of rotating pixels.
Frames have timestamps instead of a frame rate because phones record with a variable one. The code values of HDR videos
(PQ or HLG with the primaries of BT.2020) are converted to sRGB: the reference white of HDR becomes white, what is
brighter is clipped.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import Colorspace
from jaxtyping import Float32, UInt8, UInt16

from tumble.io import files, limits
from tumble.io.errors import BadFile

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
HLG_WHITE = 0.265
"""Scene light of the reference white in HLG: 75 % of the signal (ITU-R BT.2408)."""
PQ_WHITE = 203.0
"""Luminance of the reference white in PQ [cd/m^2] (ITU-R BT.2408)."""
BT709_FROM_BT2020 = (
    (1.660491, -0.587641, -0.072850),
    (-0.124550, 1.132900, -0.008349),
    (-0.018151, -0.100579, 1.118730),
)
"""Linear RGB with the primaries of BT.709 from that with those of BT.2020 (ITU-R BT.2087)."""
CONTAINERS = "mov,mp4,matroska,webm,avi,mpegts,mpeg,mjpeg,flv,asf,ogg,h264,hevc,ivf,gif,dv"
"""Names of FFmpeg's readers that may open a file; others, such as playlists, refer to further files."""
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
    """"PQ" or "HLG" for HDR videos, whose code values are converted to sRGB; else None."""
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
        with av.open(str(partial.absolute()), "w", format=CLIP_FORMATS[path.suffix.lower()]) as container:
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
        BadFile: The file is missing, is not a video, is truncated, or its frames exceed the limits.
    """
    announced = probe(path)
    number = 0
    try:
        with _open(path) as container:
            for frame in container.decode(video=0):
                yield frame.time if frame.time is not None else number / FPS, _upright(path, frame, announced.hdr)
                number += 1
    except (av.error.FFmpegError, ValueError) as error:
        if isinstance(error, BadFile):
            raise
        fix = "copy it again from the camera, or cut off the damaged part: ffmpeg -i IN -t SECONDS -c copy OUT"
        raise BadFile(path, f"cannot be decoded after frame {number}: {error}", fix) from None
    if number == 0:
        raise BadFile(path, "is a video without frames")
    if number < MIN_DECODED_FRACTION * announced.n_frames:
        raise BadFile(
            path, f"is truncated: it holds {number} of {announced.n_frames} frames", "copy it again from the camera"
        )


def probe(path: Path) -> VideoHeader:
    """The header of a video, read without decoding frames.

    Raises:
        BadFile: The file is missing, or is not a video.
    """
    limits.require_file(path)
    try:
        with _open(path) as container:
            if not container.streams.video:
                raise BadFile(path, "has no video stream", "it is an audio file or truncated: copy it again")
            stream = container.streams.video[0]
            codec = stream.codec_context
            if codec is None:
                raise BadFile(path, "has a video stream of an unknown codec", "convert it to H.264")
            limits.require_image_size(path, codec.width, codec.height, 4)
            hdr = HDR_CURVES.get(int(codec.color_trc))
            tags = {**container.metadata, **stream.metadata}
            return VideoHeader(stream.frames, codec.width, codec.height, codec.name, hdr, tags)
    except av.error.FFmpegError as error:
        raise BadFile(path, f"is not a readable video: {error.strerror}", "tumble reads mp4, mov, mkv, webm") from None


def _open(path: Path) -> InputContainer:
    """Open a video: by its absolute path, because FFmpeg takes `12:30 clip.mp4` for a protocol, and whatever the
    encoding of its tags, which cameras write in Latin-1."""
    options = {"protocol_whitelist": "file", "format_whitelist": CONTAINERS, "max_pixels": str(limits.MAX_PIXELS)}
    return av.open(str(path.absolute()), options=options, metadata_errors="replace")


def _upright(path: Path, frame: VideoFrame, hdr: str | None) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB code values of a decoded frame, rotated to upright."""
    limits.require_image_size(path, frame.width, frame.height, 4)
    if hdr is None:
        assumed = Colorspace.ITU709 if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT else None
        values = frame.reformat(format="rgb24", src_colorspace=assumed).to_ndarray()
    else:
        values = srgb_from_hdr(frame.reformat(format="rgb48le").to_ndarray(), hdr)
    # Both the rotation tag and rot90 count counter-clockwise.
    return np.ascontiguousarray(np.rot90(values, round(frame.rotation / 90)))


def srgb_from_hdr(values: UInt16[np.ndarray, "h w 3"], curve: str) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB code values of 16-bit code values with the curve "PQ" or "HLG" and the primaries of BT.2020."""
    linear = _linear_table(curve)[values] @ np.array(BT709_FROM_BT2020, np.float32).T
    return _srgb_table()[(linear.clip(0, 1) * 65535 + 0.5).astype(np.uint16)]


@cache
def _linear_table(curve: str) -> Float32[np.ndarray, "65536"]:
    """Linear light of all 16-bit code values (ITU-R BT.2100); the reference white is 1."""
    signal = np.linspace(0, 1, 1 << 16)
    if curve == "HLG":
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12) / HLG_WHITE
    else:
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        root = signal ** (1 / m2)
        light = 10000 * ((root - c1).clip(0) / (c2 - c3 * root)) ** (1 / m1) / PQ_WHITE
    return light.astype(np.float32)


@cache
def _srgb_table() -> UInt8[np.ndarray, "65536"]:
    """sRGB code values of linear light in 65535 steps (IEC 61966-2-1)."""
    light = np.linspace(0, 1, 1 << 16)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * encoded + 0.5).astype(np.uint8)
