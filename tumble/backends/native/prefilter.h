// Convolution of an equirectangular map along its columns, from every row to every row (`Backend.prefilter`), and its
// adjoint; `v_x` is the gradient of x. The Fourier transforms along the columns are sums over cosines and sines: the maps
// have at most 64 columns.
#pragma once
#include "image.h"
#include "parallel.h"
#include "project.h"

enum { MAX_HALF = 32 };   // of the columns

struct Prefilter {
    const float *radiance, *lobes, *lobes_by_input, *waves;   // lobes_by_input: [frequency, input row, row]
    int height, width, frequencies, rows, threads;            // waves: cosines, then sines, [frequency, column]
    float *scratch, *out;                                     // scratch: (width + 2 F) 3 height + 6 F rows, padded rows
    const float* v_out;
    float* v_radiance;
};

// Rows of the arrays in scratch memory are padded to whole vectors: the columns [column, (row, channel)], their transforms
// [frequency, part, (row, channel)], and those of the results [frequency, (part, channel), row]. Numbers in the padding count for nothing.
struct PrefilterArrays {
    float *columns, *spectrum, *filtered;
    int wide, long_;
};
INLINE int padded(int n) { return (n + LANES - 1) / LANES * LANES; }
INLINE PrefilterArrays prefilter_arrays(const Prefilter& s) {
    int wide = padded(3 * s.height);
    float* spectrum = s.scratch + (i64)s.width * wide;
    return {s.scratch, spectrum, spectrum + (i64)2 * s.frequencies * wide, wide, padded(s.rows)};
}
// Factor of a frequency in the inverse transform.
INLINE float inverse_factor(const Prefilter& s, int f) { return (f == 0 || 2 * f == s.width ? 1.0f : 2.0f) / s.width; }

static void filter_frequency(const Prefilter& s, const PrefilterArrays& a, int f) {
    const float *cosines = s.waves + (i64)f * s.width, *sines = cosines + (i64)s.frequencies * s.width;
    float *real = a.spectrum + (i64)2 * f * a.wide, *imaginary = real + a.wide, factor = inverse_factor(s, f);
    for (int q = 0; q < a.wide; q += LANES) {
        vf re = {}, im = {};
        for (int c = 0; c < s.width; c++) {
            vf x = load(a.columns + (i64)c * a.wide + q);
            re += cosines[c] * x, im -= sines[c] * x;
        }
        store(real + q, factor * re), store(imaginary + q, factor * im);
    }
    for (int o = 0; o < s.rows; o += LANES) {
        int count = imin2(LANES, s.rows - o);
        vf sums[6] = {};
        for (int i = 0; i < s.height; i++) {
            vf lobe = load_some(s.lobes_by_input + ((i64)f * s.height + i) * s.rows + o, count);
            for (int ch = 0; ch < 3; ch++) sums[ch] += real[3 * i + ch] * lobe, sums[3 + ch] += imaginary[3 * i + ch] * lobe;
        }
        for (int k = 0; k < 6; k++) store(a.filtered + ((i64)6 * f + k) * a.long_ + o, sums[k]);
    }
}

// LANES rows of the results from their transforms. Columns c and w - c are sum and difference of the same series.
static void inverse_rows(const Prefilter& s, const PrefilterArrays& a, int o) {
    int count = imin2(LANES, s.rows - o);
    for (int c = 0; 2 * c <= s.width; c++) {
        vf even[3] = {}, odd[3] = {};
        for (int f = 0; f < s.frequencies; f++) {
            const float* from = a.filtered + (i64)6 * f * a.long_ + o;
            float cosine = s.waves[(i64)f * s.width + c], sine = s.waves[(i64)(s.frequencies + f) * s.width + c];
            for (int ch = 0; ch < 3; ch++)
                even[ch] += cosine * load(from + ch * a.long_), odd[ch] += sine * load(from + (3 + ch) * a.long_);
        }
        int mirrored = c ? s.width - c : 0;
        for (int ch = 0; ch < 3; ch++) {
            float one[LANES], other[LANES], *row = s.out + ((i64)s.height + o) * s.width * 3 + ch;
            store(one, even[ch] - odd[ch]), store(other, even[ch] + odd[ch]);
            for (int l = 0; l < count; l++, row += 3 * s.width) row[3 * mirrored] = other[l], row[3 * c] = one[l];
        }
    }
}

static void prefilter_map(const Prefilter& s) {
    PrefilterArrays a = prefilter_arrays(s);
    clear(a.columns, (i64)4 * s.width * a.wide);
    for (int r = 0; r < s.height; r++)
        for (int c = 0; c < s.width; c++)
            for (int ch = 0; ch < 3; ch++) {
                float x = s.radiance[((i64)r * s.width + c) * 3 + ch];
                a.columns[(i64)c * a.wide + 3 * r + ch] = s.out[((i64)r * s.width + c) * 3 + ch] = x;
            }
    parallel(s.threads, [&](int share) {
        for (int f = share; f < s.frequencies; f += s.threads) filter_frequency(s, a, f);
    });
    parallel(s.threads, [&](int share) {
        for (int o = share * LANES; o < s.rows; o += s.threads * LANES) inverse_rows(s, a, o);
    });
}

static void inverse_rows_adjoint(const Prefilter& s, const PrefilterArrays& a, int o) {
    int count = imin2(LANES, s.rows - o), half = s.width / 2;
    for (int ch = 0; ch < 3; ch++) {
        vf even[MAX_HALF + 1], odd[MAX_HALF + 1];
        for (int c = 0; c <= half; c++) {
            float one[LANES] = {}, other[LANES] = {};
            const float* row = s.v_out + ((i64)s.height + o) * s.width * 3 + ch;
            for (int l = 0; l < count; l++, row += 3 * s.width)
                one[l] = row[3 * c], other[l] = c && c < half ? row[3 * (s.width - c)] : 0;
            even[c] = load(one) + load(other), odd[c] = load(other) - load(one);
        }
        for (int f = 0; f < s.frequencies; f++) {
            const float *cosines = s.waves + (i64)f * s.width, *sines = cosines + (i64)s.frequencies * s.width;
            vf re = {}, im = {};
            for (int c = 0; c <= half; c++) re += cosines[c] * even[c], im += sines[c] * odd[c];
            store(a.filtered + ((i64)6 * f + ch) * a.long_ + o, re), store(a.filtered + ((i64)6 * f + 3 + ch) * a.long_ + o, im);
        }
    }
}

static void filter_frequency_adjoint(const Prefilter& s, const PrefilterArrays& a, int f) {
    const float* v = a.filtered + (i64)6 * f * a.long_;
    float *real = a.spectrum + (i64)2 * f * a.wide, *imaginary = real + a.wide, factor = inverse_factor(s, f);
    for (int i = 0; i < s.height; i += LANES) {
        int count = imin2(LANES, s.height - i);
        vf sums[6] = {};
        for (int o = 0; o < s.rows; o++) {
            vf lobe = load_some(s.lobes + ((i64)f * s.rows + o) * s.height + i, count);
            for (int k = 0; k < 6; k++) sums[k] += v[(i64)k * a.long_ + o] * lobe;
        }
        for (int ch = 0; ch < 3; ch++)
            scatter(real, 3, ch, i, count, factor * sums[ch]), scatter(imaginary, 3, ch, i, count, factor * sums[3 + ch]);
    }
}

static void column_adjoint(const Prefilter& s, const PrefilterArrays& a, int c) {
    for (int q = 0; q < 3 * s.height; q += LANES) {
        vf sum = {};
        for (int f = 0; f < s.frequencies; f++) {
            const float* from = a.spectrum + (i64)2 * f * a.wide + q;
            float cosine = s.waves[(i64)f * s.width + c], sine = s.waves[(i64)(s.frequencies + f) * s.width + c];
            sum += cosine * load(from) - sine * load(from + a.wide);
        }
        for (int l = 0; l < imin2(LANES, 3 * s.height - q); l++) {
            i64 at = ((i64)((q + l) / 3) * s.width + c) * 3 + (q + l) % 3;
            s.v_radiance[at] = s.v_out[at] + sum[l];
        }
    }
}

static void prefilter_adjoint(const Prefilter& s) {
    PrefilterArrays a = prefilter_arrays(s);
    parallel(s.threads, [&](int share) {
        for (int o = share * LANES; o < s.rows; o += s.threads * LANES) inverse_rows_adjoint(s, a, o);
    });
    parallel(s.threads, [&](int share) {
        for (int f = share; f < s.frequencies; f += s.threads) filter_frequency_adjoint(s, a, f);
    });
    parallel(s.threads, [&](int share) {
        for (int c = share; c < s.width; c += s.threads) column_adjoint(s, a, c);
    });
}
