"""Compile the kernels of `native/` on first use, keep them in a user cache, and load them.

By the system's compiler; without one that works, by the Clang inside Warp, if that is installed (`_jit`).

A *build* is one shared library, named by a hash of everything that decides its machine code: sources, flags, compiler
and processor. Processes that start at once may compile the same build twice; each puts a whole file in place.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from types import SimpleNamespace

from tumble.backends._cache import SOURCES, NoCache, folders, writable
from tumble.backends._structs import STRUCTURES

FLAGS = (
    *("-std=c++17", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-Wno-psabi"),
    *("-fno-exceptions", "-fno-rtti", "-fno-math-errno", "-fno-trapping-math", "-pthread"),
)
"""Never -ffast-math: it folds the rounding trick of the kernels' exp away."""
VARIANTS = (("-march=native",), ("-mcpu=native",), ())
"""Tried in this order: not every compiler knows its own processor, nor by the same word."""
COMPILERS = ("c++", "g++", "clang++")


class CannotCompile(RuntimeError):
    """There is no compiler, or it fails; the message says which and what to do."""


@cache
def library() -> ctypes.CDLL | SimpleNamespace:
    """The compiled kernels of this machine.

    Raises:
        CannotCompile: There is no working C++ compiler, and no Warp that could stand in.
    """
    try:
        kernels = _by_compiler()
    except CannotCompile as reason:
        kernels = _by_warp(reason)
    assert all(kernels.sizes(i) == ctypes.sizeof(struct) for i, struct in enumerate(STRUCTURES)), "layouts differ"
    return kernels


def _by_compiler() -> ctypes.CDLL:
    compiler = find_compiler()
    name = f"kernels-{_build_hash(compiler)}.so"
    path = next((folder / name for folder in folders() if (folder / name).is_file()), None)
    if path is None:
        path = _place(name)
        compile_to(path, compiler)
    return ctypes.CDLL(str(path))


def _place(name: str) -> Path:
    try:
        return writable() / name
    except NoCache as reason:
        raise CannotCompile(str(reason)) from None


def _by_warp(no_compiler: CannotCompile) -> SimpleNamespace:
    """What Warp offers for this is marked as experimental: if a version lacks or changes it, the reason is told."""
    try:
        import warp
    except ImportError:
        raise CannotCompile(f"{no_compiler}; or pip install 'tumble[cuda]', which brings one (no GPU needed)") from None
    try:
        from tumble.backends import _jit

        return _jit.library()
    except Exception as reason:
        raise CannotCompile(
            f"{no_compiler}; nor can Warp {warp.__version__}, which is here, compile the kernels: {reason}"
        ) from reason


def find_compiler() -> str:
    """Path of the C++ compiler: $CXX if set, else the system's.

    Raises:
        CannotCompile: There is none.
    """
    wanted = [os.environ["CXX"]] if os.environ.get("CXX") else COMPILERS
    for name in wanted:
        path = shutil.which(name)
        if path:
            return path
    raise CannotCompile(
        f"no C++ compiler ({', '.join(wanted)}) on the PATH; install one "
        "(Debian: apt install g++; macOS: xcode-select --install; conda: conda install cxx-compiler)"
    )


def compile_to(path: Path, compiler: str) -> None:
    """Compile the kernels to a shared library; the file appears whole or not at all.

    Raises:
        CannotCompile: No variant of the flags works; the message ends with what the compiler said.
    """
    handle, partial = tempfile.mkstemp(prefix=".partial-", suffix=".so", dir=path.parent)
    os.close(handle)
    try:
        said = ""
        for variant in VARIANTS:
            command = [compiler, *FLAGS, *variant, str(SOURCES / "kernels.cpp"), "-o", partial]
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            if run.returncode == 0:
                Path(partial).replace(path)
                return
            said = run.stderr
        raise CannotCompile(
            f"{compiler} cannot compile the kernels; set CXX to another compiler. It says: {said[-400:]}"
        )
    finally:
        Path(partial).unlink(missing_ok=True)


def _build_hash(compiler: str) -> str:
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    parts = [version, compiler, *FLAGS, str(VARIANTS), platform.platform(), platform.processor(), _cpu_features()]
    parts += [path.name + path.read_text() for path in sorted(SOURCES.iterdir()) if path.suffix in (".h", ".cpp")]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def _cpu_features() -> str:
    """What -march=native looks at: a home folder may be shared by machines of several kinds."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "\n".join(sorted({x for x in lines if x.startswith(("flags", "Features", "model name"))}))
    return ""
