# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018, RUF046 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of blending front to back, and of its adjoint, which also traverses the Gaussians front to back.

With s_i = dL/dw_i, the Gaussians behind Gaussian i contribute rem = dL/dout . out - sum_{j <= i} w_j s_j, so that
neither a reversed list nor a state per pixel is stored. Formulas and the layouts of records and sums are in
`projection.py`.

A *pixel* is rgb, alpha, depth, variance of depth, normal, features. A tile is a block of 256 threads; the 32 lanes of a
warp cover 8 x 4 pixels and traverse the list of the tile together.
"""

from functools import cache

import warp as wp

from tumble.backends import ALPHA_MAX, ALPHA_MIN, T_MIN
from tumble.backends._warp.projection import CORNERS, SUMS, TILE
from tumble.backends._warp.runtime import add_lanes, add_row, any_lane, count_lanes, no_type_check, vec32

wp.set_module_options({"enable_backward": False})

FIXED = 9
"""Numbers of a pixel without features."""
WIDTHS = (0, 8, 16)
"""Numbers of features for which kernels are compiled; other numbers are padded with zeros."""


@wp.struct
@no_type_check
class Peak:
    """The response of a Gaussian at a pixel; alpha is 0 if it does not contribute."""

    dx: float
    dy: float
    K: float
    l: float  # noqa: E741 (as in the formulas)
    r: float
    zeta_1: float
    """zeta - 1."""
    G: float
    raw: float
    alpha: float


@wp.func
@no_type_check
def peak_at(record: wp.array2d[wp.vec4], g: int, at: wp.vec2i) -> Peak:
    p = Peak()
    centre = record[g, 0]
    conic = record[g, 1]
    beta = record[g, 2]
    p.dx = float(at[0]) + 0.5 - centre[0]
    p.dy = float(at[1]) + 0.5 - centre[1]
    p.K = p.dx * (conic[0] * p.dx + conic[1] * p.dy) + conic[2] * p.dy * p.dy
    p.l = 1.0 + beta[0] * p.dx + beta[1] * p.dy
    q = p.l * p.l + conic[3] * p.K
    if centre[2] * q >= p.K:
        p.r = 1.0 / q
        p.G = wp.exp(-0.5 * p.K * p.r)
        p.raw = centre[3] * p.G
        if p.raw >= ALPHA_MIN:
            p.alpha = wp.min(p.raw, ALPHA_MAX)
            p.zeta_1 = -(p.l * (p.l - 1.0) + conic[3] * p.K) * p.r
    return p


@wp.func
@no_type_check
def corner_coordinates(p: Peak, record: wp.array2d[wp.vec4], g: int) -> wp.vec2:
    """Corner coordinates u and v at the peak, not clamped."""
    step = record[g, 5]
    zeta = p.l * p.r
    u = 0.5 + p.zeta_1 * record[g, 3][3] + zeta * (step[0] * p.dx + step[1] * p.dy)
    v = 0.5 + p.zeta_1 * record[g, 4][3] + zeta * (step[2] * p.dx + step[3] * p.dy)
    return wp.vec2(u, v)


@wp.func
@no_type_check
def corner_weights(uv: wp.vec2) -> wp.vec4:
    u = wp.clamp(uv[0], 0.0, 1.0)
    v = wp.clamp(uv[1], 0.0, 1.0)
    return wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)


@wp.func
@no_type_check
def pixel_of(thread: int, width: int) -> wp.vec2i:
    """Column and row of the pixel of a thread; it may lie outside the image."""
    tile = thread // (TILE * TILE)
    patch = (thread // 32) % 8
    lane = thread % 32
    across = (width + TILE - 1) // TILE
    x = (tile % across) * TILE + (patch % 2) * 8 + lane % 8
    y = (tile // across) * TILE + (patch // 2) * 4 + lane // 8
    return wp.vec2i(x, y)


@wp.struct
@no_type_check
class Blend:
    """Weighted sums over the Gaussians of a pixel."""

    rgb: wp.vec3
    normal: wp.vec3
    z: float
    zz: float


@wp.func
@no_type_check
def xyz(x: wp.vec4) -> wp.vec3:
    return wp.vec3(x[0], x[1], x[2])


@wp.func
@no_type_check
def blend(b: Blend, w: float, p: Peak, record: wp.array2d[wp.vec4], g: int) -> Blend:
    to = b
    z = record[g, 2][3] + record[g, 2][2] * p.zeta_1
    to.rgb += w * xyz(record[g, 3])
    to.normal += w * xyz(record[g, 4])
    to.z += w * z
    to.zz += w * z * z
    return to


@wp.func
@no_type_check
def write_pixel(pixels: wp.array2d[float], i: int, b: Blend, alpha: float, z_0: float):
    """Write all numbers of a pixel except the features; alpha is 0 or at least ALPHA_MIN."""
    inv = 1.0 / wp.max(alpha, ALPHA_MIN)
    mean = b.z * inv
    pixels[i, 3] = alpha
    pixels[i, 4] = wp.where(alpha > 0.0, z_0 + mean, 0.0)
    pixels[i, 5] = b.zz * inv - mean * mean
    for ch in range(3):
        pixels[i, ch] = b.rgb[ch]
        pixels[i, 6 + ch] = b.normal[ch] * inv


@cache
def forward(channels: int) -> wp.Kernel:
    """The blending kernel for a number of features out of WIDTHS."""
    vec = wp.types.vector(length=channels or 1, dtype=float)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def composite(
        record: wp.array2d[wp.vec4],
        corners: wp.array2d[vec],
        camera: wp.array[float],
        mask: wp.array2d[float],
        starts: wp.array[int],
        gaussians: wp.array[int],
        height: int,
        width: int,
        pixels: wp.array2d[float],
        weight: wp.array[float],
        touched: wp.array[int],
        dominant: wp.array[int],
    ):
        thread = wp.tid()
        at = pixel_of(thread, width)
        inside = at[0] < width and at[1] < height
        counted = inside and mask[at[1], at[0]] > 0.5
        T = wp.where(inside, 1.0, 0.0)
        b = Blend()
        features = vec()
        best = float(0.0)
        winner = int(-1)
        tile = thread // (TILE * TILE)
        for k in range(starts[tile], starts[tile + 1]):
            if not any_lane(T >= T_MIN):
                break
            g = gaussians[k]
            p = peak_at(record, g, at)
            on = T >= T_MIN and p.alpha > 0.0
            if any_lane(on):
                w = float(0.0)
                if on:
                    w = T * p.alpha
                    b = blend(b, w, p, record, g)
                    if wp.static(channels > 0):
                        c = w * corner_weights(corner_coordinates(p, record, g))
                        for j in range(4):
                            features += c[j] * corners[g, j]
                    if w > best:
                        best = w
                        winner = g
                    T -= w
                add_lanes(weight, g, w)
                count_lanes(touched, g, on and counted)
        if inside:
            i = at[1] * width + at[0]
            dominant[i] = winner
            write_pixel(pixels, i, b, 1.0 - T, camera[11])
            for ch in range(channels):
                pixels[i, FIXED + ch] = features[ch] / wp.max(1.0 - T, ALPHA_MIN)

    return composite


@wp.struct
@no_type_check
class PixelSeed:
    """Gradients of the sums of a pixel, and the remaining part `rem` of dL/dout . out."""

    rgb: wp.vec3
    normal: wp.vec3
    alpha: float
    z: float
    zz: float
    rem: float


@wp.func
@no_type_check
def seed_at(pixels: wp.array2d[float], v_pixels: wp.array2d[float], i: int, z_0: float) -> PixelSeed:
    """Gradients of the sums of a pixel, except those of the features."""
    s = PixelSeed()
    alpha = pixels[i, 3]
    inv = 1.0 / alpha
    mean = pixels[i, 4] - z_0
    s.alpha = v_pixels[i, 3]
    s.rem = s.alpha * alpha
    for ch in range(3):
        s.rgb[ch] = v_pixels[i, ch]
        s.rem += s.rgb[ch] * pixels[i, ch]
        s.normal[ch] = v_pixels[i, 6 + ch] * inv
        s.alpha -= s.normal[ch] * pixels[i, 6 + ch]
    s.zz = v_pixels[i, 5] * inv
    s.z = v_pixels[i, 4] * inv - 2.0 * mean * s.zz
    s.alpha -= s.z * mean + s.zz * (pixels[i, 5] + mean * mean)
    return s


@wp.struct
@no_type_check
class BlendStep:
    """Blending weight of one Gaussian at a pixel, and gradients of the quantities at its peak."""

    w: float
    value: float
    """dL/dw."""
    v_depth: float
    v_uv: wp.vec2


@wp.func
@no_type_check
def step_at(p: Peak, s: PixelSeed, T: float, record: wp.array2d[wp.vec4], g: int) -> BlendStep:
    """Blending weight and gradients at the peak of one Gaussian, without those of the features."""
    o = BlendStep()
    o.w = T * p.alpha
    z = record[g, 2][3] + record[g, 2][2] * p.zeta_1
    o.value = s.alpha + wp.dot(s.rgb, xyz(record[g, 3])) + wp.dot(s.normal, xyz(record[g, 4])) + z * (s.z + z * s.zz)
    o.v_depth = o.w * (s.z + 2.0 * z * s.zz)
    return o


@wp.func
@no_type_check
def geometry_sums(p: Peak, s: PixelSeed, o: BlendStep, T: float, record: wp.array2d[wp.vec4], g: int) -> vec32:
    """Contribution of a pixel to the sums of a Gaussian, except those of the features."""
    x = vec32()
    conic = record[g, 1]
    beta = record[g, 2]
    step = record[g, 5]
    zeta = p.l * p.r
    v_alpha = float(0.0)
    if p.raw <= ALPHA_MAX:
        v_alpha = T * o.value - s.rem / (1.0 - p.alpha)
    v_rho = -0.5 * v_alpha * p.raw
    v_u = o.v_uv[0]
    v_v = o.v_uv[1]
    v_zeta = o.v_depth * beta[2] + v_u * (record[g, 3][3] + step[0] * p.dx + step[1] * p.dy)
    v_zeta += v_v * (record[g, 4][3] + step[2] * p.dx + step[3] * p.dy)
    v_q = -(v_rho * p.K + v_zeta * p.l) * p.r * p.r
    v_l = v_zeta * p.r + 2.0 * p.l * v_q
    v_K = v_rho * p.r + conic[3] * v_q
    x[0] = v_K * p.dx * p.dx
    x[1] = v_K * p.dx * p.dy
    x[2] = v_K * p.dy * p.dy
    x[3] = v_l * p.dx
    x[4] = v_l * p.dy
    x[5] = -(v_K * (2.0 * conic[0] * p.dx + conic[1] * p.dy) + v_l * beta[0] + zeta * (v_u * step[0] + v_v * step[2]))
    x[6] = -(v_K * (conic[1] * p.dx + 2.0 * conic[2] * p.dy) + v_l * beta[1] + zeta * (v_u * step[1] + v_v * step[3]))
    x[7] = v_q * p.K
    x[8] = v_alpha * p.G
    x[9] = o.v_depth * zeta
    x[10] = zeta * v_u * p.dx
    x[11] = zeta * v_u * p.dy
    x[12] = v_u * p.zeta_1
    x[13] = zeta * v_v * p.dx
    x[14] = zeta * v_v * p.dy
    x[15] = v_v * p.zeta_1
    for ch in range(3):
        x[16 + ch] = o.w * s.rgb[ch]
        x[19 + ch] = o.w * s.normal[ch]
    return x


@cache
def adjoint(channels: int) -> wp.Kernel:
    """The adjoint of `forward`; gradients of features are added corner by corner, 32 numbers at once."""
    vec = wp.types.vector(length=channels or 1, dtype=float)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 32})
    @no_type_check
    def composite_adjoint(
        record: wp.array2d[wp.vec4],
        corners: wp.array2d[vec],
        camera: wp.array[float],
        starts: wp.array[int],
        gaussians: wp.array[int],
        height: int,
        width: int,
        pixels: wp.array2d[float],
        v_pixels: wp.array2d[float],
        sums: wp.array2d[float],
    ):
        thread = wp.tid()
        at = pixel_of(thread, width)
        i = at[1] * width + at[0]
        T = float(0.0)
        s = PixelSeed()
        f = vec()
        if at[0] < width and at[1] < height and pixels[i, 3] > 0.0:
            T = 1.0
            s = seed_at(pixels, v_pixels, i, camera[11])
            for ch in range(channels):
                f[ch] = v_pixels[i, FIXED + ch] / pixels[i, 3]
                s.alpha -= f[ch] * pixels[i, FIXED + ch]
        tile = thread // (TILE * TILE)
        for k in range(starts[tile], starts[tile + 1]):
            if not any_lane(T >= T_MIN):
                break
            g = gaussians[k]
            p = peak_at(record, g, at)
            on = T >= T_MIN and p.alpha > 0.0
            if any_lane(on):
                x = vec32()
                c = wp.vec4()
                if on:
                    o = step_at(p, s, T, record, g)
                    if wp.static(channels > 0):
                        uv = corner_coordinates(p, record, g)
                        c = corner_weights(uv)
                        at_corner = wp.vec4()
                        for j in range(4):
                            at_corner[j] = wp.dot(f, corners[g, j])
                        o.value += wp.dot(c, at_corner)
                        o.v_uv = o.w * corner_slopes(uv, at_corner)
                        c *= o.w
                    s.rem -= o.w * o.value
                    x = geometry_sums(p, s, o, T, record, g)
                    T -= o.w
                add_row(sums, g, 0, SUMS, x)
                for part in range(channels // 8):
                    for j in range(32):
                        x[j] = c[(32 * part + j) // channels] * f[j % channels]
                    add_row(sums, g, CORNERS + 32 * part, 32, x)

    return composite_adjoint


@wp.func
@no_type_check
def corner_slopes(uv: wp.vec2, at_corner: wp.vec4) -> wp.vec2:
    """Gradients of the interpolated value in u and v, which are 0 where u or v is clamped."""
    u = wp.clamp(uv[0], 0.0, 1.0)
    v = wp.clamp(uv[1], 0.0, 1.0)
    slope = wp.vec2()
    if u == uv[0]:
        slope[0] = (1.0 - v) * (at_corner[1] - at_corner[0]) + v * (at_corner[3] - at_corner[2])
    if v == uv[1]:
        slope[1] = (1.0 - u) * (at_corner[2] - at_corner[0]) + u * (at_corner[3] - at_corner[1])
    return slope
