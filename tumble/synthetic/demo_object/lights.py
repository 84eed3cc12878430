"""Procedural environment maps, linear radiance: a room with a window and a lamp, and a field at sunset.

The camera of a hand-held capture looks along -z, the middle of the map. The light on the visible side of the object
therefore comes from behind the camera, near the left and right edges of the map.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.maths import texel_directions
from tumble.scene import Environment

SUPERSAMPLING = 4
"""Rays per texel along each axis; the texel is their mean."""
LAMP = (0.66, 0.52, 0.5422)
"""Unit direction of the room's warm lamp, env frame: to the right, above and behind the camera."""
WINDOW = (-0.8615, 0.2497, 0.4421)
"""Unit direction of the centre of the room's window, env frame: to the left, above and behind the camera."""
SUN = (0.7723, 0.1736, -0.6111)
"""Unit direction of the setting sun, env frame: ten degrees above the horizon, to the right of the view direction."""

ROOM_MIN = (-1.9, -1.1, -2.4)
"""Minimum x, y, z of the room; the object is at the origin [metres]."""
ROOM_MAX = (2.5, 1.5, 2.7)
"""Maximum x, y, z of the room [metres]."""
LAMP_RADIUS = math.radians(6.5)
"""Angular radius of the lamp [radians]."""
SUN_RADIUS = math.radians(2.5)
"""Angular radius of the sun [radians]: about nine times the real one, so that the disc is almost four texels wide in a
map of 128 rows."""

Triple = tuple[float, float, float]
Vectors = Float[Tensor, "n 3"]


def room_environment(height: int = 128) -> Environment:
    """A room: a cool window on the left (`WINDOW`), a warm lamp on the right (`LAMP`), a doorway behind the object."""
    return _supersampled(_room, height)


def sunset_environment(height: int = 128) -> Environment:
    """A field at sunset under banks of cloud: the sun (`SUN`) is a warm disc, the sky opposite to it violet."""
    return _supersampled(_sunset, height)


def _supersampled(radiance: Callable[[Vectors], Vectors], height: int) -> Environment:
    """The map of a radiance function, averaged over SUPERSAMPLING x SUPERSAMPLING directions per texel."""
    d_env = texel_directions(SUPERSAMPLING * height, SUPERSAMPLING * 2 * height).reshape(-1, 3)
    fine = radiance(d_env).reshape(height, SUPERSAMPLING, 2 * height, SUPERSAMPLING, 3)
    return Environment.from_radiance(fine.mean((1, 3)))


# The room -------------------------------------------------------------------------------------------------------------


def _room(d_env: Vectors) -> Vectors:
    """Radiance of the room from the origin: painted walls lit by two small sources, then door, window and lamp."""
    low, high = torch.tensor(ROOM_MIN), torch.tensor(ROOM_MAX)
    tiny = torch.where(d_env < 0, -1e-9, 1e-9)
    distances = torch.where(d_env > 0, high, low) / torch.where(d_env.abs() < 1e-9, tiny, d_env)
    distance, axis = distances.min(-1)
    hit = d_env * distance[:, None]
    upper = d_env.gather(1, axis[:, None])[:, 0] > 0
    wall = 2 * axis + upper
    normal = torch.nn.functional.one_hot(axis, 3) * torch.where(upper, -1.0, 1.0)[:, None]

    # Walls in the order of their index: left (cool), right (warm), floor, ceiling, front, back.
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
    window, lamp = _wall_point(WINDOW), 0.85 * _wall_point(LAMP)
    cool = 1.5 * _falloff(hit, normal, window) * torch.tensor([0.85, 1.0, 1.2])
    warm = 0.75 * _falloff(hit, normal, lamp) * torch.tensor([1.25, 0.9, 0.55])
    radiance = paint * (0.13 + cool + warm)

    radiance = _with_door(radiance, wall, hit)
    radiance = _with_window(radiance, wall, hit)
    return _with_lamp(radiance, d_env)


def _wall_point(direction: Triple) -> Float[Tensor, "3"]:
    """The point of the walls in a direction from the origin [metres]."""
    d = torch.tensor(direction)
    return d * (torch.where(d > 0, torch.tensor(ROOM_MAX), torch.tensor(ROOM_MIN)) / d).min()


def _falloff(hit: Vectors, normal: Vectors, source: Float[Tensor, "3"]) -> Float[Tensor, "n 1"]:
    """Irradiance of a small source on the walls: cosine over squared distance, softened close to the source."""
    to_source = source - hit
    distance2 = to_source.square().sum(-1, keepdim=True)
    cosine = (to_source * normal).sum(-1, keepdim=True).clamp_min(0) / distance2.clamp_min(1e-4).sqrt()
    return (0.25 + cosine) / (0.6 + distance2)


def _inside(a: Tensor, b: Tensor, left: float, right: float, bottom: float, top: float) -> Bool[Tensor, " n"]:
    return (a > left) & (a < right) & (b > bottom) & (b < top)


def _furnished(paint: Vectors, wall: Tensor, hit: Vectors) -> Vectors:
    """Albedo of the walls with floorboards, a rug, a painting, and a bookshelf behind the camera."""
    x, y, z = hit.unbind(-1)
    boards = 1 + 0.22 * torch.sin(9.0 * x.div(0.22).floor()) * (wall == 2)
    paint = paint * boards[:, None]
    rug = (wall == 2) & ((x / 1.3).square() + (z / 1.0).square() < 1)
    paint = torch.where(rug[:, None], torch.tensor([0.55, 0.20, 0.16]), paint)
    painting = (wall == 1) & _inside(z, y, -1.3, -0.3, -0.1, 0.8)
    paint = torch.where(painting[:, None], torch.tensor([0.10, 0.16, 0.30]), paint)
    shelf = (wall == 5) & _inside(x, y, -0.9, 1.0, -1.1, 0.5)
    book = 7 * x.div(0.07).floor() + 3 * y.div(0.4).floor()
    covers = torch.tensor(
        [[0.42, 0.16, 0.12], [0.12, 0.24, 0.30], [0.55, 0.42, 0.22], [0.60, 0.56, 0.48], [0.16, 0.26, 0.18]]
    )
    spines = covers[book.square().div(5).floor().remainder(5).long()]
    return torch.where(shelf[:, None], spines * (y.remainder(0.4) > 0.05)[:, None], paint)


def _with_door(radiance: Vectors, wall: Tensor, hit: Vectors) -> Vectors:
    """Radiance with a doorway into a dim, warm corridor, in the wall in front of the camera."""
    x, y, _ = hit.unbind(-1)
    door = (wall == 4) & _inside(x, y, 0.5, 1.4, -1.1, 0.95)
    frame = (wall == 4) & _inside(x, y, 0.42, 1.48, -1.1, 1.03)
    radiance = torch.where(frame[:, None], 0.5 * torch.ones(3), radiance)
    corridor = (0.08 + 0.25 * (y + 1.1) / 2)[:, None] * torch.tensor([1.0, 0.72, 0.45])
    return torch.where(door[:, None], corridor, radiance)


def _with_window(radiance: Vectors, wall: Tensor, hit: Vectors) -> Vectors:
    """Radiance with a window of six panes in the left wall: bright sky above hedges."""
    _, y, z = hit.unbind(-1)
    centre = _wall_point(WINDOW)
    up, along = y - centre[1], z - centre[2]
    frame = (wall == 0) & _inside(along, up, -1.0, 1.0, -0.75, 0.75)
    radiance = torch.where(frame[:, None], torch.tensor([0.55, 0.58, 0.62]), radiance)
    pane = frame & (along.add(0.95).remainder(0.65) < 0.58) & (up.add(0.70).remainder(0.72) < 0.66)
    pane = pane & _inside(along, up, -0.95, 0.95, -0.70, 0.70)
    sky = torch.tensor([7.5, 9.6, 12.0]) * (1 + 0.35 * up)[:, None]
    hedge = torch.tensor([0.9, 1.3, 0.6])
    above = (up > -0.42 + 0.06 * torch.sin(9 * along))[:, None]
    return torch.where(pane[:, None], torch.where(above, sky, hedge), radiance)


def _with_lamp(radiance: Vectors, d_env: Vectors) -> Vectors:
    """Radiance with a warm spherical lamp, darker at its edge, and a glow around it."""
    angle = _angle_to(LAMP, d_env)
    glow = 0.5 * torch.exp(-((angle - LAMP_RADIUS).clamp_min(0) / 0.16))
    radiance = radiance + glow * torch.tensor([1.0, 0.68, 0.36])
    globe = (0.7 + 0.3 * (1 - (angle / LAMP_RADIUS).square()).clamp_min(0)) * torch.tensor([52.0, 38.0, 23.0])
    return torch.where(angle < LAMP_RADIUS, globe, radiance)


# The sunset -----------------------------------------------------------------------------------------------------------


def _sunset(d_env: Vectors) -> Vectors:
    """Radiance of the sunset: a sky with clouds and the sun above dark hills and a field."""
    up = d_env[:, 1:2]
    angle = _angle_to(SUN, d_env)
    near_sun = torch.exp(-((angle / 0.9).square()))
    height = up.clamp_min(0)
    zenith, violet, orange = (torch.tensor(c) for c in ((0.10, 0.17, 0.42), (0.34, 0.25, 0.38), (1.9, 0.85, 0.28)))
    horizon = torch.exp(-height / 0.22)
    sky = zenith * (1 - horizon) + violet * horizon + orange * horizon * near_sun
    sky = sky + 2.2 * torch.exp(-angle / 0.12) * torch.tensor([1.0, 0.62, 0.28])

    # Long banks of cloud: waves on a high plane, brighter towards the sun.
    plane = d_env[:, ::2] / (height + 0.12) @ torch.tensor([[0.9, -0.4], [0.4, 0.9]])
    wave = _warped_waves(plane * torch.tensor([0.45, 1.5])) - 0.25
    cloud = (wave / 1.1).clamp(0, 1) * (height / 0.15).clamp(0, 1)
    lit = torch.tensor([0.42, 0.30, 0.34]) + 1.3 * near_sun * torch.tensor([1.0, 0.48, 0.26])
    sky = sky * (1 - 0.8 * cloud) + 0.8 * cloud * lit
    sky = torch.where(angle < SUN_RADIUS, torch.tensor([330.0, 200.0, 85.0]), sky)

    azimuth = torch.atan2(d_env[:, :1], -d_env[:, 2:])
    hills = 0.05 + 0.03 * torch.sin(3 * azimuth + 0.5) + 0.015 * torch.sin(11 * azimuth)
    ground = d_env[:, ::2] / up.abs().clamp_min(0.02)
    patches = 1 + 0.18 * _warped_waves(0.6 * ground) * (up.abs() / 0.3).clamp_max(1)
    field = (0.10 + 0.30 * near_sun) * patches * torch.tensor([0.95, 0.70, 0.32])
    dark = torch.tensor([0.05, 0.055, 0.075])
    return torch.where(up > hills, sky, torch.where(up > 0, dark, field))


def _warped_waves(at: Float[Tensor, "n 2"]) -> Float[Tensor, "n 1"]:
    """A procedural texture in about -2 to 2: a sum of four sine waves, each with a phase warped by the previous one."""
    total, wave = torch.zeros_like(at[:, :1]), torch.zeros_like(at[:, :1])
    for octave, amplitude in enumerate((1.0, 0.6, 0.4, 0.25)):
        angle = 1.9 * octave + 0.4
        across = at @ torch.tensor([[math.cos(angle)], [math.sin(angle)]])
        wave = torch.sin(1.8**octave * across + 1.3 * wave + octave)
        total = total + amplitude * wave
    return total


def _angle_to(direction: Triple, d_env: Vectors) -> Float[Tensor, "n 1"]:
    """Angle between each direction and a fixed one [radians]."""
    return torch.acos((d_env @ torch.tensor(direction)).clamp(-1, 1))[:, None]
