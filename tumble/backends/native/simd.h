// SIMD vectors of the machine's width through the vector extensions of GCC and Clang. No header is included, so that a
// compiler without a C library suffices. Vectors wider than the machine's would be compiled to slow code.
//
// A mask is an integer vector of 0 and -1. Never compile with -ffast-math, which removes the rounding trick of `vexp`.
#pragma once

#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define LANES 16
#elif defined(__AVX2__)
#define LANES 8
#else
#define LANES 4
#endif

typedef float vf __attribute__((vector_size(4 * LANES)));
typedef int vi __attribute__((vector_size(4 * LANES)));
typedef float vf_loose __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef unsigned char u8;
typedef unsigned int u32;
typedef long long i64;

// The lanes of a vector are a block of pixels, BLOCK_W wide.
enum { BLOCK_W = 4, BLOCK_H = LANES / 4 };

#define INLINE static inline __attribute__((always_inline))
#define METHOD inline __attribute__((always_inline))

#if defined(__clang__)
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, vi{__VA_ARGS__})
#endif

INLINE vf splat(float x) { return x - vf{}; }
INLINE vi splat(int x) { return x - vi{}; }
INLINE vf load(const float* p) { return *(const vf_loose*)p; }
INLINE void store(float* p, vf x) { *(vf_loose*)p = x; }
INLINE vf pick(vi m, vf a, vf b) { return m ? a : b; }
INLINE vf keep(vi m, vf a) { return m ? a : vf{}; }
INLINE vf vmax(vf a, vf b) { return a > b ? a : b; }
INLINE vf vmin(vf a, vf b) { return a < b ? a : b; }
INLINE float fmax2(float a, float b) { return a > b ? a : b; }
INLINE float fmin2(float a, float b) { return a < b ? a : b; }
INLINE int imax2(int a, int b) { return a > b ? a : b; }
INLINE int imin2(int a, int b) { return a < b ? a : b; }

INLINE vi lane_index() {
    vi x;
    for (int i = 0; i < LANES; i++) x[i] = i;
    return x;
}

INLINE vf vsqrt(vf x) {
    vf y;
    for (int i = 0; i < LANES; i++) y[i] = __builtin_sqrtf(x[i]);
    return y;
}

// A mask as an integer with one bit per lane.
INLINE u32 bits(vi m) {
#if LANES == 16 && !defined(__clang__)
    typedef int v16si __attribute__((vector_size(64)));
    return (unsigned short)__builtin_ia32_ptestmd512((v16si)m, (v16si)m, -1);
#elif LANES == 8
    typedef float v8sf __attribute__((vector_size(32)));
    return (u32)__builtin_ia32_movmskps256((v8sf)m);
#elif LANES == 4 && defined(__SSE__)
    typedef float v4sf __attribute__((vector_size(16)));
    return (u32)__builtin_ia32_movmskps((v4sf)m);
#else
    u32 b = 0;
    for (int i = 0; i < LANES; i++) b |= (u32)(m[i] & 1) << i;
    return b;
#endif
}

INLINE bool any(vi m) {
#if LANES == 4 && !defined(__SSE__)
    typedef i64 v2di __attribute__((vector_size(16)));
    v2di x = (v2di)m;
    return (x[0] | x[1]) != 0;
#else
    return bits(m) != 0;
#endif
}

// e^x for -87 < x < 88, relative error 2e-7.
INLINE vf vexp(vf x) {
    vf y = x * 1.44269504f, t = y + 12582912.f, f = y - (t - 12582912.f);
    vf p = f * 1.327647042e-3f + 9.675541618e-3f;
    p = p * f + 5.550713281e-2f;
    p = p * f + 2.402211972e-1f;
    p = p * f + 6.931469671e-1f;
    p = p * f + 1.000000072f;
    return (vf)((vi)p + ((vi)t << 23));
}

// Natural logarithm of a positive normal number, absolute error 1e-6.
INLINE vf vlog(vf x) {
    vi shifted = (vi)x - 0x3f2aaaab;
    vi e = shifted >> 23;
    vf m = (vf)((shifted & 0x7fffff) + 0x3f2aaaab) - 1.0f;
    vf p = m * 1.706645699e-1f - 1.940893597e-1f;
    p = p * m + 1.980253135e-1f;
    p = p * m - 2.484151960e-1f;
    p = p * m + 3.333767477e-1f;
    p = p * m - 5.000224536e-1f;
    p = p * m + 1.0f;
    return p * m + __builtin_convertvector(e, vf) * 0.693147181f;
}

#if LANES == 16
INLINE vf zip_low(vf a, vf b) { return SHUFFLE(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23); }
INLINE vf zip_high(vf a, vf b) { return SHUFFLE(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31); }
INLINE vf fold1(vf a, vf b) {
    vf x = SHUFFLE(a, b, 0, 17, 2, 19, 4, 21, 6, 23, 8, 25, 10, 27, 12, 29, 14, 31);
    return x + SHUFFLE(a, b, 1, 16, 3, 18, 5, 20, 7, 22, 9, 24, 11, 26, 13, 28, 15, 30);
}
INLINE vf fold2(vf a, vf b) {
    vf x = SHUFFLE(a, b, 0, 1, 18, 19, 4, 5, 22, 23, 8, 9, 26, 27, 12, 13, 30, 31);
    return x + SHUFFLE(a, b, 2, 3, 16, 17, 6, 7, 20, 21, 10, 11, 24, 25, 14, 15, 28, 29);
}
INLINE vf fold4(vf a, vf b) {
    vf x = SHUFFLE(a, b, 0, 1, 2, 3, 20, 21, 22, 23, 8, 9, 10, 11, 28, 29, 30, 31);
    return x + SHUFFLE(a, b, 4, 5, 6, 7, 16, 17, 18, 19, 12, 13, 14, 15, 24, 25, 26, 27);
}
INLINE vf fold8(vf a, vf b) {
    vf x = SHUFFLE(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 24, 25, 26, 27, 28, 29, 30, 31);
    return x + SHUFFLE(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23);
}
#elif LANES == 8
INLINE vf zip_low(vf a, vf b) { return SHUFFLE(a, b, 0, 8, 1, 9, 2, 10, 3, 11); }
INLINE vf zip_high(vf a, vf b) { return SHUFFLE(a, b, 4, 12, 5, 13, 6, 14, 7, 15); }
INLINE vf fold1(vf a, vf b) {
    return SHUFFLE(a, b, 0, 9, 2, 11, 4, 13, 6, 15) + SHUFFLE(a, b, 1, 8, 3, 10, 5, 12, 7, 14);
}
INLINE vf fold2(vf a, vf b) {
    return SHUFFLE(a, b, 0, 1, 10, 11, 4, 5, 14, 15) + SHUFFLE(a, b, 2, 3, 8, 9, 6, 7, 12, 13);
}
INLINE vf fold4(vf a, vf b) {
    return SHUFFLE(a, b, 0, 1, 2, 3, 12, 13, 14, 15) + SHUFFLE(a, b, 4, 5, 6, 7, 8, 9, 10, 11);
}
#else
INLINE vf zip_low(vf a, vf b) { return SHUFFLE(a, b, 0, 4, 1, 5); }
INLINE vf zip_high(vf a, vf b) { return SHUFFLE(a, b, 2, 6, 3, 7); }
INLINE vf fold1(vf a, vf b) { return SHUFFLE(a, b, 0, 5, 2, 7) + SHUFFLE(a, b, 1, 4, 3, 6); }
INLINE vf fold2(vf a, vf b) { return SHUFFLE(a, b, 0, 1, 6, 7) + SHUFFLE(a, b, 2, 3, 4, 5); }
#endif

// Lane i of x[j] becomes lane j of x[i]: interleaving both halves rotates the bits of the index of an element by one.
INLINE void transpose(vf* x) {
#pragma GCC unroll 4
    for (int bit = 1; bit < LANES; bit *= 2) {
        vf y[LANES];
#pragma GCC unroll 8
        for (int i = 0; i < LANES / 2; i++)
            y[2 * i] = zip_low(x[i], x[i + LANES / 2]), y[2 * i + 1] = zip_high(x[i], x[i + LANES / 2]);
#pragma GCC unroll 16
        for (int i = 0; i < LANES; i++) x[i] = y[i];
    }
}

// Lane i of the result is the sum of the lanes of x[i]: a transposed reduction with three operations per sum.
INLINE vf sums_of(const vf* x) {
    vf a[LANES / 2];
    for (int i = 0; i < LANES / 2; i++) a[i] = fold1(x[2 * i], x[2 * i + 1]);
    for (int i = 0; i < LANES / 4; i++) a[i] = fold2(a[2 * i], a[2 * i + 1]);
#if LANES >= 8
    for (int i = 0; i < LANES / 8; i++) a[i] = fold4(a[2 * i], a[2 * i + 1]);
#endif
#if LANES >= 16
    a[0] = fold8(a[0], a[1]);
#endif
    return a[0];
}

INLINE float sum_of(vf x) {
    float s = 0;
    for (int i = 0; i < LANES; i++) s += x[i];
    return s;
}

INLINE void clear(void* p, i64 bytes) {
    if (bytes) __builtin_memset(p, 0, bytes);   // p may be null if bytes is 0
}
