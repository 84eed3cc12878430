# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of the loss terms of Gaussians (`Backend.gaussian_terms`) with their gradients.

Every term is differentiated at once: each input belongs to one term only, so that the gradients for other seeds are
multiples.
"""

import warp as wp

from tumble.backends._warp.image_losses import sign
from tumble.backends._warp.projection import rotation, rotation_adjoint
from tumble.backends._warp.runtime import add_row, count_lanes, no_type_check, vec32
from tumble.backends._warp.sh_lighting import matrix

wp.set_module_options({"enable_backward": False})

HALF_SHARPNESS = 1.762747
"""Product of sharpness and distance at which the opacity is one half."""


@wp.struct
@no_type_check
class GaussianInputs:
    """Arguments of `gaussian_terms`, the median of |sdf|, and the number of Gaussians with a positive weight."""

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    log_scales: wp.array[wp.vec3]
    sdf: wp.array[float]
    gamma: wp.array[float]
    R: wp.array2d[float]
    t: wp.array[wp.vec3]
    weight: wp.array[float]
    depth: wp.array2d[float]
    focal: wp.array[float]
    weights: wp.vec3
    floor: float
    reach: float
    median: wp.array[float]
    seen: wp.array[int]


@wp.struct
@no_type_check
class GaussianGradients:
    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    log_scales: wp.array[wp.vec3]
    sdf: wp.array[float]
    gamma: wp.array[float]
    R: wp.array2d[float]
    t: wp.array2d[float]


@wp.kernel
@no_type_check
def count_seen(sdf: wp.array[float], weight: wp.array[float], magnitudes: wp.array[float], seen: wp.array[int]):
    i = wp.tid()
    is_seen = bool(False)
    if i < sdf.shape[0]:
        magnitudes[i] = wp.abs(sdf[i])
        is_seen = weight[i] > 0.0
    count_lanes(seen, 0, is_seen)


@wp.func
@no_type_check
def depth_at(depth: wp.array2d[float], u: float, v: float) -> float:
    """Depth at a pixel position, bilinear between pixel centres and 0 outside of the image."""
    height = depth.shape[0]
    width = depth.shape[1]
    z = float(0.0)
    # False, too, for what is not a number.
    if u > -1.0 and v > -1.0 and u < float(width) + 1.0 and v < float(height) + 1.0:
        x = wp.floor(u - 0.5)
        y = wp.floor(v - 0.5)
        fx = u - 0.5 - x
        fy = v - 0.5 - y
        for k in range(4):
            column = int(x) + k % 2
            row = int(y) + k // 2
            if column >= 0 and column < width and row >= 0 and row < height:
                z += wp.where(k % 2 == 0, 1.0 - fx, fx) * wp.where(k // 2 == 0, 1.0 - fy, fy) * depth[row, column]
    return z


@wp.func
@no_type_check
def needle_term(s: GaussianInputs, i: int, to: GaussianGradients) -> float:
    """The first term of a Gaussian; writes its gradient."""
    factor = s.weights[0] / float(s.sdf.shape[0])
    logs = 2.0 * s.log_scales[i]
    highest = wp.max(wp.max(logs[0], logs[1]), logs[2])
    sum = float(0.0)
    for a in range(3):
        sum += wp.exp(logs[a] - highest)
    log_sum = highest + wp.log(sum)
    p = wp.vec3()
    entropy = float(0.0)
    for a in range(3):
        logs[a] = logs[a] - log_sum
        p[a] = wp.exp(logs[a])
        entropy -= p[a] * logs[a]
    rank = wp.exp(entropy)
    needle = -wp.log(wp.max(rank - 1.0, 1.0e-4))
    v_entropy = float(0.0)
    if needle >= 0.0 and rank - 1.0 >= 1.0e-4:
        v_entropy = -rank / (rank - 1.0)
    thickness = wp.exp(s.log_scales[i][2])
    v = wp.vec3(0.0, 0.0, factor * thickness)
    for a in range(3):
        v[a] -= 2.0 * factor * v_entropy * p[a] * (logs[a] + entropy)
    to.log_scales[i] = v
    return factor * (wp.max(needle, 0.0) + thickness)


@wp.func
@no_type_check
def projection_term(s: GaussianInputs, i: int, to: GaussianGradients) -> vec32:
    """The third term of a Gaussian and the gradients of R and t, in this order; writes its own gradients."""
    row = vec32()
    v_mean = wp.vec3()
    v_quat = wp.vec4()
    v_sdf = float(0.0)
    if s.weight[i] > 0.0:
        q_scale = 1.0 / wp.length(s.quats[i])
        q = s.quats[i] * q_scale
        R_obj_local = rotation(q)
        normal = wp.vec3(R_obj_local[0, 2], R_obj_local[1, 2], R_obj_local[2, 2])
        point = s.means[i] - s.sdf[i] * normal
        x_cam = matrix(s.R) * point + s.t[0]
        u = s.focal[0] * x_cam[0] / x_cam[2] + s.focal[2]
        v = s.focal[1] * x_cam[1] / x_cam[2] + s.focal[3]
        surface = depth_at(s.depth, u, v)
        error = surface - x_cam[2]
        if wp.abs(error) < s.reach and surface > 0.0:
            factor = s.weights[2] / float(s.seen[0]) * sign(error)
            row[0] = factor * error
            towards = wp.vec3(s.R[2, 0], s.R[2, 1], s.R[2, 2])
            v_mean = -factor * towards
            v_sdf = factor * wp.dot(towards, normal)
            v_normal = factor * s.sdf[i] * towards
            v_q = rotation_adjoint(q, wp.outer(v_normal, wp.vec3(0.0, 0.0, 1.0)))
            v_quat = (v_q - wp.dot(v_q, q) * q) * q_scale
            for a in range(3):
                row[7 + a] = -factor * point[a]
            row[12] = -factor
    to.means[i] = v_mean
    to.quats[i] = v_quat
    to.sdf[i] = v_sdf
    return row


@wp.kernel
@no_type_check
def all_terms(s: GaussianInputs, terms: wp.array2d[float], to: GaussianGradients):
    i = wp.tid()
    of_terms = vec32()
    of_R = vec32()
    of_t = vec32()
    if i < s.sdf.shape[0]:
        of_terms[0] = needle_term(s, i, to)
        row = projection_term(s, i, to)
        of_terms[2] = row[0]
        for j in range(9):
            of_R[j] = row[1 + j]
        of_t[2] = row[12]
    if i == 0:
        missing = HALF_SHARPNESS / wp.max(s.median[0], s.floor) - s.gamma[0]
        of_terms[1] = s.weights[1] * wp.max(missing, 0.0)
        to.gamma[0] = wp.where(missing >= 0.0, -s.weights[1], 0.0)
    add_row(terms, 0, 0, 3, of_terms)
    add_row(to.R, 0, 0, 9, of_R)
    add_row(to.t, 0, 0, 3, of_t)
