"""The kernels of `native/` through the Clang that Warp brings, for machines without a compiler.

They become the preamble of a Warp module whose one Warp kernel exchanges addresses: what Clang makes here is linked to
nothing, so it is given the system's thread functions and gives its own entry points in return. Warp caches the object
file, by the text of the kernels, its own version and the processor, in the folder that `_warp` names.
"""

import ctypes
import os
from types import SimpleNamespace

import warp as wp

from tumble.backends import _warp
from tumble.backends._cache import SOURCES

ENTRY_POINTS = (
    *("lanes", "sizes", "raster_prepare", "raster_forward", "raster_adjoint", "bvh_build"),
    *("rays_trace", "rays_visible", "rays_blockers", "shade_forward", "shade_adjoint"),
)
FROM_SYSTEM = (
    *("pthread_create", "pthread_mutex_init", "pthread_mutex_lock", "pthread_mutex_unlock"),
    *("pthread_cond_init", "pthread_cond_wait", "pthread_cond_broadcast", "getpid"),
)
"""What `native/parallel.h` calls on POSIX; elsewhere it makes do with one thread."""

_used = FROM_SYSTEM if os.name == "posix" else ()

wp.set_module_options(
    {
        "enable_backward": False,
        "mode": "release",
        "optimization_level": 3,
        "cpu_compiler_flags": "-march=native",
        "extra_build_options": wp.ModuleBuildOptions(
            extra_cpu_include_dirs=[SOURCES],
            extra_cpu_preamble='#define JUST_IN_TIME\nnamespace tumble {\n#include "kernels.cpp"\n}\n',
            extra_build_dependencies=sorted(path for path in SOURCES.iterdir() if path.suffix in (".h", ".cpp")),
        ),
    }
)


@wp.func_native(
    "".join(f"tumble::{x} = (decltype(tumble::{x}))given.data[{i}];\n" for i, x in enumerate(_used))
    + "".join(f"taken.data[{i}] = (uint64_t)&tumble::{x};\n" for i, x in enumerate(ENTRY_POINTS))
)
@_warp.no_type_check
def _swap(given: wp.array[wp.uint64], taken: wp.array[wp.uint64]): ...


@wp.kernel
@_warp.no_type_check
def _exchange(given: wp.array[wp.uint64], taken: wp.array[wp.uint64]):
    _swap(given, taken)


def library() -> SimpleNamespace:
    """The compiled kernels, called as those of a shared library are; raises what Warp raises."""
    addresses = [ctypes.cast(getattr(ctypes.CDLL(None), name), ctypes.c_void_p).value for name in _used]
    given = wp.array(addresses or [0], dtype=wp.uint64, device="cpu")
    taken = wp.zeros(len(ENTRY_POINTS), dtype=wp.uint64, device="cpu")
    wp.launch(_exchange, 1, inputs=[given, taken], device="cpu")
    function = ctypes.CFUNCTYPE(ctypes.c_int)
    return SimpleNamespace(**{x: function(int(a)) for x, a in zip(ENTRY_POINTS, taken.numpy(), strict=True)})
