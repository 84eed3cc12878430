# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)
# ruff: noqa: UP018 (in it `float(0.0)` is a variable and `0.0` a constant)
"""Kernels of lookups in a stack of equirectangular maps (`Backend.lookup`), and of their adjoint."""

import math

import warp as wp

from tumble.backends._warp.runtime import no_type_check

wp.set_module_options({"enable_backward": False})

INV_PI = 1.0 / math.pi


@wp.struct
@no_type_check
class Place:
    """A place between eight texels: the first of them, the position between them, and what its gradient needs."""

    level: int
    row: int
    column: int
    x: float
    y: float
    z: float
    rho_2: float
    """Squared distance of the direction from the axis of the poles."""
    level_moves: float
    """1 if the roughness is not clamped, else 0."""


@wp.func
@no_type_check
def place_of(stack: wp.array3d[wp.vec3], d: wp.vec3, roughness: float) -> Place:
    o = Place()
    o.rho_2 = d[0] * d[0] + d[2] * d[2]
    u = float(0.5)
    if o.rho_2 > 0.0:
        u += 0.5 * INV_PI * wp.atan2(d[0], -d[2])
    column = u * float(stack.shape[2]) - 0.5
    row = INV_PI * wp.atan2(wp.sqrt(o.rho_2), d[1]) * float(stack.shape[1]) - 0.5
    level = wp.clamp(roughness, 0.0, 1.0) * float(stack.shape[0] - 1)
    o.level_moves = wp.where(roughness >= 0.0 and roughness <= 1.0, 1.0, 0.0)
    o.column = int(wp.floor(column))
    o.row = int(wp.floor(row))
    o.level = int(wp.floor(level))
    o.x = column - wp.floor(column)
    o.y = row - wp.floor(row)
    o.z = level - wp.floor(level)
    return o


@wp.func
@no_type_check
def texel(stack: wp.array3d[wp.vec3], o: Place, k: int) -> wp.vec3i:
    """Indices of a texel around a place; the bits of k are column, row and level.

    Across a pole lies the same row, half a revolution away.
    """
    height = stack.shape[1]
    width = stack.shape[2]
    row = o.row + (k // 2) % 2
    column = o.column + k % 2
    if row < 0 or row >= height:
        column += width // 2
    level = wp.clamp(o.level + k // 4, 0, stack.shape[0] - 1)
    return wp.vec3i(level, wp.clamp(row, 0, height - 1), ((column % width) + width) % width)


@wp.func
@no_type_check
def side(x: float, k: int) -> float:
    """Weight along one axis of the first (k = 0) or second texel."""
    return wp.where(k == 0, 1.0 - x, x)


@wp.kernel
@no_type_check
def lookup_forward(
    stack: wp.array3d[wp.vec3], directions: wp.array[wp.vec3], roughness: wp.array[float], out: wp.array[wp.vec3]
):
    i = wp.tid()
    o = place_of(stack, directions[i], roughness[i])
    value = wp.vec3()
    for k in range(8):
        at = texel(stack, o, k)
        weight = side(o.x, k % 2) * side(o.y, (k // 2) % 2) * side(o.z, k // 4)
        value += weight * stack[at[0], at[1], at[2]]
    out[i] = value


@wp.kernel
@no_type_check
def lookup_adjoint(
    stack: wp.array3d[wp.vec3],
    directions: wp.array[wp.vec3],
    roughness: wp.array[float],
    v_out: wp.array[wp.vec3],
    v_stack: wp.array3d[wp.vec3],
    v_directions: wp.array[wp.vec3],
    v_roughness: wp.array[float],
):
    i = wp.tid()
    d = directions[i]
    o = place_of(stack, d, roughness[i])
    v_x = float(0.0)
    v_y = float(0.0)
    v_z = float(0.0)
    for k in range(8):
        at = texel(stack, o, k)
        x = side(o.x, k % 2)
        y = side(o.y, (k // 2) % 2)
        z = side(o.z, k // 4)
        wp.atomic_add(v_stack, at[0], at[1], at[2], x * y * z * v_out[i])
        v = wp.dot(v_out[i], stack[at[0], at[1], at[2]])
        v_x += wp.where(k % 2 == 0, -v, v) * y * z
        v_y += wp.where((k // 2) % 2 == 0, -v, v) * x * z
        v_z += wp.where(k // 4 == 0, -v, v) * x * y
    v_d = wp.vec3()
    if o.rho_2 > 0.0:
        rho = wp.sqrt(o.rho_2)
        v_u = v_x * float(stack.shape[2]) * 0.5 * INV_PI / o.rho_2
        v_v = v_y * float(stack.shape[1]) * INV_PI / ((o.rho_2 + d[1] * d[1]) * rho)
        v_d = wp.vec3(v_v * d[1] * d[0] - v_u * d[2], -v_v * o.rho_2, v_v * d[1] * d[2] + v_u * d[0])
    v_directions[i] = v_d
    v_roughness[i] = v_z * o.level_moves * float(stack.shape[0] - 1)
