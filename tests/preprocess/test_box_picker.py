"""The page that asks for a box: what is drawn on it is what comes back, and nothing else is taken for an answer."""

import json
import queue
import re
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests import devtools
from tests.films import scene, written
from tumble import cli, pipeline
from tumble.io import files
from tumble.io.files import BadFile
from tumble.preprocess import box_picker
from tumble.preprocess.footage import FootageFrame
from tumble.preprocess.options import FootageOptions

FRAME = FootageFrame(7, 0.0, np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8), None)


@dataclass
class Asked:
    """A question that waits in a thread."""

    said: queue.Queue = field(default_factory=queue.Queue)
    boxes: list = field(default_factory=list)

    def address(self) -> str:
        return re.findall(r"http://127\.0\.0\.1:\d+/[\w-]+/", self.said.get(timeout=20))[0]


@contextmanager
def asking(frame: FootageFrame = FRAME) -> Iterator[Asked]:
    asked = Asked()
    thread = threading.Thread(target=lambda: asked.boxes.append(box_picker.ask(frame, asked.said.put)), daemon=True)
    thread.start()
    yield asked
    thread.join(20)
    assert not thread.is_alive(), "nobody answered"


def post(address: str, content: bytes) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(address + "box", content)) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_a_box_is_what_the_page_sends_and_ends_the_question() -> None:
    with asking() as asked:
        address = asked.address()
        page = urllib.request.urlopen(address).read().decode()
        assert "Frame 7" in page
        assert "{{" not in page
        assert post(address, b"[12, 5, 100, 80]") == 200
    assert asked.boxes == [(12, 5, 100, 80)]
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)


def test_nothing_else_is_an_answer() -> None:
    """The picture has 160 x 90 pixels."""
    wrong = [[-1, 0, 5, 5], [0, 0, 161, 5], [100, 0, 61, 5], [0, 80, 5, 11], [0, 0, 1, 5], [0, 0, 5], [0, 0, 5.5, 5], 3]
    with asking() as asked:
        address = asked.address()
        for content in (*(json.dumps(values).encode() for values in wrong), b"", b"\xff", b"[true, 0, 5, 5]"):
            assert post(address, content) == 400, content
        assert post(address, b" " * 300 + b"[0, 0, 5, 5]") == 404
        # Another page cannot know the word.
        assert post(re.sub(r"/[\w-]+/$", "/guess/", address), b"[0, 0, 5, 5]") == 404
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(re.sub(r"/[\w-]+/$", "/", address))
        assert asked.boxes == []
        assert post(address, b"[0, 0, 160, 90]") == 200
    assert asked.boxes == [(0, 0, 160, 90)]


@pytest.mark.slow
@pytest.mark.skipif(devtools.browser() is None, reason="needs Chromium")
@pytest.mark.parametrize("how", ["drag", "two clicks"])
def test_a_box_is_drawn_with_the_mouse(how: str, tmp_path: Path) -> None:
    """A picture larger than the window, so that it is shown smaller than it is."""
    large = replace(FRAME, picture=cv2.resize(FRAME.picture, (3200, 1800)))
    with asking(large) as asked, devtools.opened(asked.address(), tmp_path, 800, 600) as page:
        page.until("document.getElementById('frame').complete")
        left, top, scale = page.value(
            "(() => { const r = document.getElementById('frame').getBoundingClientRect();"
            " return [r.left, r.top, r.width / 3200]; })()"
        )
        assert scale < 0.3

        def mouse(kind: str, x: int, y: int) -> None:
            at = {"x": left + scale * x, "y": top + scale * y}
            page.call("Input.dispatchMouseEvent", type=kind, **at, button="left", buttons=1, clickCount=1)

        corners = [(2000, 1500), (800, 400)]
        mouse("mousePressed", *corners[0])
        if how == "two clicks":
            mouse("mouseReleased", *corners[0])
        mouse("mouseMoved", 1500, 900)
        mouse("mouseMoved", *corners[1])
        if how == "two clicks":
            mouse("mousePressed", *corners[1])
        mouse("mouseReleased", *corners[1])
        page.value("document.getElementById('use').click()")
    # Corners in either order; outwards to whole pixels.
    np.testing.assert_allclose(asked.boxes[0], (800, 400, 1200, 1100), atol=2)


# What is asked about --------------------------------------------------------------------------------------------------


def film(tmp_path: Path) -> Path:
    """Blurred but for frames 3 and 9."""
    pictures = [p if i in (3, 9) else cv2.GaussianBlur(p, (0, 0), 2.0) for i, p in enumerate(scene().pictures)]
    pictures[9] = pictures[9] // 2
    return written(np.stack(pictures), tmp_path / "x.mp4")


@pytest.mark.parametrize(("at", "shown"), [(0, 3), (12, 12)])
def test_the_first_sharp_frame_is_shown_or_the_one_that_is_named(at: int, shown: int, tmp_path: Path) -> None:
    frame = box_picker.sharp_frame(film(tmp_path), FootageOptions(at=at, focal=300.0))
    assert frame.number == shown
    with pytest.raises(BadFile, match="has no frame 99"):
        box_picker.sharp_frame(film(tmp_path), FootageOptions(at=99, focal=300.0))


def test_the_frame_is_shown_as_the_pinhole_camera_sees_it(tmp_path: Path) -> None:
    """A box is in pixels of the straightened film."""
    bent = box_picker.sharp_frame(film(tmp_path), FootageOptions(at=3, focal=300.0, distortion=(0.5, 0.0, 0.0, 0.0)))
    straight = box_picker.sharp_frame(film(tmp_path), FootageOptions(at=3, focal=300.0))
    assert np.abs(bent.picture.astype(int) - straight.picture).mean() > 1


def test_a_run_asks_once_and_then_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    path, box = film(tmp_path), scene().box(3)
    asked = []
    monkeypatch.setattr(box_picker, "ask", lambda frame, tell: asked.append(frame.number) or box)
    options = box_picker.pick_box(path, FootageOptions(focal=300.0), tmp_path / "run" / "capture")
    assert (options.box, options.at) == (box, 3)
    assert capsys.readouterr().out == f"--box {' '.join(map(str, box))} --at 3\n"
    pipeline.ingested(path, tmp_path / "run", options)
    again = box_picker.pick_box(path, FootageOptions(focal=300.0), tmp_path / "run" / "capture")
    assert again == options
    assert asked == [3]
    # The same as the words that were said.
    assert pipeline.ingested(path, tmp_path / "run", again) == tmp_path / "run" / "capture"


def test_where_masks_or_hints_are_nobody_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(ValueError, match="--pick asks for what"):
        box_picker.pick_box(tmp_path, FootageOptions(box=(0, 0, 9, 9)), tmp_path)
    files.write_png(tmp_path / "c" / "images" / "0.png", scene().pictures[0])
    files.write_png(tmp_path / "c" / "masks" / "0.png", scene().object[0][..., None] * np.uint8(255))
    with pytest.raises(BadFile, match="has masks"):
        box_picker.pick_box(tmp_path / "c", FootageOptions(), tmp_path / "none")
    monkeypatch.setattr("sys.argv", ["tumble", "check", str(tmp_path / "nowhere"), "--pick"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1
    assert "is no film" in capsys.readouterr().err
