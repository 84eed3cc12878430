"""Stage 2: the parts of one step."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from tumble.engine import optim
from tumble.engine.loop import State
from tumble.inverse_rendering import densify, refine
from tumble.inverse_rendering.refine import Params, Points
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.maths.directions import fibonacci_sphere
from tumble.maths.images import srgb_from_linear
from tumble.maths.points import morton_order
from tumble.maths.se3 import SE3, SO3, angle_between
from tumble.maths.spherical_harmonics import basis as basis_of_harmonics
from tumble.recipes import PAPER, SMOKE
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture, target_view
from tumble.scene.gaussians import Gaussians, constant_sh, opacity, quats_from_normals
from tumble.scene.trajectory import Trajectory

GAMMA = torch.tensor(30.0)


def textured_sphere() -> tuple[Points, SE3, Capture]:
    """A textured sphere, four poses, and a capture rendered at these poses."""
    rng = torch.Generator().manual_seed(1)
    means = torch.nn.functional.normalize(torch.randn(600, 3, generator=rng), dim=-1)
    flat = torch.tensor([-2.4, -2.4, -4.6]).expand(600, 3)
    gaussians = Gaussians(means, quats_from_normals(means), flat, torch.zeros(600), constant_sh(means * 0))
    logits = 4 * torch.sin(4 * means @ torch.tensor([[1.0, 2, -1], [2, -1, 1], [-1, 1, 2]]))
    points = Points(gaussians, logits, torch.zeros(600, 0, 3))
    axes = torch.tensor([[0.0, 0, 0], [0.0, 0.5, 0], [0.3, 0.7, 0.2], [0.5, 1.2, -0.4]])
    true = SE3.from_rotation(SO3.exp(axes), torch.tensor([0.02, 0.05, 4.0]).expand(4, 3).contiguous())
    light, camera = SHLight.constant(0.4, means), Camera.from_fov(0.6, 64, 64)
    R_env_obj = Trajectory(true, "camera").R_env_obj
    views = [refine.render(points, GAMMA, light, true[k], R_env_obj[k], camera) for k in range(4)]
    images = torch.stack([(srgb_from_linear(v.rgb).clamp(0, 1) * 255).round().to(torch.uint8) for v in views])
    masks = torch.stack([torch.where(v.alpha > 0.5, OBJECT, BACKGROUND) for v in views]).to(torch.uint8)
    return points, true, Capture(images, masks, camera, tuple("abcd"), "camera")


def test_alignment_corrects_wrong_poses_and_keeps_correct_ones() -> None:
    """Two of four initial poses have errors of half a degree and two degrees."""
    points, true, capture = textured_sphere()
    errors = torch.tensor([[0.0, 0, 0], [0.0087, 0, 0], [0.0, 0, 0], [0.02, -0.02, 0.02]])
    base = Trajectory(SE3.from_rotation(SO3.exp(errors) @ true.rotation, true.xyz), "camera")
    params = Params(points, GAMMA, SHLight.constant(0.4, errors), torch.zeros(4, 6))
    inputs = refine.Inputs(capture, base)
    for _ in range(4):
        refine._align_poses(inputs, State(0, params, None, torch.Generator(), {}))
    aligned = torch.stack([refine.pose(params, inputs, k).rotation.wxyz for k in range(4)])
    degrees = np.degrees(angle_between(SO3(aligned), true.rotation).numpy())
    # A tenth of a pixel, since the images are quantized and the masks binary.
    assert degrees.max() < 0.25, degrees


@pytest.mark.parametrize(("distance", "factor"), [(1.0, 8.0), (4.0, 1.0), (8.0, 1.0)])
def test_an_object_that_more_pixels_show_has_more_gaussians(distance: float, factor: float) -> None:
    _, true, capture = textured_sphere()
    focal = float(capture.camera.fx_fy_cx_cy[0])
    poses = SE3.from_rotation(true.rotation, torch.tensor([0.0, 0.0, distance]).expand(4, 3))
    # At a distance of 4 radii the object has the diameter for which the numbers are meant.
    cfg = replace(SMOKE.refine, points=100, hull=20, diameter=2 * focal / 4)
    grown = refine.for_resolution(cfg, refine.Inputs(capture, Trajectory(poses, "camera")))
    assert grown.densification.max_gaussians == factor * cfg.densification.max_gaussians
    assert (grown.points, grown.hull) == (100 * factor, round(20 * math.sqrt(factor)))


def with_a_hand(capture: Capture) -> Capture:
    """White pixels over the lower half of every image, which are unknown in the masks."""
    images, masks = capture.images.clone(), capture.masks.clone()
    images[:, 32:], masks[:, 32:] = 255, UNKNOWN
    return replace(capture, images=images, masks=masks)


def test_a_hand_has_no_residuals() -> None:
    points, true, capture = textured_sphere()
    params = Params(points, GAMMA, SHLight.constant(0.4, true.xyz), torch.zeros(4, 6))
    held = with_a_hand(capture)
    inputs = refine.Inputs(held, Trajectory(true, "camera"))
    away = SE3(true[1].wxyz, true[1].xyz + torch.tensor([0.1, 0.0, 0.0]))
    found = refine._residuals(params, inputs, 1, target_view(held, 1, GAMMA), None, away).reshape(64, 64, 4)
    assert found[:32].abs().amax((0, 1)).min() > 0.1
    assert not found[32:].any()


def test_a_hand_splits_no_gaussians() -> None:
    """The upper half of the images is as it is rendered; the lower one differs from it by nearly all."""
    points, true, capture = textured_sphere()
    cfg = replace(SMOKE.refine, densification=densify.Config(prune_opacity=0.0, prune_weight=-1.0))
    counts = []
    for masks in (with_a_hand(capture).masks, torch.full_like(capture.masks, OBJECT)):
        inputs = refine.Inputs(replace(with_a_hand(capture), masks=masks), Trajectory(true, "camera"))
        params = optim.leaves(Params(points, GAMMA, SHLight.constant(0.4, true.xyz), torch.zeros(4, 6)))
        optimizer, rng = optim.adam(params, refine._rates(cfg)), torch.Generator().manual_seed(0)
        memory = {"max_weight": torch.zeros(600), "watched_since": torch.tensor(0)}
        state = State(0, params, optimizer, rng, memory)
        refine._densify(cfg, inputs, state)
        counts.append(len(state.params.points.albedo_logits))
    assert counts == [600, 600 + 72]


def test_gaussians_that_no_frame_has_shown_since_the_last_densification_are_pruned() -> None:
    _, true, capture = textured_sphere()
    growth = densify.Config(max_gaussians=600, grow_score=math.inf, refine_every=1000)
    cfg = replace(SMOKE.refine, points=600, densification=growth)
    inputs = refine.Inputs(capture, Trajectory(true, "camera"))
    state = refine.init(cfg, inputs, torch.Generator().manual_seed(0))
    visible = []
    for state.step in range(1, 5):
        refine.step(cfg, inputs, state)
        visible.append(state.memory["max_weight"] > growth.prune_weight)
    # Gaussians that any frame has shown remain marked, and every frame hides the back side of the sphere.
    assert all((before <= after).all() for before, after in pairwise(visible))
    assert 0.2 < visible[0].float().mean() < 0.8 * visible[3].float().mean()
    state.memory["max_weight"][::3] = 0.9 * growth.prune_weight
    # Only one view is scored, but Gaussians that it hides are kept.
    state.step = 2 * len(capture) - 1
    refine._densify(replace(cfg, densification=replace(growth, score_views=1)), inputs, state)
    n_left = len(state.params.points.albedo_logits)
    assert n_left == (visible[3] & (torch.arange(600) % 3 > 0)).sum()
    assert torch.equal(state.memory["max_weight"], torch.zeros(n_left))


def test_no_gaussian_is_pruned_before_every_frame_could_have_shown_it() -> None:
    """Four frames in random order: seven steps contain every frame. New Gaussians are judged when all are."""
    _, true, capture = textured_sphere()
    growth = densify.Config(max_gaussians=700, bad_min_error=0.0, grow_score=0.0, grow_fraction=0.1)
    cfg = replace(SMOKE.refine, points=600, densification=growth)
    inputs = refine.Inputs(capture, Trajectory(true, "camera"))
    state = refine.init(cfg, inputs, torch.Generator().manual_seed(0))
    refine.step(cfg, inputs, state)
    shown = int((state.memory["max_weight"] > 0).sum())
    state.step = 6
    refine._densify(cfg, inputs, state)
    largest = state.memory["max_weight"]
    assert len(largest) > 600
    assert int(largest.isinf().sum()) == 2 * (len(largest) - 600)
    # Splits are of Gaussians that the views show, and each takes one of them away.
    assert int((largest > 0).sum() - largest.isinf().sum()) == shown - (len(largest) - 600)
    gaussians = state.params.points.gaussians.means
    assert len(gaussians) == len(largest)
    state.step = 7
    refine._densify(cfg, inputs, state)
    assert len(state.memory["max_weight"]) < 600
    assert not state.memory["max_weight"].any()
    assert int(state.memory["watched_since"]) == 7


def paper_like(every: int) -> refine.Config:
    """Stage 2 of PAPER with 600 Gaussians and 50 steps: densification before step 5, late pruning before step 10."""
    rules = densify.FastGS(reset_every=2 * every)
    growth = replace(PAPER.refine.densification, refine_every=every, refine_stop=0.1, fastgs=rules)
    return replace(PAPER.refine, steps=50, points=600, densification=growth, harmonics_every=0)


def test_the_papers_densification_limits_opacities_and_prunes_late() -> None:
    """At step 1 the limit is 0.8, at step 2 the one of a reset; at step 6 what has stayed faint is removed."""
    _, true, capture = textured_sphere()
    inputs, cfg = refine.Inputs(capture, Trajectory(true, "camera")), paper_like(1)
    state = refine.init(cfg, inputs, torch.Generator().manual_seed(0))
    largest = {}
    for state.step in range(1, 7):
        refine.prepare(cfg, inputs, state)
        sdf, gamma = state.params.points.gaussians.sdf.detach(), state.params.gamma.detach()
        largest[state.step] = float(opacity(sdf, gamma).max())
        assert len(state.memory["max_weight"]) == len(sdf)
        if state.step == 4:
            sdf[::2] = 0
    assert largest[1] == pytest.approx(0.8)
    assert largest[2] == pytest.approx(0.01)
    assert largest[6] == 1
    assert opacity(sdf, gamma).min() > 0.1


def test_harmonics_of_a_higher_degree_are_trained_later() -> None:
    _, true, capture = textured_sphere()
    inputs, cfg = refine.Inputs(capture, Trajectory(true, "camera")), replace(paper_like(100), harmonics_every=2)
    state = refine.init(cfg, inputs, torch.Generator().manual_seed(0))
    trained = []
    for state.step in range(8):
        refine.step(cfg, inputs, state)
        trained.append(int(state.params.points.sh_rest.detach().any(0).any(-1).sum()))
    assert trained == [0, 0, 3, 3, 8, 8, 15, 15]


def test_gaussians_stay_in_morton_order_and_keep_their_moments() -> None:
    def means_and_moments() -> list[tuple[torch.Tensor, torch.Tensor]]:
        means = state.params.points.gaussians.means
        assert state.optimizer is not None
        return list(zip(means.detach(), state.optimizer.state_of(means)["exp_avg"], strict=True))

    _, true, capture = textured_sphere()
    growth = densify.Config(max_gaussians=700, grow_score=-0.5, prune_opacity=0.0, prune_weight=-1.0, refine_every=1000)
    cfg = replace(SMOKE.refine, points=600, densification=growth)
    inputs = refine.Inputs(capture, Trajectory(true, "camera"))
    state = refine.init(cfg, inputs, torch.Generator().manual_seed(0))
    assert torch.equal(morton_order(state.params.points.gaussians.means.detach()), torch.arange(600))
    refine.step(cfg, inputs, state)
    moments = {tuple(x.tolist()): moment for x, moment in means_and_moments()}
    refine._densify(cfg, inputs, state)
    after = means_and_moments()
    assert len(after) == 600 + 72  # the fraction that is split
    assert torch.equal(morton_order(torch.stack([x for x, _ in after])), torch.arange(len(after)))
    kept = [(x, moment) for x, moment in after if tuple(x.tolist()) in moments]
    assert len(kept) == 600 - 72
    assert any(bool(moment.any()) for _, moment in kept)
    for x, moment in kept:
        assert torch.equal(moment, moments[tuple(x.tolist())])


def test_the_weight_of_the_gamma_term_is_the_stated_one() -> None:
    """All signed distances are 0, so that the median is the floor: 2 acosh(sqrt 2) / 0.02 - 30, times the weight."""
    points, true, capture = textured_sphere()
    params = Params(points, GAMMA, SHLight.constant(0.4, true.xyz), torch.zeros(4, 6))
    R_env_obj = Trajectory(true, "camera").R_env_obj[0]
    view = refine.render(points, GAMMA, params.light, true[0], R_env_obj, capture.camera)
    cfg = replace(SMOKE.refine, weights=replace(SMOKE.refine.weights, gamma=5.0))
    terms = refine._terms(cfg, params, view, capture, 0, true[0], 1.0)
    assert float(terms["gamma"]) == pytest.approx(5 * (2 * math.acosh(math.sqrt(2)) / 0.02 - 30), rel=1e-5)


def test_static_radiance_becomes_the_albedo_under_a_uniform_light() -> None:
    """Radiance 0.5 + 0.3 n.d in view direction d: its cosine-weighted mean over the front, where n.d < 0, is 0.3."""
    points, true, capture = textured_sphere()
    d_obj = fibonacci_sphere(64)
    basis = basis_of_harmonics(d_obj, 3)
    wanted = 0.5 + 0.3 * points.gaussians.means @ d_obj.T
    sh = torch.linalg.lstsq(basis, wanted.T).solution.T[..., None].expand(-1, -1, 3)
    points = replace(points, gaussians=replace(points.gaussians, sh=sh[:, :1]), sh_rest=sh[:, 1:])
    params = Params(points, GAMMA, SHLight.constant(0.4, points.albedo_logits), torch.zeros(4, 6))
    inputs = refine.Inputs(capture, Trajectory(true, "camera"))
    refined = refine.finish(refine.Config(colour="sh"), inputs, State(0, params, None, torch.Generator()))
    seen = refined.albedo * refined.light.diffuse(points.gaussians.means)
    torch.testing.assert_close(seen, torch.full_like(seen, 0.3), atol=0.01, rtol=0)
