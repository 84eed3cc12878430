"""What rays meet, and what the visible surface can see: against shapes whose shadows are known in closed form."""

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


def torus_sees(points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    """Which directions are open, by marching along them in steps of the distance to the true torus."""
    x = (points + 1e-3 * normals)[:, None].expand(-1, len(directions), -1)
    open_ = normals @ directions.T > 0
    travelled = torch.zeros(x.shape[:2], dtype=points.dtype)
    for _ in range(50):
        y = x + travelled[..., None] * directions
        distance = torch.stack([y[..., :2].norm(dim=-1) - MAJOR, y[..., 2]], -1).norm(dim=-1) - MINOR
        open_ &= distance > 5e-4
        travelled = travelled + distance.clamp(min=1e-3)
    return open_


def test_a_convex_object_casts_no_shadow_on_itself() -> None:
    """From the surface that a camera sees. From centres under it, a prototype saw 0.92 on average."""
    gaussians = sphere(2000)
    seen = surface(rasterize(gaussians, GAMMA, look_at([2, 1, 3]), CAMERA, {}), look_at([2, 1, 3]), CAMERA)
    tracer = tracing.build(gaussians, GAMMA)
    fraction = tracing.visibility(tracer, seen.points, seen.normals, DIRECTIONS).fraction(seen.normals)
    assert fraction.mean() > 0.985
    assert fraction.quantile(0.02) > 0.95


def test_a_rough_convex_object_casts_no_shadow_either() -> None:
    """Centres half a standard deviation in and out, normals 9 degrees off, sizes and opacities mixed."""
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
    seen = surface(rasterize(gaussians, GAMMA, look_at([2, 1, 3]), CAMERA, {}), look_at([2, 1, 3]), CAMERA)
    tracer = tracing.build(gaussians, GAMMA)
    assert tracing.visibility(tracer, seen.points, seen.normals, DIRECTIONS).fraction(seen.normals).mean() > 0.985


def test_a_torus_shades_itself_where_its_true_surface_does() -> None:
    gaussians = torus(4000)
    T_cam_obj = look_at([2, 1, 3])
    seen = surface(rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA)
    ring = MAJOR * torch.nn.functional.normalize(seen.points * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    normals = torch.nn.functional.normalize(seen.points - ring, dim=-1)
    truth = torus_sees(ring + MINOR * normals, normals, DIRECTIONS)
    found = tracing.visibility(tracing.build(gaussians, GAMMA), seen.points, normals, DIRECTIONS).unpacked()
    above = normals @ DIRECTIONS.T > 0
    shaded = (above & ~truth).sum() / above.sum()
    assert 0.05 < shaded < 0.1, "a torus that hides little of its sky from itself would prove little"
    # Discs overhang the tube by some 0.015 and rays start 0.05 above it, so an edge half a unit away moves by 0.1
    # radians. Errors stand at such edges: among the neighbours of a direction, which lie 0.31 apart.
    wrong = found != truth
    assert wrong.sum() / above.sum() < 0.02
    near = (math.cos(0.35) < DIRECTIONS @ DIRECTIONS.T).float()
    at_edge = (truth.float() @ near > 0) & ((~truth).float() @ near > 0)
    assert (wrong & at_edge).sum() > 0.95 * wrong.sum()


def test_bits_lie_where_the_contract_says() -> None:
    """Points on a large sphere see exactly the directions above their horizon."""
    gaussians = sphere(500)
    normals = fibonacci_sphere(7)
    found = tracing.visibility(tracing.build(gaussians, GAMMA), 1.02 * normals, normals, DIRECTIONS)
    above = normals @ DIRECTIONS.T > 0
    assert found.bits.shape == (7, 4)
    for i in range(7):
        for j in range(128):
            assert (found.bits[i, j // 32].item() >> (j % 32)) & 1 == above[i, j]
    assert torch.equal(found.unpacked(), above)
    torch.testing.assert_close(found.fraction(normals), torch.ones(7))
    again = found.gather(torch.tensor([3, 3, 0]))
    assert torch.equal(again.unpacked(), above[[3, 3, 0]])


def test_an_open_sky_hides_nothing() -> None:
    sky = tracing.unoccluded(fibonacci_sphere(70), 3)
    assert sky.bits.shape == (3, 3)
    assert sky.unpacked().shape == (3, 70)
    assert sky.unpacked().all()


def test_the_blocker_stands_in_the_blocked_direction() -> None:
    gaussians = torus(2000)
    index = torch.arange(0, 2000, 50)
    points, normals = gaussians.means[index], gaussians.normals[index]
    tracer = tracing.build(gaussians, GAMMA)
    found = tracing.visibility(tracer, points, normals, DIRECTIONS, blockers=True)
    assert found.blocker is not None
    standing = found.blocker >= 0
    assert torch.equal(standing, (normals @ DIRECTIONS.T > 0) & ~found.unpacked())
    assert standing.any()
    i, j = torch.where(standing)
    towards = gaussians.means[found.blocker[i, j].long()] - tracer.lifted(points, normals)[i]
    along = (towards * DIRECTIONS[j]).sum(-1)
    beside = (towards - along[:, None] * DIRECTIONS[j]).norm(dim=-1)
    # The tracer cuts a Gaussian at three standard deviations.
    assert (along > 0).all()
    assert (beside < 3 * gaussians.scales[0, 0]).all()


def test_a_ray_brings_back_the_radiance_of_what_it_hits() -> None:
    gaussians = sphere(500)
    radiance = (gaussians.means[:, :1] > 0).float() * torch.tensor([1.0, 2.0, 3.0])
    origins = torch.tensor([[3.0, 0, 0], [-3.0, 0, 0], [3.0, 3.0, 3.0]])
    directions = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    hits = tracing.trace(tracing.build(gaussians, GAMMA), origins, directions, radiance)
    # A blocked ray keeps no light, and its radiance is that of the opaque surface.
    torch.testing.assert_close(hits.transmittance, torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(hits.radiance, torch.tensor([[1.0, 2, 3], [0, 0, 0], [0, 0, 0]]))
    assert hits.hit[2] == -1


def test_rebuilding_is_due_when_the_middle_gaussian_has_moved() -> None:
    gaussians = sphere(100)
    tracer = tracing.build(gaussians, GAMMA)
    assert tracer.moved(gaussians) == 0
    shift = 0.5 * gaussians.scales[0, 0]
    parts = vars(gaussians)
    moved = Gaussians(**{**parts, "means": gaussians.means + torch.tensor([shift, 0, 0])})
    assert math.isclose(tracer.moved(moved), 0.5, rel_tol=1e-5)
    assert tracer.moved(Gaussians(*(x[:99] for x in parts.values()))) == math.inf
    # In place, as an optimizer does: the tracer remembers where they were.
    gaussians.means.add_(torch.tensor([shift, 0, 0]))
    assert math.isclose(tracer.moved(gaussians), 0.5, rel_tol=1e-5)


@pytest.mark.parametrize("buried", [0.03, 0.1])
def test_surface_points_lie_on_the_surface_that_is_seen(buried: float) -> None:
    """A second shell under the sphere dominates no pixel; its points come up to the seen surface."""
    outer, inner = sphere(1000), sphere(300, radius=1 - buried)
    gaussians = Gaussians(*(torch.cat(pair) for pair in zip(vars(outer).values(), vars(inner).values(), strict=True)))
    points = tracing.surface_points(gaussians, GAMMA, map(look_at, EYES), CAMERA)
    # The mean depth stands 0.01 above the sphere where discs overlap, a tangent plane another 0.01 beside its point.
    assert (points.norm(dim=-1) - 1).abs().max() < 0.025
    # The point is the Gaussian's own, no further along the surface than its width.
    assert (points - gaussians.normals).norm(dim=-1).quantile(0.99) < 3 * outer.scales[0, 0]
    tracer = tracing.build(gaussians, GAMMA)
    fraction = tracing.visibility(tracer, points, gaussians.normals, DIRECTIONS).fraction(gaussians.normals)
    assert fraction.mean() > 0.985


def test_transfer_is_the_irradiance_of_what_is_seen() -> None:
    """Under a light of degree 2, with all of the sky and with the half that is brighter."""
    normals, directions = fibonacci_sphere(9), fibonacci_sphere(4096)
    coefficients = torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
    light = spherical_harmonics.basis(directions, 2) @ coefficients
    cosine = (normals @ directions.T).clamp(min=0)
    bright = directions[:, 0] > 0.2
    closed = torch.tensor(
        [sum((1 << j) - (1 << 32) * (j == 31) for j in range(32) if word[j]) for word in bright.unflatten(0, (-1, 32))]
    )
    half = tracing.Visibility(directions, closed.int().expand(9, -1), None)
    for sky, seen in ((tracing.unoccluded(directions, 9), torch.ones(4096)), (half, bright.float())):
        truth = 4 * math.pi / 4096 * (cosine * seen) @ light
        torch.testing.assert_close(tracing.transfer([sky], normals) @ coefficients, truth, atol=1e-3, rtol=0)
    opened = tracing.transfer([tracing.unoccluded(directions, 9)], normals) @ coefficients
    series = spherical_harmonics.series(irradiance_coefficients(coefficients), normals)
    torch.testing.assert_close(opened, series, atol=0.01, rtol=0)


def test_no_gaussians_block_nothing() -> None:
    nobody = Gaussians(*(x[:0] for x in vars(sphere(1)).values()))
    normals = fibonacci_sphere(5)
    found = tracing.visibility(tracing.build(nobody, GAMMA), normals, normals, DIRECTIONS)
    assert torch.equal(found.unpacked(), normals @ DIRECTIONS.T > 0)
