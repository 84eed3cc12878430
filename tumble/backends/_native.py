"""Load the CPU kernels of `native/`: those of the wheel, or else compile them on first use and cache them.

They are compiled by the system's C++ compiler or, if none works, by the Clang inside NVIDIA Warp if that is installed
(`_jit`). A *build* is one shared library, named by a hash of everything that determines its machine code: sources,
flags, compiler and processor. Processes that start at the same time may compile the same build twice; each writes it
atomically.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace

from tumble.backends._cache import SOURCES, NoCache, is_private, user_folder, writable
from tumble.backends._prebuilt import COMPILERS, FLAGS, choose, compiler_command, processor_features
from tumble.backends._prebuilt import FOLDER as PREBUILT
from tumble.backends._structs import STRUCTURES

VARIANTS = (("-march=native",), ("-mcpu=native",), ())
"""Flags for the processor of this machine, tried in this order because compilers differ in what they accept."""


KEPT_MEMORY = {-1: 1 << 28, -3: 1 << 25}
"""Parameters of `mallopt`: how much free memory at the end of the heap is kept (M_TRIM_THRESHOLD), and the size
from which on a block has pages of its own (M_MMAP_THRESHOLD) [bytes]."""


class CannotCompile(RuntimeError):
    """Error for a missing or failing compiler; the message holds the reason and the fix."""


@cache
def library() -> ctypes.CDLL | SimpleNamespace:
    """The kernels: those of the wheel, else compiled for this machine.

    Raises:
        CannotCompile: The wheel has none, and neither a C++ compiler nor Warp can compile the kernels.
    """
    try:
        kernels = _of_wheel() or _by_compiler()
    except CannotCompile as reason:
        kernels = _by_warp(reason)
    assert all(kernels.sizes(i) == ctypes.sizeof(struct) for i, struct in enumerate(STRUCTURES)), (
        "the structures in _structs.py differ from those in native/"
    )
    _keep_freed_memory()
    return kernels


def _keep_freed_memory() -> None:
    """Let glibc keep freed memory: new pages in every step would cost as much as rendering a small image."""
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        for parameter, size in KEPT_MEMORY.items():
            mallopt(parameter, size)


def origin() -> str:
    """Where the kernels come from, for the user.

    Raises:
        CannotCompile: See `library`.
    """
    kernels = library()
    if not isinstance(kernels, ctypes.CDLL):
        return "compiled by the Clang of Warp"
    wheel = Path(kernels._name).parent == PREBUILT
    return f"{Path(kernels._name).stem} of the wheel" if wheel else f"compiled by {' '.join(find_compiler())}"


def _of_wheel() -> ctypes.CDLL | None:
    path = choose(platform.machine(), processor_features())
    # A system older than that of the build may lack functions of the C library.
    with contextlib.suppress(OSError):
        return ctypes.CDLL(str(path)) if path else None
    return None


def _by_compiler() -> ctypes.CDLL:
    compiler = find_compiler()
    name = f"kernels-{_build_hash(compiler)}.so"
    path = user_folder() / name
    if not (is_private(path.parent) and is_private(path)):
        path = _place(name)
        compile_to(path, compiler)
    return ctypes.CDLL(str(path))


def _place(name: str) -> Path:
    try:
        return writable() / name
    except NoCache as reason:
        raise CannotCompile(str(reason)) from None


def _by_warp(no_compiler: CannotCompile) -> SimpleNamespace:
    """The kernels compiled by Warp; any exception is caught because Warp marks the functions used as experimental."""
    try:
        import warp
    except ImportError:
        fix = "or pip install 'tumble[cuda]', which includes a compiler (no GPU needed)"
        raise CannotCompile(f"{no_compiler}; {fix}") from None
    try:
        from tumble.backends import _jit

        return _jit.library()
    except Exception as reason:
        failure = f"the installed Warp {warp.__version__} cannot compile the kernels either: {reason}"
        raise CannotCompile(f"{no_compiler}; {failure}") from reason


def find_compiler() -> list[str]:
    """The C++ compiler, $CXX if set, else that of the system: its path and the arguments of $CXX.

    Raises:
        CannotCompile: There is no compiler.
    """
    if command := compiler_command(COMPILERS):
        return command
    raise CannotCompile(
        f"no C++ compiler ({os.environ.get('CXX') or ', '.join(COMPILERS)}) on the PATH; install one "
        "(Debian: apt install g++; macOS: xcode-select --install; conda: conda install cxx-compiler)"
    )


def compile_to(path: Path, compiler: Sequence[str]) -> None:
    """Compile the kernels to a shared library, which is written atomically.

    Raises:
        CannotCompile: No variant of the flags works; the message ends with the output of the compiler.
    """
    handle, partial = tempfile.mkstemp(prefix=".partial-", suffix=".so", dir=path.parent)
    os.close(handle)
    try:
        output = ""
        for variant in VARIANTS:
            command = [*compiler, *FLAGS, *variant, str(SOURCES / "kernels.cpp"), "-o", partial]
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            if run.returncode == 0:
                Path(partial).chmod(0o700)  # linkers create the file anew, with the mode of the umask
                Path(partial).replace(path)
                return
            output = run.stderr
        raise CannotCompile(
            f"{' '.join(compiler)} cannot compile the kernels; set CXX to another compiler. Its output: {output[-400:]}"
        )
    finally:
        Path(partial).unlink(missing_ok=True)


def _build_hash(compiler: Sequence[str]) -> str:
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False).stdout
    parts = [version, *compiler, *FLAGS, str(VARIANTS), platform.platform(), platform.processor(), _cpu_features()]
    parts += [path.name + path.read_text() for path in sorted(SOURCES.iterdir()) if path.suffix in (".h", ".cpp")]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def _cpu_features() -> str:
    """Processor features that -march=native depends on; machines with different processors may share a cache."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "\n".join(sorted({x for x in lines if x.startswith(("flags", "Features", "model name"))}))
    return ""
