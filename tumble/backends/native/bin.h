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

// Calls visit(tile) for every tile of which a pixel centre is in a Gaussian's footprint, and for few others: for all tiles
// of its bounding box if that is two tiles wide or high, else in each row for those between the leftmost and rightmost
// points of the ellipse's part within the row. These are the extreme points of the ellipse, or else its intersections
// with the border of the row.
template <class F>
INLINE void for_tiles(const Raster& r, int g, F visit) {
    const float* s = r.span + (i64)g * SPAN;
    const int* range = (const int*)s;
    int across = tiles_x(r);
    if (range[COLUMN_END] - range[COLUMN] < 2 || range[ROW_END] - range[ROW] < 2) {
        for (int row = range[ROW]; row <= range[ROW_END]; row++)
            for (int column = range[COLUMN]; column <= range[COLUMN_END]; column++) visit(row * across + column);
        return;
    }
    for (int first = range[ROW]; first <= range[ROW_END]; first += LANES) {
        // Pixel centres of the rows, relative to the centre of the footprint.
        vf y = __builtin_convertvector((lane_index() + first) * TILE_H, vf) + (0.5f - s[MID_Y]), half = splat(s[HALF_Y]);
        vf top = vmax(y - 0.02f, -half), bottom = vmin(y + (TILE_H - 0.98f), half);
        vf e_r = vmin(vmax(splat(s[EXTREME]), top), bottom), e_l = vmin(vmax(splat(-s[EXTREME]), top), bottom);
        vf right = s[SLOPE] * e_r + vsqrt(s[REST] * vmax(1.0f - e_r * e_r * s[INV_Y2], vf{}));
        vf left = s[SLOPE] * e_l - vsqrt(s[REST] * vmax(1.0f - e_l * e_l * s[INV_Y2], vf{}));
        vi from, to;
        pixels_between(s[MID_X] + left, s[MID_X] + right, r.width, from, to);
        to = (top <= bottom) & (from <= to) ? to / TILE_W : vi{} - 1;
        from /= TILE_W;
        for (int row = first; row <= imin2(range[ROW_END], first + LANES - 1); row++)
            for (int column = from[row - first]; column <= to[row - first]; column++) visit(row * across + column);
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
