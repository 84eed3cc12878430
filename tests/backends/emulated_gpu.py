"""A GPU that `warp_emulation.cpp` emulates on the CPU, and that runs the CUDA source which Warp writes for the kernels.

The source is compiled by g++ against Warp's own headers, except for those of what no kernel uses (meshes, volumes,
textures, tiles): unlike Warp's kernels for the CPU, it takes the branches under `__CUDA_ARCH__`. Not emulated are
NVRTC, the arithmetic of the hardware, Warp's building of trees and its sorting.
"""

import ctypes
import hashlib
import importlib
import math
import pkgutil
import re
import struct
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import warp
from torch import Tensor

from tumble.backends import _cache, _native, _warp
from tumble.backends._warp import compositing, runtime

HERE = Path(__file__).parent
UNUSED_HEADERS = ("crt", "deterministic", "hashgrid", "matnn", "mesh", "noise", "svd", "texture", "tile*", "volume*")
"""Headers of Warp of which no kernel needs anything, or, for crt, that `warp_emulation.h` replaces."""
TILES = "namespace wp { struct tile_shared_storage_t { static void init() {} }; }"
"""What is left of Warp's tiles."""
FLAGS = ("-std=c++17", "-w", "-fPIC", "-march=native", "-fno-omit-frame-pointer", "-U_FORTIFY_SOURCE")
FLAGS += ("-D__assert_fail=emulated_assert_fail",)  # an assertion of Warp stops a launch, not the process
KERNEL_FLAGS = ("-O1", "-fsanitize=thread", "-fno-optimize-sibling-calls", "-fno-thread-jumps")
"""Optimisations may neither join nor copy the calls of collectives."""


class EmulationError(Exception):
    """An error of a kernel that a GPU need not report."""


@cache
def ptx_files() -> list[Path]:
    """Every module of the kernels as compiled for a GPU by Warp, in the cache; its source lies beside it."""
    names = [f"{_warp.__name__}.{found.name}" for found in pkgutil.iter_modules(_warp.__path__)]
    modules = [warp.get_module(importlib.import_module(name).__name__) for name in sorted(names)]
    factories = compositing.forward, compositing.adjoint
    modules += [make(channels).module for make in factories for channels in compositing.WIDTHS]
    folder = _cache.of_warp() / "ptx"
    found = [warp.compile_aot_module(x, arch=90, module_dir=folder, use_ptx=True) for x in modules if x.kernels]
    return [path for paths in found for path in paths]


def cuda_sources() -> list[str]:
    """The CUDA sources of all modules."""
    return [path.with_name(path.name.replace(".sm90.ptx", ".cu")).read_text("utf-8") for path in ptx_files()]


def compiled(sources: Sequence[str], folder: Path) -> ctypes.CDLL:
    """The library of the kernels in CUDA sources; what is not yet there is compiled into a folder.

    Raises:
        CannotCompile: There is no compiler.
    """
    compiler = _native.find_compiler()
    emulation = [(HERE / f"warp_emulation.{suffix}").read_text("utf-8") for suffix in ("h", "cpp")]
    common = [warp.__version__, *compiler, *FLAGS, *KERNEL_FLAGS, *emulation]

    def named(suffix: str, *parts: str) -> Path:
        return folder / f"emulated-{hashlib.sha256(chr(0).join([*common, *parts]).encode()).hexdigest()[:16]}{suffix}"

    library = named(".so", *sources)
    if library.exists():
        return ctypes.CDLL(str(library))
    objects = [named(".o", source) for source in sources]
    with tempfile.TemporaryDirectory(dir=folder) as name:
        build = Path(name)
        _write_headers(build)
        command = [*compiler, *FLAGS, "-c", "-o"]
        runs = [subprocess.Popen([*command, build / "emulation.o", "-O2", HERE / "warp_emulation.cpp"])]
        missing = {path: source for path, source in zip(objects, sources, strict=True) if not path.exists()}
        for path, source in missing.items():
            text = (build / path.name).with_suffix(".cpp")
            text.write_text(source + "".join(ENTRY.format(name) for name in kernel_names(source)), "utf-8")
            includes = "-include", HERE / "warp_emulation.h", "-I", build
            runs.append(subprocess.Popen([*command, build / path.name, *KERNEL_FLAGS, *includes, text]))
        if any([run.wait() for run in runs]):
            raise EmulationError("the compiler refuses a source; see above")
        for path in missing:
            (build / path.name).rename(path)
        partial = build / library.name
        # Modules define the same operators of the same structs.
        link = "-shared", "-Wl,--allow-multiple-definition"
        subprocess.run([*compiler, *link, build / "emulation.o", *objects, "-o", partial], check=True)
        partial.rename(library)
    return ctypes.CDLL(str(library))


ENTRY = 'extern "C" void invoke_{0}(void* const* packed) {{ emulation::Invoke<{0}>::with(packed); }}\n'


def kernel_names(source: str) -> list[str]:
    """Names of the kernels in a CUDA source."""
    return re.findall(r'extern "C" __global__ void (\w+)\(', source)


def _write_headers(folder: Path) -> None:
    for path in (Path(warp.__file__).parent / "native").glob("*.h"):
        if any(fnmatch(path.stem, name) for name in UNUSED_HEADERS):
            (folder / path.name).touch()
        else:
            (folder / path.name).symlink_to(path)
    (folder / "tile.h").write_text(TILES)


class EmulatedGpu:
    """Kernels on the emulated GPU, with tensors on the CPU."""

    def __init__(self, library: ctypes.CDLL, seed: int = 1) -> None:
        self.library = library
        self.seed = seed
        """Decides in which order lanes, warps and blocks go on."""
        self.launched: set[str] = set()
        """Names of the kernels that have run."""
        library.emulation_allow.argtypes = [ctypes.c_size_t, ctypes.c_size_t, ctypes.c_char_p]
        library.emulation_launch.restype = ctypes.c_char_p
        pointer, number = ctypes.c_void_p, ctypes.c_uint
        library.emulation_launch.argtypes = [ctypes.c_char_p, pointer, pointer, number, ctypes.c_int, number]

    def launch(self, kernel: Any, threads: int | tuple[int, int], *arguments: runtime.Argument) -> None:
        """Takes the place of `runtime.launch`."""
        parameters = kernel.adj.args
        shape = threads if isinstance(threads, tuple) else (threads,)
        n = math.prod(shape)
        # Warp's `launch_bounds_t`: shape, number of threads, threads of the same index.
        packed: list[Any] = [ctypes.create_string_buffer(struct.pack(f"@{len(shape)}IQQ", *shape, n, 1))]
        arrays = {}
        for parameter, value in zip(parameters, arguments, strict=True):
            packed.append(_packed(parameter.type, runtime.packed(parameter.type, value)))
            arrays |= _tensors(parameter.label, value)
        opaque = any(p.type is warp.uint64 for p in parameters)
        self.run(f"{kernel.get_mangled_name()}_cuda_kernel_forward", packed, n, arrays, opaque=opaque)

    def run(
        self, name: str, packed: list[Any], threads: int, arrays: dict[str, Tensor], *, opaque: bool = False
    ) -> None:
        """Run a kernel by its name.

        Args:
            name: Name in the library.
            packed: Arguments as values of ctypes.
            threads: Number of threads.
            arrays: Tensors that the kernel may access, by name.
            opaque: Whether it may read other memory, too: a tree, of which only Warp knows where it is.

        Raises:
            EmulationError: What a GPU would not report; the message is that of `warp_emulation.cpp`.
        """
        for label, x in arrays.items():
            if extent := _extent(x):
                self.library.emulation_allow(x.data_ptr(), extent, label.encode())
        pointers = (ctypes.c_void_p * len(packed))(*[ctypes.addressof(x) for x in packed])
        entry = getattr(self.library, f"invoke_{name}")
        error = self.library.emulation_launch(name.encode(), entry, pointers, threads, opaque, self.seed)
        self.launched.add(name)
        if error:
            raise EmulationError(error.decode())


def _packed(kind: Any, value: Any) -> Any:
    """The argument of a kernel as a value of ctypes."""
    scalars = {int: ctypes.c_int32, float: ctypes.c_float, warp.int32: ctypes.c_int32, warp.float32: ctypes.c_float}
    scalars |= {warp.uint64: ctypes.c_uint64, warp.float64: ctypes.c_double}
    if kind in scalars:
        return scalars[kind](value)
    return value.__ctype__() if hasattr(value, "__ctype__") else value


def _tensors(label: str, value: Any) -> dict[str, Tensor]:
    """All tensors of an argument, by name."""
    if isinstance(value, Tensor):
        return {label: value}
    if isinstance(value, Mapping):
        return {name: x for key, each in value.items() for name, x in _tensors(f"{label}.{key}", each).items()}
    if isinstance(value, list | tuple):
        return {f"{label}[{k}]": x for k, x in enumerate(value) if isinstance(x, Tensor)}
    return {}


def _extent(x: Tensor) -> int:
    """Number of bytes from the first number of a tensor to the end of the last."""
    if not x.numel():
        return 0
    last = sum((n - 1) * step for n, step in zip(x.shape, x.stride(), strict=True))
    return (last + 1) * x.element_size()
