"""Spherical-harmonic lighting: closed forms, invariance to a common rotation, and gradients."""

import math
from dataclasses import replace

import torch

from tumble.inverse_rendering import sh_lighting
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.maths import spherical_harmonics
from tumble.maths.directions import fibonacci_sphere, texel_directions, texel_solid_angles
from tumble.maths.se3 import SO3
from tumble.rendering import brdf
from tumble.scene.gaussians import Gaussians, quats_from_normals


def radiance(
    light: SHLight, albedo: torch.Tensor, n: torch.Tensor, position: torch.Tensor, R_env_obj: torch.Tensor
) -> torch.Tensor:
    """Radiance of Gaussians at the origin with given normals."""
    count = len(n)
    gaussians = Gaussians(torch.zeros(count, 3), quats_from_normals(n), torch.zeros(count, 3), n[:, 0], n[:, None])
    return sh_lighting.radiance(light, gaussians, torch.logit(albedo), None, R_env_obj, position)


def test_a_constant_light_has_the_same_radiance_in_all_directions() -> None:
    light = SHLight.constant(0.4, torch.zeros(1))
    d = fibonacci_sphere(50)
    torch.testing.assert_close(light.diffuse(d), torch.full((50, 3), 0.4))
    torch.testing.assert_close(light.glossy(d), torch.full((50, 3), 0.4))


def test_the_radiance_is_albedo_times_light_plus_split_sum_times_reflected_light() -> None:
    light = SHLight.constant(0.5, torch.zeros(1))
    view = torch.tensor([0.0, 0.0, 1.0])
    n = torch.tensor([[0.0, 0.0, 1.0], [math.sin(1.2), 0.0, math.cos(1.2)]])
    albedo = torch.tensor([[0.8, 0.2, 0.1]] * 2)
    shaded = radiance(light, albedo, n, 3 * view, torch.eye(3))
    nov = torch.tensor([[1.0], [math.cos(1.2)]])
    reflectance = 0.04 * brdf.split_sum(brdf.split_sum_table(), nov, torch.full_like(nov, 0.5))
    torch.testing.assert_close(shaded, 0.5 * albedo + 0.5 * reflectance, atol=0.5 * 0.04 * 0.03, rtol=0)
    doubled = replace(light, log_specular_scale=torch.tensor(math.log(2)))
    shaded = radiance(doubled, albedo, n, 3 * view, torch.eye(3))
    torch.testing.assert_close(shaded, 0.5 * albedo + reflectance, atol=0.04 * 0.03, rtol=0)


def test_a_common_rotation_of_object_camera_and_light_changes_nothing() -> None:
    torch.manual_seed(0)
    light = SHLight(torch.randn(16, 3), torch.randn(()))
    n, view = torch.nn.functional.normalize(torch.randn(20, 3), dim=-1), torch.randn(3)
    R_env_obj, rotation = SO3.exp(torch.randn(3)).matrix(), SO3.exp(torch.randn(3)).matrix()
    albedo = torch.rand(20, 3)
    before = radiance(light, albedo, n, view, R_env_obj)
    after = radiance(light, albedo, n @ rotation.T, view @ rotation.T, R_env_obj @ rotation.T)
    torch.testing.assert_close(before, after, atol=1e-5, rtol=0)


def test_both_lobes_match_the_light_they_are_derived_from() -> None:
    """A broad light at +x plus uniform light; irradiance / pi by quadrature."""
    fine = texel_directions(64, 128, dtype=torch.float64)
    radiance = (3.0 + 2 * fine[..., :1].clamp_min(0) ** 2).expand(-1, -1, 3)
    light = SHLight(spherical_harmonics.project(radiance), torch.tensor(0.0))
    n = fibonacci_sphere(40).double()
    cosine = torch.einsum("hwd,nd->nhw", fine, n).clamp_min(0)
    area = texel_solid_angles(64, 128).double()
    irradiance = torch.einsum("nhw,hw,hwc->nc", cosine, area, radiance) / math.pi
    # Softplus adds up to 0.05 at these values of about 3, the cut-off of the series less than 0.01.
    torch.testing.assert_close(light.diffuse(n), irradiance, atol=0.06, rtol=0)
    x = torch.eye(3, dtype=torch.float64)[:1]
    assert (light.glossy(x) - light.glossy(-x) > 0.7).all(), "the glossy lobe is brighter in the direction of the light"
    environment = sh_lighting.environment(light, 16)
    error = (environment.lookup(fine) - radiance).abs()
    assert error.mean() < 0.15
    torch.testing.assert_close(environment.integral() / (4 * math.pi), light.glossy(n).mean(0), atol=0.02, rtol=0)
