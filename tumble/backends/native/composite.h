// Blending front to back, a tile of LANES pixels at a time, and its adjoint, which also traverses front to back: with
// s_i = dL/dw_i, the Gaussians behind Gaussian i contribute rem = dL/dout . out - sum_{j <= i} w_j s_j.
// Formulas in raster.h. C is the number of features, rounded up to a multiple of 4.
#pragma once
#include "raster.h"

struct Tile {
    vf x, y;             // pixel centres
    vi inside;           // lanes within the image
    int rows, columns;   // of pixels within the image
    i64 pixel;           // index of the first one
};

INLINE Tile tile_at(const Raster& r, int index) {
    Tile t;
    int x0 = index % tiles_x(r) * TILE_W, y0 = index / tiles_x(r) * TILE_H;
    vi i = lane_index(), x = (i & 3) + x0, y = (i >> 2) + y0;
    t.x = __builtin_convertvector(x, vf) + 0.5f, t.y = __builtin_convertvector(y, vf) + 0.5f;
    t.inside = (x < r.width) & (y < r.height);
    t.columns = imin2(TILE_W, r.width - x0), t.rows = imin2(TILE_H, r.height - y0);
    t.pixel = (i64)y0 * r.width + x0;
    return t;
}

// Copies the pixels of a tile from an image with `count` numbers per pixel, 0 outside of it, or to it.
INLINE void read_pixels(const Raster& r, const float* image, const Tile& t, int count, float* to) {
    if (t.columns == TILE_W && t.rows == TILE_H) {
        for (int y = 0; y < TILE_H; y++)
            __builtin_memcpy(to + y * TILE_W * count, image + (t.pixel + (i64)y * r.width) * count, 4 * TILE_W * count);
        return;
    }
    clear(to, 4 * LANES * count);
    for (int y = 0; y < t.rows; y++)
        __builtin_memcpy(to + y * TILE_W * count, image + (t.pixel + (i64)y * r.width) * count, 4 * t.columns * count);
}
INLINE void write_pixels(const Raster& r, float* image, const Tile& t, int count, const float* from) {
    bool whole = t.columns == TILE_W;
    for (int y = 0; y < t.rows; y++) {
        float* to = image + (t.pixel + (i64)y * r.width) * count;
        if (whole)
            __builtin_memcpy(to, from + y * TILE_W * count, 4 * TILE_W * count);
        else
            __builtin_memcpy(to, from + y * TILE_W * count, 4 * t.columns * count);
    }
}

// One or three channels per pixel; 0 if the image is null.
INLINE vf read_one(const Raster& r, const float* image, const Tile& t) {
    float x[LANES];
    if (!image) return vf{};
    read_pixels(r, image, t, 1, x);
    return load(x);
}
INLINE void read_three(const Raster& r, const float* image, const Tile& t, vf* channels) {
    float x[3 * LANES];
    channels[0] = channels[1] = channels[2] = vf{};
    if (!image) return;
    read_pixels(r, image, t, 3, x);
    columns_of<3>(x, channels);
}
INLINE void write_one(const Raster& r, float* image, const Tile& t, vf value) {
    float x[LANES];
    store(x, value);
    write_pixels(r, image, t, 1, x);
}
INLINE void write_three(const Raster& r, float* image, const Tile& t, const vf* channels) {
    float x[3 * LANES];
    rows_of<3>(x, channels);
    write_pixels(r, image, t, 3, x);
}

// N rounded up to whole vectors.
template <int N>
constexpr int PADDED = (N + LANES - 1) / LANES * LANES;

// The r.c features per pixel, padded with zeros to C; all are 0 if the image is null.
template <int C>
INLINE void read_features(const Raster& r, const float* image, const Tile& t, vf* features) {
    float x[LANES * C + LANES];
    for (int ch = 0; ch < C; ch++) features[ch] = vf{};
    if (!image) return;
    if (r.c == C)
        read_pixels(r, image, t, C, x);   // a constant makes it faster
    else
        read_pixels(r, image, t, r.c, x);
    for (int first = 0; first < C; first += LANES) {
        vf group[LANES];
        for (int l = 0; l < LANES; l++) group[l] = load(x + l * r.c + first);
        transpose(group);
        for (int i = 0; i < imin2(C - first, LANES); i++) features[first + i] = first + i < r.c ? group[i] : vf{};
    }
}
template <int C>
INLINE void write_features(const Raster& r, const Tile& t, const vf* features) {
    float x[LANES * C + LANES];
    for (int first = 0; first < C; first += LANES) {
        vf group[LANES];
        for (int i = 0; i < LANES; i++) group[i] = first + i < C ? features[first + i] : vf{};
        transpose(group);
        for (int l = 0; l < LANES; l++) {
            if (C <= LANES)
                store(x + l * r.c, group[l]);   // what is beyond r.c is overwritten by the next pixel
            else
                for (int i = 0; i < imin2(r.c - first, LANES); i++) x[l * r.c + first + i] = group[l][i];
        }
    }
    if (r.c == C)
        write_pixels(r, r.features, t, C, x);
    else
        write_pixels(r, r.features, t, r.c, x);
}

// The response of a Gaussian at the pixels of a tile, up to its alpha.
struct Peak {
    vf dx, dy, K, l, r, raw, alpha, zeta_1;   // zeta_1: zeta - 1
    vi on;
};

// Computes the response at the pixels of the mask `alive`; false if the Gaussian contributes to none of them.
INLINE bool peak_at(const float* f, const Tile& t, vi alive, float alpha_min, float alpha_max, Peak& p) {
    p.dx = t.x - f[CX], p.dy = t.y - f[CY];
    vf beta = f[BX] * p.dx + f[BY] * p.dy;
    p.K = p.dx * (f[KA] * p.dx + f[KB] * p.dy) + f[KC] * p.dy * p.dy;
    p.l = beta + 1.0f;
    vf bend = f[KAPPA] * p.K, q = p.l * p.l + bend;
    p.on = alive & (p.K <= f[CUT] * q);
    if (!any(p.on)) return false;
    p.r = inverse(q);
    p.raw = f[OPACITY] * vexp2(-0.721347520f * p.K * p.r);
    p.on &= p.raw >= alpha_min;
    p.raw = keep(p.on, p.raw), p.alpha = vmin(p.raw, splat(alpha_max));
    p.zeta_1 = -(p.l * beta + bend) * p.r;
    return true;
}

struct Corners {
    vf u, v, free_u, free_v;   // clamped and unclamped coordinates
    vf du, dv;                 // derivatives by zeta
};
INLINE Corners corners_at(const float* f, const Peak& p) {
    Corners c;
    vf u = f[UX] * p.dx + f[UY] * p.dy, v = f[VX] * p.dx + f[VY] * p.dy;
    c.du = u + f[EU], c.dv = v + f[EV];
    c.free_u = u + 0.5f + p.zeta_1 * c.du, c.free_v = v + 0.5f + p.zeta_1 * c.dv;
    c.u = vmin(vmax(c.free_u, vf{}), splat(1.0f)), c.v = vmin(vmax(c.free_v, vf{}), splat(1.0f));
    return c;
}

// Buffer of blending weights w of a tile, until there are enough for one transposed reduction over its pixels.
struct Weights {
    vf w[LANES];
    int g[LANES];
    int count;
    float* total;
    METHOD void flush() {
        for (int i = count; i < LANES; i++) w[i] = vf{}, g[i] = g[0];
        float s[LANES];
        store(s, sums_of(w));
        for (int i = 0; i < count; i++) total[g[i]] += s[i];
        count = 0;
    }
    METHOD void add(int which, vf value) {
        w[count] = value, g[count] = which;
        if (++count == LANES) flush();
    }
};

// Buffer of a few Gaussians whose features are added together, so that the sums stay in registers.
template <int C>
struct Features {
    enum { WAITING = 8 };
    vf sum[C + !C], w[WAITING][4];
    const float* f4[WAITING];
    int count;

    METHOD void flush() {
        vf s[C + !C];
        for (int ch = 0; ch < C; ch++) s[ch] = sum[ch];
        for (int i = 0; i < count; i++) {
            const float* f = f4[i];
            vf w0 = w[i][0], w1 = w[i][1], w2 = w[i][2], w3 = w[i][3];
#pragma GCC unroll 16
            for (int ch = 0; ch < C; ch++) {
                s[ch] += w0 * f[ch];
                s[ch] += w1 * f[C + ch];
                s[ch] += w2 * f[2 * C + ch];
                s[ch] += w3 * f[3 * C + ch];
            }
        }
        for (int ch = 0; ch < C; ch++) sum[ch] = s[ch];
        count = 0;
    }
    METHOD void add(const float* features, vf weight, const Corners& c) {
        vf* to = w[count];
        to[0] = weight, to[1] = weight * c.u, to[2] = weight * c.v, to[3] = to[1] * c.v;
        f4[count] = features;
        if (++count == WAITING) flush();
    }
};

// Prefetches `size` numbers for the Gaussian that follows some places later in the lists of tiles, which follow each other.
INLINE void prefetch(const Raster& r, const int* place, const float* array, int size) {
    enum { AHEAD = 6 };
    const float* p = array + (i64)place[imin2(AHEAD, (int)(r.list + r.n_pairs - 1 - place))] * size;
    for (int i = 0; i < size; i += 16) __builtin_prefetch(p + i);
}

// Draws a tile, and moves the Gaussians that contribute to it to the beginning of its list; returns their number.
template <int C>
static int composite_tile(const Raster& r, const Tile& t, int* list, int count, Weights& weights, int* touched) {
    vf T = keep(t.inside, splat(1.0f)), red = {}, green = {}, blue = {}, z = {}, zz = {}, nx = {}, ny = {}, nz = {};
    vf best = {};
    Features<C> features;
    features.count = 0;
    for (int ch = 0; ch < C; ch++) features.sum[ch] = vf{};
    vi dominant = splat(-1), alive = T >= r.T_min;
    u32 counted = r.mask_stride ? bits(read_one(r, r.mask, t) > 0.5f) : bits(vi{} == 0) * (r.mask[0] > 0.5f);
    int kept = 0;
    for (int i = 0; i < count; i++) {
        int g = list[i];
        const float* f = r.record + (i64)g * r.record_size;
        prefetch(r, list + i, r.record, RECORD + 4 * C);
        Peak p;
        if (!peak_at(f, t, alive, r.alpha_min, r.alpha_max, p)) continue;
        list[kept++] = g;
        vf w = p.alpha * T, depth = f[DZ] + f[PZ] * p.zeta_1;
        red += w * f[RED], green += w * f[GREEN], blue += w * f[BLUE];
        nx += w * f[NX], ny += w * f[NY], nz += w * f[NZ];
        vf wz = w * depth;
        z += wz, zz += wz * depth;
        if (C) features.add(f + RECORD, w, corners_at(f, p));
        vi better = w > best;
        best = pick(better, w, best), dominant = better ? splat(g) : dominant;
        weights.add(g, w);
        touched[g] += __builtin_popcount(bits(p.on) & counted);
        T -= w, alive = T >= r.T_min;
        if (!any(alive)) break;
    }
    features.flush();
    vf alpha = keep(t.inside, 1.0f - T);
    vi covered = dominant >= 0;
    vf inv = keep(covered, 1.0f / alpha), mean = z * inv;
    const vf rgb[3] = {red, green, blue}, normal[3] = {nx * inv, ny * inv, nz * inv};
    write_three(r, r.rgb, t, rgb), write_three(r, r.normal, t, normal);
    write_one(r, r.alpha, t, keep(covered, alpha)), write_one(r, r.depth, t, keep(covered, r.t[2] + mean));
    write_one(r, r.depth_var, t, zz * inv - mean * mean), write_one(r, (float*)r.dominant, t, (vf)dominant);
    for (int ch = 0; ch < C; ch++) features.sum[ch] *= inv;
    if (C) write_features<C + !C>(r, t, features.sum);
    return kept;
}

// Gradients dL/d(sums) at the pixels of a tile.
template <int C>
struct Seeds {
    vf fixed[6], alpha, z, zz, rem;   // fixed: rgb and normal
    vf features[C + 1];
    float rows[LANES][PADDED<C + !C>];   // the same with one row per pixel
};

template <int C>
INLINE void seed(const Raster& r, const Tile& t, Seeds<C>& s) {
    vf alpha = read_one(r, r.alpha, t), x[C + 3], v[C + 3];
    vi covered = t.inside & (alpha > 0.0f);
    vf inv = keep(covered, 1.0f / alpha);
    read_three(r, r.rgb, t, x), read_three(r, r.v_rgb, t, s.fixed);
    s.alpha = keep(covered, read_one(r, r.v_alpha, t)), s.rem = s.alpha * alpha;
    for (int i = 0; i < 3; i++) s.rem += s.fixed[i] * x[i];
    read_three(r, r.normal, t, x), read_three(r, r.v_normal, t, v);
    for (int i = 0; i < 3; i++) s.fixed[3 + i] = v[i] * inv, s.alpha -= s.fixed[3 + i] * x[i];
    if (C) read_features<C + !C>(r, r.features, t, x), read_features<C + !C>(r, r.v_features, t, v);
    for (int ch = 0; ch < C; ch++) s.features[ch] = v[ch] * inv, s.alpha -= s.features[ch] * x[ch];
    vf mean = read_one(r, r.depth, t) - r.t[2], v_var = read_one(r, r.v_depth_var, t);
    s.zz = v_var * inv;
    s.z = (read_one(r, r.v_depth, t) - 2.0f * mean * v_var) * inv;
    s.alpha -= s.z * mean + s.zz * (read_one(r, r.depth_var, t) + mean * mean);
    for (int first = 0; first < C; first += LANES) {
        vf group[LANES];
        for (int i = 0; i < LANES; i++) group[i] = first + i < C ? s.features[first + i] : vf{};
        transpose(group);
        for (int l = 0; l < LANES; l++) store(s.rows[l] + first, group[l]);
    }
}

// Adds the gradients of the corners of a Gaussian with the weight w at the pixels of a mask.
template <int C>
INLINE void add_corners(float* out, vf w, u32 pixels, const Corners& c, const Seeds<C>& s) {
    enum { WIDTH = PADDED<C + !C> };
    vf wu = w * c.u, w1 = w - wu, w11 = wu * c.v, w01 = w1 * c.v;
    float x[4][LANES];
    store(x[0], w1 - w01), store(x[1], wu - w11), store(x[2], w01), store(x[3], w11);
    for (int j = 0; j < WIDTH; j += LANES) {
        vf sum[4];
        for (int k = 0; k < 4; k++) sum[k] = load(out + k * WIDTH + j);
        for (u32 some = pixels; some; some &= some - 1) {
            int l = __builtin_ctz(some);
            vf row = load(s.rows[l] + j);
            for (int k = 0; k < 4; k++) sum[k] += x[k][l] * row;
        }
        for (int k = 0; k < 4; k++) store(out + k * WIDTH + j, sum[k]);
    }
}

template <int C>
static void adjoint_tile(const Raster& r, const Tile& t, const int* list, int count, float* parts) {
    enum { N = C ? SUMS : S_U };
    Seeds<C> s;
    seed<C>(r, t, s);
    vf T = keep(t.inside, splat(1.0f)), rem = s.rem;
    for (int i = 0; i < count; i++) {
        int g = list[i];
        const float* f = r.record + (i64)g * r.record_size;
        prefetch(r, list + i, r.record, RECORD + 4 * C);
        prefetch(r, list + i, parts, PADDED<N> + (C ? 4 * PADDED<C + !C> : 0));
        Peak p;
        if (!peak_at(f, t, T >= r.T_min, r.alpha_min, r.alpha_max, p)) continue;
        float* out = parts + (i64)g * r.gradient_size;
        vf w = p.alpha * T, depth = f[DZ] + f[PZ] * p.zeta_1, bent = depth * s.zz, slope = s.z + bent;
        vf value = s.alpha + depth * slope, v_zeta = f[PZ] * (w * (slope + bent)), x[PADDED<N>] = {};
        for (int j = 0; j < 6; j++) value += s.fixed[j] * f[j < 3 ? RED + j : NX + j - 3];
        if (C) {
            Corners c = corners_at(f, p);
            const float* f4 = f + RECORD;
            // Two chains of sums each, because the latency of one chain would stall the processor.
            vf f0 = {}, f1 = {}, f2 = {}, f3 = {}, h0 = {}, h1 = {}, h2 = {}, h3 = {};
#pragma GCC unroll 8
            for (int ch = 0; ch < C; ch += 2) {
                vf a = s.features[ch], b = s.features[ch + 1];
                f0 += a * f4[ch], f1 += a * f4[C + ch], f2 += a * f4[2 * C + ch], f3 += a * f4[3 * C + ch];
                h0 += b * f4[ch + 1], h1 += b * f4[C + ch + 1], h2 += b * f4[2 * C + ch + 1], h3 += b * f4[3 * C + ch + 1];
            }
            f0 += h0, f1 += h1, f2 += h2, f3 += h3;
            vf by_u = f1 + c.v * f3;
            value += f0 + c.u * by_u + c.v * f2;
            vf v_u = keep(c.u == c.free_u, w * by_u), v_v = keep(c.v == c.free_v, w * (f2 + c.u * f3));
            v_zeta += v_u * c.du + v_v * c.dv;
            x[S_EU] = v_u * p.zeta_1, x[S_EV] = v_v * p.zeta_1;
            x[S_U] = v_u + x[S_EU], x[S_V] = v_v + x[S_EV];
            x[S_UX] = x[S_U] * p.dx, x[S_UY] = x[S_U] * p.dy, x[S_VX] = x[S_V] * p.dx, x[S_VY] = x[S_V] * p.dy;
            add_corners<C>(out + PADDED<N>, w, bits(p.on), c, s);
        }
        rem -= w * value;
        vf v_alpha = T * value - rem * inverse(1.0f - p.alpha);
        x[S_RHO] = keep(p.raw <= r.alpha_max, v_alpha * (-0.5f * p.raw));
        vf v_r = x[S_RHO] * p.K + v_zeta * p.l, v_q = v_r * (p.r * p.r);   // -v_q
        x[S_L] = v_zeta * p.r - 2.0f * p.l * v_q;
        vf v_K = x[S_RHO] * p.r - f[KAPPA] * v_q;
        x[S_KX] = v_K * p.dx, x[S_KY] = v_K * p.dy, x[S_KAPPA] = v_q * p.K;
        x[S_A] = x[S_KX] * p.dx, x[S_B] = x[S_KX] * p.dy, x[S_C] = x[S_KY] * p.dy;
        x[S_BX] = x[S_L] * p.dx, x[S_BY] = x[S_L] * p.dy;
        for (int j = 0; j < 6; j++) x[S_RGB + j] = w * s.fixed[j];
        for (int j = 0; j < N; j += LANES) store(out + j, load(out + j) + sums_of(x + j));
        T -= w;
    }
}

// The adjoint for the features at the corners only, if no gradient of the geometry is needed.
template <int C>
static void corner_adjoint_tile(const Raster& r, const Tile& t, const int* list, int count, float* parts) {
    Seeds<C> s;
    seed<C>(r, t, s);
    vf T = keep(t.inside, splat(1.0f));
    for (int i = 0; i < count; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size;
        prefetch(r, list + i, r.record, RECORD + 4 * C);
        Peak p;
        if (!peak_at(f, t, T >= r.T_min, r.alpha_min, r.alpha_max, p)) continue;
        vf w = p.alpha * T;
        add_corners<C>(parts + (i64)list[i] * r.gradient_size + PADDED<SUMS>, w, bits(p.on), corners_at(f, p), s);
        T -= w;
    }
}

// The first tile of a share. Shares are consecutive tiles with about as many pairs of a tile and a Gaussian.
INLINE int first_tile(const Raster& r, int share) {
    i64 n_tiles = tiles_x(r) * tiles_y(r), low = 0, high = n_tiles, wanted = (r.n_pairs + n_tiles) * share / r.threads;
    while (low < high) {
        i64 middle = (low + high) / 2;
        if (r.tile_start[middle] + middle < wanted)
            low = middle + 1;
        else
            high = middle;
    }
    return (int)low;
}

template <int C>
static void composite_share(Raster& r, int share) {
    int* touched = r.touched_parts + (i64)share * r.n;
    Weights weights;
    weights.count = 0, weights.total = r.weight_parts + (i64)share * r.n;
    clear(weights.total, (i64)4 * r.n), clear(touched, (i64)4 * r.n);
    for (int tile = first_tile(r, share); tile < first_tile(r, share + 1); tile++) {
        int start = r.tile_start[tile], count = r.tile_start[tile + 1] - start;
        r.counts[tile] = composite_tile<C>(r, tile_at(r, tile), r.list + start, count, weights, touched);
    }
    weights.flush();
}

// Adds the weights and counts of all shares.
static void add_share(const Raster& r, int share) {
    int start = share_start(r.n, share, r.threads), end = share_start(r.n, share + 1, r.threads);
    for (int part = 0; part < r.threads; part++) {
        const float* weight = r.weight_parts + (i64)part * r.n;
        const int* touched = r.touched_parts + (i64)part * r.n;
        for (int i = start; i < end; i++) {
            r.weight[i] = (part ? r.weight[i] : 0) + weight[i];
            r.touched[i] = (part ? r.touched[i] : 0) + touched[i];
        }
    }
}

template <int C>
static void adjoint_share(Raster& r, int share) {
    float* parts = r.parts + (i64)share * r.n * r.gradient_size;
    for (int g = 0; g < r.n; g++)
        for (int j = 0; r.keys[g] != ~0u && j < r.gradient_size; j += LANES) store(parts + (i64)g * r.gradient_size + j, vf{});
    for (int tile = first_tile(r, share); tile < first_tile(r, share + 1); tile++) {
        const int* list = r.list + r.tile_start[tile];
        if (!r.counts[tile]) continue;
        if (r.v_means)
            adjoint_tile<C>(r, tile_at(r, tile), list, r.counts[tile], parts);
        else
            corner_adjoint_tile<C>(r, tile_at(r, tile), list, r.counts[tile], parts);
    }
}
