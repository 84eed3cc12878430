// Projection of Gaussians to the screen, sixteen at a time, and its adjoint. Formulas in raster.h.
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

// Row-major 3x3, either of vectors or (splatted) of the camera.
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

// Field j of Gaussians first .. first + count of an [n stride] array; lanes beyond repeat the last one.
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
INLINE V3 gather3(const float* p, int first, int count) {
    return {gather(p, 3, 0, first, count), gather(p, 3, 1, first, count), gather(p, 3, 2, first, count)};
}
INLINE void scatter3(float* p, int first, int count, V3 v) {
    scatter(p, 3, 0, first, count, v.x), scatter(p, 3, 1, first, count, v.y), scatter(p, 3, 2, first, count, v.z);
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

// Real spherical harmonics in the signs of 3D Gaussian splatting, and the gradient of sum_i v_i Y_i in (x, y, z).
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

// Everything between the inputs and the record, kept for the adjoint.
struct Projected {
    vf q[4], q_scale;        // unit quaternion, 1 / length of the given one
    M3 R_obj_local, M;       // M: local to camera
    V3 mu, mu_cam, p, s, inv_s;   // mu_cam = R mu, p = mu_cam + t
    V3 P, E1, E2, C1, C2;    // whitened centre, whitened pixel steps, their cross products
    vf N, inv_N, inv_z;      // N = |P|^2
    vf a, b, c, bx, by;      // b is half of raster.h's
    V3 dir_p, dir;           // object-frame direction, before and after normalisation
    vf dir_scale;
    vf Y[16], raw[3];        // colour before the clamp
    vf opacity;
};

INLINE Projected project(const Raster& r, const Camera& cam, int first, int count) {
    Projected o;
    for (int j = 0; j < 4; j++) o.q[j] = gather(r.quats, 4, j, first, count);
    o.q_scale = 1.0f / vsqrt(o.q[0] * o.q[0] + o.q[1] * o.q[1] + o.q[2] * o.q[2] + o.q[3] * o.q[3]);
    for (int j = 0; j < 4; j++) o.q[j] *= o.q_scale;
    o.R_obj_local = rotation(o.q);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            o.M.m[3 * i + j] = cam.R(i, 0) * o.R_obj_local(0, j) + cam.R(i, 1) * o.R_obj_local(1, j) +
                               cam.R(i, 2) * o.R_obj_local(2, j);
    o.mu = gather3(r.means, first, count);
    o.s = gather3(r.scales, first, count);
    o.inv_s = {1.0f / o.s.x, 1.0f / o.s.y, 1.0f / o.s.z};
    o.opacity = gather(r.opacity, 1, 0, first, count);
    o.mu_cam = mul(cam.R, o.mu);
    o.p = o.mu_cam + cam.t;
    o.inv_z = 1.0f / o.p.z;
    o.P = mul_T(o.M, o.p) * o.inv_s;
    o.E1 = row(o.M, 0) * o.inv_s * (1.0f / cam.fx);
    o.E2 = row(o.M, 1) * o.inv_s * (1.0f / cam.fy);
    o.C1 = cross(o.P, o.E1), o.C2 = cross(o.P, o.E2);
    o.N = dot(o.P, o.P), o.inv_N = 1.0f / o.N;
    vf f = o.p.z * o.p.z * o.inv_N, g = o.p.z * o.inv_N;
    o.a = f * dot(o.C1, o.C1), o.b = f * dot(o.C1, o.C2), o.c = f * dot(o.C2, o.C2);
    o.bx = g * dot(o.P, o.E1), o.by = g * dot(o.P, o.E2);
    o.dir_p = mul_T(cam.R, o.p);
    o.dir_scale = 1.0f / vsqrt(dot(o.dir_p, o.dir_p));
    o.dir = o.dir_p * o.dir_scale;
    harmonics(r.k, o.dir, o.Y);
    for (int ch = 0; ch < 3; ch++) {
        o.raw[ch] = vf{};
        for (int j = 0; j < r.k; j++) o.raw[ch] += o.Y[j] * gather(r.sh, 3 * r.k, 3 * j + ch, first, count);
    }
    return o;
}

// Which lanes are drawn, and the outline of each on screen: the ellipse inside which alpha can reach alpha_min.
INLINE vi outline(const Raster& r, const Camera& cam, const Projected& o, vf cut, vf* span) {
    V3 X = row(o.M, 0) * o.s, Y = row(o.M, 1) * o.s, Z = row(o.M, 2) * o.s, p = o.p;
    vf zz = dot(Z, Z), xz = dot(X, Z), yz = dot(Y, Z), D = p.z * p.z - cut * zz, inv_D = 1.0f / D;
    V3 x = X * p.z + Z * (-p.x), y = Y * p.z + Z * (-p.y);
    vf scale = cut * inv_D * inv_D;
    vf x2 = scale * (dot(x, x) + cut * (xz * xz - dot(X, X) * zz));
    vf xy = scale * (dot(x, y) + cut * (xz * yz - dot(X, Y) * zz));
    vf y2 = scale * (dot(y, y) + cut * (yz * yz - dot(Y, Y) * zz));
    span[0] = cam.cx + cam.fx * (p.x * p.z - cut * xz) * inv_D;
    span[1] = cam.cy + cam.fy * (p.y * p.z - cut * yz) * inv_D;
    span[2] = cam.fx * cam.fx * x2, span[3] = cam.fx * cam.fy * xy, span[4] = cam.fy * cam.fy * y2;
    V3 n = {o.M(0, 2), o.M(1, 2), o.M(2, 2)};
    vi drawn = (p.z > r.near) & (p.z > r.near_sigmas * vsqrt(zz)) & (o.opacity >= r.alpha_min) &
               (dot(p, n) <= r.facing * vsqrt(dot(p, p)));
    vf half_x = vsqrt(vmax(span[2], vf{})) + 0.05f, half_y = vsqrt(vmax(span[4], vf{})) + 0.05f;
    // Whole pixels, so that what misses every pixel centre of the image is not drawn either.
    return drawn & (span[0] + half_x > 0.5f) & (span[0] - half_x < (float)r.width - 0.5f) &
           (span[1] + half_y > 0.5f) & (span[1] - half_y < (float)r.height - 0.5f);
}

static void project_share(Raster& r, int share) {
    Camera cam = camera_of(r);
    int end = share_start(r.n, share + 1, r.threads);
    for (int first = share_start(r.n, share, r.threads); first < end; first += LANES) {
        int count = imin2(LANES, end - first);
        Projected o = project(r, cam, first, count);
        vf cut = 2.0f * vlog(vmax(o.opacity * (1.0f / r.alpha_min), splat(1.0f))) + 1e-4f;
        vf span[SPAN];
        u32 drawn = bits(outline(r, cam, o, cut, span));
        vf uv = splat(1.0f / (2.0f * r.corner)), f[RECORD] = {};
        f[CX] = cam.cx + cam.fx * o.p.x * o.inv_z, f[CY] = cam.cy + cam.fy * o.p.y * o.inv_z;
        f[KA] = o.a, f[KB] = 2.0f * o.b, f[KC] = o.c, f[BX] = o.bx, f[BY] = o.by, f[KAPPA] = o.inv_N;
        f[CUT] = cut, f[OPACITY] = o.opacity, f[PZ] = o.p.z, f[DZ] = o.mu_cam.z;
        for (int ch = 0; ch < 3; ch++) f[RED + ch] = vmax(o.raw[ch], vf{});
        for (int i = 0; i < 3; i++) f[NX + i] = o.R_obj_local(i, 2);
        f[EU] = uv * o.P.x, f[UX] = uv * o.p.z * o.E1.x, f[UY] = uv * o.p.z * o.E2.x;
        f[EV] = uv * o.P.y, f[VX] = uv * o.p.z * o.E1.y, f[VY] = uv * o.p.z * o.E2.y;
        float lanes[RECORD][LANES], spans[SPAN][LANES];
        for (int j = 0; j < RECORD; j++) store(lanes[j], f[j]);
        for (int j = 0; j < SPAN; j++) store(spans[j], span[j]);
        for (int i = 0; i < count; i++) {
            int g = first + i;
            r.keys[g] = ~0u;
            if (!(drawn >> i & 1)) continue;
            float* record = r.record + (i64)g * r.record_size;
            for (int j = 0; j < RECORD; j++) record[j] = lanes[j][i];
            for (int j = 0; j < SPAN; j++) r.span[(i64)g * SPAN + j] = spans[j][i];
            __builtin_memcpy(&r.keys[g], &record[PZ], 4);
            const float* f4 = r.corners + (i64)g * 4 * r.c;
            for (int ch = 0; ch < r.c; ch++) {
                float *out = record + RECORD + 4 * ch, f00 = f4[ch], f10 = f4[r.c + ch], f01 = f4[2 * r.c + ch];
                out[0] = f00, out[1] = f10 - f00, out[2] = f01 - f00;
                out[3] = f4[3 * r.c + ch] - f10 - f01 + f00;
            }
            for (int j = RECORD + 4 * r.c; j < r.record_size; j++) record[j] = 0;
        }
    }
}

// Gradients of a record's fields, lane-wise, to those of the inputs. The camera's gather in `camera`:
// R (9), t (3), focal lengths and principal point (4).
INLINE void project_adjoint(const Raster& r, const Camera& cam, const Projected& o, const vf* g, V3 v_rgb,
                            V3 v_normal, vi drawn, int first, int count, vf* camera) {
    vf z = o.p.z, iz = o.inv_z, uv = splat(1.0f / (2.0f * r.corner)), f = z * z * o.inv_N, h = z * o.inv_N;
    // Conic.
    vf v_b = 2.0f * g[G_B], sum = g[G_A] * o.a + v_b * o.b + g[G_C] * o.c;
    V3 v_C1 = o.C1 * (2.0f * f * g[G_A]) + o.C2 * (f * v_b), v_C2 = o.C2 * (2.0f * f * g[G_C]) + o.C1 * (f * v_b);
    vf v_beta = g[G_BX] * o.bx + g[G_BY] * o.by;
    vf v_N = -o.inv_N * (sum + v_beta + o.inv_N * g[G_KAPPA]);
    V3 v_P = cross(o.E1, v_C1) + cross(o.E2, v_C2) + o.E1 * (h * g[G_BX]) + o.E2 * (h * g[G_BY]) + o.P * (2.0f * v_N);
    V3 v_E1 = cross(v_C1, o.P) + o.P * (h * g[G_BX]), v_E2 = cross(v_C2, o.P) + o.P * (h * g[G_BY]);
    vf v_z = g[G_PZ] + iz * (2.0f * sum + v_beta);
    // Corner coordinates.
    vf zuv = z * uv;
    v_P.x += uv * g[G_EU], v_P.y += uv * g[G_EV];
    v_E1.x += zuv * g[G_UX], v_E2.x += zuv * g[G_UY], v_E1.y += zuv * g[G_VX], v_E2.y += zuv * g[G_VY];
    v_z += uv * (g[G_UX] * o.E1.x + g[G_UY] * o.E2.x + g[G_VX] * o.E1.y + g[G_VY] * o.E2.y);
    // Projected centre.
    V3 v_p = {g[G_CX] * cam.fx * iz, g[G_CY] * cam.fy * iz, v_z};
    v_p.z -= iz * (v_p.x * o.p.x + v_p.y * o.p.y);
    V3 keep_E1 = o.E1 * v_E1, keep_E2 = o.E2 * v_E2;
    camera[12] += keep(drawn, g[G_CX] * o.p.x * iz - (keep_E1.x + keep_E1.y + keep_E1.z) / cam.fx);
    camera[13] += keep(drawn, g[G_CY] * o.p.y * iz - (keep_E2.x + keep_E2.y + keep_E2.z) / cam.fy);
    camera[14] += keep(drawn, g[G_CX]), camera[15] += keep(drawn, g[G_CY]);
    // Whitening.
    V3 v_s = (o.P * v_P + keep_E1 + keep_E2) * o.inv_s * splat(-1.0f);
    V3 w = v_P * o.inv_s, w1 = v_E1 * o.inv_s * (1.0f / cam.fx), w2 = v_E2 * o.inv_s * (1.0f / cam.fy);
    v_p = v_p + mul(o.M, w);
    M3 v_M = {{o.p.x * w.x + w1.x, o.p.x * w.y + w1.y, o.p.x * w.z + w1.z, o.p.y * w.x + w2.x,
               o.p.y * w.y + w2.y, o.p.y * w.z + w2.z, o.p.z * w.x, o.p.z * w.y, o.p.z * w.z}};
    // Colour.
    vf v_raw[3] = {keep(o.raw[0] >= 0.0f, v_rgb.x), keep(o.raw[1] >= 0.0f, v_rgb.y), keep(o.raw[2] >= 0.0f, v_rgb.z)};
    vf v_Y[16];
    for (int j = 0; j < r.k; j++) {
        v_Y[j] = vf{};
        for (int ch = 0; ch < 3; ch++) {
            v_Y[j] += v_raw[ch] * gather(r.sh, 3 * r.k, 3 * j + ch, first, count);
            scatter(r.v_sh, 3 * r.k, 3 * j + ch, first, count, keep(drawn, v_raw[ch] * o.Y[j]));
        }
    }
    V3 v_dir = harmonics_adjoint(r.k, o.dir, v_Y);
    v_dir = (v_dir + o.dir * (-dot(v_dir, o.dir))) * o.dir_scale;
    v_p = v_p + mul(cam.R, v_dir);
    // Pose and rotation.
    M3 v_Rq;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            v_Rq.m[3 * i + j] = cam.R(0, i) * v_M(0, j) + cam.R(1, i) * v_M(1, j) + cam.R(2, i) * v_M(2, j);
    v_Rq.m[2] += v_normal.x, v_Rq.m[5] += v_normal.y, v_Rq.m[8] += v_normal.z;
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
    for (int j = 0; j < 4; j++)
        scatter(r.v_quats, 4, j, first, count, keep(drawn, (v_q[j] - radial * o.q[j]) * o.q_scale));
    V3 v_mu = mul_T(cam.R, v_p);
    scatter3(r.v_means, first, count, {keep(drawn, v_mu.x), keep(drawn, v_mu.y), keep(drawn, v_mu.z)});
    scatter3(r.v_scales, first, count, {keep(drawn, v_s.x), keep(drawn, v_s.y), keep(drawn, v_s.z)});
    scatter(r.v_opacity, 1, 0, first, count, keep(drawn, g[G_OPACITY]));
}

// Add up what the shares found, and take it to the inputs.
static void project_adjoint_share(Raster& r, int share) {
    Camera cam = camera_of(r);
    vf camera[CAMERA] = {};
    int end = share_start(r.n, share + 1, r.threads), size = r.gradient_size, width = r.channel_vectors * LANES;
    for (int first = share_start(r.n, share, r.threads); first < end; first += LANES) {
        int count = imin2(LANES, end - first);
        float lanes[GEOMETRY + 6][LANES] = {}, drawn_lanes[LANES] = {};
        for (int i = 0; i < count; i++) {
            int g = first + i;
            float* v_corners = r.v_corners + (i64)g * 4 * r.c;
            if (r.keys[g] == ~0u) {
                clear(v_corners, (i64)16 * r.c);
                continue;
            }
            drawn_lanes[i] = 1;
            float* total = r.parts + (i64)g * size;
            for (int part = 1; part < r.threads; part++) {
                const float* more = r.parts + ((i64)part * r.n + g) * size;
                for (int j = 0; j < size; j++) total[j] += more[j];
            }
            for (int j = 0; j < GEOMETRY; j++) lanes[j][i] = total[j];
            const float* channels = total + GEOMETRY;
            for (int corner = 0; corner < (r.c ? 4 : 1); corner++, channels += width) {
                for (int j = 0; j < 6; j++) lanes[GEOMETRY + j][i] += channels[j];
                for (int ch = 0; ch < r.c; ch++) v_corners[corner * r.c + ch] = channels[6 + ch];
            }
        }
        vf g[GEOMETRY + 6];
        for (int j = 0; j < GEOMETRY + 6; j++) g[j] = load(lanes[j]);
        vi drawn = load(drawn_lanes) > 0.5f;
        Projected o = project(r, cam, first, count);
        const vf* c = g + GEOMETRY;
        project_adjoint(r, cam, o, g, {c[0], c[1], c[2]}, {c[3], c[4], c[5]}, drawn, first, count, camera);
    }
    for (int j = 0; j < CAMERA; j++) r.camera_parts[share * CAMERA + j] = sum_of(camera[j]);
}
