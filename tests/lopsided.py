"""An ellipsoid with knobs tumbling before a still camera, with true silhouettes and matches: an oracle for poses."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.match import Match
from tumble.scene.trajectory import Trajectory
from tumble.synthetic import trajectories

AXES = torch.tensor([0.9, 0.6, 0.4], dtype=torch.float64)
KNOBS = torch.tensor([[0.55, 0.5, 0.25, 0.25], [-0.5, 0.1, -0.5, 0.3]], dtype=torch.float64)
"""Centres and radii of balls that break the ellipsoid's symmetry in the silhouettes; no matches lie on them."""
DISTANCE = trajectories.distance_for(math.radians(30))


@dataclass(frozen=True)
class Tumble:
    """Frames and their truth, in the object's unit."""

    capture: Capture
    T_cam_obj: SE3
    points: Tensor
    """On the surface."""

    def seen(self, frame: int) -> tuple[Tensor, Tensor]:
        """Pixels of all points in a frame, and which of them face the camera."""
        T = self.T_cam_obj[frame]
        normal = self.points / AXES.square()
        facing = (normal * (T.inverse().xyz - self.points)).sum(-1) > 0.2 * normal.norm(dim=-1) * DISTANCE
        camera = Camera(self.capture.camera.fx_fy_cx_cy.double(), 1, 1)
        return camera.project(T @ self.points), facing

    def match(self, i: int, j: int, rng: torch.Generator, *, noise: float = 0.2, wrong: float = 0.1) -> Match:
        """What a good matcher would find: noisy [pixels], with a share of wrong pairs."""
        (uv_i, in_i), (uv_j, in_j) = self.seen(i), self.seen(j)
        both = in_i & in_j
        uv_i, uv_j = uv_i[both], uv_j[both] + noise * torch.randn(int(both.sum()), 2, generator=rng)
        astray = torch.rand(len(uv_j), generator=rng) < wrong
        uv_j[astray] += 8 * torch.randn(int(astray.sum()), 2, generator=rng)
        return Match(i, j, uv_i, uv_j, torch.ones(len(uv_i)))


def tumbling(n: int, *, size: int = 128, points: int = 400, seed: int = 1) -> Tumble:
    """`n` hand-held frames, 5 to 12 degrees apart."""
    return moving(trajectories.handheld(n, DISTANCE, seed=seed), size=size, points=points, seed=seed)


def moving(T_cam_obj: SE3, *, size: int = 128, points: int = 400, seed: int = 1) -> Tumble:
    """The object in some poses, one per frame."""
    camera, n = Camera.from_fov(math.radians(30), size, size), len(T_cam_obj.xyz)
    directions = camera.directions().double()
    masks = []
    for i in range(n):
        T_obj_cam = T_cam_obj[i].inverse()
        o, d = T_obj_cam.xyz / AXES, (T_obj_cam.rotation @ directions) / AXES
        inside = first_hits(o, d, 1.0)[1]
        for knob in KNOBS:
            inside |= first_hits(T_obj_cam.xyz - knob[:3], T_obj_cam.rotation @ directions, float(knob[3]))[1]
        masks.append(torch.where(inside, OBJECT, BACKGROUND).to(torch.uint8))
    rng = torch.Generator().manual_seed(seed)
    surface = torch.nn.functional.normalize(torch.randn(points, 3, generator=rng, dtype=torch.float64), dim=-1) * AXES
    images = torch.full((n, size, size, 3), 100, dtype=torch.uint8)
    names = tuple(f"{i}.png" for i in range(n))
    return Tumble(Capture(images, torch.stack(masks), camera, names, "camera"), T_cam_obj, surface)


def first_hits(origin: Tensor, direction: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Where rays first meet a ball about 0, and whether they do, by the discriminant."""
    a, b = (direction * direction).sum(-1), (direction * origin).sum(-1)
    discriminant = b * b - a * ((origin * origin).sum() - radius**2)
    return origin + direction * ((-b - discriminant.clamp_min(0).sqrt()) / a)[..., None], discriminant > 0


def tumbling_rotations(n: int) -> Tensor:
    """Ten degrees per frame about an axis that turns within the image plane, (n, 3, 3)."""
    rotations = [torch.eye(3, dtype=torch.float64)]
    for k in range(n - 1):
        axis = torch.tensor([math.cos(0.2 * k), math.sin(0.2 * k), 0.3], dtype=torch.float64)
        rotations.append(SO3.exp(math.radians(10) * axis).matrix() @ rotations[-1])
    return torch.stack(rotations)


def truth(scene: Tumble) -> Trajectory:
    """The true poses, float32 like a stage's."""
    T = scene.T_cam_obj
    return Trajectory(SE3(T.wxyz.float(), T.xyz.float()), "camera")
