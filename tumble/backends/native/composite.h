// Blending front to back, a block of LANES pixels at a time, and its adjoint, which also traverses front to back: with
// s_i = dL/dw_i, the Gaussians behind Gaussian i contribute rem = dL/dout . out - sum_{j <= i} w_j s_j.
// Formulas in raster.h. C is the number of features, rounded up to a multiple of 4.
#pragma once
#include "raster.h"

struct Block {
    vf x, y;       // pixel centres
    vi inside;     // lanes within the image
    bool whole;    // all lanes are within the image
    bool corner;   // first block of its tile
    int tile;
    i64 pixel[LANES];
};

INLINE Block block_at(const Raster& r, int x0, int y0) {
    Block b;
    vi i = lane_index(), x = (i & 3) + x0, y = (i >> 2) + y0;
    b.whole = x0 + BLOCK_W <= r.width && y0 + BLOCK_H <= r.height;
    b.x = __builtin_convertvector(x, vf) + 0.5f, b.y = __builtin_convertvector(y, vf) + 0.5f;
    b.inside = (x < r.width) & (y < r.height);
    for (int l = 0; l < LANES; l++)
        b.pixel[l] = (i64)imin2(y0 + (l >> 2), r.height - 1) * r.width + imin2(x0 + (l & 3), r.width - 1);
    return b;
}

// Reads LANES channels from `first` on of an image with `stride` channels, at the pixels of a block. Channels beyond
// the last one are those of the next pixel, or zero at the end of the image. All are zero if the image is null.
INLINE void read_channels(const Raster& r, const float* image, const Block& b, int stride, int first, vf* x) {
    i64 end = (i64)r.height * r.width * stride;
    for (int l = 0; l < LANES; l++) {
        i64 at = b.pixel[l] * stride + first;
        if (image && at + LANES <= end) {
            x[l] = load(image + at);
            continue;
        }
        float part[LANES] = {};
        for (int ch = 0; image && ch < end - at; ch++) part[ch] = image[at + ch];
        x[l] = load(part);
    }
    transpose(x);
}
INLINE vf read_one(const float* image, const Block& b) {
    float x[LANES];
    if (!image) return vf{};
    for (int y = 0; y < BLOCK_H; y++) {
        const i64* pixel = b.pixel + y * BLOCK_W;
        if (b.whole)
            __builtin_memcpy(x + y * BLOCK_W, image + *pixel, 4 * BLOCK_W);
        else
            for (int l = 0; l < BLOCK_W; l++) x[y * BLOCK_W + l] = image[pixel[l]];
    }
    return load(x);
}

// Transposes C channels x of a block to one row per pixel, padded with zeros.
template <int C, int N>
INLINE void lay_out(const vf* x, float (*rows)[N]) {
    for (int first = 0; first < N; first += LANES) {
        vf group[LANES];
        for (int i = 0; i < LANES; i++) group[i] = first + i < C ? x[first + i] : vf{};
        transpose(group);
        for (int l = 0; l < LANES; l++) store(rows[l] + first, group[l]);
    }
}

// N rounded up to whole vectors.
template <int N>
constexpr int PADDED = (N + LANES - 1) / LANES * LANES;

// Writes the first `count` of C channels to an image with `count` channels.
template <int C>
INLINE void write_channels(float* image, const Block& b, int count, const vf* x) {
    float rows[LANES][PADDED<C>];
    u32 inside = bits(b.inside);
    lay_out<C>(x, rows);
    for (int l = 0; l < LANES; l++)
        if (inside >> l & 1) __builtin_memcpy(image + b.pixel[l] * count, rows[l], 4 * count);
}
INLINE void write_one(float* image, const Block& b, vf value) {
    float x[LANES];
    u32 inside = bits(b.inside);
    store(x, value);
    for (int y = 0; b.whole && y < BLOCK_H; y++)
        __builtin_memcpy(image + b.pixel[y * BLOCK_W], x + y * BLOCK_W, 4 * BLOCK_W);
    for (int l = 0; !b.whole && l < LANES; l++)
        if (inside >> l & 1) image[b.pixel[l]] = x[l];
}

// The response of a Gaussian at the pixels of a block, up to its alpha.
struct Peak {
    vf dx, dy, K, l, q, r, G, raw, alpha;
    vi on;
};

// Computes the response at the pixels of the mask `alive`; false if the Gaussian contributes to none of them.
INLINE bool peak_at(const float* f, const Block& b, vi alive, float alpha_min, float alpha_max, Peak& p) {
    p.dx = b.x - f[CX], p.dy = b.y - f[CY];
    vf beta = f[BX] * p.dx + f[BY] * p.dy;
    p.K = p.dx * (f[KA] * p.dx + f[KB] * p.dy) + f[KC] * p.dy * p.dy;
    p.l = beta + 1.0f, p.q = p.l * p.l + f[KAPPA] * p.K;
    p.on = alive & (p.K <= f[CUT] * p.q);
    if (!any(p.on)) return false;
    p.r = 1.0f / p.q;
    p.G = vexp(vmax(-0.5f * p.K * p.r, splat(-80.0f)));
    p.raw = f[OPACITY] * p.G;
    p.on &= p.raw >= alpha_min;
    p.alpha = keep(p.on, vmin(p.raw, splat(alpha_max)));
    return true;
}
// zeta - 1
INLINE vf lift(const float* f, const Peak& p) { return -(p.l * (p.l - 1.0f) + f[KAPPA] * p.K) * p.r; }

struct Corners {
    vf u, v, free_u, free_v;   // clamped and unclamped coordinates
};
INLINE Corners corners_at(const float* f, const Peak& p, vf zeta, vf zeta_1) {
    Corners c;
    c.free_u = 0.5f + zeta_1 * f[EU] + zeta * (f[UX] * p.dx + f[UY] * p.dy);
    c.free_v = 0.5f + zeta_1 * f[EV] + zeta * (f[VX] * p.dx + f[VY] * p.dy);
    c.u = vmin(vmax(c.free_u, vf{}), splat(1.0f)), c.v = vmin(vmax(c.free_v, vf{}), splat(1.0f));
    return c;
}

// Buffer of blending weights w of a block, until there are enough for one transposed reduction over its pixels.
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
            for (int ch = 0; ch < C; ch++)
                s[ch] += w0 * f[4 * ch] + w1 * f[4 * ch + 1] + w2 * f[4 * ch + 2] + w3 * f[4 * ch + 3];
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

template <int C>
static void composite_block(const Raster& r, const Block& b, const int* list, int count, Weights& weights,
                            int* touched) {
    vf T = keep(b.inside, splat(1.0f)), red = {}, green = {}, blue = {}, z = {}, zz = {}, nx = {}, ny = {}, nz = {};
    vf best = {};
    Features<C> features;
    features.count = 0;
    for (int ch = 0; ch < C; ch++) features.sum[ch] = vf{};
    vi dominant = splat(-1);
    u32 counted = 0;
    for (int l = 0; l < LANES; l++)
        counted |= (u32)(r.mask[r.mask_stride * b.pixel[l]] > 0.5f) << l;
    for (int i = 0; i < count; i++) {
        int g = list[i];
        const float* f = r.record + (i64)g * r.record_size;
        Peak p;
        if (!peak_at(f, b, T >= r.T_min, r.alpha_min, r.alpha_max, p)) continue;
        vf w = p.alpha * T, zeta_1 = lift(f, p), depth = f[DZ] + f[PZ] * zeta_1;
        red += w * f[RED], green += w * f[GREEN], blue += w * f[BLUE];
        nx += w * f[NX], ny += w * f[NY], nz += w * f[NZ];
        vf wz = w * depth;
        z += wz, zz += wz * depth;
        if (C) features.add(f + RECORD, w, corners_at(f, p, p.l * p.r, zeta_1));
        vi better = w > best;
        best = pick(better, w, best), dominant = better ? splat(g) : dominant;
        weights.add(g, w);
        touched[g] += __builtin_popcount(bits(p.on) & counted);
        T -= w;
        if (!any(T >= r.T_min)) break;
    }
    features.flush();
    vf alpha = keep(b.inside, 1.0f - T);
    vi covered = dominant >= 0;
    vf inv = keep(covered, 1.0f / alpha), mean = z * inv;
    const vf rgb[3] = {red, green, blue}, normal[3] = {nx * inv, ny * inv, nz * inv};
    write_channels<3>(r.rgb, b, 3, rgb), write_channels<3>(r.normal, b, 3, normal);
    write_one(r.alpha, b, keep(covered, alpha)), write_one(r.depth, b, keep(covered, r.t[2] + mean));
    write_one(r.depth_var, b, zz * inv - mean * mean), write_one((float*)r.dominant, b, (vf)dominant);
    for (int ch = 0; ch < C; ch++) features.sum[ch] *= inv;
    if (C) write_channels<C + !C>(r.features, b, r.c, features.sum);
}

// Gradients dL/d(sums) at the pixels of a block.
template <int C>
struct Seeds {
    vf red, green, blue, nx, ny, nz, alpha, z, zz, rem;
    vf features[C + 1];
    // The same channels with one row per pixel: rgb and normal; features.
    float fixed_rows[LANES][PADDED<6>], feature_rows[LANES][PADDED<C + !C>];
};

template <int C>
INLINE void seed(const Raster& r, const Block& b, Seeds<C>& s) {
    vf alpha = read_one(r.alpha, b), inv = keep(b.inside & (alpha > 0.0f), 1.0f / alpha), x[LANES], v[LANES];
    vi covered = inv > 0.0f;
    read_channels(r, r.rgb, b, 3, 0, x), read_channels(r, r.v_rgb, b, 3, 0, v);
    s.red = keep(covered, v[0]), s.green = keep(covered, v[1]), s.blue = keep(covered, v[2]);
    s.alpha = keep(covered, read_one(r.v_alpha, b));
    s.rem = s.red * x[0] + s.green * x[1] + s.blue * x[2] + s.alpha * alpha;
    read_channels(r, r.normal, b, 3, 0, x), read_channels(r, r.v_normal, b, 3, 0, v);
    s.nx = v[0] * inv, s.ny = v[1] * inv, s.nz = v[2] * inv;
    s.alpha -= s.nx * x[0] + s.ny * x[1] + s.nz * x[2];
    for (int first = 0; first < C; first += LANES) {
        read_channels(r, r.features, b, r.c, first, x), read_channels(r, r.v_features, b, r.c, first, v);
        for (int i = 0; i < imin2(C - first, LANES); i++) {
            s.features[first + i] = first + i < r.c ? v[i] * inv : vf{};
            if (first + i < r.c) s.alpha -= s.features[first + i] * x[i];
        }
    }
    vf mean = read_one(r.depth, b) - r.t[2], v_var = read_one(r.v_depth_var, b);
    s.zz = v_var * inv;
    s.z = (read_one(r.v_depth, b) - 2.0f * mean * v_var) * inv;
    s.alpha -= s.z * mean + s.zz * (read_one(r.depth_var, b) + mean * mean);
    const vf fixed[6] = {s.red, s.green, s.blue, s.nx, s.ny, s.nz};
    lay_out<6>(fixed, s.fixed_rows), lay_out<C>(s.features, s.feature_rows);
}

// to[k][0..] += sum over pixels of w[k] times the row of channels, for M weightings k.
template <int M, int N>
INLINE void add_channels(float* to, const vf* w, const float (*rows)[N]) {
    float x[M][LANES];
    for (int k = 0; k < M; k++) store(x[k], w[k]);
    for (int j = 0; j < N; j += LANES) {
        vf even[M], odd[M] = {};
        for (int k = 0; k < M; k++) even[k] = load(to + k * N + j);
        for (int l = 0; l < LANES; l += 2) {
            vf row = load(rows[l] + j), next = load(rows[l + 1] + j);
            for (int k = 0; k < M; k++) even[k] += x[k][l] * row, odd[k] += x[k][l + 1] * next;
        }
        for (int k = 0; k < M; k++) store(to + k * N + j, even[k] + odd[k]);
    }
}

// Adds the gradients of the corners of a Gaussian.
template <int C>
INLINE void add_corners(float* out, vf w, const Corners& c, const Seeds<C>& s) {
    vf wu = w * c.u, w1 = w - wu, w11 = wu * c.v, w01 = w1 * c.v;
    const vf parts_of_w[4] = {w1 - w01, wu - w11, w01, w11};
    add_channels<4>(out + GEOMETRY + PADDED<6>, parts_of_w, s.feature_rows);
}

template <int C>
static void adjoint_block(const Raster& r, const Block& b, const int* list, int count, float* parts) {
    Seeds<C> s;
    seed<C>(r, b, s);
    vf T = keep(b.inside, splat(1.0f)), rem = s.rem;
    for (int i = 0; i < count; i++) {
        int g = list[i];
        const float* f = r.record + (i64)g * r.record_size;
        Peak p;
        if (!peak_at(f, b, T >= r.T_min, r.alpha_min, r.alpha_max, p)) continue;
        float* out = parts + (i64)g * r.gradient_size;
        vf w = p.alpha * T, zeta = p.l * p.r, zeta_1 = lift(f, p), depth = f[DZ] + f[PZ] * zeta_1;
        vf value = s.alpha + s.red * f[RED] + s.green * f[GREEN] + s.blue * f[BLUE] + s.nx * f[NX] + s.ny * f[NY] +
                   s.nz * f[NZ] + depth * (s.z + depth * s.zz);
        vf v_depth = w * (s.z + 2.0f * depth * s.zz), v_zeta = v_depth * f[PZ], v_dx = {}, v_dy = {};
        vf x[16];
        for (int j = G_UX; j <= G_EV; j++) x[j] = vf{};
        if (C) {
            Corners c = corners_at(f, p, zeta, zeta_1);
            const float* f4 = f + RECORD;
            // Two chains of sums each, because the latency of one chain would stall the processor.
            vf f0 = {}, f1 = {}, f2 = {}, f3 = {}, h0 = {}, h1 = {}, h2 = {}, h3 = {};
#pragma GCC unroll 8
            for (int ch = 0; ch < C; ch += 2, f4 += 8) {
                vf x = s.features[ch], y = s.features[ch + 1];
                f0 += x * f4[0], f1 += x * f4[1], f2 += x * f4[2], f3 += x * f4[3];
                h0 += y * f4[4], h1 += y * f4[5], h2 += y * f4[6], h3 += y * f4[7];
            }
            f0 += h0, f1 += h1, f2 += h2, f3 += h3;
            value += f0 + c.u * f1 + c.v * (f2 + c.u * f3);
            vf v_u = keep(c.u == c.free_u, w * (f1 + c.v * f3)), v_v = keep(c.v == c.free_v, w * (f2 + c.u * f3));
            vf zu = zeta * v_u, zv = zeta * v_v;
            v_zeta += v_u * (f[EU] + f[UX] * p.dx + f[UY] * p.dy) + v_v * (f[EV] + f[VX] * p.dx + f[VY] * p.dy);
            v_dx = zu * f[UX] + zv * f[VX], v_dy = zu * f[UY] + zv * f[VY];
            x[G_UX] = zu * p.dx, x[G_UY] = zu * p.dy, x[G_EU] = v_u * zeta_1;
            x[G_VX] = zv * p.dx, x[G_VY] = zv * p.dy, x[G_EV] = v_v * zeta_1;
            add_corners<C>(out, w, c, s);
        }
        add_channels<1>(out + GEOMETRY, &w, s.fixed_rows);
        rem -= w * value;
        vf v_alpha = T * value - rem / (1.0f - p.alpha);
        v_alpha = keep(p.on & (p.raw <= r.alpha_max), v_alpha);
        vf v_rho = -0.5f * v_alpha * p.raw;
        vf v_r = v_rho * p.K + v_zeta * p.l, v_q = -v_r * p.r * p.r;
        vf v_l = v_zeta * p.r + 2.0f * p.l * v_q, v_K = v_rho * p.r + f[KAPPA] * v_q;
        vf Kx = v_K * p.dx, Ky = v_K * p.dy;
        x[G_A] = Kx * p.dx, x[G_B] = Kx * p.dy, x[G_C] = Ky * p.dy;
        x[G_BX] = v_l * p.dx, x[G_BY] = v_l * p.dy;
        x[G_CX] = -(v_dx + 2.0f * f[KA] * Kx + f[KB] * Ky + v_l * f[BX]);
        x[G_CY] = -(v_dy + f[KB] * Kx + 2.0f * f[KC] * Ky + v_l * f[BY]);
        x[G_KAPPA] = v_q * p.K, x[G_OPACITY] = v_alpha * p.G, x[G_PZ] = v_depth * zeta;
        for (int j = 0; j < GEOMETRY; j += LANES) store(out + j, load(out + j) + sums_of(x + j));
        T -= w;
        if (!any(T >= r.T_min)) break;
    }
}

// The adjoint for the features at the corners only, if no gradient of the geometry is needed.
template <int C>
static void corner_adjoint_block(const Raster& r, const Block& b, const int* list, int count, float* parts) {
    Seeds<C> s;
    seed<C>(r, b, s);
    vf T = keep(b.inside, splat(1.0f));
    for (int i = 0; i < count; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size;
        Peak p;
        if (!peak_at(f, b, T >= r.T_min, r.alpha_min, r.alpha_max, p)) continue;
        vf w = p.alpha * T;
        Corners c = corners_at(f, p, p.l * p.r, lift(f, p));
        add_corners<C>(parts + (i64)list[i] * r.gradient_size, w, c, s);
        T -= w;
        if (!any(T >= r.T_min)) break;
    }
}

// Calls visit for all blocks of a share. Tiles are assigned round-robin because the object is in the image centre.
template <class F>
INLINE void for_blocks(const Raster& r, int share, F visit) {
    int across = tiles_x(r), n_tiles = across * tiles_y(r);
    for (int tile = share; tile < n_tiles; tile += r.threads) {
        int start = r.tile_start[tile], count = r.tile_start[tile + 1] - start;
        int x0 = tile % across * TILE, y0 = tile / across * TILE;
        for (int y = y0; y < imin2(y0 + TILE, r.height); y += BLOCK_H)
            for (int x = x0; x < imin2(x0 + TILE, r.width); x += BLOCK_W) {
                Block b = block_at(r, x, y);
                b.tile = tile, b.corner = x == x0 && y == y0;
                visit(b, r.list + start, count);
            }
    }
}

// Prefetches what the adjoint of a tile will read, because the rows of a tile lie far apart in memory.
INLINE void prefetch_tile(const Raster& r, int tile) {
    const float* images[] = {r.rgb, r.v_rgb, r.normal, r.v_normal, r.features, r.v_features, r.alpha, r.v_alpha};
    const int strides[] = {3, 3, 3, 3, r.c, r.c, 1, 1};
    int across = tiles_x(r), x0 = tile % across * TILE, y0 = tile / across * TILE;
    if (tile >= across * tiles_y(r) || r.tile_start[tile] == r.tile_start[tile + 1]) return;
    for (int i = 0; i < 8; i++)
        for (int y = y0; images[i] && y < imin2(y0 + TILE, r.height); y++) {
            const float* row = images[i] + ((i64)y * r.width + x0) * strides[i];
            for (int at = 0; at < TILE * strides[i]; at += 16) __builtin_prefetch(row + at);
        }
}

template <int C>
static void composite_share(Raster& r, int share) {
    int* touched = r.touched_parts + (i64)share * r.n;
    Weights weights;
    weights.count = 0, weights.total = r.weight_parts + (i64)share * r.n;
    clear(weights.total, (i64)4 * r.n), clear(touched, (i64)4 * r.n);
    for_blocks(r, share, [&](const Block& b, const int* list, int count) {
        composite_block<C>(r, b, list, count, weights, touched);
    });
    weights.flush();
}

template <int C>
static void adjoint_share(Raster& r, int share) {
    float* parts = r.parts + (i64)share * r.n * r.gradient_size;
    for (int g = 0; g < r.n; g++)
        if (r.keys[g] != ~0u) clear(parts + (i64)g * r.gradient_size, (i64)4 * r.gradient_size);
    for_blocks(r, share, [&](const Block& b, const int* list, int count) {
        if (b.corner) prefetch_tile(r, b.tile + r.threads);
        if (count && r.v_means) adjoint_block<C>(r, b, list, count, parts);
        if (count && !r.v_means) corner_adjoint_block<C>(r, b, list, count, parts);
    });
}
