// Lookups in a stack of equirectangular maps, one level per roughness, and their adjoint (`Backend.lookup`).
#pragma once
#include "raster.h"
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

// Sine and cosine of an angle in turns, |turns| <= 1000; error below 2e-7 for one turn.
INLINE void vsincos(vf turns, vf& sine, vf& cosine) {
    vf quarters = 4.0f * turns, whole = (quarters + 12582912.f) - 12582912.f;
    vf y = 1.570796327f * (quarters - whole), yy = y * y;
    vi quadrant = __builtin_convertvector(whole, vi);
    // The series of Cephes for |y| <= pi / 4.
    vf s = y + y * yy * (-1.6666654611e-1f + yy * (8.3321608736e-3f - 1.9515295891e-4f * yy));
    vf c = 1.0f - 0.5f * yy + yy * yy * (4.166664568298827e-2f + yy * (-1.388731625493765e-3f + 2.443315711809948e-5f * yy));
    vi odd = (quadrant & 1) != 0;
    vf a = pick(odd, c, s), b = pick(odd, s, c);
    sine = pick((quadrant & 2) != 0, -a, a), cosine = pick(((quadrant + 1) & 2) != 0, -b, b);
}

// Coordinates of LANES directions on an equirectangular map.
struct OnMap {
    vf rho2, u, v;   // rho2 = x^2 + z^2
};
INLINE OnMap on_map(const vf* d) {
    vf rho2 = d[0] * d[0] + d[2] * d[2];
    return {rho2, 0.159154943f * vatan2(d[0], -d[2]) + 0.5f, 0.318309886f * vatan2(vsqrt(rho2), d[1])};
}

// The four texels around LANES directions, and the position between them.
struct Square {
    vf fx, fy;
    vi at[4];   // number of a texel; bits: column, row
};
INLINE Square square_at(const OnMap& o, int height, int width) {
    Square q;
    vf x = o.u * (float)width + 0.5f, y = o.v * (float)height + 0.5f;   // one texel further, so that they are positive
    vi column = __builtin_convertvector(x, vi), row = __builtin_convertvector(y, vi);
    q.fx = x - __builtin_convertvector(column, vf), q.fy = y - __builtin_convertvector(row, vf);
    for (int k = 0; k < 4; k++) {
        vi r = row + ((k >> 1) - 1), c = column + ((k & 1) - 1);
        // Across a pole lies the same row, half a revolution away.
        vi across = (r < 0) | (r >= height);
        r = r < 0 ? vi{} : r, r = r >= height ? splat(height - 1) : r;
        c += across & (width / 2);
        c = c < 0 ? c + width : c, c = c >= width ? c - width : c;
        q.at[k] = r * width + (((c >= 0) & (c < width)) & c);   // within the map even if the direction is not a number
    }
    return q;
}

// The eight texels around LANES directions, and the position between them.
struct Texels {
    vf d[3], rho2, fx, fy, fz;
    vi at[8];   // first number of a texel; bits: column, row, level
    vi level_moves;
};

INLINE void texels_around(const Lookup& s, const vf* d, vf roughness, Texels& o) {
    OnMap at = on_map(d);
    Square q = square_at(at, s.height, s.width);
    vf z = vmin(vmax(roughness, vf{}), splat(1.0f)) * (float)(s.levels - 1);
    o.level_moves = (roughness >= 0.0f) & (roughness <= 1.0f);
    vi low = __builtin_convertvector(z, vi), top = splat(imax2(0, s.levels - 2)), size = splat(s.height * s.width);
    low = low > top ? top : low;
    vi high = low + 1 < s.levels ? low + 1 : low;
    for (int i = 0; i < 3; i++) o.d[i] = d[i];
    o.rho2 = at.rho2, o.fx = q.fx, o.fy = q.fy, o.fz = z - __builtin_convertvector(low, vf);
    for (int k = 0; k < 4; k++) o.at[k] = 3 * (low * size + q.at[k]), o.at[k + 4] = 3 * (high * size + q.at[k]);
}
INLINE void texels_at(const Lookup& s, int first, int count, Texels& o) {
    float lanes[4][LANES];
    for (int l = 0; l < LANES; l++) {
        i64 i = first + imin2(l, count - 1);
        for (int j = 0; j < 3; j++) lanes[j][l] = s.directions[3 * i + j];
        lanes[3][l] = s.roughness[i];
    }
    vf d[3] = {load(lanes[0]), load(lanes[1]), load(lanes[2])};
    texels_around(s, d, load(lanes[3]), o);
}

INLINE vf gathered(const float* from, vi at) {
    vf x;
    for (int l = 0; l < LANES; l++) x[l] = from[at[l]];
    return x;
}
INLINE vf texel_values(const Lookup& s, const Texels& o, int k, int ch) {
    return gathered(s.stack + ch, o.at[k]);
}
INLINE vf blend(vf a, vf b, vf f) { return a + f * (b - a); }

INLINE vf value_at(const Lookup& s, const Texels& o, int ch) {
    vf x[4];
    for (int k = 0; k < 4; k++) x[k] = blend(texel_values(s, o, 2 * k, ch), texel_values(s, o, 2 * k + 1, ch), o.fx);
    return blend(blend(x[0], x[1], o.fy), blend(x[2], x[3], o.fy), o.fz);
}

static void lookup_values(const Lookup& s, int share, int shares) {
    int end = share_start(s.n, share + 1, shares);
    for (int first = share_start(s.n, share, shares); first < end; first += LANES) {
        int count = imin2(LANES, end - first);
        Texels o;
        texels_at(s, first, count, o);
        for (int ch = 0; ch < 3; ch++) {
            vf value = value_at(s, o, ch);
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
