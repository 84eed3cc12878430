"""The shade that stage 2 knows of: none on a ball, that of theory in a hollow."""

import math

import torch

from tests.surfaces import GAMMA, MAJOR, MINOR, sphere, torus
from tumble.export.depth_fusion import around
from tumble.inverse_rendering import self_shadowing
from tumble.inverse_rendering.self_shadowing import Sky, look_around
from tumble.inverse_rendering.sh_lighting import CoarseLight
from tumble.maths import spherical_harmonics
from tumble.maths.directions import fibonacci_sphere
from tumble.rendering.trace import transfer, unoccluded
from tumble.scene.gaussians import Gaussians

EVEN = CoarseLight.constant(0.4, torch.zeros(1))


def from_the_side() -> CoarseLight:
    """Much light from +x, env frame."""
    light = CoarseLight.constant(0.4, torch.zeros(1))
    light.coefficients[3] = -1.5
    return light


def skies(normals: torch.Tensor, blocked: torch.Tensor) -> Sky:
    """What points see that have one wall, in the directions of positive product with `blocked`."""
    directions = fibonacci_sphere(4096)
    cosine = (normals @ directions.T).clamp(min=0) * (directions @ blocked <= 0)
    seen = 4 * math.pi / len(directions) * cosine @ spherical_harmonics.basis(directions, 2)
    return Sky(seen, transfer([unoccluded(directions, len(normals))], normals))


def test_half_an_even_sky_is_half_the_light() -> None:
    up, wall = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0])
    share = skies(up, wall).share(EVEN, torch.full((1, 3), 1e-4), torch.eye(3))
    floor = self_shadowing.FLOOR
    torch.testing.assert_close(share, torch.full((1, 3), (0.5 + floor) / (1 + floor)), atol=0.01, rtol=0)


def test_a_white_wall_gives_back_what_it_takes() -> None:
    """In an even light a white cavity is as bright as the sky (all bounces)."""
    up, wall = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0])
    share = skies(up, wall).share(EVEN, torch.full((1, 3), 1.0), torch.eye(3))
    torch.testing.assert_close(share, torch.ones(1, 3), atol=0.02, rtol=0)


def test_the_shadow_turns_with_the_object_and_the_light_does_not() -> None:
    """A wall towards +x of the object keeps out the lamp; turned half around z, it stands away from it."""
    up, wall, black = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0]), torch.full((1, 3), 1e-4)
    sky, light = skies(up, wall), from_the_side()
    before = sky.share(light, black, torch.eye(3)).mean()
    after = sky.share(light, black, torch.diag(torch.tensor([-1.0, -1.0, 1.0]))).mean()
    assert before < 0.45 < 0.6 < after


def looked_around(gaussians: Gaussians) -> torch.Tensor:
    poses, camera = around(16, 96)
    sky = look_around(gaussians, GAMMA, [poses[i] for i in range(16)], camera)
    return sky.share(EVEN, torch.full((len(gaussians), 3), 1e-4), torch.eye(3))[:, 0]


def test_a_ball_hardly_shadows_itself() -> None:
    assert looked_around(sphere(2000)).mean() > 0.985


def open_to_the_inside(n: int = 4000) -> float:
    """Share of an even sky's light that reaches the innermost circle of the ring: rays stepped through its distance."""
    rng = torch.Generator().manual_seed(0)
    u = torch.rand(n, 2, generator=rng)
    across, phi = u[:, 0].sqrt(), 2 * math.pi * u[:, 1]
    toward = torch.stack([-(1 - u[:, 0]).sqrt(), across * phi.cos(), across * phi.sin()], -1)
    at = torch.tensor([MAJOR - MINOR, 0.0, 0.0]) + 0.02 * toward
    free = torch.ones(n, dtype=torch.bool)
    for _ in range(200):
        distance = ((at[:, :2].norm(dim=-1) - MAJOR).square() + at[:, 2].square()).sqrt() - MINOR
        free &= distance > 1e-3
        at = at + distance.clamp(min=1e-3)[:, None] * toward
    return float(free.float().mean())


def test_the_inside_of_a_ring_has_the_shade_that_rays_find() -> None:
    ring = torus(4000)
    outward = (ring.normals[:, :2] * ring.means[:, :2]).sum(-1) / ring.means[:, :2].norm(dim=-1)
    share = looked_around(ring)
    assert share[outward > 0.9].mean() > 0.97
    assert abs(float(share[outward < -0.97].mean()) - open_to_the_inside()) < 0.05
