"""Common parts of the Warp kernels: initialisation, launches on torch's stream, and sums over lanes.

A *lane* is one of the 32 threads of a GPU warp. When the pixels of a warp add to the same number, lanes are summed
first and one of them adds the sum to memory, by native code on a GPU. On the CPU, where Warp runs one thread after
another, these functions are plain additions, so that the same kernels can be tested on machines without a GPU; their
native code for a GPU is tested on an emulated one (`tests/backends/emulated_gpu.py`).

Compiled kernels are cached in the folder of the CPU kernels unless $WARP_CACHE_PATH is set.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any, TypeVar

import torch
import warp as wp
from torch import Tensor

from tumble.backends import _cache

LANES = 32
"""Threads of a GPU warp."""

if "WARP_CACHE_PATH" not in os.environ and wp.config.kernel_cache_dir is None:
    wp.config.kernel_cache_dir = str(_cache.of_warp())
# Suppresses Warp's banner, but not its warnings.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
wp.init()

X = TypeVar("X", bound=Callable[..., Any])


def no_type_check(warped: X) -> X:
    """Decorator that excludes Warp functions and structs from the shape checks of the tests, which look for its name.

    `typing.no_type_check` cannot be used because it would also hide the annotations from Warp.
    """
    return warped


def stream(device: torch.device) -> AbstractContextManager[Any]:
    """Context in which Warp uses torch's current stream on a device."""
    if device.type != "cuda":
        return wp.ScopedDevice(str(device))
    return wp.ScopedStream(_stream_of(torch.cuda.current_stream(device)), sync_enter=False)


@cache
def _stream_of(stream: torch.cuda.Stream) -> Any:
    """A stream of torch as one of Warp; kept, since Warp forgets what it holds for a stream when the object ends."""
    return wp.stream_from_torch(stream)


@contextmanager
def told_of_capture(device: torch.device) -> Iterator[list[Any]]:
    """Context in which Warp knows that torch captures its current stream; afterwards the list holds Warp's graph.

    Kernels stay loaded as long as that exists.
    """
    graph: list[Any] = []
    with stream(device):
        wp.capture_begin(force_module_load=False, external=True)
        try:
            yield graph
        finally:
            graph.append(wp.capture_end())


Argument = Tensor | float | wp.uint64 | Sequence[Any] | Mapping[str, Any]
"""Argument of a kernel: a tensor for an array, a mapping for a struct, a sequence of numbers for a vector or of tensors
for `Addresses`, or a number."""


def launch(kernel: Any, threads: int | tuple[int, int], *arguments: Argument) -> None:
    """Launch a kernel; must be called within `stream`."""
    wp.launch(kernel, threads, inputs=[packed(p.type, x) for p, x in zip(kernel.adj.args, arguments, strict=True)])


def packed(kind: Any, value: Argument) -> Any:
    """An argument of a kernel as Warp takes it, without copies."""
    if isinstance(value, Tensor):
        array = value.detach() if value.ndim else value.detach()[None]
        return wp.from_torch(array, kind.dtype, requires_grad=False, return_ctype=True)
    if isinstance(value, Mapping):
        fields = {name: packed(variable.type, value[name]) for name, variable in kind.vars.items()}
        return _PackedStruct(kind.ctype(**fields))
    if isinstance(value, Sequence):
        numbers = [x.data_ptr() if isinstance(x, Tensor) else x for x in value]
        return kind(*numbers, *[numbers[-1]] * (kind._length_ - len(numbers)))
    return value


class _PackedStruct:
    """What Warp asks of a struct."""

    def __init__(self, value: Any) -> None:
        self.__ctype__ = lambda: value


Addresses = wp.types.vector(length=16, dtype=wp.uint64)
"""Addresses of tensors of float32, which `numbers` reads; a shorter list ends with repetitions of its last one."""


@wp.func
@no_type_check
def numbers(address: wp.uint64) -> wp.array[float]:
    """The numbers of a contiguous tensor from its address on."""
    return wp.array(ptr=address, shape=(1 << 30,), dtype=float)  # type: ignore


def whole_warps(n: int) -> int:
    """The number of threads, at least n, that fills warps."""
    return -(-n // LANES) * LANES


vec32 = wp.types.vector(length=LANES, dtype=float)
"""Numbers that one lane adds to a row."""


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, x);
#else
    return x;
#endif
"""
)
def any_lane(x: bool) -> bool:
    """Whether x is true in any lane. All lanes must call this function."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int step = 16; step; step /= 2) x += __shfl_xor_sync(0xffffffffu, x, step);
    if ((threadIdx.x & 31) == 0) atomicAdd(out.data + i, x);
#else
    out.data[i] += x;
#endif
"""
)
@no_type_check
def add_lanes(out: wp.array[float], i: int, x: float):
    """Add the sum of x over all lanes to out[i]. All lanes must call this function with the same i."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    int count = __popc(__ballot_sync(0xffffffffu, x));
    if ((threadIdx.x & 31) == 0) atomicAdd(out.data + i, count);
#else
    out.data[i] += x;
#endif
"""
)
@no_type_check
def count_lanes(out: wp.array[int], i: int, x: bool):
    """Add the number of lanes in which x is true to out[i]. All lanes must call this function with the same i."""
    ...


@wp.func_native(
    """
    int* to = out.data + (size_t)row * out.shape[1] + (column >> 5);
#if defined(__CUDA_ARCH__)
    int word = __ballot_sync(0xffffffffu, x);
    if ((threadIdx.x & 31) == 0) *to = word;
#else
    *to = (column & 31 ? *to : 0) | (int)((unsigned)x << (column & 31));
#endif
"""
)
@no_type_check
def write_lanes(out: wp.array2d[int], row: int, column: int, x: bool):  # type: ignore
    """Write x as bit `column % 32` of out[row, column // 32]; lanes have 32 columns of a word in their order.

    All lanes must call this function, with the same row.
    """
    ...


@wp.func_native(
    """
    float* to = out.data + (size_t)row * out.shape[1] + column;
#if defined(__CUDA_ARCH__)
    // Butterfly reduction: lanes 16 apart exchange halves of x, lanes 8 apart exchange quarters, and so on, so that
    // lane i ends with the sum of x[i]. Loop bounds are constants, so that x stays in registers.
    int lane = threadIdx.x & 31;
    #pragma unroll
    for (int step = 4; step >= 0; step--) {
        const int half = 1 << step;
        const bool upper = lane & half;
        #pragma unroll
        for (int i = 0; i < 16; i++) {
            if (i >= half) continue;
            float give = upper ? x[i] : x[i + half], keep = upper ? x[i + half] : x[i];
            x[i] = keep + __shfl_xor_sync(0xffffffffu, give, half);
        }
    }
    if (lane < count) atomicAdd(to + lane, x[0]);
#else
    for (int i = 0; i < count; i++) to[i] += x[i];
#endif
"""
)
@no_type_check
def add_row(out: wp.array2d[float], row: int, column: int, count: int, x: vec32):  # type: ignore
    """Add the sum over all lanes of the first `count` numbers of x to out[row, column:].

    All lanes must call this function with the same row, column and count.
    """
    ...
