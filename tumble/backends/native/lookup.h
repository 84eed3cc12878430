// Lookups in a stack of equirectangular maps, one level per roughness, and their adjoint (`Backend.lookup`).
#pragma once
#include "simd.h"

struct Lookup {
    const float *stack, *directions, *roughness;
    int n, levels, height, width;
    float* out;
    const float* v_out;
    float *v_stack, *v_directions, *v_roughness;   // v_stack: null if not needed
};

// Inverse tangent of y / x in [-pi, pi], and inverse cosine by it; error below 1e-6.
INLINE vf vatan2(vf y, vf x) {
    vf ax = vmax(x, -x), ay = vmax(y, -y), large = vmax(ax, ay), small = vmin(ax, ay);
    vf z = small / vmax(large, splat(1e-37f));
    // Reduced to |z| <= tan(pi / 8), where the series of Cephes is accurate.
    vi reduced = z > 0.414213562f;
    vf r = pick(reduced, (z - 1.0f) / (z + 1.0f), z), rr = r * r;
    vf p = ((8.05374449538e-2f * rr - 1.38776856032e-1f) * rr + 1.99777106478e-1f) * rr - 3.33329491539e-1f;
    vf angle = p * rr * r + r + keep(reduced, splat(0.785398163f));
    angle = pick(ay > ax, 1.570796327f - angle, angle);
    angle = pick(x < 0.0f, 3.141592654f - angle, angle);
    return pick(y < 0.0f, -angle, angle);
}

// The eight texels around LANES directions, and the position between them.
struct Texels {
    vf d[3], rho2, fx, fy, fz;     // rho2 = x^2 + z^2
    int at[8][LANES];              // first number of a texel; bits: column, row, level
    vi level_moves;
};

INLINE int texel(const Lookup& s, int level, int row, int column) {
    // Across a pole lies the same row, half a revolution away.
    if (row < 0 || row >= s.height) row = row < 0 ? 0 : s.height - 1, column += s.width / 2;
    column %= s.width;
    return 3 * ((level * s.height + row) * s.width + (column < 0 ? column + s.width : column));
}

INLINE void texels_at(const Lookup& s, int first, int count, Texels& o) {
    float lanes[4][LANES];
    for (int l = 0; l < LANES; l++) {
        i64 i = first + imin2(l, count - 1);
        for (int j = 0; j < 3; j++) lanes[j][l] = s.directions[3 * i + j];
        lanes[3][l] = s.roughness[i];
    }
    for (int j = 0; j < 3; j++) o.d[j] = load(lanes[j]);
    o.rho2 = o.d[0] * o.d[0] + o.d[2] * o.d[2];
    vf u = 0.159154943f * vatan2(o.d[0], -o.d[2]) + 0.5f, v = 0.318309886f * vatan2(vsqrt(o.rho2), o.d[1]);
    vf x = u * (float)s.width + 0.5f, y = v * (float)s.height + 0.5f;   // one texel further, so that they are positive
    vf roughness = load(lanes[3]), z = vmin(vmax(roughness, vf{}), splat(1.0f)) * (float)(s.levels - 1);
    o.level_moves = (roughness >= 0.0f) & (roughness <= 1.0f);
    vi column = __builtin_convertvector(x, vi), row = __builtin_convertvector(y, vi), low = __builtin_convertvector(z, vi);
    o.fx = x - __builtin_convertvector(column, vf), o.fy = y - __builtin_convertvector(row, vf);
    for (int l = 0; l < LANES; l++) {
        low[l] = imax2(0, imin2(low[l], s.levels - 2));
        for (int k = 0; k < 8; k++) {
            int above = imin2(low[l] + (k >> 2), s.levels - 1);
            o.at[k][l] = texel(s, above, row[l] - 1 + (k >> 1 & 1), column[l] - 1 + (k & 1));
        }
    }
    o.fz = z - __builtin_convertvector(low, vf);
}

INLINE vf texel_values(const Lookup& s, const Texels& o, int k, int ch) {
    vf x;
    for (int l = 0; l < LANES; l++) x[l] = s.stack[o.at[k][l] + ch];
    return x;
}
INLINE vf blend(vf a, vf b, vf f) { return a + f * (b - a); }

static void lookup_values(const Lookup& s) {
    for (int first = 0; first < s.n; first += LANES) {
        int count = imin2(LANES, s.n - first);
        Texels o;
        texels_at(s, first, count, o);
        for (int ch = 0; ch < 3; ch++) {
            vf x[4];
            for (int k = 0; k < 4; k++)
                x[k] = blend(texel_values(s, o, 2 * k, ch), texel_values(s, o, 2 * k + 1, ch), o.fx);
            vf value = blend(blend(x[0], x[1], o.fy), blend(x[2], x[3], o.fy), o.fz);
            for (int l = 0; l < count; l++) s.out[3 * (i64)(first + l) + ch] = value[l];
        }
    }
}

static void lookup_adjoint(const Lookup& s) {
    if (s.v_stack) clear(s.v_stack, (i64)12 * s.levels * s.height * s.width);
    for (int first = 0; first < s.n; first += LANES) {
        int count = imin2(LANES, s.n - first);
        Texels o;
        texels_at(s, first, count, o);
        vf v_x = {}, v_y = {}, v_z = {};
        for (int ch = 0; ch < 3; ch++) {
            vf t[8], v = {};
            for (int l = 0; l < count; l++) v[l] = s.v_out[3 * (i64)(first + l) + ch];
            for (int k = 0; k < 8; k++) t[k] = texel_values(s, o, k, ch);
            vf x[4], slope[4];
            for (int k = 0; k < 4; k++) x[k] = blend(t[2 * k], t[2 * k + 1], o.fx), slope[k] = t[2 * k + 1] - t[2 * k];
            v_z += v * (blend(x[2], x[3], o.fy) - blend(x[0], x[1], o.fy));
            v_y += v * blend(x[1] - x[0], x[3] - x[2], o.fz);
            v_x += v * blend(blend(slope[0], slope[1], o.fy), blend(slope[2], slope[3], o.fy), o.fz);
            if (!s.v_stack) continue;
            for (int k = 0; k < 8; k++) {
                vf weight = (k & 1 ? o.fx : 1.0f - o.fx) * (k & 2 ? o.fy : 1.0f - o.fy) * (k & 4 ? o.fz : 1.0f - o.fz);
                vf share = v * weight;
                for (int l = 0; l < count; l++) s.v_stack[o.at[k][l] + ch] += share[l];
            }
        }
        // u = atan2(x, -z) / 2 pi + 1/2, v = atan2(rho, y) / pi; without gradient at the poles.
        vi pole = o.rho2 == 0.0f;
        vf rho2 = pick(pole, splat(1.0f), o.rho2), rho = vsqrt(rho2);
        vf v_u = keep(~pole, v_x * (s.width * 0.159154943f) / rho2);
        vf v_v = keep(~pole, v_y * (s.height * 0.318309886f) / ((rho2 + o.d[1] * o.d[1]) * rho));
        vf v_d[3] = {v_v * o.d[1] * o.d[0] - v_u * o.d[2], -v_v * rho2, v_v * o.d[1] * o.d[2] + v_u * o.d[0]};
        vf v_roughness = keep(o.level_moves, v_z * (float)(s.levels - 1));
        for (int l = 0; l < count; l++) {
            for (int j = 0; j < 3; j++) s.v_directions[3 * (i64)(first + l) + j] = v_d[j][l];
            s.v_roughness[first + l] = v_roughness[l];
        }
    }
}
