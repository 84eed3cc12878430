"""Box around the object, drawn by the user in the browser on a local page.

The page shows one sharp undistorted frame. Its address contains a random token, so that no other page can send a box;
the server stops when a box is received.
"""

import base64
import re
import secrets
from collections.abc import Callable
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from tumble.io import BadFile, files
from tumble.preprocess import footage
from tumble.preprocess.footage import PROVENANCE, WRONG_PROVENANCE, FootageFrame
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.source import input_kind
from tumble.preprocess.survey import lens_of, undistort_frame

N_CANDIDATES = 60
"""Number of frames among which the sharpest is selected: the first two seconds."""
MAX_REQUEST_BYTES = 256
"""Maximum size of a request that is read [bytes]."""

Box = tuple[int, int, int, int]


class _Choice(msgspec.Struct, frozen=True):
    """Box and frame number among the options of `ingest.json`."""

    box: Box | None
    at: int


class _Marked(msgspec.Struct, frozen=True):
    """The entry of `ingest.json` that holds the user's choice."""

    options: _Choice


def pick_box(
    path: Path, options: FootageOptions, capture: Path, output: Callable[[str], Any] = print
) -> FootageOptions:
    """The options, completed with a box that the user draws and the number of its frame; waits for the box.

    Args:
        capture: The capture to which the footage is converted. If it exists, its box is used and no page is opened.
        output: Called with the page's address, and then with the options that repeat the choice.

    Raises:
        BadFile: The footage cannot be read, or has masks.
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
        return replace(options, box=saved.box, at=saved.at)
    frame = sharpest_frame(path, options)
    box = request_box(frame, output)
    output(f"--box {' '.join(map(str, box))} --at {frame.number}")
    return replace(options, box=box, at=frame.number)


def sharpest_frame(path: Path, options: FootageOptions) -> FootageFrame:
    """The undistorted frame `options.at`, or if that is 0 the sharpest of the first `N_CANDIDATES`."""
    opened = footage.open_footage(path, options.masks)
    best, highest = None, -1.0
    for frame in footage.read_frames(opened):
        if frame.mask is not None:
            raise BadFile(path, "has masks, so no box is needed", "leave --pick out")
        if options.at and frame.number < options.at:
            continue
        sharpness = float(cv2.Laplacian(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
        if sharpness > highest:
            best, highest = frame, sharpness
        if frame.number >= (options.at or N_CANDIDATES - 1):
            break
    if best is None:
        raise BadFile(path, f"has no frame {options.at}")
    return undistort_frame(best, lens_of(opened, options, *best.image.shape[:2]))


def request_box(frame: FootageFrame, output: Callable[[str], Any] = print) -> Box:
    """Serve the page on localhost until a box is drawn; returns left, top, width, height [pixels]."""
    height, width = frame.image.shape[:2]
    page, token, boxes = _page(frame), secrets.token_urlsafe(12), []

    class Handler(BaseHTTPRequestHandler):
        timeout = 30

        def do_GET(self) -> None:
            self._reply(200, page) if self.path == f"/{token}/" else self._reply(404, b"no such page")

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if self.path != f"/{token}/box" or not length.isdecimal() or int(length) > MAX_REQUEST_BYTES:
                return self._reply(404, b"no such page")
            box = _parse_box(self.rfile.read(int(length)), height, width)
            if box is None:
                return self._reply(400, f"not a box inside {width} x {height} pixels".encode())
            self._reply(200, b"")
            boxes.append(box)
            server.shutdown()

        def _reply(self, code: int, content: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", "text/html; charset=utf-8")
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
    return boxes[0]


def _parse_box(content: bytes, height: int, width: int) -> Box | None:
    """The box sent by the page; None if it is no box inside the image."""
    try:
        left, top, w, h = msgspec.json.decode(content, type=Box)
    except (msgspec.DecodeError, UnicodeError):
        return None
    inside = left >= 0 and top >= 0 and min(w, h) >= 2 and left + w <= width and top + h <= height
    return (left, top, w, h) if inside else None


def _page(frame: FootageFrame) -> bytes:
    height, width = frame.image.shape[:2]
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(frame.image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    image = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
    parts = {"image": image, "width": str(width), "height": str(height), "number": str(frame.number)}
    template = (resources.files("tumble.preprocess") / "pick.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template).encode()
