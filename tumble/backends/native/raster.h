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

enum { TILE = 8, RECORD = 32, GEOMETRY = 16, CHANNELS_MAX = 16 };

// Fields of a record; four numbers per feature follow: f = f0 + f1 u + f2 v + f3 u v.
enum {
    CX, CY, KA, KB, KC, BX, BY, KAPPA, CUT, OPACITY, PZ, DZ, RED, GREEN, BLUE, SPARE,
    NX, NY, NZ, EU, UX, UY, EV, VX, VY
};

// Gradients of a Gaussian summed over pixels; those of its fixed channels follow (rgb, normal), then those of the
// features at each of the four corners, all padded to whole vectors.
enum { G_A, G_B, G_C, G_BX, G_BY, G_CX, G_CY, G_KAPPA, G_OPACITY, G_PZ, G_UX, G_UY, G_EU, G_VX, G_VY, G_EV };

struct Raster {
    const float *means, *quats, *scales, *opacity, *sh, *corners, *R, *t, *focal, *mask;
    int n, k, c, height, width, threads;
    float alpha_max, alpha_min, T_min, facing, near, near_sigmas, corner;
    int record_size, gradient_size, fixed_width, corner_width, mask_stride;
    // Workspace. `span`: footprint (centre and second moments). `ranks`: Gaussians by depth without culled ones.
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

enum { SPAN = 5, CAMERA = 16, DIGIT = 2048 };

INLINE int tiles_x(const Raster& r) { return (r.width + TILE - 1) / TILE; }
INLINE int tiles_y(const Raster& r) { return (r.height + TILE - 1) / TILE; }

// Index of the first of n items in share i, in multiples of a vector.
INLINE int share_start(int n, int i, int shares) {
    i64 groups = (n + LANES - 1) / LANES;
    return imin2(n, (int)(groups * i / shares) * LANES);
}
