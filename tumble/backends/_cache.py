"""Cache folder of compiled kernels: that of the user, or else a private one for this process.

Who can write a library in the cache can run code as this user. Files and folders are therefore used only if nobody else
can write them, and no folder that users share, such as /tmp, is searched.
"""

import atexit
import os
import shutil
import stat
import tempfile
import warnings
from functools import cache
from pathlib import Path

SOURCES = Path(__file__).parent / "native"
"""Folder with the C++ sources of the CPU kernels."""


class NoCache(RuntimeError):
    """Error for a machine on which no folder can be written; the message holds the reason and the fix."""


def user_folder() -> Path:
    """Cache folder of this user, which may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tumble"


def is_private(path: Path) -> bool:
    """Whether a file or folder exists, is no symlink, belongs to this user or root, and only its owner can write it."""
    try:
        found = path.lstat()
    except OSError:
        return False
    if os.name != "posix":
        return True  # profiles of other users cannot be written there, and modes say nothing
    shared = stat.S_ISLNK(found.st_mode) or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return not shared and found.st_uid in (os.getuid(), 0)


def writable() -> Path:
    """The user's cache folder, created if missing, or with a warning a temporary one for this process.

    Raises:
        NoCache: Neither can be written.
    """
    return _created(user_folder())


def of_warp() -> Path:
    """A folder in `writable` for Warp, which loads whatever it finds there, and writes with the modes of the umask.

    Nobody else can enter it from now on; one into which others could write before is not used.

    Raises:
        NoCache: See `writable`.
    """
    folder = _created(writable() / "warp")
    folder.chmod(0o700)
    return folder


def _created(folder: Path) -> Path:
    """A folder that only this user can write, created if missing; a temporary one, with a warning, if others can."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        reason = error.strerror or str(error)
    else:
        if is_private(folder) and os.access(folder, os.W_OK):
            return folder
        reason = "it is a link, others can write it, or it cannot be written (fix: chmod 700 on your own folder)"
    warnings.warn(
        f"{folder}: compiled kernels cannot be kept: {reason}; each process compiles them again until this is fixed or "
        "XDG_CACHE_HOME names another folder",
        RuntimeWarning,
        stacklevel=3,
    )
    return _process_folder()


@cache
def _process_folder() -> Path:
    """A new temporary folder, accessible to this user alone and removed when the process ends."""
    try:
        folder = tempfile.mkdtemp(prefix="tumble-")
    except OSError as error:
        raise NoCache(f"no folder for compiled kernels: {error}; set XDG_CACHE_HOME to a writable folder") from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
