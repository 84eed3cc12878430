# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of the loss terms of images (`Backend.image_terms`, `Backend.material_terms`) with their gradients.

Every term is differentiated at once: each input belongs to one term only, so that the gradients for other seeds are
multiples (`scale`). SSIM's window is a product of two, along rows and along columns, and so are its sums.
"""

import math

import warp as wp

from tumble.backends import KNEE, OBJECT, SATURATED, SSIM_SIGMA, SSIM_STABILISERS, SSIM_WINDOW, UNKNOWN
from tumble.backends._warp.parameters import Ends, leaf_of
from tumble.backends._warp.runtime import add_lanes, add_row, no_type_check, vec32
from tumble.backends._warp.sh_lighting import matrix

wp.set_module_options({"enable_backward": False})

MARGIN = SSIM_WINDOW - 1
"""Rows and columns by which the image of SSIM is smaller."""
C1, C2 = SSIM_STABILISERS
_WEIGHTS = [math.exp(-0.5 * ((i - SSIM_WINDOW // 2) / SSIM_SIGMA) ** 2) for i in range(SSIM_WINDOW)]
TAPS = wp.constant(wp.types.vector(length=SSIM_WINDOW, dtype=float)(*(x / sum(_WEIGHTS) for x in _WEIGHTS)))
"""Weights of the window of SSIM along one axis."""


@wp.kernel
@no_type_check
def scale(gradients: wp.array[float], ends: Ends, terms: Ends, v_terms: wp.array[float], out: wp.array[float]):
    """Gradients of parts of an array, the k-th of which belongs to the term terms[k] and ends at ends[k]."""
    i = wp.tid()
    out[i] = v_terms[terms[leaf_of(ends, i)]] * gradients[i]


@wp.struct
@no_type_check
class ImageInputs:
    """Arguments of `image_terms`; the weights of its terms are divided by the number of pixels."""

    rgb: wp.array2d[wp.vec3]
    alpha: wp.array2d[float]
    depth: wp.array2d[float]
    depth_var: wp.array2d[float]
    normal: wp.array2d[wp.vec3]
    R: wp.array2d[float]
    photo: wp.array2d[wp.vec3ub]
    mask: wp.array2d[wp.uint8]
    focal: wp.array[float]
    weights: wp.vec4
    ssim_weight: float
    crease: float


@wp.struct
@no_type_check
class ImageGradients:
    rgb: wp.array2d[wp.vec3]
    alpha: wp.array2d[float]
    depth: wp.array2d[float]
    depth_var: wp.array2d[float]
    normal: wp.array2d[wp.vec3]
    R: wp.array2d[float]


@wp.struct
@no_type_check
class Planes:
    """Images between the kernels: rendering and photo in sRGB, derivative of the former, and sums for SSIM."""

    x: wp.array2d[wp.vec3]
    y: wp.array2d[wp.vec3]
    slope: wp.array2d[wp.vec3]
    rows: wp.array3d[wp.vec3]
    """Sums along rows: of x, y, x^2 + y^2, x y."""
    maps: wp.array3d[wp.vec3]
    """Gradients of SSIM to the means of x, x^2 + y^2, x y."""
    blurred: wp.array3d[wp.vec3]
    """Sums of the maps along rows."""


@wp.struct
@no_type_check
class Captured:
    """A channel in sRGB as the camera captures it, its derivative, and the photo."""

    x: float
    slope: float
    y: float


@wp.func
@no_type_check
def as_captured(linear: float, code: float) -> Captured:
    o = Captured()
    o.y = code / 255.0
    if linear <= KNEE:
        o.x = 12.92 * wp.max(linear, 0.0)
        o.slope = wp.where(linear >= 0.0, 12.92, 0.0)
    else:
        power = 1.055 * wp.pow(linear, 1.0 / 2.4)
        o.x = power - 0.055
        o.slope = power / (2.4 * linear)
    if code >= float(SATURATED) and o.x > o.y:
        o.x = o.y
        o.slope = 0.0
    return o


@wp.func
@no_type_check
def sign(x: float) -> float:
    """Sign of a number; 0 for 0."""
    return wp.where(x > 0.0, 1.0, 0.0) - wp.where(x < 0.0, 1.0, 0.0)


@wp.func
@no_type_check
def normal_term(s: ImageInputs, y: int, x: int, to: ImageGradients) -> vec32:
    """The third term at a pixel and the gradient of R, in this order; writes the gradients of normal and depth."""
    row = vec32()
    height = s.alpha.shape[0]
    width = s.alpha.shape[1]
    to.normal[y, x] = wp.vec3()
    if y == 0 or x == 0 or y == height - 1 or x == width - 1:
        return row
    lowest = wp.min(wp.min(s.alpha[y, x - 1], s.alpha[y, x + 1]), wp.min(s.alpha[y - 1, x], s.alpha[y + 1, x]))
    if not wp.min(lowest, s.alpha[y, x]) > 0.5:
        return row
    fx = s.focal[0]
    fy = s.focal[1]
    X = (float(x) + 0.5 - s.focal[2]) / fx
    Y = (float(y) + 0.5 - s.focal[3]) / fy
    left = s.depth[y, x - 1]
    right = s.depth[y, x + 1]
    above = s.depth[y - 1, x]
    below = s.depth[y + 1, x]
    across = 1.0 / (right + left)
    down = 1.0 / (below + above)
    p = fx * (right - left) * across
    q = fy * (below - above) * down
    u = wp.vec3(p, q, -1.0 - p * X - q * Y)
    inv_length = 1.0 / wp.length(u)
    u = u * inv_length
    a = s.normal[y, x]
    inv_a = 1.0 / wp.max(wp.length(a), 1.0e-12)
    R = matrix(s.R)
    k = R * a * inv_a
    cosine = wp.dot(k, u)
    shrunk = 1.0 / (1.0 + s.crease * (1.0 - cosine))
    row[0] = s.weights[2] * (1.0 - cosine) * shrunk
    v_cosine = -s.weights[2] * shrunk * shrunk
    to.normal[y, x] = v_cosine * inv_a * (wp.transpose(R) * u - cosine * inv_a * a)
    v_R = v_cosine * inv_a * wp.outer(u, a)
    for i in range(3):
        for j in range(3):
            row[1 + 3 * i + j] = v_R[i, j]
    v_u = v_cosine * inv_length * (k - cosine * u)
    v_p = 2.0 * fx * across * across * (v_u[0] - X * v_u[2])
    v_q = 2.0 * fy * down * down * (v_u[1] - Y * v_u[2])
    wp.atomic_add(to.depth, y, x + 1, v_p * left)
    wp.atomic_add(to.depth, y, x - 1, -v_p * right)
    wp.atomic_add(to.depth, y + 1, x, v_q * above)
    wp.atomic_add(to.depth, y - 1, x, -v_q * below)
    return row


@wp.kernel
@no_type_check
def pixel_terms(s: ImageInputs, planes: Planes, terms: wp.array2d[float], to: ImageGradients):
    """Terms of single pixels and their neighbours, and the images that are compared."""
    i = wp.tid()
    of_terms = vec32()
    of_R = vec32()
    width = s.alpha.shape[1]
    if i < s.alpha.shape[0] * width:
        y = i // width
        x = i % width
        code = int(s.mask[y, x])
        known = wp.where(code == UNKNOWN, 0.0, 1.0)
        a = wp.vec3()
        b = wp.vec3()
        slope = wp.vec3()
        for ch in range(3):
            o = as_captured(s.rgb[y, x][ch], float(s.photo[y, x][ch]))
            a[ch] = known * o.x
            b[ch] = known * o.y
            slope[ch] = known * o.slope
            of_terms[0] += s.weights[0] * (1.0 - s.ssim_weight) / 3.0 * wp.abs(a[ch] - b[ch])
        planes.x[y, x] = a
        planes.y[y, x] = b
        planes.slope[y, x] = slope
        error = known * (s.alpha[y, x] - wp.where(code == OBJECT, 1.0, 0.0))
        of_terms[1] = s.weights[1] * error * error
        to.alpha[y, x] = 2.0 * s.weights[1] * error
        variance = s.depth_var[y, x]
        v_variance = float(0.0)
        if s.alpha[y, x] > 0.0:
            root = wp.sqrt(wp.max(variance, 0.0) + 1.0e-6)
            of_terms[3] = s.weights[3] * (root - 1.0e-3)
            if variance >= 0.0:
                v_variance = 0.5 * s.weights[3] / root
        to.depth_var[y, x] = v_variance
        of_R = normal_term(s, y, x, to)
        of_terms[2] = of_R[0]
    for j in range(9):
        of_R[j] = of_R[j + 1]
    add_row(terms, 0, 0, 4, of_terms)
    add_row(to.R, 0, 0, 9, of_R)


@wp.kernel
@no_type_check
def sum_rows(planes: Planes):
    y, x = wp.tid()
    mean_x = wp.vec3()
    mean_y = wp.vec3()
    power = wp.vec3()
    product = wp.vec3()
    for k in range(SSIM_WINDOW):
        a = planes.x[y, x + k]
        b = planes.y[y, x + k]
        mean_x += TAPS[k] * a
        mean_y += TAPS[k] * b
        power += TAPS[k] * (wp.cw_mul(a, a) + wp.cw_mul(b, b))
        product += TAPS[k] * wp.cw_mul(a, b)
    planes.rows[0, y, x] = mean_x
    planes.rows[1, y, x] = mean_y
    planes.rows[2, y, x] = power
    planes.rows[3, y, x] = product


@wp.kernel
@no_type_check
def similarity(planes: Planes, weight: float, terms: wp.array[float]):
    """Add 1 - SSIM of all windows to the first term, and write its gradients to the means of each window."""
    i = wp.tid()
    width = planes.maps.shape[2]
    total = float(0.0)
    if i < planes.maps.shape[1] * width:
        y = i // width
        x = i % width
        mean_x = wp.vec3()
        mean_y = wp.vec3()
        power = wp.vec3()
        product = wp.vec3()
        for k in range(SSIM_WINDOW):
            mean_x += TAPS[k] * planes.rows[0, y + k, x]
            mean_y += TAPS[k] * planes.rows[1, y + k, x]
            power += TAPS[k] * planes.rows[2, y + k, x]
            product += TAPS[k] * planes.rows[3, y + k, x]
        of_x = wp.vec3()
        of_power = wp.vec3()
        of_product = wp.vec3()
        for ch in range(3):
            xy = mean_x[ch] * mean_y[ch]
            squares = mean_x[ch] * mean_x[ch] + mean_y[ch] * mean_y[ch]
            a1 = 2.0 * xy + C1
            a2 = 2.0 * (product[ch] - xy) + C2
            b1 = squares + C1
            b2 = power[ch] - squares + C2
            ratio = 1.0 / (b1 * b2)
            alike = a1 * a2 * ratio
            total += 1.0 - alike
            of_x[ch] = 2.0 * ratio * (a2 - a1) * mean_y[ch] + 2.0 * alike * (1.0 / b2 - 1.0 / b1) * mean_x[ch]
            of_power[ch] = -alike / b2
            of_product[ch] = 2.0 * ratio * a1
        planes.maps[0, y, x] = of_x
        planes.maps[1, y, x] = of_power
        planes.maps[2, y, x] = of_product
    add_lanes(terms, 0, weight * total)


@wp.kernel
@no_type_check
def sum_maps(planes: Planes):
    y, x = wp.tid()
    for i in range(3):
        sum = wp.vec3()
        for k in range(SSIM_WINDOW):
            if x - k >= 0 and x - k < planes.maps.shape[2]:
                sum += TAPS[k] * planes.maps[i, y, x - k]
        planes.blurred[i, y, x] = sum


@wp.kernel
@no_type_check
def photometric_adjoint(planes: Planes, of_l1: float, of_ssim: float, v_rgb: wp.array2d[wp.vec3]):
    y, x = wp.tid()
    of_x = wp.vec3()
    of_power = wp.vec3()
    of_product = wp.vec3()
    for k in range(SSIM_WINDOW):
        if y - k >= 0 and y - k < planes.blurred.shape[1]:
            of_x += TAPS[k] * planes.blurred[0, y - k, x]
            of_power += TAPS[k] * planes.blurred[1, y - k, x]
            of_product += TAPS[k] * planes.blurred[2, y - k, x]
    a = planes.x[y, x]
    b = planes.y[y, x]
    v = wp.vec3()
    for ch in range(3):
        alike = of_x[ch] + 2.0 * a[ch] * of_power[ch] + b[ch] * of_product[ch]
        v[ch] = (of_l1 * sign(a[ch] - b[ch]) - of_ssim * alike) * planes.slope[y, x][ch]
    v_rgb[y, x] = v


@wp.struct
@no_type_check
class MaterialInputs:
    """Arguments of `material_terms`."""

    features: wp.array3d[float]
    alpha: wp.array2d[float]
    photo: wp.array2d[wp.vec3ub]
    mask: wp.array2d[wp.uint8]


@wp.func
@no_type_check
def material_at(s: MaterialInputs, y: int, x: int) -> wp.vec4:
    """The first four features of a pixel of the object; 0 elsewhere."""
    if int(s.mask[y, x]) != OBJECT or not s.alpha[y, x] > 0.5:
        return wp.vec4()
    return wp.vec4(s.features[y, x, 0], s.features[y, x, 1], s.features[y, x, 2], s.features[y, x, 3])


@wp.func
@no_type_check
def smoothness(s: MaterialInputs, y: int, x: int, to_y: int, to_x: int) -> float:
    """Weight of a difference between a pixel and its neighbour; 0 if there is no neighbour."""
    weight = float(0.0)
    if to_y >= 0 and to_x >= 0 and to_y < s.alpha.shape[0] and to_x < s.alpha.shape[1]:
        for ch in range(3):
            step = float(s.photo[to_y, to_x][ch]) - float(s.photo[y, x][ch])
            weight += wp.exp(-wp.abs(step) / 255.0) / 3.0
    return weight


@wp.kernel
@no_type_check
def material_pixels(
    s: MaterialInputs,
    across: float,
    down: float,
    terms: wp.array2d[float],
    v_features: wp.array3d[float],
    v_alpha: wp.array2d[float],
):
    """Both terms of materials and their gradients; `across` and `down` are the weights of a pair of neighbours."""
    i = wp.tid()
    row = vec32()
    width = s.alpha.shape[1]
    if i < s.alpha.shape[0] * width:
        y = i // width
        x = i % width
        per_pixel = 1.0 / float(s.alpha.shape[0] * width)
        code = int(s.mask[y, x])
        error = wp.where(code == UNKNOWN, 0.0, s.alpha[y, x] - wp.where(code == OBJECT, 1.0, 0.0))
        row[0] = per_pixel * error * error
        v_alpha[y, x] = 2.0 * per_pixel * error
        own = material_at(s, y, x)
        v = wp.vec4()
        for k in range(4):
            # Right, below, left, above; the first two are this pixel's pairs.
            to_x = x + wp.where(k == 0, 1, 0) - wp.where(k == 2, 1, 0)
            to_y = y + wp.where(k == 1, 1, 0) - wp.where(k == 3, 1, 0)
            weight = wp.where(k % 2 == 0, across, down) * smoothness(s, y, x, to_y, to_x)
            if weight > 0.0:
                step = own - material_at(s, to_y, to_x)
                for j in range(4):
                    v[j] += weight * sign(step[j])
                    row[1] += wp.where(k < 2, weight * wp.abs(step[j]), 0.0)
        shown = code == OBJECT and s.alpha[y, x] > 0.5
        for j in range(s.features.shape[2]):
            v_features[y, x, j] = 0.0
        if shown:
            for j in range(4):
                v_features[y, x, j] = v[j]
    add_row(terms, 0, 0, 2, row)
