# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of the colour of Gaussians under one light of spherical harmonics, and of indirect light, with adjoints.

The formulas are in `Backend.sh_shade` and `Backend.bounce`; `v_x` is the gradient of x. *Coefficients* are 30 numbers:
q_k of three channels for k = 0 to 8, then the floor f of `sh_shade`.
"""

import math

import warp as wp

from tumble.backends import IRRADIANCE_FLOOR, NORMAL_GRADIENT, RATIO_MAX
from tumble.backends._warp.parameters import sigmoid
from tumble.backends._warp.projection import harmonics, harmonics_adjoint, rotation, rotation_adjoint, vec16
from tumble.backends._warp.runtime import add_row, no_type_check, vec32

wp.set_module_options({"enable_backward": False})

COEFFICIENTS = 30
"""Number of coefficients."""
LIGHT_SUMS = 109
"""Numbers of the gradients of light, specular scale, rotation and position, in this order."""
FOUR_PI = 4.0 * math.pi
INV_PI = 1.0 / math.pi
TO_FRACTION = math.sqrt(4.0 / math.pi)
"""Visible fraction of the hemisphere divided by the first number of its transfer vector."""


@wp.func
@no_type_check
def softplus(x: float) -> float:
    return wp.max(x, 0.0) + wp.log(1.0 + wp.exp(-wp.abs(x)))


@wp.func
@no_type_check
def matrix(R: wp.array2d[float]) -> wp.mat33:
    return wp.mat33(R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2])


@wp.func
@no_type_check
def series(light: wp.array2d[wp.vec3], lobe: int, Y: vec16) -> wp.vec3:
    sum = wp.vec3()
    for k in range(16):
        sum += Y[k] * light[lobe, k]
    return sum


@wp.func
@no_type_check
def projected(radiance: wp.vec3, direction: wp.vec3, factor: float, floor: float) -> vec32:
    """What the radiance from one direction adds to the coefficients."""
    Y = harmonics(direction)
    row = vec32()
    for ch in range(3):
        for k in range(9):
            row[3 * k + ch] = factor * Y[k] * radiance[ch]
        row[27 + ch] = floor * radiance[ch]
    return row


@wp.kernel
@no_type_check
def project_light(
    light: wp.array2d[wp.vec3], directions: wp.array[wp.vec3], R: wp.array2d[float], coefficients: wp.array2d[float]
):
    """The coefficients of the glossy radiance, object frame."""
    j = wp.tid()
    row = vec32()
    if j < directions.shape[0]:
        d = directions[j]
        at = series(light, 1, harmonics(matrix(R) * d))
        radiance = wp.vec3(softplus(at[0]), softplus(at[1]), softplus(at[2]))
        n = float(directions.shape[0])
        row = projected(radiance, d, FOUR_PI / n, IRRADIANCE_FLOOR * math.pi / n)
    add_row(coefficients, 0, 0, COEFFICIENTS, row)


@wp.struct
@no_type_check
class ShPoint:
    """Quantities of a Gaussian; `at` is a series before the softplus, `lobe` after it."""

    q: wp.vec4
    q_scale: float
    normal: wp.vec3
    view: wp.vec3
    away: float
    n_v: float
    mirrored: wp.vec3
    n_env: wp.vec3
    m_env: wp.vec3
    fresnel: float
    slope: float
    albedo: wp.vec3
    ratio: wp.vec3
    at_n: wp.vec3
    at_m: wp.vec3
    lobe_n: wp.vec3
    lobe_m: wp.vec3


@wp.struct
@no_type_check
class ShInputs:
    """Arguments of `sh_shade`, with the coefficients instead of its directions."""

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    albedo_logits: wp.array[wp.vec3]
    light: wp.array2d[wp.vec3]
    specular_scale: wp.array[float]
    R: wp.array2d[float]
    position: wp.array[wp.vec3]
    occluded: wp.array2d[float]
    unoccluded: wp.array2d[float]
    coefficients: wp.array2d[float]
    reflectance: wp.array[float]


@wp.func
@no_type_check
def irradiance(transfer: wp.array2d[float], i: int, coefficients: wp.array2d[float], albedo: wp.vec3) -> wp.vec3:
    """H of `Backend.sh_shade`."""
    hidden = 1.0 - wp.clamp(transfer[i, 0] * TO_FRACTION, 0.0, 1.0)
    out = wp.vec3()
    for ch in range(3):
        sum = float(0.0)
        for k in range(9):
            sum += transfer[i, k] * coefficients[0, 3 * k + ch]
        out[ch] = wp.max(sum, 0.0) / wp.max(1.0 - albedo[ch] * hidden, 1.0e-3)
    return out


@wp.func
@no_type_check
def sh_point(s: ShInputs, i: int) -> ShPoint:
    o = ShPoint()
    o.q_scale = 1.0 / wp.length(s.quats[i])
    o.q = s.quats[i] * o.q_scale
    R_obj_local = rotation(o.q)
    o.normal = wp.vec3(R_obj_local[0, 2], R_obj_local[1, 2], R_obj_local[2, 2])
    towards = s.position[0] - s.means[i]
    o.away = 1.0 / wp.max(wp.length(towards), 1.0e-12)
    o.view = towards * o.away
    o.n_v = wp.dot(o.normal, o.view)
    o.mirrored = 2.0 * o.n_v * o.normal - o.view
    R = matrix(s.R)
    o.n_env = R * o.normal
    o.m_env = R * o.mirrored
    m = 1.0 - wp.min(o.n_v, 1.0)
    power = float(1.0)
    before = float(0.0)
    for k in range(s.reflectance.shape[0]):
        o.fresnel += s.reflectance[k] * power
        o.slope -= float(k) * s.reflectance[k] * before
        before = power
        power *= m
    if o.n_v > 1.0:
        o.slope = 0.0
    o.at_n = series(s.light, 0, harmonics(o.n_env))
    o.at_m = series(s.light, 1, harmonics(o.m_env))
    for ch in range(3):
        o.albedo[ch] = sigmoid(s.albedo_logits[i][ch])
        o.ratio[ch] = 1.0
        o.lobe_n[ch] = softplus(o.at_n[ch])
        o.lobe_m[ch] = softplus(o.at_m[ch])
    if s.occluded.shape[0] > 0:
        shadowed = irradiance(s.occluded, i, s.coefficients, o.albedo)
        full = irradiance(s.unoccluded, i, s.coefficients, o.albedo)
        for ch in range(3):
            floor = s.coefficients[0, 27 + ch]
            o.ratio[ch] = wp.min((shadowed[ch] + floor) / wp.max(full[ch] + floor, 1.0e-12), RATIO_MAX)
    return o


@wp.kernel
@no_type_check
def sh_forward(s: ShInputs, out: wp.array[wp.vec3]):
    i = wp.tid()
    o = sh_point(s, i)
    colour = wp.vec3()
    if o.n_v > 0.0:
        glossy = s.specular_scale[0] * o.fresnel
        colour = wp.cw_mul(wp.cw_mul(o.albedo, o.ratio), o.lobe_n) + glossy * o.lobe_m
    out[i] = colour


@wp.struct
@no_type_check
class ShGradients:
    """Gradients of the arguments of `sh_shade`; `light` has rows of 32 numbers, LIGHT_SUMS in all."""

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    albedo_logits: wp.array[wp.vec3]
    light: wp.array2d[float]


@wp.kernel
@no_type_check
def sh_adjoint(s: ShInputs, v_out: wp.array[wp.vec3], to: ShGradients):
    i = wp.tid()
    v_at_n = wp.vec3()
    v_at_m = wp.vec3()
    Y_n = vec16()
    Y_m = vec16()
    pose = vec32()
    if i < s.means.shape[0]:
        o = sh_point(s, i)
        v_logits = wp.vec3()
        v_mean = wp.vec3()
        v_quat = wp.vec4()
        if o.n_v > 0.0:
            v_fresnel = float(0.0)
            for ch in range(3):
                v = v_out[i][ch]
                shaded = o.albedo[ch] * o.ratio[ch]
                v_glossy = v * s.specular_scale[0]
                v_logits[ch] = v * o.lobe_n[ch] * shaded * (1.0 - o.albedo[ch])
                v_fresnel += v_glossy * o.lobe_m[ch]
                pose[0] += v * o.lobe_m[ch] * o.fresnel
                v_at_n[ch] = v * shaded * sigmoid(o.at_n[ch])
                v_at_m[ch] = v_glossy * o.fresnel * sigmoid(o.at_m[ch])
            Y_n = harmonics(o.n_env)
            Y_m = harmonics(o.m_env)
            v_Y_n = vec16()
            v_Y_m = vec16()
            for k in range(16):
                v_Y_n[k] = wp.dot(v_at_n, s.light[0, k])
                v_Y_m[k] = wp.dot(v_at_m, s.light[1, k])
            v_n_env = harmonics_adjoint(o.n_env, v_Y_n)
            v_m_env = harmonics_adjoint(o.m_env, v_Y_m)
            R = wp.transpose(matrix(s.R))
            v_mirrored = R * v_m_env
            v_n_v = 2.0 * wp.dot(v_mirrored, o.normal) + o.slope * v_fresnel
            v_normal = NORMAL_GRADIENT * (R * v_n_env + 2.0 * o.n_v * v_mirrored + v_n_v * o.view)
            v_view = v_n_v * o.normal - v_mirrored
            v_R = wp.outer(v_n_env, o.normal) + wp.outer(v_m_env, o.mirrored)
            v_towards = (v_view - wp.dot(v_view, o.view) * o.view) * o.away
            for a in range(3):
                for b in range(3):
                    pose[1 + 3 * a + b] = v_R[a, b]
                pose[10 + a] = v_towards[a]
            v_mean = -v_towards
            v_q = rotation_adjoint(o.q, wp.outer(v_normal, wp.vec3(0.0, 0.0, 1.0)))
            v_quat = (v_q - wp.dot(v_q, o.q) * o.q) * o.q_scale
        to.means[i] = v_mean
        to.quats[i] = v_quat
        to.albedo_logits[i] = v_logits
    for part in range(3):
        row = vec32()
        for j in range(32):
            at = 32 * part + j
            if at < 48:
                row[j] = v_at_n[at % 3] * Y_n[at // 3]
            else:
                row[j] = v_at_m[at % 3] * Y_m[at // 3 - 16]
        add_row(to.light, part, 0, 32, row)
    add_row(to.light, 3, 0, 13, pose)


@wp.kernel
@no_type_check
def project_radiance(directions: wp.array[wp.vec3], radiance: wp.array[wp.vec3], coefficients: wp.array2d[float]):
    """The coefficients of the radiance from given directions, without a floor."""
    j = wp.tid()
    row = vec32()
    if j < directions.shape[0]:
        row = projected(radiance[j], directions[j], FOUR_PI / float(directions.shape[0]), 0.0)
    add_row(coefficients, 0, 0, COEFFICIENTS, row)


@wp.kernel
@no_type_check
def bounce_forward(
    albedo: wp.array[wp.vec3], transfer: wp.array2d[float], coefficients: wp.array2d[float], out: wp.array[wp.vec3]
):
    i = wp.tid()
    out[i] = INV_PI * wp.cw_mul(albedo[i], irradiance(transfer, i, coefficients, albedo[i]))


@wp.kernel
@no_type_check
def bounce_adjoint(
    albedo: wp.array[wp.vec3],
    transfer: wp.array2d[float],
    coefficients: wp.array2d[float],
    v_out: wp.array[wp.vec3],
    v_albedo: wp.array[wp.vec3],
    v_coefficients: wp.array2d[float],
):
    i = wp.tid()
    row = vec32()
    if i < albedo.shape[0]:
        hidden = 1.0 - wp.clamp(transfer[i, 0] * TO_FRACTION, 0.0, 1.0)
        v_a = wp.vec3()
        for ch in range(3):
            a = albedo[i][ch]
            sum = float(0.0)
            for k in range(9):
                sum += transfer[i, k] * coefficients[0, 3 * k + ch]
            rest = 1.0 - a * hidden
            inverse = 1.0 / wp.max(rest, 1.0e-3)
            v = INV_PI * v_out[i][ch] * inverse
            grows = float(0.0)
            if rest >= 1.0e-3:
                grows = a * hidden * inverse
            v_a[ch] = v * wp.max(sum, 0.0) * (1.0 + grows)
            if sum >= 0.0:
                for k in range(9):
                    row[3 * k + ch] = v * a * transfer[i, k]
        v_albedo[i] = v_a
    add_row(v_coefficients, 0, 0, COEFFICIENTS, row)


@wp.kernel
@no_type_check
def radiance_adjoint(directions: wp.array[wp.vec3], v_coefficients: wp.array2d[float], v_radiance: wp.array[wp.vec3]):
    """Add the gradient of the radiance from given directions, through their coefficients."""
    j = wp.tid()
    Y = harmonics(directions[j])
    v = wp.vec3()
    for ch in range(3):
        for k in range(9):
            v[ch] += Y[k] * v_coefficients[0, 3 * k + ch]
    v_radiance[j] += FOUR_PI / float(directions.shape[0]) * v
