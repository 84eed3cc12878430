"""The version of the code that a row was measured with."""

import ast
import hashlib
import os
import platform
import subprocess
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NotRequired, TypedDict

import torch

from tumble import __version__, backends

DECIDING = (
    "backends",
    "datasets",
    "engine",
    "evaluation",
    "export",
    "inverse_rendering",
    "io",
    "maths",
    "matching",
    "poses",
    "rendering",
    "scene",
    "synthetic",
    "actions.py",
    "glb_scores.py",
    "pipeline.py",
    "recipes.py",
)
"""Rooms and files of the package that decide the scores of a row."""
STAGE_1 = ("matching", "poses")
"""Those of them that run only where poses are estimated."""
SOURCES = (".py", ".cpp", ".h")
"""Extensions of source files."""


class Code(TypedDict):
    """The code that measured a row."""

    version: str
    """Version of the package."""
    commit: str | None
    """Git commit, with "+" if files were changed since; None outside of a repository."""
    fingerprint: str
    """Hash of the sources that decide the scores, without comments and docstrings."""
    fingerprint_given: NotRequired[str]
    """The same without the sources of stage 1, for rows with given poses. A row has only its own fingerprint."""


@cache
def current_code() -> Code:
    """The code of this process."""
    given = tuple(part for part in DECIDING if part not in STAGE_1)
    return {
        "version": __version__,
        "commit": _commit(),
        "fingerprint": source_fingerprint(DECIDING)[:16],
        "fingerprint_given": source_fingerprint(given)[:16],
    }


@cache
def source_fingerprint(parts: Sequence[str]) -> str:
    """Hash of the sources in some rooms and files of the package, without comments and docstrings."""
    root = Path(str(resources.files("tumble")))
    paths = [path for part in parts for path in ([root / part] if part.endswith(".py") else (root / part).rglob("*"))]
    digest = hashlib.sha256()
    for path in sorted(path for path in paths if path.suffix in SOURCES):
        text = path.read_text("utf-8")
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        digest.update((_code_lines(text) if path.suffix == ".py" else text).encode())
    return digest.hexdigest()


def machine_class(device: torch.device) -> str:
    """The kind of machine: number of cores, architecture and vector width, and the GPU if it computes."""
    gpu = "" if device.type == "cpu" else torch.get_device_module(device).get_device_name(device)
    cpu = f"{os.cpu_count()}-core {platform.machine()} CPU, {backends.vector_bits()}-bit vectors"
    return f"{cpu}, {gpu}" if gpu else cpu


def _code_lines(text: str) -> str:
    """Python source without empty lines, lines of comments, and docstrings."""
    prose: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        # Any expression statement that is a string: also the docstrings of constants and fields.
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            prose |= set(range(node.lineno, (node.end_lineno or 0) + 1))
    lines = (line for number, line in enumerate(text.splitlines(), 1) if number not in prose)
    return "\n".join(line for line in lines if line.strip() and not line.strip().startswith("#"))


def _commit() -> str | None:
    root = Path(str(resources.files("tumble"))).parent
    if not (root / ".git").exists():
        return None
    try:
        words = ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"]
        return subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
