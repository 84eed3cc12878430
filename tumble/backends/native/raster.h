// Common parts of projection and compositing: the arguments, the packed record of a Gaussian, and its gradient.
//
// A *share* is the part of a computation that one thread does.
//
// With (dx, dy) the offset of a pixel from the projected centre, the quantities at the peak of the pixel's ray are
//     K = a dx^2 + b dx dy + c dy^2,   l = 1 + beta_x dx + beta_y dy,   q = l^2 + kappa K,
//     |W(peak - mu)|^2 = K / q,   zeta = (z-depth of the peak) / (z-depth of the centre) = l / q.
// They are exact in perspective. K is a sum of squares, and zeta - 1 is computed as -(l (l - 1) + kappa K) / q, which
// avoids cancellation in float32 for thin Gaussians. The corner coordinates are
//     u = 1/2 + (zeta - 1) e_u + zeta (u_x dx + u_y dy), and the same for v, clamped to [0, 1].
#pragma once
#include "parallel.h"
#include "simd.h"

// A tile is a block of pixels, one per lane.
constexpr int TILE_W = 4, TILE_H = LANES / TILE_W;
enum { RECORD = 32, SPAN = 16, CAMERA = 16, DIGIT = 2048 };

// Fields of a record; four rows of numbers per feature follow: f = f0 + f1 u + f2 v + f3 u v.
enum {
    CX, CY, KA, KB, KC, BX, BY, KAPPA, CUT, OPACITY, PZ, DZ, RED, GREEN, BLUE, SPARE,
    NX, NY, NZ, EU, UX, UY, EV, VX, VY
};

// Fields of a footprint. Ranges of tiles (integers): first and last column, first and last row. Then centre, half the
// height, and of the ellipse x = slope y +- sqrt(rest (1 - y^2 / y2)): the y of its rightmost point and 1 / y2.
enum { COLUMN, COLUMN_END, ROW, ROW_END, MID_X, MID_Y, HALF_Y, SLOPE, REST, EXTREME, INV_Y2 };

// Sums over pixels, from which the gradients of a Gaussian follow, with v_x the gradient of x in
// `visit_responses`: of v_K dx^2, v_K dx dy, v_K dy^2, v_K dx, v_K dy, v_l, v_l dx, v_l dy, -v_q K, v_rho; of the fixed
// channels; and, with features, of zeta v_u and its products with dx and dy, of (zeta - 1) v_u, and the same for v. The
// gradients of the features at each of the four corners follow, padded to whole vectors.
enum {
    S_A, S_B, S_C, S_KX, S_KY, S_L, S_BX, S_BY, S_KAPPA, S_RHO, S_RGB, S_NORMAL = S_RGB + 3,
    S_U = S_NORMAL + 3, S_UX, S_UY, S_EU, S_V, S_VX, S_VY, S_EV, SUMS
};

struct Raster {
    const float *means, *quats, *scales, *opacity, *sh, *corners, *R, *t, *focal, *mask;
    int n, k, c, height, width, threads;
    float alpha_max, alpha_min, T_min, facing, near, near_sigmas, corner;
    int record_size, gradient_size, corner_start, corner_width, mask_stride;
    // Workspace. `span`: footprints. `ranks`: Gaussians by depth without culled ones. `counts`: of a tile per share; once
    // the image is drawn, how many Gaussians at the beginning of a tile's list contribute to it.
    float *record, *span;
    u32 *keys;
    int *ranks, *ranks_2, *counts, *tile_start, *list;
    int n_drawn, n_pairs;
    // Results.
    float *rgb, *alpha, *depth, *depth_var, *normal, *features, *weight;
    int *touched, *dominant;
    float* weight_parts;
    int* touched_parts;
    // Gradients: of results, per share, of inputs. If v_means is null, only those of the corners are computed.
    const float *v_rgb, *v_alpha, *v_depth, *v_depth_var, *v_normal, *v_features;
    float *parts, *camera_parts;
    float *v_means, *v_quats, *v_scales, *v_opacity, *v_sh, *v_corners, *v_camera;
};

INLINE int tiles_x(const Raster& r) { return (r.width + TILE_W - 1) / TILE_W; }
INLINE int tiles_y(const Raster& r) { return (r.height + TILE_H - 1) / TILE_H; }

// The pixels whose centres lie between two positions along an axis of the image, with a margin against rounding: the first
// and the last one, which is smaller if there is none.
INLINE void pixels_between(vf low, vf high, int size, vi& first, vi& last) {
    low = vmin(vmax(low - 0.02f, vf{}), splat((float)size)), high = vmin(vmax(high + 0.02f, splat(-0.5f)), splat(size - 0.5f));
    first = __builtin_convertvector(low + 0.5f, vi), last = __builtin_convertvector(high + 0.5f, vi) - 1;
}

// Index of the first of n items in share i, in multiples of a vector.
INLINE int share_start(int n, int i, int shares) {
    i64 groups = (n + LANES - 1) / LANES;
    return imin2(n, (int)(groups * i / shares) * LANES);
}
