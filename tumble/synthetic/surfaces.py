"""Procedural surfaces of what surrounds the object in a synthetic capture: quads, tubes, their normals and textures."""

import numpy as np
import torch
from jaxtyping import Float, Int

from tumble.synthetic.pathtracer import Part


def quads(
    corners: Float[np.ndarray, "q 3"],
    across: Float[np.ndarray, "q 3"],
    down: Float[np.ndarray, "q 3"],
    albedo: Float[np.ndarray, "h w 3"],
    roughness: float,
) -> Part:
    """Parallelograms, each of which shows the whole texture.

    Args:
        corners: Position of the texture's top left corner.
        across: Edge along the texture's upper border.
        down: Edge along the texture's left border.
        albedo: Texture, linear RGB.
        roughness: Perceptual roughness.
    """
    vertices = np.stack([corners, corners + across, corners + across + down, corners + down], 1).reshape(-1, 3)
    normals = np.cross(down, across)
    normals = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 4, axis=0)
    faces = (4 * np.arange(len(corners))[:, None] + np.array([0, 3, 2, 0, 2, 1])).reshape(-1, 3)
    uv = np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (len(corners), 1))
    return Part(vertices, normals, faces, uv, albedo, np.full((1, 1, 1), roughness))


def tube(
    rings: Float[np.ndarray, "r c 3"], albedo: Float[np.ndarray, "h w 3"], roughness: float, *, repeats: float = 1.0
) -> Part:
    """A surface through closed rings of points; the texture's columns run around it, its rows along it.

    Args:
        rings: Points of each ring, without a repetition of the first one.
        albedo: Texture, linear RGB.
        roughness: Perceptual roughness.
        repeats: Number of times that the texture is repeated along the tube.
    """
    n, columns, _ = rings.shape
    vertices = np.concatenate([rings, rings[:, :1]], 1).reshape(-1, 3)
    grid = np.arange(n * (columns + 1)).reshape(n, columns + 1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, repeats, n))
    position = columns * np.arange(n)[:, None] + np.arange(columns + 1) % columns
    normals = smooth_normals(vertices, faces, position.ravel())
    return Part(vertices, normals, faces, np.stack([u, v], -1).reshape(-1, 2), albedo, np.full((1, 1, 1), roughness))


def smooth_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], position: Int[np.ndarray, " v"]
) -> Float[np.ndarray, "v 3"]:
    """Unit vertex normals, weighted by area; vertices with the same number in `position` have the same normal."""
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((position.max() + 1, 3))
    for corner in range(3):
        np.add.at(normals, position[faces[:, corner]], areas)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    return normals[position]


def noise(points: Float[np.ndarray, "*b 3"], seed: int) -> Float[np.ndarray, "*b"]:
    """Smooth noise in space with a period of 16, standard deviation about 0.3, and about one bump per unit."""
    rng = torch.Generator().manual_seed(seed)
    lattice = 2 * torch.rand(1, 1, 16, 16, 16, generator=rng) - 1
    lattice = torch.nn.functional.pad(lattice, (0, 1) * 3, mode="circular")
    flat = torch.from_numpy(np.asarray(points, np.float32)).reshape(1, -1, 1, 1, 3)
    values = torch.nn.functional.grid_sample(lattice, (flat % 16) / 8 - 1, align_corners=True)
    return values.double().numpy().reshape(np.shape(points)[:-1])


def pattern(
    colours: Float[np.ndarray, "2 3"], frequency: tuple[float, float], seed: int, *, rows: int = 256
) -> Float[np.ndarray, "rows rows 3"]:
    """A square texture that wanders between two colours [linear RGB], with noise of two sizes.

    Args:
        colours: The two colours.
        frequency: Number of bumps along the columns and along the rows of the texture.
        seed: Seed of the noise.
        rows: Height and width [pixels].
    """
    x, y = np.meshgrid(*[(np.arange(rows) + 0.5) / rows] * 2)
    at = np.stack([x * frequency[0], y * frequency[1], np.zeros_like(x)], -1)
    wander = (0.5 + noise(at, seed) + 0.4 * noise(4 * at, seed + 1))[..., None].clip(0, 1)
    return (1 - wander) * colours[0] + wander * colours[1]
