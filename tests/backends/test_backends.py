"""Every backend against the reference, and the reference against closed forms, brute force and finite differences."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from tests.backends import cases
from tumble import backends
from tumble.backends import _brute, reference
from tumble.maths import images
from tumble.scene import capture

CPU = torch.device("cpu")
RELATIVE = 1e-4
"""Tolerance of float32 against float64: about 1e-7 per operation, some thousand operations, without cancellation."""


@pytest.fixture(params=cases.fast())
def backend(request: pytest.FixtureRequest) -> backends.Backend:
    module = backends.load(request.param)
    device = torch.device("cuda" if request.param == "cuda" else "cpu")
    if reason := module.ready(device, torch.float32):
        pytest.skip(reason)
    return module


def _compare(backend: backends.Backend, run: Callable[..., list[torch.Tensor]], limit: float = RELATIVE) -> None:
    """`run(backend, dtype)` of a backend in float32 against the reference in float64."""
    worst = [
        cases.difference(a, b) for a, b in zip(run(backend, torch.float32), run(reference, torch.float64), strict=True)
    ]
    assert max(worst) < limit, worst


# ------------------------------------------------------------------------------------------------ rasterize


@pytest.mark.parametrize("name", cases.SCENES)
def test_values_and_gradients_are_those_of_the_reference(backend: backends.Backend, name: str) -> None:
    scene = cases.SCENES[name]()
    rng = torch.Generator().manual_seed(0)
    mask = (torch.rand(scene.height, scene.width, generator=rng) > 0.4).double()
    view, gradients = cases.render(backend, scene, torch.float32, mask)
    truth, true_gradients = cases.render(reference, scene, torch.float64, mask)
    worst = {field: cases.difference(a, b) for field, a, b in zip(view._fields[:7], view, truth, strict=False)}
    # The variance is a difference of nearly equal numbers.
    assert worst.pop("depth_var") < 5 * RELATIVE
    assert max(worst.values()) < RELATIVE, worst
    assert torch.equal(view.touched, truth.touched)
    assert torch.equal(view.dominant, truth.dominant)
    worst = {i: cases.difference(a, b) for i, (a, b) in enumerate(zip(gradients, true_gradients, strict=True))}
    assert max(worst.values()) < RELATIVE, worst


def test_the_hard_scene_covers_all_thresholds() -> None:
    """The alpha clamp and the early stop occur many times, and Gaussians are culled for every reason."""
    scene = cases.hard()
    means, quats, scales, opacity, sh, corners, R, t, focal = scene.inputs
    view = reference.project(means, quats, scales, opacity, sh, R, t)
    mask = torch.zeros(scene.height, scene.width, dtype=torch.float64)

    def alpha(thresholds: reference.Thresholds) -> torch.Tensor:
        return reference.composite(view, opacity, corners, t, focal, mask, thresholds).alpha

    truth = alpha(reference.THRESHOLDS)
    assert (alpha(reference.THRESHOLDS._replace(alpha_max=1.0)) != truth).sum() > 50
    assert (alpha(reference.THRESHOLDS._replace(T_min=0.0)) != truth).sum() > 1000
    p_cam = means @ R.T + t
    assert (p_cam[:, 2] < 0).sum() >= 5
    pixel = p_cam[:, :2] / p_cam[:, 2:] * focal[:2] + focal[2:]
    outside = (pixel < -5).any(1) | (pixel[:, 0] > scene.width + 5) | (pixel[:, 1] > scene.height + 5)
    assert (outside & (p_cam[:, 2] > 0.5)).sum() > 5
    assert 50 < len(view.index) < len(means) - 50
    assert (view.rgb == 0).any()
    assert (scales.amax(1) / scales.amin(1)).max() > 1000


def test_one_gaussian_has_the_closed_form() -> None:
    """An isotropic Gaussian on the axis: |peak - mu|^2 = 9 r^2 / (1 + r^2), z = 3 / (1 + r^2), r = tan of the angle."""
    sigma, o, size = 0.1, 0.8, 9
    inputs = [
        [[0.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0, 0.0]],  # Rotation by pi about x: the normal faces the camera.
        [[sigma, sigma, sigma]],
        [o],
        [[[0.7 / 0.28209479177387814] * 3]],
        [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [0.0, 0.0, 3.0],
        [40.0, 40.0, size / 2, size / 2],
    ]
    doubles = [torch.tensor(x, dtype=torch.float64) for x in inputs]
    view = reference.rasterize(*doubles, size, size, torch.ones(1, 1).double())
    x = (torch.arange(size).double() + 0.5 - size / 2) / 40
    x, y = x[None, :], x[:, None]
    rr = x * x + y * y
    alpha = o * torch.exp(-0.5 * 9 * rr / (1 + rr) / sigma**2)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    on = alpha > 0
    z = 3 / (1 + rr)
    # The second local axis is the camera's -y.
    u, v = (z * x / (4 * sigma) + 0.5).clamp(0, 1), (-z * y / (4 * sigma) + 0.5).clamp(0, 1)
    assert 30 < on.sum() < size * size
    expected = {
        "alpha": alpha,
        "depth": torch.where(on, z, 0),
        "depth_var": torch.zeros(size, size),
        "rgb": 0.7 * alpha[..., None].expand(-1, -1, 3),
        "normal": torch.where(on[..., None], torch.tensor([0.0, 0.0, -1.0]), 0),
        "features": torch.where(on[..., None], torch.stack([u, v], -1), 0),
        "weight": alpha.sum()[None],
        "touched": on.sum()[None],
        "dominant": torch.where(on, 0, -1),
    }
    for name, value in expected.items():
        torch.testing.assert_close(getattr(view, name), value, check_dtype=False, rtol=1e-12, atol=1e-12)


def test_gradients_of_the_reference_are_finite_differences() -> None:
    rng = torch.Generator().manual_seed(3)
    scene = cases.easy()
    p_cam = scene.inputs[0] @ scene.inputs[6].T + scene.inputs[7]
    index = p_cam[:, 2].argsort()[[0, 9, 18, 27, 36]]
    inputs = [x[index].requires_grad_() for x in scene.inputs[:6]]
    inputs[5] = inputs[5][..., :2].detach().requires_grad_()
    focal = torch.tensor([4.0, 4.0, 2.0, 1.5], dtype=torch.float64, requires_grad=True)
    inputs += [x.clone().requires_grad_() for x in scene.inputs[6:8]] + [focal]
    weights = torch.randn(3, 4, 13, generator=rng, dtype=torch.float64)

    def render(*x: torch.Tensor) -> torch.Tensor:
        view = reference.project(*x[:5], x[6], x[7])
        image = reference.composite(view, x[3], x[5], x[7], x[8], torch.ones(3, 4).double(), reference.NO_THRESHOLDS)
        flat = [y if y.ndim == 3 else y[..., None] for y in image[: cases.DIFFERENTIABLE]]
        return (torch.cat(flat, -1) * weights[..., : sum(y.shape[-1] for y in flat)]).sum((0, 1))

    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("c", [0, 1, 8, 13, 16, 21])
def test_any_number_of_features_is_rendered(backend: backends.Backend, c: int) -> None:
    scene = cases.easy()
    rng = torch.Generator().manual_seed(c)
    scene.inputs[5] = torch.randn(150, 4, c, generator=rng).double()
    view, gradients = cases.render(backend, scene, torch.float32)
    truth, true_gradients = cases.render(reference, scene, torch.float64)
    assert cases.difference(view.features, truth.features) < RELATIVE
    assert max(cases.difference(a, b) for a, b in zip(gradients, true_gradients, strict=True)) < RELATIVE


@pytest.mark.parametrize("name", ["easy", "hard"])
def test_gradients_of_features_do_not_depend_on_those_of_geometry(backend: backends.Backend, name: str) -> None:
    scene = cases.SCENES[name]()
    inputs = [x.float() for x in scene.inputs]
    corners = inputs[5].requires_grad_()
    view = backend.rasterize(*inputs, scene.height, scene.width, torch.ones(1, 1))
    seeded = [v.float() for v in cases.seeds(scene)]
    alone = torch.autograd.grad([view.features, view.alpha], corners, [seeded[5], seeded[1]])[0]
    _, gradients = cases.render(backend, scene, torch.float32)
    torch.testing.assert_close(alone, gradients[5])


def test_threads_for_kernels_limits_torch_and_not_the_kernels() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with backends.threads_for_kernels(), backends.threads_for_kernels():
            assert (torch.get_num_threads(), backends.threads()) == (1, 2)
        assert (torch.get_num_threads(), backends.threads()) == (2, 2)
    finally:
        torch.set_num_threads(before)


def test_results_are_reproducible_and_depend_on_threads_by_rounding_only(backend: backends.Backend) -> None:
    scene = cases.hard()
    threads = torch.get_num_threads()
    try:
        runs = []
        for count in (1, 2, 2):
            torch.set_num_threads(count)
            view, gradients = cases.render(backend, scene, torch.float32)
            runs.append([*view, *gradients])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(runs[1], runs[2], strict=True))
    # The order of sums over pixels depends on the number of threads.
    assert max(cases.difference(a, b) for a, b in zip(runs[0], runs[1], strict=True)) < 1e-5


# ---------------------------------------------------------------------------------------------------- trace


def _gaussians(name: str) -> list[torch.Tensor]:
    return cases.shell(700) if name == "shell" else cases.SCENES[name]().inputs[:4]


def _rays(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(7)
    origins = normalize(torch.randn(n, 3, generator=rng), dim=-1) * 2.5 * torch.rand(n, 1, generator=rng)
    return origins, normalize(torch.randn(n, 3, generator=rng), dim=-1)


def test_a_ray_past_one_gaussian_has_the_closed_form() -> None:
    """At distance b from the centre alpha = o exp(-b^2 / 2 s^2), up to three sigma, and only from the front."""
    sigma, o = 0.1, 0.7
    gaussian = [torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), sigma), torch.tensor([o])]
    bvh = reference.build(*(x.double() for x in gaussian))
    b = torch.linspace(-0.4, 0.4, 33).double()
    origins = torch.stack([b, 0 * b, 0 * b + 2], -1)
    down = torch.tensor([0.0, 0.0, -1.0]).double().expand(33, 3)
    hits = reference.trace(bvh, origins, down, torch.tensor([[1.0, 2.0, 3.0]]).double())
    alpha = torch.where(b.abs() <= 3 * sigma, o * torch.exp(-0.5 * (b / sigma) ** 2), 0)
    torch.testing.assert_close(hits.transmittance, 1 - alpha)
    torch.testing.assert_close(hits.radiance, alpha[:, None] * torch.tensor([1.0, 2.0, 3.0]).double())
    assert torch.equal(hits.hit, torch.where(alpha > 0, 0, -1).int())
    for origin, direction in ((origins, -down), (-origins, -down)):
        assert (reference.trace(bvh, origin, direction, torch.zeros(0, 3).double()).transmittance == 1).all()


@pytest.mark.parametrize("name", ["shell", "easy", "hard", "empty"])
def test_hits_are_those_of_brute_force(backend: backends.Backend, name: str) -> None:
    cloud = _gaussians(name)
    origins, directions = _rays(3000)
    radiance = torch.rand(len(cloud[0]), 3, generator=torch.Generator().manual_seed(0))
    tree = backend.build(*(x.float() for x in cloud))
    hits = backend.trace(tree, origins, directions, radiance)
    bvh = reference.build(*(x.float().double() for x in cloud))
    truth = reference.trace(bvh, origins.double(), directions.double(), radiance.double())
    assert cases.difference(hits.transmittance, truth.transmittance) < RELATIVE
    assert cases.difference(hits.radiance, truth.radiance) < RELATIVE
    # Two Gaussians of equal weight may be swapped.
    assert (hits.hit != truth.hit).float().mean() < 2e-3
    if name != "empty":
        assert 0.005 < (truth.transmittance == 0).double().mean() < 0.9


def test_a_ray_through_hundreds_of_faint_gaussians_is_exact(backend: backends.Backend) -> None:
    """More hits than the buffers hold, with exact duplicates: 600 of alpha 0.005 give T = 0.995^600."""
    n = 600
    rng = torch.Generator().manual_seed(2)
    z = torch.rand(n, generator=rng).round(decimals=2)
    cloud = [torch.stack([0 * z, 0 * z, z], -1), torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4)]
    cloud += [torch.full((n, 3), 0.05), torch.full((n,), 0.005)]
    origins, down = torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    hits = backend.trace(backend.build(*cloud), origins, down, torch.ones(n, 3))
    # 600 roundings of 6e-8 each.
    torch.testing.assert_close(hits.transmittance.item(), 0.995**n, rtol=4e-5, atol=0)
    torch.testing.assert_close(hits.radiance[0, 0].item(), 1 - 0.995**n, rtol=4e-5, atol=0)
    assert z[hits.hit.item()] == z.max()


@cache
def _true_visibility(name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Visibility bits and blockers by brute force, with which every backend is compared."""
    bvh = reference.build(*(x.float().double() for x in _gaussians(name)))
    rays = [x.double() for x in (*_rays(100), cases.fibonacci(75).float())]
    bits = reference.visible(bvh, *rays)
    return bits, reference.blockers(bvh, *rays, bits)


@pytest.mark.parametrize("name", ["shell", "hard"])
def test_visibility_bits_and_blockers_are_those_of_brute_force(backend: backends.Backend, name: str) -> None:
    points, normals = _rays(100)
    directions = cases.fibonacci(75).float()
    tree = backend.build(*(x.float() for x in _gaussians(name)))
    bits = backend.visible(tree, points, normals, directions)
    truth, true_blockers = _true_visibility(name)
    visible, truly_visible = _brute.unpack(bits, 75), _brute.unpack(truth, 75)
    # A transmittance may lie within rounding of one half.
    assert (visible != truly_visible).float().mean() < 1e-3
    assert not visible[normals @ directions.T <= 0].any()
    assert 0.1 < truly_visible.double().mean() < 0.49
    blockers = backend.blockers(tree, points, normals, directions, truth)
    assert (blockers != true_blockers).float().mean() < 1e-3
    assert torch.equal(true_blockers >= 0, (normals @ directions.T > 0) & ~truly_visible)


def test_unpack_inverts_pack() -> None:
    bits = torch.rand(5, 70, generator=torch.Generator().manual_seed(0)) > 0.5
    words = _brute.pack(bits)
    assert words.shape == (5, 3)
    assert torch.equal(_brute.unpack(words, 70), bits)
    assert words[0, 0].item() & 0xFFFFFFFF == sum(1 << j for j in range(32) if bits[0, j])


def test_visibility_is_that_of_traced_rays_whether_few_or_many_gaussians_are_above_a_point(
    backend: backends.Backend,
) -> None:
    """Points at the rim of a cloud of 8000 Gaussians, which looks inwards, along the rim, or outwards."""
    rng = torch.Generator().manual_seed(0)
    means, quats = torch.randn(8000, 3, generator=rng), torch.randn(8000, 4, generator=rng)
    scales = 0.01 + 0.02 * torch.rand(8000, 3, generator=rng)
    tree = backend.build(0.4 * means, quats, scales, torch.rand(8000, generator=rng))
    normals = normalize(torch.randn(600, 3, generator=rng), dim=-1)
    points = torch.linspace(-1, 1, 600)[:, None] * normals + 0.1 * torch.randn(600, 3, generator=rng)
    directions = cases.fibonacci(64).float()
    found = _brute.unpack(backend.visible(tree, points, normals, directions), 64)
    hits = backend.trace(tree, points.repeat_interleave(64, 0), directions.repeat(600, 1), points[:0])
    expected = (normals @ directions.T > 0) & (hits.transmittance.reshape(600, 64) >= backends.VISIBLE)
    assert 0.1 < expected.float().mean() < 0.4
    # Products of transmittances in another order may fall on the other side of the limit.
    assert (found != expected).sum() <= 1


def test_a_convex_object_hardly_shadows_itself(backend: backends.Backend) -> None:
    """Mean visibility above the horizon exceeds 0.985 at points of the rendered surface of a sphere of Gaussians."""
    n, size = 4000, 48
    means, quats, scales, opacity = (x.float() for x in cases.shell(n))
    R, t, focal = (x.float() for x in cases.camera(size, size))
    flat = torch.zeros(n, 1, 3), torch.zeros(n, 4, 0)
    view = backend.rasterize(means, quats, scales, opacity, *flat, R, t, focal, size, size, torch.ones(1, 1))
    y, x = torch.where(view.alpha > 0.5)
    rays = torch.stack([(x + 0.5 - focal[2]) / focal[0], (y + 0.5 - focal[3]) / focal[1], torch.ones(len(x))], -1)
    points = (rays * view.depth[y, x][:, None] - t) @ R
    normals = normalize(view.normal[y, x], dim=-1)
    # The surface lies where the sphere is, to a fraction of the Gaussians' spacing.
    assert (points.norm(dim=-1) - 1).abs().mean() < 0.01
    directions = cases.fibonacci(256).float()
    lifted = points + 2 * scales[0, 0] * normals
    visible = _brute.unpack(
        backend.visible(backend.build(means, quats, scales, opacity), lifted, normals, directions), 256
    )
    assert visible.sum() / (normals @ directions.T > 0).sum() > 0.985


# ---------------------------------------------------------------------------------------------------- shade


def _surface(p: int, rough: tuple[float, float]) -> list[torch.Tensor]:
    """Normals, roughness and view directions; some views are behind the surface."""
    rng = torch.Generator().manual_seed(11)
    normal = normalize(torch.randn(p, 3, generator=rng), dim=-1)
    view = normalize(normal + 1.1 * normalize(torch.randn(p, 3, generator=rng), dim=-1), dim=-1)
    return [normal, rough[0] + (rough[1] - rough[0]) * torch.rand(p, generator=rng), view]


@pytest.mark.parametrize(("d", "m", "rough"), [(100, 0, (0.3, 1.0)), (256, 7, (0.03, 0.6)), (1, 3, (0.5, 0.5))])
def test_shading_and_its_gradients_are_those_of_the_reference(
    backend: backends.Backend, d: int, m: int, rough: tuple[float, float]
) -> None:
    rng = torch.Generator().manual_seed(d)
    p = 80
    inputs = [*_surface(p, rough), torch.rand(d, 3, generator=rng), torch.rand(m, 3, generator=rng)]
    directions = cases.fibonacci(d).float()
    visibility, rows = _brute.pack(torch.rand(50, d, generator=rng) > 0.3), torch.randint(0, 50, (p,), generator=rng)
    blocker = torch.randint(-1, m, (50, d), generator=rng).int() if m else torch.full((1, 1), -1).int()
    seeds = torch.randn(2, p, 3, generator=rng)

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in inputs]
        lobes = by.shade(*x[:3], directions.to(dtype), x[3], visibility, blocker, rows, x[4])
        used = x if m else x[:4]
        assert not lobes.specular_visibility.requires_grad
        return [*lobes, *torch.autograd.grad(lobes[:2], used, [*seeds.to(dtype)])]

    _compare(backend, run)


def test_gradients_of_reference_shading_are_finite_differences() -> None:
    inputs = [x[:4].double().requires_grad_() for x in _surface(4, (0.2, 0.9))]
    rng = torch.Generator().manual_seed(1)
    inputs += [torch.rand(9, 3, generator=rng).double().requires_grad_() for _ in range(2)]
    visibility = _brute.pack(torch.rand(4, 9, generator=rng) > 0.3)
    blocker, rows = torch.randint(-1, 9, (4, 9), generator=rng).int(), torch.tensor([2, 0, 2, 3])

    def render(*x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(reference.shade(*x[:3], cases.fibonacci(9), x[3], visibility, blocker, rows, x[4])[:2])

    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_a_sphere_in_uniform_light_matches_the_integrated_brdf(backend: backends.Backend, roughness: float) -> None:
    """The Lambertian lobe is the light; GGX is D F G / (4 n.l n.v), integrated on another grid."""
    normal = cases.fibonacci(40)
    view = torch.tensor([0.0, 0.0, 1.0]).double()
    front = normal @ view > 0.2
    normal, p = normal[front], int(front.sum())
    d = 1 << 14
    light = torch.full((d, 3), 1.5)
    visibility = torch.full((p, d // 32), -1, dtype=torch.int32)
    black = torch.full((1, 1), -1, dtype=torch.int32), torch.arange(p), torch.zeros(0, 3)
    point = normal.float(), torch.full((p,), roughness), view.float().expand(p, 3)
    lobes = backend.shade(*point, cases.fibonacci(d).float(), light, visibility, *black)
    # Both grids resolve the narrowest of these lobes to about 1e-3.
    np.testing.assert_allclose(lobes.diffuse.numpy(), np.full((p, 3), 1.5), rtol=3e-3)
    expected = 1.5 * _integrated_ggx(normal.numpy(), view.numpy(), roughness)[:, None].repeat(3, 1)
    np.testing.assert_allclose(0.04 * lobes.specular.numpy(), expected, rtol=6e-3)
    torch.testing.assert_close(lobes.specular_visibility, torch.ones(p))


def _stack(levels: int, height: int, n: int) -> list[torch.Tensor]:
    """Maps, directions of any length all around and at the seam, and roughness beyond both ends."""
    rng = torch.Generator().manual_seed(levels)
    directions = torch.randn(n, 3, generator=rng)
    directions[: n // 3, 0] *= 1e-2
    directions[n // 3 : n // 2, 1] *= 30
    return [
        torch.rand(levels, height, 2 * height, 3, generator=rng),
        directions,
        1.4 * torch.rand(n, generator=rng) - 0.2,
    ]


@pytest.mark.parametrize(("levels", "height", "n"), [(9, 16, 200), (1, 1, 20), (2, 5, 0)])
def test_lookups_and_their_gradients_are_those_of_the_reference(
    backend: backends.Backend, levels: int, height: int, n: int
) -> None:
    inputs, seed = _stack(levels, height, n), torch.randn(n, 3, generator=torch.Generator().manual_seed(n))

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in inputs]
        values = by.lookup(*x)
        return [values, *torch.autograd.grad(values, x, seed.to(dtype))]

    _compare(backend, run)


def test_lookups_at_the_poles_are_means_of_their_rows_and_have_no_gradient(backend: backends.Backend) -> None:
    stack = _stack(2, 4, 1)[0]
    poles = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], requires_grad=True)
    values = backend.lookup(stack, poles, torch.zeros(2))
    # At u = 1/2: two neighbouring columns of the row and their opposites.
    expected = [stack[0, row][[3, 4, 7, 0]].mean(0) for row in (0, -1)]
    torch.testing.assert_close(values, torch.stack(expected))
    assert not torch.autograd.grad(values.sum(), poles)[0].any()


def test_gradients_of_reference_lookups_are_finite_differences() -> None:
    inputs = [x.double().requires_grad_() for x in _stack(3, 4, 9)]
    assert torch.autograd.gradcheck(reference.lookup, inputs)


def _integrated_ggx(normals: np.ndarray, view: np.ndarray, roughness: float, f0: float = 0.04) -> np.ndarray:
    """Integral of f_s cos over the hemisphere by the midpoint rule in polar angles about each normal."""
    a = roughness**2
    mu = (np.arange(400) + 0.5) / 400
    phi = (np.arange(400) + 0.5) / 400 * 2 * math.pi
    mu, phi = np.meshgrid(mu, phi)
    s = np.sqrt(1 - mu * mu)
    result = []
    for n in normals:
        side = np.cross(n, [0.6, -0.8, 0.1])
        side /= np.linalg.norm(side)
        w = (s * np.cos(phi))[..., None] * side + (s * np.sin(phi))[..., None] * np.cross(n, side) + mu[..., None] * n
        h = w + view
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        nh, vh, nv = h @ n, h @ view, n @ view
        D = a**2 / (math.pi * (nh**2 * (a**2 - 1) + 1) ** 2)
        # Walter 2007, equation 34.
        G = 4 / (1 + np.sqrt(1 + a**2 * (1 / mu**2 - 1))) / (1 + np.sqrt(1 + a**2 * (1 / nv**2 - 1)))
        inside = np.sqrt(1 - (1 - vh**2) / 1.5**2)
        F = f0 / 0.08 * ((vh - 1.5 * inside) / (vh + 1.5 * inside)) ** 2
        F += f0 / 0.08 * ((inside - 1.5 * vh) / (inside + 1.5 * vh)) ** 2
        result.append((D * F * G / (4 * mu * nv) * mu).mean() * 2 * math.pi)
    return np.array(result)


# ------------------------------------------------------------------------------- kernels of the steps of stage 2


def _lit_gaussians(n: int, d: int) -> list[torch.Tensor]:
    """Arguments of `sh_shade`, rounded to float32; the matrix is no rotation, as its entries are independent."""
    rng = torch.Generator().manual_seed(n)
    shapes = (n, 3), (n, 4), (n, 3), (2, 16, 3), (), (n, 9), (n, 9), (3, 3)
    means, quats, logits, light, scale, occluded, unoccluded, R = (torch.randn(x, generator=rng) for x in shapes)
    reflectance = 0.04 * torch.tensor([0.937, -0.296, 5.535, -11.654, 20.113, -9.978])
    transfer = [0.3 * occluded + 0.5, unoccluded.abs() + 0.3, cases.fibonacci(d).float()]
    return [
        means,
        quats,
        2 * logits,
        0.5 * light,
        scale.exp(),
        *transfer,
        reflectance,
        R,
        torch.tensor([0.1, 0.2, 3.0]),
    ]


@pytest.mark.parametrize("n", [0, 1, 133])
@pytest.mark.parametrize("shadowed", [False, True])
def test_shading_by_harmonics_and_its_gradients_are_those_of_the_reference(
    backend: backends.Backend, n: int, shadowed: bool
) -> None:
    inputs, rng = _lit_gaussians(n, 75), torch.Generator().manual_seed(1)
    seed = torch.randn(n, 3, generator=rng)
    if not shadowed:
        inputs[5:7] = [torch.zeros(0, 9)] * 2

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in inputs]
        shaded = by.sh_shade(*x)
        return [shaded, *torch.autograd.grad(shaded, [*x[:5], *x[9:]], seed.to(dtype))]

    _compare(backend, run)


def test_gradients_of_reference_shading_by_harmonics_are_finite_differences() -> None:
    """Without self-shadowing, which counts as a constant; the gradient of the rotations is scaled."""
    inputs = [x.double() for x in _lit_gaussians(5, 9)]
    quats, rest = inputs[1], (torch.zeros(0, 9).double(), torch.zeros(0, 9).double(), *inputs[7:9])
    others = [x.requires_grad_() for x in (inputs[0], *inputs[2:5], *inputs[9:])]

    def render(means: torch.Tensor, *x: torch.Tensor) -> torch.Tensor:
        return reference.sh_shade(means, quats, *x[:3], *rest, *x[3:])

    assert torch.autograd.gradcheck(render, others, fast_mode=True)

    def of_quats(q: torch.Tensor) -> torch.Tensor:
        return reference.sh_shade(others[0].detach(), q, *(x.detach() for x in others[1:4]), *rest, *inputs[9:]).sum()

    analytic = torch.autograd.grad(of_quats(quats.requires_grad_()), quats)[0]
    step = 1e-6 * torch.randn(quats.shape, generator=torch.Generator().manual_seed(0)).double()
    change = (of_quats(quats + step) - of_quats(quats - step)) / 2
    assert (analytic * step).sum().item() == pytest.approx(backends.NORMAL_GRADIENT * change.item(), rel=1e-5)


def _pictures(height: int, width: int, box: tuple[slice, slice]) -> list[torch.Tensor]:
    """Arguments of `image_terms` up to the mask: an object within a box, with saturated and unknown pixels."""
    rng = torch.Generator().manual_seed(height)

    def noise(*shape: int) -> torch.Tensor:
        return torch.rand(height, width, *shape, generator=rng)

    inside = torch.zeros(height, width)
    inside[box] = 1
    alpha, rgb = inside * (0.4 + 0.6 * noise()), inside[..., None] * (1.5 * noise(3) - 0.1)
    depth, variance = inside * (3 + 0.1 * noise()), inside * (0.01 * noise() - 1e-5)
    photo = (inside[..., None] * 280 * noise(3)).clamp(max=255).to(torch.uint8)
    mask = (inside * torch.tensor([0.0, 128.0, 255.0, 255.0])[(4 * noise()).long()]).to(torch.uint8)
    return [rgb, alpha, depth, variance, inside[..., None] * (noise(3) - 0.3), photo, mask]


@pytest.mark.parametrize(
    ("height", "width", "box"),
    [
        (40, 50, (slice(8, 30), slice(12, 40))),
        (37, 51, (slice(None), slice(None))),
        (64, 33, (slice(50, None), slice(20, None))),
        (11, 11, (slice(2, 5), slice(2, 5))),
        (13, 90, (slice(6, 7), slice(3, 4))),
        (20, 21, (slice(0, 0), slice(0, 0))),
    ],
)
@pytest.mark.parametrize(("ssim_weight", "crease"), [(0.2, 25.0), (1.0, 0.0)])
def test_terms_of_images_and_their_gradients_are_those_of_the_reference(
    backend: backends.Backend, height: int, width: int, box: tuple[slice, slice], ssim_weight: float, crease: float
) -> None:
    *images, photo, mask = _pictures(height, width, box)
    R, _, focal = (x.float() for x in cases.camera(height, width))

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in (*images, R)]
        terms = by.image_terms(*x[:5], photo, mask, x[5], focal.to(dtype), ssim_weight, crease)
        return [terms, *torch.autograd.grad(terms, x, torch.tensor([1.0, 2.0, 3.0, 4.0]).to(dtype))]

    _compare(backend, run)


def test_gradients_of_reference_image_terms_are_finite_differences() -> None:
    *images, photo, mask = _pictures(13, 12, (slice(1, 12), slice(1, 11)))
    R, _, focal = cases.camera(13, 12)
    photo = photo.clamp(max=250)  # a rendering equal to a saturated photo has a kink
    inputs = [x.double().requires_grad_() for x in (*images, R)]
    # Where alpha is 0 the variance does not count, and a change of alpha would make it count.
    inside = (images[1] > 0).double()

    def on_the_object(*x: torch.Tensor) -> torch.Tensor:
        view = (x[0] * inside[..., None], x[1] * inside, x[2], x[3] * inside, x[4])
        return reference.image_terms(*view, photo, mask, x[5], focal, 0.3, 5.0)

    assert torch.autograd.gradcheck(on_the_object, inputs, eps=1e-7, atol=1e-5, fast_mode=True)


def _measured_gaussians(n: int) -> list[torch.Tensor]:
    """Arguments of `gaussian_terms` up to the depth: some needles, some Gaussians outside of the image or unseen."""
    rng = torch.Generator().manual_seed(n)
    means, quats, log_scales, sdf = (torch.randn(n, *x, generator=rng) for x in ((3,), (4,), (3,), ()))
    log_scales[: n // 8] *= 0.01
    weight = (torch.rand(n, generator=rng) - 0.3).clamp(min=0)
    depth = 3 + 0.3 * torch.rand(40, 50, generator=rng)
    depth[:10] = 0
    return [0.4 * means, quats, log_scales, 0.05 * sdf, torch.tensor(8.0), weight, depth]


@pytest.mark.parametrize(("n", "gamma"), [(333, 8.0), (332, 100.0), (1, 8.0), (0, 8.0)])
def test_terms_of_gaussians_and_their_gradients_are_those_of_the_reference(
    backend: backends.Backend, n: int, gamma: float
) -> None:
    *own, _, weight, depth = _measured_gaussians(n)
    R, t, focal = (x.float() for x in cases.camera(40, 50))

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in (*own, torch.tensor(gamma), R, t)]
        terms = by.gaussian_terms(*x[:5], weight.to(dtype), depth.to(dtype), *x[5:], focal.to(dtype), 0.01, 0.2)
        gradients = torch.autograd.grad(terms, x, torch.tensor([1.0, 2.0, 3.0]).to(dtype), materialize_grads=True)
        return [terms, *gradients]

    _compare(backend, run)


def test_gradients_of_reference_gaussian_terms_are_finite_differences() -> None:
    """The median of the signed distances counts as a constant."""
    means, quats, log_scales, sdf, _, weight, depth = (x.double() for x in _measured_gaussians(9))
    camera = cases.camera(40, 50)
    gamma, depth = torch.tensor(8.0).double(), depth * 0 + 3.1

    def sharpness_apart(*x: torch.Tensor) -> torch.Tensor:
        return reference.gaussian_terms(*x[:4], gamma, weight, depth, x[4], x[5], camera[2], 0.01, 2.0)[[0, 2]]

    inputs = [x.requires_grad_() for x in (means, quats, log_scales, sdf, camera[0], camera[1])]
    assert torch.autograd.gradcheck(sharpness_apart, inputs)


def _material(n: int) -> list[torch.Tensor]:
    """Albedo and roughness logits and normal offsets of the corners, and positive transfer vectors."""
    rng = torch.Generator().manual_seed(n)
    shapes = (n, 4, 3), (n, 4), (n, 4, 3), (n, 9)
    *corners, transfer = (torch.randn(x, generator=rng) for x in shapes)
    return [*(3 * x for x in corners), 0.5 * transfer + 0.3]


@pytest.mark.parametrize("n", [0, 1, 75])
def test_features_of_corners_and_their_gradients_are_those_of_the_reference(backend: backends.Backend, n: int) -> None:
    inputs, rng = _material(n)[:3], torch.Generator().manual_seed(n)
    seeds = torch.randn(n, 4, 7, generator=rng), torch.randn(n, 3, generator=rng)

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in inputs]
        corners, albedo = by.corner_features(*x, 2.0)
        return [corners, albedo, *torch.autograd.grad([corners, albedo], x, [y.to(dtype) for y in seeds])]

    _compare(backend, run)


@pytest.mark.parametrize("n", [0, 1, 75])
def test_bounces_and_their_gradients_are_those_of_the_reference(backend: backends.Backend, n: int) -> None:
    rng = torch.Generator().manual_seed(n)
    transfer, directions = _material(n)[3], cases.fibonacci(45).float()
    inputs, seed = [torch.rand(x, 3, generator=rng) for x in (n, 45)], torch.randn(n, 3, generator=rng)

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in inputs]
        radiance = by.bounce(x[0], transfer.to(dtype), directions.to(dtype), x[1])
        return [radiance, *torch.autograd.grad(radiance, x, seed.to(dtype))]

    _compare(backend, run)


@pytest.mark.parametrize(("height", "width"), [(19, 37), (1, 5), (4, 1)])
def test_terms_of_materials_and_their_gradients_are_those_of_the_reference(
    backend: backends.Backend, height: int, width: int
) -> None:
    _, alpha, *_, photo, mask = _pictures(height, width, (slice(None), slice(None, 30)))
    features = torch.rand(height, width, 7, generator=torch.Generator().manual_seed(0))

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in (features, alpha)]
        terms = by.material_terms(*x, photo, mask)
        return [terms, *torch.autograd.grad(terms, x, torch.tensor([1.0, 2.0]).to(dtype))]

    _compare(backend, run)


def test_gradients_of_reference_materials_are_finite_differences() -> None:
    *corners, transfer = (x.double() for x in _material(5))
    inputs = [x.requires_grad_() for x in corners]
    assert torch.autograd.gradcheck(lambda *x: reference.corner_features(*x, 2.0), inputs)
    rng = torch.Generator().manual_seed(0)
    inputs = [torch.rand(x, 3, generator=rng).double().requires_grad_() for x in (5, 12)]
    around = transfer, cases.fibonacci(12)
    assert torch.autograd.gradcheck(lambda albedo, light: reference.bounce(albedo, *around, light), inputs)
    _, alpha, *_, photo, mask = _pictures(5, 6, (slice(None), slice(None, 4)))
    inputs = [x.double().requires_grad_() for x in (torch.rand(5, 6, 7, generator=rng), alpha)]
    assert torch.autograd.gradcheck(lambda *x: reference.material_terms(*x, photo, mask), inputs)


def test_kernels_of_the_steps_conform_with_two_threads(backend: backends.Backend) -> None:
    """More than a vector of Gaussians per thread, and more jobs than threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        test_shading_by_harmonics_and_its_gradients_are_those_of_the_reference(backend, 133, shadowed=True)
        test_features_of_corners_and_their_gradients_are_those_of_the_reference(backend, 75)
        test_terms_of_gaussians_and_their_gradients_are_those_of_the_reference(backend, 333, 8.0)
        box = slice(8, 30), slice(12, 40)
        test_terms_of_images_and_their_gradients_are_those_of_the_reference(backend, 40, 50, box, 0.2, 25.0)
    finally:
        torch.set_num_threads(before)


def test_constants_that_the_kernels_repeat_are_those_of_the_package() -> None:
    assert images.LINEAR_KNEE == backends.KNEE
    assert tuple(k * k for k in images.STABILISERS) == backends.SSIM_STABILISERS
    assert (capture.OBJECT, capture.UNKNOWN) == (backends.OBJECT, backends.UNKNOWN)
    x, y = torch.rand(2, 20, 30, 3, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(reference.similarity(x, y).mean(), images.ssim(x, y))


# --------------------------------------------------------------------------------------------------- choice


def test_float64_is_rendered_by_the_reference() -> None:
    assert backends.choose(CPU, torch.float64) is reference


def test_activations_and_their_gradients_are_those_of_the_reference(backend: backends.Backend) -> None:
    rng = torch.Generator().manual_seed(0)
    n = 333
    inputs = [2 * torch.randn(n, 3, generator=rng) - 3, 0.1 * torch.randn(n, generator=rng), torch.tensor(30.0)]
    seeds = torch.randn(n, 3, generator=rng), torch.randn(n, generator=rng)

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in inputs]
        results = by.activate(*x)
        return [*results, *torch.autograd.grad(results, x, [y.to(dtype) for y in seeds])]

    _compare(backend, run)
    x = [y[:4].double() if y.ndim else y.double() for y in inputs]
    assert torch.autograd.gradcheck(lambda *y: reference.activate(*y), [y.requires_grad_() for y in x])


@pytest.mark.parametrize(("count", "n"), [(0, 4), (49, 19)])
def test_steps_of_adam_are_those_of_the_reference_and_those_that_are_not_finite_are_none(
    backend: backends.Backend, count: int, n: int
) -> None:
    rng = torch.Generator().manual_seed(count)
    shapes = [(), (7, 3), (40, 4, 3), (0, 3), *[(k, 3) for k in range(4, n)]]
    values = [[torch.rand(shape, generator=rng) for _ in range(4)] for shape in shapes]

    def run(
        by: backends.Backend, dtype: torch.dtype, broken: float = 0.0, loss: float = 1.0, failed: float = 0.0
    ) -> list[torch.Tensor]:
        steps = torch.full((n,), float(count)).unbind()
        leaves = [
            backends.Leaf(*(x.to(dtype, copy=True) for x in each), steps[k].clone(), 0.01 * (k + 1))
            for k, each in enumerate(values)
        ]
        leaves[2].gradient[3, 1, 2] += broken
        told = torch.tensor(failed)
        by.adam(leaves, torch.tensor(loss).to(dtype), told, 0.9, 0.999, 1e-15)
        assert told == (not (math.isfinite(broken) and math.isfinite(loss)) or failed)
        return [x for leaf in leaves for x in (leaf.value, leaf.first, leaf.second, leaf.count)]

    _compare(backend, run)
    assert run(backend, torch.float32)[3] == count + 1
    before = [x for value, _, *moments in values for x in (value, *moments, torch.tensor(float(count)))]
    for bad in (math.nan, math.inf, -math.inf):
        for unchanged in (
            run(backend, torch.float32, broken=bad),
            run(backend, torch.float32, loss=bad),
            run(backend, torch.float32, failed=1.0),
        ):
            assert all(torch.equal(a, b) for a, b in zip(unchanged, before, strict=True))


@pytest.mark.parametrize(("n", "d", "p"), [(60, 100, 70), (0, 48, 17)])
def test_the_term_of_shaded_pixels_and_its_gradients_are_those_of_the_reference(
    backend: backends.Backend, n: int, d: int, p: int
) -> None:
    rng = torch.Generator().manual_seed(p)
    height, width = 12, 15
    R, _, focal = (x.float() for x in cases.camera(height, width))
    R_env = cases.camera(9, 9)[0].float().T

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=rng)

    # Normals towards the camera, but for some at the rim; a roughness on both sides of every limit.
    normal = -R[2] + 0.8 * (rand(height, width, 3) - 0.5)
    features = torch.cat([rand(height, width, 3), 0.7 * rand(height, width, 1), 0.2 * rand(height, width, 3)], -1)
    stack = _stack(5, 8, 1)[0] ** 3
    moving = [features, 0.5 + 0.5 * rand(height, width), normal, stack, rand(n, 3), rand(3), R, R_env]
    dominant = torch.randint(-1, 60, (height, width), generator=rng).int()
    photo = torch.randint(0, 256, (height, width, 3), generator=rng).to(torch.uint8)
    pixels = torch.randint(-20, height * width, (p,), generator=rng)
    visibility = _brute.pack(rand(60, d) > 0.3)
    blocker = torch.randint(-1, n, (60, d), generator=rng).int() if n else torch.full((1, 1), -1).int()
    directions, transfer, table = cases.fibonacci(d).float(), 0.3 + 0.2 * rand(n, 9), rand(16, 16)

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = [y.to(dtype).requires_grad_() for y in moving]
        constant = [y.to(dtype) for y in (directions, transfer, table, focal)]
        view = backends.SampledView(*x[:3], dominant, photo, pixels)
        light = backends.ShadingLight(x[3], constant[0], visibility, blocker, x[4], *constant[1:3])
        term = by.shading_term(view, light, x[6], x[7], constant[3], x[5])
        return [term[None], *torch.autograd.grad(3 * term, x, materialize_grads=True)]

    _compare(backend, run)


@pytest.mark.parametrize(("height", "rows"), [(8, 24), (16, 128), (6, 30), (64, 80)])
def test_convolutions_of_maps_and_their_gradients_are_those_of_the_reference(
    backend: backends.Backend, height: int, rows: int
) -> None:
    rng = torch.Generator().manual_seed(height)
    radiance, lobes = (
        torch.rand(height, 2 * height, 3, generator=rng),
        torch.rand(height + 1, rows, height, generator=rng),
    )
    seed = torch.randn(height + rows, 2 * height, 3, generator=rng)

    def run(by: backends.Backend, dtype: torch.dtype) -> list[torch.Tensor]:
        x = radiance.to(dtype).requires_grad_()
        out = by.prefilter(x, lobes.to(dtype))
        return [out, *torch.autograd.grad(out, x, seed.to(dtype))]

    _compare(backend, run)
