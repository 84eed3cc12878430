"""The Warp kernels: their results on the CPU, their compilation for a GPU, and their results on a GPU if there is one.

The conformance tests are those of `test_backends.py`.
"""

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_leaves, tree_map

from tests.backends import cases
from tests.backends import test_backends as conformance
from tumble import backends
from tumble.backends import cuda, reference

GPU = torch.device("cuda")

KERNEL_CASES = [
    *[(conformance.test_values_and_gradients_are_those_of_the_reference, name) for name in cases.SCENES],
    *[(conformance.test_any_number_of_features_is_rendered, c) for c in (0, 8, 21)],
    *[(conformance.test_hits_are_those_of_brute_force, name) for name in ("shell", "hard", "empty")],
    (conformance.test_a_ray_through_hundreds_of_faint_gaussians_is_exact,),
    (conformance.test_visibility_bits_and_blockers_are_those_of_brute_force, "hard"),
    (conformance.test_a_convex_object_hardly_shadows_itself,),
    (conformance.test_shading_and_its_gradients_are_those_of_the_reference, 100, 0, (0.3, 1.0)),
    (conformance.test_shading_and_its_gradients_are_those_of_the_reference, 256, 7, (0.03, 0.6)),
    (conformance.test_shading_and_its_gradients_are_those_of_the_reference, 1, 3, (0.5, 0.5)),
    (conformance.test_a_sphere_in_uniform_light_matches_the_integrated_brdf, 0.3),
    *[
        (conformance.test_shading_by_harmonics_and_its_gradients_are_those_of_the_reference, n, shadowed)
        for n, shadowed in ((133, True), (133, False), (0, True))
    ],
    *[(conformance.test_bounces_and_their_gradients_are_those_of_the_reference, n) for n in (0, 75)],
    *[
        (conformance.test_terms_of_images_and_their_gradients_are_those_of_the_reference, height, width, box, *weights)
        for height, width, box, weights in (
            (40, 50, (slice(8, 30), slice(12, 40)), (0.2, 25.0)),
            (37, 51, (slice(None), slice(None)), (1.0, 0.0)),
            (11, 13, (slice(0, 9), slice(3, None)), (0.2, 25.0)),
        )
    ],
    *[
        (conformance.test_terms_of_materials_and_their_gradients_are_those_of_the_reference, *size)
        for size in ((19, 37), (1, 5), (4, 1))
    ],
    *[
        (conformance.test_terms_of_gaussians_and_their_gradients_are_those_of_the_reference, n, gamma)
        for n, gamma in ((333, 8.0), (332, 100.0), (1, 8.0))
    ],
    *[
        (conformance.test_lookups_and_their_gradients_are_those_of_the_reference, *sizes)
        for sizes in ((9, 16, 200), (1, 1, 20), (2, 5, 0))
    ],
    (conformance.test_lookups_at_the_poles_are_means_of_their_rows_and_have_no_gradient,),
    *[
        (conformance.test_the_term_of_shaded_pixels_and_its_gradients_are_those_of_the_reference, *sizes)
        for sizes in ((60, 100, 70), (0, 48, 17))
    ],
    *[
        (conformance.test_convolutions_of_maps_and_their_gradients_are_those_of_the_reference, *size)
        for size in ((8, 24), (6, 30))
    ],
    (conformance.test_activations_and_their_gradients_are_those_of_the_reference,),
    *[(conformance.test_features_of_corners_and_their_gradients_are_those_of_the_reference, n) for n in (0, 75)],
    (conformance.test_steps_of_adam_are_those_of_the_reference_and_those_that_are_not_finite_are_none, 0, 4),
    (conformance.test_steps_of_adam_are_those_of_the_reference_and_those_that_are_not_finite_are_none, 49, 19),
]
CONFORMANCE = [
    *KERNEL_CASES,
    (conformance.test_terms_of_gaussians_and_their_gradients_are_those_of_the_reference, 0, 8.0),
    (conformance.test_convolutions_of_maps_and_their_gradients_are_those_of_the_reference, 64, 80),
]
every_case = pytest.mark.parametrize(
    "case", CONFORMANCE, ids=lambda case: "-".join([case[0].__name__, *map(str, case[1:])])
)


@pytest.fixture
def kernels() -> Any:
    """The backend if Warp is installed; it is called with tensors on the CPU."""
    if importlib.util.find_spec("warp") is None:
        pytest.skip("needs NVIDIA Warp: pip install 'tumble[cuda]'")
    return cuda


@every_case
def test_the_kernels_conform_on_the_cpu(kernels: Any, case: tuple[Callable[..., None], ...]) -> None:
    check, *arguments = case
    check(kernels, *arguments)


def test_hits_of_rays_along_the_axes_are_those_of_brute_force(kernels: Any) -> None:
    """Such rays lie in the sides of boxes, and the inverse of their direction is infinite."""
    cloud = [x.float() for x in cases.shell(300)]
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    starts = torch.tensor([[0.3, -0.2, 0.4], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    origins = (starts[None] - 2 * axes[:, None]).reshape(-1, 3)
    directions = axes.repeat_interleave(3, 0)
    hits = kernels.trace(kernels.build(*cloud), origins, directions, torch.zeros(0, 3))
    bvh = reference.build(*(x.double() for x in cloud))
    truth = reference.trace(bvh, origins.double(), directions.double(), torch.zeros(0, 3).double())
    assert (truth.hit >= 0).sum() > 5
    assert torch.equal(hits.hit, truth.hit)
    assert cases.difference(hits.transmittance, truth.transmittance) < conformance.RELATIVE


def projected(scene: cases.Scene, factor: int) -> tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], int, int]:
    """Records, depths and numbers of tiles of the Gaussians of a scene in a view of `factor` times its size."""
    from tumble.backends._warp import projection, runtime

    height, width = factor * scene.height, factor * scene.width
    *gaussians, _, R, t, focal = scene.inputs
    camera, n = torch.cat([R.flatten(), t, factor * focal]).float(), len(gaussians[0])
    prepared = torch.empty(n, 8, 4), torch.empty(n), torch.empty(n, dtype=torch.int32)
    with runtime.stream(camera.device):
        inputs = [x.float().contiguous() for x in gaussians]
        runtime.launch(projection.project_forward, n, *inputs, camera, height, width, *prepared)
    return prepared, height, width


def lists(scene: cases.Scene, factor: int, limit: cuda.PairLimit | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    from tumble.backends._warp import runtime

    prepared, height, width = projected(scene, factor)
    with runtime.stream(prepared[0].device):
        return cuda._bin(*prepared, height, width, limit)


def test_tile_lists_with_room_for_more_are_the_same_and_those_with_too_little_say_so(kernels: Any) -> None:
    """The limit is that of the first view of as many Gaussians, which is looked at after 1, 2, 4, ... views."""
    near, far = cases.hard(), cases.hard()
    far.inputs[7][2] += 30  # some hundred pairs less
    limit = cuda.PairLimit()
    for scene in (near, far, near):
        (starts, listed), (true_starts, true_listed) = lists(scene, 8, limit), lists(scene, 8)
        assert torch.equal(starts, true_starts)
        assert torch.equal(listed[: len(true_listed)], true_listed)
    n_pairs = len(lists(near, 8)[1])
    assert 2 * n_pairs <= limit.capacity < 4 * n_pairs
    limit = cuda.PairLimit()
    small = len(lists(far, 8, limit)[1])
    assert small < n_pairs
    starts, listed = lists(near, 8, limit)
    assert starts[-1] == small
    # Of every tile the first ones: the farthest Gaussians are left out.
    true_starts, true_listed = lists(near, 8)
    for tile, start in enumerate(starts[:-1]):
        kept = listed[start : starts[tile + 1]]
        assert torch.equal(kept, true_listed[true_starts[tile] :][: len(kept)])
    with pytest.warns(RuntimeWarning, match=f"left out {n_pairs - small} of {n_pairs} pairs"):
        starts, listed = lists(near, 8, limit)
    assert torch.equal(starts, true_starts)
    limit = cuda.PairLimit()
    for scene in (far, near):
        lists(scene, 8, limit)
    with pytest.warns(RuntimeWarning, match=f"left out {n_pairs - small} of {n_pairs} pairs"):
        lists(cases.easy(), 8, limit)  # another number of Gaussians
    for _ in range(20):
        lists(far, 8, limit)
    limit.look()  # without a warning, as before each view without gradients
    assert limit.views == 20


def test_tile_lists_hold_all_overlapping_tiles_and_hardly_any_other(kernels: Any) -> None:
    """Compared with the response of every Gaussian at every pixel."""
    scene = cases.hard()
    (_, depth, _), height, width = projected(scene, 8)
    starts, listed = lists(scene, 8)
    means, quats, scales, opacity, sh, _, R, t, focal = scene.inputs
    n = len(means)
    across, down = -(-width // 16), -(-height // 16)
    in_list = torch.zeros(across * down, n, dtype=torch.bool)
    in_list[torch.repeat_interleave(torch.arange(across * down), starts.diff().long()), listed.long()] = True
    view = reference.project(means, quats, scales, opacity, sh, R, t)
    touched = torch.zeros(across * down, n, dtype=torch.bool)
    for tile in range(across * down):
        y, x = 16 * (tile // across), 16 * (tile % across)
        square = slice(y, min(y + 16, height)), slice(x, min(x + 16, width))
        d = reference._rays(8 * focal, square)
        Wd = torch.einsum("vij,pj->pvi", view.WR_obj_cam, d)
        Wp = torch.einsum("vij,vj->vi", view.WR_obj_cam, view.p_cam)
        off = torch.linalg.cross(Wd, Wp.expand_as(Wd)).square().sum(-1) / Wd.square().sum(-1)
        alpha = opacity[view.index] * torch.exp(-0.5 * off)
        touched[tile, view.index] = (alpha >= backends.ALPHA_MIN).any(0)
    # Alphas close to the threshold may differ in float32.
    assert (touched & ~in_list).sum() <= 1e-3 * touched.sum()
    # Excess tiles: needles between pixel centres, and footprints that are a fiftieth of a pixel wider.
    assert (in_list & ~touched).sum() < 0.01 * touched.sum()
    ordered = depth[listed.long()].split(starts.diff().tolist())
    assert all((x.diff() >= 0).all() for x in ordered)


def test_every_kernel_compiles_for_a_gpu_without_having_one(kernels: Any) -> None:
    import warp

    from tests.backends import emulated_gpu

    if 90 not in warp.get_cuda_supported_archs():
        pytest.skip("this build of Warp has no compiler for sm_90")
    for path in emulated_gpu.ptx_files():
        assert b".target sm_90" in path.read_bytes()


def test_ready_returns_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "not torch.float32 on cpu" in cuda.ready(torch.device("cpu"), torch.float32)
    assert "not torch.float64 on cuda" in cuda.ready(GPU, torch.float64)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "driver" in cuda.ready(GPU, torch.float32)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "pip install 'tumble[cuda]'" in cuda.ready(GPU, torch.float32)
    backends._warn_once.cache_clear()
    with pytest.warns(RuntimeWarning, match="tumble\\[cuda\\]"):
        assert backends.choose(GPU, torch.float32) is reference
    backends._warn_once.cache_clear()


def test_warp_is_not_loaded_before_it_is_needed() -> None:
    program = (
        "import sys, torch; from tumble import backends\n"
        "for name in backends.names(): backends.load(name).ready(torch.device('cuda'), torch.float32)\n"
        "assert 'warp' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


# ------------------------------------------------------------------------------------------------ on a GPU


class OnGpu:
    """The backend wrapped for tensors on the CPU, which are copied to the GPU and back."""

    def __getattr__(self, verb: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            there = tree_map(lambda x: x.to(GPU) if isinstance(x, torch.Tensor) else x, arguments)
            result = getattr(cuda, verb)(*there)
            if verb == "adam":  # which changes its arguments
                for mine, changed in zip(tree_leaves(arguments), tree_leaves(there), strict=True):
                    if isinstance(mine, torch.Tensor):
                        mine.copy_(changed)
            if verb == "build":
                return result
            return tree_map(lambda x: x.cpu() if isinstance(x, torch.Tensor) else x, result)

        return call


@pytest.fixture
def on_gpu() -> Any:
    if reason := cuda.ready(GPU, torch.float32):
        pytest.skip(reason)
    return OnGpu()


@pytest.mark.gpu
@every_case
def test_the_kernels_conform_on_a_gpu(on_gpu: Any, case: tuple[Callable[..., None], ...]) -> None:
    check, *arguments = case
    check(on_gpu, *arguments)


@pytest.mark.gpu
def test_runs_on_a_gpu_differ_by_rounding_in_any_stream(on_gpu: Any) -> None:
    """The order of a few thousand atomic additions varies, and each is rounded to 6e-8."""
    scene = cases.hard()
    view, gradients = cases.render(on_gpu, scene, torch.float32)
    with torch.cuda.stream(torch.cuda.Stream()):
        again, gradients_again = cases.render(on_gpu, scene, torch.float32)
    assert torch.equal(view.rgb, again.rgb)
    pairs = zip([view.weight, *gradients], [again.weight, *gradients_again], strict=True)
    assert max(cases.difference(a, b) for a, b in pairs) < 1e-5


@pytest.mark.gpu
def test_tensors_on_a_gpu_choose_these_kernels(on_gpu: Any) -> None:
    assert backends.choose(GPU, torch.float32) is cuda
