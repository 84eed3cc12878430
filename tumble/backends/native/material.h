// Material of Gaussians, their indirect light, and loss terms of rendered materials, with adjoints (`Backend`:
// corner_features, bounce, material_terms); `v_x` is the gradient of x.
#pragma once
#include "image.h"
#include "sh_shade.h"

enum { FEATURES = 7, BATCH = 32 };   // features of a corner; Gaussians whose activations are computed at once

struct Activation {
    const float *albedo_logits, *roughness_logits, *normal_offset;
    int n, threads;
    float temperature;
    float *corners, *albedo;   // albedo: mean of the corners
    const float *v_corners, *v_albedo;
    float *v_albedo_logits, *v_roughness_logits, *v_normal_offset;
};

static void activate_share(const Activation& m, int share) {
    int end = share_start(m.n, share + 1, m.threads);
    float inverse = 1 / m.temperature;
    for (int first = share_start(m.n, share, m.threads); first < end; first += BATCH) {
        int count = imin2(BATCH, end - first);
        float albedo[12 * BATCH + LANES], rough[4 * BATCH + LANES];
        for (int i = 0; i < 12 * count; i += LANES)
            store(albedo + i, sigmoid(inverse * load_some(m.albedo_logits + 12 * (i64)first + i, 12 * count - i)));
        for (int i = 0; i < 4 * count; i += LANES)
            store(rough + i, sigmoid(inverse * load_some(m.roughness_logits + 4 * (i64)first + i, 4 * count - i)));
        for (int g = 0; g < count; g++) {
            const float *a = albedo + 12 * g, *offset = m.normal_offset + 12 * (i64)(first + g);
            float* to = m.corners + 4 * FEATURES * (i64)(first + g);
            for (int corner = 0; corner < 4; corner++, to += FEATURES) {
                for (int j = 0; j < 3; j++) to[j] = a[3 * corner + j], to[4 + j] = offset[3 * corner + j];
                to[3] = rough[4 * g + corner];
            }
            for (int j = 0; j < 3; j++) m.albedo[3 * (i64)(first + g) + j] = 0.25f * (a[j] + a[3 + j] + a[6 + j] + a[9 + j]);
        }
    }
}

static void activate_adjoint_share(const Activation& m, int share) {
    int end = share_start(m.n, share + 1, m.threads);
    float inverse = 1 / m.temperature;
    for (i64 g = share_start(m.n, share, m.threads); g < end; g++)
        for (int corner = 0; corner < 4; corner++) {
            i64 at = 4 * g + corner;
            const float *value = m.corners + FEATURES * at, *v = m.v_corners + FEATURES * at;
            for (int j = 0; j < 3; j++) {
                float slope = inverse * value[j] * (1 - value[j]);
                m.v_albedo_logits[3 * at + j] = slope * (v[j] + 0.25f * m.v_albedo[3 * g + j]);
                m.v_normal_offset[3 * at + j] = v[4 + j];
            }
            m.v_roughness_logits[at] = inverse * value[3] * (1 - value[3]) * v[3];
        }
}

struct Indirect {
    const float *albedo, *transfer, *directions, *radiance;
    int n, n_directions, threads;
    float* out;
    const float* v_out;
    float *v_albedo, *v_radiance;
};

enum { MAX_SHARES = 64 };

// Coefficients of the radiance that arrives from all directions.
static void project_radiance(const Indirect& s, float (*coefficients)[3]) {
    float per_direction = 12.566370614f / s.n_directions;
    vf projected[9][3] = {};
    for (int first = 0; first < s.n_directions; first += LANES) {
        int count = imin2(LANES, s.n_directions - first);
        vf Y[16];
        harmonics(9, gather3(s.directions, first, count), Y);
        for (int ch = 0; ch < 3; ch++) {
            vf radiance = keep(lane_index() < count, gather(s.radiance, 3, ch, first, count));
            for (int k = 0; k < 9; k++) projected[k][ch] += Y[k] * radiance;
        }
    }
    for (int k = 0; k < 9; k++)
        for (int ch = 0; ch < 3; ch++) coefficients[k][ch] = per_direction * sum_of(projected[k][ch]);
}

// Radiance of a share of the Gaussians, or its adjoint, with the gradient of the coefficients in `totals`.
static void bounce_share(const Indirect& s, const float (*coefficients)[3], bool adjoint, int share, int shares,
                         float (*totals)[3]) {
    vf sums[9][3] = {};
    int end = share_start(s.n, share + 1, shares);
    for (int first = share_start(s.n, share, shares); first < end; first += LANES) {
        int count = imin2(LANES, end - first);
        vi inside = lane_index() < count;
        vf t[9];
        for (int k = 0; k < 9; k++) t[k] = gather(s.transfer, 9, k, first, count);
        vf hidden = 1.0f - vmin(vmax(t[0] * 1.12837917f, vf{}), splat(1.0f));
        for (int ch = 0; ch < 3; ch++) {
            vf irradiance = {}, a = gather(s.albedo, 3, ch, first, count);
            for (int k = 0; k < 9; k++) irradiance += t[k] * coefficients[k][ch];
            vf rest = 1.0f - a * hidden, inverse = 1.0f / vmax(rest, splat(1e-3f)), lit = vmax(irradiance, vf{});
            if (!adjoint) {
                scatter(s.out, 3, ch, first, count, 0.318309886f * a * lit * inverse);
                continue;
            }
            vf v = keep(inside, 0.318309886f * gather(s.v_out, 3, ch, first, count));
            vf v_lit = keep(irradiance >= 0.0f, v * a * inverse);
            vf grows = keep(rest >= 1e-3f, a * hidden * inverse);
            scatter(s.v_albedo, 3, ch, first, count, v * lit * inverse * (1.0f + grows));
            for (int k = 0; k < 9; k++) sums[k][ch] += v_lit * t[k];
        }
    }
    for (int k = 0; k < 9; k++)
        for (int ch = 0; ch < 3; ch++) totals[k][ch] = sum_of(sums[k][ch]);
}

static void bounce_values(const Indirect& s, bool adjoint) {
    float coefficients[9][3], totals[MAX_SHARES][9][3], per_direction = 12.566370614f / s.n_directions;
    int shares = imin2(s.threads, MAX_SHARES);
    project_radiance(s, coefficients);
    parallel(shares, [&](int share) { bounce_share(s, coefficients, adjoint, share, shares, totals[share]); });
    if (!adjoint) return;
    for (int k = 0; k < 9; k++)
        for (int ch = 0; ch < 3; ch++) {
            coefficients[k][ch] = 0;
            for (int share = 0; share < shares; share++) coefficients[k][ch] += per_direction * totals[share][k][ch];
        }
    for (int first = 0; first < s.n_directions; first += LANES) {
        int count = imin2(LANES, s.n_directions - first);
        vf Y[16];
        harmonics(9, gather3(s.directions, first, count), Y);
        for (int ch = 0; ch < 3; ch++) scatter(s.v_radiance, 3, ch, first, count, series(coefficients, Y, ch, 9));
    }
}

struct MaterialImage {
    const float *features, *alpha;
    const u8 *photo, *mask;
    int height, width, n_features, plane_size, threads;
    float* scratch;   // 11 planes
    float *terms, *g_features, *g_alpha;
};

// The mask term of a share of the rows, and the window of its pixels with a material, widened by one pixel.
static float mask_share(const MaterialImage& m, int share, Window& w) {
    float per_pixel = 1 / ((float)m.height * m.width);
    int first = m.height * share / m.threads, end = m.height * (share + 1) / m.threads;
    int top = m.height, bottom = -1, left = m.width, right = -1;
    vf sum = {};
    for (int y = first; y < end; y++)
        for (int c = 0; c < m.width; c += LANES) {
            i64 at = (i64)y * m.width + c;
            int n = imin2(LANES, m.width - c);
            vf code = load_bytes(m.mask + at, 1, n), alpha = load_some(m.alpha + at, n);
            vi object = code == 255.0f;
            vf error = keep(code != 128.0f, alpha - keep(object, splat(1.0f)));
            sum += error * error;
            store_some(m.g_alpha + at, 2 * per_pixel * error, n);
            u32 found = bits(object & (alpha > 0.5f));
            if (!found) continue;
            top = imin2(top, y), bottom = y;
            left = imin2(left, c + __builtin_ctz(found)), right = imax2(right, c + 31 - __builtin_clz(found));
        }
    clear(m.g_features + (i64)first * m.width * m.n_features, (i64)4 * (end - first) * m.width * m.n_features);
    w = {imax2(top - 1, 0), imax2(left - 1, 0), imin2(bottom + 2, m.height), imin2(right + 2, m.width), bottom};
    return per_pixel * sum_of(sum);
}

// Calls visit with pixel, place in the planes, and whether there is a material, for rows of the window.
template <class F>
INLINE void for_window(const MaterialImage& m, const Window& w, int first, int end, F visit) {
    for (int y = first; y < end; y++)
        for (int c = 0; c < w.width; c++) {
            i64 at = (i64)(w.top + y) * m.width + w.left + c;
            visit(at, (i64)y * w.stride + c, m.mask[at] == 255 && m.alpha[at] > 0.5f);
        }
}

// Sum of |x_b - x_a| w over pairs of neighbours a and b = a + step whose a is in some rows, and its gradient; w is the
// mean of e^-|difference| over the channels of the photo.
static float smoothness(float* const* plane, int first, int end, int width, int stride, i64 step, float factor) {
    float *const *x = plane, *const *g = plane + 4, *const *photo = plane + 8;
    vf sum = {};
    for (int y = first; y < end; y++)
        for (int c = 0; c < width; c += LANES) {
            i64 a = (i64)y * stride + c, b = a + step;
            vf weight = {};
            for (int j = 0; j < 3; j++) weight += vexp(-vabs(load(photo[j] + b) - load(photo[j] + a)));
            weight = keep(lane_index() < width - c, weight * (1.0f / 3.0f));
            for (int j = 0; j < 4; j++) {
                vf difference = load(x[j] + b) - load(x[j] + a);
                sum += weight * vabs(difference);
                vf v = factor * (keep(difference > 0.0f, weight) - keep(difference < 0.0f, weight));
                store(g[j] + b, load(g[j] + b) + v), store(g[j] + a, load(g[j] + a) - v);
            }
        }
    return factor * sum_of(sum);
}

static void material_terms(const MaterialImage& m) {
    int shares = m.threads, bottom = -1;
    Window part[MAX_SHARES], w = {m.height, m.width, 0, 0, 0};   // at first with the end of rows and columns
    float mask[MAX_SHARES] = {}, pairs[MAX_SHARES] = {}, *plane[11];
    parallel(shares, [&](int share) { mask[share] = mask_share(m, share, part[share]); });
    m.terms[0] = m.terms[1] = 0;
    for (int i = 0; i < shares; i++) {
        m.terms[0] += mask[i];
        if (part[i].stride < 0) continue;
        w.top = imin2(w.top, part[i].top), w.left = imin2(w.left, part[i].left), bottom = part[i].stride;
        w.height = imax2(w.height, part[i].height), w.width = imax2(w.width, part[i].width);
    }
    if (bottom < 0) return;
    w.height -= w.top, w.width -= w.left, w.stride = w.width + 2 * LANES;
    for (int i = 0; i < 11; i++) plane[i] = m.scratch + (i64)i * m.plane_size;
    auto row = [&](int share) { return w.height * share / shares; };
    parallel(shares, [&](int share) {
        // A row below the window is read, too.
        int last = share + 1 == shares ? w.height + 1 : row(share + 1);
        for (int i = 0; i < 11; i++) clear(plane[i] + (i64)row(share) * w.stride, (i64)4 * (last - row(share)) * w.stride);
        for_window(m, w, row(share), row(share + 1), [&](i64 at, i64 to, bool material) {
            for (int j = 0; j < 3; j++) plane[8 + j][to] = m.photo[3 * at + j] / 255.0f;
            for (int j = 0; j < 4 && material; j++) plane[j][to] = m.features[m.n_features * at + j];
        });
    });
    float across = m.width > 1 ? 1 / (4.0f * m.height * (m.width - 1)) : 0;
    float down = m.height > 1 ? 1 / (4.0f * (m.height - 1) * m.width) : 0;
    parallel(shares, [&](int share) {
        pairs[share] = smoothness(plane, row(share), row(share + 1), w.width - 1, w.stride, 1, across) +
                       smoothness(plane, row(share), row(share + 1) - 1, w.width, w.stride, w.stride, down);
    });
    for (int share = 0; share < shares; share++) {
        m.terms[1] += pairs[share];
        int last = row(share + 1) - 1;   // its pairs with the first row of the next share
        if (share + 1 < shares && last >= row(share))
            m.terms[1] += smoothness(plane, last, last + 1, w.width, w.stride, w.stride, down);
    }
    parallel(shares, [&](int share) {
        for_window(m, w, row(share), row(share + 1), [&](i64 at, i64 from, bool material) {
            for (int j = 0; j < 4 && material; j++) m.g_features[m.n_features * at + j] = plane[4 + j][from];
        });
    });
}
