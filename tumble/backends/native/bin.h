// Lists of the Gaussians that overlap each tile, nearest first: a radix sort by depth, then a counting sort by tile.
#pragma once
#include "raster.h"

// Writes the Gaussians that are not culled to r.ranks, by depth, ties by index. Keys are the bits of a positive float,
// or ~0 if culled.
static void sort_by_depth(Raster& r) {
    int *from = r.ranks, *to = r.ranks_2, n = 0;
    int histogram[3][DIGIT];
    clear(histogram, sizeof histogram);
    for (int i = 0; i < r.n; i++) {
        u32 key = r.keys[i];
        if (key == ~0u) continue;
        from[n++] = i;
        histogram[0][key & 2047]++, histogram[1][key >> 11 & 2047]++, histogram[2][key >> 22]++;
    }
    for (int pass = 0; pass < 3; pass++) {
        int start = 0, *h = histogram[pass];
        for (int d = 0; d < DIGIT; d++) {
            int count = h[d];
            h[d] = start, start += count;
        }
        for (int i = 0; i < n; i++) to[h[r.keys[from[i]] >> 11 * pass & 2047]++] = from[i];
        int* other = from;
        from = to, to = other;
    }
    r.ranks_2 = to, r.ranks = from, r.n_drawn = n;
}

// Calls visit(tile) for every tile with a pixel centre inside a Gaussian's footprint. The leftmost and rightmost points
// of the part of an ellipse within a row of tiles are the extreme points of the ellipse, or else its intersections with
// the border of the row.
template <class F>
INLINE void for_tiles(const Raster& r, int g, F visit) {
    const float* s = r.span + (i64)g * SPAN;
    const float margin = 0.02f;
    float x2 = fmax2(s[2], 0), y2 = fmax2(s[4], 1e-12f);
    float half_x = __builtin_sqrtf(x2), half_y = __builtin_sqrtf(y2), slope = s[3] / y2;
    float rest = fmax2(x2 - s[3] * slope, 0), inv_y2 = 1 / y2, extreme = half_x > 0 ? s[3] / half_x : 0;
    float low = fmax2(s[1] - half_y - margin, 0), high = fmin2(s[1] + half_y + margin, (float)r.height);
    int row_end = imin2(tiles_y(r), ((int)high + TILE) / TILE), across = tiles_x(r);
    for (int row = (int)low / TILE; row < row_end; row++) {
        // Pixel centres of the row, relative to the centre of the footprint.
        float top = fmax2(row * TILE + 0.5f - margin - s[1], -half_y);
        float bottom = fmin2(row * TILE + TILE - 0.5f + margin - s[1], half_y);
        if (top > bottom) continue;
        float e_r = fmin2(fmax2(extreme, top), bottom), e_l = fmin2(fmax2(-extreme, top), bottom);
        float right = s[0] + slope * e_r + __builtin_sqrtf(rest * fmax2(1 - e_r * e_r * inv_y2, 0)) + margin;
        float left = s[0] + slope * e_l - __builtin_sqrtf(rest * fmax2(1 - e_l * e_l * inv_y2, 0)) - margin;
        left = fmax2(left, 0.5f), right = fmin2(right, (float)r.width - 0.5f);
        if (left > right) continue;
        // Pixels whose centre x + 1/2 lies in [left, right].
        int from = (int)(left + 0.5f), to = (int)(right - 0.5f);
        if (from > to) continue;
        for (int tile = from / TILE; tile <= to / TILE && tile < across; tile++) visit(row * across + tile);
    }
}

static void count_share(Raster& r, int share) {
    int n_tiles = tiles_x(r) * tiles_y(r), *counts = r.counts + (i64)share * n_tiles;
    clear(counts, (i64)4 * n_tiles);
    int end = share_start(r.n_drawn, share + 1, r.threads);
    for (int i = share_start(r.n_drawn, share, r.threads); i < end; i++)
        for_tiles(r, r.ranks[i], [&](int tile) { counts[tile]++; });
}

// Turns counts into positions in the list, so that the shares of a tile follow each other by depth.
static void place(Raster& r) {
    int n_tiles = tiles_x(r) * tiles_y(r), start = 0;
    for (int tile = 0; tile < n_tiles; tile++) {
        r.tile_start[tile] = start;
        for (int share = 0; share < r.threads; share++) {
            int* c = r.counts + (i64)share * n_tiles + tile;
            int count = *c;
            *c = start, start += count;
        }
    }
    r.tile_start[n_tiles] = start, r.n_pairs = start;
}

static void list_share(Raster& r, int share) {
    int* places = r.counts + (i64)share * tiles_x(r) * tiles_y(r);
    int end = share_start(r.n_drawn, share + 1, r.threads);
    for (int i = share_start(r.n_drawn, share, r.threads); i < end; i++) {
        int g = r.ranks[i];
        for_tiles(r, g, [&](int tile) { r.list[places[tile]++] = g; });
    }
}
