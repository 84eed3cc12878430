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

// The r.c features per pixel, one pixel after the other; what is read beyond the last one is undefined.
template <int C>
INLINE void read_features(const Raster& r, const float* image, const Tile& t, float* to) {
    if (r.c == C)
        read_pixels(r, image, t, C, to);   // a constant makes it faster
    else
        read_pixels(r, image, t, r.c, to);
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

// Prefetches `size` numbers for the Gaussian that follows some places later in the lists of tiles, which follow each other.
INLINE void prefetch(const Raster& r, const int* place, const float* array, int size) {
    enum { AHEAD = 6 };
    const float* p = array + (i64)place[imin2(AHEAD, (int)(r.list + r.n_pairs - 1 - place))] * size;
    for (int i = 0; i < size; i += 16) __builtin_prefetch(p + i);
}

// Gaussians of a tile are processed in groups, one part of the computation after the other for the whole group: the processor
// overlaps what depends on no other Gaussian, and sums and seeds of features stay in registers.
enum { GROUP = 12 };

// Responses of a group at the pixels of a tile.
struct Responses {
    vf K[GROUP], l[GROUP], r[GROUP], zeta_1[GROUP];   // r: 1 / q; zeta_1: zeta - 1
    vf raw[GROUP];                                    // alpha before it is limited, 0 where it is too small
    vf u[GROUP], v[GROUP];                            // corner coordinates before they are clamped
};

template <int C>
INLINE void respond(const Raster& r, const Tile& t, const int* list, int n, Responses& s) {
    for (int i = 0; i < n; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size;
        prefetch(r, list + i, r.record, RECORD + 4 * C);
        vf dx = t.x - f[CX], dy = t.y - f[CY], beta = f[BX] * dx + f[BY] * dy, l = beta + 1.0f;
        vf K = dx * (f[KA] * dx + f[KB] * dy) + f[KC] * dy * dy, bend = f[KAPPA] * K, q = l * l + bend, inv_q = inverse(q);
        vf raw = f[OPACITY] * vexp2(-0.721347520f * K * inv_q), zeta_1 = -(l * beta + bend) * inv_q;
        s.K[i] = K, s.l[i] = l, s.r[i] = inv_q, s.zeta_1[i] = zeta_1;
        s.raw[i] = keep((K <= f[CUT] * q) & (raw >= r.alpha_min), raw);
        if (!C) continue;
        vf u = f[UX] * dx + f[UY] * dy, v = f[VX] * dx + f[VY] * dy;
        s.u[i] = u + 0.5f + zeta_1 * (u + f[EU]), s.v[i] = v + 0.5f + zeta_1 * (v + f[EV]);
    }
}

INLINE vf clamped(vf x) { return vmin(vmax(x, vf{}), splat(1.0f)); }

// Adds the features of n Gaussians, of which f holds the rows of a record, with the weights w, w u, w v and w u v.
template <int C>
INLINE void add_features(const float* const* f4, const vf (*w)[4], int n, vf* sum) {
    vf s[C + !C];
    for (int ch = 0; ch < C; ch++) s[ch] = sum[ch];
    for (int i = 0; i < n; i++) {
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
}

// Draws a tile, and moves the Gaussians that contribute to it to the beginning of its list; returns their number.
template <int C>
static int composite_tile(const Raster& r, const Tile& t, int* list, int count, Weights& weights, int* touched) {
    vf T = keep(t.inside, splat(1.0f)), red = {}, green = {}, blue = {}, z = {}, zz = {}, nx = {}, ny = {}, nz = {};
    vf best = {}, features[C + !C] = {};
    vi dominant = splat(-1), alive = T >= r.T_min;
    u32 counted = r.mask_stride ? bits(read_one(r, r.mask, t) > 0.5f) : bits(vi{} == 0) * (r.mask[0] > 0.5f);
    int kept = 0;
    for (int first = 0; first < count && any(alive); first += GROUP) {
        int n = imin2(GROUP, count - first), n_blended = 0;
        Responses s;
        vf w4[GROUP][4];
        const float* f4[GROUP];
        respond<C>(r, t, list + first, n, s);
        for (int i = 0; i < n; i++) {
            int g = list[first + i];
            vi on = alive & (s.raw[i] > 0.0f);
            if (!any(on)) continue;
            list[kept++] = g;
            const float* f = r.record + (i64)g * r.record_size;
            vf w = keep(alive, vmin(s.raw[i], splat(r.alpha_max)) * T), depth = f[DZ] + f[PZ] * s.zeta_1[i];
            red += w * f[RED], green += w * f[GREEN], blue += w * f[BLUE];
            nx += w * f[NX], ny += w * f[NY], nz += w * f[NZ];
            vf wz = w * depth;
            z += wz, zz += wz * depth;
            if (C) {
                vf *to = w4[n_blended], v = clamped(s.v[i]);
                to[0] = w, to[1] = w * clamped(s.u[i]), to[2] = w * v, to[3] = to[1] * v;
                f4[n_blended++] = f + RECORD;
            }
            vi better = w > best;
            best = pick(better, w, best), dominant = better ? splat(g) : dominant;
            weights.add(g, w);
            touched[g] += __builtin_popcount(bits(on) & counted);
            T -= w, alive = T >= r.T_min;
        }
        if (C) add_features<C>(f4, w4, n_blended, features);
    }
    vf alpha = keep(t.inside, 1.0f - T);
    vi covered = dominant >= 0;
    vf inv = keep(covered, 1.0f / alpha), mean = z * inv;
    const vf rgb[3] = {red, green, blue}, normal[3] = {nx * inv, ny * inv, nz * inv};
    write_three(r, r.rgb, t, rgb), write_three(r, r.normal, t, normal);
    write_one(r, r.alpha, t, keep(covered, alpha)), write_one(r, r.depth, t, keep(covered, r.t[2] + mean));
    write_one(r, r.depth_var, t, zz * inv - mean * mean), write_one(r, (float*)r.dominant, t, (vf)dominant);
    for (int ch = 0; ch < C; ch++) features[ch] *= inv;
    if (C) write_features<C + !C>(r, t, features);
    return kept;
}

// Gradients dL/d(sums) at the pixels of a tile.
template <int C>
struct Seeds {
    vf fixed[6], alpha, z, zz, rem;   // fixed: rgb and normal
    vf features[C + 1];
    float rows[LANES][PADDED<C + !C>];   // the same with one row per pixel
};

// Seeds of the features, both with a vector per feature and with a row per pixel, and what they contribute to that of alpha.
template <int C>
INLINE void seed_features(const Raster& r, const Tile& t, vf inv, Seeds<C>& s) {
    float v[LANES * C + LANES], x[LANES * C + LANES], scale[LANES];
    read_features<C>(r, r.v_features, t, v), read_features<C>(r, r.features, t, x), store(scale, inv);
    vf products[LANES] = {};
    for (int first = 0; first < C; first += LANES) {
        vf group[LANES];
        vi exists = lane_index() < r.c - first;
        for (int l = 0; l < LANES; l++) {
            group[l] = keep(exists, load(v + l * r.c + first) * scale[l]);
            products[l] += keep(exists, group[l] * load(x + l * r.c + first));
            store(s.rows[l] + first, group[l]);
        }
        transpose(group);
        for (int i = 0; i < imin2(C - first, LANES); i++) s.features[first + i] = group[i];
    }
    s.alpha -= sums_of(products);
}

template <int C>
INLINE void seed(const Raster& r, const Tile& t, Seeds<C>& s) {
    vf alpha = read_one(r, r.alpha, t), x[3], v[3];
    vi covered = t.inside & (alpha > 0.0f);
    vf inv = keep(covered, 1.0f / alpha);
    read_three(r, r.rgb, t, x), read_three(r, r.v_rgb, t, s.fixed);
    s.alpha = keep(covered, read_one(r, r.v_alpha, t)), s.rem = s.alpha * alpha;
    for (int i = 0; i < 3; i++) s.rem += s.fixed[i] * x[i];
    read_three(r, r.normal, t, x), read_three(r, r.v_normal, t, v);
    for (int i = 0; i < 3; i++) s.fixed[3 + i] = v[i] * inv, s.alpha -= s.fixed[3 + i] * x[i];
    vf mean = read_one(r, r.depth, t) - r.t[2], v_var = read_one(r, r.v_depth_var, t);
    s.zz = v_var * inv;
    s.z = (read_one(r, r.v_depth, t) - 2.0f * mean * v_var) * inv;
    s.alpha -= s.z * mean + s.zz * (read_one(r, r.depth_var, t) + mean * mean);
    if (C && r.v_features) return seed_features(r, t, inv, s);
    for (int ch = 0; ch < C; ch++) s.features[ch] = vf{};
    clear(s.rows, sizeof s.rows);
}

// Prefetches what `seed` reads in a row of a tile beyond the previous tile's: a large view is not in the cache. (If this were
// not inlined, GCC would drop the call, because it thinks that it has no effect.)
INLINE void prefetch_seed(const Raster& r, const Tile& t, int row) {
    if (row >= t.rows) return;
    const struct {
        const float* image;
        int count;
    } images[] = {{r.alpha, 1}, {r.v_alpha, 1}, {r.depth, 1}, {r.v_depth, 1}, {r.depth_var, 1}, {r.v_depth_var, 1},
                  {r.rgb, 3}, {r.v_rgb, 3}, {r.normal, 3}, {r.v_normal, 3}, {r.features, r.c}, {r.v_features, r.c}};
    for (auto [image, count] : images)
        for (int i = t.columns * count - 1; i >= 0 && image; i -= 16)
            __builtin_prefetch(image + (t.pixel + (i64)row * r.width) * count + i);
}

// The Gaussians of a group in the adjoint, between two parts of the computation.
struct Visits : Responses {
    vf T[GROUP], w[GROUP], v_u[GROUP], v_v[GROUP], v_zeta[GROUP], value[GROUP];
    vf v_rho[GROUP], v_l[GROUP], v_K[GROUP], v_kappa[GROUP];   // v_kappa: -v_q K
    float corner[GROUP][4][LANES];   // weights of the corners
};

// Computes responses and weights, and moves the transmittance behind the group.
template <int C>
APART void visit(const Raster& r, const Tile& t, const int* list, int n, vf& before, Visits& s) {
    respond<C>(r, t, list, n, s);
    vf T = before;
    for (int i = 0; i < n; i++) {
        vi alive = T >= r.T_min;
        vf w = keep(alive, vmin(s.raw[i], splat(r.alpha_max)) * T);
        s.raw[i] = keep(alive, s.raw[i]), s.T[i] = T, s.w[i] = w;
        T -= w;
        if (!C) continue;
        vf u = clamped(s.u[i]), v = clamped(s.v[i]), wu = w * u, w1 = w - wu, w11 = wu * v, w01 = w1 * v;
        s.v_u[i] = keep(u == s.u[i], w), s.v_v[i] = keep(v == s.v[i], w), s.u[i] = u, s.v[i] = v;
        store(s.corner[i][0], w1 - w01), store(s.corner[i][1], wu - w11);
        store(s.corner[i][2], w01), store(s.corner[i][3], w11);
    }
    before = T;
}

// Derivatives by the corner coordinates and the sum of the features' seeds times features.
template <int C>
APART void visit_features(const Raster& r, const int* list, int n, const Seeds<C>& seeds, Visits& s) {
    for (int i = 0; i < n; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size + RECORD;
        // Two chains of sums each, because the latency of one chain would stall the processor.
        vf f0 = {}, f1 = {}, f2 = {}, f3 = {}, h0 = {}, h1 = {}, h2 = {}, h3 = {};
#pragma GCC unroll 8
        for (int ch = 0; ch < C; ch += 2) {
            vf a = seeds.features[ch], b = seeds.features[ch + 1];
            f0 += a * f[ch], f1 += a * f[C + ch], f2 += a * f[2 * C + ch], f3 += a * f[3 * C + ch];
            h0 += b * f[ch + 1], h1 += b * f[C + ch + 1], h2 += b * f[2 * C + ch + 1], h3 += b * f[3 * C + ch + 1];
        }
        f0 += h0, f1 += h1, f2 += h2, f3 += h3;
        vf by_u = f1 + s.v[i] * f3, by_v = f2 + s.u[i] * f3;
        s.value[i] = f0 + s.u[i] * by_u + s.v[i] * f2;
        s.v_u[i] *= by_u, s.v_v[i] *= by_v;
    }
}

// Adds the gradients of the features at the corners.
template <int C>
APART void visit_corners(const Raster& r, const int* list, int n, const Seeds<C>& seeds, const Visits& s, float* parts) {
    enum { WIDTH = PADDED<C + !C> };
    for (int j = 0; j < WIDTH; j += LANES) {
        vf rows[LANES];
#pragma GCC unroll 16
        for (int l = 0; l < LANES; l++) rows[l] = load(seeds.rows[l] + j);
        for (int i = 0; i < n; i++) {
            float* out = parts + (i64)list[i] * r.gradient_size + PADDED<SUMS> + j;
            vf sum[4];
            for (int k = 0; k < 4; k++) sum[k] = load(out + k * WIDTH);
#pragma GCC unroll 16
            for (int l = 0; l < LANES; l++)
#pragma GCC unroll 4
                for (int k = 0; k < 4; k++) sum[k] += s.corner[i][k][l] * rows[l];
            for (int k = 0; k < 4; k++) store(out + k * WIDTH, sum[k]);
        }
    }
}

// Derivatives by w and zeta.
template <int C>
APART void visit_values(const Raster& r, const Tile& t, const int* list, int n, const Seeds<C>& seeds, Visits& s) {
    for (int i = 0; i < n; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size;
        vf depth = f[DZ] + f[PZ] * s.zeta_1[i], bent = depth * seeds.zz, slope = seeds.z + bent;
        vf value = seeds.alpha + depth * slope, v_zeta = f[PZ] * (s.w[i] * (slope + bent));
        for (int j = 0; j < 6; j++) value += seeds.fixed[j] * f[j < 3 ? RED + j : NX + j - 3];
        if (C) {
            vf dx = t.x - f[CX], dy = t.y - f[CY];
            value += s.value[i];
            v_zeta += s.v_u[i] * (f[UX] * dx + f[UY] * dy + f[EU]) + s.v_v[i] * (f[VX] * dx + f[VY] * dy + f[EV]);
        }
        s.value[i] = value, s.v_zeta[i] = v_zeta;
    }
}

// Derivatives by l, K, kappa and rho; subtracts the group's shares from what the Gaussians behind it contribute.
APART void visit_responses(const Raster& r, const int* list, int n, vf& rem, Visits& s) {
    vf behind = rem;
    for (int i = 0; i < n; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size;
        vf raw = s.raw[i], K = s.K[i], l = s.l[i], inv_q = s.r[i], value = s.value[i], v_zeta = s.v_zeta[i];
        behind -= s.w[i] * value;
        vf v_alpha = s.T[i] * value - behind * inverse(1.0f - vmin(raw, splat(r.alpha_max)));
        vf v_rho = keep(raw <= r.alpha_max, v_alpha * (-0.5f * raw));
        vf v_r = v_rho * K + v_zeta * l, v_q = v_r * (inv_q * inv_q);   // -v_q
        s.v_rho[i] = v_rho, s.v_l[i] = v_zeta * inv_q - 2.0f * l * v_q;
        s.v_K[i] = v_rho * inv_q - f[KAPPA] * v_q, s.v_kappa[i] = v_q * K;
    }
    rem = behind;
}

// Adds the sums over the pixels.
template <int C>
APART void visit_sums(const Raster& r, const Tile& t, const int* list, int n, const Seeds<C>& seeds, const Visits& s, float* parts) {
    enum { N = C ? SUMS : S_U };
    for (int i = 0; i < n; i++) {
        const float* f = r.record + (i64)list[i] * r.record_size;
        float* out = parts + (i64)list[i] * r.gradient_size;
        vf dx = t.x - f[CX], dy = t.y - f[CY], x[PADDED<N>] = {};
        x[S_RHO] = s.v_rho[i], x[S_L] = s.v_l[i], x[S_KAPPA] = s.v_kappa[i];
        x[S_KX] = s.v_K[i] * dx, x[S_KY] = s.v_K[i] * dy;
        x[S_A] = x[S_KX] * dx, x[S_B] = x[S_KX] * dy, x[S_C] = x[S_KY] * dy;
        x[S_BX] = x[S_L] * dx, x[S_BY] = x[S_L] * dy;
        for (int j = 0; j < 6; j++) x[S_RGB + j] = s.w[i] * seeds.fixed[j];
        if (C) {
            x[S_EU] = s.v_u[i] * s.zeta_1[i], x[S_EV] = s.v_v[i] * s.zeta_1[i];
            x[S_U] = s.v_u[i] + x[S_EU], x[S_V] = s.v_v[i] + x[S_EV];
            x[S_UX] = x[S_U] * dx, x[S_UY] = x[S_U] * dy, x[S_VX] = x[S_V] * dx, x[S_VY] = x[S_V] * dy;
        }
        for (int j = 0; j < N; j += LANES) store(out + j, load(out + j) + sums_of(x + j));
    }
}

template <int C>
static void adjoint_tile(const Raster& r, const Tile& t, const Tile& next, const int* list, int count, float* parts) {
    Seeds<C> seeds;
    seed<C>(r, t, seeds);
    vf T = keep(t.inside, splat(1.0f)), rem = seeds.rem;
    Visits s;
    for (int first = 0; first < count; first += GROUP, list += GROUP) {
        int n = imin2(GROUP, count - first);
        prefetch_seed(r, next, first / GROUP);
        for (int i = 0; i < n; i++) __builtin_prefetch(parts + (i64)list[i] * r.gradient_size);
        visit<C>(r, t, list, n, T, s);
        if (C) visit_features<C>(r, list, n, seeds, s);
        visit_values<C>(r, t, list, n, seeds, s);
        visit_responses(r, list, n, rem, s);
        visit_sums<C>(r, t, list, n, seeds, s, parts);
        if (C) visit_corners<C>(r, list, n, seeds, s, parts);
    }
}

// The adjoint for the features at the corners only, if no gradient of the geometry is needed.
template <int C>
static void corner_adjoint_tile(const Raster& r, const Tile& t, const int* list, int count, float* parts) {
    Seeds<C> seeds;
    seed<C>(r, t, seeds);
    vf T = keep(t.inside, splat(1.0f));
    Visits s;
    for (int first = 0; first < count; first += GROUP, list += GROUP) {
        int n = imin2(GROUP, count - first);
        visit<C>(r, t, list, n, T, s);
        visit_corners<C>(r, list, n, seeds, s, parts);
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
            adjoint_tile<C>(r, tile_at(r, tile), tile_at(r, tile + 1), list, r.counts[tile], parts);
        else
            corner_adjoint_tile<C>(r, tile_at(r, tile), list, r.counts[tile], parts);
    }
}
