# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
"""Kernels of shading (Lambert + GGX) under light directions shared by all points, and of its adjoint.

The formulas are in `Backend.shade`; f below is the specular part, t_h2 is t |H|^2, `v_x` is the gradient of x. In the
forward kernel and in the gradient of surface quantities, the 32 lanes of a warp process one point, and lane i takes the
directions of bit i. In the gradient of radiances, a thread processes one direction and several points.
"""

import math

import warp as wp

from tumble.backends import ROUGHNESS_MIN
from tumble.backends._warp.runtime import LANES, add_row, no_type_check, vec32

wp.set_module_options({"enable_backward": False})

POINTS = 32
"""Points per thread in the gradient of radiances."""
INV_PI = 1.0 / math.pi
FOUR_PI = 4.0 * math.pi


@wp.struct
@no_type_check
class Point:
    """Quantities of a point that do not depend on the direction."""

    n: wp.vec3
    v: wp.vec3
    n_v: float
    r: float
    aa: float
    g_v: float


@wp.func
@no_type_check
def smith_root(x: float, aa: float) -> float:
    """The root in Smith's g(x) = (x + root) / 2."""
    return wp.sqrt(aa + (1.0 - aa) * x * x)


@wp.func
@no_type_check
def point_at(normal: wp.array[wp.vec3], roughness: wp.array[float], view: wp.array[wp.vec3], i: int) -> Point:
    p = Point()
    p.n = normal[i]
    p.v = view[i]
    p.n_v = wp.dot(p.n, p.v)
    p.r = wp.max(roughness[i], ROUGHNESS_MIN)
    p.aa = p.r * p.r * p.r * p.r
    facing = wp.max(p.n_v, 0.0)
    p.g_v = 0.5 * (facing + smith_root(facing, p.aa))
    return p


@wp.struct
@no_type_check
class Lobe:
    """The specular lobe in one direction: f = F rest."""

    w: wp.vec3
    n_w: float
    HH: float
    C: wp.vec3
    t_h2: float
    vh: float
    F: float
    slope: float
    g_w: float
    rest: float
    f: float
    exists: bool


@wp.func
@no_type_check
def lobe_at(p: Point, w: wp.vec3, n_w: float) -> Lobe:
    o = Lobe()
    o.w = w
    o.n_w = n_w
    o.HH = 2.0 + 2.0 * wp.dot(p.v, w)
    o.exists = o.HH > 1.0e-6 and p.n_v > 0.0
    if not o.exists:
        return o
    o.C = wp.cross(p.n, p.v + w)
    o.t_h2 = wp.dot(o.C, o.C) + p.aa * (p.n_v + n_w) * (p.n_v + n_w)
    o.g_w = 0.5 * (n_w + smith_root(n_w, p.aa))
    o.vh = 0.5 * wp.sqrt(o.HH)
    m = 1.0 - o.vh
    # `tumble.rendering.brdf.fresnel` and its derivative in m.
    o.F = 1.0 + 24.0 * m * m * m * (0.9878 + m * (-3.8886 + m * (9.1922 + m * (-9.6217 + m * 4.3303))))
    o.slope = 24.0 * m * m * (2.9634 + m * (-15.5544 + m * (45.961 + m * (-57.7302 + m * 30.3121))))
    x = o.HH / o.t_h2
    o.rest = p.aa * x * x / (FOUR_PI * p.g_v * o.g_w)
    o.f = o.F * o.rest
    return o


UNBLOCKED = wp.constant(-1)
"""Source index of the environment."""
BLACK = wp.constant(-2)
"""Source index of a black blocker."""


@wp.func
@no_type_check
def source_of(
    visibility: wp.array2d[int], blocker: wp.array2d[int], blocker_radiance: wp.array[wp.vec3], i: int, j: int
) -> int:
    """Source of the light at points of row i from direction j: UNBLOCKED, BLACK, or the index of a blocker."""
    if (visibility[i, j // 32] >> (j % 32)) & 1 == 1:
        return UNBLOCKED
    if blocker_radiance.shape[0] == 0:
        return BLACK
    return wp.where(blocker[i, j] < 0, BLACK, blocker[i, j])


@wp.func
@no_type_check
def arriving(source: int, radiance: wp.array[wp.vec3], blocker_radiance: wp.array[wp.vec3], j: int) -> wp.vec3:
    """Radiance arriving from direction j, given its source."""
    if source == UNBLOCKED:
        return radiance[j]
    return blocker_radiance[source]


@wp.struct
@no_type_check
class LobeSums:
    """Sums of a point over some of its directions; `visible` and `total` are weights of `specular_visibility`."""

    diffuse: wp.vec3
    specular: wp.vec3
    visible: float
    total: float


@wp.kernel
@no_type_check
def shade_forward(
    normal: wp.array[wp.vec3],
    roughness: wp.array[float],
    view: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    visibility: wp.array2d[int],
    blocker: wp.array2d[int],
    rows: wp.array[wp.int64],
    blocker_radiance: wp.array[wp.vec3],
    out: wp.array2d[float],
):
    i, lane = wp.tid()
    p = point_at(normal, roughness, view, i)
    sum = LobeSums()
    mirrored = 2.0 * p.n_v * p.n - p.v
    bb = wp.max(p.aa, 0.25 * math.pi / float(directions.shape[0]))
    for j in range(lane, directions.shape[0], LANES):
        n_w = wp.dot(p.n, directions[j])
        source = source_of(visibility, blocker, blocker_radiance, int(rows[i]), j)
        c = wp.dot(mirrored, directions[j])
        if n_w > 0.0 and c > 0.0:
            t = 0.5 * (1.0 - c) + bb * 0.5 * (1.0 + c)
            sum.total += c / (t * t)
            if source == UNBLOCKED:
                sum.visible += c / (t * t)
        if n_w > 0.0 and source != BLACK:
            f = lobe_at(p, directions[j], n_w).f
            lit = n_w * arriving(source, radiance, blocker_radiance, j)
            sum.diffuse += INV_PI * lit
            sum.specular += f * lit
    scale = FOUR_PI / float(directions.shape[0])
    row = vec32()
    for ch in range(3):
        row[ch] = scale * sum.diffuse[ch]
        row[3 + ch] = scale * sum.specular[ch]
    row[6] = sum.visible
    row[7] = sum.total
    add_row(out, i, 0, 8, row)


@wp.struct
@no_type_check
class PointSums:
    """Gradients of a point, summed over some of its directions."""

    n: wp.vec3
    v: wp.vec3
    g_v: float
    n_v: float
    aa: float


@wp.func
@no_type_check
def lobe_adjoint(p: Point, o: Lobe, v_f: float, v_n_w: float, sum: PointSums) -> PointSums:
    """The sums with one direction added. v.h and |H| depend on v.w only, |C| and n.H on the other variables."""
    to = sum
    v_log_f = v_f * o.f
    v_t_h2 = -2.0 * v_log_f / o.t_h2
    n_H = p.n_v + o.n_w
    v_n_H = 2.0 * v_t_h2 * p.aa * n_H
    to.g_v += v_log_f
    v_g_w = -v_log_f / o.g_w
    root = 2.0 * o.g_w - o.n_w
    to.aa += v_log_f / p.aa + v_t_h2 * n_H * n_H + v_g_w * (1.0 - o.n_w * o.n_w) / (4.0 * root)
    to.n_v += v_n_H
    v_HH = 2.0 * v_log_f / o.HH - v_f * o.rest * o.slope / (8.0 * o.vh)
    v_C = 2.0 * v_t_h2 * o.C
    to.n += wp.cross(p.v + o.w, v_C) + (v_n_w + v_n_H + v_g_w * 0.5 * (1.0 + (1.0 - p.aa) * o.n_w / root)) * o.w
    to.v += wp.cross(v_C, p.n) + 2.0 * v_HH * o.w
    return to


@wp.func
@no_type_check
def point_adjoint(p: Point, sum: PointSums, roughness: float) -> vec32:
    """Gradients of normal, view and roughness, in this order."""
    row = vec32()
    v_g_v = -sum.g_v / p.g_v
    v_n_v = sum.n_v
    facing = wp.max(p.n_v, 0.0)
    root = 2.0 * p.g_v - facing
    if p.n_v >= 0.0:
        v_n_v += v_g_v * 0.5 * (1.0 + (1.0 - p.aa) * facing / root)
    v_aa = sum.aa + v_g_v * (1.0 - facing * facing) / (4.0 * root)
    v_n = sum.n + v_n_v * p.v
    v_v = sum.v + v_n_v * p.n
    for a in range(3):
        row[a] = v_n[a]
        row[3 + a] = v_v[a]
    if roughness >= ROUGHNESS_MIN:
        row[6] = 4.0 * p.r * p.r * p.r * v_aa
    return row


@wp.kernel
@no_type_check
def shade_adjoint(
    normal: wp.array[wp.vec3],
    roughness: wp.array[float],
    view: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    visibility: wp.array2d[int],
    blocker: wp.array2d[int],
    rows: wp.array[wp.int64],
    blocker_radiance: wp.array[wp.vec3],
    v_diffuse: wp.array[wp.vec3],
    v_specular: wp.array[wp.vec3],
    v_points: wp.array2d[float],
):
    """Gradients of normal, view and roughness of each point."""
    i, lane = wp.tid()
    p = point_at(normal, roughness, view, i)
    sum = PointSums()
    seed = v_specular[i] * (FOUR_PI / float(directions.shape[0]))
    seed_diffuse = v_diffuse[i] * (4.0 / float(directions.shape[0]))
    for j in range(lane, directions.shape[0], LANES):
        n_w = wp.dot(p.n, directions[j])
        source = source_of(visibility, blocker, blocker_radiance, int(rows[i]), j)
        if n_w > 0.0 and source != BLACK:
            L = arriving(source, radiance, blocker_radiance, j)
            o = lobe_at(p, directions[j], n_w)
            specular = wp.dot(seed, L)
            v_n_w = wp.dot(seed_diffuse, L) + o.f * specular
            if o.exists:
                sum = lobe_adjoint(p, o, specular * n_w, v_n_w, sum)
            else:
                sum.n += v_n_w * directions[j]
    add_row(v_points, i, 0, 7, point_adjoint(p, sum, roughness[i]))


@wp.kernel
@no_type_check
def light_adjoint(
    normal: wp.array[wp.vec3],
    roughness: wp.array[float],
    view: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    visibility: wp.array2d[int],
    blocker: wp.array2d[int],
    rows: wp.array[wp.int64],
    v_diffuse: wp.array[wp.vec3],
    v_specular: wp.array[wp.vec3],
    v_radiance: wp.array[wp.vec3],
    v_blocker_radiance: wp.array[wp.vec3],
):
    """Gradients of the radiance of directions and blockers."""
    group, j = wp.tid()
    v_unblocked = wp.vec3()
    for i in range(POINTS * group, wp.min(POINTS * group + POINTS, normal.shape[0])):
        p = point_at(normal, roughness, view, i)
        n_w = wp.dot(p.n, directions[j])
        source = source_of(visibility, blocker, v_blocker_radiance, int(rows[i]), j)
        if n_w > 0.0 and source != BLACK:
            f = lobe_at(p, directions[j], n_w).f
            v_L = n_w * (INV_PI * v_diffuse[i] + f * v_specular[i])
            v_L *= FOUR_PI / float(directions.shape[0])
            if source == UNBLOCKED:
                v_unblocked += v_L
            else:
                wp.atomic_add(v_blocker_radiance, source, v_L)
    wp.atomic_add(v_radiance, j, v_unblocked)
