"""Losses: zero for perfect inputs, correct values and gradients elsewhere."""

import math

import pytest
import torch

from tumble.inverse_rendering import losses
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians

CAMERA = Camera.from_fov(math.radians(40), 32, 40)


def test_equal_images_have_no_loss_and_unknown_pixels_do_not_count() -> None:
    torch.manual_seed(0)
    image = torch.rand(32, 40, 3)
    valid = torch.ones(32, 40, 1)
    # SSIM of equal images is 1 up to the rounding of its variances.
    assert losses.photometric(image, image, valid, ssim_weight=0.2) < 1e-6
    other = image.clone()
    other[:8] = torch.rand(8, 40, 3)
    valid[:8] = 0
    assert losses.photometric(other, image, valid, ssim_weight=0.2) < 1e-6
    assert losses.photometric(other, image, torch.ones_like(valid), ssim_weight=0.2) > 0.01


def test_the_loss_of_a_window_is_that_of_the_whole_image() -> None:
    """The window touches the top of the image and has the margin of the SSIM at the other sides."""
    torch.manual_seed(0)
    rendered, photo = torch.zeros(2, 40, 50, 3, dtype=torch.float64)
    rendered[:8, 20:29], photo[:9, 21:28] = torch.rand(8, 9, 3), torch.rand(9, 7, 3)
    valid = torch.ones(40, 50, 1)
    whole = losses.photometric(rendered, photo, valid, ssim_weight=0.2)
    part = [x[:19, 10:39] for x in (rendered, photo, valid)]
    torch.testing.assert_close(losses.photometric(*part, ssim_weight=0.2, size=(40, 50)), whole)


def test_brighter_renderings_are_tolerated_at_saturated_pixels_only() -> None:
    linear = torch.tensor([[[1.5, 1.5, 0.2]]], requires_grad=True)
    photo = torch.tensor([[[1.0, 0.9, 1.0]]])
    srgb = losses.srgb_as_captured(linear, photo)
    srgb.sum().backward()
    assert srgb[0, 0, 0] == 1.0
    assert srgb[0, 0, 1] > 1.0
    assert linear.grad[0, 0].tolist()[0] == 0.0
    assert (linear.grad[0, 0, 1:] > 0).all(), "pixels that are too bright, or too dark where saturated, have a gradient"


def plane(normal_obj: torch.Tensor, T_cam_obj: SE3) -> torch.Tensor:
    """Depth map of a plane through the object's origin."""
    n_cam = T_cam_obj.rotation @ normal_obj
    ray = CAMERA.unproject(CAMERA.pixel_centers(), torch.ones(32, 40))
    return (n_cam @ T_cam_obj.xyz) / (ray @ n_cam)


def test_the_depth_of_a_plane_gives_the_normal_of_the_plane() -> None:
    T_cam_obj = SE3.from_rotation(SO3.exp(torch.tensor([0.4, -0.3, 0.8])), torch.tensor([0.1, 0.0, 4.0]))
    n_obj = T_cam_obj.rotation.inverse() @ torch.nn.functional.normalize(torch.tensor([0.3, -0.5, -1.0]), dim=-1)
    covered = torch.ones(32, 40, dtype=torch.bool)
    covered[:, :5] = False
    normals, known = losses.surface_normals(plane(n_obj, T_cam_obj), covered, CAMERA, T_cam_obj)
    assert not known[0].any()
    assert not known[:, :6].any()
    assert known[1:-1, 6:-1].all()
    torch.testing.assert_close(normals[known], n_obj.expand_as(normals[known]), atol=2e-4, rtol=0)
    assert losses.normal_consistency(n_obj.expand(32, 40, 3), normals, known) < 1e-6
    assert losses.normal_consistency(-n_obj.expand(32, 40, 3), normals, known) > 1.0


def test_the_normal_term_saturates_at_creases() -> None:
    up, known = torch.tensor([0.0, 0.0, 1.0]).expand(4, 5, 3), torch.ones(4, 5, dtype=torch.bool)

    def term(degrees: float, crease: float) -> float:
        a = math.radians(degrees)
        leaning = torch.tensor([math.sin(a), 0.0, math.cos(a)]).expand(4, 5, 3)
        return float(losses.normal_consistency(leaning, up, known, crease=crease))

    assert term(90, 0.0) == pytest.approx(1.0)
    assert term(90, 25.0) == pytest.approx(1 / 26)
    # Small differences are not affected.
    assert term(2, 25.0) == pytest.approx(term(2, 0.0), rel=0.02)


def test_the_silhouette_loss_uses_known_pixels_only() -> None:
    mask, valid = torch.zeros(4, 4), torch.ones(4, 4, 1)
    alpha = torch.zeros(4, 4)
    alpha[0, 0] = 1.0
    assert losses.silhouette(alpha, mask, valid) == pytest.approx(1 / 16)
    valid[0, 0] = 0
    assert losses.silhouette(alpha, mask, valid) == 0


def test_discs_and_spheres_have_no_rank_penalty_but_needles_have() -> None:
    def penalty(*scales: float) -> float:
        log_scales = torch.tensor([scales]).log()
        return float(losses.effective_rank(log_scales) - scales[2])

    assert penalty(0.1, 0.1, 0.1) == pytest.approx(0, abs=1e-7)
    assert penalty(0.1, 0.1, 1e-6) == pytest.approx(0, abs=1e-4)
    # exp(entropy) of fractions (.8, .2) is 1.649, so -log(.649) = .432.
    assert penalty(0.2, 0.1, 1e-6) == pytest.approx(0.432, abs=2e-3)
    assert penalty(0.1, 1e-4, 1e-6) > 2


def test_gamma_is_raised_until_the_median_gaussian_is_half_opaque() -> None:
    sdf = torch.tensor([-0.1, 0.05, 0.2], requires_grad=True)
    target = 1.762747 / 0.1
    gamma = torch.tensor(10.0, requires_grad=True)
    loss = losses.sharpness(sdf, gamma, floor=0.02)
    loss.backward()
    assert loss.item() == pytest.approx(target - 10, abs=1e-4)
    assert gamma.grad == -1
    assert sdf.grad is None
    assert losses.sharpness(sdf, torch.tensor(30.0), floor=0.02) == 0


def test_gaussians_at_their_signed_distance_from_the_surface_have_no_projection_loss() -> None:
    T_cam_obj = SE3.from_rotation(SO3.identity(), torch.tensor([0.0, 0.0, 4.0]))
    n = torch.tensor([0.0, 0.0, -1.0])
    depth = plane(n, T_cam_obj)
    sdf = torch.tensor([0.03, -0.02, 0.0])
    means = torch.tensor([[0.1, 0.2, 0.0], [-0.2, 0.1, 0.0], [0.0, 0.0, 0.0]]) + sdf[:, None] * n
    quats = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(3, 4)
    gaussians = Gaussians(means, quats, torch.full((3, 3), -3.0), sdf, torch.zeros(3, 1, 3))
    visible = torch.ones(3, dtype=torch.bool)
    assert losses.projection(gaussians, visible, depth, CAMERA, T_cam_obj, reach=0.1) < 1e-5
    moved = Gaussians(means + 0.05 * n, quats, gaussians.log_scales, sdf, gaussians.sh)
    assert losses.projection(moved, visible, depth, CAMERA, T_cam_obj, reach=0.1) == pytest.approx(0.05, abs=1e-4)
    far = Gaussians(means + 0.5 * n, quats, gaussians.log_scales, sdf, gaussians.sh)
    assert losses.projection(far, visible, depth, CAMERA, T_cam_obj, reach=0.1) == 0


def test_gaussians_that_are_hidden_or_behind_the_camera_have_no_projection_loss() -> None:
    T_cam_obj = SE3.from_rotation(SO3.exp(torch.tensor([0.2, 0.1, -0.3])), torch.tensor([0.0, 0.0, 4.0]))
    T_cam_obj = SE3(T_cam_obj.wxyz.double(), T_cam_obj.xyz.double())
    rng = torch.Generator().manual_seed(0)
    means = 0.2 * torch.randn(6, 3, generator=rng, dtype=torch.float64)
    means[4] = T_cam_obj.inverse().xyz  # at the camera centre
    means[5] *= -30
    sdf, quats = means[:, 0] * 0.1, torch.randn(6, 4, generator=rng, dtype=torch.float64)
    visible = torch.tensor([True, True, False, True, True, True])
    depth = torch.full((32, 40), 4.0, dtype=torch.float64)

    def loss(means: torch.Tensor, sdf: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
        gaussians = Gaussians(means, quats, means, sdf, means[:, None])
        return losses.projection(gaussians, visible, depth, CAMERA, T_cam_obj, reach=1.0)

    inputs = [x.detach().requires_grad_() for x in (means, sdf, quats)]
    x_cam = T_cam_obj @ (means - sdf[:, None] * Gaussians(means, quats, means, sdf, means[:, None]).normals)
    assert loss(*inputs).item() == pytest.approx(float((x_cam[[0, 1, 3], 2] - 4).abs().sum() / 5))
    assert torch.autograd.gradcheck(loss, inputs)


def test_depth_without_variance_has_no_loss() -> None:
    assert losses.variance(torch.zeros(3, 3)) == pytest.approx(0, abs=1e-7)
    assert losses.variance(torch.full((3, 3), 0.01)) == pytest.approx(0.1, abs=2e-3)
