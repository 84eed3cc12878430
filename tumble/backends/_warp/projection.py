# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018, RUF046 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of the projection of Gaussians to the screen, of its adjoint, and of the assignment of Gaussians to tiles.

With (dx, dy) the offset of a pixel from the projected centre, the quantities at the peak of the pixel's ray are
    K = a dx^2 + b dx dy + c dy^2,   l = 1 + beta_x dx + beta_y dy,   q = l^2 + kappa K,
    |W(peak - mu)|^2 = K / q,   zeta = (z-depth of the peak) / (z-depth of the centre) = l / q.
They are exact in perspective. K is computed by a cross product and zeta - 1 as -(l (l - 1) + kappa K) / q, which avoids
cancellation in float32 for thin Gaussians. The corner coordinates are
    u = 1/2 + (zeta - 1) e_u + zeta (u_x dx + u_y dy), and the same for v, clamped to [0, 1].

A Gaussian's *record* is eight groups of four numbers:
    0: projected centre x y, cut, opacity     1: a b c, kappa              2: beta_x beta_y, z, z - t.z
    3: red green blue, e_u                    4: normal, e_v               5: u_x u_y v_x v_y
    6: footprint centre x y, moments xx xy    7: footprint moment yy
Alpha is at least ALPHA_MIN where K <= cut q. This region is the *footprint*, an ellipse on screen that is described by
its centre and second moments.

The *sums* of a Gaussian are gradients summed over pixels: those of a b c, beta_x beta_y, the centre, kappa, opacity, z,
u_x u_y, e_u, v_x v_y, e_v, red green blue, normal, in this order, then (from CORNERS on) those of the corner features.

The camera is 16 numbers: R_cam_obj by rows, t_cam_obj, focal lengths, principal point.

The adjoint computes gradients of the Gaussians and the camera from the sums; `v_x` is the gradient of x.
"""

import warp as wp

from tumble.backends import ALPHA_MIN, CORNER, FACING, NEAR, NEAR_SIGMAS
from tumble.backends._warp.runtime import add_row, no_type_check, vec32

wp.set_module_options({"enable_backward": False})

TILE = 16
"""Side of a tile [pixels]."""
RECORD = 8
"""Groups of four numbers in a record."""
SUMS = 22
"""Number of sums of a Gaussian without features."""
OPACITY = 8
"""Index of the opacity among the sums."""
CORNERS = 32
"""Index of the first feature among the sums."""
FAR = 3.0e38
"""Sorting depth of culled Gaussians."""
UV = 1.0 / (2.0 * CORNER)
"""Factor from standard deviations to corner coordinates."""

vec16 = wp.types.vector(length=16, dtype=float)


@wp.struct
@no_type_check
class Projected:
    """Intermediate values of the projection, which the adjoint needs again."""

    quat: wp.vec4
    quat_scale: float
    R_obj_local: wp.mat33
    R_cam_obj: wp.mat33
    R_cam_local: wp.mat33
    inv_s: wp.vec3
    mu_cam: wp.vec3
    p: wp.vec3
    fx: float
    fy: float
    P: wp.vec3
    E1: wp.vec3
    E2: wp.vec3
    C1: wp.vec3
    C2: wp.vec3
    kappa: float
    a: float
    b: float
    c: float
    beta_x: float
    beta_y: float
    away: float
    view: wp.vec3


@wp.func
@no_type_check
def rotation(q: wp.vec4) -> wp.mat33:
    """Matrix of a unit quaternion wxyz."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
@no_type_check
def rotation_adjoint(q: wp.vec4, g: wp.mat33) -> wp.vec4:
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    v_xy = g[0, 1] + g[1, 0]
    v_xz = g[0, 2] + g[2, 0]
    v_yz = g[1, 2] + g[2, 1]
    v_wx = g[2, 1] - g[1, 2]
    v_wy = g[0, 2] - g[2, 0]
    v_wz = g[1, 0] - g[0, 1]
    return wp.vec4(
        2.0 * (x * v_wx + y * v_wy + z * v_wz),
        2.0 * (y * v_xy + z * v_xz + w * v_wx) - 4.0 * x * (g[1, 1] + g[2, 2]),
        2.0 * (x * v_xy + z * v_yz + w * v_wy) - 4.0 * y * (g[0, 0] + g[2, 2]),
        2.0 * (x * v_xz + y * v_yz + w * v_wz) - 4.0 * z * (g[0, 0] + g[1, 1]),
    )


@wp.func
@no_type_check
def harmonics(d: wp.vec3) -> vec16:
    """Real spherical harmonics with the signs of 3D Gaussian splatting."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    Y = vec16()
    Y[0] = 0.28209479177
    Y[1] = -0.48860251190 * y
    Y[2] = 0.48860251190 * z
    Y[3] = -0.48860251190 * x
    Y[4] = 1.09254843059 * x * y
    Y[5] = -1.09254843059 * y * z
    Y[6] = 0.31539156525 * (2.0 * zz - xx - yy)
    Y[7] = -1.09254843059 * x * z
    Y[8] = 0.54627421530 * (xx - yy)
    Y[9] = -0.59004358993 * y * (3.0 * xx - yy)
    Y[10] = 2.89061144264 * x * y * z
    Y[11] = -0.45704579946 * y * (4.0 * zz - xx - yy)
    Y[12] = 0.37317633259 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    Y[13] = -0.45704579946 * x * (4.0 * zz - xx - yy)
    Y[14] = 1.44530572132 * z * (xx - yy)
    Y[15] = -0.59004358993 * x * (xx - 3.0 * yy)
    return Y


@wp.func
@no_type_check
def harmonics_adjoint(d: wp.vec3, v: vec16) -> wp.vec3:
    """Gradient of v . harmonics(d) with the components of d as independent variables."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    s = 4.0 * z * z - xx - yy
    g = 0.48860251190 * wp.vec3(-v[3], -v[1], v[2])
    g += 1.09254843059 * (v[4] * wp.vec3(y, x, 0.0) - v[5] * wp.vec3(0.0, z, y) - v[7] * wp.vec3(z, 0.0, x))
    g += 0.63078313050 * v[6] * wp.vec3(-x, -y, 2.0 * z) + 1.09254843060 * v[8] * wp.vec3(x, -y, 0.0)
    g -= 0.59004358993 * v[9] * wp.vec3(6.0 * x * y, 3.0 * (xx - yy), 0.0)
    g += 2.89061144264 * v[10] * wp.vec3(y * z, x * z, x * y)
    g -= 0.45704579946 * v[11] * wp.vec3(-2.0 * x * y, s - 2.0 * yy, 8.0 * y * z)
    g += 0.37317633259 * v[12] * wp.vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * xx - 3.0 * yy)
    g -= 0.45704579946 * v[13] * wp.vec3(s - 2.0 * xx, -2.0 * x * y, 8.0 * x * z)
    g += 1.44530572132 * v[14] * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
    g -= 0.59004358993 * v[15] * wp.vec3(3.0 * (xx - yy), -6.0 * x * y, 0.0)
    return g


@wp.func
@no_type_check
def row_of(m: wp.mat33, i: int) -> wp.vec3:
    return wp.vec3(m[i, 0], m[i, 1], m[i, 2])


@wp.func
@no_type_check
def project(mean: wp.vec3, quat: wp.vec4, scale: wp.vec3, camera: wp.array[float]) -> Projected:
    o = Projected()
    o.quat_scale = 1.0 / wp.length(quat)
    o.quat = quat * o.quat_scale
    for i in range(3):
        for j in range(3):
            o.R_cam_obj[i, j] = camera[3 * i + j]
    o.fx = camera[12]
    o.fy = camera[13]
    o.R_obj_local = rotation(o.quat)
    o.R_cam_local = o.R_cam_obj * o.R_obj_local
    o.inv_s = wp.vec3(1.0 / scale[0], 1.0 / scale[1], 1.0 / scale[2])
    o.mu_cam = o.R_cam_obj * mean
    o.p = o.mu_cam + wp.vec3(camera[9], camera[10], camera[11])
    o.P = wp.cw_mul(wp.transpose(o.R_cam_local) * o.p, o.inv_s)
    o.E1 = wp.cw_mul(row_of(o.R_cam_local, 0), o.inv_s) / o.fx
    o.E2 = wp.cw_mul(row_of(o.R_cam_local, 1), o.inv_s) / o.fy
    o.C1 = wp.cross(o.P, o.E1)
    o.C2 = wp.cross(o.P, o.E2)
    o.kappa = 1.0 / wp.dot(o.P, o.P)
    f = o.p[2] * o.p[2] * o.kappa
    o.a = f * wp.dot(o.C1, o.C1)
    o.b = 2.0 * f * wp.dot(o.C1, o.C2)
    o.c = f * wp.dot(o.C2, o.C2)
    o.beta_x = o.p[2] * o.kappa * wp.dot(o.P, o.E1)
    o.beta_y = o.p[2] * o.kappa * wp.dot(o.P, o.E2)
    from_camera = wp.transpose(o.R_cam_obj) * o.p
    o.away = 1.0 / wp.length(from_camera)
    o.view = from_camera * o.away
    return o


@wp.func
@no_type_check
def colour(Y: vec16, sh: wp.array2d[wp.vec3], i: int) -> wp.vec3:
    """Radiance of a Gaussian before clamping at 0."""
    rgb = wp.vec3()
    for j in range(16):
        if j < sh.shape[1]:
            rgb += Y[j] * sh[i, j]
    return rgb


@wp.func
@no_type_check
def faces_camera(o: Projected, sigma_z: float) -> bool:
    """Whether a Gaussian is in front of the camera and faces it."""
    n = wp.vec3(o.R_cam_local[0, 2], o.R_cam_local[1, 2], o.R_cam_local[2, 2])
    in_front = o.p[2] > NEAR and o.p[2] > NEAR_SIGMAS * sigma_z
    return in_front and wp.dot(o.p, n) <= FACING * wp.length(o.p)


@wp.kernel
@no_type_check
def project_forward(
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacity: wp.array[float],
    sh: wp.array2d[wp.vec3],
    camera: wp.array[float],
    height: int,
    width: int,
    record: wp.array2d[wp.vec4],
    depth: wp.array[float],
    n_tiles: wp.array[int],
):
    """Write the record, sorting depth and number of tiles of each Gaussian; FAR and 0 if it is culled."""
    i = wp.tid()
    o = project(means[i], quats[i], scales[i], camera)
    X = wp.cw_mul(row_of(o.R_cam_local, 0), scales[i])
    Y = wp.cw_mul(row_of(o.R_cam_local, 1), scales[i])
    Z = wp.cw_mul(row_of(o.R_cam_local, 2), scales[i])
    depth[i] = FAR
    n_tiles[i] = 0
    if opacity[i] < ALPHA_MIN or not faces_camera(o, wp.length(Z)):
        return
    cut = 2.0 * wp.log(wp.max(opacity[i] / ALPHA_MIN, 1.0)) + 1.0e-4
    p = o.p
    zz = wp.dot(Z, Z)
    xz = wp.dot(X, Z)
    yz = wp.dot(Y, Z)
    inv_D = 1.0 / (p[2] * p[2] - cut * zz)
    x = X * p[2] - Z * p[0]
    y = Y * p[2] - Z * p[1]
    scale = cut * inv_D * inv_D
    x2 = o.fx * o.fx * scale * (wp.dot(x, x) + cut * (xz * xz - wp.dot(X, X) * zz))
    xy = o.fx * o.fy * scale * (wp.dot(x, y) + cut * (xz * yz - wp.dot(X, Y) * zz))
    y2 = o.fy * o.fy * scale * (wp.dot(y, y) + cut * (yz * yz - wp.dot(Y, Y) * zz))
    footprint_x = camera[14] + o.fx * (p[0] * p[2] - cut * xz) * inv_D
    footprint_y = camera[15] + o.fy * (p[1] * p[2] - cut * yz) * inv_D
    rgb = colour(harmonics(o.view), sh, i)
    R = o.R_obj_local
    uz = UV * p[2]
    record[i, 0] = wp.vec4(camera[14] + o.fx * p[0] / p[2], camera[15] + o.fy * p[1] / p[2], cut, opacity[i])
    record[i, 1] = wp.vec4(o.a, o.b, o.c, o.kappa)
    record[i, 2] = wp.vec4(o.beta_x, o.beta_y, p[2], o.mu_cam[2])
    record[i, 3] = wp.vec4(wp.max(rgb[0], 0.0), wp.max(rgb[1], 0.0), wp.max(rgb[2], 0.0), UV * o.P[0])
    record[i, 4] = wp.vec4(R[0, 2], R[1, 2], R[2, 2], UV * o.P[1])
    record[i, 5] = uz * wp.vec4(o.E1[0], o.E2[0], o.E1[1], o.E2[1])
    record[i, 6] = wp.vec4(footprint_x, footprint_y, wp.max(x2, 0.0), xy)
    record[i, 7] = wp.vec4(wp.max(y2, 1.0e-12), 0.0, 0.0, 0.0)
    rows = tile_rows(record, i, height)
    count = int(0)
    for row in range(rows[0], rows[1]):
        columns = tile_columns(record, i, row, width)
        count += columns[1] - columns[0]
    depth[i] = p[2]
    n_tiles[i] = count


MARGIN = 0.02
"""Distance by which a footprint is widened against rounding errors [pixels]."""


@wp.func
@no_type_check
def tile_rows(record: wp.array2d[wp.vec4], i: int, height: int) -> wp.vec2i:
    """First row of tiles that a footprint may overlap, and the row after the last."""
    half = wp.sqrt(record[i, 7][0]) + MARGIN
    top = wp.max(record[i, 6][1] - half, 0.0)
    bottom = wp.min(record[i, 6][1] + half, float(height) - 0.5)
    if top > bottom:
        return wp.vec2i(0, 0)
    return wp.vec2i(int(top) // TILE, int(bottom) // TILE + 1)


@wp.func
@no_type_check
def tile_columns(record: wp.array2d[wp.vec4], i: int, row: int, width: int) -> wp.vec2i:
    """First tile of a row with a pixel centre inside a footprint, and the tile after the last.

    The leftmost and rightmost points of the part of an ellipse within a row of tiles are the extreme points of the
    ellipse, or else its intersections with the border of the row.
    """
    none = wp.vec2i(0, 0)
    centre = record[i, 6]
    x2 = centre[2]
    xy = centre[3]
    y2 = record[i, 7][0]
    half_y = wp.sqrt(y2)
    y = float(row * TILE) - centre[1]
    top = wp.max(y + 0.5 - MARGIN, -half_y)
    bottom = wp.min(y + float(TILE) - 0.5 + MARGIN, half_y)
    if top > bottom:
        return none
    extreme = wp.where(x2 > 0.0, xy / wp.sqrt(wp.max(x2, 1.0e-30)), 0.0)
    rest = wp.max(x2 - xy * xy / y2, 0.0)
    y_right = wp.clamp(extreme, top, bottom)
    y_left = wp.clamp(-extreme, top, bottom)
    right = centre[0] + xy / y2 * y_right + wp.sqrt(rest * wp.max(1.0 - y_right * y_right / y2, 0.0)) + MARGIN
    left = centre[0] + xy / y2 * y_left - wp.sqrt(rest * wp.max(1.0 - y_left * y_left / y2, 0.0)) - MARGIN
    # Pixels whose centre x + 1/2 lies in [left, right].
    first = int(wp.ceil(wp.max(left, 0.5) - 0.5))
    last = int(wp.floor(wp.min(right, float(width) - 0.5) - 0.5))
    if first > last:
        return none
    return wp.vec2i(first // TILE, last // TILE + 1)


@wp.kernel
@no_type_check
def list_tiles(
    order: wp.array[wp.int64],
    ends: wp.array[wp.int64],
    record: wp.array2d[wp.vec4],
    n_tiles: wp.array[int],
    height: int,
    width: int,
    tiles: wp.array[int],
    gaussians: wp.array[int],
    longest: wp.array[int],
):
    """Write pairs of a tile and a Gaussian as far as there is room; those of the i-th by depth end before ends[i].

    `longest` becomes the number of pairs if that is larger.
    """
    rank = wp.tid()
    i = int(order[rank])
    if rank == order.shape[0] - 1:
        wp.atomic_max(longest, 0, int(ends[rank]))
    if n_tiles[i] == 0:
        return
    across = (width + TILE - 1) // TILE
    pair = int(ends[rank]) - n_tiles[i]
    rows = tile_rows(record, i, height)
    for row in range(rows[0], rows[1]):
        columns = tile_columns(record, i, row, width)
        for column in range(columns[0], columns[1]):
            if pair < tiles.shape[0]:
                tiles[pair] = row * across + column
                gaussians[pair] = i
            pair += 1


@wp.struct
@no_type_check
class Gradient:
    """Gradients of the fields of `Projected` with the same names."""

    p: wp.vec3
    P: wp.vec3
    E1: wp.vec3
    E2: wp.vec3
    view: wp.vec3


@wp.func
@no_type_check
def screen_adjoint(o: Projected, sums: wp.array2d[float], i: int) -> Gradient:
    """Gradients through the conic, the corner coordinates and the projected centre."""
    v = Gradient()
    v_a = sums[i, 0]
    v_b = 2.0 * sums[i, 1]
    v_c = sums[i, 2]
    v_beta_x = sums[i, 3]
    v_beta_y = sums[i, 4]
    g = o.p[2] * o.kappa
    f = o.p[2] * g
    conic = v_a * o.a + 0.5 * v_b * o.b + v_c * o.c
    v_C1 = f * (2.0 * v_a * o.C1 + v_b * o.C2)
    v_C2 = f * (2.0 * v_c * o.C2 + v_b * o.C1)
    beta = v_beta_x * o.beta_x + v_beta_y * o.beta_y
    v_N = -o.kappa * (conic + beta + o.kappa * sums[i, 7])
    v.E1 = wp.cross(v_C1, o.P) + g * v_beta_x * o.P
    v.E2 = wp.cross(v_C2, o.P) + g * v_beta_y * o.P
    v.P = wp.cross(o.E1, v_C1) + wp.cross(o.E2, v_C2) + g * (v_beta_x * o.E1 + v_beta_y * o.E2) + 2.0 * v_N * o.P
    v_ux = UV * sums[i, 10]
    v_uy = UV * sums[i, 11]
    v_vx = UV * sums[i, 13]
    v_vy = UV * sums[i, 14]
    v.P += UV * wp.vec3(sums[i, 12], sums[i, 15], 0.0)
    v.E1 += o.p[2] * wp.vec3(v_ux, v_vx, 0.0)
    v.E2 += o.p[2] * wp.vec3(v_uy, v_vy, 0.0)
    v_z = v_ux * o.E1[0] + v_uy * o.E2[0] + v_vx * o.E1[1] + v_vy * o.E2[1]
    v_x = sums[i, 5] * o.fx / o.p[2]
    v_y = sums[i, 6] * o.fy / o.p[2]
    v_z += sums[i, 9] + (2.0 * conic + beta - v_x * o.p[0] - v_y * o.p[1]) / o.p[2]
    v.p = wp.vec3(v_x, v_y, v_z)
    return v


@wp.kernel
@no_type_check
def project_adjoint(
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    sh: wp.array2d[wp.vec3],
    camera: wp.array[float],
    n_tiles: wp.array[int],
    sums: wp.array2d[float],
    v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4],
    v_scales: wp.array[wp.vec3],
    v_sh: wp.array2d[wp.vec3],
    v_camera: wp.array2d[float],
):
    """Gradients of each Gaussian and of the camera; the latter is summed over lanes, which needs whole warps."""
    i = wp.tid()
    v_cam = vec32()
    if i < means.shape[0] and n_tiles[i] > 0:
        o = project(means[i], quats[i], scales[i], camera)
        v = screen_adjoint(o, sums, i)
        v_s = wp.cw_mul(o.P, v.P) + wp.cw_mul(o.E1, v.E1) + wp.cw_mul(o.E2, v.E2)
        v_scales[i] = -wp.cw_mul(v_s, o.inv_s)
        v_cam[12] = (sums[i, 5] * o.p[0] / o.p[2]) - wp.dot(o.E1, v.E1) / o.fx
        v_cam[13] = (sums[i, 6] * o.p[1] / o.p[2]) - wp.dot(o.E2, v.E2) / o.fy
        v_cam[14] = sums[i, 5]
        v_cam[15] = sums[i, 6]
        v_view = colour_adjoint(harmonics(o.view), o.view, sums, sh, i, v_sh)
        v_view = (v_view - wp.dot(v_view, o.view) * o.view) * o.away
        w = wp.cw_mul(v.P, o.inv_s)
        v_p = v.p + o.R_cam_local * w + o.R_cam_obj * v_view
        x = wp.vec3(1.0 / o.fx, 0.0, 0.0)
        y = wp.vec3(0.0, 1.0 / o.fy, 0.0)
        v_R_cam_local = wp.outer(o.p, w) + wp.outer(x, wp.cw_mul(v.E1, o.inv_s))
        v_R_cam_local += wp.outer(y, wp.cw_mul(v.E2, o.inv_s))
        v_R_obj_local = wp.transpose(o.R_cam_obj) * v_R_cam_local
        v_normal = wp.vec3(sums[i, 19], sums[i, 20], sums[i, 21])
        v_R_obj_local += wp.outer(v_normal, wp.vec3(0.0, 0.0, 1.0))
        v_R_cam_obj = v_R_cam_local * wp.transpose(o.R_obj_local) + wp.outer(v_p, means[i]) + wp.outer(o.p, v_view)
        for a in range(3):
            for b in range(3):
                v_cam[3 * a + b] = v_R_cam_obj[a, b]
            v_cam[9 + a] = v_p[a]
        v_means[i] = wp.transpose(o.R_cam_obj) * v_p
        v_q = rotation_adjoint(o.quat, v_R_obj_local)
        v_quats[i] = (v_q - wp.dot(v_q, o.quat) * o.quat) * o.quat_scale
    elif i < means.shape[0]:
        v_means[i] = wp.vec3()
        v_quats[i] = wp.vec4()
        v_scales[i] = wp.vec3()
        for j in range(sh.shape[1]):
            v_sh[i, j] = wp.vec3()
    add_row(v_camera, 0, 0, 16, v_cam)


@wp.func
@no_type_check
def colour_adjoint(
    Y: vec16, view: wp.vec3, sums: wp.array2d[float], sh: wp.array2d[wp.vec3], i: int, v_sh: wp.array2d[wp.vec3]
) -> wp.vec3:
    """Gradient of the view direction; also writes the gradient of the coefficients of the harmonics."""
    raw = colour(Y, sh, i)
    v = wp.vec3()
    for ch in range(3):
        if raw[ch] >= 0.0:
            v[ch] = sums[i, 16 + ch]
    v_Y = vec16()
    for j in range(16):
        if j < sh.shape[1]:
            v_sh[i, j] = v * Y[j]
            v_Y[j] = wp.dot(v, sh[i, j])
    return harmonics_adjoint(view, v_Y)
