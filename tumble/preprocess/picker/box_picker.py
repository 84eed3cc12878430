"""Box around the object, drawn by the user in the browser on a local page, and clicks that correct its masks.

The page shows one sharp undistorted frame. After a box is drawn the user may look at the masks of all frames, and click
pixels that show the object, or something else; the server answers with the mask, cut again. All state is in the page:
each request has the box and all clicks. The page's address contains a random token, so that no other page can send
anything; the server stops when the choice is received.
"""

import base64
import re
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from tumble.io import BadFile, files
from tumble.preprocess import footage, segmentation
from tumble.preprocess.clicks import correct_masks
from tumble.preprocess.footage import PROVENANCE, WRONG_PROVENANCE, FootageFrame
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.segmentation import Masks
from tumble.preprocess.source import input_kind
from tumble.preprocess.survey import Survey, lens_of, survey_footage, to_clicks, undistort_frame
from tumble.preprocess.video_to_capture import mask_overlay
from tumble.scene import OBJECT

N_CANDIDATES = 60
"""Number of frames among which the sharpest is selected: the first two seconds."""
MAX_CLICKS = 200
"""Maximum number of clicks of each kind."""
MAX_REQUEST_BYTES = 16_384
"""Maximum size of a request that is read [bytes]."""
EDGE = (90, 90, 90)
"""Border colour of a frame with its mask."""
CONTOUR = (255, 255, 255)
"""Colour of the silhouette."""

Box = tuple[int, int, int, int]
Pixel = tuple[int, int, int]
"""Column, row [pixels of the footage], number of the frame."""


class Marks(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the user marked."""

    box: Box
    object: tuple[Pixel, ...] = ()
    """Clicks on the object."""
    not_object: tuple[Pixel, ...] = ()
    """Clicks on something else."""
    frame: int = 0
    """Index of the frame whose mask is requested, among those with a mask."""


@dataclass(frozen=True)
class Review:
    """Masks for the page."""

    survey: Callable[[Box], Survey]
    """Survey of the footage with masks from a box; takes seconds to minutes."""
    masks: Callable[[Marks], Masks]
    """These masks, corrected by the clicks."""


class _Choice(msgspec.Struct, frozen=True):
    """Box, its frame number and the clicks among the options of `ingest.json`."""

    box: Box | None
    at: int
    object: tuple[Pixel, ...] = ()
    not_object: tuple[Pixel, ...] = ()


class _Marked(msgspec.Struct, frozen=True):
    """The entry of `ingest.json` that holds the user's choice."""

    options: _Choice


def pick_box(
    path: Path, options: FootageOptions, capture: Path, output: Callable[[str], Any] = print
) -> FootageOptions:
    """The options, completed with the user's box, the number of its frame, and clicks; waits for the user.

    Args:
        capture: The capture to which the footage is converted. If it exists and was made from a box and at least the
            clicks of `options`, its box and clicks are used and no page is opened.
        output: Called with the page's address, and then with the options that repeat the choice.

    Raises:
        BadFile: The footage cannot be read, or has masks, or the capture was made without a box or without the clicks.
        ValueError: `options` mark the object already.
    """
    if options.box is not None or options.click is not None or options.masks is not None:
        raise ValueError(
            "--pick cannot be combined with --box, --click or --masks, which mark the object already: leave it out"
        )
    if input_kind(path) not in ("video", "images"):
        raise BadFile(path, "is neither a video nor a folder of images", "--pick works only for those: leave it out")
    if (capture / PROVENANCE).is_file():
        saved = files.read_json(capture / PROVENANCE, _Marked, WRONG_PROVENANCE).options
        # The user may have clicked more on the page.
        repeated = {*options.object} <= {*saved.object} and {*options.not_object} <= {*saved.not_object}
        if saved.box is None or not repeated:
            fix = "choose another folder with -o, or repeat the command that made it"
            raise BadFile(capture.parent, "holds a capture with other masks, made without this box or click", fix)
        return replace(options, box=saved.box, at=saved.at, object=saved.object, not_object=saved.not_object)
    frame = sharpest_frame(path, options)
    options = replace(options, at=frame.number)
    marks = request_marks(frame, _review(path, options), output)
    clicks = [*options.object, *marks.object], [*options.not_object, *marks.not_object]
    chosen = replace(options, box=marks.box, object=tuple(clicks[0]), not_object=tuple(clicks[1]))
    words = ["--box", *marks.box, "--at", frame.number]
    for name, pixels in (("--object", chosen.object), ("--not-object", chosen.not_object)):
        words += [word for pixel in pixels for word in (name, *pixel)]
    output(" ".join(map(str, words)))
    return chosen


def sharpest_frame(path: Path, options: FootageOptions) -> FootageFrame:
    """The undistorted frame `options.at`, or if that is 0 the sharpest of the first `N_CANDIDATES` that are used."""
    opened = footage.open_footage(path, options.masks)
    best, highest = None, -1.0
    for frame in footage.read_frames(opened, part=options.part):
        if frame.mask is not None:
            raise BadFile(path, "has masks, so no box is needed", "leave --pick out")
        if options.at and frame.number < options.at:
            continue
        sharpness = float(cv2.Laplacian(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
        if sharpness > highest:
            best, highest = frame, sharpness
        if frame.number >= (options.at or options.first + N_CANDIDATES - 1):
            break
    if best is None:
        raise BadFile(path, f"has no frame {options.at}" + (" in --part" if options.part else ""))
    return undistort_frame(best, lens_of(opened, options, *best.image.shape[:2]))


def request_marks(frame: FootageFrame, review: Review, output: Callable[[str], Any] = print) -> Marks:
    """Serve the page on localhost until the user has chosen; returns the box and the clicks [pixels]."""
    height, width = frame.image.shape[:2]
    page, token, chosen = _page(frame), secrets.token_urlsafe(12), []
    one_at_a_time = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        timeout = 30

        def do_GET(self) -> None:
            found = self.path == f"/{token}/"
            self._reply(*((200, "text/html", page) if found else (404, "text/plain", b"no such page")))

        def do_POST(self) -> None:
            length, name = self.headers.get("Content-Length", ""), self.path.removeprefix(f"/{token}/")
            if name not in ("done", "frames", "mask") or not length.isdecimal() or int(length) > MAX_REQUEST_BYTES:
                return self._reply(404, "text/plain", b"no such page")
            marks = _parse_marks(self.rfile.read(int(length)), height, width)
            if marks is None:
                wrong = f"not a box, or a click outside of {width} x {height} pixels".encode()
                return self._reply(400, "text/plain", wrong)
            if name != "done":
                with one_at_a_time:
                    return self._reply(*_answer(name, marks, review))
            self._reply(200, "text/plain", b"")
            chosen.append(marks)
            server.shutdown()

        def _reply(self, code: int, kind: str, content: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            """Suppress the log of requests."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        address = f"http://127.0.0.1:{server.server_address[1]}/{token}/"
        tunnel = f"ssh -L {server.server_address[1]}:127.0.0.1:{server.server_address[1]} THIS_MACHINE"
        output(f"{address}   open this page and draw a box around the object (on another machine after {tunnel})")
        server.serve_forever(poll_interval=0.1)
    return chosen[0]


def _review(path: Path, options: FootageOptions) -> Review:
    """Masks of footage for the page; the last survey and the last masks are kept."""

    @lru_cache(maxsize=1)
    def survey(box: Box) -> Survey:
        return survey_footage(path, replace(options, box=box))

    @lru_cache(maxsize=1)
    def corrected(box: Box, object: tuple[Pixel, ...], not_object: tuple[Pixel, ...]) -> Masks:
        known = survey(box)
        clicks = to_clicks(object, not_object, known.numbers, known.scale)
        return correct_masks(known.images, known.masks, known.background, clicks, known.hands)

    return Review(survey, lambda marks: corrected(marks.box, marks.object, marks.not_object))


def _answer(name: str, marks: Marks, review: Review) -> tuple[int, str, bytes]:
    """Status, type and content of the answer to a request: numbers of the frames, or a frame with its mask."""
    try:
        survey = review.survey(marks.box)
        if name == "frames":
            return 200, "application/json", msgspec.json.encode(survey.numbers.tolist())
        if not 0 <= marks.frame < len(survey.numbers):
            return 400, "text/plain", f"no such frame: there are {len(survey.numbers)}, counted from 0".encode()
        return 200, "image/jpeg", _overlay(survey, review.masks(marks), marks.frame)
    except BadFile as error:
        return 400, "text/plain", str(error).encode()
    except Exception as error:
        return 500, "text/plain", f"{type(error).__name__}: {error}".encode()


def _parse_marks(content: bytes, height: int, width: int) -> Marks | None:
    """What the page sent; None unless it is a box and clicks inside the image."""
    try:
        marks = msgspec.json.decode(content, type=Marks)
    except (msgspec.DecodeError, UnicodeError):
        return None
    left, top, w, h = marks.box
    inside = left >= 0 and top >= 0 and min(w, h) >= 2 and left + w <= width and top + h <= height
    for clicks in (marks.object, marks.not_object):
        inside &= len(clicks) <= MAX_CLICKS
        inside &= all(0 <= column < width and 0 <= row < height and number >= 0 for column, row, number in clicks)
    return marks if inside else None


def _overlay(survey: Survey, masks: Masks, i: int) -> bytes:
    """A frame with its mask and silhouette, as JPEG."""
    image, labels = survey.images[i].copy(), masks.labels[i]
    inside = segmentation.dilated(labels == OBJECT, 1)
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    shown = mask_overlay(image, masks.with_doubt(i), EDGE)
    return _jpeg(cv2.drawContours(shown, contours, -1, CONTOUR, 1))


def _jpeg(image: np.ndarray) -> bytes:
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    return encoded.tobytes()


def _page(frame: FootageFrame) -> bytes:
    height, width = frame.image.shape[:2]
    image = "data:image/jpeg;base64," + base64.b64encode(_jpeg(frame.image)).decode()
    parts = {"image": image, "width": str(width), "height": str(height), "number": str(frame.number)}
    template = (resources.files("tumble.preprocess.picker") / "pick.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template).encode()
