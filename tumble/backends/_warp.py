"""What the Warp kernels share: their start, launches on torch's stream, and sums over lanes.

A *lane* is one of 32 GPU threads in step. Where pixels add to the same number, their lanes add to each other first and
one of them to memory: native code on a GPU. On the CPU, where Warp runs one thread after the other, these are plain
additions; so the same kernels compute the same thing, and are tested, on machines without a GPU.

Compiled kernels go to the folder of the CPU's ones unless $WARP_CACHE_PATH names another.
"""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import torch
import warp as wp
from torch import Tensor

from tumble.backends import _cache

LANES = 32

if "WARP_CACHE_PATH" not in os.environ and wp.config.kernel_cache_dir is None:
    wp.config.kernel_cache_dir = str(_cache.writable() / "warp")
# No greeting; what goes wrong is still said.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
wp.init()

X = TypeVar("X", bound=Callable[..., Any])


def no_type_check(warped: X) -> X:
    """Marks a function or struct in Warp's language for the shape checker of the tests, which goes by this name.

    `typing.no_type_check` would hide the annotations from Warp as well.
    """
    return warped


def stream(device: torch.device) -> AbstractContextManager[Any]:
    """Inside, Warp works on a device in torch's current stream."""
    if device.type != "cuda":
        return wp.ScopedDevice(str(device))
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)


def launch(kernel: Any, threads: int | tuple[int, int], *arguments: Tensor | float | wp.uint64) -> None:
    """Run a kernel over tensors, on their device; inside `stream` only."""
    wp.launch(kernel, threads, inputs=[_argument(p, x) for p, x in zip(kernel.adj.args, arguments, strict=True)])


def _argument(parameter: Any, value: Tensor | float | wp.uint64) -> Any:
    if not isinstance(value, Tensor):
        return value
    return wp.from_torch(value.detach(), parameter.type.dtype, requires_grad=False, return_ctype=True)


vec32 = wp.types.vector(length=LANES, dtype=float)
"""What one lane adds to a row."""


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
    """Whether x holds in any lane. All lanes must ask."""
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
    """Add every lane's x to out[i]. All lanes must call, with the same i."""
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
    """Add the number of lanes in which x holds to out[i]. All lanes must call, with the same i."""
    ...


@wp.func_native(
    """
    float* to = out.data + (size_t)row * out.shape[1] + column;
#if defined(__CUDA_ARCH__)
    // Halves change places between lanes 16 apart, quarters between lanes 8 apart, and so on: lane i ends with the sum
    // of x[i]. Loop bounds are constants, so that x stays in registers.
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
    """Add the first numbers of every lane's x to out[row, column:]. All lanes must call, with the same place."""
    ...
