"""Every loss is zero where it must be, and points the right way elsewhere."""

import math

import pytest
import torch

from tumble.inverse_rendering import losses
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians

CAMERA = Camera.from_fov(math.radians(40), 32, 40)


def test_equal_pictures_cost_nothing_and_unknown_pixels_do_not_count() -> None:
    torch.manual_seed(0)
    picture = torch.rand(32, 40, 3)
    valid = torch.ones(32, 40, 1)
    # SSIM of equal pictures is 1 up to the rounding of its variances.
    assert losses.photometric(picture, picture, valid, ssim_weight=0.2) < 1e-6
    other = picture.clone()
    other[:8] = torch.rand(8, 40, 3)
    valid[:8] = 0
    assert losses.photometric(other, picture, valid, ssim_weight=0.2) < 1e-6
    assert losses.photometric(other, picture, torch.ones_like(valid), ssim_weight=0.2) > 0.01


def test_a_window_of_a_picture_costs_what_the_picture_does() -> None:
    """Black around; the window reaches the picture's top, and has room for SSIM's on the other sides."""
    torch.manual_seed(0)
    rendered, photograph = torch.zeros(2, 40, 50, 3, dtype=torch.float64)
    rendered[:8, 20:29], photograph[:9, 21:28] = torch.rand(8, 9, 3), torch.rand(9, 7, 3)
    valid = torch.ones(40, 50, 1)
    whole = losses.photometric(rendered, photograph, valid, ssim_weight=0.2)
    part = [x[:19, 10:39] for x in (rendered, photograph, valid)]
    torch.testing.assert_close(losses.photometric(*part, ssim_weight=0.2, size=(40, 50)), whole)


def test_only_saturated_pixels_forgive_brightness() -> None:
    linear = torch.tensor([[[1.5, 1.5, 0.2]]], requires_grad=True)
    photograph = torch.tensor([[[1.0, 0.9, 1.0]]])
    developed = losses.developed(linear, photograph)
    developed.sum().backward()
    assert developed[0, 0, 0] == 1.0
    assert developed[0, 0, 1] > 1.0
    assert linear.grad[0, 0].tolist()[0] == 0.0
    assert (linear.grad[0, 0, 1:] > 0).all(), "a pixel that is too bright, or too dark for saturation, has a gradient"


def plane(normal_obj: torch.Tensor, T_cam_obj: SE3) -> torch.Tensor:
    """Depth of a plane through the object's origin."""
    n_cam = T_cam_obj.rotation @ normal_obj
    ray = CAMERA.unproject(CAMERA.pixel_centers(), torch.ones(32, 40))
    return (n_cam @ T_cam_obj.xyz) / (ray @ n_cam)


def test_normals_of_a_plane_are_the_planes() -> None:
    T_cam_obj = SE3.from_rotation(SO3.exp(torch.tensor([0.4, -0.3, 0.8])), torch.tensor([0.1, 0.0, 4.0]))
    n_obj = T_cam_obj.rotation.inverse() @ torch.nn.functional.normalize(torch.tensor([0.3, -0.5, -1.0]), dim=-1)
    covered = torch.ones(32, 40, dtype=torch.bool)
    covered[:, :5] = False
    found, known = losses.surface_normals(plane(n_obj, T_cam_obj), covered, CAMERA, T_cam_obj)
    assert not known[0].any()
    assert not known[:, :6].any()
    assert known[1:-1, 6:-1].all()
    torch.testing.assert_close(found[known], n_obj.expand_as(found[known]), atol=2e-4, rtol=0)
    assert losses.normal_consistency(n_obj.expand(32, 40, 3), found, known) < 1e-6
    assert losses.normal_consistency(-n_obj.expand(32, 40, 3), found, known) > 1.0


def test_a_crease_counts_no_more_than_its_share() -> None:
    up, known = torch.tensor([0.0, 0.0, 1.0]).expand(4, 5, 3), torch.ones(4, 5, dtype=torch.bool)

    def term(degrees: float, crease: float) -> float:
        a = math.radians(degrees)
        leaning = torch.tensor([math.sin(a), 0.0, math.cos(a)]).expand(4, 5, 3)
        return float(losses.normal_consistency(leaning, up, known, crease=crease))

    assert term(90, 0.0) == pytest.approx(1.0)
    assert term(90, 25.0) == pytest.approx(1 / 26)
    # Small differences count as ever.
    assert term(2, 25.0) == pytest.approx(term(2, 0.0), rel=0.02)


def test_silhouette_counts_known_pixels_alone() -> None:
    mask, valid = torch.zeros(4, 4), torch.ones(4, 4, 1)
    alpha = torch.zeros(4, 4)
    alpha[0, 0] = 1.0
    assert losses.silhouette(alpha, mask, valid) == pytest.approx(1 / 16)
    valid[0, 0] = 0
    assert losses.silhouette(alpha, mask, valid) == 0


def test_discs_and_balls_have_no_rank_penalty_but_needles_do() -> None:
    def penalty(*scales: float) -> float:
        log_scales = torch.tensor([scales]).log()
        return float(losses.effective_rank(log_scales) - scales[2])

    assert penalty(0.1, 0.1, 0.1) == pytest.approx(0, abs=1e-7)
    assert penalty(0.1, 0.1, 1e-6) == pytest.approx(0, abs=1e-4)
    # exp(entropy) of shares (.8, .2) is 1.649, so -log(.649) = .432.
    assert penalty(0.2, 0.1, 1e-6) == pytest.approx(0.432, abs=2e-3)
    assert penalty(0.1, 1e-4, 1e-6) > 2


def test_sharpness_is_pushed_up_to_the_median_and_no_further() -> None:
    sdf = torch.tensor([-0.1, 0.05, 0.2], requires_grad=True)
    wanted = 1.762747 / 0.1
    gamma = torch.tensor(10.0, requires_grad=True)
    loss = losses.sharpness(sdf, gamma, floor=0.02)
    loss.backward()
    assert loss.item() == pytest.approx(wanted - 10, abs=1e-4)
    assert gamma.grad == -1
    assert sdf.grad is None
    assert losses.sharpness(sdf, torch.tensor(30.0), floor=0.02) == 0


def test_gaussians_off_the_surface_by_their_own_distance_project_to_nothing() -> None:
    T_cam_obj = SE3.from_rotation(SO3.identity(), torch.tensor([0.0, 0.0, 4.0]))
    n = torch.tensor([0.0, 0.0, -1.0])
    depth = plane(n, T_cam_obj)
    sdf = torch.tensor([0.03, -0.02, 0.0])
    means = torch.tensor([[0.1, 0.2, 0.0], [-0.2, 0.1, 0.0], [0.0, 0.0, 0.0]]) + sdf[:, None] * n
    quats = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(3, 4)
    gaussians = Gaussians(means, quats, torch.full((3, 3), -3.0), sdf, torch.zeros(3, 1, 3))
    seen = torch.ones(3, dtype=torch.bool)
    assert losses.projection(gaussians, seen, depth, CAMERA, T_cam_obj, reach=0.1) < 1e-5
    moved = Gaussians(means + 0.05 * n, quats, gaussians.log_scales, sdf, gaussians.sh)
    assert losses.projection(moved, seen, depth, CAMERA, T_cam_obj, reach=0.1) == pytest.approx(0.05, abs=1e-4)
    far = Gaussians(means + 0.5 * n, quats, gaussians.log_scales, sdf, gaussians.sh)
    assert losses.projection(far, seen, depth, CAMERA, T_cam_obj, reach=0.1) == 0


def test_what_a_view_does_not_show_or_lies_behind_it_is_not_projected() -> None:
    T_cam_obj = SE3.from_rotation(SO3.exp(torch.tensor([0.2, 0.1, -0.3])), torch.tensor([0.0, 0.0, 4.0]))
    T_cam_obj = SE3(T_cam_obj.wxyz.double(), T_cam_obj.xyz.double())
    rng = torch.Generator().manual_seed(0)
    means = 0.2 * torch.randn(6, 3, generator=rng, dtype=torch.float64)
    means[4] = T_cam_obj.inverse().xyz  # in the camera itself
    means[5] *= -30
    sdf, quats = means[:, 0] * 0.1, torch.randn(6, 4, generator=rng, dtype=torch.float64)
    seen = torch.tensor([True, True, False, True, True, True])
    depth = torch.full((32, 40), 4.0, dtype=torch.float64)

    def loss(means: torch.Tensor, sdf: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
        gaussians = Gaussians(means, quats, means, sdf, means[:, None])
        return losses.projection(gaussians, seen, depth, CAMERA, T_cam_obj, reach=1.0)

    inputs = [x.detach().requires_grad_() for x in (means, sdf, quats)]
    x_cam = T_cam_obj @ (means - sdf[:, None] * Gaussians(means, quats, means, sdf, means[:, None]).normals)
    assert loss(*inputs).item() == pytest.approx(float((x_cam[[0, 1, 3], 2] - 4).abs().sum() / 5))
    assert torch.autograd.gradcheck(loss, inputs)


def test_depth_without_spread_costs_nothing() -> None:
    assert losses.variance(torch.zeros(3, 3)) == pytest.approx(0, abs=1e-7)
    assert losses.variance(torch.full((3, 3), 0.01)) == pytest.approx(0.1, abs=2e-3)
