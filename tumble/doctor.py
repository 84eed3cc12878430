"""Environment check of `tumble doctor`: hardware, libraries and extras, and how to install what is missing."""

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from tumble import __version__
from tumble.backends import origin_of_kernels
from tumble.maths import SE3, fibonacci_sphere
from tumble.rendering import rasterize
from tumble.scene import Camera, Gaussians, constant_sh, quats_from_normals
from tumble.synthetic import MIN_LLVM, find_llvm

TIMED_GAUSSIANS = 4000
"""Number of Gaussians of the scene whose rendering is timed."""


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
    return [*_machine(), _renderer(), _kernels(), _compiler(), _codec(), _atlas(), *_extras()]


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
    fixes = {"Darwin": "brew install llvm", "Windows": "install LLVM 15 or newer from llvm.org"}
    fix = fixes.get(platform.system(), f"apt install libllvm15 (or any other libLLVM >= {MIN_LLVM})")
    return DoctorFinding(
        "tumble synth", "Mitsuba in its scalar variant: correct, but several times slower than with LLVM", fix
    )


def _kernels() -> DoctorFinding:
    """Which kernels render on the CPU, and their speed on a sphere of `TIMED_GAUSSIANS`, the best of three views."""
    state, fix = origin_of_kernels()
    n, normals = TIMED_GAUSSIANS, fibonacci_sphere(TIMED_GAUSSIANS)
    log_scales, white = torch.full((n, 3), 0.02).log(), constant_sh(torch.ones(n, 3))
    sphere = Gaussians(normals, quats_from_normals(normals), log_scales, torch.zeros(n), white)
    T_cam_obj, camera = SE3.exp(torch.tensor([0.0, 0, 4, 0, 0, 0])), Camera.from_fov(0.6, 128, 128)
    seconds = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # its reason is the fix of this finding
        for _ in range(3):
            start = time.perf_counter()
            rasterize(sphere, torch.tensor(20.0), T_cam_obj, camera, {})
            seconds.append(time.perf_counter() - start)
    speed = f"{n} Gaussians at 128 x 128 pixels in {1000 * min(seconds):.3g} ms"
    return DoctorFinding("kernels", f"{state}; {speed}", fix)


def _compiler() -> DoctorFinding:
    compiler = next((path for name in ("c++", "g++", "clang++") if (path := shutil.which(name))), None)
    if compiler:
        return DoctorFinding("compiler", compiler)
    return DoctorFinding(
        "compiler", "none", "optional: apt install g++ (compiles the CPU kernels if the wheel has none)"
    )


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
    extras = {"view": ("viser", "viser"), "cuda": ("warp", "warp-lang"), "cluster": ("ray", "ray")}
    for extra, (module, package) in extras.items():
        if importlib.util.find_spec(module) is None:
            yield DoctorFinding(f"extra {extra}", "not installed", f"optional: pip install 'tumble[{extra}]'")
        else:
            yield DoctorFinding(f"extra {extra}", f"{package} {importlib.metadata.version(package)}")
