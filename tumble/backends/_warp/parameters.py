# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018, RUF046 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of raw parameters: the activations of Gaussians and of their materials with adjoints, and steps of Adam.

`v_x` is the gradient of x. Adam processes up to LEAVES leaves per launch; the numbers of all of them are counted
together, and those of leaf k end at ends[k].
"""

import warp as wp

from tumble.backends._warp.runtime import Addresses, add_lanes, no_type_check, numbers

wp.set_module_options({"enable_backward": False})

LEAVES = 16
"""Number of leaves of a launch."""
Ends = wp.types.vector(length=LEAVES, dtype=int)
Rates = wp.types.vector(length=LEAVES, dtype=float)


@wp.func
@no_type_check
def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + wp.exp(-x))


@wp.kernel
@no_type_check
def activate_forward(
    log_scales: wp.array[wp.vec3],
    sdf: wp.array[float],
    gamma: wp.array[float],
    scales: wp.array[wp.vec3],
    opacity: wp.array[float],
):
    i = wp.tid()
    x = log_scales[i]
    scales[i] = wp.vec3(wp.exp(x[0]), wp.exp(x[1]), wp.exp(x[2]))
    inside = sigmoid(-gamma[0] * sdf[i])
    opacity[i] = 4.0 * inside * (1.0 - inside)


@wp.kernel
@no_type_check
def activate_adjoint(
    scales: wp.array[wp.vec3],
    sdf: wp.array[float],
    gamma: wp.array[float],
    v_scales: wp.array[wp.vec3],
    v_opacity: wp.array[float],
    v_log_scales: wp.array[wp.vec3],
    v_sdf: wp.array[float],
    v_gamma: wp.array[float],
):
    """Gradients of each Gaussian and of gamma; the latter is summed over lanes, which needs whole warps."""
    i = wp.tid()
    v = float(0.0)
    if i < sdf.shape[0]:
        v_log_scales[i] = wp.cw_mul(v_scales[i], scales[i])
        inside = sigmoid(-gamma[0] * sdf[i])
        v_exponent = v_opacity[i] * 4.0 * inside * (1.0 - inside) * (2.0 * inside - 1.0)
        v_sdf[i] = v_exponent * gamma[0]
        v = v_exponent * sdf[i]
    add_lanes(v_gamma, 0, v)


@wp.kernel
@no_type_check
def corners_forward(
    albedo_logits: wp.array2d[wp.vec3],
    roughness_logits: wp.array2d[float],
    normal_offset: wp.array2d[wp.vec3],
    temperature: float,
    corners: wp.array3d[float],
    albedo: wp.array[wp.vec3],
):
    i = wp.tid()
    mean = wp.vec3()
    for k in range(4):
        for ch in range(3):
            a = sigmoid(albedo_logits[i, k][ch] / temperature)
            corners[i, k, ch] = a
            corners[i, k, 4 + ch] = normal_offset[i, k][ch]
            mean[ch] += 0.25 * a
        corners[i, k, 3] = sigmoid(roughness_logits[i, k] / temperature)
    albedo[i] = mean


@wp.kernel
@no_type_check
def corners_adjoint(
    corners: wp.array3d[float],
    temperature: float,
    v_corners: wp.array3d[float],
    v_albedo: wp.array[wp.vec3],
    v_albedo_logits: wp.array3d[float],
    v_roughness_logits: wp.array2d[float],
    v_normal_offset: wp.array3d[float],
):
    i = wp.tid()
    for k in range(4):
        for ch in range(3):
            a = corners[i, k, ch]
            v_albedo_logits[i, k, ch] = a * (1.0 - a) / temperature * (v_corners[i, k, ch] + 0.25 * v_albedo[i][ch])
            v_normal_offset[i, k, ch] = v_corners[i, k, 4 + ch]
        r = corners[i, k, 3]
        v_roughness_logits[i, k] = r * (1.0 - r) / temperature * v_corners[i, k, 3]


@wp.func
@no_type_check
def leaf_of(ends: Ends, i: int) -> int:
    """The leaf of a number."""
    k = int(0)
    for j in range(LEAVES - 1):
        if i >= ends[j]:
            k = j + 1
    return k


@wp.func
@no_type_check
def start_of(ends: Ends, k: int) -> int:
    if k == 0:
        return 0
    return ends[k - 1]


@wp.kernel
@no_type_check
def find_not_finite(gradients: Addresses, ends: Ends, failed: wp.array[float]):
    """Set `failed` if a number is not finite."""
    i = wp.tid()
    k = leaf_of(ends, i)
    x = numbers(gradients[k])
    if not wp.isfinite(x[i - start_of(ends, k)]):
        wp.atomic_max(failed, 0, 1.0)


@wp.kernel
@no_type_check
def count_step(
    counts: Addresses,
    rates: Rates,
    factors: Addresses,
    beta_1: wp.float64,
    beta_2: wp.float64,
    failed: wp.array[float],
    corrections: wp.array2d[float],
):
    """Count a step of each leaf, and write its rate (times its factor) and root of the second moment, corrected."""
    k = wp.tid()
    count = numbers(counts[k])
    n = count[0] + 1.0 - failed[0]
    count[0] = n
    one = wp.float64(1.0)
    factor = numbers(factors[k])
    corrections[k, 0] = rates[k] * factor[0] / float(one - wp.pow(beta_1, wp.float64(n)))
    corrections[k, 1] = float(wp.sqrt(one - wp.pow(beta_2, wp.float64(n))))


@wp.kernel
@no_type_check
def adam_step(
    values: Addresses,
    gradients: Addresses,
    firsts: Addresses,
    seconds: Addresses,
    ends: Ends,
    corrections: wp.array2d[float],
    beta_2: float,
    rest_1: float,
    rest_2: float,
    eps: float,
    failed: wp.array[float],
):
    """Move the numbers unless `failed` is set; rest_1 is 1 - beta_1, which in float32 would have lost its digits."""
    i = wp.tid()
    if failed[0] > 0.0:
        return
    k = leaf_of(ends, i)
    j = i - start_of(ends, k)
    gradient = numbers(gradients[k])
    first = numbers(firsts[k])
    second = numbers(seconds[k])
    value = numbers(values[k])
    g = gradient[j]
    m = first[j] + rest_1 * (g - first[j])
    v = beta_2 * second[j] + rest_2 * g * g
    first[j] = m
    second[j] = v
    value[j] -= corrections[k, 0] * m / (wp.sqrt(v) / corrections[k, 1] + eps)
