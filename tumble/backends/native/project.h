// Projection of Gaussians to the screen, LANES at a time, and its adjoint. Formulas in raster.h.
#pragma once
#include "raster.h"

struct V3 {
    vf x, y, z;
};
INLINE V3 operator+(V3 a, V3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE V3 operator*(V3 a, vf s) { return {a.x * s, a.y * s, a.z * s}; }
INLINE V3 operator*(V3 a, V3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
INLINE vf dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE V3 cross(V3 a, V3 b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

struct V2 {
    vf x, y;
};
INLINE V2 operator+(V2 a, V2 b) { return {a.x + b.x, a.y + b.y}; }
INLINE V2 operator*(V2 a, vf s) { return {a.x * s, a.y * s}; }
INLINE vf dot(V2 a, V2 b) { return a.x * b.x + a.y * b.y; }
INLINE vf cross(V2 a, V2 b) { return a.x * b.y - a.y * b.x; }

// Row-major 3x3 matrices, one per lane.
struct M3 {
    vf m[9];
    METHOD vf operator()(int i, int j) const { return m[3 * i + j]; }
};
INLINE V3 mul(const M3& A, V3 b) {
    return {A(0, 0) * b.x + A(0, 1) * b.y + A(0, 2) * b.z, A(1, 0) * b.x + A(1, 1) * b.y + A(1, 2) * b.z,
            A(2, 0) * b.x + A(2, 1) * b.y + A(2, 2) * b.z};
}
INLINE V3 mul_T(const M3& A, V3 b) {
    return {A(0, 0) * b.x + A(1, 0) * b.y + A(2, 0) * b.z, A(0, 1) * b.x + A(1, 1) * b.y + A(2, 1) * b.z,
            A(0, 2) * b.x + A(1, 2) * b.y + A(2, 2) * b.z};
}
INLINE V3 row(const M3& A, int i) { return {A(i, 0), A(i, 1), A(i, 2)}; }

// The N numbers of each of the Gaussians [first, first + count) of an [n N] array; further lanes repeat the last Gaussian.
template <int N>
INLINE void gather(const float* p, int first, int count, vf* x) {
    if (N <= 4 && count == LANES) return columns_of<N>(p + (i64)N * first, x);
    float rows[LANES * (N + 1)];
    for (int i = 0; i < LANES; i++) __builtin_memcpy(rows + N * i, p + (i64)N * (first + imin2(i, count - 1)), 4 * N);
    columns_of<N>(rows, x);
}
template <int N>
INLINE void scatter(float* p, int first, int count, const vf* x) {
    if (count == LANES) return rows_of<N>(p + (i64)N * first, x);
    float rows[LANES * N];
    rows_of<N>(rows, x);
    __builtin_memcpy(p + (i64)N * first, rows, 4 * N * count);
}
// The same for number j of an [n stride] array.
INLINE vf gather(const float* p, int stride, int j, int first, int count) {
    float x[LANES];
    for (int i = 0; i < LANES; i++) x[i] = p[(i64)(first + imin2(i, count - 1)) * stride + j];
    return load(x);
}
INLINE void scatter(float* p, int stride, int j, int first, int count, vf value) {
    float x[LANES];
    store(x, value);
    for (int i = 0; i < count; i++) p[(i64)(first + i) * stride + j] = x[i];
}
INLINE vf gather1(const float* p, int first, int count) {
    vf x;
    gather<1>(p, first, count, &x);
    return x;
}
INLINE V3 gather3(const float* p, int first, int count) {
    vf x[3];
    gather<3>(p, first, count, x);
    return {x[0], x[1], x[2]};
}
INLINE void scatter1(float* p, int first, int count, vf x) { scatter<1>(p, first, count, &x); }
INLINE void scatter3(float* p, int first, int count, V3 v) {
    const vf x[3] = {v.x, v.y, v.z};
    scatter<3>(p, first, count, x);
}

// Up to LANES Gaussians with their indices; further lanes repeat the last one.
struct Batch {
    int g[LANES], count;
    METHOD bool add(int which) {
        g[count++] = which;
        return count == LANES;
    }
    METHOD void pad() {
        for (int i = count; i < LANES; i++) g[i] = g[count - 1];
    }
};
// N consecutive numbers of each Gaussian of a batch, in an array with `stride` numbers per Gaussian.
template <int N>
INLINE void gather(const float* p, int stride, const Batch& b, vf* x) {
    float rows[LANES * (N + 1)];
    for (int i = 0; i < LANES; i++) __builtin_memcpy(rows + N * i, p + (i64)b.g[i] * stride, 4 * N);
    columns_of<N>(rows, x);
}
template <int N>
INLINE void scatter(float* p, int stride, const Batch& b, const vf* x) {
    float rows[LANES * N];
    rows_of<N>(rows, x);
    for (int i = 0; i < b.count; i++) __builtin_memcpy(p + (i64)b.g[i] * stride, rows + N * i, 4 * N);
}
INLINE V3 gather3(const float* p, const Batch& b) {
    vf x[3];
    gather<3>(p, 3, b, x);
    return {x[0], x[1], x[2]};
}
INLINE void scatter3(float* p, const Batch& b, V3 v) {
    const vf x[3] = {v.x, v.y, v.z};
    scatter<3>(p, 3, b, x);
}

struct Camera {
    M3 R;
    V3 t;
    vf fx, fy, cx, cy;
};
INLINE Camera camera_of(const Raster& r) {
    Camera c;
    for (int i = 0; i < 9; i++) c.R.m[i] = splat(r.R[i]);
    c.t = {splat(r.t[0]), splat(r.t[1]), splat(r.t[2])};
    c.fx = splat(r.focal[0]), c.fy = splat(r.focal[1]), c.cx = splat(r.focal[2]), c.cy = splat(r.focal[3]);
    return c;
}

INLINE M3 rotation(const vf* q) {
    vf w = q[0], x = q[1], y = q[2], z = q[3];
    return {{1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y),
             2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x),
             2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y)}};
}
INLINE void rotation_adjoint(const vf* q, const M3& g, vf* v) {
    vf w = q[0], x = q[1], y = q[2], z = q[3];
    v[0] = 2.0f * (x * (g(2, 1) - g(1, 2)) + y * (g(0, 2) - g(2, 0)) + z * (g(1, 0) - g(0, 1)));
    v[1] = 2.0f * (y * (g(0, 1) + g(1, 0)) + z * (g(0, 2) + g(2, 0)) + w * (g(2, 1) - g(1, 2))) -
           4.0f * x * (g(1, 1) + g(2, 2));
    v[2] = 2.0f * (x * (g(0, 1) + g(1, 0)) + z * (g(1, 2) + g(2, 1)) + w * (g(0, 2) - g(2, 0))) -
           4.0f * y * (g(0, 0) + g(2, 2));
    v[3] = 2.0f * (x * (g(0, 2) + g(2, 0)) + y * (g(1, 2) + g(2, 1)) + w * (g(1, 0) - g(0, 1))) -
           4.0f * z * (g(0, 0) + g(1, 1));
}

// Real spherical harmonics with the signs of 3D Gaussian splatting, and the gradient of sum_i v_i Y_i in (x, y, z).
INLINE void harmonics(int k, V3 d, vf* Y) {
    vf x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    Y[0] = splat(0.28209479177f);
    if (k < 4) return;
    Y[1] = -0.48860251190f * y, Y[2] = 0.48860251190f * z, Y[3] = -0.48860251190f * x;
    if (k < 9) return;
    Y[4] = 1.09254843059f * x * y, Y[5] = -1.09254843059f * y * z;
    Y[6] = 0.31539156525f * (2.0f * zz - xx - yy);
    Y[7] = -1.09254843059f * x * z, Y[8] = 0.54627421530f * (xx - yy);
    if (k < 16) return;
    Y[9] = -0.59004358993f * y * (3.0f * xx - yy), Y[10] = 2.89061144264f * x * y * z;
    Y[11] = -0.45704579946f * y * (4.0f * zz - xx - yy);
    Y[12] = 0.37317633259f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
    Y[13] = -0.45704579946f * x * (4.0f * zz - xx - yy), Y[14] = 1.44530572132f * z * (xx - yy);
    Y[15] = -0.59004358993f * x * (xx - 3.0f * yy);
}
INLINE V3 harmonics_adjoint(int k, V3 d, const vf* v) {
    vf x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    V3 g = {};
    if (k < 4) return g;
    g = {-0.48860251190f * v[3], -0.48860251190f * v[1], 0.48860251190f * v[2]};
    if (k < 9) return g;
    vf a = 1.09254843059f * v[4], b = -1.09254843059f * v[5], c = 0.63078313050f * v[6],
       e = -1.09254843059f * v[7], f = 1.09254843060f * v[8];
    g = g + V3{a * y - c * x + e * z + f * x, a * x + b * z - c * y - f * y, b * y + 2.0f * c * z + e * x};
    if (k < 16) return g;
    vf h = -0.59004358993f * v[9], i = 2.89061144264f * v[10], j = -0.45704579946f * v[11],
       l = 0.37317633259f * v[12], m = -0.45704579946f * v[13], o = 1.44530572132f * v[14],
       p = -0.59004358993f * v[15];
    vf s = 4.0f * zz - xx - yy;
    return g + V3{h * 6.0f * x * y + i * y * z - j * 2.0f * x * y - l * 6.0f * x * z + m * (s - 2.0f * xx) +
                      o * 2.0f * x * z + p * 3.0f * (xx - yy),
                  h * 3.0f * (xx - yy) + i * x * z + j * (s - 2.0f * yy) - l * 6.0f * y * z - m * 2.0f * x * y -
                      o * 2.0f * y * z - p * 6.0f * x * y,
                  i * x * y + j * 8.0f * y * z + l * (6.0f * zz - 3.0f * xx - 3.0f * yy) + m * 8.0f * x * z +
                      o * (xx - yy)};
}

// Intermediate values of the projection, which the adjoint needs again.
struct Projected {
    vf q[4], q_scale;        // unit quaternion, 1 / length of the given one
    M3 R_obj_local, M;       // M: local to camera
    V3 mu, mu_cam, p, s, inv_s;   // mu_cam = R mu, p = mu_cam + t
    // Whitened centre P and pixel steps E: the first two components. The third is represented by n = normal.p,
    // e = step / centre and tau = (s_3 / n)^2, so that the thickness enters through tau alone, without cancellation.
    V2 P, E1, E2;
    vf n, e1, e2, tau;
    // F = E - e P, g = P x E, w = P.E, h = 1 / (1 + tau P.P), S = F.F + tau g g.
    V2 F1, F2;
    vf g1, g2, w1, w2, PP, h, S11, S12, S22, inv_n, inv_z;
    V3 dir_p, dir;           // object-frame direction, before and after normalisation
    vf dir_scale;
    vf Y[16], raw[3];        // colour before the clamp
    vf opacity;
};

INLINE Projected project(const Raster& r, const Camera& cam, const Batch& b) {
    Projected o;
    gather<4>(r.quats, 4, b, o.q);
    o.q_scale = 1.0f / vsqrt(o.q[0] * o.q[0] + o.q[1] * o.q[1] + o.q[2] * o.q[2] + o.q[3] * o.q[3]);
    for (int j = 0; j < 4; j++) o.q[j] *= o.q_scale;
    o.R_obj_local = rotation(o.q);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            o.M.m[3 * i + j] = cam.R(i, 0) * o.R_obj_local(0, j) + cam.R(i, 1) * o.R_obj_local(1, j) +
                               cam.R(i, 2) * o.R_obj_local(2, j);
    o.mu = gather3(r.means, b);
    o.s = gather3(r.scales, b);
    o.inv_s = {1.0f / o.s.x, 1.0f / o.s.y, 1.0f / o.s.z};
    gather<1>(r.opacity, 1, b, &o.opacity);
    o.mu_cam = mul(cam.R, o.mu);
    o.p = o.mu_cam + cam.t;
    o.inv_z = 1.0f / o.p.z;
    V3 P = mul_T(o.M, o.p);
    vf inv_fx = 1.0f / cam.fx, inv_fy = 1.0f / cam.fy;
    o.P = {P.x * o.inv_s.x, P.y * o.inv_s.y};
    o.E1 = {o.M(0, 0) * o.inv_s.x * inv_fx, o.M(0, 1) * o.inv_s.y * inv_fx};
    o.E2 = {o.M(1, 0) * o.inv_s.x * inv_fy, o.M(1, 1) * o.inv_s.y * inv_fy};
    o.n = P.z, o.inv_n = 1.0f / o.n;
    o.e1 = o.M(0, 2) * inv_fx * o.inv_n, o.e2 = o.M(1, 2) * inv_fy * o.inv_n;
    o.tau = o.s.z * o.inv_n * (o.s.z * o.inv_n);
    o.F1 = o.E1 + o.P * -o.e1, o.F2 = o.E2 + o.P * -o.e2;
    o.g1 = cross(o.P, o.E1), o.g2 = cross(o.P, o.E2), o.w1 = dot(o.P, o.E1), o.w2 = dot(o.P, o.E2);
    o.PP = dot(o.P, o.P), o.h = 1.0f / (1.0f + o.tau * o.PP);
    o.S11 = dot(o.F1, o.F1) + o.tau * o.g1 * o.g1, o.S22 = dot(o.F2, o.F2) + o.tau * o.g2 * o.g2;
    o.S12 = dot(o.F1, o.F2) + o.tau * o.g1 * o.g2;
    o.dir_p = mul_T(cam.R, o.p);
    o.dir_scale = 1.0f / vsqrt(dot(o.dir_p, o.dir_p));
    o.dir = o.dir_p * o.dir_scale;
    harmonics(r.k, o.dir, o.Y);
    o.raw[0] = o.raw[1] = o.raw[2] = vf{};
    for (int j = 0; j < r.k; j++) {
        vf sh[3];
        gather<3>(r.sh + 3 * j, 3 * r.k, b, sh);
        for (int ch = 0; ch < 3; ch++) o.raw[ch] += o.Y[j] * sh[ch];
    }
    return o;
}

// Which of `count` Gaussians from `first` on may be drawn: most others face away from the camera. The limit is looser than
// in `outline`, which decides.
INLINE u32 facing(const Raster& r, const Camera& cam, int first, int count) {
    vf q[4];
    gather<4>(r.quats, first, count, q);
    vf w = q[0], x = q[1], y = q[2], z = q[3], length2 = w * w + x * x + y * y + z * z;
    V3 n = {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), w * w + z * z - x * x - y * y};
    V3 p = mul(cam.R, gather3(r.means, first, count)) + cam.t;
    vf along = dot(mul(cam.R, n), p), limit = (r.facing + 1e-3f) * vsqrt(dot(p, p)) * length2;
    return bits((along <= limit) & (p.z > r.near) & (gather1(r.opacity, first, count) >= r.alpha_min) &
                (lane_index() < count));
}

// Which lanes are not culled, and the footprint of each: the ellipse on screen inside which alpha can reach alpha_min.
INLINE vi outline(const Raster& r, const Camera& cam, const Projected& o, vf cut, vf* span) {
    V3 X = row(o.M, 0) * o.s, Y = row(o.M, 1) * o.s, Z = row(o.M, 2) * o.s, p = o.p;
    vf zz = dot(Z, Z), xz = dot(X, Z), yz = dot(Y, Z), D = p.z * p.z - cut * zz, inv_D = 1.0f / D;
    V3 x = X * p.z + Z * (-p.x), y = Y * p.z + Z * (-p.y);
    vf scale = cut * inv_D * inv_D;
    vf x2 = cam.fx * cam.fx * scale * (dot(x, x) + cut * (xz * xz - dot(X, X) * zz));
    vf xy = cam.fx * cam.fy * scale * (dot(x, y) + cut * (xz * yz - dot(X, Y) * zz));
    vf y2 = cam.fy * cam.fy * scale * (dot(y, y) + cut * (yz * yz - dot(Y, Y) * zz));
    x2 = vmax(x2, vf{}), y2 = vmax(y2, splat(1e-12f));
    vf half_x = vsqrt(x2), inv_y2 = 1.0f / y2;
    span[MID_X] = cam.cx + cam.fx * (p.x * p.z - cut * xz) * inv_D;
    span[MID_Y] = cam.cy + cam.fy * (p.y * p.z - cut * yz) * inv_D;
    span[HALF_Y] = vsqrt(y2), span[SLOPE] = xy * inv_y2, span[REST] = vmax(x2 - xy * span[SLOPE], vf{});
    span[EXTREME] = keep(half_x > 0.0f, xy / half_x), span[INV_Y2] = inv_y2;
    vi left, right, top, bottom;
    pixels_between(span[MID_X] - half_x, span[MID_X] + half_x, r.width, left, right);
    pixels_between(span[MID_Y] - span[HALF_Y], span[MID_Y] + span[HALF_Y], r.height, top, bottom);
    span[COLUMN] = (vf)(left / TILE_W), span[COLUMN_END] = (vf)(right / TILE_W);
    span[ROW] = (vf)(top / TILE_H), span[ROW_END] = (vf)(bottom / TILE_H);
    V3 n = {o.M(0, 2), o.M(1, 2), o.M(2, 2)};
    return (p.z > r.near) & (p.z > r.near_sigmas * vsqrt(zz)) & (o.opacity >= r.alpha_min) &
           (dot(p, n) <= r.facing * vsqrt(dot(p, p))) & (left <= right) & (top <= bottom);
}

// Writes N numbers per lane to rows of an array, for the lanes of a mask.
template <int N>
INLINE void write_rows(float* to, int stride, const Batch& b, u32 lanes, const vf* x) {
    for (int first = 0; first < N; first += LANES) {
        vf rows[LANES];
        for (int i = 0; i < LANES; i++) rows[i] = x[first + i];
        transpose(rows);
        for (u32 some = lanes; some; some &= some - 1) {
            int i = __builtin_ctz(some);
            store(to + (i64)b.g[i] * stride + first, rows[i]);
        }
    }
}

static void project_batch(Raster& r, const Camera& cam, Batch& b) {
    b.pad();
    Projected o = project(r, cam, b);
    vf cut = 2.0f * vlog(vmax(o.opacity * (1.0f / r.alpha_min), splat(1.0f))) + 1e-4f;
    vf span[SPAN] = {};
    u32 drawn = bits(outline(r, cam, o, cut, span) & (lane_index() < b.count));
    vf uv = splat(1.0f / (2.0f * r.corner)), f[RECORD] = {};
    f[CX] = cam.cx + cam.fx * o.p.x * o.inv_z, f[CY] = cam.cy + cam.fy * o.p.y * o.inv_z;
    vf zh = o.p.z * o.h, zzh = o.p.z * zh;
    f[KA] = zzh * o.S11, f[KB] = 2.0f * zzh * o.S12, f[KC] = zzh * o.S22;
    f[BX] = zh * (o.e1 + o.tau * o.w1), f[BY] = zh * (o.e2 + o.tau * o.w2), f[KAPPA] = o.tau * o.h;
    f[CUT] = cut, f[OPACITY] = o.opacity, f[PZ] = o.p.z, f[DZ] = o.mu_cam.z;
    for (int ch = 0; ch < 3; ch++) f[RED + ch] = vmax(o.raw[ch], vf{});
    for (int i = 0; i < 3; i++) f[NX + i] = o.R_obj_local(i, 2);
    f[EU] = uv * o.P.x, f[UX] = uv * o.p.z * o.E1.x, f[UY] = uv * o.p.z * o.E2.x;
    f[EV] = uv * o.P.y, f[VX] = uv * o.p.z * o.E1.y, f[VY] = uv * o.p.z * o.E2.y;
    write_rows<RECORD>(r.record, r.record_size, b, drawn, f), write_rows<SPAN>(r.span, SPAN, b, drawn, span);
    for (; drawn; drawn &= drawn - 1) {
        int g = b.g[__builtin_ctz(drawn)], width = (r.record_size - RECORD) / 4;
        float* record = r.record + (i64)g * r.record_size;
        __builtin_memcpy(&r.keys[g], &record[PZ], 4);
        const float* f4 = r.corners + (i64)g * 4 * r.c;
        float* out = record + RECORD;
        for (int ch = 0; ch < r.c; ch++) {
            float f00 = f4[ch], f10 = f4[r.c + ch], f01 = f4[2 * r.c + ch];
            out[ch] = f00, out[width + ch] = f10 - f00, out[2 * width + ch] = f01 - f00;
            out[3 * width + ch] = f4[3 * r.c + ch] - f10 - f01 + f00;
        }
        for (int ch = r.c; ch < width; ch++) out[ch] = out[width + ch] = out[2 * width + ch] = out[3 * width + ch] = 0;
    }
    b.count = 0;
}

static void project_share(Raster& r, int share) {
    Camera cam = camera_of(r);
    Batch b;
    b.count = 0;
    int end = share_start(r.n, share + 1, r.threads);
    for (int first = share_start(r.n, share, r.threads); first < end; first += LANES) {
        int count = imin2(LANES, end - first);
        for (int i = 0; i < count; i++) r.keys[first + i] = ~0u;
        for (u32 some = facing(r, cam, first, count); some; some &= some - 1)
            if (b.add(first + __builtin_ctz(some))) project_batch(r, cam, b);
    }
    if (b.count) project_batch(r, cam, b);
}

// Gradients of the inputs from sums over pixels, per lane. The gradient of the camera is accumulated in `camera`: R (9),
// t (3), focal lengths and principal point (4).
INLINE void project_adjoint(const Raster& r, const Camera& cam, const Projected& o, const vf* g, const Batch& b, vf* camera) {
    vi drawn = lane_index() < b.count;
    vf z = o.p.z, iz = o.inv_z, uv = splat(1.0f / (2.0f * r.corner)), zh = z * o.h, zzh = z * zh;
    // Conic, slant and kappa.
    vf v_S11 = zzh * g[S_A], v_S12 = 2.0f * zzh * g[S_B], v_S22 = zzh * g[S_C], v_kappa = -g[S_KAPPA];
    vf m1 = o.e1 + o.tau * o.w1, m2 = o.e2 + o.tau * o.w2;
    vf h_v_h = v_S11 * o.S11 + v_S12 * o.S12 + v_S22 * o.S22 + zh * (g[S_BX] * m1 + g[S_BY] * m2) +
               o.tau * o.h * v_kappa;   // h dL/dh
    vf v_w1 = zh * o.tau * g[S_BX], v_w2 = zh * o.tau * g[S_BY];
    vf v_tau = v_S11 * o.g1 * o.g1 + v_S12 * o.g1 * o.g2 + v_S22 * o.g2 * o.g2 +
               zh * (g[S_BX] * o.w1 + g[S_BY] * o.w2) + o.h * v_kappa - o.PP * o.h * h_v_h;
    V2 v_F1 = o.F1 * (2.0f * v_S11) + o.F2 * v_S12, v_F2 = o.F2 * (2.0f * v_S22) + o.F1 * v_S12;
    vf v_g1 = o.tau * (2.0f * v_S11 * o.g1 + v_S12 * o.g2), v_g2 = o.tau * (2.0f * v_S22 * o.g2 + v_S12 * o.g1);
    vf v_e1 = zh * g[S_BX] - dot(v_F1, o.P), v_e2 = zh * g[S_BY] - dot(v_F2, o.P);
    V2 v_E1 = v_F1 + o.P * v_w1 + V2{-o.P.y, o.P.x} * v_g1, v_E2 = v_F2 + o.P * v_w2 + V2{-o.P.y, o.P.x} * v_g2;
    V2 v_P = v_F1 * -o.e1 + v_F2 * -o.e2 + o.E1 * v_w1 + o.E2 * v_w2 + V2{o.E1.y, -o.E1.x} * v_g1 +
             V2{o.E2.y, -o.E2.x} * v_g2 + o.P * (-2.0f * o.tau * o.h * h_v_h);
    // Corner coordinates.
    vf zuv = z * uv;
    v_P.x += uv * g[S_EU], v_P.y += uv * g[S_EV];
    v_E1.x += zuv * g[S_UX], v_E2.x += zuv * g[S_UY], v_E1.y += zuv * g[S_VX], v_E2.y += zuv * g[S_VY];
    // Projected centre. Because v_l l + 2 v_K K = -v_zeta zeta in every pixel, the depth z of the centre has this gradient.
    vf v_z = -iz * (g[S_L] + uv * (o.P.x * g[S_U] + o.P.y * g[S_V]));
    vf v_cx = -2.0f * zzh * (o.S11 * g[S_KX] + o.S12 * g[S_KY]) - zh * m1 * g[S_L] - zuv * (o.E1.x * g[S_U] + o.E1.y * g[S_V]);
    vf v_cy = -2.0f * zzh * (o.S12 * g[S_KX] + o.S22 * g[S_KY]) - zh * m2 * g[S_L] - zuv * (o.E2.x * g[S_U] + o.E2.y * g[S_V]);
    V3 v_p = {v_cx * cam.fx * iz, v_cy * cam.fy * iz, v_z};
    v_p.z -= iz * (v_p.x * o.p.x + v_p.y * o.p.y);
    vf inv_fx = 1.0f / cam.fx, inv_fy = 1.0f / cam.fy;
    camera[12] += keep(drawn, v_cx * o.p.x * iz - (dot(o.E1, v_E1) + o.e1 * v_e1) * inv_fx);
    camera[13] += keep(drawn, v_cy * o.p.y * iz - (dot(o.E2, v_E2) + o.e2 * v_e2) * inv_fy);
    camera[14] += keep(drawn, v_cx), camera[15] += keep(drawn, v_cy);
    // Whitening.
    V3 v_s = {-o.inv_s.x * (o.P.x * v_P.x + o.E1.x * v_E1.x + o.E2.x * v_E2.x),
              -o.inv_s.y * (o.P.y * v_P.y + o.E1.y * v_E1.y + o.E2.y * v_E2.y),
              2.0f * v_tau * o.s.z * o.inv_n * o.inv_n};
    vf v_n = -o.inv_n * (v_e1 * o.e1 + v_e2 * o.e2 + 2.0f * v_tau * o.tau);
    V3 w = {v_P.x * o.inv_s.x, v_P.y * o.inv_s.y, v_n};
    V3 w1 = V3{v_E1.x * o.inv_s.x, v_E1.y * o.inv_s.y, v_e1 * o.inv_n} * inv_fx;
    V3 w2 = V3{v_E2.x * o.inv_s.x, v_E2.y * o.inv_s.y, v_e2 * o.inv_n} * inv_fy;
    v_p = v_p + mul(o.M, w);
    M3 v_M = {{o.p.x * w.x + w1.x, o.p.x * w.y + w1.y, o.p.x * w.z + w1.z, o.p.y * w.x + w2.x,
               o.p.y * w.y + w2.y, o.p.y * w.z + w2.z, o.p.z * w.x, o.p.z * w.y, o.p.z * w.z}};
    // Colour.
    vf v_raw[3], v_Y[16];
    for (int ch = 0; ch < 3; ch++) v_raw[ch] = keep(o.raw[ch] >= 0.0f, g[S_RGB + ch]);
    for (int j = 0; j < r.k; j++) {
        vf sh[3], v_sh[3];
        gather<3>(r.sh + 3 * j, 3 * r.k, b, sh);
        v_Y[j] = v_raw[0] * sh[0] + v_raw[1] * sh[1] + v_raw[2] * sh[2];
        for (int ch = 0; ch < 3; ch++) v_sh[ch] = v_raw[ch] * o.Y[j];
        scatter<3>(r.v_sh + 3 * j, 3 * r.k, b, v_sh);
    }
    V3 v_dir = harmonics_adjoint(r.k, o.dir, v_Y);
    v_dir = (v_dir + o.dir * (-dot(v_dir, o.dir))) * o.dir_scale;
    v_p = v_p + mul(cam.R, v_dir);
    // Pose and rotation.
    M3 v_Rq;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            v_Rq.m[3 * i + j] = cam.R(0, i) * v_M(0, j) + cam.R(1, i) * v_M(1, j) + cam.R(2, i) * v_M(2, j);
    for (int i = 0; i < 3; i++) v_Rq.m[3 * i + 2] += g[S_NORMAL + i];
    vf vp[3] = {v_p.x, v_p.y, v_p.z}, pc[3] = {o.p.x, o.p.y, o.p.z}, vd[3] = {v_dir.x, v_dir.y, v_dir.z},
       mu[3] = {o.mu.x, o.mu.y, o.mu.z};
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            camera[3 * i + j] +=
                keep(drawn, v_M(i, 0) * o.R_obj_local(j, 0) + v_M(i, 1) * o.R_obj_local(j, 1) +
                                v_M(i, 2) * o.R_obj_local(j, 2) + vp[i] * mu[j] + pc[i] * vd[j]);
        camera[9 + i] += keep(drawn, vp[i]);
    }
    vf v_q[4];
    rotation_adjoint(o.q, v_Rq, v_q);
    vf radial = v_q[0] * o.q[0] + v_q[1] * o.q[1] + v_q[2] * o.q[2] + v_q[3] * o.q[3];
    for (int j = 0; j < 4; j++) v_q[j] = (v_q[j] - radial * o.q[j]) * o.q_scale;
    vf v_opacity = -2.0f * g[S_RHO] / o.opacity;
    scatter<4>(r.v_quats, 4, b, v_q), scatter<1>(r.v_opacity, 1, b, &v_opacity);
    scatter3(r.v_means, b, mul_T(cam.R, v_p)), scatter3(r.v_scales, b, v_s);
}

// Gradients of a batch from the sums over pixels of all shares.
static void project_adjoint_batch(Raster& r, const Camera& cam, Batch& b, vf* camera) {
    b.pad();
    for (int i = 0; i < b.count; i++) {
        int g = b.g[i], size = r.gradient_size;
        float *total = r.parts + (i64)g * size, *v_corners = r.v_corners + (i64)g * 4 * r.c;
        for (int part = 1; part < r.threads; part++) {
            const float* more = r.parts + ((i64)part * r.n + g) * size;
            for (int j = 0; j < size; j += LANES) store(total + j, load(total + j) + load(more + j));
        }
        const float* corner = total + r.corner_start;
        for (int k = 0; k < 4; k++, corner += r.corner_width)
            for (int ch = 0; ch < r.c; ch++) v_corners[k * r.c + ch] = corner[ch];
    }
    if (r.v_means) {
        vf g[SUMS + LANES] = {};
        for (int first = 0; first < r.corner_start; first += LANES) {
            for (int i = 0; i < LANES; i++) g[first + i] = load(r.parts + (i64)b.g[i] * r.gradient_size + first);
            transpose(g + first);
        }
        project_adjoint(r, cam, project(r, cam, b), g, b, camera);
    }
    b.count = 0;
}

// Sums the gradients of all shares and propagates them to the inputs; those of culled Gaussians are 0.
static void project_adjoint_share(Raster& r, int share) {
    Camera cam = camera_of(r);
    vf camera[CAMERA] = {};
    Batch b;
    b.count = 0;
    i64 start = share_start(r.n, share, r.threads), end = share_start(r.n, share + 1, r.threads), n = end - start;
    clear(r.v_corners + 4 * r.c * start, 16 * r.c * n);
    if (r.v_means) {
        clear(r.v_means + 3 * start, 12 * n), clear(r.v_quats + 4 * start, 16 * n), clear(r.v_scales + 3 * start, 12 * n);
        clear(r.v_opacity + start, 4 * n), clear(r.v_sh + 3 * r.k * start, 12 * r.k * n);
    }
    for (int g = start; g < end; g++)
        if (r.keys[g] != ~0u && b.add(g)) project_adjoint_batch(r, cam, b, camera);
    if (b.count) project_adjoint_batch(r, cam, b, camera);
    for (int j = 0; j < CAMERA; j++) r.camera_parts[share * CAMERA + j] = sum_of(camera[j]);
}
