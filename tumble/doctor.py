"""What this machine offers, and the exact fix for what it lacks."""

import importlib.metadata
import importlib.util
import os
import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from tumble import __version__
from tumble.synthetic import OLDEST_LLVM, find_llvm


@dataclass(frozen=True)
class DoctorFinding:
    """One line of the report."""

    subject: str
    state: str
    fix: str = ""
    """What to do; empty when all is well."""


def findings() -> list[DoctorFinding]:
    """Everything `tumble doctor` prints, in order."""
    return [*_machine(), _renderer(), _compiler(), _codec(), _atlas(), *_extras()]


def _machine() -> Iterator[DoctorFinding]:
    yield DoctorFinding(
        "tumble",
        f"{__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}",
    )
    yield DoctorFinding("torch", f"{torch.__version__}, {torch.get_num_threads()} threads")
    if torch.cuda.is_available():
        free, total = torch.cuda.mem_get_info()
        name = torch.cuda.get_device_name()
        yield DoctorFinding("device", f"{name}, {free / 2**30:.0f} of {total / 2**30:.0f} GiB free")
    else:
        yield DoctorFinding("device", "CPU")
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        yield DoctorFinding(
            "memory",
            f"{memory:.0f} GiB",
            "" if memory >= 4 else "runs need about 4 GiB: close other programs",
        )


def _renderer() -> DoctorFinding:
    if importlib.util.find_spec("mitsuba") is None:
        return DoctorFinding("tumble synth", "not installed", "pip install 'tumble[synth]'")
    llvm = find_llvm()
    if llvm is not None:
        return DoctorFinding("tumble synth", f"Mitsuba on LLVM {llvm[1]} ({llvm[0]})")
    how = {"Darwin": "brew install llvm", "Windows": "install LLVM 17 or newer from llvm.org"}
    fix = how.get(platform.system(), f"apt install libllvm19 (any libLLVM >= {OLDEST_LLVM} will do)")
    return DoctorFinding(
        "tumble synth", "Mitsuba in its scalar variant: right, but several times slower than with LLVM", fix
    )


def _compiler() -> DoctorFinding:
    found = next((path for name in ("c++", "g++", "clang++") if (path := shutil.which(name))), None)
    if found:
        return DoctorFinding("compiler", found)
    return DoctorFinding("compiler", "none", "optional: apt install g++ (the CPU kernels are compiled on first use)")


def _codec() -> DoctorFinding:
    import av

    known = "libx264" in av.codecs_available
    return DoctorFinding(
        "film",
        f"PyAV {av.__version__}, H.264 {'in and out' if known else 'in only'}",
        "" if known else "pip install -U av",
    )


def _atlas() -> DoctorFinding:
    if importlib.util.find_spec("xatlas") is None:
        return DoctorFinding(
            "export", "no meshes: xatlas is not installed", "pip install xatlas (without a wheel: needs g++)"
        )
    return DoctorFinding("export", f"meshes by xatlas {importlib.metadata.version('xatlas')}")


def _extras() -> Iterator[DoctorFinding]:
    for extra, module, package in (("view", "viser", "viser"), ("cuda", "warp", "warp-lang")):
        if importlib.util.find_spec(module) is None:
            yield DoctorFinding(f"extra {extra}", "not installed", f"optional: pip install 'tumble[{extra}]'")
        else:
            yield DoctorFinding(f"extra {extra}", f"{package} {importlib.metadata.version(package)}")
