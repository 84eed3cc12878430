"""Self-shadowing of stage 2 against closed forms: a sphere, a wall, and a torus."""

import math
from dataclasses import replace

import torch

from tests.surfaces import GAMMA, MAJOR, MINOR, sphere, torus
from tumble import backends
from tumble.export.depth_fusion import surrounding_cameras
from tumble.inverse_rendering import sh_lighting
from tumble.inverse_rendering.self_shadowing import VisibilityTransfer, trace_visibility
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.maths import spherical_harmonics
from tumble.maths.directions import fibonacci_sphere
from tumble.rendering.trace import transfer, unoccluded
from tumble.scene.gaussians import Gaussians

UNIFORM = SHLight.constant(0.4, torch.zeros(1))


def irradiance_ratio(
    visibility: VisibilityTransfer, light: SHLight, albedo: torch.Tensor, R_env_obj: torch.Tensor
) -> torch.Tensor:
    """Diffuse radiance with self-shadowing divided by that without."""
    n = len(albedo)
    up = torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4)
    points = Gaussians(torch.zeros(n, 3), up, torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 1, 3))
    matte = replace(light, log_specular_scale=torch.tensor(-math.inf))
    own, rest = (matte, points, torch.logit(albedo)), (R_env_obj, torch.tensor([0.0, 0.0, 3.0]))
    return sh_lighting.radiance(*own, visibility, *rest) / sh_lighting.radiance(*own, None, *rest)


def light_from_the_side() -> SHLight:
    """Light mostly from +x, env frame."""
    light = SHLight.constant(0.4, torch.zeros(1))
    light.coefficients[3] = -1.5
    return light


def behind_wall(normals: torch.Tensor, blocked: torch.Tensor) -> VisibilityTransfer:
    """Transfer of points beside a wall that occludes all directions with a positive product with `blocked`."""
    directions = fibonacci_sphere(4096)
    cosine = (normals @ directions.T).clamp(min=0) * (directions @ blocked <= 0)
    occluded = 4 * math.pi / len(directions) * cosine @ spherical_harmonics.basis(directions, 2)
    return VisibilityTransfer(occluded, transfer([unoccluded(directions, len(normals))], normals))


def test_half_of_a_uniform_light_is_half_of_the_irradiance() -> None:
    up, wall = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0])
    ratio = irradiance_ratio(behind_wall(up, wall), UNIFORM, torch.full((1, 3), 1e-4), torch.eye(3))
    floor = backends.IRRADIANCE_FLOOR
    torch.testing.assert_close(ratio, torch.full((1, 3), (0.5 + floor) / (1 + floor)), atol=0.01, rtol=0)


def test_a_white_wall_reflects_as_much_as_it_occludes() -> None:
    """Under uniform light a white cavity is as bright as the light, if all bounces are included."""
    up, wall = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0])
    ratio = irradiance_ratio(behind_wall(up, wall), UNIFORM, torch.full((1, 3), 1 - 1e-6), torch.eye(3))
    torch.testing.assert_close(ratio, torch.ones(1, 3), atol=0.02, rtol=0)


def test_the_shadow_rotates_with_the_object_and_the_light_does_not() -> None:
    """A wall at +x of the object occludes the light; after a rotation by 180 degrees about z it does not."""
    up, wall, black = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0]), torch.full((1, 3), 1e-4)
    visibility, light = behind_wall(up, wall), light_from_the_side()
    before = irradiance_ratio(visibility, light, black, torch.eye(3)).mean()
    after = irradiance_ratio(visibility, light, black, torch.diag(torch.tensor([-1.0, -1.0, 1.0]))).mean()
    assert before < 0.45 < 0.6 < after


def traced_ratio(gaussians: Gaussians) -> torch.Tensor:
    poses, camera = surrounding_cameras(16, 96)
    visibility = trace_visibility(gaussians, GAMMA, [poses[i] for i in range(16)], camera)
    return irradiance_ratio(visibility, UNIFORM, torch.full((len(gaussians), 3), 1e-4), torch.eye(3))[:, 0]


def test_a_sphere_hardly_shadows_itself() -> None:
    assert traced_ratio(sphere(2000)).mean() > 0.985


def reference_ratio_inside(n: int = 4000) -> float:
    """Fraction of uniform irradiance at the innermost circle of the torus, by sphere tracing."""
    rng = torch.Generator().manual_seed(0)
    u = torch.rand(n, 2, generator=rng)
    across, phi = u[:, 0].sqrt(), 2 * math.pi * u[:, 1]
    toward = torch.stack([-(1 - u[:, 0]).sqrt(), across * phi.cos(), across * phi.sin()], -1)
    x = torch.tensor([MAJOR - MINOR, 0.0, 0.0]) + 0.02 * toward
    free = torch.ones(n, dtype=torch.bool)
    for _ in range(200):
        distance = ((x[:, :2].norm(dim=-1) - MAJOR).square() + x[:, 2].square()).sqrt() - MINOR
        free &= distance > 1e-3
        x = x + distance.clamp(min=1e-3)[:, None] * toward
    return float(free.float().mean())


def test_the_inside_of_a_torus_is_shadowed_as_by_sphere_tracing() -> None:
    ring = torus(4000)
    outward = (ring.normals[:, :2] * ring.means[:, :2]).sum(-1) / ring.means[:, :2].norm(dim=-1)
    ratio = traced_ratio(ring)
    assert ratio[outward > 0.9].mean() > 0.97
    assert abs(float(ratio[outward < -0.97].mean()) - reference_ratio_inside()) < 0.05
