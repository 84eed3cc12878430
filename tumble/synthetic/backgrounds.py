"""Procedural backgrounds of synthetic captures, at rest in the camera frame (OpenCV axes, lengths in object radii)."""

import math

import numpy as np
from jaxtyping import Float

from tumble.synthetic.pathtracer import Part
from tumble.synthetic.surfaces import noise, pattern, quads, tube

WALL_DISTANCE = 4.0
"""Distance of the wall behind the object's centre [object radius]."""
DESK_PITCH = math.radians(50)
"""Angle by which the camera looks down on the desk [radians]."""
DESK_DROP = 2.7
"""Distance of the desk below the object's centre [object radius]."""
HALF = 9.0
"""Half the side of a wall [object radius]; it reaches beyond the image, and beyond the film."""
DESK_HALF = 18.0
"""Half the side of a desk [object radius]. It is larger than a wall, because the camera looks down on it at an angle:
the upper corners of the film of the largest field of view show what is 17.5 behind the object."""
THINGS = 9
"""Number of boxes on a cluttered desk."""


def background_parts(kind: str, distance: float, seed: int) -> dict[str, Part]:
    """Surfaces behind the object in the camera frame, by name; none for the kind "none".

    Args:
        kind: A value of `SynthOptions.background`.
        distance: Distance of the camera from the object [object radius].
        seed: Seed of colours and patterns.
    """
    rng = np.random.default_rng(seed)
    if kind == "wall":
        return {"wall": _wall(distance, rng)}
    if kind == "desk":
        return {"desk": _desk(distance, rng)}
    if kind == "clutter":
        return {"desk": _desk(distance, rng)} | _things(distance, rng)
    if kind == "torso":
        return {"wall": _wall(distance + 2, rng), "torso": _torso(distance, rng)}
    return {}


def _colours(rng: np.random.Generator, low: float, high: float) -> Float[np.ndarray, "2 3"]:
    """Two muted colours of one hue [linear RGB]."""
    colour = rng.uniform(low, high) * rng.uniform(0.6, 1.4, 3)
    return np.stack([0.8 * colour, 1.15 * colour]).clip(0, 0.85)


def _wall(distance: float, rng: np.random.Generator) -> Part:
    """An upright wall with a few flat pictures."""
    texture = pattern(_colours(rng, 0.25, 0.6), (24, 24), int(rng.integers(1 << 16)), rows=512)
    for _ in range(5):
        top, left = rng.integers(130, 330, 2)
        height, width = rng.integers(25, 70, 2)
        framed = pattern(_colours(rng, 0.05, 0.5), (9, 9), int(rng.integers(1 << 16)))[:height, :width]
        framed[[0, 1, -1, -2]] = framed[:, [0, 1, -1, -2]] = rng.uniform(0.02, 0.5)
        texture[top : top + height, left : left + width] = framed
    corner = np.array([[-HALF, -HALF, distance + WALL_DISTANCE]])
    return quads(corner, np.array([[2 * HALF, 0, 0]]), np.array([[0, 2 * HALF, 0]]), texture, 0.9)


def _desk_axes(distance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Point of the desk below the object, direction along the desk away from the camera, and downward normal."""
    down = np.array([0.0, math.cos(DESK_PITCH), math.sin(DESK_PITCH)])
    away = np.array([0.0, -math.sin(DESK_PITCH), math.cos(DESK_PITCH)])
    return np.array([0.0, 0.0, distance]) + DESK_DROP * down, away, down


def _desk(distance: float, rng: np.random.Generator) -> Part:
    """A wooden desk on which the camera looks down."""
    x, y = np.meshgrid(*[np.linspace(-DESK_HALF, DESK_HALF, 1024)] * 2)
    at = np.stack([x / 6, 14 / 9 * y, np.zeros_like(x)], -1)
    grain = np.sin(y + 5 * noise(at / 3, int(rng.integers(1 << 16))) + 2 * noise(4 * at, 1))
    wander = (0.5 + 0.3 * grain + 0.5 * noise(at * [4, 12, 1], 2))[..., None].clip(0, 1)
    wood = np.array([[0.16, 0.085, 0.04], [0.36, 0.22, 0.12]]) * rng.uniform(0.7, 1.5)
    point, away, _ = _desk_axes(distance)
    right = np.array([1.0, 0.0, 0.0])
    corner = point - DESK_HALF * right + DESK_HALF * away
    texture = (1 - wander) * wood[0] + wander * wood[1]
    return quads(corner[None], 2 * DESK_HALF * right[None], -2 * DESK_HALF * away[None], texture, 0.45)


def _things(distance: float, rng: np.random.Generator) -> dict[str, Part]:
    """Boxes that stand on the desk around the place of the object, with patterns of two colours."""
    point, away, down = _desk_axes(distance)
    right = np.array([1.0, 0.0, 0.0])
    things = {}
    for i in range(THINGS):
        yaw, size = rng.uniform(0, math.pi), rng.uniform([0.5, 0.3, 0.5], [1.6, 1.6, 1.6])
        place = point + (i - THINGS / 2 + rng.uniform(0, 1)) * 1.3 * right + rng.uniform(0.5, 5.5) * away
        first = math.cos(yaw) * right + math.sin(yaw) * away
        second = math.cos(yaw) * away - math.sin(yaw) * right
        a, b, up = size[0] * first, size[2] * second, -size[1] * down
        base = place - (a + b) / 2 + up
        corners = np.stack([base, base + a, base + a + b, base + b, base + b])
        across = np.stack([a, b, -a, -b, a])
        texture = pattern(_colours(rng, 0.05, 0.6) * [[0.4], [1]], (rng.uniform(1, 9), rng.uniform(1, 9)), i, rows=128)
        things[f"thing_{i}"] = quads(corners, across, np.stack([-up, -up, -up, -up, -b]), texture, 0.6)
    return things


def _torso(distance: float, rng: np.random.Generator) -> Part:
    """The clothed upper body of a person who faces the camera."""
    heights = np.array([-3.8, -3.1, -2.9, -2.7, -2.4, -2.05, -1.6, -0.8, 0.5, 2.5, 5.0, 7.0])
    widths = np.array([0.75, 0.8, 1.1, 1.6, 2.2, 2.6, 2.75, 2.7, 2.45, 2.25, 2.3, 2.4])
    depths = np.array([0.7, 0.75, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.3, 1.3, 1.3, 1.3])
    fine = np.linspace(heights[0], heights[-1], 60)
    angle = np.linspace(0, 2 * math.pi, 64, endpoint=False)
    wide, deep = (np.interp(fine, heights, values)[:, None] for values in (widths, depths))
    rings = np.stack([wide * np.cos(angle), fine[:, None] + 0 * angle, deep * np.sin(angle)], -1)
    rings *= 1 + 0.05 * noise(rings / [0.5, 0.8, 0.5], int(rng.integers(1 << 16)))[..., None]
    texture = pattern(_colours(rng, 0.03, 0.4), (60, 40), int(rng.integers(1 << 16)))
    return tube(rings + np.array([0, 0, distance + WALL_DISTANCE - 0.3]), texture, 0.95)
