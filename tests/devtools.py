"""A headless browser without a network, driven through its DevTools protocol with the standard library alone."""

import base64
import json
import os
import shutil
import socket
import struct
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader")
OPTIONS += ("--enable-unsafe-swiftshader", "--remote-debugging-port=0")
OPTIONS += ("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",)


def browser() -> str | None:
    """Where a browser is installed."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@dataclass
class Page:
    """An open page; a class because it holds a connection."""

    connection: socket.socket
    count: int = 0
    events: list[dict[str, Any]] = field(default_factory=list)

    def call(self, method: str, **arguments: Any) -> dict[str, Any]:
        """The protocol's answer; events that come meanwhile are kept."""
        self.count += 1
        self._send(json.dumps({"id": self.count, "method": method, "params": arguments}).encode())
        while True:
            message = json.loads(self._receive())
            if message.get("id") == self.count:
                assert "error" not in message, message
                return message["result"]
            self.events.append(message)

    def value(self, expression: str) -> Any:
        """What an expression of JavaScript comes to, awaited."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression: str, seconds: float = 120) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.value(f"Boolean({expression})"):
            assert time.monotonic() < end, f"never became true: {expression}"
            time.sleep(0.2)

    def screenshot(self) -> bytes:
        """A PNG of the window."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def _send(self, data: bytes) -> None:
        """One text frame, masked as a client must (RFC 6455, section 5.3); the mask of zeros changes nothing."""
        n = len(data)
        length = bytes([0x80 | n]) if n < 126 else struct.pack("!BH" if n < 1 << 16 else "!BQ", 0xFE | (n >> 16 > 0), n)
        self.connection.sendall(b"\x81" + length + bytes(4) + data)

    def _receive(self) -> bytes:
        whole, last = b"", False
        while not last:
            first, n = self._exactly(2)
            last, n = bool(first & 0x80), n & 0x7F
            if n > 125:
                n = int.from_bytes(self._exactly(2 if n == 126 else 8), "big")
            part = self._exactly(n)
            whole += part if first & 0x0F < 8 else b""
        return whole

    def _exactly(self, n: int) -> bytes:
        data = bytearray()
        while len(data) < n:
            more = self.connection.recv(n - len(data))
            assert more, "the browser went away"
            data += more
        return bytes(data)


@contextmanager
def opened(address: str, folder: Path, width: int, height: int) -> Iterator[Page]:
    """A page in a window of its own; its console is in `Page.events`."""
    program = browser()
    assert program is not None, "ask `browser` first"
    profile = folder / "profile"
    words = [program, *OPTIONS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        page = _page(_port(profile / "DevToolsActivePort"), address)
        with page.connection:
            yield page
    finally:
        process.terminate()
        process.wait(30)


def _port(file: Path, seconds: float = 60) -> int:
    end = time.monotonic() + seconds
    while not (file.is_file() and file.read_text().strip()):
        assert time.monotonic() < end, "the browser did not start"
        time.sleep(0.1)
    return int(file.read_text().split()[0])


def _page(port: int, address: str) -> Page:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
        path = next(tab["webSocketDebuggerUrl"] for tab in json.load(answer) if tab["type"] == "page").split("/", 3)[3]
    connection = socket.create_connection(("127.0.0.1", port), timeout=180)
    key = base64.b64encode(os.urandom(16)).decode()
    head = f"GET /{path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    connection.sendall(f"{head}Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
    reply = b""
    while not reply.endswith(b"\r\n\r\n"):
        reply += connection.recv(1)
    assert reply.startswith(b"HTTP/1.1 101"), reply
    page = Page(connection)
    for domain in ("Runtime", "Log", "Page"):
        page.call(f"{domain}.enable")
    page.call("Page.navigate", url=address)
    page.until("location.href !== 'about:blank' && document.readyState === 'complete'")
    return page
