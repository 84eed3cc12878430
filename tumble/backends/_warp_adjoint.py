# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
"""Adjoint of the projection: gradients of the Gaussians and the camera from the gradient sums over pixels.

Formulas and the layouts of sums, records and camera are in `_warp_project.py`. `v_x` is the gradient of x.
"""

import warp as wp

from tumble.backends._warp import add_row, no_type_check, vec32
from tumble.backends._warp_project import (
    UV,
    Projected,
    colour,
    harmonics,
    harmonics_adjoint,
    project,
    rotation_adjoint,
    vec16,
)

wp.set_module_options({"enable_backward": False})


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
