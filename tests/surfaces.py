"""Sphere and torus made of flat Gaussians, and the same as triangles: shapes whose light is known otherwise."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tumble.maths.directions import GOLDEN_ANGLE, fibonacci_sphere, local_frame
from tumble.maths.se3 import SE3, SO3
from tumble.scene.gaussians import Gaussians, constant_sh
from tumble.synthetic.pathtracer import Part

MAJOR, MINOR = 0.65, 0.3
"""Radii of the torus around +z: it fits the unit ball, with a hole of radius 0.35."""
GAMMA = torch.tensor(20.0)


def sphere(n: int, dtype: torch.dtype = torch.float32, radius: float = 1.0) -> Gaussians:
    normals = fibonacci_sphere(n, dtype=dtype)
    return flat(radius * normals, normals, 4 * math.pi * radius**2)


def torus(n: int, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Evenly by area: the ring grows with MAJOR + MINOR cos v."""
    i = torch.arange(n, dtype=torch.float64) + 0.5
    fine = torch.linspace(0, 2 * math.pi, 1 << 16, dtype=torch.float64)
    share = (MAJOR * fine + MINOR * fine.sin()) / (2 * math.pi * MAJOR)
    v = fine[torch.searchsorted(share, i / n).clamp(max=len(fine) - 1)]
    points, normals = torus_point(GOLDEN_ANGLE * i, v)
    return flat(points.to(dtype), normals.to(dtype), 4 * math.pi**2 * MAJOR * MINOR)


def torus_point(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    normals = torch.stack([v.cos() * u.cos(), v.cos() * u.sin(), v.sin()], -1)
    ring = torch.stack([u.cos(), u.sin(), torch.zeros_like(u)], -1)
    return MAJOR * ring + MINOR * normals, normals


def flat(points: Tensor, normals: Tensor, area: float) -> Gaussians:
    """Gaussians on a surface: 0.7 of their distance wide, a tenth of it thick, opaque, white."""
    n = len(points)
    spacing = math.sqrt(area / n)
    log_scales = torch.tensor([0.7, 0.7, 0.1]).to(points).mul(spacing).log().expand(n, 3).clone()
    quats = SO3.from_matrix(local_frame(normals)).wxyz
    return Gaussians(points, quats, log_scales, torch.zeros_like(points[:, 0]), constant_sh(torch.ones_like(points)))


def sphere_mesh(rows: int = 256) -> Part:
    v, u = (
        x.reshape(-1)
        for x in np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, 2 * rows), indexing="ij")
    )
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], 1)
    return part(points, points, rows, 2 * rows)


def torus_mesh(rows: int = 256) -> Part:
    grid = np.meshgrid(np.linspace(0, 2 * np.pi, rows), np.linspace(0, 2 * np.pi, 2 * rows), indexing="ij")
    v, u = (torch.from_numpy(x.reshape(-1)) for x in grid)
    points, normals = torus_point(u, v)
    flipped = part(points.numpy(), normals.numpy(), rows, 2 * rows)
    return replace(flipped, faces=flipped.faces[:, ::-1].copy())


def part(points: np.ndarray, normals: np.ndarray, rows: int, columns: int, albedo: float = 0.6) -> Part:
    i, j = (x.reshape(-1) for x in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = i * columns + j
    faces = np.concatenate([np.stack([a, a + columns, a + 1], 1), np.stack([a + 1, a + columns, a + columns + 1], 1)])
    colour, rough = np.full((1, 1, 3), albedo), np.full((1, 1, 1), 0.5)
    return Part(points, normals, faces, np.zeros((len(points), 2)), colour, rough)


def look_at(eye: list[float], dtype: torch.dtype = torch.float32) -> SE3:
    """The pose in which a camera at `eye` looks at the origin with +z up in the picture."""
    eye_obj = torch.tensor(eye, dtype=dtype)
    forward = -eye_obj / eye_obj.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=dtype))
    right = right / right.norm()
    R_cam_obj = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return SE3(SO3.from_matrix(R_cam_obj).wxyz, -(R_cam_obj @ eye_obj))
