"""Cache folder of compiled kernels: the user's cache, else a temporary folder owned by the user."""

import contextlib
import os
import tempfile
from pathlib import Path

SOURCES = Path(__file__).parent / "native"
"""Folder with the C++ sources of the CPU kernels."""


class NoCache(RuntimeError):
    """Error for a machine without a writable cache folder; the message lists the folders that were tried."""


def folders() -> list[Path]:
    """Candidate cache folders in order of preference."""
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tumble"
    return [user, Path(tempfile.gettempdir()) / f"tumble-{os.getuid() if hasattr(os, 'getuid') else 'user'}"]


def writable() -> Path:
    """The first candidate folder that can be written, created with access for this user only because it holds code.

    Raises:
        NoCache: No candidate can be written.
    """
    for folder in folders():
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if os.access(folder, os.W_OK):
                return folder
    raise NoCache(f"none of {', '.join(map(str, folders()))} can be written; set XDG_CACHE_HOME to a writable folder")
