// Loss terms of the Gaussians themselves and their gradients (`Backend.gaussian_terms`), LANES at a time. Every term is
// differentiated at once, since each input belongs to one term only.
#pragma once
#include "parallel.h"
#include "project.h"

struct GaussianTerms {
    const float *means, *quats, *log_scales, *sdf, *gamma, *weight, *depth, *R, *t, *focal;
    int n, height, width, threads;
    float floor, reach, weights[3];   // weights: of the terms
    u32* magnitudes;   // one per Gaussian
    float *terms, *g_means, *g_quats, *g_log_scales, *g_sdf, *g_gamma, *g_R, *g_t;   // g_R and g_t: the third row
};

// Lower median of n non-negative numbers, which are given as their bits, by counting their leading bits first.
static float median(const u32* x, int n) {
    u32 prefix = 0, known = 0;
    int rank = (n - 1) / 2;
    const int shifts[3] = {21, 10, 0}, sizes[3] = {2048, 2048, 1024};
    for (int pass = 0; pass < 3; pass++) {
        int counts[2048];
        clear(counts, sizeof(counts));
        for (int i = 0; i < n; i++)
            if ((x[i] & known) == prefix) counts[x[i] >> shifts[pass] & (sizes[pass] - 1)]++;
        u32 digit = 0;
        while (rank >= counts[digit]) rank -= counts[digit++];
        prefix |= digit << shifts[pass], known |= (u32)(sizes[pass] - 1) << shifts[pass];
    }
    float result;
    __builtin_memcpy(&result, &prefix, 4);
    return result;
}

static void sharpness_term(const GaussianTerms& s) {
    for (int i = 0; i < s.n; i++) {
        __builtin_memcpy(&s.magnitudes[i], &s.sdf[i], 4);
        s.magnitudes[i] &= 0x7fffffff;
    }
    float missing = 1.762747f / fmax2(median(s.magnitudes, s.n), s.floor) - s.gamma[0];
    s.terms[1] = s.weights[1] * fmax2(missing, 0), s.g_gamma[0] = missing >= 0 ? -s.weights[1] : 0;
}

static void rank_term(const GaussianTerms& s) {
    float per_gaussian = s.weights[0] / s.n;
    vf total = {};
    for (int first = 0; first < s.n; first += LANES) {
        int count = imin2(LANES, s.n - first);
        vf logs[3], sum = {}, entropy = {}, thickness, highest;
        gather<3>(s.log_scales, first, count, logs);
        thickness = vexp(logs[2]);
        for (int i = 0; i < 3; i++) logs[i] *= 2.0f;
        highest = vmax(vmax(logs[0], logs[1]), logs[2]);
        for (int i = 0; i < 3; i++) logs[i] = vmax(logs[i] - highest, splat(-80.0f)), sum += vexp(logs[i]);
        vf p[3], log_sum = vlog(sum);
        for (int i = 0; i < 3; i++) logs[i] -= log_sum, p[i] = vexp(vmax(logs[i], splat(-80.0f))), entropy -= p[i] * logs[i];
        vf rank = vexp(entropy), above = rank - 1.0f, needle = -vlog(vmax(above, splat(1e-4f)));
        total += keep(lane_index() < count, vmax(needle, vf{}) + thickness);
        vf v_entropy = keep((needle >= 0.0f) & (above >= 1e-4f), -rank / above);
        vf g[3];
        for (int i = 0; i < 3; i++)
            g[i] = per_gaussian * (-2.0f * v_entropy * p[i] * (logs[i] + entropy) + (i == 2 ? thickness : vf{}));
        scatter<3>(s.g_log_scales, first, count, g);
    }
    s.terms[0] = per_gaussian * sum_of(total);
}

// Depth at pixel positions, bilinear between pixel centres and 0 outside of the image.
INLINE vf depth_at(const GaussianTerms& s, vf u, vf v, vi wanted) {
    float us[LANES], vs[LANES], z[LANES];
    u32 mask = bits(wanted & (u > -1.0f) & (u < s.width + 1.0f) & (v > -1.0f) & (v < s.height + 1.0f));
    store(us, u - 0.5f), store(vs, v - 0.5f), store(z, vf{});
    for (; mask; mask &= mask - 1) {
        int l = __builtin_ctz(mask), x = (int)(us[l] + 2) - 2, y = (int)(vs[l] + 2) - 2;
        float fx = us[l] - x, fy = vs[l] - y;
        for (int corner = 0; corner < 4; corner++) {
            int column = x + (corner & 1), row = y + (corner >> 1);
            if (column < 0 || column >= s.width || row < 0 || row >= s.height) continue;
            z[l] += (corner & 1 ? fx : 1 - fx) * (corner >> 1 ? fy : 1 - fy) * s.depth[(i64)row * s.width + column];
        }
    }
    return load(z);
}

static void projection_term(const GaussianTerms& s) {
    int seen = 0;
    for (int i = 0; i < s.n; i++) seen += s.weight[i] > 0;
    float per_seen = s.weights[2] / imax2(seen, 1);
    vf total = {}, v_R[3] = {}, v_t = {};
    for (int first = 0; first < s.n; first += LANES) {
        int count = imin2(LANES, s.n - first);
        vi visible = (gather1(s.weight, first, count) > 0.0f) & (lane_index() < count);
        if (!any(visible)) {
            clear(s.g_means + 3 * (i64)first, 12 * count), clear(s.g_quats + 4 * (i64)first, 16 * count);
            clear(s.g_sdf + first, 4 * count);
            continue;
        }
        vf q[4], sdf = gather1(s.sdf, first, count);
        gather<4>(s.quats, first, count, q);
        vf q_scale = 1.0f / vsqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int j = 0; j < 4; j++) q[j] *= q_scale;
        M3 R_obj_local = rotation(q);
        V3 normal = {R_obj_local(0, 2), R_obj_local(1, 2), R_obj_local(2, 2)};
        V3 point = gather3(s.means, first, count) + normal * -sdf;
        vf x_cam[3];
        for (int i = 0; i < 3; i++)
            x_cam[i] = s.R[3 * i] * point.x + s.R[3 * i + 1] * point.y + s.R[3 * i + 2] * point.z + s.t[i];
        vf z = x_cam[2], u = s.focal[0] * x_cam[0] / z + s.focal[2], v = s.focal[1] * x_cam[1] / z + s.focal[3];
        vf surface = depth_at(s, u, v, visible), error = surface - z;
        vi inlier = visible & (vmax(error, -error) < s.reach) & (surface > 0.0f);
        vf sign = keep(error > 0.0f, splat(1.0f)) - keep(error < 0.0f, splat(1.0f));
        vf weight = keep(inlier, per_seen * sign);
        total += keep(inlier, weight * error);
        vf along = s.R[6] * normal.x + s.R[7] * normal.y + s.R[8] * normal.z;
        scatter3(s.g_means, first, count, {-weight * s.R[6], -weight * s.R[7], -weight * s.R[8]});
        scatter1(s.g_sdf, first, count, weight * along);
        v_R[0] -= weight * point.x, v_R[1] -= weight * point.y, v_R[2] -= weight * point.z, v_t -= weight;
        M3 g = {};
        g.m[2] = weight * sdf * s.R[6], g.m[5] = weight * sdf * s.R[7], g.m[8] = weight * sdf * s.R[8];
        vf v_q[4];
        rotation_adjoint(q, g, v_q);
        vf radial = v_q[0] * q[0] + v_q[1] * q[1] + v_q[2] * q[2] + v_q[3] * q[3];
        for (int j = 0; j < 4; j++) v_q[j] = (v_q[j] - radial * q[j]) * q_scale;
        scatter<4>(s.g_quats, first, count, v_q);
    }
    s.terms[2] = sum_of(total);
    for (int i = 0; i < 3; i++) s.g_R[i] = sum_of(v_R[i]);
    s.g_t[0] = sum_of(v_t);
}

static void gaussian_terms(const GaussianTerms& s) {
    clear(s.terms, 12);
    if (!s.n) {
        clear(s.g_gamma, 4), clear(s.g_R, 12), clear(s.g_t, 4);
        return;
    }
    parallel(imin2(s.threads, 2), [&](int share) {
        if (share == 0) projection_term(s);
        if (share == 1 || s.threads == 1) rank_term(s), sharpness_term(s);
    });
}
