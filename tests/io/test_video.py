"""Videos: colours, upright frames, timestamps, codecs, and errors."""

import struct
from fractions import Fraction
from pathlib import Path

import av
import av.codec
import numpy as np
import pytest
from av.video.frame import VideoFrame

from tumble.io import video
from tumble.io.files import BadFile

QUARTERS = np.zeros((64, 96, 3), np.uint8)
QUARTERS[:32, :48], QUARTERS[32:, 48:], QUARTERS[:32, 48:] = (220, 30, 40), (20, 160, 200), (90, 200, 60)
CENTRES = [(16, 24), (16, 72), (48, 24), (48, 72)]


def encode(path: Path, frames: list[np.ndarray], *, codec: str = "libx264", times: list[int] | None = None) -> None:
    """Write a video with PyAV directly; times in milliseconds; the header is at the start of the file."""
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(codec, rate=30, options={"crf": "10"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, 1000)
        stream.codec_context.time_base = Fraction(1, 1000)
        for i, values in enumerate(frames):
            frame = VideoFrame.from_ndarray(values, "rgb24")
            frame.pts, frame.time_base = times[i] if times else 33 * i, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize("height", [64, 736])
def test_colours_are_preserved_at_any_size(tmp_path: Path, height: int) -> None:
    """Decoding BT.709 as BT.601 would shift a saturated red by more than 10 code values; 4:2:0 and rounding by 3."""
    image = np.full((height, 96, 3), (220, 30, 40), np.uint8)
    video.write_clip(tmp_path / "x.mp4", [image, image])
    assert np.abs(next(video.read_clip(tmp_path / "x.mp4")).astype(int) - image).max() <= 3


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_frames_are_rotated_upright(tmp_path: Path, quarter_turns: int) -> None:
    """The matrix of the track header (ISO 14496-12) as phones write it, compared with its action on the corners."""
    path = tmp_path / "ein Handy ü.mp4"
    encode(path, [QUARTERS] * 3)
    data = bytearray(path.read_bytes())
    a, b, c, d = {0: (1, 0, 0, 1), 1: (0, 1, -1, 0), 2: (-1, 0, 0, -1), 3: (0, -1, 1, 0)}[quarter_turns]
    start = data.index(b"tkhd") + 4 + 4 + 20 + 16
    data[start : start + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    # (x, y) goes to (a x + c y, b x + d y): a quarter turn takes the x axis to the y axis, clockwise on a screen.
    expected = np.rot90(QUARTERS, -quarter_turns)
    upright = next(video.read_clip(path))
    assert upright.shape == expected.shape
    for row, column in CENTRES if quarter_turns % 2 == 0 else [(c, r) for r, c in CENTRES]:
        assert np.abs(upright[row, column].astype(int) - expected[row, column]).max() < 25


def test_timestamps_of_a_variable_frame_rate_are_preserved(tmp_path: Path) -> None:
    times = [0, 20, 100, 110, 400]
    encode(tmp_path / "x.mp4", [QUARTERS] * 5, times=times)
    decoded = [time for time, _ in video.timed_frames(tmp_path / "x.mp4")]
    np.testing.assert_allclose(decoded, np.array(times) / 1000, atol=1e-3)


@pytest.mark.skipif("libx265" not in av.codec.codecs_available, reason="this FFmpeg cannot write HEVC")
def test_hevc_is_read(tmp_path: Path) -> None:
    encode(tmp_path / "x.mp4", [QUARTERS] * 4, codec="libx265")
    assert video.probe(tmp_path / "x.mp4").codec == "hevc"
    assert len(list(video.read_clip(tmp_path / "x.mp4"))) == 4


def test_truncated_videos_are_rejected(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    encode(tmp_path / "x.mp4", [rng.integers(0, 256, (64, 96, 3), dtype=np.uint8) for _ in range(30)])
    data = (tmp_path / "x.mp4").read_bytes()
    (tmp_path / "half.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(BadFile, match=r"half\.mp4: .*(truncated|cannot be decoded)"):
        list(video.read_clip(tmp_path / "half.mp4"))
    (tmp_path / "head.mp4").write_bytes(data[:200])
    with pytest.raises(BadFile, match=r"head\.mp4: (is not a readable video|has no video stream)"):
        list(video.read_clip(tmp_path / "head.mp4"))


def test_errors_name_files_that_are_not_videos(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match="is missing"):
        video.probe(tmp_path / "x.mp4")
    with pytest.raises(BadFile, match="is not a file"):
        video.probe(tmp_path)
    (tmp_path / "x.mp4").write_bytes(b"not a video at all" * 100)
    with pytest.raises(BadFile, match="is not a readable video"):
        video.probe(tmp_path / "x.mp4")


def test_frames_over_the_size_limit_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encode(tmp_path / "x.mp4", [QUARTERS])
    monkeypatch.setattr("tumble.io.limits.MAX_PIXELS", 1000)
    with pytest.raises(BadFile, match="96 x 64 pixels, over the limit of 1000"):
        next(video.timed_frames(tmp_path / "x.mp4"))
