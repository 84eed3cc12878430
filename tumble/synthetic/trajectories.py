"""The three capture settings of the paper (section 5) as trajectories, and the views on which they are scored.

The object stands at the origin of its frame with +y up, inside the unit ball; its *horizon* is the plane y = 0.

- *dome*: the object lies still, the camera looks from all over the upper hemisphere; the light stands with the object.
- *turntable*: the camera stands still 25 degrees above the horizon, the object turns about +y; the light stands with
  the camera.
- *handheld*: the camera stands still, the object tumbles about ever-changing axes, its underside included; the light
  stands with the camera.
"""

import math
from collections.abc import Callable
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, fibonacci_sphere
from tumble.scene import Light
from tumble.synthetic.options import Setting

SETTINGS: tuple[str, ...] = get_args(Setting)
LIGHT: dict[str, Light] = {"dome": "object", "turntable": "camera", "handheld": "camera"}
"""What the light stands still with, by setting."""

ELEVATION = math.radians(25)
"""Of the turntable's camera above the horizon [radians]."""
SHARED_ELEVATIONS = (math.radians(15), math.radians(35))
"""Every setting has seen what a view between these elevations shows [radians]."""
TUMBLE_STEP = (math.radians(5), math.radians(12))
"""Smallest and largest turn between two hand-held frames [radians]."""
CANDIDATES = 1024
"""Random tumbles drawn for one hand-held capture; the one that shows most of the object is taken."""
GOLDEN = (math.sqrt(5) - 1) / 2


def look_at_object(position: Float[Tensor, "t 3"], roll: Float[Tensor, " t"] | None = None) -> SE3:
    """`T_cam_obj` of cameras at `position` [object radius] that look at the origin, +y of the object upwards.

    Args:
        position: Object frame, not on the y axis (there "up" has no meaning).
        roll: Turn of the camera about its viewing axis [radians]; 0 when None.
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
    """Positions around the object; azimuth 0 is +z, 90 degrees is +x."""
    level = elevation.cos()
    return distance * torch.stack([level * azimuth.sin(), elevation.sin(), level * azimuth.cos()], -1)


def dome(n: int, distance: float) -> SE3:
    """`n` cameras spread evenly over the upper hemisphere, on a golden-angle spiral from the horizon up."""
    i = torch.arange(n, dtype=torch.float64)
    return look_at_object(_from_angles(i * 2 * math.pi * GOLDEN, torch.asin((i + 0.5) / n), distance))


def turntable(n: int, distance: float) -> SE3:
    """One full turn about +y in `n` equal steps, seen from 25 degrees above."""
    azimuth = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    return look_at_object(_from_angles(azimuth, torch.full_like(azimuth, ELEVATION), distance))


def handheld(n: int, distance: float, *, seed: int) -> SE3:
    """A smooth tumble of `n` frames that shows the object from all around, 5 to 12 degrees from frame to frame.

    The object also drifts a little, as in a hand: up to 0.07 across and 0.15 along the viewing axis [object radius].
    Deterministic by `seed`.
    """
    rng = torch.Generator().manual_seed(seed)
    time = torch.arange(n, dtype=torch.float64)
    # A turn about the viewing axis shows no new side, so axes lie mostly across it.
    turns = _wander(rng, CANDIDATES, 3, time, period=(25, 80)) * torch.tensor([1.0, 1.0, 0.4])
    turns = torch.nn.functional.normalize(turns, dim=-1)
    low, high = TUMBLE_STEP
    pace = 0.5 * (low + high) + 0.5 * (high - low) * torch.sin(_wander(rng, CANDIDATES, 1, time, period=(10, 30)) * 2)
    first = SO3.exp(3 * torch.randn(CANDIDATES, 3, generator=rng, dtype=torch.float64))
    rotations = [first]
    for t in range(n - 1):
        rotations.append(SO3.exp(turns[:, t] * pace[:, t]) @ rotations[-1])
    wxyz = torch.stack([R.wxyz for R in rotations], 1)
    R_cam_obj = SO3(wxyz[_coverage(wxyz).argmax()])
    drift = torch.tensor([0.07, 0.07, 0.15]) * torch.sin(_wander(rng, 1, 3, time, period=(20, 60))[0])
    return SE3.from_rotation(R_cam_obj, drift + torch.tensor([0.0, 0.0, distance], dtype=torch.float64))


def _wander(
    rng: torch.Generator, n: int, axes: int, time: Float[Tensor, " t"], *, period: tuple[float, float]
) -> Float[Tensor, "n t axes"]:
    """Smooth random curves: sums of three sine waves with periods in a range [frames]."""
    shape = (n, 1, axes, 3)
    low, high = period
    wave = 2 * math.pi / (low + (high - low) * torch.rand(shape, generator=rng, dtype=torch.float64))
    phase = 2 * math.pi * torch.rand(shape, generator=rng, dtype=torch.float64)
    return torch.sin(time[None, :, None, None] * wave + phase).sum(-1)


def _coverage(wxyz: Float[Tensor, "n t 4"]) -> Float[Tensor, " n"]:
    """How well tumbles show the object: the cosine between its worst seen side and the view nearest to that."""
    d_cam = torch.tensor([0.0, 0.0, -1.0], dtype=wxyz.dtype)
    views = SO3(wxyz).inverse() @ d_cam
    return (views @ fibonacci_sphere(128).to(wxyz).T).amax(1).amin(1)


def trajectory(setting: str, n: int, distance: float, *, seed: int) -> SE3:
    """`T_cam_obj` of the `n` training frames of a setting; only hand-held captures depend on the seed."""
    paths: dict[str, Callable[[], SE3]] = {
        "dome": lambda: dome(n, distance),
        "turntable": lambda: turntable(n, distance),
        "handheld": lambda: handheld(n, distance, seed=seed),
    }
    return paths[setting]()


def shared_views(n: int, distance: float) -> SE3:
    """Evaluation views of region "shared": all around, 15 to 35 degrees above the horizon, in every setting."""
    i = torch.arange(n, dtype=torch.float64)
    low, high = SHARED_ELEVATIONS
    return look_at_object(
        _from_angles(2 * math.pi * (i + 0.5) / max(n, 1), low + (high - low) * (i * GOLDEN % 1), distance)
    )


def sphere_views(n: int, distance: float) -> SE3:
    """Evaluation views of region "sphere": from anywhere, at any roll; the same for all settings."""
    i = torch.arange(n, dtype=torch.float64)
    height = 1 - (2 * i + 1) / max(n, 1)
    return look_at_object(
        _from_angles(i * 2 * math.pi * GOLDEN + 0.3, torch.asin(height), distance), i * 2 * math.pi * GOLDEN
    )


def distance_for(fov: float) -> float:
    """Distance [object radius] at which the unit ball, with room to drift, fills a field of view [radians]."""
    return 1.15 / math.sin(fov / 2)
