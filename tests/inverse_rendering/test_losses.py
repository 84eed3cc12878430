"""Losses: zero for perfect inputs, correct values and gradients elsewhere."""

import math
from typing import Any

import pytest
import torch

from tumble.inverse_rendering import losses
from tumble.maths.images import linear_from_srgb
from tumble.maths.se3 import SE3, SO3
from tumble.rendering.rasterizer import Buffers
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN
from tumble.scene.gaussians import Gaussians

CAMERA = Camera.from_fov(math.radians(40), 32, 40)


FACING = SE3.from_rotation(SO3.identity(), torch.tensor([0.0, 0.0, 4.0]))


def view_of(*, features: dict[str, torch.Tensor] | None = None, **images: torch.Tensor) -> Buffers:
    """Buffers of a covered view with the given images; the others are flat."""
    flat = torch.ones(32, 40)
    given = {"alpha": flat, "depth": 4 * flat, "depth_var": 0 * flat, "normal": flat[..., None].expand(-1, -1, 3)}
    given |= {"rgb": torch.zeros(32, 40, 3), "weight": torch.ones(1)} | images
    touched, dominant = (given["weight"] > 0).int(), torch.zeros(32, 40).int()
    return Buffers(**given, features=features or {}, touched=touched, dominant=dominant)


def terms_of(view: Buffers, photo: torch.Tensor, mask: torch.Tensor, T_cam_obj: SE3 = FACING, **options: float) -> Any:
    return losses.image_terms(view, photo, mask, CAMERA, T_cam_obj, **{"ssim_weight": 0.2, "crease": 0.0} | options)


def random_photo(seed: int) -> torch.Tensor:
    return torch.randint(0, 250, (32, 40, 3), generator=torch.Generator().manual_seed(seed)).to(torch.uint8)


def test_equal_images_have_no_loss_and_unknown_pixels_do_not_count() -> None:
    photo, mask = random_photo(0), torch.full((32, 40), OBJECT, dtype=torch.uint8)
    view = view_of(rgb=linear_from_srgb(photo / 255))
    # SSIM of equal images is 1 up to the rounding of its variances.
    assert terms_of(view, photo, mask)["render"] < 1e-6
    photo[:8] = random_photo(1)[:8]
    assert terms_of(view, photo, mask)["render"] > 0.01
    mask[:8] = UNKNOWN
    assert terms_of(view, photo, mask)["render"] < 1e-6


def test_images_smaller_than_the_window_of_ssim_are_refused() -> None:
    small, no = Camera.from_fov(0.7, 10, 40), torch.zeros(10, 40, dtype=torch.uint8)
    with pytest.raises(ValueError, match="smaller than the window"):
        losses.image_terms(view_of(), no[..., None].expand(-1, -1, 3), no, small, FACING, ssim_weight=0.2)


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
    depth, photo = plane(n_obj, T_cam_obj), random_photo(0)
    mask = torch.full((32, 40), OBJECT, dtype=torch.uint8)

    def term(normal: torch.Tensor, alpha: torch.Tensor) -> float:
        view = view_of(depth=depth, normal=normal.expand(32, 40, 3), alpha=alpha)
        return float(terms_of(view, photo, mask, T_cam_obj)["normal"])

    covered = torch.ones(32, 40)
    assert term(n_obj, covered) < 1e-6
    # All pixels but those of the border have four neighbours; the length of a normal does not count.
    assert term(-3 * n_obj, covered) == pytest.approx(2 * 30 * 38 / (32 * 40), rel=1e-4)
    covered[:, :5] = 0.4
    assert term(-n_obj, covered) == pytest.approx(2 * 30 * 33 / (32 * 40), rel=1e-4)


def test_the_normal_term_saturates_at_creases() -> None:
    photo, mask = random_photo(0), torch.full((32, 40), OBJECT, dtype=torch.uint8)
    inner = 30 * 38 / (32 * 40)

    def term(degrees: float, crease: float) -> float:
        a = math.radians(degrees)
        leaning = torch.tensor([math.sin(a), 0.0, -math.cos(a)]).expand(32, 40, 3)
        depth = plane(torch.tensor([0.0, 0.0, -1.0]), FACING)
        return float(terms_of(view_of(depth=depth, normal=leaning), photo, mask, crease=crease)["normal"])

    assert term(90, 0.0) == pytest.approx(inner)
    assert term(90, 25.0) == pytest.approx(inner / 26)
    # Small differences are not affected.
    assert term(2, 25.0) == pytest.approx(term(2, 0.0), rel=0.02)


def test_the_mask_term_uses_known_pixels_only() -> None:
    mask, alpha = torch.zeros(32, 40, dtype=torch.uint8), torch.zeros(32, 40)
    alpha[0, 0] = 1.0
    view = view_of(alpha=alpha, features={"material": torch.zeros(32, 40, 7)})

    def terms() -> list[float]:
        both = terms_of(view, random_photo(0), mask), losses.material_terms(view, random_photo(0), mask)
        return [float(found["mask"]) for found in both]

    assert terms() == pytest.approx([1 / 1280] * 2)
    mask[0, 0] = UNKNOWN
    assert terms() == [0, 0]


def test_the_material_term_counts_edges_less_where_the_photo_has_edges() -> None:
    """Albedo is 0.5 in the left half of the object; the silhouette is an edge, too."""
    mask, material = torch.zeros(32, 40, dtype=torch.uint8), torch.zeros(32, 40, 7)
    mask[:, :20] = OBJECT
    material[:, :10, :3] = 0.5
    flat, view = torch.full((32, 40, 3), 90, dtype=torch.uint8), view_of(features={"material": material})
    plain = losses.material_terms(view, flat, mask)["material"]
    assert plain == pytest.approx(0.5 * 3 * 32 / (4 * 32 * 39))
    edge = flat.clone()
    edge[:, :10] = 243  # 0.6 brighter
    assert losses.material_terms(view, edge, mask)["material"] == pytest.approx(math.exp(-0.6) * float(plain))
    material[:, :20, 3] = 0.2
    assert losses.material_terms(view, flat, mask)["material"] == pytest.approx(float(plain) * (1 + 0.2 / 1.5))


def gaussian_terms(
    gaussians: Gaussians, gamma: torch.Tensor, view: Buffers | None = None, T_cam_obj: SE3 = FACING, **options: float
) -> Any:
    view = view or view_of(weight=torch.ones(len(gaussians)))
    limits = {"floor": 0.02, "reach": 0.1} | options
    return losses.gaussian_terms(gaussians, gamma, view, CAMERA, T_cam_obj, **limits)


def scaled(log_scales: torch.Tensor, sdf: torch.Tensor) -> Gaussians:
    n = len(sdf)
    return Gaussians(
        torch.zeros(n, 3), torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4), log_scales, sdf, torch.zeros(n, 1, 3)
    )


def test_discs_and_spheres_have_no_rank_penalty_but_needles_have() -> None:
    def penalty(*scales: float) -> float:
        log_scales = torch.tensor([scales]).log()
        return float(gaussian_terms(scaled(log_scales, torch.zeros(1)), torch.tensor(1.0))["rank"] - scales[2])

    assert penalty(0.1, 0.1, 0.1) == pytest.approx(0, abs=1e-7)
    assert penalty(0.1, 0.1, 1e-6) == pytest.approx(0, abs=1e-4)
    # exp(entropy) of fractions (.8, .2) is 1.649, so -log(.649) = .432.
    assert penalty(0.2, 0.1, 1e-6) == pytest.approx(0.432, abs=2e-3)
    assert penalty(0.1, 1e-4, 1e-6) > 2


def test_gamma_is_raised_until_the_median_gaussian_is_half_opaque() -> None:
    sdf = torch.tensor([-0.1, 0.05, 0.2], requires_grad=True)
    target = 1.762747 / 0.1
    gamma = torch.tensor(10.0, requires_grad=True)
    loss = gaussian_terms(scaled(torch.zeros(3, 3), sdf), gamma)["gamma"]
    loss.backward()
    assert loss.item() == pytest.approx(target - 10, abs=1e-4)
    assert gamma.grad == -1
    assert sdf.grad is None or not sdf.grad.any()
    assert gaussian_terms(scaled(torch.zeros(3, 3), sdf), torch.tensor(30.0))["gamma"] == 0


def test_gaussians_at_their_signed_distance_from_the_surface_have_no_projection_loss() -> None:
    T_cam_obj = SE3.from_rotation(SO3.identity(), torch.tensor([0.0, 0.0, 4.0]))
    n = torch.tensor([0.0, 0.0, -1.0])
    depth = plane(n, T_cam_obj)
    sdf = torch.tensor([0.03, -0.02, 0.0])
    means = torch.tensor([[0.1, 0.2, 0.0], [-0.2, 0.1, 0.0], [0.0, 0.0, 0.0]]) + sdf[:, None] * n
    quats = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(3, 4)
    gaussians = Gaussians(means, quats, torch.full((3, 3), -3.0), sdf, torch.zeros(3, 1, 3))
    view, gamma = view_of(depth=depth, weight=torch.ones(3)), torch.tensor(1.0)
    assert gaussian_terms(gaussians, gamma, view, T_cam_obj)["proj"] < 1e-5
    moved = Gaussians(means + 0.05 * n, quats, gaussians.log_scales, sdf, gaussians.sh)
    assert gaussian_terms(moved, gamma, view, T_cam_obj)["proj"] == pytest.approx(0.05, abs=1e-4)
    far = Gaussians(means + 0.5 * n, quats, gaussians.log_scales, sdf, gaussians.sh)
    assert gaussian_terms(far, gamma, view, T_cam_obj)["proj"] == 0


def test_gaussians_that_are_hidden_or_behind_the_camera_have_no_projection_loss() -> None:
    T_cam_obj = SE3.from_rotation(SO3.exp(torch.tensor([0.2, 0.1, -0.3])), torch.tensor([0.0, 0.0, 4.0]))
    T_cam_obj = SE3(T_cam_obj.wxyz.double(), T_cam_obj.xyz.double())
    rng = torch.Generator().manual_seed(0)
    means = 0.2 * torch.randn(6, 3, generator=rng, dtype=torch.float64)
    means[4] = T_cam_obj.inverse().xyz  # at the camera centre
    means[5] *= -30
    sdf, quats = means[:, 0] * 0.1, torch.randn(6, 4, generator=rng, dtype=torch.float64)
    visible = torch.tensor([True, True, False, True, True, True])
    depth, gamma = torch.full((32, 40), 4.0, dtype=torch.float64), torch.tensor(1.0).double()

    def loss(means: torch.Tensor, sdf: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
        gaussians = Gaussians(means, quats, means, sdf, means[:, None])
        view = view_of(depth=depth, weight=visible.double())
        return gaussian_terms(gaussians, gamma, view, T_cam_obj, reach=1.0)["proj"]

    inputs = [x.detach().requires_grad_() for x in (means, sdf, quats)]
    x_cam = T_cam_obj @ (means - sdf[:, None] * Gaussians(means, quats, means, sdf, means[:, None]).normals)
    assert loss(*inputs).item() == pytest.approx(float((x_cam[[0, 1, 3], 2] - 4).abs().sum() / 5))
    assert torch.autograd.gradcheck(loss, inputs)


def test_depth_without_variance_has_no_loss() -> None:
    photo, mask = random_photo(0), torch.full((32, 40), OBJECT, dtype=torch.uint8)
    assert terms_of(view_of(), photo, mask)["variance"] == pytest.approx(0, abs=1e-7)
    view = view_of(depth_var=torch.full((32, 40), 0.01))
    assert terms_of(view, photo, mask)["variance"] == pytest.approx(0.1, abs=2e-3)


def test_mask_entropy_is_the_binary_cross_entropy_of_known_pixels() -> None:
    mask = torch.tensor([[OBJECT, OBJECT, BACKGROUND, UNKNOWN]], dtype=torch.uint8)
    alpha = torch.tensor([[0.25, 1.0, 0.5, 0.1]], requires_grad=True)
    loss = losses.mask_entropy(alpha, mask)
    assert loss.item() == pytest.approx((math.log(4) + math.log(2)) / 4, rel=1e-4)
    loss.backward()
    assert alpha.grad is not None
    # d/da of -log a and -log(1 - a), over four pixels; none where coverage is clamped or the mask unknown.
    torch.testing.assert_close(alpha.grad, torch.tensor([[-1.0, 0.0, 0.5, 0.0]]))
