// Colour of Gaussians under one light of 16 spherical harmonics, LANES at a time, and its adjoint. The formulas are in
// `Backend.sh_shade`; `v_x` is the gradient of x.
#pragma once
#include "parallel.h"
#include "project.h"

struct ShShade {
    const float *means, *quats, *albedo_logits, *light, *specular_scale, *occluded, *unoccluded;
    const float *directions, *reflectance, *R, *position;
    int n, n_directions, n_terms, shadowed, threads;   // n_terms: of the polynomial `reflectance`
    float normal_gradient, irradiance_floor, ratio_max;
    float* out;
    // Gradients: of the result, of inputs, and of the light and the pose per share (LIGHT_SUMS numbers).
    const float* v_out;
    float *v_means, *v_quats, *v_albedo_logits, *parts;
};

enum { LIGHT_SUMS = 48 + 48 + 1 + 9 + 3 };

// Quantities that do not depend on the Gaussian.
struct ShLight {
    const float (*lobe)[16][3];   // coefficients of both lobes
    float irradiance[9][3];       // coefficients of the glossy radiance, object frame
    float floor[3], specular_scale;
    M3 R;
    V3 position;
};

// e^x, also for large |x|.
INLINE vf vexp_any(vf x) { return vexp(vmin(vmax(x, splat(-80.0f)), splat(80.0f))); }
INLINE vf sigmoid(vf x) { return 1.0f / (1.0f + vexp_any(-x)); }
INLINE vf softplus(vf x) { return vmax(x, vf{}) + vlog(1.0f + vexp_any(-vmax(x, -x))); }
INLINE vf series(const float (*lobe)[3], const vf* Y, int ch, int count) {
    vf sum = Y[0] * lobe[0][ch];
    for (int k = 1; k < count; k++) sum += Y[k] * lobe[k][ch];
    return sum;
}

static void sh_light(const ShShade& s, ShLight& o) {
    o.lobe = (const float(*)[16][3])s.light, o.specular_scale = s.specular_scale[0];
    for (int i = 0; i < 9; i++) o.R.m[i] = splat(s.R[i]);
    o.position = {splat(s.position[0]), splat(s.position[1]), splat(s.position[2])};
    if (!s.shadowed) return;
    vf sums[9][3] = {}, total[3] = {};
    for (int first = 0; first < s.n_directions; first += LANES) {
        int count = imin2(LANES, s.n_directions - first);
        V3 d = gather3(s.directions, first, count);
        vf Y[16], own[16];
        harmonics(16, mul(o.R, d), Y), harmonics(9, d, own);
        for (int ch = 0; ch < 3; ch++) {
            vf radiance = keep(lane_index() < count, softplus(series(o.lobe[1], Y, ch, 16)));
            total[ch] += radiance;
            for (int k = 0; k < 9; k++) sums[k][ch] += own[k] * radiance;
        }
    }
    for (int ch = 0; ch < 3; ch++) {
        o.floor[ch] = s.irradiance_floor * 3.14159265f / s.n_directions * sum_of(total[ch]);
        for (int k = 0; k < 9; k++) o.irradiance[k][ch] = 12.566370614f / s.n_directions * sum_of(sums[k][ch]);
    }
}

// Irradiance from transfer vectors, with all bounces.
INLINE vf irradiance(const vf* transfer, const ShLight& light, int ch, vf albedo) {
    vf sum = {}, visible = transfer[0] * 1.12837917f;
    for (int k = 0; k < 9; k++) sum += transfer[k] * light.irradiance[k][ch];
    visible = vmin(vmax(visible, vf{}), splat(1.0f));
    return vmax(sum, vf{}) / vmax(1.0f - albedo * (1.0f - visible), splat(1e-3f)) + light.floor[ch];
}

struct ShPoint {
    vf q[4], q_scale, length;    // unit quaternion, 1 / length of the given one; distance to the camera
    V3 normal, view, mirrored, n_env, m_env;
    vf n_v, m, reflectance, slope;   // m = 1 - n.v within [0, 1]; slope: of the reflectance in n.v
    vf Y[2][16], albedo[3], ratio[3], at[2][3], lobe[2][3];   // `at` before, `lobe` after the softplus
};

INLINE void sh_point(const ShShade& s, const ShLight& light, const Batch& b, ShPoint& o) {
    gather<4>(s.quats, 4, b, o.q);
    o.q_scale = 1.0f / vsqrt(o.q[0] * o.q[0] + o.q[1] * o.q[1] + o.q[2] * o.q[2] + o.q[3] * o.q[3]);
    for (int j = 0; j < 4; j++) o.q[j] *= o.q_scale;
    M3 R = rotation(o.q);
    o.normal = {R(0, 2), R(1, 2), R(2, 2)};
    V3 away = light.position + gather3(s.means, b) * splat(-1.0f);
    o.length = vmax(vsqrt(dot(away, away)), splat(1e-12f));
    o.view = away * (1.0f / o.length);
    o.n_v = dot(o.normal, o.view);
    o.mirrored = o.normal * (2.0f * o.n_v) + o.view * splat(-1.0f);
    o.n_env = mul(light.R, o.normal), o.m_env = mul(light.R, o.mirrored);
    harmonics(16, o.n_env, o.Y[0]), harmonics(16, o.m_env, o.Y[1]);
    o.m = 1.0f - vmin(vmax(o.n_v, vf{}), splat(1.0f));
    vf slope = {};
    o.reflectance = splat(s.reflectance[s.n_terms - 1]);
    for (int k = s.n_terms - 2; k >= 0; k--)
        slope = slope * o.m + o.reflectance, o.reflectance = o.reflectance * o.m + s.reflectance[k];
    o.slope = keep(o.n_v <= 1.0f, -slope);
    vf occluded[9], unoccluded[9];
    if (s.shadowed) gather<9>(s.occluded, 9, b, occluded), gather<9>(s.unoccluded, 9, b, unoccluded);
    gather<3>(s.albedo_logits, 3, b, o.albedo);
    for (int ch = 0; ch < 3; ch++) {
        o.albedo[ch] = sigmoid(o.albedo[ch]), o.ratio[ch] = splat(1.0f);
        if (s.shadowed) {
            vf shadowed = irradiance(occluded, light, ch, o.albedo[ch]), full = irradiance(unoccluded, light, ch, o.albedo[ch]);
            o.ratio[ch] = vmin(shadowed / vmax(full, splat(1e-12f)), splat(s.ratio_max));
        }
        for (int i = 0; i < 2; i++) {
            o.at[i][ch] = series(light.lobe[i], o.Y[i], ch, 16);
            o.lobe[i][ch] = softplus(o.at[i][ch]);
        }
    }
}

// Calls visit for batches of the Gaussians of a share that face the camera and, if given, have a gradient.
template <class F>
INLINE void for_facing(const ShShade& s, const ShLight& light, int share, const float* v_out, F visit) {
    Batch b;
    b.count = 0;
    int end = share_start(s.n, share + 1, s.threads);
    for (int first = share_start(s.n, share, s.threads); first < end; first += LANES) {
        int count = imin2(LANES, end - first);
        vf q[4];
        gather<4>(s.quats, first, count, q);
        vf w = q[0], x = q[1], y = q[2], z = q[3];
        V3 n = {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), w * w + z * z - x * x - y * y};
        V3 away = light.position + gather3(s.means, first, count) * splat(-1.0f);
        u32 some = bits((dot(n, away) > 0.0f) & (lane_index() < count));
        for (; some; some &= some - 1) {
            i64 g = first + __builtin_ctz(some);
            if (v_out && v_out[3 * g] == 0 && v_out[3 * g + 1] == 0 && v_out[3 * g + 2] == 0) continue;
            if (b.add(g)) b.pad(), visit(b), b.count = 0;
        }
    }
    if (b.count) b.pad(), visit(b);
}

static void sh_shade_share(const ShShade& s, const ShLight& light, int share) {
    i64 start = share_start(s.n, share, s.threads), end = share_start(s.n, share + 1, s.threads);
    clear(s.out + 3 * start, 12 * (end - start));
    for_facing(s, light, share, nullptr, [&](const Batch& b) {
        ShPoint o;
        sh_point(s, light, b, o);
        vf out[3];
        for (int ch = 0; ch < 3; ch++)
            out[ch] = o.albedo[ch] * o.ratio[ch] * o.lobe[0][ch] + light.specular_scale * o.reflectance * o.lobe[1][ch];
        scatter<3>(s.out, 3, b, out);
    });
}

static void sh_shade_adjoint_share(const ShShade& s, const ShLight& light, int share) {
    vf sums[LIGHT_SUMS] = {};
    i64 start = share_start(s.n, share, s.threads), size = share_start(s.n, share + 1, s.threads) - start;
    clear(s.v_means + 3 * start, 12 * size), clear(s.v_quats + 4 * start, 16 * size);
    clear(s.v_albedo_logits + 3 * start, 12 * size);
    for_facing(s, light, share, s.v_out, [&](const Batch& batch) {
        vi inside = lane_index() < batch.count;
        ShPoint o;
        sh_point(s, light, batch, o);
        vf v_reflectance = {}, v_series[2][3], v_Y[2][16] = {}, v_out[3], v_logits[3];
        gather<3>(s.v_out, 3, batch, v_out);
        for (int ch = 0; ch < 3; ch++) {
            vf v = keep(inside, v_out[ch]), v_lobe = v * light.specular_scale;
            vf a = o.albedo[ch], shaded = a * o.ratio[ch];
            v_logits[ch] = v * o.lobe[0][ch] * shaded * (1.0f - a);
            v_reflectance += v_lobe * o.lobe[1][ch];
            sums[96] += v * o.lobe[1][ch] * o.reflectance;
            v_series[0][ch] = v * shaded * sigmoid(o.at[0][ch]);
            v_series[1][ch] = v_lobe * o.reflectance * sigmoid(o.at[1][ch]);
        }
        scatter<3>(s.v_albedo_logits, 3, batch, v_logits);
        for (int i = 0; i < 2; i++)
            for (int k = 0; k < 16; k++)
                for (int ch = 0; ch < 3; ch++) {
                    v_Y[i][k] += v_series[i][ch] * light.lobe[i][k][ch];
                    sums[48 * i + 3 * k + ch] += v_series[i][ch] * o.Y[i][k];
                }
        V3 v_n_env = harmonics_adjoint(16, o.n_env, v_Y[0]), v_m_env = harmonics_adjoint(16, o.m_env, v_Y[1]);
        V3 v_mirrored = mul_T(light.R, v_m_env);
        vf v_n_v = 2.0f * dot(v_mirrored, o.normal) + o.slope * v_reflectance;
        V3 v_normal = mul_T(light.R, v_n_env) + v_mirrored * (2.0f * o.n_v) + o.view * v_n_v;
        V3 v_view = o.normal * v_n_v + v_mirrored * splat(-1.0f);
        vf a[3] = {v_n_env.x, v_n_env.y, v_n_env.z}, b[3] = {v_m_env.x, v_m_env.y, v_m_env.z};
        vf n[3] = {o.normal.x, o.normal.y, o.normal.z}, m[3] = {o.mirrored.x, o.mirrored.y, o.mirrored.z};
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) sums[97 + 3 * i + j] += a[i] * n[j] + b[i] * m[j];
        V3 v_away = (v_view + o.view * (-dot(v_view, o.view))) * (1.0f / o.length);
        sums[106] += v_away.x, sums[107] += v_away.y, sums[108] += v_away.z;
        scatter3(s.v_means, batch, v_away * splat(-1.0f));
        M3 v_R = {};
        v_R.m[2] = v_normal.x * s.normal_gradient, v_R.m[5] = v_normal.y * s.normal_gradient;
        v_R.m[8] = v_normal.z * s.normal_gradient;
        vf v_q[4];
        rotation_adjoint(o.q, v_R, v_q);
        vf radial = v_q[0] * o.q[0] + v_q[1] * o.q[1] + v_q[2] * o.q[2] + v_q[3] * o.q[3];
        for (int j = 0; j < 4; j++) v_q[j] = (v_q[j] - radial * o.q[j]) * o.q_scale;
        scatter<4>(s.v_quats, 4, batch, v_q);
    });
    for (int i = 0; i < LIGHT_SUMS; i++) s.parts[share * LIGHT_SUMS + i] = sum_of(sums[i]);
}
