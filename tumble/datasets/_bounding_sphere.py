"""The sphere around an object, from the rays through the contours of its silhouettes in views with known poses."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64

from tumble.maths import smallest_enclosing_sphere

RADIUS_MARGIN = 1.02
"""Radius of the object's sphere divided by the radius that the silhouettes determine."""
SPHERE_STEPS = 2000
"""Number of steps of the search for the smallest sphere; the last ones move it by a thousandth of its radius."""


def bounding_sphere(
    starts: Sequence[Float64[np.ndarray, "3"]], rays: Sequence[Float64[np.ndarray, "_ 3"]]
) -> tuple[Float64[np.ndarray, "3"], float, float]:
    """Centre and radius of the smallest sphere that reaches all rays, and the disagreement of the views.

    The surface point farthest from the centre lies on the contour in the views perpendicular to it, so with many views
    this is the sphere around the object, up to `RADIUS_MARGIN`.

    Args:
        starts: Camera position of each view, in any frame and unit.
        rays: Unit directions through the vertices of the silhouette's convex hull in each view, in the same frame.

    Returns:
        Centre and radius in the frame and unit of the views; the median distance of the rays through the silhouettes'
        centres from their common point [radius of the median silhouette].
    """
    axes = _unit(np.stack([directions.mean(0) for directions in rays]))
    P = np.eye(3) - axes[:, :, None] * axes[:, None]
    # Least squares, because the solution stays finite for parallel rays, which do not intersect.
    centre = np.linalg.lstsq(P.sum(0), (P @ np.stack(starts)[..., None]).sum(0)[:, 0], rcond=None)[0]
    ray_distance = np.median(np.linalg.norm(_offsets_to_rays(centre, np.stack(starts), axes), axis=1))
    distances = np.linalg.norm(np.stack(starts) - centre, axis=1)
    radii = [np.linalg.norm(r - axis, axis=1).max() for r, axis in zip(rays, axes, strict=True)]
    start = np.repeat(np.stack(starts), [len(r) for r in rays], 0)
    direction = np.concatenate(rays)

    def offsets(x: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(_offsets_to_rays(x.numpy(), start, direction))

    solution = smallest_enclosing_sphere(offsets, torch.from_numpy(centre), steps=SPHERE_STEPS)
    radius = float(offsets(solution).norm(dim=-1).max())
    return solution.numpy(), RADIUS_MARGIN * radius, float(ray_distance / np.median(distances * radii))


def _offsets_to_rays(x: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Vectors from a point to the closest points of lines."""
    offset = start - x
    return offset - (offset * direction).sum(1, keepdims=True) * direction


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)
