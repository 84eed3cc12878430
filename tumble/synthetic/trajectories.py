"""Object poses of the three capture settings of the paper (section 5), and the evaluation views.

The object lies in the unit sphere around the origin of its frame, +y up; its *horizon* is the plane y = 0.

- *dome*: the object is still and the camera moves over the upper hemisphere; the light is fixed to the object.
- *turntable*: the camera is still, 25 degrees above the horizon, and the object rotates about +y; the light is fixed
  to the camera.
- *handheld*: the camera is still and the object rotates about changing axes, so that all its sides are visible; the
  light is fixed to the camera.
- *turned*: the views of the dome, under a light that is turned from frame to frame by the poses of a hand-held motion.
  So the light is as diverse as for a hand-held object, while views and visible geometry are those of the dome.
"""

import math
from collections.abc import Callable
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, fibonacci_sphere
from tumble.scene import Light, env_from_obj
from tumble.synthetic.options import Setting

SETTINGS: tuple[str, ...] = get_args(Setting)
"""Names of the capture settings."""
LIGHT_FRAME: dict[str, Light] = {"dome": "object", "turntable": "camera", "handheld": "camera", "turned": "object"}
"""Frame in which the light is at rest, by setting."""

ELEVATION = math.radians(25)
"""Elevation of the turntable's camera above the horizon [radians]."""
SHARED_ELEVATIONS = (math.radians(15), math.radians(35))
"""Minimum and maximum elevation of the views of region "shared" [radians]; the training frames of every setting cover
this range."""
TUMBLE_STEP = (math.radians(5), math.radians(12))
"""Minimum and maximum rotation of the object between two hand-held frames [radians]."""
CANDIDATES = 1024
"""Random trajectories drawn per hand-held capture; the one with the best coverage of the object is used."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Golden ratio minus 1: step of the low-discrepancy sequences of angles [revolutions]."""


def look_at_object(position: Float[Tensor, "t 3"], roll: Float[Tensor, " t"] | None = None) -> SE3:
    """`T_cam_obj` of cameras at `position` that look at the origin, with the object's +y up in the image.

    Args:
        position: Camera positions in the object frame [object radius]; not on the y axis, where "up" is undefined.
        roll: Rotation of the camera about its viewing axis [radians]; 0 if None.
    """
    forward = torch.nn.functional.normalize(-position, dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=position.dtype).expand_as(position)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    down = torch.linalg.cross(forward, right)
    R_cam_obj = SO3.from_matrix(torch.stack([right, down, forward], -2))
    if roll is not None:
        R_cam_obj = SO3.exp(roll[:, None] * position.new_tensor([0.0, 0.0, 1.0])) @ R_cam_obj
    return SE3.from_rotation(R_cam_obj, -(R_cam_obj @ position))


def _from_angles(azimuth: Tensor, elevation: Tensor, distance: float) -> Float[Tensor, "t 3"]:
    """Positions in the object frame from spherical coordinates [radians]; azimuth 0 is +z, 90 degrees is +x."""
    horizontal = elevation.cos()
    return distance * torch.stack([horizontal * azimuth.sin(), elevation.sin(), horizontal * azimuth.cos()], -1)


def dome(n: int, distance: float) -> SE3:
    """`T_cam_obj` of `n` cameras spread evenly over the upper hemisphere, on a golden-angle spiral from the horizon."""
    i = torch.arange(n, dtype=torch.float64)
    return look_at_object(_from_angles(i * 2 * math.pi * GOLDEN, torch.asin((i + 0.5) / n), distance))


def turntable(n: int, distance: float) -> SE3:
    """`T_cam_obj` of one revolution about +y in `n` equal steps, from 25 degrees above the horizon."""
    azimuth = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    return look_at_object(_from_angles(azimuth, torch.full_like(azimuth, ELEVATION), distance))


def handheld(n: int, distance: float, *, seed: int) -> SE3:
    """`T_cam_obj` of a smooth hand-held rotation over `n` frames, 5 to 12 degrees per frame, that shows all sides.

    The object also drifts slightly, as in a hand: up to 0.07 across and 0.15 along the viewing axis [object radius].
    The result depends on `seed` only.
    """
    rng = torch.Generator().manual_seed(seed)
    time = torch.arange(n, dtype=torch.float64)
    # Rotation about the viewing axis shows no new side, so the axes lie mostly across it.
    axes = _smooth_noise(rng, CANDIDATES, 3, time, period=(25, 80)) * torch.tensor([1.0, 1.0, 0.4])
    axes = torch.nn.functional.normalize(axes, dim=-1)
    low, high = TUMBLE_STEP
    noise = _smooth_noise(rng, CANDIDATES, 1, time, period=(10, 30))
    angles = 0.5 * (low + high) + 0.5 * (high - low) * torch.sin(noise * 2)
    first = SO3.exp(3 * torch.randn(CANDIDATES, 3, generator=rng, dtype=torch.float64))
    rotations = [first]
    for t in range(n - 1):
        rotations.append(SO3.exp(axes[:, t] * angles[:, t]) @ rotations[-1])
    wxyz = torch.stack([R.wxyz for R in rotations], 1)
    R_cam_obj = SO3(wxyz[_view_coverage(wxyz).argmax()])
    drift = torch.tensor([0.07, 0.07, 0.15]) * torch.sin(_smooth_noise(rng, 1, 3, time, period=(20, 60))[0])
    return SE3.from_rotation(R_cam_obj, drift + torch.tensor([0.0, 0.0, distance], dtype=torch.float64))


def _smooth_noise(
    rng: torch.Generator, n: int, axes: int, time: Float[Tensor, " t"], *, period: tuple[float, float]
) -> Float[Tensor, "n t axes"]:
    """Smooth random functions of time: sums of three sine waves with periods in the given range [frames]."""
    shape = (n, 1, axes, 3)
    low, high = period
    wave = 2 * math.pi / (low + (high - low) * torch.rand(shape, generator=rng, dtype=torch.float64))
    phase = 2 * math.pi * torch.rand(shape, generator=rng, dtype=torch.float64)
    return torch.sin(time[None, :, None, None] * wave + phase).sum(-1)


def _view_coverage(wxyz: Float[Tensor, "n t 4"]) -> Float[Tensor, " n"]:
    """Coverage of the object by each trajectory: the minimum over 128 directions of the cosine to the nearest view."""
    d_cam = torch.tensor([0.0, 0.0, -1.0], dtype=wxyz.dtype)
    views = SO3(wxyz).inverse() @ d_cam
    return (views @ fibonacci_sphere(128).to(wxyz).T).amax(1).amin(1)


def trajectory(setting: str, n: int, distance: float, *, seed: int, stride: int = 1) -> SE3:
    """`T_cam_obj` of the `n` training frames of a setting.

    Args:
        seed: Seed of the hand-held motion.
        stride: Every how many frames of the hand-held motion a training frame is taken.
    """
    paths: dict[str, Callable[[], SE3]] = {
        "dome": lambda: dome(n, distance),
        "turntable": lambda: turntable(n, distance),
        "handheld": lambda: handheld(n * stride, distance, seed=seed)[::stride],
        "turned": lambda: dome(n, distance),
    }
    return paths[setting]()


def light_turns(n: int, turns: int, *, seed: int) -> Float[Tensor, "n 3 3"]:
    """Rotations of the light in the `n` frames of the setting "turned", from the object frame to the env frame.

    Args:
        turns: Number of poses, taken evenly from a hand-held motion of `n` frames; frame i has pose i modulo `turns`.
        seed: Seed of the motion.
    """
    R_env_obj = env_from_obj(handheld(n, 1.0, seed=seed), "camera")
    chosen = R_env_obj[torch.arange(n) % turns * n // turns]
    return chosen @ R_env_obj[0].T  # the first frame is one of the dome


def shared_views(n: int, distance: float) -> SE3:
    """`T_cam_obj` of the evaluation views of region "shared": evenly spaced azimuths, 15 to 35 degrees above the
    horizon; the same for all settings."""
    i = torch.arange(n, dtype=torch.float64)
    low, high = SHARED_ELEVATIONS
    return look_at_object(
        _from_angles(2 * math.pi * (i + 0.5) / max(n, 1), low + (high - low) * (i * GOLDEN % 1), distance)
    )


def sphere_views(n: int, distance: float) -> SE3:
    """`T_cam_obj` of the evaluation views of region "sphere": all directions and rolls; the same for all settings."""
    i = torch.arange(n, dtype=torch.float64)
    height = 1 - (2 * i + 1) / max(n, 1)
    return look_at_object(
        _from_angles(i * 2 * math.pi * GOLDEN + 0.3, torch.asin(height), distance), i * 2 * math.pi * GOLDEN
    )


def distance_for(fov: float) -> float:
    """Camera distance [object radius] at which the unit sphere fills a field of view [radians], with a 15 % margin for
    drift."""
    return 1.15 / math.sin(fov / 2)
