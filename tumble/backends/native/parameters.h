// Raw parameters: the activations of Gaussians (`Backend.activate`) with their adjoint, and the optimizer's step
// (`Backend.adam`); `v_x` is the gradient of x.
#pragma once
#include "image.h"
#include "raster.h"
#include "sh_shade.h"

struct GaussianActivation {
    const float *log_scales, *sdf, *gamma;
    int n, threads;
    float *scales, *opacity;   // results; their adjoint reads them, too
    const float *v_scales, *v_opacity;
    float *v_log_scales, *v_sdf, *parts;   // parts: the gradient of gamma per share
};

static void gaussian_activation_share(const GaussianActivation& s, int share) {
    int start = share_start(s.n, share, s.threads), end = share_start(s.n, share + 1, s.threads);
    for (i64 i = 3 * (i64)start; i < 3 * (i64)end; i += LANES) {
        int count = imin2(LANES, (int)(3 * (i64)end - i));
        store_some(s.scales + i, vexp_any(load_some(s.log_scales + i, count)), count);
    }
    for (int i = start; i < end; i += LANES) {
        int count = imin2(LANES, end - i);
        vf inside = sigmoid(-s.gamma[0] * load_some(s.sdf + i, count));
        store_some(s.opacity + i, 4.0f * inside * (1.0f - inside), count);
    }
}

static void gaussian_activation_adjoint_share(const GaussianActivation& s, int share) {
    int start = share_start(s.n, share, s.threads), end = share_start(s.n, share + 1, s.threads);
    float gamma = s.gamma[0];
    vf v_gamma = {};
    for (i64 i = 3 * (i64)start; i < 3 * (i64)end; i += LANES) {
        int count = imin2(LANES, (int)(3 * (i64)end - i));
        store_some(s.v_log_scales + i, load_some(s.v_scales + i, count) * load_some(s.scales + i, count), count);
    }
    for (int i = start; i < end; i += LANES) {
        int count = imin2(LANES, end - i);
        vf sdf = load_some(s.sdf + i, count), inside = sigmoid(-gamma * sdf);
        vf v = load_some(s.v_opacity + i, count) * 4.0f * inside * (1.0f - inside) * (2.0f * inside - 1.0f);
        store_some(s.v_sdf + i, gamma * v, count);
        v_gamma += v * sdf;
    }
    s.parts[share] = sum_of(v_gamma);
}

struct AdamLeaf {
    float* value;
    const float* gradient;
    float *first, *second;
    i64 n;
    float rate, root_correction;   // rate: divided by the correction of the first moment; root of that of the second
};

struct AdamStep {
    const AdamLeaf* leaves;
    int n_leaves, threads;
    float beta_2, rest_1, rest_2, eps;   // rest_1 = 1 - beta_1, which in float32 would have lost its digits
};

INLINE i64 number_start(i64 n, int share, int shares) {
    i64 groups = (n + LANES - 1) / LANES, start = groups * share / shares * LANES;
    return start < n ? start : n;
}

// Whether a share of all gradients is finite.
static bool finite_share(const AdamStep& s, int share) {
    vi odd = {};
    for (int k = 0; k < s.n_leaves; k++) {
        const AdamLeaf& leaf = s.leaves[k];
        i64 end = number_start(leaf.n, share + 1, s.threads);
        for (i64 i = number_start(leaf.n, share, s.threads); i < end; i += LANES) {
            vf g = load_some(leaf.gradient + i, (int)(end - i < LANES ? end - i : LANES));
            odd |= g - g != 0.0f;
        }
    }
    return !any(odd);
}

static void adam_share(const AdamStep& s, int share) {
    for (int k = 0; k < s.n_leaves; k++) {
        const AdamLeaf& leaf = s.leaves[k];
        i64 end = number_start(leaf.n, share + 1, s.threads);
        for (i64 i = number_start(leaf.n, share, s.threads); i < end; i += LANES) {
            int count = (int)(end - i < LANES ? end - i : LANES);
            vf g = load_some(leaf.gradient + i, count), m = load_some(leaf.first + i, count);
            vf v = load_some(leaf.second + i, count);
            m += s.rest_1 * (g - m), v = s.beta_2 * v + s.rest_2 * g * g;
            vf step = leaf.rate * m / (vsqrt(v) / leaf.root_correction + s.eps);
            store_some(leaf.first + i, m, count), store_some(leaf.second + i, v, count);
            store_some(leaf.value + i, load_some(leaf.value + i, count) - step, count);
        }
    }
}

// Moves the leaves unless a gradient is not finite; returns whether they were moved.
static int adam_step(const AdamStep& s) {
    int failed = 0;
    parallel(s.threads, [&](int share) {
        if (!finite_share(s, share)) __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
    });
    if (failed) return 0;
    parallel(s.threads, [&](int share) { adam_share(s, share); });
    return 1;
}
