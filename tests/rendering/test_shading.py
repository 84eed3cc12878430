"""Deferred shading against closed forms, the claims of the paper, and Mitsuba (slow)."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.surfaces import GAMMA, look_at, sphere, sphere_mesh, torus, torus_mesh
from tumble.maths.directions import fibonacci_sphere, random_rotation, texel_directions
from tumble.maths.se3 import SE3, SO3
from tumble.rendering import brdf, importance_sampling, shading
from tumble.rendering.prefiltered_light import prefilter
from tumble.rendering.rasterizer import rasterize
from tumble.rendering.shading import Bounce, Surface
from tumble.rendering.trace import Visibility, build_tracer, transfer, unoccluded, visibility
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians
from tumble.scene.trajectory import Trajectory

CAMERA = Camera.from_fov(0.6, 48, 48)
F0 = 0.04


def uniform(value: float = 1.0, dtype: torch.dtype = torch.float32) -> Environment:
    return Environment.from_radiance(torch.full((8, 16, 3), value, dtype=dtype))


def lamp(towards: list[float], width: float = 0.15, power: float = 60.0, rows: int = 64) -> Environment:
    """One round light in front of dim uniform light; `towards` in the env frame, width in radians."""
    centre = torch.nn.functional.normalize(torch.tensor(towards), dim=-1)
    bright = ((texel_directions(rows, 2 * rows) @ centre - 1) / width**2).exp()
    return Environment.from_radiance((1e-3 + power * bright)[..., None].expand(-1, -1, 3))


def visible_sphere(n: int, dtype: torch.dtype = torch.float32) -> Surface:
    """The part of a unit sphere that faces a camera at +z, three radii away, without grazing angles."""
    normals = fibonacci_sphere(2 * n, dtype=dtype)[: n // 2]
    views = torch.nn.functional.normalize(torch.tensor([0.0, 0, 3]).to(normals) - normals, dim=-1)
    return Surface(torch.arange(len(normals)), normals, normals, views)


def grey(surface: Surface, albedo: float = 0.5, roughness: float = 0.5) -> tuple[Tensor, Tensor]:
    p = len(surface.pixels)
    return surface.points.new_full((p, 3), albedo), surface.points.new_full((p, 1), roughness)


def transfer_vectors(gaussians: Gaussians) -> Tensor:
    """Transfer vectors of Gaussians whose centres are on the surface."""
    tracer = build_tracer(gaussians, GAMMA)
    traced = visibility(tracer, gaussians.means, gaussians.normals, fibonacci_sphere(512))
    return transfer([traced], gaussians.normals)


def rms(x: Tensor) -> float:
    return x.square().mean().sqrt().item()


# The surface ----------------------------------------------------------------------------------------------------------


def test_the_surface_points_of_a_sphere_have_its_positions_normals_and_views() -> None:
    T_cam_obj = look_at([1, -4, 2])
    surface = shading.surface(rasterize(sphere(4000), GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA)
    eye = T_cam_obj.inverse().xyz
    # Overlapping flat discs are slightly above the sphere, and the nearest one dominates (2 degrees at 4000 discs).
    assert (surface.points.norm(dim=-1) - 1).abs().max() < 0.01
    assert (surface.points * surface.normals).sum(-1).mean() > math.cos(math.radians(3))
    torch.testing.assert_close(
        surface.views, torch.nn.functional.normalize(eye - surface.points, dim=-1), atol=1e-5, rtol=0
    )
    assert torch.equal(surface.sample(surface.paint(surface.points, 48, 48)), surface.points)


def test_the_points_of_chosen_pixels_are_those_of_the_whole_view() -> None:
    T_cam_obj = look_at([1, -4, 2])
    view = rasterize(sphere(400), GAMMA, T_cam_obj, CAMERA, {})
    whole = shading.surface(view, T_cam_obj, CAMERA)
    part = shading.surface(view, T_cam_obj, CAMERA, pixels=whole.pixels[10:20])
    for ours, expected in zip(vars(part).values(), vars(whole).values(), strict=True):
        # The last digit of vectorised products depends on the number of points.
        torch.testing.assert_close(ours, expected[10:20], atol=1e-6, rtol=0)


# Closed forms ---------------------------------------------------------------------------------------------------------


def test_a_lambertian_surface_reflects_its_albedo_under_uniform_light() -> None:
    surface = visible_sphere(400)
    found = shading.diffuse(
        surface, grey(surface)[0], uniform(2.0), torch.eye(3), unoccluded(fibonacci_sphere(2048), 200)
    )
    # 2048 directions resolve a cosine to a few parts in ten thousand.
    torch.testing.assert_close(found, torch.full((200, 3), 1.0), rtol=2e-3, atol=0)


def lobe_visibility(surface: Surface, roughness: torch.Tensor, visibility: Visibility) -> torch.Tensor:
    """Visible fraction of the specular lobe."""
    black = torch.zeros_like(visibility.directions)
    return shading._lobes(surface, roughness, visibility, black, None).specular_visibility[:, None]


def test_diffuse_is_the_diffuse_lobe_alone() -> None:
    torch.manual_seed(0)
    surface, directions = visible_sphere(400, torch.float64), fibonacci_sphere(256, dtype=torch.float64)
    environment = Environment(torch.randn(8, 16, 3, dtype=torch.float64))
    found = shading.diffuse(surface, grey(surface)[0], environment, torch.eye(3).double(), unoccluded(directions, 200))
    cosine = (surface.normals @ directions.T).clamp(min=0)
    expected = 0.5 / math.pi * 4 * math.pi / 256 * cosine @ environment.lookup(directions)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_both_estimators_give_the_reflectance_under_uniform_light(roughness: float) -> None:
    surface = visible_sphere(400)
    albedo, rough = grey(surface, 0.0, roughness)
    nov = (surface.normals * surface.views).sum(-1, keepdim=True)
    expected = F0 * brdf.split_sum(brdf.split_sum_table(), nov, rough)
    unshadowed, R = unoccluded(fibonacci_sphere(1 << 14), 200), torch.eye(3)
    summed = shading.shade(surface, albedo, rough, uniform(), R, unshadowed, f0=F0)
    split = shading.shade_split(surface, albedo, rough, prefilter(uniform()), R, unshadowed, f0=F0)
    # The table is bilinear on 64 entries; 16384 directions resolve a lobe of roughness 0.3 to a percent.
    torch.testing.assert_close(summed, expected.expand(-1, 3), rtol=0.02, atol=0)
    torch.testing.assert_close(split, expected.expand(-1, 3), rtol=1e-3, atol=1e-5)


def test_the_split_sum_of_a_smooth_mirror_is_the_light_itself() -> None:
    surface = visible_sphere(100)
    environment = lamp([0.3, 0.5, 0.8], 0.5)
    _, rough = grey(surface, 0.0, 0.05)
    R = random_rotation(torch.Generator().manual_seed(0))
    unshadowed = unoccluded(fibonacci_sphere(64), 50)
    albedo = torch.zeros(50, 3)
    found = shading.shade_split(surface, albedo, rough, prefilter(environment), R, unshadowed, f0=0.04)
    mirrored = 2 * (surface.normals * surface.views).sum(-1, keepdim=True) * surface.normals - surface.views
    nov = (surface.normals * surface.views).sum(-1, keepdim=True)
    directional_albedo = brdf.split_sum(brdf.split_sum_table(), nov, rough)
    # Level 1 has a weight of 2/5 and blurs a little; the texels are a tenth of the light's width.
    expected = 0.04 * directional_albedo * environment.lookup(mirrored @ R.mT)
    torch.testing.assert_close(found, expected, rtol=0.02, atol=0.0008)


def test_a_white_torus_with_indirect_light_vanishes_in_a_white_furnace() -> None:
    """Occluded directions show the torus, which is as bright as this light."""
    gaussians, T_cam_obj = torus(1000), look_at([2, 1, 3])
    surface = shading.surface(rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA)
    traced = visibility(
        build_tracer(gaussians, GAMMA), surface.points, surface.normals, fibonacci_sphere(256), blockers=True
    )
    white = grey(surface, 1.0)[0]
    bounce = Bounce(torch.ones(1000, 3), transfer_vectors(gaussians))
    found = shading.diffuse(surface, white, uniform(), torch.eye(3), traced, bounce=bounce)
    black = shading.diffuse(surface, white, uniform(), torch.eye(3), traced)
    assert black.min() < 0.7, "the test needs self-shadowing"
    torch.testing.assert_close(found, torch.ones_like(found), atol=0.03, rtol=0)


def test_occluded_directions_dim_the_specular_lobe() -> None:
    """Half of all directions are occluded: lobes in this half lose their light, the others keep it."""
    surface, directions = visible_sphere(800), fibonacci_sphere(256)
    bits = unoccluded(directions, 400).bits.clone()
    occluded = directions[:, 0] < 0
    for j in torch.where(occluded)[0].tolist():
        bits[:, j // 32] &= ~(1 << (j % 32)) if j % 32 < 31 else 0x7FFFFFFF
    half = replace(unoccluded(directions, 400), bits=bits)
    assert torch.equal(half.unpacked()[0], ~occluded)
    mirrored = 2 * (surface.normals * surface.views).sum(-1, keepdim=True) * surface.normals - surface.views
    fraction = lobe_visibility(surface, torch.full((400, 1), 0.2), half)[:, 0]
    # Neighbouring directions are 0.22 apart.
    assert fraction[mirrored[:, 0] > 0.5].min() > 0.95
    assert fraction[mirrored[:, 0] < -0.5].max() < 0.05


def test_the_horizon_does_not_dim_the_specular_lobe() -> None:
    """Bits are 0 below the horizon, where a lobe at a grazing angle has half of its weight."""
    surface = visible_sphere(800)
    traced = visibility(build_tracer(sphere(500), GAMMA), 1.02 * surface.points, surface.normals, fibonacci_sphere(256))
    for roughness in (0.1, 0.5, 1.0):
        fraction = lobe_visibility(surface, torch.full((400, 1), roughness), traced)
        torch.testing.assert_close(fraction, torch.ones_like(fraction))


# Gradients ------------------------------------------------------------------------------------------------------------


def test_gradients_reach_surface_material_light_and_rotation() -> None:
    torch.manual_seed(0)
    surface = visible_sphere(16, torch.float64)
    # No direction along a normal: there the camera behind the surface, which finite differences move, is at a pole.
    directions = fibonacci_sphere(33, dtype=torch.float64) @ SO3.exp(torch.tensor([0.3, 0.4, 0.5]).double()).matrix()
    bits = torch.randint(-(1 << 31), (1 << 31) - 1, (8, 2)).int()
    traced = Visibility(directions, bits, torch.randint(0, 3, (8, 33)).int())
    base = SO3.exp(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    inputs = [
        surface.normals,
        surface.views,
        torch.rand(8, 3).double(),
        0.3 + 0.5 * torch.rand(8, 1).double(),
        torch.randn(4, 8, 3).double(),
        torch.zeros(3).double(),
        torch.rand(3, 3).double(),
    ]

    def summed(*x: Tensor) -> Tensor:
        points = Surface(surface.pixels, surface.points, x[0], x[1])
        bounce = Bounce(x[6], transfer([traced], surface.normals)[:3])
        R_env_obj = (SO3.exp(x[5]) @ base).matrix()
        return shading.shade(points, x[2], x[3], Environment(x[4]), R_env_obj, traced, f0=F0, bounce=bounce)

    def split(*x: Tensor) -> Tensor:
        points = Surface(surface.pixels, surface.points, x[0], x[1])
        R_env_obj, unshadowed = (SO3.exp(x[5]) @ base).matrix(), unoccluded(directions, 8)
        return shading.shade_split(points, x[2], x[3], prefilter(Environment(x[4])), R_env_obj, unshadowed, f0=F0)

    inputs = [x.clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(summed, inputs, fast_mode=True)
    # `diffuse` treats its camera, which depends on the normal, as constant: an error of 1e-4 of the light.
    assert torch.autograd.gradcheck(split, inputs[:6], fast_mode=True, rtol=5e-3, atol=1e-3)


def test_shading_in_parts_equals_shading_at_once() -> None:
    surface, unshadowed = visible_sphere(800), unoccluded(fibonacci_sphere(128), 400)
    albedo, rough = grey(surface)
    environment, R = lamp([0.3, 0.5, 0.8]), torch.eye(3)
    whole = shading.shade(surface, albedo, rough, environment, R, unshadowed, f0=F0)
    parts = []
    for index in torch.arange(400).split(77):
        part = Surface(*(x[index] for x in vars(surface).values()))
        part_unshadowed = unshadowed.gather(index)
        parts.append(shading.shade(part, albedo[index], rough[index], environment, R, part_unshadowed, f0=F0))
    torch.testing.assert_close(torch.cat(parts), whole)


# The claims of the paper ----------------------------------------------------------------------------------------------


def albedo_gradient(environment: Environment, trajectory: Trajectory) -> Tensor:
    """Gradient of a squared error with respect to the albedo, summed over frames that show all points."""
    surface = visible_sphere(200)
    albedo = grey(surface)[0].requires_grad_()
    truth = grey(surface, 0.3)[0]
    unshadowed = unoccluded(fibonacci_sphere(512), 100)
    loss = torch.zeros(())
    for R_env_obj in trajectory.R_env_obj:
        ours, expected = (shading.diffuse(surface, x, environment, R_env_obj, unshadowed) for x in (albedo, truth))
        loss = loss + (ours - expected).square().sum()
    return torch.autograd.grad(loss, albedo)[0]


def test_only_a_directional_light_distinguishes_handheld_from_dome() -> None:
    """The paper: motion under a fixed light adds information about the albedo, except if the light is uniform."""
    generator = torch.Generator().manual_seed(0)
    R = torch.stack([random_rotation(generator) for _ in range(4)])
    poses = SE3(SO3.from_matrix(R).wxyz, torch.tensor([0.0, 0, 4]).expand(4, 3))
    hand, dome = Trajectory(poses, "camera"), Trajectory(poses, "object")
    torch.testing.assert_close(albedo_gradient(uniform(), hand), albedo_gradient(uniform(), dome), rtol=1e-4, atol=0)
    point = lamp([1.0, 0.2, -0.3])
    by_hand, by_dome = albedo_gradient(point, hand), albedo_gradient(point, dome)
    assert rms(by_hand - by_dome) > 0.5 * rms(by_dome)
    # In a dome some points are never lit and have no gradient; in a hand-held capture all points are lit in some frame.
    dark = by_dome.norm(dim=-1) < 1e-3 * by_dome.norm(dim=-1).max()
    assert dark.sum() > 10
    assert (by_hand.norm(dim=-1)[dark] > 1e-2 * by_hand.norm(dim=-1).max()).float().mean() > 0.9


def test_a_common_rotation_of_object_camera_and_light_changes_nothing() -> None:
    gaussians, T_cam_obj, R_env_obj = torus(1000), look_at([2, 1, 3]), SO3.exp(torch.tensor([0.2, -0.4, 0.9]))
    Q_new_old = SO3.exp(torch.tensor([1.0, 0.5, -0.7]))
    rotated = Gaussians(
        Q_new_old @ gaussians.means,
        (Q_new_old @ SO3(gaussians.quats)).wxyz,
        gaussians.log_scales,
        gaussians.sdf,
        gaussians.sh,
    )
    environment, directions = lamp([0.3, 0.5, 0.8], 0.5), fibonacci_sphere(128)
    identity = SO3.identity()
    found = []
    for shape, Q in ((gaussians, identity), (rotated, Q_new_old)):
        T = T_cam_obj @ SE3.from_rotation(Q.inverse(), torch.zeros(3))
        surface = shading.surface(rasterize(shape, GAMMA, T, CAMERA, {}), T, CAMERA)
        traced = visibility(build_tracer(shape, GAMMA), surface.points, surface.normals, Q @ directions, blockers=True)
        bounce = Bounce(torch.full((1000, 3), 0.5), transfer_vectors(shape))
        R = (R_env_obj @ Q.inverse()).matrix()
        found.append(
            surface.paint(shading.shade(surface, *grey(surface), environment, R, traced, f0=F0, bounce=bounce), 48, 48)
        )
    # One ray in a hundred thousand crosses a threshold by rounding.
    assert (found[0] - found[1]).abs().mean() < 1e-3 * found[0].mean()
    assert found[0].max() > 0.1


# Mitsuba --------------------------------------------------------------------------------------------------------------


def real_light(shared_data: Any) -> Environment:
    return Environment.read(shared_data / "hdri" / "venice_sunset_1k.hdr").resampled(64, 128)


def compare(shape: str, environment: Environment, albedo: float = 0.6, depth: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """Our image, Mitsuba's image of the same shape and BRDF, and the mask of pixels where both geometries are equal.

    With direct light only at depth 2, otherwise with indirect light.
    """
    from tests.rendering import mitsuba_brdf
    from tumble.synthetic import pathtracer

    n, size, roughness = 20000, 96, 0.5
    gaussians, mesh = (sphere(n), sphere_mesh()) if shape == "sphere" else (torus(n), torus_mesh())
    camera, T_cam_obj = Camera.from_fov(0.6, size, size), look_at([2.5, 1, 2.5])
    R_env_obj = SO3.exp(torch.tensor([-1.2, 0.3, 0.2])).matrix()
    view = rasterize(gaussians, GAMMA, T_cam_obj, camera, {})
    surface = shading.surface(view, T_cam_obj, camera, alpha_min=0.9)
    light, tracer = importance_sampling.light_sampler(environment), build_tracer(gaussians, GAMMA)
    generator = torch.Generator().manual_seed(0)
    diffuse = Bounce(torch.full((n, 3), albedo), transfer_vectors(gaussians))
    bounce = importance_sampling.GlossyBounce(diffuse, torch.full((n, 1), roughness), prefilter(environment))
    ours = importance_sampling.relight_surface(
        surface,
        *grey(surface, albedo, roughness),
        light,
        R_env_obj,
        tracer,
        f0=F0,
        generator=generator,
        n_brdf=256,
        n_light=256,
        bounce=bounce if depth > 2 else None,
    )
    material = {"albedo": albedo, "roughness": roughness, "f0": F0}
    scene = mitsuba_brdf.scene(mesh, environment, **material, depth=depth)
    truth, coverage = pathtracer.radiance(scene, T_cam_obj, camera, R_env_obj, samples=1024, seed=0)
    model = pathtracer.ObjectModel((mesh,), T_cam_obj.matrix().double().numpy())
    maps = pathtracer.maps(pathtracer.unlit_scenes(model, "original", None), T_cam_obj, camera, samples=64)
    normals = torch.nn.functional.normalize(view.normal, dim=-1)
    agree = (torch.from_numpy(coverage) > 0.999) & (view.alpha > 0.95)
    agree &= (normals - torch.from_numpy(maps.normal)).norm(dim=-1) < math.radians(1.5)
    agree &= (view.depth - torch.from_numpy(maps.depth[..., 0])).abs() < 0.01
    return surface.paint(ours, size, size), torch.from_numpy(truth), agree


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["sphere", "torus"])
@pytest.mark.parametrize("light", ["constant", "lamp", "real"])
def test_direct_light_matches_the_path_tracer_to_three_percent(shape: str, light: str, shared_data: Any) -> None:
    """Direct light with shadows; the same BRDF is implemented a second time for Mitsuba."""
    # In the object frame the light is low at +x: one side of the torus is in the shadow of the other.
    lights = {"constant": uniform, "lamp": lambda: lamp([0.87, 0.28, -0.41]), "real": lambda: real_light(shared_data)}
    ours, truth, agree = compare(shape, lights[light]())
    assert agree.sum() > 1000
    assert rms((ours - truth)[agree]) < 0.03 * rms(truth[agree])


@pytest.mark.slow
@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_indirect_light_matches_the_path_tracer(albedo: float, shared_data: Any) -> None:
    """All bounces. Without shadows on the occluding surface it would be 1.13 times as bright at albedo 0.3."""
    light = real_light(shared_data)
    (ours, truth, agree), (direct, lit, _) = compare("torus", light, albedo, 12), compare("torus", light, albedo)
    found, between = (ours - direct)[agree], (truth - lit)[agree]
    assert found.mean().item() == pytest.approx(between.mean().item(), rel=0.07)
    assert rms(found - between) < 0.2 * rms(between)


@pytest.mark.parametrize("theta", [0.1, 0.8, 1.2])
def test_a_wide_lobe_matches_the_path_tracer(theta: float) -> None:
    """A black dielectric under a light with a gradient, against Mitsuba's own BRDF.

    Schlick's Fresnel term would be 7 to 18 % too dark; the split sum alone is 1.4 times too bright at 1.2.
    """
    pytest.importorskip("mitsuba")
    from tumble.synthetic import pathtracer

    mi = pathtracer.mitsuba()
    varnish = {"type": "principled", "base_color": {"type": "rgb", "value": 0.0}, "roughness": 0.5, "specular": 0.5}
    bsdf = mi.load_dict(varnish)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(math.sin(theta), 0.0, math.cos(theta))
    w = fibonacci_sphere(800).double()
    # The light is brightest at -x, where the reflection of the camera is.
    light = 1 + 0.9 * -w[:, 0]
    above = w[:, 2] > 0
    values = [np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*d))).ravel()[0] for d in w[above].tolist()]
    truth = float((torch.tensor(values) * light[above]).sum() * 4 * math.pi / len(w))

    environment = Environment.from_radiance((1 - 0.9 * texel_directions(32, 64)[..., :1]).expand(32, 64, 3))
    eye = torch.tensor([[math.sin(theta), 0.0, math.cos(theta)]])
    point = Surface(torch.zeros(1, dtype=torch.long), torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), eye)
    black, rough, prefiltered = torch.zeros(1, 3), torch.full((1, 1), 0.5), prefilter(environment)
    ours = shading.shade_split(point, black, rough, prefiltered, torch.eye(3), unoccluded(w.float(), 1), f0=F0)
    assert ours[0, 0].item() == pytest.approx(truth, rel=0.02)


@pytest.mark.parametrize(("roughness", "theta", "metalness"), [(0.25, 0.1, 1.0), (0.25, 1.0, 1.0), (0.5, 0.3, 0.5)])
def test_a_metal_matches_the_path_tracer(roughness: float, theta: float, metalness: float) -> None:
    """A coloured metal, and a surface that is half of one, under a light with a gradient, against Mitsuba's BRDF."""
    pytest.importorskip("mitsuba")
    from tumble.synthetic import pathtracer

    mi = pathtracer.mitsuba()
    base, up, eye = (
        torch.tensor([0.9, 0.5, 0.1]),
        torch.tensor([[0.0, 0.0, 1.0]]),
        [math.sin(theta), 0, math.cos(theta)],
    )
    colour, wo = {"type": "rgb", "value": base.tolist()}, torch.tensor([eye])
    material = {"base_color": colour, "roughness": roughness, "metallic": metalness, "specular": 0.5}
    bsdf, si = mi.load_dict({"type": "principled"} | material), mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*eye)
    u = torch.quasirandom.SobolEngine(3).draw(256)
    wi = brdf.sample(u, wo, up, roughness=roughness)
    wi = wi[wi[:, 2] > 0]
    values = [np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*d))).ravel()[:3] for d in wi.tolist()]
    # The light is brightest at -x, where the reflection of the camera is.
    light = (1 - 0.9 * wi[:, :1]) / brdf.pdf(wi, wo, up, roughness=roughness)
    truth = (torch.from_numpy(np.stack(values)) * light).sum(0) / len(u)

    environment = Environment.from_radiance((1 - 0.9 * texel_directions(32, 64)[..., :1]).expand(32, 64, 3))
    point = Surface(torch.zeros(1, dtype=torch.long), torch.zeros(1, 3), up, wo)
    lit = (prefilter(environment), torch.eye(3), unoccluded(fibonacci_sphere(2000), 1))
    rough, metal = torch.full((1, 1), roughness), torch.full((1, 1), metalness)
    ours = shading.shade_split(point, base[None], rough, *lit, f0=F0, metalness=metal)
    torch.testing.assert_close(ours[0], truth, rtol=0.03, atol=0)
