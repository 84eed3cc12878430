"""Environment check of `tumble doctor`: hardware, libraries and extras, and how to install what is missing."""

import importlib.metadata
import importlib.util
import os
import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from tumble import __version__
from tumble.synthetic import MIN_LLVM, find_llvm


@dataclass(frozen=True)
class DoctorFinding:
    """One line of the report."""

    subject: str
    """What was checked."""
    state: str
    """What was found."""
    fix: str = ""
    """How to fix it; empty if nothing is wrong."""


def findings() -> list[DoctorFinding]:
    """All lines of the report, in the order in which `tumble doctor` prints them."""
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
            "" if memory >= 4 else "a run needs about 4 GiB: close other programs",
        )


def _renderer() -> DoctorFinding:
    if importlib.util.find_spec("mitsuba") is None:
        return DoctorFinding("tumble synth", "not installed", "pip install 'tumble[synth]'")
    llvm = find_llvm()
    if llvm is not None:
        return DoctorFinding("tumble synth", f"Mitsuba on LLVM {llvm[1]} ({llvm[0]})")
    fixes = {"Darwin": "brew install llvm", "Windows": "install LLVM 17 or newer from llvm.org"}
    fix = fixes.get(platform.system(), f"apt install libllvm19 (or any other libLLVM >= {MIN_LLVM})")
    return DoctorFinding(
        "tumble synth", "Mitsuba in its scalar variant: correct, but several times slower than with LLVM", fix
    )


def _compiler() -> DoctorFinding:
    compiler = next((path for name in ("c++", "g++", "clang++") if (path := shutil.which(name))), None)
    if compiler:
        return DoctorFinding("compiler", compiler)
    return DoctorFinding("compiler", "none", "optional: apt install g++ (the CPU kernels are compiled on first use)")


def _codec() -> DoctorFinding:
    import av

    encodes = "libx264" in av.codecs_available
    return DoctorFinding(
        "video",
        f"PyAV {av.__version__}, H.264 {'in and out' if encodes else 'in only'}",
        "" if encodes else "pip install -U av",
    )


def _atlas() -> DoctorFinding:
    if importlib.util.find_spec("xatlas") is None:
        return DoctorFinding(
            "export",
            "no mesh export: xatlas is not installed",
            "pip install xatlas (needs g++ if there is no wheel for this platform)",
        )
    return DoctorFinding("export", f"meshes by xatlas {importlib.metadata.version('xatlas')}")


def _extras() -> Iterator[DoctorFinding]:
    for extra, module, package in (("view", "viser", "viser"), ("cuda", "warp", "warp-lang")):
        if importlib.util.find_spec(module) is None:
            yield DoctorFinding(f"extra {extra}", "not installed", f"optional: pip install 'tumble[{extra}]'")
        else:
            yield DoctorFinding(f"extra {extra}", f"{package} {importlib.metadata.version(package)}")
