"""Voxel grids against formulas and finite differences, and rendering through them against rendering all sections."""

import torch
from torch.nn.functional import normalize

from tumble.poses.progressive import grid_field, neus, sdf_field
from tumble.poses.progressive.grid_field import Grids
from tumble.poses.progressive.sdf_field import Sizes


def with_a_plane(nodes: tuple[int, ...] = (5, 9)) -> Grids:
    """A sphere of radius 0.5 plus 0.1 x - 0.2 y + 0.3 z, in equal parts on all grids, which carry it exactly."""
    grids = grid_field.sphere(nodes, 2, radius=0.5, bound=1.1, rng=torch.Generator().manual_seed(0))
    for n in nodes:
        ticks = torch.linspace(-1.1, 1.1, n)
        x, y, z = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
        plane = (0.1 * x - 0.2 * y + 0.3 * z) / len(nodes)
        grids.offsets[str(n)][0, 0] = plane.permute(2, 1, 0)
    return grids


def test_distance_gradient_and_features() -> None:
    grids = with_a_plane()
    x = normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1) * 0.8
    distance, gradient, features = grid_field.distance_and_gradient(grids, x)
    slope = torch.tensor([0.1, -0.2, 0.3])
    assert torch.allclose(distance, 0.3 + x @ slope, atol=1e-5)
    assert torch.allclose(grid_field.distance(grids, x), distance, atol=1e-6)
    # Differences over h curve with the sphere: h^2 / 6 times the third derivative, at most 3 / 0.8^2.
    assert (gradient - (x / 0.8 + slope)).abs().max() < (1.1 / 8) ** 2 / 6 * 3 / 0.8**2
    assert features.shape == (50, 2)


def test_sizes_with_nodes_select_the_grids() -> None:
    sizes = Sizes(nodes=(4, 8), features=3, colour_width=8, colour_depth=1, radius=0.6)
    fields = sdf_field.sphere_initialised(sizes, torch.Generator().manual_seed(0))
    x = torch.tensor([[0.6, 0.0, 0.0], [0.0, 0.9, 0.0]])
    assert torch.allclose(sdf_field.distance(fields.sdf, x), torch.tensor([0.0, 0.3]), atol=1e-6)
    distance, gradient, features = sdf_field.distance_and_gradient(fields.sdf, x)
    rgb = sdf_field.colour(fields.colour, x, torch.zeros_like(x), gradient, features)
    assert rgb.shape == (2, 3)
    assert torch.allclose(distance, torch.tensor([0.0, 0.3]), atol=1e-6)


def test_sections_that_contribute_nothing_are_left_out() -> None:
    origins = torch.tensor([0.05, 0.0, -3.0]).expand(30, 3)
    across = torch.linspace(-0.3, 0.3, 30)
    directions = normalize(torch.stack([across, 0.2 * across, torch.ones(30)], -1), dim=-1)
    intervals = neus.sections(origins, directions, 48, bound=1.1)
    grids, sharpness = with_a_plane(), torch.tensor(60.0)

    def colour(x: torch.Tensor, view: torch.Tensor, gradient: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        return 0.5 + 0.5 * x

    def shape(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return grid_field.distance_and_gradient(grids, x)

    where = neus.near_surface(lambda x: grid_field.distance(grids, x), sharpness, origins, directions, intervals)
    some = neus.render(shape, colour, sharpness, origins, directions, intervals, where=where)
    every = neus.render(shape, colour, sharpness, origins, directions, intervals)
    assert where.any(1).all()
    assert where.float().mean() < 0.3
    # What is left out weighs little where a ray meets the surface head on; grazing rays lose up to a sixteenth.
    assert (some.opacity - every.opacity).abs().median() < 5e-3
    assert (some.opacity - every.opacity).abs().max() < 0.08
    assert (some.rgb - every.rgb).abs().max() < 0.08
