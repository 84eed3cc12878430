"""Films, and options for them that no film fits."""

import io
import struct
import wave
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame

from tests.hostile.cases import Case, cut, flipped, pictures, put

WORDS = ["run", "x.mp4", "-o", "out"]
"""The command that converts a film; in the valid one nothing moves, so that it always ends with a refusal."""
STILL = "shows nothing that moves"
"""The refusal of the valid film."""
N_FLIPPED = 24
"""Number of bytes that are flipped, one per film."""


@cache
def film(side: int = 64, n: int = 8) -> bytes:
    """A valid film of noise that stands still."""
    picture = np.random.default_rng(0).integers(0, 255, (side, side, 3), dtype=np.uint8)
    stream = io.BytesIO()
    with av.open(stream, "w", format="mp4") as container:
        track = container.add_stream("mpeg4", rate=30)
        track.height = track.width = side
        track.pix_fmt = "yuv420p"
        for _ in range(n):
            container.mux(track.encode(VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(track.encode())
    return stream.getvalue()


def sound() -> bytes:
    """A file of sound."""
    stream = io.BytesIO()
    with wave.open(stream, "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(8000)
        file.writeframes(bytes(16000))
    return stream.getvalue()


def patched(place: bytes, offset: int, value: bytes) -> bytes:
    """The film with some bytes after a mark replaced."""
    content = film()
    start = content.index(place) + len(place) + offset
    return content[:start] + value + content[start + len(value) :]


def contents() -> dict[str, bytes]:
    """Files that are no film of a turning object, by name."""
    playlist = b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n"
    positions = np.linspace(0, len(film()) - 1, N_FLIPPED).astype(int)
    return {
        **{"empty": b"", "text": b"a film", "zeros": bytes(5000), "sound": sound(), "a playlist": playlist},
        "a list of files": b"ffconcat version 1.0\nfile /etc/passwd\n",
        "a description of a stream": b"v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n",
        "a picture": pictures()["images/0000.png"],
        "nothing that moves": film(),
        **{f"cut at {part}": cut(film(), part) for part in (0.001, 0.1, 0.5, 0.9, 0.99)},
        **{f"byte {i} flipped": flipped(film(), int(i)) for i in positions},
        "65535 x 65535 stated": patched(b"mp4v", 24, b"\xff" * 4),
        "0 x 0 stated": patched(b"mp4v", 24, bytes(4)),
        "2^32 samples": patched(b"stsz", 8, b"\xff" * 4),
        "2^32 chunks": patched(b"stco", 4, b"\xff" * 4),
        "a box of 2^32 bytes": patched(b"isom", 0, b"") [:28] + b"\xff\xff\xff\xffmdat" + film()[36:],
        "a negative box": struct.pack(">I", 7) + film()[4:],
        "nested boxes": b"".join(struct.pack(">I4s", 8 * (2000 - i), b"moov") for i in range(2000)),
    }  # fmt: skip


def options() -> Iterator[Case]:
    """Options that no film fits."""
    wrong = {
        **{f"--focal {value}": "--focal is out of range" for value in ("inf", "1e-30", "1e30", "nan", "-5", "0")},
        **{f"--fov {value}": "--fov is out of range" for value in ("nan", "inf", "0", "-20", "400")},
        **{f"--distortion {value} 0 0 0": "--fisheye and --distortion" for value in ("nan", "inf", "1e30")},
        "--distortion 0.1": "--distortion takes 4 or 5",
        **{f"--fisheye 0 0 0 {value}": "--fisheye and --distortion" for value in ("nan", "1e30")},
        "--fisheye 0 0 0 0 --distortion 0 0 0 0": "different lens models",
        **{f"--size {value}": "--size 64 to 4096" for value in ("0", "-1", "1000000")},
        **{f"--frames {value}": "--frames must be" for value in ("0", "-1", "1000000")},
        "--box 0 0 1 1": "--box is left, top",
        "--box 5 5 20 20 --click 3 3": "give only one of them",
        **{f"--box {box}": "box" for box in ("-9 0 20 20", "50 50 60 60", "1000000 0 9 9", "0 0 100000 100000")},
        **{f"--click {click}": "click" for click in ("-1 3", "64 64", "100000000 0")},
        **{f"--object {column} 3 0": "the click .* lies outside" for column in ("-1", "64", "100000000")},
        "--not-object 3 64 0": "the click 3 64 lies outside",
        **{f"--box 5 5 20 20 --object 3 3 {at}": "a click is on frame" for at in ("-1", "8", "1000000000")},
        "--object 3 3 0 --masks nowhere": "leave them out, or --masks",
        **{f"--box 5 5 20 20 --at {at}": "at" for at in ("-1", "8", "1000000000")},
        **{f"--part {part}": "--part is the first and the last" for part in ("3 3", "4 2", "-1 5")},
        "--part 1000000000 1000000001": "--part begins with frame 1000000000",
        "--masks nowhere": "nowhere: is missing",
        "--segmenter sam2": "needs --weights",
        "--matcher ../x": "no '../x' in",
    }
    for words, sentence in wrong.items():
        yield Case(words, partial(put, contents={"x.mp4": film()}), [*WORDS, *words.split()], sentence)
    for words in ("--focal long", "--box 1 2 3", "--frames 1e3", "--light room", "--size 100000000000000000000.5"):
        yield Case(words, partial(put, contents={"x.mp4": film()}), [*WORDS, *words.split()], "", code=2)


def special(folder: Path, make: Callable[[Path], object]) -> None:
    make(folder / "x.mp4")


def large(path: Path) -> None:
    """A file of a terabyte that takes no place on the disk."""
    with path.open("wb") as file:
        file.truncate(1 << 40)


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for name, content in contents().items():
        yield Case(name, partial(put, contents={"x.mp4": content}), WORDS, r"x\.mp4: ")
    for name in ("12:30 clip.mp4", "http:x.mp4", "pipe:0", "%d.mp4", "-", "ü\n.mp4", "a'b\".mp4"):
        words = ["run", f"./{name}", "-o", "out"]
        yield Case(f"a film named {name!r}", partial(put, contents={name: film()}), words, STILL)
    makers = {"missing": lambda path: None, "a folder": Path.mkdir, "a link to itself": lambda p: p.symlink_to(p.name)}
    makers |= {"zeros without end": lambda path: path.symlink_to("/dev/zero"), "a terabyte of zeros": large}
    for name, make in makers.items():
        yield Case(f"a film that is {name}", partial(special, make=make), WORDS, r"x\.mp4: ")
    yield from options()
