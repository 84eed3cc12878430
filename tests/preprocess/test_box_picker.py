"""The page returns the box and the clicks of the user, shows masks that obey them, and refuses all other requests."""

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
from tumble.preprocess.footage import PROVENANCE, FootageFrame
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.picker import box_picker
from tumble.preprocess.picker.box_picker import Marks

NO_REVIEW = box_picker.Review(lambda box: pytest.fail("no masks are needed"), lambda marks: pytest.fail("nor these"))
FRAME = FootageFrame(7, 0.0, np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8), None)


@dataclass
class Request:
    """A request for marks that waits in a thread."""

    outputs: queue.Queue = field(default_factory=queue.Queue)
    marks: list = field(default_factory=list)

    def address(self) -> str:
        return re.findall(r"http://127\.0\.0\.1:\d+/[\w-]+/", self.outputs.get(timeout=20))[0]


@contextmanager
def requested(frame: FootageFrame = FRAME, review: box_picker.Review = NO_REVIEW) -> Iterator[Request]:
    request = Request()
    thread = threading.Thread(
        target=lambda: request.marks.append(box_picker.request_marks(frame, review, request.outputs.put)), daemon=True
    )
    thread.start()
    yield request
    thread.join(20)
    assert not thread.is_alive(), "no marks were sent"


def answered(address: str, content: bytes, name: str = "done") -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address + name, content)) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def post(address: str, content: bytes, name: str = "done") -> int:
    return answered(address, content, name)[0]


def sent(**marks: object) -> bytes:
    """A request of the page."""
    return json.dumps({"box": [12, 5, 100, 80], **marks}).encode()


def test_the_box_sent_by_the_page_is_returned_and_the_server_stops() -> None:
    with requested() as request:
        address = request.address()
        page = urllib.request.urlopen(address).read().decode()
        assert "Frame 7" in page
        assert "{{" not in page
        assert post(address, sent(not_object=[[159, 89, 3]])) == 200
    assert request.marks == [Marks((12, 5, 100, 80), not_object=((159, 89, 3),))]
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)


def test_invalid_requests_are_refused() -> None:
    """The image has 160 x 90 pixels."""
    wrong = [[-1, 0, 5, 5], [0, 0, 161, 5], [100, 0, 61, 5], [0, 80, 5, 11], [0, 0, 1, 5], [0, 0, 5], [0, 0, 5.5, 5], 3]
    with requested() as request:
        address = request.address()
        clicks = [[160, 0, 0]], [[0, 90, 0]], [[-1, 0, 0]], [[0, 0, -1]], [[0, 0]], [[0.5, 0, 0]], [[0, 0, 0]] * 201, 1
        contents = [*(sent(box=values) for values in wrong), *(sent(object=each) for each in clicks), sent(path="/")]
        for content in (*contents, b"", b"\xff", b"{}", b"[1, 2, 5, 5]", sent(box=[True, 0, 5, 5])):
            for name in ("done", "frames", "mask"):
                assert post(address, content, name) == 400, content
        assert post(address, b" " * 17_000 + sent()) == 404
        # Without the token nothing is accepted.
        for name in ("done", "frames", "mask"):
            assert post(re.sub(r"/[\w-]+/$", "/wrong/", address), sent(), name) == 404
        assert post(address, sent(), "../done") == post(address, sent(), "elsewhere") == 404
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(re.sub(r"/[\w-]+/$", "/", address))
        assert request.marks == []
        assert post(address, sent(box=[0, 0, 160, 90])) == 200
    assert request.marks == [Marks((0, 0, 160, 90))]


def test_the_masks_on_the_page_obey_clicks(tmp_path: Path) -> None:
    """A click on the object says that it is something else."""
    path, video = written(scene(8).pictures, tmp_path / "x.mp4"), scene(8)
    frame = box_picker.sharpest_frame(path, FootageOptions(at=3, focal=300.0))
    left, top, width, height = box = video.box(3)
    column, row = left + width // 2, top + height // 2
    with requested(frame, box_picker._review(path, FootageOptions(at=3, focal=300.0))) as request:
        address = request.address()
        code, content = answered(address, sent(box=box), "frames")
        assert (code, json.loads(content)) == (200, list(range(8)))
        shown = []
        for clicks in ([], [[column, row, 6]]):
            code, content = answered(address, sent(box=box, not_object=clicks, frame=6), "mask")
            assert code == 200
            shown.append(np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR), int)[..., ::-1])
        # Unknown pixels are orange; the click made those around it unknown.
        change = shown[1] - shown[0]
        near = change[row - 1 : row + 2, column - 1 : column + 2].mean((0, 1))
        assert near[0] > near[2] + 10
        assert np.abs(change[:10]).max() < 10
        code, content = answered(address, sent(box=box, frame=8), "mask")
        assert (code, content) == (400, b"no such frame: there are 8, counted from 0")
        code, content = answered(address, sent(box=[0, 100, 20, 20]), "frames")
        assert code == 400
        assert b"no object in the box" in content
        assert post(address, sent(box=box, not_object=[[column, row, 6]])) == 200
    assert request.marks[0].not_object == ((column, row, 6),)


@pytest.mark.slow
@pytest.mark.skipif(devtools.browser() is None, reason="needs Chromium")
@pytest.mark.parametrize("how", ["drag", "two clicks"])
def test_a_box_is_drawn_with_the_mouse(how: str, tmp_path: Path) -> None:
    """The image is larger than the window, so it is displayed at a reduced size."""
    large = replace(FRAME, image=cv2.resize(FRAME.image, (3200, 1800)))
    with requested(large) as request, devtools.opened(request.address(), tmp_path, 800, 600) as page:
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
    # The corners may come in either order; the box is rounded outwards to whole pixels.
    np.testing.assert_allclose(request.marks[0].box, (800, 400, 1200, 1100), atol=2)


# Frame and run --------------------------------------------------------------------------------------------------------


def video_of(tmp_path: Path) -> Path:
    """A video that is blurred except for frames 3 and 9."""
    pictures = [p if i in (3, 9) else cv2.GaussianBlur(p, (0, 0), 2.0) for i, p in enumerate(scene().pictures)]
    pictures[9] = pictures[9] // 2
    return written(np.stack(pictures), tmp_path / "x.mp4")


@pytest.mark.parametrize(("at", "number"), [(0, 3), (12, 12)])
def test_the_frame_is_the_sharpest_of_the_first_or_the_given_one(at: int, number: int, tmp_path: Path) -> None:
    frame = box_picker.sharpest_frame(video_of(tmp_path), FootageOptions(at=at, focal=300.0))
    assert frame.number == number
    part = FootageOptions(at=at and 12, focal=300.0, part=(8, 15))
    assert box_picker.sharpest_frame(video_of(tmp_path), part).number == (at or 9)
    with pytest.raises(BadFile, match="has no frame 99"):
        box_picker.sharpest_frame(video_of(tmp_path), FootageOptions(at=99, focal=300.0))


def test_the_frame_is_undistorted(tmp_path: Path) -> None:
    """A box is in pixels of the undistorted video."""
    distorted = box_picker.sharpest_frame(
        video_of(tmp_path), FootageOptions(at=3, focal=300.0, distortion=(0.5, 0.0, 0.0, 0.0))
    )
    original = box_picker.sharpest_frame(video_of(tmp_path), FootageOptions(at=3, focal=300.0))
    assert np.abs(distorted.image.astype(int) - original.image).mean() > 1


def test_a_run_requests_the_box_only_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    path, box = video_of(tmp_path), scene().box(3)
    numbers = []
    marks = Marks(box, object=((box[0] + box[2] // 2, box[1] + box[3] // 2, 7),), not_object=((0, 0, 5), (3, 2, 6)))
    monkeypatch.setattr(box_picker, "request_marks", lambda frame, *_: numbers.append(frame.number) or marks)
    options = box_picker.pick_box(path, FootageOptions(focal=300.0), tmp_path / "run" / "capture")
    assert (options.box, options.at) == (box, 3)
    assert (options.object, options.not_object) == (marks.object, marks.not_object)
    clicks = f"--object {marks.object[0][0]} {marks.object[0][1]} 7 --not-object 0 0 5 --not-object 3 2 6"
    assert capsys.readouterr().out == f"--box {' '.join(map(str, box))} --at 3 {clicks}\n"
    pipeline.capture_of(path, tmp_path / "run", options)
    again = box_picker.pick_box(path, FootageOptions(focal=300.0), tmp_path / "run" / "capture")
    assert again == options
    assert numbers == [3]
    stored = json.loads((tmp_path / "run" / "capture" / PROVENANCE).read_text())["options"]
    assert stored["not_object"] == [[0, 0, 5], [3, 2, 6]]
    with pytest.raises(BadFile, match=r"options.not_object is \[\[0, 0, 5\]"):
        pipeline.capture_of(path, tmp_path / "run", replace(options, not_object=()))
    # The options that were printed select the same capture.
    assert pipeline.capture_of(path, tmp_path / "run", again) == tmp_path / "run" / "capture"


def test_marks_of_a_capture_never_replace_other_marks_of_the_user(tmp_path: Path) -> None:
    """Clicks that the capture was made with may be repeated."""
    path, click = video_of(tmp_path), (20, 30, 4)
    saved = {"box": (1, 2, 30, 40), "at": 3, "object": [click, (9, 9, 9)], "not_object": []}
    record = tmp_path / "run" / "capture" / PROVENANCE
    files.write_json(record, {"options": saved})
    options = box_picker.pick_box(path, FootageOptions(object=(click,)), record.parent)
    assert (options.box, options.object) == ((1, 2, 30, 40), (click, (9, 9, 9)))
    with pytest.raises(BadFile, match="run: holds a capture with other masks"):
        box_picker.pick_box(path, FootageOptions(not_object=(click,)), record.parent)
    files.write_json(record, {"options": saved | {"box": None}})
    with pytest.raises(BadFile, match="run: holds a capture with other masks"):
        box_picker.pick_box(path, FootageOptions(), record.parent)


def test_no_box_is_requested_if_the_object_is_marked_already(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(ValueError, match="--pick cannot be combined"):
        box_picker.pick_box(tmp_path, FootageOptions(box=(0, 0, 9, 9)), tmp_path)
    files.write_png(tmp_path / "c" / "images" / "0.png", scene().pictures[0])
    files.write_png(tmp_path / "c" / "masks" / "0.png", scene().object[0][..., None] * np.uint8(255))
    with pytest.raises(BadFile, match="has masks"):
        box_picker.pick_box(tmp_path / "c", FootageOptions(), tmp_path / "none")
    monkeypatch.setattr("sys.argv", ["tumble", "check", str(tmp_path / "nowhere"), "--pick"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1
    assert "is neither a video nor a folder of images" in capsys.readouterr().err
