// Loss terms of a rendered view against a photo, and their gradients (`Backend.image_terms`).
//
// A *window* is the smallest part of the image outside of which rendering, photo and mask are all black, widened by the
// margin of SSIM; outside of it all terms and gradients are 0. A *plane* is one channel of the window, followed by
// padding. Every term is differentiated at once: each input belongs to one term only, so that the gradients for other
// seeds are multiples.
#pragma once
#include "parallel.h"
#include "simd.h"

enum { TAPS = 11, MARGIN = TAPS - 1, PLANES = 11 };

struct Image {
    const float *rgb, *alpha, *depth, *depth_var, *normal;
    const u8 *photo, *mask;
    const float *R, *focal, *taps;   // taps: the weights of SSIM's window along one axis
    int height, width, plane_size, threads;   // plane_size: floats of a plane of the whole image
    float ssim_weight, crease, saturated, knee, c1, c2, weights[4];   // weights: of the terms
    float* scratch;                  // PLANES planes per channel
    float *terms, *g_rgb, *g_alpha, *g_depth, *g_depth_var, *g_normal, *g_R;
};

struct Window {
    int top, left, height, width, stride;
};

INLINE vf load_some(const float* p, int n) {
    if (n >= LANES) return load(p);
    vf x = {};
    for (int l = 0; l < n; l++) x[l] = p[l];
    return x;
}
INLINE void store_some(float* p, vf x, int n) {
    if (n >= LANES) return store(p, x);
    for (int l = 0; l < n; l++) p[l] = x[l];
}
INLINE void add_some(float* p, vf x, int n) { store_some(p, load_some(p, n) + x, n); }
// Every third number from p on.
INLINE vf load_third(const float* p, int n) {
    vf x = {};
    for (int l = 0; l < imin2(n, LANES); l++) x[l] = p[3 * l];
    return x;
}
INLINE vf load_bytes(const u8* p, int step, int n) {
    vi x = {};
    for (int l = 0; l < imin2(n, LANES); l++) x[l] = p[step * l];
    return __builtin_convertvector(x, vf);
}
INLINE vf vabs(vf x) { return vmax(x, -x); }

static Window window_of(const Image& m) {
    int top = m.height, bottom = -1, left = m.width, right = -1;
    for (int y = 0; y < m.height; y++)
        for (int x = 0; x < m.width; x += LANES) {
            i64 at = (i64)y * m.width + x;
            int n = imin2(LANES, m.width - x);
            vi content = (load_some(m.alpha + at, n) > 0.0f) | (load_bytes(m.mask + at, 1, n) == 255.0f);
            for (int ch = 0; ch < 3; ch++) content |= load_bytes(m.photo + 3 * at + ch, 3, n) > 0.0f;
            u32 found = bits(content);
            if (!found) continue;
            top = imin2(top, y), bottom = y;
            left = imin2(left, x + __builtin_ctz(found)), right = imax2(right, x + 31 - __builtin_clz(found));
        }
    if (bottom < 0) return {0, 0, 0, 0, 0};
    top = imax2(0, top - MARGIN), left = imax2(0, left - MARGIN);
    bottom = imin2(m.height, bottom + 1 + MARGIN), right = imin2(m.width, right + 1 + MARGIN);
    // A window at the border of the image may be narrower than that of SSIM.
    top = imax2(0, imin2(top, bottom - TAPS)), left = imax2(0, imin2(left, right - TAPS));
    bottom = imax2(bottom, top + TAPS), right = imax2(right, left + TAPS);
    // Vectors of a row may read and write beyond it, and adjoint sums begin MARGIN columns before it.
    return {top, left, bottom - top, right - left, (right - left + MARGIN + 2 * LANES - 1) / LANES * LANES};
}

// sRGB of one channel of the rendering, 0 where the mask is unknown, and its derivative; photo likewise.
static float srgb_planes(const Image& m, const Window& w, int ch, float* x, float* y, float* slope) {
    vf sum = {};
    for (int r = 0; r < w.height; r++)
        for (int c = 0; c < w.stride; c += LANES) {
            i64 at = (i64)(w.top + r) * m.width + w.left + c, to = (i64)r * w.stride + c;
            int n = imax2(0, imin2(LANES, w.width - c));
            vf linear = load_third(m.rgb + 3 * at + ch, n), code = load_bytes(m.photo + 3 * at + ch, 3, n);
            vf photo = code / 255.0f, above = vmax(linear, splat(m.knee));
            vf power = 1.055f * vexp(vlog(above) * (1 / 2.4f)) - 0.055f;
            vi line = linear <= m.knee;
            vf srgb = pick(line, 12.92f * vmax(linear, vf{}), power);
            vf derivative = pick(line, keep(linear >= 0.0f, splat(12.92f)), (power + 0.055f) / (2.4f * above));
            vi clipped = (code >= m.saturated) & (srgb > photo);
            vi known = load_bytes(m.mask + at, 1, n) != 128.0f;
            srgb = keep(known, pick(clipped, photo, srgb)), photo = keep(known, photo);
            store(x + to, srgb), store(y + to, photo), store(slope + to, keep(known & ~clipped, derivative));
            sum += vabs(srgb - photo);
        }
    return sum_of(sum);
}

// Sum of 1 - SSIM over all window positions; its gradients with respect to the mean of x, the mean of x^2 + y^2 and the
// mean of x y are written to `maps`, shifted by MARGIN in both directions into planes of zeros.
static float similarity(const Image& m, const Window& w, const float* x, const float* y, float** rows, float** maps) {
    int height = w.height - MARGIN, width = w.width - MARGIN;
    for (int r = 0; r < w.height; r++)
        for (int c = 0; c < width; c += LANES) {
            const float *a = x + (i64)r * w.stride + c, *b = y + (i64)r * w.stride + c;
            vf mean_x = {}, mean_y = {}, power = {}, product = {};
            for (int k = 0; k < TAPS; k++) {
                vf p = load(a + k), q = load(b + k), wp = m.taps[k] * p, wq = m.taps[k] * q;
                mean_x += wp, mean_y += wq, power += wp * p + wq * q, product += wp * q;
            }
            i64 to = (i64)r * w.stride + c;
            store(rows[0] + to, mean_x), store(rows[1] + to, mean_y);
            store(rows[2] + to, power), store(rows[3] + to, product);
        }
    vf sum = {};
    for (int r = 0; r < height; r++)
        for (int c = 0; c < width; c += LANES) {
            vf mean[4] = {};
            for (int i = 0; i < 4; i++)
                for (int k = 0; k < TAPS; k++) mean[i] += m.taps[k] * load(rows[i] + (i64)(r + k) * w.stride + c);
            vf xy = mean[0] * mean[1], squares = mean[0] * mean[0] + mean[1] * mean[1];
            vf a1 = 2.0f * xy + m.c1, a2 = 2.0f * (mean[3] - xy) + m.c2, b1 = squares + m.c1, b2 = mean[2] - squares + m.c2;
            vf ratio = 1.0f / (b1 * b2), s = a1 * a2 * ratio;
            vi inside = lane_index() < width - c;
            sum += keep(inside, 1.0f - s);
            vf cross = 2.0f * ratio * (a2 - a1), direct = 2.0f * s * (1.0f / b2 - 1.0f / b1);
            i64 to = (i64)(r + MARGIN) * w.stride + c + MARGIN;
            store(maps[0] + to, keep(inside, cross * mean[1] + direct * mean[0]));
            store(maps[1] + to, keep(inside, -s / b2)), store(maps[2] + to, keep(inside, 2.0f * ratio * a1));
        }
    return sum_of(sum);
}

// Sum over a window of TAPS x TAPS of each map, first along columns and then, into the result, along rows.
static void blur_maps(const Image& m, const Window& w, float** maps, float** rows) {
    for (int i = 0; i < 3; i++)
        for (int r = 0; r < w.height; r++)
            for (int c = 0; c < w.stride; c += LANES) {
                vf sum = {};
                for (int k = 0; k < TAPS; k++) sum += m.taps[k] * load(maps[i] + (i64)(r + k) * w.stride + c);
                store(rows[i] + (i64)r * w.stride + c, sum);
            }
}

// The photometric term of one channel, and its gradient.
static float photometric(const Image& m, const Window& w, int ch) {
    float* plane[PLANES];
    for (int i = 0; i < PLANES; i++) plane[i] = m.scratch + (i64)(PLANES * ch + i) * m.plane_size;
    float *x = plane[0], *y = plane[1], *slope = plane[2], **rows = plane + 3, **maps = plane + 7;
    i64 size = (i64)(w.height + MARGIN) * w.stride;
    for (int i = 0; i < 3; i++) clear(maps[i], 4 * size);
    float l1 = srgb_planes(m, w, ch, x, y, slope);
    float unlike = similarity(m, w, x, y, rows, maps);
    float of_l1 = m.weights[0] * (1 - m.ssim_weight) / (3.0f * m.height * m.width);
    float of_ssim = m.weights[0] * m.ssim_weight / (3.0f * (m.height - MARGIN) * (m.width - MARGIN));
    blur_maps(m, w, maps, rows);
    for (int r = 0; r < w.height; r++)
        for (int c = 0; c < w.width; c += LANES) {
            i64 at = (i64)r * w.stride + c;
            vf sums[3] = {};
            for (int i = 0; i < 3; i++)
                for (int k = 0; k < TAPS; k++) sums[i] += m.taps[k] * load(rows[i] + at + k);
            vf a = load(x + at), b = load(y + at), sign = keep(a > b, splat(1.0f)) - keep(a < b, splat(1.0f));
            vf g = of_l1 * sign - of_ssim * (sums[0] + 2.0f * a * sums[1] + b * sums[2]);
            g *= load(slope + at);
            float* to = m.g_rgb + 3 * ((i64)(w.top + r) * m.width + w.left + c) + ch;
            for (int l = 0; l < imin2(LANES, w.width - c); l++) to[3 * l] = g[l];
        }
    return of_l1 * l1 + of_ssim * unlike;
}

// Terms of mask and depth variance, which concern single pixels.
static void pixel_terms(const Image& m, const Window& w) {
    float per_pixel = 1 / ((float)m.height * m.width), of_mask = m.weights[1] * per_pixel;
    float of_deviation = m.weights[3] * per_pixel;
    vf mask_sum = {}, deviation = {};
    for (int r = 0; r < w.height; r++)
        for (int c = 0; c < w.width; c += LANES) {
            i64 at = (i64)(w.top + r) * m.width + w.left + c;
            int n = imin2(LANES, w.width - c);
            vf code = load_bytes(m.mask + at, 1, n);
            vf alpha = load_some(m.alpha + at, n);
            vf error = keep(code != 128.0f, alpha - keep(code == 255.0f, splat(1.0f)));
            mask_sum += error * error;
            store_some(m.g_alpha + at, 2 * of_mask * error, n);
            vf var = load_some(m.depth_var + at, n), root = vsqrt(vmax(var, vf{}) + 1e-6f);
            deviation += keep(alpha > 0.0f, root - 1e-3f);
            store_some(m.g_depth_var + at, keep((alpha > 0.0f) & (var >= 0.0f), 0.5f * of_deviation / root), n);
        }
    m.terms[1] = of_mask * sum_of(mask_sum), m.terms[3] = of_deviation * sum_of(deviation);
}

// Term of the consistency of rendered normals with those of the depth map.
static void normal_term(const Image& m, const Window& w) {
    float per_pixel = m.weights[2] / ((float)m.height * m.width), fx = m.focal[0], fy = m.focal[1];
    vf total = {}, v_R[9] = {};
    for (int row = imax2(1, w.top); row < imin2(m.height - 1, w.top + w.height); row++) {
        float Y = (row + 0.5f - m.focal[3]) / fy;
        for (int x = imax2(1, w.left); x < imin2(m.width - 1, w.left + w.width); x += LANES) {
            i64 at = (i64)row * m.width + x;
            int n = imin2(LANES, imin2(m.width - 1, w.left + w.width) - x);
            vi known = lane_index() < n;
            const i64 around[5] = {at, at - 1, at + 1, at - m.width, at + m.width};
            for (i64 to : around) known &= load_some(m.alpha + to, n) > 0.5f;
            if (!any(known)) continue;
            vf right = load_some(m.depth + at + 1, n), left = load_some(m.depth + at - 1, n);
            vf below = load_some(m.depth + at + m.width, n), above = load_some(m.depth + at - m.width, n);
            vf across = 1.0f / pick(known, right + left, splat(1.0f)), down = 1.0f / pick(known, below + above, splat(1.0f));
            vf p = fx * (right - left) * across, q = fy * (below - above) * down;
            vf X = (__builtin_convertvector(lane_index() + x, vf) + (0.5f - m.focal[2])) / fx, u[3], a[3], k[3];
            u[0] = p, u[1] = q, u[2] = -1.0f - p * X - q * Y;
            vf length = 1.0f / vsqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]), square = {}, cosine = {};
            for (int i = 0; i < 3; i++) {
                u[i] *= length, a[i] = load_third(m.normal + 3 * at + i, n);
                square += a[i] * a[i];
            }
            vf inverse = 1.0f / vsqrt(vmax(square, splat(1e-24f)));
            for (int i = 0; i < 3; i++) {
                k[i] = inverse * (m.R[3 * i] * a[0] + m.R[3 * i + 1] * a[1] + m.R[3 * i + 2] * a[2]);
                cosine += k[i] * u[i];
            }
            vf off = 1.0f - cosine, shrunk = 1.0f / (1.0f + m.crease * off);
            total += keep(known, off * shrunk);
            vf v_cos = keep(known, -per_pixel * shrunk * shrunk);
            for (int j = 0; j < 3; j++) {
                vf from_depth = m.R[j] * u[0] + m.R[3 + j] * u[1] + m.R[6 + j] * u[2];
                vf g = v_cos * inverse * (from_depth - cosine * inverse * a[j]);
                for (int l = 0; l < n; l++) m.g_normal[3 * (at + l) + j] = g[l];
                for (int i = 0; i < 3; i++) v_R[3 * i + j] += u[i] * v_cos * inverse * a[j];
            }
            vf scale = v_cos * length, v_n[3];
            for (int i = 0; i < 3; i++) v_n[i] = scale * (k[i] - cosine * u[i]);
            vf v_p = 2.0f * fx * across * across * (v_n[0] - X * v_n[2]);
            vf v_q = 2.0f * fy * down * down * (v_n[1] - Y * v_n[2]);
            add_some(m.g_depth + at + 1, v_p * left, n), add_some(m.g_depth + at - 1, -v_p * right, n);
            add_some(m.g_depth + at + m.width, v_q * above, n), add_some(m.g_depth + at - m.width, -v_q * below, n);
        }
    }
    m.terms[2] = per_pixel * sum_of(total);
    for (int i = 0; i < 9; i++) m.g_R[i] = sum_of(v_R[i]);
}

static void image_terms(const Image& m) {
    i64 pixels = (i64)m.height * m.width;
    clear(m.g_rgb, 12 * pixels), clear(m.g_alpha, 4 * pixels), clear(m.g_depth, 4 * pixels);
    clear(m.g_depth_var, 4 * pixels), clear(m.g_normal, 12 * pixels), clear(m.g_R, 36), clear(m.terms, 16);
    Window w = window_of(m);
    if (!w.height) return;
    float of_channel[3];
    parallel(m.threads, [&](int share) {
        for (int job = share; job < 4; job += m.threads)
            if (job < 3)
                of_channel[job] = photometric(m, w, job);
            else
                pixel_terms(m, w), normal_term(m, w);
    });
    m.terms[0] = of_channel[0] + of_channel[1] + of_channel[2];
}
