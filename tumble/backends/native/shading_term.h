// The photometric term of shaded pixels and its gradients (`Backend.shading_term`). The lobes, the lookups and the
// indirect light are those of the kernels of their own; here is what lies between them. `v_x` is the gradient of x.
#pragma once
#include "lookup.h"
#include "material.h"
#include "shade.h"

enum { POINT_SUMS = 9 + 9 + 3 + 1 };   // of a share: gradients of R_cam_obj, R_env_obj and f0, and the term

struct ShadingTerm {
    const float *features, *alpha, *normal;
    const u8* photo;
    const i64* pixels;
    const int* dominant;
    const float *R_cam_obj, *R_env_obj, *focal, *stack, *f0, *albedo, *transfer, *directions, *direction_rows;
    const int *visibility, *blocker;
    const float* table;
    int n_points, n_features, width, n_pixels, n_directions, stride, words, n_gaussians;
    int blocker_point_stride, blocker_direction_stride, levels, map_height, map_width, table_size, threads;
    float cell, roughness_min, narrow_from, narrow_to, saturated, knee;
    i64* rows;        // one per point
    float* scratch;   // for `shading_arrays`
    float *term, *g_features, *g_alpha, *g_normal, *g_R_cam_obj, *g_R_env_obj, *g_stack, *g_f0, *g_albedo;
};

// Arrays of all points, and of all directions followed by the mirrored view directions of all points.
struct ShadingArrays {
    float *normal, *view, *roughness, *diffuse, *specular, *visible, *shaded, *codes;
    float *v_diffuse, *v_specular, *v_normal, *v_view, *v_roughness, *v_own;   // v_own: of n.v and of the roughness
    float *v_material, *v_image_normal, *v_alpha;
    float *looked, *levels, *light, *v_light, *v_looked, *v_levels;
    float *rows, *v_rows, *row_parts, *bounced, *v_bounced, *bounced_parts, *v_sky, *sums;
};

static ShadingArrays shading_arrays(const ShadingTerm& s) {
    ShadingArrays a;
    float* free = s.scratch;
    auto take = [&](i64 n) {
        float* at = free;
        free += n;
        return at;
    };
    i64 p = s.n_points, all = p + s.n_directions;
    float** const of_points[] = {&a.normal, &a.view, &a.diffuse, &a.specular, &a.shaded, &a.codes, &a.v_diffuse, &a.v_specular,
                                 &a.v_normal, &a.v_view, &a.v_image_normal};
    for (float** x : of_points) *x = take(3 * p);
    a.roughness = take(p), a.visible = take(p), a.v_roughness = take(p), a.v_alpha = take(p);
    a.v_own = take(2 * p), a.v_material = take(4 * p);
    a.looked = take(3 * all), a.light = take(3 * all), a.v_light = take(3 * all), a.v_looked = take(3 * all);
    a.levels = take(all), a.v_levels = take(all);
    a.rows = take(3 * (i64)s.stride), a.v_rows = take(3 * (i64)s.stride), a.row_parts = take(3 * (i64)s.stride * s.threads);
    a.bounced = take(3 * (i64)s.n_gaussians), a.v_bounced = take(3 * (i64)s.n_gaussians);
    a.bounced_parts = take(3 * (i64)s.n_gaussians * s.threads);
    a.v_sky = take(3 * (i64)s.n_directions), a.sums = take((i64)POINT_SUMS * s.threads);
    return a;
}

INLINE float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE void turn(const float* R, const float* x, float* y) {
    for (int i = 0; i < 3; i++) y[i] = dot3(R + 3 * i, x);
}
INLINE void turn_back(const float* R, const float* x, float* y) {
    for (int i = 0; i < 3; i++) y[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}
INLINE float ray_of(const ShadingTerm& s, i64 pixel, float* ray) {
    ray[0] = (pixel % s.width + 0.5f - s.focal[2]) / s.focal[0], ray[1] = (pixel / s.width + 0.5f - s.focal[3]) / s.focal[1];
    ray[2] = 1;
    return __builtin_sqrtf(dot3(ray, ray));
}
INLINE i64 pixel_of(const ShadingTerm& s, i64 i) { return s.pixels[i] < 0 ? 0 : s.pixels[i]; }
INLINE float summed_normal(const ShadingTerm& s, i64 pixel, float* n) {
    for (int j = 0; j < 3; j++) n[j] = s.normal[3 * pixel + j] + s.features[s.n_features * pixel + 4 + j];
    return fmax2(__builtin_sqrtf(dot3(n, n)), 1e-12f);
}

static void points_share(const ShadingTerm& s, const ShadingArrays& a, int share) {
    int end = share_start(s.n_points, share + 1, s.threads);
    for (i64 i = share_start(s.n_points, share, s.threads); i < end; i++) {
        i64 pixel = pixel_of(s, i), at = s.n_directions + i;
        float *n = a.normal + 3 * i, *v = a.view + 3 * i, ray[3], mirrored[3];
        float length = summed_normal(s, pixel, n), distance = ray_of(s, pixel, ray);
        turn_back(s.R_cam_obj, ray, v);
        for (int j = 0; j < 3; j++) n[j] /= length, v[j] /= -distance;
        float n_v = dot3(n, v);
        for (int j = 0; j < 3; j++) mirrored[j] = 2 * n_v * n[j] - v[j];
        turn(s.R_env_obj, mirrored, a.looked + 3 * at);
        a.roughness[i] = a.levels[at] = s.features[s.n_features * pixel + 3];
        s.rows[i] = imax2(0, s.dominant[pixel]);
    }
    int last = share_start(s.n_directions, share + 1, s.threads);
    for (i64 j = share_start(s.n_directions, share, s.threads); j < last; j++) {
        turn(s.R_env_obj, s.directions + 3 * j, a.looked + 3 * j);
        a.levels[j] = s.cell;
    }
}

// The directional albedo of the specular lobe (`brdf.split_sum`) and its slopes in n.v and roughness.
INLINE float table_at(const ShadingTerm& s, float n_v, float roughness, float* slopes) {
    float top = (float)(s.table_size - 1), range = top / (1 - s.roughness_min);
    float x = fmin2(fmax2(n_v, 0), 1) * top, y = fmin2((fmax2(roughness, s.roughness_min) - s.roughness_min) * range, top);
    int i = imin2((int)x, s.table_size - 2), j = imin2((int)y, s.table_size - 2);
    const float *low = s.table + i * s.table_size + j, *high = low + s.table_size;
    float fx = x - i, fy = y - j, below = low[0] + fx * (high[0] - low[0]), above = low[1] + fx * (high[1] - low[1]);
    slopes[0] = n_v >= 0 && n_v <= 1 ? top * (high[0] - low[0] + fy * (high[1] - low[1] - high[0] + low[0])) : 0;
    slopes[1] = roughness >= s.roughness_min && roughness <= 1 ? range * (above - below) : 0;
    return below + fy * (above - below);
}

// Reflected radiance of a share of the points; with `sums` also the gradients of the lobes from those of the radiance.
static void reflect_share(const ShadingTerm& s, const ShadingArrays& a, int share, float* sums) {
    float range = s.narrow_to - s.narrow_from;
    int end = share_start(s.n_points, share + 1, s.threads);
    for (i64 i = share_start(s.n_points, share, s.threads); i < end; i++) {
        i64 pixel = pixel_of(s, i);
        const float *albedo = s.features + s.n_features * pixel, *mirrored = a.light + 3 * (s.n_directions + i);
        float slopes[2], n_v = dot3(a.normal + 3 * i, a.view + 3 * i), reflectance = table_at(s, n_v, a.roughness[i], slopes);
        float seen = a.visible[i], wide = (a.roughness[i] - s.narrow_from) / range, v_wide = 0, v_reflectance = 0, v_alpha = 0;
        bool moves = wide >= 0 && wide <= 1;
        wide = fmin2(fmax2(wide, 0), 1);
        for (int ch = 0; ch < 3; ch++) {
            float diffuse = a.diffuse[3 * i + ch], summed = a.specular[3 * i + ch];
            float narrow = mirrored[ch] * seen * reflectance, specular = narrow + wide * (summed - narrow);
            float out = albedo[ch] * diffuse + s.f0[ch] * specular, v = a.shaded[3 * i + ch];
            if (!sums) {
                a.shaded[3 * i + ch] = s.alpha[pixel] * out, a.codes[3 * i + ch] = s.photo[3 * pixel + ch];
                continue;
            }
            v_alpha += v * out, v *= s.alpha[pixel];
            a.v_material[4 * i + ch] = v * diffuse, a.v_diffuse[3 * i + ch] = v * albedo[ch];
            sums[18 + ch] += v * specular;
            float v_specular = v * s.f0[ch], v_narrow = v_specular * (1 - wide);
            a.v_specular[3 * i + ch] = v_specular * wide, v_wide += v_specular * (summed - narrow);
            a.v_light[3 * (s.n_directions + i) + ch] = v_narrow * seen * reflectance;
            v_reflectance += v_narrow * mirrored[ch] * seen;
        }
        a.v_alpha[i] = v_alpha, a.v_own[2 * i] = v_reflectance * slopes[0];
        a.v_own[2 * i + 1] = v_reflectance * slopes[1] + (moves ? v_wide / range : 0);
    }
}

// sRGB of the share's radiance against the photo: the term, and its gradient in the place of the radiance.
static float error_share(const ShadingTerm& s, const ShadingArrays& a, int share) {
    i64 end = 3 * (i64)share_start(s.n_points, share + 1, s.threads);
    float weight = 1 / (3.0f * s.n_points);
    vf total = {};
    for (i64 i = 3 * (i64)share_start(s.n_points, share, s.threads); i < end; i += LANES) {
        int count = imin2(LANES, (int)(end - i));
        vi inside = {};
        for (int l = 0; l < count; l++) inside[l] = s.pixels[(i + l) / 3] < 0 ? 0 : -1;
        vf linear = load_some(a.shaded + i, count), code = load_some(a.codes + i, count), photo = code / 255.0f;
        vf above = vmax(linear, splat(s.knee)), power = 1.055f * vexp(vlog(above) * (1 / 2.4f)) - 0.055f;
        vi line = linear <= s.knee;
        vf srgb = pick(line, 12.92f * vmax(linear, vf{}), power);
        vf slope = pick(line, keep(linear >= 0.0f, splat(12.92f)), (power + 0.055f) / (2.4f * above));
        vf error = keep(inside & ~((code >= s.saturated) & (srgb > photo)), srgb - photo);
        total += vabs(error);
        vf sign = keep(error > 0.0f, splat(weight)) - keep(error < 0.0f, splat(weight));
        store_some(a.shaded + i, sign * slope, count);
    }
    return weight * sum_of(total);
}

// Gradients of the images at a share of the points, from those of normals, views, lookups and roughness.
static void points_adjoint_share(const ShadingTerm& s, const ShadingArrays& a, int share, float* sums) {
    int end = share_start(s.n_points, share + 1, s.threads);
    for (i64 i = share_start(s.n_points, share, s.threads); i < end; i++) {
        i64 pixel = pixel_of(s, i), at = s.n_directions + i;
        const float *n = a.normal + 3 * i, *v = a.view + 3 * i, *v_looked = a.v_looked + 3 * at;
        float n_v = dot3(n, v), v_m[3], v_n[3], v_v[3], ray[3], unused[3], distance = ray_of(s, pixel, ray);
        turn_back(s.R_env_obj, v_looked, v_m);
        float m_n = dot3(v_m, n), of_cosine = a.v_own[2 * i];
        for (int j = 0; j < 3; j++) {
            v_n[j] = a.v_normal[3 * i + j] + 2 * (n_v * v_m[j] + m_n * v[j]) + of_cosine * v[j];
            v_v[j] = a.v_view[3 * i + j] + 2 * m_n * n[j] - v_m[j] + of_cosine * n[j];
        }
        float length = summed_normal(s, pixel, unused), n_along = dot3(v_n, n), v_along = dot3(v_v, v);
        for (int j = 0; j < 3; j++) {
            a.v_image_normal[3 * i + j] = (v_n[j] - n_along * n[j]) / length;
            float v_u = (v_v[j] - v_along * v[j]) / distance;
            for (int k = 0; k < 3; k++) {
                sums[3 * k + j] -= ray[k] * v_u;
                sums[9 + 3 * k + j] += v_looked[k] * (2 * n_v * n[j] - v[j]);
            }
        }
        a.v_material[4 * i + 3] = a.v_roughness[i] + a.v_levels[at] + a.v_own[2 * i + 1];
    }
    int last = share_start(s.n_directions, share + 1, s.threads);
    for (i64 d = share_start(s.n_directions, share, s.threads); d < last; d++)
        for (int k = 0; k < 3; k++)
            for (int j = 0; j < 3; j++) sums[9 + 3 * k + j] += a.v_looked[3 * d + k] * s.directions[3 * d + j];
}

static void scatter_gradients(const ShadingTerm& s, const ShadingArrays& a) {
    clear(s.g_features, 4 * (i64)s.n_pixels * s.n_features);
    clear(s.g_alpha, 4 * (i64)s.n_pixels), clear(s.g_normal, 12 * (i64)s.n_pixels);
    for (i64 i = 0; i < s.n_points; i++) {
        if (s.pixels[i] < 0) continue;
        float *to = s.g_features + s.n_features * s.pixels[i], *normal = s.g_normal + 3 * s.pixels[i];
        for (int j = 0; j < 4; j++) to[j] += a.v_material[4 * i + j];
        for (int j = 0; j < 3; j++) to[4 + j] += a.v_image_normal[3 * i + j], normal[j] += a.v_image_normal[3 * i + j];
        s.g_alpha[s.pixels[i]] += a.v_alpha[i];
    }
    float* const sums[] = {s.g_R_cam_obj, s.g_R_env_obj, s.g_f0, s.term};
    const int starts[] = {0, 9, 18, 21, POINT_SUMS};
    for (int k = 0; k < 4; k++)
        for (int j = starts[k]; j < starts[k + 1]; j++) {
            float sum = 0;
            for (int share = 0; share < s.threads; share++) sum += a.sums[share * POINT_SUMS + j];
            sums[k][j - starts[k]] = sum;
        }
}

static void shading_term(const ShadingTerm& s) {
    ShadingArrays a = shading_arrays(s);
    int d = s.n_directions, p = s.n_points;
    Shade lobes = {a.normal, a.roughness, a.view, s.direction_rows, a.rows, s.visibility, s.blocker, s.rows, a.bounced, p, d,
                   s.stride, s.words, s.n_gaussians, s.threads, s.blocker_point_stride, s.blocker_direction_stride,
                   s.roughness_min, a.diffuse, a.specular, a.visible, a.v_diffuse, a.v_specular, a.row_parts,
                   a.bounced_parts, a.v_normal, a.v_roughness, a.v_view, a.v_rows, a.v_bounced};
    Lookup looked = {s.stack, a.looked, a.levels, d + p, s.levels, s.map_height, s.map_width, a.light, a.v_light, s.g_stack,
                     a.v_looked, a.v_levels};
    Indirect indirect = {s.albedo, s.transfer, s.directions, a.light, s.n_gaussians, d, s.threads, a.bounced, a.v_bounced,
                         s.g_albedo, a.v_sky};
    parallel(s.threads, [&](int share) { points_share(s, a, share); });
    parallel(s.threads, [&](int share) { lookup_values(looked, share, s.threads); });
    clear(a.rows, (i64)12 * s.stride), clear(a.sums, (i64)4 * POINT_SUMS * s.threads), clear(a.v_sky, (i64)12 * d);
    for (int j = 0; j < d; j++)
        for (int ch = 0; ch < 3; ch++) a.rows[ch * s.stride + j] = a.light[3 * j + ch];
    if (s.n_gaussians) bounce_values(indirect, false);
    parallel(s.threads, [&](int share) {
        shade_share(lobes, share);
    });
    parallel(s.threads, [&](int share) {
        float* sums = a.sums + share * POINT_SUMS;
        reflect_share(s, a, share, nullptr);
        sums[21] = error_share(s, a, share);
        reflect_share(s, a, share, sums);
    });
    parallel(s.threads, [&](int share) { shade_adjoint_share(lobes, share); });
    add_parts(a.v_rows, a.row_parts, (i64)3 * s.stride, s.threads);
    if (s.n_gaussians) {
        add_parts(a.v_bounced, a.bounced_parts, (i64)3 * s.n_gaussians, s.threads);
        bounce_values(indirect, true);
    }
    for (int j = 0; j < d; j++)
        for (int ch = 0; ch < 3; ch++) a.v_light[3 * j + ch] = a.v_rows[ch * s.stride + j] + a.v_sky[3 * j + ch];
    lookup_adjoint(looked);
    parallel(s.threads, [&](int share) { points_adjoint_share(s, a, share, a.sums + share * POINT_SUMS); });
    scatter_gradients(s, a);
}
