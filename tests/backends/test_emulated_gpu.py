"""The CUDA branches of the Warp kernels on the GPU that `emulated_gpu.py` emulates; first, what the emulation finds."""

import ctypes
import importlib.util
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch

from tests import test_device
from tests.backends import cases, test_backends_cuda
from tests.backends import test_backends as conformance
from tests.backends.test_backends_cuda import KERNEL_CASES
from tumble.backends import _brute, _cache, _native, cuda

if importlib.util.find_spec("warp") is None:
    pytest.skip("needs NVIDIA Warp: pip install 'tumble[cuda]'", allow_module_level=True)
if sys.platform != "linux":
    pytest.skip("fibers need the C library of Linux", allow_module_level=True)
try:
    _native.find_compiler()
except _native.CannotCompile as no_compiler:
    pytest.skip(str(no_compiler), allow_module_level=True)

import warp

from tests.backends.emulated_gpu import EmulatedGpu, EmulationError, compiled, cuda_sources
from tumble.backends._warp import runtime

SMALL_KERNELS = """
#define LANE (threadIdx.x % 32)
#define ALL 0xffffffffu

__device__ float sum(float x, int largest_step = 16)
{
    for (int step = largest_step; step; step /= 2) x += __shfl_xor_sync(ALL, x, step);
    return x;
}
KERNEL(sums) { float x = sum(in[threadIdx.x]); if (LANE == 0) atomicAdd(out, x); }
KERNEL(wrong_offset) { float x = sum(in[threadIdx.x], 8); if (LANE == 0) atomicAdd(out, x); }
KERNEL(no_atomic) { float x = sum(in[threadIdx.x]); if (LANE == 0) out[0] += x; }
KERNEL(no_lane_chosen) { out[0] = sum(in[0]); }
KERNEL(half_atomic) { if (threadIdx.x == 9) out[0] = 1; else atomicAdd(out, in[threadIdx.x]); }
KERNEL(mask_without_caller) { out[threadIdx.x] = __ballot_sync(0x0000ffffu, 1); }
KERNEL(divergent) { if (LANE < 16) out[threadIdx.x] = sum(in[threadIdx.x]); }
KERNEL(two_places) { out[threadIdx.x] = LANE < 16 ? __any_sync(ALL, 1) : __any_sync(ALL, 0); }
KERNEL(two_masks) { out[threadIdx.x] = __any_sync(LANE < 16 ? ALL : ~1u, 1); }
KERNEL(early_break)
{
    for (int i = 0; i < 40; i++) {
        if (i == LANE + 5) break;
        out[threadIdx.x] += __shfl_sync(ALL, in[threadIdx.x], 0);
    }
}
KERNEL(votes_of_the_rest)
{
    for (int i = 0; i < 40; i++) {
        if (i == LANE + 5) return;
        out[threadIdx.x] = __popc(__ballot_sync(ALL, 1));
    }
}
KERNEL(halves)
{
    unsigned mask = LANE < 16 ? 0x0000ffffu : 0xffff0000u;
    if (LANE < 16) out[threadIdx.x] = __popc(__ballot_sync(mask, LANE % 2));
    else out[threadIdx.x] = __popc(__ballot_sync(mask, 1));
}
KERNEL(neighbour) { out[threadIdx.x] = in[threadIdx.x]; in[threadIdx.x] = out[threadIdx.x ^ 1]; }
KERNEL(neighbour_after_shuffle)
{
    out[threadIdx.x] = in[threadIdx.x];
    __any_sync(ALL, 1);
    in[threadIdx.x] = out[threadIdx.x ^ 1];
}
KERNEL(neighbour_after_barrier)
{
    out[threadIdx.x] = in[threadIdx.x];
    __syncwarp();
    in[threadIdx.x] = out[threadIdx.x ^ 1];
}
KERNEL(other_warp_after_barrier)
{
    out[threadIdx.x] = in[threadIdx.x];
    __syncwarp();
    in[threadIdx.x] = out[threadIdx.x ^ 32];
}
KERNEL(block)
{
    __shared__ float part[256];
    part[threadIdx.x] = in[threadIdx.x];
    __syncthreads();
    out[threadIdx.x] = part[255 - threadIdx.x];
}
KERNEL(block_without_barrier)
{
    __shared__ float part[256];
    part[threadIdx.x] = in[threadIdx.x];
    out[threadIdx.x] = part[255 - threadIdx.x];
}
KERNEL(too_far) { out[threadIdx.x + 1] = 1; }
KERNEL(register_of_another)
{
    float x = LANE;
    float* all = (float*)__shfl_sync(ALL, (unsigned long long)&x, 0);
    out[threadIdx.x] = *all;
}
"""
"""Correct kernels and wrong ones, for one block of 256 threads; `KERNEL` stands for what they have in common."""

WRONG = {
    "no_atomic": "byte 0 of out, which thread .* (read|wrote) without a barrier",
    "no_lane_chosen": "writes byte 0 of out, which thread .* wrote without a barrier",
    "half_atomic": "byte 0 of out, which thread .* (wrote|changed) without a barrier",
    "mask_without_caller": "not in the mask",
    "divergent": "in which lane .* reads from lane .*, which is not there",
    "two_places": "meet at different places",
    "two_masks": "meet at different masks",
    "early_break": "reads from lane 0, which is not there",
    "neighbour": "of (in|out), which thread .* (read|wrote) without a barrier",
    "neighbour_after_shuffle": "of (in|out), which thread .* (read|wrote) without a barrier",
    "other_warp_after_barrier": "of (in|out), which thread .* (read|wrote) without a barrier",
    "block_without_barrier": "of shared memory, which thread .* (read|wrote) without a barrier",
    "too_far": "writes 4 bytes outside all arrays",
    "register_of_another": "reads the stack of another lane",
}
"""Kernels with an error that a GPU need not report, and its message."""

SEEDS = range(1, 6)
"""Orders of threads that are tried."""
LONG = (
    conformance.test_visibility_bits_and_blockers_are_those_of_brute_force,
    conformance.test_a_convex_object_hardly_shadows_itself,
)
"""Conformance tests that take more than two seconds."""
stages = test_device.stages


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    """All kernels; those that are not in the cache are compiled, which takes half a minute for all of them."""
    if 90 not in warp.get_cuda_supported_archs():
        pytest.skip("this build of Warp has no compiler for sm_90")
    common = r'extern "C" __global__ void \1(float* out, float* in)'
    small = re.sub(r"KERNEL\((\w+)\)", common, SMALL_KERNELS)
    return compiled([small, *cuda_sources()], _cache.of_warp())


def run(library: ctypes.CDLL, name: str, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The two arrays of a small kernel after it has run."""
    arrays = {"out": torch.zeros(256), "in": torch.arange(256.0)}
    packed = [ctypes.c_void_p(x.data_ptr()) for x in arrays.values()]
    EmulatedGpu(library, seed).run(name, packed, 256, arrays)
    return arrays["out"], arrays["in"]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_emulation_computes_what_a_gpu_would(library: ctypes.CDLL, seed: int) -> None:
    lanes = torch.arange(256)
    assert run(library, "sums", seed)[0][0] == 255 * 128
    assert run(library, "wrong_offset", seed)[0][0] != 255 * 128
    # A vote counts the lanes that are still there.
    assert torch.equal(run(library, "votes_of_the_rest", seed)[0], (lanes % 32).flip(0) + 1.0)
    assert torch.equal(run(library, "halves", seed)[0], torch.where(lanes % 32 < 16, 8.0, 16.0))
    assert torch.equal(run(library, "neighbour_after_barrier", seed)[1], (lanes ^ 1).float())
    assert torch.equal(run(library, "block", seed)[0], 255.0 - lanes)


@pytest.mark.parametrize("name", WRONG)
def test_the_emulation_finds_errors(library: ctypes.CDLL, name: str) -> None:
    for seed in SEEDS:
        with pytest.raises(EmulationError, match=f"^{name}.*{WRONG[name]}"):
            run(library, name, seed)


@pytest.fixture
def gpu(library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> Iterator[EmulatedGpu]:
    """The emulated GPU with the kernels of the package, in the place of Warp's kernels for the CPU.

    Memory that is not initialised holds NaN or the largest integer.
    """
    emulated = EmulatedGpu(library)
    monkeypatch.setattr(runtime, "launch", emulated.launch)
    torch.use_deterministic_algorithms(True)
    yield emulated
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize(
    "case",
    [pytest.param(x, marks=pytest.mark.slow if x[0] in LONG else ()) for x in KERNEL_CASES],
    ids=lambda case: "-".join([case[0].__name__, *map(str, case[1:])]),
)
def test_the_kernels_conform_on_the_emulated_gpu(gpu: EmulatedGpu, case: tuple[Callable[..., None], ...]) -> None:
    check, *arguments = case
    check(cuda, *arguments)
    assert gpu.launched


def test_visibility_and_blockers_are_those_of_warp_on_the_cpu(
    gpu: EmulatedGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = cuda.build(*(x.float() for x in cases.shell(300)))
    normals = cases.fibonacci(40).float()
    points, directions = -1.5 * normals, cases.fibonacci(75).float()

    def traced() -> tuple[torch.Tensor, torch.Tensor]:
        bits = cuda.visible(tree, points, normals, directions)
        return _brute.unpack(bits, 75), cuda.blockers(tree, points, normals, directions, bits)

    bits, blockers = traced()
    assert len(gpu.launched) == 3
    monkeypatch.undo()
    for found, expected in zip((bits, blockers), traced(), strict=True):
        assert len(expected.unique()) > 1
        assert (found != expected).sum() <= 3  # transmittances within rounding of one half


def test_tile_lists_are_written_as_far_as_there_is_room(gpu: EmulatedGpu) -> None:
    test_backends_cuda.test_tile_lists_with_room_for_more_are_the_same_and_those_with_too_little_say_so(cuda)
    assert len(gpu.launched) == 2


@pytest.mark.parametrize(
    ("scene", "seeds"), [("easy", (1, 2)), pytest.param("hard", SEEDS, marks=pytest.mark.slow)], ids=["easy", "hard"]
)
def test_the_order_of_threads_changes_nothing_but_rounding(gpu: EmulatedGpu, scene: str, seeds: Sequence[int]) -> None:
    views = []
    for gpu.seed in seeds:
        views.append(cases.render(cuda, cases.SCENES[scene](), torch.float32))
    (view, gradients), *others = views
    for again, gradients_again in others:
        for name in ("rgb", "features", "touched", "dominant"):
            assert torch.equal(getattr(view, name), getattr(again, name))
        pairs = zip([view.weight, *gradients], [again.weight, *gradients_again], strict=True)
        # A sum of a few thousand numbers, each rounded to 6e-8.
        assert max(cases.difference(a, b) for a, b in pairs) < 1e-5


@pytest.mark.slow
@test_device.each_stage
def test_steps_on_the_emulated_gpu_are_those_of_the_cpu(
    number: int, stages: list[Any], gpu: EmulatedGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    test_device.test_steps_with_the_kernels_for_a_gpu_are_those_of_the_cpu(number, stages, monkeypatch)
    assert len(gpu.launched) >= 20
