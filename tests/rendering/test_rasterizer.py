"""Rasterization of one view: frames, names of features, and gradients to Gaussians, features and pose."""

import math

import pytest
import torch
from torch import Tensor

from tests.surfaces import GAMMA, look_at, sphere
from tumble.maths.se3 import SE3, SO3
from tumble.rendering.rasterizer import Buffers, rasterize
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians, constant_sh

CAMERA = Camera.from_fov(0.6, 48, 64)


def disc(mean: list[float], rotation: list[float], sigma: float = 0.06) -> Gaussians:
    """A disc at `mean`, whose normal is +z rotated by the rotation vector `rotation`."""
    quats = SO3.exp(torch.tensor([rotation])).wxyz
    log_scales = torch.tensor([[sigma, sigma, 0.1 * sigma]]).log()
    return Gaussians(torch.tensor([mean]), quats, log_scales, torch.zeros(1), constant_sh(torch.ones(1, 3)))


def centroid(alpha: Tensor) -> Tensor:
    weights = alpha / alpha.sum()
    uv = CAMERA.pixel_centers()
    return (uv * weights[..., None]).sum((0, 1))


def test_up_and_right_in_the_object_frame_is_up_and_right_in_the_image() -> None:
    """For a camera at -y with +z up, +x is to the right; the disc's normal is rotated from +z to -y."""
    view = rasterize(disc([0.4, 0, 0.3], [math.pi / 2, 0, 0]), GAMMA, look_at([0, -3, 0]), CAMERA, {})
    u, v = centroid(view.alpha).tolist()
    assert u > CAMERA.width / 2
    assert v < CAMERA.height / 2


def test_a_small_disc_is_rendered_at_the_projection_of_its_centre() -> None:
    T_cam_obj = look_at([0.4, -3, 0.5])
    gaussians = disc([0.3, 0, 0.2], [math.pi / 2, 0, 0])
    view = rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {})
    x_cam = (T_cam_obj @ gaussians.means)[0]
    # Perspective moves the centroid of a disc that is two pixels wide by a few hundredths of a pixel.
    torch.testing.assert_close(centroid(view.alpha), CAMERA.project(x_cam), atol=0.05, rtol=0)
    row, column = int(CAMERA.project(x_cam)[1]), int(CAMERA.project(x_cam)[0])
    assert view.dominant[row, column] == 0
    # The pixel is half a pixel off the centre of the disc, which nearly faces the camera.
    torch.testing.assert_close(view.depth[row, column], x_cam[2], atol=5e-3, rtol=0)
    torch.testing.assert_close(view.normal[row, column], torch.tensor([0.0, -1.0, 0.0]), atol=1e-5, rtol=0)


def test_features_are_returned_under_their_names() -> None:
    n = 400
    features = {
        "albedo": torch.tensor([0.2, 0.5, 0.7]).expand(n, 4, 3),
        "roughness": torch.full((n, 4, 1), 0.3),
        "normal_offset": torch.tensor([1.0, 2.0, -3.0]).expand(n, 4, 3),
    }
    view = rasterize(sphere(n), GAMMA, look_at([0, -4, 0]), CAMERA, features)
    assert list(view.features) == list(features)
    for name, values in features.items():
        inside = view.features[name][view.alpha > 0]
        # A sum of some twenty single-precision products over a weight as small as 1/255.
        torch.testing.assert_close(inside, values[0, 0].expand_as(inside), rtol=1e-4, atol=0)
        assert not view.features[name][view.alpha == 0].any()


def test_no_features_give_no_images() -> None:
    assert rasterize(sphere(50), GAMMA, look_at([0, -4, 0]), CAMERA, {}).features == {}


def test_constant_harmonics_have_the_given_colour_from_all_sides() -> None:
    gaussians = sphere(400)
    colour = torch.tensor([0.1, 0.9, 2.0])
    gaussians = Gaussians(
        gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sdf, constant_sh(colour.expand(400, 3))
    )
    for eye in ([0.0, -4.0, 0.0], [3.0, 1.0, -2.0]):
        view = rasterize(gaussians, GAMMA, look_at(eye), CAMERA, {})
        torch.testing.assert_close(view.rgb, view.alpha[..., None] * colour)


def test_only_pixels_under_the_mask_are_counted() -> None:
    T_cam_obj, gaussians = look_at([0, -4, 0]), sphere(400)
    mask = torch.zeros(CAMERA.height, CAMERA.width)
    mask[:, CAMERA.width // 2 :] = 1
    whole, right = (rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}, m) for m in (None, mask))
    left = rasterize(gaussians, GAMMA, T_cam_obj, CAMERA, {}, 1 - mask)
    assert torch.equal(left.touched + right.touched, whole.touched)
    assert right.touched.sum() > 0
    torch.testing.assert_close(right.weight, whole.weight)
    # The camera looks along +y with +x to the right: Gaussians on the left do not contribute to pixels on the right.
    assert not right.touched[gaussians.means[:, 0] < -0.5].any()


def test_no_gaussians_give_an_empty_image() -> None:
    empty = Gaussians(*(x[:0] for x in vars(sphere(1)).values()))
    view = rasterize(empty, GAMMA, look_at([0, -4, 0]), CAMERA, {"albedo": torch.zeros(0, 4, 3)})
    assert view.alpha.shape == (48, 64)
    assert not view.alpha.any()
    assert view.features["albedo"].shape == (48, 64, 3)


def test_both_precisions_render_the_same_image() -> None:
    single = rasterize(sphere(300), GAMMA, look_at([1, -4, 2]), CAMERA, {})
    double = rasterize(sphere(300, torch.float64), GAMMA.double(), look_at([1, -4, 2], torch.float64), CAMERA, {})
    for name in ("alpha", "rgb", "normal", "depth"):
        x, y = getattr(single, name), getattr(double, name)
        # In some pixels rounding moves a Gaussian across the threshold of the smallest alpha, 1/255.
        assert (x - y).abs().mean() < 1e-4, name


def wide(n: int = 5) -> list[Tensor]:
    """Translucent Gaussians wider than the image: no pixel is near a threshold, where derivatives do not exist."""
    torch.manual_seed(0)
    means = 0.3 * torch.randn(n, 3, dtype=torch.float64)
    quats = SO3.exp(torch.tensor([math.pi / 2, 0, 0]) + 0.2 * torch.randn(n, 3, dtype=torch.float64)).wxyz * 1.5
    log_scales = torch.tensor([1.3, 1.1, 0.2], dtype=torch.float64).log() + 0.1 * torch.rand(n, 3, dtype=torch.float64)
    sdf = 0.1 + 0.05 * torch.rand(n, dtype=torch.float64)
    sh = torch.cat([torch.full((n, 1, 3), 3.0, dtype=torch.float64), 0.2 * torch.randn(n, 3, 3).double()], 1)
    corners = torch.randn(n, 4, 2, dtype=torch.float64)
    return [means, quats, log_scales, sdf, sh, torch.tensor(9.0, dtype=torch.float64), corners]


@pytest.mark.parametrize("base", [look_at([0.2, -4, 0.3], torch.float64), look_at([1.0, -3.8, -0.6], torch.float64)])
def test_gradients_of_all_inputs_match_finite_differences(base: SE3) -> None:
    """The pose is parametrised by `SE3.exp`, as in an optimizer."""
    camera = Camera.from_fov(0.15, 4, 5)

    def buffers(tangent: Tensor, *raw: Tensor) -> tuple[Tensor, ...]:
        *geometry, gamma, corners = raw
        T_cam_obj = SE3.exp(tangent) @ base
        view: Buffers = rasterize(Gaussians(*geometry), gamma, T_cam_obj, camera, {"f": corners})
        assert view.alpha.min() > 0.5
        return view.alpha, view.depth, view.depth_var, view.normal, view.rgb, view.features["f"]

    inputs = [torch.zeros(6, dtype=torch.float64), *wide()]
    assert torch.autograd.gradcheck(buffers, [x.requires_grad_() for x in inputs], fast_mode=True)


def test_gradients_of_the_native_kernels_match_the_reference() -> None:
    """Single precision against double precision, which only the reference backend computes."""
    gradients = []
    for dtype in (torch.float32, torch.float64):
        base = look_at([1.0, -3.5, 2.0], dtype)
        raw = [x.detach().to(dtype).clone().requires_grad_() for x in vars(sphere(200, torch.float64)).values()]
        tangent, gamma = torch.zeros(6, dtype=dtype, requires_grad=True), GAMMA.to(dtype).clone().requires_grad_()
        corners = torch.linspace(0, 1, 200 * 4, dtype=dtype).view(200, 4, 1).clone().requires_grad_()
        view = rasterize(Gaussians(*raw), gamma, SE3.exp(tangent) @ base, CAMERA, {"f": corners})
        ramp = torch.linspace(0, 1, 64, dtype=dtype)
        loss = (view.rgb.sum(-1) * ramp).sum() + (view.depth * ramp).sum() + (view.features["f"][..., 0] * ramp).sum()
        gradients.append(torch.autograd.grad(loss + view.normal[..., 2].sum(), [tangent, *raw, corners]))
    for single, double in zip(*gradients, strict=True):
        # With 200 Gaussians, thresholds crossed by rounding have a visible effect.
        assert (single.double() - double).norm() <= 5e-3 * double.norm() + 1e-6
