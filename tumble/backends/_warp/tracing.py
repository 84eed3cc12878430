# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018, RUF046 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of ray tracing through Gaussians, with Warp's bounding volume hierarchy.

The *record* of a Gaussian is four groups of four numbers: the rows of its whitening matrix W, each followed by a
coordinate of its mean, and its opacity.

Visibility is traced with one ray per thread and 32 directions of one point per warp, which visit the same boxes at
first; blockers in one direction at many points, which lie in the order of a space-filling curve. Measured on an H200
(docs/experiments/constants.md), each is the faster way round for its rays.
"""

import warp as wp

from tumble.backends import ALPHA_MAX, ALPHA_MIN, TRACE_SIGMAS, TRACE_T_MIN, VISIBLE
from tumble.backends._warp.projection import rotation
from tumble.backends._warp.runtime import no_type_check, write_lanes

wp.set_module_options({"enable_backward": False})

HITS_PER_PASS = 8
"""Number of nearest hits that a ray collects in one traversal; further hits need another traversal behind these."""
UNREACHABLE = 3.0e38
"""Distance of an unused hit, and coordinates of the box of an empty scene."""
MAX_DISTANCE = 1.0e30
"""Upper limit of the distance of hits."""
REACH_2 = TRACE_SIGMAS * TRACE_SIGMAS
"""Largest squared distance of a peak from the centre [variances]."""

vec8 = wp.types.vector(length=HITS_PER_PASS, dtype=float)
vec8i = wp.types.vector(length=HITS_PER_PASS, dtype=int)


@wp.kernel
@no_type_check
def enclose(
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacity: wp.array[float],
    record: wp.array2d[wp.vec4],
    low: wp.array[wp.vec3],
    high: wp.array[wp.vec3],
):
    """Write the record of each Gaussian, and the bounding box of its region that rays can hit."""
    i = wp.tid()
    R = rotation(wp.normalize(quats[i]))
    mean = means[i]
    s = scales[i]
    # Slightly wider than the thresholds, against rounding errors.
    cut = wp.min(2.0 * wp.log(wp.max(opacity[i] / ALPHA_MIN, 1.0)) + 1.0e-4, REACH_2 * 1.0001)
    half = wp.vec3()
    for a in range(3):
        side = wp.cw_mul(wp.vec3(R[a, 0], R[a, 1], R[a, 2]), s)
        half[a] = wp.sqrt(cut * wp.dot(side, side)) * 1.00001 + 1.0e-6
        record[i, a] = wp.vec4(R[0, a] / s[a], R[1, a] / s[a], R[2, a] / s[a], mean[a])
    record[i, 3] = wp.vec4(opacity[i], 0.0, 0.0, 0.0)
    low[i] = mean - half
    high[i] = mean + half


@wp.func
@no_type_check
def intersect(record: wp.array2d[wp.vec4], i: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """Alpha of a Gaussian on a ray, 0 if it is not hit, and the distance of its peak."""
    missed = wp.vec2(0.0, 0.0)
    x = record[i, 0]
    y = record[i, 1]
    z = record[i, 2]
    to = wp.vec3(x[3], y[3], z[3]) - origin
    W = wp.matrix_from_rows(wp.vec3(x[0], x[1], x[2]), wp.vec3(y[0], y[1], y[2]), wp.vec3(z[0], z[1], z[2]))
    Wd = W * direction
    Wp = W * to
    along = wp.dot(Wp, Wd)
    if along <= 0.0 or Wd[2] > 0.0:
        return missed
    distance = along / wp.dot(Wd, Wd)
    off = distance * Wd - Wp
    off_2 = wp.dot(off, off)
    if off_2 > REACH_2:
        return missed
    alpha = record[i, 3][0] * wp.exp(-0.5 * off_2)
    if alpha < ALPHA_MIN:
        return missed
    return wp.vec2(wp.min(alpha, ALPHA_MAX), distance)


@wp.func
@no_type_check
def is_visible(boxes: wp.uint64, record: wp.array2d[wp.vec4], origin: wp.vec3, direction: wp.vec3) -> bool:
    T = float(1.0)
    i = int(0)
    query = wp.bvh_query_ray(boxes, origin, direction)
    while wp.bvh_query_next(query, i):
        T *= 1.0 - intersect(record, i, origin, direction)[0]
        if T < VISIBLE:
            break
    return T >= VISIBLE


@wp.struct
@no_type_check
class Nearest:
    """The nearest hits of a ray, by distance; equal distances (exact duplicates) are ordered by index."""

    z: vec8
    alpha: vec8
    i: vec8i


@wp.func
@no_type_check
def before(z: float, i: int, other_z: float, other_i: int) -> bool:
    return z < other_z or (z == other_z and i < other_i)


@wp.func
@no_type_check
def nearest_behind(
    boxes: wp.uint64, record: wp.array2d[wp.vec4], origin: wp.vec3, direction: wp.vec3, last_z: float, last_i: int
) -> Nearest:
    """The nearest hits of a ray behind the hit (last_z, last_i)."""
    o = Nearest()
    for j in range(HITS_PER_PASS):
        o.z[j] = UNREACHABLE
    i = int(0)
    query = wp.bvh_query_ray(boxes, origin, direction)
    # A box contains all peaks of its Gaussian, so boxes behind the last collected hit need not be visited.
    while wp.bvh_query_next(query, i, wp.min(o.z[HITS_PER_PASS - 1] * 1.0001, MAX_DISTANCE)):
        hit = intersect(record, i, origin, direction)
        alpha = hit[0]
        z = hit[1]
        if alpha > 0.0 and before(last_z, last_i, z, i):
            inserted = i
            for j in range(HITS_PER_PASS):
                if before(z, inserted, o.z[j], o.i[j]):
                    z_j = o.z[j]
                    i_j = o.i[j]
                    alpha_j = o.alpha[j]
                    o.z[j] = z
                    o.i[j] = inserted
                    o.alpha[j] = alpha
                    z = z_j
                    inserted = i_j
                    alpha = alpha_j
    return o


@wp.struct
@no_type_check
class Traced:
    """Result of tracing a ray: transmittance, radiance and dominant Gaussian."""

    T: float
    radiance: wp.vec3
    hit: int


@wp.func
@no_type_check
def trace_ray(
    boxes: wp.uint64,
    record: wp.array2d[wp.vec4],
    radiance: wp.array[wp.vec3],
    origin: wp.vec3,
    direction: wp.vec3,
) -> Traced:
    """Blend the hits of a ray front to back."""
    o = Traced()
    o.T = 1.0
    o.hit = -1
    best = float(0.0)
    z = float(-1.0)
    i = int(-1)
    searching = bool(True)
    while searching:
        hits = nearest_behind(boxes, record, origin, direction, z, i)
        for j in range(HITS_PER_PASS):
            if hits.z[j] < MAX_DISTANCE and o.T >= TRACE_T_MIN:
                i = hits.i[j]
                w = o.T * hits.alpha[j]
                if w > best:
                    best = w
                    o.hit = i
                if radiance.shape[0] > 0:
                    o.radiance += w * radiance[i]
                o.T -= w
        z = hits.z[HITS_PER_PASS - 1]
        searching = z < MAX_DISTANCE and o.T >= TRACE_T_MIN
    if o.T < TRACE_T_MIN:
        o.radiance /= 1.0 - o.T
        o.T = 0.0
    return o


@wp.kernel
@no_type_check
def trace_rays(
    boxes: wp.uint64,
    record: wp.array2d[wp.vec4],
    radiance: wp.array[wp.vec3],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    T: wp.array[float],
    out: wp.array[wp.vec3],
    hit: wp.array[int],
):
    ray = wp.tid()
    o = trace_ray(boxes, record, radiance, origins[ray], directions[ray])
    T[ray] = o.T
    out[ray] = o.radiance
    hit[ray] = o.hit


@wp.kernel
@no_type_check
def trace_visibility(
    boxes: wp.uint64,
    record: wp.array2d[wp.vec4],
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    bits: wp.array2d[int],
):
    """Write the visibility bits of each point: one ray per thread, and one word per warp."""
    point, j = wp.tid()
    seen = bool(False)
    if j < directions.shape[0] and wp.dot(normals[point], directions[j]) > 0.0:
        seen = is_visible(boxes, record, points[point], directions[j])
    write_lanes(bits, point, j, seen)


@wp.kernel
@no_type_check
def find_blockers(
    boxes: wp.uint64,
    record: wp.array2d[wp.vec4],
    no_radiance: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    bits: wp.array2d[int],
    blocker: wp.array2d[int],
):
    """Write the dominant Gaussian in each blocked direction above the horizon of each point; -1 elsewhere."""
    j, point = wp.tid()
    index = int(-1)
    visible = (bits[point, j // 32] >> (j % 32)) & 1
    if visible == 0 and wp.dot(normals[point], directions[j]) > 0.0:
        index = trace_ray(boxes, record, no_radiance, points[point], directions[j]).hit
    blocker[point, j] = index
