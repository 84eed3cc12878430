"""Where commands write: the rules by which nothing of the user is overwritten.

A command writes into a folder that is new, empty, or holds its own earlier output, which is recognised by a file that
the command always writes first, its *mark*. It writes a file only where none is. Anything else takes `--overwrite`.
"""

import os
import tempfile
from collections.abc import Collection
from pathlib import Path

from tumble.io.files import PARTIAL_PREFIX, BadFile, describe_write_errors, partial_prefix

OTHER_PLACE = "choose another place, or insist with --overwrite (overwrite=True in Python)"
"""Fix for an output that would replace something."""


def claim_folder(folder: Path, mark: str, *, overwrite: bool = False, fix: str = OTHER_PLACE) -> None:
    """Check that a command may write into a folder, which need not exist.

    Args:
        mark: Name of the file by which an earlier output of the same command is recognised.
        overwrite: Allow a folder with other files, of which those with the same names are replaced.
        fix: What the error suggests for a folder with other files.

    Raises:
        BadFile: The path or a part of it is a file, or the folder holds something other than the command's output, or
            a link out of it.
        WriteError: The folder cannot be written.
    """
    existing = _existing(folder)
    if not existing.is_dir():
        raise BadFile(existing, "is a file, where a folder is to be written", "choose another folder with -o")
    if (folder / mark).is_file():
        require_no_links(folder)
    require_writable(folder)
    if overwrite or existing != folder or (folder / mark).is_file():
        return
    if any(not path.name.startswith(PARTIAL_PREFIX) for path in folder.iterdir()):
        raise BadFile(folder, f"holds other files, and no {mark} of an earlier output of this command", fix)


def require_writable(folder: Path) -> None:
    """Check that files can be written into a folder, or that it can be made: before hours of work, not after them.

    Raises:
        WriteError: They cannot.
    """
    with describe_write_errors(folder), tempfile.TemporaryFile(prefix=partial_prefix(), dir=_existing(folder)):
        pass


def _existing(folder: Path) -> Path:
    """The folder, or the innermost part of its path that exists."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def require_no_links(folder: Path) -> None:
    """Check that no link in an earlier output leads out of it: it may come from somebody else, and is written into.

    Raises:
        BadFile: One does.
    """
    root = os.path.realpath(folder)
    for place, folders, names in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *names)):
            target = os.path.realpath(path)
            if path.is_symlink() and not Path(target).is_relative_to(root):
                reason = "what is written through a link could replace any file of yours"
                raise BadFile(path, f"is a link to {target}, outside of {folder}", f"remove it; {reason}")


def claim_file(path: Path, suffixes: Collection[str], *, overwrite: bool = False) -> None:
    """Check that a command may write a file, whose format its extension tells.

    Args:
        suffixes: Extensions of the formats that can be written.

    Raises:
        BadFile: The format is not among them, or the file exists and may not be overwritten.
        WriteError: Its folder cannot be written.
    """
    if path.suffix.lower() not in suffixes:
        raise BadFile(path, f"has the extension {path.suffix!r}", f"these can be written: {', '.join(suffixes)}")
    if path.exists() and not (overwrite and path.is_file()):
        raise BadFile(path, "exists already", OTHER_PLACE)
    require_writable(path.parent)


def require_outside(out: Path, source: Path) -> None:
    """Check that an output does not lie in the folder of its input, which would change with every run.

    Raises:
        BadFile: It does.
    """
    if source.is_dir() and out.resolve().is_relative_to(source.resolve()):
        raise BadFile(out, f"lies in the input folder {source}", "choose a folder outside of it with -o")
