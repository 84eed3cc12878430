"""Where compiled kernels are kept: the user's cache, else a folder of the user's own among the temporary ones."""

import contextlib
import os
import tempfile
from pathlib import Path

SOURCES = Path(__file__).parent / "native"
"""Of the kernels for the CPU."""


class NoCache(RuntimeError):
    """No folder for compiled kernels can be written; the message says which were tried."""


def folders() -> list[Path]:
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tumble"
    return [user, Path(tempfile.gettempdir()) / f"tumble-{os.getuid() if hasattr(os, 'getuid') else 'user'}"]


def writable() -> Path:
    """The first folder that can be made, is ours and is not open to others: a library is code."""
    for folder in folders():
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if os.access(folder, os.W_OK):
                return folder
    raise NoCache(f"none of {', '.join(map(str, folders()))} can be written; set XDG_CACHE_HOME to a folder that can")
