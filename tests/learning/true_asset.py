"""The figure of `scene` as an asset that was not trained: Gaussians on its true surfaces, with true material and light.

What is rendered from it is compared with Mitsuba's images of the same figure.
"""

import math
from functools import cache

import numpy as np
import torch

from tests.learning.scene import CAPTURE, PARTS, Surface, surface
from tumble.datasets import folder
from tumble.maths import SO3, local_frame
from tumble.scene import TEMPERATURE, Asset, Gaussians, Material, constant_sh

GAMMA = 200.0
"""Sharpness of the opacity [1 / object radius]."""


@cache
def true_asset(n: int = 8_000) -> Asset:
    """The asset with about `n` Gaussians, in the frame and at the poses of the committed capture."""
    shapes = {name: surface(name) for name in PARTS}
    vertices = np.concatenate([shape.vertices for shape in shapes.values()])
    centre = (vertices.min(0) + vertices.max(0)) / 2
    radius = np.linalg.norm(vertices - centre, axis=1).max()
    total = sum(_areas(shape).sum() for shape in shapes.values())
    rng = np.random.default_rng(0)
    points, normals, albedo, roughness = [], [], [], []
    for name, shape in shapes.items():
        count = round(n * _areas(shape).sum() / total)
        x, normal, colour = _spread(shape, count, rng)
        points.append((x - centre) / radius)
        normals.append(normal)
        albedo.append(colour)
        roughness.append(np.full(count, PARTS[name].roughness))
    x_obj, normal, colour, rough = (
        torch.from_numpy(np.concatenate(x)).float() for x in (points, normals, albedo, roughness)
    )
    spacing = math.sqrt(total / n) / radius
    gaussians = Gaussians(
        means=x_obj,
        quats=SO3.from_matrix(local_frame(normal)).wxyz,
        log_scales=(spacing * torch.tensor([0.7, 0.7, 0.1])).log().expand(len(x_obj), 3).clone(),
        sdf=torch.zeros(len(x_obj)),
        sh=constant_sh(torch.zeros_like(x_obj)),
    )
    plain = Material.constant(len(x_obj), torch.full((3,), 0.5), 0.5)
    material = Material(
        (TEMPERATURE * torch.logit(colour))[:, None].repeat(1, 4, 1),
        (TEMPERATURE * torch.logit(rough))[:, None].repeat(1, 4),
        plain.normal_offset,
        plain.f0_logit,
    )
    capture, truth = folder.load(CAPTURE), folder.load_truth(CAPTURE)
    assert capture.trajectory is not None
    assert truth is not None
    assert truth.light is not None
    return Asset(gaussians, torch.tensor(GAMMA), material, truth.light, capture.trajectory, capture.camera)


def _areas(shape: Surface) -> np.ndarray:
    """Area of every triangle."""
    a, b, c = (shape.vertices[shape.faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _spread(shape: Surface, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points evenly by area, with unit normals and albedo."""
    cumulative = _areas(shape).cumsum()
    triangles = shape.faces[np.searchsorted(cumulative, (np.arange(n) + 0.5) / n * cumulative[-1])]
    weight = rng.dirichlet((1, 1, 1), n)[..., None]
    x, normal, uv = ((weight * values[triangles]).sum(1) for values in (shape.vertices, shape.normals, shape.uv))
    rows = len(shape.albedo)
    column, row = ((rows * t).astype(int).clip(0, rows - 1) for t in (uv[:, 0], 1 - uv[:, 1]))
    return x, normal / np.linalg.norm(normal, axis=1, keepdims=True), shape.albedo[row, column]
