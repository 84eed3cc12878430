"""Deferred shading against closed forms, the physics of the thesis, and Mitsuba as the judge (slow)."""

import math
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
from tumble.rendering.trace import Visibility, build, transfer, unoccluded, visibility
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians
from tumble.scene.trajectory import Trajectory

CAMERA = Camera.from_fov(0.6, 48, 48)
F0 = 0.04


def uniform(value: float = 1.0, dtype: torch.dtype = torch.float32) -> Environment:
    return Environment.from_radiance(torch.full((8, 16, 3), value, dtype=dtype))


def lamp(towards: list[float], width: float = 0.15, power: float = 60.0, rows: int = 64) -> Environment:
    """One round lamp in a dim room; `towards` in the env frame, width in radians."""
    centre = torch.nn.functional.normalize(torch.tensor(towards), dim=-1)
    bright = ((texel_directions(rows, 2 * rows) @ centre - 1) / width**2).exp()
    return Environment.from_radiance((1e-3 + power * bright)[..., None].expand(-1, -1, 3))


def ball(n: int, dtype: torch.dtype = torch.float32) -> Surface:
    """The part of a unit sphere that a camera at +z, three radii away, sees without grazing."""
    normals = fibonacci_sphere(2 * n, dtype=dtype)[: n // 2]
    views = torch.nn.functional.normalize(torch.tensor([0.0, 0, 3]).to(normals) - normals, dim=-1)
    return Surface(torch.arange(len(normals)), normals, normals, views)


def grey(surface: Surface, albedo: float = 0.5, roughness: float = 0.5) -> tuple[Tensor, Tensor]:
    p = len(surface.pixels)
    return surface.points.new_full((p, 3), albedo), surface.points.new_full((p, 1), roughness)


def seen_by_all(gaussians: Gaussians) -> Tensor:
    """What every Gaussian of a clean surface sees of the light."""
    tracer = build(gaussians, GAMMA)
    sky = visibility(tracer, gaussians.means, gaussians.normals, fibonacci_sphere(512))
    return transfer([sky], gaussians.normals)


def rms(x: Tensor) -> float:
    return x.square().mean().sqrt().item()


# The surface ----------------------------------------------------------------------------------------------------------


def test_the_surface_of_a_sphere_lies_on_it_and_looks_back_at_the_camera() -> None:
    T_cam_obj = look_at([1, -4, 2])
    seen = shading.surface(rasterize(sphere(4000), GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA)
    eye = T_cam_obj.inverse().xyz
    # Flat overlapping discs stand a little above their sphere, and the nearer of them win (2 degrees at 4000).
    assert (seen.points.norm(dim=-1) - 1).abs().max() < 0.01
    assert (seen.points * seen.normals).sum(-1).mean() > math.cos(math.radians(3))
    torch.testing.assert_close(seen.views, torch.nn.functional.normalize(eye - seen.points, dim=-1), atol=1e-5, rtol=0)
    assert torch.equal(seen.sample(seen.paint(seen.points, 48, 48)), seen.points)


def test_chosen_pixels_are_those_of_the_whole() -> None:
    T_cam_obj = look_at([1, -4, 2])
    view = rasterize(sphere(400), GAMMA, T_cam_obj, CAMERA, {})
    whole = shading.surface(view, T_cam_obj, CAMERA)
    some = shading.surface(view, T_cam_obj, CAMERA, pixels=whole.pixels[10:20])
    for one, two in zip(vars(some).values(), vars(whole).values(), strict=True):
        # Where the vectors of a product end depends on how many there are: the last digit is not the same everywhere.
        torch.testing.assert_close(one, two[10:20], atol=1e-6, rtol=0)


# Closed forms ---------------------------------------------------------------------------------------------------------


def test_chalk_in_a_uniform_light_sends_back_its_albedo() -> None:
    seen = ball(400)
    found = shading.diffuse(seen, grey(seen)[0], uniform(2.0), torch.eye(3), unoccluded(fibonacci_sphere(2048), 200))
    # 2048 directions resolve a cosine to a few parts in ten thousand.
    torch.testing.assert_close(found, torch.full((200, 3), 1.0), rtol=2e-3, atol=0)


def test_an_eye_behind_the_surface_sees_the_diffuse_lobe_alone() -> None:
    """`diffuse` borrows the kernel of both lobes."""
    torch.manual_seed(0)
    seen, directions = ball(400, torch.float64), fibonacci_sphere(256, dtype=torch.float64)
    environment = Environment(torch.randn(8, 16, 3, dtype=torch.float64))
    found = shading.diffuse(seen, grey(seen)[0], environment, torch.eye(3).double(), unoccluded(directions, 200))
    cosine = (seen.normals @ directions.T).clamp(min=0)
    expected = 0.5 / math.pi * 4 * math.pi / 256 * cosine @ environment.lookup(directions)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_both_estimators_know_the_reflectance_of_a_uniform_light(roughness: float) -> None:
    seen = ball(400)
    albedo, rough = grey(seen, 0.0, roughness)
    nov = (seen.normals * seen.views).sum(-1, keepdim=True)
    expected = F0 * brdf.split_sum(brdf.split_sum_table(), nov, rough)
    sky, R = unoccluded(fibonacci_sphere(1 << 14), 200), torch.eye(3)
    summed = shading.shade(seen, albedo, rough, uniform(), R, sky, f0=F0)
    split = shading.shade_split(seen, albedo, rough, prefilter(uniform()), R, sky, f0=F0)
    # The table is bilinear on 64 entries; 16384 directions resolve a lobe of roughness 0.3 to a percent.
    torch.testing.assert_close(summed, expected.expand(-1, 3), rtol=0.02, atol=0)
    torch.testing.assert_close(split, expected.expand(-1, 3), rtol=1e-3, atol=1e-5)


def test_the_split_sum_shows_a_smooth_mirror_the_light_itself() -> None:
    seen = ball(100)
    environment = lamp([0.3, 0.5, 0.8], 0.5)
    _, rough = grey(seen, 0.0, 0.05)
    R = random_rotation(torch.Generator().manual_seed(0))
    sky = unoccluded(fibonacci_sphere(64), 50)
    albedo = torch.zeros(50, 3)
    found = shading.shade_split(seen, albedo, rough, prefilter(environment), R, sky, f0=0.04)
    mirrored = 2 * (seen.normals * seen.views).sum(-1, keepdim=True) * seen.normals - seen.views
    nov = (seen.normals * seen.views).sum(-1, keepdim=True)
    share = brdf.split_sum(brdf.split_sum_table(), nov, rough)
    # Two fifths of level 1, which blurs a little, on a map whose texels are a tenth of the lamp.
    torch.testing.assert_close(found, 0.04 * share * environment.lookup(mirrored @ R.mT), rtol=0.02, atol=0.0008)


def test_a_white_torus_that_bounces_light_vanishes_in_a_white_furnace() -> None:
    """What is not seen of the light is seen of the torus, which under this light is as bright."""
    gaussians, T_cam_obj = torus(1000), look_at([2, 1, 3])
    seen = shading.surface(rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}), T_cam_obj, CAMERA)
    sees = visibility(build(gaussians, GAMMA), seen.points, seen.normals, fibonacci_sphere(256), blockers=True)
    white = grey(seen, 1.0)[0]
    bounce = Bounce(torch.ones(1000, 3), seen_by_all(gaussians))
    found = shading.diffuse(seen, white, uniform(), torch.eye(3), sees, bounce=bounce)
    black = shading.diffuse(seen, white, uniform(), torch.eye(3), sees)
    assert black.min() < 0.7, "some of the torus must be in its own shade for this to say anything"
    torch.testing.assert_close(found, torch.ones_like(found), atol=0.03, rtol=0)


def test_a_shadow_dims_the_mirror_that_shows_it() -> None:
    """Half of the sky is closed: mirrors that look into the one half keep their light, the others lose it."""
    seen, directions = ball(800), fibonacci_sphere(256)
    bits = unoccluded(directions, 400).bits.clone()
    closed = directions[:, 0] < 0
    for j in torch.where(closed)[0].tolist():
        bits[:, j // 32] &= ~(1 << (j % 32)) if j % 32 < 31 else 0x7FFFFFFF
    half = Visibility(directions, bits, None)
    assert torch.equal(half.unpacked()[0], ~closed)
    mirrored = 2 * (seen.normals * seen.views).sum(-1, keepdim=True) * seen.normals - seen.views
    share = shading.lobe_visibility(seen, torch.full((400, 1), 0.2), half)[:, 0]
    # Neighbouring directions lie 0.22 apart.
    assert share[mirrored[:, 0] > 0.5].min() > 0.95
    assert share[mirrored[:, 0] < -0.5].max() < 0.05


def test_the_horizon_casts_no_shadow_on_a_mirror() -> None:
    """Bits are clear below the horizon, where a lobe seen at a grazing angle has half of its weight."""
    seen = ball(800)
    sees = visibility(build(sphere(500), GAMMA), 1.02 * seen.points, seen.normals, fibonacci_sphere(256))
    for roughness in (0.1, 0.5, 1.0):
        share = shading.lobe_visibility(seen, torch.full((400, 1), roughness), sees)
        torch.testing.assert_close(share, torch.ones_like(share))


# Gradients ------------------------------------------------------------------------------------------------------------


def test_gradients_reach_surface_material_light_and_rotation() -> None:
    torch.manual_seed(0)
    seen = ball(16, torch.float64)
    # None of them along a normal, where the eye behind the surface, which finite differences move, is on a pole.
    directions = fibonacci_sphere(33, dtype=torch.float64) @ SO3.exp(torch.tensor([0.3, 0.4, 0.5]).double()).matrix()
    bits = torch.randint(-(1 << 31), (1 << 31) - 1, (8, 2)).int()
    sees = Visibility(directions, bits, torch.randint(0, 3, (8, 33)).int())
    turned = SO3.exp(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    inputs = [
        seen.normals,
        seen.views,
        torch.rand(8, 3).double(),
        0.3 + 0.5 * torch.rand(8, 1).double(),
        torch.randn(4, 8, 3).double(),
        torch.zeros(3).double(),
        torch.rand(3, 3).double(),
    ]

    def summed(*x: Tensor) -> Tensor:
        surface = Surface(seen.pixels, seen.points, x[0], x[1])
        bounce = Bounce(x[6], transfer([sees], seen.normals)[:3])
        R_env_obj = (SO3.exp(x[5]) @ turned).matrix()
        return shading.shade(surface, x[2], x[3], Environment(x[4]), R_env_obj, sees, f0=F0, bounce=bounce)

    def split(*x: Tensor) -> Tensor:
        surface = Surface(seen.pixels, seen.points, x[0], x[1])
        R_env_obj, sky = (SO3.exp(x[5]) @ turned).matrix(), unoccluded(directions, 8)
        return shading.shade_split(surface, x[2], x[3], prefilter(Environment(x[4])), R_env_obj, sky, f0=F0)

    inputs = [x.clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(summed, inputs, fast_mode=True)
    # `diffuse` holds its eye still where it turns with the normal: 1e-4 of the light.
    assert torch.autograd.gradcheck(split, inputs[:6], fast_mode=True, rtol=5e-3, atol=1e-3)


def test_shading_in_parts_is_shading_at_once() -> None:
    seen, sky = ball(800), unoccluded(fibonacci_sphere(128), 400)
    albedo, rough = grey(seen)
    environment, R = lamp([0.3, 0.5, 0.8]), torch.eye(3)
    whole = shading.shade(seen, albedo, rough, environment, R, sky, f0=F0)
    parts = []
    for index in torch.arange(400).split(77):
        part = Surface(*(x[index] for x in vars(seen).values()))
        parts.append(shading.shade(part, albedo[index], rough[index], environment, R, sky.gather(index), f0=F0))
    torch.testing.assert_close(torch.cat(parts), whole)


# The physics of the thesis --------------------------------------------------------------------------------------------


def albedo_gradient(environment: Environment, trajectory: Trajectory) -> Tensor:
    """Gradient of a squared error to the albedo, summed over frames in which all points are shaded."""
    seen = ball(200)
    albedo = grey(seen)[0].requires_grad_()
    truth = grey(seen, 0.3)[0]
    sky = unoccluded(fibonacci_sphere(512), 100)
    loss = torch.zeros(())
    for R_env_obj in trajectory.R_env_obj:
        found, wanted = (shading.diffuse(seen, x, environment, R_env_obj, sky) for x in (albedo, truth))
        loss = loss + (found - wanted).square().sum()
    return torch.autograd.grad(loss, albedo)[0]


def test_only_a_light_with_direction_tells_a_hand_from_a_dome() -> None:
    """The thesis: motion under a light that stands still adds information, and none if the light is uniform."""
    generator = torch.Generator().manual_seed(0)
    R = torch.stack([random_rotation(generator) for _ in range(4)])
    poses = SE3(SO3.from_matrix(R).wxyz, torch.tensor([0.0, 0, 4]).expand(4, 3))
    hand, dome = Trajectory(poses, "camera"), Trajectory(poses, "object")
    torch.testing.assert_close(albedo_gradient(uniform(), hand), albedo_gradient(uniform(), dome), rtol=1e-4, atol=0)
    point = lamp([1.0, 0.2, -0.3])
    by_hand, by_dome = albedo_gradient(point, hand), albedo_gradient(point, dome)
    assert rms(by_hand - by_dome) > 0.5 * rms(by_dome)
    # Under the dome some points are never lit and nothing is learnt of them; by hand all have their turn.
    dark = by_dome.norm(dim=-1) < 1e-3 * by_dome.norm(dim=-1).max()
    assert dark.sum() > 10
    assert (by_hand.norm(dim=-1)[dark] > 1e-2 * by_hand.norm(dim=-1).max()).float().mean() > 0.9


def test_turning_object_camera_and_light_together_changes_nothing() -> None:
    gaussians, T_cam_obj, R_env_obj = torus(1000), look_at([2, 1, 3]), SO3.exp(torch.tensor([0.2, -0.4, 0.9]))
    Q_new_old = SO3.exp(torch.tensor([1.0, 0.5, -0.7]))
    turned = Gaussians(
        Q_new_old @ gaussians.means,
        (Q_new_old @ SO3(gaussians.quats)).wxyz,
        gaussians.log_scales,
        gaussians.sdf,
        gaussians.sh,
    )
    environment, directions = lamp([0.3, 0.5, 0.8], 0.5), fibonacci_sphere(128)
    identity = SO3.identity()
    found = []
    for shape, Q in ((gaussians, identity), (turned, Q_new_old)):
        T = T_cam_obj @ SE3.from_rotation(Q.inverse(), torch.zeros(3))
        seen = shading.surface(rasterize(shape, GAMMA, T, CAMERA, {}), T, CAMERA)
        sees = visibility(build(shape, GAMMA), seen.points, seen.normals, Q @ directions, blockers=True)
        bounce = Bounce(torch.full((1000, 3), 0.5), seen_by_all(shape))
        R = (R_env_obj @ Q.inverse()).matrix()
        found.append(seen.paint(shading.shade(seen, *grey(seen), environment, R, sees, f0=F0, bounce=bounce), 48, 48))
    # A ray in a hundred thousand meets a threshold from the other side.
    assert (found[0] - found[1]).abs().mean() < 1e-3 * found[0].mean()
    assert found[0].max() > 0.1


# The judge ------------------------------------------------------------------------------------------------------------


def real_light(shared_data: Any) -> Environment:
    return Environment.read(shared_data / "hdri" / "venice_sunset_1k.hdr").resampled(64, 128)


def compared(
    shape: str, environment: Environment, albedo: float = 0.6, depth: int = 2
) -> tuple[Tensor, Tensor, Tensor]:
    """Our picture, Mitsuba's of the same mesh and BRDF, and where the geometry of both agrees; with all light between
    parts of the object, or with direct light alone at depth 2."""
    from tests.rendering import mitsuba_brdf
    from tumble.synthetic import pathtracer

    n, size, roughness = 20000, 96, 0.5
    gaussians, mesh = (sphere(n), sphere_mesh()) if shape == "sphere" else (torus(n), torus_mesh())
    camera, T_cam_obj = Camera.from_fov(0.6, size, size), look_at([2.5, 1, 2.5])
    R_env_obj = SO3.exp(torch.tensor([-1.2, 0.3, 0.2])).matrix()
    view = rasterize(gaussians, GAMMA, T_cam_obj, camera, {})
    seen = shading.surface(view, T_cam_obj, camera, alpha_min=0.9)
    light, tracer = importance_sampling.light_sampler(environment), build(gaussians, GAMMA)
    generator = torch.Generator().manual_seed(0)
    diffuse = Bounce(torch.full((n, 3), albedo), seen_by_all(gaussians))
    bounce = importance_sampling.GlossyBounce(diffuse, torch.full((n, 1), roughness), prefilter(environment))
    ours = importance_sampling.relight_surface(
        seen,
        *grey(seen, albedo, roughness),
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
    maps = pathtracer.maps(pathtracer.unlit_scenes(model, None), T_cam_obj, camera, samples=64)
    normals = torch.nn.functional.normalize(view.normal, dim=-1)
    agree = (torch.from_numpy(coverage) > 0.999) & (view.alpha > 0.95)
    agree &= (normals - torch.from_numpy(maps.normal)).norm(dim=-1) < math.radians(1.5)
    agree &= (view.depth - torch.from_numpy(maps.depth[..., 0])).abs() < 0.01
    return seen.paint(ours, size, size), torch.from_numpy(truth), agree


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["sphere", "torus"])
@pytest.mark.parametrize("light", ["constant", "lamp", "real"])
def test_a_path_tracer_agrees_to_three_percent(shape: str, light: str, shared_data: Any) -> None:
    """Direct light with shadows, the same BRDF written a second time for Mitsuba."""
    # In the object frame the lamp stands low at +x: one side of the torus lies in the shade of the other.
    lights = {"constant": uniform, "lamp": lambda: lamp([0.87, 0.28, -0.41]), "real": lambda: real_light(shared_data)}
    ours, truth, agree = compared(shape, lights[light]())
    assert agree.sum() > 1000
    assert rms((ours - truth)[agree]) < 0.03 * rms(truth[agree])


@pytest.mark.slow
@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_light_between_parts_is_that_of_a_path_tracer(albedo: float, shared_data: Any) -> None:
    """All bounces. Lit from everywhere, what stands in the way would send on 1.13 times as much at albedo 0.3."""
    light = real_light(shared_data)
    (ours, truth, agree), (direct, lit, _) = compared("torus", light, albedo, 12), compared("torus", light, albedo)
    found, between = (ours - direct)[agree], (truth - lit)[agree]
    assert found.mean().item() == pytest.approx(between.mean().item(), rel=0.07)
    assert rms(found - between) < 0.2 * rms(between)


@pytest.mark.parametrize("theta", [0.1, 0.8, 1.2])
def test_a_wide_lobe_is_that_of_the_path_tracer(theta: float) -> None:
    """A black dielectric under a sky that is bright above the horizon, against Mitsuba's own BRDF.

    Schlick's Fresnel term would be 7 to 18 percent too dark; the split sum alone is 1.4 times too bright at 1.2.
    """
    pytest.importorskip("mitsuba")
    from tumble.synthetic import pathtracer

    mi = pathtracer.mitsuba()
    varnish = {"type": "principled", "base_color": {"type": "rgb", "value": 0.0}, "roughness": 0.5, "specular": 0.5}
    bsdf = mi.load_dict(varnish)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(math.sin(theta), 0.0, math.cos(theta))
    w = fibonacci_sphere(800).double()
    # The sky is bright towards +x, where the mirror image of the eye is not, and behind it where it is.
    sky = 1 + 0.9 * -w[:, 0]
    above = w[:, 2] > 0
    compared = [np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*d))).ravel()[0] for d in w[above].tolist()]
    truth = float((torch.tensor(compared) * sky[above]).sum() * 4 * math.pi / len(w))

    environment = Environment.from_radiance((1 - 0.9 * texel_directions(32, 64)[..., :1]).expand(32, 64, 3))
    eye = torch.tensor([[math.sin(theta), 0.0, math.cos(theta)]])
    point = Surface(torch.zeros(1, dtype=torch.long), torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), eye)
    black, rough, sky_of = torch.zeros(1, 3), torch.full((1, 1), 0.5), prefilter(environment)
    ours = shading.shade_split(point, black, rough, sky_of, torch.eye(3), unoccluded(w.float(), 1), f0=F0)
    assert ours[0, 0].item() == pytest.approx(truth, rel=0.02)
