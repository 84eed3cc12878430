"""Compile the CPU kernels of `native/` with the Clang inside NVIDIA Warp, for machines without a C++ compiler.

The kernels become the preamble of a Warp module. The result is not linked to any library, so the only Warp kernel of
the module exchanges addresses: it receives those of the system's thread functions and returns those of the entry
points. Warp caches the object file by the source text, its own version and the processor, in the folder that
`_warp/runtime.py` sets.
"""

import ctypes
import os
from types import SimpleNamespace

import warp as wp

from tumble.backends._cache import SOURCES
from tumble.backends._warp import runtime

ENTRY_POINTS = (
    *("lanes", "sizes", "raster_prepare", "raster_forward", "raster_adjoint", "bvh_build"),
    *("rays_trace", "rays_visible", "rays_blockers", "shade_forward", "shade_adjoint"),
    *("sh_shade_forward", "sh_shade_adjoint", "image_loss", "gaussian_loss"),
    *("lookup_forward", "lookup_backward", "material_forward", "material_adjoint"),
    *("bounce_forward", "bounce_adjoint", "material_loss", "relight_points"),
    *("maps_fuse", "maps_blend"),
    *("activation_forward", "activation_adjoint", "adam", "shading_loss"),
    *("prefilter_forward", "prefilter_backward"),
    *("bundle_cost", "bundle_reduce", "bundle_move"),
)
"""Functions that `native/kernels.cpp` exports."""
FROM_SYSTEM = (
    *("pthread_create", "pthread_mutex_init", "pthread_mutex_lock", "pthread_mutex_unlock"),
    *("pthread_cond_init", "pthread_cond_wait", "pthread_cond_broadcast", "getpid", "sched_yield"),
)
"""System functions that `native/parallel.h` calls on POSIX systems; on others it uses one thread."""

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
@runtime.no_type_check
def _swap(given: wp.array[wp.uint64], taken: wp.array[wp.uint64]): ...


@wp.kernel
@runtime.no_type_check
def _exchange(given: wp.array[wp.uint64], taken: wp.array[wp.uint64]):
    _swap(given, taken)


def library() -> SimpleNamespace:
    """The compiled kernels, with the same functions as the shared library; passes on all exceptions of Warp."""
    addresses = [ctypes.cast(getattr(ctypes.CDLL(None), name), ctypes.c_void_p).value for name in _used]
    given = wp.array(addresses or [0], dtype=wp.uint64, device="cpu")
    taken = wp.zeros(len(ENTRY_POINTS), dtype=wp.uint64, device="cpu")
    wp.launch(_exchange, 1, inputs=[given, taken], device="cpu")
    function = ctypes.CFUNCTYPE(ctypes.c_int)
    return SimpleNamespace(**{x: function(int(a)) for x, a in zip(ENTRY_POINTS, taken.numpy(), strict=True)})
