"""Two lights by arithmetic: a room with a window and a lamp, and a field at sunset.

The camera of a hand-held capture looks at -z, the middle of the map; what lights the side of the object that it sees
lies behind it, near the map's left and right edges. Linear radiance.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.maths import texel_directions
from tumble.scene import Environment

FINE = 4
"""Rays per texel, each way."""
LAMP = (0.66, 0.52, 0.5422)
"""Unit direction of the room's warm lamp, env frame: to the right, above and behind the camera."""
WINDOW = (-0.8615, 0.2497, 0.4421)
"""Unit direction of the middle of the room's window, env frame: to the left, above and behind the camera."""
SUN = (0.7723, 0.1736, -0.6111)
"""Unit direction of the setting sun, env frame: ten degrees above the horizon, right of what the camera looks at."""

ROOM_LOW, ROOM_HIGH = (-1.9, -1.1, -2.4), (2.5, 1.5, 2.7)
"""Corners of the room around the object [metres]."""
LAMP_SIZE = math.radians(6.5)
"""Half the angle under which the lamp is seen [radians]."""
SUN_SIZE = math.radians(2.5)
"""Half the angle under which the sun is seen: five times the real one, so that a map of 128 rows can hold it."""

Colour = tuple[float, float, float]
Rays = Float[Tensor, "n 3"]


def environment(height: int = 128) -> Environment:
    """A room: a cool window on the left (`WINDOW`), a warm lamp on the right (`LAMP`), a doorway behind the object."""
    return _rendered(_room, height)


def other_environment(height: int = 128) -> Environment:
    """A field at sunset, under banks of cloud: the sun (`SUN`) is a warm disc, the sky across from it violet."""
    return _rendered(_sunset, height)


def _rendered(radiance: Callable[[Rays], Rays], height: int) -> Environment:
    """Averages of FINE x FINE rays per texel."""
    d_env = texel_directions(FINE * height, FINE * 2 * height).reshape(-1, 3)
    fine = radiance(d_env).reshape(height, FINE, 2 * height, FINE, 3)
    return Environment.from_radiance(fine.mean((1, 3)))


# The room -------------------------------------------------------------------------------------------------------------


def _room(d_env: Rays) -> Rays:
    low, high = torch.tensor(ROOM_LOW), torch.tensor(ROOM_HIGH)
    tiny = torch.where(d_env < 0, -1e-9, 1e-9)
    steps = torch.where(d_env > 0, high, low) / torch.where(d_env.abs() < 1e-9, tiny, d_env)
    reach, axis = steps.min(-1)
    hit = d_env * reach[:, None]
    upper = d_env.gather(1, axis[:, None])[:, 0] > 0
    wall = 2 * axis + upper
    normal = torch.nn.functional.one_hot(axis, 3) * torch.where(upper, -1.0, 1.0)[:, None]

    # Left, right, floor, ceiling, front, back: a cool and a warm side.
    paint = torch.tensor(
        [
            [0.50, 0.58, 0.66],
            [0.74, 0.46, 0.30],
            [0.36, 0.24, 0.16],
            [0.82, 0.80, 0.76],
            [0.62, 0.60, 0.54],
            [0.44, 0.50, 0.42],
        ]
    )[wall]
    paint = _furnished(paint, wall, hit)
    window, lamp = _on_walls(WINDOW), 0.85 * _on_walls(LAMP)
    cool = 1.5 * _falloff(hit, normal, window) * torch.tensor([0.85, 1.0, 1.2])
    warm = 0.75 * _falloff(hit, normal, lamp) * torch.tensor([1.25, 0.9, 0.55])
    radiance = paint * (0.13 + cool + warm)

    radiance = _with_door(radiance, wall, hit)
    radiance = _with_window(radiance, wall, hit)
    return _with_lamp(radiance, d_env)


def _on_walls(direction: Colour) -> Float[Tensor, "3"]:
    """The point of the room's walls that lies in a direction."""
    d = torch.tensor(direction)
    return d * (torch.where(d > 0, torch.tensor(ROOM_HIGH), torch.tensor(ROOM_LOW)) / d).min()


def _falloff(hit: Rays, normal: Rays, source: Float[Tensor, "3"]) -> Float[Tensor, "n 1"]:
    """Light of a small source on a wall: the cosine there over the square of the distance, softened near it."""
    away = source - hit
    distance2 = away.square().sum(-1, keepdim=True)
    cosine = (away * normal).sum(-1, keepdim=True).clamp_min(0) / distance2.clamp_min(1e-4).sqrt()
    return (0.25 + cosine) / (0.6 + distance2)


def _inside(a: Tensor, b: Tensor, left: float, right: float, bottom: float, top: float) -> Bool[Tensor, " n"]:
    return (a > left) & (a < right) & (b > bottom) & (b < top)


def _furnished(paint: Rays, wall: Tensor, hit: Rays) -> Rays:
    """Floorboards, a rug, pictures, and a shelf of books behind the camera."""
    x, y, z = hit.unbind(-1)
    boards = 1 + 0.22 * torch.sin(9.0 * x.div(0.22).floor()) * (wall == 2)
    paint = paint * boards[:, None]
    rug = (wall == 2) & ((x / 1.3).square() + (z / 1.0).square() < 1)
    paint = torch.where(rug[:, None], torch.tensor([0.55, 0.20, 0.16]), paint)
    picture = (wall == 1) & _inside(z, y, -1.3, -0.3, -0.1, 0.8)
    paint = torch.where(picture[:, None], torch.tensor([0.10, 0.16, 0.30]), paint)
    shelf = (wall == 5) & _inside(x, y, -0.9, 1.0, -1.1, 0.5)
    number = 7 * x.div(0.07).floor() + 3 * y.div(0.4).floor()
    cloth = torch.tensor(
        [[0.42, 0.16, 0.12], [0.12, 0.24, 0.30], [0.55, 0.42, 0.22], [0.60, 0.56, 0.48], [0.16, 0.26, 0.18]]
    )
    spines = cloth[number.square().div(5).floor().remainder(5).long()]
    return torch.where(shelf[:, None], spines * (y.remainder(0.4) > 0.05)[:, None], paint)


def _with_door(radiance: Rays, wall: Tensor, hit: Rays) -> Rays:
    """A doorway into a dim, warm corridor, in the wall that the camera looks at."""
    x, y, _ = hit.unbind(-1)
    door = (wall == 4) & _inside(x, y, 0.5, 1.4, -1.1, 0.95)
    frame = (wall == 4) & _inside(x, y, 0.42, 1.48, -1.1, 1.03)
    radiance = torch.where(frame[:, None], 0.5 * torch.ones(3), radiance)
    corridor = (0.08 + 0.25 * (y + 1.1) / 2)[:, None] * torch.tensor([1.0, 0.72, 0.45])
    return torch.where(door[:, None], corridor, radiance)


def _with_window(radiance: Rays, wall: Tensor, hit: Rays) -> Rays:
    """Six panes of bright sky over hedges, in the wall on the left."""
    _, y, z = hit.unbind(-1)
    middle = _on_walls(WINDOW)
    up, along = y - middle[1], z - middle[2]
    frame = (wall == 0) & _inside(along, up, -1.0, 1.0, -0.75, 0.75)
    radiance = torch.where(frame[:, None], torch.tensor([0.55, 0.58, 0.62]), radiance)
    pane = frame & (along.add(0.95).remainder(0.65) < 0.58) & (up.add(0.70).remainder(0.72) < 0.66)
    pane = pane & _inside(along, up, -0.95, 0.95, -0.70, 0.70)
    sky = torch.tensor([7.5, 9.6, 12.0]) * (1 + 0.35 * up)[:, None]
    hedge = torch.tensor([0.9, 1.3, 0.6])
    above = (up > -0.42 + 0.06 * torch.sin(9 * along))[:, None]
    return torch.where(pane[:, None], torch.where(above, sky, hedge), radiance)


def _with_lamp(radiance: Rays, d_env: Rays) -> Rays:
    """A warm globe, darker at its limb, and its glow on what is around it."""
    angle = _angle_to(LAMP, d_env)
    glow = 0.5 * torch.exp(-((angle - LAMP_SIZE).clamp_min(0) / 0.16))
    radiance = radiance + glow * torch.tensor([1.0, 0.68, 0.36])
    globe = (0.7 + 0.3 * (1 - (angle / LAMP_SIZE).square()).clamp_min(0)) * torch.tensor([52.0, 38.0, 23.0])
    return torch.where(angle < LAMP_SIZE, globe, radiance)


# The sunset -----------------------------------------------------------------------------------------------------------


def _sunset(d_env: Rays) -> Rays:
    up = d_env[:, 1:2]
    angle = _angle_to(SUN, d_env)
    toward = torch.exp(-((angle / 0.9).square()))
    height = up.clamp_min(0)
    zenith, violet, orange = (torch.tensor(c) for c in ((0.10, 0.17, 0.42), (0.34, 0.25, 0.38), (1.9, 0.85, 0.28)))
    band = torch.exp(-height / 0.22)
    sky = zenith * (1 - band) + violet * band + orange * band * toward
    sky = sky + 2.2 * torch.exp(-angle / 0.12) * torch.tensor([1.0, 0.62, 0.28])

    # Long banks of cloud: waves on a plane high above, lit from the side of the sun.
    plane = d_env[:, ::2] / (height + 0.12) @ torch.tensor([[0.9, -0.4], [0.4, 0.9]])
    wave = _waves(plane * torch.tensor([0.45, 1.5])) - 0.25
    cloud = (wave / 1.1).clamp(0, 1) * (height / 0.15).clamp(0, 1)
    lit = torch.tensor([0.42, 0.30, 0.34]) + 1.3 * toward * torch.tensor([1.0, 0.48, 0.26])
    sky = sky * (1 - 0.8 * cloud) + 0.8 * cloud * lit
    sky = torch.where(angle < SUN_SIZE, torch.tensor([330.0, 200.0, 85.0]), sky)

    turn = torch.atan2(d_env[:, :1], -d_env[:, 2:])
    hills = 0.05 + 0.03 * torch.sin(3 * turn + 0.5) + 0.015 * torch.sin(11 * turn)
    ground = d_env[:, ::2] / up.abs().clamp_min(0.02)
    patches = 1 + 0.18 * _waves(0.6 * ground) * (up.abs() / 0.3).clamp_max(1)
    field = (0.10 + 0.30 * toward) * patches * torch.tensor([0.95, 0.70, 0.32])
    dark = torch.tensor([0.05, 0.055, 0.075])
    return torch.where(up > hills, sky, torch.where(up > 0, dark, field))


def _waves(at: Float[Tensor, "n 2"]) -> Float[Tensor, "n 1"]:
    """A few sine waves across each other, each bent by the one before: about -2 to 2, without visible repeats."""
    total, bend = torch.zeros_like(at[:, :1]), torch.zeros_like(at[:, :1])
    for octave, strength in enumerate((1.0, 0.6, 0.4, 0.25)):
        turn = 1.9 * octave + 0.4
        across = at @ torch.tensor([[math.cos(turn)], [math.sin(turn)]])
        bend = torch.sin(1.8**octave * across + 1.3 * bend + octave)
        total = total + strength * bend
    return total


def _angle_to(direction: Colour, d_env: Rays) -> Float[Tensor, "n 1"]:
    """Angle between directions and a fixed one [radians]."""
    return torch.acos((d_env @ torch.tensor(direction)).clamp(-1, 1))[:, None]
