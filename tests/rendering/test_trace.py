"""Ray tracing and visibility against shapes with known shadows."""

import math

import pytest
import torch
from torch import Tensor

from tests.oracles.irradiance import irradiance_coefficients
from tests.surfaces import GAMMA, MAJOR, MINOR, look_at, sphere, torus
from tumble.maths import spherical_harmonics
from tumble.maths.directions import fibonacci_sphere
from tumble.rendering import trace as tracing
from tumble.rendering.rasterizer import rasterize
from tumble.rendering.shading import surface
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians

CAMERA = Camera.from_fov(0.6, 48, 48)
EYES = [[0, -4, 0.1], [0, 4, 0.1], [4, 0, 0.1], [-4, 0, 0.1], [0.1, 0, 4], [0.1, 0, -4]]
DIRECTIONS = fibonacci_sphere(128)


def torus_visibility(points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    """Which directions are not occluded, by sphere tracing of the true torus."""
    x = (points + 1e-3 * normals)[:, None].expand(-1, len(directions), -1)
    visible = normals @ directions.T > 0
    travelled = torch.zeros(x.shape[:2], dtype=points.dtype)
    for _ in range(50):
        y = x + travelled[..., None] * directions
        distance = torch.stack([y[..., :2].norm(dim=-1) - MAJOR, y[..., 2]], -1).norm(dim=-1) - MINOR
        visible &= distance > 5e-4
        travelled = travelled + distance.clamp(min=1e-3)
    return visible


def test_a_convex_object_does_not_shadow_itself() -> None:
    """Rays start from the rendered surface; from the Gaussians' centres the mean fraction would be 0.92."""
    gaussians = sphere(2000)
    visible_surface = surface(rasterize(gaussians, GAMMA, look_at([2, 1, 3]), CAMERA, {}), look_at([2, 1, 3]), CAMERA)
    tracer = tracing.build_tracer(gaussians, GAMMA)
    fraction = tracing.visibility(tracer, visible_surface.points, visible_surface.normals, DIRECTIONS).fraction(
        visible_surface.normals
    )
    assert fraction.mean() > 0.985
    assert fraction.quantile(0.02) > 0.95


def test_a_noisy_convex_object_does_not_shadow_itself_either() -> None:
    """Noise of half a standard deviation on centres and 9 degrees on normals; varying sizes and opacities."""
    torch.manual_seed(0)
    clean = sphere(2000)
    sigma = clean.scales[0, 0]
    gaussians = Gaussians(
        clean.means + 0.5 * sigma * torch.randn(2000, 1) * clean.normals,
        clean.quats + 0.08 * torch.randn(2000, 4),
        clean.log_scales + 0.3 * torch.randn(2000, 3),
        0.1 * torch.rand(2000),
        clean.sh,
    )
    visible_surface = surface(rasterize(gaussians, GAMMA, look_at([2, 1, 3]), CAMERA, {}), look_at([2, 1, 3]), CAMERA)
    tracer = tracing.build_tracer(gaussians, GAMMA)
    assert (
        tracing.visibility(tracer, visible_surface.points, visible_surface.normals, DIRECTIONS)
        .fraction(visible_surface.normals)
        .mean()
        > 0.985
    )


def test_a_torus_shadows_itself_like_the_true_surface() -> None:
    gaussians = torus(4000)
    T_cam_obj = look_at([2, 1, 3])
    visible_surface = surface(rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA)
    ring = MAJOR * torch.nn.functional.normalize(visible_surface.points * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    normals = torch.nn.functional.normalize(visible_surface.points - ring, dim=-1)
    truth = torus_visibility(ring + MINOR * normals, normals, DIRECTIONS)
    found = tracing.visibility(
        tracing.build_tracer(gaussians, GAMMA), visible_surface.points, normals, DIRECTIONS
    ).unpacked()
    above = normals @ DIRECTIONS.T > 0
    shadowed = (above & ~truth).sum() / above.sum()
    assert 0.05 < shadowed < 0.1, "the test needs self-shadowing"
    # Discs extend beyond the tube by about 0.015 and rays start 0.05 above it, which moves an edge half a unit away by
    # 0.1 radians. Errors are at such edges: between neighbouring directions, which are 0.31 apart.
    wrong = found != truth
    assert wrong.sum() / above.sum() < 0.02
    near = (math.cos(0.35) < DIRECTIONS @ DIRECTIONS.T).float()
    at_edge = (truth.float() @ near > 0) & ((~truth).float() @ near > 0)
    assert (wrong & at_edge).sum() > 0.95 * wrong.sum()


def test_the_layout_of_the_bits() -> None:
    """From points just above a sphere exactly the directions above the horizon are visible."""
    gaussians = sphere(500)
    normals = fibonacci_sphere(7)
    found = tracing.visibility(tracing.build_tracer(gaussians, GAMMA), 1.02 * normals, normals, DIRECTIONS)
    above = normals @ DIRECTIONS.T > 0
    assert found.bits.shape == (7, 4)
    for i in range(7):
        for j in range(128):
            assert (found.bits[i, j // 32].item() >> (j % 32)) & 1 == above[i, j]
    assert torch.equal(found.unpacked(), above)
    torch.testing.assert_close(found.fraction(normals), torch.ones(7))
    again = found.gather(torch.tensor([3, 3, 0]))
    assert torch.equal(again.unpacked(), above[[3, 3, 0]])


def test_unoccluded_has_all_directions_visible() -> None:
    unshadowed = tracing.unoccluded(fibonacci_sphere(70), 3)
    assert unshadowed.bits[unshadowed.rows()].shape == (3, 3)
    assert unshadowed.unpacked().shape == (3, 70)
    assert unshadowed.unpacked().all()


def test_the_blocker_is_in_the_occluded_direction() -> None:
    gaussians = torus(2000)
    index = torch.arange(0, 2000, 50)
    points, normals = gaussians.means[index], gaussians.normals[index]
    tracer = tracing.build_tracer(gaussians, GAMMA)
    found = tracing.visibility(tracer, points, normals, DIRECTIONS, blockers=True)
    assert found.blocker is not None
    occluded = found.blocker >= 0
    assert torch.equal(occluded, (normals @ DIRECTIONS.T > 0) & ~found.unpacked())
    assert occluded.any()
    i, j = torch.where(occluded)
    towards = gaussians.means[found.blocker[i, j].long()] - tracer.ray_origins(points, normals)[i]
    along = (towards * DIRECTIONS[j]).sum(-1)
    beside = (towards - along[:, None] * DIRECTIONS[j]).norm(dim=-1)
    # The tracer truncates a Gaussian at three standard deviations.
    assert (along > 0).all()
    assert (beside < 3 * gaussians.scales[0, 0]).all()


def test_a_ray_returns_the_radiance_of_the_gaussian_that_it_hits() -> None:
    gaussians = sphere(500)
    radiance = (gaussians.means[:, :1] > 0).float() * torch.tensor([1.0, 2.0, 3.0])
    origins = torch.tensor([[3.0, 0, 0], [-3.0, 0, 0], [3.0, 3.0, 3.0]])
    directions = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    hits = tracing.trace(tracing.build_tracer(gaussians, GAMMA), origins, directions, radiance)
    # An occluded ray has a transmittance of 0 and the radiance of the opaque surface.
    torch.testing.assert_close(hits.transmittance, torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(hits.radiance, torch.tensor([[1.0, 2, 3], [0, 0, 0], [0, 0, 0]]))
    assert hits.hit[2] == -1


def test_displacement_is_the_median_shift() -> None:
    gaussians = sphere(100)
    tracer = tracing.build_tracer(gaussians, GAMMA)
    assert tracer.displacement(gaussians) == 0
    shift = 0.5 * gaussians.scales[0, 0]
    parts = vars(gaussians)
    moved = Gaussians(**{**parts, "means": gaussians.means + torch.tensor([shift, 0, 0])})
    assert math.isclose(tracer.displacement(moved), 0.5, rel_tol=1e-5)
    assert tracer.displacement(Gaussians(*(x[:99] for x in parts.values()))) == math.inf
    # The tracer has a copy, so that changes in place, as by an optimizer, are measured.
    gaussians.means.add_(torch.tensor([shift, 0, 0]))
    assert math.isclose(tracer.displacement(gaussians), 0.5, rel_tol=1e-5)


@pytest.mark.parametrize("depth", [0.03, 0.1])
def test_surface_points_are_on_the_rendered_surface(depth: float) -> None:
    """A second shell below the sphere dominates no pixel; its points are moved up to the rendered surface."""
    outer, inner = sphere(1000), sphere(300, radius=1 - depth)
    gaussians = Gaussians(*(torch.cat(pair) for pair in zip(vars(outer).values(), vars(inner).values(), strict=True)))
    points = tracing.surface_points(gaussians, GAMMA, map(look_at, EYES), CAMERA)
    # Overlapping discs put the mean depth 0.01 above the sphere, a tangent plane another 0.01.
    assert (points.norm(dim=-1) - 1).abs().max() < 0.025
    # A point is no further along the surface from its Gaussian than the Gaussian's width.
    assert (points - gaussians.normals).norm(dim=-1).quantile(0.99) < 3 * outer.scales[0, 0]
    tracer = tracing.build_tracer(gaussians, GAMMA)
    fraction = tracing.visibility(tracer, points, gaussians.normals, DIRECTIONS).fraction(gaussians.normals)
    assert fraction.mean() > 0.985


def test_transfer_gives_the_irradiance_of_the_visible_light() -> None:
    """Under a light of degree 2, without occlusion and with some directions occluded."""
    normals, directions = fibonacci_sphere(9), fibonacci_sphere(4096)
    coefficients = torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
    light = spherical_harmonics.basis(directions, 2) @ coefficients
    cosine = (normals @ directions.T).clamp(min=0)
    visible = directions[:, 0] > 0.2
    bits = torch.tensor(
        [sum((1 << j) - (1 << 32) * (j == 31) for j in range(32) if word[j]) for word in visible.unflatten(0, (-1, 32))]
    )
    half = tracing.Visibility(directions, bits.int().expand(9, -1), None)
    for traced, fraction in ((tracing.unoccluded(directions, 9), torch.ones(4096)), (half, visible.float())):
        truth = 4 * math.pi / 4096 * (cosine * fraction) @ light
        torch.testing.assert_close(tracing.transfer([traced], normals) @ coefficients, truth, atol=1e-3, rtol=0)
    unshadowed = tracing.transfer([tracing.unoccluded(directions, 9)], normals) @ coefficients
    series = spherical_harmonics.series(irradiance_coefficients(coefficients), normals)
    torch.testing.assert_close(unshadowed, series, atol=0.01, rtol=0)


def test_no_gaussians_occlude_nothing() -> None:
    empty = Gaussians(*(x[:0] for x in vars(sphere(1)).values()))
    normals = fibonacci_sphere(5)
    found = tracing.visibility(tracing.build_tracer(empty, GAMMA), normals, normals, DIRECTIONS)
    assert torch.equal(found.unpacked(), normals @ DIRECTIONS.T > 0)
