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


@pytest.mark.parametrize("name", ["12:30 clip.mp4", "http:x.mp4", "a%d.mp4"])
def test_a_name_with_a_colon_is_no_protocol(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    video.write_clip(Path(name), [QUARTERS] * 2)
    assert video.probe(Path(name)).width == 96
    assert len(list(video.read_clip(Path(name)))) == 2


def test_tags_in_any_encoding_are_read(tmp_path: Path) -> None:
    """Cameras write Latin-1 into tags that are UTF-8 by the standard."""
    path = tmp_path / "x.mp4"
    with av.open(str(path), "w", format="mp4") as container:
        container.metadata["title"] = "Caf_"
        stream = container.add_stream("mpeg4", rate=30)
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
        container.mux(stream.encode(VideoFrame.from_ndarray(QUARTERS, "rgb24")))
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes().replace(b"Caf_", "Café".encode("latin-1")))
    assert video.probe(path).tags["title"].startswith("Caf")
    assert len(list(video.read_clip(path))) == 1


@pytest.mark.parametrize("playlist", [b"#EXTM3U\n#EXTINF:9,\nfile:%s\n", b"ffconcat version 1.0\nfile %s\n"])
def test_a_file_that_refers_to_others_is_refused(tmp_path: Path, playlist: bytes) -> None:
    video.write_clip(tmp_path / "secret.mp4", [QUARTERS] * 2)
    (tmp_path / "x.mp4").write_bytes(playlist % b"secret.mp4")
    with pytest.raises(BadFile, match=r"x\.mp4: is not a readable video"):
        list(video.read_clip(tmp_path / "x.mp4"))


# Phones ---------------------------------------------------------------------------------------------------------------


def bt2020(rgb: np.ndarray) -> list[np.ndarray]:
    """Planes Y, Cb and Cr of 10 bits, limited range and 4:2:0, of code values in [0, 1] (ITU-R BT.2100)."""
    y = rgb @ [0.2627, 0.6780, 0.0593]
    cb, cr = (rgb[..., 2] - y) / 1.8814, (rgb[..., 0] - y) / 1.4746
    half = [c.reshape(c.shape[0] // 2, 2, -1, 2).mean((1, 3)) for c in (cb, cr)]
    return [np.round(876 * y + 64), *(np.round(896 * c + 512) for c in half)]


def write_phone_film(path: Path, signal: np.ndarray, curve: int, times: list[int]) -> None:
    """HEVC of 10 bits with the primaries of BT.2020 and a transfer curve, at a variable frame rate."""
    if "libx265" not in av.codec.codecs_available:
        pytest.skip("this FFmpeg cannot write HEVC")
    parameters = f"lossless=1:log-level=none:colorprim=9:transfer={curve}:colormatrix=9:range=limited"
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx265", rate=30, options={"x265-params": parameters})
        stream.height, stream.width = signal.shape[:2]
        stream.pix_fmt, stream.time_base = "yuv420p10le", Fraction(1, 1000)
        codec = stream.codec_context
        codec.time_base, codec.color_primaries, codec.color_trc = Fraction(1, 1000), 9, curve
        codec.colorspace, codec.color_range = 9, 1
        for time in times:
            frame = VideoFrame(signal.shape[1], signal.shape[0], "yuv420p10le")
            for plane, values in zip(frame.planes, bt2020(signal), strict=True):
                rows = np.zeros((plane.height, plane.line_size // 2), "<u2")
                rows[:, : plane.width] = values
                plane.update(rows.tobytes())
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def rotate(path: Path) -> None:
    """Write the tag of a quarter turn clockwise into the track header, as phones held upright do."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 4 + 20 + 16
    data[start : start + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def hlg(light: np.ndarray) -> np.ndarray:
    """The opto-electronic transfer function of HLG (ITU-R BT.2100, table 5)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(light <= 1 / 12, np.sqrt(3 * light), a * np.log(np.maximum(12 * light - b, 1e-9)) + c)


def pq(luminance: np.ndarray) -> np.ndarray:
    """The inverse electro-optical transfer function of PQ, of luminances in cd/m^2 (ITU-R BT.2100, table 4)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    y = (luminance / 10000) ** m1
    return ((c1 + c2 * y) / (1 + c3 * y)) ** m2


@pytest.mark.parametrize(("curve", "name"), [(18, "HLG"), (16, "PQ")])
def test_an_hdr_film_of_a_phone_has_the_colours_of_srgb(tmp_path: Path, curve: int, name: str) -> None:
    """HEVC, 10 bits, a rotation tag, a variable frame rate. Linear colours of BT.709 are converted to those of BT.2020
    with the matrix of ITU-R BT.2087, and encoded with the reference white at 75 % of HLG or at 203 cd/m^2 of PQ."""
    colours = np.zeros((64, 96, 3), np.uint8)
    colours[:32, :48], colours[32:, 48:], colours[:32, 48:], colours[32:, :48] = (
        (200, 120, 90), (90, 160, 200), (230, 230, 230), (40, 60, 30),
    )  # fmt: skip
    values = colours / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    to_bt2020 = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    wide = linear @ np.array(to_bt2020).T
    times = [0, 20, 100, 110]
    write_phone_film(tmp_path / "x.mp4", hlg(0.265 * wide) if name == "HLG" else pq(203 * wide), curve, times)
    rotate(tmp_path / "x.mp4")
    header = video.probe(tmp_path / "x.mp4")
    assert (header.codec, header.hdr) == ("hevc", name)
    frames = list(video.timed_frames(tmp_path / "x.mp4"))
    np.testing.assert_allclose([time for time, _ in frames], np.array(times) / 1000, atol=1e-3)
    upright = np.rot90(colours, -1)
    assert frames[0][1].shape == upright.shape
    for column, row in CENTRES:
        # Ten bits of a curve for 10000 cd/m^2 are steps of one code value; rounding of chroma adds two.
        assert np.abs(frames[2][1][row, column].astype(int) - upright[row, column]).max() <= 4


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
    with pytest.raises(BadFile, match="is not a readable video") as refused:
        video.probe(tmp_path / "x.mp4")
    assert "Errno" not in str(refused.value)
    assert str(refused.value).count("x.mp4") == 1


def test_frames_over_the_size_limit_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encode(tmp_path / "x.mp4", [QUARTERS])
    monkeypatch.setattr("tumble.io.limits.MAX_PIXELS", 1000)
    with pytest.raises(BadFile, match="96 x 64 pixels, over the limit of 1000"):
        next(video.timed_frames(tmp_path / "x.mp4"))
