// Bundle adjustment in double precision: cost, elimination of the points, and the step of the points that follows from
// that of the cameras (`BundleKernel`). Groups share no points, so that every group is one thread's work.
#pragma once
#include "simd.h"

typedef double vd __attribute__((vector_size(4 * LANES)));
typedef double vd_loose __attribute__((vector_size(4 * LANES), aligned(8), may_alias));

// Rows of six numbers are padded to whole vectors.
enum { WIDTH = LANES / 2, VECTORS = (6 + WIDTH - 1) / WIDTH, BUNDLE_ROW = VECTORS * WIDTH, BLOCK = 6 * BUNDLE_ROW, POINT = 12 };

struct Bundle {
    const double *R, *t, *focal, *X, *uv, *weight, *prior, *damping;
    // Observations are sorted by point, and points by group: `point` is the number of each, `first_observation` and
    // `first_point` say where those of a point and of a group begin.
    const i64 *camera, *point, *first_observation, *first_point;
    int n_groups, n_cameras, threads;   // cameras: of a group
    double scale, min_depth, cx, cy;
    double* cost;
    double *U, *g_camera, *E, *e;                                          // of cameras, and what points subtract
    double *focal_camera, *focal_e, *focal_sums;                           // null where the focal length is known
    double *records, *point_records, *scratch;                             // 3 BUNDLE_ROW, POINT, and those of a thread
    const double *d_camera, *d_focal;
    double* d_point;
};

struct Row {
    vd part[VECTORS];
};
INLINE Row load_row(const double* p) {
    Row row;
    for (int i = 0; i < VECTORS; i++) row.part[i] = *(const vd_loose*)(p + i * WIDTH);
    return row;
}
INLINE void store_row(double* p, const Row& row) {
    for (int i = 0; i < VECTORS; i++) *(vd_loose*)(p + i * WIDTH) = row.part[i];
}
INLINE void add_row(double* p, double factor, const Row& row) {
    for (int i = 0; i < VECTORS; i++) *(vd_loose*)(p + i * WIDTH) += factor * row.part[i];
}

// log(1 + x) for x >= 0, relative error 1e-15 (the series of fdlibm).
INLINE double log_1p(double x) {
    double u = 1.0 + x;
    i64 word;
    __builtin_memcpy(&word, &u, 8);
    i64 shifted = word - 0x3fe6a09e667f3bcdll, exponent = shifted >> 52;
    word -= exponent << 52;
    double m, f = x, lost = (x - (u - 1.0)) / u;
    __builtin_memcpy(&m, &word, 8);
    if (exponent) f = m - 1.0;
    else lost = 0;
    double s = f / (2.0 + f), z = s * s, half = 0.5 * f * f;
    double r = 1.818357216161805012e-1 + z * (1.531383769920937332e-1 + z * 1.479819860511658591e-1);
    r = 2.857142874366239149e-1 + z * (2.222219843214978396e-1 + z * r);
    r = z * (6.666666666666735130e-1 + z * (3.999999999940941908e-1 + z * r));
    return exponent * 0.69314718055994530942 + (f - (half - s * (half + r))) + lost;
}

// An observation: its camera, the point in the camera frame and without the translation, and the reprojection error.
struct Seen {
    const double *R, *focal;
    double x[3], arm[3], z, error[2], squared;
};
INLINE Seen see(const Bundle& b, i64 o, const double* X) {
    i64 camera = b.camera[o];
    Seen s;
    s.R = b.R + 9 * camera, s.focal = b.focal + 2 * camera;
    for (int i = 0; i < 3; i++) {
        s.arm[i] = s.R[3 * i] * X[0] + s.R[3 * i + 1] * X[1] + s.R[3 * i + 2] * X[2];
        s.x[i] = s.arm[i] + b.t[3 * camera + i];
    }
    s.z = s.x[2] > b.min_depth ? s.x[2] : b.min_depth;
    s.error[0] = s.x[0] / s.z * s.focal[0] + b.cx - b.uv[2 * o];
    s.error[1] = s.x[1] / s.z * s.focal[1] + b.cy - b.uv[2 * o + 1];
    s.squared = (s.error[0] * s.error[0] + s.error[1] * s.error[1]) / (b.scale * b.scale);
    return s;
}

INLINE void bundle_cost_of(const Bundle& b, int group) {
    double cost = 0;
    for (i64 p = b.first_point[group]; p < b.first_point[group + 1]; p++) {
        const double* X = b.X + 3 * b.point[p];
        for (i64 o = b.first_observation[p]; o < b.first_observation[p + 1]; o++)
            cost += b.weight[o] * b.scale * b.scale * log_1p(see(b, o, X).squared);
        cost += b.prior[group] * (X[0] * X[0] + X[1] * X[1] + X[2] * X[2]);
    }
    b.cost[group] = cost;
}

// Sums over the observations of a point: its block, gradient, and entries coupled with the focal length.
struct BundleSums {
    double V[6], g[3], f[3];
};

// Adds an observation to the blocks of its camera `c` of the group and of its point, and stores the block of both.
INLINE void linearise(const Bundle& b, i64 o, const double* X, double* U, double* g, double* f, double* sums,
                      BundleSums& point) {
    Seen s = see(b, o, X);
    double w = b.weight[o] / (1.0 + s.squared), J[2][BUNDLE_ROW] = {}, P[2][3], F[2];
    for (int k = 0; k < 2; k++) {
        double dx = s.focal[k] / s.z, dz = -s.focal[k] * s.x[k] / (s.z * s.z), d[3] = {k ? 0 : dx, k ? dx : 0, dz};
        J[k][0] = s.arm[1] * d[2] - s.arm[2] * d[1];
        J[k][1] = s.arm[2] * d[0] - s.arm[0] * d[2];
        J[k][2] = s.arm[0] * d[1] - s.arm[1] * d[0];
        for (int i = 0; i < 3; i++) {
            J[k][3 + i] = d[i];
            P[k][i] = d[0] * s.R[i] + d[1] * s.R[3 + i] + d[2] * s.R[6 + i];
        }
        F[k] = s.x[k] / s.z * s.focal[k];
    }
    Row J0 = load_row(J[0]), J1 = load_row(J[1]);
    for (int i = 0; i < 6; i++) add_row(U + i * BUNDLE_ROW, w * J[0][i], J0), add_row(U + i * BUNDLE_ROW, w * J[1][i], J1);
    add_row(g, w * s.error[0], J0), add_row(g, w * s.error[1], J1);
    double* record = b.records + o * 3 * BUNDLE_ROW;
    for (int j = 0; j < 3; j++) {
        double a = w * P[0][j], c = w * P[1][j];
        for (int i = 0; i < VECTORS; i++) *(vd_loose*)(record + j * BUNDLE_ROW + i * WIDTH) = a * J0.part[i] + c * J1.part[i];
        for (int k = 0; k <= j; k++) point.V[j * (j + 1) / 2 + k] += a * P[0][k] + c * P[1][k];
        point.g[j] += a * s.error[0] + c * s.error[1];
        point.f[j] += a * F[0] + c * F[1];
    }
    if (!b.focal_camera) return;
    add_row(f, w * F[0], J0), add_row(f, w * F[1], J1);
    sums[0] += w * (F[0] * F[0] + F[1] * F[1]), sums[1] += w * (F[0] * s.error[0] + F[1] * s.error[1]);
}

// Solves C x = y for the Cholesky factor C of a point's block (by rows: c00, c10, c11, c20, c21, c22).
INLINE void forward_solve(const double* C, double* y) {
    y[0] /= C[0], y[1] = (y[1] - C[1] * y[0]) / C[2], y[2] = (y[2] - C[3] * y[0] - C[4] * y[1]) / C[5];
}

// Cholesky factor of the damped block of a point, and its transformed gradients, in the record of the point.
INLINE double* factorise(const Bundle& b, i64 p, double damping, BundleSums& s) {
    double *C = b.point_records + p * POINT, *V = s.V;
    for (int i = 0; i < 3; i++) V[i * (i + 3) / 2] += damping * V[i * (i + 3) / 2] + 1e-9;
    C[0] = __builtin_sqrt(V[0]), C[1] = V[1] / C[0], C[3] = V[3] / C[0];
    C[2] = __builtin_sqrt(V[2] - C[1] * C[1]), C[4] = (V[4] - C[3] * C[1]) / C[2];
    C[5] = __builtin_sqrt(V[5] - C[3] * C[3] - C[4] * C[4]);
    forward_solve(C, s.g), forward_solve(C, s.f);
    for (int i = 0; i < 3; i++) C[6 + i] = s.g[i], C[9 + i] = s.f[i];
    return C;
}

// The block of pose and point of an observation times the inverse transposed factor, in place.
INLINE void transform(double* record, const double* C) {
    Row a = load_row(record), c = load_row(record + BUNDLE_ROW), d = load_row(record + 2 * BUNDLE_ROW);
    for (int i = 0; i < VECTORS; i++) {
        a.part[i] /= C[0];
        c.part[i] = (c.part[i] - C[1] * a.part[i]) / C[2];
        d.part[i] = (d.part[i] - C[3] * a.part[i] - C[4] * c.part[i]) / C[5];
    }
    store_row(record, a), store_row(record + BUNDLE_ROW, c), store_row(record + 2 * BUNDLE_ROW, d);
}

// Adds the product of two transformed blocks to a block of the cameras.
INLINE void add_product(double* block, const double* x, const double* y) {
    Row y0 = load_row(y), y1 = load_row(y + BUNDLE_ROW), y2 = load_row(y + 2 * BUNDLE_ROW);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < VECTORS; k++) {
            vd_loose* at = (vd_loose*)(block + i * BUNDLE_ROW + k * WIDTH);
            *at = *at + x[i] * y0.part[k] + x[BUNDLE_ROW + i] * y1.part[k] + x[2 * BUNDLE_ROW + i] * y2.part[k];
        }
}

// Subtracted by a point from the normal equations of the cameras; only blocks on and above the diagonal are summed.
INLINE void eliminate(const Bundle& b, i64 p, int group, const double* C, double* E, double* e, double* focal_e) {
    i64 begin = b.first_observation[p], end = b.first_observation[p + 1], first = (i64)group * b.n_cameras;
    for (i64 o = begin; o < end; o++) {
        double* own = b.records + o * 3 * BUNDLE_ROW;
        transform(own, C);
        i64 camera = b.camera[o] - first;
        for (int j = 0; j < 3; j++) {
            add_row(e + camera * BUNDLE_ROW, C[6 + j], load_row(own + j * BUNDLE_ROW));
            if (b.focal_camera) add_row(focal_e + camera * BUNDLE_ROW, C[9 + j], load_row(own + j * BUNDLE_ROW));
        }
        add_product(E + (camera * b.n_cameras + camera) * BLOCK, own, own);
        for (i64 q = begin; q < o; q++) {
            const double* other = b.records + q * 3 * BUNDLE_ROW;
            i64 second = b.camera[q] - first;
            if (second >= camera) add_product(E + (camera * b.n_cameras + second) * BLOCK, own, other);
            if (second <= camera) add_product(E + (second * b.n_cameras + camera) * BLOCK, other, own);
        }
    }
}

// Writes the padded sums of a group without the padding, and the blocks below the diagonal.
INLINE void unpad(const Bundle& b, int group, const double* E, const double* rows) {
    int n = b.n_cameras, side = 6 * n;
    i64 first = (i64)group * n;
    for (int c = 0; c < n; c++)
        for (int i = 0; i < 6; i++) {
            i64 at = (first + c) * 6 + i;
            const double* row = rows + c * BLOCK + i * BUNDLE_ROW;
            for (int k = 0; k < 6; k++) b.U[at * 6 + k] = row[k];
            const double* vectors = rows + n * BLOCK + c * BUNDLE_ROW + i;
            b.g_camera[at] = vectors[0], b.e[at] = vectors[n * BUNDLE_ROW];
            if (b.focal_camera) b.focal_camera[at] = vectors[2 * n * BUNDLE_ROW], b.focal_e[at] = vectors[3 * n * BUNDLE_ROW];
        }
    double* out = b.E + (i64)group * side * side;
    for (int c = 0; c < n; c++)
        for (int d = c; d < n; d++)
            for (int i = 0; i < 6; i++)
                for (int k = 0; k < 6; k++) {
                    double value = E[(c * n + d) * BLOCK + i * BUNDLE_ROW + k];
                    out[(6 * c + i) * (i64)side + 6 * d + k] = value, out[(6 * d + k) * (i64)side + 6 * c + i] = value;
                }
}

// Normal equations of the cameras of a group after the elimination of its points.
INLINE void reduce_group(const Bundle& b, int group, double* E) {
    i64 n = b.n_cameras, first = group * n;
    double *U = E + n * n * BLOCK, *g = U + n * BLOCK, *e = g + n * BUNDLE_ROW, *f = e + n * BUNDLE_ROW, *focal_e = f + n * BUNDLE_ROW;
    clear(E, 8 * ((n * n + n) * BLOCK + 4 * n * BUNDLE_ROW));
    double sums[4] = {};   // of the focal length: block, gradient, and what points subtract from both
    for (i64 p = b.first_point[group]; p < b.first_point[group + 1]; p++) {
        double prior = b.prior[group];
        const double* X = b.X + 3 * b.point[p];
        BundleSums s = {{prior, 0, prior, 0, 0, prior}, {}, {}};
        for (int i = 0; i < 3; i++) s.g[i] = s.f[i] = prior * X[i];
        sums[0] += prior * (X[0] * X[0] + X[1] * X[1] + X[2] * X[2]);
        sums[1] += prior * (X[0] * X[0] + X[1] * X[1] + X[2] * X[2]);
        for (i64 o = b.first_observation[p]; o < b.first_observation[p + 1]; o++) {
            i64 c = b.camera[o] - first;
            linearise(b, o, X, U + c * BLOCK, g + c * BUNDLE_ROW, f + c * BUNDLE_ROW, sums, s);
        }
        double* C = factorise(b, p, b.damping[group], s);
        eliminate(b, p, group, C, E, e, focal_e);
        for (int i = 0; i < 3; i++) sums[2] += s.f[i] * s.f[i], sums[3] += s.f[i] * s.g[i];
    }
    for (int i = 0; i < 4 && b.focal_camera; i++) b.focal_sums[4 * group + i] = sums[i];
    unpad(b, group, E, U);
}

INLINE void move_points(const Bundle& b, int group) {
    for (i64 p = b.first_point[group]; p < b.first_point[group + 1]; p++) {
        const double* C = b.point_records + p * POINT;
        double y[3];
        for (int i = 0; i < 3; i++) y[i] = C[6 + i] + (b.d_focal ? b.d_focal[group] * C[9 + i] : 0);
        for (i64 o = b.first_observation[p]; o < b.first_observation[p + 1]; o++)
            for (int j = 0; j < 3; j++)
                for (int i = 0; i < 6; i++)
                    y[j] += b.records[(o * 3 + j) * BUNDLE_ROW + i] * b.d_camera[6 * b.camera[o] + i];
        double z = y[2] / C[5], x = (y[1] - C[4] * z) / C[2];
        double* out = b.d_point + 3 * b.point[p];
        out[0] = -(y[0] - C[1] * x - C[3] * z) / C[0], out[1] = -x, out[2] = -z;
    }
}

template <class F>
INLINE void for_groups(const Bundle& b, int share, F f) {
    for (i64 g = (i64)b.n_groups * share / b.threads; g < (i64)b.n_groups * (share + 1) / b.threads; g++) f((int)g);
}
static void bundle_cost_share(const Bundle& b, int share) {
    for_groups(b, share, [&](int group) { bundle_cost_of(b, group); });
}
static void bundle_reduce_share(const Bundle& b, int share) {
    i64 n = b.n_cameras;
    double* scratch = b.scratch + share * ((n * n + n) * BLOCK + 4 * n * BUNDLE_ROW);
    for_groups(b, share, [&](int group) { reduce_group(b, group, scratch); });
}
static void bundle_move_share(const Bundle& b, int share) {
    for_groups(b, share, [&](int group) { move_points(b, group); });
}
