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
typedef unsigned vu __attribute__((vector_size(4 * LANES)));
typedef float vf_loose __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef unsigned char u8;
typedef unsigned int u32;
typedef long long i64;

#define INLINE static inline __attribute__((always_inline))
// Loops that keep many vectors in registers are functions of their own: merged into one, GCC moves some to memory.
#define APART static __attribute__((noinline))
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
// a > b ? a : b and a < b ? a : b, for which GCC needs to be told that there is one instruction.
#if defined(__clang__) || !defined(__SSE__)
INLINE vf vmax(vf a, vf b) { return a > b ? a : b; }
INLINE vf vmin(vf a, vf b) { return a < b ? a : b; }
#elif LANES == 16
INLINE vf vmax(vf a, vf b) { return __builtin_ia32_maxps512_mask(a, b, a, -1, 4); }
INLINE vf vmin(vf a, vf b) { return __builtin_ia32_minps512_mask(a, b, a, -1, 4); }
#elif LANES == 8
INLINE vf vmax(vf a, vf b) { return __builtin_ia32_maxps256(a, b); }
INLINE vf vmin(vf a, vf b) { return __builtin_ia32_minps256(a, b); }
#else
INLINE vf vmax(vf a, vf b) { return __builtin_ia32_maxps(a, b); }
INLINE vf vmin(vf a, vf b) { return __builtin_ia32_minps(a, b); }
#endif
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

// Writes the lanes of a mask, given as bits, one after the other; what follows them is undefined up to LANES numbers.
INLINE void pack(float* p, u32 lanes, vf x) {
#if LANES == 16
    typedef float v16sf __attribute__((vector_size(64)));
    store(p, (vf)__builtin_ia32_compresssf512_mask((v16sf)x, (v16sf)x, (unsigned short)lanes));
#else
    for (; lanes; lanes &= lanes - 1) *p++ = x[__builtin_ctz(lanes)];
#endif
}

// 1 / x to the last bit or two; a division would take as long as ten multiplications.
INLINE vf inverse(vf x) {
#if LANES == 16
    typedef float v16sf __attribute__((vector_size(64)));
    vf y = (vf)__builtin_ia32_rcp14ps512_mask((v16sf)x, (v16sf)x, -1);
    return y + y * (1.0f - x * y);
#else
    return 1.0f / x;
#endif
}

// 2^x for -126 < x < 127 and e^x for -87 < x < 88, relative error 2e-7.
INLINE vf vexp2(vf x) {
    vf t = x + 12582912.f, f = x - (t - 12582912.f);
    vf p = f * 1.327647042e-3f + 9.675541618e-3f;
    p = p * f + 5.550713281e-2f;
    p = p * f + 2.402211972e-1f;
    p = p * f + 6.931469671e-1f;
    p = p * f + 1.000000072f;
    return (vf)((vu)p + ((vu)t << 23));   // unsigned, because lanes that are not needed may overflow
}
INLINE vf vexp(vf x) { return vexp2(x * 1.44269504f); }

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

// The numbers from 0 to N - 1 as template arguments, with which the lanes of a shuffle are named.
template <int... I>
struct Indices {};
template <int N, int... I>
struct Count : Count<N - 1, N - 1, I...> {};
template <int... I>
struct Count<0, I...> : Indices<I...> {};
typedef Count<LANES> Lanes;

// The lower (0) or upper (1) halves of two vectors, interleaved.
template <int half, int... I>
INLINE vf zip(vf a, vf b, Indices<I...>) {
    return SHUFFLE(a, b, (I % 2 * LANES + I / 2 + half * LANES / 2)...);
}
// Sums of pairs of lanes `step` apart: those of a in lanes whose number lacks that bit, those of b in the others.
template <int step, int... I>
INLINE vf fold(vf a, vf b, Indices<I...>) {
    return SHUFFLE(a, b, (I & step ? LANES + I : I)...) + SHUFFLE(a, b, (I & step ? LANES + I - step : I + step)...);
}
// Every third or fourth number, from number `first` on, of vectors that follow each other.
template <int first, int... I>
INLINE vf every(vf a, vf b, vf c, Indices<I...>) {
    vf ab = SHUFFLE(a, b, ((3 * I + first) % (2 * LANES))...);
    return SHUFFLE(ab, c, (3 * I + first < 2 * LANES ? I : 3 * I + first - LANES)...);
}
template <int first, int... I>
INLINE vf every(vf a, vf b, vf c, vf d, Indices<I...>) {
    vf ab = SHUFFLE(a, b, ((4 * I + first) % (2 * LANES))...), cd = SHUFFLE(c, d, ((4 * I + first) % (2 * LANES))...);
    return SHUFFLE(ab, cd, (I < LANES / 2 ? I : LANES + I)...);
}
// The inverse: vector `which` of the numbers x0 y0 z0 x1 y1 ... or x0 y0 z0 w0 x1 ...
template <int which, int... I>
INLINE vf woven(vf x, vf y, vf z, Indices<I...>) {
    vf xy = SHUFFLE(x, y, ((which * LANES + I) % 3 % 2 * LANES + (which * LANES + I) / 3)...);
    return SHUFFLE(xy, z, ((which * LANES + I) % 3 == 2 ? LANES + (which * LANES + I) / 3 : I)...);
}
template <int which, int... I>
INLINE vf woven(vf x, vf y, vf z, vf w, Indices<I...>) {
    vf xy = SHUFFLE(x, y, (I % 2 * LANES + (which * LANES + I) / 4)...);
    vf zw = SHUFFLE(z, w, (I % 2 * LANES + (which * LANES + I) / 4)...);
    return SHUFFLE(xy, zw, (I % 4 < 2 ? I : LANES + I)...);
}

// Lane i of x[j] becomes lane j of x[i]: interleaving both halves rotates the bits of the index of an element by one.
INLINE void transpose(vf* x) {
#pragma GCC unroll 4
    for (int bit = 1; bit < LANES; bit *= 2) {
        vf y[LANES];
#pragma GCC unroll 8
        for (int i = 0; i < LANES / 2; i++)
            y[2 * i] = zip<0>(x[i], x[i + LANES / 2], Lanes()), y[2 * i + 1] = zip<1>(x[i], x[i + LANES / 2], Lanes());
#pragma GCC unroll 16
        for (int i = 0; i < LANES; i++) x[i] = y[i];
    }
}

// LANES rows of N numbers, which follow each other, as N vectors; up to LANES numbers beyond them are read if N > 4. And
// the inverse, for N up to 4.
template <int N>
INLINE void columns_of(const float* p, vf* x) {
    if constexpr (N == 1) {
        x[0] = load(p);
    } else if constexpr (N == 3) {
        vf a = load(p), b = load(p + LANES), c = load(p + 2 * LANES);
        x[0] = every<0>(a, b, c, Lanes()), x[1] = every<1>(a, b, c, Lanes()), x[2] = every<2>(a, b, c, Lanes());
    } else if constexpr (N == 4) {
        vf a = load(p), b = load(p + LANES), c = load(p + 2 * LANES), d = load(p + 3 * LANES);
        x[0] = every<0>(a, b, c, d, Lanes()), x[1] = every<1>(a, b, c, d, Lanes());
        x[2] = every<2>(a, b, c, d, Lanes()), x[3] = every<3>(a, b, c, d, Lanes());
    } else {
        for (int first = 0; first < N; first += LANES) {
            vf group[LANES];
            for (int l = 0; l < LANES; l++) group[l] = load(p + l * N + first);
            transpose(group);
            for (int i = 0; i < LANES && first + i < N; i++) x[first + i] = group[i];
        }
    }
}
template <int N>
INLINE void rows_of(float* p, const vf* x) {
    static_assert(N == 1 || N == 3 || N == 4, "not needed");
    if constexpr (N == 1) {
        store(p, x[0]);
    } else if constexpr (N == 3) {
        store(p, woven<0>(x[0], x[1], x[2], Lanes())), store(p + LANES, woven<1>(x[0], x[1], x[2], Lanes()));
        store(p + 2 * LANES, woven<2>(x[0], x[1], x[2], Lanes()));
    } else {
        store(p, woven<0>(x[0], x[1], x[2], x[3], Lanes())), store(p + LANES, woven<1>(x[0], x[1], x[2], x[3], Lanes()));
        store(p + 2 * LANES, woven<2>(x[0], x[1], x[2], x[3], Lanes()));
        store(p + 3 * LANES, woven<3>(x[0], x[1], x[2], x[3], Lanes()));
    }
}

// Lane i of the result is the sum of the lanes of x[i]: a transposed reduction with three operations per sum.
INLINE vf sums_of(const vf* x) {
    vf a[LANES / 2];
    for (int i = 0; i < LANES / 2; i++) a[i] = fold<1>(x[2 * i], x[2 * i + 1], Lanes());
    for (int i = 0; i < LANES / 4; i++) a[i] = fold<2>(a[2 * i], a[2 * i + 1], Lanes());
#if LANES >= 8
    for (int i = 0; i < LANES / 8; i++) a[i] = fold<4>(a[2 * i], a[2 * i + 1], Lanes());
#endif
#if LANES >= 16
    a[0] = fold<8>(a[0], a[1], Lanes());
#endif
    return a[0];
}

// x with the lanes exchanged that are `step` apart, with which all lanes of x are combined in few steps.
template <int step, int... I>
INLINE vf swapped(vf x, Indices<I...>) {
    return SHUFFLE(x, x, (I ^ step)...);
}
template <int step = LANES / 2>
INLINE float product_of(vf x) {
    x *= swapped<step>(x, Lanes());
    if constexpr (step == 1)
        return x[0];
    else
        return product_of<step / 2>(x);
}
template <int step = LANES / 2>
INLINE float largest_of(vf x) {
    x = vmax(x, swapped<step>(x, Lanes()));
    if constexpr (step == 1)
        return x[0];
    else
        return largest_of<step / 2>(x);
}

INLINE float sum_of(vf x) {
    float s = 0;
    for (int i = 0; i < LANES; i++) s += x[i];
    return s;
}

INLINE void clear(void* p, i64 bytes) {
    if (bytes) __builtin_memset(p, 0, bytes);   // p may be null if bytes is 0
}
