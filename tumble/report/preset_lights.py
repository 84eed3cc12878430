"""Three environment maps computed by formulas, free of third-party licences: studio, overcast sky, sunset.

Frame and layout are those of `Environment`: +y is up, the centre of the map is -z. Radiance is up to one factor.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import texel_directions
from tumble.scene import Environment

HEIGHT = 64
"""Rows of the maps: enough for sharp edges of softboxes of twenty degrees."""


def studio() -> Environment:
    """A dark room with a large softbox to the left, a smaller one to the right, and a strip light above and behind."""
    d = texel_directions(HEIGHT, 2 * HEIGHT)
    room = 0.06 + 0.04 * d[..., 1:2]
    boxes = [  # direction, half angles [radians], radiance
        ((-0.8, 0.45, 0.55), (0.45, 0.55), (9.0, 8.6, 8.0)),
        ((0.95, 0.25, 0.3), (0.22, 0.4), (3.6, 3.9, 4.4)),
        ((0.1, 0.75, -0.75), (0.8, 0.14), (7.0, 7.0, 7.0)),
    ]
    light = sum(_softbox(d, direction, half)[..., None] * d.new_tensor(colour) for direction, half, colour in boxes)
    return Environment.from_radiance(room + light)


def overcast() -> Environment:
    """The CIE overcast sky, three times as bright above as at the horizon, over a grey ground."""
    y = texel_directions(HEIGHT, 2 * HEIGHT)[..., 1:2]
    sky = (1 + 2 * y.clamp(min=0)) / 3 * y.new_tensor([0.92, 0.98, 1.08])
    return Environment.from_radiance(_sky_and_ground(y, sky, y.new_tensor([0.16, 0.15, 0.13])))


def sunset() -> Environment:
    """A low sun to the right, an orange horizon around it, and a blue sky."""
    d = texel_directions(HEIGHT, 2 * HEIGHT)
    y = d[..., 1:2]
    sun = d.new_tensor([0.9, 0.17, 0.25])
    cosine = (d @ torch.nn.functional.normalize(sun, dim=-1))[..., None].clamp(-1, 1)
    glow = (4 * (cosine - 1)).exp() * (-5 * y.abs()).exp()
    sky = torch.lerp(y.new_tensor([0.55, 0.42, 0.40]), y.new_tensor([0.12, 0.20, 0.42]), y.clamp(0, 1).sqrt())
    sky = sky + glow * y.new_tensor([2.6, 1.1, 0.35])
    disc = torch.sigmoid((cosine - math.cos(0.09)) / 0.002) * y.new_tensor([90.0, 52.0, 22.0])
    return Environment.from_radiance(_sky_and_ground(y, sky + disc, y.new_tensor([0.12, 0.08, 0.06]) + 0.15 * glow))


def _sky_and_ground(
    y: Float[Tensor, "h w 1"], sky: Float[Tensor, "h w 3"], ground: Float[Tensor, "... 3"]
) -> Float[Tensor, "h w 3"]:
    """Sky above and ground below the horizon, with a transition of about one texel."""
    return torch.lerp(ground.expand_as(sky), sky, torch.sigmoid(y * HEIGHT / 2))


def _softbox(
    d: Float[Tensor, "h w 3"], direction: tuple[float, float, float], half: tuple[float, float]
) -> Float[Tensor, "h w"]:
    """Coverage of each texel by an upright rectangular softbox with half angles `half` (width, height) [radians]."""
    forward = torch.nn.functional.normalize(d.new_tensor(direction), dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, d.new_tensor([0.0, 1.0, 0.0])), dim=-1)
    up = torch.linalg.cross(right, forward)
    x, y, z = d @ right, d @ up, d @ forward
    sharpness = HEIGHT / math.pi * 2
    inside = torch.sigmoid((half[0] - torch.atan2(x, z).abs()) * sharpness)
    return inside * torch.sigmoid((half[1] - torch.atan2(y, z).abs()) * sharpness)
