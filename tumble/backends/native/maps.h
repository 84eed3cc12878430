// Rendered maps of cameras around the object, at points near its surface: the sums of depth fusion (`FuseKernel`) and of
// texture baking (`BlendKernel`).
#pragma once
#include "simd.h"

struct Fusion {
    const float* points;              // n x 3
    const float *R, *t, *positions;   // object to camera, and positions of the cameras, by view
    const int* index;                 // of each view's pixels: row of `planes`, -1 unknown, -2 free space
    const float* planes;              // unit normal, offset and z-depth
    int n, n_views, height, width, threads;
    float fx, fy, cx, cy, cell, reach, distance;
    float* out;                       // 5 x n
};

INLINE void add(float* to, vf x) { store(to, load(to) + x); }

// Points of neighbouring rows of a grid, which are taken together so that a view's pixels stay in the cache.
enum { FUSED_AT_ONCE = 1024 };
struct FuseBlock {
    alignas(64) float x[3][FUSED_AT_ONCE], z[FUSED_AT_ONCE], sum[5][FUSED_AT_ONCE];
    alignas(64) int at[FUSED_AT_ONCE], row[FUSED_AT_ONCE];
};

// Depths of the points in a view, and rows of their planes, which are on their way into the cache then.
INLINE void find_planes(const Fusion& s, int view, int count, FuseBlock& block) {
    const float *R = s.R + 9 * view, *t = s.t + 3 * view;
    const int* index = s.index + (i64)view * s.height * s.width;
    for (int j = 0; j < count; j += LANES) {
        vf x[3] = {load(block.x[0] + j), load(block.x[1] + j), load(block.x[2] + j)};
        vf z = R[6] * x[0] + R[7] * x[1] + R[8] * x[2] + t[2];
        vf u = (R[0] * x[0] + R[1] * x[1] + R[2] * x[2] + t[0]) / z * s.fx + s.cx;
        vf v = (R[3] * x[0] + R[4] * x[1] + R[5] * x[2] + t[1]) / z * s.fy + s.cy;
        vi inside = (u >= 0.0f) & (u < (float)s.width) & (v >= 0.0f) & (v < (float)s.height);
        vi pixel = __builtin_convertvector(v, vi) * s.width + __builtin_convertvector(u, vi);
        *(vi*)(block.at + j) = inside ? pixel : splat(-1);
        store(block.z + j, z);
    }
    for (int j = 0; j < count; j++) {
        block.row[j] = block.at[j] < 0 ? -2 : index[block.at[j]];
        if (block.row[j] >= 0) __builtin_prefetch(s.planes + 5 * (i64)block.row[j]);
    }
}

INLINE void fuse_view(const Fusion& s, int view, int count, FuseBlock& block) {
    const float* c = s.positions + 3 * view;
    for (int j = 0; j < count; j += LANES) {
        vf x[3] = {load(block.x[0] + j), load(block.x[1] + j), load(block.x[2] + j)}, plane[5];
        vi row = *(vi*)(block.row + j), shown = row >= 0;
        add(block.sum[4] + j, keep(row == -2, splat(1.0f)));
        u32 left = bits(shown);
        if (!left) continue;
        alignas(64) float planes[5][LANES] = {};
        for (; left; left &= left - 1) {
            int l = __builtin_ctz(left);
            const float* from = s.planes + 5 * (i64)block.row[j + l];
            for (int k = 0; k < 5; k++) planes[k][l] = from[k];
        }
        for (int k = 0; k < 5; k++) plane[k] = load(planes[k]);
        vf behind = (load(block.z + j) - plane[4]) / s.cell;
        shown &= behind < 3 * s.reach;
        if (!bits(shown)) continue;
        vf distance = (plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] - plane[3]) / s.cell;
        add(block.sum[4] + j, keep(shown & (behind < -3 * s.reach) & (distance > s.reach), splat(1.0f)));
        vf cosine = (plane[0] * (c[0] - x[0]) + plane[1] * (c[1] - x[1]) + plane[2] * (c[2] - x[2])) / s.distance;
        cosine = vmax(cosine, vf{});
        vf fade = vmax(1.0f + vmin(distance + 0.5f, vf{}) / 1.5f, vf{});
        vi near = shown & (vmax(distance, -distance) < s.reach) & (behind > -3 * s.reach);
        vf weight = keep(near, fade * cosine * cosine), outside = keep(distance > 0.0f, weight);
        add(block.sum[0] + j, weight * distance), add(block.sum[1] + j, weight);
        add(block.sum[2] + j, outside * distance), add(block.sum[3] + j, outside);
    }
}

static void fuse_share(const Fusion& s, int share) {
    FuseBlock block;
    i64 end = (i64)s.n * (share + 1) / s.threads;
    for (i64 first = (i64)s.n * share / s.threads; first < end; first += FUSED_AT_ONCE) {
        int count = (int)(end - first < FUSED_AT_ONCE ? end - first : FUSED_AT_ONCE);
        clear(&block, sizeof block);
        for (int i = 0; i < count; i++)
            for (int k = 0; k < 3; k++) block.x[k][i] = s.points[3 * (first + i) + k];
        int whole = (count + LANES - 1) / LANES * LANES;
        for (int view = 0; view < s.n_views; view++) find_planes(s, view, whole, block), fuse_view(s, view, whole, block);
        for (int k = 0; k < 5; k++)
            for (int i = 0; i < count; i++) s.out[(i64)k * s.n + first + i] = block.sum[k][i];
    }
}

enum { BLENDED = 7, MAPS = BLENDED + 2 };

struct Baking {
    const float* maps;                  // height x width x MAPS: values, depth, and 1 in pixels that show a surface; else 0
    const float *points, *normals;      // n x 3
    const float *R, *t, *position;
    int n, height, width, threads;
    float fx, fy, cx, cy, min_cosine, tolerance;
    float *total, *weights;             // n x BLENDED and n, to which is added
};

static void blend_share(const Baking& s, int share) {
    i64 end = (i64)s.n * (share + 1) / s.threads;
    for (i64 i = (i64)s.n * share / s.threads; i < end; i++) {
        const float *x = s.points + 3 * i, *n = s.normals + 3 * i, *R = s.R, *c = s.position;
        float d[3] = {c[0] - x[0], c[1] - x[1], c[2] - x[2]};
        float along = n[0] * d[0] + n[1] * d[1] + n[2] * d[2];
        if (along <= 0) continue;
        float cosine = along / __builtin_sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        if (cosine <= s.min_cosine) continue;
        float z = R[6] * x[0] + R[7] * x[1] + R[8] * x[2] + s.t[2];
        float u = (R[0] * x[0] + R[1] * x[1] + R[2] * x[2] + s.t[0]) / z * s.fx + s.cx - 0.5f;
        float v = (R[3] * x[0] + R[4] * x[1] + R[5] * x[2] + s.t[1]) / z * s.fy + s.cy - 0.5f;
        if (!(u > -1 && v > -1 && u < (float)s.width && v < (float)s.height)) continue;
        int column = (int)(u + 1) - 1, row = (int)(v + 1) - 1;
        float a = u - (float)column, b = v - (float)row, sum[MAPS] = {};
        for (int k = 0; k < 4; k++) {
            int r = row + (k >> 1), q = column + (k & 1);
            if (r < 0 || q < 0 || r >= s.height || q >= s.width) continue;
            float w = (k & 1 ? a : 1 - a) * (k >> 1 ? b : 1 - b);
            const float* from = s.maps + MAPS * ((i64)r * s.width + q);
            for (int j = 0; j < MAPS; j++) sum[j] += w * from[j];
        }
        float known = sum[MAPS - 1];
        if (known <= 0.25f) continue;
        float depth = sum[BLENDED] / known - z;
        if ((depth < 0 ? -depth : depth) >= s.tolerance) continue;
        // The known pixels' mean has the weight `known`, so that it cancels.
        float weight = cosine * cosine * cosine * cosine;
        for (int j = 0; j < BLENDED; j++) s.total[BLENDED * i + j] += weight * sum[j];
        s.weights[i] += weight * known;
    }
}
