"""Where the object is, asked of a person: one page in the browser, on this machine, that closes when it is answered.

The page shows one sharp frame, as the pinhole camera sees it; its address holds a random word, so that no other page
can answer.
"""

import base64
import json
import re
import secrets
from collections.abc import Callable
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tumble.io import BadFile, files
from tumble.preprocess import footage, video_to_capture
from tumble.preprocess.footage import FootageFrame
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.source import input_kind
from tumble.preprocess.survey import lens_of, undistorted

LOOKED_AT = 60
"""Frames among which the sharpest is shown: the first two seconds."""
ANSWER = 256
"""Longest answer that is read [bytes]."""

Box = tuple[int, int, int, int]


def pick_box(path: Path, options: FootageOptions, made: Path, tell: Callable[[str], Any] = print) -> FootageOptions:
    """The options with a box that a person draws, and the frame it is on; waits until one is drawn.

    Args:
        made: The capture that the footage becomes. Where it is there already its box is taken, and nobody asked.
        tell: Is given the page's address, then the options to give next time.

    Raises:
        BadFile: The footage cannot be read, or has masks.
        ValueError: `options` say already where the object is.
    """
    if options.box is not None or options.click is not None or options.masks is not None:
        raise ValueError("--pick asks for what --box, --click or --masks say already: leave it out")
    if input_kind(path) not in ("film", "pictures"):
        raise BadFile(path, "is no film and no folder of pictures", "--pick is for those: leave it out")
    note = made / video_to_capture.PROVENANCE
    if note.is_file():
        said = files.read_json(note)["options"]
        return replace(options, box=None if said["box"] is None else tuple(said["box"]), at=said["at"])
    frame = sharp_frame(path, options)
    box = ask(frame, tell)
    tell(f"--box {' '.join(map(str, box))} --at {frame.number}")
    return replace(options, box=box, at=frame.number)


def sharp_frame(path: Path, options: FootageOptions) -> FootageFrame:
    """The frame `options.at`, or where that is 0 the sharpest of the first ones, without the lens's distortion."""
    opened = footage.open_footage(path, options.masks)
    best, most = None, -1.0
    for frame in footage.frames(opened):
        if frame.mask is not None:
            raise BadFile(path, "has masks: nothing to ask", "leave --pick out")
        if options.at and frame.number < options.at:
            continue
        sharpness = float(cv2.Laplacian(cv2.cvtColor(frame.picture, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
        if sharpness > most:
            best, most = frame, sharpness
        if frame.number >= (options.at or LOOKED_AT - 1):
            break
    if best is None:
        raise BadFile(path, f"has no frame {options.at}")
    return undistorted(best, lens_of(opened, options, *best.picture.shape[:2]))


def ask(frame: FootageFrame, tell: Callable[[str], Any] = print) -> Box:
    """Serve the page to this machine alone until a box is drawn: left, top, width, height [pixels]."""
    height, width = frame.picture.shape[:2]
    page, word, answers = _page(frame), secrets.token_urlsafe(12), []

    class Handler(BaseHTTPRequestHandler):
        timeout = 30

        def do_GET(self) -> None:
            self._reply(200, page) if self.path == f"/{word}/" else self._reply(404, b"no such page")

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if self.path != f"/{word}/box" or not length.isdecimal() or int(length) > ANSWER:
                return self._reply(404, b"no such page")
            box = _box(self.rfile.read(int(length)), height, width)
            if box is None:
                return self._reply(400, f"not a box in {width} x {height} pixels".encode())
            self._reply(200, b"")
            answers.append(box)
            server.shutdown()

        def _reply(self, code: int, content: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        address = f"http://127.0.0.1:{server.server_address[1]}/{word}/"
        tunnel = f"ssh -L {server.server_address[1]}:127.0.0.1:{server.server_address[1]} THIS_MACHINE"
        tell(f"{address}   draw a box around the object there (from another machine after {tunnel})")
        server.serve_forever(poll_interval=0.1)
    return answers[0]


def _box(content: bytes, height: int, width: int) -> Box | None:
    """What the page sends, if it is a box inside the picture."""
    try:
        values = json.loads(content)
    except (json.JSONDecodeError, UnicodeDecodeError):
        return None
    if not isinstance(values, list) or len(values) != 4 or not all(type(v) is int for v in values):
        return None
    left, top, wide, high = values
    inside = left >= 0 and top >= 0 and min(wide, high) >= 2 and left + wide <= width and top + high <= height
    return (left, top, wide, high) if inside else None


def _page(frame: FootageFrame) -> bytes:
    height, width = frame.picture.shape[:2]
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(frame.picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    picture = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
    parts = {"picture": picture, "width": str(width), "height": str(height), "number": str(frame.number)}
    template = (resources.files("tumble.preprocess") / "pick.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template).encode()
