// Shading (Lambert + GGX) under light directions shared by all points, LANES directions at a time, and its adjoint.
// The formulas are in `Backend.shade`; f below is the specular part. Directions and radiance are three rows of numbers
// each, padded with zeros to whole vectors; padding directions have n.w = 0 and therefore do not count.
#pragma once
#include "parallel.h"
#include "simd.h"

struct Shade {
    const float *normal, *roughness, *view, *directions, *radiance;
    const int *visibility, *blocker;
    const i64* rows;   // row of visibility and blocker of each point
    const float* blocker_radiance;
    int n_points, n_directions, stride, words, n_blockers, threads;   // stride: n_directions padded
    int blocker_point_stride, blocker_direction_stride;
    float roughness_min;
    float *diffuse, *specular, *specular_visibility;
    // Gradients: of results, per share, of inputs.
    const float *v_diffuse, *v_specular;
    float *radiance_parts, *blocker_parts;
    float *v_normal, *v_roughness, *v_view, *v_radiance, *v_blocker_radiance;
};

// Quantities of a point that do not depend on the direction.
struct Point {
    float n[3], v[3], C[3], n_v, r, a, aa, g_v, slope_v, scale;   // C = n x v, slope_v = dg_v / dn_v
    float mirrored[3], bb;   // reflected view direction; b^2 of the weights of specular_visibility
};
// The root in Smith's g(x) = (x + root) / 2.
INLINE vf smith_root(vf x, float aa) { return vsqrt(aa + (1 - aa) * x * x); }
INLINE Point point_at(const Shade& s, i64 p) {
    Point o;
    for (int i = 0; i < 3; i++) o.n[i] = s.normal[3 * p + i], o.v[i] = s.view[3 * p + i];
    o.C[0] = o.n[1] * o.v[2] - o.n[2] * o.v[1], o.C[1] = o.n[2] * o.v[0] - o.n[0] * o.v[2];
    o.C[2] = o.n[0] * o.v[1] - o.n[1] * o.v[0];
    o.n_v = o.n[0] * o.v[0] + o.n[1] * o.v[1] + o.n[2] * o.v[2];
    o.r = fmax2(s.roughness[p], s.roughness_min);
    o.a = o.r * o.r, o.aa = o.a * o.a;
    float facing = fmax2(o.n_v, 0), root = smith_root(splat(facing), o.aa)[0];
    o.g_v = 0.5f * (facing + root), o.slope_v = 0.5f + 0.5f * (1 - o.aa) * facing / root;
    o.scale = 12.566370614f / s.n_directions;
    for (int i = 0; i < 3; i++) o.mirrored[i] = 2 * o.n_v * o.n[i] - o.v[i];
    o.bb = fmax2(o.aa, 0.785398163f / s.n_directions);
    return o;
}

// The specular lobe of a point in LANES directions.
struct Lobe {
    vf w[3], n_w, HH, C[3], n_H, t_num, vh, F, slope_F, root_w, g_w, rest, f;   // f = F rest
    vi exists;
};
INLINE vf cosine(const Shade& s, const Point& p, int j, vf* w) {
    for (int i = 0; i < 3; i++) w[i] = load(s.directions + i * s.stride + j);
    return p.n[0] * w[0] + p.n[1] * w[1] + p.n[2] * w[2];
}
INLINE void lobe_at(const Shade& s, const Point& p, Lobe& o) {
    o.HH = 2.0f + 2.0f * (p.v[0] * o.w[0] + p.v[1] * o.w[1] + p.v[2] * o.w[2]);
    o.exists = (o.HH > 1e-6f) & (splat(p.n_v) > 0.0f);
    o.HH = pick(o.exists, o.HH, splat(1.0f));
    o.C[0] = p.n[1] * o.w[2] - p.n[2] * o.w[1] + p.C[0], o.C[1] = p.n[2] * o.w[0] - p.n[0] * o.w[2] + p.C[1];
    o.C[2] = p.n[0] * o.w[1] - p.n[1] * o.w[0] + p.C[2];
    o.n_H = o.n_w + p.n_v;
    o.t_num = o.C[0] * o.C[0] + o.C[1] * o.C[1] + o.C[2] * o.C[2] + p.aa * o.n_H * o.n_H;   // t |H|^2
    vf facing = vmax(o.n_w, vf{});
    o.root_w = smith_root(facing, p.aa), o.g_w = 0.5f * (facing + o.root_w);
    o.vh = 0.5f * vsqrt(o.HH);
    vf m = 1.0f - o.vh, mm = m * m;
    // tumble.rendering.brdf.fresnel and its derivative in m.
    o.F = (1 + 24 * m * mm * (0.9878f + m * (-3.8886f + m * (9.1922f + m * (-9.6217f + m * 4.3303f)))));
    o.slope_F = 24 * mm * (2.9634f + m * (-15.5544f + m * (45.961f + m * (-57.7302f + m * 30.3121f))));
    vf x = o.HH * inverse(o.t_num);
    o.rest = keep(o.exists, (p.aa * 0.0795774715f / p.g_v) * x * x * inverse(o.g_w));
    o.f = o.F * o.rest;
}

// The lanes whose bits are set.
INLINE vi mask_of(u32 lanes) { return (splat((int)lanes) >> lane_index() & 1) != 0; }
// Radiance arriving from LANES directions, given which are visible (`seen`) and above the horizon (`lit`).
INLINE void arriving(const Shade& s, i64 p, int j, u32 seen, u32 lit, vf* L) {
    float lanes[3][LANES];
    u32 blocked = lit & ~seen;
    vi in_sight = mask_of(seen);
    for (int ch = 0; ch < 3; ch++) L[ch] = keep(in_sight, load(s.radiance + ch * s.stride + j));
    if (!blocked || !s.n_blockers) return;
    for (int ch = 0; ch < 3; ch++) store(lanes[ch], L[ch]);
    for (; blocked; blocked &= blocked - 1) {
        int l = __builtin_ctz(blocked);
        int b = s.blocker[s.rows[p] * s.blocker_point_stride + (i64)(j + l) * s.blocker_direction_stride];
        for (int ch = 0; ch < 3 && b >= 0; ch++) lanes[ch][l] = s.blocker_radiance[3 * (i64)b + ch];
    }
    for (int ch = 0; ch < 3; ch++) L[ch] = load(lanes[ch]);
}

// Visibility bits of LANES directions from j on; they never straddle two words.
INLINE u32 seen_at(const Shade& s, i64 p, int j) {
    return (u32)s.visibility[s.rows[p] * s.words + j / 32] >> j % 32 & ((1ull << LANES) - 1);
}

// Weight of LANES directions above the horizon in `specular_visibility`.
INLINE vf mirrored_weight(const Point& p, const vf* w, vi above) {
    vf cosine = p.mirrored[0] * w[0] + p.mirrored[1] * w[1] + p.mirrored[2] * w[2];
    vf t = 0.5f * (1.0f - cosine) + p.bb * 0.5f * (1.0f + cosine);
    return keep(above & (cosine > 0.0f), cosine / (t * t));
}

static void shade_share(const Shade& s, int share) {
    for (i64 p = share; p < s.n_points; p += s.threads) {
        Point o = point_at(s, p);
        vf diffuse[3] = {}, specular[3] = {}, total = {}, visible = {};
        for (int j = 0; j < s.stride; j += LANES) {
            Lobe b;
            b.n_w = cosine(s, o, j, b.w);
            vi above = b.n_w > 0.0f;
            u32 lit = bits(above), seen = seen_at(s, p, j) & lit;
            if (!lit) continue;
            vf weight = mirrored_weight(o, b.w, above);
            total += weight, visible += keep(mask_of(seen), weight);
            if (!s.n_blockers && !seen) continue;
            lobe_at(s, o, b);
            vf L[3], cos = vmax(b.n_w, vf{}), f_cos = b.f * cos;
            arriving(s, p, j, seen, lit, L);
            for (int ch = 0; ch < 3; ch++) diffuse[ch] += L[ch] * cos, specular[ch] += L[ch] * f_cos;
        }
        for (int ch = 0; ch < 3; ch++) {
            s.diffuse[3 * p + ch] = o.scale * 0.318309886f * sum_of(diffuse[ch]);
            s.specular[3 * p + ch] = o.scale * sum_of(specular[ch]);
        }
        float sum = sum_of(total);
        s.specular_visibility[p] = sum > 0 ? sum_of(visible) / sum : 0;
    }
}

// Gradients of a point summed over directions.
struct PointSums {
    vf n[3], v[3], g_v, n_v, aa, a;
};

INLINE void lobe_adjoint(const Shade& s, const Point& p, const Lobe& b, vf v_f, vf v_n_w, PointSums& sum) {
    vf over_f = v_f * b.f, v_num = -2.0f * over_f * inverse(b.t_num);   // d/d(t |H|^2)
    sum.g_v += over_f;
    vf v_g_w = -over_f * inverse(b.g_w), facing = vmax(b.n_w, vf{}), inv_root = inverse(b.root_w);
    sum.aa += v_g_w * (1.0f - facing * facing) * (0.25f * inv_root);
    v_n_w += v_g_w * (0.5f + 0.5f * (1 - p.aa) * facing * inv_root);
    sum.a += over_f * (2.0f / p.a) + v_num * (2.0f * p.a) * b.n_H * b.n_H;
    vf v_n_H = v_num * (2.0f * p.aa) * b.n_H;
    v_n_w += v_n_H, sum.n_v += v_n_H;
    // f ~ |H|^4 F(|H|); d(v.h)/d|H|^2 = 1 / (8 v.h), and |H|^2 = 2 + 2 v.w.
    vf v_F = v_f * b.rest, v_HH = 2.0f * over_f * inverse(b.HH) - v_F * b.slope_F * (0.125f * inverse(b.vh));
    vf v_vw = keep(b.exists, 2.0f * v_HH), H[3], c[3];
    for (int i = 0; i < 3; i++) H[i] = b.w[i] + p.v[i], c[i] = 2.0f * v_num * b.C[i];
    // C = n x H.
    sum.n[0] += H[1] * c[2] - H[2] * c[1], sum.n[1] += H[2] * c[0] - H[0] * c[2], sum.n[2] += H[0] * c[1] - H[1] * c[0];
    sum.v[0] += c[1] * p.n[2] - c[2] * p.n[1], sum.v[1] += c[2] * p.n[0] - c[0] * p.n[2];
    sum.v[2] += c[0] * p.n[1] - c[1] * p.n[0];
    for (int i = 0; i < 3; i++) sum.n[i] += v_n_w * b.w[i], sum.v[i] += v_vw * b.w[i];
}

static void shade_adjoint_share(const Shade& s, int share) {
    float *v_radiance = s.radiance_parts + (i64)share * 3 * s.stride;
    float *v_blocker = s.blocker_parts + (i64)share * 3 * s.n_blockers;
    clear(v_radiance, (i64)12 * s.stride), clear(v_blocker, (i64)12 * s.n_blockers);
    for (i64 p = share; p < s.n_points; p += s.threads) {
        Point o = point_at(s, p);
        PointSums sum = {};
        float seed[3], seed_diffuse[3];
        for (int ch = 0; ch < 3; ch++) {
            seed[ch] = s.v_specular[3 * p + ch] * o.scale;
            seed_diffuse[ch] = s.v_diffuse[3 * p + ch] * o.scale * 0.318309886f;
        }
        for (int j = 0; j < s.stride; j += LANES) {
            Lobe b;
            b.n_w = cosine(s, o, j, b.w);
            u32 lit = bits(b.n_w > 0.0f), seen = seen_at(s, p, j) & lit;
            if (!(s.n_blockers ? lit : seen)) continue;
            lobe_at(s, o, b);
            vf L[3], cos = vmax(b.n_w, vf{}), v_L[3];
            arriving(s, p, j, seen, lit, L);
            for (int ch = 0; ch < 3; ch++) v_L[ch] = cos * (seed_diffuse[ch] + seed[ch] * b.f);
            vf specular = seed[0] * L[0] + seed[1] * L[1] + seed[2] * L[2];
            vf diffuse = seed_diffuse[0] * L[0] + seed_diffuse[1] * L[1] + seed_diffuse[2] * L[2];
            vf v_n_w = keep(b.n_w > 0.0f, diffuse + b.f * specular);
            lobe_adjoint(s, o, b, specular * cos, v_n_w, sum);
            vi in_sight = mask_of(seen);
            for (int ch = 0; ch < 3; ch++) {
                float* to = v_radiance + ch * s.stride + j;
                store(to, load(to) + keep(in_sight, v_L[ch]));
            }
            u32 blocked = s.n_blockers ? lit & ~seen : 0;
            if (!blocked) continue;
            float lanes[3][LANES];
            for (int ch = 0; ch < 3; ch++) store(lanes[ch], v_L[ch]);
            for (; blocked; blocked &= blocked - 1) {
                int l = __builtin_ctz(blocked);
                int at = s.blocker[s.rows[p] * s.blocker_point_stride + (i64)(j + l) * s.blocker_direction_stride];
                for (int ch = 0; ch < 3 && at >= 0; ch++) v_blocker[3 * (i64)at + ch] += lanes[ch][l];
            }
        }
        float v_g_v = -sum_of(sum.g_v) / o.g_v, v_n_v = sum_of(sum.n_v) + (o.n_v >= 0 ? v_g_v * o.slope_v : 0);
        float facing = fmax2(o.n_v, 0), root = 2 * o.g_v - facing;
        float v_aa = sum_of(sum.aa) + v_g_v * (1 - facing * facing) / (4 * root);
        float v_r = sum_of(sum.a) * 2 * o.r + v_aa * 4 * o.a * o.r;
        s.v_roughness[p] = s.roughness[p] >= s.roughness_min ? v_r : 0;
        for (int i = 0; i < 3; i++) {
            s.v_normal[3 * p + i] = sum_of(sum.n[i]) + v_n_v * o.v[i];
            s.v_view[3 * p + i] = sum_of(sum.v[i]) + v_n_v * o.n[i];
        }
    }
}

INLINE void add_parts(float* to, const float* parts, i64 size, int count) {
    for (i64 i = 0; i < size; i++) {
        float sum = 0;
        for (int part = 0; part < count; part++) sum += parts[part * size + i];
        to[i] = sum;
    }
}
