"""Volume rendering of an analytic sphere against its silhouette, its depth and a plain loop."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from tumble.poses.progressive import neus

RADIUS = 0.6


def sphere_sdf(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Distance, gradient and features of a sphere."""
    return x.norm(dim=-1) - RADIUS, normalize(x, dim=-1), x[:, :1]


def position(x: torch.Tensor, view: torch.Tensor, gradient: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """The position itself as colour."""
    return x


def rays(n: int = 41) -> tuple[torch.Tensor, torch.Tensor]:
    """A fan of rays from (0.1, 0, -3) past a sphere."""
    across = torch.linspace(-0.34, 0.34, n, dtype=torch.float64)
    directions = normalize(torch.stack([across, 0.1 * across, torch.ones_like(across)], -1), dim=-1)
    return torch.tensor([0.1, 0.0, -3.0], dtype=torch.float64).expand(n, 3), directions


def rendered_sphere(n_sections: int, sharpness: float) -> tuple[neus.Rendered, torch.Tensor, torch.Tensor]:
    """Rendered rays, their distances from the centre, and the points where they enter the sphere."""
    origins, directions = rays()
    intervals = neus.sections(origins, directions, n_sections, bound=1.0)
    sharp = torch.tensor(sharpness, dtype=torch.float64)
    rendered = neus.render(sphere_sdf, position, sharp, origins, directions, intervals)
    closest = -(origins * directions).sum(-1)
    miss = (origins + closest[:, None] * directions).norm(dim=-1)
    entry = closest - (RADIUS**2 - miss**2).clamp_min(0).sqrt()
    return rendered, miss, origins + entry[:, None] * directions


def test_opacity_is_the_silhouette_and_colour_is_the_point_of_entry() -> None:
    rendered, miss, entry = rendered_sphere(n_sections=2000, sharpness=2000.0)
    inside, outside = miss < RADIUS - 0.02, miss > RADIUS + 0.02
    assert inside.sum() > 10
    assert outside.sum() > 5
    assert rendered.opacity[inside].min() > 0.999
    assert rendered.opacity[outside].max() < 1e-3
    # The weight peaks where the distance is 0, a logistic of width 1/2000 along a slanted ray, with tails on one side.
    assert (rendered.rgb[inside] - entry[inside]).norm(dim=-1).max() < 5e-3


def test_opacity_of_a_grazing_ray_is_a_ratio_of_logistic_functions() -> None:
    """The product up to the closest point telescopes: transmittance = F(closest) / F(start)."""
    rendered, miss, _ = rendered_sphere(n_sections=4000, sharpness=30.0)

    def logistic(s: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(30.0 * s)

    passing = miss < 0.99
    expected = 1 - logistic(miss - RADIUS) / logistic(torch.tensor(1.0 - RADIUS, dtype=torch.float64))
    # The section around the closest point, 1/2000 long, is cut in half; 1e-5 of NeuS in each of 4000 denominators.
    assert (rendered.opacity - expected)[passing & (miss > 0.3)].abs().max() < 5e-3


def test_compositing_equals_a_loop() -> None:
    alpha = torch.rand(3, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weights = neus.composite(alpha)
    for r in range(3):
        transmittance = 1.0
        for k in range(7):
            assert weights[r, k] == pytest.approx(float(alpha[r, k]) * transmittance, abs=1e-6)  # 1e-7 per section
            transmittance *= 1 - float(alpha[r, k])


def test_sections_that_leave_the_object_are_transparent() -> None:
    """Where the distance rises along the ray the opacity is 0; otherwise the back side would be visible."""
    sdf, length = torch.linspace(-0.5, 0.5, 10)[None], torch.full((1, 10), 0.1)
    assert (neus.opacities(sdf, torch.ones(1, 10), length, torch.tensor(50.0)) == 0).all()
    assert neus.opacities(-sdf, -torch.ones(1, 10), length, torch.tensor(50.0)).max() > 0.9


def test_sections_tile_the_chord_and_jitter_moves_them_together() -> None:
    origins, directions = torch.tensor([[0.0, 0.3, -2.0], [0.0, 3.0, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]] * 2)
    intervals = neus.sections(origins, directions, 4, bound=0.5)
    half = math.sqrt(0.25 - 0.09)
    assert torch.allclose(intervals.lengths[0], torch.full((4,), half / 2))
    assert torch.allclose(intervals.middles[0], torch.tensor([-0.75, -0.25, 0.25, 0.75]) * half + 2)
    assert (intervals.lengths[1] == 0).all()
    moved = neus.sections(origins, directions, 4, bound=0.5, jitter=torch.tensor([0.25, 0.25]))
    assert torch.allclose(moved.middles[0] - intervals.middles[0], torch.full((4,), 0.25 * half / 2))


def test_a_ray_that_misses_the_sphere_is_transparent() -> None:
    origins, directions = torch.tensor([[0.0, 3.0, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    intervals = neus.sections(origins, directions, 8, bound=1.0)
    rendered = neus.render(sphere_sdf, position, torch.tensor(20.0), origins, directions, intervals)
    assert float(rendered.opacity) == 0
    assert (rendered.rgb == 0).all()


def test_gradients_reach_the_ray() -> None:
    """Against finite differences in double precision."""
    origins, directions = rays(5)
    intervals = neus.sections(origins, directions, 64, bound=1.0)
    sharp = torch.tensor(40.0, dtype=torch.float64)

    def rendered_colours(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        return neus.render(sphere_sdf, position, sharp, origins, directions, intervals).rgb

    inputs = (origins.clone().requires_grad_(), directions.clone().requires_grad_())
    # eps times the curvature of a logistic of sharpness 40: 1e-6 * 40^2.
    assert torch.autograd.gradcheck(rendered_colours, inputs, atol=1e-4)
