// Monte Carlo shading of surface points (`RelightKernel`), one point after the other and a batch of samples at a time:
// directions from LANES samples at once, of which those above the horizon are kept; their weights; a ray for each.
#pragma once
#include "bvh.h"
#include "lookup.h"
#include "parallel.h"

struct Relight {
    const Bvh* bvh;
    const float *origins, *normals, *views, *albedo, *roughness, *shift, *lattice;   // lattice: three padded rows
    const float *light, *density;
    const double *cumulative, *cosines;     // cosines: of the polar angles between rows
    const int *row_guide, *column_guide;
    const float *R, *radiance, *gaussian_normals, *gaussian_roughness, *stack, *table;   // from radiance on may be null
    int n_points, n_brdf, n_samples, stride, threads;   // stride: of the lattice
    int height, width, rows, columns, row_buckets, column_buckets;
    int levels, stack_height, stack_width, table_size;
    float f0, roughness_min;
    float* out;
};

enum { SAMPLES_AT_ONCE = 256 };

// Samples of a point that are above the horizon, in three rows.
struct Samples {
    float w[3][SAMPLES_AT_ONCE + LANES], weight[3][SAMPLES_AT_ONCE + LANES], value[3][SAMPLES_AT_ONCE + LANES];   // value: weight times light
    int count;
};
// Rays of a batch that hit Gaussians.
struct Occluded {
    float w[3][SAMPLES_AT_ONCE + LANES], normal[3][SAMPLES_AT_ONCE + LANES], roughness[SAMPLES_AT_ONCE + LANES], weight[3][SAMPLES_AT_ONCE + LANES];
    int count;
};
// Quantities of a point that do not depend on the direction. The columns of the tangent frame are x, y, n.
struct Relit {
    float n[3], v[3], x[3], y[3], shift[3], albedo[3], aa, n_v, smith_v;
};

INLINE float smith(float cosine, float aa) {
    float x = fmax2(cosine, 0);
    return x + vsqrt(splat(aa + (1 - aa) * x * x))[0];
}
INLINE Relit relit_at(const Relight& s, i64 p) {
    Relit o;
    float r = fmax2(s.roughness[p], s.roughness_min);
    for (int i = 0; i < 3; i++) {
        o.n[i] = s.normals[3 * p + i], o.v[i] = s.views[3 * p + i];
        o.shift[i] = s.shift[3 * p + i], o.albedo[i] = s.albedo[3 * p + i] * 0.318309886f;
    }
    o.aa = r * r * r * r, o.n_v = o.n[0] * o.v[0] + o.n[1] * o.v[1] + o.n[2] * o.v[2];
    o.smith_v = smith(o.n_v, o.aa);
    // tumble.maths.local_frame (Duff et al. 2017).
    float sign = o.n[2] < 0 ? -1.0f : 1.0f, a = -1 / (sign + o.n[2]), b = o.n[0] * o.n[1] * a;
    o.x[0] = 1 + sign * o.n[0] * o.n[0] * a, o.x[1] = sign * b, o.x[2] = -sign * o.n[0];
    o.y[0] = b, o.y[1] = sign + o.n[1] * o.n[1] * a, o.y[2] = -o.n[1];
    return o;
}

INLINE vf dot3(const float* a, const vf* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE vf dot3(const vf* a, const vf* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE void rotated(const float* R, const vf* d, vf* out) {
    for (int i = 0; i < 3; i++) out[i] = dot3(R + 3 * i, d);
}

// The uniform numbers of LANES samples along one axis.
INLINE vf uniform_at(const Relight& s, const Relit& o, int axis, int j) {
    vf x = load(s.lattice + axis * s.stride + j) + o.shift[axis];
    return x - keep(x >= 1.0f, splat(1.0f));
}

// `brdf.sample`: a cosine-distributed direction, or the view mirrored at a half vector.
INLINE void scattered(const Relight& s, const Relit& o, int j, vf* w) {
    vf lobe = uniform_at(s, o, 0, j), height = uniform_at(s, o, 1, j), sine, cosine;
    vsincos(uniform_at(s, o, 2, j), sine, cosine);
    vi diffuse = lobe < 0.5f;
    vf sine2 = pick(diffuse, height, o.aa * height / (1.0f + (o.aa - 1) * height));
    vf across = vsqrt(sine2), along = vsqrt(1.0f - sine2), x = across * cosine, y = across * sine;
    for (int i = 0; i < 3; i++) w[i] = o.x[i] * x + o.y[i] * y + o.n[i] * along;
    vf twice = 2.0f * dot3(o.v, w);
    for (int i = 0; i < 3; i++) w[i] = pick(diffuse, w[i], twice * w[i] - o.v[i]);
}

// Index of the first of the ascending numbers x[low .. high - 1] above a value, else high; without branches to predict.
INLINE int first_above(const double* x, double value, int low, int high) {
    for (int count = high - low; count > 0;) {
        int half = (count + 1) / 2;
        low += x[low + half - 1] > value ? 0 : half;
        count -= half;
    }
    return low;
}

// `LightSampler.sample` in the object frame. A guide holds the first bin above each of evenly spaced numbers.
INLINE void towards_light(const Relight& s, const Relit& o, int j, vf* w) {
    float row_at[LANES], column_at[LANES], height[LANES], sine2[LANES], turns[LANES];
    double value[LANES], down[LANES];
    int row[LANES];
    const int* guide[LANES];
    store(row_at, uniform_at(s, o, 1, j)), store(column_at, uniform_at(s, o, 2, j));
    // The numbers that the cells are searched in are far apart in memory, and are therefore requested beforehand.
    for (int l = 0; l < LANES; l++) {
        double u = row_at[l];
        int bucket = (int)(u * s.row_buckets), r = s.row_guide[bucket], last = s.row_guide[bucket + 1];
        while (r < last && s.cumulative[(i64)(r + 1) * s.columns - 1] <= u) r++;
        row[l] = r = imin2(r, s.rows - 1);
        double start = r ? s.cumulative[(i64)r * s.columns - 1] : 0;
        double width = s.cumulative[(i64)(r + 1) * s.columns - 1] - start;
        down[l] = width > 0 ? (u - start) / width : 0, value[l] = start + column_at[l] * width;
        guide[l] = s.column_guide + r * (s.column_buckets + 1) + (int)(column_at[l] * s.column_buckets);
        __builtin_prefetch(guide[l]);
    }
    for (int l = 0; l < LANES; l++)
        __builtin_prefetch(s.cumulative + guide[l][0]), __builtin_prefetch(s.cumulative + guide[l][1]);
    for (int l = 0; l < LANES; l++) {
        int r = row[l], cell = first_above(s.cumulative, value[l], guide[l][0], guide[l][1]);
        cell = imin2(cell, s.rows * s.columns - 1);
        double start = cell ? s.cumulative[cell - 1] : 0, width = s.cumulative[cell] - start;
        double along = width > 0 ? (value[l] - start) / width : 0;
        along = along < 0 ? 0 : along > 1 ? 1 : along, down[l] = down[l] > 1 ? 1 : down[l];
        // Rounding may give a cell of another row.
        int column = imax2(0, imin2(cell - r * s.columns, s.columns - 1));
        double cosine = s.cosines[r] + (s.cosines[r + 1] - s.cosines[r]) * down[l];
        height[l] = cosine, sine2[l] = 1 - cosine * cosine, turns[l] = (column + along) / s.columns - 0.5;
    }
    vf sine, cosine, radius = vsqrt(vmax(load(sine2), vf{})), d[3];
    vsincos(load(turns), sine, cosine);
    d[0] = radius * sine, d[1] = load(height), d[2] = -radius * cosine;
    for (int i = 0; i < 3; i++) w[i] = s.R[i] * d[0] + s.R[3 + i] * d[1] + s.R[6 + i] * d[2];
}

// Keeps the directions above the horizon among samples `first` to `last`, which are of one kind.
template <class F>
INLINE void keep_above(const Relit& o, int first, int last, Samples& batch, F sample) {
    for (int j = first; j < last; j += LANES) {
        vf w[3];
        sample(j, w);
        float lanes[3][LANES];
        for (int i = 0; i < 3; i++) store(lanes[i], w[i]);
        for (u32 b = bits((dot3(o.n, w) > 0.0f) & (lane_index() < last - j)); b; b &= b - 1, batch.count++)
            for (int i = 0; i < 3; i++) batch.w[i][batch.count] = lanes[i][__builtin_ctz(b)];
    }
}

// BRDF times cosine, divided by the density of both kinds of samples, and that times the light.
INLINE void weigh(const Relight& s, const Relit& o, int j, Samples& batch) {
    vf w[3], h[3], env[3], half_way[3];
    for (int i = 0; i < 3; i++) w[i] = load(batch.w[i] + j), h[i] = w[i] + o.v[i];
    vf length = 1.0f / vmax(vsqrt(dot3(h, h)), splat(1e-12f));
    length = pick(dot3(o.n, h) < 0.0f, -length, length);
    for (int i = 0; i < 3; i++) h[i] *= length, half_way[i] = h[i] - o.n[i];
    vf n_l = dot3(o.n, w), n_h = dot3(o.n, h), v_h = dot3(o.v, h), low = 0.5f * dot3(half_way, half_way);
    vf t = o.aa * (1.0f - low) * (1.0f - low) + low * (2.0f - low);
    vf D = o.aa / (3.141592654f * t * t), facing = vmax(n_l, vf{});
    vf by_brdf = 0.5f * (facing * 0.318309886f + D * n_h / (4.0f * vmax(vmax(v_h, -v_h), splat(1e-7f))));
    rotated(s.R, w, env);
    OnMap at = on_map(env);
    vi row = __builtin_convertvector(at.v * (float)s.rows, vi), column = __builtin_convertvector(at.u * (float)s.columns, vi);
    row = row < s.rows ? row : s.rows - 1, column = column < s.columns ? column : s.columns - 1;
    row = row < 0 ? 0 : row, column = column < 0 ? 0 : column;
    vf density = (float)s.n_brdf * by_brdf;
    density += (float)(s.n_samples - s.n_brdf) * gathered(s.density, row * s.columns + column);
    vf m = vmin(vmax(1.0f - v_h, vf{}), splat(1.0f)), mm = m * m;
    vf F = 1.0f + 24.0f * m * mm * (0.9878f + m * (-3.8886f + m * (9.1922f + m * (-9.6217f + m * 4.3303f))));
    vf specular = D * s.f0 * F / ((facing + vsqrt(o.aa + (1 - o.aa) * facing * facing)) * o.smith_v);
    specular = keep(splat(o.n_v) > 0.0f, specular);
    vf scale = keep(density > 0.0f, n_l / density);
    Square q = square_at(at, s.height, s.width);
    for (int i = 0; i < 4; i++) q.at[i] *= 3;
    for (int ch = 0; ch < 3; ch++) {
        vf weight = scale * (o.albedo[ch] + specular), x[4];
        for (int i = 0; i < 4; i++) x[i] = gathered(s.light + ch, q.at[i]);
        store(batch.weight[ch] + j, weight);
        store(batch.value[ch] + j, weight * blend(blend(x[0], x[1], q.fx), blend(x[2], x[3], q.fx), q.fy));
    }
}

// Traces the rays of a batch; adds their light, and lists those that hit Gaussians.
static void trace_batch(const Relight& s, const Near* near, const float* origin, const Samples& batch, Occluded& occluded, float* sum) {
    occluded.count = 0;
    auto ray_of = [&](int i) {
        float d[3] = {batch.w[0][i], batch.w[1][i], batch.w[2][i]};
        return ray_at(origin, d);
    };
    trace_rays(*s.bvh, near, s.radiance, batch.count, ray_of, [&](int i, const Traced& ray) {
        for (int ch = 0; ch < 3; ch++) sum[ch] += ray.T * batch.value[ch][i] + batch.weight[ch][i] * ray.sum[ch];
        if (ray.dominant < 0 || !s.stack) return;
        int to = occluded.count++;
        occluded.roughness[to] = s.gaussian_roughness[ray.dominant];
        for (int a = 0; a < 3; a++) {
            occluded.w[a][to] = ray.ray.d[a];
            occluded.normal[a][to] = s.gaussian_normals[3 * (i64)ray.dominant + a];
            occluded.weight[a][to] = (1 - ray.T) * batch.weight[a][i];
        }
    });
}

// Adds the specular lobes of the Gaussians that were hit, by the split sum (`shading.specular`).
INLINE void add_specular(const Relight& s, const Occluded& o, int j, vf* sum) {
    vf w[3], n[3], mirrored[3], env[3];
    for (int i = 0; i < 3; i++) w[i] = load(o.w[i] + j), n[i] = load(o.normal[i] + j);
    vi on = lane_index() < o.count - j;
    vf n_v = -dot3(n, w), roughness = pick(on, load(o.roughness + j), splat(1.0f));
    for (int i = 0; i < 3; i++) mirrored[i] = pick(on, 2.0f * n_v * n[i] + w[i], splat((float)(i == 1)));
    rotated(s.R, mirrored, env);
    Lookup lookup = {s.stack, nullptr, nullptr, 0, s.levels, s.stack_height, s.stack_width};
    Texels t;
    texels_around(lookup, env, roughness, t);
    // The finer map replaces the stack's first level.
    vf fine = vmax(1.0f - vmin(vmax(roughness, vf{}), splat(1.0f)) * (float)(s.levels - 1), vf{});
    bool finer = (s.stack_height != s.height || s.stack_width != s.width) && any(on & (fine > 0.0f));
    Square q = square_at(on_map(env), s.height, s.width);
    for (int i = 0; i < 4; i++) q.at[i] *= 3;
    // Bilinear in the split-sum table: rows nov, columns roughness.
    float last = s.table_size - 1;
    vf y = vmin(vmax(n_v, vf{}), splat(1.0f)) * last;
    vf x = vmin(vmax((roughness - s.roughness_min) * (last / (1 - s.roughness_min)), vf{}), splat(last));
    vi row = __builtin_convertvector(vmin(y, splat(last - 1)), vi), column = __builtin_convertvector(vmin(x, splat(last - 1)), vi);
    vf fy = y - __builtin_convertvector(row, vf), fx = x - __builtin_convertvector(column, vf);
    vi at = row * s.table_size + column;
    vf upper = blend(gathered(s.table, at), gathered(s.table, at + 1), fx);
    at += s.table_size;
    vf reflectance = s.f0 * blend(upper, blend(gathered(s.table, at), gathered(s.table, at + 1), fx), fy);
    for (int ch = 0; ch < 3; ch++) {
        vf value = value_at(lookup, t, ch), c[4], f[4];
        for (int i = 0; i < 4 && finer; i++) c[i] = gathered(s.stack + ch, t.at[i] % (3 * s.stack_height * s.stack_width));
        for (int i = 0; i < 4 && finer; i++) f[i] = gathered(s.light + ch, q.at[i]);
        if (finer)
            value += fine * (blend(blend(f[0], f[1], q.fx), blend(f[2], f[3], q.fx), q.fy) -
                             blend(blend(c[0], c[1], t.fx), blend(c[2], c[3], t.fx), t.fy));
        sum[ch] += keep(on, load(o.weight[ch] + j) * value * reflectance);
    }
}

static void relight_share(const Relight& s, int share) {
    Samples batch;
    Occluded occluded;
    Near buffer;
    clear(&batch, sizeof batch), clear(&occluded, sizeof occluded);
    for (i64 p = share; p < s.n_points; p += s.threads) {
        Relit o = relit_at(s, p);
        const Near* near = collect_near(*s.bvh, s.origins + 3 * p, o.n, buffer) ? &buffer : nullptr;
        float sum[3] = {};
        vf specular[3] = {};
        for (int first = 0; first < s.n_samples; first += SAMPLES_AT_ONCE) {
            int last = imin2(first + SAMPLES_AT_ONCE, s.n_samples), middle = imax2(first, imin2(s.n_brdf, last));
            batch.count = 0;
            keep_above(o, first, middle, batch, [&](int j, vf* w) { scattered(s, o, j, w); });
            keep_above(o, middle, last, batch, [&](int j, vf* w) { towards_light(s, o, j, w); });
            for (int j = 0; j < batch.count; j += LANES) weigh(s, o, j, batch);
            trace_batch(s, near, s.origins + 3 * p, batch, occluded, sum);
            for (int j = 0; j < occluded.count; j += LANES) add_specular(s, occluded, j, specular);
        }
        for (int ch = 0; ch < 3; ch++) s.out[3 * p + ch] = sum[ch] + sum_of(specular[ch]);
    }
}
