# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of the photometric term of shaded pixels and its gradients (`Backend.shading_term`).

The lobes, lookups and indirect light are those of the kernels of their own; here is what lies between them. `v_x` is
the gradient of x. Arrays of *looked* directions hold all directions of the light, then the mirrored view directions of
all points.
"""

import warp as wp

from tumble.backends import NARROW_ROUGHNESS, ROUGHNESS_MIN
from tumble.backends._warp.image_losses import as_captured, sign
from tumble.backends._warp.runtime import add_row, no_type_check, vec32
from tumble.backends._warp.sh_lighting import matrix

wp.set_module_options({"enable_backward": False})

NARROW, WIDE = NARROW_ROUGHNESS


@wp.struct
@no_type_check
class ShadingInputs:
    """Arguments of `shading_term`, with images as lists of pixels; `cell` is the roughness of a direction's cell."""

    features: wp.array2d[float]
    alpha: wp.array[float]
    normal: wp.array[wp.vec3]
    photo: wp.array[wp.vec3ub]
    dominant: wp.array[int]
    pixels: wp.array[wp.int64]
    width: int
    R_cam_obj: wp.array2d[float]
    R_env_obj: wp.array2d[float]
    focal: wp.array[float]
    f0: wp.array[float]
    table: wp.array2d[float]
    directions: wp.array[wp.vec3]
    cell: float


@wp.struct
@no_type_check
class ShadedPoints:
    """Quantities of all points and looked directions."""

    normal: wp.array[wp.vec3]
    view: wp.array[wp.vec3]
    roughness: wp.array[float]
    rows: wp.array[wp.int64]
    looked: wp.array[wp.vec3]
    levels: wp.array[float]
    light: wp.array[wp.vec3]
    lobes: wp.array2d[float]
    """Results of `shading.shade_forward`."""
    v_diffuse: wp.array[wp.vec3]
    v_specular: wp.array[wp.vec3]
    v_light: wp.array[wp.vec3]
    v_own: wp.array[wp.vec2]
    """Gradients of n.v and of the roughness, other than those through lobes and lookups."""
    v_points: wp.array2d[float]
    """Results of `shading.shade_adjoint`."""
    v_looked: wp.array[wp.vec3]
    v_levels: wp.array[float]


@wp.struct
@no_type_check
class ShadingGradients:
    features: wp.array2d[float]
    alpha: wp.array[float]
    normal: wp.array[wp.vec3]
    R_cam_obj: wp.array2d[float]
    R_env_obj: wp.array2d[float]
    f0: wp.array2d[float]


@wp.func
@no_type_check
def pixel_of(s: ShadingInputs, i: int) -> int:
    return wp.max(int(s.pixels[i]), 0)


@wp.func
@no_type_check
def ray_of(s: ShadingInputs, pixel: int) -> wp.vec3:
    """Direction of a pixel in the camera frame, with z = 1."""
    x = float(pixel % s.width) + 0.5 - s.focal[2]
    y = float(pixel // s.width) + 0.5 - s.focal[3]
    return wp.vec3(x / s.focal[0], y / s.focal[1], 1.0)


@wp.func
@no_type_check
def summed_normal(s: ShadingInputs, pixel: int) -> wp.vec3:
    """Normal with its offset, of any length."""
    return s.normal[pixel] + wp.vec3(s.features[pixel, 4], s.features[pixel, 5], s.features[pixel, 6])


@wp.kernel
@no_type_check
def find_points(s: ShadingInputs, to: ShadedPoints):
    """Normals, views and looked directions."""
    k = wp.tid()
    d = s.directions.shape[0]
    R = matrix(s.R_env_obj)
    if k < d:
        to.looked[k] = R * s.directions[k]
        to.levels[k] = s.cell
        return
    i = k - d
    pixel = pixel_of(s, i)
    n = summed_normal(s, pixel)
    n = n / wp.max(wp.length(n), 1.0e-12)
    v = -wp.normalize(wp.transpose(matrix(s.R_cam_obj)) * ray_of(s, pixel))
    to.normal[i] = n
    to.view[i] = v
    to.looked[k] = R * (2.0 * wp.dot(n, v) * n - v)
    to.levels[k] = s.features[pixel, 3]
    to.roughness[i] = s.features[pixel, 3]
    to.rows[i] = wp.int64(wp.max(s.dominant[pixel], 0))


@wp.func
@no_type_check
def reflectance(table: wp.array2d[float], n_v: float, roughness: float) -> wp.vec3:
    """Directional albedo of the specular lobe divided by f0, and its slopes in n.v and roughness."""
    size = table.shape[0]
    top = float(size - 1)
    range = top / (1.0 - ROUGHNESS_MIN)
    x = wp.clamp(n_v, 0.0, 1.0) * top
    y = wp.clamp((roughness - ROUGHNESS_MIN) * range, 0.0, top)
    i = wp.min(int(x), size - 2)
    j = wp.min(int(y), size - 2)
    fx = x - float(i)
    fy = y - float(j)
    below = wp.lerp(table[i, j], table[i + 1, j], fx)
    above = wp.lerp(table[i, j + 1], table[i + 1, j + 1], fx)
    o = wp.vec3(wp.lerp(below, above, fy), 0.0, 0.0)
    if n_v >= 0.0 and n_v <= 1.0:
        o[1] = top * wp.lerp(table[i + 1, j] - table[i, j], table[i + 1, j + 1] - table[i, j + 1], fy)
    if roughness >= ROUGHNESS_MIN and roughness <= 1.0:
        o[2] = range * (above - below)
    return o


@wp.kernel
@no_type_check
def compare(s: ShadingInputs, to: ShadedPoints, term: wp.array2d[float], gradients: ShadingGradients):
    """The term, and the gradients of lobes, mirrored light, albedo, coverage and f0."""
    i = wp.tid()
    row = vec32()
    of_f0 = vec32()
    p = s.pixels.shape[0]
    if i < p:
        k = s.directions.shape[0] + i
        pixel = pixel_of(s, i)
        weight = wp.where(s.pixels[i] < wp.int64(0), 0.0, 1.0 / float(3 * p))
        rough = to.roughness[i]
        G = reflectance(s.table, wp.dot(to.normal[i], to.view[i]), rough)
        seen = to.lobes[i, 6] / wp.max(to.lobes[i, 7], 1.0e-37)
        share = (rough - NARROW) / (WIDE - NARROW)
        wide = wp.clamp(share, 0.0, 1.0)
        alpha = s.alpha[pixel]
        v_alpha = float(0.0)
        v_wide = float(0.0)
        v_G = float(0.0)
        v_diffuse = wp.vec3()
        v_specular = wp.vec3()
        v_light = wp.vec3()
        for ch in range(3):
            albedo = s.features[pixel, ch]
            diffuse = to.lobes[i, ch]
            summed = to.lobes[i, 3 + ch]
            mirrored = to.light[k][ch]
            narrow = mirrored * seen * G[0]
            specular = wp.lerp(narrow, summed, wide)
            out = albedo * diffuse + s.f0[ch] * specular
            o = as_captured(alpha * out, float(s.photo[pixel][ch]))
            row[0] += weight * wp.abs(o.x - o.y)
            v = weight * sign(o.x - o.y) * o.slope
            v_alpha += v * out
            v *= alpha
            wp.atomic_add(gradients.features, pixel, ch, v * diffuse)
            v_diffuse[ch] = v * albedo
            of_f0[ch] = v * specular
            v *= s.f0[ch]
            v_specular[ch] = v * wide
            v_wide += v * (summed - narrow)
            v_narrow = v * (1.0 - wide)
            v_light[ch] = v_narrow * seen * G[0]
            v_G += v_narrow * mirrored * seen
        wp.atomic_add(gradients.alpha, pixel, v_alpha)
        to.v_diffuse[i] = v_diffuse
        to.v_specular[i] = v_specular
        to.v_light[k] = v_light
        v_rough = v_G * G[2]
        if share >= 0.0 and share <= 1.0:
            v_rough += v_wide / (WIDE - NARROW)
        to.v_own[i] = wp.vec2(v_G * G[1], v_rough)
    add_row(term, 0, 0, 1, row)
    add_row(gradients.f0, 0, 0, 3, of_f0)


@wp.kernel
@no_type_check
def points_adjoint(s: ShadingInputs, a: ShadedPoints, to: ShadingGradients):
    """Gradients of images and rotations from those of normals, views, looked directions and roughness."""
    k = wp.tid()
    of_cam = vec32()
    v_cam = wp.mat33()
    v_env = wp.mat33()
    d = s.directions.shape[0]
    i = k - d
    if k < d:
        v_env = wp.outer(a.v_looked[k], s.directions[k])
    elif i < s.pixels.shape[0]:
        pixel = pixel_of(s, i)
        n = a.normal[i]
        v = a.view[i]
        n_v = wp.dot(n, v)
        of_cosine = a.v_own[i][0]
        v_m = wp.transpose(matrix(s.R_env_obj)) * a.v_looked[k]
        m_n = wp.dot(v_m, n)
        v_n = wp.vec3(a.v_points[i, 0], a.v_points[i, 1], a.v_points[i, 2])
        v_n += 2.0 * (n_v * v_m + m_n * v) + of_cosine * v
        v_v = wp.vec3(a.v_points[i, 3], a.v_points[i, 4], a.v_points[i, 5])
        v_v += 2.0 * m_n * n - v_m + of_cosine * n
        v_n = (v_n - wp.dot(v_n, n) * n) / wp.max(wp.length(summed_normal(s, pixel)), 1.0e-12)
        ray = ray_of(s, pixel)
        v_u = (v_v - wp.dot(v_v, v) * v) / wp.length(ray)
        v_cam = -wp.outer(ray, v_u)
        v_env = wp.outer(a.v_looked[k], 2.0 * n_v * n - v)
        wp.atomic_add(to.features, pixel, 3, a.v_points[i, 6] + a.v_levels[k] + a.v_own[i][1])
        for j in range(3):
            wp.atomic_add(to.features, pixel, 4 + j, v_n[j])
        wp.atomic_add(to.normal, pixel, v_n)
    of_env = vec32()
    for j in range(9):
        of_cam[j] = v_cam[j // 3, j % 3]
        of_env[j] = v_env[j // 3, j % 3]
    add_row(to.R_cam_obj, 0, 0, 9, of_cam)
    add_row(to.R_env_obj, 0, 0, 9, of_env)
