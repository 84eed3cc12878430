"""The CPU kernels that wheels carry, compiled once for each vector width, for machines without a compiler.

`hatch_build.py` compiles them when a wheel is built; an editable installation or one from a checkout without a compiler
has none. Only the standard library is imported, because the build has nothing else.
"""

import os
import platform
import re
import shlex
import shutil
import subprocess
import sysconfig
from collections.abc import Iterable
from pathlib import Path

FOLDER = Path(__file__).parent / "prebuilt"
"""Folder of the compiled kernels in an installed wheel."""
SOURCE = Path(__file__).parent / "native" / "kernels.cpp"
"""The kernels."""
FLAGS = (
    *("-std=c++17", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-Wno-psabi"),
    *("-fno-exceptions", "-fno-rtti", "-fno-math-errno", "-fno-trapping-math", "-pthread"),
)
"""Compiler flags. -ffast-math must not be added: it would remove the rounding trick in the kernels' exp."""
COMPILERS = ("c++", "g++", "clang++")
"""Compilers, tried in this order."""
_V3 = frozenset({"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"})
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
_X86: tuple[tuple[str, frozenset[str]], ...] = (("x86-64-v4", _V4), ("x86-64-v3", _V3), ("x86-64", frozenset()))
VARIANTS = {"x86_64": _X86, "aarch64": (("armv8-a", frozenset()),), "arm64": (("armv8-a", frozenset()),)}
"""By machine, fastest first: the -march of each library, of 16, 8 and 4 floats per vector on x86-64, and the processor
features that it needs, as Linux names them. Other systems do not list features and use the last one."""

SYSTEM_LIBRARIES = frozenset({b"libc.so.6", b"libm.so.6", b"libpthread.so.0", b"libgcc_s.so.1"})
"""Libraries that every Linux with glibc has (PEP 600); of these, only the version of glibc matters to the kernels."""


def choose(machine: str, features: frozenset[str], folder: Path = FOLDER) -> Path | None:
    """The fastest of the libraries in the folder that a processor can execute; None if there is none."""
    for march, needed in VARIANTS.get(machine, ()):
        path = folder / f"kernels-{march}.so"
        if needed <= features and path.is_file():
            return path
    return None


def processor_features() -> frozenset[str]:
    """Features of this machine's processor that the system supports; empty where it does not list them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), ()))


def compiler_command(names: Iterable[str]) -> list[str] | None:
    """The C++ compiler, $CXX or else the first of the names that there is; None if there is none.

    $CXX may have arguments, or begin with a wrapper: `ccache g++`.
    """
    given = os.environ.get("CXX", "")
    commands = [[given], shlex.split(given)] if given.strip() else [[name] for name in names]
    return next(([path, *arguments] for name, *arguments in commands if (path := shutil.which(name))), None)


def compile_all(folder: Path) -> list[Path]:
    """Compile the kernels for every variant of this machine into a folder.

    Returns:
        The libraries; none if there is no compiler or it fails, as a wheel without kernels is valid too.
    """
    compiler = compiler_command(COMPILERS)
    if compiler is None:
        return []
    libraries = []
    for march, _ in VARIANTS.get(platform.machine(), ()):
        library = folder / f"kernels-{march}.so"
        command = [*compiler, *FLAGS, f"-march={march}", str(SOURCE), "-o", str(library)]
        if subprocess.run(command, check=False).returncode == 0:
            libraries.append(library)
    return libraries


def platform_tag(libraries: Iterable[Path]) -> str:
    """Tag of the platform of a wheel with these libraries: that of every system with their symbols, as far as known.

    Of libraries for Linux that need nothing but glibc this is `manylinux_X_Y_MACHINE` (PEP 600), where X.Y is the
    newest version of glibc that they refer to, which an older build system lowers. Package indices accept no other.
    """
    content = b"".join(path.read_bytes() for path in libraries)
    own = re.sub("[-.]", "_", sysconfig.get_platform())
    needed = set(re.findall(rb"\0(lib[\w+-]+\.so[\d.]*)(?=\0)", content))
    versions = [tuple(map(int, found.split(b"."))) for found in re.findall(rb"\0GLIBC_(\d+\.\d+)[\d.]*(?=\0)", content)]
    if not own.startswith("linux_") or not versions or not needed <= SYSTEM_LIBRARIES:
        return own
    major, minor = max(versions)
    return f"manylinux_{major}_{minor}_{own.removeprefix('linux_')}"
