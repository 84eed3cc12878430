// What the compiler of CUDA has built in, for a C++ compiler: kernels written for a GPU then run on the CPU.
//
// Every thread of a block ("lane" within its warp) is a fiber with a stack of its own. A fiber runs until it reaches a
// collective (shuffle, vote, barrier) or an atomic operation; there another one continues, in an order that depends on
// a seed. Errors that a GPU answers with wrong numbers stop the launch with a message: see `warp_emulation.cpp`.
//
// Kernels are compiled with -fsanitize=thread, so that each of their memory accesses calls a function of the emulation.
#pragma once

#include <assert.h>
#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <utility>

// After the headers of C, which look for some of these names.
#define __CUDACC__
#define __CUDACC_RTC__
#define __CUDA_ARCH__ 900
#define __global__
#define __device__
#define __host__
// One block runs at a time.
#define __shared__ static
#define EMULATED static inline __attribute__((always_inline))
#define UNWATCHED __attribute__((noinline, no_sanitize("thread")))

struct uint3 {
    unsigned x, y, z;
};
struct alignas(16) float4 {
    float x, y, z, w;
};

namespace emulation {

constexpr unsigned LANES = 32;

enum Meeting { VOTE, SHUFFLE, SYNC_WARP, SYNC_BLOCK };

// Wait for the other lanes of the mask. Returns the votes of all lanes, or the number of lane `source`.
uint64_t meet(Meeting, unsigned mask, uint64_t number, unsigned source);

// Before an atomic operation.
void before_atomic(const void*, size_t bytes);
// Report an error and leave the launch.
[[noreturn]] void fail(const char* message);

struct Indices {
    uint3 thread, block, block_size, grid_size;
};
extern Indices indices;

template <class T> EMULATED T shuffle(unsigned mask, T x, unsigned source) {
    static_assert(sizeof(T) <= 8, "a shuffle exchanges 4 or 8 bytes");
    uint64_t bits = 0;
    memcpy(&bits, &x, sizeof(T));
    bits = meet(SHUFFLE, mask, bits, source);
    memcpy(&x, &bits, sizeof(T));
    return x;
}

// Calls a kernel with the arguments that a launch has packed.
template <auto kernel> struct Invoke;
template <class... A, void (*kernel)(A...)> struct Invoke<kernel> {
    template <size_t... I> UNWATCHED static void with(void* const* arguments, std::index_sequence<I...>) {
        kernel(*static_cast<A*>(arguments[I])...);
    }
    UNWATCHED static void with(void* const* arguments) { with(arguments, std::index_sequence_for<A...>()); }
};

}  // namespace emulation

#define threadIdx emulation::indices.thread
#define blockIdx emulation::indices.block
#define blockDim emulation::indices.block_size
#define gridDim emulation::indices.grid_size

EMULATED unsigned __ballot_sync(unsigned mask, int x) { return emulation::meet(emulation::VOTE, mask, x != 0, 0); }
EMULATED int __any_sync(unsigned mask, int x) { return emulation::meet(emulation::VOTE, mask, x != 0, 0) != 0; }
EMULATED int __all_sync(unsigned mask, int x) { return emulation::meet(emulation::VOTE, mask, x == 0, 0) == 0; }
EMULATED void __syncwarp(unsigned mask = ~0u) { emulation::meet(emulation::SYNC_WARP, mask, 0, 0); }
EMULATED void __syncthreads() { emulation::meet(emulation::SYNC_BLOCK, ~0u, 0, 0); }

template <class T> EMULATED T __shfl_sync(unsigned mask, T x, unsigned source) {
    return emulation::shuffle(mask, x, source % emulation::LANES);
}
template <class T> EMULATED T __shfl_xor_sync(unsigned mask, T x, unsigned other) {
    return emulation::shuffle(mask, x, (threadIdx.x % emulation::LANES) ^ other);
}
template <class T> EMULATED T __shfl_down_sync(unsigned mask, T x, unsigned distance) {
    unsigned lane = threadIdx.x % emulation::LANES, source = lane + distance;
    return emulation::shuffle(mask, x, source < emulation::LANES ? source : lane);
}
template <class T> EMULATED T __shfl_up_sync(unsigned mask, T x, unsigned distance) {
    unsigned lane = threadIdx.x % emulation::LANES;
    return emulation::shuffle(mask, x, lane >= distance ? lane - distance : lane);
}

#define EMULATED_ATOMIC(name, expression)                                                                              \
    template <class T> UNWATCHED T name(T* at, T x)                                                                    \
    {                                                                                                                  \
        emulation::before_atomic(at, sizeof(T));                                                                       \
        T old = *at;                                                                                                   \
        *at = expression;                                                                                              \
        return old;                                                                                                    \
    }
EMULATED_ATOMIC(atomicAdd, old + x)
EMULATED_ATOMIC(atomicMin, x < old ? x : old)
EMULATED_ATOMIC(atomicMax, x > old ? x : old)
EMULATED_ATOMIC(atomicAnd, old& x)
EMULATED_ATOMIC(atomicOr, old | x)
EMULATED_ATOMIC(atomicXor, old ^ x)
EMULATED_ATOMIC(atomicExch, x)
template <class T> UNWATCHED T atomicCAS(T* at, T expected, T x) {
    emulation::before_atomic(at, sizeof(T));
    T old = *at;
    if (old == expected)
        *at = x;
    return old;
}

EMULATED int __popc(unsigned x) { return __builtin_popcount(x); }
EMULATED int __popcll(unsigned long long x) { return __builtin_popcountll(x); }
EMULATED int __ffs(int x) { return __builtin_ffs(x); }
EMULATED int __clz(int x) { return x ? __builtin_clz(x) : 32; }
template <class T> static inline T __ldg(const T* at) { return *at; }
template <class To, class From> EMULATED To emulated_bits(From x) {
    static_assert(sizeof(To) == sizeof(From), "a number of the same size");
    To to;
    memcpy(&to, &x, sizeof(To));
    return to;
}
EMULATED int __float_as_int(float x) { return emulated_bits<int>(x); }
EMULATED unsigned __float_as_uint(float x) { return emulated_bits<unsigned>(x); }
EMULATED float __uint_as_float(unsigned x) { return emulated_bits<float>(x); }
EMULATED float __int_as_float(int x) { return emulated_bits<float>(x); }
EMULATED long long __double_as_longlong(double x) { return emulated_bits<long long>(x); }
EMULATED double __longlong_as_double(long long x) { return emulated_bits<double>(x); }
[[noreturn]] static inline void __trap() { emulation::fail("__trap() is called"); }
[[noreturn]] static inline void __brkpt() { emulation::fail("__brkpt() is called"); }
// Named by Warp's headers, used by no kernel.
float erfinvf(float), erfcinvf(float);
double erfinv(double), erfcinv(double);
